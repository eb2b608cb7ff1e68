"""The encoder: time per token while a rollout is collected, and tokens per second in its update, against an LSTM's."""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from torch import nn
from torch.nn.utils.rnn import pad_sequence

from benchmarks.harness import TARGETS, Row, Tables, interleave, ratio, rows, target
from sb3_uspl._threads import torch_threads
from sb3_uspl.encoder import MEMORIES, Belief, ObservationEncoder, Tokens, gaussian_nll, take_rows
from sb3_uspl.observations import COMMON, PREVIOUS_ACTION, PRIVILEGED

N_COMMON, N_ACTION, N_PRIVILEGED = 4, 1, 1
"""Sizes of LateralChoice-v0."""
SPACE = spaces.Dict(
    {
        COMMON: spaces.Box(-1.0, 1.0, (N_COMMON,), np.float32),
        PRIVILEGED: spaces.Box(-0.25, 0.25, (N_PRIVILEGED,), np.float32),
    }
)
POSITIONS = (1, 10, 100, 500, 1000)
EARLY, LATE, POSITION_TARGET = 10, 500, 2.0
"""A token at the late position may take this many times as long as at the early one."""
STEPPED, AT_ONCE = "LSTM in a loop (sb3-contrib)", "LSTM in one call"

QUICK: dict[str, Any] = dict(
    repetitions=1, env_counts=(8,), positions=(1, 10, 500), n_steps=3, lengths=(20,), n_tokens=200, width=16
)


def make_encoder(memory: str, width: int) -> ObservationEncoder:
    """
    An encoder of one width throughout, as the zoo's entries have it.

    :param memory: one of ``MEMORIES``
    :param width: features of every layer
    """
    sizes = dict(hidden=(width,), trunk=(width,), embedding=(width,))
    return ObservationEncoder(SPACE, N_ACTION, memory=memory, overrides=sizes)


class LSTMEncoder(nn.Module):
    """
    The same encoder with an LSTM as RecurrentPPO runs it: by sb3-contrib's own function.

    :param width: features of every layer
    :param stepped: with the episodes' starts marked, as in its minibatches, which makes it loop over time
    """

    def __init__(self, width: int, stepped: bool = True) -> None:
        super().__init__()
        around = make_encoder("gru", width)
        self.features, self.embedding, self.mean, self.log_std = around.features, around.embedding, around.mean, around.log_std
        self.lstm = nn.LSTM(width, width)
        self.stepped = stepped

    def initial_state(self, n_envs: int) -> tuple[th.Tensor, th.Tensor]:
        """
        :param n_envs: number of environments
        """
        return th.zeros(1, n_envs, self.lstm.hidden_size), th.zeros(1, n_envs, self.lstm.hidden_size)

    def step(self, tokens: Tokens, state: Any) -> tuple[Belief, Any]:
        """
        :param tokens: encoder inputs, ``(n_envs, ...)``
        :param state: hidden and cell state
        :return: beliefs ``(n_envs, n_privileged)`` and the next state
        """
        features = self.features(tokens)
        starts = th.zeros(len(features))
        remembered, state = RecurrentActorCriticPolicy._process_sequence(features, state, starts, self.lstm)
        return self._belief(remembered), state

    def forward(self, tokens: Tokens, lengths: th.Tensor) -> tuple[Belief, None]:
        """
        :param tokens: encoder inputs of whole episodes, one after another, ``(n_tokens, ...)``
        :param lengths: of the episodes, ``(n_episodes,)``
        :return: beliefs, ``(n_tokens, n_privileged)``
        """
        features = self.features(tokens)
        padded = pad_sequence(list(features.split(lengths.tolist())), batch_first=True)
        starts = th.zeros(padded.shape[:2])
        starts[:, 0] = float(self.stepped)
        remembered, _ = RecurrentActorCriticPolicy._process_sequence(
            padded.flatten(0, 1), self.initial_state(len(lengths)), starts.flatten(), self.lstm
        )
        real = th.arange(padded.shape[1]) < lengths[:, None]
        return self._belief(remembered[real.flatten()]), None

    def _belief(self, remembered: th.Tensor) -> Belief:
        embedding = self.embedding(remembered)
        return Belief(self.mean(embedding), self.log_std(embedding))


def random_tokens(n: int) -> Tokens:
    """
    :param n: number of tokens
    """
    return {COMMON: th.randn(n, N_COMMON), PREVIOUS_ACTION: th.randn(n, N_ACTION)}


def _state_at(encoder: ObservationEncoder, position: int, n_envs: int) -> Any:
    """The memory of environments that are about to take a token at a position (the first is 1)."""
    if position == 1:
        return encoder.memory.initial_state(n_envs)
    _, state = encoder(random_tokens(position - 1), th.tensor([position - 1]))
    return take_rows(state, th.zeros(n_envs, dtype=th.long))


@th.no_grad()
def _step_microseconds(step: Callable[..., Any], tokens: Tokens, state: Any, n_steps: int) -> float:
    """The same token again and again: the state that is passed stays at its position."""
    n_envs = len(tokens[COMMON])
    begin = time.perf_counter()
    for _ in range(n_steps):
        step(tokens, state)
    return (time.perf_counter() - begin) / (n_steps * n_envs) * 1e6


def rollout_values(
    n_envs: int, positions: Sequence[int] = POSITIONS, n_steps: int = 50, width: int = 64, repetitions: int = 5
) -> dict[str, list[float]]:
    """
    Microseconds per token at context positions.

    :param n_envs: environments that take a token at once
    :param positions: of the token in its episode; the first is 1
    :param n_steps: tokens an environment and repetition
    :param width: of the encoder
    :param repetitions: rounds
    :return: values by memory and position
    """
    tokens, contenders = random_tokens(n_envs), {}
    with th.no_grad():
        for memory in MEMORIES:
            encoder = make_encoder(memory, width).eval()
            for position in positions:
                state = _state_at(encoder, position, n_envs)
                name = f"{memory}, position {position}"
                contenders[name] = functools.partial(_step_microseconds, encoder.step, tokens, state, n_steps)
        lstm = LSTMEncoder(width).eval()
        state = lstm.initial_state(n_envs)
        contenders["LSTM (sb3-contrib)"] = functools.partial(_step_microseconds, lstm.step, tokens, state, n_steps)
    return interleave(contenders, repetitions)


def ragged_lengths(longest: int, n_tokens: int) -> th.Tensor:
    """
    Lengths of episodes that end between a quarter of the longest one and it.

    :param longest: decisions
    :param n_tokens: the episodes have at least so many in all
    """
    rng, lengths = np.random.default_rng(0), [longest]
    while sum(lengths) < n_tokens:
        lengths.append(int(rng.integers(max(1, longest // 4), longest + 1)))
    return th.tensor(lengths)


def _tokens_per_second(encoder: nn.Module, tokens: Tokens, truth: th.Tensor, lengths: th.Tensor) -> float:
    begin = time.perf_counter()
    loss = gaussian_nll(encoder(tokens, lengths)[0], truth)
    encoder.zero_grad(set_to_none=True)
    loss.backward()
    return len(truth) / (time.perf_counter() - begin)


def update(longest: int, n_tokens: int = 4096, width: int = 64, repetitions: int = 5) -> list[Row]:
    """
    Tokens per second forward and backward.

    :param longest: episode, in decisions
    :param n_tokens: of a batch
    :param width: of the encoder
    :param repetitions: rounds
    """
    lengths = ragged_lengths(longest, n_tokens)
    tokens, truth = random_tokens(int(lengths.sum())), th.randn(int(lengths.sum()), N_PRIVILEGED)
    encoders: dict[str, nn.Module] = {f"USPL, {memory}": make_encoder(memory, width) for memory in MEMORIES}
    encoders |= {STEPPED: LSTMEncoder(width), AT_ONCE: LSTMEncoder(width, stepped=False)}
    contenders = {
        name: functools.partial(_tokens_per_second, encoder, tokens, truth, lengths) for name, encoder in encoders.items()
    }
    values = interleave(contenders, repetitions)
    return rows(values, f"{len(lengths)} episodes of up to {longest} decisions", "tokens / s", STEPPED)


def run(
    repetitions: int = 5,
    env_counts: Sequence[int] = (64, 128),
    positions: Sequence[int] = POSITIONS,
    n_steps: int = 50,
    lengths: Sequence[int] = (80, 500),
    n_tokens: int = 4096,
    width: int = 64,
    threads: int = 1,
) -> Tables:
    """
    The whole section.

    :param repetitions: rounds of every comparison
    :param env_counts: numbers of environments at rollout
    :param positions: of a token in its episode
    :param n_steps: tokens an environment and repetition at rollout
    :param lengths: of the longest episode in a batch of the update
    :param n_tokens: of such a batch
    :param width: of the encoder
    :param threads: of torch
    """
    rollout: list[Row] = []
    targets: list[Row] = []
    with torch_threads(threads):
        for n_envs in env_counts:
            values = rollout_values(n_envs, positions, n_steps, width, repetitions)
            rollout += rows(values, f"rollout, {n_envs} envs", "us / token")
            for memory in MEMORIES if {EARLY, LATE} <= set(positions) else ():
                measured = ratio(values, f"{memory}, position {LATE}", f"{memory}, position {EARLY}")
                what = f"{memory}, {n_envs} envs: a token at position {LATE} / at {EARLY}"
                targets.append(target(what, measured, at_most=POSITION_TARGET))
        updates = [row for longest in lengths for row in update(longest, n_tokens, width, repetitions)]
    described = f"width {width}, {threads} thread(s)"
    return {f"Encoder at rollout, {described}": rollout, f"Encoder's update, {described}": updates, TARGETS: targets}
