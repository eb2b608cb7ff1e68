"""The demo from one end to the other, with trainings of a few seconds; and what it reads while they run."""

import json
import os
import signal
import subprocess
import sys
import time

import gymnasium as gym
import pytest

pytest.importorskip("rl_zoo3")

import sb3_uspl._zoo  # noqa: F401 (first: importing the zoo patches Gymnasium)
from sb3_uspl._demo_trainings import clock, last_values
from sb3_uspl.demo import film_seed
from sb3_uspl.envs import TargetReachingEnv


def command(folder, timesteps):
    arguments = ["--folder", str(folder), "--timesteps", str(timesteps), "--episodes", "4"]
    return [sys.executable, "-m", "sb3_uspl.demo", *arguments]


def test_last_values_survives_a_line_that_is_being_written(tmp_path):
    (tmp_path / "progress.csv").write_text("a,b\n1,\n2,0.5\n3")
    assert last_values(tmp_path / "progress.csv") == {"a": 3.0, "b": 0.5}
    assert last_values(tmp_path / "missing.csv") == {}


def test_clock():
    assert (clock(5.9), clock(754.0)) == ("0:05", "12:34")


def test_film_seed_is_the_first_whose_goal_is_behind_the_robot():
    with gym.make("LateralChoice-v0") as env:
        behind = []
        for seed in range(10, 20):
            env.reset(seed=seed)
            facing_right = abs(env.unwrapped.robot.state.yaw) < 1.0
            behind.append(facing_right != (env.unwrapped.task.goal[0] > 0.0))
        assert film_seed(env, 10) == 10 + behind.index(True)
    assert film_seed(TargetReachingEnv(), 7) == 7


@pytest.mark.slow
def test_demo_writes_everything_and_does_not_train_twice(tmp_path):
    run = subprocess.run(command(tmp_path, 64), capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stdout + run.stderr
    for name in ("results.json", "learning_curve.png", "uncertainty.png", "film.gif", "uspl_ppo.log", "rma.log"):
        assert (tmp_path / name).stat().st_size > 0
    algorithms = json.loads((tmp_path / "results.json").read_text())["algorithms"]
    assert set(algorithms) == {"USPL", "RMA"}
    for row in algorithms.values():
        low, high = row["deployment_interval"]
        assert low <= row["deployment_success"] <= high and 0.0 < row["mean_length"] <= 20.0 and row["wall_time"] > 0.0

    again = subprocess.run(command(tmp_path, 64), capture_output=True, text=True, timeout=600)
    assert again.returncode == 0, again.stdout + again.stderr
    assert again.stdout.count("is used again") == 2
    repeated = json.loads((tmp_path / "results.json").read_text())["algorithms"]
    assert repeated == algorithms, "the same models on the same episodes"


@pytest.mark.slow
def test_interrupt_stops_the_trainings_and_says_how_to_continue(tmp_path):
    environment = {**os.environ, "DEMO_TEST": str(tmp_path)}
    demo = subprocess.Popen(
        command(tmp_path, 10_000_000), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    deadline = time.monotonic() + 120.0
    while not list(tmp_path.glob("logs/rma/*/progress.csv")) and time.monotonic() < deadline:
        time.sleep(0.5)
    demo.send_signal(signal.SIGINT)
    _, errors = demo.communicate(timeout=60)
    assert demo.returncode == 1 and "same command again" in errors and "Traceback" not in errors
    time.sleep(2.0)
    if os.path.isdir("/proc/self"):
        marker = f"DEMO_TEST={tmp_path}".encode()
        assert not [pid for pid in filter(str.isdigit, os.listdir("/proc")) if marker in environment_of(pid)]


def environment_of(pid):
    try:
        with open(f"/proc/{pid}/environ", "rb") as file:
            return file.read()
    except OSError:
        return b""
