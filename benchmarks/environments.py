"""Environments: decisions per second, start-up, memory and reset, against the vector environments of SB3."""

import contextlib
import functools
import multiprocessing
import statistics
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from benchmarks import start_up
from benchmarks.contenders import make_env, make_venv
from benchmarks.harness import TARGETS, Row, Tables, interleave, ratio, rows, target
from bullet_tasks import ENV_IDS

PHYSICS = ("kinematic", "compiled")
"""Of those kinds that train; a task that knows neither is measured as it comes."""
ONE, TWO, _, SUBPROC = start_up.VEC_ENVS
MANY = {"compiled": 256}
"""Environments of a training, by kind of physics; 64 of the others, which have 30 MB each in PyBullet."""
WORKERS_TARGET, SUBPROC_TARGET = 1.7, 3.0
"""Times as fast: 2 workers as 1 worker, and as SubprocVecEnv, on a machine with 2 cores."""

QUICK: dict[str, Any] = dict(repetitions=1, n_envs=4, n_many=8, n_steps=20, n_resets=5, n_start_up_envs=2)


def variants(env_id: str) -> dict[str, dict[str, Any]]:
    """
    Kinds of physics that a task has.

    :param env_id: registered id
    :return: arguments of the environment by name of the variant
    """
    found: dict[str, dict[str, Any]] = {}
    for physics in PHYSICS:
        with contextlib.suppress(ValueError, TypeError):
            make_env(env_id, physics=physics).close()
            found[physics] = {"physics": physics}
    return found or {"default": {}}


def random_actions(space: gym.Space, n_steps: int, n_envs: int) -> np.ndarray:
    """
    Actions drawn beforehand, the same for every contender.

    :param space: action space
    :param n_steps: decisions per environment
    :param n_envs: number of environments
    :return: ``(n_steps, n_envs, *shape)``
    """
    space.seed(0)
    return np.array([[space.sample() for _ in range(n_envs)] for _ in range(n_steps)])


def decisions_per_second(venv: VecEnv, actions: np.ndarray) -> float:
    """
    Step through the same episodes every time; those that end are reset as always.

    :param venv: environments
    :param actions: ``(n_steps, n_envs, *shape)``
    """
    venv.seed(0)
    venv.reset()
    begin = time.perf_counter()
    for step in actions:
        venv.step(step)
    return actions.shape[0] * actions.shape[1] / (time.perf_counter() - begin)


def throughput(
    env_id: str,
    env_kwargs: dict[str, Any],
    n_envs: int = 16,
    n_steps: int = 120,
    repetitions: int = 5,
    names: Sequence[str] = tuple(start_up.VEC_ENVS),
) -> dict[str, list[float]]:
    """
    Decisions per second of vector environments.

    :param env_id: registered id
    :param env_kwargs: of the environment
    :param n_envs: number of environments
    :param n_steps: decisions per environment and repetition
    :param repetitions: rounds
    :param names: of the vector environments, see ``start_up.VEC_ENVS``
    :return: values by name of the vector environment
    """
    with contextlib.ExitStack() as stack:
        venvs = {}
        for name in names:
            vec_env_cls, vec_env_kwargs = start_up.VEC_ENVS[name]
            venv = make_venv(env_id, n_envs, vec_env_cls, vec_env_kwargs=vec_env_kwargs, **env_kwargs)
            stack.callback(venv.close)
            venvs[name] = venv
        actions = random_actions(venv.action_space, n_steps, n_envs)
        contenders = {name: functools.partial(decisions_per_second, venv, actions) for name, venv in venvs.items()}
        return interleave(contenders, repetitions)


def count(n: int) -> int:
    """
    Work that needs nothing but a core.

    :param n: how much
    """
    total = 0
    for i in range(n):
        total += i
    return total


def second_process(n: int = 2_000_000, repetitions: int = 5) -> dict[str, list[float]]:
    """
    What this machine gives to a second process: the limit for two workers. Cores that share a processor give less than 2.

    :param n: additions of one process
    :param repetitions: rounds
    :return: million additions per second by number of processes
    """
    context = multiprocessing.get_context("fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn")
    with contextlib.ExitStack() as stack:

        def rate(pool: Any, n_processes: int) -> float:
            begin = time.perf_counter()
            pool.map(count, [n] * n_processes, 1)
            return n_processes * n / (time.perf_counter() - begin) / 1e6

        pools = {k: stack.enter_context(context.Pool(k)) for k in (1, 2)}
        contenders = {f"{k} process(es)": functools.partial(rate, pool, k) for k, pool in pools.items()}
        return interleave(contenders, repetitions)


def reset_microseconds(env: gym.Env, n_resets: int) -> float:
    """
    Mean time of a reset.

    :param env: environment
    :param n_resets: number of resets
    """
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(n_resets):
        env.reset()
    return (time.perf_counter() - begin) / n_resets * 1e6


def resets(env_ids: Sequence[str] = ENV_IDS, n_resets: int = 200, repetitions: int = 5) -> list[Row]:
    """
    Cost of a reset of a single environment.

    :param env_ids: registered ids
    :param n_resets: resets per repetition
    :param repetitions: rounds
    """
    table = []
    for env_id in env_ids:
        with contextlib.ExitStack() as stack:
            contenders = {}
            for variant, env_kwargs in variants(env_id).items():
                env = make_env(env_id, **env_kwargs)
                stack.callback(env.close)
                contenders[variant] = functools.partial(reset_microseconds, env, n_resets)
            table += rows(interleave(contenders, repetitions), env_id, "us / reset")
    return table


def start_ups(env_id: str, n_envs: int = 8, repetitions: int = 5) -> list[Row]:
    """
    Time until the first observations, and memory, each in a fresh process.

    :param env_id: registered id
    :param n_envs: number of environments
    :param repetitions: rounds
    """
    times, memories = [], []
    # The start method takes the same time whatever the physics, and long.
    names = [*start_up.VEC_ENVS, start_up.DEFAULT_SUBPROC]
    for variant, env_kwargs in variants(env_id).items():
        memory: dict[str, list[float]] = {name: [] for name in names}

        def seconds(name: str, env_kwargs: dict[str, Any] = env_kwargs, memory: dict[str, list[float]] = memory) -> float:
            measured = start_up.measure(name, env_id, n_envs, env_kwargs)
            memory[name] += [] if measured.memory is None else [measured.memory]
            return measured.seconds

        contenders = {name: functools.partial(seconds, name) for name in names}
        what = f"{env_id}, {variant}"
        times += rows(interleave(contenders, repetitions, warm_up=False), what, "s", TWO)
        if all(memory.values()):
            memories += rows(memory, what, "MiB / env", TWO)
        names = [*start_up.VEC_ENVS]
    return times + memories


def run(
    repetitions: int = 5,
    n_envs: int = 16,
    n_many: int | None = None,
    n_steps: int = 120,
    n_resets: int = 200,
    env_ids: Sequence[str] = ENV_IDS,
    start_up_env: str | None = "LateralChoice-v0",
    n_start_up_envs: int = 8,
) -> Tables:
    """
    The whole section.

    :param repetitions: rounds of every comparison
    :param n_envs: number of environments
    :param n_many: of environments, of BulletVecEnv alone; None: as many as in a training, see ``MANY``
    :param n_steps: decisions per environment and repetition, half of that with many
    :param n_resets: resets per repetition
    :param env_ids: tasks
    :param start_up_env: task whose start-up and memory are measured; None leaves that out
    :param n_start_up_envs: number of environments there
    """
    values = second_process(repetitions=repetitions)
    second = rows(values, "a loop in Python", "million additions / s", "1 process(es)")
    table: list[Row] = []
    gains: dict[tuple[str, str, float], list[float]] = {}
    for env_id in env_ids:
        for variant, env_kwargs in variants(env_id).items():
            values = throughput(env_id, env_kwargs, n_envs, n_steps, repetitions)
            table += rows(values, f"{env_id}, {variant}, {n_envs} envs", "decisions / s", SUBPROC)
            gains.setdefault((f"{variant}, {n_envs} envs", SUBPROC, SUBPROC_TARGET), []).append(ratio(values, TWO, SUBPROC))
            gains.setdefault((f"{variant}, {n_envs} envs", ONE, WORKERS_TARGET), []).append(ratio(values, TWO, ONE))
            # SubprocVecEnv would need a process for each, and all contenders' clients at once a machine's memory.
            many = n_many or MANY.get(variant, 64)
            values = throughput(env_id, env_kwargs, many, n_steps // 2, repetitions, [ONE, TWO])
            table += rows(values, f"{env_id}, {variant}, {many} envs", "decisions / s", ONE)
            gains.setdefault((f"{variant}, {many} envs", ONE, WORKERS_TARGET), []).append(ratio(values, TWO, ONE))
    targets = []
    for (variant, reference, limit), measured in gains.items():
        for name, value in (("worst", min(measured)), ("median", statistics.median(measured))):
            what = f"{TWO} / {reference}, {variant}, {name} of {len(measured)} tasks"
            targets.append(target(what, value, at_least=limit))
    tables = {
        "A second process": second,
        "Environments, random actions": table,
        "Reset": resets(env_ids, n_resets, repetitions),
    }
    if start_up_env is not None:
        title = f"Start-up and memory of {n_start_up_envs} environments"
        tables[title] = start_ups(start_up_env, n_start_up_envs, repetitions)
    return {**tables, TARGETS: targets}
