"""Laws of the vector environment: the results of DummyVecEnv, helpful failures, and nothing left behind."""

import contextlib
import copy
import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from bullet_tasks import ENV_IDS
from bullet_tasks.vec_env import BulletVecEnv, WorkerTraceback

N_ENVS = 5
N_STEPS = 200
# A file of shared memory exists only while workers map it.
SHARED_FILES = "/dev/shm"

ACTION_SPACES = [
    spaces.Box(-1.0, 1.0, (2,), np.float32),
    spaces.Discrete(3),
    spaces.MultiDiscrete([2, 5]),
    spaces.MultiBinary(4),
]
OBSERVATION_SPACES = [
    spaces.Box(-np.inf, np.inf, (3,), np.float64),
    spaces.Box(0, 255, (1, 4, 5), np.uint8),
    spaces.Dict({"b": spaces.Box(-1.0, 1.0, (2, 2), np.float32), "a": spaces.Box(0, 9, (1,), np.int64)}),
]


class ToyEnv(gymnasium.Env):
    """
    Random observations; remembers what it was told; ends or fails on request.

    :param number: its name
    :param observation_space: of any kind
    :param action_space: of any kind
    :param fail_at: step at which it raises an error
    :param die_at: step at which its process dies
    :param slow: time that a step takes, s
    :param interrupts: process that it interrupts in the middle of its first step
    :param hangs: whether it does so for ever
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        number=0,
        observation_space=None,
        action_space=None,
        fail_at=None,
        die_at=None,
        slow=0.0,
        interrupts=None,
        hangs=False,
        render_mode=None,
    ):
        self.number = number
        self.observation_space = observation_space or OBSERVATION_SPACES[0]
        self.action_space = action_space or ACTION_SPACES[1]
        self.fail_at, self.die_at, self.slow, self.interrupts, self.hangs = fail_at, die_at, slow, interrupts, hangs
        self.render_mode = render_mode
        self.unpicklable = lambda: None
        self.last_options = None

    def _observe(self):
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.last_options = options
        return self._observe(), {"number": self.number, "seed": seed, "options": options}

    def step(self, action):
        self.steps += 1
        time.sleep(self.slow)
        if self.steps == self.fail_at:
            raise OSError(f"the motor of number {self.number} is on fire")
        if self.steps == self.die_at:
            os._exit(7)
        while self.interrupts is not None:
            os.kill(self.interrupts, signal.SIGINT)
            self.interrupts = self.interrupts if self.hangs else None
            time.sleep(0.05)
        end = self.np_random.random()
        return self._observe(), self.np_random.random() / 3, end < 0.1, end > 0.8, {"action": action, "end": end}

    def render(self):
        return np.full((8, 8, 3), self.number, np.uint8)

    def add(self, a, b=0):
        return self.number + a + b

    def complain(self):
        raise ZeroDivisionError("nothing to divide by")


def toys(n=N_ENVS, **arguments):
    return [functools.partial(ToyEnv, number=i, **arguments) for i in range(n)]


def assert_same(a, b):
    """Equality of nested results, bit for bit and type for type of arrays."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    else:
        assert a == b


def assert_equivalent(env_fns, n_steps=N_STEPS, **arguments):
    """Run DummyVecEnv and BulletVecEnv side by side."""
    reference, ours = DummyVecEnv(env_fns), BulletVecEnv(env_fns, **arguments)
    try:
        assert ours.observation_space == reference.observation_space and ours.action_space == reference.action_space
        for seed in (3, 3, None):
            if seed is not None:
                assert ours.seed(seed) == reference.seed(seed)
                assert_same(ours.reset(), reference.reset())
            assert_same(ours.reset_infos, reference.reset_infos)
            reference.action_space.seed(0)
            for _ in range(n_steps):
                actions = np.array([reference.action_space.sample() for _ in env_fns])
                assert_same(list(ours.step(actions)), list(reference.step(actions)))
                assert_same(ours.reset_infos, reference.reset_infos)
    finally:
        ours.close()
        reference.close()


@pytest.fixture(autouse=True)
def nothing_left_behind():
    files = set(os.listdir(SHARED_FILES)) if os.path.isdir(SHARED_FILES) else set()
    yield
    assert not multiprocessing.active_children()
    left = (set(os.listdir(SHARED_FILES)) if os.path.isdir(SHARED_FILES) else set()) - files
    assert not [name for name in left if name.startswith(f"bullet_tasks_{os.getpid()}_")]


@pytest.fixture
def env():
    env = BulletVecEnv(toys(), n_workers=2)
    env.reset()
    yield env
    env.close()


def actions(env, value=1):
    return np.full(env.num_envs, value)


@pytest.mark.parametrize("n_workers", [1, 2])
@pytest.mark.parametrize("physics", ["kinematic", "compiled"])
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_registered_environments_step_as_in_dummy_vec_env(env_id, physics, n_workers):
    assert_equivalent([functools.partial(gymnasium.make, env_id, physics=physics)] * N_ENVS, n_workers=n_workers)


@pytest.mark.parametrize("action_space", ACTION_SPACES, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("observation_space", OBSERVATION_SPACES, ids=lambda space: type(space).__name__)
def test_all_supported_spaces_step_as_in_dummy_vec_env(observation_space, action_space):
    env_fns = toys(3, observation_space=observation_space, action_space=action_space)
    assert_equivalent(env_fns, n_steps=30, n_workers=2)


def test_binary_actions_may_be_floating_point_numbers_as_sb3s_policies_give_them():
    class Recorder(ToyEnv):
        def step(self, action):
            return *super().step(action)[:4], {"action": action.copy()}

    env = BulletVecEnv([functools.partial(Recorder, action_space=ACTION_SPACES[3])] * 2, n_workers=2)
    try:
        env.reset()
        given = np.array([[0, 1, 1, 0], [1, 0, 0, 1]], dtype=np.float32)
        assert all((info["action"] == row).all() for info, row in zip(env.step(given)[3], given, strict=True))
    finally:
        env.close()


def test_spawned_workers_do_the_same():
    assert_equivalent([functools.partial(gymnasium.make, f"bullet_tasks:{ENV_IDS[0]}")] * 2, 20, start_method="spawn")


def test_make_vec_env_makes_it():
    arguments = {"n_envs": 3, "seed": 4, "vec_env_cls": BulletVecEnv, "vec_env_kwargs": {"n_workers": 2}}
    env = make_vec_env(ENV_IDS[0], **arguments)
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gymnasium.wrappers.RecordVideo, indices=[0, 2]) == [False] * 2
    env.reset()
    episodes = []
    for _ in range(100):
        infos = env.step(np.zeros((3, 1), np.float32))[3]
        episodes.extend(info["episode"] for info in infos if "episode" in info)
    assert episodes and {"r", "l", "t"} <= episodes[0].keys()
    env.close()


def test_a_worker_imports_no_torch():
    code = "import sys, bullet_tasks.vec_worker; sys.exit('torch' in sys.modules or 'stable_baselines3' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_returned_arrays_are_copies(env):
    first = env.step(actions(env))
    before = copy.deepcopy(first)
    env.step(actions(env, 2))
    assert_same(list(first), list(before))
    first[0][:] = 0.0
    assert_same(env.step(actions(env))[3][0]["action"], np.int64(1))


def test_seeds_and_options_are_used_once(env):
    assert env.seed(10) == [10, 11, 12, 13, 14]
    env.set_options([{"wind": i} for i in range(N_ENVS)])
    first = env.reset()
    assert [info["seed"] for info in env.reset_infos] == [10, 11, 12, 13, 14]
    assert [info["options"] for info in env.reset_infos] == [{"wind": i} for i in range(N_ENVS)]
    second = env.reset()
    assert [info["seed"] for info in env.reset_infos] == [None] * N_ENVS
    assert [info["options"] for info in env.reset_infos] == [None] * N_ENVS
    assert not np.array_equal(first, second)
    env.seed(10)
    assert np.array_equal(env.reset(), first)


def test_attributes_and_methods_of_chosen_environments(env):
    assert env.get_attr("number") == [0, 1, 2, 3, 4]
    assert env.get_attr("number", indices=3) == [3]
    assert env.get_attr("number", indices=[4, 0, 4, -1]) == [4, 0, 4, 4]
    env.set_attr("number", 40, indices=[1, 4])
    assert env.env_method("add", 2, b=100) == [102, 142, 104, 105, 142]
    assert env.env_method("add", 0, indices=np.array([4, 2])) == [40, 2]
    with pytest.raises(IndexError):
        env.get_attr("number", indices=[5])


def test_questions_that_fail_leave_it_usable(env):
    assert env.has_attr("number") and not env.has_attr("no_such")
    assert env.has_attr("unpicklable"), "it need not survive the way to the parent"
    with pytest.raises(AttributeError, match="no_such"):
        env.get_attr("no_such")
    with pytest.raises(Exception, match="pickle"):
        env.get_attr("unpicklable")
    with pytest.raises(ZeroDivisionError):
        env.env_method("complain")
    assert env.step(actions(env))[1].shape == (N_ENVS,)


def test_pictures():
    env = BulletVecEnv(toys(3, render_mode="rgb_array"), n_workers=2)
    assert env.render_mode == "rgb_array"
    assert [picture[0, 0, 0] for picture in env.get_images()] == [0, 1, 2]
    assert env.render().shape == (16, 16, 3)
    env.close()


def test_no_pictures_without_a_render_mode(env):
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.get_images() == [None] * N_ENVS


@pytest.mark.parametrize("number", [0, 3])
def test_an_error_in_a_step_is_raised_here_with_its_traceback_and_closes(number):
    env_fns = toys(4)
    env_fns[number] = functools.partial(ToyEnv, number=number, fail_at=2)
    env = BulletVecEnv(env_fns, n_workers=2)
    env.reset()
    # The number of steps counts within an episode, so it may end a few times before the failure.
    with pytest.raises(OSError, match=f"number {number} is on fire") as caught:
        for _ in range(100):
            env.step(actions(env))
    assert isinstance(caught.value.__cause__, WorkerTraceback)
    assert "in step" in str(caught.value.__cause__) and __file__ in str(caught.value.__cause__)
    assert env.closed
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()


def test_a_worker_that_dies_is_reported():
    env = BulletVecEnv([*toys(3), functools.partial(ToyEnv, number=3, die_at=1)], n_workers=2)
    env.reset()
    with pytest.raises(RuntimeError, match=r"Worker 1 .*environments 2 to 3 died \(exit code 7"):
        env.step(actions(env))
    assert env.closed


def test_a_worker_that_is_killed_between_steps_is_reported(env):
    (worker,) = multiprocessing.active_children()
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    with pytest.raises(RuntimeError, match=r"Worker 1 .*exit code -9"):
        env.step(actions(env))


class MotorError(Exception):
    """Does not survive the way between processes."""

    def __init__(self, number, reason):
        super().__init__(f"motor {number}: {reason}")


class BrokenEnv(ToyEnv):
    def step(self, action):
        raise MotorError(self.number, "on fire")


@pytest.mark.parametrize(("n_workers", "error"), [(1, MotorError), (2, RuntimeError)])
def test_an_error_that_cannot_travel_is_told_and_in_this_process_raised(n_workers, error):
    env = BulletVecEnv([*toys(1), BrokenEnv], n_workers=n_workers)
    env.reset()
    with pytest.raises(error) as caught:
        env.step(actions(env))
    assert "motor 0: on fire" in str(caught.value.__cause__)


def fail():
    raise FileNotFoundError("no such robot")


@pytest.mark.parametrize("place", [0, 2])
def test_an_error_at_construction_is_raised_here(place):
    env_fns = toys(2)
    env_fns.insert(place, fail)
    with pytest.raises(FileNotFoundError, match="no such robot"):
        BulletVecEnv(env_fns, n_workers=2)


@pytest.fixture
def ctrl_c_interrupts():
    """A job in the background of a shell is born deaf to it."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


# In this process, which is in the middle of a step then; in a worker, for which it waits.
@pytest.mark.parametrize("place", [0, 3])
@pytest.mark.usefixtures("ctrl_c_interrupts")
def test_an_interrupted_step_is_lost_and_no_more(place):
    env_fns = toys(4)
    env_fns[place] = functools.partial(ToyEnv, number=place, interrupts=os.getpid())
    reference = DummyVecEnv(toys(4))
    with contextlib.closing(BulletVecEnv(env_fns, n_workers=2)) as env:
        for vec_env in (env, reference):
            vec_env.seed(0)
            vec_env.reset()
        with pytest.raises(KeyboardInterrupt):
            env.step(actions(env))
        reference.step(actions(env))
        assert_same(list(env.step(actions(env))), list(reference.step(actions(env))))


@pytest.mark.usefixtures("ctrl_c_interrupts")
def test_a_step_that_never_ends_can_be_interrupted():
    env = BulletVecEnv([functools.partial(ToyEnv, interrupts=os.getpid(), hangs=True)], n_workers=1)
    env.reset()
    with pytest.raises(KeyboardInterrupt):
        env.step(actions(env))
    env.close()


@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize("moment", ["send_bytes", "recv_bytes"])
def test_an_interrupt_never_parts_a_message_from_its_being_noted(env, monkeypatch, moment):
    """As soon as it is sent or read, before anything else."""
    reference = DummyVecEnv(toys())
    for vec_env in (env, reference):
        vec_env.seed(0)
        vec_env.reset()
    original = getattr(Connection, moment)

    def interrupted(self, *args):
        result = original(self, *args)
        monkeypatch.undo()
        signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(Connection, moment, interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(actions(env))
    reference.step(actions(env))
    assert_same(list(env.step(actions(env))), list(reference.step(actions(env))))


def test_reset_throws_a_running_step_away(env):
    env.step_async(actions(env))
    with pytest.raises(RuntimeError, match="step_wait"):
        env.get_attr("number")
    assert env.reset().shape == (N_ENVS, 3)
    with pytest.raises(RuntimeError, match="step_async"):
        env.step_wait()
    assert env.step(actions(env))[2].dtype == bool


def test_closing_is_idempotent_and_possible_during_a_step():
    env = BulletVecEnv(toys(slow=0.02), n_workers=2)
    env.reset()
    env.step_async(actions(env))
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.step(actions(env))


def test_dropping_it_ends_its_workers():
    env = BulletVecEnv(toys(2), n_workers=2)
    assert multiprocessing.active_children()
    del env
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("bad", [np.zeros(4, int), np.zeros((5, 1), int), 0])
def test_actions_of_another_shape_are_refused(env, bad):
    with pytest.raises(ValueError, match="shape"):
        env.step(bad)
    assert env.step(actions(env))[1].shape == (N_ENVS,)


def test_actions_of_a_type_that_does_not_fit_are_refused(env):
    with pytest.raises(ValueError, match="type"):
        env.step(np.zeros(N_ENVS))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"env_fns": []}, "empty"),
        ({"env_fns": toys(2), "n_workers": 3}, "n_workers"),
        ({"env_fns": toys(2), "n_workers": 0}, "n_workers"),
        ({"env_fns": toys(2), "n_workers": 1.5}, "whole number"),
        ({"env_fns": toys(2), "start_method": "teleport"}, "start_method"),
        ({"env_fns": toys(1, observation_space=spaces.Discrete(3))}, "Dict of Box"),
        ({"env_fns": toys(1, observation_space=spaces.Dict({"a": spaces.Dict({"b": OBSERVATION_SPACES[0]})}))}, "Dict of Box"),
        ({"env_fns": toys(1, action_space=spaces.Tuple([spaces.Discrete(2)]))}, "action space"),
        ({"env_fns": [*toys(1), *toys(1, action_space=spaces.Discrete(9))]}, "same spaces"),
    ],
)
def test_impossible_arguments_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        BulletVecEnv(**arguments)


def test_one_environment_for_two_is_refused():
    shared = ToyEnv()
    with pytest.raises(ValueError, match="same environment"):
        BulletVecEnv([lambda: shared] * 2, n_workers=1)


@pytest.mark.parametrize(("cores", "n_envs", "n_others"), [(1, 3, 0), (2, 3, 1), (8, 3, 2), (2, 1, 0)])
def test_by_default_every_core_has_a_process_and_this_one_is_among_them(monkeypatch, cores, n_envs, n_others):
    monkeypatch.setattr("bullet_tasks.vec_env._cores", lambda: cores)
    env = BulletVecEnv(toys(n_envs))
    assert len(multiprocessing.active_children()) == n_others
    env.close()
