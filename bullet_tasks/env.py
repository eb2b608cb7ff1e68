"""The gymnasium environment: a robot, a task and sensors put together."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import TimeLimit

from bullet_tasks.robots.base import Robot
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import Sensor
from bullet_tasks.tasks.base import Outcome, Task
from bullet_tasks.world import World

# Relative to one substep: how far the decision period may be from a whole number of substeps.
_PERIOD_TOLERANCE = 1e-6


class RobotTaskEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """
    Robot x task x sensors.

    Observations are a dict of ``common``, ``privileged`` and, if there is a sensor, ``target``. ``info`` holds
    ``is_success`` (bool) and ``position`` (float32, m: ``(2,)``, or ``(3,)`` of what flies), and after a step ``reward_terms``
    (name -> float, their sum is the reward) and ``fallen`` (bool, see ``Robot``).

    An episode depends on its seed and the actions alone, not on what happened before: it is started by repositioning
    bodies, which in PyBullet leaves no trace in later steps for a body without legs.

    PyBullet runs only where the robot's physics or a picture needs it.

    It does not end when the task's time is up: ``TaskTimeLimit`` does, which ``gymnasium.make`` adds.

    :param make_robot: creates the robot in a world
    :param task: geometry, goal, rewards and ends
    :param sensors: at most one; its readings are the ``target`` observation
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :raises ValueError: if an argument is not a possible choice
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        make_robot: Callable[[World], Robot[Any]],
        task: Task,
        sensors: Sequence[Sensor] = (),
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"Unknown render_mode {render_mode!r}; known: None, {self.metadata['render_modes']}.")
        if len(sensors) > 1:
            raise ValueError(f"At most one sensor can yield the `target` observation, got {len(sensors)}.")
        self.task = task
        self.sensors = tuple(sensors)
        self.render_mode = render_mode
        self.decision_period = task.decision_period
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / task.decision_period))}
        observations: dict[str, spaces.Space[Any]] = {"common": task.common_space, "privileged": task.privileged_space}
        if self.sensors:
            observations["target"] = self.sensors[0].space
        self.observation_space: spaces.Space[Any] = spaces.Dict(observations)
        self.action_space = task.action_space
        self._action_shape = task.action_space.shape
        self._bounds: list[tuple[float, float]] = []
        if isinstance(task.action_space, spaces.Box):
            self._bounds = list(zip(task.action_space.low.tolist(), task.action_space.high.tolist(), strict=True))
        self._n_choices = task.action_space.nvec.tolist() if isinstance(task.action_space, spaces.MultiDiscrete) else None
        self.discrete_privileged, self.symmetries = task.discrete_privileged, task.symmetries

        self.world = World(task.scene, gui=render_mode == "human")
        try:
            self.robot = make_robot(self.world)
            if render_mode == "human":
                self.robot.appear(self.world.simulation)
            substeps = task.decision_period / self.robot.substep_period
            if round(substeps) < 1 or abs(substeps - round(substeps)) > _PERIOD_TOLERANCE:
                raise ValueError(
                    f"`decision_period` ({task.decision_period} s) must be a whole number of the robot's substeps "
                    f"({self.robot.substep_period} s)."
                )
        except BaseException:
            self.world.close()
            raise
        self._substeps = round(substeps)
        self._elapsed_substeps = 0
        self._privileged = np.empty(0, dtype=np.float32)
        self._substeps_in_limit = task.time_limit / self.robot.substep_period

    @property
    def scene(self) -> SceneSpec:
        """The scene of the present episode."""
        return self.world.scene

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        Start an episode.

        :param seed: of the random numbers from now on
        :param options: none are known
        :raises ValueError: if there are options
        """
        self._check_open()
        super().reset(seed=seed)
        if options:
            raise ValueError(f"Unknown reset options {sorted(options)}; this environment has none.")
        start = self.task.reset(self.np_random)
        self.world.place(start.placements)
        scene = self.scene
        self.robot.vary(self.np_random)
        state = self.robot.reset(start.x, start.y, scene.ground_height(start.x, start.y), start.yaw)
        self.task.begin(state, scene)
        self._privileged = self.task.privileged()
        for sensor in self.sensors:
            sensor.reset(scene, self.np_random)
        self._elapsed_substeps = 0
        if self.render_mode == "human":
            self.robot.appear(self.world.simulation)
        info = {"is_success": False, "position": np.array(state.position, dtype=np.float32)}
        return self._observation(), info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """
        Hold an action for one decision period, or until the episode ends.

        :param action: numbers in the action space; those beyond the bounds of a Box are clipped
        :raises ValueError: if the action has another shape, is not finite or names a choice that there is not
        :raises ResetNeeded: before the first ``reset``
        """
        self._check_open()
        if not self._privileged.size:
            raise ResetNeeded("Call `reset` before the first `step`.")
        task, robot = self.task, self.robot
        robot.command(task.command(self._checked(action), robot.state))
        substeps, contacts, outcome = robot.advance(self._substeps, task.judge)
        state = robot.state
        self._elapsed_substeps += substeps
        time_left = max(0.0, 1.0 - self._elapsed_substeps / self._substeps_in_limit)
        terms = task.reward_terms(state, contacts * robot.substep_period, time_left, outcome)
        info = {
            "is_success": outcome is Outcome.SUCCESS,
            "position": np.array(state.position, dtype=np.float32),
            "reward_terms": terms,
            "fallen": robot.fallen,
        }
        if self.render_mode == "human":
            robot.appear(self.world.simulation)
            time.sleep(self.decision_period)
        return self._observation(), sum(terms.values()), outcome is not Outcome.RUNNING, False, info

    def _check_open(self) -> None:
        # PyBullet gives the number of a closed client to the next one: a step now would move somebody else's robot.
        if self.world.closed:
            raise RuntimeError("This environment is closed; make a new one.")

    def _checked(self, action: np.ndarray) -> list[float]:
        """The action as floats: within the bounds, or each one of the choices."""
        array = np.asarray(action, dtype=np.float64)
        if array.shape != self._action_shape:
            raise ValueError(f"An action must have shape {self._action_shape}, got {array.shape}.")
        values: list[float] = array.tolist()
        for value in values:
            if not math.isfinite(value):
                raise ValueError(f"An action must be finite, got {values}.")
        if self._n_choices is not None:
            for value, n in zip(values, self._n_choices, strict=True):
                if not (value.is_integer() and 0.0 <= value < n):
                    raise ValueError(f"An action must be whole numbers from 0 and below {self._n_choices}, got {values}.")
            return values
        return [max(low, min(high, value)) for value, (low, high) in zip(values, self._bounds, strict=True)]

    def _observation(self) -> dict[str, np.ndarray]:
        state = self.robot.state
        # What only training knows does not change within an episode.
        observation = {"common": self.task.common(state), "privileged": self._privileged.copy()}
        if self.sensors:
            observation["target"] = self.sensors[0].read(state)
        return observation

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        Take a picture, uint8 ``(height, width, 3)``; None unless ``render_mode="rgb_array"`` (a window draws itself).
        """
        if self.render_mode != "rgb_array":
            return None
        self._check_open()
        simulation = self.world.simulation
        self.robot.appear(simulation)
        return simulation.picture(self.task.camera, *self.task.picture_size)

    def close(self) -> None:
        """Close the world and what sensors hold open; a second call does nothing."""
        for sensor in self.sensors:
            sensor.close()
        self.world.close()


class TaskTimeLimit(TimeLimit):
    """
    Truncates an episode when the time is up that the task's configuration gives it, or after the ``max_episode_steps`` that
    ``gymnasium.make`` was given; -1 there does not lift the limit, a great number or ``env.unwrapped`` does.

    :param env: a ``RobotTaskEnv``, within ``TimeLimit`` if ``max_episode_steps`` was given
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        given = None if env.spec is None else env.spec.max_episode_steps
        super().__init__(env, given or env.get_wrapper_attr("task").max_decisions)
