"""Laws of the small environments."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import sb3_uspl.envs

ENV_IDS = ["TargetReaching-v0", "ActiveTMaze-v0"]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_both_checkers_are_content(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(gym.make(env_id, render_mode="rgb_array").unwrapped)
        sb3_check(gym.make(env_id))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_seed_fixes_an_episode(env_id):
    env, other = gym.make(env_id), gym.make(env_id)
    env.action_space.seed(0)
    for seed in (3, 4, 3):
        obs, _ = env.reset(seed=seed)
        twin, _ = other.reset(seed=seed)
        for _ in range(200):
            for key, value in obs.items():
                np.testing.assert_array_equal(value, twin[key])
            action = env.action_space.sample()
            obs, *end, _ = env.step(action)
            twin, *_ = other.step(action)
            if end[1] or end[2]:
                break


@pytest.mark.parametrize(
    ("env_id", "action"),
    [("TargetReaching-v0", [1.0]), ("TargetReaching-v0", [0.0, np.nan]), ("ActiveTMaze-v0", 4), ("ActiveTMaze-v0", -1)],
)
def test_impossible_actions_are_refused(env_id, action):
    env = gym.make(env_id, disable_env_checker=True)
    env.reset()
    with pytest.raises(ValueError, match="An action must be"):
        env.step(action)


def test_the_papers_behaviour_reaches_every_target_and_going_one_way_does_not():
    def run(seed, direction_of):
        obs, _ = env.reset(seed=seed)
        passed = False
        while True:
            passed = passed or obs["common"][0] < -0.7
            obs, _, terminated, truncated, info = env.step(np.array([direction_of(passed), -obs["common"][1] / 0.1]))
            if terminated or truncated:
                return info["is_success"]

    env = gym.make("TargetReaching-v0")
    assert all(run(seed, lambda passed: 1.0 if passed else -1.0) for seed in range(100))
    only_left = np.mean([run(seed, lambda passed: -1.0) for seed in range(300)])
    assert 0.45 < only_left < 0.65  # the slight leftward bias


def test_reward_is_progress_and_bonus():
    env = gym.make("TargetReaching-v0")
    env.reset(seed=0)
    env.unwrapped.position, env.unwrapped.target = np.zeros(2), np.array([0.8, 0.0])
    assert env.step(np.array([1.0, 0.0]))[1] == pytest.approx(0.5)
    env.unwrapped.position = np.array([0.6, 0.0])
    assert env.step(np.array([1.0, 0.0]))[1] == pytest.approx(0.5 + 2.0)


def test_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="rgb_array"):
        sb3_uspl.envs.TargetReachingEnv(render_mode="ansi")
