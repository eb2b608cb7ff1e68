"""Laws that every registered environment obeys, and what the composition of robot, task and sensors promises."""

import functools
import re
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from bullet_tasks import ENV_IDS
from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import make_quadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import Sensor
from bullet_tasks.tasks.lateral_choice import LateralChoice, LateralChoiceConfig

N_RANDOM_STEPS = 1000

pytestmark = pytest.mark.parametrize("env_id", ENV_IDS)


@pytest.fixture(params=["kinematic", "compiled"])
def env(request, env_id):
    env = gymnasium.make(env_id, physics=request.param)
    yield env
    env.close()


def record(env, seed, actions):
    """Everything an episode returns, as bytes, stopping at its end."""
    observation, info = env.reset(seed=seed)
    trace = [[observation[key].tobytes() for key in sorted(observation)], info["position"].tobytes()]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        trace.append([observation[key].tobytes() for key in sorted(observation)])
        trace.append((reward, terminated, truncated, info["is_success"], info["position"].tobytes(), info["reward_terms"]))
        if terminated or truncated:
            break
    return trace


def random_actions(env, seed, n):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(n)]


@pytest.mark.parametrize(
    "check_env",
    [
        # Rendering is tested below; gymnasium's own check would open a window.
        functools.partial(gymnasium_check_env, skip_render_check=True),
        sb3_check_env,
    ],
)
def test_checkers_find_nothing(env_id, env, check_env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_random_steps_stay_in_the_spaces(env_id, env):
    observation, _ = env.reset(seed=0)
    for action in random_actions(env, 0, N_RANDOM_STEPS):
        assert env.observation_space.contains(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(reward)
        assert reward == sum(info["reward_terms"].values())
        assert isinstance(info["is_success"], bool)
        assert info["position"].shape == (3 if "Quadrotor" in env_id else 2,) and info["position"].dtype == np.float32
        if terminated or truncated:
            observation, _ = env.reset()


def test_an_episode_is_its_seed_and_actions_bit_for_bit(env_id, env):
    straight = [np.zeros(env.action_space.shape, np.float32)] * 200
    wild = random_actions(env, 1, 200)
    first = {name: record(env, 3, actions) for name, actions in (("straight", straight), ("wild", wild))}
    # Histories that end in the open, in a fall and while pressing against a wall.
    for history in range(4):
        record(env, history, random_actions(env, history, 7 * history))
        record(env, history, straight[: 30 * history])
        assert record(env, 3, straight) == first["straight"]
        assert record(env, 3, wild) == first["wild"]
    other = gymnasium.make(env.spec)
    assert record(other, 3, straight) == first["straight"]
    other.close()


def test_another_environment_in_the_same_process_changes_nothing(env_id, env):
    actions = random_actions(env, 2, 40)
    alone = record(env, 5, actions)
    other = gymnasium.make(env.spec)
    observation, _ = env.reset(seed=5)
    other.reset(seed=9)
    trace = []
    for action in actions:
        other.step(other.action_space.sample())
        observation, _, terminated, truncated, _ = env.step(action)
        trace.append([observation[key].tobytes() for key in sorted(observation)])
        if terminated or truncated:
            break
    other.close()
    assert trace == alone[2::2]


def test_seeds_differ(env_id, env):
    starts = {tuple(value.tobytes() for value in env.reset(seed=seed)[0].values()) for seed in range(20)}
    # The fewest different episodes of any task: a start that is always the same and one of four corners.
    assert len(starts) >= 4


def test_time_limit_truncates(env_id):
    env = gymnasium.make(env_id)
    task = env.unwrapped.task
    assert env.spec.max_episode_steps == task.max_decisions == round(task.time_limit / env.get_wrapper_attr("decision_period"))
    env.close()


def test_gymnasium_collects_pictures(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    assert len(env.render()) == 2
    env.close()


def test_pictures_show_the_robot_move(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(6):
        env.step(np.zeros(env.action_space.shape, np.float32))
    after = env.render()
    env.close()
    assert before.dtype == np.uint8 and before.ndim == 3 and before.shape[2] == 3
    assert before.shape[1] >= 480
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 5
    assert 50 < np.any(before != after, axis=2).sum()


def test_no_picture_without_a_render_mode(env_id, env):
    env.reset(seed=0)
    assert env.unwrapped.render() is None


def test_closing_twice_is_harmless_and_a_closed_environment_says_so(env_id):
    env = gymnasium.make(env_id)
    env.reset(seed=0)
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.unwrapped.step(np.zeros(env.action_space.shape, np.float32))
    with pytest.raises(RuntimeError, match="closed"):
        env.unwrapped.reset()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_actions_that_are_not_finite_are_refused(env_id, env, value):
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    action[-1] = value
    with pytest.raises(ValueError, match="action must be finite"):
        env.unwrapped.step(action)


@pytest.mark.parametrize("action", [np.zeros(7), np.float32(0.0), np.zeros((1, 1))])
def test_actions_of_another_shape_are_refused(env_id, env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must have shape"):
        env.unwrapped.step(action)


def test_actions_beyond_the_bounds_are_clipped_and_choices_that_there_are_not_refused(env_id, env):
    if isinstance(env.action_space, spaces.MultiDiscrete):
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action must be whole numbers"):
            env.step(env.action_space.nvec)
        return
    beyond, at = (record(env, 0, [np.full(env.action_space.shape, value, np.float32)] * 3) for value in (7.0, 1.0))
    assert beyond == at


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"physics": "magic"}, r"Unknown physics 'magic'.*compiled.*kinematic"),
        ({"render_mode": "ascii"}, r"Unknown render_mode 'ascii'.*rgb_array"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_bad_arguments_are_refused_at_construction(env_id, arguments, words):
    with pytest.raises(ValueError, match=words):
        gymnasium.make(env_id, **arguments)


def test_full_physics_works_or_says_that_it_is_not_there_yet(env_id):
    try:
        env = gymnasium.make(env_id, physics="full")
    except ValueError as error:
        assert re.search(r"not available yet.*compiled.*kinematic", str(error))
        return
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    env.close()


def test_unknown_reset_options_are_refused(env_id, env):
    with pytest.raises(ValueError, match="goal_side"):
        env.reset(options={"goal_side": "left"})


class Compass(Sensor):
    """Reads the heading."""

    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def reset(self, scene: SceneSpec, rng: np.random.Generator) -> None:
        self.scene = scene

    def read(self, state: RobotState) -> np.ndarray:
        return np.array([state.yaw], dtype=np.float32)


def test_a_sensor_yields_the_target_observation(env_id):
    sensor = Compass()
    env = RobotTaskEnv(make_quadruped, LateralChoice(), sensors=(sensor,))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    # The sensor sees the world of this episode: the goal's disc lies where the goal is.
    assert sensor.scene["goal"].centre[:2] == env.task.goal
    assert env.scene is sensor.scene, "and so do films"
    observation, *_ = env.step(np.array([0.5], np.float32))
    assert observation["target"][0] == np.float32(env.robot.state.yaw)
    env.close()


def test_a_step_needs_a_reset(env_id):
    env = gymnasium.make(env_id)
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())
    env.close()


def test_actions_are_clipped_to_the_tasks_own_bounds(env_id):
    class Wide(LateralChoice):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
            self.seen = []

        def command(self, action, state):
            self.seen.append(action[0])
            return super().command(action, state)

    env = RobotTaskEnv(make_quadruped, Wide())
    env.reset(seed=0)
    for value in (-3.0, -1.5, 1.7, 2.5):
        env.step(np.array([value], np.float32))
    env.close()
    assert env.task.seen == pytest.approx([-2.0, -1.5, 1.7, 2.0])


def test_closing_closes_the_sensors(env_id):
    class Held(Compass):
        closed = 0

        def close(self):
            self.closed += 1

    sensor = Held()
    RobotTaskEnv(make_quadruped, LateralChoice(), sensors=(sensor,)).close()
    assert sensor.closed == 1


def test_a_film_has_a_frame_rate(env_id):
    assert gymnasium.make(env_id).metadata["render_fps"] >= 1


def test_impossible_compositions_are_refused(env_id):
    with pytest.raises(ValueError, match="one sensor"):
        RobotTaskEnv(make_quadruped, LateralChoice(), sensors=(Compass(), Compass()))
    with pytest.raises(ValueError, match="whole number"):
        RobotTaskEnv(make_quadruped, LateralChoice(LateralChoiceConfig(decision_period=0.12)))
