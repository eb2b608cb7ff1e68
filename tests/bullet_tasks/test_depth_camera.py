"""Laws of the depth camera: PyBullet renders the same, and what becomes of a depth on its way into an observation."""

import functools
import math

import numpy as np
import pytest
from sensor_scenes import clear_poses, depth_bounds, random_scene, task_scenes
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from bullet_tasks import ENV_IDS
from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import make_quadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import CameraPose, DepthCamera, DepthNoise, Intrinsics
from bullet_tasks.sensors.camera import RELEASE
from bullet_tasks.sensors.pybullet_depth import PyBulletDepth, gpu_found
from bullet_tasks.shapes import Box, Cylinder
from bullet_tasks.tasks.lateral_choice import LateralChoice

FAR = 6.0
TOLERANCE = 1e-3  # m
# Share of pixels at an edge, where moving the pixel by 1/50 of its size changes the depth by more than 5 cm.
MOST_EDGES = 0.02
# PyBullet's cylinders are drawn as 12 crossed boxes: between the circle and the one that lies within all of them.
CYLINDER_SCALE = math.cos(math.pi / 24)
LENSES = {"release": RELEASE, "64x48": Intrinsics.from_field_of_view(64, 48, math.radians(87.0))}
WALL = Box("wall", (1.5, 0.0, 0.0), (0.5, 10.0, 10.0))


def state(x=0.0, yaw=0.0, pitch=0.0):
    return RobotState(x, 0.0, 0.3, yaw, 0.0, 0.0, False, pitch)


def camera_at(*shapes, seed=0, lower_ground=-math.inf, **options):
    camera = DepthCamera(**options)
    camera.reset(SceneSpec(shapes, lower_ground), np.random.default_rng(seed))
    return camera


def compare(renderer, lens, scenes, n_poses, rng, shift=0.02, relative=0.0):
    """Assert that PyBullet's depths are ours; the share of pixels at edges, where the law says little, and all depths."""
    edges, depths = [], []
    for scene in scenes:
        renderer.reset(scene)
        for pose in clear_poses(scene, rng, n_poses):
            low, high = depth_bounds(lens, FAR, scene, pose, shift, CYLINDER_SCALE)
            depth = renderer.render(pose)
            slack = TOLERANCE + relative * depth
            wrong = (depth < low - slack) | (depth > high + slack)
            assert not wrong.any(), f"{wrong.sum()} pixels differ at {pose}"
            edges.append(np.mean(high - low > 0.05))
            depths.append(depth)
    renderer.close()
    return np.mean(edges), np.array(depths)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("n_cylinders", [0, 4])
def test_tiny_renderer_sees_the_same_in_random_scenes(name, n_cylinders):
    rng = np.random.default_rng(0)
    scenes = [random_scene(rng, n_cylinders=n_cylinders) for _ in range(8)]
    edges, depths = compare(PyBulletDepth(LENSES[name], FAR), LENSES[name], scenes, 5, rng)
    assert edges < MOST_EDGES
    assert depths.std() > 0.5


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_tiny_renderer_sees_the_same_in_every_task(env_id):
    rng = np.random.default_rng(0)
    edges, depths = compare(PyBulletDepth(RELEASE, FAR), RELEASE, task_scenes(env_id, 3), 8, rng)
    assert edges < MOST_EDGES
    assert depths.std() > 0.5


@pytest.mark.skipif(not gpu_found(), reason="no GPU")
def test_egl_sees_the_same():
    rng = np.random.default_rng(0)
    lens = LENSES["64x48"]
    # OpenGL rounds corners to a fraction of a pixel. Mesa's software renderer was wrong by up to 1.2 % of the depth.
    renderer = PyBulletDepth(lens, FAR, egl=True)
    edges, depths = compare(renderer, lens, [random_scene(rng)], 10, rng, shift=0.05, relative=0.02)
    assert edges < 0.05
    assert depths.std() > 0.5


@pytest.mark.skipif(gpu_found(), reason="a GPU is here")
def test_egl_is_refused_without_a_gpu():
    with pytest.raises(ValueError, match=r"needs a GPU.*compiled"):
        DepthCamera(back_end="egl")


def test_tiny_back_end_gives_the_same_readings():
    scene = random_scene(np.random.default_rng(3))
    cameras = [DepthCamera(back_end=back_end, far=FAR) for back_end in ("compiled", "tiny")]
    for pose in clear_poses(scene, np.random.default_rng(3), 5):
        readings = []
        for camera in cameras:
            camera.reset(scene, np.random.default_rng(0))
            # So that the lens, not the body, is where it is clear.
            x, y, z, yaw, _ = CameraPose(*pose[:4]).moved((-0.27, 0.0, -0.03))
            readings.append(camera.read(RobotState(x, y, z, yaw, 0.0, 0.0, False)).astype(int))
        assert np.mean(np.abs(readings[0] - readings[1]) > 1) < 0.01
    for camera in cameras:
        camera.close()


def test_the_releases_camera():
    camera = DepthCamera()
    assert camera.space.shape == (1, 58, 87) and camera.space.dtype == np.uint8
    # 98 of 106 columns and 40 of 42 rows are left of 87 degrees across, with square pixels, the lower two rows cut off.
    edge = math.tan(math.radians(43.5)) * 98 / 106
    assert RELEASE.right[0] - 0.5 / RELEASE.focal_x == pytest.approx(-edge, rel=1e-5)
    assert RELEASE.right[-1] + 0.5 / RELEASE.focal_x == pytest.approx(edge, rel=1e-5)
    assert RELEASE.up[0] + 0.5 / RELEASE.focal_y == pytest.approx(math.tan(math.radians(43.5)) * 21 / 53, rel=1e-5)
    assert RELEASE.up[-1] - 0.5 / RELEASE.focal_y == pytest.approx(-math.tan(math.radians(43.5)) * 19 / 53, rel=1e-5)


def test_stable_baselines_takes_images_as_they_are():
    space = DepthCamera().space
    assert is_image_space(space) and is_image_space_channels_first(space)


def test_levels_are_linear_between_near_and_far():
    # The lens is 0.27 m ahead of the body, the wall's face at 1 m.
    for near, far in ((0.0, 2.0), (0.5, 1.5)):
        camera = camera_at(WALL, near=near, far=far)
        reading = camera.read(state())
        assert reading.shape == (1, 58, 87) and camera.space.contains(reading)
        assert (reading == round(255 * (0.73 - near) / (far - near))).all()
        assert camera.metres(reading) == pytest.approx(0.73, abs=0.5 * (far - near) / 255)
    assert (camera_at(far=2.0).read(state()) == 255).all()
    assert not camera_at(WALL, near=0.9, far=2.0).read(state()).any()
    assert not camera_at(WALL).read(state(x=1.2)).any(), "a lens within a wall sees black"


def test_the_camera_goes_with_the_body():
    camera = camera_at(WALL, position=(0.5, 0.1, 0.2), pitch=0.1)
    # Half a turn away from the wall there is nothing; sideways offsets turn as well.
    assert (camera.depth(CameraPose(0.0, 0.0, 0.3, math.pi)) == 2.0).all()
    pose = CameraPose(1.0, 2.0, 3.0, math.pi / 2).moved((0.5, 0.1, 0.2), 0.1)
    assert pose == pytest.approx((0.9, 2.5, 3.2, math.pi / 2, 0.1))
    # Nose down by a right angle: what was ahead is below, what was above is ahead.
    pose = CameraPose(0.0, 0.0, 1.0, 0.0, math.pi / 2).moved((0.5, 0.1, 0.2))
    assert pose == pytest.approx((0.2, 0.1, 0.5, 0.0, math.pi / 2))


def test_a_pitched_body_looks_down():
    # Level, the ground 10 m below is out of range; nose down, it is seen.
    camera = camera_at(lower_ground=-0.5, far=1.5)
    level, down = camera.read(state()), camera_at(lower_ground=-0.5, far=1.5).read(state(pitch=0.6))
    assert (level[0, :30] == 255).all()
    assert down.mean() < level.mean() - 20
    expected = camera.depth(CameraPose(0.0, 0.0, 0.3, 0.0, 0.6))
    assert np.abs(camera.metres(down[0]) - expected).max() < 0.5 * 1.5 / 255 + 1e-5


@pytest.mark.parametrize(
    "update_period, fresh",
    [
        (0.1, [0, 1, 2, 3, 4, 5]),  # every reading is of the moment
        (0.25, [0, 1, 2, 3, 4, 5]),
        (0.5, [0, 0, 2, 2, 4, 4]),
        (0.4, [0, 0, 2, 2, 4, 5]),  # due at 0.4, 0.8, 1.2 s: seen at 0.5, 1.0, 1.25 s
        (100.0, [0, 0, 0, 0, 0, 0]),
    ],
)
def test_images_are_kept_until_the_next_update(update_period, fresh):
    positions = 0.1 * np.arange(6)
    expected = [int(camera_at(WALL).read(state(x=x))[0, 0, 0]) for x in positions]
    camera = camera_at(WALL, update_period=update_period, read_period=0.25)
    readings = [int(camera.read(state(x=x))[0, 0, 0]) for x in positions]
    assert readings == [expected[k] for k in fresh]
    assert len(set(expected)) == 6


def test_latency_is_counted_in_images():
    positions = 0.1 * np.arange(5)
    now = [int(camera_at(WALL).read(state(x=x))[0, 0, 0]) for x in positions]
    camera = camera_at(WALL, noise=DepthNoise(latency=2))
    assert [int(camera.read(state(x=x))[0, 0, 0]) for x in positions] == [now[k] for k in (0, 0, 0, 1, 2)]
    # Nothing of an episode is left in the next one.
    camera.reset(SceneSpec((WALL,)), np.random.default_rng(0))
    assert int(camera.read(state(x=0.4))[0, 0, 0]) == now[4]


def test_noise_has_its_size_and_leaves_what_is_not_measured():
    half = Box("half", (1.5, 5.0, 0.0), (0.5, 5.0, 10.0))
    camera = camera_at(half, noise=DepthNoise(deviation=0.05))
    clean, noisy = camera_at(half).read(state())[0], camera.read(state())[0]
    nothing = clean == 255
    assert nothing.any() and (noisy[nothing] == 255).all()
    # The rim of the wall that faces the camera is seen too, so errors are compared pixel by pixel.
    error = camera.metres(noisy[~nothing]) - camera.metres(clean[~nothing])
    assert error.std() == pytest.approx(0.05, rel=0.05) and abs(error.mean()) < 0.005
    assert not np.array_equal(noisy, camera.read(state())[0])


def test_dropout_reads_zero_in_its_share_of_pixels():
    reading = camera_at(WALL, noise=DepthNoise(dropout=0.2)).read(state())
    assert np.mean(reading == 0) == pytest.approx(0.2, abs=0.02)
    assert (np.delete(np.unique(reading), 0) == camera_at(WALL).read(state())[0, 0, 0]).all()


def test_the_episodes_seed_decides_the_noise_and_noise_decides_nothing_else():
    def episode(noise):
        rng = np.random.default_rng(5)
        camera = DepthCamera(noise=noise)
        readings = []
        for _ in range(2):
            camera.reset(SceneSpec((WALL,)), rng)
            readings.append(camera.read(state()))
        return readings, rng.random()

    first, second = (episode(DepthNoise(deviation=0.1, dropout=0.1)) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert not np.array_equal(first[0][0], first[0][1])
    assert first[1] == episode(None)[1], "the task's draws do not depend on the camera's noise"


def test_a_reading_belongs_to_its_receiver():
    camera = camera_at(WALL, update_period=1.0)
    camera.read(state())[:] = 7
    assert (camera.read(state()) != 7).all()


def test_an_environment_with_a_camera():
    env = RobotTaskEnv(functools.partial(make_quadruped, physics="kinematic"), LateralChoice(), sensors=(DepthCamera(),))
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert env.observation_space["target"].shape == (1, 58, 87)
    assert observation["target"].std() > 1.0
    env.close()


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: DepthCamera(near=2.0), "near.*far.*2.0"),
        (lambda: DepthCamera(far=math.inf), "far"),
        (lambda: DepthCamera(position=(0.0, math.nan, 0.0)), "place"),
        (lambda: DepthCamera(pitch=math.inf), "place"),
        (lambda: DepthCamera(update_period=0.0), "update_period.*0.0"),
        (lambda: DepthCamera(read_period=-1.0), "read_period"),
        (lambda: DepthCamera(back_end="opengl"), "'opengl'.*compiled"),
        (lambda: DepthNoise(deviation=-0.1), "deviation"),
        (lambda: DepthNoise(dropout=1.5), "dropout"),
        (lambda: DepthNoise(latency=-1), "latency"),
        (lambda: DepthNoise(latency=0.5), "latency"),
        (lambda: Intrinsics(0, 48, 50.0, 50.0, 32.0, 24.0), "width"),
        (lambda: Intrinsics(64, 48, 50.0, 0.0, 32.0, 24.0), "focal_y"),
        (lambda: Intrinsics(64, 48, 50.0, 50.0, math.nan, 24.0), "axis"),
        (lambda: Intrinsics.from_field_of_view(64, 48, 87.0), "rad.*87.0"),
        (lambda: RELEASE.cropped(left=80, right=7), "width"),
        (lambda: PyBulletDepth(RELEASE, 0.005), "far"),
    ],
)
def test_bad_cameras_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_reading_needs_a_scene():
    for back_end in ("compiled", "tiny"):
        with pytest.raises(RuntimeError, match="reset"):
            DepthCamera(back_end=back_end).read(state())


def test_cylinders_look_round_to_us():
    camera = camera_at(Cylinder("post", (1.0, 0.0, 0.0), 0.3, 5.0))
    middle = camera.depth(CameraPose(0.0, 0.0, 0.3, 0.0))[30, 43]
    for yaw in np.linspace(0.0, 0.3, 7):
        x, y = 1.0 - math.cos(yaw), -math.sin(yaw)
        assert camera.depth(CameraPose(x, y, 0.3, yaw))[30, 43] == pytest.approx(middle, rel=1e-4)
