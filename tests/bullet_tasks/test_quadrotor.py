"""Laws of the quadrotors: what they are told becomes of them, the same in every physics as far as it can be."""

import math

import numpy as np
import pytest

from bullet_tasks.ends import Outcome
from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.quadrotor import make_quadrotor
from bullet_tasks.robots.quadrotor_body import DRAG, GRAVITY, HALF_EXTENTS, MASS, Aloft, QuadrotorCommand
from bullet_tasks.robots.quadrotor_ends import HoverEnds, HoverLimits
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

PHYSICS = ("compiled", "kinematic", "full")
FLOOR_TOP = 0.7  # m; not 0, so that heights above the floor and above zero differ
SCENE = SceneSpec((Box("floor", (0.0, 0.0, FLOOR_TOP - 0.05), (30.0, 30.0, 0.05), floor=True),))


@pytest.fixture
def make():
    worlds = []

    def make(physics, altitude=2.0, roll=0.0, pitch=0.0, yaw=0.0):
        worlds.append(World(SCENE))
        robot = make_quadrotor(worlds[-1], lambda: Aloft(altitude, roll, pitch), physics)
        robot.reset(1.0, 2.0, FLOOR_TOP, yaw)
        return robot

    yield make
    for world in worlds:
        world.close()


def fly(robot, seconds, *command):
    robot.command(QuadrotorCommand(*command))
    return [robot.substep() for _ in range(round(seconds / robot.substep_period))]


@pytest.mark.parametrize("physics", PHYSICS)
def test_a_command_is_reached_and_kept(make, physics):
    robot = make(physics)
    for roll, pitch, altitude in ((0.2, -0.1, 1.0), (-0.3, 0.25, 3.0), (0.0, 0.0, 0.5)):
        state = fly(robot, 5.0, roll, pitch, altitude)[-1]
        assert (state.roll, state.pitch, state.altitude) == pytest.approx((roll, pitch, altitude), abs=3e-3)
        assert (state.roll_rate, state.pitch_rate, state.yaw_rate, state.vz) == pytest.approx((0.0,) * 4, abs=3e-3)
        assert state.z == pytest.approx(FLOOR_TOP + HALF_EXTENTS[2] + state.altitude)
        assert not (state.landed or state.in_contact)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_tilt_drifts_towards_the_low_side_up_to_a_final_speed(make, physics, yaw):
    state = fly(make(physics, yaw=yaw), 8.0, 0.0, 0.1, 2.0)[-1]
    final = GRAVITY * math.tan(0.1) / DRAG
    assert (state.vx, state.vy) == pytest.approx((final * math.cos(yaw), final * math.sin(yaw)), abs=0.02)
    state = fly(make(physics, yaw=yaw), 8.0, 0.1, 0.0, 2.0)[-1]
    assert (state.vx, state.vy) == pytest.approx((final * math.sin(yaw), -final * math.cos(yaw)), abs=0.02)
    assert state.yaw == pytest.approx(yaw, abs=0.02)


@pytest.mark.parametrize("physics", PHYSICS)
def test_a_tilted_body_lands_on_its_feet_and_takes_off_again(make, physics):
    robot = make(physics, altitude=0.5, roll=0.2, pitch=-0.15)
    states = fly(robot, 3.0, 0.2, -0.15, -0.3)
    touched = [state.in_contact for state in states]
    assert not touched[0] and touched[-1] and states[-1].landed
    first = touched.index(True)
    assert 0.2 < states[first].impact < 1.2
    assert states[first].impact_tilt == pytest.approx(0.25, abs=0.03)
    assert (states[-1].roll, states[-1].pitch, states[-1].altitude) == pytest.approx((0.0, 0.0, 0.0), abs=3e-3)
    assert (states[-1].vx, states[-1].vy, states[-1].vz) == pytest.approx((0.0, 0.0, 0.0), abs=3e-3)
    assert all(s.altitude > -0.01 for s in states), "nobody sinks into the ground"
    state = fly(robot, 4.0, 0.0, 0.0, 1.0)[-1]
    assert not state.landed and state.altitude == pytest.approx(1.0, abs=3e-3)


def random_flight(robot, seed):
    """States after every substep under random commands, half of which lead to the ground."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(20):
        command = (*rng.uniform(-0.25, 0.25, 2), rng.choice((-0.4, 0.7)))
        for s in fly(robot, 0.8, *command):
            rows.append((s.x, s.y, s.z, s.roll, s.pitch, s.roll_rate, s.pitch_rate, s.vz, s.landed, s.in_contact, s.impact))
    return np.array(rows)


def test_the_compiled_one_is_the_kinematic_one(make):
    landed = 0.0
    for seed in range(8):
        reference, ours = (random_flight(make(physics), seed) for physics in ("kinematic", "compiled"))
        assert np.allclose(ours, reference, rtol=0.0, atol=1e-9)
        landed += reference[:, 8].mean() / 8
        assert reference[:, 2].max() > FLOOR_TOP + 0.5
    assert 0.1 < landed < 0.9, "the flights are about landing and taking off"


def test_pybullet_and_the_compiled_ground_agree_to_a_hundredth_of_a_millimetre(make):
    robot = make("kinematic")
    touched = []
    for roll, pitch in np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2)):
        for gap in (-1e-5, 1e-5):
            height = kernels.TOUCH + gap + kernels.reach_down(robot._body, roll, pitch)
            robot._flight[[kernels.Z, kernels.ROLL, kernels.PITCH]] = height, roll, pitch
            touched.append(robot._touches())
            assert touched[-1] == kernels.touches(robot._flight, robot._body) == (gap < 0.0), (roll, pitch, gap)
    assert sum(touched) == 50


def test_the_full_one_flies_like_the_others(make):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        pair = [make("compiled"), make("full")]
        for _ in range(10):
            command = (*rng.uniform(-0.25, 0.25, 2), rng.uniform(1.0, 3.0))
            one, other = (fly(robot, 0.2, *command)[-1] for robot in pair)
            # Rotors lag behind by 0.02 s.
            assert one.altitude == pytest.approx(other.altitude, abs=0.06)
            assert (one.roll, one.pitch) == pytest.approx((other.roll, other.pitch), abs=0.06)
            assert (one.x, one.y) == pytest.approx((other.x, other.y), abs=0.3)


def test_a_judge_taken_along_ends_a_flight_where_one_that_is_asked_does(make):
    outcomes = []
    for altitude in (-0.6, 0.0, 1.5):
        limits = HoverLimits(crash_speed=0.5, hold_time=0.5)
        along, asked = make("compiled"), make("kinematic")
        for robot in (along, asked):
            robot.command(QuadrotorCommand(0.0, 0.0, altitude))
        stretches = [robot.advance(300, HoverEnds(limits)) for robot in (along, asked)]
        assert stretches[0] == stretches[1]
        assert along.state.time == asked.state.time
        outcomes.append(stretches[0].outcome)
    assert outcomes == [Outcome.FAILURE, Outcome.RUNNING, Outcome.SUCCESS]


def test_rotors_of_a_level_hover_carry_the_weight_and_turn_nothing(make):
    robot = make("full")
    wrench = kernels.spin(robot._flight, robot._command, robot._body, robot._rotors, robot._thrusts)
    assert wrench == pytest.approx((0.0, 0.0, MASS * GRAVITY, 0.0, 0.0, 0.0), abs=1e-12)
    assert robot._thrusts == pytest.approx([0.25 * MASS * GRAVITY] * 4)


@pytest.mark.parametrize(("roll", "pitch"), [(0.1, 0.0), (0.0, 0.1)])
def test_more_thrust_on_one_side_lifts_it(make, roll, pitch):
    robot = make("full")
    robot.command(QuadrotorCommand(roll, pitch, 2.0))
    wrench = kernels.spin(robot._flight, robot._command, robot._body, robot._rotors, robot._thrusts)
    left_front, right_front, left_rear, right_rear = robot._thrusts
    assert (wrench[3] > 0.0, wrench[4] > 0.0) == (roll > 0.0, pitch > 0.0)
    assert (left_front > right_front) == (left_rear > right_rear) == (roll > 0.0)
    assert (left_rear > left_front) == (right_rear > right_front) == (pitch > 0.0)
    assert sum(robot._thrusts) == pytest.approx(MASS * GRAVITY)


def test_thrusts_have_limits(make):
    robot = make("full")
    for altitude in (1e6, -1e6):
        robot.command(QuadrotorCommand(10.0, 0.0, altitude))
        for _ in range(100):
            kernels.spin(robot._flight, robot._command, robot._body, robot._rotors, robot._thrusts)
        assert robot._thrusts.min() == pytest.approx(0.0, abs=1e-6)
        assert robot._thrusts.max() <= 0.5 * MASS * GRAVITY + 1e-12


def test_unknown_physics_is_refused():
    with pytest.raises(ValueError, match=r"'magic'.*compiled.*full.*kinematic"):
        make_quadrotor(World(SCENE), lambda: Aloft(1.0, 0.0, 0.0), "magic")
