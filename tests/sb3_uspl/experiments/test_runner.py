"""A grid whatever happens to it: cells are trained once, go on where they stopped, and do not hold each other up."""

import json
import math
import re
import signal
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sb3_uspl.experiments.plan import Cell, Plan
from sb3_uspl.experiments.results import Results, collect
from sb3_uspl.experiments.runner import Grid, share_cores
from sb3_uspl.experiments.store import CellFolder
from sb3_uspl.experiments.tables import markdown
from tests.sb3_uspl.experiments.test_results import result_of


class FakeChild:
    """Has ended, or goes on until it is told to end."""

    def __init__(self, status):
        self.status, self.signals = status, []

    def poll(self):
        return self.status

    def send_signal(self, signum):
        self.signals.append(signum)
        self.status = -signum

    def wait(self, timeout=None):
        return self.poll()


class FakeMachine:
    """Trains and measures at once, without learning anything; ``events`` says what to do otherwise, by start."""

    def __init__(self, events=None):
        self.events, self.started, self.children = events or {}, [], []

    def __call__(self, arguments, log):
        event = self.events.get(len(self.started), "work")
        self.started.append(arguments)
        if event == "interrupt":
            raise KeyboardInterrupt
        if event != "refuse":
            self._work(arguments, {"half": 0.5, "hang": 0.5, "late": 1.1}.get(event, 1.0))
        child = FakeChild({"half": 1, "refuse": 1, "hang": None, "late": None}.get(event, 0))
        self.children.append(child)
        return child

    def _work(self, arguments, share):
        if arguments[0] == "sb3_uspl.experiments.measure":
            folder, target = map(Path, arguments[1:])
            cell = Cell(**json.loads((folder / "cell.json").read_text()))
            target.parent.mkdir(parents=True, exist_ok=True)
            success = 0.1 * cell.seed + 0.01 * len(cell.variant)
            target.write_text(json.dumps(result_of(cell, success, privileged=1.0)))
            return
        given = {name: arguments[arguments.index(name) + 1] for name in ("--algo", "--env", "-f", "-n")}
        first = int(re.search(r"rl_model_(\d+)_", arguments[arguments.index("-i") + 1])[1]) if "-i" in arguments else 0
        runs = Path(given["-f"]) / given["--algo"]
        run = runs / f"{given['--env']}_{1 + len(list(runs.glob('*')))}"
        run.mkdir(parents=True)
        steps = first + int(share * int(given["-n"]))
        header = "time/total_timesteps,time/iterations,time/time_elapsed"
        (run / "progress.csv").write_text(f"{header}\n{steps},1,2\n")
        with zipfile.ZipFile(run / f"rl_model_{steps}_steps.zip", "w") as file:
            for member in ("data", "system_info.txt"):
                file.writestr(member, "x")

    def trainings(self):
        return [arguments for arguments in self.started if arguments[0] == "sb3_uspl.train"]


PLAN = Plan()
EXPERIMENT, SEEDS = PLAN.experiments["table2"], (1, 2)


@pytest.fixture
def cells():
    return PLAN.cells(EXPERIMENT, ["TargetReaching-v0"], SEEDS, PLAN.budgets["smoke"])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("sb3_uspl.experiments.runner.POLL_PERIOD", 0.0)
    monkeypatch.setattr("sb3_uspl.experiments.results.BOOTSTRAPS", 10)


def run(folder, cells, machine, jobs=2):
    results = Results(folder / "raw")
    failed = Grid(cells, folder / "logs", results, jobs, machine).run()
    return results, failed


def table(cells, results):
    return markdown(PLAN, EXPERIMENT, collect(EXPERIMENT, cells, results, SEEDS, "best"))


def test_a_finished_grid_is_never_repeated(tmp_path, cells):
    machine = FakeMachine()
    results, failed = run(tmp_path, cells, machine)
    assert not failed and all(results.has(cell) for cell in cells)
    assert len(machine.trainings()) == len(cells) == 14 and len(machine.started) == 28
    again = FakeMachine()
    run(tmp_path, cells, again)
    assert again.started == []


@pytest.mark.parametrize("moment", [0, 5, 6, 22])
def test_an_interrupted_grid_resumes_to_the_same_table(tmp_path, cells, moment):
    expected, _ = run(tmp_path / "at once", cells, FakeMachine())
    first, second = FakeMachine({moment: "interrupt"}), FakeMachine()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "twice", cells, first)
    results, failed = run(tmp_path / "twice", cells, second)
    assert not failed
    text = table(cells, results)
    assert text == table(cells, expected) and "not run" not in text
    # What had been started before the interruption is not trained a second time.
    repeated = {tuple(a) for a in first.trainings()[:-1]} & {tuple(a) for a in second.trainings()}
    assert len(repeated) <= 2  # at most the jobs that ran


def test_a_broken_training_continues_from_its_checkpoint(tmp_path, cells):
    cell = cells[0]
    results, failed = run(tmp_path, [cell], FakeMachine({0: "half"}), jobs=1)
    assert list(failed) == [cell.name] and not results.has(cell)
    machine = FakeMachine()
    _, failed = run(tmp_path, [cell], machine, jobs=1)
    assert not failed and results.has(cell)
    (training,) = machine.trainings()
    half = cell.timesteps // 2
    assert training[training.index("-i") + 1].endswith(f"_1/rl_model_{half}_steps.zip")
    assert int(training[training.index("-n") + 1]) == cell.timesteps - half
    folder = CellFolder(tmp_path / "logs", cell)
    assert len(folder.state["wall_times"]) == 2 and folder.state["trained"]
    assert not list(folder.path.rglob("rl_model*"))  # only a continued training needs them


def test_a_training_that_cannot_continue_starts_again_and_says_so(tmp_path, cells, capsys):
    cell = cells[0]
    run(tmp_path, [cell], FakeMachine({0: "half"}), jobs=1)
    machine = FakeMachine({0: "refuse"})
    results, failed = run(tmp_path, [cell], machine, jobs=1)
    assert not failed and results.has(cell)
    assert ["-i" in training for training in machine.trainings()] == [True, False]
    assert "could not continue" in capsys.readouterr().out
    assert (tmp_path / "logs" / cell.name / "abandoned_1").is_dir()


def test_a_half_written_checkpoint_is_left_out(tmp_path, cells):
    cell = cells[0]
    run(tmp_path, [cell], FakeMachine({0: "half"}), jobs=1)
    folder = CellFolder(tmp_path / "logs", cell)
    whole, steps = folder.checkpoint()
    (whole.parent / f"rl_model_{steps + 1}_steps.zip").write_bytes(whole.read_bytes()[:-9])
    with zipfile.ZipFile(whole.parent / f"rl_model_{steps + 2}_steps.zip", "w") as closed_too_early:
        closed_too_early.writestr("data", "x")
    assert folder.checkpoint() == (whole, steps)


def test_a_training_that_ends_early_without_an_error_is_not_finished(tmp_path, cells):
    """As the zoo does when it is interrupted."""

    class Early(FakeMachine):
        def __call__(self, arguments, log):
            super().__call__(arguments, log)
            return FakeChild(0)

    _, failed = run(tmp_path, [cells[0]], Early({0: "half"}), jobs=1)
    assert list(failed) == [cells[0].name]
    assert not CellFolder(tmp_path / "logs", cells[0]).state["trained"]


def test_a_failed_cell_does_not_hold_up_the_others(tmp_path, cells, capsys):
    results, failed = run(tmp_path, cells, FakeMachine({0: "refuse"}))
    assert list(failed) == [cells[0].name] and all(results.has(cell) for cell in cells[1:])
    assert "FAILED" in capsys.readouterr().out and "not run" not in table(cells[1:], results)


def test_ctrl_c_ends_the_children_and_keeps_their_wall_times(tmp_path, cells):
    machine = FakeMachine({0: "hang", 1: "hang"})
    grid = Grid(cells, tmp_path / "logs", Results(tmp_path / "raw"), 2, machine)

    def press(*_):
        raise KeyboardInterrupt

    grid._report = press
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_uspl.experiments.runner.REPORT_PERIOD", 0.0)
        grid.run()
    assert [child.signals for child in machine.children] == [[signal.SIGTERM]] * 2
    for cell in cells[:2]:
        state = CellFolder(tmp_path / "logs", cell).state
        assert len(state["wall_times"]) == 1 and not state["trained"]


def test_no_time_is_left_where_the_last_rollout_goes_past_the_end(tmp_path, cells, capsys):
    grid = Grid(cells[:1], tmp_path / "logs", Results(tmp_path / "raw"), 1, FakeMachine({0: "late"}))
    report = grid._report

    def report_and_press(*_):
        grid._begin -= 1000.0  # s
        report()
        raise KeyboardInterrupt

    grid._report = report_and_press
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_uspl.experiments.runner.REPORT_PERIOD", 0.0)
        grid.run()
    assert "about 0:00:00 left" in capsys.readouterr().out


def test_the_time_left_counts_every_cell_at_its_own_speed(tmp_path):
    budget = PLAN.budgets["smoke"]
    slow, fast, neither = (
        PLAN.cell("uspl", env, 2, budget) for env in ("ActiveTMaze-v0", "TargetReaching-v0", "LateralChoice-v0")
    )
    other = PLAN.cell("resel_ppo", "TargetReaching-v0", 2, budget)
    grid = Grid([slow, fast, neither, other], tmp_path / "logs", Results(tmp_path / "raw"), 2, FakeMachine())
    assert grid._seconds_left([], {}) == math.inf
    grid._trained, grid._measuring_times = [(slow, 300.0, 100), (fast, 10.0, 100)], [1.0, 3.0]
    expected = 256 * (3.0 + 0.1 + 310.0 / 200 + 0.1) + 4 * 2.0
    assert grid._seconds_left([], {}) == pytest.approx(expected / 2)
    # What has been trained already needs to be measured only; what has a checkpoint, the rest.
    folder = CellFolder(tmp_path / "logs", slow)
    folder.create()
    folder.add_attempt(1.0, 1, True, "c0ffee")
    again = Grid([slow], tmp_path / "logs", Results(tmp_path / "raw"), 1, FakeMachine())
    again._measuring_times = [2.0]
    assert again._seconds_left([], {}) == 2.0


def test_what_was_done_after_the_checkpoint_that_is_continued_has_not_happened(tmp_path, cells):
    folder = CellFolder(tmp_path, cells[0])
    # Evaluations at these decisions had these rewards; the second attempt continues after 20,000 decisions.
    attempts = {1: ({10_000: 1.0, 20_000: 2.0, 30_000: 9.0}, ""), 2: ({29_000: 3.0, 39_000: 1.0}, "rl_model_20000_steps.zip")}
    for number, (rewards, continued) in attempts.items():
        path = folder.train / cells[0].algo / f"{cells[0].env}_{number}"
        (path / cells[0].env).mkdir(parents=True)
        (path / cells[0].env / "args.yml").write_text(f"- - trained_agent\n  - {continued}\n")
        (path / "best_model.zip").touch()
        results = np.array(list(rewards.values()))[:, None]
        np.savez(path / "evaluations.npz", timesteps=list(rewards), results=results, successes=results > 1.0)
    assert [attempt.first for attempt in folder.attempts()] == [0, 20_000]
    curve = folder.learning_curve()
    assert curve["timesteps"] == [10_000, 20_000, 29_000, 39_000] and curve["reward"] == [1.0, 2.0, 3.0, 1.0]
    best = folder.best_attempt()
    assert best is not None and best.number == 2, "the best model of the first one is of decision 30,000"


def test_no_more_children_than_jobs(tmp_path, cells):
    machine, most = FakeMachine(), []
    grid = Grid(cells, tmp_path / "logs", Results(tmp_path / "raw"), 3, machine)
    begin = grid._begin_cell
    grid._begin_cell = lambda folder: (begin(folder), most.append(len(grid.running)))
    grid.run()
    assert max(most) == 3
    with pytest.raises(ValueError, match="at least one"):
        Grid(cells, tmp_path / "logs", Results(tmp_path / "raw"), 0)


def test_two_grids_in_one_folder_are_refused(tmp_path, cells):
    class Nested(FakeMachine):
        def __call__(self, arguments, log):
            with pytest.raises(SystemExit, match="Another grid runs"):
                run(tmp_path, cells, FakeMachine())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, cells, Nested())


def test_cores_are_shared_unless_the_user_has_decided(monkeypatch):
    monkeypatch.setattr("sb3_uspl.experiments.runner.os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert [share_cores(jobs)["OMP_NUM_THREADS"] for jobs in (1, 2, 3, 9)] == ["8", "4", "2", "1"]
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert share_cores(2)["OMP_NUM_THREADS"] == "5"
