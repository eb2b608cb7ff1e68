"""What every robot that moves over ground offers to an environment, whatever physics is behind it."""

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, NamedTuple, TypeVar

CommandT = TypeVar("CommandT")


class RobotState(NamedTuple):
    """
    A robot's base after a substep.

    ``yaw`` is continuous: it is not wrapped, so that a half turn to the left differs from one to the right.
    """

    x: float
    """m"""
    y: float
    """m"""
    z: float
    """m"""
    yaw: float
    """rad"""
    vx: float
    """Mean velocity over the substep in the world, m/s."""
    vy: float
    """m/s"""
    in_contact: bool
    """Whether something pressed on the body during the substep."""


class Robot(ABC, Generic[CommandT]):
    """A robot in a simulation: placed by ``reset``, told by ``command``, moved by ``substep``."""

    name: ClassVar[str] = "robot"
    substep_period: float
    """Time that one ``substep`` takes, s."""
    state: RobotState

    @abstractmethod
    def reset(self, x: float, y: float, ground: float, yaw: float) -> RobotState:
        """
        Put the robot somewhere, at rest.

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """

    @abstractmethod
    def command(self, command: CommandT) -> None:
        """
        Set the command that holds from now on.

        :param command: what the robot is to do
        """

    @abstractmethod
    def substep(self) -> RobotState:
        """Let ``substep_period`` pass."""
