"""RewReg (App. C.2): RMA with a penalty on the divergence of privileged and deployment policy."""

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_uspl.baselines.rma import RMA
from sb3_uspl.encoder import ObservationEncoder
from sb3_uspl.observations import BELIEF, POLICY_KEYS, PRIVILEGED, TRUTH
from sb3_uspl.policies import USPLPolicy
from sb3_uspl.wrappers import UncertaintyConfig, UncertaintyVecWrapper

DIVERGENCES = ("behaviour", "prediction")
MAX_KL = 5.0
"""Divergence of behaviour that counts most, nats: with a small action noise, two opposite actions are hundreds apart."""


class PenaltyVecWrapper(UncertaintyVecWrapper):
    """
    Subtracts a penalty from the reward of every decision that the deployment policy would not have taken.

    :param venv: as for ``UncertaintyVecWrapper``
    :param encoder: as for ``UncertaintyVecWrapper``
    :param config: as for ``UncertaintyVecWrapper``
    :param seed: as for ``UncertaintyVecWrapper``
    :param policy: whose divergence is penalised
    :param weight: reward per unit of divergence
    :param divergence: "behaviour" or "prediction", see :class:`RewReg`
    """

    def __init__(
        self,
        venv: VecEnv,
        encoder: ObservationEncoder,
        config: UncertaintyConfig,
        seed: int | None,
        policy: USPLPolicy,
        weight: float,
        divergence: str,
    ):
        super().__init__(venv, encoder, config, seed)
        self.policy, self.weight, self.divergence = policy, weight, divergence
        self._last: dict[str, np.ndarray] = {}

    def _observe(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self._last = super()._observe(obs)
        return self._last

    def step_wait(self) -> VecEnvStepReturn:
        # Before the step: the reward is that of the action taken on the observation that is now the last one.
        divergence = self._divergence()
        obs, rewards, dones, infos = super().step_wait()
        self.metrics["divergence"].append(divergence[: self._n_matched])
        return obs, (rewards - self.progress * self.weight * divergence).astype(np.float32), dones, infos

    @th.no_grad()
    def _divergence(self) -> np.ndarray:
        """Of every environment at its last observation, ``(n_envs,)``."""
        last = self._last
        if self.divergence == "prediction":
            return np.sqrt(np.square(last[BELIEF] - last[TRUTH]).mean(axis=1))
        obs = {key: th.as_tensor(last[key], device=self.device) for key in POLICY_KEYS}
        # A copy, because the policy has one distribution, which the second call fills anew.
        privileged = copy.copy(self.policy.get_distribution(obs))  # type: ignore[arg-type]
        deployed = self.policy.get_distribution({**obs, PRIVILEGED: obs[BELIEF]})  # type: ignore[arg-type]
        kl = kl_divergence(privileged, deployed)
        return kl.reshape(self.num_envs, -1).sum(dim=1).clamp(max=MAX_KL).cpu().numpy()


class RewReg(RMA):
    """
    RMA whose privileged policy is penalised where the deployment policy would act otherwise.

    The authors' release has no RewReg and the paper no formula. Ours is the reward penalty of its reference [20] (Messikommer
    et al., "Student-Informed Teacher Training", ICLR 2025), with the deployment policy in the place of their student::

        r_hat = r - l w D,    D = min(KL(pi(. | o_c, o_p) || pi(. | o_c, mu_p)), 5 nats)

    where l is the progress coefficient of App. C.3.1, so that the policy first learns the task. There is no need of their
    proxy student, as the encoder runs beside the environments, nor of their alignment step, as both policies are one network.
    With ``divergence="prediction"``, D is the root mean square of mu_p - o_p instead, of which the release has a remnant.

    :param policy: as for ``USPLPPO``
    :param env: as for ``USPLPPO``
    :param penalty_weight: w, in units of the reward. The default makes the complete divergence of a decision cost 0.5, about
        what the best decision earns in our navigation tasks; it is not tuned.
    :param divergence: "behaviour" or "prediction"
    :param kwargs: as for ``RMA``
    :raises ValueError: for a negative weight or an unknown divergence, or as for ``USPLPPO``
    """

    def __init__(
        self,
        policy: str | type[USPLPolicy],
        env: GymEnv | str,
        *,
        penalty_weight: float = 0.1,
        divergence: str = "behaviour",
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(policy, env, _init_setup_model=False, **kwargs)
        self.penalty_weight, self.divergence = penalty_weight, divergence
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if not 0.0 <= self.penalty_weight < np.inf:
            raise ValueError(f"penalty_weight={self.penalty_weight}: give the reward per unit of divergence, 0 or more.")
        if self.divergence not in DIVERGENCES:
            raise ValueError(f"divergence='{self.divergence}': choose one of {DIVERGENCES}.")

    def _make_rollout_env(self, env: VecEnv) -> UncertaintyVecWrapper:
        config, weight = self._uncertainty_config, self.penalty_weight
        return PenaltyVecWrapper(env, self.policy.encoder, config, self.seed, self.policy, weight, self.divergence)
