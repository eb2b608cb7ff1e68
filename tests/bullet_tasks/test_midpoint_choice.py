"""Laws of Midpoint Choice: the goal is behind the second tallest columns, which a robot can measure in time."""

import itertools
import math

import gymnasium
import numpy as np
import pytest
from scripted_policies import ColumnReader, run_episode, scandots_in_world, through_the_gap, towards

import bullet_tasks  # noqa: F401
from bullet_tasks.tasks.midpoint_choice import MidpointChoice, MidpointChoiceConfig

DECISION = 0.25  # s
N_EPISODES = 100
CORNERS = list(itertools.product((1.0, -1.0), (1.0, -1.0)))
PAIRS = ("low", "middle", "tall")


@pytest.fixture(params=["kinematic", "compiled"])
def env(request):
    env = gymnasium.make("MidpointChoice-v0", physics=request.param)
    yield env
    env.close()


def corner_of(observation):
    return tuple(float(sign) for sign in np.sign(observation["privileged"]))


def walk_to(corner):
    return lambda observation: towards(observation, through_the_gap(observation, corner))


def columns(env):
    """Corner and height of every pair of this episode, measured from the scene."""
    scene = env.unwrapped.world.scene
    found = {}
    for pair in PAIRS:
        left, right = scene[f"{pair}_left"], scene[f"{pair}_right"]
        assert left.top == pytest.approx(right.top)
        middle = 0.5 * (np.array(left.centre) + np.array(right.centre))
        found[pair] = (tuple(float(sign) for sign in np.sign(middle[:2])), left.top)
    return found


def test_an_informed_policy_reaches_every_goal(env):
    seconds = []
    for seed in range(N_EPISODES):
        episode = run_episode(env, walk_to(corner_of(env.reset(seed=seed)[0])), seed)
        assert episode.success and episode.terminated, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    assert max(seconds) < 9.0


def test_a_robot_that_measures_the_columns_reaches_every_goal_in_time(env):
    points = env.unwrapped.sensors[0].points
    seconds = []
    for seed in range(N_EPISODES):
        reader = ColumnReader(points)
        episode = run_episode(env, reader, seed)
        seconds.append(episode.decisions * DECISION)
        assert episode.success, f"seed {seed}: went to {reader.choice}, measured {reader.heights}"
        truth = dict(columns(env).values())
        assert all(height == pytest.approx(truth.get(corner, 0.0), abs=1e-5) for corner, height in reader.heights.items())
    assert max(seconds) <= 15.0


def test_a_guessed_corner_is_right_once_in_four_and_ends_the_episode(env):
    rng = np.random.default_rng(0)
    episodes = [run_episode(env, walk_to(CORNERS[rng.integers(4)]), seed) for seed in range(200)]
    assert 0.17 < np.mean([episode.success for episode in episodes]) < 0.33
    assert all(episode.terminated for episode in episodes)
    for episode in episodes:
        x, y = episode.infos[-1]["position"]
        assert math.hypot(abs(x) - 1.7, abs(y) - 1.7) <= 0.4, "all ended in a corner, none over a drop"
        assert (episode.infos[-1]["reward_terms"]["goal_bonus"] > 0.0) == episode.success


@pytest.mark.parametrize("rank", [0, 2])
def test_neither_the_lowest_nor_the_tallest_columns_lead_to_the_goal(env, rank):
    for seed in range(20):
        env.reset(seed=seed)
        corner, _ = columns(env)[PAIRS[rank]]
        episode = run_episode(env, walk_to(corner), seed)
        assert episode.terminated and not episode.success


def test_columns_are_as_in_the_release(env):
    empty, heights = [], []
    for seed in range(400):
        observation, _ = env.reset(seed=seed)
        found = columns(env)
        corners = [corner for corner, _ in found.values()]
        assert len(set(corners)) == 3 and found["middle"][0] == corner_of(observation)
        empty += [corner for corner in CORNERS if corner not in corners]
        heights.append([found[pair][1] for pair in PAIRS])
    low, middle, tall = np.array(heights).T
    for values, least, greatest in ((low, 0.0, 0.5), (middle - low, 0.1, 0.25), (tall - middle, 0.1, 0.15)):
        assert least <= values.min() + 1e-9 and values.max() <= greatest + 1e-9
        assert np.quantile(values, [0.25, 0.75]) == pytest.approx(
            [least + 0.25 * (greatest - least), least + 0.75 * (greatest - least)], abs=0.1 * (greatest - least)
        )
    # Five standard deviations of a binomial of 400 and 1/4 are 43.
    assert all(abs(empty.count(corner) - 100) < 43 for corner in CORNERS)


def test_the_shape_of_the_platforms_is_that_of_the_release(env):
    for seed in range(4):
        env.reset(seed=seed)
        scene = env.unwrapped.world.scene
        for sign_x, sign_y in CORNERS:
            carries = {
                (1.79, 0.0): True,
                (1.81, 0.0): False,
                (1.79, 1.79): True,
                # The corner platform is |dx| + |dy| < 1 around (1.7, 1.7).
                (2.69, 1.7): True,
                (2.71, 1.7): False,
                (2.19, 2.19): True,
                (2.21, 2.21): False,
                (1.85, 0.86): True,
                (1.85, 0.8): False,
            }
            for (x, y), floor in carries.items():
                assert scene.ground_height(sign_x * x, sign_y * y) == (pytest.approx(0.0) if floor else -0.8)
        for pair, (corner, _) in columns(env).items():
            diagonal = np.array(corner) / math.sqrt(2.0)
            across = np.array((-diagonal[1], diagonal[0]))
            stands = {(1.66, 0.44): True, (1.64, 0.5): False, (1.90, 0.77): True, (1.92, 0.6): False, (1.78, 0.42): False}
            for (along, beside), column in stands.items():
                for side, sign in (("left", 1.0), ("right", -1.0)):
                    point = along * diagonal + sign * beside * across
                    assert scene[f"{pair}_{side}"].covers(*map(float, point)) == column


def test_scandots_read_the_heights_and_not_the_goal(env):
    sensor = env.unwrapped.sensors[0]
    on_columns, on_goal = 0, 0
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        goal = np.array(env.unwrapped.task.goal)
        scene = env.unwrapped.world.scene
        shapes = [
            (scene[f"{pair}_{side}"], height) for pair, (_, height) in columns(env).items() for side in ("left", "right")
        ]
        reader = ColumnReader(sensor.points)
        for _ in range(80):
            assert env.observation_space["target"].contains(observation["target"])
            points = scandots_in_world(observation, sensor.points)
            height = np.array([scene.ground_height(*map(float, point)) for point in points])
            for shape, top in shapes:
                covered = np.array([shape.covers(*map(float, point)) for point in points])
                height[covered] = np.maximum(top, height[covered])
                on_columns += covered.sum()
            on_goal += np.sum(np.hypot(*(points - goal).T) < 0.3)
            # Where a point is at an edge, the rounding of the observed pose decides.
            assert np.mean(np.abs(observation["target"] + height) > 1e-5) < 0.03
            observation, _, terminated, _, _ = env.step(reader(observation))
            if terminated:
                break
    assert on_columns > 100 and on_goal > 100


def test_only_columns_that_reach_the_trunk_stop_the_robot(env):
    stopped = {}
    for seed in range(60):
        env.reset(seed=seed)
        for pair, (corner, height) in columns(env).items():
            if 0.19 < height < 0.25:
                # A trunk that a column reaches by less than what it sinks in may wade through.
                continue
            # Start on the diagonal and walk into the left column.
            env.reset(seed=seed)
            diagonal = np.array(corner) / math.sqrt(2.0)
            across = np.array((-diagonal[1], diagonal[0]))
            robot = env.unwrapped.robot
            robot.reset(*map(float, 0.9 * diagonal + 0.6 * across), 0.0, math.atan2(corner[1], corner[0]))
            blocked = False
            for _ in range(4):
                *_, info = env.step(np.zeros(1, np.float32))
                blocked = blocked or info["reward_terms"]["collision"] < 0.0
            along = float(info["position"] @ diagonal)
            assert blocked == (height > 0.2) == (along < 1.65 - 0.22 + 0.02), (pair, height, along)
            stopped[blocked] = stopped.get(blocked, 0) + 1
    assert min(stopped[True], stopped[False]) > 10


def test_leaving_the_platform_is_a_fall(env):
    episode = run_episode(env, lambda observation: towards(observation, (9.0, 0.0)), 0)
    assert episode.terminated and not episode.success
    xs = [info["position"][0] for info in episode.infos]
    assert xs[-1] > 1.8 > xs[-2]


def test_corners_and_starts_are_as_in_the_release(env):
    starts = [env.reset(seed=seed) for seed in range(400)]
    corners = np.array([observation["privileged"] for observation, _ in starts])
    assert np.all(np.abs(corners) == 0.25), "the scale of the paper"
    counts = np.unique(corners, axis=0, return_counts=True)[1]
    assert len(counts) == 4 and np.all(np.abs(counts - 100) < 43)
    spawns = np.hypot(*np.array([info["position"] for _, info in starts]).T)
    assert np.quantile(spawns, [0.25, 0.5, 0.75]) == pytest.approx([0.3, 0.6, 0.9], abs=0.1) and spawns.max() <= 1.2
    headings = np.array([observation["common"][2:] for observation, _ in starts])
    assert np.abs(headings.mean(axis=0)).max() < 0.15


def test_a_belief_is_drawn_where_the_goal_is(env):
    observation, _ = env.reset(seed=0)
    centre, half_widths = env.unwrapped.task.belief_in_world(observation["privileged"], np.array([0.25, 0.05]))
    assert centre == pytest.approx(env.unwrapped.task.goal)
    assert half_widths == pytest.approx((1.7, 0.34))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"low_height": (0.5, 0.0)}, "low_height"),
        ({"middle_step": (-0.1, 0.2)}, "middle_step"),
        ({"tall_step": (0.1, math.inf)}, "tall_step"),
        ({"column_near": 2.0}, "column_near"),
        ({"column_inner": 0.2}, "column_inner"),
        ({"column_inner": 0.8}, "column_inner"),
        ({"corner": 2.4}, "corner_reach"),
        ({"corner": 1.2}, "corner_reach"),
        ({"spawn_distance": 1.5}, "spawn_distance"),
        ({"spawn_distance": -0.1}, "spawn_distance"),
        ({"drop": -1.0}, "half_extents"),
        ({"decision_period": 0.0}, "decision_period"),
        ({"goal_radius": 0.0}, "goal_radius"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        MidpointChoice(MidpointChoiceConfig(**arguments))
