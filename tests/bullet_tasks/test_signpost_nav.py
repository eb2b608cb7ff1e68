"""Laws of Signpost Nav: the signpost tells the goal, a robot that reads it arrives in time, one that guesses does not."""

import math

import gymnasium
import numpy as np
import pytest
from scripted_policies import SignReader, run_episode, scandots_in_world, towards

import bullet_tasks  # noqa: F401
from bullet_tasks.tasks.signpost_nav import SignpostNav, SignpostNavConfig

DECISION = 0.25  # s
N_EPISODES = 100
POST = np.array([4.65, 0.0])  # m
BLOCKS = ("post_near", "post_middle", "post_far")


@pytest.fixture(params=["kinematic", "compiled"])
def env(request):
    env = gymnasium.make("SignpostNav-v0", physics=request.param)
    yield env
    env.close()


def walk_to(point):
    return lambda observation: towards(observation, point)


def on_signpost(scene, points):
    return np.array([any(scene[name].covers(*map(float, point)) for name in BLOCKS) for point in points])


def test_an_informed_policy_reaches_every_goal(env):
    seconds = []
    for seed in range(N_EPISODES):
        env.reset(seed=seed)
        episode = run_episode(env, walk_to(env.unwrapped.task.goal), seed)
        assert episode.success and episode.terminated, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    # From 3 m on one side to 3.3 m on the other, after a half turn.
    assert max(seconds) < 11.0


def test_a_robot_that_reads_the_signpost_reaches_the_goal_in_time(env):
    points = env.unwrapped.sensors[0].points
    errors, successes = [], 0
    for seed in range(N_EPISODES):
        reader = SignReader(points)
        episode = run_episode(env, reader, seed)
        successes += episode.success
        if reader.has_read:
            errors.append(math.dist(reader.estimate(), env.unwrapped.task.goal))
    assert successes >= 0.98 * N_EPISODES
    assert len(errors) > 0.8 * N_EPISODES and np.mean(errors) < 0.2


def test_a_guessed_goal_is_seldom_right(env):
    rng = np.random.default_rng(0)
    successes = 0
    for seed in range(N_EPISODES):
        distance, angle = rng.uniform(1.3, 3.325), rng.uniform(-math.pi, math.pi)
        successes += run_episode(env, walk_to((distance * math.cos(angle), distance * math.sin(angle))), seed).success
    assert successes < 0.25 * N_EPISODES


def test_the_signpost_tells_where_the_goal_is(env):
    along = np.arange(-2.0, 2.0, 0.005)
    lengths = []
    for seed in range(50):
        env.reset(seed=seed)
        scene, way = env.unwrapped.world.scene, np.array(env.unwrapped.task.goal) - POST
        distance = np.hypot(*way)
        axis, normal = way / distance, np.array([-way[1], way[0]]) / distance
        # A line through the goal meets the signpost in one piece around its centre, as long as the distance says.
        covered = along[on_signpost(scene, POST + along[:, None] * axis)]
        assert np.ptp(covered) == pytest.approx(0.8 + 0.2 * distance, abs=0.011)
        assert np.diff(covered).max() < 0.006
        assert covered.mean() == pytest.approx(0.0, abs=0.006)
        # Across it is 0.3 m thick.
        across = along[on_signpost(scene, POST + along[:, None] * normal)]
        assert np.ptp(across) == pytest.approx(0.3, abs=0.011)
        assert all(scene[name].top == pytest.approx(0.5) for name in BLOCKS)
        lengths.append(np.ptp(covered))
    assert min(lengths) < 1.4 and max(lengths) > 2.2, "short and long ones have been measured"


def test_scandots_see_the_signpost_and_the_drop_but_not_the_goal(env):
    sensor, goals_seen, readings = env.unwrapped.sensors[0], 0, set()
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        route = walk_to((3.1, 0.0))
        for _ in range(60):
            assert env.observation_space["target"].contains(observation["target"])
            points = scandots_in_world(observation, sensor.points)
            height = np.where(
                on_signpost(env.unwrapped.world.scene, points), 0.5, np.where(np.hypot(*points.T) < 4.5, 0.0, -0.8)
            )
            # Where a point is at an edge, the rounding of the observed pose decides.
            assert np.mean(np.abs(observation["target"] + height) > 1e-6) < 0.03
            readings |= {round(float(value), 3) for value in observation["target"]}
            goals_seen += np.any(np.hypot(*(points - np.array(env.unwrapped.task.goal)).T) < 0.4)
            observation, _, terminated, _, _ = env.step(route(observation))
            if terminated:
                break
    assert readings == {-0.5, 0.0, 0.8} and goals_seen > 20


def test_leaving_the_disc_is_a_fall(env):
    env.reset(seed=0)
    episode = run_episode(env, walk_to((-9.0, 0.0)), 0)
    assert episode.terminated and not episode.success
    assert episode.infos[-1]["reward_terms"]["goal_bonus"] == 0.0
    distances = [math.hypot(*info["position"]) for info in episode.infos]
    assert distances[-1] > 4.5 > distances[-2]


def test_goals_and_starts_are_as_in_the_release(env):
    starts = [env.reset(seed=seed) for seed in range(1000)]
    goals = np.array([observation["privileged"] for observation, _ in starts])
    assert np.all(goals.std(axis=0) > 0.2) and np.all(goals.std(axis=0) < 0.22), "the scale of the paper"
    assert np.all(np.abs(goals) <= 3.325 / 8.0 + 1e-6)
    distances = 8.0 * np.hypot(*goals.T)
    assert 1.3 <= distances.min() + 1e-5 and distances.max() <= 3.325 + 1e-5
    assert np.quantile(distances, [0.25, 0.5, 0.75]) == pytest.approx([1.806, 2.3125, 2.819], abs=0.12)
    assert np.abs(goals.mean(axis=0)).max() < 0.03
    spawns = np.hypot(*np.array([info["position"] for _, info in starts]).T)
    assert np.quantile(spawns, [0.25, 0.5, 0.75]) == pytest.approx([0.75, 1.5, 2.25], abs=0.17) and spawns.max() <= 3.0
    headings = np.array([observation["common"][2:] for observation, _ in starts])
    assert np.abs(headings.mean(axis=0)).max() < 0.1


def test_a_belief_is_drawn_where_the_goal_is(env):
    observation, _ = env.reset(seed=0)
    centre, half_widths = env.unwrapped.task.belief_in_world(observation["privileged"], np.array([0.1, 0.05]))
    assert centre == pytest.approx(env.unwrapped.task.goal, abs=1e-5)
    assert half_widths == pytest.approx((0.8, 0.4))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"goal_distance": (1.3, 4.2)}, "goal_distance"),
        ({"goal_distance": (3.0, 2.0)}, "goal_distance"),
        ({"goal_distance": (1.3, 3.4)}, "privileged_scale"),
        ({"privileged_bound": -0.4}, "privileged_bound"),
        ({"post_x": 20.0}, "post_x"),
        ({"post_base_length": 0.0}, "post_base_length"),
        ({"post_length_per_metre": -0.1}, "post_length_per_metre"),
        ({"post_base_length": 0.1, "post_length_per_metre": 0.3}, "longest signpost.*3 times"),
        ({"spawn_distance": 3.5}, "spawn_distance"),
        ({"spawn_distance": -1.0}, "spawn_distance"),
        ({"post_thickness": 0.0}, "half_extents"),
        ({"decision_period": 0.0}, "decision_period"),
        ({"goal_radius": -0.4}, "goal_radius"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        SignpostNav(SignpostNavConfig(**arguments))
