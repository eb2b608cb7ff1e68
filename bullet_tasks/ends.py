"""What ends an episode before its time: as data, so that one function judges every robot, compiled or not."""

import enum
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bullet_tasks import kernels
from bullet_tasks.scene import SceneSpec

if TYPE_CHECKING:
    from bullet_tasks.robots.base import RobotState


class Outcome(enum.Enum):
    """How an episode stands."""

    RUNNING = "running"
    SUCCESS = "success"
    FAILURE = "failure"


Judge = Callable[["RobotState"], Outcome]
"""Says how an episode stands after a substep."""

_CODES = {Outcome.RUNNING: kernels.RUNNING, Outcome.SUCCESS: kernels.SUCCESS, Outcome.FAILURE: kernels.FAILURE}
OUTCOMES = tuple(sorted(_CODES, key=lambda outcome: _CODES[outcome]))
"""The outcome of every code of the compiled functions."""


class Ends:
    """
    A judge that compiled robots can take along: circles on the map and drops.

    :param circles: (x, y, radius in m, outcome for a robot whose base's centre is within or on the rim); the first one counts
    :param scene: the world of the episode
    :param fall_height: over ground lower than this an episode is a failure, m; by default there are no falls
    :raises ValueError: if a circle has no finite centre or no positive radius
    """

    def __init__(
        self, circles: Sequence[tuple[float, float, float, Outcome]], scene: SceneSpec, fall_height: float = -math.inf
    ) -> None:
        for x, y, radius, _ in circles:
            if not (math.isfinite(x) and math.isfinite(y) and 0.0 < radius < math.inf):
                raise ValueError(f"A circle must have a finite centre and a positive radius, got {(x, y)} and {radius} m.")
        rows = [(x, y, radius, _CODES[outcome]) for x, y, radius, outcome in circles]
        self.circles = np.array(rows, dtype=np.float64).reshape(-1, 4)
        """As the compiled functions take them, ``(n, 4)``."""
        self.fall_height = float(fall_height)
        self._scene = (scene.packed, scene.lower_ground)

    def __call__(self, state: "RobotState") -> Outcome:
        """
        Judge the robot after a substep.

        :param state: of the robot
        """
        return OUTCOMES[kernels.judge(self.circles, self.fall_height, *self._scene, state.x, state.y)]
