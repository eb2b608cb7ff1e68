"""Laws of domain randomisation: an episode is its seed, no two are alike, and without variation it is the compiled body."""

import math

import numpy as np
import pytest

from bullet_tasks import kernels
from bullet_tasks.robots.quadruped import (
    BODY_RADIUS,
    MAX_YAW_RATE,
    SUBSTEP,
    WALKING_SPEED,
    QuadrupedCommand,
    Variation,
    VariedQuadruped,
    make_quadruped,
)
from bullet_tasks.robots.quadruped_body import YAW_GAIN
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

WALL = Box("wall", (2.0, 0.0, 0.5), (0.1, 3.0, 1.0))
NONE = Variation(
    radius=(BODY_RADIUS,) * 2,
    max_yaw_rate=(MAX_YAW_RATE,) * 2,
    yaw_gain=(YAW_GAIN,) * 2,
    yaw_acceleration=(1e9,) * 2,
    speed=(1.0, 1.0),
    heading_error=0.0,
    pitch_error=0.0,
)


@pytest.fixture
def world():
    world = World(SceneSpec((WALL,)))
    yield world
    world.close()


def walk(robot, seed=0):
    """States of a walk with random turns, the body drawn from a seed."""
    robot.vary(np.random.default_rng(seed))
    robot.reset(0.0, 0.0, 0.0, 0.0)
    rng, states = np.random.default_rng(1), []
    for _ in range(40):
        robot.command(QuadrupedCommand(WALKING_SPEED, robot.state.yaw + rng.uniform(-1.0, 1.0)))
        states += [robot.substep() for _ in range(5)]
    return np.array([(*state[:6], state.pitch) for state in states])


def test_without_variation_it_is_the_compiled_body_bit_for_bit(world):
    np.testing.assert_array_equal(walk(VariedQuadruped(world, NONE)), walk(make_quadruped(world, "compiled")))


def test_every_episode_has_a_body_of_its_own_that_its_seed_repeats(world):
    robot = make_quadruped(world, "varied")
    first, second, again = walk(robot, 1), walk(robot, 2), walk(robot, 1)
    assert np.abs(first - second).max() > 0.1
    np.testing.assert_array_equal(first, again)


def test_bodies_are_spread_over_their_ranges(world):
    robot, drawn = VariedQuadruped(world), []
    rng = np.random.default_rng(0)
    for _ in range(500):
        robot.vary(rng)
        drawn.append(robot._body[[kernels.RADIUS, kernels.MAX_YAW_RATE, kernels.YAW_GAIN, kernels.YAW_ACCELERATION]])
    v = robot.variation
    ranges = np.array([v.radius, v.max_yaw_rate, v.yaw_gain, v.yaw_acceleration])
    least, greatest, width = np.min(drawn, axis=0), np.max(drawn, axis=0), ranges[:, 1] - ranges[:, 0]
    assert (least >= ranges[:, 0]).all() and (least < ranges[:, 0] + 0.02 * width).all()
    assert (greatest <= ranges[:, 1]).all() and (greatest > ranges[:, 1] - 0.02 * width).all()


def test_turns_set_in_and_end_no_faster_than_the_acceleration_allows(world):
    robot = VariedQuadruped(world, Variation(yaw_acceleration=(10.0, 10.0)))
    rates = np.diff(walk(robot)[:, 3], prepend=0.0) / SUBSTEP
    changes = np.abs(np.diff(rates, prepend=0.0))
    assert changes.max() == pytest.approx(10.0 * SUBSTEP)


@pytest.mark.parametrize("error", [0.0, 0.2])
@pytest.mark.parametrize("name", ["heading_error", "pitch_error"])
def test_commands_are_off_by_no_more_than_the_error(world, name, error):
    robot = VariedQuadruped(world, Variation(**{name: error}))
    robot.vary(np.random.default_rng(0))
    reached = []
    for _ in range(30):
        robot.reset(-2.0, 0.0, 0.0, 0.0)
        robot.command(QuadrupedCommand(0.0, 0.5, 0.1))
        for _ in range(60):
            robot.substep()
        reached.append(robot.state.yaw - 0.5 if name == "heading_error" else robot.state.pitch - 0.1)
    assert np.abs(reached).max() <= error + 1e-3
    assert np.std(reached) == pytest.approx(error / math.sqrt(3.0), rel=0.3, abs=1e-3)
