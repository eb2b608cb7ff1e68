"""
Time and decisions until the deployment policy succeeds: ``python -m benchmarks.to_success`` (``make benchmark-learning``).

Every method learns with its own entry of the zoo; PPO and RecurrentPPO, which have none, with PPO's part of USPL's. The
evaluations, on seeds that training never uses and, in Active T-Maze, in a longer corridor than the entry's, stop the clock. A
method that does not get there says so, with the best that it reached.
"""

import argparse
import contextlib
import itertools
import math
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.contenders import build, hides_privileged, make_venv, zoo_entry, zoo_settings
from benchmarks.harness import Row, show, write_json
from benchmarks.machine import ROOT, busy, describe, load
from benchmarks.training import TASKS, Task
from sb3_uspl._threads import torch_threads
from sb3_uspl.evaluation import EVALUATION_SEED, run_episodes, success_rate

ENTRIES = {"USPLPPO": "uspl_ppo", "PPO": "uspl_ppo", "RecurrentPPO": "uspl_ppo", "RESeLPPO": "resel_ppo"}
"""Files in ``zoo_configs``."""
METHODS = tuple(ENTRIES)
"""PPO sees the privileged observation, in its evaluations, too: the floor."""
SUCCESS = 0.95
NO_END = 10**9
"""Decisions that nobody waits for."""


class Learned(NamedTuple):
    """How a training went."""

    reached: bool
    seconds: float
    """Of training, until the last evaluation."""
    decisions: int
    """Until the last evaluation."""
    success: float
    """Best of the evaluations, share of episodes."""


class UntilSuccess(BaseCallback):
    """
    Evaluates between iterations and ends the training at success or when its time is up.

    :param venv: environments of the evaluation
    :param every: decisions between two evaluations, at least
    :param n_episodes: of an evaluation, new ones each time
    :param limit: s of training, evaluations not counted
    :param success: share of episodes that is enough
    """

    def __init__(self, venv: VecEnv, every: int, n_episodes: int, limit: float, success: float = SUCCESS) -> None:
        super().__init__()
        self.venv, self.every, self.n_episodes, self.limit, self.success = venv, every, n_episodes, limit, success
        self.learned = Learned(False, 0.0, 0, 0.0)
        self._seed, self._elapsed, self._since = EVALUATION_SEED, 0.0, 0.0

    def _on_training_start(self) -> None:
        self._since = time.perf_counter()

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self.learned.decisions >= self.every:
            self.evaluate()

    def _on_training_end(self) -> None:
        if not self.learned.reached and self.num_timesteps > self.learned.decisions:
            self.evaluate()

    def evaluate(self) -> None:
        """Stop the clock and look at the deployment policy."""
        self._elapsed += time.perf_counter() - self._since
        rate, _, _ = success_rate(run_episodes(self.model, self.venv, self.n_episodes, self._seed))
        self._seed += self.n_episodes
        best = max(self.learned.success, rate)
        self.learned = Learned(rate >= self.success, self._elapsed, self.num_timesteps, best)
        self._since = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.learned.reached and self._elapsed + time.perf_counter() - self._since < self.limit


def learn(
    method: str,
    task: Task,
    seed: int = 0,
    limit: float = 1800.0,
    every: int = 25_000,
    n_episodes: int = 200,
    success: float = SUCCESS,
    **replacements: Any,
) -> Learned:
    """
    One training until success.

    :param method: one of ``METHODS``
    :param task: to learn; the number of environments is the entry's
    :param seed: of the training
    :param limit: s of training
    :param every: decisions between two evaluations, at least
    :param n_episodes: of an evaluation
    :param success: share of episodes that is enough
    :param replacements: of single settings in the zoo's entry
    """
    entry, hide = zoo_entry(ENTRIES[method], task.env_id), hides_privileged(method)
    settings = {**zoo_settings(ENTRIES[method], task.env_id), "device": "cpu", "seed": seed, **replacements}
    n_envs, decisions = int(entry["n_envs"]), int(entry["n_timesteps"])
    if method in ("PPO", "RecurrentPPO"):
        # No schedule of theirs depends on the end, so that the clock alone decides.
        decisions = NO_END
    with contextlib.ExitStack() as stack:
        venvs = []
        for env_kwargs in ({**entry.get("env_kwargs", {}), **task.env_kwargs}, task.env_kwargs):
            venvs.append(make_venv(task.env_id, n_envs, hide_privileged=hide, seed=seed, **env_kwargs))
            stack.callback(venvs[-1].close)
        callback = UntilSuccess(venvs[1], every, n_episodes, limit, success)
        build(method, venvs[0], settings).learn(decisions, callback=callback)
    return callback.learned


def compare(
    tasks: Sequence[Task] = TASKS[::2],
    methods: Sequence[str] = METHODS,
    seeds: Sequence[int] = (0,),
    threads: int = 1,
    **arguments: Any,
) -> Iterator[Row]:
    """
    Train every method with every seed, the methods in turn.

    :param tasks: to learn
    :param methods: some of ``METHODS``
    :param seeds: of the trainings
    :param threads: of torch
    :param arguments: of :func:`learn`
    :return: a row as soon as a training ends
    """
    for task, seed, method in itertools.product(tasks, seeds, methods):
        with torch_threads(threads):
            yield {"task": str(task), "seed": seed, "method": method, **learn(method, task, seed, **arguments)._asdict()}


def summary(table: Sequence[Row]) -> list[Row]:
    """
    Medians over the seeds; without a number where the median training did not get there.

    :param table: from :func:`compare`
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in table:
        groups.setdefault((row["task"], row["method"]), []).append(row)
    lines = []
    for (task, method), trainings in groups.items():
        line: Row = {"task": task, "method": method, "reached": f"{sum(r['reached'] for r in trainings)} of {len(trainings)}"}
        for key in ("seconds", "decisions"):
            middle = statistics.median_high([float(r[key]) if r["reached"] else math.inf for r in trainings])
            line[key] = middle if math.isfinite(middle) else None
        lines.append({**line, "best success": max(r["success"] for r in trainings)})
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = {task.env_id: task for task in TASKS[::2]}
    parser.add_argument("--envs", nargs="+", default=list(known), choices=list(known))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--seeds", type=int, default=1, help="number of trainings of each method")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds that a training may take")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "learning.json", help="file to write")
    parser.add_argument("--markdown", action="store_true", help="print tables as Markdown")
    options = parser.parse_args()
    machine, table = describe(), []
    print(busy() or "The machine is quiet.", flush=True)
    tasks, seeds = [known[env_id] for env_id in options.envs], range(options.seeds)
    for row in compare(tasks, options.methods, seeds, options.threads, limit=options.limit):
        table.append(row)
        print(row, flush=True)
        content = {"machine": machine, "load_after": load(), "threads": options.threads, "limit": options.limit}
        write_json(options.json, {**content, "trainings": table, "summary": summary(table)})
    title = f"Training until {SUCCESS:.0%} deployment success, {options.threads} thread(s), at most {options.limit:.0f} s"
    print("\n" + show(title, summary(table), options.markdown))


if __name__ == "__main__":
    main()
