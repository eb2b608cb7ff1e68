"""``python -m sb3_uspl.export``: the deployment policy as an ONNX or TorchScript file, and a JSON card that explains it."""

import argparse
import contextlib
import importlib.util
import inspect
import json
import logging
import math
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

import sb3_uspl
from sb3_uspl.deployment import NEXT, DeploymentPolicy, Signal
from sb3_uspl.observations import PRIVILEGED, UNCERTAINTY

SUFFIXES = {"onnx": ".onnx", "torchscript": ".pt"}
_CARD = ".json"
_ONNX_PACKAGES = ("onnx", "onnxscript")
_TRACED_ROBOTS = 2
"""One would be taken for a constant of the graph."""


def export_policy(
    model: BaseAlgorithm,
    out: Path,
    file_format: str = "onnx",
    horizon: int = 1024,
    decision_period: float | None = None,
    normalize: VecNormalize | None = None,
    **notes: Any,
) -> dict[str, Any]:
    """
    Write the deployment policy and, beside it, its card ``<name>.json``.

    :param model: trained ``USPLPPO``, ``RMA`` or ``RESeLPPO``
    :param out: file to write; the format's suffix is added if it has none
    :param file_format: "onnx" or "torchscript"
    :param horizon: decisions that a Transformer remembers, see ``DeploymentPolicy``
    :param decision_period: s per decision; None asks the model
    :param normalize: the environments' normalisation, if the model was trained under one
    :param notes: further entries of the card
    :return: the card
    :raises ValueError: for an unknown format, a file that cannot be written, a missing package or a policy that cannot be
        exported
    """
    if file_format not in SUFFIXES:
        raise ValueError(f"format='{file_format}': choose one of {sorted(SUFFIXES)}.")
    missing = [name for name in _ONNX_PACKAGES if importlib.util.find_spec(name) is None]
    if file_format == "onnx" and missing:
        raise ValueError(
            f'ONNX needs {missing}, which the extra brings: pip install -e ".[export]". TorchScript does without.'
        )
    if out.is_dir() or out.suffix == _CARD:
        raise ValueError(f"{out} {'is a folder' if out.is_dir() else 'is what the card is called'}: name the policy's file.")
    policy = DeploymentPolicy(model.policy, horizon, normalize)
    path = out if out.suffix else out.with_suffix(SUFFIXES[file_format])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error}") from error
    with _quiet():
        (_write_onnx if file_format == "onnx" else _write_torchscript)(policy, path)
    period = getattr(model, "decision_period", None) if decision_period is None else decision_period
    head = {"file": path.name, "format": file_format, "algorithm": type(model).__name__, "decision_period_s": period}
    card = {**head, **_describe(policy), **notes}
    path.with_suffix(_CARD).write_text(json.dumps(card, indent=2) + "\n")
    return card


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporters warn of constants, which are meant to be constants, and of packages that are not needed."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _write_onnx(policy: DeploymentPolicy, path: Path) -> None:
    robots = th.export.Dim("n_robots")
    th.onnx.export(
        policy,
        tuple(part.start(_TRACED_ROBOTS) for part in policy.inputs),
        path,
        input_names=[part.name for part in policy.inputs],
        output_names=[part.name for part in policy.outputs],
        dynamic_shapes=(tuple({0: robots} for _ in policy.inputs),),
        external_data=False,
        verbose=False,
    )


def _write_torchscript(policy: DeploymentPolicy, path: Path) -> None:
    traced = th.jit.trace(policy, tuple(part.start(_TRACED_ROBOTS) for part in policy.inputs))
    th.jit.save(traced, str(path))


def _describe(policy: DeploymentPolicy) -> dict[str, Any]:
    network = policy.policy
    action, *others = policy.outputs
    privileged = network.contract[PRIVILEGED]
    return {
        "arrays": "the first axis of every array is the robots, of any number; 'shape' leaves it out",
        "deterministic": True,
        "normalisation": "none is needed: raw observations go in (images: channels first), the robot's action comes out",
        "inputs": [part.name for part in policy.inputs],
        "outputs": [part.name for part in policy.outputs],
        "observation": [_card(part, network.contract[part.name]) for part in policy.inputs if part.initial is None],
        "action": _card(action, network.action_space),
        "memory": [
            {"input": part.name, "output": NEXT + part.name, **_card(part, name=None), "initial": part.initial}
            for part in policy.inputs
            if part.initial is not None
        ],
        "belief": [_card(part, privileged) for part in others if part.name == "belief_mean"]
        + [_card(part) for part in others if part.name == NEXT + UNCERTAINTY],
        "versions": {"sb3_uspl": sb3_uspl.__version__, "torch": th.__version__},
    }


def _card(part: Signal, space: spaces.Space | None = None, **changes: Any) -> dict[str, Any]:
    entries = {
        "name": part.name,
        "dtype": part.dtype,
        "shape": [int(n) for n in part.shape],
        "meaning": part.meaning,
        **changes,
    }
    if isinstance(space, spaces.Box):
        entries |= {"low": _bound(space.low), "high": _bound(space.high)}
    elif space is not None:
        entries["values"] = str(space)
    return {key: value for key, value in entries.items() if value is not None}


def _bound(limits: np.ndarray) -> Any:
    """One number if they are all the same; None for no limit, as JSON knows no infinity."""
    if limits.size and (limits == limits.flat[0]).all():
        limit = float(limits.flat[0])
        return limit if math.isfinite(limit) else None
    return [value if math.isfinite(value) else None for value in limits.ravel().tolist()]


def parse_arguments() -> argparse.Namespace:
    """:return: command line"""
    from sb3_uspl._episode import add_env_kwargs
    from sb3_uspl._zoo import ALGORITHMS, TRAINED_AGENTS

    parser = argparse.ArgumentParser(prog="python -m sb3_uspl.export", description=__doc__)
    parser.add_argument("--algo", default="uspl_ppo", choices=sorted(ALGORITHMS), help="algorithm")
    parser.add_argument("--env", required=True, help="environment, e.g. LateralChoice-v0")
    parser.add_argument("--format", default="onnx", choices=sorted(SUFFIXES), help="of the file")
    parser.add_argument("--path", help="model to export, a .zip file; default: looked for in the log folder")
    parser.add_argument("-f", "--folder", default=str(TRAINED_AGENTS), help="log folder; default: the shipped agents")
    parser.add_argument("--exp-id", type=int, default=0, help="experiment number; default: the latest")
    parser.add_argument("--load-best", action="store_true", help="best model of the training's evaluations")
    parser.add_argument("--horizon", type=int, help="decisions that a Transformer remembers; default: the longest episode")
    add_env_kwargs(parser)
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules to import, for environments of your own")
    parser.add_argument("-o", "--out", required=True, type=Path, help="file to write; its card lies beside it")
    return parser.parse_args()


def main() -> None:
    """Load, write, tell."""
    arguments = parse_arguments()
    with contextlib.redirect_stdout(sys.stderr):  # the zoo prints too
        try:
            card = _export(arguments)
        except (ValueError, ModuleNotFoundError) as error:
            raise SystemExit(str(error)) from error
    print(f"{card['file']} and its card in {arguments.out.parent.resolve()}")


def _export(arguments: argparse.Namespace) -> dict[str, Any]:
    from sb3_uspl._zoo import register
    from sb3_uspl.evaluate import load_agent

    register(arguments.gym_packages)
    kwargs, chosen = arguments.env_kwargs, (arguments.exp_id, arguments.load_best)
    model, venv = load_agent(arguments.algo, arguments.env, arguments.folder, *chosen, 1, kwargs, arguments.path)
    try:
        normalize = unwrap_vec_normalize(venv)
    finally:
        venv.close()
    with contextlib.closing(gym.make(arguments.env, **kwargs)) as env:
        world: Any = env.unwrapped
        period = getattr(world, "decision_period", None)
        steps = env.spec.max_episode_steps if env.spec is not None else None
        text = (inspect.getdoc(getattr(world, "task", world)) or "").split(":param")[0].strip()
    horizon = arguments.horizon if arguments.horizon is not None else steps or getattr(model, "context_length", None) or 1024
    notes = {"environment": arguments.env, "units_and_task": text}
    return export_policy(model, arguments.out, arguments.format, horizon, period, normalize, **notes)


if __name__ == "__main__":
    main()
