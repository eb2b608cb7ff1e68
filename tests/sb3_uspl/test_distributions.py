"""Correlated exploration: each sample as Gaussian as ever, samples in a row alike."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uspl import USPLPPO
from sb3_uspl.distributions import CorrelatedGaussianDistribution
from tests.sb3_uspl.toy import ToyEnv


def test_the_deployment_policy_draws_independent_actions_and_leaves_the_trainings_noise_alone():
    model = USPLPPO("MlpPolicy", DummyVecEnv([ToyEnv] * 8), n_steps=8, batch_size=64, action_noise_time=10.0, seed=0).learn(64)
    noise = model.policy.action_dist.noise.clone()
    obs = {"common": np.zeros((400, 2), np.float32)}
    first, second = (model.predict(obs, deterministic=False)[0][:, 0] for _ in range(2))
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.2
    assert th.equal(model.policy.action_dist.noise, noise)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.95])
def test_samples_keep_their_mean_and_spread_and_are_correlated_in_time(correlation):
    th.manual_seed(0)
    distribution = CorrelatedGaussianDistribution(2, correlation)
    mean, log_std = th.tensor([0.5, -1.0]).expand(500, 2), th.log(th.tensor([0.2, 0.4]))
    samples = th.stack([distribution.proba_distribution(mean, log_std).sample() for _ in range(200)])
    th.testing.assert_close(samples.mean((0, 1)), mean[0], atol=0.02, rtol=0.0)
    th.testing.assert_close(samples.std((0, 1)), log_std.exp(), atol=0.01, rtol=0.0)
    noise = (samples - mean) / log_std.exp()
    for lag in (1, 3):
        assert (noise[lag:] * noise[:-lag]).mean().item() == pytest.approx(correlation**lag, abs=0.02)


def test_the_time_constant_does_not_depend_on_the_decision_period():
    def correlation(period):
        venv = DummyVecEnv([ToyEnv] * 8)
        model = USPLPPO("MlpPolicy", venv, n_steps=8, batch_size=64, decision_period=period, action_noise_time=1.0)
        assert isinstance(model.policy.action_dist, CorrelatedGaussianDistribution)
        return model.policy.action_dist.correlation

    assert correlation(0.1) ** 5 == pytest.approx(correlation(0.5)) and 0.0 < correlation(0.5) < 1.0
