"""Hand-written policies that show what a task allows, and a loop that runs them."""

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import numpy as np

from bullet_tasks.tasks.navigation import MAX_TURN

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]

POSITION_SCALE = 8.0  # m, of the pose in `common`
LOOK_AHEAD = 1.0  # m
GOAL_BEHIND = 3.56  # m; walking on the middle line, a robot this far out has passed the rim of any goal circle


class Episode(NamedTuple):
    """What became of an episode."""

    success: bool
    decisions: int
    terminated: bool
    rewards: list[float]
    infos: list[dict]


def walk(observation: dict[str, np.ndarray], direction: float) -> np.ndarray:
    """
    Walk along the middle line of the corridor.

    :param observation: ``common`` is read, nothing else
    :param direction: 1 towards +x, -1 towards -x
    """
    _, y, cos_yaw, sin_yaw = map(float, observation["common"])
    heading = math.atan2(-y * POSITION_SCALE, direction * LOOK_AHEAD)
    turn = math.remainder(heading - math.atan2(sin_yaw, cos_yaw), math.tau)
    return np.array([max(-1.0, min(1.0, turn / MAX_TURN))], dtype=np.float32)


def informed(observation: dict[str, np.ndarray]) -> np.ndarray:
    """
    Walk straight to the goal, which only a privileged robot can.

    :param observation: with ``privileged``
    """
    return walk(observation, math.copysign(1.0, float(observation["privileged"][0])))


def misled(observation: dict[str, np.ndarray]) -> np.ndarray:
    """
    Walk straight to the wrong end.

    :param observation: with ``privileged``
    """
    return walk(observation, -math.copysign(1.0, float(observation["privileged"][0])))


class Blind:
    """
    The best that a robot without privileged knowledge can do: one end first, then the other.

    :param first: the end to look at first, 1 or -1; by default the one that the robot faces at the start
    """

    def __init__(self, first: float | None = None) -> None:
        self.direction = first

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else
        """
        x = float(observation["common"][0]) * POSITION_SCALE
        if self.direction is None:
            self.direction = math.copysign(1.0, float(observation["common"][2]))
        if self.direction * x > GOAL_BEHIND:
            self.direction = -self.direction
        return walk(observation, self.direction)


def run_episode(env: gymnasium.Env, policy: Policy, seed: int | None = None) -> Episode:
    """
    Run one episode.

    :param env: the environment
    :param policy: observation -> action
    :param seed: of the episode
    """
    observation, _ = env.reset(seed=seed)
    rewards, infos = [], []
    while True:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rewards.append(float(reward))
        infos.append(info)
        if terminated or truncated:
            return Episode(info["is_success"], len(rewards), terminated, rewards, infos)
