"""What the goal-finding tasks of the quadruped share: observation of the pose, heading action, rewards and ends."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from bullet_tasks.ends import Ends
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped_body import WALKING_SPEED, QuadrupedCommand
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Shape
from bullet_tasks.tasks.base import Outcome, Task
from bullet_tasks.tasks.configuration import check_positive

POSITION_SCALE = 8.0
"""Positions are observed in units of this length, m (the authors' release)."""
MAX_TURN = math.pi / 4.0
"""Heading change that the action 1 asks for, rad. The release asks for up to pi, anew every 20 ms; the robot turns at 2 rad/s,
so no decision of 0.25 s can turn it further than this range allows, and a larger one would only make most actions the same."""
FALL_HEIGHT = -0.25
"""A robot over ground lower than this has fallen, m (the authors' release)."""
_MARGIN = 0.1  # m; a robot is that far beyond a floor's edge at most before it has fallen


@dataclass(frozen=True)
class NavigationReward:
    """
    Reward weights, the same for all tasks of the authors' release.

    :param goal_progress: per m by which the distance to the goal decreases
    :param heading_progress: per rad by which the absolute heading error to the goal decreases
    :param collision: per s of contact (the release: -0.06 per 20 ms)
    :param goal_bonus: once, at the goal
    :param time_bonus: once, at the goal, times the fraction of the episode's time that is left
    """

    goal_progress: float = 4.0
    heading_progress: float = 2.0
    collision: float = -3.0
    goal_bonus: float = 4.0
    time_bonus: float = 2.0


class NavigationTask(Task):
    """
    Walk at constant speed to a goal on a platform, steering by heading.

    A subclass sets ``scene`` and draws ``goal`` in ``reset``, and ``dead_zones`` where the task has any: the middles of
    circles as wide as the goal's, in which an episode ends as a failure.

    :param decision_period: s
    :param time_limit: s
    :param goal_radius: the base's centre within this distance of the goal has reached it, m
    :param reward: weights
    :raises ValueError: if a time or the radius is not positive, or the periods do not fit into the time limit; from setting
        ``scene``, if a floor reaches further than ``POSITION_SCALE`` or nobody could fall from it
    """

    def __init__(self, decision_period: float, time_limit: float, goal_radius: float, reward: NavigationReward) -> None:
        self.decision_period = decision_period
        self.time_limit = time_limit
        self.goal_radius = goal_radius
        check_positive(self, "decision_period", "time_limit", "goal_radius")
        if decision_period > time_limit:
            raise ValueError(f"`decision_period` ({decision_period} s) must not exceed `time_limit` ({time_limit} s).")
        self.reward = reward
        self.goal = (0.0, 0.0)
        self.dead_zones: tuple[tuple[float, float], ...] = ()
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.common_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._distance = 0.0
        self._heading_error = 0.0

    @property
    def scene(self) -> SceneSpec:
        """The world as it is built."""
        return self._whole_scene

    @scene.setter
    def scene(self, scene: SceneSpec) -> None:
        if scene.lower_ground >= FALL_HEIGHT:
            raise ValueError(
                f"The ground beside the floor, at {scene.lower_ground} m, must be lower than {FALL_HEIGHT} m, where a robot "
                "has fallen: raise `drop`."
            )
        reach = max((_reach(shape) for shape in scene.shapes if shape.floor and shape.top > FALL_HEIGHT), default=0.0)
        if reach > POSITION_SCALE - _MARGIN:
            raise ValueError(
                f"The floor reaches {reach:.2f} m from the middle, but positions are observed in units of {POSITION_SCALE} m: "
                f"it may reach {POSITION_SCALE - _MARGIN} m."
            )
        self._whole_scene = scene

    @abstractmethod
    def privileged(self) -> np.ndarray:
        """What only training knows in this episode (see base class)."""

    def begin(self, state: RobotState, scene: SceneSpec) -> None:
        """
        Measure distance and heading error, and lay out the ends: goal circle, dead zones, drops (see base class).

        :param state: of the robot
        :param scene: the world of this episode
        """
        radius = self.goal_radius
        circles = [(*self.goal, radius, Outcome.SUCCESS), *((*zone, radius, Outcome.FAILURE) for zone in self.dead_zones)]
        self.judge = Ends(circles, scene, FALL_HEIGHT)
        self._distance, self._heading_error = self._to_goal(state)

    def _to_goal(self, state: RobotState) -> tuple[float, float]:
        """Distance (m) and absolute heading error (rad, at most pi) to the goal."""
        dx, dy = self.goal[0] - state.x, self.goal[1] - state.y
        return math.hypot(dx, dy), abs(math.remainder(math.atan2(dy, dx) - state.yaw, math.tau))

    def command(self, action: Sequence[float], state: RobotState) -> QuadrupedCommand:
        """
        Turn by up to ``MAX_TURN`` either way, always walking (see base class).

        :param action: turn in units of ``MAX_TURN``, ``(1,)``
        :param state: of the robot, now
        """
        return QuadrupedCommand(WALKING_SPEED, state.yaw + MAX_TURN * action[0])

    def reward_terms(self, state: RobotState, contact_time: float, time_left: float, outcome: Outcome) -> dict[str, float]:
        """
        Progress, collisions and bonus (see base class and ``NavigationReward``).

        :param state: of the robot, after the decision
        :param contact_time: s
        :param time_left: fraction of the episode's time that is left
        :param outcome: how the episode stands
        """
        reward = self.reward
        distance, heading_error = self._to_goal(state)
        terms = {
            "goal_progress": reward.goal_progress * (self._distance - distance),
            "heading_progress": reward.heading_progress * (self._heading_error - heading_error),
            "collision": reward.collision * contact_time if contact_time else 0.0,
            "goal_bonus": reward.goal_bonus + reward.time_bonus * time_left if outcome is Outcome.SUCCESS else 0.0,
        }
        self._distance, self._heading_error = distance, heading_error
        return terms

    def common(self, state: RobotState) -> np.ndarray:
        """
        Pose of the base: x and y in units of 8 m, cosine and sine of the yaw; float32 ``(4,)``.

        :param state: of the robot
        """
        pose = (state.x / POSITION_SCALE, state.y / POSITION_SCALE, math.cos(state.yaw), math.sin(state.yaw))
        return np.array(pose, dtype=np.float32)


def _reach(shape: Shape) -> float:
    """The greatest absolute x or y of a shape's points, m."""
    x, y = abs(shape.centre[0]), abs(shape.centre[1])
    if not isinstance(shape, Box):
        return max(x, y) + shape.radius
    c, s = abs(math.cos(shape.yaw)), abs(math.sin(shape.yaw))
    half_x, half_y, _ = shape.half_extents
    return max(x + c * half_x + s * half_y, y + s * half_x + c * half_y)
