"""The encoder of the paper with a Transformer, on a GPU; no rows without one."""

import contextlib
import functools
import time
from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.contenders import build, make_venv
from benchmarks.harness import Tables, interleave, rows
from benchmarks.training import ALL_AT_ONCE

ENV_ID, PHYSICS = "LateralChoice-v0", "compiled"
VARIANTS: dict[str, dict[str, Any]] = {
    "float32": {},
    "bfloat16": {"encoder_bf16": True},
    "bfloat16, compiled": {"encoder_bf16": True, "encoder_compile": True},
}
"""Arguments of USPLPPO. Compilation takes its minutes in the round that does not count."""

QUICK: dict[str, Any] = dict(repetitions=1, n_envs=16, n_steps=32, n_updates=2)


def _measure(model: OnPolicyAlgorithm) -> float:
    begin = time.perf_counter()
    model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False)
    if model.device.type == "cuda":
        th.cuda.synchronize(model.device)
    return time.perf_counter() - begin


def run(
    repetitions: int = 5,
    n_envs: int = 256,
    n_steps: int = 128,
    n_updates: int = 170,
    encoder: str = "paper",
    variants: Sequence[str] = tuple(VARIANTS),
    device: str | None = None,
) -> Tables:
    """
    The whole section.

    :param repetitions: rounds
    :param n_envs: number of environments
    :param n_steps: decisions per environment and iteration
    :param n_updates: of the encoder in an iteration (Table 5: 170)
    :param encoder: preset
    :param variants: some of ``VARIANTS``
    :param device: by default the GPU
    """
    if device is None:
        if not th.cuda.is_available():
            return {}
        device = "cuda"
    settings = {
        **ALL_AT_ONCE,
        "n_steps": n_steps,
        "batch_size": n_envs * n_steps // 4,
        "encoder_updates": n_updates,
        "encoder_batch_size": min(16_000, n_envs * n_steps),
        "policy_kwargs": dict(encoder=encoder, memory="transformer"),
        "device": device,
    }
    with contextlib.ExitStack() as stack:
        contenders = {}
        for name in variants:
            venv = make_venv(ENV_ID, n_envs, physics=PHYSICS)
            stack.callback(venv.close)
            model = build("USPLPPO", venv, {**settings, **VARIANTS[name]})
            contenders[name] = functools.partial(_measure, model)
        values = interleave(contenders, repetitions)
    title = f"{encoder} preset, transformer, {n_updates} encoder updates on {device}"
    return {title: rows(values, f"{ENV_ID}, {n_envs} envs x {n_steps}", "s / iteration", next(iter(contenders)))}
