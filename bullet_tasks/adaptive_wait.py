"""Waiting for a message from another process, without sleeping where it is about to come."""

import functools
import select
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

SOON = 3e-4
"""Messages that come within this time are waited for awake, s: to be woken takes about as long as some worlds' whole step."""


class AdaptiveWait:
    """
    Waits awake for a moment, then asleep; asleep from the start if the last message came late, so that a process that waits
    for an update of the networks leaves its core to others (adaptive spinning, as of mutexes).

    :param connection: where messages come from
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._is_there = _glance(connection)
        self._came_soon = True

    def wait(self, timeout: float | None) -> bool:
        """
        Wait for a message, or for the connection's end.

        :param timeout: s that are waited asleep at most; None for ever
        :return: whether there is one
        """
        began = time.perf_counter()
        while self._came_soon and time.perf_counter() - began < SOON:
            if self._is_there():
                return True
        there = self._connection.poll(timeout)
        self._came_soon = there and time.perf_counter() - began < SOON
        return there


def _glance(connection: Connection) -> Callable[[], object]:
    """What tells at once whether there is a message; ``Connection.poll`` makes a selector each time, ten times as slow."""
    if not hasattr(select, "poll"):
        return functools.partial(connection.poll, 0)
    poller = select.poll()
    poller.register(connection.fileno(), select.POLLIN)
    return functools.partial(poller.poll, 0)
