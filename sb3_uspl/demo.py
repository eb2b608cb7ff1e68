"""``python -m sb3_uspl.demo``: train USPL and RMA side by side, evaluate both, draw the pictures and the film."""

import argparse
import json
import math
import signal
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uspl._demo_trainings import NAMES, Trainings, clock
from sb3_uspl._zoo import register
from sb3_uspl.evaluate import load_agent
from sb3_uspl.evaluation import EVALUATION_SEED, EpisodeRecord, run_episodes, success_rate
from sb3_uspl.film import film
from sb3_uspl.pictures import learning_curve, sigma_over_time

N_ENVS = 50
"""Environments of the final evaluation."""
_SEEDS_TO_TRY = 100
_STOPPED = "\nStopped. To continue, give the same command again: a finished training is kept, an unfinished one starts anew."


def film_seed(env: gym.Env, first: int = EVALUATION_SEED) -> int:
    """
    The episode to film, chosen before anybody acts: the first evaluation seed whose goal lies behind the robot (more than a
    quarter turn from where it faces), so that walking straight on does not find it. Without robot or goal: the first seed.

    :param env: environment
    :param first: first evaluation seed
    :return: seed
    """
    world: Any = env.unwrapped
    if not (hasattr(world, "robot") and hasattr(getattr(world, "task", None), "goal")):
        return first
    for seed in range(first, first + _SEEDS_TO_TRY):
        env.reset(seed=seed)
        state, goal = world.robot.state, world.task.goal
        if (goal[0] - state.x) * math.cos(state.yaw) + (goal[1] - state.y) * math.sin(state.yaw) < 0.0:
            return seed
    return first


def evaluate_all(
    trainings: Trainings, episodes: int
) -> tuple[dict[str, dict[str, Any]], dict[str, list[EpisodeRecord]], dict[str, BaseAlgorithm]]:
    """
    Evaluate the best model of every training, both of its policies, on the same episodes.

    Best in the evaluations during the training, whose episodes have other seeds than those here.

    :param trainings: finished
    :param episodes: of each policy
    :return: results, the deployment policy's episodes and the model, each by algorithm
    """
    results: dict[str, dict[str, Any]] = {}
    records: dict[str, list[EpisodeRecord]] = {}
    models: dict[str, BaseAlgorithm] = {}
    for algo, name in NAMES.items():
        training = trainings.finished(algo)
        assert training is not None
        folder = str(trainings.folder / "logs")
        n_envs = min(N_ENVS, episodes)
        # A training shorter than the time to its first evaluation has a last model only.
        best = (trainings.path(algo, training) / "best_model.zip").is_file()
        models[name], venv = load_agent(algo, trainings.env_id, folder, training.exp_id, best, n_envs)
        try:
            records[name] = run_episodes(models[name], venv, episodes)
            privileged = run_episodes(models[name], venv, episodes, policy="privileged")
            period = venv.get_attr("decision_period", 0)[0]
        finally:
            venv.close()
        rate, low, high = success_rate(records[name])
        results[name] = {
            "deployment_success": rate,
            "deployment_interval": [low, high],
            "privileged_success": success_rate(privileged)[0],
            "mean_length": float(np.mean([len(record) for record in records[name]])) * period,
            **asdict(training),
        }
    return results, records, models


def parse_arguments() -> argparse.Namespace:
    """:return: command line"""
    parser = argparse.ArgumentParser(prog="python -m sb3_uspl.demo", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where trainings, pictures and numbers go")
    parser.add_argument("--env", default="LateralChoice-v0", help="environment with an entry in zoo_configs/")
    parser.add_argument("--seed", type=int, default=1, help="seed of both trainings")
    parser.add_argument("--episodes", type=int, default=500, help="evaluation episodes of each policy")
    parser.add_argument("--timesteps", type=int, help="decisions of each training; default: as in zoo_configs/")
    parser.add_argument("--one-by-one", action="store_true", help="train one after the other: half the memory, more time")
    parser.add_argument("--film-seed", type=int, help="episode to film; default: the first whose goal is behind the robot")
    return parser.parse_args()


def main() -> None:
    """Train, evaluate, draw and print."""
    arguments = parse_arguments()
    if arguments.episodes < 1 or (arguments.timesteps is not None and arguments.timesteps < 1):
        raise SystemExit("--episodes and --timesteps must be at least 1.")
    register()
    th.set_num_threads(1)
    folder: Path = arguments.folder
    trainings = Trainings(folder, arguments.env, arguments.seed, arguments.timesteps)
    trainings.run_all(arguments.one_by_one)
    print(f"Evaluating the models that were best in training, {arguments.episodes} episodes of each policy ...", flush=True)
    results, records, models = evaluate_all(trainings, arguments.episodes)

    print(f"\n{'':6}{'deployment policy':>18}{'95 % interval':>18}{'privileged policy':>20}{'episode':>10}{'training':>11}")
    for name, row in results.items():
        low, high = row["deployment_interval"]
        print(
            f"{name:6}{row['deployment_success']:>18.1%}{f'{low:.1%} - {high:.1%}':>18}{row['privileged_success']:>20.1%}"
            f"{row['mean_length']:>8.1f} s{clock(row['wall_time']):>7} min"
        )
    print("\nDrawing the pictures and the film ...", flush=True)
    runs = {algo: trainings.path(algo, training) for algo in NAMES if (training := trainings.finished(algo))}
    learning_curve({NAMES[algo]: run / "progress.csv" for algo, run in runs.items()}, folder / "learning_curve.png")
    env = gym.make(arguments.env, render_mode="rgb_array")
    try:
        world: Any = env.unwrapped
        belief_in_world = getattr(world, "task", world).belief_in_world
        sigma_over_time(records, env.get_wrapper_attr("decision_period"), folder / "uncertainty.png", belief_in_world)
        seed = film_seed(env) if arguments.film_seed is None else arguments.film_seed
        clips = film(models, env, [seed], folder / "film.gif")
    finally:
        env.close()
    for name, clip in zip(models, clips, strict=True):
        results[name]["film"] = {"seed": seed, "reached": clip.success}
    summary = {"env": arguments.env, "episodes": arguments.episodes, "first_episode": EVALUATION_SEED, "algorithms": results}
    (folder / "results.json").write_text(json.dumps(summary, indent=2) + "\n")
    for path in ("results.json", "learning_curve.png", "uncertainty.png", "film.gif"):
        print(folder / path)


if __name__ == "__main__":
    # The children do not hear a terminal's signals: whatever ends the demo has to end them.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(_STOPPED) from None
