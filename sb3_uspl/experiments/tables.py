"""Markdown tables beside the paper's numbers."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sb3_uspl.experiments.plan import AVERAGE, Experiment, Plan
from sb3_uspl.experiments.results import Summary, interquartile_mean

NOT_RUN = "not run"
NOTES = {
    "success": (
        "Success in %: mean ± deviation over the seeds; below, the interquartile mean and its 95 % bootstrap interval "
        "(rliable). One seed has neither deviation nor interval. Every started episode counts, time-outs are failures."
    ),
    "seconds": (
        "Seconds an iteration (rollout, updates, and the training's own evaluations), mean ± deviation over the seeds. "
        "Only cells that ran on the same machine with as many others beside them can be compared: see the CSV."
    ),
}
Summaries = Mapping[tuple[str, str], Summary]
"""By environment and column."""


def markdown(
    plan: Plan, experiment: Experiment, summaries: Summaries, missing: Sequence[str] = (), last: Summaries | None = None
) -> str:
    """
    :param plan: for the labels
    :param experiment: table
    :param summaries: of our numbers
    :param missing: environments of the experiment that do not exist (yet)
    :param last: of the models at the trainings' ends, if the other numbers are not theirs
    :return: table, of every environment a row for our numbers, one for the last models' and one for the paper's
    """
    ours = {"ours": summaries} | ({"ours, last": last} if last is not None else {})
    envs = list(dict.fromkeys(env for env, _ in summaries))
    rows = [["", "", *(plan.label(column) for column in experiment.columns)], ["---"] * (2 + len(experiment.columns))]
    for env in envs:
        for name, those in ours.items():
            values = [_ours(those[env, column], experiment.kind) for column in experiment.columns]
            rows.append([env if name == "ours" else "", name, *values])
        rows.append(["", "paper", *(_paper(experiment, env, column) for column in experiment.columns)])
    if experiment.average and len(envs) > 1:
        for name, those in ours.items():
            averages = [_average(envs, those, column) for column in experiment.columns]
            rows.append(["average" if name == "ours" else "", name, *averages])
        complete = set(envs) == set(experiment.envs)
        paper = [_paper(experiment, AVERAGE, column) if complete else "" for column in experiment.columns]
        rows.append(["", "paper" if complete else "paper: other rows", *paper])
    rows += [[env, "no such task yet", *[""] * len(experiment.columns)] for env in missing]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _ours(summary: Summary, kind: str) -> str:
    n = len(summary.values)
    if n == 0:
        return NOT_RUN
    digits = 1 if kind == "success" else 2
    text = f"{summary.mean:.{digits}f}"
    if not math.isnan(summary.deviation):
        text += f" ± {summary.deviation:.{digits}f}"
    if not math.isnan(summary.interval[0]):
        low, high = summary.interval
        text += f"<br>{summary.iqm:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"
    if n < summary.n_seeds:
        text += f"<br>{n} of {summary.n_seeds} seeds"
    elif n == 1:
        text += "<br>1 seed"
    return text


def _paper(experiment: Experiment, env: str, column: str) -> str:
    value = experiment.paper.get(env, {}).get(column)
    return "" if value is None else str(value).replace("±", " ± ")


def _average(envs: Sequence[str], summaries: Summaries, column: str) -> str:
    """Over tasks, of those that are complete; the interval is stratified by task."""
    cells = [summaries[env, column] for env in envs]
    if any(not cell.values for cell in cells):
        return f"{sum(bool(cell.values) for cell in cells)} of {len(envs)} rows run"
    n = min(len(cell.values) for cell in cells)
    text = f"{np.mean([cell.mean for cell in cells]):.1f}"
    if n > 1:
        iqm, (low, high) = interquartile_mean(np.array([cell.values[:n] for cell in cells]).T)
        text += f"<br>{iqm:.1f} ({low:.1f}-{high:.1f})"
    return text
