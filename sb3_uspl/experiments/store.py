"""What a cell leaves on disk: configuration, attempts at the training with their checkpoints, wall times."""

import csv
import json
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_uspl.experiments.plan import Cell

CHECKPOINT = "rl_model_*_steps.zip"
CHECKPOINTS_PER_TRAINING = 20
_LAST_MEMBER = "system_info.txt"
"""What ``save`` of Stable-Baselines3 writes last."""
_STEPS = "time/total_timesteps"


@dataclass
class Attempt:
    """One run of the trainer, in the zoo's folder ``<train>/<algo>/<env>_<number>``."""

    path: Path
    number: int

    @property
    def first(self) -> int:
        """Decisions after which it continues another one; 0 if it begins at the beginning."""
        given = next(self.path.glob("*/args.yml"), None)
        # The zoo's file names Python's own classes.
        found = None if given is None else re.search(r"rl_model_(\d+)_steps", given.read_text())
        return int(found[1]) if found else 0


class CellFolder:
    """
    The folder of one cell.

    :param root: of all cells of a budget
    :param cell: whose folder it is
    """

    def __init__(self, root: Path, cell: Cell):
        self.cell = cell
        self.path = root / cell.name
        self.train = self.path / "train"
        self.config = self.path / "config.yml"
        self.spec = self.path / "cell.json"
        self.log = self.path / "log.txt"
        self._state = self.path / "state.json"

    def create(self) -> None:
        """Write the cell's configuration, for the trainer and for people."""
        self.path.mkdir(parents=True, exist_ok=True)
        self.config.write_text(yaml.safe_dump({self.cell.env: self.cell.hyperparameters}))
        self.spec.write_text(json.dumps(self.cell.to_json(), indent=1) + "\n")

    # -- what happened so far ----------------------------------------------------------------------------------------------

    @property
    def state(self) -> dict[str, Any]:
        """
        ``wall_times`` (s) of the attempts, ``jobs`` at the same time, ``commits`` of the code, and whether the training is
        ``trained`` to its end.
        """
        if not self._state.is_file():
            return {"wall_times": [], "jobs": [], "commits": [], "trained": False}
        return {"commits": [], **json.loads(self._state.read_text())}

    def add_attempt(self, wall_time: float, jobs: int, trained: bool, commit: str | None) -> None:
        """
        :param wall_time: s
        :param jobs: trainings that ran at the same time
        :param trained: whether the training reached its end
        :param commit: of its code
        """
        state = self.state
        state["wall_times"].append(wall_time)
        state["jobs"].append(jobs)
        state["commits"].append(commit)
        state["trained"] = trained
        self._state.write_text(json.dumps(state))

    def attempts(self) -> list[Attempt]:
        """:return: runs of the trainer, in the order of time"""
        found = (self.train / self.cell.algo).glob(f"{self.cell.env}_*")
        numbered = [Attempt(path, int(path.name.rsplit("_", 1)[1])) for path in found if path.name.rsplit("_", 1)[1].isdigit()]
        return sorted(numbered, key=lambda attempt: attempt.number)

    def decisions(self) -> int:
        """:return: decisions that the latest attempt has come to, those of the ones that it continues included"""
        attempts = self.attempts()
        rows = progress(attempts[-1].path) if attempts else []
        return max((int(float(row[_STEPS])) for row in rows if row.get(_STEPS)), default=0)

    # -- continuing --------------------------------------------------------------------------------------------------------

    def checkpoint(self) -> tuple[Path, int] | None:
        """:return: the latest whole checkpoint, and the decisions it was saved after"""
        saved = [(int(path.stem.split("_")[2]), path) for attempt in self.attempts() for path in attempt.path.glob(CHECKPOINT)]
        for steps, path in sorted(saved, reverse=True):
            if steps < self.cell.timesteps and _is_whole(path, _LAST_MEMBER):
                return path, steps
        return None

    def start_over(self) -> Path:
        """
        Put all attempts aside.

        :return: where they are now
        """
        number = len(list(self.path.glob("abandoned_*"))) + 1
        return self.train.rename(self.path / f"abandoned_{number}")

    def drop_checkpoints(self) -> None:
        """Delete what only a continued training needs."""
        for attempt in self.attempts():
            for path in attempt.path.glob(CHECKPOINT):
                path.unlink()

    # -- what the training showed ------------------------------------------------------------------------------------------

    def best_attempt(self) -> Attempt | None:
        """:return: the one whose best model had the highest reward of all in the evaluations during the training"""
        scored = []
        attempts = self.attempts()
        for i, attempt in enumerate(attempts):
            results = evaluations(attempt.path)
            if results is None or not (attempt.path / "best_model.zip").is_file():
                continue
            rewards = results["results"].mean(axis=1)
            # What an attempt did after the checkpoint that a later one continues has not happened.
            end = min((later.first for later in attempts[i + 1 :]), default=math.inf)
            if results["timesteps"][rewards.argmax()] <= end:
                scored.append((float(rewards.max()), -attempt.number, attempt))
        return max(scored)[2] if scored else None

    def learning_curve(self) -> dict[str, list[float]]:
        """:return: success of the deployment policy in the evaluations during the training, of all attempts put together"""
        curve: dict[int, tuple[float, float]] = {}
        for attempt in self.attempts():
            saved = evaluations(attempt.path)
            if saved is None:
                continue
            steps = saved["timesteps"].tolist()
            # As in ``best_attempt``.
            curve = {step: value for step, value in curve.items() if step <= attempt.first}
            success = saved["successes"].mean(axis=1) if "successes" in saved else np.full(len(steps), np.nan)
            curve |= dict(zip(steps, zip(success.tolist(), saved["results"].mean(axis=1).tolist(), strict=True), strict=True))
        return {
            "timesteps": list(curve),
            "success_rate": [success for success, _ in curve.values()],
            "reward": [reward for _, reward in curve.values()],
        }

    def seconds_per_iteration(self) -> float | None:
        """:return: rollout and updates, the training's evaluations included, on average over the latest attempt"""
        attempts = self.attempts()
        rows = [row for row in (progress(attempts[-1].path) if attempts else []) if row.get("time/iterations")]
        if not rows:
            return None
        return float(rows[-1]["time/time_elapsed"]) / float(rows[-1]["time/iterations"])


def progress(run: Path) -> list[dict[str, str]]:
    """
    :param run: folder of an attempt
    :return: rows of its ``progress.csv`` so far
    """
    path = run / "progress.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def evaluations(run: Path) -> dict[str, np.ndarray] | None:
    """
    :param run: folder of an attempt
    :return: its ``evaluations.npz``; None if there is none, or if it was being written when the attempt was killed
    """
    path = run / "evaluations.npz"
    if not _is_whole(path):
        return None
    with np.load(path) as data:
        return dict(data)


def _is_whole(path: Path, member: str | None = None) -> bool:
    """A zip file that was being written when its process was asked to end can be sound and lack its last members."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None and (member is None or member in file.namelist())
    except (OSError, zipfile.BadZipFile):
        return False
