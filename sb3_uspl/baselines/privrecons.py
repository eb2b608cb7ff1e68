"""PrivRecons as the paper runs it (App. C.2): experience of the deployment policy, networks and encoder of USPL."""

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl.observations import PRIVILEGED
from sb3_uspl.policies import USPLPolicy
from sb3_uspl.uspl_ppo import USPLPPO
from sb3_uspl.wrappers import UncertaintyVecWrapper


class BeliefVecWrapper(UncertaintyVecWrapper):
    """Shows the encoder's mean where the privileged observation was, also to the mismatched environments."""

    @staticmethod
    def _assemble(obs: dict[str, np.ndarray], shown: np.ndarray, mean: np.ndarray, std: np.ndarray) -> dict[str, np.ndarray]:
        return UncertaintyVecWrapper._assemble(obs, shown, mean, std) | {PRIVILEGED: mean}


class PrivRecons(USPLPPO):
    """
    The policy acts on the encoder's mean while it trains, too: PPO collects the experience of the deployment policy.

    PPO updates actor and critic only, with the mean as a constant; the encoder learns by maximum likelihood (Eq. 1), as in
    ``USPLPPO``. The critic sees the true privileged observation. As in the authors' release, a share of the environments,
    which are USPL's mismatched ones, feeds the encoder alone; ``mismatch_fraction=0`` gives PPO all of them. Unlike in the
    release, the encoder learns from the start and not only after the warm-up, in which the policy would get used to the mean
    of an untrained one (``encoder_warmup=False`` for that).

    :param policy: as for ``USPLPPO``
    :param env: as for ``USPLPPO``
    :param blur: must be off: there is no privileged observation to blur
    :param reward_scaling: off
    :param uncertainty_input: off
    :param kwargs: as for ``USPLPPO``
    :raises ValueError: if ``blur`` is on, or as for ``USPLPPO``
    """

    def __init__(
        self,
        policy: str | type[USPLPolicy],
        env: GymEnv | str,
        *,
        blur: bool = False,
        reward_scaling: bool = False,
        uncertainty_input: bool = False,
        **kwargs: Any,
    ):
        if blur:
            raise ValueError("blur=True: PrivRecons acts on the encoder's mean, which is not blurred. Leave `blur` off.")
        super().__init__(policy, env, blur=blur, reward_scaling=reward_scaling, uncertainty_input=uncertainty_input, **kwargs)

    def _make_rollout_env(self, env: VecEnv) -> UncertaintyVecWrapper:
        return BeliefVecWrapper(env, self.policy.encoder, self._uncertainty_config, self.seed)
