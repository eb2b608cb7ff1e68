"""What seeds add up to, against numbers computed by hand."""

import csv
import json
import math

import numpy as np
import pytest

from sb3_uspl.experiments.plan import Plan
from sb3_uspl.experiments.results import Results, collect, interquartile_mean, summarise, write_csv
from sb3_uspl.experiments.tables import markdown


@pytest.fixture(autouse=True)
def few_bootstraps(monkeypatch):
    monkeypatch.setattr("sb3_uspl.experiments.results.BOOTSTRAPS", 200)


@pytest.fixture(scope="module")
def plan():
    return Plan()


def test_summary_hand_computed():
    summary = summarise([90.0, 94.0, 98.0, 100.0], 5)
    assert summary.mean == pytest.approx(95.5)
    # Deviations -5.5, -1.5, 2.5, 4.5: squares 30.25 + 2.25 + 6.25 + 20.25 = 59, over n - 1 = 3.
    assert summary.deviation == pytest.approx(math.sqrt(59.0 / 3.0))
    assert summary.iqm == pytest.approx(96.0)  # without the lowest and the highest quarter: (94 + 98) / 2
    low, high = summary.interval
    assert 90.0 <= low < summary.iqm < high <= 100.0


def test_the_interval_is_the_same_every_time_and_leaves_the_global_generator_alone():
    np.random.seed(5)
    expected = np.random.uniform(size=3)
    np.random.seed(5)
    scores = np.random.default_rng(0).uniform(size=(5, 2))
    assert interquartile_mean(scores) == interquartile_mean(scores)
    np.testing.assert_array_equal(np.random.uniform(size=3), expected)


def test_one_seed_has_a_mean_and_nothing_more():
    summary = summarise([80.0], 3)
    assert summary.mean == summary.iqm == 80.0
    assert math.isnan(summary.deviation) and math.isnan(summary.interval[0])
    assert math.isnan(summarise([], 3).mean)


def test_the_interval_of_equal_seeds_is_a_point_and_tasks_are_strata():
    assert interquartile_mean(np.full((3, 1), 70.0)) == (70.0, (70.0, 70.0))
    # Every bootstrap sample holds both tasks equally often, so the interval is a point again.
    assert interquartile_mean(np.array([[0.0, 100.0], [0.0, 100.0]])) == (50.0, (50.0, 50.0))


def result_of(cell, success, privileged=None, seconds=2.0):
    """What ``measure`` would write."""
    measured = {
        "episodes": cell.episodes,
        "seed": 1_000_000,
        "success_rate": success,
        "success_interval": [success, success],
        "privileged_success_rate": privileged,
        **dict.fromkeys(("mean_return", "mean_length", "prediction_error_final", "divergence_mean"), 0.0),
    }
    return {
        "episodes": cell.episodes,
        "commit": "abc",
        "machine": {"processor": "P", "cores": 2},
        "training": {"wall_time": 9.0, "attempts": 1, "jobs": 1, "decisions": 10, "seconds_per_iteration": seconds},
        "models": {"best": measured, "last": {**measured, "success_rate": 0.0}},
    }


def write(results, cell, *arguments, **kwargs):
    results.folder.mkdir(exist_ok=True)
    results.path(cell).write_text(json.dumps(result_of(cell, *arguments, **kwargs)))


def test_a_table_beside_the_papers_numbers(plan, tmp_path):
    experiment, results = plan.experiments["table9"], Results(tmp_path / "raw")
    cells = plan.cells(experiment, experiment.envs, (1, 2), plan.budgets["cpu"])
    for cell in cells:
        if cell.variant == "uspl":
            write(results, cell, {1: 0.98, 2: 1.0}[cell.seed], privileged=1.0)
        elif cell.variant == "rma" and cell.seed == 1:
            write(results, cell, 0.5, privileged=0.9)
    summaries = collect(experiment, cells, results, (1, 2), "best")
    lines = markdown(plan, experiment, summaries, ["Nowhere-v0"]).splitlines()
    header, ours, paper = ([part.strip() for part in lines[i].strip("|").split("|")] for i in (0, 2, 3))
    ours, paper = dict(zip(header, ours, strict=True)), dict(zip(header, paper, strict=True))
    assert ours["USPL"].startswith("99.0 ± 1.4<br>99.0 (98.0-100.0)") and paper["USPL"] == "100.0 ± 0.0"
    assert ours["USPL-p"].startswith("100.0 ± 0.0") and paper["USPL-p"] == "100.0"
    assert ours["RMA"] == "50.0<br>1 of 2 seeds" and ours["RMA-p"] == "90.0<br>1 of 2 seeds"
    assert ours["RewReg"] == "not run" and paper["RewReg"] == "49.5 ± 0.6"
    assert lines[-1].startswith("| Nowhere-v0 | no such task yet")
    last = collect(experiment, cells, results, (1, 2), "last")
    assert last["ActiveTMaze-v0", "uspl"].mean == 0.0
    with_last = markdown(plan, experiment, summaries, ["Nowhere-v0"], last).splitlines()
    assert [*with_last[:3], *with_last[4:]] == lines
    assert with_last[3].startswith("|  | ours, last | not run |") and " 0.0 ± 0.0<br>0.0 (0.0-0.0) " in with_last[3]

    write_csv(tmp_path / "t.csv", plan, cells, results)
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert sum(row["model"] == "not run" for row in rows) == len(cells) - 3
    measured = [row for row in rows if (row["variant"], row["model"]) == ("uspl", "best")]
    assert [(row["seed"], row["success_rate"], row["wall_time"]) for row in measured] == [
        ("1", "0.98", "9.0"),
        ("2", "1.0", "9.0"),
    ]


def test_averages_are_of_complete_columns_only(plan, tmp_path):
    experiment, results = plan.experiments["table2"], Results(tmp_path)
    cells = plan.cells(experiment, experiment.envs, (1,), plan.budgets["cpu"])
    for i, cell in enumerate(cell for cell in cells if cell.variant == "uspl"):
        write(results, cell, 0.9 + 0.02 * i)
    for cell in cells[: len(experiment.columns)]:
        if cell.variant == "rma":
            write(results, cell, 0.3)
    lines = markdown(plan, experiment, collect(experiment, cells, results, (1,), "best")).splitlines()
    average = [part.strip() for part in lines[-2].strip("|").split("|")]
    assert average[:3] == ["average", "ours", "93.0"]  # 90, 92, 94, 96
    assert average[-1] == "1 of 4 rows run" and average[3] == "0 of 4 rows run"
    assert "| 98.2 |" in lines[-1]


def test_seconds_an_iteration(plan, tmp_path):
    experiment, results = plan.experiments["table8"], Results(tmp_path)
    cells = plan.cells(experiment, experiment.envs, (1,), plan.budgets["cpu"])
    for cell in cells:
        write(results, cell, 0.5, seconds=1.234)
    table = markdown(plan, experiment, collect(experiment, cells, results, (1,), "best"))
    assert table.count("1.23<br>1 seed") == 5 and "53.9" in table


def test_a_result_on_fewer_episodes_than_asked_for_does_not_count(plan, tmp_path):
    results = Results(tmp_path)
    cell = plan.cell("uspl", "LateralChoice-v0", 1, plan.budgets["cpu"])
    assert not results.has(cell)
    write(results, cell, 0.5)
    assert results.has(cell)
    more = type(cell)(**{**cell.to_json(), "episodes": cell.episodes + 1})
    assert more.name == cell.name and not results.has(more)
