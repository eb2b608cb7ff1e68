"""What actor and critic see."""

import math
from collections.abc import Sequence

import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_uspl.encoder import MIN_STD, RunningNormalizer
from sb3_uspl.observations import BELIEF, COMMON, PRIVILEGED, UNCERTAINTY
from sb3_uspl.symmetries import Symmetry, SymmetryGroup
from sb3_uspl.uncertainty import INITIAL_STD

BELIEF_SHARE = 0.3
"""Gain of the encoder's mean as an input, relative to the privileged observation's: at an equal gain, a policy that may take
either relies on the mean before the encoder is worth it."""


class PolicyFeatures(BaseFeaturesExtractor):
    """
    Concatenates what the actor or the critic sees, each part brought to about unit scale.

    :param observation_space: with the keys ``POLICY_KEYS``
    :param privileged_key: ``privileged`` (blurred) for the actor, ``truth`` for the critic
    :param uncertainty_input: whether the uncertainty is seen
    :param mean_input: whether the encoder's mean is seen
    :param privileged_gain: factor on privileged values, whose scale is 0.2-0.25 by contract
    :param normalize_common: whether the common observation is brought to zero mean and unit variance
    :param one_hot: discrete dimensions that are seen as one number for each of their values, and these; None: there are none
    :param symmetries: of the world, see ``SymmetryGroup``: all that look the same are seen as one of them
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        privileged_key: str,
        uncertainty_input: bool,
        mean_input: bool,
        privileged_gain: float,
        normalize_common: bool,
        one_hot: dict[int, list[float]] | None = None,
        symmetries: Sequence[Symmetry] = (),
    ):
        n_privileged = get_flattened_obs_dim(observation_space[PRIVILEGED])
        n_common = get_flattened_obs_dim(observation_space[COMMON])
        one_hot = one_hot or {}
        n_seen = n_privileged + sum(len(values) - 1 for values in one_hot.values())
        super().__init__(observation_space, n_common + n_seen * (1 + mean_input) + n_privileged * uncertainty_input)
        self.privileged_key = privileged_key
        self.one_hot = {dim: sorted(values) for dim, values in one_hot.items()}
        self.continuous = [dim for dim in range(n_privileged) if dim not in one_hot]
        self.uncertainty_input, self.mean_input = uncertainty_input, mean_input
        self.privileged_gain = privileged_gain
        self.common_normalizer = RunningNormalizer(n_common) if normalize_common else nn.Identity()
        self.symmetries = SymmetryGroup(symmetries, n_common, n_privileged) if symmetries else None

    def forward(self, obs: dict[str, th.Tensor]) -> th.Tensor:
        """
        :param obs: batch by key, ``(n, ...)``
        :return: ``(n, features_dim)``
        :raises ValueError: if a part is missing
        """
        wanted = [COMMON, self.privileged_key] + [UNCERTAINTY] * self.uncertainty_input + [BELIEF] * self.mean_input
        missing = [key for key in wanted if key not in obs]
        if missing:
            raise ValueError(
                f"There is no {missing} in the observation {sorted(obs)}. Actor and critic see what experience is made into, "
                f"{wanted}; `predict` takes the environment's own observations."
            )
        obs = self._canonical(obs)
        parts = [self.common_normalizer(obs[COMMON]), self._seen(obs[self.privileged_key])]
        if self.uncertainty_input:
            # Log scale, as the reward transformation: INITIAL_STD -> 0, MIN_STD -> -1. The warm-up knows little but 0, so
            # that certainty, when it comes, does not act through weights that grew as a bias.
            parts.append(-th.log(obs[UNCERTAINTY].clamp(min=MIN_STD) / INITIAL_STD) / math.log(MIN_STD / INITIAL_STD))
        if self.mean_input:
            parts.append(self._seen(obs[BELIEF]) * BELIEF_SHARE)
        return th.cat(parts, dim=1)

    def update_normalizer(self, common: th.Tensor) -> None:
        """
        Let the normaliser know more observations, if there is one.

        :param common: ``(n, n_common)``
        """
        if isinstance(self.common_normalizer, RunningNormalizer):
            self.common_normalizer.update(self._canonical({COMMON: common})[COMMON])

    def _canonical(self, obs: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        return obs if self.symmetries is None else self.symmetries.turn(obs, self.symmetries.canonical(obs[COMMON]))

    def _seen(self, privileged: th.Tensor) -> th.Tensor:
        if not self.one_hot:
            return privileged * self.privileged_gain
        parts = [privileged[:, self.continuous] * self.privileged_gain]
        parts += [one_hot(privileged[:, dim], values) for dim, values in self.one_hot.items()]
        return th.cat(parts, dim=1)


def one_hot(x: th.Tensor, values: Sequence[float]) -> th.Tensor:
    """
    How much of each value a number is: 1 of the one that it equals, shares of its two neighbours in between.

    :param x: ``(n,)``
    :param values: at least two, in order
    :return: ``(n, n_values)``, not negative, each row's sum is 1
    """
    v = th.tensor(values, dtype=x.dtype, device=x.device)
    passed = ((x[:, None] - v[:-1]) / (v[1:] - v[:-1])).clamp(0.0, 1.0)
    return F.pad(passed, (1, 0), value=1.0) - F.pad(passed, (0, 1))
