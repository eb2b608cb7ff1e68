"""The machine that the numbers are from, and how busy it was."""

import importlib.metadata
import os
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

import torch as th

ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = ("torch", "numpy", "stable-baselines3", "sb3-contrib", "gymnasium", "pybullet", "numba")
_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_QUIET_LOAD = 0.25
"""Load average a core up to which a machine counts as quiet."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def load() -> list[float]:
    """Load averages over 1, 5 and 15 minutes; empty where the system has none."""
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else []


def busy() -> str | None:
    """A warning if others use the machine now, else None."""
    average = load()
    if not average or average[0] <= _QUIET_LOAD * cores():
        return None
    return f"The load average is {average[0]} on {cores()} core(s): others use this machine, its numbers mean little."


def describe() -> dict[str, Any]:
    """Processor, versions, threads and commit; plain data."""
    return {
        "time": time.strftime("%Y-%m-%d %H:%M:%S"),
        "processor": _processor(),
        "cores": cores(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "torch_threads": th.get_num_threads(),
        "thread_settings": {name: os.environ.get(name) for name in _THREAD_SETTINGS},
        "commit": _commit(),
        "load": load(),
    }


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    for line in path.read_text().splitlines() if path.is_file() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit, and whether files differ from it."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude=*"], cwd=ROOT, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return described.stdout.strip()
