"""Trains and measures the cells of a grid in child processes, as many at a time as asked for."""

import fcntl
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from sb3_uspl.experiments.plan import Cell
from sb3_uspl.experiments.provenance import commit
from sb3_uspl.experiments.results import Results
from sb3_uspl.experiments.store import CHECKPOINTS_PER_TRAINING, CellFolder

REPORT_PERIOD, POLL_PERIOD = 30.0, 0.2
"""s between two progress lines, and between two looks at the children."""
STOP_TIMEOUT = 10.0
"""s that a child has to end before it is killed."""
LOG_TAIL = 12
"""Lines of a failed cell's output to show."""
MAX_N_EVAL_ENVS = 25


class Child(Protocol):
    """The part of ``subprocess.Popen`` that the runner uses."""

    def poll(self) -> int | None: ...
    def send_signal(self, signum: int) -> None: ...
    def wait(self, timeout: float | None = None) -> int: ...


Launch = Callable[[list[str], IO[str]], Child]
"""Starts ``python -m <arguments>`` with its output going to a file."""


def launch(arguments: list[str], log: IO[str]) -> Child:
    """
    :param arguments: of ``python -m``
    :param log: where the output goes
    :return: the child
    """
    # A session of its own: Ctrl-C is for the runner, which then ends the children itself.
    command = [sys.executable, "-m", *arguments]
    return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


@dataclass
class Job:
    """A cell that is being trained or measured."""

    folder: CellFolder
    phase: str
    child: Child
    log: IO[str]
    begin: float
    first: int
    """Decisions at the start of this attempt."""
    commit: str | None
    """Of the code when it was started; somebody may go on working while a long grid runs."""


class Grid:
    """
    The cells of a table or figure.

    :param cells: in the order in which they should run
    :param root: folder of all cells of this budget
    :param results: where measured cells go
    :param jobs: children at the same time
    :param start: starts a child
    :raises ValueError: for less than one job
    """

    def __init__(self, cells: Sequence[Cell], root: Path, results: Results, jobs: int, start: Launch = launch):
        if jobs < 1:
            raise ValueError(f"jobs={jobs}: at least one cell has to run at a time.")
        self.root, self.results, self.jobs, self.start = root, results, jobs, start
        self.n_cells = len(cells)
        self.waiting = [CellFolder(root, cell) for cell in cells if not results.has(cell)]
        self.running: list[Job] = []
        self.failed: dict[str, str] = {}
        self._begin = time.monotonic()
        self._left = {folder.cell.name: _decisions_left(folder) for folder in self.waiting}
        self._trained: list[tuple[Cell, float, int]] = []
        """Seconds and decisions of attempts that have ended."""
        self._measuring_times: list[float] = []

    def run(self) -> dict[str, str]:
        """
        Train and measure what is missing. After a KeyboardInterrupt the same grid can be run again.

        :return: name -> reason of the cells that failed; the others are not held up by them
        """
        finished = self.n_cells - len(self.waiting)
        if finished:
            self._say(f"{finished} of {self.n_cells} cells are there already and are used again")
        self.root.mkdir(parents=True, exist_ok=True)
        with _alone_in(self.root):
            next_report = time.monotonic() + REPORT_PERIOD
            try:
                while self.waiting or self.running:
                    while self.waiting and len(self.running) < self.jobs:
                        self._begin_cell(self.waiting.pop(0))
                    time.sleep(POLL_PERIOD)
                    for job in [job for job in self.running if job.child.poll() is not None]:
                        self._end(job)
                    if self.running and time.monotonic() >= next_report:
                        next_report += REPORT_PERIOD
                        self._report()
            finally:
                self._stop()
        return self.failed

    # -- one cell ----------------------------------------------------------------------------------------------------------

    def _begin_cell(self, folder: CellFolder) -> None:
        folder.create()
        if folder.state["trained"]:
            self._measure(folder)
            return
        checkpoint = folder.checkpoint()
        if folder.attempts() and checkpoint is None:
            self._say(f"{folder.cell.name}: was interrupted before its first checkpoint, starts again")
            folder.start_over()
        elif checkpoint is not None:
            self._say(f"{folder.cell.name}: continues after {checkpoint[1]:,} of {folder.cell.timesteps:,} decisions")
        self._train(folder, checkpoint)

    def _train(self, folder: CellFolder, checkpoint: tuple[Path, int] | None) -> None:
        cell = folder.cell
        n_envs = int(cell.hyperparameters.get("n_envs", 1))
        first = checkpoint[1] if checkpoint else 0
        arguments = ["sb3_uspl.train", "--algo", cell.algo, "--env", cell.env, "--seed", str(cell.seed)]
        arguments += ["-conf", str(folder.config), "-f", str(folder.train), "-n", str(cell.timesteps - first)]
        # Within a rollout, a checkpoint would hold no more than at its beginning.
        rollout = n_envs * int(cell.hyperparameters.get("n_steps", 1))
        arguments += ["--save-freq", str(max(cell.timesteps // CHECKPOINTS_PER_TRAINING, rollout))]
        arguments += ["--eval-freq", str(max(cell.timesteps // cell.evaluations, n_envs))]
        arguments += ["--eval-episodes", str(cell.evaluation_episodes)]
        arguments += ["--n-eval-envs", str(min(cell.evaluation_episodes, MAX_N_EVAL_ENVS))]
        if cell.env_kwargs:
            given = [f"{name}:{value!r}" for name, value in cell.env_kwargs.items()]
            arguments += ["--eval-env-kwargs", *given]
        if checkpoint:
            arguments += ["-i", str(checkpoint[0])]
        self._launch(folder, "train", arguments, first)

    def _measure(self, folder: CellFolder) -> None:
        target = self.results.path(folder.cell)
        self._launch(folder, "measure", ["sb3_uspl.experiments.measure", str(folder.path), str(target)], folder.cell.timesteps)

    def _launch(self, folder: CellFolder, phase: str, arguments: list[str], first: int) -> None:
        log = folder.log.open("a")
        log.write(f"\n== python -m {' '.join(arguments)}\n")
        log.flush()
        begin = time.monotonic()
        self.running.append(Job(folder, phase, self.start(arguments, log), log, begin, first, commit()))

    def _end(self, job: Job) -> None:
        self.running.remove(job)
        job.log.close()
        folder, cell, status = job.folder, job.folder.cell, job.child.wait()
        if job.phase == "measure":
            self._measuring_times.append(time.monotonic() - job.begin)
            if status == 0 and self.results.has(cell):
                folder.drop_checkpoints()
                rate = self.results.read(cell)["models"]["best"]["success_rate"]
                self._say(f"{cell.name}: done, success of the deployment policy {rate:.1%}")
            else:
                self._fail(folder, status)
            return
        # The zoo ends an interrupted training without an error.
        trained = status == 0 and folder.decisions() >= cell.timesteps
        self._trained.append((cell, time.monotonic() - job.begin, max(folder.decisions() - job.first, 0)))
        folder.add_attempt(time.monotonic() - job.begin, self.jobs, trained, job.commit)
        if trained:
            self._measure(folder)
        elif job.first and folder.decisions() <= job.first:
            aside = folder.start_over()
            why = f"could not continue from its checkpoint (now in {aside}), starts again"
            self._say(f"{cell.name}: {why}; {_end_of(folder.log)}")
            self._train(folder, None)
        else:
            self._fail(folder, status)

    def _fail(self, folder: CellFolder, status: int) -> None:
        reason = f"exit status {status}, see {folder.log}"
        self.failed[folder.cell.name] = reason
        self._say(f"{folder.cell.name}: FAILED, {reason}; {_end_of(folder.log)}")

    def _stop(self) -> None:
        for job in self.running:
            if job.child.poll() is None:
                job.child.send_signal(signal.SIGTERM)
        for job in self.running:
            try:
                job.child.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                job.child.send_signal(signal.SIGKILL)
                job.child.wait()
            job.log.close()
            if job.phase == "train":
                job.folder.add_attempt(time.monotonic() - job.begin, self.jobs, False, job.commit)
        self.running = []

    # -- progress ----------------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        training = [job for job in self.running if job.phase == "train"]
        now = {job.folder.cell.name: max(job.folder.decisions(), job.first) for job in training}
        seconds = self._seconds_left(training, now)
        remaining = f"about {_clock(seconds)} left" if math.isfinite(seconds) else "no estimate yet"
        done = self.n_cells - len(self.waiting) - len(self.running)
        states = []
        for job in self.running:
            share = f"{now[job.folder.cell.name] / job.folder.cell.timesteps:.0%}" if job.phase == "train" else "measured"
            states.append(f"{job.folder.cell.variant} {job.folder.cell.env} seed {job.folder.cell.seed}: {share}")
        self._say(f"{done} of {self.n_cells} cells done | {' | '.join(states)} | {remaining}")

    def _seconds_left(self, training: list[Job], now: dict[str, int]) -> float:
        """At the speed of the trainings so far, if there were any of the same algorithm and environment at theirs."""
        time_now = time.monotonic()
        seen = [*self._trained]
        seen += [(job.folder.cell, time_now - job.begin, now[job.folder.cell.name] - job.first) for job in training]

        def seconds(cell: Cell, decisions: int) -> float:
            same_env = [entry for entry in seen if entry[0].env == cell.env]
            same = [entry for entry in same_env if entry[0].algo == cell.algo]
            for entries in (same, same_env, seen):
                if sum(gone for _, _, gone in entries):
                    return decisions * sum(spent for _, spent, _ in entries) / sum(gone for _, _, gone in entries)
            return math.inf if decisions else 0.0

        measuring = sum(self._measuring_times) / max(len(self._measuring_times), 1)
        # The last rollout goes past the end.
        running = [
            seconds(job.folder.cell, max(job.folder.cell.timesteps - now[job.folder.cell.name], 0)) + measuring
            if job.phase == "train"
            else max(measuring - (time_now - job.begin), 0.0)
            for job in self.running
        ]
        waiting = [seconds(folder.cell, self._left[folder.cell.name]) + measuring for folder in self.waiting]
        return max([sum(running + waiting) / self.jobs, *running])

    def _say(self, text: str) -> None:
        print(f"[{_clock(time.monotonic() - self._begin)}] {text}", flush=True)


def _decisions_left(folder: CellFolder) -> int:
    if folder.state["trained"]:
        return 0
    checkpoint = folder.checkpoint()
    return folder.cell.timesteps - (checkpoint[1] if checkpoint else 0)


def _end_of(log: Path) -> str:
    return "the end of its log:\n" + "\n".join(log.read_text().splitlines()[-LOG_TAIL:])


def _clock(seconds: float) -> str:
    minutes = int(seconds) // 60
    return f"{minutes // 60}:{minutes % 60:02d}:{int(seconds) % 60:02d}"


@contextmanager
def _alone_in(root: Path) -> Iterator[None]:
    """Two grids that train the same cell would overwrite each other's files."""
    with (root / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SystemExit(f"Another grid runs in {root}: wait for it, or give another folder with --logs.") from error
        yield


def share_cores(jobs: int) -> dict[str, Any]:
    """
    :param jobs: children at the same time
    :return: environment variables that share the cores among them, for what the user has not set
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(max(1, cores // jobs)))}
