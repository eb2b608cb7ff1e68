"""Where a number comes from: commit and machine."""

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch as th

ROOT = Path(__file__).resolve().parents[2]


def commit() -> str | None:
    """:return: commit of the code, with "+changes" if the working tree differs from it; None outside of a checkout"""
    head = _git("rev-parse", "HEAD")
    if head is None:
        return None
    return head + ("+changes" if _git("status", "--porcelain", "--untracked-files=no") else "")


def machine() -> dict[str, Any]:
    """:return: what a wall time depends on"""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": th.__version__,
        "system": platform.platform(),
    }


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())
