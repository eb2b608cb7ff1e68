"""What every sensor offers to an environment."""

from abc import ABC, abstractmethod

import numpy as np
from gymnasium import spaces

from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec


class Sensor(ABC):
    """Reads the scene from where the robot is."""

    space: spaces.Box
    """Of one reading."""

    @abstractmethod
    def reset(self, scene: SceneSpec, rng: np.random.Generator) -> None:
        """
        Start an episode.

        :param scene: the world of this episode
        :param rng: source of all randomness
        """

    @abstractmethod
    def read(self, state: RobotState) -> np.ndarray:
        """
        One reading, in ``space``.

        :param state: of the robot that carries the sensor
        """

    def close(self) -> None:  # noqa: B027 (most sensors hold nothing)
        """Free what the sensor holds open, by default nothing; a second call does nothing."""
