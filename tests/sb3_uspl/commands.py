"""The command lines, called by tests."""

import contextlib
import io
import os
import runpy
import subprocess
import sys
from types import SimpleNamespace
from unittest import mock

ENV = "TargetReaching-v0"
SMALL = ("n_envs:8", "n_steps:32", "batch_size:64", "learning_rate_floor:0.1")


def run(module, *arguments):
    """The command in this process: importing torch and the zoo anew takes longer than what most of these tests do."""
    stdout, stderr = io.StringIO(), io.StringIO()
    code: object = 0
    with (
        mock.patch.object(sys, "argv", [module, *arguments]),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        try:
            runpy.run_module(module, run_name="__main__")
        except SystemExit as end:
            code = end.code
    # What the interpreter would do with it.
    message, code = (code, 1) if isinstance(code, str) else ("", code or 0)
    return SimpleNamespace(returncode=code, stdout=stdout.getvalue(), stderr=stderr.getvalue() + message)


def run_apart(*arguments, timeout=300, **environment):
    env = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, env=env, timeout=timeout)


def train(folder, algo="uspl_ppo", n=1024, *arguments, small=SMALL, run=run):
    command = ("sb3_uspl.train", "--algo", algo, "--env", ENV, "-f", str(folder), "-n", str(n), "--seed", "1")
    encoder = () if algo == "resel_ppo" else ("encoder_updates:1",)
    result = run(*command, *arguments, "-params", *small, *encoder)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
