"""What ends a flight before its time, as data: one compiled function judges every quadrotor, compiled or not."""

import math
from dataclasses import dataclass

import numpy as np

from bullet_tasks.ends import OUTCOMES, Outcome
from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadrotor_body import QuadrotorState


@dataclass(frozen=True)
class HoverLimits:
    """
    Where a hover counts, and what is a crash.

    :param altitude: of the hover, m
    :param altitude_tolerance: how far from it still counts, m
    :param level_tolerance: how far from level roll and pitch may be, each, rad
    :param hold_time: how long a hover must last, s
    :param crash_speed: greatest vertical speed of a touchdown, m/s
    :param crash_tilt: greatest tilt of a touchdown, rad
    :param flip_tilt: a body tilted further than this has turned over, rad
    :raises ValueError: if a number is not positive and finite
    """

    altitude: float = 1.5
    altitude_tolerance: float = 0.15
    level_tolerance: float = 0.05
    hold_time: float = 1.0
    crash_speed: float = 1.1
    crash_tilt: float = 0.35
    flip_tilt: float = 1.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"`{name}` of a hover must be positive and finite, got {value}.")


class HoverEnds:
    """
    A judge of one episode that compiled quadrotors can take along: a hover that has been held, or a crash.

    :param limits: where a hover counts, and what is a crash
    """

    def __init__(self, limits: HoverLimits) -> None:
        # The fields are in the order of the kernels' entries; `dataclasses.astuple` takes most of a reset's time.
        self.limits = np.array(tuple(vars(limits).values()), dtype=np.float64)
        """As the compiled functions take them, ``(N_ENDS,)``."""
        self.since = kernels.NOT_HOVERING
        """Time from which on the robot has hovered where it should, s."""

    def __call__(self, state: RobotState) -> Outcome:
        """
        Judge the robot after a substep.

        :param state: of a quadrotor
        """
        assert isinstance(state, QuadrotorState)
        code, self.since = kernels.judge(
            self.limits,
            state.altitude,
            state.roll,
            state.pitch,
            state.impact,
            state.impact_tilt,
            state.time,
            self.since,
        )
        return OUTCOMES[code]
