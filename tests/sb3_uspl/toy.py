"""A tiny environment under the observation contract, configurable in every respect that the learner depends on; its models."""

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_uspl import USPLPPO

IMAGE = spaces.Box(0, 255, (1, 40, 40), np.uint8)


class ToyEnv(gym.Env):
    """Guess the sign of a hidden number, which the third observation of every episode reveals."""

    decision_period = 0.2

    def __init__(self, length=8, target=None, action_space=None, n_privileged=1, terminate=False, bounded=True):
        self.length, self.terminate = length, terminate
        limit = 0.25 if bounded else np.inf
        parts = {
            "common": spaces.Box(-1, 1, (2,), np.float32),
            "privileged": spaces.Box(-limit, limit, (n_privileged,), np.float32),
        }
        if target is not None:
            parts["target"] = target
        self.observation_space = spaces.Dict(parts)
        self.action_space = action_space or spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.hidden = self.np_random.choice([-0.25, 0.25], self.observation_space["privileged"].shape).astype(np.float32)
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        over = self.t >= self.length
        reward = float(np.sign(self.hidden[0]) * np.asarray(action, dtype=np.float64).ravel()[0])
        return self._observe(), reward, over and self.terminate, over and not self.terminate, {"is_success": reward > 0}

    def _observe(self):
        revealed = 4 * self.hidden[0] if self.t == 2 else 0.0
        obs = {"common": np.array([self.t / self.length, revealed], np.float32), "privileged": self.hidden.copy()}
        target = self.observation_space.spaces.get("target")
        if target is not None:
            obs["target"] = np.full(target.shape, 100 + self.t, target.dtype)
        return obs


FAST = dict(n_steps=16, batch_size=32, n_epochs=2, encoder_updates=2, encoder_batch_size=64, seed=0)


def make_venv(n_envs=8, seed=0, **kwargs):
    return make_vec_env(ToyEnv, n_envs, seed=seed, env_kwargs=kwargs)


def make_model(n_envs=8, policy="MlpPolicy", algorithm=USPLPPO, env_kwargs=None, **kwargs):
    return algorithm(policy, make_venv(n_envs, **(env_kwargs or {})), **{**FAST, **kwargs})


def parameters(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def assert_equal_parameters(a, b, only=""):
    names = [name for name in a if name.startswith(only)]
    assert names and all(th.equal(a[name], b[name]) for name in names)
