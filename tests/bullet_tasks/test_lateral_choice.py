"""Laws of Lateral Choice: what pays, what ends an episode, and that the paper's optimal behaviour is possible."""

import math

import gymnasium
import numpy as np
import pytest
from scripted_policies import Blind, informed, misled, run_episode

import bullet_tasks  # noqa: F401
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import MAX_YAW_RATE, WALKING_SPEED
from bullet_tasks.tasks.base import Outcome
from bullet_tasks.tasks.lateral_choice import LateralChoice, LateralChoiceConfig

DECISION = 0.25  # s
N_SUBSTEPS = 5


@pytest.fixture
def env():
    env = gymnasium.make("LateralChoice-v0")
    yield env
    env.close()


def start(env, side, facing):
    """Reset until the goal is on a side and the robot faces an end; both 1 or -1."""
    for seed in range(100):
        observation, _ = env.reset(seed=seed)
        if np.sign(observation["privileged"][0]) == side and np.sign(observation["common"][2]) == facing:
            return observation
    raise AssertionError("no such start in 100 seeds")


def turn(action):
    return np.array([action], dtype=np.float32)


def test_an_informed_policy_reaches_every_goal(env):
    for seed in range(30):
        episode = run_episode(env, informed, seed)
        assert episode.success and episode.terminated
        assert episode.infos[-1]["reward_terms"]["goal_bonus"] > 4.0
        assert [info["is_success"] for info in episode.infos[:-1]] == [False] * (len(episode.infos) - 1)


def test_the_wrong_end_costs_time_only(env):
    episode = run_episode(env, misled, 0)
    assert not episode.success and not episode.terminated
    assert episode.decisions == 80


def test_looking_at_one_end_and_then_at_the_other_always_succeeds_in_time(env):
    seconds = []
    for seed in range(50):
        episode = run_episode(env, Blind(), seed)
        assert episode.success, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    assert max(seconds) <= 18.5
    # Even the robot that ignores which way it faces and starts with the left end makes it, just.
    assert all(run_episode(env, Blind(first=-1.0), seed).success for seed in range(50))


@pytest.mark.parametrize("side", [-1, 1])
def test_leaving_the_corridor_sideways_is_a_fall(env, side):
    start(env, side=1, facing=1)
    env.step(turn(0.5 * side))
    for _ in range(20):
        *_, terminated, truncated, info = env.step(turn(0.0))
        if terminated:
            break
    assert terminated and not truncated and not info["is_success"]
    assert 0.8 < side * info["position"][1] < 0.8 + WALKING_SPEED / 20
    assert info["reward_terms"]["goal_bonus"] == 0.0


def test_walking_straight_pays_by_the_metre(env):
    for facing in (-1, 1):
        start(env, side=1, facing=facing)
        _, reward, _, _, info = env.step(turn(0.0))
        assert info["reward_terms"]["goal_progress"] == pytest.approx(4.0 * facing * WALKING_SPEED * DECISION, abs=1e-9)
        assert info["reward_terms"]["heading_progress"] == pytest.approx(0.0, abs=1e-9)
        assert info["reward_terms"]["collision"] == 0.0
        assert reward == pytest.approx(0.7 * facing, abs=1e-9)


def test_turning_away_costs_by_the_radian(env):
    start(env, side=1, facing=1)
    x, y = env.unwrapped.robot.state[:2]
    goal_x = env.unwrapped.task.goal[0]
    _, _, _, _, info = env.step(turn(1.0))
    # More is asked for than a decision can turn, so the yaw rate is at its limit throughout: 0.1 rad a substep.
    step_yaw, step_length = MAX_YAW_RATE * DECISION / N_SUBSTEPS, WALKING_SPEED * DECISION / N_SUBSTEPS
    headings = [(k + 0.5) * step_yaw for k in range(N_SUBSTEPS)]
    end_x = x + sum(step_length * math.cos(h) for h in headings)
    end_y = y + sum(step_length * math.sin(h) for h in headings)
    heading_error = 0.5 - math.atan2(0.0 - end_y, goal_x - end_x)
    terms = info["reward_terms"]
    assert terms["heading_progress"] == pytest.approx(-2.0 * heading_error, abs=1e-9)
    distance = math.hypot(goal_x - end_x, end_y)
    assert terms["goal_progress"] == pytest.approx(4.0 * (goal_x - x - distance), abs=1e-9)


def test_the_bonus_counts_the_time_left(env):
    task = env.unwrapped.task
    env.reset(seed=0)
    state = RobotState(task.goal[0], 0.0, 0.3, 0.0, 0.0, 0.0, False)
    assert task.judge(state) is Outcome.SUCCESS
    task.begin(state, env.unwrapped.world.scene)
    assert task.reward_terms(state, 0.0, 0.25, Outcome.SUCCESS)["goal_bonus"] == 4.5
    assert task.reward_terms(state, 0.1, 0.25, Outcome.RUNNING)["collision"] == pytest.approx(-0.3)
    episode = run_episode(env, informed, 0)
    bonus = episode.infos[-1]["reward_terms"]["goal_bonus"]
    # The goal may be reached within the last decision, so its time is known to within one decision.
    assert 4.0 + 2.0 * (1.0 - episode.decisions / 80) <= bonus < 4.0 + 2.0 * (1.0 - (episode.decisions - 1) / 80)


def test_a_wall_is_penalised_and_left_again(env):
    start(env, side=-1, facing=1)
    for _ in range(40):
        *_, info = env.step(turn(0.0))
    # A whole decision of contact, at the wall and not in it.
    assert info["reward_terms"]["collision"] == pytest.approx(-3.0 * DECISION)
    assert info["position"][0] == pytest.approx(4.6 - 0.22, abs=0.01)
    for _ in range(16):
        *_, info = env.step(turn(0.0) if abs(float(env.unwrapped.robot.state.yaw)) > 3.0 else turn(1.0))
    assert info["reward_terms"]["collision"] == 0.0
    assert info["position"][0] < 4.0


@pytest.mark.parametrize("action, direction", [(1.0, 1.0), (-1.0, -1.0)])
def test_a_turn_goes_the_way_it_was_asked_for(env, action, direction):
    start(env, side=1, facing=-1)
    yaw = env.unwrapped.robot.state.yaw
    env.step(turn(action))
    assert env.unwrapped.robot.state.yaw - yaw == pytest.approx(direction * MAX_YAW_RATE * DECISION)


def test_the_prior_is_on_the_scale_of_the_paper(env):
    values = np.array([env.reset(seed=seed)[0]["privileged"][0] for seed in range(400)])
    assert 0.24 < values.std() < 0.25
    assert abs(values.mean()) < 0.05
    assert np.all(np.abs(values) <= 0.25)


def test_starts_are_as_in_the_release(env):
    common = np.array([env.reset(seed=seed)[0]["common"] for seed in range(200)])
    assert np.all(np.abs(common[:, 0]) * 8.0 <= 0.5) and common[:, 0].min() < -0.05 and common[:, 0].max() > 0.05
    assert np.all(common[:, 1] == 0.0)
    assert set(np.round(common[:, 2], 6)) == {-1.0, 1.0}
    assert 60 < np.sum(common[:, 2] > 0) < 140


def test_a_belief_is_drawn_where_the_goal_is(env):
    task = env.unwrapped.task
    observation, _ = env.reset(seed=0)
    centre, half_widths = task.belief_in_world(observation["privileged"], np.array([0.05]))
    assert centre == pytest.approx(task.goal, abs=1e-5)
    assert half_widths == pytest.approx((0.8, 0.0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"goal_distance": (3.9, 4.7)}, "on its platform"),
        ({"goal_distance": (3.9, 3.8)}, "on its platform"),
        ({"goal_distance": (4.2, 4.3)}, "privileged_scale"),
        ({"privileged_scale": 0.0}, "privileged_scale"),
        ({"post_distance": 0.0}, "post_distance"),
        ({"corridor_half_width": 0.1}, "corridor_half_width"),
        ({"spawn_distance": 3.6}, "spawn_distance"),
        ({"decision_period": 0.0}, "decision_period"),
        ({"decision_period": -0.25}, "decision_period"),
        ({"time_limit": float("nan")}, "time_limit"),
        ({"time_limit": 0.1}, "must not exceed"),
        ({"block_height": 0.0}, "half_extents"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        LateralChoice(LateralChoiceConfig(**arguments))
