"""
Start-up time and memory of one vector environment, in a process of its own: ``python -m benchmarks.start_up NAME ...``.

One environment is made and closed before: imports and compilation, which all contenders share, are paid then.
"""

import argparse
import gc
import json
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from benchmarks.contenders import make_env, make_venv
from benchmarks.machine import ROOT
from bullet_tasks.vec_env import BulletVecEnv

VEC_ENVS: dict[str, tuple[type[VecEnv], dict[str, Any]]] = {
    "BulletVecEnv, 1 worker": (BulletVecEnv, {"n_workers": 1}),
    "BulletVecEnv, 2 workers": (BulletVecEnv, {"n_workers": 2}),
    "DummyVecEnv": (DummyVecEnv, {}),
    # The quickest way to start it, and no slower to step than SB3's default.
    "SubprocVecEnv": (SubprocVecEnv, {"start_method": "fork"}),
}
DEFAULT_SUBPROC = "SubprocVecEnv, SB3's start method"
"""With the start method that SB3 chooses: every process imports everything anew."""


class StartUp(NamedTuple):
    """What it takes to start a vector environment."""

    seconds: float
    """Until the first observations."""
    memory: float | None
    """MiB an environment; None where the system does not tell."""


def _proportional_memory() -> float | None:
    """Proportional set size of this process and its workers, MiB; None where the system does not tell."""
    total = 0
    for pid in (os.getpid(), *(process.pid for process in multiprocessing.active_children())):
        path = Path(f"/proc/{pid}/smaps_rollup")
        if not path.is_file():
            return None
        total += sum(int(line.split()[1]) for line in path.read_text().splitlines() if line.startswith("Pss:"))
    return total / 1024.0


def measure_here(name: str, env_id: str, n_envs: int, env_kwargs: dict[str, Any]) -> StartUp:
    """
    Start a vector environment in this process.

    :param name: one of ``VEC_ENVS``, or ``DEFAULT_SUBPROC``
    :param env_id: registered id
    :param n_envs: number of environments
    :param env_kwargs: of the environment
    """
    vec_env_cls, vec_env_kwargs = VEC_ENVS[name] if name in VEC_ENVS else (SubprocVecEnv, {})
    env = make_env(env_id, **env_kwargs)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    gc.collect()
    before, begin = _proportional_memory(), time.perf_counter()
    venv = make_venv(env_id, n_envs, vec_env_cls, vec_env_kwargs=vec_env_kwargs, **env_kwargs)
    try:
        venv.reset()
        seconds, after = time.perf_counter() - begin, _proportional_memory()
    finally:
        venv.close()
    return StartUp(seconds, None if before is None or after is None else (after - before) / n_envs)


def measure(name: str, env_id: str, n_envs: int, env_kwargs: dict[str, Any]) -> StartUp:
    """
    :func:`measure_here` in a fresh process.

    :param name: see there
    :param env_id: see there
    :param n_envs: see there
    :param env_kwargs: see there
    :raises RuntimeError: if the process fails, with what it wrote
    """
    arguments = json.dumps([name, env_id, n_envs, env_kwargs])
    done = subprocess.run([sys.executable, "-m", __name__, arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"Starting {name} with {env_id} failed:\n{done.stderr}")
    return StartUp(*json.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arguments", help="JSON list: arguments of measure_here")
    print(json.dumps(measure_here(*json.loads(parser.parse_args().arguments))))
