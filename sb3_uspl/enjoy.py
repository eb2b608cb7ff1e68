"""``python -m sb3_uspl.enjoy``: the zoo's viewer with our algorithms and environments; ``--replay out.html`` writes a page."""

import argparse
import contextlib
import sys
from pathlib import Path

import gymnasium as gym
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_uspl._zoo import ALGORITHMS, TRAINED_AGENTS, check_command_line, register, use_default_folder


def parse_replay_arguments() -> argparse.Namespace:
    """:return: command line with ``--replay``"""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_uspl.enjoy", description="One episode as a page; without --replay, the options are the zoo's."
    )
    parser.add_argument("--replay", required=True, type=Path, help=".html file to write")
    parser.add_argument("--algo", default="uspl_ppo", choices=sorted(ALGORITHMS), help="algorithm")
    parser.add_argument("--env", required=True, help="environment, e.g. LateralChoice-v0")
    parser.add_argument("-f", "--folder", default=str(TRAINED_AGENTS), help="log folder; default: the shipped agents")
    parser.add_argument("--exp-id", type=int, default=0, help="experiment number; default: the latest")
    parser.add_argument("--load-best", action="store_true", help="best model of the training's evaluations")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episode")
    return parser.parse_args()


def replay(arguments: argparse.Namespace) -> None:
    """
    Write the page of one episode.

    :param arguments: of :func:`parse_replay_arguments`
    :raises ValueError: if there is no such agent or it cannot be shown
    """
    from sb3_uspl.evaluate import load_agent
    from sb3_uspl.replay import write_replay

    model, venv = load_agent(arguments.algo, arguments.env, arguments.folder, arguments.exp_id, arguments.load_best, n_envs=1)
    venv.close()
    if unwrap_vec_normalize(venv) is not None:
        raise ValueError("The agent was trained under VecNormalize; a replay runs in the plain environment.")
    with contextlib.closing(gym.make(arguments.env)) as env:
        title = f"{arguments.env}: {arguments.algo}, deployment policy, seed {arguments.seed}"
        write_replay(model, env, arguments.seed, arguments.replay, title)


if __name__ == "__main__":
    register()
    check_command_line()
    if "--replay" in sys.argv:
        try:
            replay(parse_replay_arguments())
        except ValueError as error:
            raise SystemExit(str(error)) from error
    else:
        use_default_folder()
        from rl_zoo3.enjoy import enjoy

        enjoy()
