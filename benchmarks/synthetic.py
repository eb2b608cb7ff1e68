"""An environment under the observation contract that takes hardly any time, in any size."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_uspl.observations import COMMON, PRIVILEGED, TARGET

N_COMMON, N_ACTION, LIMIT = 4, 1, 0.25
_N_IMAGES = 16


class SyntheticEnv(gym.Env):
    """
    Episodes of one length with random observations; what only the encoder sees may be a picture.

    :param episode_length: decisions
    :param image: edge of the picture in pixels; None leaves it out
    :raises ValueError: for a length or an edge below 1
    """

    decision_period = 0.25
    """s"""

    def __init__(self, episode_length: int = 80, image: int | None = None) -> None:
        if episode_length < 1 or (image is not None and image < 1):
            raise ValueError(f"episode_length={episode_length}, image={image}: both must be at least 1 (image: or None).")
        self.episode_length = episode_length
        parts: dict[str, spaces.Space[Any]] = {
            COMMON: spaces.Box(-1.0, 1.0, (N_COMMON,), np.float32),
            PRIVILEGED: spaces.Box(-LIMIT, LIMIT, (1,), np.float32),
        }
        rng = np.random.default_rng(0)
        self._images: np.ndarray | None = None
        if image is not None:
            parts[TARGET] = spaces.Box(0, 255, (1, image, image), np.uint8)
            self._images = rng.integers(0, 256, (_N_IMAGES, 1, image, image), dtype=np.uint8)
        self._common = rng.uniform(-1.0, 1.0, (episode_length + 1, N_COMMON)).astype(np.float32)
        self.observation_space = spaces.Dict(parts)
        self.action_space = spaces.Box(-1.0, 1.0, (N_ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """
        Start an episode.

        :param seed: of the privileged observation
        :param options: none are known
        """
        super().reset(seed=seed)
        self._time = 0
        self._privileged = self.np_random.uniform(-LIMIT, LIMIT, 1).astype(np.float32)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        """
        :param action: multiplies the privileged observation in the reward
        """
        self._time += 1
        return self._observe(), float(action[0] * self._privileged[0]), self._time >= self.episode_length, False, {}

    def _observe(self) -> dict[str, np.ndarray]:
        observation = {COMMON: self._common[self._time], PRIVILEGED: self._privileged}
        if self._images is not None:
            observation[TARGET] = self._images[self._time % _N_IMAGES]
        return observation
