"""Laws of the three tasks with a depth camera: what is to be found out can be seen, and not otherwise."""

import math

import gymnasium
import numpy as np
import pybullet
import pytest
from scripted_policies import run_episode, through_the_gap, towards
from scripted_seeing import CORNERS, ColumnSeer, SignSeer, StairFinder, along_and_beside, points_in_world

import bullet_tasks  # noqa: F401
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import QuadrupedCommand, make_quadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import CameraPose
from bullet_tasks.sensors.camera import RELEASE
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.sensors.scene_arrays import pack
from bullet_tasks.shapes import Box
from bullet_tasks.tasks.stairway_search import MAX_PITCH, StairwaySearch, StairwaySearchConfig
from bullet_tasks.vec_env import BulletVecEnv
from bullet_tasks.world import World

DECISION = 0.25  # s
SEERS = {"SignpostNavDepth-v0": SignSeer, "MidpointChoiceDepth-v0": ColumnSeer, "StairwaySearchDepth-v0": StairFinder}
N_EPISODES = {"SignpostNavDepth-v0": 12, "MidpointChoiceDepth-v0": 60, "StairwaySearchDepth-v0": 60}
ENV_IDS = tuple(SEERS)


@pytest.fixture(params=ENV_IDS)
def env(request):
    env = gymnasium.make(request.param, physics="compiled")
    yield env
    env.close()


@pytest.fixture(params=["kinematic", "compiled"])
def stairway(request):
    env = gymnasium.make("StairwaySearchDepth-v0", physics=request.param)
    yield env
    env.close()


def informed(env):
    goal = env.unwrapped.task.goal

    def policy(observation):
        gap = env.spec.id.startswith("Midpoint")
        point = through_the_gap(observation, tuple(np.sign(goal).tolist())) if gap else goal
        return np.append(towards(observation, point), np.zeros(env.action_space.shape[0] - 1, np.float32))

    return policy


def floor_world():
    return World(SceneSpec((Box("floor", (0.0, 0.0, -0.5), (20.0, 20.0, 0.5), floor=True),)))


def test_a_robot_that_looks_reaches_the_goal_in_time(env):
    seconds = []
    for seed in range(N_EPISODES[env.spec.id]):
        seer = SEERS[env.spec.id](env.unwrapped.sensors[0])
        episode = run_episode(env, seer, seed)
        assert episode.success, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    assert np.mean(seconds) < 15.0


def test_an_informed_robot_is_quicker(env):
    seconds = []
    for seed in range(60):
        env.reset(seed=seed)
        episode = run_episode(env, informed(env), seed)
        assert episode.success and episode.terminated, f"seed {seed}"
        seconds.append(episode.decisions * DECISION)
    assert np.mean(seconds) < 7.0


def test_spaces_and_images(env):
    observation, _ = env.reset(seed=0)
    assert env.observation_space["target"].shape == (1, 36, 48) and env.observation_space["target"].dtype == np.uint8
    assert env.action_space.shape == ((2,) if env.spec.id.startswith("Stairway") else (1,))
    images = []
    for _ in range(30):
        assert env.observation_space.contains(observation)
        images.append(observation["target"])
        observation, *_ = env.step(env.action_space.sample())
    assert np.std(images) > 10.0


def test_the_releases_lens_and_pybullets_renderer_can_be_had(env):
    like_ours = {}
    for back_end in ("compiled", "tiny"):
        other = gymnasium.make(env.spec.id, physics="compiled", lens=RELEASE, back_end=back_end)
        observation, _ = other.reset(seed=3)
        images = [observation["target"]]
        for _ in range(8):
            observation, *_ = other.step(np.full(other.action_space.shape, 0.5, np.float32))
            images.append(observation["target"])
        like_ours[back_end] = np.array(images, dtype=int)
        other.close()
    assert like_ours["tiny"].shape == (9, 1, 58, 87) and like_ours["tiny"].std() > 10.0
    assert np.mean(np.abs(like_ours["tiny"] - like_ours["compiled"]) > 1) < 0.02


def test_an_episode_depends_on_its_seed_and_actions_alone(env):
    def episode():
        observations = [env.reset(seed=5)[0]]
        rng = np.random.default_rng(0)
        for _ in range(20):
            observation, _, terminated, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            observations.append(observation)
            if terminated:
                break
        return observations

    first = episode()
    env.reset(seed=8)
    env.step(np.zeros(env.action_space.shape, np.float32))
    second = episode()
    assert len(first) == len(second) > 5
    for a, b in zip(first, second, strict=True):
        assert all(np.array_equal(a[key], b[key]) for key in a)


def test_vector_environments_see_the_same(env):
    n = 5
    venv = BulletVecEnv([lambda: gymnasium.make(env.spec.id, physics="compiled")] * n, n_workers=1)
    venv.seed(7)
    observations = venv.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (12, n, *env.action_space.shape)).astype(np.float32)
    stacks = [observations["target"]]
    dones = np.zeros(n, dtype=bool)
    for action in actions:
        observations, _, done, _ = venv.step(action)
        dones |= done
        stacks.append(observations["target"])
    venv.close()
    assert np.array(stacks).dtype == np.uint8 and not dones[1]
    alone = [env.reset(seed=8)[0]["target"]] + [env.step(action[1])[0]["target"] for action in actions]
    assert np.array_equal(np.array(stacks)[:, 1], alone)


@pytest.mark.parametrize("physics", ["full"])
def test_a_walking_robot_sees_too(env, physics):
    full = gymnasium.make(env.spec.id, physics=physics)
    observation, _ = full.reset(seed=1)
    same, _ = env.reset(seed=1)
    # Its trunk is not exactly as high.
    assert np.mean(np.abs(observation["target"].astype(int) - same["target"]) > 12) < 0.1
    for _ in range(4):
        observation, *_ = full.step(np.zeros(full.action_space.shape, np.float32))
    assert full.observation_space.contains(observation)
    full.close()


@pytest.mark.parametrize("physics", ["kinematic", "compiled"])
def test_a_legless_body_pitches_at_a_limited_rate(physics):
    world = floor_world()
    robot = make_quadruped(world, physics)
    robot.reset(0.0, 0.0, 0.0, 0.0)
    assert robot.state.pitch == 0.0
    robot.command(QuadrupedCommand(0.5, 0.0, 0.5))
    pitches = [robot.substep().pitch for _ in range(20)]
    assert pitches == pytest.approx([min(0.04 * (i + 1), 0.5) for i in range(20)])
    robot.command(QuadrupedCommand(0.5, 0.0, -0.1))
    assert robot.substep().pitch == pytest.approx(0.46)
    assert robot.reset(0.0, 0.0, 0.0, 0.0).pitch == 0.0
    assert robot.substep().pitch == 0.0, "a new episode begins without a command"
    world.close()


def test_the_walking_body_pitches():
    world = floor_world()
    robot = make_quadruped(world, "full")
    robot.command(QuadrupedCommand(0.5, 0.0, 0.3))
    pitches = [robot.substep().pitch for _ in range(40)]
    assert np.mean(pitches[-10:]) == pytest.approx(0.3, abs=0.06)
    world.close()


def test_the_camera_and_the_pose_follow_the_pitch(stairway):
    stairway.reset(seed=0)
    camera, body = stairway.unwrapped.sensors[0], []
    for down in (1.0, 1.0, 1.0, -1.0):
        observation, *_ = stairway.step(np.array((0.3, down), np.float32))
        state = stairway.unwrapped.robot.state
        body.append(state.pitch)
        expected = camera.depth(CameraPose(state.x, state.y, state.z, state.yaw, state.pitch))
        assert np.abs(camera.metres(observation["target"][0]) - expected).max() < 0.5 * 2.0 / 255 + 1e-5
        assert observation["common"][4] == pytest.approx(state.pitch / math.pi)
    assert body == pytest.approx([0.2, 0.4, MAX_PITCH, MAX_PITCH - 0.2])


def test_stairs_are_seen_over_the_edge_with_the_nose_down_only():
    task, rng = StairwaySearch(), np.random.default_rng(0)
    caster = CompiledDepth(RELEASE, 2.0)
    scenes = []
    while len(scenes) < 2:
        placements = task.reset(rng).placements
        if task.goal == ((2.0, 2.0), (-2.0, -2.0))[len(scenes)]:
            scenes.append(task.scene.moved(placements))
    differences = {}
    for pitch in (0.0, MAX_PITCH):
        bodies = [
            CameraPose(x, y, 0.3, yaw, pitch) for x, y, yaw in rng.uniform((-2, -2, -math.pi), (2, 2, math.pi), (2000, 3))
        ]
        poses = np.array([body.moved((0.27, 0.0, 0.03)) for body in bodies])
        first, second = (caster.render_all(pack([scene] * len(poses)), poses) for scene in scenes)
        share = np.mean(np.abs(first - second) > 0.05, axis=(1, 2))
        differences[pitch] = np.mean(share > 0.01)
    assert differences[MAX_PITCH] > 0.05
    assert differences[0.0] < 0.01 * differences[MAX_PITCH]


def test_stairs_lead_down_from_the_goal_and_no_other_corner(stairway):
    ends = []
    for seed in range(40):
        stairway.reset(seed=seed)
        scene, goal = stairway.unwrapped.scene, np.sign(stairway.unwrapped.task.goal)
        for corner in CORNERS:
            diagonal, across = np.array(corner) / math.sqrt(2.0), np.array((-corner[1], corner[0])) / math.sqrt(2.0)
            for side in (1.0, -1.0):
                for beside, height in ((0.6, 0.0), (0.92, -0.26), (1.34, -0.52), (1.6, -0.8)):
                    expected = height if height == 0.0 or tuple(goal) == corner else -0.8
                    point = 2.5 * diagonal + side * beside * across
                    assert scene.ground_height(*map(float, point)) == pytest.approx(expected)
            if tuple(goal) == corner:
                out = np.arange(2.4, 3.5, 0.002)
                steps = [scene.ground_height(*map(float, d * diagonal + 0.92 * across)) > -0.5 for d in out]
                ends.append(math.sqrt(2.0) * out[steps].max())
        # Nothing of the stairs shows above the platform.
        inside = np.random.default_rng(seed).uniform(-2.1, 2.1, (50, 2))
        assert all(scene.ground_height(*map(float, point)) == 0.0 for point in inside)
    assert 3.67 < min(ends) < 3.8 and 4.3 < max(ends) < 4.42


def test_stairway_starts_and_ends_are_as_in_the_release(stairway):
    starts = [stairway.reset(seed=seed) for seed in range(400)]
    corners = np.array([observation["privileged"] for observation, _ in starts])
    assert np.all(np.abs(corners) == 0.25), "the scale of the paper"
    counts = np.unique(corners, axis=0, return_counts=True)[1]
    assert len(counts) == 4 and np.all(np.abs(counts - 100) < 43)
    spawns = np.hypot(*np.array([info["position"] for _, info in starts]).T)
    assert np.quantile(spawns, [0.25, 0.5, 0.75]) == pytest.approx([0.25, 0.5, 0.75], abs=0.1) and spawns.max() <= 1.0
    for goal in CORNERS:
        episode = None
        for seed in range(40):
            observation, _ = stairway.reset(seed=seed)
            wrong = -np.sign(observation["privileged"])
            if tuple(np.sign(observation["privileged"])) == goal:
                point = tuple(2.0 * wrong)
                episode = run_episode(stairway, lambda o, p=point: np.append(towards(o, p), np.float32(0.0)), seed)
                break
        assert episode is not None and episode.terminated and not episode.success
        assert math.dist(episode.infos[-1]["position"], point) <= 0.41, "a dead zone"


def test_the_robot_walks_at_half_a_metre_per_second(stairway):
    stairway.reset(seed=0)
    before = stairway.unwrapped.robot.state
    stairway.step(np.zeros(2, np.float32))
    after = stairway.unwrapped.robot.state
    assert math.hypot(after.x - before.x, after.y - before.y) == pytest.approx(0.125, abs=1e-3)


def test_what_the_camera_shows_is_where_it_is():
    env = gymnasium.make("MidpointChoiceDepth-v0", physics="compiled")
    n_tops = 0
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        for _ in range(10):
            points = points_in_world(observation, env.unwrapped.sensors[0])
            scene = env.unwrapped.scene
            for pair in ("low", "middle", "tall"):
                left = scene[f"{pair}_left"]
                corner = tuple(np.sign(left.centre[:2]).tolist())
                along, beside = along_and_beside(points, corner)
                face = (np.abs(along - 2.34) < 0.01) & (np.abs(np.abs(beside) - 0.74) < 0.3)
                n_tops += face.sum()
                assert (points[face, 2] < left.top + 0.02).all() and (points[face, 2] > -0.01).all()
            observation, *_ = env.step(np.ones(1, np.float32))
    assert n_tops > 200
    env.close()


def test_a_body_without_pybullet_bows_in_pictures():
    env = gymnasium.make("StairwaySearchDepth-v0", physics="compiled", render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.ones(2, np.float32))
    env.render()
    simulation, state = env.unwrapped.world.simulation, env.unwrapped.robot.state
    position, orientation = simulation.client.getBasePositionAndOrientation(simulation.body_id("robot"))
    expected = pybullet.getQuaternionFromEuler((0.0, MAX_PITCH, state.yaw))
    assert position == pytest.approx(state[:3])
    assert np.abs(np.dot(orientation, expected)) == pytest.approx(1.0) and math.hypot(*orientation[:2]) > 0.1
    env.close()


def test_a_state_without_pitch_is_level():
    assert RobotState(0.0, 0.0, 0.3, 0.0, 0.0, 0.0, False).pitch == 0.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"corner": 3.0}, "corner_reach"),
        ({"step_height": 0.4}, "step_height"),
        ({"step_height": 0.0}, "step_height"),
        ({"step_reach": (2.2, 1.6)}, "step_reach"),
        ({"step_reach": (0.9, 2.2)}, "step_reach"),
        ({"cut": (3.0, 4.0)}, "cut"),
        ({"cut": (4.0, 5.5)}, "cut"),
        ({"speed": 0.0}, "speed"),
        ({"spawn_distance": 2.2}, "spawn_distance"),
        ({"decision_period": 0.0}, "decision_period"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        StairwaySearch(StairwaySearchConfig(**arguments))


@pytest.mark.parametrize("arguments", [{"physics": "magic"}, {"back_end": "opengl"}, {"lens": "fisheye"}])
def test_unknown_choices_are_refused(env, arguments):
    with pytest.raises(ValueError, match=r"magic|opengl|fisheye.*release.*small"):
        gymnasium.make(env.spec.id, **arguments)


def test_a_lens_is_given_by_its_name(env):
    named, given = (gymnasium.make(env.spec.id, physics="compiled", lens=lens) for lens in ("release", RELEASE))
    assert named.observation_space == given.observation_space != env.observation_space
