"""Where experience lives: PPO's rollout buffer, and the episodes that the observation encoder learns from."""

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples

from sb3_uspl.encoder import Tokens
from sb3_uspl.observations import (
    COMMON,
    EPISODE_STEP,
    PREVIOUS_ACTION,
    PRIVILEGED,
    TARGET,
    TRUTH,
    policy_observation_space,
    stored_space,
)
from sb3_uspl.symmetries import SymmetryGroup


def _shape(space: spaces.Space) -> tuple[int, ...]:
    assert space.shape is not None
    return space.shape


@dataclass
class Episode:
    """
    One finished episode, as the encoder needs it.

    :param arrays: encoder inputs and truth by key, each ``(length, ...)``
    :param mismatched: whether the policy acted on another environment's privileged observation
    """

    arrays: dict[str, np.ndarray]
    mismatched: bool

    def __len__(self) -> int:
        return len(self.arrays[TRUTH])

    def __getitem__(self, decisions: np.ndarray) -> "Episode":
        return Episode({key: array[decisions] for key, array in self.arrays.items()}, self.mismatched)

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values())


def _ranges(firsts: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Whole numbers from each first one on, as many as its size, one after another."""
    return np.repeat(firsts - (np.cumsum(sizes) - sizes), sizes) + np.arange(sizes.sum())


class EpisodeBatch(NamedTuple):
    """Whole episodes, one after another."""

    tokens: Tokens
    """Encoder inputs, ``(n_tokens, ...)``."""
    truth: th.Tensor
    """Privileged observations, ``(n_tokens, n_privileged)``."""
    lengths: th.Tensor
    """Lengths of the episodes, ``(n_episodes,)``."""


class EpisodeReplayBuffer:
    """
    Whole episodes for the encoder: those running, those that ended in this iteration, and a replay of older ones.

    The replay keeps images in their own dtype and numbers as float32, once, within a budget of bytes; the oldest episodes go
    first.

    :param observation_space: the environment's observation space (the contract)
    :param n_action: number of encoded action values
    :param n_envs: number of environments
    :param n_mismatched: the last ``n_mismatched`` environments are mismatched
    :param context_length: longest episode, in decisions
    :param max_bytes: budget of the replay
    :param keep: "mismatched" replays mismatched episodes only, as the authors' release does (all, if none is mismatched):
        in them the behaviour says nothing about the truth. "all" replays every episode, as the paper's Alg. 1 says.
        As long as ``telltale`` is set, "mismatched" leaves the matched episodes of this iteration out as well.
    :param seed: of the sampling
    """

    STAGED_BATCHES = 16
    """Encoder updates whose episodes are on the device at the same time."""

    def __init__(
        self,
        observation_space: spaces.Dict,
        n_action: int,
        n_envs: int,
        n_mismatched: int,
        context_length: int,
        max_bytes: int,
        keep: str = "mismatched",
        seed: int | None = None,
    ):
        if keep not in ("mismatched", "all"):
            raise ValueError(f"replay='{keep}': replay either 'mismatched' or 'all' episodes.")
        self.n_envs, self.n_mismatched = n_envs, n_mismatched
        self.context_length, self.max_bytes, self.keep = context_length, max_bytes, keep
        self.rng = np.random.default_rng(seed)
        self.symmetries: SymmetryGroup | None = None
        """Every episode that is drawn is turned by one of them at random."""
        self._spec: dict[str, tuple[tuple[int, ...], Any]] = {
            COMMON: (_shape(observation_space[COMMON]), np.float32),
            PREVIOUS_ACTION: ((n_action,), np.float32),
            TRUTH: (_shape(observation_space[PRIVILEGED]), np.float32),
        }
        if TARGET in observation_space.spaces:
            target = stored_space(observation_space[TARGET])
            self._spec[TARGET] = (target.shape, target.dtype)
        self.telltale = False
        """Whether matched policies act on the plain truth now, so that their behaviour gives it away."""
        self.replay: deque[Episode] = deque()
        self.fresh: list[Episode] = []
        self.nbytes = 0
        self.full = False
        """Whether older episodes have had to make room for newer ones."""
        self.forget_running()

    def forget_running(self) -> None:
        """Drop the episodes that have not ended, because the environments were reset."""
        self._capacity = min(64, self.context_length)
        self.running = {
            key: np.zeros((self.n_envs, self._capacity, *shape), dtype) for key, (shape, dtype) in self._spec.items()
        }
        self.lengths = np.zeros(self.n_envs, dtype=np.int64)
        self._rows = np.arange(self.n_envs)

    def add(self, obs: dict[str, np.ndarray]) -> None:
        """
        Append one decision to every running episode; an environment at step 0 first closes the episode before.

        :param obs: what :class:`~sb3_uspl.wrappers.UncertaintyVecWrapper` returns, ``(n_envs, ...)`` by key
        """
        step = obs[EPISODE_STEP]
        self.close_ended(step)
        self._grow(int(step.max()) + 1)
        for key, array in self.running.items():
            array[self._rows, step] = obs[key]
        self.lengths += 1

    def close_ended(self, step: np.ndarray) -> None:
        """
        An environment at step 0 has ended the episode before.

        :param step: of the current observation in its episode, ``(n_envs,)``
        """
        for env in np.flatnonzero((step == 0) & (self.lengths > 0)):
            arrays = {key: array[env, : self.lengths[env]].copy() for key, array in self.running.items()}
            self.fresh.append(Episode(arrays, mismatched=bool(env >= self.n_envs - self.n_mismatched)))
        self.lengths[step == 0] = 0

    def end_iteration(self) -> None:
        """Move this iteration's episodes to the replay and drop the oldest ones beyond the budget."""
        for episode in self.fresh:
            if self.keep == "all" or episode.mismatched or self.n_mismatched == 0:
                self.replay.append(episode)
                self.nbytes += episode.nbytes
        self.fresh = []
        self.full = self.full or self.nbytes > self.max_bytes
        while self.nbytes > self.max_bytes:
            self.nbytes -= self.replay.popleft().nbytes

    @property
    def n_decisions(self) -> int:
        """Decisions of the episodes that :meth:`batches` can draw."""
        return sum(map(len, (*self._eligible_fresh(), *self.replay)))

    def batches(
        self,
        n_batches: int,
        n_tokens: int,
        device: th.device | str = "cpu",
        window: int | None = None,
    ) -> Generator[EpisodeBatch, None, None]:
        """
        Draw whole episodes or windows of them, half of the tokens from this iteration, half replayed (Sec. 3.2); all from one
        if the other is empty. Nothing comes before the first episode has ended. Without a window, episodes with images are
        drawn whole, too: what they show has to be remembered until the end, so ``n_tokens`` bounds what the CNN has to see.

        Tokens go to the device once for every ``STAGED_BATCHES`` batches, which are then put together there.

        :param n_batches: number of batches
        :param n_tokens: about how many decisions in each
        :param device: of the tensors
        :param window: decisions in a row that are drawn of an episode, from anywhere in it; None: all. Episodes are as likely
            as each other whatever their length.
        """
        fresh = self._eligible_fresh()
        episodes = [*fresh, *self.replay]
        lengths = np.array([len(episode) for episode in episodes], dtype=np.int64)
        starts = np.cumsum(lengths) - lengths  # of the episodes, if the decisions of all of them lay one after another
        ranges = ((0, len(fresh)), (len(fresh), len(episodes)))
        sources = [np.arange(low, high) for low, high in ranges if low < high]
        if not sources:
            return
        for first in range(0, n_batches, self.STAGED_BATCHES):
            count = min(self.STAGED_BATCHES, n_batches - first)
            pieces = [self._choose(sources, starts, lengths, n_tokens, window) for _ in range(count)]
            decisions = np.concatenate([_ranges(*piece) for piece in pieces])
            unique, places = np.unique(decisions, return_inverse=True)
            staged = self._gather(episodes, starts, unique, device)
            sizes = th.as_tensor(np.concatenate([size for _, size in pieces]), device=device)
            all_places = th.as_tensor(places, device=device).split([int(size.sum()) for _, size in pieces])
            for place, size in zip(all_places, sizes.split([len(size) for _, size in pieces]), strict=True):
                tokens = {key: value.index_select(0, place) for key, value in staged.tokens.items()}  # whole images at once
                truth = staged.truth.index_select(0, place)
                if self.symmetries is not None:
                    which = self.symmetries.random(size, self.rng)
                    turned = self.symmetries.turn({COMMON: tokens[COMMON], TRUTH: truth}, which)
                    tokens[COMMON], truth = turned[COMMON], turned[TRUTH]
                yield EpisodeBatch(tokens, truth, size)

    def _eligible_fresh(self) -> list[Episode]:
        only_mismatched = self.telltale and self.keep == "mismatched" and self.n_mismatched > 0
        return [episode for episode in self.fresh if episode.mismatched or not only_mismatched]

    def _choose(
        self, sources: list[np.ndarray], starts: np.ndarray, lengths: np.ndarray, n_tokens: int, window: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """First decisions and lengths of a batch's pieces, an equal share of the tokens from each source."""
        firsts, sizes = [], []
        for rows in sources:
            share = n_tokens / len(sources)
            drawn = self.rng.choice(rows, math.ceil(share))  # enough if every episode had a single decision
            size = lengths[drawn] if window is None else np.minimum(lengths[drawn], window)
            enough = int(np.searchsorted(np.cumsum(size), share)) + 1
            drawn, size = drawn[:enough], size[:enough]
            firsts.append(starts[drawn] + self.rng.integers(lengths[drawn] - size + 1))
            sizes.append(size)
        return np.concatenate(firsts), np.concatenate(sizes)

    def _gather(
        self, episodes: Sequence[Episode], starts: np.ndarray, decisions: np.ndarray, device: th.device | str
    ) -> EpisodeBatch:
        """Single decisions, in rising order, of episodes that begin at ``starts``; those of an episode are a part of it."""
        owners, firsts, counts = np.unique(
            np.searchsorted(starts, decisions, side="right") - 1, return_index=True, return_counts=True
        )
        parts = [
            episodes[owner][decisions[first : first + count] - starts[owner]]
            for owner, first, count in zip(owners.tolist(), firsts.tolist(), counts.tolist(), strict=True)
        ]
        return self.collate(parts, device)

    def running_tokens(self, device: th.device | str = "cpu") -> tuple[Tokens, th.Tensor]:
        """
        The past of the running episodes, without the current observation.

        :param device: of the tensors
        :return: tokens, one episode after another, ``(n_tokens, ...)``, and lengths ``(n_envs,)``
        """
        mask = np.arange(self._capacity) < self.lengths[:, None]
        tokens = {key: th.as_tensor(array[mask], device=device) for key, array in self.running.items() if key != TRUTH}
        return tokens, th.as_tensor(self.lengths, device=device)

    def collate(self, episodes: Sequence[Episode], device: th.device | str = "cpu") -> EpisodeBatch:
        """
        :param episodes: episodes of any length
        :param device: of the tensors
        :return: all of them, one after another
        """
        lengths = th.as_tensor([len(episode) for episode in episodes], device=device)
        tokens = {
            key: th.as_tensor(np.concatenate([episode.arrays[key] for episode in episodes]), device=device)
            for key in self._spec
        }
        return EpisodeBatch(tokens, tokens.pop(TRUTH), lengths)

    def _grow(self, capacity: int) -> None:
        if capacity > self.context_length:
            raise ValueError(
                f"An episode is longer than the encoder's context of {self.context_length} decisions. "
                "Raise `context_length`, or limit the environment with gymnasium.wrappers.TimeLimit."
            )
        if capacity > self._capacity:
            extra = min(max(capacity, 2 * self._capacity), self.context_length) - self._capacity
            for key, array in self.running.items():
                padding = [(0, 0)] * array.ndim
                padding[1] = (0, extra)
                self.running[key] = np.pad(array, padding)
            self._capacity += extra


class USPLRolloutBuffer(DictRolloutBuffer):
    """
    PPO's rollout buffer for what actor and critic saw, which also feeds the encoder's :class:`EpisodeReplayBuffer`.

    The last ``n_mismatched`` environments acted on wrong privileged observations: they feed the encoder, never PPO's loss.

    :param buffer_size: decisions per environment and rollout
    :param observation_space: the environment's observation space (the contract)
    :param action_space: action space
    :param n_mismatched: number of mismatched environments
    :param kwargs: as for ``DictRolloutBuffer``
    """

    VALUED_AT_ONCE = 8192
    """Observations that the critic is shown together."""

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        n_mismatched: int = 0,
        **kwargs: Any,
    ):
        self.n_mismatched = n_mismatched
        self.n_collecting = kwargs.get("n_envs", 1)
        self.episodes: EpisodeReplayBuffer | None = None
        self.critic: Callable[[dict[str, th.Tensor]], th.Tensor] | None = None
        """Values the observations when the rollout is over, many at once, in place of the values that came with them."""
        super().__init__(buffer_size, policy_observation_space(observation_space), action_space, **kwargs)

    def reset(self) -> None:
        self.n_envs = self.n_collecting
        super().reset()

    def add(self, obs: dict[str, np.ndarray], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """
        :param obs: what :class:`~sb3_uspl.wrappers.UncertaintyVecWrapper` returned
        :param args: as for ``DictRolloutBuffer.add``
        :param kwargs: as for ``DictRolloutBuffer.add``
        """
        super().add(obs, *args, **kwargs)
        if self.episodes is not None:
            self.episodes.add(obs)

    @th.no_grad()
    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """
        :param last_values: of the observations after the rollout, ``(n_envs, 1)``
        :param dones: whether they begin an episode, ``(n_envs,)``
        """
        if self.critic is not None:
            n_matched = self.n_envs - self.n_mismatched
            n_steps = max(1, self.VALUED_AT_ONCE // n_matched)
            for first in range(0, self.buffer_size, n_steps):
                part = slice(first, first + n_steps), slice(n_matched)
                obs = {key: self.to_torch(array[part]).flatten(0, 1) for key, array in self.observations.items()}
                self.values[part] = self.critic(obs).cpu().numpy().reshape(-1, n_matched)
        super().compute_returns_and_advantage(last_values, dones)

    def get(self, batch_size: int | None = None) -> Generator[DictRolloutBufferSamples, None, None]:  # type: ignore[override]
        if not self.generator_ready and self.n_mismatched > 0:
            self.n_envs = self.n_collecting - self.n_mismatched
            self.observations = {key: array[:, : self.n_envs] for key, array in self.observations.items()}
            for name in ("actions", "values", "log_probs", "advantages", "returns"):
                setattr(self, name, getattr(self, name)[:, : self.n_envs])
        yield from super().get(batch_size)
