"""Whole sequences for PPO: what a policy that acts on its history needs beside SB3's parts."""

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch import nn

from sb3_uspl._experience import ExperienceVecWrapper
from sb3_uspl.encoder import MemoryState, ObservationEncoder, Tokens, encode_actions, reset_rows
from sb3_uspl.observations import COMMON, PREVIOUS_ACTION, PRIVILEGED, check_finite, stored_space

EMBEDDING = "embedding"
"""Key of the memory's output, which the actor sees in the place of USPL's belief."""


class SequenceBatch(NamedTuple):
    """What a minibatch's decisions were based on: whole sequences, each from the start of its episode."""

    tokens: Tokens
    """Encoder inputs, sequence after sequence, ``(n_tokens, ...)`` by key."""
    lengths: th.Tensor
    """Lengths of the sequences, ``(n_sequences,)``."""
    sampled: th.Tensor
    """Which tokens are decisions of this rollout; the others are their past, ``(n_tokens,)``."""
    privileged: th.Tensor
    """What only the critic sees, ``(n_decisions, n_privileged)``."""


class HistoryEncoder(nn.Module):
    """
    The observation encoder without its belief: token features, memory, embedding.

    :param space: observation space of the environment (the contract)
    :param n_action: number of encoded action values; the previous action is an input
    :param preset: as for ``ObservationEncoder``
    :param memory: as for ``ObservationEncoder``
    :param overrides: as for ``ObservationEncoder``
    :raises ValueError: for an unknown preset, memory or override, or for dropout
    """

    def __init__(self, space: spaces.Dict, n_action: int, preset: str, memory: str, overrides: dict[str, Any] | None):
        super().__init__()
        parts = ObservationEncoder(space, n_action, preset, memory, overrides)
        self.features, self.memory, self.embedding = parts.features, parts.memory, parts.embedding
        self.width = int(parts.mean[0].in_features)  # type: ignore[arg-type]
        if any(isinstance(module, nn.Dropout) and module.p > 0.0 for module in self.modules()):
            raise ValueError(
                "RESeLPPO recomputes the log-probabilities of a rollout, which dropout would make noisy: remove 'dropout' "
                "from the memory_kwargs in encoder_kwargs."
            )

    def forward(self, tokens: Tokens, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        """
        :param tokens: encoder inputs of whole sequences, one after another, ``(n_tokens, ...)``
        :param lengths: lengths of the sequences, ``(n_sequences,)``; 0 is allowed
        :return: embeddings ``(n_tokens, width)`` and the memory after each sequence's last token
        """
        remembered, state = self.memory(self.features.in_parts(tokens), lengths)
        return self.embedding(remembered), state

    def step(self, tokens: Tokens, state: MemoryState) -> tuple[th.Tensor, MemoryState]:
        """
        :param tokens: encoder inputs, ``(n_envs, ...)``
        :param state: memory state; may be overwritten
        :return: embeddings ``(n_envs, width)`` and the next state
        """
        remembered, state = self.memory.step(self.features(tokens), state)
        return self.embedding(remembered), state


class HistoryVecWrapper(ExperienceVecWrapper):
    """
    Runs the memory beside the environments: adds the embedding of the history and the previous action to observations.

    :param venv: environments under the observation contract
    :param encoder: whose memory it is
    :raises ValueError: if images or the privileged observation are normalised
    """

    encoder: HistoryEncoder

    def begin(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Start with an empty history (see base class).

        :param obs: current observation of the wrapped environments, or one returned by this wrapper
        :return: observation for the policy
        """
        self.memory = self.encoder.memory.initial_state(self.num_envs)
        self.previous_action = np.zeros((self.num_envs, get_flattened_obs_dim(self.action_space)), dtype=np.float32)
        return self._observe({key: obs[key] for key in self.observation_space.spaces})  # type: ignore[attr-defined]

    @th.no_grad()
    def resume(self, tokens: Tokens, lengths: th.Tensor) -> dict[str, np.ndarray]:
        """
        Recompute every memory with the present weights, so that none mixes states of two policies.

        :param tokens: past of the running episodes without the current observation, ``(n_tokens, ...)``
        :param lengths: number of past tokens of each environment, ``(n_envs,)``
        :return: current observation for the policy
        """
        _, self.memory = self.encoder(tokens, lengths)
        return self._observe(self._obs)

    def step_async(self, actions: np.ndarray) -> None:
        self.previous_action = encode_actions(actions, self.action_space)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(obs, dict)
        if dones.any():
            reset_rows(self.memory, th.as_tensor(dones, device=self.device))
            self.previous_action[dones] = 0.0
        return self._observe(obs), rewards, dones, infos

    @th.no_grad()
    def _observe(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        check_finite(obs)
        self._obs = obs
        seen = {**{key: value for key, value in obs.items() if key != PRIVILEGED}, PREVIOUS_ACTION: self.previous_action}
        tokens = {key: th.as_tensor(value, device=self.device) for key, value in seen.items()}
        embedding, self.memory = self.encoder.step(tokens, self.memory)
        return {**obs, PREVIOUS_ACTION: self.previous_action, EMBEDDING: embedding.cpu().numpy()}


class SequenceRolloutBuffer(DictRolloutBuffer):
    """
    PPO's rollout buffer for a policy with a memory: a minibatch is whole environments, with the past of their episodes.

    :param buffer_size: decisions per environment and rollout
    :param observation_space: the environment's observation space (the contract)
    :param action_space: action space
    :param context_length: longest episode, in decisions
    :param kwargs: as for ``DictRolloutBuffer``
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        context_length: int = 1024,
        **kwargs: Any,
    ):
        previous_action = spaces.Box(-np.inf, np.inf, (get_flattened_obs_dim(action_space),), np.float32)
        stored = {key: stored_space(part) for key, part in observation_space.items()}
        super().__init__(buffer_size, spaces.Dict({**stored, PREVIOUS_ACTION: previous_action}), action_space, **kwargs)
        self.context_length = context_length
        self.forget_running()

    def forget_running(self) -> None:
        """Drop the rollout and the past of the running episodes, because the environments were reset."""
        self.reset()
        self.past: list[dict[str, np.ndarray]] = [
            {key: array[:0, env] for key, array in self.observations.items() if key != PRIVILEGED}
            for env in range(self.n_envs)
        ]

    def keep_running(self, dones: np.ndarray) -> None:
        """
        Keep the tokens of those episodes that go on beyond this rollout.

        :param dones: which environments' episodes ended with the last decision, ``(n_envs,)``
        """
        if not self.full:
            return
        self._join_sequences()
        ends = np.flatnonzero(np.diff(self._env, append=self.n_envs)) + 1
        lengths = np.bincount(self._sequence)[self._sequence[ends - 1]]
        for env, (end, length) in enumerate(zip(ends, np.where(dones, 0, lengths), strict=True)):
            self.past[env] = {key: array[end - length : end].copy() for key, array in self._tokens.items()}

    def rollout_tokens(self) -> Tokens:
        """:return: tokens of the rollout's decisions alone, ``(n_decisions, ...)`` by key"""
        self._join_sequences()
        return {key: self.to_torch(array[self._sampled]) for key, array in self._tokens.items()}

    def running_tokens(self) -> tuple[Tokens, th.Tensor]:
        """:return: past of the running episodes, one after another, and their lengths ``(n_envs,)``"""
        tokens = {key: self.to_torch(np.concatenate([past[key] for past in self.past])) for key in self.past[0]}
        return tokens, self.to_torch(np.array([len(past[COMMON]) for past in self.past]))

    def get(self, batch_size: int | None = None) -> Generator[DictRolloutBufferSamples, None, None]:  # type: ignore[override]
        assert self.full
        self._join_sequences()
        n_rows = self.n_envs if batch_size is None else batch_size // self.buffer_size
        order = np.random.permutation(self.n_envs)
        for first in range(0, self.n_envs, n_rows):
            yield self._rows(np.sort(order[first : first + n_rows]))

    def _join_sequences(self) -> None:
        """Lay out past and rollout of all environments one after another and find the sequences among them."""
        if self.generator_ready:
            return
        envs = range(self.n_envs)
        self._tokens = {
            key: np.concatenate([part for env in envs for part in (self.past[env][key], self.observations[key][:, env])])
            for key in self.past[0]
        }
        n_past = np.array([len(past[COMMON]) for past in self.past])
        n_tokens = n_past + self.buffer_size
        self._env = np.repeat(np.arange(self.n_envs), n_tokens)
        position = np.arange(n_tokens.sum()) - np.repeat(np.cumsum(n_tokens) - n_tokens, n_tokens)
        self._sampled = position >= n_past[self._env]
        starts = position == 0
        starts[self._sampled] |= self.episode_starts.T.ravel() > 0
        self._sequence = np.cumsum(starts) - 1
        longest = np.bincount(self._sequence).max()
        if longest > self.context_length:
            raise ValueError(
                f"An episode is {longest} decisions long, beyond the context of {self.context_length}. Raise "
                "`context_length`, or limit the environment with gymnasium.wrappers.TimeLimit."
            )
        self.generator_ready = True

    def _rows(self, envs: np.ndarray) -> DictRolloutBufferSamples:
        """:return: all decisions of some environments, in the order of the environments and of time"""
        chosen = np.isin(self._env, envs)
        batch = SequenceBatch(
            {key: self.to_torch(array[chosen]) for key, array in self._tokens.items()},
            self.to_torch(np.unique(self._sequence[chosen], return_counts=True)[1]),
            self.to_torch(self._sampled[chosen]),
            self._decisions(self.observations[PRIVILEGED], envs),
        )
        numbers = (self.values, self.log_probs, self.advantages, self.returns)
        actions = self._decisions(self.actions, envs).float()
        return DictRolloutBufferSamples(batch, actions, *(self._decisions(array, envs) for array in numbers))  # type: ignore[arg-type]

    def _decisions(self, array: np.ndarray, envs: np.ndarray) -> th.Tensor:
        return self.to_torch(array[:, envs].swapaxes(0, 1).reshape(-1, *array.shape[2:]))
