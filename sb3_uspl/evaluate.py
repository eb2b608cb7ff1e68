"""``python -m sb3_uspl.evaluate``: success of a trained agent over fresh episodes, all of them counted."""

import argparse
import contextlib
import json
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl import _episode
from sb3_uspl._agents import find_model, load_model
from sb3_uspl._zoo import ALGORITHMS, TRAINED_AGENTS, BulletVecEnv, check_names, register
from sb3_uspl.evaluation import EVALUATION_SEED, evaluate
from sb3_uspl.observations import PRIVILEGED


def load_agent(
    algo: str,
    env_id: str,
    folder: str,
    exp_id: int = 0,
    best: bool = False,
    n_envs: int = 32,
    env_kwargs: dict[str, Any] | None = None,
    path: str | None = None,
) -> tuple[BaseAlgorithm, VecEnv]:
    """
    Load an agent and its environments from the zoo's layout ``<folder>/<algo>/<env>_<exp_id>/``.

    :param algo: zoo name of the algorithm
    :param env_id: environment
    :param folder: log folder
    :param exp_id: experiment number; 0 is the latest
    :param best: the best model of the training's evaluations instead of the last one
    :param n_envs: number of environments
    :param env_kwargs: passed to the environment
    :param path: the model's .zip file, instead of folder and number; its configuration is looked for beside it
    :return: model and environments, normalised as in training
    :raises ValueError: for an unknown algorithm or environment, if there is no such agent or it was made by other versions or
        for other spaces, or if the environment refuses its arguments
    """
    from rl_zoo3.utils import create_test_env, get_saved_hyperparams

    check_names(algo, env_id)
    model_path = find_model(algo, env_id, folder, exp_id, best) if path is None else path
    log_path = os.path.dirname(model_path)
    model = load_model(algo, model_path)
    hyperparams, stats_path = get_saved_hyperparams(os.path.join(log_path, env_id), test_mode=True)
    try:
        venv = create_test_env(
            env_id,
            n_envs=n_envs,
            stats_path=stats_path,
            seed=EVALUATION_SEED,
            should_render=False,
            hyperparams=hyperparams,
            env_kwargs=env_kwargs,
            vec_env_cls=BulletVecEnv,
        )
    except TypeError as error:
        raise ValueError(f"{env_id} cannot be made with {env_kwargs or {}}: {error}") from error
    try:
        check_for_correct_spaces(venv, model.observation_space, model.action_space)
    except ValueError as error:
        venv.close()
        raise ValueError(
            f"{model_path} was trained on other spaces than those of {env_id}: {error}. Choose the environment, and the "
            "--env-kwargs, that it was trained with."
        ) from error
    return model, venv


def parse_arguments() -> argparse.Namespace:
    """:return: command line"""
    parser = argparse.ArgumentParser(prog="python -m sb3_uspl.evaluate", description=__doc__)
    parser.add_argument("--algo", default="uspl_ppo", help=f"algorithm ({', '.join(ALGORITHMS)} or one of the zoo's)")
    parser.add_argument("--env", required=True, help="environment, e.g. LateralChoice-v0")
    parser.add_argument("--episodes", type=int, default=500, help="episodes of each policy")
    parser.add_argument("-f", "--folder", default=str(TRAINED_AGENTS), help="log folder; default: the shipped agents")
    parser.add_argument("--exp-id", type=int, default=0, help="experiment number; default: the latest")
    parser.add_argument("--load-best", action="store_true", help="best model of the training's evaluations")
    parser.add_argument("--policy", choices=("deployment", "privileged", "both"), default="both")
    parser.add_argument(
        "--physics",
        choices=("kinematic", "compiled", "varied", "full", "full_accurate"),
        help="fidelity of the robot; default: the environment's",
    )
    _episode.add_env_kwargs(parser)
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="seed of the first episode")
    parser.add_argument("--n-envs", type=int, default=32, help="environments that run at the same time")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules to import, for environments of your own")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument(
        _episode.REPLAY, type=Path, help=".html file to write: the first of the episodes in 3-D, with a timeline"
    )
    given = parser.parse_args()
    for name, least in (("episodes", 1), ("n_envs", 1), ("seed", 0)):
        if getattr(given, name) < least:
            parser.error(f"--{name.replace('_', '-')} {getattr(given, name)}: must be at least {least}.")
    return given


def main() -> None:
    """Evaluate and print."""
    arguments = parse_arguments()
    th.set_num_threads(1)
    with contextlib.redirect_stdout(sys.stderr):  # the zoo prints too
        try:
            register(arguments.gym_packages)
            result = _measure(arguments)
        except (ValueError, ModuleNotFoundError) as error:
            raise SystemExit(str(error)) from error
    if arguments.json:
        print(json.dumps(result, default=repr))  # the environment's arguments may be anything
    else:
        _print_table(result)


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    env_kwargs = _episode.env_kwargs(arguments)
    n_envs = min(arguments.n_envs, arguments.episodes)
    model, venv = load_agent(
        arguments.algo, arguments.env, arguments.folder, arguments.exp_id, arguments.load_best, n_envs, env_kwargs
    )
    if PRIVILEGED in getattr(model.observation_space, "spaces", ()) and arguments.algo not in ALGORITHMS:
        warnings.warn(
            f"This {arguments.algo} was trained with the privileged observation and is shown it: no deployment policy. "
            "Train it on environments under sb3_uspl.HidePrivileged."
        )
    with contextlib.closing(venv):
        if arguments.replay is not None:
            _episode.write_replay_page(model, venv, arguments)
        result = evaluate(model, venv, arguments.episodes, arguments.seed, arguments.policy)
    head = {"algo": arguments.algo, "env": arguments.env, "physics": env_kwargs.get("physics"), "env_kwargs": env_kwargs}
    return {**head, **result}


def _print_table(result: dict[str, Any]) -> None:
    for name in ("deployment", "privileged"):
        prefix = "" if name == "deployment" else "privileged_"
        if result[f"{prefix}mean_return"] is not None:
            success = "success unknown, as the environment's info has no is_success"
            if result[f"{prefix}success_rate"] is not None:
                low, high = result[f"{prefix}success_interval"]
                success = f"success {result[f'{prefix}success_rate']:.1%} (95 % interval {low:.1%} - {high:.1%})"
            means = result[f"{prefix}mean_return"], result[f"{prefix}mean_length"]
            print(f"{name:>10} policy: {success}, return {means[0]:.2f}, length {means[1]:.1f} decisions")
    if result["prediction_error_final"] is not None:
        print(f"prediction error at the end of an episode: {result['prediction_error_final']:.4f}")
    if result["divergence_mean"] is not None:
        print(f"distance between privileged and deployment policy, mean over time: {result['divergence_mean']:.3f}")


if __name__ == "__main__":
    main()
