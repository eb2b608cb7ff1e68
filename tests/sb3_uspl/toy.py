"""A tiny environment under the observation contract, configurable in every respect that the learner depends on."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

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
