"""Laws of waiting for another process: no message is missed, and only what comes soon is waited for awake."""

import functools
import multiprocessing
import time
from types import SimpleNamespace

import pytest

from bullet_tasks import adaptive_wait
from bullet_tasks.adaptive_wait import SOON, AdaptiveWait

WAKING = SOON / 3  # s that it takes to be woken
GLANCE = SOON / 20  # s that a look takes


class Simulated:
    """A connection and a clock in which messages come when they should."""

    def __init__(self, monkeypatch):
        self.now, self.comes, self.glances, self.naps = 0.0, 0.0, 0, 0
        monkeypatch.setattr(adaptive_wait, "time", SimpleNamespace(perf_counter=lambda: self.now))
        monkeypatch.setattr(adaptive_wait, "_glance", lambda connection: functools.partial(connection.poll, 0))

    def poll(self, timeout):
        if timeout == 0:
            self.glances += 1
            self.now += GLANCE
            return self.now >= self.comes
        self.naps += 1
        late = timeout is not None and self.comes > self.now + timeout
        self.now = self.now + timeout if late else max(self.now, self.comes + WAKING)
        return not late

    def after(self, wait, delay, timeout=None):
        self.comes, self.glances, self.naps = self.now + delay, 0, 0
        return wait(timeout)


def test_what_comes_soon_is_waited_for_awake(monkeypatch):
    connection = Simulated(monkeypatch)
    wait = AdaptiveWait(connection).wait
    for _ in range(3):
        assert connection.after(wait, 0.5 * SOON)
        assert connection.naps == 0 and connection.glances == pytest.approx(10, abs=1)


def test_what_comes_late_is_waited_for_asleep_until_something_comes_soon_again(monkeypatch):
    connection = Simulated(monkeypatch)
    wait = AdaptiveWait(connection).wait
    assert connection.after(wait, 10.0 * SOON) and connection.naps == 1 and connection.glances > 10
    assert connection.after(wait, 10.0 * SOON) and (connection.naps, connection.glances) == (1, 0)
    assert connection.after(wait, 0.5 * SOON) and (connection.naps, connection.glances) == (1, 0)
    assert connection.after(wait, 0.5 * SOON) and connection.naps == 0


def test_nothing_is_said_to_be_there_when_time_is_up(monkeypatch):
    connection = Simulated(monkeypatch)
    wait = AdaptiveWait(connection).wait
    assert not connection.after(wait, 3.0, timeout=1.0)
    assert not connection.after(wait, 3.0, timeout=1.0) and connection.glances == 0


def test_messages_of_a_real_connection_are_not_missed():
    here, there = multiprocessing.Pipe()
    wait = AdaptiveWait(here).wait
    began = time.perf_counter()
    assert not wait(0.05) and time.perf_counter() - began >= 0.05
    there.send("message")
    assert wait(None) and here.recv() == "message"
    there.close()
    assert wait(None), "the other end's death is an event, too"
    with pytest.raises(EOFError):
        here.recv()
    here.close()
