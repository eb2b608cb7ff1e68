"""``python -m sb3_uspl.experiments.measure <cell folder> <result.json>``: evaluate a trained cell. The runner calls it."""

import json
import sys
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_uspl._zoo import register
from sb3_uspl.evaluate import load_agent
from sb3_uspl.evaluation import evaluate
from sb3_uspl.experiments.plan import Cell
from sb3_uspl.experiments.provenance import commit, machine
from sb3_uspl.experiments.recording import N_EPISODES, record_all
from sb3_uspl.experiments.store import CellFolder
from sb3_uspl.policies import USPLPolicy

N_ENVS = 50


def measure(folder: CellFolder, target: Path) -> None:
    """
    Evaluate the last model and the best one, record some episodes of the best one, and write it all down.

    :param folder: of a trained cell
    :param target: JSON file to write; recorded episodes go beside it
    """
    begin, cell, state = time.monotonic(), folder.cell, folder.state
    best, last = folder.best_attempt(), folder.attempts()[-1]
    models = {"last": _evaluate(folder, last.number, False, None)}
    target.parent.mkdir(parents=True, exist_ok=True)
    episodes_file = target.with_suffix(".npz")
    # A training shorter than the time to its first evaluation has a last model only.
    models["best"] = _evaluate(folder, (best or last).number, best is not None, episodes_file)
    result = {
        "cell": cell.to_json(),
        "seed": cell.seed,
        "episodes": cell.episodes,
        "configuration": cell.configuration,
        "commit": commit(),
        "machine": machine(),
        "finished": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "training": {
            "wall_time": sum(state["wall_times"]),
            "attempts": len(state["wall_times"]),
            "jobs": max(state["jobs"], default=1),
            "commits": state["commits"],
            "decisions": folder.decisions(),
            "seconds_per_iteration": folder.seconds_per_iteration(),
        },
        "learning_curve": folder.learning_curve(),
        "models": models,
        "evaluation_wall_time": time.monotonic() - begin,
    }
    # Whole or not at all: the file says that the cell is finished.
    unfinished = target.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(result, indent=1) + "\n")
    unfinished.replace(target)


def _evaluate(folder: CellFolder, number: int, best: bool, episodes_file: Path | None) -> dict[str, Any]:
    cell = folder.cell
    n_envs = max(min(N_ENVS, cell.episodes), N_EPISODES)
    model, venv = load_agent(cell.algo, cell.env, str(folder.train), number, best, n_envs, cell.env_kwargs or None)
    try:
        result = evaluate(model, venv, cell.episodes)
        if episodes_file is not None and isinstance(model.policy, USPLPolicy):
            with gym.make(cell.env, **cell.env_kwargs) as env:
                np.savez_compressed(episodes_file, **record_all(model, venv, env))  # type: ignore[arg-type]
    finally:
        venv.close()
    return result


def main() -> None:
    """Measure the cell on the command line."""
    folder, target = map(Path, sys.argv[1:])
    cell = Cell(**json.loads((folder / "cell.json").read_text()))
    register()
    th.set_num_threads(1)
    measure(CellFolder(folder.parent, cell), target)


if __name__ == "__main__":
    main()
