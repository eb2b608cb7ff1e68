"""Laws of the quadrupeds without legs: they follow their command exactly unless something is in their way."""

import itertools
import math

import numpy as np
import pytest

from bullet_tasks.robots.quadruped import (
    BODY_HEIGHT,
    BODY_RADIUS,
    MAX_YAW_RATE,
    WALKING_SPEED,
    QuadrupedCommand,
    make_quadruped,
)
from bullet_tasks.robots.quadruped_body import CONTACT_FORCE
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

SUBSTEP = 1.0 / 20.0
WALL = Box("wall", (2.0, 0.0, 0.5), (0.1, 3.0, 1.0))
DEAD_END = (
    Box("end", (1.0, 0.0, 0.5), (0.1, 1.0, 0.5)),
    Box("left", (0.0, 0.35, 0.5), (1.0, 0.1, 0.5)),
    Box("right", (0.0, -0.35, 0.5), (1.0, 0.1, 0.5)),
)


@pytest.fixture(params=["kinematic", "compiled"])
def make(request):
    """Makes a robot in a world of some shapes."""
    worlds = []

    def make(*shapes):
        worlds.append(World(SceneSpec(shapes)))
        return make_quadruped(worlds[-1], request.param)

    yield make
    for world in worlds:
        world.close()


@pytest.fixture
def robot(make):
    return make()


def walk(robot, target_yaw, seconds):
    robot.command(QuadrupedCommand(WALKING_SPEED, target_yaw))
    return [robot.substep() for _ in range(round(seconds / SUBSTEP))]


def test_a_straight_walk_is_exact(robot):
    robot.reset(1.0, 2.0, 0.5, 0.3)
    state = walk(robot, 0.3, 4.0)[-1]
    assert state.x == pytest.approx(1.0 + 4.0 * WALKING_SPEED * math.cos(0.3), abs=1e-9)
    assert state.y == pytest.approx(2.0 + 4.0 * WALKING_SPEED * math.sin(0.3), abs=1e-9)
    assert state.z == 0.5 + BODY_HEIGHT
    assert math.hypot(state.vx, state.vy) == pytest.approx(WALKING_SPEED)
    assert not state.in_contact


def test_a_turn_is_limited_and_settles(robot):
    robot.reset(0.0, 0.0, 0.0, 0.0)
    yaws = [0.0, *(state.yaw for state in walk(robot, 2.0, 3.0))]
    rates = [(b - a) / SUBSTEP for a, b in itertools.pairwise(yaws)]
    assert max(rates) == pytest.approx(MAX_YAW_RATE)
    assert min(rates) >= -1e-9, "no overshoot"
    assert yaws[-1] == pytest.approx(2.0, abs=1e-3)


def test_yaw_is_continuous_over_many_turns(robot):
    robot.reset(0.0, 0.0, 0.0, 3.0)
    for _ in range(8):
        walk(robot, robot.state.yaw + 3.0, 2.0)
    assert robot.state.yaw == pytest.approx(3.0 + 8 * 3.0, abs=0.05)


def test_a_heading_beyond_half_a_turn_is_reached_the_shorter_way(robot):
    robot.reset(0.0, 0.0, 0.0, 0.0)
    assert walk(robot, 1.5 * math.pi, 3.0)[-1].yaw == pytest.approx(-0.5 * math.pi, abs=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.6, 1.2])
def test_a_wall_stops_the_body_at_its_face(make, angle):
    robot = make(WALL)
    robot.reset(1.5, 0.0, 0.0, angle)
    states = walk(robot, angle, 3.0)
    assert states[-1].in_contact and not states[0].in_contact
    assert states[-1].x == pytest.approx(1.9 - BODY_RADIUS, abs=0.005)
    # Bullet sees a contact at most 2 cm ahead, so the impact may sink in by less than the length of one substep.
    assert max(state.x for state in states) < 1.9 - BODY_RADIUS + WALKING_SPEED * SUBSTEP
    assert states[-1].yaw == pytest.approx(angle, abs=1e-3), "it slides along and keeps its heading"
    if angle:
        assert states[-1].vy == pytest.approx(WALKING_SPEED * math.sin(angle), rel=0.02)
    # Turned round, it walks off at once.
    away = walk(robot, robot.state.yaw + math.pi, 4.0)
    assert not away[-1].in_contact and away[-1].x < 1.0


def test_a_body_that_presses_against_a_wall_does_not_tilt():
    world = World(SceneSpec((WALL,)))
    robot = make_quadruped(world, "kinematic")
    robot.reset(1.5, 0.0, 0.0, 0.3)
    assert walk(robot, 0.3, 3.0)[-1].in_contact
    simulation = world.simulation
    _, orientation = simulation.client.getBasePositionAndOrientation(simulation.body_id(robot.name))
    assert abs(orientation[0]) < 1e-5 and abs(orientation[1]) < 1e-5
    world.close()


def test_no_contact_of_pybullets_is_missed():
    # One of the shapes is so low that the trunk lies on it.
    low = Box("low", (-1.0, 0.0, 0.1), (0.2, 0.2, 0.12))
    world = World(SceneSpec((*DEAD_END, low)))
    robot = make_quadruped(world, "kinematic")
    body = world.simulation.body_id(robot.name)
    rng, touched, steps = np.random.default_rng(0), 0, 0
    for _ in range(20):
        robot.reset(*rng.uniform(-1.5, 0.5, 2), 0.0, rng.uniform(-math.pi, math.pi))
        robot.command(QuadrupedCommand(WALKING_SPEED, rng.uniform(-math.pi, math.pi)))
        for _ in range(60):
            state = robot.substep()
            assert state.in_contact == world.simulation.pressed(body, CONTACT_FORCE)
            touched, steps = touched + state.in_contact, steps + 1
    world.close()
    assert 0.1 < touched / steps < 0.9


def test_a_narrow_dead_end_lets_the_body_out_again(make):
    robot = make(*DEAD_END)
    robot.reset(-0.5, 0.0, 0.0, 0.0)
    assert walk(robot, 0.0, 4.0)[-1].in_contact
    assert walk(robot, math.pi, 4.0)[-1].x < 0.0


@pytest.mark.parametrize("physics", ["", "legs"])
def test_physics_that_does_not_exist_is_refused(physics):
    with pytest.raises(ValueError, match=f"{physics}.*available.*compiled.*kinematic"):
        make_quadruped(World(SceneSpec(())), physics)
