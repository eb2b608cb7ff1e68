"""``python -m sb3_uspl.experiments``: train what is missing of a table or figure of the paper, measure it, and draw it."""

import argparse
import os
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_uspl.experiments.figures import RECORDED, SINGLE, Figures
from sb3_uspl.experiments.plan import Budget, Cell, Experiment, Plan, variant_of
from sb3_uspl.experiments.provenance import ROOT, commit
from sb3_uspl.experiments.results import MODELS, Results, collect, write_csv
from sb3_uspl.experiments.runner import Grid, Launch, launch, share_cores
from sb3_uspl.experiments.tables import NOTES, markdown

TABLE_KINDS = tuple(NOTES)
_STOPPED = "\nStopped. Nothing is lost: give the same command again to continue, or add --no-train to see what there is."


def parse_arguments(plan: Plan, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """
    :param plan: what can be asked for
    :param arguments: command line; None: the process's
    :return: parsed and checked
    """
    from sb3_uspl._zoo import EVALUATION_OFFSET

    parser = argparse.ArgumentParser(prog="python -m sb3_uspl.experiments", description=__doc__)
    parser.add_argument("experiments", nargs="+", choices=sorted(plan.experiments), metavar="experiment", help="table1, ...")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="of the trainings")
    parser.add_argument("--envs", nargs="+", help="instead of the experiment's own environments")
    parser.add_argument("--only", nargs="+", choices=sorted(plan.variants), metavar="VARIANT", help="train only these")
    parser.add_argument("--budget", choices=sorted(plan.budgets), default="cpu", help="how long to train and evaluate")
    parser.add_argument("--jobs", type=int, default=2, help="cells at the same time")
    parser.add_argument("--model", choices=MODELS, default="best", help="of the training's evaluations; the CSV has both")
    parser.add_argument("--no-train", action="store_true", help="show what there is")
    parser.add_argument(
        "--output", type=Path, help="tables, pictures and raw results; default: docs/results, for smoke the folder of the logs"
    )
    parser.add_argument("--logs", type=Path, default=Path("logs") / "experiments", help="trainings and checkpoints")
    given = parser.parse_args(arguments)
    if given.jobs < 1:
        parser.error(f"--jobs {given.jobs}: at least one cell has to run at a time.")
    # Those of the evaluations during the training begin there, those of the final one still higher.
    if min(given.seeds) < 0 or max(given.seeds) >= EVALUATION_OFFSET or len(set(given.seeds)) < len(given.seeds):
        parser.error(f"--seeds must be different numbers of at least 0 and below {EVALUATION_OFFSET}, got {given.seeds}.")
    if given.envs and len(set(given.envs)) < len(given.envs):
        parser.error(f"--envs must be different environments, got {given.envs}.")
    experiments = [plan.experiments[name] for name in given.experiments]
    there = {variant_of(column) for experiment in experiments for column in experiment.columns}
    if given.only and not set(given.only) <= there:
        parser.error(f"--only {sorted(set(given.only) - there)}: {given.experiments} consist of {sorted(there)}.")
    single = [experiment.name for experiment in experiments if experiment.kind in SINGLE]
    if single and (len(given.envs or []) > 1 or len(given.seeds) > 1):
        parser.error(f"{single} show one environment and one seed: give one with --envs and --seeds.")
    if given.output is None:
        # Nobody should take a smoke test's numbers for results.
        given.output = given.logs if given.budget == "smoke" else ROOT / "docs" / "results"
    return given


def main(arguments: Sequence[str] | None = None, start: Launch = launch) -> int:
    """
    :param arguments: command line; None: the process's
    :param start: starts a child
    :return: exit status: 1 if a cell failed
    """
    plan = Plan()
    given = parse_arguments(plan, arguments)
    budget = plan.budgets[given.budget]
    known = _registered()
    wrong = [env for env in given.envs or [] if env not in known]
    if wrong:
        ours = sorted({env for experiment in plan.experiments.values() for env in experiment.envs} & known)
        raise SystemExit(f"There are no environments {wrong}. Those of the experiments: {ours}.")
    os.environ.update(share_cores(given.jobs))
    results = Results(given.output / budget.name / "raw")
    experiments = [plan.experiments[name] for name in given.experiments]
    grids = {e.name: _cells(plan, e, given, budget, known) for e in experiments}
    failed: dict[str, str] = {}
    if not given.no_train:
        # A cell that two experiments share is one cell.
        cells = {cell.name: cell for grid in grids.values() for cell in grid}
        wanted = [cell for cell in cells.values() if given.only is None or cell.variant in given.only]
        failed = Grid(wanted, given.logs / budget.name, results, given.jobs, start).run()
    for experiment in experiments:
        missing = [] if given.envs else [env for env in experiment.envs if env not in known]
        _show(plan, experiment, grids[experiment.name], missing, results, given)
    for name, reason in failed.items():
        print(f"FAILED: {name}: {reason}")
    return 1 if failed else 0


def _registered() -> set[str]:
    import gymnasium

    import bullet_tasks  # noqa: F401 (registers the environments)
    import sb3_uspl  # noqa: F401 (the same)
    from sb3_uspl._zoo import is_ours

    return set(filter(is_ours, gymnasium.registry))


def _cells(plan: Plan, experiment: Experiment, given: argparse.Namespace, budget: Budget, known: set[str]) -> list[Cell]:
    envs = given.envs or [env for env in experiment.envs if env in known]
    return plan.cells(experiment, envs, given.seeds, budget)


def _show(
    plan: Plan, experiment: Experiment, cells: list[Cell], missing: list[str], results: Results, given: argparse.Namespace
) -> None:
    folder = given.output / given.budget
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / f"{experiment.name}.csv", plan, cells, results)
    at_end = "at the training's end"
    model = at_end
    if given.model == "best" or experiment.kind in RECORDED:
        model = "with the highest reward in the training's own evaluations"
    figures, picture = Figures(plan, results, given.model), folder / f"{experiment.name}.png"
    if experiment.kind in TABLE_KINDS:
        summaries = collect(experiment, cells, results, given.seeds, given.model)
        last = None
        if experiment.kind == "success" and given.model != "last":
            last = collect(experiment, cells, results, given.seeds, "last")
            model += f' ("last": {at_end})'
        body = [markdown(plan, experiment, summaries, missing, last), "", NOTES[experiment.kind]]
        drawn = figures.bars(experiment, summaries, picture)
    else:
        drawn = figures.draw(experiment, cells, picture)
        body = [f"No such task yet: {env}." for env in missing]
    unrun = [cell for cell in cells if not results.has(cell)]
    text = [
        f"# {experiment.title}",
        "",
        f"Budget `{given.budget}`, seeds {', '.join(map(str, given.seeds))}, the model {model}; "
        f"{len(cells) - len(unrun)} of {len(cells)} cells run. Every cell: [{experiment.name}.csv]({experiment.name}.csv).",
        "",
        *([f"![{experiment.title}]({picture.name})"] if drawn else ["Nothing to draw yet."]),
        "",
        *body,
        "",
        *([f"Not run: {', '.join(_in_words(plan, cell) for cell in unrun)}.", ""] if unrun else []),
        f"Made with `{_command(experiment, given)}` at commit `{commit()}`; the cells' own commits are in the CSV.",
    ]
    page = folder / f"{experiment.name}.md"
    page.write_text("\n".join(text) + "\n")
    print(f"\n{page}\n" + ("\n".join(body) if body else f"{picture}" if drawn else "nothing to draw yet"))


def _in_words(plan: Plan, cell: Cell) -> str:
    return f"{plan.label(variant_of(cell.variant))} {cell.env} seed {cell.seed}"


def _command(experiment: Experiment, given: argparse.Namespace) -> str:
    parts = ["python", "-m", "sb3_uspl.experiments", experiment.name, "--budget", given.budget]
    parts += ["--seeds", *map(str, given.seeds), "--model", given.model]
    if given.envs:
        parts += ["--envs", *given.envs]
    return shlex.join(parts)


if __name__ == "__main__":
    # As after Ctrl-C: the children, which do not hear a terminal's signals, have to be ended.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        raise SystemExit(_STOPPED) from None
