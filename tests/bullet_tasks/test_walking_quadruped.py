"""Laws of the quadruped on its legs: it obeys, keeps to the body without legs, falls when it must, and says so."""

import math

import gymnasium
import numpy as np
import pybullet
import pytest

from benchmarks.calibrate_quadruped import DECISION, FLOOR, differences
from benchmarks.gait import crossings, stairs
from bullet_tasks import ENV_IDS
from bullet_tasks.ends import Outcome
from bullet_tasks.robots.quadruped import BODY_HEIGHT, BODY_RADIUS, SUBSTEP, WALKING_SPEED, QuadrupedCommand, make_quadruped
from bullet_tasks.robots.walking_quadruped import FAST, MAX_PITCH, MAX_SPEED, WalkingPreset, WalkingQuadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

QUADRUPED_TASKS = [env_id for env_id in ENV_IDS if env_id not in {"ActiveTMaze-v0", "BiasedQuadrotor-v0", "BlindMassStack-v0"}]
WALL = Box("wall", (1.1, 0.0, 0.5), (0.1, 3.0, 0.5))
CURB = Box("curb", (1.1, 0.0, 0.175), (0.1, 3.0, 0.175))
LEDGE = SceneSpec((Box("ledge", (0.0, 0.0, -0.5), (1.5, 1.5, 0.5), floor=True),), lower_ground=-1.0)


@pytest.fixture
def make():
    """Makes a robot on its legs in a scene."""
    worlds = []

    def make(scene=FLOOR, preset=FAST):
        worlds.append(World(scene))
        return WalkingQuadruped(worlds[-1], preset)

    yield make
    for world in worlds:
        world.close()


def walk(robot, heading, seconds, speed=WALKING_SPEED, pitch=0.0):
    """States of a walk towards a heading, told anew in every decision as the tasks do."""
    states = []
    for _ in range(round(seconds / SUBSTEP / DECISION)):
        robot.command(QuadrupedCommand(speed, heading, pitch))
        states += [robot.substep() for _ in range(DECISION)]
    return states


def test_it_walks_straight_at_the_speed_it_is_told(make):
    robot = make()
    robot.reset(1.0, 2.0, 0.0, 0.3)
    states = walk(robot, 0.3, 6.0)
    begin, end = states[39], states[-1]
    way = math.hypot(end.x - begin.x, end.y - begin.y)
    assert way / 4.0 == pytest.approx(WALKING_SPEED, abs=0.03)
    assert math.atan2(end.y - begin.y, end.x - begin.x) == pytest.approx(0.3, abs=0.05)
    assert end.yaw == pytest.approx(0.3, abs=0.05)
    assert np.mean([state.z for state in states[39:]]) == pytest.approx(BODY_HEIGHT, abs=0.01)
    assert not any(state.in_contact for state in states), "walking on a floor is no collision"
    assert not robot.fallen


def test_it_stands_where_it_is_when_it_is_told_to(make):
    robot = make()
    robot.reset(0.0, 0.0, 0.0, 0.0)
    end = walk(robot, 0.0, 3.0, speed=0.0)[-1]
    assert math.hypot(end.x, end.y) < 0.1 and abs(end.yaw) < 0.05 and not robot.fallen


def test_a_heading_is_reached_and_its_scale_is_continuous(make):
    robot = make()
    robot.reset(0.0, 0.0, 0.0, 3.0)
    for turn in range(1, 4):
        walk(robot, 3.0 + 2.0 * turn, 2.5)
        assert robot.state.yaw == pytest.approx(3.0 + 2.0 * turn, abs=0.08)
    walk(robot, robot.state.yaw + 1.5 * math.pi, 2.5)
    assert robot.state.yaw == pytest.approx(9.0 - 0.5 * math.pi, abs=0.16), "the shorter way round"
    assert not robot.fallen


@pytest.mark.parametrize("pitch", [-0.3, 0.3])
def test_the_trunk_holds_the_pitch_it_is_told(make, pitch):
    robot = make()
    robot.reset(0.0, 0.0, 0.0, 0.0)
    walk(robot, 0.0, 2.0, speed=0.4, pitch=pitch)
    pitches = []
    for _ in range(40):
        robot.substep()
        pitches.append(robot.pitch)
    assert np.mean(pitches) == pytest.approx(pitch, abs=0.03) and not robot.fallen


def test_commands_beyond_the_limits_are_clipped_and_nonsense_is_refused(make):
    ends = []
    for speed, pitch in ((7.0, 2.0), (MAX_SPEED, MAX_PITCH)):
        robot = make()
        robot.reset(0.0, 0.0, 0.0, 0.0)
        ends.append(walk(robot, 0.0, 0.5, speed=speed, pitch=pitch)[-1])
    assert ends[0] == ends[1]
    for bad in ((math.nan, 0.0, 0.0), (0.7, math.inf, 0.0), (0.7, 0.0, math.nan)):
        with pytest.raises(ValueError, match="finite"):
            robot.command(QuadrupedCommand(*bad))


def test_it_keeps_to_the_body_without_legs():
    """Both are told the same random turns for 5 s (3.5 m of way)."""
    found = differences("full", n=12, seed=3)
    assert not found["fallen"].any()
    # Measured over 40 sequences: medians of 0.21 m, 0.18 rad and 0.13 m; 0 falls.
    assert np.median(found["position"]) < 0.4
    assert np.median(found["heading"]) < 0.35
    assert np.median(found["path"]) < 0.22


def test_pushes_do_not_make_it_fall(make):
    robot = make()
    client = robot._world.simulation.client
    rng = np.random.default_rng(0)
    for phase in (0.0, 0.3, 0.6):
        robot.reset(0.0, 0.0, 0.0, 0.0, phase)
        for _ in range(3):
            walk(robot, 0.0, 1.5)
            angle = rng.uniform(0.0, math.tau)
            robot.push(0.3 * math.cos(angle), 0.3 * math.sin(angle))
            assert math.hypot(*client.getBaseVelocity(robot._body)[0][:2]) > 0.3
        walk(robot, 0.0, 1.5)
        assert not robot.fallen


@pytest.mark.parametrize("rise", [0.08, -0.08])
def test_it_walks_up_and_down_stairs(rise):
    assert crossings("full", stairs(5, rise, 0.3), n_trials=2) == 2
    assert crossings("full", stairs(5, rise, 0.3), n_trials=1, seconds=3.0) == 0, "it takes its time"


def test_legs_move(make):
    robot = make()
    robot.reset(0.0, 0.0, 0.0, 0.0)
    client, places = robot._world.simulation.client, []
    for _ in range(20):
        walk(robot, 0.0, 0.25)
        links = client.getLinkStates(robot._body, [robot._joints[2], robot._joints[5]], computeForwardKinematics=1)
        places.append([link[0] for link in links])
    heights = np.array(places)[:, :, 2]
    assert (heights.std(axis=0) > 0.005).all()
    assert (np.array(places)[-1, :, 0] > 2.0).all(), "they come along"


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_a_wall_stops_it_and_lets_it_go_again(make, angle):
    robot = make(SceneSpec((*FLOOR.shapes, WALL)))
    robot.reset(0.0, 0.0, 0.0, angle)
    states = walk(robot, angle, 4.0)
    assert np.mean([state.in_contact for state in states]) < 0.1, "it gives way before it touches"
    assert 0.7 < max(state.x for state in states) < 0.85, "the trunk reaches 0.23 m ahead"
    assert not robot.fallen
    robot.push(1.0, 0.0)
    assert any(robot.substep().in_contact for _ in range(6)), "what presses on it is a collision"
    away = walk(robot, robot.state.yaw + math.pi, 4.0)
    assert away[-1].x < 0.2 and not away[-1].in_contact and not robot.fallen


@pytest.mark.parametrize("angle", [0.2, -0.4])
def test_it_slides_along_a_wall_as_the_body_without_legs(make, angle):
    """Past the seam of two boxes in line, too. A robot that sticks there would never learn that the wall goes on."""
    halves = [Box(f"half_{side}", (1.1, side * 2.0 + 0.3, 0.5), (0.1, 2.0, 0.5)) for side in (-1.0, 1.0)]
    robot = make(SceneSpec((*FLOOR.shapes, *halves)))
    robot.reset(0.6, 0.0, 0.0, angle)
    states = walk(robot, angle, 6.0)
    along = (states[-1].y - states[39].y) / 4.0
    assert along == pytest.approx(WALKING_SPEED * math.sin(angle), rel=0.2)
    assert abs(states[-1].yaw - angle) < 0.1


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_before_a_curb_as_in_the_open(make, side):
    """No shoulder, knee or foot is caught: the trunk is moved out of the way of the turn."""
    turns = []
    for scene in (FLOOR, SceneSpec((*FLOOR.shapes, CURB))):
        robot = make(scene)
        robot.reset(0.45, 0.0, 0.0, 0.0)
        states = walk(robot, 0.0, 1.5)
        if scene is not FLOOR:
            assert states[-1].x == pytest.approx(1.0 - BODY_RADIUS, abs=0.03), "it comes as near as the body without legs"
        for _ in range(4):
            robot.command(QuadrupedCommand(WALKING_SPEED, robot.state.yaw + side * math.pi / 4.0))
            for _ in range(DECISION):
                robot.substep()
        turns.append(side * robot.state.yaw)
        assert not robot.fallen
    assert turns[0] > 1.5 and turns[1] > 0.8 * turns[0]


def test_neither_hard_turns_nor_curbs_make_it_fall(make):
    """From side to side at random, in the open and on a road of 1.3 m between curbs 0.35 m high."""
    curbs = [Box(f"curb_{i}", (0.0, side * 0.75, 0.175), (20.0, 0.1, 0.175)) for i, side in enumerate((1.0, -1.0))]
    for scene in (FLOOR, SceneSpec((*FLOOR.shapes, *curbs))):
        robot, rng = make(scene), np.random.default_rng(1)
        for phase in (0.0, 0.4):
            robot.reset(0.0, 0.0, 0.0, 0.5, phase)
            for _ in range(24):
                turn = float(rng.choice((-1.0, 1.0))) * math.pi / 4.0
                robot.command(QuadrupedCommand(WALKING_SPEED, robot.state.yaw + turn))
                for _ in range(DECISION):
                    robot.substep()
            assert not robot.fallen and (scene is FLOOR or abs(robot.state.y) < 0.5)


def test_beyond_an_edge_it_falls_which_ends_the_episode(make):
    robot = make(LEDGE)
    robot.reset(0.5, 0.0, 0.0, 0.0)
    outcomes = []
    for _ in range(24):
        robot.command(QuadrupedCommand(WALKING_SPEED, 0.0))
        stretch = robot.advance(DECISION, lambda state: Outcome.RUNNING)
        outcomes.append(stretch.outcome)
        if stretch.outcome is not Outcome.RUNNING:
            break
    assert outcomes[-1] is Outcome.FAILURE and robot.fallen
    assert outcomes[0] is Outcome.RUNNING
    assert robot.state.x > 1.0
    # At the goal, success counts even in a fall.
    assert robot.advance(1, lambda state: Outcome.SUCCESS).outcome is Outcome.SUCCESS
    robot.reset(0.0, 0.0, 0.0, 0.0)
    assert not robot.fallen


def test_it_walks_along_an_edge(make):
    """The trunk's centre is 14 cm from the edge, the outer hips 1 cm."""
    robot = make(SceneSpec((Box("road", (0.0, 0.0, -0.5), (20.0, 1.0, 0.5), floor=True),), lower_ground=-1.0))
    for y in (0.86, -0.86):
        robot.reset(0.0, y, 0.0, 0.0)
        walk(robot, 0.0, 4.0)
        assert not robot.fallen and robot.state.x > 2.0
        assert abs(robot.state.y) < abs(y), "it has moved away from the edge"


def test_an_episode_is_its_start_and_commands_bit_for_bit(make):
    robot = make(LEDGE)

    def episode():
        robot.reset(0.2, 0.1, 0.0, 1.0, 0.2)
        return walk(robot, 1.7, 1.0)

    first = episode()
    for seconds in (0.25, 3.0):
        # Histories that end in the open and in a fall.
        robot.reset(0.0, 0.0, 0.0, -0.5)
        walk(robot, -0.5, seconds)
        assert episode() == first


def test_it_has_the_masses_of_the_a1(make):
    robot = make()
    client = robot._world.simulation.client
    masses = [client.getDynamicsInfo(robot._body, link)[0] for link in range(-1, client.getNumJoints(robot._body))]
    assert sum(masses) == pytest.approx(12.46, abs=0.05)
    assert len(robot._joints) == len(set(robot._joints)) == 12
    assert all(client.getJointInfo(robot._body, joint)[2] == pybullet.JOINT_REVOLUTE for joint in robot._joints)


@pytest.mark.parametrize("env_id", QUADRUPED_TASKS)
def test_the_tasks_run_unchanged(env_id):
    env = gymnasium.make(env_id, physics="full")
    twin = gymnasium.make(env_id, physics="kinematic")
    assert env.observation_space == twin.observation_space and env.action_space == twin.action_space
    (observation, _), (reference, _) = env.reset(seed=3), twin.reset(seed=3)
    assert observation["common"] == pytest.approx(reference["common"], abs=1e-6)
    assert np.array_equal(observation["privileged"], reference["privileged"])
    start = observation["common"][:2].copy()
    for _ in range(4):
        observation, reward, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert env.observation_space.contains(observation) and np.isfinite(reward) and not truncated
        if terminated:
            break
    # A second ahead, or the episode's end.
    assert terminated or np.hypot(*(observation["common"][:2] - start)) * 8.0 == pytest.approx(0.6, abs=0.15)
    env.close()
    twin.close()


def test_episodes_begin_anywhere_in_the_stride_and_seeds_repeat_them():
    env = gymnasium.make("SquareMaze-v0", physics="full")

    def joints(seed):
        env.reset(seed=seed)
        env.step(env.action_space.low * 0.0)
        return env.unwrapped.robot.trot.angles.copy()

    first, second, again = joints(1), joints(2), joints(1)
    assert np.abs(first - second).max() > 0.02
    np.testing.assert_array_equal(first, again)
    env.close()


def test_the_accurate_preset_walks_too():
    world = World(FLOOR)
    robot = make_quadruped(world, "full_accurate")
    robot.reset(0.0, 0.0, 0.0, 0.0)
    end = walk(robot, 0.0, 2.0)[-1]
    assert end.x == pytest.approx(1.3, abs=0.15) and abs(end.y) < 0.1 and not robot.fallen
    end = walk(robot, 1.5, 2.0)[-1]
    assert end.yaw == pytest.approx(1.5, abs=0.15) and end.y > 0.7 and not robot.fallen
    world.close()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"physics_rate": 50}, "physics_rate.*multiple of 20.*50"),
        ({"iterations": 0}, "iterations.*at least 1"),
        ({"motor_gain": 0.0}, "motor_gain.*greater than 0"),
    ],
)
def test_impossible_presets_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        WalkingPreset(**{"physics_rate": 120, "iterations": 20, "motor_gain": 0.3, "meshes": False, **arguments})
