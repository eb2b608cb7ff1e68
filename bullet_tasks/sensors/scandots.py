"""Scandots: the heights of the terrain at a grid of points around the robot."""

import math

import numpy as np
from gymnasium import spaces

from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors.base import Sensor
from bullet_tasks.sensors.ray_casting import look_down
from bullet_tasks.sensors.scene_arrays import SceneArrays, pack

_GRID_TOLERANCE = 1e-6
"""How far a range may be from a whole number of spacings, in spacings."""


class Scandots(Sensor):
    """
    How far the terrain at a grid of points lies below the robot's feet, float32 ``(n_points,)`` in m.

    The points move and turn with the robot, but stay level when it tilts. A reading is clip(z - ``standing_height`` - h,
    -``limit``, ``limit``), where z is the height of the robot's base and h that of the highest solid shape at the point, or
    else of the lower ground: 0 on the floor that the robot stands on, 0.8 over a drop of 0.8 m, -1 on a wall of 1 m, ``limit``
    where nothing is. The numbers are of the order of one, so they are not scaled. Points are ordered by their forward
    coordinate, then by their sideways one, both ascending.

    Defaults are the authors' release's: 12 x 11 points. Unlike there, terrain is exact instead of a grid
    of 5 cm cells, and every reading is of the moment; the release renews them every 0.1 s.

    :param forward: least and greatest forward coordinate, m
    :param sideways: least and greatest coordinate to the left, m
    :param spacing: distance of neighbouring points, m
    :param standing_height: height of the base above the floor that reads as 0, m
    :param limit: greatest absolute reading, m
    :raises ValueError: if a number is not a possible choice, or a range is not a whole number of spacings
    """

    def __init__(
        self,
        forward: tuple[float, float] = (-0.45, 1.20),
        sideways: tuple[float, float] = (-0.75, 0.75),
        spacing: float = 0.15,
        standing_height: float = 0.3,
        limit: float = 2.0,
    ) -> None:
        for name, value in (("spacing", spacing), ("limit", limit)):
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"`{name}` must be a positive finite length in metres, got {value}.")
        if not math.isfinite(standing_height):
            raise ValueError(f"`standing_height` must be a finite length in metres, got {standing_height}.")
        along, across = _ticks("forward", forward, spacing), _ticks("sideways", sideways, spacing)
        self.points = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
        """Forward and left coordinates of the points, m, ``(n_points, 2)``."""
        self.standing_height = standing_height
        self.limit = limit
        self.space = spaces.Box(-limit, limit, (len(self.points),), np.float32)
        self._rows = np.ascontiguousarray(self.points.T)
        self._reach = float(np.hypot(*self._rows).max())
        self._scene: SceneArrays | None = None
        self._pose = np.empty((1, 4))

    def reset(self, scene: SceneSpec, rng: np.random.Generator) -> None:
        """
        Take the scene of an episode (see base class).

        :param scene: the world of this episode
        :param rng: not used, the heights are exact
        """
        self._scene = pack((scene,))

    def read(self, state: RobotState) -> np.ndarray:
        """
        Look down from where the robot is (see base class).

        :param state: of the robot
        :return: float32 ``(n_points,)``, m
        :raises RuntimeError: before the first ``reset``
        """
        if self._scene is None:
            raise RuntimeError("The scandots have no scene yet; call `reset` before `read`.")
        self._pose[0] = state.x, state.y, state.z, state.yaw
        readings = np.empty((1, len(self.points)), dtype=np.float32)
        look_down(*self._scene, self._pose, self._rows, self._reach, self.standing_height, self.limit, readings)
        return readings[0]


def _ticks(name: str, bounds: tuple[float, float], spacing: float) -> np.ndarray:
    """
    Evenly spaced coordinates from one bound to the other.

    :param name: of the range, for the message
    :param bounds: least and greatest coordinate, m
    :param spacing: m
    :raises ValueError: if the bounds are not in order, or not a whole number of spacings apart
    """
    least, greatest = bounds
    if not (math.isfinite(least) and math.isfinite(greatest) and least <= greatest):
        raise ValueError(f"`{name}` must be (least, greatest) in metres, got {bounds}.")
    steps = (greatest - least) / spacing
    if abs(steps - round(steps)) > _GRID_TOLERANCE:
        raise ValueError(f"`{name}` {bounds} must span a whole number of spacings of {spacing} m, but spans {steps:.3f}.")
    return np.linspace(least, greatest, round(steps) + 1)
