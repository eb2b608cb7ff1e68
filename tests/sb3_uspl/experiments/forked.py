"""Children for the runner that are forks of this process: the same commands, without seconds of imports each."""

import contextlib
import os
import runpy
import signal
import subprocess
import sys
import time
import traceback

import torch as th


def _let_go_of_files():
    """
    As Popen does: a child that outlives the runner must not hold its lock. But the numbers stay taken, as the parent's objects
    close them when they are collected here, too, whosever they are by then.
    """
    null = os.open(os.devnull, os.O_RDWR)
    for number in range(3, 1024):
        with contextlib.suppress(OSError):
            os.fstat(number)
            os.dup2(null, number)


class ForkedChild:
    """``python -m <arguments>``, like ``subprocess.Popen`` as far as the runner uses it."""

    def __init__(self, arguments, log):
        self.status = None
        self.pid = os.fork()
        if self.pid == 0:
            os._exit(self._run(arguments, log))

    @staticmethod
    def _run(arguments, log):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        th.set_num_threads(1)
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        _let_go_of_files()
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        sys.argv = [arguments[0], *arguments[1:]]
        try:
            runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
            status = 0
        except SystemExit as end:
            status = 0 if end.code is None else 1
        except BaseException:
            traceback.print_exc()
            status = 1
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        return status

    def poll(self):
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.status = os.waitstatus_to_exitcode(status)
        return self.status

    def send_signal(self, signum):
        if self.poll() is None:
            os.kill(self.pid, signum)

    def wait(self, timeout=None):
        deadline = None if timeout is None else time.monotonic() + timeout
        while self.poll() is None:
            if deadline is not None and time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("fork", timeout)
            time.sleep(0.02)
        return self.status
