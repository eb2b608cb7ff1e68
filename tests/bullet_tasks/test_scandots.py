"""Laws of the scandots: they are PyBullet's vertical rays, and their order and sign are the release's."""

import math

import numpy as np
import pytest
from gymnasium import spaces
from sensor_scenes import distance_to_outline, random_scene, task_scenes

from bullet_tasks import ENV_IDS
from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import Scandots
from bullet_tasks.sensors.scene_arrays import pack
from bullet_tasks.shapes import Box, Cylinder
from bullet_tasks.simulation import Simulation

TOLERANCE = 1e-4  # m
RIM = 1e-3  # m; PyBullet and we may differ about what is so close to an edge
N_POSES = 30
SKY = 20.0  # m


def state(x=0.0, y=0.0, z=0.3, yaw=0.0):
    return RobotState(x, y, z, yaw, 0.0, 0.0, False)


def scandots_in(*shapes, lower_ground=-0.8, **options):
    sensor = Scandots(**options)
    sensor.reset(SceneSpec(shapes, lower_ground), np.random.default_rng(0))
    return sensor


def random_poses(rng, n, extent):
    return np.column_stack([rng.uniform(-extent, extent, (n, 2)), rng.uniform(0.0, 1.0, n), rng.uniform(-4.0, 4.0, n)])


def compare_with_rays(scene, poses):
    """Assert that readings are those of PyBullet's rays; how many points lay too close to an edge, and all readings."""
    sensor = Scandots()
    sensor.reset(scene, np.random.default_rng(0))
    readings = np.stack([sensor.read(state(*pose)) for pose in poses])

    c, s = np.cos(poses[:, 3:]), np.sin(poses[:, 3:])
    along, across = sensor.points.T
    x, y = poses[:, :1] + c * along - s * across, poses[:, 1:2] + s * along + c * across
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    simulation = Simulation()
    scene.build(simulation)
    sky, abyss = np.full((len(points), 1), SKY), np.full((len(points), 1), -SKY)
    hits = simulation.client.rayTestBatch(np.hstack([points, sky]), np.hstack([points, abyss]))
    simulation.close()
    height = np.array([hit[3][2] if hit[0] >= 0 else -math.inf for hit in hits]).reshape(readings.shape)

    near_rim = np.zeros(len(points), dtype=bool)
    for shape in scene.shapes:
        near_rim |= shape.solid & (distance_to_outline(shape, points) < RIM)
    expected = np.clip(poses[:, 2:3] - 0.3 - height, -2.0, 2.0)
    clear = ~near_rim.reshape(readings.shape)
    np.testing.assert_allclose(readings[clear], expected[clear], rtol=0.0, atol=TOLERANCE)
    return near_rim.mean(), readings


@pytest.mark.parametrize("seed", range(10))
def test_readings_are_pybullets_rays_in_random_scenes(seed):
    rng = np.random.default_rng(seed)
    excepted, readings = compare_with_rays(random_scene(rng), random_poses(rng, N_POSES, 3.0))
    assert excepted < 0.01
    assert len(np.unique(readings.round(3))) > 30, "there must be many heights to see"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_readings_are_pybullets_rays_in_every_task(env_id):
    rng = np.random.default_rng(0)
    for scene in task_scenes(env_id, 4):
        xy = np.array([shape.centre[:2] for shape in scene.shapes if shape.solid])
        # Around the shapes, where there is something to see.
        poses = random_poses(rng, N_POSES, 1.5)
        poses[:, :2] += xy[rng.integers(len(xy), size=N_POSES)]
        excepted, readings = compare_with_rays(scene, poses)
        assert excepted < 0.05
        assert readings.std() > 0.1


def test_flat_floor_reads_zero_a_drop_positive_and_a_wall_negative():
    floor = Box("floor", (0.0, 0.0, -0.4), (5.0, 1.0, 0.4), floor=True)
    wall = Box("wall", (4.0, 0.0, 0.5), (0.5, 1.0, 0.5))
    sensor = scandots_in(floor, wall)
    assert not sensor.read(state()).any()
    at_the_edge = sensor.read(state(y=0.5)).reshape(12, 11)
    assert at_the_edge[:, :9] == pytest.approx(0.0) and at_the_edge[:, 9:] == pytest.approx(0.8)
    at_the_wall = sensor.read(state(x=3.0)).reshape(12, 11)
    assert at_the_wall[:7] == pytest.approx(0.0) and at_the_wall[7:] == pytest.approx(-1.0)


def test_points_are_the_releases():
    points = Scandots().points
    assert points.shape == (132, 2)
    assert points[0] == pytest.approx((-0.45, -0.75)) and points[-1] == pytest.approx((1.20, 0.75))
    assert points[1] == pytest.approx((-0.45, -0.60)) and points[11] == pytest.approx((-0.30, -0.75))


def test_points_turn_with_the_robot():
    # One point, straight ahead; a post under it only when the robot looks that way.
    post = Cylinder("post", (0.0, 1.0, 0.5), 0.1, 0.5)
    sensor = scandots_in(post, forward=(1.0, 1.0), sideways=(0.0, 0.0))
    assert sensor.read(state(yaw=math.pi / 2)) == pytest.approx([-1.0])
    assert sensor.read(state(yaw=0.0)) == pytest.approx([0.8])
    assert sensor.read(state(y=-0.5, yaw=math.pi / 2)) == pytest.approx([0.8])


def test_readings_are_clipped_and_in_the_space():
    bottomless = scandots_in(Box("tower", (1.0, 0.0, 5.0), (0.5, 5.0, 5.0)), lower_ground=-math.inf)
    readings = bottomless.read(state())
    assert set(readings.tolist()) == {-2.0, 2.0}
    assert isinstance(bottomless.space, spaces.Box) and bottomless.space.shape == (132,)
    assert bottomless.space.contains(readings)


def test_what_only_guides_the_eye_is_not_sensed():
    marker = Cylinder("goal", (0.3, 0.0, 0.0), 0.4, 0.1, solid=False)
    assert (scandots_in(marker).read(state()) == np.float32(0.8)).all()


def test_a_reading_belongs_to_its_receiver():
    sensor = scandots_in(Box("wall", (1.0, 0.0, 0.5), (0.2, 0.2, 0.5)))
    first = sensor.read(state())
    kept = first.copy()
    sensor.read(state(x=0.3))
    assert np.array_equal(first, kept)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"spacing": 0.0}, "spacing.*0.0"),
        ({"limit": math.inf}, "limit"),
        ({"standing_height": math.nan}, "standing_height"),
        ({"forward": (1.0, 0.0)}, "forward.*least, greatest"),
        ({"sideways": (0.0, 0.4)}, "sideways.*whole number of spacings"),
    ],
)
def test_bad_grids_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        Scandots(**options)


def test_a_reading_needs_a_scene():
    with pytest.raises(RuntimeError, match="reset"):
        Scandots().read(state())
    with pytest.raises(ValueError, match="at least one scene"):
        pack([])
