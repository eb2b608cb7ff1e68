"""Laws of a varied quadrotor: an episode is its seed, no two land alike, and without variation it is the compiled body."""

import numpy as np
import pytest

from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.quadrotor import make_quadrotor
from bullet_tasks.robots.quadrotor_body import (
    ALTITUDE_GAIN,
    BANDWIDTH,
    DRAG,
    SETTLING_TIME,
    SPEED_GAIN,
    Aloft,
    QuadrotorCommand,
)
from bullet_tasks.robots.varied_quadrotor import FlightVariation, VariedQuadrotor
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

NO_SHAKING = dict(shaking_rate=0.0, shaking_speed=0.0, shaking_tilt=0.0)
NONE = FlightVariation(
    bandwidth=(BANDWIDTH,) * 2,
    altitude_gain=(ALTITUDE_GAIN,) * 2,
    speed_gain=(SPEED_GAIN,) * 2,
    drag=(DRAG,) * 2,
    settling=(SETTLING_TIME,) * 2,
    **NO_SHAKING,
)


@pytest.fixture
def world():
    world = World(SceneSpec((Box("floor", (0.0, 0.0, -0.05), (30.0, 30.0, 0.05), floor=True),)))
    yield world
    world.close()


def launch():
    return Aloft(1.0, 0.1, -0.1)


def row(state):
    return (state.x, state.y, state.z, state.roll, state.pitch)


def readings(state):
    return (*row(state)[3:], state.roll_rate, state.pitch_rate, state.yaw_rate, state.vz)


def fly(robot, seed=0, told=1):
    """States of a flight with random commands, half of which lead to the ground, the body drawn from a seed."""
    robot.vary(np.random.default_rng(seed))
    robot.reset(0.0, 0.0, 0.0, 0.0)
    rng, states = np.random.default_rng(told), []
    for _ in range(20):
        robot.command(QuadrotorCommand(*rng.uniform(-0.25, 0.25, 2), rng.choice((-0.4, 0.7))))
        states += [robot.substep() for _ in range(40)]
    return states


def table(states):
    return np.array([(*row(state), *readings(state), state.landed) for state in states])


def test_without_variation_it_is_the_compiled_body_bit_for_bit(world):
    ours, reference = VariedQuadrotor(world, launch, NONE), make_quadrotor(world, launch, "compiled")
    np.testing.assert_array_equal(table(fly(ours)), table(fly(reference)))


def test_every_episode_has_a_body_of_its_own_that_its_seed_repeats(world):
    robot = make_quadrotor(world, launch, "varied")
    first, second, again = (table(fly(robot, seed)) for seed in (1, 2, 1))
    assert np.abs(first - second)[:, 2].max() > 0.02
    np.testing.assert_array_equal(first, again)


def test_bodies_are_spread_over_their_ranges(world):
    robot, rng = VariedQuadrotor(world, launch), np.random.default_rng(0)
    drawn = []
    for _ in range(500):
        robot.vary(rng)
        drawn.append(
            robot._body[[kernels.BANDWIDTH, kernels.ALTITUDE_GAIN, kernels.SPEED_GAIN, kernels.DRAG, kernels.SETTLING]]
        )
    v = robot.variation
    ranges = np.array([v.bandwidth, v.altitude_gain, v.speed_gain, v.drag, v.settling])
    least, greatest, width = np.min(drawn, axis=0), np.max(drawn, axis=0), ranges[:, 1] - ranges[:, 0]
    assert (least >= ranges[:, 0]).all() and (least < ranges[:, 0] + 0.02 * width).all()
    assert (greatest <= ranges[:, 1]).all() and (greatest > ranges[:, 1] - 0.02 * width).all()


def test_readings_shake_on_the_ground_only_and_by_no_more_than_the_errors(world):
    still, shaken = (
        VariedQuadrotor(world, launch, FlightVariation(**errors))
        for errors in (NO_SHAKING, dict(shaking_rate=2.0, shaking_speed=0.5, shaking_tilt=0.02))
    )
    pairs = list(zip(fly(still), fly(shaken), strict=True))
    errors = np.array([np.subtract(readings(b), readings(a)) for a, b in pairs])
    on_ground = np.array([a.in_contact for a, _ in pairs])
    assert 0.1 < on_ground.mean() < 0.9, "the flight is about landing and taking off"
    assert (errors[~on_ground] == 0.0).all()
    bounds = np.array((0.02, 0.02, 2.0, 2.0, 2.0, 0.5))
    np.testing.assert_allclose(np.abs(errors[on_ground]).max(axis=0), bounds, rtol=0.1)
    assert (np.abs(errors[on_ground]) <= bounds + 1e-12).all()
    # The body itself does not shake.
    assert all(a[:4] == b[:4] and a.landed == b.landed for a, b in pairs)
