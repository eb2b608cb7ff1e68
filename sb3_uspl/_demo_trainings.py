"""The demo's trainings: the zoo's trainer in child processes, all at the same time, watched through ``progress.csv``."""

import csv
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from sb3_uspl._configs import CONFIGS, load_entries

NAMES = {"uspl_ppo": "USPL", "rma": "RMA"}
EVAL_FREQ, EVAL_EPISODES, N_EVAL_ENVS = 50_000, 100, 25
"""Evaluations during training: every so many decisions, on so many episodes, in so many environments."""
REPORT_PERIOD, POLL_PERIOD = 10.0, 0.5
"""s between two progress lines, and between two looks at the children."""
STOP_TIMEOUT = 10.0
"""s that a child has to end before it is killed."""
LOG_TAIL = 15
"""Lines of a failed training's output to show."""
MARKER = "demo.json"
"""Beside the model of a training that the demo has seen to its end."""


@dataclass
class Training:
    """A finished training in the zoo's folder."""

    exp_id: int
    seed: int
    timesteps: int
    wall_time: float
    """s"""


class Trainings:
    """
    The trainings of one environment under ``<folder>/logs``, found again when the demo is called again.

    :param folder: of the demo
    :param env_id: environment
    :param seed: of the trainings
    :param timesteps: decisions of each training; None: as in ``zoo_configs/``
    """

    def __init__(self, folder: Path, env_id: str, seed: int, timesteps: int | None):
        self.folder, self.env_id, self.seed = folder, env_id, seed
        self.timesteps = {algo: timesteps or _configured_timesteps(algo, env_id) for algo in NAMES}

    def finished(self, algo: str) -> Training | None:
        """
        :param algo: zoo name
        :return: the latest training of this seed and length that was seen to its end
        """
        for marker in sorted(self._runs(algo), key=_exp_id, reverse=True):
            if (marker / MARKER).is_file():
                training = Training(**json.loads((marker / MARKER).read_text()))
                if (training.seed, training.timesteps) == (self.seed, self.timesteps[algo]):
                    return training
        return None

    def run_all(self, one_by_one: bool = False) -> None:
        """
        Train what is not finished yet.

        :param one_by_one: instead of all at the same time, for less memory
        :raises SystemExit: if a training fails; the others are stopped then, as after Ctrl-C
        """
        missing = []
        for algo, name in NAMES.items():
            training = self.finished(algo)
            if training is None:
                missing.append(algo)
            else:
                print(f"{name}: the training in {self.path(algo, training)} is finished and is used again.")
        self.folder.mkdir(parents=True, exist_ok=True)
        for group in [[algo] for algo in missing] if one_by_one else filter(None, [missing]):
            self._run(group)

    def _run(self, algos: list[str]) -> None:
        begin = time.monotonic()
        known = {algo: self._runs(algo) for algo in algos}
        files: list[IO[str]] = []
        children: dict[str, subprocess.Popen] = {}
        try:
            for algo in algos:
                log = self.folder / f"{algo}.log"
                print(f"{NAMES[algo]}: training for {self.timesteps[algo]:,} decisions, output in {log}", flush=True)
                files.append(log.open("w"))
                children[algo] = self._start(algo, files[-1])
            self._wait(children, known, begin)
        finally:
            _stop(children)
            for file in files:
                file.close()

    def path(self, algo: str, training: Training) -> Path:
        """
        :param algo: zoo name
        :param training: of this algorithm
        :return: its folder
        """
        return self.folder / "logs" / algo / f"{self.env_id}_{training.exp_id}"

    def _runs(self, algo: str) -> set[Path]:
        return set((self.folder / "logs" / algo).glob(f"{self.env_id}_*"))

    def _start(self, algo: str, log: IO[str]) -> subprocess.Popen:
        command = [sys.executable, "-m", "sb3_uspl.train", "--algo", algo, "--env", self.env_id, "--seed", str(self.seed)]
        command += ["-f", str(self.folder / "logs"), "-n", str(self.timesteps[algo]), "--eval-freq", str(EVAL_FREQ)]
        command += ["--eval-episodes", str(EVAL_EPISODES), "--n-eval-envs", str(N_EVAL_ENVS)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        # A session of its own: Ctrl-C reaches the demo only, and the zoo does not save a half-trained model.
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True)

    def _wait(self, children: Mapping[str, subprocess.Popen], known: Mapping[str, set[Path]], begin: float) -> None:
        running, next_report = dict(children), begin + REPORT_PERIOD
        while running:
            time.sleep(POLL_PERIOD)
            elapsed = time.monotonic() - begin
            for algo in [algo for algo, child in running.items() if child.poll() is not None]:
                status = running.pop(algo).returncode
                if status != 0:
                    log = self.folder / f"{algo}.log"
                    tail = "\n".join(log.read_text().splitlines()[-LOG_TAIL:])
                    raise SystemExit(
                        f"{tail}\n{NAMES[algo]}: the training failed (exit status {status}); above is the end of {log}. "
                        "Status -9 without a message means that memory ran out: --one-by-one needs half of it."
                    )
                run = max(self._runs(algo) - known[algo], key=_exp_id)
                training = Training(_exp_id(run), self.seed, self.timesteps[algo], elapsed)
                (run / MARKER).write_text(json.dumps(asdict(training)))
                print(f"[{clock(elapsed)}] {NAMES[algo]}: training finished")
            if running and begin + elapsed >= next_report:
                next_report += REPORT_PERIOD
                self._report(list(running), known, elapsed)

    def _report(self, running: list[str], known: Mapping[str, set[Path]], elapsed: float) -> None:
        parts, left = [], 0.0
        for algo in running:
            runs = self._runs(algo) - known[algo]
            last = last_values(max(runs, key=_exp_id) / "progress.csv") if runs else {}
            done = int(last.get("time/total_timesteps", 0))
            rates = [last.get(key, math.nan) for key in ("rollout/success_rate", "eval/success_rate")]
            pp, dp = ("  - " if math.isnan(rate) else f"{rate:4.0%}" for rate in rates)
            parts.append(f"{NAMES[algo]} {done:>9,} decisions, privileged {pp}, deployment {dp}")
            left = max(left, elapsed * (self.timesteps[algo] / done - 1.0) if done else math.inf)
        remaining = f"about {clock(left)} left" if math.isfinite(left) else "starting"
        print(f"[{clock(elapsed)}] {' | '.join(parts)} | {remaining}", flush=True)


def _configured_timesteps(algo: str, env_id: str) -> int:
    config = load_entries(CONFIGS / f"{algo}.yml")
    if env_id not in config:
        raise SystemExit(f"{CONFIGS}/{algo}.yml has no entry for {env_id}, only for {sorted(config)}.")
    return int(config[env_id]["n_timesteps"])


def _exp_id(run: Path) -> int:
    suffix = run.name.rsplit("_", 1)[1]
    return int(suffix) if suffix.isdigit() else 0


def _stop(children: Mapping[str, subprocess.Popen]) -> None:
    for child in children.values():
        if child.poll() is None:
            child.terminate()
    for child in children.values():
        try:
            child.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            child.kill()


def clock(seconds: float) -> str:
    """
    :param seconds: duration, s
    :return: minutes:seconds
    """
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def last_values(progress_csv: Path) -> dict[str, float]:
    """
    :param progress_csv: of a training that may be writing it at this moment
    :return: latest value of every metric logged so far
    """
    values: dict[str, float] = {}
    if progress_csv.is_file():
        with progress_csv.open() as file:
            for row in csv.DictReader(file):
                for key, text in row.items():
                    try:
                        values[key] = float(text)
                    except (TypeError, ValueError):  # empty, or a line that is being written
                        continue
    return values
