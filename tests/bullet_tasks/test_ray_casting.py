"""Laws of the compiled depth images: geometry by hand, and PyBullet's rays."""

import math

import numpy as np
import pytest
from sensor_scenes import clear_poses, depth_bounds, random_scene

from bullet_tasks import kernels
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import CameraPose, Intrinsics, ray_casting
from bullet_tasks.sensors.camera import RELEASE
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.sensors.scene_arrays import pack
from bullet_tasks.shapes import Box, Cylinder
from bullet_tasks.simulation import Simulation

LENS = Intrinsics.from_field_of_view(64, 48, math.radians(87.0))
FAR = 6.0
LEVEL = CameraPose(0.0, 0.0, 0.5, 0.0)
# Bullet searches for a ray's hit, which it finds to a few mm, and at the rim of a cylinder sometimes not at all.
TOLERANCE = 5e-3  # m
WRONG_RAYS = 1e-3
WALL = Box("wall", (2.0, 0.0, 0.0), (0.5, 10.0, 10.0))


def image(*shapes, pose=LEVEL, lens=LENS, far=FAR, lower_ground=-math.inf):
    caster = CompiledDepth(lens, far)
    caster.reset(SceneSpec(shapes, lower_ground))
    return caster.render(pose)


def test_columns_are_those_of_the_scenes():
    for name in ("X", "Y", "COS", "SIN", "HALF_X", "HALF_Y", "BOTTOM", "TOP", "ROUND", "SOLID"):
        assert getattr(ray_casting, name) == getattr(kernels, name)


def test_depth_is_measured_along_the_axis():
    # A wall across the view has one depth everywhere, though its rim is further away than its middle.
    np.testing.assert_allclose(image(WALL), 1.5, rtol=1e-6)
    # Turned with the world, nothing changes.
    turned = Box("wall", (0.0, 2.0, 0.0), (0.5, 10.0, 10.0), yaw=math.pi / 2)
    np.testing.assert_allclose(image(turned, pose=CameraPose(0.0, 0.0, 0.5, math.pi / 2)), 1.5, rtol=1e-6)
    # Looking down onto the ground.
    down = image(pose=CameraPose(0.0, 0.0, 0.5, 0.7, math.pi / 2), lower_ground=-0.5)
    np.testing.assert_allclose(down, 1.0, rtol=1e-6)


def test_rows_look_where_the_intrinsics_say():
    # On the ground under a level camera the depth is height / slope of the row, and a column sees one side of a plank's edge.
    depth = image(lower_ground=0.0, far=100.0)
    slope = -LENS.up.astype(float)
    np.testing.assert_allclose(depth[slope > 0], np.repeat((0.5 / slope[slope > 0])[:, None], 64, axis=1), rtol=1e-5)
    assert (depth[slope < 0] == 100.0).all()
    left_half = Box("left", (2.0, 5.0, 0.0), (0.5, 5.0, 10.0))
    depth = image(left_half)
    assert (depth[:, :32] < FAR).all() and (depth[:, 32:] == FAR).all()


def test_a_cylinder_ahead_is_nearest_in_its_middle():
    odd = Intrinsics.from_field_of_view(65, 49, math.radians(87.0))
    depth = image(Cylinder("post", (2.0, 0.0, 0.0), 0.4, 10.0), lens=odd)
    assert depth[:, 32] == pytest.approx(1.6, rel=1e-5)
    # The tangent from a distance of 2 m touches at asin(0.4 / 2).
    seen = np.abs(odd.right) < math.tan(math.asin(0.2))
    assert np.array_equal(depth[20] < FAR, seen)


@pytest.mark.parametrize("seed", range(6))
def test_images_are_pybullets_rays(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    simulation = Simulation()
    scene.build(simulation)
    wrong, edges = [], []
    for pose in clear_poses(scene, rng, 4):
        low, high = depth_bounds(LENS, FAR, scene, pose, shift=0.02)
        ahead, aside, above = (np.subtract(pose.moved(axis)[:3], pose[:3]) for axis in np.eye(3))
        rays = ahead - LENS.right[None, :, None] * aside + LENS.up[:, None, None] * above
        ends = (np.array(pose[:3]) + FAR * rays).reshape(-1, 3)
        hits = simulation.client.rayTestBatch(np.tile(pose[:3], (len(ends), 1)), ends)
        depth = FAR * np.array([hit[2] for hit in hits]).reshape(low.shape)
        wrong.append(np.mean((depth < low - TOLERANCE) | (depth > high + TOLERANCE)))
        edges.append(np.mean(high - low > 0.05))
        assert (depth < FAR).mean() > 0.2
    simulation.close()
    assert np.mean(wrong) < WRONG_RAYS
    assert np.mean(edges) < 0.02, "the bounds must be tight, or this says nothing"


def test_from_within_everything_is_black():
    inside = CameraPose(2.0, 0.0, 0.5, 0.3, 0.2)
    assert not image(WALL, pose=inside).any()
    assert not image(Cylinder("post", (2.0, 0.0, 0.0), 0.4, 1.0), pose=inside).any()
    assert not image(pose=inside, lower_ground=1.0).any()
    behind = image(WALL, pose=CameraPose(2.6, 0.0, 0.5, 0.0))
    assert (behind == FAR).all()


def test_a_ray_along_a_face_does_no_harm():
    # The middle column looks along the wall's face, in whose plane the camera is; the middle row along the floor's.
    odd = Intrinsics.from_field_of_view(65, 49, math.radians(87.0))
    beside = Box("beside", (3.0, 1.0, 0.5), (1.0, 1.0, 0.5))
    floor = Box("floor", (0.0, 0.0, -0.5), (9.0, 9.0, 0.5), floor=True)
    for z in (0.0, 0.5, 1.0):
        depth = image(beside, floor, pose=CameraPose(0.0, 0.0, z, 0.0), lens=odd)
        assert np.isfinite(depth).all()
        assert (depth >= 0.0).all() and (depth <= FAR).all()
    assert depth[24:, :32].min() < 2.1


def test_what_only_guides_the_eye_is_not_seen():
    assert (image(Box("marker", (2.0, 0.0, 0.0), (0.5, 10.0, 10.0), solid=False)) == FAR).all()


def test_many_cameras_see_what_each_would_alone():
    rng = np.random.default_rng(0)
    scenes = [random_scene(rng, n_boxes=n) for n in range(5)] + [SceneSpec((), -0.3)]
    poses = [*(clear_poses(scene, rng, 1)[0] for scene in scenes[:-1]), CameraPose(0.0, 0.0, 0.5, 0.0)]
    caster = CompiledDepth(RELEASE, FAR)
    together = caster.render_all(pack(scenes), np.array(poses))
    for scene, pose, seen in zip(scenes, poses, together, strict=True):
        caster.reset(scene)
        assert np.array_equal(caster.render(pose), seen)
    assert together.std() > 0.5
    with pytest.raises(ValueError, match=r"\(6, 5\)"):
        caster.render_all(pack(scenes), np.array(poses)[:, :4])


@pytest.mark.parametrize("far", [0.0, -1.0, math.inf, math.nan])
def test_bad_depths_are_refused(far):
    with pytest.raises(ValueError, match="far"):
        CompiledDepth(LENS, far)


def test_an_image_needs_a_scene():
    with pytest.raises(RuntimeError, match="reset"):
        CompiledDepth(LENS, FAR).render(CameraPose(0.0, 0.0, 0.5, 0.0))
