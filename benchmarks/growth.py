"""
Growth: the cost of a decision against the number of environments, the length of episodes, the encoder's width, image size.

A rollout is one episode of every environment, and every decision passes the same number of times through the updates: if
cost did not grow, the time per decision would stay the same.
"""

import contextlib
import functools
import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

from benchmarks.contenders import build, make_venv
from benchmarks.harness import Row, Tables, interleave, rows
from benchmarks.phases import POLICY, watch_rollouts
from benchmarks.synthetic import SyntheticEnv
from benchmarks.training import ALL_AT_ONCE, iteration_seconds
from sb3_uspl import USPLPPO
from sb3_uspl._threads import torch_threads
from sb3_uspl.encoder import MEMORIES

PASSES = 4
"""Of every decision through PPO's update; of as many through the encoder's."""
LARGEST_BATCH = 512
"""Minibatches of PPO are all of one size."""
MISMATCH_FROM, MISMATCH = 8, 0.25
"""Fewer environments have none to mismatch."""

QUICK: dict[str, Any] = dict(
    repetitions=1, env_counts=(1, 8), lengths=(8, 16), widths=(16, 32), image_sizes=(None, 16), n_envs=8, length=8
)


class Size(NamedTuple):
    """What the cost may grow with."""

    n_envs: int = 16
    length: int = 32
    """Of an episode, decisions."""
    width: int = 64
    """Of the encoder."""
    image: int | None = None
    """Edge, pixels."""
    memory: str = "gru"


def make_model(size: Size) -> USPLPPO:
    """
    :param size: of everything
    """
    decisions = size.n_envs * size.length
    widths = dict(hidden=(size.width,), trunk=(size.width,), embedding=(size.width,))
    mismatch = MISMATCH if size.n_envs >= MISMATCH_FROM else 0.0
    settings = dict(
        n_steps=size.length,
        batch_size=max(n for n in range(1, LARGEST_BATCH + 1) if decisions % n == 0),
        n_epochs=PASSES,
        encoder_updates=PASSES,
        encoder_batch_size=decisions,
        mismatch_fraction=mismatch,
        policy_kwargs=dict(memory=size.memory, encoder_kwargs=widths),
    )
    env = functools.partial(SyntheticEnv, episode_length=size.length, image=size.image)
    model = build("USPLPPO", make_venv(env, size.n_envs), {**ALL_AT_ONCE, **settings})
    assert isinstance(model, USPLPPO)
    return model


def grow(what: str, sizes: dict[str, Size], threads: int = 1, repetitions: int = 5) -> list[Row]:
    """
    Microseconds per decision for some sizes.

    :param what: grows
    :param sizes: by name
    :param threads: of torch
    :param repetitions: rounds
    """
    rollouts: dict[str, list[float]] = {name: [] for name in sizes}

    def measure(name: str, model: USPLPPO) -> float:
        per_decision = 1e6 / (model.n_steps * model.n_envs)
        with watch_rollouts(model) as stopwatch:
            whole = iteration_seconds(model, threads)
        rollouts[name].append(stopwatch.seconds[POLICY] * per_decision)
        return whole * per_decision

    with contextlib.ExitStack() as stack:
        contenders = {}
        for name, size in sizes.items():
            model = make_model(size)
            stack.callback(model.get_env().close)  # type: ignore[union-attr]
            contenders[name] = functools.partial(measure, name, model)
        table = rows(interleave(contenders, repetitions), what, "us / decision")
    for row in table:
        row["of which rollout"] = statistics.median(rollouts[row["contender"]][-repetitions:])
    return table


def run(
    repetitions: int = 5,
    env_counts: Sequence[int] = (1, 4, 16, 64, 256, 1024),
    lengths: Sequence[int] = (20, 80, 320, 1000),
    widths: Sequence[int] = (32, 64, 128, 256, 512),
    image_sizes: Sequence[int | None] = (None, 16, 32, 48),
    n_envs: int = 16,
    length: int = 32,
    threads: int = 1,
) -> Tables:
    """
    The whole section.

    :param repetitions: rounds of every comparison
    :param env_counts: numbers of environments
    :param lengths: of an episode, decisions
    :param widths: of the encoder
    :param image_sizes: edges of the picture, pixels; None is without
    :param n_envs: number of environments where that does not grow
    :param length: of an episode where that does not grow
    :param threads: of torch
    """
    base = Size(n_envs, length)
    comparisons: dict[str, dict[str, Size]] = {
        "number of envs": {f"{n} envs": base._replace(n_envs=n) for n in env_counts},
        "image size": {f"{edge} px" if edge else "no image": base._replace(image=edge) for edge in image_sizes},
    }
    for memory in MEMORIES:
        sized = base._replace(memory=memory)
        comparisons[f"episode length, {memory}"] = {f"{n} decisions": sized._replace(length=n) for n in lengths}
        comparisons[f"encoder width, {memory}"] = {f"width {n}": sized._replace(width=n) for n in widths}
    with torch_threads(threads):
        table = [row for what, sizes in comparisons.items() for row in grow(what, sizes, threads, repetitions)]
    return {f"Growth of USPL's iteration, {threads} thread(s)": table}
