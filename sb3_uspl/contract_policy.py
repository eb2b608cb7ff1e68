"""What the policies of all our algorithms share: the observation contract, and continuous actions within their bounds."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.utils import is_vectorized_observation

from sb3_uspl.activations import recoverable_tanh
from sb3_uspl.encoder import MemoryState
from sb3_uspl.observations import COMMON, PRIVILEGED, TARGET, check_finite
from sb3_uspl.policy_features import PolicyFeatures


class ContractPolicy(ActorCriticPolicy):
    """
    Actor and critic of an algorithm on the observation contract, which build their own features.

    A subclass sets ``contract`` and calls :meth:`_own_features` before ``ActorCriticPolicy``'s constructor, and
    :meth:`_bound_mean` after it.
    """

    contract: spaces.Dict
    action_centre: th.Tensor
    action_half_range: th.Tensor

    @classmethod
    def _own_features(cls, kwargs: dict[str, Any]) -> None:
        """
        :param kwargs: of ``ActorCriticPolicy``, of which those that choose its features are taken out
        :raises ValueError: if they choose others
        """
        for name in ("features_extractor_class", "features_extractor_kwargs", "share_features_extractor"):
            if kwargs.pop(name, None) not in (None, PolicyFeatures, {}, False):
                raise ValueError(f"{cls.__name__} builds its own features; '{name}' cannot be set.")

    def _bound_mean(self, bounded: bool) -> None:
        """
        :param bounded: whether the mean of continuous actions is squashed into the action space
        """
        space = self.action_space
        self.bounded_mean = bounded and isinstance(space, spaces.Box)
        if self.bounded_mean:
            low, high = (th.as_tensor(bound, device=self.device) for bound in (space.low, space.high))  # type: ignore[attr-defined]
            self.register_buffer("action_centre", 0.5 * (high + low).flatten())
            self.register_buffer("action_half_range", 0.5 * (high - low).flatten())

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        if not self.bounded_mean:
            return super()._get_action_dist_from_latent(latent_pi)
        assert isinstance(self.action_dist, DiagGaussianDistribution)
        mean = self.action_centre + self.action_half_range * recoverable_tanh(self.action_net(latent_pi))
        return self.action_dist.proba_distribution(mean, self.log_std)

    def _starts(self, episode_start: np.ndarray, n_envs: int) -> np.ndarray:
        """Which environments have just been reset, ``(n_envs,)``."""
        starts = np.asarray(episode_start, dtype=bool)
        if starts.size != n_envs:
            raise ValueError(f"`episode_start` is about {starts.size} environments but {n_envs} observations were given.")
        return starts.reshape(n_envs)

    def _as_memory(self, parts: Any, initial: MemoryState) -> MemoryState:
        """A copy, because the memory is updated in place while the caller may keep the state."""
        if len(parts) != len(initial):
            raise ValueError(
                f"The state's memory has {len(parts)} parts but this policy's has {len(initial)}: pass the state that this "
                "policy's predict returned, or None to start anew."
            )
        return tuple(th.as_tensor(part.copy(), device=self.device) for part in parts)

    def set_action_std(self, std: float | Sequence[float] | np.ndarray) -> None:
        """
        Fix the standard deviation of continuous actions (App. C.3.1 anneals it instead of learning it).

        :param std: standard deviation of the sampled actions, of all or of each, ``(n_action,)``
        """
        self.log_std.requires_grad_(False)
        self.log_std.data.copy_(th.as_tensor(np.log(std)))

    def _as_tokens(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[dict[str, th.Tensor], bool]:
        if not isinstance(observation, dict):
            raise ValueError(
                f"The observation is a {type(observation).__name__}; expected a dict with the keys "
                f"{[key for key in self.contract.spaces if key != PRIVILEGED]}. `env.reset()` of a Gymnasium env returns "
                "(obs, info): pass only obs."
            )
        keys = [key for key in (COMMON, TARGET) if key in self.contract.spaces]
        missing = [key for key in keys if key not in observation]
        if missing:
            raise ValueError(
                f"The observation has the keys {sorted(observation)}; the deployment policy also needs {missing}."
            )
        # Images with the channels last come as the environment has them, while the training saw SB3's transposed ones. Copies,
        # as in SB3: torch takes no views that run backwards, and the encoder scales images in place.
        arrays = {key: maybe_transpose(np.array(observation[key]), self.contract[key]) for key in keys}
        check_finite(arrays)
        vectorized = is_vectorized_observation(arrays[COMMON], self.contract[COMMON])
        if not vectorized:
            arrays = {key: array[None] for key, array in arrays.items()}
        return {key: th.as_tensor(array, device=self.device) for key, array in arrays.items()}, vectorized
