"""Scenes of several robots as arrays, which compiled sensors read."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bullet_tasks.scene import SceneSpec


class SceneArrays(NamedTuple):
    """One or several scenes."""

    shapes: np.ndarray
    """Float64 ``(n_shapes, kernels.N_COLUMNS)``: the shapes of all scenes in a row, see ``bullet_tasks.kernels``."""
    starts: np.ndarray
    """Int64 ``(n_scenes + 1,)``: the shapes of scene i are the rows ``starts[i]`` to ``starts[i + 1]``."""
    ground: np.ndarray
    """Float64 ``(n_scenes,)``: height of the ground around the shapes, m; minus infinity where there is none."""


def pack(scenes: Sequence[SceneSpec]) -> SceneArrays:
    """
    Put scenes one after the other; that of a single one takes microseconds, as scenes know their arrays.

    :param scenes: at least one
    :raises ValueError: if there is none
    """
    if not scenes:
        raise ValueError("`scenes` is empty, but there must be at least one scene to pack.")
    starts = np.zeros(len(scenes) + 1, dtype=np.int64)
    starts[1:] = np.cumsum([len(scene.packed) for scene in scenes])
    shapes = scenes[0].packed if len(scenes) == 1 else np.concatenate([scene.packed for scene in scenes])
    return SceneArrays(shapes, starts, np.array([scene.lower_ground for scene in scenes], dtype=np.float64))
