"""Pictures of a training and films of the deployment policy. Needs matplotlib (extra ``zoo``); never opens a window."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.typing import ColorType

from sb3_uspl.evaluation import EpisodeRecord, mean_over_time

BeliefInWorld = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""An environment's ``belief_in_world``: mean and standard deviation -> centre and half-widths on the map."""

# Okabe and Ito's colours, which colour-blind people tell apart.
PRIVILEGED_COLOUR, DEPLOYMENT_COLOUR, SIGMA_COLOUR, PROGRESS_COLOUR = "#0072B2", "#D55E00", "#9A5590", "#6B6B6B"
ALGORITHM_COLOURS = ("#009E73", "#E69F00", "#56B4E9", "#CC79A7")
_RAMP_COLOUR, _WARM_UP_COLOUR = "#FFF1CC", "#E8EEF4"
_DPI = 110
_LEAST_RUNNING = 0.05
"""Share of the episodes below which a mean over those still running says nothing."""
_STEPS, _PROGRESS = "time/total_timesteps", "uspl/progress"

_SUCCESS_CURVES = (
    ("rollout/success_rate", "privileged policy (training episodes)", PRIVILEGED_COLOUR),
    ("eval/success_rate", "deployment policy (evaluation episodes)", DEPLOYMENT_COLOUR),
)


def learning_curve(progress: Path | Sequence[Path] | Mapping[str, Path | Sequence[Path]], out_png: Path) -> None:
    """
    Success of both policies above uncertainty and progress coefficient, over decisions; one column an algorithm.

    Thin lines are seeds, thick ones their mean. RMA has the same progress coefficient, though nothing depends on it.

    :param progress: ``progress.csv`` of a training run, of several seeds, or either by algorithm
    :param out_png: picture to write
    :raises ValueError: if there is no file or one has no training in it
    """
    columns = progress if isinstance(progress, Mapping) else {"": progress}
    figure = Figure(figsize=(max(5.2 * len(columns), 6.4), 5.6), dpi=_DPI, layout="constrained")
    axes = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False)
    for (name, paths), (top, bottom) in zip(columns.items(), axes.T, strict=True):
        runs = [_read_progress(path) for path in ([paths] if isinstance(paths, Path) else paths)]
        if not runs:
            raise ValueError(f"No progress.csv was given for '{name}'.")
        top.set_title(name, fontweight="bold")
        for axis in (top, bottom):
            _shade_schedule(axis, runs[0], label=axis is top)
        for column, label, colour in _SUCCESS_CURVES:
            _plot_seeds(top, runs, column, label, colour, 100.0)
        _plot_seeds(bottom, runs, "uspl/uncertainty", r"mean $\sigma$, uncertainty of the encoder", SIGMA_COLOUR)
        _plot_seeds(bottom, runs, _PROGRESS, r"progress $\ell$", PROGRESS_COLOUR, dashes="--")
        top.set(ylim=(-3.0, 114.0), yticks=range(0, 101, 20))  # room above for the phases' names
        bottom.set_ylim(-0.02, 1.02)
        bottom.set_xlabel("decisions in training (thousands)")
    axes[0, 0].set_ylabel("success (%)")
    axes[1, 0].set_ylabel(r"mean $\sigma$ (privileged units), $\ell$ (-)")
    for row, corner in zip(axes, ("lower right", "center right"), strict=True):
        if row[0].get_legend_handles_labels()[0]:
            row[0].legend(loc=corner, fontsize="small", framealpha=0.95)
    figure.savefig(out_png)


def _read_progress(path: Path) -> pd.DataFrame:
    frame = pd.read_csv(path)
    if _STEPS not in frame or frame.empty:
        raise ValueError(f"{path} has no column '{_STEPS}' or no row: is it the progress.csv of a training run?")
    return frame.assign(**{_STEPS: frame[_STEPS] / 1000.0})


def _plot_seeds(
    axis: Axes, runs: Sequence[pd.DataFrame], column: str, label: str, colour: str, scale: float = 1.0, dashes: str = "-"
) -> None:
    """A column is logged in a part of the rows only."""
    curves = [run[[_STEPS, column]].dropna().to_numpy().T for run in runs if column in run]
    curves = [(x, scale * y) for x, y in curves if len(x)]
    if curves:
        dotted = column.startswith("eval/") or max(len(x) for x, _ in curves) == 1
        plot_seeds(axis, curves, colour, label, dashes, marker="o" if dotted else "")


def plot_seeds(
    axis: Axes,
    curves: Sequence[tuple[np.ndarray, np.ndarray]],
    colour: ColorType,
    label: str | None = None,
    dashes: str = "-",
    marker: str = "",
) -> None:
    """
    One thin line a seed and, thick, their mean where all have values.

    :param axis: to draw on
    :param curves: x and y of every seed, at least one; they need not have the same x
    :param colour: of all lines
    :param label: of the mean
    :param dashes: style of the lines
    :param marker: of the mean's points
    """
    if len(curves) > 1:
        for x, y in curves:
            axis.plot(x, y, dashes, color=colour, linewidth=0.7, alpha=0.5)
    first, last = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = np.unique(np.concatenate([x for x, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    mean = np.mean([np.interp(grid, x, y) for x, y in curves], axis=0)
    axis.plot(grid, mean, dashes, color=colour, linewidth=2.0, marker=marker, markersize=3.5, label=label)


def _shade_schedule(axis: Axes, run: pd.DataFrame, label: bool) -> None:
    """Warm-up (l = 0) and ramp (0 < l < 1), as the run itself logged them."""
    axis.set_xlim(0.0, run[_STEPS].max())
    axis.grid(alpha=0.25)
    if _PROGRESS not in run:
        return
    rows = run[[_STEPS, _PROGRESS]].dropna()
    warm = rows.loc[rows[_PROGRESS] <= 0.0, _STEPS]
    ramp = rows.loc[rows[_PROGRESS] < 1.0, _STEPS]
    begin, end = warm.max() if len(warm) else 0.0, ramp.max() if len(ramp) else 0.0
    regions = (
        (0.0, begin, _WARM_UP_COLOUR, " warm-up"),
        (begin, end, _RAMP_COLOUR, "\n ramp"),  # a line lower: both may be narrow
    )
    for left, right, colour, text in regions:
        if right > left:
            axis.axvspan(left, right, color=colour, zorder=0, linewidth=0)
            if label:
                axis.text(left, 1.0, text, transform=axis.get_xaxis_transform(), ha="left", va="top", alpha=0.7)


def on_map(
    belief_in_world: BeliefInWorld, mean: np.ndarray, std: np.ndarray, truth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """
    A belief and its error, drawn to the scale of the environment's map.

    :param belief_in_world: of the environment
    :param mean: ``(n_privileged,)``
    :param std: ``(n_privileged,)``
    :param truth: privileged observation, ``(n_privileged,)``
    :return: centre ``(2,)``, half-widths ``(2,)``, length of the half-widths and distance of the centre from the truth, m
    """
    centre, half_widths = belief_in_world(mean, std)
    true_centre, _ = belief_in_world(truth, np.zeros_like(std))
    return centre, half_widths, float(np.linalg.norm(half_widths)), float(np.linalg.norm(centre - true_centre))


def sigma_over_time(
    records: Mapping[str, Sequence[EpisodeRecord]],
    decision_period: float,
    out_png: Path,
    belief_in_world: BeliefInWorld | None = None,
) -> None:
    """
    The deployment policies' uncertainty and prediction error over an episode: mean and quartiles of the running episodes.

    :param records: episodes of the deployment policy by algorithm
    :param decision_period: s
    :param out_png: picture to write
    :param belief_in_world: of the environment, for metres on its map; None: units of the privileged observation
    """
    figure = Figure(figsize=(7.2, 6.4), dpi=_DPI, layout="constrained")
    sigma_axis, error_axis, running_axis = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1.4))
    for (name, episodes), colour in zip(records.items(), ALGORITHM_COLOURS, strict=False):
        sigmas, errors = zip(
            *(_belief_curves(record, belief_in_world) for record in episodes if record.belief_mean), strict=True
        )
        time = decision_period * np.arange(max(map(len, sigmas)))
        running = np.sum([len(curve) > np.arange(len(time)) for curve in sigmas], axis=0) / len(sigmas)
        shown = running >= _LEAST_RUNNING
        for axis, curves in ((sigma_axis, sigmas), (error_axis, errors)):
            low, high = (_quantile_over_time(curves, share) for share in (0.25, 0.75))
            axis.fill_between(time[shown], low[shown], high[shown], color=colour, alpha=0.18, linewidth=0)
            axis.plot(time[shown], mean_over_time(curves)[shown], color=colour, linewidth=2.0, label=name)
        running_axis.step(time, 100.0 * running, where="post", color=colour, linewidth=2.0)
    unit = "privileged units" if belief_in_world is None else "m"
    sigma_axis.set_title(
        "What the deployed robot believes: mean and quartiles of the episodes still running", fontsize="medium"
    )
    sigma_axis.set_ylabel(rf"uncertainty $\sigma$ ({unit})")
    error_axis.set_ylabel(f"|belief - truth| ({unit})")
    running_axis.set_ylabel("still\nrunning (%)")
    running_axis.set_xlabel("time in the episode (s)")
    sigma_axis.legend(loc="upper right")
    for axis in (sigma_axis, error_axis, running_axis):
        axis.set_ylim(bottom=0.0)
        axis.set_xlim(left=0.0)
        axis.grid(alpha=0.25)
    figure.savefig(out_png)


def _belief_curves(record: EpisodeRecord, belief_in_world: BeliefInWorld | None) -> tuple[np.ndarray, np.ndarray]:
    """Uncertainty and error at each decision."""
    if belief_in_world is None:
        return np.stack(record.belief_std).mean(axis=1), record.prediction_error
    steps = zip(record.belief_mean, record.belief_std, record.truth, strict=True)
    curves = np.array([on_map(belief_in_world, mean, std, truth)[2:] for mean, std, truth in steps])
    return curves[:, 0], curves[:, 1]


def _quantile_over_time(curves: Sequence[np.ndarray], share: float) -> np.ndarray:
    longest = max(map(len, curves))
    return np.array([np.quantile([c[t] for c in curves if len(c) > t], share) for t in range(longest)])
