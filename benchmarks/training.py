"""
Training, end to end: samples per second of all methods on the same environments, with the same threads and workers.

Samples count every environment, as SB3 does. A quarter of USPL's and RMA's are mismatched (App. C.3.1): their episodes teach
the encoder only, and PPO's minibatches are so many fewer. Plain PPO sees the privileged observation exactly: the floor.
"""

import contextlib
import functools
import math
import statistics
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.contenders import (
    METHODS,
    Settings,
    build,
    hides_privileged,
    make_env,
    make_venv,
    memory_width,
    zoo_entry,
    zoo_settings,
)
from benchmarks.harness import TARGETS, Row, Tables, interleave, ratio, rows, target
from benchmarks.phases import PHASES, POLICY, watch_phases, watch_rollouts
from sb3_uspl import USPLPPO
from sb3_uspl._threads import torch_threads


class Task(NamedTuple):
    """What is learned, and in how many environments at once."""

    env_id: str
    env_kwargs: dict[str, Any]
    fixed_n_envs: int | None = None
    """None takes the zoo's."""

    def __str__(self) -> str:
        return " ".join([self.env_id, *(str(value) for value in self.env_kwargs.values())])

    @property
    def n_envs(self) -> int:
        """Number of environments."""
        return self.fixed_n_envs or int(zoo_entry("uspl_ppo", self.env_id)["n_envs"])


TASKS = (
    Task("LateralChoice-v0", {"physics": "compiled"}),
    # All methods' environments are alive at once, with 30 MB each in PyBullet.
    Task("LateralChoice-v0", {"physics": "kinematic"}, 64),
    # A repetition lasts as long as one of its episodes.
    Task("ActiveTMaze-v0", {}, 32),
)
DEFAULT_TASKS = TASKS[1:]
"""Learned with the libraries' defaults, too. With more environments an iteration of RecurrentPPO takes minutes."""
IMAGE_TASKS = (Task("SignpostNavDepth-v0", {"physics": "compiled"}),)
"""Broken down by phase only: minutes an iteration in methods that keep images in PPO's buffers."""
RECURRENT_TARGET, RMA_TARGET, ROLLOUT_TARGET, SPEED_TARGET = 10.0, 1.1, 1.5, 10_000.0
"""USPL's samples/s over RecurrentPPO's; its iteration over RMA's; its rollout over PPO's, in time; decisions/s end to end."""
ALL_AT_ONCE: Settings = dict(warmup_timesteps=0, ramp_timesteps=1, target_kl=None, seed=0, device="cpu")
"""Blurring and reward transformation at full strength from the start, and no update cut short."""

QUICK: dict[str, Any] = dict(
    repetitions=1,
    tasks=(Task("LateralChoice-v0", {"physics": "compiled"}, 32),),
    decisions=512,
    default_tasks=(),
    image_tasks=(),
    rollout_envs=8,
    env_counts=(32, 64),
    thread_counts=(1,),
)


def settings_for(task: Task, n_envs: int | None = None, decisions: int | None = None, **replacements: Any) -> Settings:
    """
    The zoo's entry for USPL, made ready for timing. Whatever the number of environments, an iteration has as many decisions.

    :param task: to learn
    :param n_envs: number of environments; None takes the task's
    :param decisions: of an iteration, in all environments; None takes the entry's
    :param replacements: further settings
    """
    entry = zoo_entry("uspl_ppo", task.env_id)
    n_steps = (decisions or entry["n_envs"] * entry["n_steps"]) // (n_envs or task.n_envs)
    return {**zoo_settings("uspl_ppo", task.env_id), **ALL_AT_ONCE, "n_steps": n_steps, **replacements}


def default_settings(n_envs: int, decisions: int | None = None) -> Settings:
    """
    Nothing of the zoo's: each library's own defaults.

    :param n_envs: number of environments
    :param decisions: of an iteration, in all environments; None takes each library's number of steps
    """
    return ALL_AT_ONCE if decisions is None else {**ALL_AT_ONCE, "n_steps": decisions // n_envs}


@contextlib.contextmanager
def ready(method: str, task: Task, n_envs: int, settings: Settings) -> Any:
    """
    A model with its environments, closed afterwards.

    :param method: one of ``METHODS``
    :param task: to learn
    :param n_envs: number of environments
    :param settings: of USPL
    """
    venv = make_venv(task.env_id, n_envs, hide_privileged=hides_privileged(method), **task.env_kwargs)
    try:
        yield build(method, venv, settings)
    finally:
        venv.close()


def iterations_per_episode(task: Task, n_steps: int) -> int:
    """
    Number of iterations that is as long as an episode.

    :param task: to learn
    :param n_steps: decisions per environment and rollout
    """
    env = make_env(task.env_id, **task.env_kwargs)
    assert env.spec is not None
    # Who sets no limit for gymnasium tells it.
    longest: int = env.spec.max_episode_steps or env.get_wrapper_attr("episode_length")
    env.close()
    return math.ceil(longest / n_steps)


def iteration_seconds(model: OnPolicyAlgorithm, threads: int = 1, iterations: int = 1) -> float:
    """
    Mean time of an iteration: a rollout and the updates.

    :param model: any on-policy algorithm of SB3
    :param threads: of torch
    :param iterations: number of iterations
    """
    with torch_threads(threads):
        begin = time.perf_counter()
        model.learn(iterations * model.n_steps * model.n_envs, reset_num_timesteps=False)
        return (time.perf_counter() - begin) / iterations


def samples_per_second(model: OnPolicyAlgorithm, threads: int = 1, iterations: int = 1) -> float:
    """
    :param model: any on-policy algorithm of SB3
    :param threads: of torch
    :param iterations: number of iterations
    """
    return model.n_steps * model.n_envs / iteration_seconds(model, threads, iterations)


def compare_methods(
    task: Task, settings: Settings, threads: int = 1, repetitions: int = 5, methods: Sequence[str] = METHODS
) -> dict[str, list[float]]:
    """
    Samples per second of every method, over whole episodes: encoders learn when one has ended, and RecurrentPPO's LSTM goes
    through a minibatch in one call unless one begins in it.

    :param task: to learn
    :param settings: of USPL; the others have what they know of them
    :param threads: of torch
    :param repetitions: rounds
    :param methods: to compare
    :return: values by method
    """
    contenders = {}
    with contextlib.ExitStack() as stack:
        for method in methods:
            model = stack.enter_context(ready(method, task, task.n_envs, settings))
            iterations = iterations_per_episode(task, model.n_steps)
            contenders[method] = functools.partial(samples_per_second, model, threads, iterations)
        return interleave(contenders, repetitions)


def breakdown(task: Task, decisions: int | None = None, threads: int = 1, repetitions: int = 5) -> list[Row]:
    """
    Where the time of an iteration of USPL goes.

    :param task: to learn
    :param decisions: of an iteration, in all environments; None takes the zoo's
    :param threads: of torch
    :param repetitions: rounds
    """
    seen: dict[str, list[float]] = {phase: [] for phase in PHASES}
    with ready("USPLPPO", task, task.n_envs, settings_for(task, decisions=decisions)) as model:
        assert isinstance(model, USPLPPO)
        cycle = iterations_per_episode(task, model.n_steps)
        iteration_seconds(model, threads, cycle)
        for _ in range(repetitions):
            with watch_phases(model) as stopwatch:
                iteration_seconds(model, threads, cycle)
            for phase in PHASES:
                seen[phase].append(stopwatch.seconds[phase] / cycle)
        per_iteration = model.n_steps * model.n_envs
    medians = {phase: statistics.median(values) for phase, values in seen.items()}
    total = sum(medians.values())
    return [
        {
            "what": f"{task}, {task.n_envs} envs",
            "phase": phase,
            "median ms": 1e3 * seconds,
            "us / decision": 1e6 * seconds / per_iteration,
            "share": seconds / total,
            "repetitions": repetitions,
        }
        for phase, seconds in medians.items()
    ]


def _rollout_seconds(model: OnPolicyAlgorithm) -> float:
    with watch_rollouts(model) as stopwatch:
        iteration_seconds(model)
    return stopwatch.seconds[POLICY]


def compare_rollouts(task: Task, n_envs: int = 128, n_steps: int = 64, repetitions: int = 5) -> dict[str, list[float]]:
    """
    Seconds of USPL's and PPO's rollouts; the updates between them are kept short.

    :param task: to learn
    :param n_envs: number of environments
    :param n_steps: decisions per environment and rollout
    :param repetitions: rounds
    :return: values by method
    """
    short = dict(n_epochs=1, batch_size=n_envs * n_steps, encoder_updates=1)
    settings = settings_for(task, n_envs, n_envs * n_steps, **short)
    with contextlib.ExitStack() as stack:
        models = {name: stack.enter_context(ready(name, task, n_envs, settings)) for name in ("USPLPPO", "PPO")}
        return interleave({name: functools.partial(_rollout_seconds, model) for name, model in models.items()}, repetitions)


def end_to_end(
    task: Task,
    env_counts: Sequence[int] = (128, 256),
    thread_counts: Sequence[int] = (1, 2),
    decisions: int | None = None,
    repetitions: int = 5,
) -> dict[str, list[float]]:
    """
    Decisions per second of USPL with the zoo's settings, save for the number of environments.

    :param task: to learn
    :param env_counts: numbers of environments
    :param thread_counts: threads of torch
    :param decisions: of an iteration, in all environments; None takes the zoo's
    :param repetitions: rounds
    :return: values by numbers of environments and threads
    """
    with contextlib.ExitStack() as stack:
        contenders = {}
        for n_envs in env_counts:
            settings = settings_for(task, n_envs, decisions)
            cycle = iterations_per_episode(task, settings["n_steps"])
            model = stack.enter_context(ready("USPLPPO", task, n_envs, settings))
            for threads in thread_counts:
                name = f"{n_envs} envs x {model.n_steps}, {threads} thread(s)"
                contenders[name] = functools.partial(samples_per_second, model, threads, cycle)
        return interleave(contenders, repetitions)


def run(
    repetitions: int = 5,
    tasks: Sequence[Task] = TASKS,
    decisions: int | None = None,
    rollout_envs: int = 128,
    env_counts: Sequence[int] = (128, 256),
    thread_counts: Sequence[int] = (1, 2),
    threads: int = 1,
    default_tasks: Sequence[Task] = DEFAULT_TASKS,
    image_tasks: Sequence[Task] = IMAGE_TASKS,
) -> Tables:
    """
    The whole section.

    :param repetitions: rounds of every comparison
    :param tasks: to learn; the first is the one for :func:`end_to_end`
    :param decisions: of an iteration, in all environments; None takes the zoo's
    :param rollout_envs: number of environments for :func:`compare_rollouts`
    :param env_counts: numbers of environments for :func:`end_to_end`
    :param thread_counts: threads of torch for :func:`end_to_end`; the most of them to compare the methods
    :param threads: of torch for everything else; phases of updates that run side by side cannot be told apart
    :param default_tasks: tasks that USPL and RecurrentPPO also learn with :func:`default_settings`
    :param image_tasks: further tasks, broken down by phase only
    """
    methods: list[Row] = []
    phases: list[Row] = []
    rollouts: list[Row] = []
    targets: list[Row] = []
    for task in tasks:
        settings = settings_for(task, decisions=decisions)
        width = memory_width(settings)
        values = compare_methods(task, settings, max(thread_counts), repetitions)
        methods += rows(values, f"{task}, {task.n_envs} envs, memory of {width}", "samples / s", "RecurrentPPO")
        targets += [
            target(f"{task}: samples/s of USPL / RecurrentPPO", ratio(values, "USPLPPO", "RecurrentPPO"), RECURRENT_TARGET),
            target(f"{task}: time of an iteration, USPL / RMA", ratio(values, "RMA", "USPLPPO"), at_most=RMA_TARGET),
        ]
        phases += breakdown(task, decisions, threads, repetitions)
        values = compare_rollouts(task, rollout_envs, repetitions=repetitions)
        rollouts += rows(values, f"{task}, {rollout_envs} envs", "s / rollout", "PPO")
        measured = ratio(values, "USPLPPO", "PPO")
        targets.append(target(f"{task}: time of a rollout, USPL / PPO", measured, at_most=ROLLOUT_TARGET))
    for task in default_tasks:
        settings = default_settings(task.n_envs, decisions)
        values = compare_methods(task, settings, max(thread_counts), repetitions, ("USPLPPO", "RecurrentPPO"))
        what = f"{task}, {task.n_envs} envs, the libraries' defaults, memory of {memory_width(settings)}"
        methods += rows(values, what, "samples / s", "RecurrentPPO")
        measured = ratio(values, "USPLPPO", "RecurrentPPO")
        what = f"{task}, the libraries' defaults: samples/s of USPL / RecurrentPPO"
        targets.append(target(what, measured, RECURRENT_TARGET))
    for task in image_tasks:
        phases += breakdown(task, decisions, threads, repetitions)
    values = end_to_end(tasks[0], env_counts, thread_counts, decisions, repetitions)
    best = max(statistics.median(measured) for measured in values.values())
    targets.append(target(f"{tasks[0]}: decisions/s end to end, the best of these", best, SPEED_TARGET))
    return {
        f"Training, {max(thread_counts)} thread(s)": methods,
        f"An iteration of USPL by phase, {threads} thread(s)": phases,
        "Rollout, 1 thread": rollouts,
        "End to end, USPL with the zoo's settings": rows(values, str(tasks[0]), "decisions / s"),
        TARGETS: targets,
    }
