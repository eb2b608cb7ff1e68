"""Makes a task with hidden parameters out of an ordinary Gymnasium environment."""

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_uspl.observations import COMMON, PRIVILEGED

INFORMATIONLESS_STD = 0.25
"""Standard deviation of a privileged value that nothing is known of, the scale of the paper's constants."""
_STREAM = 0x5EED
"""Sets our random numbers apart from the environment's own, which start from the same seed."""


class HiddenParameters(gym.Wrapper):
    """
    Draw some attributes of an environment anew in every episode, and observe them as ``privileged``.

    What the environment returns becomes ``common``. A tuple ``(low, high)`` is a range from which values are drawn uniformly,
    a list holds single values, which are equally likely. Each becomes one privileged number, shifted and scaled so that a
    guess without information has the mean 0 and a standard deviation of 0.25. The value itself is in ``info["hidden"]``.

    :param env: environment with a one-dimensional ``Box`` observation
    :param parameters: attribute of ``env.unwrapped`` -> ``(low, high)`` or list of values
    :param decision_period: s per decision; None leaves what the environment says
    :raises ValueError: for another observation space, an attribute that does not exist, or values that do not differ
    """

    def __init__(
        self,
        env: gym.Env,
        parameters: Mapping[str, tuple[float, float] | list[float]],
        decision_period: float | None = None,
    ):
        super().__init__(env)
        space = env.observation_space
        if isinstance(space, spaces.Dict) and PRIVILEGED in space.spaces:
            raise ValueError(
                f"{env} has a privileged observation already, which would become one of its sensors: name all hidden "
                "parameters in one HiddenParameters around the environment without it."
            )
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(
                f"HiddenParameters takes a one-dimensional Box observation, not {space}: wrap the environment in "
                "gymnasium.wrappers.FlattenObservation first."
            )
        if not parameters:
            raise ValueError("No parameter is hidden: name at least one attribute and its values.")
        for name, values in parameters.items():
            self._check(name, values)
        self.parameters = {name: values for name, values in parameters.items()}
        self.discrete_privileged: dict[int, list[float]] = {}
        """Dimensions that are lists, and their values as they are observed; asked for by ``USPLPPO``."""
        self._middles, self._scales = np.zeros(len(parameters)), np.ones(len(parameters))
        for dim, values in enumerate(parameters.values()):
            low, high = min(values), max(values)
            is_range = isinstance(values, tuple)
            self._middles[dim] = 0.5 * (low + high) if is_range else np.mean(values)
            std = (high - low) / math.sqrt(12.0) if is_range else np.std(values)
            self._scales[dim] = INFORMATIONLESS_STD / std
            if not is_range:
                self.discrete_privileged[dim] = [self._observed(dim, value) for value in values]
        ends = np.array([(min(values), max(values)) for values in parameters.values()])
        limits = ((ends - self._middles[:, None]) * self._scales[:, None]).astype(np.float32)
        self.observation_space = spaces.Dict(
            {COMMON: space, PRIVILEGED: spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)}
        )
        if decision_period is not None:
            self.decision_period = decision_period
        self._rng = np.random.default_rng()
        self._privileged = np.zeros(len(parameters), dtype=np.float32)

    def _check(self, name: str, values: Sequence[float]) -> None:
        if not hasattr(self.env.unwrapped, name):
            known = sorted(
                key for key, value in vars(self.env.unwrapped).items() if isinstance(value, int | float) and key[0] != "_"
            )
            raise ValueError(f"{self.env.unwrapped} has no attribute '{name}'; its numbers are {known}.")
        try:
            setattr(self.env.unwrapped, name, getattr(self.env.unwrapped, name))
        except AttributeError as error:
            raise ValueError(f"'{name}' of {self.env.unwrapped} cannot be set; give the property a setter: {error}") from error
        if not isinstance(values, tuple | list):
            raise ValueError(f"'{name}': {values!r}; expected a range (low, high) or a list of two or more values.")
        is_possible = all(isinstance(value, numbers.Real) and math.isfinite(value) for value in values)
        if isinstance(values, tuple):
            is_possible = is_possible and len(values) == 2 and values[0] < values[1]
        if not is_possible or len(set(values)) < 2:
            raise ValueError(
                f"'{name}': {values!r}; expected a range (low, high) with low < high, or a list of two or more numbers."
            )

    def _observed(self, dim: int, value: float) -> float:
        return float(np.float32((value - self._middles[dim]) * self._scales[dim]))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Draw the parameters, then start the episode.

        :param seed: of the parameters and of the environment
        :param options: of the environment
        """
        if seed is not None:
            self._rng = np.random.default_rng([seed, _STREAM])
        hidden: dict[str, float] = {}
        for dim, (name, values) in enumerate(self.parameters.items()):
            drawn = self._rng.uniform(*values) if isinstance(values, tuple) else values[self._rng.integers(len(values))]
            hidden[name] = float(drawn)
            self._privileged[dim] = self._observed(dim, hidden[name])
            setattr(self.env.unwrapped, name, drawn)
        obs, info = self.env.reset(seed=seed, options=options)
        return self._observation(obs), {**info, "hidden": hidden}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, *others = self.env.step(action)
        return self._observation(obs), *others  # type: ignore[return-value]

    def _observation(self, obs: np.ndarray) -> dict[str, np.ndarray]:
        return {COMMON: obs, PRIVILEGED: self._privileged.copy()}
