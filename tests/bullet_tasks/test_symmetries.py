"""A robot in a world that is turned lives through the same, and observes the same but for the turn of what it is told."""

import math

import gymnasium
import numpy as np
import pytest

import bullet_tasks  # noqa: F401
from bullet_tasks.tasks.base import Start

TASKS = ("MidpointChoice-v0", "MidpointChoiceDepth-v0", "StairwaySearchDepth-v0")


def turn_the_world(task, times):
    """Let a task's episodes take place by so many quarters of the circle further round."""
    reset, angle = task.reset, 0.5 * math.pi * times

    def turned(x, y):
        return x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)

    def turned_reset(rng):
        start = reset(rng)
        task.goal, task.dead_zones = turned(*task.goal), tuple(turned(*zone) for zone in task.dead_zones)
        placements = {name: ((*turned(x, y), z), yaw + angle) for name, ((x, y, z), yaw) in start.placements.items()}
        return Start(*turned(start.x, start.y), start.yaw + angle, placements)

    task.reset = turned_reset


@pytest.mark.parametrize("times", [1, 2, 3])
@pytest.mark.parametrize("name", TASKS)
def test_a_turned_world_is_the_same_to_the_robot(name, times):
    env, other = (gymnasium.make(name, physics="compiled").unwrapped for _ in range(2))
    turn_the_world(other.task, times)
    common, privileged = env.symmetries[times - 1]
    rng, told = np.random.default_rng(0), 0
    for seed in range(6):
        (here, _), (there, _) = env.reset(seed=seed), other.reset(seed=seed)
        over = False
        while not over:
            np.testing.assert_allclose(there["common"], common @ here["common"], atol=1e-5)
            np.testing.assert_allclose(there["privileged"], privileged @ here["privileged"], atol=1e-6)
            # A ray that grazes an edge may fall on either side of it.
            far = np.abs(there["target"].astype(float) - here["target"]) > 0.01 * env.observation_space["target"].high.max()
            assert far.mean() < 0.02
            told += (here["target"] != np.median(here["target"])).mean() > 0.1
            action = rng.uniform(-1.0, 1.0, env.action_space.shape) + [0.0, 0.5][: env.action_space.shape[0]]
            here, reward, over, _, info = env.step(action)
            there, other_reward, other_over, _, other_info = other.step(action)
            assert over == other_over and info["is_success"] == other_info["is_success"]
            assert other_reward == pytest.approx(reward, abs=1e-4)
    assert told > 10
