"""Privileged observations with a discrete and a continuous part: each is blurred its own way, as the environment says."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

import bullet_tasks  # noqa: F401
from bullet_tasks.vec_env import BulletVecEnv
from sb3_uspl import RMA, USPLPPO
from sb3_uspl.encoder import ObservationEncoder
from sb3_uspl.policy_features import one_hot
from sb3_uspl.wrappers import UncertaintyConfig, UncertaintyVecWrapper
from tests.sb3_uspl.toy import ToyEnv

VALUES = [-0.25, 0.0, 0.25]
FAST = dict(n_steps=16, batch_size=64, n_epochs=1, encoder_updates=2, encoder_batch_size=64, seed=0, mismatch_fraction=0.5)


class MixedEnv(ToyEnv):
    """Dimension 1 is discrete, 0 and 2 are continuous."""

    discrete_privileged = {1: VALUES}

    def __init__(self, **kwargs):
        super().__init__(n_privileged=3, **kwargs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.hidden = self.np_random.uniform(-0.1, 0.1, 3).astype(np.float32)
        self.hidden[1] = self.np_random.choice(VALUES)
        return self._observe(), {}


def mixed_wrapper(n_envs=2000, **config):
    th.manual_seed(0)
    venv = DummyVecEnv([MixedEnv] * n_envs)
    venv.seed(0)
    encoder = ObservationEncoder(venv.observation_space, 1, memory="gru")
    wrapper = UncertaintyVecWrapper(venv, encoder, UncertaintyConfig(discrete_privileged={1: VALUES}, **config), 0)
    wrapper.progress = 1.0
    return wrapper


def test_every_dimension_is_blurred_its_own_way():
    obs = mixed_wrapper(blur_gain=0.5).reset()
    shown, truth, std = obs["privileged"], obs["truth"], obs["uncertainty"]
    discrete = shown[:, 1]
    assert set(discrete) == set(truth[:, 1]) == {np.float32(value) for value in VALUES}
    changed = (discrete != truth[:, 1]).mean()
    # Uncertainty counts in steps from one value to the next; a third draws the same value.
    share = np.minimum(std[:, 1] / np.diff(sorted(VALUES)).min(), 1.0).mean()
    assert 0.0 < changed == pytest.approx(share * 2 / 3, abs=0.04)
    for dim in (0, 2):
        noise = (shown[:, dim] - truth[:, dim]) / (0.5 * std[:, dim])
        unclipped = np.abs(shown[:, dim]) < 0.25
        assert unclipped.mean() > 0.5 and np.abs(noise).max() <= 1.0 + 1e-5
        assert len(np.unique(shown[unclipped, dim])) > 900
        assert 0.4 < np.abs(noise[unclipped]).mean() < 0.6
    assert abs(np.corrcoef(discrete != truth[:, 1], np.abs(shown[:, 0] - truth[:, 0]))[0, 1]) < 0.07, "drawn independently"


def test_a_discrete_value_stays_one_at_the_end_of_an_episode_too():
    wrapper = mixed_wrapper(64)
    wrapper.reset()
    for _ in range(8):
        obs, _, dones, infos = wrapper.step(np.zeros((64, 1), np.float32))
        assert set(obs["privileged"][:, 1]) <= {np.float32(value) for value in VALUES}
    assert dones.all()
    last = np.array([info["terminal_observation"]["privileged"] for info in infos])
    assert set(last[:, 1]) == {np.float32(value) for value in VALUES}


def test_without_blurring_or_progress_nothing_changes():
    for blur, progress in ((False, 1.0), (True, 0.0)):
        wrapper = mixed_wrapper(64, blur=blur)
        wrapper.progress = progress
        obs = wrapper.reset()
        np.testing.assert_array_equal(obs["privileged"], obs["truth"])


@pytest.mark.parametrize("venv_class", [DummyVecEnv, SubprocVecEnv, BulletVecEnv])
def test_the_environment_says_which_dimensions_are_discrete(venv_class):
    for env_class, expected in ((MixedEnv, {1: VALUES}), (ToyEnv, {})):
        venv = VecMonitor(venv_class([env_class] * 4, **({} if venv_class is DummyVecEnv else {"start_method": "fork"})))
        model = USPLPPO("MlpPolicy", venv, **FAST)
        assert model.discrete_privileged == expected
        assert model._uncertainty_config.discrete_privileged == expected
        # A worker that was asked for what it does not know still lives.
        model.learn(64)
        venv.close()


def test_the_argument_goes_before_the_environment():
    venv = make_vec_env(MixedEnv, 4)
    assert USPLPPO("MlpPolicy", venv, discrete_privileged={}, **FAST).discrete_privileged == {}
    assert USPLPPO("MlpPolicy", venv, discrete_privileged={0: [0, 0.1]}, **FAST).discrete_privileged == {0: [0.0, 0.1]}
    assert RMA("MlpPolicy", venv, **FAST).discrete_privileged == {1: VALUES}


def test_an_environment_that_names_impossible_values_is_refused():
    class Wrong(MixedEnv):
        discrete_privileged = {1: [0.0, 3.0]}

    with pytest.raises(ValueError, match="within the bounds"):
        USPLPPO("MlpPolicy", make_vec_env(Wrong, 4), **FAST)


def test_a_loaded_model_still_knows(tmp_path):
    model = USPLPPO("MlpPolicy", make_vec_env(MixedEnv, 4), **FAST)
    model.save(tmp_path / "model")
    assert USPLPPO.load(tmp_path / "model").discrete_privileged == {1: VALUES}
    # Though the new environment would not say so.
    loaded = USPLPPO.load(tmp_path / "model", make_vec_env(lambda: ToyEnv(n_privileged=3), 4))
    assert loaded._uncertainty_config.discrete_privileged == {1: VALUES}


def test_actor_and_critic_can_see_one_number_for_each_value():
    x = th.tensor([-0.3, -0.25, -0.0625, 0.25, 0.3])
    expected = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.25, 0.75, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
    th.testing.assert_close(one_hot(x, VALUES), th.tensor(expected))
    model = USPLPPO("MlpPolicy", make_vec_env(MixedEnv, 4), policy_kwargs=dict(one_hot=True), **FAST)
    features = model.policy.pi_features_extractor
    seen = {"common": th.zeros(1, 2), "privileged": th.tensor([[0.1, 0.25, 0.2]]), "uncertainty": th.full((1, 3), 0.5)}
    expected = [0.0, 0.0, 0.4, 0.8, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0]
    outputs = features({**seen, "belief": th.zeros(1, 3)})
    assert features.features_dim == outputs.shape[1] == len(expected)
    assert outputs[0].tolist() == pytest.approx(expected)
    model.learn(128)
    with pytest.raises(ValueError, match="one_hot"):
        USPLPPO("MlpPolicy", make_vec_env(ToyEnv, 4), policy_kwargs=dict(one_hot=True), **FAST)


def test_a_categorical_belief_is_learned_saved_and_loaded(tmp_path):
    kwargs = dict(one_hot=True, encoder_kwargs=dict(categorical=True))
    model = USPLPPO("MlpPolicy", make_vec_env(MixedEnv, 4), policy_kwargs=kwargs, **FAST)
    before = model.policy.encoder.discrete["1"].logits[-1].weight.detach().clone()
    model.learn(128)
    assert "discrete_privileged" not in model.policy_kwargs
    head = model.policy.encoder.discrete["1"]
    assert head.values.tolist() == VALUES and not th.equal(head.logits[-1].weight, before)
    model.save(tmp_path / "model")
    env = MixedEnv()
    obs, _ = env.reset(seed=0)
    for loaded in (USPLPPO.load(tmp_path / "model"), USPLPPO.load(tmp_path / "model", make_vec_env(MixedEnv, 4))):
        for ours, theirs in zip(
            model.predict(obs, deterministic=True)[1][:2], loaded.predict(obs, deterministic=True)[1][:2], strict=True
        ):
            np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="discrete_privileged"):
        USPLPPO("MlpPolicy", make_vec_env(ToyEnv, 4), policy_kwargs=kwargs, **FAST)


def test_the_arm_is_learned_on_through_its_mixed_privileged_observation():
    venv = make_vec_env("BlindMassStack-v0", 8, env_kwargs=dict(physics="compiled"), vec_env_cls=BulletVecEnv)
    model = USPLPPO("MultiInputPolicy", venv, warmup_timesteps=0, ramp_timesteps=0, **FAST)
    assert isinstance(venv.action_space, spaces.MultiDiscrete)
    assert model.discrete_privileged == {0: [-0.3, 0.0, 0.3]} and model.decision_period == 2.5
    model.learn(512)
    shown = model._last_obs["privileged"]
    assert set(shown[:, 0]) <= {np.float32(value) for value in (-0.3, 0.0, 0.3)}
    assert (np.abs(shown[:, 1]) <= 0.4 + 1e-6).all() and (shown[:, 1] != model._last_obs["truth"][:, 1]).any()
    env = gym.make("BlindMassStack-v0")
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)
    env.close()
    venv.close()
