"""The commands of the README, small: train with the zoo, evaluate, watch, plot."""

import argparse
import csv
import inspect
import json
import pickle
import shutil
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_uspl import RESeLPolicy, USPLPolicy
from sb3_uspl._configs import CONFIGS, load_entries
from sb3_uspl._zoo import ALGORITHMS, TRAINED_AGENTS, ProgressCSV, is_ours, use_default_config, use_default_folder
from tests.sb3_uspl.commands import ENV, run, run_apart, train
from tests.sb3_uspl.toy import make_model


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


def test_a_training_closes_its_progress_file(tmp_path):
    model, callback = make_model(), ProgressCSV(str(tmp_path / "progress.csv"))
    model.set_logger(Logger(None, []))
    callback.init_callback(model)
    callback.on_training_end()  # stopped before it began
    callback.on_training_start({}, {})
    (written,) = model.logger.output_formats
    for _ in range(2):  # the zoo ends its first callback's training twice
        callback.on_training_end()
        assert written.file.closed and not model.logger.output_formats


def test_evaluation_prints_one_json_object(logs):
    result = run(
        *("sb3_uspl.evaluate", "--algo", "uspl_ppo", "--env", "TargetReaching-v0", "-f", str(logs)),
        *("--episodes", "6", "--n-envs", "3", "--json"),
    )
    assert result.returncode == 0, result.stderr
    measured = json.loads(result.stdout)
    assert measured["env"] == "TargetReaching-v0" and measured["episodes"] == 6
    assert {"success_rate", "privileged_success_rate", "mean_length", "prediction_error_final"} <= set(measured)
    assert measured["env_kwargs"] == {}


@pytest.mark.parametrize("algo", sorted(set(ALGORITHMS) - {"uspl_ppo"}))
def test_every_algorithm_trains_and_is_evaluated(algo, tmp_path):
    train(tmp_path, algo, 512)
    arguments = ("--env", ENV, "-f", str(tmp_path), "--episodes", "2", "--n-envs", "2", "--json")
    result = run("sb3_uspl.evaluate", "--algo", algo, *arguments)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["algo"] == algo


def test_evaluation_warns_of_an_sb3_policy_that_sees_the_answer(tmp_path):
    folder = tmp_path / "ppo" / f"{ENV}_1"
    folder.mkdir(parents=True)
    PPO("MultiInputPolicy", gym.make(ENV), n_steps=64).save(folder / f"{ENV}.zip")
    arguments = ("--env", ENV, "-f", str(tmp_path), "--episodes", "2", "--n-envs", "2", "--json")
    with pytest.warns(UserWarning, match="is shown it: no deployment policy"):
        result = run("sb3_uspl.evaluate", "--algo", "ppo", *arguments)
    assert result.returncode == 0, result.stderr


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


def test_evaluation_and_export_take_arguments_of_the_environment(tmp_path):
    where = ("--env", "ActiveTMaze-v0", "--env-kwargs", "corridor_length:5")
    result = run("sb3_uspl.evaluate", *where, "--episodes", "4", "--policy", "deployment", "--json")
    assert result.returncode == 0 and json.loads(result.stdout)["mean_length"] == 5 + 3, result.stderr
    result = run("sb3_uspl.export", *where, "--format", "torchscript", "-o", str(tmp_path / "out"))
    assert result.returncode == 0 and (tmp_path / "out.pt").is_file(), result.stderr


def test_evaluation_shows_its_first_episode(logs, tmp_path):
    pytest.importorskip("plotly")
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs), "--episodes", "1", "--json")
    result = run("sb3_uspl.evaluate", *where, "--policy", "deployment", "--replay", str(tmp_path / "a.html"))
    assert result.returncode == 0, result.stderr
    measured, page = json.loads(result.stdout), (tmp_path / "a.html").read_text("utf-8")
    outcome = "reached the goal" if measured["success_rate"] else "failed"
    assert f"seed {measured['seed']}" in page and f'"{outcome} after {0.2 * measured["mean_length"]:.1f} s"' in page


def test_record_video_writes_a_film(logs, tmp_path):
    pytest.importorskip("moviepy")
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs), "-o", str(tmp_path))
    result = run("sb3_uspl.record_video", *where, "--gym-packages", "sb3_uspl", "-n", "20")
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


def test_training_success_is_drawn_without_a_window(logs, tmp_path):
    plt = pytest.importorskip("rl_zoo3.plots.plot_train").plt
    arguments = ("-a", "uspl_ppo", "-e", ENV, "-f", str(logs), "-y", "success", "-w", "2")
    result = run("sb3_uspl.plots", "plot_train", *arguments, "-o", str(tmp_path / "a.png"))
    assert result.returncode == 0 and (tmp_path / "a.png").stat().st_size > 5000, result.stderr
    (line,) = plt.gca().lines
    assert len(line.get_ydata()) > 5 and 0.0 <= min(line.get_ydata()) and max(line.get_ydata()) <= 1.0
    plt.close("all")


def test_evaluations_of_one_training_are_gathered_and_drawn(logs, tmp_path):
    """One only, over which the zoo's own stumbles."""
    plt = pytest.importorskip("rl_zoo3.plots.plot_train").plt
    successes = np.load(logs / "uspl_ppo" / f"{ENV}_1" / "evaluations.npz")["successes"]
    arguments = ("-a", "uspl_ppo", "-e", ENV, "-f", str(logs), "-k", "successes", "--no-display", "-o", str(tmp_path / "a"))
    result = run("sb3_uspl.plots", "all_plots", *arguments)
    assert result.returncode == 0 and f": {successes[-1].mean():.1%} ± 0.0% (1 training)" in result.stdout, result.stderr
    (entry,) = pickle.loads((tmp_path / "a.pkl").read_bytes())[ENV].values()
    np.testing.assert_allclose(entry["mean"], successes.mean(axis=1))
    drawn = ("-i", str(tmp_path / "a"), "-l", "USPL", "-o", str(tmp_path / "b.png"), "--format", "png")
    result = run("sb3_uspl.plots", "plot_from_file", *drawn)
    assert result.returncode == 0 and (tmp_path / "b.png").stat().st_size > 5000, result.stderr
    plt.close("all")


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no virtual display here: apt-get install xvfb")
def test_a_window_opens_where_there_is_a_display():
    command = ("-m", "sb3_uspl.enjoy", "--algo", "uspl_ppo", "--env", "LateralChoice-v0", "-n", "5")
    result = subprocess.run(["xvfb-run", "-a", sys.executable, *command], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0 and "GL_RENDERER" in result.stdout, result.stdout[-1000:] + result.stderr[-1000:]


def test_export_of_a_trained_agent(logs, tmp_path):
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(logs), "-o", str(tmp_path / "out"))
    result = run("sb3_uspl.export", *where, "--format", "torchscript")
    assert result.returncode == 0, result.stderr
    card = json.loads((tmp_path / "out.json").read_text())
    assert (tmp_path / "out.pt").is_file() and card["environment"] == ENV and card["decision_period_s"] == 0.2


def test_importing_the_package_does_not_import_the_zoo_or_pybullet():
    heavy = "{'rl_zoo3', 'pybullet', 'matplotlib'}"
    code = f"import sys, sb3_uspl; sys.exit(bool({heavy} & {{name.split('.')[0] for name in sys.modules}}))"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([], (str(CONFIGS / "rma.yml"), str(TRAINED_AGENTS))),
        (["-conf", "mine.yml", "-f", "logs"], ("mine.yml", "logs")),
        (["--conf-file=mine.yml", "--folder=logs"], ("mine.yml", "logs")),
        (["--conf", "mine.yml", "--fold", "logs"], ("mine.yml", "logs")),
    ],
)
def test_what_the_command_line_says_is_not_replaced_by_defaults(monkeypatch, given, expected):
    zoo = argparse.ArgumentParser()
    zoo.add_argument("--algo")
    zoo.add_argument("-conf", "--conf-file")
    zoo.add_argument("-f", "--folder")
    for algo in (["--algo", "rma"], ["--algo=rma"]):
        monkeypatch.setattr(sys, "argv", ["train", *algo, *given])
        use_default_config()
        use_default_folder()
        parsed = zoo.parse_args()
        assert (parsed.conf_file, parsed.folder) == expected


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


@pytest.mark.parametrize("algo", sorted(ALGORITHMS))
def test_every_environment_has_an_entry(algo):
    assert set(load_entries(CONFIGS / f"{algo}.yml")) == {"default", *filter(is_ours, gym.registry)}


def test_resel_ppo_updates_with_whole_sequences():
    for entry in load_entries(CONFIGS / "resel_ppo.yml").values():
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
