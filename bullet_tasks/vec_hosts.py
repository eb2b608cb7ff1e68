"""How ``BulletVecEnv`` reaches the hosts of its environments: one lives in this process, each other one in a worker."""

import _signal  # what `signal` wraps to name handlers by enumerations, which takes 25 us a step
import contextlib
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, NoReturn, Protocol

import gymnasium

from bullet_tasks.adaptive_wait import AdaptiveWait
from bullet_tasks.vec_worker import CLOSE, EnvFns, EnvHost, Reply, Request, run_worker

_LIVENESS_PERIOD = 1.0  # s between two looks at whether a silent worker still lives
_CLOSE_TIMEOUT = 5.0  # s that a worker has to close its environments


class WorkerDied(Exception):
    """A worker process is gone. Its exit code is the argument."""


class Host(Protocol):
    """Takes a request and gives its reply; a reply that nobody has fetched stays."""

    owes_reply: bool
    """Whether there is a request whose reply has not been fetched."""

    def post(self, request: Request) -> None:
        """
        Hand over a request. Does not wait.

        :param request: a method of ``EnvHost`` and its arguments
        :raises WorkerDied: if there is nobody to take it
        """

    def receive(self) -> Reply:
        """
        Wait for the reply.

        :raises WorkerDied: if none will come
        """

    def hang_up(self) -> None:
        """Begin to end; no more requests."""

    def join(self) -> None:
        """End, and free everything."""


class HostHere:
    """
    Environments in this process. Its work is done in ``receive``, while those in other processes are at theirs.

    :param env_fns: make the environments, the first of all
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env]]) -> None:
        self.owes_reply = True
        self._host = EnvHost(env_fns, 0)
        self._request: Request = ("env_spaces", ())

    def post(self, request: Request) -> None:
        """See :class:`Host`."""
        self._request, self.owes_reply = request, True

    def receive(self) -> Reply:
        """See :class:`Host`."""
        with _interrupts_deferred():
            self.owes_reply = False
            return self._host.serve(self._request)

    def hang_up(self) -> None:
        """See :class:`Host`."""

    def join(self) -> None:
        """See :class:`Host`."""
        self._host.close()


class HostInWorker:
    """
    Environments in a process of their own.

    :param context: of ``multiprocessing``
    :param connections: of the other workers that a fork would copy
    :param env_fns: make the environments
    :param first: index of the first of them among all
    :param name: of the process
    """

    def __init__(self, context: Any, connections: Sequence[Connection], env_fns: EnvFns, first: int, name: str) -> None:
        self.owes_reply = True
        self.connection, there = context.Pipe()
        self._wait = AdaptiveWait(self.connection).wait
        inherited = (*connections, self.connection) if context.get_start_method() == "fork" else ()
        arguments = (there, inherited, env_fns, first)
        self.process = context.Process(target=run_worker, args=arguments, name=name, daemon=True)
        self.process.start()
        # Only the worker may hold its end, or its death would go unnoticed.
        there.close()

    def post(self, request: Request) -> None:
        """See :class:`Host`."""
        message = pickle.dumps(request)  # `send` prepares a pickler of its own each time
        with _interrupts_deferred():
            try:
                self.connection.send_bytes(message)
            except OSError:
                self._bury()
            self.owes_reply = True

    def receive(self) -> Reply:
        """See :class:`Host`."""
        try:
            while not self._wait(_LIVENESS_PERIOD):
                # A reply sent just before the end still counts, hence the second look.
                if not self.process.is_alive() and not self.connection.poll(0):
                    self._bury()
            with _interrupts_deferred():
                reply = self.connection.recv_bytes()
                self.owes_reply = False
        except (EOFError, OSError):
            self._bury()
        return pickle.loads(reply)

    def _bury(self) -> NoReturn:
        self.process.join(_CLOSE_TIMEOUT)
        raise WorkerDied(self.process.exitcode) from None

    def hang_up(self) -> None:
        """See :class:`Host`."""
        with contextlib.suppress(OSError, ValueError):
            self.connection.send_bytes(pickle.dumps((CLOSE, ())))
        # Frees a worker that waits for room to send a reply that nobody will read.
        self.connection.close()

    def join(self) -> None:
        """See :class:`Host`."""
        self.process.join(_CLOSE_TIMEOUT)
        if self.process.is_alive():
            self.process.terminate()
            self.process.join(_CLOSE_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """
    A KeyboardInterrupt would leave a world in the middle of a step, or a message half read: it comes at the end of this
    context. A second one comes at once, for what never ends.
    """
    former = _signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(former):
        yield  # only the main thread is interrupted, and a handler that is not Python's could not be put back
        return
    pending: list[int] = []

    def defer(number: int, frame: FrameType | None) -> None:
        if pending:
            pending.clear()
            former(number, frame)
        else:
            pending.append(number)

    _signal.signal(signal.SIGINT, defer)
    try:
        yield
    finally:
        _signal.signal(signal.SIGINT, former)
        if pending:
            signal.raise_signal(signal.SIGINT)
