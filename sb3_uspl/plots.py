"""
``python -m sb3_uspl.plots plot_train|all_plots|plot_from_file``: the zoo's plots of trainings, with its options.

Beyond the zoo's, they work with a single training, over which ``plot_from_file`` stumbles; ``plot_train`` can write its
picture to a file (``-o``); and ``all_plots`` prints success rates, which the zoo's table rounds to 0 or 1.
"""

import os
import pickle
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

try:
    import rl_zoo3.plots
    from matplotlib import pyplot as plt
except ImportError as error:  # pragma: no cover
    raise SystemExit(f'{error}. The plots need the zoo: pip install -e ".[zoo]"') from error

COMMANDS = ("plot_train", "all_plots", "plot_from_file")
_TABLE = "results_table"
_LAYOUT = "Trainings are looked for in <folder>/<algo>/<env>_<id>/, where <folder> is what -f names."


def plot_train() -> None:
    """
    Training curves from ``*.monitor.csv``; with ``-o FILE`` a picture instead of a window.

    :raises ValueError: if there is nothing to draw
    """
    out = _take_option("-o", "--output")
    if out is not None:
        plt.switch_backend("Agg")
    try:
        rl_zoo3.plots.plot_train()
    except FileNotFoundError as error:
        raise ValueError(f"There is no folder {error.filename}. {_LAYOUT}") from error
    if plt.get_fignums() and not plt.gca().lines:
        raise ValueError(f"There is nothing to draw: no training with as many episodes as -w says (100). {_LAYOUT}")
    if out is not None:
        plt.savefig(out)
        print(out)


def all_plots() -> None:
    """
    Evaluations of several trainings, algorithms and environments: curves, a table and, with ``-o NAME``, ``NAME.pkl``.

    :raises ValueError: if an environment has no evaluations with what was asked for
    """
    with tempfile.TemporaryDirectory() as folder:
        out = _option("-o", "--output")
        if out is None:
            out = os.path.join(folder, "results")
            sys.argv += ["-o", out]
        try:
            rl_zoo3.plots.all_plots()
        except KeyError as error:
            raise ValueError(f"{error} of -k: 'successes' needs environments that say info['is_success'].") from error
        except np.exceptions.AxisError as error:
            raise ValueError("The only training was evaluated on one episode at a time: --eval-episodes 2 or more.") from error
        path = Path(f"{out}.pkl")
        results = with_one_axis(pickle.loads(path.read_bytes()))
        path.write_bytes(pickle.dumps(results))
    print(_table(results, _option("-k", "--key") == "successes"))


def with_one_axis(results: dict[str, Any]) -> dict[str, Any]:
    """
    :param results: by environment and algorithm, as the zoo's ``all_plots`` stores them
    :return: the same, where the last evaluations of a single training are an array as well
    :raises ValueError: if an environment has no results
    """
    for env, algorithms in results.items():
        if env == _TABLE:
            continue
        if not algorithms:
            raise ValueError(f"No evaluations of {env}: at least two of a training are needed (--eval-freq). {_LAYOUT}")
        for entry in algorithms.values():
            entry["last_evals"] = np.atleast_1d(entry["last_evals"])
    return results


def _table(results: dict[str, Any], success: bool) -> str:
    lines = [f"last evaluation, mean of the trainings{' (success)' if success else ''}:"]
    for env, algorithms in results.items():
        for name, entry in algorithms.items() if env != _TABLE else ():
            scores = entry["last_evals"]
            mean, error = float(scores.mean()), float(entry["std_error_last_eval"])
            shown = f"{mean:.1%} ± {error:.1%}" if success else f"{mean:.4g} ± {error:.2g}"
            lines.append(f"  {env}  {name}: {shown} ({len(scores)} training{'s' if len(scores) > 1 else ''})")
    return "\n".join(lines)


def plot_from_file() -> None:
    """
    Curves and comparisons of what ``all_plots -o`` stored.

    :raises ValueError: if there is no such file
    """
    try:
        rl_zoo3.plots.plot_from_file()
    except FileNotFoundError as error:
        raise ValueError(
            f"There is no file {error.filename}: 'all_plots ... -o NAME' writes it, '-i NAME' reads it."
        ) from error


def _option(*names: str) -> str | None:
    argv = sys.argv
    return next((argv[i + 1] for i in range(1, len(argv) - 1) if argv[i] in names), None)


def _take_option(*names: str) -> str | None:
    """What follows an option, which is taken off the command line."""
    value = _option(*names)
    if value is not None:
        index = next(i for i, word in enumerate(sys.argv) if word in names)
        del sys.argv[index : index + 2]
    return value


def main() -> None:
    """Draw what the first word of the command line says."""
    if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
        raise SystemExit(
            f"usage: python -m sb3_uspl.plots {'|'.join(COMMANDS)} [the zoo's options], e.g. plot_train -a uspl_ppo "
            "-e LateralChoice-v0 -f logs -y success -o success.png"
        )
    command = sys.argv.pop(1)
    # Where there is no display, nothing is shown, which is no news.
    warnings.filterwarnings("ignore", message=".*is non-interactive, and thus cannot be shown")
    try:
        {"plot_train": plot_train, "all_plots": all_plots, "plot_from_file": plot_from_file}[command]()
    except ValueError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
