"""What a training left in the zoo's layout: found and loaded, with errors that help."""

import argparse
import os
import sys

import rl_zoo3.utils
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_uspl

LOADING_ERRORS = (AttributeError, KeyError, RuntimeError, TypeError, ValueError, ImportError)
"""What is raised for a model that cannot be loaded depends on where two versions differ."""
_HUB = "rl-trained-agents"
"""The zoo looks for agents of a folder with this name on its hub, too."""


def find_model(
    algo: str,
    env_id: str,
    folder: str,
    exp_id: int = 0,
    best: bool = False,
    checkpoint: str | None = None,
    last_checkpoint: bool = False,
) -> str:
    """
    Look for an agent in ``<folder>/<algo>/<env>_<exp_id>/``.

    :param algo: zoo name of the algorithm
    :param env_id: environment
    :param folder: log folder
    :param exp_id: experiment number; 0 is the latest
    :param best: the best model of the training's evaluations instead of the last one
    :param checkpoint: number of decisions of the checkpoint to take instead
    :param last_checkpoint: take the last checkpoint instead
    :return: path of its ``.zip`` file
    :raises ValueError: if there is none
    """
    name = rl_zoo3.utils.EnvironmentName(env_id)
    try:
        return rl_zoo3.utils.get_model_path(exp_id, folder, algo, name, best, checkpoint, last_checkpoint)[1]
    except (AssertionError, ValueError) as error:
        raise ValueError(f"{error}. Agents are looked for in <folder>/<algo>/<env>_<id>/.") from error


def load_model(algo: str, path: str) -> BaseAlgorithm:
    """
    :param algo: zoo name of the algorithm
    :param path: ``.zip`` file
    :return: the model, on the CPU and without environments
    :raises ValueError: if there is no such file, or another algorithm or version made it
    """
    if not os.path.isfile(path):
        raise ValueError(f"There is no model {path}; expected the .zip file that model.save() writes.")
    try:
        return rl_zoo3.ALGOS[algo].load(path, device="cpu")
    except LOADING_ERRORS as error:
        raise ValueError(why_not_loaded(algo, path, error)) from error


def why_not_loaded(algo: str, path: str, error: Exception) -> str:
    """
    :param algo: zoo name of the algorithm
    :param path: of the model
    :param error: that loading it raised
    :return: message for the user
    """
    return (
        f"{path} cannot be loaded as a model of {algo} ({type(error).__name__}: {error}). Was it trained on other spaces, or "
        f"saved by another algorithm or by other versions than sb3_uspl {sb3_uspl.__version__} and Stable-Baselines3 "
        f"{stable_baselines3.__version__}? Name its algorithm and its environment, install its versions, or train anew."
    )


def check_agent() -> None:
    """End with a message, rather than with the zoo's traceback, if the agent on the command line is missing or unreadable."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-f", "--folder", default=_HUB)
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--load-best", action="store_true")
    parser.add_argument("--load-checkpoint")
    parser.add_argument("--load-last-checkpoint", action="store_true")
    given, _ = parser.parse_known_args()
    # What else is wrong, or a question for help, is the zoo's to answer.
    if {"-h", "--help"} & set(sys.argv) or given.algo not in rl_zoo3.ALGOS or _HUB in given.folder:
        return
    chosen = (given.exp_id, given.load_best, given.load_checkpoint, given.load_last_checkpoint)
    try:
        load_model(given.algo, find_model(given.algo, given.env, given.folder, *chosen))
    except ValueError as error:
        raise SystemExit(str(error)) from error
