"""What is wrong with a command is said in a sentence, with what to do; never by a traceback."""

import re
import shutil
import sys

import gymnasium as gym
import pytest

from sb3_uspl import USPLPPO
from sb3_uspl._agents import load_model
from sb3_uspl._zoo import TRAINED_AGENTS, _is_installed
from tests.sb3_uspl.commands import ENV, SMALL, run, run_apart

COMMANDS = ("train", "enjoy", "evaluate", "export", "record_video")
READERS = COMMANDS[1:]
SHIPPED = TRAINED_AGENTS / "uspl_ppo" / f"{ENV}_1" / f"{ENV}.zip"


def refused(module, *arguments, run=run):
    result = run(module, *arguments)
    assert result.returncode != 0 and "Traceback" not in result.stderr, result.stdout + result.stderr
    return result.stderr


def out(command, folder):
    return ("-o", str(folder / "out")) if command in ("export", "record_video") else ()


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_environment_is_told_what_there_is(command, tmp_path):
    where = ("--algo", "uspl_ppo", "--env", "LateralChoise-v0", "-f", str(tmp_path), *out(command, tmp_path))
    message = refused(f"sb3_uspl.{command}", *where)
    assert "LateralChoice-v0?" in message and ENV in message


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_algorithm_is_told_what_there_is(command, tmp_path):
    where = ("--algo", "usppl", "--env", ENV, "-f", str(tmp_path), *out(command, tmp_path))
    message = refused(f"sb3_uspl.{command}", *where)
    assert "usppl" in message and "uspl_ppo" in message and "resel_ppo" in message


def test_a_configuration_without_the_environment_is_named(tmp_path):
    config = tmp_path / "mine.yml"
    config.write_text("Other-v0: {n_envs: 2}\n")
    message = refused("sb3_uspl.train", "--env", ENV, "-f", str(tmp_path), "-conf", str(config))
    assert f"uspl_ppo-{ENV} in {config}" in message, "without --algo it is USPL"


@pytest.mark.parametrize("command", READERS)
def test_a_missing_agent_is_told_where_agents_lie(command, tmp_path):
    where = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(tmp_path), *out(command, tmp_path))
    assert "<folder>/<algo>/<env>_<id>/" in refused(f"sb3_uspl.{command}", *where)


@pytest.mark.parametrize("command", READERS)
def test_an_environment_of_ones_own_is_known_by_the_module_that_registers_it(command, tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text("import gymnasium\n\ngymnasium.register('Own-v0', 'tests.sb3_uspl.toy:ToyEnv')\n")
    monkeypatch.syspath_prepend(tmp_path)
    where = ("--algo", "uspl_ppo", "--env", "Own-v0", "-f", str(tmp_path), *out(command, tmp_path))
    message = refused(f"sb3_uspl.{command}", *where, "--gym-packages", "own")
    assert "<folder>/<algo>/<env>_<id>/" in message, "what is missing is the agent"
    gym.registry.pop("Own-v0")
    sys.modules.pop("own")


@pytest.mark.parametrize("command", READERS)
def test_an_agent_of_another_version_or_algorithm_is_refused(command, tmp_path):
    folder = tmp_path / "resel_ppo" / f"{ENV}_1"
    shutil.copytree(SHIPPED.parent, folder)
    where = ("--algo", "resel_ppo", "--env", ENV, "-f", str(tmp_path), *out(command, tmp_path))
    message = refused(f"sb3_uspl.{command}", *where)
    assert str(folder / SHIPPED.name) in message and "by other versions than sb3_uspl" in message


@pytest.mark.parametrize("change", ["argument", "shape", "no model"])
def test_a_model_of_another_version_is_refused(change, tmp_path):
    path = tmp_path / "model.zip"
    if change == "no model":
        path.write_text("not a model")
    else:
        model = USPLPPO.load(SHIPPED, device="cpu")
        # An argument that a later version took out; a network that it gave other layers.
        changes = {"argument": {"no_longer_there": 1}, "shape": {"net_arch": [7]}}
        model.policy_kwargs = {**model.policy_kwargs, **changes[change]}
        model.save(path)
    with pytest.raises(ValueError, match=r"by other versions than sb3_uspl .* or train anew"):
        load_model("uspl_ppo", str(path))


def test_an_agent_of_other_spaces_is_refused(tmp_path):
    message = refused("sb3_uspl.export", "--env", "LateralChoice-v0", "--path", str(SHIPPED), "-o", str(tmp_path / "out"))
    assert "trained on other spaces" in message and not list(tmp_path.iterdir())
    message = refused(
        *("sb3_uspl.train", "--algo", "uspl_ppo", "--env", "ActiveTMaze-v0", "-f", str(tmp_path), "-i", str(SHIPPED)),
        *("-n", "64", "-params", *SMALL),
    )
    assert "trained on other spaces" in message and "spaces do not match" in message


def test_a_missing_model_to_go_on_with_is_named(tmp_path):
    arguments = ("--algo", "uspl_ppo", "--env", ENV, "-f", str(tmp_path), "-i", str(tmp_path / "gone.zip"))
    assert "gone.zip: there is no such model" in refused("sb3_uspl.train", *arguments)


def test_a_missing_window_is_told_what_goes_without(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    message = refused("sb3_uspl.enjoy", "--algo", "uspl_ppo", "--env", "LateralChoice-v0")
    assert "needs a display" in message and "--film FILE.mp4" in message


@pytest.mark.parametrize("module", ["train", "plots"])
def test_a_missing_zoo_is_told_how_to_install_it(module, tmp_path):
    """Apart, since a module that is there once cannot be missing here."""
    (tmp_path / "rl_zoo3.py").write_text("raise ImportError('no zoo')")
    message = refused(f"sb3_uspl.{module}", run=lambda name: run_apart(name, PYTHONPATH=str(tmp_path)))
    assert 'pip install -e ".[zoo]"' in message and "no zoo" in message


def test_a_missing_tracker_is_told_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    message = refused("sb3_uspl.train", "--algo", "uspl_ppo", "--env", ENV, "--track", "-f", str(tmp_path))
    assert 'pip install -e ".[track]"' in message


def test_a_folder_of_runs_is_no_package(tmp_path, monkeypatch):
    (tmp_path / "folder_of_runs").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert _is_installed("yaml") and not _is_installed("folder_of_runs") and not _is_installed("no_such_package")


def test_a_film_as_mp4_without_its_packages_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_uspl.film._MP4_PACKAGES", ("imageio", "no_such_writer"))
    arguments = ("--env", ENV, "--film", str(tmp_path / "a.mp4"))
    message = refused("sb3_uspl.record_video", *arguments)
    assert "no_such_writer" in message and 'pip install -e ".[zoo]"' in message and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "plot_train|all_plots|plot_from_file"),
        (("plot_train", "-a", "uspl_ppo", "-e", ENV, "-f", "gone", "-y", "success", "-o", "a.png"), "no folder gone"),
        (("all_plots", "-a", "uspl_ppo", "-e", ENV, "-f", "gone", "--no-display"), "--eval-freq"),
        (("plot_from_file", "-i", "gone"), "no file gone.pkl"),
    ],
)
def test_plots_of_nothing_are_refused(arguments, message):
    assert message in refused("sb3_uspl.plots", *arguments)


WANDB = """
import types
given = {}
def init(**kwargs):
    given.update(kwargs)
    return types.SimpleNamespace(config=types.SimpleNamespace(setdefaults=lambda values: given.update(later=dict(values))))
"""


def test_tracking_is_the_zoos(tmp_path, monkeypatch):
    """Up to what W&B is told, since it is not installed here."""
    (tmp_path / "wandb.py").write_text(WANDB)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    tracked = ("--track", "--wandb-project-name", "looking", "-f", str(tmp_path / "logs"), "-n", "256", "--eval-freq", "-1")
    result = run("sb3_uspl.train", "--algo", "uspl_ppo", "--env", ENV, *tracked, "-params", *SMALL, "encoder_updates:1")
    assert result.returncode == 0, result.stderr
    given = sys.modules.pop("wandb").given
    assert given["project"] == "looking" and given["sync_tensorboard"] and given["config"]["algo"] == "uspl_ppo"
    assert given["later"]["saved_hyperparams"]["n_envs"] == 8
    assert list((tmp_path / "runs").glob("**/events.out.tfevents*")), "what W&B would read"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--physics", "full"), "cannot be made with.*'physics'"),
        (("--physics", "full", "--env-kwargs", "physics:'compiled'"), "name one of them"),
        (("--seed", "-5"), "--seed -5: must be at least 0"),
        (("--n-envs", "0"), "--n-envs 0: must be at least 1"),
        (("--episodes", "0"), "--episodes 0: must be at least 1"),
        (("--gym-packages", "nosuch"), "No module named 'nosuch'"),
    ],
)
def test_an_evaluation_that_cannot_be_is_refused(arguments, words):
    assert re.search(words, refused("sb3_uspl.evaluate", "--env", ENV, "--episodes", "2", *arguments))


@pytest.mark.parametrize(("name", "words"), [("policy.json", "what the card is called"), ("", "is a folder")])
def test_an_export_that_would_overwrite_itself_is_refused(tmp_path, name, words):
    where = ("--env", ENV, "--format", "torchscript", "-o", str(tmp_path / name))
    assert words in refused("sb3_uspl.export", *where)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("table1", "--envs", ENV, ENV), "--envs must be different"),
        (("table1", "--envs", "CartPole-v1"), "There are no environments"),
        (("table1", "--seeds", "1000000"), "below 500000"),
        (("table8", "--only", "k_5"), r"--only \['k_5'\]"),
        (("figure7", "--envs", "BiasedQuadrotor-v0", "LateralChoice-v0"), "one environment and one seed"),
        (("figure7", "--seeds", "1", "2"), "one environment and one seed"),
        (("table1", "--jobs", "0"), "--jobs 0"),
    ],
)
def test_an_experiment_that_would_mislead_is_refused(tmp_path, arguments, words):
    options = ("--budget", "smoke", "--no-train", "--logs", str(tmp_path))
    assert re.search(words, refused("sb3_uspl.experiments", *arguments, *options))
