"""Scenes that sensors are compared in, and how far points are from the outlines of shapes."""

import math

import gymnasium
import numpy as np

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Cylinder, Shape


def random_scene(rng, n_boxes=12, n_cylinders=4, extent=3.0):
    """Turned boxes and cylinders of all sizes on a floor, with a drop around, and one shape that is not solid."""
    shapes: list[Shape] = [
        Box("floor", (0.3, -0.2, -0.5), (2.5, 2.0, 0.5), yaw=0.3, floor=True),
        Box("picture", (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), solid=False),
    ]
    for i in range(n_boxes):
        half = tuple(rng.uniform(0.05, 0.6, 3))
        shapes.append(Box(f"box_{i}", (*rng.uniform(-extent, extent, 2), half[2]), half, yaw=rng.uniform(-math.pi, math.pi)))
    for i in range(n_cylinders):
        half_height = rng.uniform(0.05, 0.6)
        centre = (*rng.uniform(-extent, extent, 2), half_height)
        shapes.append(Cylinder(f"cylinder_{i}", centre, rng.uniform(0.05, 0.6), half_height))
    return SceneSpec(tuple(shapes), lower_ground=-0.8)


def task_scenes(env_id, n):
    """The scenes of a task's first episodes."""
    env = gymnasium.make(env_id)
    scenes = []
    for seed in range(n):
        env.reset(seed=seed)
        scenes.append(env.unwrapped.world.scene)
    env.close()
    return scenes


def distance_to_outline(shape, points):
    """
    How far points are from the rim of a shape seen from above, m.

    :param shape: a box or a cylinder
    :param points: ``(n, 2)``
    """
    dx, dy = (points - np.array(shape.centre[:2])).T
    if isinstance(shape, Cylinder):
        return np.abs(np.hypot(dx, dy) - shape.radius)
    c, s = math.cos(shape.yaw), math.sin(shape.yaw)
    outside = np.abs(np.stack([c * dx + s * dy, c * dy - s * dx])) - np.array(shape.half_extents[:2])[:, None]
    return np.where((outside < 0).all(axis=0), -outside.max(axis=0), np.hypot(*np.maximum(outside, 0.0)))
