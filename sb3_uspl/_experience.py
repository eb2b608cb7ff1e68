"""What algorithms share whose experience comes through a wrapper of their own; ``model.env`` stays what the user gave."""

from typing import Any, Generic, TypeVar

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs
from torch import nn

from sb3_uspl.observations import check_vec_wrappers

SelfWrappedExperience = TypeVar("SelfWrappedExperience", bound="WrappedExperience[Any]")


class ExperienceVecWrapper(VecEnvWrapper):
    """
    Runs an encoder beside environments that others may use between two trainings.

    :param venv: environments under the observation contract
    :param encoder: whose memory it keeps
    :raises ValueError: if images or the privileged observation are normalised
    """

    def __init__(self, venv: VecEnv, encoder: nn.Module):
        check_vec_wrappers(venv)
        super().__init__(venv)
        self.encoder = encoder
        self.device = next(encoder.parameters()).device
        self._left: list[Any] = []

    def reset(self) -> VecEnvObs:
        return self.begin(self.venv.reset())  # type: ignore[arg-type]

    def begin(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Start with an empty history.

        :param obs: current observation of the wrapped environments, or one returned by this wrapper
        :return: observation for the policy
        """
        raise NotImplementedError

    def leave(self) -> None:
        """Remember how a rollout leaves the environments."""
        env = self.venv.unwrapped
        env.reset_infos = [dict(info) for info in env.reset_infos]  # no environment's: one may give the same at every reset
        self._left = self._traces()

    def was_left_alone(self) -> bool:
        """Whether no environment has been reset or stepped since."""
        now = self._traces()
        return len(self._left) == len(now) and all(before is after for before, after in zip(self._left, now, strict=True))

    def _traces(self) -> list[Any]:
        """Objects of which resets and steps replace one at least."""
        env = self.venv.unwrapped
        return [*env.reset_infos, getattr(env, "actions", None)]


WrapperT = TypeVar("WrapperT", bound=ExperienceVecWrapper)


class WrappedExperience(PPO, Generic[WrapperT]):
    """PPO whose rollouts are collected in a private wrapper of its environments."""

    _rollout_env: WrapperT | None = None

    def _make_rollout_env(self, env: VecEnv) -> WrapperT:
        """What the experience is collected in."""
        raise NotImplementedError

    def _prepare(self, total_timesteps: int, reset_num_timesteps: bool) -> None:
        """
        What comes before the first episode of a training.

        :param total_timesteps: as for ``learn``
        :param reset_num_timesteps: as for ``learn``
        """

    def _start_episodes(self, wrapper: WrapperT) -> None:
        """Begin new episodes in the wrapper, and forget those that were running."""
        raise NotImplementedError

    def learn(
        self: SelfWrappedExperience,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfWrappedExperience:
        name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self._prepare(total_timesteps, reset_num_timesteps)
        if self._rollout_env is not None and not self._rollout_env.was_left_alone():
            self._last_obs = None
        fresh = reset_num_timesteps or self._last_obs is None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        # SB3 does it after a rollout, too late for what depends on it in the first one.
        self._update_current_progress_remaining(self.num_timesteps, max(1, self._total_timesteps))
        wrapper, env = self._rollout_env, self.env
        assert env is not None
        if wrapper is None or wrapper.venv is not env or wrapper.encoder is not self.policy.encoder:
            wrapper = self._rollout_env = self._make_rollout_env(env)
            fresh = True
        if fresh:
            self._start_episodes(wrapper)
        return result

    def _collect_in_wrapper(self, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int) -> bool:
        """PPO's rollout. `model.env` stays the user's: callbacks, VecNormalize and set_env rely on it."""
        wrapper, going_on = self._rollout_env, False
        assert wrapper is not None
        try:
            going_on = super().collect_rollouts(wrapper, callback, rollout_buffer, n_rollout_steps)
        finally:
            if not going_on:
                # The decision at which a callback stops, an environment fails or a user interrupts is not stored: the
                # histories have a gap, so the episodes start anew.
                self._last_obs = None
        wrapper.leave()
        return going_on

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rollout_env"]
