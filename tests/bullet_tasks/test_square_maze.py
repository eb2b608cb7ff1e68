"""Laws of Square Maze: the layout tells the corner, a blind robot can feel it, a wrong corner is the end."""

import itertools

import gymnasium
import numpy as np
import pytest
from scripted_policies import MazeProbe, Route, maze_route, run_episode

import bullet_tasks  # noqa: F401
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import BODY_RADIUS
from bullet_tasks.tasks.base import Outcome
from bullet_tasks.tasks.corners import CornerTask
from bullet_tasks.tasks.navigation import NavigationReward
from bullet_tasks.tasks.square_maze import SquareMaze, SquareMazeConfig

DECISION = 0.25  # s
N_EPISODES = 100
CORNERS = list(itertools.product((1.0, -1.0), (1.0, -1.0)))


@pytest.fixture(params=["kinematic", "compiled"])
def env(request):
    env = gymnasium.make("SquareMaze-v0", physics=request.param)
    yield env
    env.close()


def corner_of(observation):
    return tuple(float(sign) for sign in np.sign(observation["privileged"]))


def start(env, corner):
    """Reset until the goal is at a corner."""
    for seed in range(100):
        observation, _ = env.reset(seed=seed)
        if corner_of(observation) == corner:
            return observation
    raise AssertionError(f"no goal at {corner} in 100 seeds")


def walk(env, observation, points, decisions):
    """Walk along points; the last observation, whether the episode ended, and the last info."""
    route = Route(points)
    for _ in range(decisions):
        observation, _, terminated, _, info = env.step(route(observation))
        if terminated:
            break
    return observation, terminated, info


def test_an_informed_policy_reaches_every_goal_along_the_roads(env):
    for seed in range(N_EPISODES):
        corner = corner_of(env.reset(seed=seed)[0])
        episode = run_episode(env, Route(maze_route(*corner)), seed)
        assert episode.success and episode.terminated, f"seed {seed}"
        assert all(info["reward_terms"]["collision"] == 0.0 for info in episode.infos), "the roads are wide enough"


def test_a_blind_robot_that_feels_for_the_road_ahead_reaches_every_goal(env):
    seconds = []
    for seed in range(N_EPISODES):
        episode = run_episode(env, MazeProbe(), seed)
        assert episode.success, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    assert max(seconds) <= 14.0


def test_a_guessed_corner_is_right_once_in_four_and_ends_the_episode(env):
    rng = np.random.default_rng(0)
    episodes = [run_episode(env, Route(maze_route(*CORNERS[rng.integers(4)])), seed) for seed in range(200)]
    assert 0.17 < np.mean([episode.success for episode in episodes]) < 0.33
    assert all(episode.terminated for episode in episodes)
    assert all(episode.infos[-1]["reward_terms"]["goal_bonus"] == 0.0 for episode in episodes if not episode.success)


@pytest.mark.parametrize("corner", CORNERS)
def test_how_far_a_road_can_be_walked_tells_the_corner(env, corner):
    sign_x, sign_y = corner
    # Straight on at the first junction: to the curb of a T, or to the end of the extension at y = -1.62.
    observation = start(env, corner)
    _, _, info = walk(env, observation, [(0.0, -9.0)], 30)
    assert info["position"][1] == pytest.approx((-1.625 if sign_x > 0 else -0.65) + BODY_RADIUS, abs=0.02)
    # Straight on at the second junction, on the side of the goal and on the other one.
    bar = 2.24 + 0.65
    end = {1.0: 3.865, -1.0: 3.54}[sign_x] if sign_y > 0 else bar
    for side, reach in ((sign_x, end), (-sign_x, bar)):
        observation = start(env, corner)
        _, _, info = walk(env, observation, [(0.0, 0.0), (side * 9.0, 0.0)], 40)
        assert side * info["position"][0] == pytest.approx(reach - BODY_RADIUS, abs=0.02)


@pytest.mark.parametrize("corner", CORNERS)
def test_goal_and_dead_zones_are_the_four_corners(env, corner):
    start(env, corner)
    task = env.unwrapped.task
    assert task.goal == (corner[0] * 2.4, corner[1] * 1.55)
    assert {task.goal, *task.dead_zones} == {(x * 2.4, y * 1.55) for x, y in CORNERS} and len(task.dead_zones) == 3
    for centre in (task.goal, *task.dead_zones):
        inside, outside = (RobotState(centre[0] - dx, centre[1], 0.3, 0.0, 0.0, 0.0, False) for dx in (0.39, 0.41))
        assert task.judge(inside) is (Outcome.SUCCESS if centre == task.goal else Outcome.FAILURE)
        assert task.judge(outside) is Outcome.RUNNING


def test_nothing_tells_the_corner_at_the_start(env):
    starts = {corner_of(observation): observation for observation in (env.reset(seed=seed)[0] for seed in range(50))}
    assert set(starts) == set(CORNERS)
    assert len({observation["common"].tobytes() for observation in starts.values()}) == 1
    x, y, cos_yaw, sin_yaw = starts[CORNERS[0]]["common"] * np.array([8.0, 8.0, 1.0, 1.0])
    assert (x, y, cos_yaw, sin_yaw) == pytest.approx((0.0, 1.45, 0.0, -1.0), abs=1e-6)
    assert set(starts[CORNERS[0]]) == {"common", "privileged"}, "the task is blind"


def test_corners_are_equally_likely_on_the_scale_of_the_paper(env):
    corners = np.array([env.reset(seed=seed)[0]["privileged"] for seed in range(400)])
    assert np.all(np.abs(corners) == 0.25)
    counts = np.unique(corners, axis=0, return_counts=True)[1]
    # Five standard deviations of a binomial of 400 and 1/4 are 43.
    assert len(counts) == 4 and np.all(np.abs(counts - 100) < 43)


def test_nobody_leaves_the_maze(env):
    env.action_space.seed(0)
    env.reset(seed=0)
    seen = []
    for _ in range(1500):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        seen.append(info["position"])
        assert env.unwrapped.world.scene.ground_height(*info["position"]) == 0.0
        if terminated or truncated:
            env.reset()
    assert np.ptp(np.array(seen), axis=0).min() > 2.0, "the walk has tried many curbs"


def wandering(env, seed):
    """Positions of a robot that turns another way every 2 s, ``(n_decisions, 2)``."""
    rng, path = np.random.default_rng(seed), []
    env.reset(seed=seed)
    for decision in range(80):
        if decision % 8 == 0:
            action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
        _, _, terminated, truncated, info = env.step(action)
        path.append(info["position"])
        if terminated or truncated:
            break
    return np.array(path)


def test_episodes_before_leave_no_trace_at_corners_of_walls(env):
    """Two walls at once are solved in the same order in a world that has been used as in a new one."""
    for seed in range(25):
        new = gymnasium.make(env.spec)
        assert np.array_equal(wandering(env, seed), wandering(new, seed)), seed
        new.close()


def test_compiled_robots_go_where_pybullets_go_but_for_some_that_touch_a_corner():
    deviations = []
    kinematic, compiled = (gymnasium.make("SquareMaze-v0", physics=physics) for physics in ("kinematic", "compiled"))
    for seed in range(60):
        paths = wandering(kinematic, seed), wandering(compiled, seed)
        both = min(map(len, paths))
        deviations.append(np.abs(paths[0][:both] - paths[1][:both]).max())
    kinematic.close()
    compiled.close()
    assert np.median(deviations) < 0.002 and np.quantile(deviations, 0.9) < 0.05  # m


def test_a_belief_is_drawn_where_the_goal_is(env):
    observation = start(env, (1.0, -1.0))
    centre, half_widths = env.unwrapped.task.belief_in_world(observation["privileged"], np.array([0.25, 0.05]))
    assert centre == pytest.approx((2.4, -1.55))
    assert half_widths == pytest.approx((2.4, 0.31))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"road_half_width": 0.2}, "road_half_width"),
        ({"road_half_width": 1.2}, "road_half_width"),
        ({"goal": (1.5, 1.55)}, "side road"),
        ({"goal": (2.4, 0.9)}, "side road"),
        ({"goal": (2.4, 2.3)}, "side road"),
        ({"goal": (2.4, float("nan"))}, "side road"),
        ({"spawn_y": 2.2}, "spawn_y"),
        ({"spawn_y": 0.0}, "spawn_y"),
        ({"south_pocket": 0.0}, "south_pocket.*positive"),
        ({"west_pocket": -0.5}, "west_pocket.*positive"),
        ({"curb_height": 0.0}, "curb_height.*body"),
        ({"goal_radius": 0.0}, "goal_radius"),
        ({"decision_period": 0.0}, "decision_period"),
        ({"time_limit": 0.1}, "must not exceed"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        SquareMaze(SquareMazeConfig(**arguments))


class Corners(CornerTask):
    """The least corner task."""

    def reset(self, rng):
        raise NotImplementedError


def test_circles_of_mirrored_corners_must_not_touch():
    Corners((0.5, 2.0), DECISION, 20.0, 0.4, NavigationReward())
    with pytest.raises(ValueError, match="mirrored corners touch"):
        Corners((0.3, 2.0), DECISION, 20.0, 0.4, NavigationReward())
