"""Where the time of a training iteration goes, measured from outside: timed methods take the place of public ones."""

import contextlib
import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_uspl import USPLPPO
from sb3_uspl.wrappers import UncertaintyVecWrapper

SIMULATION, ENCODER, UNCERTAINTY = "simulation", "encoder at rollout", "blurring, scaling, smoothing"
POLICY, PPO_UPDATE, ENCODER_UPDATE, REBUILD = "policy and buffers", "PPO update", "encoder update", "memory rebuild"
PHASES = (SIMULATION, ENCODER, UNCERTAINTY, POLICY, PPO_UPDATE, ENCODER_UPDATE, REBUILD)
"""An iteration of USPL. What the first three and the updates leave of a rollout is the policy's and the buffers' time."""


class Stopwatch:
    """
    Seconds by phase. Within a phase another one may begin, which stops the outer one's clock; the inner parts of a whole
    phase count as its own.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running: list[tuple[str, bool]] = []
        self._since = 0.0

    @contextlib.contextmanager
    def phase(self, name: str, whole: bool = False) -> Iterator[None]:
        """
        :param name: of the phase
        :param whole: whether phases within it count as this one
        """
        if self._running and self._running[-1][1]:
            yield
            return
        self._book()
        self._running.append((name, whole))
        try:
            yield
        finally:
            self._book()
            self._running.pop()

    def _book(self) -> None:
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1][0]] += now - self._since
        self._since = now

    def timed(self, function: Callable[..., Any], name: str, whole: bool = False) -> Callable[..., Any]:
        """
        A function whose calls are a phase.

        :param function: to time
        :param name: of the phase
        :param whole: see :meth:`phase`
        """

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            with self.phase(name, whole):
                return function(*args, **kwargs)

        return call


@contextlib.contextmanager
def watch_phases(model: USPLPPO) -> Iterator[Stopwatch]:
    """
    Time the ``PHASES`` of everything that a model learns within this context.

    :param model: USPLPPO or RMA
    """
    stopwatch, env = Stopwatch(), model.get_env()
    places: list[tuple[Any, str, str, bool]] = [
        (env, "step_async", SIMULATION, False),
        (env, "step_wait", SIMULATION, False),
        (model.policy.encoder, "step", ENCODER, False),
        (UncertaintyVecWrapper, "step_async", UNCERTAINTY, False),
        (UncertaintyVecWrapper, "step_wait", UNCERTAINTY, False),
        (UncertaintyVecWrapper, "rebuild_memory", REBUILD, True),
        (model, "collect_rollouts", POLICY, False),
        # The super().train() of USPLPPO.train, which is the encoder's update beyond it.
        (PPO, "train", PPO_UPDATE, False),
        (model, "train", ENCODER_UPDATE, False),
    ]
    with contextlib.ExitStack() as stack:
        for owner, method, name, whole in places:
            # What has been renamed since is counted in the phase around it.
            if hasattr(owner, method):
                timed = stopwatch.timed(getattr(owner, method), name, whole)
                stack.enter_context(mock.patch.object(owner, method, timed))
        yield stopwatch


@contextlib.contextmanager
def watch_rollouts(model: OnPolicyAlgorithm) -> Iterator[Stopwatch]:
    """
    Time the rollouts of any algorithm, as one phase ``POLICY``, within this context.

    :param model: any on-policy algorithm of SB3
    """
    stopwatch = Stopwatch()
    with mock.patch.object(model, "collect_rollouts", stopwatch.timed(model.collect_rollouts, POLICY)):
        yield stopwatch
