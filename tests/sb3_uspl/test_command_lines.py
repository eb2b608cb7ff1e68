"""The commands of the README, small: train with the zoo, evaluate, errors that help."""

import contextlib
import csv
import inspect
import io
import json
import os
import runpy
import subprocess
import sys
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import pytest
from torch import nn

from sb3_uspl import RESeLPolicy, USPLPolicy
from sb3_uspl._configs import CONFIGS, load_entries
from sb3_uspl._zoo import ALGORITHMS, is_ours


def run(module, *arguments):
    """The command in this process: importing torch and the zoo anew takes longer than what most of these tests do."""
    stdout, stderr = io.StringIO(), io.StringIO()
    code: object = 0
    with (
        mock.patch.object(sys, "argv", [module, *arguments]),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        try:
            runpy.run_module(module, run_name="__main__")
        except SystemExit as end:
            code = end.code
    # What the interpreter would do with it.
    message, code = (code, 1) if isinstance(code, str) else ("", code or 0)
    return SimpleNamespace(returncode=code, stdout=stdout.getvalue(), stderr=stderr.getvalue() + message)


def run_apart(*arguments):
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, env=env, timeout=300)


SMALL = ("n_envs:8", "n_steps:32", "batch_size:64", "learning_rate_floor:0.1")
ENV = "TargetReaching-v0"


def train(folder, algo="uspl_ppo", n=1024, *arguments, small=SMALL, run=run):
    command = ("sb3_uspl.train", "--algo", algo, "--env", ENV, "-f", str(folder), "-n", str(n), "--seed", "1")
    encoder = () if algo == "resel_ppo" else ("encoder_updates:1",)
    result = run(*command, *arguments, "-params", *small, *encoder)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    train(
        folder,
        "uspl_ppo",
        1024,
        "--eval-freq",
        "512",
        "--eval-episodes",
        "4",
        "--n-eval-envs",
        "2",
        "-tb",
        str(folder),
        run=run_apart,
    )
    return folder


def test_training_leaves_the_zoos_files_and_every_metric(logs):
    folder = logs / "uspl_ppo" / "TargetReaching-v0_1"
    names = {path.name for path in folder.iterdir()}
    assert {"TargetReaching-v0.zip", "best_model.zip", "evaluations.npz", "progress.csv"} <= names
    with open(folder / "progress.csv") as file:
        rows = list(csv.DictReader(file))
    expected = {"uspl/uncertainty", "uspl/progress", "encoder/nll", "eval/success_rate", "rollout/success_rate"}
    assert expected <= set(rows[0])
    rates = [float(row["train/learning_rate"]) for row in rows if row["train/learning_rate"]]
    assert 0.1 * rates[0] <= rates[-1] < 0.5 * rates[0]  # the cosine, not a constant of the zoo's


def test_evaluation_prints_one_json_object(logs):
    result = run(
        *("sb3_uspl.evaluate", "--algo", "uspl_ppo", "--env", "TargetReaching-v0", "-f", str(logs)),
        *("--episodes", "6", "--n-envs", "3", "--json"),
    )
    assert result.returncode == 0, result.stderr
    measured = json.loads(result.stdout)
    assert measured["env"] == "TargetReaching-v0" and measured["episodes"] == 6
    assert {"success_rate", "privileged_success_rate", "mean_length", "prediction_error_final"} <= set(measured)


def test_a_missing_agent_is_explained(tmp_path):
    result = run("sb3_uspl.evaluate", "--env", "TargetReaching-v0", "-f", str(tmp_path))
    assert result.returncode != 0 and "<folder>/<algo>/<env>_<id>/" in result.stderr and "Traceback" not in result.stderr


@pytest.mark.parametrize("algo", sorted(set(ALGORITHMS) - {"uspl_ppo"}))
def test_every_algorithm_trains_and_is_evaluated(algo, tmp_path):
    train(tmp_path, algo, 512)
    arguments = ("--env", ENV, "-f", str(tmp_path), "--episodes", "2", "--n-envs", "2", "--json")
    result = run("sb3_uspl.evaluate", "--algo", algo, *arguments)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["algo"] == algo


def test_training_is_continued_where_it_ended(logs, tmp_path):
    model = logs / "uspl_ppo" / f"{ENV}_1" / f"{ENV}.zip"
    train(tmp_path, "uspl_ppo", 512, "-i", str(model))
    with open(tmp_path / "uspl_ppo" / f"{ENV}_1" / "progress.csv") as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file) if row["time/total_timesteps"]]
    assert steps[0] > 1024 and steps[-1] >= 1536


@pytest.mark.parametrize("algo", ["uspl_ppo", "resel_ppo"])
def test_optimisation_keeps_the_configurations_networks_and_its_trials_can_be_trained(algo, tmp_path):
    storage = ("--storage", f"sqlite:///{tmp_path}/study.db", "--study-name", "study")
    trials = ("--n-trials", "2", "--n-startup-trials", "0", "--n-evaluations", "1", "--eval-episodes", "2", "--pruner", "none")
    train(tmp_path, algo, 512, "-optimize", *trials, *storage, "--no-optim-plots", small=("n_envs:8",))
    with open(next((tmp_path / algo).glob("report_*.csv"))) as file:
        _, trial = csv.DictReader(file)  # the zoo takes trial 0 for none
    assert trial["state"] == "COMPLETE" and trial["params_learning_rate"] and "params_net_arch" not in trial
    output = train(tmp_path, algo, 512, *storage, "--trial-id", "1", small=("n_envs:8", "n_steps:32", "batch_size:256"))
    assert trial["params_learning_rate"][:8] in output and "policy_kwargs" in output


def test_enjoy_writes_a_replay_and_runs_without_a_window(logs, tmp_path):
    pytest.importorskip("plotly")
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs))
    result = run("sb3_uspl.enjoy", *where, "--replay", str(tmp_path / "a.html"))
    assert result.returncode == 0 and (tmp_path / "a.html").stat().st_size > 1e6, result.stderr
    result = run("sb3_uspl.enjoy", *where, "--no-render", "-n", "60")
    assert result.returncode == 0 and "Success rate" in result.stdout, result.stderr


def test_record_video_writes_a_film(logs, tmp_path):
    pytest.importorskip("moviepy")
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs), "-o", str(tmp_path))
    result = run("sb3_uspl.record_video", *where, "-n", "20")
    assert result.returncode == 0, result.stderr
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 1000


def test_films_of_what_the_robot_believes_under_a_chosen_uncertainty(logs, tmp_path):
    pytest.importorskip("matplotlib")
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs))
    (tmp_path / "schedule.csv").write_text("decisions,sigma\n0,0.3\n5,\n")
    chosen = ("--uncertainty", str(tmp_path / "schedule.csv"), "--policy", "privileged")
    result = run("sb3_uspl.record_video", *where, "--film", str(tmp_path / "a.gif"), *chosen)
    assert result.returncode == 0 and (tmp_path / "a.gif").stat().st_size > 10_000, result.stderr
    result = run("sb3_uspl.enjoy", *where, "--film", str(tmp_path / "b.gif"), "--uncertainty", "high")
    assert result.returncode != 0 and "expected a number" in result.stderr and "Traceback" not in result.stderr
    result = run("sb3_uspl.enjoy", *where, "--replay", str(tmp_path / "b.html"), "--uncertainty", "0.3")
    assert result.returncode != 0 and "for films" in result.stderr


def test_a_missing_window_is_explained(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    result = run("sb3_uspl.enjoy", "--algo", "uspl_ppo", "--env", "LateralChoice-v0")
    assert result.returncode != 0 and "needs a display" in result.stderr and "--film FILE.mp4" in result.stderr


def test_training_success_can_be_plotted(logs, monkeypatch):
    """The zoo only shows its plot; what it drew is read from the figure."""
    plot_train = pytest.importorskip("rl_zoo3.plots.plot_train")
    plt = plot_train.plt
    monkeypatch.setattr(plt, "show", lambda: None)
    arguments = ["-a", "uspl_ppo", "-e", ENV, "-f", str(logs), "-y", "success", "-w", "2"]
    monkeypatch.setattr(sys, "argv", ["plot_train", *arguments])
    plot_train.plot_train()
    (line,) = plt.gca().lines
    assert len(line.get_ydata()) > 5 and 0.0 <= min(line.get_ydata()) and max(line.get_ydata()) <= 1.0
    plt.close("all")


def test_export_of_a_trained_agent(logs, tmp_path):
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs), "-o", str(tmp_path / "out"))
    result = run("sb3_uspl.export", *where, "--format", "torchscript")
    assert result.returncode == 0, result.stderr
    card = json.loads((tmp_path / "out.json").read_text())
    assert (tmp_path / "out.pt").is_file() and card["environment"] == ENV and card["decision_period_s"] == 0.2


@pytest.mark.parametrize("command", ["train", "enjoy", "evaluate", "export", "record_video"])
def test_an_unknown_environment_is_explained(command, tmp_path):
    out = ("-o", str(tmp_path)) if command in ("export", "record_video") else ()
    result = run(f"sb3_uspl.{command}", "--algo", "uspl_ppo", "--env", "LateralChoise-v0", "-f", str(tmp_path), *out)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert "LateralChoice-v0?" in result.stderr and ENV in result.stderr


def test_an_unknown_algorithm_is_explained(tmp_path):
    result = run("sb3_uspl.evaluate", "--algo", "usppl", "--env", ENV, "-f", str(tmp_path))
    assert result.returncode != 0 and "Traceback" not in result.stderr and "'uspl_ppo'" in result.stderr


def test_agents_of_other_spaces_and_of_other_algorithms_are_refused(logs, tmp_path):
    model = str(logs / "uspl_ppo" / f"{ENV}_1" / f"{ENV}.zip")
    out = ("-o", str(tmp_path / "out"), "--path", model)
    result = run("sb3_uspl.export", "--env", "LateralChoice-v0", *out)
    assert result.returncode != 0 and "trained on other spaces" in result.stderr and "Traceback" not in result.stderr
    result = run("sb3_uspl.export", "--algo", "resel_ppo", "--env", ENV, *out)
    assert result.returncode != 0 and "Name its algorithm" in result.stderr and "Traceback" not in result.stderr


def test_importing_the_package_does_not_import_the_zoo_or_pybullet():
    heavy = "{'rl_zoo3', 'pybullet', 'matplotlib'}"
    code = f"import sys, sb3_uspl; sys.exit(bool({heavy} & {{name.split('.')[0] for name in sys.modules}}))"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


@pytest.mark.parametrize("algo", sorted(ALGORITHMS))
def test_every_configuration_is_accepted_by_its_algorithm(algo):
    zoo_keys = {"n_envs", "n_timesteps", "normalize", "env_wrapper", "callback", "env_kwargs", "monitor_kwargs"}
    known = _arguments(ALGORITHMS[algo])
    entries = load_entries(CONFIGS / f"{algo}.yml")
    assert "default" in entries and set(entries) - {"default"} <= set(gym.registry)
    policy = RESeLPolicy if algo == "resel_ppo" else USPLPolicy
    for entry in entries.values():
        assert set(entry) - zoo_keys <= known
        if "policy_kwargs" in entry:
            kwargs = eval(entry["policy_kwargs"], {"nn": nn, "dict": dict})
            assert set(kwargs) <= set(inspect.signature(policy).parameters)


def test_resel_ppo_has_an_entry_for_every_environment():
    entries = load_entries(CONFIGS / "resel_ppo.yml")
    assert set(entries) == {"default", *filter(is_ours, gym.registry)}
    for entry in entries.values():
        assert entry["batch_size"] % entry["n_steps"] == 0


def _arguments(algorithm):
    """Of the constructor and of those that it passes its ``**kwargs`` to."""
    names = set()
    for ancestor in algorithm.__mro__:
        parameters = inspect.signature(ancestor.__init__).parameters
        names |= set(parameters)
        if "kwargs" not in parameters:
            return names
    return names
