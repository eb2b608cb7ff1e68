"""Scenes and poses that sensors are compared in, and where edges are, about which two ways of seeing may differ."""

import dataclasses
import math

import gymnasium
import numpy as np

from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import CameraPose, Intrinsics
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.shapes import Box, Cylinder, Shape

CLEARANCE = 0.05  # m; PyBullet's renderer looks through what is closer than 1 cm


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


def clear_poses(scene, rng, n, extent=1.5):
    """Poses of a camera around a scene's solid shapes, not within one nor with one right before the lens."""
    eye = CompiledDepth(Intrinsics.from_field_of_view(40, 30, math.radians(110.0)), 1.0)
    eye.reset(scene)
    centres = [shape.centre[:2] for shape in scene.shapes if shape.solid]
    poses = []
    while len(poses) < n:
        x, y = np.array(centres[rng.integers(len(centres))]) + rng.uniform(-extent, extent, 2)
        pose = CameraPose(x, y, rng.uniform(0.1, 0.9), rng.uniform(-4.0, 4.0), rng.uniform(-0.3, 0.6))
        if eye.render(pose).min() > CLEARANCE:
            poses.append(pose)
    return poses


def depth_bounds(intrinsics, far, scene, pose, shift, cylinder_scale=1.0):
    """
    The least and the greatest depth that we cast if the pixels were moved by ``shift`` in all directions, m.

    They are equal but for rounding on a face that is seen head-on, and far apart at the edge of a shape.

    :param cylinder_scale: of the thinnest cylinders that count
    """
    shapes = [
        dataclasses.replace(shape, radius=shape.radius * cylinder_scale) if isinstance(shape, Cylinder) else shape
        for shape in scene.shapes
    ]
    depths = []
    for seen in (scene, SceneSpec(tuple(shapes), scene.lower_ground)):
        for dx, dy in ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            centre = {"centre_x": intrinsics.centre_x + shift * dx, "centre_y": intrinsics.centre_y + shift * dy}
            caster = CompiledDepth(dataclasses.replace(intrinsics, **centre), far)
            caster.reset(seen)
            depths.append(caster.render(pose))
    return np.min(depths, axis=0), np.max(depths, axis=0)
