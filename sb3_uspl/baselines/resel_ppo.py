"""RESeL-PPO as the paper runs it (App. C.2): the deployment policy itself is trained, by PPO alone."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl._arguments import check_action_std
from sb3_uspl._experience import WrappedExperience
from sb3_uspl.baselines.resel_policy import RESeLPolicy
from sb3_uspl.baselines.sequences import HistoryVecWrapper, SequenceRolloutBuffer
from sb3_uspl.observations import check_observation_space, check_vec_wrappers
from sb3_uspl.schedules import CosineSchedule, falling


class RESeLPPO(WrappedExperience[HistoryVecWrapper]):
    """
    The deployment policy, a Transformer, trained end to end by PPO on whole sequences (App. C.2; RESeL: Luo et al., 2024).

    What makes that stable in RESeL is a much smaller learning rate for the memory than for the layers after it. The authors'
    release squeezes the memory through as many numbers as the privileged observation has; here it passes at its full width.

    :param policy: "MlpPolicy", "CnnPolicy" or "MultiInputPolicy", all the same, as the network follows the observation space;
        or a subclass of ``RESeLPolicy``
    :param env: environment under the observation contract (see ``sb3_uspl.observations``)
    :param learning_rate: of actor and critic, as for ``USPLPPO``
    :param n_steps: decisions per environment and rollout
    :param batch_size: decisions in a minibatch, which is whole environments: a multiple of ``n_steps``
    :param n_epochs: passes of PPO over a rollout (release: 15)
    :param max_grad_norm: of PPO, for actor, critic and encoder together (release: 40)
    :param target_kl: of PPO, which stops an update at 1.5 times this (release: an update is skipped at 0.1)
    :param learning_rate_floor: as for ``USPLPPO``
    :param action_std: as for ``USPLPPO``
    :param action_std_floor: as for ``USPLPPO``
    :param encoder_learning_rate: of token features, memory and embedding; constant unless a schedule is given (release: 5e-5)
    :param context_length: longest episode, in decisions
    :param kwargs: as for ``PPO``
    :param _init_setup_model: as in SB3
    :raises ValueError: for a space outside the contract or an argument outside its range, naming what to do
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": RESeLPolicy,
        "CnnPolicy": RESeLPolicy,
        "MultiInputPolicy": RESeLPolicy,
    }
    policy: RESeLPolicy
    rollout_buffer: SequenceRolloutBuffer

    def __init__(
        self,
        policy: str | type[RESeLPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 128,
        batch_size: int = 512,
        n_epochs: int = 10,
        max_grad_norm: float = 40.0,
        target_kl: float | None = 0.067,
        learning_rate_floor: float = 0.05,
        action_std: float | Sequence[float] | None = 0.35,
        action_std_floor: float = 0.5,
        encoder_learning_rate: float | Schedule = 5e-5,
        context_length: int = 1024,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        if kwargs.get("use_sde"):
            raise ValueError("RESeLPPO anneals the action noise itself (action_std); use_sde=True is not supported.")
        kwargs["rollout_buffer_class"] = kwargs.get("rollout_buffer_class") or SequenceRolloutBuffer
        super().__init__(
            # SB3 refuses "MlpPolicy" on a Dict space by its name, so the name is resolved first.
            self.policy_aliases.get(policy, policy) if isinstance(policy, str) else policy,  # type: ignore[arg-type]
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            # Of any other, SB3 would warn even while it loads a model, when the number of decisions is not yet the model's.
            batch_size=max(n_steps, 2),
            n_epochs=n_epochs,
            max_grad_norm=max_grad_norm,
            target_kl=target_kl,
            _init_setup_model=False,
            **kwargs,
        )
        self.batch_size = batch_size
        self.learning_rate_floor = learning_rate_floor
        self.action_std, self.action_std_floor = action_std, action_std_floor
        self.encoder_learning_rate = encoder_learning_rate
        self.context_length = context_length
        if _init_setup_model:
            self._setup_model()

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = falling(self.learning_rate, self.learning_rate_floor)

    def _setup_model(self) -> None:
        self._check_arguments()
        self.encoder_lr_schedule = FloatSchedule(self.encoder_learning_rate)
        given = self.rollout_buffer_kwargs
        self.rollout_buffer_kwargs = {**given, "context_length": self.context_length}
        super()._setup_model()
        self.rollout_buffer_kwargs = given
        self._action_std_share: CosineSchedule | None = None
        if self.action_std is not None and isinstance(self.action_space, spaces.Box):
            self._action_std_share = CosineSchedule(1.0, self.action_std_floor)
            self.policy.set_action_std(self.action_std)
        self._rollout_env = None

    def _check_arguments(self) -> None:
        check_observation_space(self.observation_space)
        if self.env is not None:
            check_vec_wrappers(self.env)
        if not issubclass(self.policy_class, RESeLPolicy):
            raise ValueError(f"RESeLPPO needs a subclass of RESeLPolicy as policy; {self.policy_class} was given.")
        if not issubclass(self.rollout_buffer_class or SequenceRolloutBuffer, SequenceRolloutBuffer):
            raise ValueError(f"RESeLPPO needs a subclass of SequenceRolloutBuffer; {self.rollout_buffer_class} was given.")
        if self.batch_size < self.n_steps or self.batch_size % self.n_steps:
            raise ValueError(
                f"batch_size={self.batch_size} with n_steps={self.n_steps}: a minibatch holds whole environments, so "
                "batch_size must be a multiple of n_steps."
            )
        if self.context_length < 1:
            raise ValueError(f"context_length={self.context_length}: an episode has one decision at least.")
        check_action_std(self.action_std, self.action_space, self.policy_kwargs)

    def _make_rollout_env(self, env: VecEnv) -> HistoryVecWrapper:
        return HistoryVecWrapper(env, self.policy.encoder)

    def _start_episodes(self, wrapper: HistoryVecWrapper) -> None:
        assert isinstance(self._last_obs, dict)
        self.rollout_buffer.forget_running()
        self._last_obs = wrapper.begin(self._last_obs)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        wrapper, buffer = self._rollout_env, rollout_buffer
        assert wrapper is not None and env is self.env and isinstance(buffer, SequenceRolloutBuffer)
        assert self._last_episode_starts is not None
        if self._action_std_share is not None:
            assert self.action_std is not None
            self.policy.set_action_std(self._action_std_share(self._current_progress_remaining) * np.asarray(self.action_std))
        buffer.keep_running(self._last_episode_starts)
        self._last_obs = wrapper.resume(*buffer.running_tokens())  # type: ignore[assignment]
        return self._collect_in_wrapper(callback, buffer, n_rollout_steps)

    def train(self) -> None:
        """PPO's update, through the memory; then the normalisers, which must not change within it."""
        super().train()
        self.policy.update_normalizers(self.rollout_buffer.rollout_tokens())

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        learning_rate = self.encoder_lr_schedule(self._current_progress_remaining)
        self.policy.optimizer.param_groups[1]["lr"] = learning_rate
        self.logger.record("encoder/learning_rate", learning_rate)
