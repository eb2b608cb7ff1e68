"""What every task offers to an environment."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces

from bullet_tasks.ends import Judge, Outcome
from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Vector3
from bullet_tasks.simulation import Camera


class Start(NamedTuple):
    """How an episode begins."""

    x: float
    """m"""
    y: float
    """m"""
    yaw: float
    """rad"""
    placements: Mapping[str, tuple[Vector3, float]]
    """Shapes that are elsewhere in this episode: name -> (centre in m, yaw in rad)."""


class Task(ABC):
    """Where a robot is, what it is to do, and what that is worth. A task object belongs to one environment."""

    scene: SceneSpec
    decision_period: float
    """Time that one action holds, s."""
    time_limit: float
    """Length of an episode that nothing ends, s."""
    action_space: spaces.Box | spaces.MultiDiscrete
    common_space: spaces.Box
    """What the deployed robot always knows, ``(n_common,)``."""
    privileged_space: spaces.Box
    """What only training knows, ``(n_privileged,)``."""
    discrete_privileged: Mapping[int, Sequence[float]] = {}
    """The privileged dimensions that are discrete, and their values."""
    symmetries: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    """Of the world: matrices that turn ``common`` and ``privileged`` into those of the same episode in a world that is turned
    or mirrored, where sensors and actions stay what they were."""
    camera: ClassVar[Camera]
    """Shows the whole scene."""
    judge: Judge
    """Says how this episode stands, set by ``begin``. Compiled robots are fastest if it is an ``Ends``."""
    picture_size: ClassVar[tuple[int, int]]
    """Width and height of a picture that suits the camera, pixels."""

    @property
    def max_decisions(self) -> int:
        """Number of decisions in an episode that nothing ends."""
        return round(self.time_limit / self.decision_period)

    @abstractmethod
    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw an episode.

        :param rng: source of all randomness
        """

    @abstractmethod
    def begin(self, state: RobotState, scene: SceneSpec) -> None:
        """
        Take note of where the robot stands at the start.

        :param state: of the robot
        :param scene: the world of this episode
        """

    @abstractmethod
    def command(self, action: Sequence[float], state: RobotState) -> Any:
        """
        Turn an action into the robot's command.

        :param action: numbers in the action space
        :param state: of the robot, now
        """

    @abstractmethod
    def reward_terms(self, state: RobotState, contact_time: float, time_left: float, outcome: Outcome) -> dict[str, float]:
        """
        What the last decision was worth, by name; the reward is the sum.

        :param state: of the robot, after the decision
        :param contact_time: time that something pressed on the robot during the decision, s
        :param time_left: fraction of the episode's time that is left
        :param outcome: how the episode stands
        """

    @abstractmethod
    def common(self, state: RobotState) -> np.ndarray:
        """
        What the deployed robot always knows, float32 ``(n_common,)``.

        :param state: of the robot
        """

    @abstractmethod
    def privileged(self) -> np.ndarray:
        """What only training knows in this episode, float32 ``(n_privileged,)``."""

    @abstractmethod
    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put a belief over the privileged observation on the map.

        :param mean: ``(n_privileged,)``
        :param std: standard deviation, ``(n_privileged,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation along x and y, m
        """
