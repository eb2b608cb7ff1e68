"""A vector environment that has several environments a process and moves observations through shared memory."""

import contextlib
import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from bullet_tasks.infos import unpack
from bullet_tasks.shared_arrays import SharedArrays
from bullet_tasks.vec_hosts import Host, HostHere, HostInWorker, WorkerDied
from bullet_tasks.vec_worker import ACTION, DONE, REWARD, SINGLE_OBSERVATION, EnvFns, Reply, Request, observation_array


class WorkerTraceback(Exception):
    """The traceback of an error in an environment, shown as the cause of the error that is raised."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:
        return f'\n"""\n{self.text}"""'


class BulletVecEnv(VecEnv):
    """
    Several environments a process, this one and workers; observations, rewards, ends and actions go through shared memory.

    SB3's ``SubprocVecEnv`` has one process an environment, which costs 0.2-0.3 ms a step each; that is more than a step
    of a small PyBullet world. Results are those of ``DummyVecEnv``, bit for bit. Works for any gymnasium environment with
    Box, Discrete, MultiDiscrete or MultiBinary actions and with Box or flat Dict-of-Box observations::

        make_vec_env("LateralChoice-v0", n_envs=32, vec_env_cls=BulletVecEnv, vec_env_kwargs={"n_workers": 2})

    An error in ``step`` or ``reset`` of an environment is raised here with the worker's traceback as its cause, and closes
    the vector environment. After a KeyboardInterrupt it can be used again; the interrupted step is lost. A second
    one is not put off until this process has done its part of the step, which may never be.

    :param env_fns: functions that make the environments
    :param n_workers: number of processes at work, this one included; by default one a core that this process may use, at
        most one an environment
    :param start_method: of ``multiprocessing``, for the other ones; by default ``"fork"`` where there is one, else ``"spawn"``
    :raises ValueError: if the environments have spaces that are not supported or differ, or an argument is impossible
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        n_workers: int | None = None,
        start_method: str | None = None,
    ) -> None:
        self.closed = True
        self.waiting = False
        self._owner = os.getpid()
        if not env_fns:
            raise ValueError("`env_fns` is empty: give at least one function that makes an environment.")
        n_workers = min(_cores(), len(env_fns)) if n_workers is None else n_workers
        if n_workers != int(n_workers) or not 1 <= n_workers <= len(env_fns):
            raise ValueError(
                f"`n_workers` must be a whole number between 1 and the number of environments {len(env_fns)}, got {n_workers}."
            )
        known = multiprocessing.get_all_start_methods()
        start_method = start_method or ("fork" if "fork" in known else "spawn")
        if start_method not in known:
            raise ValueError(f"Unknown start_method {start_method!r}; known here: {known}.")

        self._hosts: list[Host] = []
        # Environments are dealt out in contiguous runs, so that a worker's part of every shared array is one slice.
        self._parts = [range(part[0], part[-1] + 1) for part in np.array_split(np.arange(len(env_fns)), n_workers)]
        self._home = [(worker, i - part[0]) for worker, part in enumerate(self._parts) for i in part]
        self._arrays: SharedArrays | None = None
        self.closed = False
        try:
            self._start(env_fns, start_method)
            observation_space, action_space = self._common_spaces()
            self._share(len(env_fns), observation_space, action_space)
            super().__init__(len(env_fns), observation_space, action_space)
            self.metadata = self.get_attr("metadata", 0)[0]
        except BaseException:
            self.close()
            raise

    def _start(self, env_fns: Sequence[Callable[[], gymnasium.Env]], start_method: str) -> None:
        context = multiprocessing.get_context(start_method)
        workers: list[HostInWorker] = []
        # Workers first: a fork shall not copy the environments of this process, and all make theirs at the same time.
        for worker, part in enumerate(self._parts[1:], 1):
            connections = [other.connection for other in workers]
            fns = EnvFns([env_fns[i] for i in part])
            workers.append(HostInWorker(context, connections, fns, part[0], f"BulletVecEnv-{worker}"))
            self._hosts.append(workers[-1])
        self._hosts.insert(0, HostHere([env_fns[i] for i in self._parts[0]]))

    def _common_spaces(self) -> tuple[spaces.Space, spaces.Space]:
        """The spaces of all environments, after a check that all have the same."""
        replies = self._gather(range(len(self._hosts)))
        all_spaces = [pair for worker in sorted(replies) for pair in replies[worker]]
        for index, pair in enumerate(all_spaces):
            if pair != all_spaces[0]:
                raise ValueError(
                    f"All environments must have the same spaces: number 0 has {all_spaces[0]}, number {index} has {pair}."
                )
        return all_spaces[0]

    def _share(self, n_envs: int, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        """Create the shared arrays and have all workers map them."""
        supported = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
        if not isinstance(action_space, supported):
            raise ValueError(
                f"BulletVecEnv needs a Box, Discrete, MultiDiscrete or MultiBinary action space, got {action_space}; "
                "wrap the environment or use SB3's SubprocVecEnv."
            )
        self._observation_names = _observation_names(observation_space)
        layout: dict[str, tuple[tuple[int, ...], np.dtype]] = {
            ACTION: ((n_envs, *_shape(action_space)), np.dtype(action_space.dtype)),
            # float32 as in SB3's own vector environments.
            REWARD: ((n_envs,), np.dtype(np.float32)),
            DONE: ((n_envs,), np.dtype(bool)),
        }
        for key, name in self._observation_names.items():
            space = observation_space if key is None else observation_space[key]  # type: ignore[index]
            layout[name] = ((n_envs, *_shape(space)), np.dtype(space.dtype))
        self._arrays = SharedArrays.create(layout)
        try:
            self._ask_all("attach", self._arrays.path, layout)
        finally:
            self._arrays.unlink()

    # ------------------------------------------------------------------ messages

    def _ask(self, requests: Mapping[int, Request], fatal: bool = False) -> dict[int, Any]:
        """Send a request to each of some hosts and wait for all replies."""
        if self.waiting:
            raise RuntimeError("A step is under way: call step_wait() first.")
        self._settle()
        self._post(requests)
        return self._gather(requests, fatal)

    def _ask_all(self, method: str, *arguments: Any) -> dict[int, Any]:
        return self._ask(dict.fromkeys(range(len(self._hosts)), (method, arguments)))

    def _settle(self) -> None:
        """Throw away what is left over from an exchange that a KeyboardInterrupt broke off."""
        if self.closed:
            raise RuntimeError("This BulletVecEnv is closed; make a new one.")
        for worker, host in enumerate(self._hosts):
            if host.owes_reply:
                self._receive(worker)

    def _post(self, requests: Mapping[int, Request]) -> None:
        for worker, request in requests.items():
            try:
                self._hosts[worker].post(request)
            except WorkerDied as death:
                self._bury(worker, death)

    def _gather(self, workers: Iterable[int], fatal: bool = True) -> dict[int, Any]:
        """
        Wait for the replies of some hosts; if one is an error, raise it after all have come.

        :param workers: indices
        :param fatal: whether an error closes the vector environment
        """
        # This process does its own part first: the others are at theirs.
        replies = {worker: self._receive(worker) for worker in sorted(workers)}
        for succeeded, result in replies.values():
            if not succeeded:
                error, text = result
                if fatal:
                    self.close()
                if error is None:
                    raise RuntimeError("An environment failed in a worker process.") from WorkerTraceback(text)
                raise error from WorkerTraceback(text)
        return {worker: result for worker, (_, result) in replies.items()}

    def _receive(self, worker: int) -> Reply:
        try:
            return self._hosts[worker].receive()
        except WorkerDied as death:
            self._bury(worker, death)

    def _bury(self, worker: int, death: WorkerDied) -> NoReturn:
        """Close everything because a worker died, and say so."""
        self.close()
        part = self._parts[worker]
        raise RuntimeError(
            f"Worker {worker} with environments {part[0]} to {part[-1]} died (exit code {death}; negative: ended by that "
            "signal, -9 often means that memory ran out). The vector environment is closed."
        ) from None

    # ------------------------------------------------------------------ stepping

    def reset(self) -> VecEnvObs:
        """Reset all environments; a step under way is thrown away (see base class)."""
        self.waiting = False
        requests = {
            worker: ("reset", (self._seeds[part[0] : part[-1] + 1], self._options[part[0] : part[-1] + 1]))
            for worker, part in enumerate(self._parts)
        }
        replies = self._ask(requests, fatal=True)
        self.reset_infos = [info for worker in range(len(self._hosts)) for info in replies[worker]]
        self._reset_seeds()
        self._reset_options()
        return self._copied_observations()

    def step_async(self, actions: np.ndarray) -> None:
        """
        Start a step (see base class).

        :param actions: ``(n_envs, *action_space.shape)``
        :raises ValueError: if they have another shape, or a type that the action space's cannot hold
        """
        if self.closed or self._arrays is None:
            raise RuntimeError("This BulletVecEnv is closed; make a new one.")
        if self.waiting:
            raise RuntimeError("A step is already under way: call step_wait() first.")
        shared = self._arrays[ACTION]
        actions = np.asarray(actions)
        if actions.shape != shared.shape:
            raise ValueError(f"Actions must have shape {shared.shape}, got {actions.shape}.")
        if isinstance(self.action_space, spaces.MultiBinary):
            actions = actions.astype(shared.dtype)  # SB3's policies say 0.0 and 1.0
        if not np.can_cast(actions.dtype, shared.dtype, casting="same_kind"):
            raise ValueError(f"Actions must be of a type that fits into {shared.dtype}, got {actions.dtype}.")
        self._settle()
        self.actions = actions  # as SB3's `DummyVecEnv` has them
        np.copyto(shared, actions, casting="same_kind")
        self._post(dict.fromkeys(range(len(self._hosts)), ("step", ())))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step (see base class)."""
        if not self.waiting or self._arrays is None:
            raise RuntimeError("No step is under way: call step_async() first.")
        # Before the wait: after a KeyboardInterrupt no step is under way any more, only replies to throw away.
        self.waiting = False
        replies = self._gather(range(len(self._hosts)))
        infos: list[dict[str, Any]] = []
        for worker, part in enumerate(self._parts):
            part_infos, reset_infos = replies[worker]
            infos.extend(unpack(part_infos))
            for i, reset_info in reset_infos.items():
                self.reset_infos[part[0] + i] = reset_info
        return self._copied_observations(), self._arrays[REWARD].copy(), self._arrays[DONE].copy(), infos

    def _copied_observations(self) -> VecEnvObs:
        """Copies, because the next step overwrites the shared memory."""
        assert self._arrays is not None
        arrays = self._arrays
        if None in self._observation_names:
            return arrays[SINGLE_OBSERVATION].copy()
        return {key: arrays[name].copy() for key, name in self._observation_names.items() if key is not None}

    # ------------------------------------------------------------------ questions

    def _ask_envs(self, method: str, indices: VecEnvIndices, *arguments: Any) -> list[Any]:
        """Ask some environments; answers in the order of the indices."""
        wanted = [range(self.num_envs)[i] for i in self._get_indices(indices)]
        local: dict[int, list[int]] = {}
        for i in wanted:
            local.setdefault(self._home[i][0], []).append(self._home[i][1])
        replies = self._ask({worker: (method, (own, *arguments)) for worker, own in local.items()})
        answers = {worker: iter(reply) for worker, reply in replies.items()}
        return [next(answers[self._home[i][0]]) for i in wanted]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        An attribute of some environments (see base class).

        :param attr_name: its name
        :param indices: of the environments, all by default
        """
        return self._ask_envs("get_attr", indices, attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """
        Whether all environments have an attribute (see base class).

        :param attr_name: its name
        """
        return all(self._ask_envs("has_attr", None, attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of some environments (see base class).

        :param attr_name: its name
        :param value: its value
        :param indices: of the environments, all by default
        """
        self._ask_envs("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of some environments (see base class).

        :param method_name: its name
        :param method_args: positional arguments
        :param indices: of the environments, all by default
        :param method_kwargs: keyword arguments
        """
        return self._ask_envs("env_method", indices, method_name, method_args, method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        Whether some environments have a wrapper of a class (see base class).

        :param wrapper_class: the class
        :param indices: of the environments, all by default
        """
        return self._ask_envs("env_is_wrapped", indices, wrapper_class)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of every environment if its ``render_mode`` is ``"rgb_array"`` (see base class)."""
        if self.render_mode != "rgb_array":
            warnings.warn(f"Pictures need render_mode='rgb_array', but it is {self.render_mode!r}.")
            return [None] * self.num_envs
        return self.env_method("render")

    # ------------------------------------------------------------------ end

    def close(self) -> None:
        """End all workers and free the shared memory; a second call does nothing."""
        # A forked child inherits this object, but the workers are its parent's.
        if self.closed or self._owner != os.getpid():
            return
        self.closed = True
        self.waiting = False
        for host in self._hosts:
            host.hang_up()
        # Workers first: whatever an environment's `close` does in this process, they are gone.
        for host in reversed(self._hosts):
            host.join()
        self._hosts.clear()
        if self._arrays is not None:
            self._arrays.unlink()
            self._arrays = None

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()


def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _shape(space: spaces.Space) -> tuple[int, ...]:
    assert space.shape is not None
    return space.shape


def _observation_names(space: spaces.Space) -> dict[str | None, str]:
    """Key of an observation (None for one that is no dict) -> name of its shared array."""
    if isinstance(space, spaces.Box):
        return {None: SINGLE_OBSERVATION}
    if isinstance(space, spaces.Dict) and all(isinstance(part, spaces.Box) for part in space.spaces.values()):
        return {key: observation_array(key) for key in space.spaces}
    raise ValueError(
        f"BulletVecEnv needs a Box or a flat Dict of Box observations, got {space}; "
        "flatten the observations or use SB3's SubprocVecEnv."
    )
