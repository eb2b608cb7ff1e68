"""Every experiment, trained for seconds: real trainings by the zoo's trainer, real evaluations, tables and pictures."""

import csv
import json
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

import matplotlib.figure  # noqa: F401 (imported before the forks, to be there in each)
import torch as th

import sb3_uspl._zoo  # noqa: F401 (first: importing the zoo patches Gymnasium)
from sb3_uspl.experiments import measure  # noqa: F401 (as matplotlib)
from sb3_uspl.experiments.__main__ import main
from sb3_uspl.experiments.plan import Cell, Plan
from sb3_uspl.experiments.recording import HIGH, LOW, episodes
from sb3_uspl.experiments.results import Results
from sb3_uspl.experiments.runner import Grid
from sb3_uspl.experiments.store import CellFolder, progress
from tests.sb3_uspl.experiments.forked import ForkedChild

PLAN = Plan()
ENV = "TargetReaching-v0"
TRAINED = ["uspl", "k_10", "rewreg", "resel_ppo", "recurrent_ppo"]
"""One of each kind; the others are for the slow test."""


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """A child would wait for ever for the threads that a fork leaves behind."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(threads)


def command(folder, experiments, *options):
    where = ["--output", str(folder / "docs"), "--logs", str(folder / "logs")]
    return [*experiments, "--budget", "smoke", *where, *options]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """All experiments, from a few trainings."""
    folder = tmp_path_factory.mktemp("experiments")
    assert main(command(folder, PLAN.experiments, "--envs", ENV, "--only", *TRAINED), start=ForkedChild) == 0
    return folder


def pages(folder):
    return folder / "docs" / "smoke"


@pytest.mark.parametrize("name", PLAN.experiments)
def test_every_experiment_leaves_a_page_a_csv_and_a_picture(folder, name):
    page = (pages(folder) / f"{name}.md").read_text()
    assert f"sb3_uspl.experiments {name} --budget smoke --seeds 1" in page and "![" in page
    assert (pages(folder) / f"{name}.png").stat().st_size > 5000
    rows = list(csv.DictReader((pages(folder) / f"{name}.csv").open()))
    unrun = {row["variant"] for row in rows if row["model"] == "not run"}
    assert unrun == {row["variant"] for row in rows} - set(TRAINED) and len(rows) > len(unrun)
    assert ("Not run: " in page) == bool(unrun)


def test_a_result_says_where_it_comes_from(folder):
    cells = [PLAN.cell(name, ENV, 1, PLAN.budgets["smoke"]) for name in TRAINED]
    results = Results(pages(folder) / "raw")
    for cell in cells:
        result = results.read(cell)
        assert result["seed"] == 1 and result["configuration"] == cell.configuration and result["machine"]["cores"] >= 1
        assert Cell(**result["cell"]) == cell
        training = result["training"]
        assert training["wall_time"] > 0.0 and training["attempts"] == 1 and training["decisions"] >= cell.timesteps
        assert result["learning_curve"]["timesteps"] == sorted(result["learning_curve"]["timesteps"])
        assert len(result["learning_curve"]["success_rate"]) >= 1
        for model in ("best", "last"):
            measured = result["models"][model]
            assert measured["episodes"] == cell.episodes and measured["seed"] >= 1_000_000
            has_privileged = cell.algo in ("uspl_ppo", "rma", "rewreg", "privrecons")
            assert (measured["privileged_success_rate"] is not None) == has_privileged


def test_recorded_episodes_show_the_uncertainty_that_was_chosen(folder):
    cell = PLAN.cell("uspl", ENV, 1, PLAN.budgets["smoke"])
    records = Results(pages(folder) / "raw").records(cell)
    step = episodes(records, "privileged, step")
    assert len(step) == len(episodes(records, "deployment")) == 8
    for episode in step:
        n = len(episode["shown"])
        switch = round(0.25 * 50)
        np.testing.assert_array_equal(episode["shown"], [HIGH if t < switch else LOW for t in range(n)])
        assert len(episode["position"]) == len(episode["std"]) == n
    assert all(np.isnan(episode["shown"]).all() for episode in episodes(records, "privileged, encoder's"))
    # Under the encoder's own uncertainty it is the privileged policy.
    for ours, same in zip(episodes(records, "privileged, encoder's"), episodes(records, "privileged"), strict=True):
        np.testing.assert_allclose(ours["position"], same["position"], atol=1e-5)


def test_nothing_is_trained_twice(folder):
    def refuse(arguments, log):
        raise AssertionError(arguments)

    before = {path: path.stat().st_mtime_ns for path in (pages(folder) / "raw").iterdir()}
    page = (pages(folder) / "table1.md").read_text()
    assert main(command(folder, ["table1", "table11"], "--envs", ENV, "--only", *TRAINED), start=refuse) == 0
    assert {path: path.stat().st_mtime_ns for path in (pages(folder) / "raw").iterdir()} == before
    assert (pages(folder) / "table1.md").read_text() == page


def test_the_maze_is_as_long_as_the_budget_says_in_training_and_evaluation(tmp_path):
    assert main(command(tmp_path, ["table9"], "--only", "uspl", "--jobs", "1"), start=ForkedChild) == 0
    (raw,) = (pages(tmp_path) / "raw").glob("*.json")
    result = json.loads(raw.read_text())
    assert result["models"]["last"]["mean_length"] == 5 + 3 and result["models"]["best"]["mean_length"] == 5 + 3
    assert "100.0 ± 0.0" in (pages(tmp_path) / "table9.md").read_text()  # the paper's


def test_a_killed_training_continues_where_its_checkpoint_was(tmp_path):
    short = PLAN.cell("uspl", ENV, 1, PLAN.budgets["smoke"])
    hyperparameters = {**short.hyperparameters, "n_timesteps": 1536, "warmup_timesteps": 512, "ramp_timesteps": 512}
    cell = Cell(**{**short.to_json(), "hyperparameters": hyperparameters})
    folder = CellFolder(tmp_path / "logs", cell)

    class Killed(ForkedChild):
        def poll(self):
            if folder.checkpoint() and folder.decisions() > 512:
                raise KeyboardInterrupt
            return super().poll()

    class Quiet(ForkedChild):
        pass

    children = []

    def start(arguments, log):
        children.append(Killed(arguments, log))
        return children[-1]

    grid = Grid([cell], tmp_path / "logs", Results(tmp_path / "raw"), 1, start)
    stop = grid._stop

    def stop_quietly():
        for child in children:
            child.__class__ = Quiet
        stop()

    grid._stop = stop_quietly
    with pytest.raises(KeyboardInterrupt):
        grid.run()
    assert children[0].poll() == -15
    _, saved = folder.checkpoint()
    assert 0 < saved < cell.timesteps
    results = Results(tmp_path / "raw")
    assert Grid([cell], tmp_path / "logs", results, 1, ForkedChild).run() == {}
    training = results.read(cell)["training"]
    assert training["attempts"] == 2 and cell.timesteps <= training["decisions"] < cell.timesteps + 256
    first, second = (progress(attempt.path) for attempt in folder.attempts())
    steps = [int(row["time/total_timesteps"]) for row in second if row["time/total_timesteps"]]
    assert steps[0] == saved + 128
    # The schedule goes on: a new warm-up would begin with a progress of 0.
    shown = [float(row["uspl/progress"]) for row in second if row["uspl/progress"]]
    assert shown and shown[0] > 0.0 and shown[-1] == 1.0
    assert max(float(row["uspl/progress"] or 0.0) for row in first) < 1.0


@pytest.mark.slow
def test_ablations_and_sweeps_train_too(folder):
    assert main(command(folder, PLAN.experiments, "--envs", ENV), start=ForkedChild) == 0
    for name in PLAN.experiments:
        assert "Not run" not in (pages(folder) / f"{name}.md").read_text()


def test_the_command_line_explains_itself():
    run = subprocess.run(
        [sys.executable, "-m", "sb3_uspl.experiments", "table1", "--envs", "Nowhere-v0", "--budget", "smoke"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 1 and "Nowhere-v0" in run.stderr and "LateralChoice-v0" in run.stderr
    assert "Traceback" not in run.stderr
