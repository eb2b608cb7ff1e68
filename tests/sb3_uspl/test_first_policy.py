"""What an actor begins with, at the start of training and when it starts anew after the warm-up."""

import itertools

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_uspl import USPLPPO
from tests.sb3_uspl.toy import ToyEnv


def make_model(env_kwargs, **kwargs):
    venv = make_vec_env(ToyEnv, 8, seed=0, env_kwargs=env_kwargs)
    return USPLPPO("MlpPolicy", venv, n_steps=16, batch_size=32, seed=0, **kwargs)


def test_a_policy_that_starts_anew_after_the_warm_up_keeps_the_encoder():
    venv = make_vec_env(ToyEnv, 8, seed=0)
    kwargs = dict(n_steps=8, batch_size=32, n_epochs=1, seed=0, ramp_timesteps=0, warmup_timesteps=128)
    before = {}

    class Watch(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            policy = self.model.policy
            actor, encoder = policy.action_net.weight.detach().clone(), policy.encoder.mean[-1].weight.detach().clone()
            before[self.num_timesteps] = (actor, encoder, policy.pi_features_extractor.common_normalizer.count.item())

    model = USPLPPO("MlpPolicy", venv, policy_restart=True, learning_rate=0.0, encoder_updates=0, **kwargs)
    model.learn(256, callback=Watch())
    assert list(before) == [64, 128, 192, 256]
    for (earlier, later), same in zip(itertools.pairwise(before), (True, False, True), strict=True):
        assert th.equal(before[earlier][0], before[later][0]) == same
        assert th.equal(before[earlier][1], before[later][1])
        assert before[earlier][2] < before[later][2]
    held = {id(parameter) for group in model.policy.optimizer.param_groups for parameter in group["params"]}
    assert id(model.policy.action_net.weight) in held
    assert not held & {id(parameter) for parameter in model.policy.encoder.parameters()}


@pytest.mark.parametrize("bounded", [True, False])
def test_the_first_mean_action_is_the_chosen_one_before_training_and_after_a_restart(bounded):
    space = spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 4.0]))
    kwargs = dict(policy_kwargs=dict(initial_action=(-0.3, 3.0), bounded_mean=bounded), env_kwargs=dict(action_space=space))
    model = make_model(**kwargs)
    obs = model.env.reset()

    def mean():
        return model.predict(obs, deterministic=True)[0].mean(axis=0)

    np.testing.assert_allclose(mean(), (-0.3, 3.0), atol=0.05)
    with th.no_grad():
        model.policy.action_net.bias.zero_()
    model.policy.restart(model.lr_schedule)
    np.testing.assert_allclose(mean(), (-0.3, 3.0), atol=0.05)


def test_a_policy_that_starts_anew_stays_on_its_device():
    policy = make_model(policy_kwargs=dict(initial_action=(0.3,)), env_kwargs={}).policy.to("meta")
    policy.restart(lambda remaining: 1e-3)
    assert {part.device.type for part in (*policy.parameters(), *policy.buffers())} == {"meta"}


@pytest.mark.parametrize("action", [(0.0,), (0.0, 1.0), (0.0, np.nan)], ids=["shape", "at the bound", "nan"])
def test_an_initial_action_that_the_action_space_does_not_hold_is_refused(action):
    with pytest.raises(ValueError, match=r"`initial_action` must be .* inside its bounds, got"):
        make_model(
            policy_kwargs=dict(initial_action=action), env_kwargs=dict(action_space=spaces.Box(-1, 1, (2,), np.float32))
        )
    with pytest.raises(ValueError, match="Box action space"):
        make_model(policy_kwargs=dict(initial_action=(0.0,)), env_kwargs=dict(action_space=spaces.Discrete(3)))
