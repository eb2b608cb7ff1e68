"""USPL on top of Stable-Baselines3's PPO (Alg. 1)."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl import _arguments
from sb3_uspl._experience import WrappedExperience
from sb3_uspl._threads import run_side_by_side, torch_threads
from sb3_uspl.buffers import EpisodeReplayBuffer, USPLRolloutBuffer
from sb3_uspl.distributions import CorrelatedGaussianDistribution
from sb3_uspl.encoder import ObservationEncoder
from sb3_uspl.encoder.training import fit
from sb3_uspl.observations import COMMON
from sb3_uspl.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, USPLPolicy
from sb3_uspl.schedules import CosineSchedule, cosine_progress, falling
from sb3_uspl.symmetries import Symmetry
from sb3_uspl.uncertainty import C_MAX, C_MIN, DELTA, smoothing_factor
from sb3_uspl.wrappers import UncertaintyConfig, UncertaintyVecWrapper


class USPLPPO(WrappedExperience[UncertaintyVecWrapper]):
    """
    Uncertainty-Sensitive Privileged Learning (Luo, Yuan, Yu; NeurIPS 2025) with PPO.

    PPO trains a policy that sees the privileged observation, blurred by the uncertainty of an observation encoder that has to
    predict it from the history of what the robot sees, on rewards scaled by that uncertainty. ``predict`` is the deployment
    policy: encoder and policy together, without the privileged observation.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a subclass of ``USPLPolicy``
    :param env: environment under the observation contract (see ``sb3_uspl.observations``)
    :param learning_rate: of actor and critic. A number falls along a cosine to ``learning_rate_floor`` of itself by the end
        of training (App. C.3.1); a schedule is used as it is. Paper: 1e-4 (actor), 5e-4 (critic); SB3 has one optimizer.
    :param n_steps: decisions per environment and rollout
    :param batch_size: minibatch of PPO
    :param n_epochs: passes of PPO over a rollout
    :param gamma: discount factor per decision (paper: 0.998 per 20 ms, 0.995 for quadrotor and arm)
    :param gae_lambda: of generalised advantage estimation (release: 0.97)
    :param clip_range: of PPO
    :param clip_range_vf: of PPO
    :param normalize_advantage: of PPO
    :param ent_coef: of PPO (the release's has no effect)
    :param vf_coef: of PPO
    :param max_grad_norm: of PPO, for actor and critic together (release: 40). At SB3's 0.5 the critic, whose returns Eq. 2
        scales by up to 3, leaves the actor hardly any gradient.
    :param use_sde: must be False
    :param sde_sample_freq: unused
    :param rollout_buffer_class: a subclass of ``USPLRolloutBuffer``
    :param rollout_buffer_kwargs: its further arguments
    :param target_kl: of PPO
    :param learning_rate_floor: share of the learning rate left at the end of training (release: 1/20)
    :param action_std: initial standard deviation of continuous actions, of all or of each, annealed by a cosine, not learned
        (Table 4: 0.35; Table 5: 0.65). None learns it, as stock PPO does.
    :param action_std_floor: share of ``action_std`` left at the end of training (release: 1/5; see ``docs/findings.md``)
    :param action_noise_time: time constant in s over which the noise of continuous actions is correlated during the warm-up,
        so that it finds detours; 0: not at all
    :param action_noise_timesteps: decisions after the warm-up over which that time constant falls to 0 along a cosine. PPO
        takes the noise for independent, and learns to fight it by jerks where precision is asked for.
    :param warmup_timesteps: decisions before blurring and reward transformation set in (l = 0; C.3.1: 100 epochs). None: 20 %
        of ``total_timesteps`` of ``learn``, and kept when it goes on with ``reset_num_timesteps=False``.
    :param policy_warmup: whether actor and critic learn during the warm-up. Without it, the policy of the warm-up is an
        untrained one: the encoder learns from its strolls, and PPO meets blurring and reward transformation before it has
        learned to do without information.
    :param policy_restart: whether actor and critic start anew after the warm-up. What they learned there serves the encoder's
        experience; one that has learned to do without information may be too sure of itself to look for any.
    :param ramp_timesteps: decisions over which the progress coefficient l rises to 1 (C.3.1: 300 epochs). None: 50 % of
        ``total_timesteps``, and kept likewise.
    :param blur: privileged blurring, Eq. 3 and 4
    :param reward_scaling: reward transformation, Eq. 2
    :param uncertainty_input: whether actor and critic see the uncertainty ("UI" in Table 2)
    :param mean_input: whether they also see the encoder's mean, as in the authors' release. None: if they see the uncertainty
    :param c_min: C_min of Eq. 2
    :param c_max: C_max of Eq. 2
    :param delta: delta of Eq. 2 (Tables 4 and 5)
    :param blur_gain: K of Eq. 3 (Table 11)
    :param blur_noise: distribution of epsilon_c in Eq. 3, "uniform" (bounded dimensions, clipped) or "gaussian"
    :param blur_hold_time: s for which the blur noise is held (release: 10 decisions of 20 ms)
    :param discrete_privileged: discrete dimensions and their values, blurred by Eq. 4, e.g. ``{0: [0.0, 0.25, 0.5]}``. None
        asks the environment's ``discrete_privileged``, else there are none.
    :param smoothing_time: time constant of the uncertainty smoothing in s (release: 0.95 per 20 ms)
    :param decision_period: s per decision. None asks the environment's ``decision_period``, else assumes the paper's 20 ms.
    :param mismatch_fraction: share of environments that act on each other's privileged observation (release: 0.25). None: a
        quarter, or none (with a warning) if that is fewer than two environments.
    :param mismatch_hold_time: least and greatest mean time in s after which a mismatched environment is shown another one's
        privileged observation, spread over the environments. None: once a rollout (release).
    :param wander_share: share of time in which a mismatched environment repeats a random action of its own, so that the
        encoder sees what the policy does not look at yet (0 in the release)
    :param wander_time: least and greatest length of such a stretch in s
    :param wander_actions: components of a continuous action that are drawn at random there, and around what (``{1: 0.6}``),
        where the policy has no reason yet to turn a camera to what is to be seen. None: all, around the middle.
    :param replay: "mismatched" replays mismatched episodes only (release), "all" every episode (Alg. 1)
    :param replay_bytes: memory budget of the episode replay; 0: the encoder learns from the rollout's own episodes only
    :param encoder_learning_rate: of the encoder (Tables 4 and 5: 5e-5 and 2e-5 for the large one), or a schedule
    :param encoder_learning_rate_floor: share of it left at the end of training, after half a cosine wave (release: 1)
    :param encoder_weight_decay: of the encoder (Tables 4 and 5)
    :param encoder_batch_size: decisions per encoder update, in whole episodes (Tables 4 and 5: 8000, 16000)
    :param encoder_updates: encoder updates per rollout (Tables 4 and 5: 450, 170). A loaded model that goes on training begins
        with an empty replay: until that suffices for as many or is full, there is no more than one pass over it per rollout.
    :param encoder_max_grad_norm: gradient clipping of the encoder
    :param encoder_beta: of the encoder's loss, see ``gaussian_nll``; 0 is Eq. 1
    :param encoder_warmup: whether the encoder learns during the warm-up (not in the release)
    :param encoder_window: decisions in a row, from anywhere in an episode, that the encoder learns from at first, where one
        image that tells something is lost among the many of its episode (1: single ones); None: whole episodes
    :param encoder_window_timesteps: decisions until it learns from whole episodes. None: those of the warm-up.
    :param encoder_bf16: whether the encoder's update computes in bfloat16 where torch's autocast deems it safe; for GPUs
    :param encoder_compile: whether ``torch.compile`` translates the encoder for its update: takes minutes; for GPUs
    :param symmetries: of the world (see ``SymmetryGroup``; not in the paper): the encoder also learns from episodes as they
        would have been in a turned one, actor and critic see one of those that look the same. True asks the environment.
    :param context_length: longest episode, in decisions
    :param stats_window_size: as in SB3
    :param tensorboard_log: as in SB3
    :param policy_kwargs: for ``USPLPolicy``, e.g. ``dict(memory="transformer", encoder="paper")``
    :param verbose: as in SB3
    :param seed: as in SB3
    :param device: as in SB3
    :param _init_setup_model: as in SB3
    :raises ValueError: for a space outside the contract or an argument outside its range, naming what to do
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: USPLPolicy
    rollout_buffer: USPLRolloutBuffer

    def __init__(
        self,
        policy: str | type[USPLPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 256,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 40.0,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = USPLRolloutBuffer,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        learning_rate_floor: float = 0.05,
        action_std: float | Sequence[float] | None = 0.35,
        action_std_floor: float = 0.5,
        action_noise_time: float = 0.0,
        action_noise_timesteps: int = 500_000,
        warmup_timesteps: int | None = None,
        policy_warmup: bool = True,
        policy_restart: bool = False,
        ramp_timesteps: int | None = None,
        blur: bool = True,
        reward_scaling: bool = True,
        uncertainty_input: bool = True,
        mean_input: bool | None = None,
        c_min: float = C_MIN,
        c_max: float = C_MAX,
        delta: float = DELTA,
        blur_gain: float = 10.0,
        blur_noise: str = "uniform",
        blur_hold_time: float = 0.2,
        discrete_privileged: dict[int, list[float]] | None = None,
        smoothing_time: float = 0.39,
        decision_period: float | None = None,
        mismatch_fraction: float | None = None,
        mismatch_hold_time: tuple[float, float] | None = None,
        wander_share: float = 0.0,
        wander_time: tuple[float, float] = (0.5, 5.0),
        wander_actions: dict[int, float] | None = None,
        replay: str = "mismatched",
        replay_bytes: int = 256_000_000,
        encoder_learning_rate: float | Schedule = 1e-3,
        encoder_learning_rate_floor: float = 1.0,
        encoder_weight_decay: float = 0.0,
        encoder_batch_size: int = 4096,
        encoder_updates: int = 16,
        encoder_max_grad_norm: float = 1.0,
        encoder_beta: float = 0.5,
        encoder_warmup: bool = True,
        encoder_window: int | None = None,
        encoder_window_timesteps: int | None = None,
        encoder_bf16: bool = False,
        encoder_compile: bool = False,
        symmetries: Sequence[Symmetry] | bool = False,
        context_length: int = 1024,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if use_sde:
            raise ValueError("USPLPPO anneals the action noise itself (action_std); use_sde=True is not supported.")
        super().__init__(
            # SB3 refuses "MlpPolicy" on a Dict space by its name, so the name is resolved first.
            self.policy_aliases.get(policy, policy) if isinstance(policy, str) else policy,  # type: ignore[arg-type]
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            rollout_buffer_class=rollout_buffer_class or USPLRolloutBuffer,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.learning_rate_floor = learning_rate_floor
        self.action_std, self.action_std_floor = action_std, action_std_floor
        self.action_noise_time, self.action_noise_timesteps = action_noise_time, action_noise_timesteps
        self.warmup_timesteps, self.ramp_timesteps = warmup_timesteps, ramp_timesteps
        self.policy_warmup, self.policy_restart = policy_warmup, policy_restart
        self.blur, self.reward_scaling = blur, reward_scaling
        self.uncertainty_input = uncertainty_input
        self.mean_input = uncertainty_input if mean_input is None else mean_input
        self.c_min, self.c_max, self.delta = c_min, c_max, delta
        self.blur_gain, self.blur_noise, self.blur_hold_time = blur_gain, blur_noise, blur_hold_time
        self.discrete_privileged = discrete_privileged
        self.smoothing_time, self.decision_period = smoothing_time, decision_period
        self.mismatch_fraction = mismatch_fraction
        self.mismatch_hold_time = mismatch_hold_time
        self.wander_share, self.wander_time, self.wander_actions = wander_share, wander_time, wander_actions
        self.replay, self.replay_bytes = replay, replay_bytes
        self.encoder_learning_rate, self.encoder_learning_rate_floor = encoder_learning_rate, encoder_learning_rate_floor
        self.encoder_weight_decay = encoder_weight_decay
        self.encoder_batch_size, self.encoder_updates = encoder_batch_size, encoder_updates
        self.encoder_max_grad_norm, self.encoder_warmup = encoder_max_grad_norm, encoder_warmup
        self.encoder_beta = encoder_beta
        self.encoder_window, self.encoder_window_timesteps = encoder_window, encoder_window_timesteps
        self.encoder_bf16, self.encoder_compile = encoder_bf16, encoder_compile
        self.context_length, self.symmetries = context_length, symmetries
        self._progress_period: tuple[int, int] | None = None
        self._replay_is_lost = False
        self._past_warmup: bool | None = None  # in the rollout before; None: there is none
        if _init_setup_model:
            self._setup_model()

    # -- set-up ------------------------------------------------------------------------------------------------------------

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = falling(self.learning_rate, self.learning_rate_floor)

    def _setup_model(self) -> None:
        self.discrete_privileged = _arguments.ask_discrete_privileged(self.env, self.discrete_privileged)
        self.symmetries = _arguments.ask_symmetries(self.env, self.symmetries)
        self._check_arguments()
        # A model that was trained is loaded with any number of environments, be it to evaluate it in one.
        loaded = self._replay_is_lost = self.num_timesteps > 0
        self.n_mismatched = _arguments.count_mismatched(self, lenient=loaded)
        period = self.decision_period = _arguments.ask_decision_period(self.env, self.decision_period)
        self.encoder_lr_schedule = falling(self.encoder_learning_rate, self.encoder_learning_rate_floor)
        smoothing = smoothing_factor(self.smoothing_time, self.decision_period)
        given = self.policy_kwargs, self.rollout_buffer_kwargs
        derived = {
            "uncertainty_input": self.uncertainty_input,
            "mean_input": self.mean_input,
            "discrete_privileged": self.discrete_privileged,
            "smoothing": smoothing,
            "symmetries": self.symmetries,
            "noise_correlation": smoothing_factor(self.action_noise_time, self.decision_period),
            "encoder_learning_rate": self.encoder_lr_schedule(1.0),
            "encoder_weight_decay": self.encoder_weight_decay,
        }
        _arguments.check_policy_kwargs(self.policy_kwargs, derived)
        self.policy_kwargs = {**self.policy_kwargs, **derived}
        self.rollout_buffer_kwargs = {**self.rollout_buffer_kwargs, "n_mismatched": self.n_mismatched}
        super()._setup_model()
        # What was derived stays out of the arguments that save() stores and load() compares.
        self.policy_kwargs, self.rollout_buffer_kwargs = given
        assert isinstance(self.observation_space, spaces.Dict)
        self.rollout_buffer.episodes = EpisodeReplayBuffer(
            self.observation_space,
            get_flattened_obs_dim(self.action_space),
            self.n_envs,
            self.n_mismatched,
            self.context_length,
            self.replay_bytes,
            self.replay,
            self.seed,
        )
        self.rollout_buffer.episodes.symmetries = self.policy.symmetries
        self.rollout_buffer.critic = self.policy.predict_values
        if self.action_std is not None and isinstance(self.action_space, spaces.Box):
            self._action_std_share: CosineSchedule | None = CosineSchedule(1.0, self.action_std_floor)
            self.policy.set_action_std(self.action_std)
        else:
            self._action_std_share = None
        hold = self.mismatch_hold_time
        self._uncertainty_config = UncertaintyConfig(
            blur=self.blur,
            reward_scaling=self.reward_scaling,
            blur_gain=self.blur_gain,
            noise=self.blur_noise,
            noise_hold=max(1, round(self.blur_hold_time / self.decision_period)),
            smoothing=smoothing,
            c_min=self.c_min,
            c_max=self.c_max,
            delta=self.delta,
            discrete_privileged=self.discrete_privileged,
            n_mismatched=self.n_mismatched,
            mismatch_hold=None if hold is None else _arguments.in_decisions("mismatch_hold_time", hold, period),
            wander_share=self.wander_share,
            wander_hold=_arguments.in_decisions("wander_time", self.wander_time, period),
            wander_actions=self.wander_actions,
        )
        self._rollout_env = None

    def _check_arguments(self) -> None:
        _arguments.check_arguments(self)

    # -- training ----------------------------------------------------------------------------------------------------------

    def _prepare(self, total_timesteps: int, reset_num_timesteps: bool) -> None:
        if self.num_timesteps > 0:
            _arguments.count_mismatched(self)  # more strictly than when it was loaded
        if reset_num_timesteps:
            self._replay_is_lost = False
        warmup, ramp = int(0.2 * total_timesteps), int(0.5 * total_timesteps)
        if self._progress_period is not None and not reset_num_timesteps:
            warmup, ramp = self._progress_period
        self._progress_period = (
            warmup if self.warmup_timesteps is None else self.warmup_timesteps,
            ramp if self.ramp_timesteps is None else self.ramp_timesteps,
        )
        if reset_num_timesteps:
            self._past_warmup = None

    def _start_episodes(self, wrapper: UncertaintyVecWrapper) -> None:
        assert isinstance(self._last_obs, dict)
        self._episodes.forget_running()
        wrapper.progress = self.progress  # the first observation is blurred like those after it
        self._last_obs = wrapper.begin(self._last_obs)

    def _make_rollout_env(self, env: VecEnv) -> UncertaintyVecWrapper:
        """What the experience is collected in; the baselines have others."""
        _arguments.ask_symmetries(env, self.symmetries)  # `set_env` may have brought a normalisation
        return UncertaintyVecWrapper(env, self.policy.encoder, self._uncertainty_config, self.seed)

    @property
    def _episodes(self) -> EpisodeReplayBuffer:
        assert self.rollout_buffer.episodes is not None
        return self.rollout_buffer.episodes

    @property
    def progress(self) -> float:
        """Progress coefficient l of App. C.3.1, in [0, 1]."""
        if self._progress_period is None:
            return 0.0
        return cosine_progress(self.num_timesteps, *self._progress_period)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        wrapper = self._rollout_env
        assert wrapper is not None and env is self.env
        if self.policy_restart and self._past_warmup is False and self.progress > 0.0:
            self.policy.restart(self.lr_schedule)
        self._past_warmup = self.progress > 0.0
        wrapper.progress = self.progress
        if self.mismatch_hold_time is None:
            wrapper.redraw_mismatch()
        remaining = self._current_progress_remaining
        if self._action_std_share is not None:
            assert self.action_std is not None
            self.policy.set_action_std(self._action_std_share(remaining) * np.asarray(self.action_std))
        if isinstance(self.policy.action_dist, CorrelatedGaussianDistribution):
            assert self.decision_period is not None and self._progress_period is not None
            fall = cosine_progress(self.num_timesteps, self._progress_period[0], self.action_noise_timesteps)
            correlation = smoothing_factor(self.action_noise_time * (1.0 - fall), self.decision_period)
            self.policy.action_dist.correlation = correlation
        # A rollout's batches are too small for several threads, which would take the cores from the environments' workers.
        with torch_threads(1), self.policy.without_critic():
            return self._collect_in_wrapper(callback, rollout_buffer, n_rollout_steps)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Episode statistics of the privileged policy, without the mismatched environments."""
        n_matched = len(infos) - self.n_mismatched
        super()._update_info_buffer(infos[:n_matched], None if dones is None else dones[:n_matched])

    def train(self) -> None:
        """PPO's update and the encoder's (Alg. 1, lines 12 and 13), side by side where torch has two threads or more."""
        wrapper, episodes = self._rollout_env, self._episodes
        assert wrapper is not None
        untrained = wrapper.progress == 0.0 and not self.policy_warmup
        # An episode that ended with the rollout's last decision is over, though no observation has been added since.
        episodes.close_ended(wrapper.step_count)
        episodes.telltale = wrapper.progress == 0.0 and not untrained
        encoder_learns = self.encoder_updates > 0 and (self.encoder_warmup or wrapper.progress > 0.0)
        # PPO clips the gradients of the whole policy; the encoder's must not be among them.
        with self.policy.without_encoder() as encoder:
            learners: list[Callable[[], None]] = [] if untrained else [super().train]
            if encoder_learns:
                learners.append(functools.partial(self._train_encoder, encoder))
            run_side_by_side(learners, self.device)
        self.policy.update_normalizers(self.rollout_buffer.observations[COMMON])
        for name, values in wrapper.metrics.items():
            self.logger.record(f"uspl/{name}", float(np.mean(values)))
        wrapper.metrics.clear()
        self.logger.record("uspl/progress", wrapper.progress)
        if encoder_learns:
            self.policy.encoder.eval()
            wrapper.rebuild_memory(*episodes.running_tokens(self.device))
        episodes.end_iteration()
        self.logger.record("encoder/replay_episodes", len(episodes.replay))
        self.logger.record("encoder/replay_fill", episodes.nbytes / max(1, episodes.max_bytes))

    def _train_encoder(self, encoder: ObservationEncoder) -> None:
        """Maximum likelihood on whole episodes, Eq. 1. Touches nothing that PPO's update does, which may run beside it."""
        optimizer, episodes = self.policy.encoder_optimizer, self._episodes
        learning_rate = self.encoder_lr_schedule(self._current_progress_remaining)
        update_learning_rate(optimizer, learning_rate)
        self.logger.record("encoder/learning_rate", learning_rate)
        encoder.train()
        limit = self.encoder_window_timesteps
        whole = self.progress > 0.0 if limit is None else self.num_timesteps >= limit
        n_updates, n_tokens = self._count_encoder_updates(episodes), self.encoder_batch_size
        batches = episodes.batches(n_updates, n_tokens, self.device, None if whole else self.encoder_window)
        clipping, bf16, compiled = self.encoder_max_grad_norm, self.encoder_bf16, self.encoder_compile
        for name, value in fit(encoder, optimizer, batches, self.encoder_beta, clipping, bf16, compiled).items():
            self.logger.record(f"encoder/{name}", value)

    def _count_encoder_updates(self, episodes: EpisodeReplayBuffer) -> int:
        """A model that was loaded knows more than the first few episodes of a new replay, which it would learn by heart."""
        if not self._replay_is_lost:
            return self.encoder_updates
        one_pass = episodes.n_decisions // self.encoder_batch_size
        self._replay_is_lost = one_pass < self.encoder_updates and not episodes.full
        return min(one_pass, self.encoder_updates)

    # -- saving ------------------------------------------------------------------------------------------------------------

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "policy.encoder_optimizer"], []
