"""Scenes as arrays, which compiled sensors read."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Shape

X, Y, COS, SIN, HALF_X, HALF_Y, BOTTOM, TOP, ROUND = range(9)
"""Columns of ``SceneArrays.shapes``: centre (m), direction of the shape's x axis, half edges or twice the radius (m), heights
of the lower and the upper face (m), 1 for a cylinder and 0 for a box."""
_N_COLUMNS = 9


class SceneArrays(NamedTuple):
    """
    One or several scenes: what physics knows of them.

    Only solid shapes are there. Those that are not, such as goal markers, guide the eye and cannot be sensed; whether a shape
    is a floor does not matter.
    """

    shapes: np.ndarray
    """Float64 ``(n_shapes, 9)``, the shapes of all scenes one after the other; columns see above."""
    starts: np.ndarray
    """Int64 ``(n_scenes + 1,)``: the shapes of scene i are the rows ``starts[i]`` to ``starts[i + 1]``."""
    ground: np.ndarray
    """Float64 ``(n_scenes,)``: height of the ground around the shapes, m; minus infinity where there is none."""


def _row(shape: Shape) -> tuple[float, ...]:
    x, y, z = shape.centre
    if isinstance(shape, Box):
        half_x, half_y, half_z = shape.half_extents
        return x, y, math.cos(shape.yaw), math.sin(shape.yaw), half_x, half_y, z - half_z, z + half_z, 0.0
    return x, y, 1.0, 0.0, shape.radius, shape.radius, z - shape.half_height, z + shape.half_height, 1.0


def pack(scenes: Sequence[SceneSpec]) -> SceneArrays:
    """
    Put scenes into arrays; 20 shapes take about 20 us, so no scene needs to be kept.

    :param scenes: at least one
    :raises ValueError: if there is none
    """
    if not scenes:
        raise ValueError("`scenes` is empty, but there must be at least one scene to pack.")
    rows: list[tuple[float, ...]] = []
    starts = [0]
    for scene in scenes:
        rows.extend(_row(shape) for shape in scene.shapes if shape.solid)
        starts.append(len(rows))
    shapes = np.array(rows, dtype=np.float64).reshape(-1, _N_COLUMNS)
    return SceneArrays(shapes, np.array(starts, dtype=np.int64), np.array([scene.lower_ground for scene in scenes]))
