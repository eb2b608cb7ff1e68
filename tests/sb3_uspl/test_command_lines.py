"""The commands of the README, small: train with the zoo, evaluate, errors that help."""

import csv
import json
import os
import subprocess
import sys

import pytest

from sb3_uspl._zoo import CONFIGS


def run(*arguments, **kwargs):
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, env=env, timeout=300, **kwargs)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    small = ("n_envs:8", "n_steps:32", "batch_size:64", "encoder_updates:1")
    command = [
        "sb3_uspl.train",
        "--algo",
        "uspl_ppo",
        "--env",
        "TargetReaching-v0",
        "-f",
        str(folder),
        "-n",
        "1024",
        "-params",
        *small,
    ]
    result = run(
        *command, "--eval-freq", "512", "--eval-episodes", "4", "--n-eval-envs", "2", "--seed", "1", "-tb", str(folder)
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


def test_training_leaves_the_zoos_files_and_every_metric(logs):
    folder = logs / "uspl_ppo" / "TargetReaching-v0_1"
    names = {path.name for path in folder.iterdir()}
    assert {"TargetReaching-v0.zip", "best_model.zip", "evaluations.npz", "progress.csv"} <= names
    with open(folder / "progress.csv") as file:
        header = next(csv.reader(file))
    assert {"uspl/uncertainty", "uspl/progress", "encoder/nll", "eval/success_rate", "rollout/success_rate"} <= set(header)


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


def test_importing_the_package_does_not_import_the_zoo_or_pybullet():
    heavy = "{'rl_zoo3', 'pybullet', 'matplotlib'}"
    code = f"import sys, sb3_uspl; sys.exit(bool({heavy} & {{name.split('.')[0] for name in sys.modules}}))"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


@pytest.mark.parametrize("algo", ["uspl_ppo", "rma"])
def test_every_configuration_is_accepted_by_its_algorithm(algo):
    import inspect

    import yaml
    from torch import nn

    from sb3_uspl import USPLPPO, USPLPolicy

    zoo_keys = {"n_envs", "n_timesteps", "normalize", "env_wrapper", "callback", "env_kwargs", "monitor_kwargs"}
    known = set(inspect.signature(USPLPPO).parameters)
    for entry in yaml.safe_load((CONFIGS / f"{algo}.yml").read_text()).values():
        assert set(entry) - zoo_keys <= known
        if "policy_kwargs" in entry:
            kwargs = eval(entry["policy_kwargs"], {"nn": nn, "dict": dict})
            assert set(kwargs) <= set(inspect.signature(USPLPolicy).parameters)
