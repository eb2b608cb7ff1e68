"""What turns an environment's experience into USPL's: encoder, blurring and reward transformation around any VecEnv."""

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_uspl._experience import ExperienceVecWrapper
from sb3_uspl.encoder import ObservationEncoder, encode_actions, reset_rows, take_rows
from sb3_uspl.observations import (
    BELIEF,
    COMMON,
    EPISODE_STEP,
    POLICY_KEYS,
    PREVIOUS_ACTION,
    PRIVILEGED,
    TARGET,
    TRUTH,
    UNCERTAINTY,
    check_finite,
)
from sb3_uspl.uncertainty import (
    C_MAX,
    C_MIN,
    DELTA,
    INITIAL_STD,
    blur_continuous,
    blur_discrete,
    reward_coefficient,
    smooth,
)

_OUTSIDE = 1e-3
"""How far a privileged value may be beyond its bounds, relative to their distance: as far as rounding can bring it."""


@dataclass
class UncertaintyConfig:
    """How uncertainty shapes what PPO sees; times already in decisions. See ``USPLPPO`` for the meaning of each entry."""

    blur: bool = True
    reward_scaling: bool = True
    blur_gain: float = 10.0
    noise: str = "uniform"
    noise_hold: int = 1
    smoothing: float = 0.0
    c_min: float = C_MIN
    c_max: float = C_MAX
    delta: float = DELTA
    discrete_privileged: dict[int, list[float]] = field(default_factory=dict)
    n_mismatched: int = 0
    mismatch_hold: tuple[float, float] | None = None
    wander_share: float = 0.0
    wander_hold: tuple[float, float] = (1.0, 1.0)
    wander_actions: dict[int, float] | None = None


class BlurNoise:
    """
    Noise of Eq. 3 and 4, held for a number of decisions so that it cannot be averaged away within a turn.

    :param n_envs: number of environments
    :param n_privileged: privileged dimensions
    :param config: noise distribution, holding time, discrete values
    :param rng: random generator
    """

    def __init__(self, n_envs: int, n_privileged: int, config: UncertaintyConfig, rng: np.random.Generator):
        self.config, self.rng = config, rng
        self.continuous = np.zeros((n_envs, n_privileged))
        self.threshold = np.ones((n_envs, n_privileged))
        self.replacement = np.zeros((n_envs, n_privileged))
        # Eq. 4 compares the uncertainty with 1, the distance between two indices.
        self.gap = np.ones(n_privileged)
        for dim, values in config.discrete_privileged.items():
            self.gap[dim] = np.diff(np.unique(values)).min()

    def redraw(self, rows: np.ndarray) -> None:
        """
        :param rows: environments whose noise is due
        """
        shape = (len(rows), self.continuous.shape[1])
        if len(rows) == 0:
            return
        draw = self.rng.uniform(-1.0, 1.0, shape) if self.config.noise == "uniform" else self.rng.standard_normal(shape)
        self.continuous[rows] = draw
        self.threshold[rows] = self.rng.uniform(size=shape)
        for dim, values in self.config.discrete_privileged.items():
            self.replacement[rows, dim] = self.rng.choice(np.asarray(values), size=len(rows))


class Wandering:
    """
    Stretches of time in which environments repeat an action of their own instead of the policy's.

    What only a long detour shows is never seen by an encoder that learns from a policy which goes straight to its goal.
    Repeated actions reach what independent noise does not (temporally extended epsilon-greedy, Dabney et al. 2021). Lengths
    are log-uniform; a continuous action is drawn around the middle of its range, often close to it: each dimension's spread is
    drawn anew.

    :param action_space: Box, Discrete, MultiDiscrete or MultiBinary
    :param share: of time that each environment spends wandering, ``(n_envs,)``
    :param hold: least and greatest length of a stretch in decisions
    :param rng: random generator
    :param chosen: components of a continuous action that wander, and what each is drawn around; None: all, around the middle
    """

    def __init__(
        self,
        action_space: spaces.Space,
        share: np.ndarray,
        hold: tuple[float, float],
        rng: np.random.Generator,
        chosen: dict[int, float] | None = None,
    ):
        self.action_space, self.share, self.rng = action_space, share, rng
        self.taken = np.ones(action_space.shape or (), dtype=bool)
        if isinstance(action_space, spaces.Box):
            self.middle = 0.5 * (action_space.low + action_space.high)
        if chosen is not None:
            self.taken[:] = False
            for component, middle in chosen.items():
                self.taken[component], self.middle[component] = True, middle
        self.log_hold = math.log(hold[0]), math.log(hold[1])
        self.left = np.zeros(len(share), dtype=np.int64)
        self.active = np.zeros(len(share), dtype=bool)
        """Which environments will not take the policy's next action."""
        self.actions = np.stack([action_space.sample() for _ in share])

    def advance(self) -> None:
        """Draw who wanders at the next decision."""
        self.left -= 1
        due = np.flatnonzero(self.left <= 0)
        self.left[due] = np.ceil(np.exp(self.rng.uniform(self.log_hold[0], self.log_hold[1], len(due)))).astype(np.int64)
        self.active[due] = self.rng.uniform(size=len(due)) < self.share[due]
        for row in due[self.active[due]]:
            self.actions[row] = self._draw()

    def replace(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: the policy's, ``(n_envs, ...)``
        :return: those that are taken
        """
        active = self.active.reshape(-1, *[1] * (actions.ndim - 1))
        return np.where(active & self.taken, self.actions, actions).astype(actions.dtype)

    def _draw(self) -> Any:
        space = self.action_space
        if not isinstance(space, spaces.Box):
            return space.sample()
        half = 0.5 * (space.high - space.low)
        spread = self.rng.uniform(size=space.shape) ** 3
        return np.clip(self.middle + half * spread * self.rng.standard_normal(space.shape), space.low, space.high)


class UncertaintyVecWrapper(ExperienceVecWrapper):
    """
    Runs the encoder beside the environments (Alg. 1, lines 5-10).

    Returned observations hold what the actor sees (``common``, blurred ``privileged``, ``uncertainty``, ``belief``), what only
    the critic sees (``truth``) and what the encoder learns from (``target``, ``previous_action``, ``episode_step``). Rewards
    are scaled with the uncertainty that the action was chosen under.

    ``terminal_observation`` of an episode that was cut short is encoded with the memory from before the reset. Where one
    really ended, nobody asks what its last observation was worth, and it stays the environment's.

    The last ``n_mismatched`` environments are shown each other's privileged observations; with ``mismatch_hold``, each draws
    another one after a random time, whose mean is spread log-uniformly over that range, so that the encoder sees the behaviour
    of the undecided and of those who change their mind before the policy has learned either.

    :param venv: environments under the observation contract
    :param encoder: observation encoder
    :param config: blurring, reward transformation, smoothing
    :param seed: of the blur noise and the mismatching
    :raises ValueError: if images or the privileged observation are normalised; in a step, for observations that are not finite
        or a privileged observation outside of its bounds
    """

    encoder: ObservationEncoder

    def __init__(self, venv: VecEnv, encoder: ObservationEncoder, config: UncertaintyConfig, seed: int | None = None):
        super().__init__(venv, encoder)
        self.config = config
        self.progress = 0.0
        self.rng = np.random.default_rng(seed)
        space = venv.observation_space[PRIVILEGED]  # type: ignore[index]
        self.low, self.high = space.low, space.high
        width = space.high - space.low
        tolerance = np.where(np.isfinite(width), _OUTSIDE * width, 0.0)
        self._lowest, self._highest = space.low - tolerance, space.high + tolerance
        self.noise = BlurNoise(self.num_envs, space.shape[0], config, self.rng)
        self.metrics: dict[str, list[np.ndarray]] = defaultdict(list)
        """What happened in matched environments since the last update, one array a decision."""
        self._shape = (self.num_envs, space.shape[0])
        self._n_matched = self.num_envs - config.n_mismatched
        if config.mismatch_hold is not None:
            self._redraw_rate = 1.0 / np.geomspace(*config.mismatch_hold, config.n_mismatched)
        self._wandering = None
        if config.wander_share > 0.0:
            share = np.where(np.arange(self.num_envs) < self._n_matched, 0.0, config.wander_share)
            self._wandering = Wandering(venv.action_space, share, config.wander_hold, self.rng, config.wander_actions)

    def begin(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Start with an empty history (see base class).

        :param obs: current observation of the wrapped environments, or one returned by this wrapper
        :return: observation for the policy
        """
        if TRUTH in obs:
            obs = {PRIVILEGED: obs[TRUTH], **{key: obs[key] for key in (COMMON, TARGET) if key in obs}}
        self.memory = self.encoder.memory.initial_state(self.num_envs)
        self.std = np.full(self._shape, INITIAL_STD, dtype=np.float32)
        self.previous_action = np.zeros((self.num_envs, get_flattened_obs_dim(self.action_space)), dtype=np.float32)
        self.step_count = np.zeros(self.num_envs, dtype=np.int64)
        self.redraw_mismatch()
        return self._observe(obs)

    def redraw_mismatch(self) -> None:
        """Draw anew which mismatched environment sees whose privileged observation; never its own."""
        order = self.rng.permutation(np.arange(self._n_matched, self.num_envs))
        self._source = np.arange(self.num_envs)
        self._source[order] = np.roll(order, 1)

    def _change_minds(self) -> None:
        """Show some mismatched environments another one's privileged observation from now on; never their own."""
        n = self.config.n_mismatched
        due = np.flatnonzero(self.rng.uniform(size=n) < self._redraw_rate)
        first = self._n_matched
        self._source[first + due] = first + (due + self.rng.integers(1, n, len(due))) % n

    def step_async(self, actions: np.ndarray) -> None:
        if self._wandering is not None:
            actions = self._wandering.replace(actions)
        self.previous_action = encode_actions(actions, self.action_space)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(obs, dict)
        if self.config.reward_scaling:
            config = self.config
            scale = reward_coefficient(self.std, self.progress, config.c_min, config.c_max, config.delta)
            rewards = (rewards * scale).astype(np.float32)
            self.metrics["reward_scale"].append(scale[: self._n_matched])
        self.step_count += 1
        rows = np.flatnonzero(dones)
        if len(rows):
            self._rewrite_terminal(rows[[infos[row].get("TimeLimit.truncated", False) for row in rows]], infos)
            reset_rows(self.memory, th.as_tensor(rows, device=self.device))
            # A new array: the last observation, which PPO has yet to store, holds the old one.
            self.std = np.where(dones[:, None], np.float32(INITIAL_STD), self.std)
            self.previous_action[rows] = 0.0
            self.step_count[rows] = 0
        return self._observe(obs), rewards, dones, infos

    @th.no_grad()
    def rebuild_memory(self, tokens: dict[str, th.Tensor], lengths: th.Tensor) -> None:
        """
        Recompute every memory with the updated encoder in one pass, so that none mixes two encoders' states.

        :param tokens: past of the running episodes without the current observation, one after another, ``(n_tokens, ...)``
        :param lengths: number of past tokens, ``(n_envs,)``
        """
        _, self.memory = self.encoder(tokens, lengths)
        _, self.memory = self.encoder.step(self._tokens, self.memory, int(self.step_count.max()))

    def _observe(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Encode the current observation of all environments and build what the policy sees."""
        check_finite(obs)
        if self.config.blur:
            self._check_bounds(obs[PRIVILEGED])
        self._tokens = self._as_tokens(obs, self.previous_action)
        with th.no_grad():
            belief, self.memory = self.encoder.step(self._tokens, self.memory, int(self.step_count.max()))
        mean = belief.mean.cpu().numpy()
        self.std = smooth(self.std, belief.std.cpu().numpy(), self.config.smoothing)
        self.noise.redraw(np.flatnonzero(self.step_count % self.config.noise_hold == 0))
        if self.config.mismatch_hold is not None and self.config.n_mismatched:
            self._change_minds()
        shown = self._blur(obs[PRIVILEGED][self._source], self.std, np.arange(self.num_envs))
        out = self._assemble(obs, shown, mean, self.std)
        out |= {PREVIOUS_ACTION: self.previous_action, EPISODE_STEP: self.step_count.copy()}
        if TARGET in obs:
            out[TARGET] = obs[TARGET]
        if self._wandering is not None:
            self._wandering.advance()
        n, truth = self._n_matched, obs[PRIVILEGED]
        self.metrics["uncertainty"].append(self.std[:n])
        self.metrics["prediction_error"].append(np.abs(mean[:n] - truth[:n]))
        self.metrics["blur"].append(np.abs(shown[:n] - truth[:n]))
        return out

    def _check_bounds(self, privileged: np.ndarray) -> None:
        """Blurring clips to the bounds: beyond them, the policy would be shown another value than the encoder is taught."""
        outside = (privileged < self._lowest) | (privileged > self._highest)
        if outside.any():
            env, dim = (int(index) for index in np.argwhere(outside)[0])
            raise ValueError(
                f"Privileged value {dim} of environment {env} is {privileged[env, dim]}, outside of its bounds "
                f"{self.low[dim]} and {self.high[dim]} in the observation space, to which blurring clips: widen them."
            )

    def _rewrite_terminal(self, rows: np.ndarray, infos: list[dict]) -> None:
        """Encode the last observations of episodes that were cut short with the history that they belong to."""
        if len(rows) == 0:
            return
        last = {key: np.stack([infos[i]["terminal_observation"][key] for i in rows]) for key in self.observation_space.spaces}  # type: ignore[attr-defined]
        check_finite(last)
        with th.no_grad():
            memory = take_rows(self.memory, th.as_tensor(rows, device=self.device))
            tokens = self._as_tokens(last, self.previous_action[rows])
            belief, _ = self.encoder.step(tokens, memory, int(self.step_count[rows].max()))
        std = smooth(self.std[rows], belief.std.cpu().numpy(), self.config.smoothing)
        shown = self._blur(last[PRIVILEGED], std, rows)
        terminal = self._assemble(last, shown, belief.mean.cpu().numpy(), std)
        for index, row in enumerate(rows):
            infos[row]["terminal_observation"] = {key: terminal[key][index] for key in POLICY_KEYS}

    def _blur(self, privileged: np.ndarray, std: np.ndarray, rows: np.ndarray) -> np.ndarray:
        if not self.config.blur:
            return privileged
        noise, config = self.noise, self.config
        shown = blur_continuous(
            privileged, std, noise.continuous[rows], config.blur_gain, self.progress, self.low, self.high
        ).astype(np.float32)
        if config.discrete_privileged:
            dims = list(config.discrete_privileged)
            replaced = blur_discrete(
                privileged, std / noise.gap, noise.threshold[rows], noise.replacement[rows], self.progress
            )
            shown[:, dims] = replaced[:, dims]
        return shown

    @staticmethod
    def _assemble(obs: dict[str, np.ndarray], shown: np.ndarray, mean: np.ndarray, std: np.ndarray) -> dict[str, np.ndarray]:
        return {COMMON: obs[COMMON], PRIVILEGED: shown, TRUTH: obs[PRIVILEGED], UNCERTAINTY: std, BELIEF: mean}

    def _as_tokens(self, obs: dict[str, np.ndarray], previous_action: np.ndarray) -> dict[str, th.Tensor]:
        tokens = {key: th.as_tensor(obs[key], device=self.device) for key in (COMMON, TARGET) if key in obs}
        return {**tokens, PREVIOUS_ACTION: th.as_tensor(previous_action, device=self.device)}
