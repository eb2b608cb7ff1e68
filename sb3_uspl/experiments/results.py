"""Raw results of the cells, and what seeds add up to."""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uspl.experiments.plan import PRIVILEGED_SUFFIX, Cell, Experiment, Plan, variant_of

BOOTSTRAPS = 2000
CONFIDENCE = 0.95
MODELS = ("best", "last")


class Results:
    """
    One JSON file (and one NPZ file of recorded episodes) a measured cell.

    :param folder: where they are
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def path(self, cell: Cell) -> Path:
        """
        :param cell: measured or not
        :return: its file
        """
        return self.folder / f"{cell.name}.json"

    def has(self, cell: Cell) -> bool:
        """
        :param cell: to look for
        :return: whether it was measured on at least as many episodes as asked for
        """
        return self.path(cell).is_file() and self.read(cell)["episodes"] >= cell.episodes

    def read(self, cell: Cell) -> dict[str, Any]:
        """
        :param cell: measured
        :return: what ``measure`` wrote
        """
        return json.loads(self.path(cell).read_text())

    def records(self, cell: Cell) -> dict[str, np.ndarray]:
        """
        :param cell: measured
        :return: recorded episodes, see ``recording``; empty for an algorithm without a belief
        """
        path = self.path(cell).with_suffix(".npz")
        if not path.is_file():
            return {}
        with np.load(path) as data:
            return dict(data)

    def measured(self, cells: Sequence[Cell]) -> list[tuple[Cell, dict[str, Any]]]:
        """
        :param cells: of a grid
        :return: those that have been measured, with their results
        """
        return [(cell, self.read(cell)) for cell in cells if self.has(cell)]


@dataclass
class Summary:
    """What the seeds of one variant in one environment add up to."""

    values: list[float]
    """One a seed that was run."""
    n_seeds: int
    """Seeds that were asked for."""
    mean: float = float("nan")
    deviation: float = float("nan")
    """Of a sample; nan for one seed."""
    iqm: float = float("nan")
    interval: tuple[float, float] = (float("nan"), float("nan"))
    """95 % stratified bootstrap interval of the interquartile mean; nan for one seed."""


def summarise(values: Sequence[float], n_seeds: int) -> Summary:
    """
    :param values: one a seed
    :param n_seeds: seeds that were asked for
    :return: mean, deviation, interquartile mean and its interval
    """
    summary = Summary(list(values), n_seeds)
    if values:
        summary.mean = float(np.mean(values))
        summary.iqm, summary.interval = interquartile_mean(np.asarray(values)[:, None])
    if len(values) > 1:
        summary.deviation = float(np.std(values, ddof=1))
    return summary


def interquartile_mean(scores: np.ndarray) -> tuple[float, tuple[float, float]]:
    """
    :param scores: ``(n_seeds, n_tasks)``
    :return: interquartile mean over seeds and tasks, and its 95 % bootstrap interval, stratified by task; nan for one seed
    """
    from rliable.library import get_interval_estimates
    from rliable.metrics import aggregate_iqm

    point = float(aggregate_iqm(scores))
    if len(scores) < 2:
        return point, (float("nan"), float("nan"))
    # rliable draws from NumPy's global generator, whatever random_state it is given; a table has to be the same every time.
    state = np.random.get_state()
    np.random.seed(0)
    try:
        _, intervals = get_interval_estimates(
            {"": scores},
            lambda sample: np.array([aggregate_iqm(sample)]),
            reps=BOOTSTRAPS,
            confidence_interval_size=CONFIDENCE,
        )
    finally:
        np.random.set_state(state)
    low, high = intervals[""][:, 0]
    return point, (float(low), float(high))


def value_of(result: dict[str, Any], column: str, kind: str, model: str) -> float | None:
    """
    :param result: of a cell
    :param column: of the experiment
    :param kind: "seconds" an iteration; of all others, success in %
    :param model: "best" or "last"
    :return: number for the table; None if it was not measured
    """
    if kind == "seconds":
        return result["training"]["seconds_per_iteration"]
    name = "privileged_success_rate" if column.endswith(PRIVILEGED_SUFFIX) else "success_rate"
    rate = result["models"][model][name]
    return None if rate is None else 100.0 * rate


def collect(
    experiment: Experiment, cells: Sequence[Cell], results: Results, seeds: Sequence[int], model: str
) -> dict[tuple[str, str], Summary]:
    """
    :param experiment: table
    :param cells: of its grid
    :param results: measured cells
    :param seeds: that were asked for
    :param model: "best" or "last"
    :return: by environment and column
    """
    values: dict[tuple[str, str], list[float]] = {}
    measured = results.measured(cells)
    for column in experiment.columns:
        for cell, result in measured:
            if cell.variant == variant_of(column):
                value = value_of(result, column, experiment.kind, model)
                values.setdefault((cell.env, column), []).extend([] if value is None else [value])
    envs = dict.fromkeys(cell.env for cell in cells)
    return {
        (env, column): summarise(values.get((env, column), []), len(seeds)) for env in envs for column in experiment.columns
    }


_CSV_COLUMNS = (
    *("variant", "label", "env", "seed", "model", "success_rate", "success_low", "success_high", "privileged_success_rate"),
    *("mean_return", "mean_length", "prediction_error_final", "divergence_mean", "episodes", "decisions", "wall_time"),
    *("seconds_per_iteration", "attempts", "jobs", "evaluation_seed", "configuration", "trained_at", "commit", "processor"),
    "cores",
)


def write_csv(path: Path, plan: Plan, cells: Sequence[Cell], results: Results) -> None:
    """
    One row a cell and model, unrun cells included.

    :param path: to write
    :param plan: for the labels
    :param cells: of a grid
    :param results: measured cells
    """
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, _CSV_COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        for cell in cells:
            row = {"variant": cell.variant, "label": plan.label(cell.variant), "env": cell.env, "seed": cell.seed}
            row["configuration"] = cell.configuration
            if not results.has(cell):
                writer.writerow({**row, "model": "not run"})
                continue
            result = results.read(cell)
            for model in MODELS:
                writer.writerow({**row, "model": model, **_flat(result, model)})


def _flat(result: dict[str, Any], model: str) -> dict[str, Any]:
    training, measured, machine = result["training"], result["models"][model], result["machine"]
    low, high = measured["success_interval"]
    same = ("success_rate", "privileged_success_rate", "mean_return", "mean_length", "prediction_error_final")
    return {
        **{name: measured[name] for name in (*same, "divergence_mean", "episodes")},
        "success_low": low,
        "success_high": high,
        "evaluation_seed": measured["seed"],
        "decisions": training["decisions"],
        "wall_time": round(training["wall_time"], 1),
        "seconds_per_iteration": training["seconds_per_iteration"],
        "attempts": training["attempts"],
        "jobs": training["jobs"],
        # Of results from before it was noted, the commit of the training is not known.
        "trained_at": " ".join(dict.fromkeys(map(str, training.get("commits", [])))),
        "commit": result["commit"],
        "processor": machine["processor"],
        "cores": machine["cores"],
    }
