"""The process behind ``BulletVecEnv``: hosts some environments and serves requests. It imports neither SB3 nor torch."""

import pickle
import signal
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
from gymnasium import spaces

from bullet_tasks.adaptive_wait import AdaptiveWait
from bullet_tasks.infos import PackedInfos, pack
from bullet_tasks.shared_arrays import Layout, SharedArrays

ACTION, REWARD, DONE = "action", "reward", "done"
"""Names of the shared arrays beside those of the observations."""
SINGLE_OBSERVATION = "observation"
"""Name of the shared array of an observation that is no dict."""
CLOSE = "close"
"""Request that has no reply."""

Request = tuple[str, tuple[Any, ...]]
"""A method of ``EnvHost`` and its arguments."""
Reply = tuple[bool, Any]
"""``(True, result)`` or ``(False, (error or None, traceback))``."""


def observation_array(key: str) -> str:
    """
    Name of the shared array of one entry of a dict observation.

    :param key: of the entry
    """
    return f"{SINGLE_OBSERVATION}/{key}"


class EnvFns:
    """
    Functions that make environments, on their way to a worker; lambdas survive it too.

    :param env_fns: the functions
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env]]) -> None:
        self.env_fns = list(env_fns)

    def __getstate__(self) -> bytes:
        return cloudpickle.dumps(self.env_fns)

    def __setstate__(self, state: bytes) -> None:
        self.env_fns = pickle.loads(state)


class EnvHost:
    """
    The environments of one process. Public methods are the requests that it serves.

    :param env_fns: make the environments
    :param first: index of the first of them among all
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env]], first: int) -> None:
        self._first = first
        self._envs: list[gymnasium.Env] = []
        try:
            for env_fn in env_fns:
                self._envs.append(env_fn())
        except BaseException:
            self.close()
            raise
        if len({id(env.unwrapped) for env in self._envs}) != len(self._envs):
            self.close()
            raise ValueError("Two of `env_fns` returned the same environment; each must make one of its own.")
        self._arrays: SharedArrays | None = None
        self._actions = self._rewards = self._dones = np.zeros(0)
        self._observations: list[tuple[str | None, np.ndarray]] = []

    def serve(self, request: Request) -> Reply:
        """
        Whatever happens, there is a reply.

        :param request: to serve
        """
        method, arguments = request
        try:
            return True, getattr(self, method)(*arguments)
        except Exception as error:
            return False, (error, traceback.format_exc())

    def env_spaces(self) -> list[tuple[spaces.Space, spaces.Space]]:
        """Observation and action space of every environment."""
        return [(env.observation_space, env.action_space) for env in self._envs]

    def attach(self, path: str, layout: Layout) -> None:
        """
        Map the shared arrays.

        :param path: of their file
        :param layout: of the arrays, whose first axis is the environment
        """
        arrays = self._arrays = SharedArrays(path, layout)
        mine = slice(self._first, self._first + len(self._envs))
        self._actions, self._rewards, self._dones = arrays[ACTION][mine], arrays[REWARD][mine], arrays[DONE][mine]
        space = self._envs[0].observation_space
        if isinstance(space, spaces.Dict):
            self._observations = [(key, arrays[observation_array(key)][mine]) for key in space.spaces]
        else:
            self._observations = [(None, arrays[SINGLE_OBSERVATION][mine])]

    def _store(self, index: int, observation: Any) -> None:
        for key, array in self._observations:
            array[index] = observation if key is None else observation[key]

    def step(self) -> tuple[PackedInfos, dict[int, dict[str, Any]]]:
        """
        Step every environment with its shared action; one that ends is reset at once.

        :return: infos of all environments, and reset info by local index of those that ended
        """
        infos, reset_infos = [], {}
        for i, env in enumerate(self._envs):
            # A copy: the environment may keep its action, and the parent will overwrite this memory.
            observation, self._rewards[i], terminated, truncated, info = env.step(self._actions[i].copy())
            done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                observation, reset_infos[i] = env.reset()
            self._dones[i] = done
            self._store(i, observation)
            infos.append(info)
        return pack(infos), reset_infos

    def reset(self, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """
        Reset every environment.

        :param seeds: one an environment
        :param options: one an environment
        :return: reset infos
        """
        infos = []
        for i, (env, seed, option) in enumerate(zip(self._envs, seeds, options, strict=True)):
            observation, info = env.reset(seed=seed, **({"options": option} if option else {}))
            self._store(i, observation)
            infos.append(info)
        return infos

    def get_attr(self, indices: Sequence[int], name: str) -> list[Any]:
        """
        An attribute of some environments or of their wrappers.

        :param indices: local
        :param name: of the attribute
        """
        return [self._envs[i].get_wrapper_attr(name) for i in indices]

    def has_attr(self, indices: Sequence[int], name: str) -> list[bool]:
        """
        Whether some environments have an attribute, which need not survive the way to the parent.

        :param indices: local
        :param name: of the attribute
        """
        return [self._envs[i].has_wrapper_attr(name) for i in indices]

    def set_attr(self, indices: Sequence[int], name: str, value: Any) -> list[None]:
        """
        Set an attribute of some environments, on the outermost wrapper as SB3 does.

        :param indices: local
        :param name: of the attribute
        :param value: its value
        """
        return [setattr(self._envs[i], name, value) for i in indices]  # type: ignore[func-returns-value]

    def env_method(self, indices: Sequence[int], name: str, args: tuple, kwargs: dict[str, Any]) -> list[Any]:
        """
        Call a method of some environments.

        :param indices: local
        :param name: of the method
        :param args: positional arguments
        :param kwargs: keyword arguments
        """
        return [self._envs[i].get_wrapper_attr(name)(*args, **kwargs) for i in indices]

    def env_is_wrapped(self, indices: Sequence[int], wrapper_class: type[gymnasium.Wrapper]) -> list[bool]:
        """
        Whether some environments have a wrapper of a class.

        :param indices: local
        :param wrapper_class: the class
        """
        return [_is_wrapped(self._envs[i], wrapper_class) for i in indices]

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()


def _is_wrapped(env: gymnasium.Env, wrapper_class: type[gymnasium.Wrapper]) -> bool:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, wrapper_class):
            return True
        env = env.env
    return False


def _pickled(reply: Reply) -> bytes:
    """A reply for another process: of what does not survive the way, the error that says so, or the traceback alone."""
    succeeded, result = reply
    try:
        message = pickle.dumps(reply)
        if not succeeded:
            pickle.loads(message)
        return message
    except Exception as error:
        return _pickled((False, (error, traceback.format_exc()))) if succeeded else pickle.dumps((False, (None, result[1])))


def run_worker(connection: Connection, inherited: Sequence[Connection], env_fns: EnvFns, first: int) -> None:
    """
    Serve a parent's requests until it hangs up.

    :param connection: to the parent
    :param inherited: the parent's connections that a fork copied, which would keep other workers alive after the parent
    :param env_fns: make the environments
    :param first: index of the first of them among all
    """
    # Ctrl-C reaches the whole process group; the parent decides what becomes of its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for other in inherited:
        other.close()
    host = None
    try:
        try:
            host = EnvHost(env_fns.env_fns, first)
            connection.send((True, host.env_spaces()))
        except Exception as error:
            connection.send_bytes(_pickled((False, (error, traceback.format_exc()))))
            return
        wait = AdaptiveWait(connection).wait
        while True:
            wait(None)
            request = pickle.loads(connection.recv_bytes())
            if request[0] == CLOSE:
                return
            connection.send_bytes(_pickled(host.serve(request)))
    except (EOFError, OSError):
        # The parent is gone or has hung up.
        return
    finally:
        if host is not None:
            host.close()
        connection.close()
