"""The observation contract, and the wrapper that brings a user's environment under it."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uspl import USPLPPO, PrivilegedObservation, RESeLPPO
from sb3_uspl.observations import check_finite, check_observation_space, policy_observation_space
from tests.sb3_uspl.toy import IMAGE, ToyEnv

BOX = spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (BOX, "PrivilegedObservation"),
        (spaces.Dict(common=BOX), "keys"),
        (spaces.Dict(common=BOX, privileged=BOX, camera=BOX), "camera"),
        (spaces.Dict(common=spaces.Dict(a=BOX), privileged=BOX), "must be a Box"),
        (spaces.Dict(common=spaces.Discrete(3), privileged=BOX), "must be a Box"),
        (spaces.Dict(common=spaces.Box(-1, 1, (2, 2)), privileged=BOX), "one-dimensional"),
        (spaces.Dict(common=BOX, privileged=BOX, target=spaces.Box(-1, 1, (1, 8, 8))), "uint8 image"),
        (spaces.Dict(common=BOX, privileged=spaces.Box(-1, 1, (0,))), "empty"),
    ],
)
def test_a_space_outside_the_contract_is_refused_with_advice(space, message):
    with pytest.raises(ValueError, match=message):
        check_observation_space(space)


def test_a_space_under_the_contract_passes():
    space = ToyEnv(target=IMAGE).observation_space
    assert check_observation_space(space) is space
    assert set(policy_observation_space(space).spaces) == {"common", "privileged", "truth", "uncertainty", "belief"}


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_numbers_are_found(value):
    check_finite({"common": np.zeros((2, 3)), "target": np.zeros(3, np.uint8)})
    with pytest.raises(ValueError, match=r"'common' holds (nan|inf) at index \(1, 2\)"):
        check_finite({"common": np.array([[0, 0, 0], [0, 0, value]])})


def test_whole_numbers_are_kept_as_fractions_which_normalising_makes_of_them():
    """In the buffers of all algorithms: what the encoder sees in a rollout is what it learns from."""
    lidar = spaces.Box(0, 255, (3,), np.uint8)
    for algorithm in (USPLPPO, RESeLPPO):
        venv = VecNormalize(make_vec_env(ToyEnv, 8, env_kwargs={"target": lidar}), norm_obs_keys=["common", "target"])
        model = algorithm("MlpPolicy", venv, n_steps=8, batch_size=32, device="cpu").learn(128)
        if algorithm is USPLPPO:
            kept = model.rollout_buffer.episodes.replay[-1].arrays["target"]
        else:
            kept = model.rollout_buffer.observations["target"]
        assert kept.dtype == np.float32 and (kept % 1.0 != 0.0).any()


class FlatEnv(gym.Env):
    observation_space = spaces.Box(np.array([-1, -2, 0, 10], np.float32), np.array([1, 2, 8, 20], np.float32))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([0, 1, 2, 15], np.float32), {}

    def step(self, action):
        return np.array([0, 1, 2, 15], np.float32), 0.0, False, False, {}


def test_indices_become_keys_and_privileged_values_are_scaled():
    env = PrivilegedObservation(FlatEnv(), privileged=[3], target=[2], offset=15, scale=0.05)
    obs, _ = env.reset(seed=0)
    assert {key: value.tolist() for key, value in obs.items()} == {"common": [0, 1], "privileged": [0], "target": [2]}
    assert env.observation_space["privileged"] == spaces.Box(-0.25, 0.25, (1,), np.float32)
    check_env(env, warn=False)


def test_a_negative_scale_keeps_the_bounds_in_order():
    space = PrivilegedObservation(FlatEnv(), privileged=[2, 3], scale=[-0.1, 0.1]).observation_space["privileged"]
    np.testing.assert_allclose(space.low, [-0.8, 1.0])
    np.testing.assert_allclose(space.high, [0.0, 2.0])


class DictEnv(gym.Env):
    observation_space = spaces.Dict(pose=BOX, speed=BOX, goal=BOX, camera=IMAGE)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), 0.0, False, False, {}

    def _observe(self):
        one = np.ones(2, np.float32)
        return {"pose": 0.1 * one, "speed": 0.2 * one, "goal": 0.3 * one, "camera": np.full(IMAGE.shape, 7, np.uint8)}


def test_keys_are_concatenated_and_images_pass_through():
    env = PrivilegedObservation(DictEnv(), privileged=["goal"], target=["camera"])
    obs, _ = env.reset()
    np.testing.assert_allclose(obs["common"], [0.1, 0.1, 0.2, 0.2])
    np.testing.assert_allclose(obs["privileged"], [0.3, 0.3])
    assert obs["target"].dtype == np.uint8 and env.observation_space["target"] == IMAGE
    check_env(env, warn=False)


@pytest.mark.parametrize("kwargs", [dict(privileged=["goal"]), dict(privileged=["goal"], target=["camera", "speed"])])
def test_an_image_among_numbers_is_refused(kwargs):
    with pytest.raises(ValueError, match=r"\['camera'\].*target=\['camera'\]"):
        PrivilegedObservation(DictEnv(), **kwargs)


@pytest.mark.parametrize(
    "kwargs",
    [dict(privileged=[]), dict(privileged=[7]), dict(privileged=[1], target=[1]), dict(privileged=[0, 1, 2, 3])],
)
def test_impossible_parts_are_refused(kwargs):
    with pytest.raises(ValueError, match=r"name at least one|must stay common"):
        PrivilegedObservation(FlatEnv(), **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(privileged=[2], scale=[0.1, 0.2]), r"scale=.*one for each of the 1 privileged"),
        (dict(privileged=[1, 2], offset=[0.0, 1.0, 2.0]), r"offset=.*one for each of the 2 privileged"),
        (dict(privileged=2), r"privileged=2: give a list"),
        (dict(privileged="goal"), r"give a list .*\['goal'\]"),
        (dict(privileged=[1], target=3), r"target=3: give a list"),
    ],
)
def test_numbers_that_do_not_fit_the_parts_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        PrivilegedObservation(FlatEnv(), **kwargs)


def test_indices_may_be_an_array():
    env = PrivilegedObservation(FlatEnv(), privileged=np.array([1, 2]), scale=[1.0, 2.0])
    assert env.observation_space["privileged"].shape == (2,)
