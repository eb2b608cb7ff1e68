"""Pictures of tables, trainings and recorded episodes."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_uspl.evaluation import mean_over_time
from sb3_uspl.experiments.plan import Cell, Experiment, Plan, variant_of
from sb3_uspl.experiments.recording import episodes
from sb3_uspl.experiments.results import Results, Summary
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR, SIGMA_COLOUR, plot_seeds

DPI = 110
PANEL = (4.4, 3.2)
"""inches"""
PATH_EPISODES, BELIEF_EPISODES = 8, 3
_LIMIT = "#6B6B6B"
SINGLE = ("belief", "forced")
"""Kinds of figures that show one environment and one seed."""
RECORDED = ("paths", *SINGLE)
"""Kinds of figures that show recorded episodes, which are always the best model's."""


class Figures:
    """
    Draws experiments from what their cells measured.

    :param plan: for the labels
    :param results: measured cells
    :param model: "best" or "last", where the figure is not one of ``RECORDED``
    """

    def __init__(self, plan: Plan, results: Results, model: str = "best"):
        self.plan, self.results, self.model = plan, results, model
        self._colours = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]

    def draw(self, experiment: Experiment, cells: Sequence[Cell], path: Path) -> bool:
        """
        :param experiment: figure
        :param cells: of its grid
        :param path: picture to write
        :return: whether any of the cells has been measured, so that there was something to draw
        """
        measured = self.results.measured(cells)
        if not measured:
            return False
        draw: dict[str, Callable[[Experiment, Any, Path], None]] = {
            "learning": self._learning,
            "divergence": self._divergence,
            "paths": self._paths,
            "belief": self._belief,
            "forced": self._forced,
        }
        draw[experiment.kind](experiment, measured, path)
        return True

    def bars(self, experiment: Experiment, summaries: dict[tuple[str, str], Summary], path: Path) -> bool:
        """
        :param experiment: table
        :param summaries: by environment and column
        :param path: picture to write: means with deviations, and the paper's means as black marks
        :return: whether there was something to draw
        """
        if not any(summary.values for summary in summaries.values()):
            return False
        envs = list(dict.fromkeys(env for env, _ in summaries))
        figure, axes = _panels(len(envs))
        for env, axis in zip(envs, axes, strict=True):
            for i, column in enumerate(experiment.columns):
                summary = summaries[env, column]
                if summary.values:
                    deviation = 0.0 if np.isnan(summary.deviation) else summary.deviation
                    axis.bar(i, summary.mean, color=self._colours[i % 10], yerr=deviation or None, capsize=3)
                else:
                    axis.text(i, 0.0, "not run", rotation=90, ha="center", va="bottom", fontsize="x-small", color=_LIMIT)
                paper = str(experiment.paper.get(env, {}).get(column, "")).split("±")[0]
                if paper and experiment.kind == "success":
                    axis.plot([i - 0.4, i + 0.4], [float(paper)] * 2, color="black", linewidth=1.5)
            axis.set_xticks(range(len(experiment.columns)))
            axis.set_xticklabels([self.plan.label(c) for c in experiment.columns], rotation=60, ha="right", fontsize="x-small")
            axis.set_title(env, fontsize="small")
            axis.set(xlim=(-0.6, len(experiment.columns) - 0.4), ylim=(0.0, None))
            if experiment.kind == "success":
                axis.set(ylabel="success (%), paper: black", ylim=(0.0, 108.0))
            else:
                axis.set_ylabel("s an iteration")
        figure.savefig(path)
        return True

    # -- one a kind --------------------------------------------------------------------------------------------------------

    def _learning(self, experiment: Experiment, measured: list[tuple[Cell, dict]], path: Path) -> None:
        figure, axes = _panels(len(_envs(measured)))
        for env, axis in zip(_envs(measured), axes, strict=True):
            for i, column in enumerate(experiment.columns):
                curves = [result["learning_curve"] for cell, result in measured if (cell.env, cell.variant) == (env, column)]
                curves = [
                    (np.array(curve["timesteps"]) / 1000.0, 100.0 * np.array(curve["success_rate"]))
                    for curve in curves
                    if curve["timesteps"]
                ]
                if curves:
                    marker = "o" if min(len(steps) for steps, _ in curves) < 3 else ""
                    plot_seeds(axis, curves, self._colours[i % 10], self.plan.label(column), marker=marker)
            axis.set(title=env, xlabel="decisions in training (thousands)", ylabel="success (%)", ylim=(-3.0, 103.0))
        _legend(figure, axes)
        figure.savefig(path)

    def _divergence(self, experiment: Experiment, measured: list[tuple[Cell, dict]], path: Path) -> None:
        figure, axes = _panels(len(_envs(measured)))
        for env, axis in zip(_envs(measured), axes, strict=True):
            error_axis = axis.twinx()
            for i, column in enumerate(experiment.columns):
                shown = [result for cell, result in measured if (cell.env, cell.variant) == (env, variant_of(column))]
                models = [result["models"][self.model] for result in shown]
                for name, target, dashes in (
                    ("divergence_over_time", axis, "-"),
                    ("prediction_error_over_time", error_axis, "--"),
                ):
                    curves = [np.array(model[name]) for model in models if model[name]]
                    if curves:
                        label = self.plan.label(column) if target is axis else None
                        target.plot(mean_over_time(curves), dashes, color=self._colours[i % 10], label=label)
            axis.set(title=env, xlabel="decision", ylabel="distance of the robots (m, solid)")
            axis.set_ylim(bottom=0.0)
            error_axis.set_ylabel("prediction error (dashed)")
            error_axis.set_ylim(bottom=0.0)
        _legend(figure, axes)
        figure.savefig(path)

    def _paths(self, experiment: Experiment, measured: list[tuple[Cell, dict]], path: Path) -> None:
        cells = _first_of_each(experiment, measured)
        figure, axes = _panels(len(cells))
        policies = (("privileged", PRIVILEGED_COLOUR), ("deployment", DEPLOYMENT_COLOUR))
        for cell, axis in zip(cells, axes, strict=True):
            records = self.results.records(cell)
            period = float(records["decision_period"])
            for policy, colour in policies:
                for i, episode in enumerate(episodes(records, policy)[:PATH_EPISODES]):
                    x = episode["position"][:, 0]
                    axis.plot(period * np.arange(len(x)), x, color=colour, alpha=0.6, label=policy if i == 0 else None)
            axis.set(title=f"{self.plan.label(cell.variant)}, {cell.env}", xlabel="time (s)", ylabel="x")
        _legend(figure, axes)
        figure.savefig(path)

    def _belief(self, experiment: Experiment, measured: list[tuple[Cell, dict]], path: Path) -> None:
        cell = _first_of_each(experiment, measured)[0]
        records = self.results.records(cell)
        shown = episodes(records, "deployment")[:BELIEF_EPISODES]
        figure = Figure(figsize=(PANEL[0] * len(shown), 2.0 * PANEL[1]), dpi=DPI, layout="constrained")
        rows = figure.subplots(2, len(shown), squeeze=False, sharex="col")
        period = float(records["decision_period"])
        for episode, (above, below) in zip(shown, rows.T, strict=True):
            time = period * np.arange(len(episode["position"]))
            for name, coordinate in zip("xyz", episode["position"].T, strict=False):
                above.plot(time, coordinate, label=name)
            _draw_belief(below, time, episode)
            above.set_title("success" if episode["success"] else "no success", fontsize="small")
            below.set_xlabel("time (s)")
        rows[0, 0].set_ylabel("the robot's position")
        rows[1, 0].set_ylabel(r"belief: mean $\pm$ $\sigma$, truth dashed")
        rows[0, 0].legend(fontsize="x-small")
        figure.suptitle(f"{experiment.title}: {cell.env}, seed {cell.seed}", fontsize="medium")
        figure.savefig(path)

    def _forced(self, experiment: Experiment, measured: list[tuple[Cell, dict]], path: Path) -> None:
        cell = _first_of_each(experiment, measured)[0]
        records = self.results.records(cell)
        groups = [key.split("/")[0] for key in records if key.endswith("/0/shown")]
        figure = Figure(figsize=(PANEL[0] * len(groups), 2.0 * PANEL[1]), dpi=DPI, layout="constrained")
        rows = figure.subplots(2, len(groups), squeeze=False, sharex=True, sharey="row")
        period = float(records["decision_period"])
        for group, (above, below) in zip(groups, rows.T, strict=True):
            for episode in episodes(records, group):
                time = period * np.arange(len(episode["position"]))
                above.plot(time, _signal(episode["position"]), color=PRIVILEGED_COLOUR, alpha=0.6)
                encoder = episode["std"].mean(axis=1)
                below.plot(time, encoder, color=SIGMA_COLOUR, alpha=0.35)
                below.plot(time, np.where(np.isnan(episode["shown"]), encoder, episode["shown"]), color="black", linewidth=1.0)
            above.set_title(group, fontsize="small")
            below.set_xlabel("time (s)")
        rows[0, 0].set_ylabel(_signal_name(episodes(records, groups[0])[0]["position"]))
        rows[1, 0].set_ylabel(r"$\sigma$: shown (black), the encoder's")
        figure.suptitle(f"{experiment.title}: {cell.env}, seed {cell.seed}", fontsize="medium")
        figure.savefig(path)


def _panels(n: int) -> tuple[Figure, list[Axes]]:
    columns = min(n, 3)
    rows = -(-n // columns)
    figure = Figure(figsize=(max(PANEL[0] * columns, 6.4), PANEL[1] * rows), dpi=DPI, layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes[n:]:
        axis.remove()
    for axis in axes[:n]:
        axis.grid(alpha=0.25)
    return figure, axes[:n]


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """One for all panels, below them: a line may be in some of them only."""
    handles = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 8), fontsize="small")


def _envs(measured: list[tuple[Cell, dict]]) -> list[str]:
    return list(dict.fromkeys(cell.env for cell, _ in measured))


def _first_of_each(experiment: Experiment, measured: list[tuple[Cell, dict]]) -> list[Cell]:
    """The first measured seed of every column, in their order."""
    cells: dict[tuple[str, str], Cell] = {}
    for cell, _ in measured:
        cells.setdefault((cell.env, cell.variant), cell)
    order = {variant_of(column): i for i, column in enumerate(experiment.columns)}
    return [cells[key] for key in sorted(cells, key=lambda key: (key[0], order[key[1]]))]


def _draw_belief(axis: Axes, time: np.ndarray, episode: dict[str, np.ndarray]) -> None:
    """On the map if the task has one with a place for all dimensions, else in privileged units."""
    on_map = "map_centre" in episode and episode["map_centre"].shape[1] == episode["mean"].shape[1]
    centre, width = (episode["map_centre"], episode["map_half_widths"]) if on_map else (episode["mean"], episode["std"])
    truth = episode["map_truth"] if on_map else episode["truth"][0]
    for dim in range(centre.shape[1]):
        line = axis.plot(time, centre[:, dim])[0]
        axis.fill_between(
            time, centre[:, dim] - width[:, dim], centre[:, dim] + width[:, dim], color=line.get_color(), alpha=0.2
        )
        axis.axhline(truth[dim], color=line.get_color(), linestyle="--", linewidth=1.0)
    axis.grid(alpha=0.25)


def _signal(position: np.ndarray) -> np.ndarray:
    """What the chosen uncertainty should move: the altitude of what flies, else how far the robot has come."""
    return position[:, 2] if position.shape[1] > 2 else np.linalg.norm(position - position[0], axis=1)


def _signal_name(position: np.ndarray) -> str:
    return "altitude (m)" if position.shape[1] > 2 else "distance from the start"
