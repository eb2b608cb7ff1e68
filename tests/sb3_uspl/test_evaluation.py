"""Evaluation counts every started episode once, whatever its length."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from sb3_uspl import USPLPPO
from sb3_uspl.evaluation import EpisodeRecord, evaluate, mean_over_time, run_episodes, success_rate, trajectory_divergence
from tests.sb3_uspl.toy import ToyEnv


class UnequalEnv(ToyEnv):
    """Odd seeds succeed after 2 decisions, even seeds fail by time-out after 9: counting ends favours success."""

    def reset(self, *, seed=None, options=None):
        result = super().reset(seed=seed)
        self.length = 9
        if seed is not None:
            self.length = 2 if seed % 2 else 9
        return result

    def step(self, action):
        obs, reward, _, over, _ = super().step(action)
        return obs, reward, over and self.length == 2, over and self.length == 9, {"is_success": over and self.length == 2}


@pytest.fixture(scope="module")
def model():
    venv = make_vec_env(ToyEnv, 8, seed=0)
    return USPLPPO("MlpPolicy", venv, n_steps=16, batch_size=32, encoder_updates=1, seed=0).learn(128)


@pytest.mark.parametrize("n_envs", [1, 3, 8])
def test_every_started_episode_counts_once_with_its_own_seed(model, n_envs):
    records = run_episodes(model, make_vec_env(UnequalEnv, n_envs), 10, seed=100)
    assert [record.seed for record in records] == list(range(100, 110))
    assert [record.success for record in records] == [False, True] * 5
    assert [len(record) for record in records] == [9, 2] * 5


def test_episodes_do_not_depend_on_their_neighbours(model):
    alone = run_episodes(model, make_vec_env(ToyEnv, 1), 6, seed=7)
    together = run_episodes(model, make_vec_env(ToyEnv, 4), 6, seed=7)
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_allclose(a.belief_mean, b.belief_mean, atol=1e-5)
        assert a.reward == pytest.approx(b.reward, abs=1e-4)


class PlacedEnv(UnequalEnv):
    """Says where it is in one array that it changes, from the start or from the first step on."""

    at_start = True

    def reset(self, *, seed=None, options=None):
        self.place = np.array([5.0, 0.0])
        obs, _ = super().reset(seed=seed)
        return obs, {"position": self.place} if self.at_start else {}

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.place[1] += 1.0
        return obs, reward, terminated, truncated, {**info, "position": self.place}


@pytest.mark.parametrize("wrap", [lambda venv: venv, VecMonitor])
def test_positions_are_the_environments_at_their_time(model, wrap):
    (record,) = run_episodes(model, wrap(make_vec_env(PlacedEnv, 1)), 1, seed=1)
    assert np.stack(record.positions).tolist() == [[5.0, 0.0], [5.0, 1.0]]


def test_positions_that_are_not_known_from_the_start_are_left_alone(model):
    class Late(PlacedEnv):
        at_start = False

    (record,) = run_episodes(model, make_vec_env(Late, 1), 1, seed=1)
    np.testing.assert_allclose(np.stack(record.positions)[:, 0], [0.0, 1 / 2])  # the common observation's time


def test_success_is_unknown_where_the_environment_does_not_say(model):
    class Silent(ToyEnv):
        def step(self, action):
            return *super().step(action)[:4], {}

    result = evaluate(model, make_vec_env(Silent, 2), 4)
    assert result["success_rate"] is None and result["privileged_success_interval"] is None
    assert result["mean_length"] == 8.0


def test_it_agrees_with_sb3(model):
    venv = make_vec_env(ToyEnv, 5, seed=50)
    ours = run_episodes(model, venv, 5, seed=50)
    venv.seed(50)
    rewards, lengths = evaluate_policy(model, venv, n_eval_episodes=5, return_episode_rewards=True)
    np.testing.assert_allclose(sorted(rewards), sorted(record.reward for record in ours), atol=1e-4)
    assert lengths == [len(record) for record in ours]


def test_the_privileged_policy_is_shown_the_truth(model):
    venv = make_vec_env(ToyEnv, 4)
    pp, dp = (run_episodes(model, venv, 4, seed=3, policy=name) for name in ("privileged", "deployment"))
    # Same start, same belief; only what the actor is shown differs.
    for a, b in zip(pp, dp, strict=True):
        np.testing.assert_allclose(a.belief_mean[0], b.belief_mean[0], atol=1e-6)
        np.testing.assert_array_equal(a.truth[0], b.truth[0])


def test_success_rate_and_wilson_interval():
    records = [EpisodeRecord(seed, success=seed < 95) for seed in range(100)]
    rate, low, high = success_rate(records)
    assert rate == 0.95
    assert (low, high) == pytest.approx((0.8882, 0.9785), abs=1e-3)  # Wilson, by hand: (p + z2/2n -+ ...) / (1 + z2/n)


def test_divergence_hand_computed():
    a = [EpisodeRecord(0, positions=[np.zeros(2)] * 3), EpisodeRecord(1, positions=[np.zeros(2)] * 2)]
    b = [EpisodeRecord(0, positions=[np.array([3.0, 4.0])] * 2), EpisodeRecord(1, positions=[np.zeros(2)])]
    np.testing.assert_allclose(trajectory_divergence(a, b), [2.5, 5.0])


def test_mean_over_time_uses_the_episodes_that_are_left():
    np.testing.assert_allclose(mean_over_time([np.array([1.0, 2.0, 6.0]), np.array([3.0])]), [2.0, 2.0, 6.0])


def test_evaluate_names_what_it_measured(model):
    venv = make_vec_env(ToyEnv, 4)
    result = evaluate(model, venv, 6)
    needed = {"episodes", "success_rate", "privileged_success_rate", "mean_length", "prediction_error_final"}
    assert needed <= set(result) and all(result[key] is not None for key in needed)
    assert len(result["prediction_error_over_time"]) == len(result["divergence_over_time"]) == 8
    assert evaluate(model, venv, 6, policy="deployment")["privileged_success_rate"] is None


def test_unknown_policies_are_refused(model):
    with pytest.raises(ValueError, match="'deployment' or 'privileged'"):
        run_episodes(model, make_vec_env(ToyEnv, 1), 1, policy="oracle")


def test_a_model_without_a_privileged_policy_is_evaluated_without_it():
    venv = make_vec_env(ToyEnv, 2, seed=0)
    result = evaluate(PPO("MultiInputPolicy", venv, n_steps=16, batch_size=32), venv, 3)
    assert 0.0 <= result["success_rate"] <= 1.0 and result["privileged_success_rate"] is None
