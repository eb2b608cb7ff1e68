"""RMA (Kumar et al. 2021) as the paper runs it (App. C.2)."""

from typing import Any

from stable_baselines3.common.type_aliases import GymEnv

from sb3_uspl.policies import USPLPolicy
from sb3_uspl.uspl_ppo import USPLPPO


class RMA(USPLPPO):
    """
    USPL without its three parts: an exact privileged observation, no uncertainty input, the task's own reward.

    Sampling, networks, encoder and mismatched episodes stay the same, so any difference to ``USPLPPO`` is one of method.

    :param policy: as for ``USPLPPO``
    :param env: as for ``USPLPPO``
    :param blur: off
    :param reward_scaling: off
    :param uncertainty_input: off
    :param kwargs: as for ``USPLPPO``
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
        super().__init__(policy, env, blur=blur, reward_scaling=reward_scaling, uncertainty_input=uncertainty_input, **kwargs)
