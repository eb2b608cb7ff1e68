"""What ``enjoy`` and ``record_video`` add to the zoo's: an episode as a film (``--film``) or as a page (``--replay``)."""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_uspl._zoo import ALGORITHMS, TRAINED_AGENTS
from sb3_uspl.chosen_uncertainty import read_uncertainty

FILM, REPLAY = "--film", "--replay"


def is_asked_for() -> bool:
    """:return: whether the command line has ``--film`` or ``--replay``"""
    return any(argument.split("=")[0] in (FILM, REPLAY) for argument in sys.argv[1:])


def parse_arguments(command: str) -> argparse.Namespace:
    """
    :param command: name of the module, for the help
    :return: command line with ``--film`` or ``--replay``
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m sb3_uspl.{command}",
        description="Episodes as a film, or one as a page; without --film and --replay, the options are the zoo's.",
    )
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument(FILM, type=Path, help=".mp4 or .gif file to write: scene, camera, belief and uncertainty over time")
    kind.add_argument(REPLAY, type=Path, help=".html file to write: one episode in 3-D, with a timeline")
    parser.add_argument("--algo", default="uspl_ppo", choices=sorted(ALGORITHMS), help="algorithm")
    parser.add_argument("--env", required=True, help="environment, e.g. LateralChoice-v0")
    parser.add_argument("-f", "--folder", default=str(TRAINED_AGENTS), help="log folder; default: the shipped agents")
    parser.add_argument("--exp-id", type=int, default=0, help="experiment number; default: the latest")
    parser.add_argument("--load-best", action="store_true", help="best model of the training's evaluations")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    parser.add_argument("--episodes", type=int, default=1, help="episodes of a film, one after the other")
    parser.add_argument("--physics", help="fidelity of the robot; default: the environment's")
    add_env_kwargs(parser)
    parser.add_argument(
        "--uncertainty",
        help="shown to the policy instead of the encoder's, in a film: a number, or a .csv file with the columns "
        "'seconds' or 'decisions', and 'sigma'",
    )
    parser.add_argument(
        "--policy",
        choices=("deployment", "privileged"),
        default="deployment",
        help="privileged: shown the truth, as in the paper's Fig. 7; in a film",
    )
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments of your own")
    arguments = parser.parse_args()
    if arguments.replay is not None and (arguments.uncertainty or arguments.policy != "deployment" or arguments.episodes != 1):
        parser.error("--uncertainty, --policy and --episodes are for films: --film FILE")
    if arguments.episodes < 1:
        parser.error(f"--episodes {arguments.episodes}: at least one is needed")
    return arguments


def add_env_kwargs(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of a command line that takes arguments for the environment, as the zoo's do
    """
    from rl_zoo3.utils import StoreDict

    text = "arguments of the environment, e.g. length:6 name:\"'a'\"; default: none, whatever the agent was trained with"
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict, default={}, metavar="NAME:VALUE", help=text)


def write(arguments: argparse.Namespace) -> None:
    """
    Write the film or the page.

    :param arguments: of :func:`parse_arguments`
    :raises ValueError: if there is no such agent, it cannot be shown or the uncertainty makes no sense
    """
    from sb3_uspl.evaluate import load_agent

    uncertainty = read_uncertainty(arguments.uncertainty) if arguments.uncertainty is not None else None
    given, kwargs = (arguments.algo, arguments.env, arguments.folder, arguments.exp_id), env_kwargs(arguments)
    model, venv = load_agent(*given, arguments.load_best, n_envs=1, env_kwargs=kwargs)
    venv.close()
    if arguments.film is None:
        write_replay_page(model, venv, arguments)
        return
    _check_plain(venv)
    from sb3_uspl.film import film

    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    with contextlib.closing(make_for_pictures(arguments.env, kwargs)) as env:
        film({arguments.algo: model}, env, seeds, arguments.film, uncertainty, arguments.policy)
    print(arguments.film)


def write_replay_page(model: BaseAlgorithm, venv: VecEnv, arguments: argparse.Namespace) -> None:
    """
    Write the episode ``arguments.seed`` of the deployment policy as the page ``arguments.replay``.

    :param model: the agent
    :param venv: its environments, only asked for what they are wrapped in
    :param arguments: with ``env``, ``env_kwargs``, ``algo``, ``physics``, ``seed`` and ``replay``
    :raises ValueError: if it cannot be shown
    """
    from sb3_uspl.replay import write_replay

    _check_plain(venv)
    with contextlib.closing(gym.make(arguments.env, **env_kwargs(arguments))) as env:
        title = f"{arguments.env}: {arguments.algo}, deployment policy, seed {arguments.seed}"
        write_replay(model, env, arguments.seed, arguments.replay, title)


def _check_plain(venv: VecEnv) -> None:
    if unwrap_vec_normalize(venv) is not None:
        raise ValueError("The agent was trained under VecNormalize; films and replays run in the plain environment.")


def env_kwargs(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    :param arguments: with ``env_kwargs`` and ``physics``
    :return: arguments of the environment
    :raises ValueError: if the two name different physics
    """
    other = arguments.env_kwargs.get("physics", arguments.physics)
    if arguments.physics and other != arguments.physics:
        raise ValueError(f"--physics {arguments.physics}, but --env-kwargs says '{other}': name one of them.")
    return {**arguments.env_kwargs, **({"physics": arguments.physics} if arguments.physics else {})}


def make_for_pictures(env_id: str, kwargs: dict[str, Any]) -> gym.Env:
    """
    :param env_id: name of an environment
    :param kwargs: for it
    :return: the environment, with ``render_mode="rgb_array"`` if it has that
    """
    env = gym.make(env_id, **kwargs)
    if "rgb_array" not in env.metadata.get("render_modes", ()):
        return env
    env.close()
    return gym.make(env_id, render_mode="rgb_array", **kwargs)


def run(command: str) -> bool:
    """
    Do what ``--film`` or ``--replay`` ask for, if the command line has one of them; end with a message if it cannot be done.

    :param command: name of the module
    :return: whether that was so
    """
    if not is_asked_for():
        return False
    try:
        write(parse_arguments(command))
    except (ValueError, DependencyNotInstalled) as error:
        raise SystemExit(str(error)) from error
    return True
