"""What every robot that moves over ground offers to an environment, whatever physics is behind it."""

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from bullet_tasks.ends import Judge, Outcome
from bullet_tasks.simulation import Simulation

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
    pitch: float = 0.0
    """rad, nose down positive."""

    @property
    def position(self) -> tuple[float, ...]:
        """Where it is, for ``info["position"]``: x and y in m, and the altitude of what flies."""
        return self.x, self.y


class Stretch(NamedTuple):
    """What came of some substeps; the robot's state is that after the last of them."""

    substeps: int
    """How many there were: fewer than asked for if the episode ended."""
    contacts: int
    """In how many of them something pressed on the body."""
    outcome: Outcome
    """How the episode stands."""


class Robot(ABC, Generic[CommandT]):
    """A robot in a world: placed by ``reset``, told by ``command``, moved by ``substep``."""

    name: ClassVar[str] = "robot"
    substep_period: float
    """Time that one ``substep`` takes, s."""
    state: RobotState
    fallen: bool = False
    """Whether the robot has tipped over or sunk down since it was placed, which ends the episode; only one on legs can."""

    def vary(self, rng: np.random.Generator) -> None:
        """
        Draw what the pose of the next ``reset`` leaves open. Nothing, but for a robot on legs (its stride's phase)
        or with domain randomisation (its body).

        :param rng: the episode's random generator
        """

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

    def advance(self, n_substeps: int, judge: Judge) -> Stretch:
        """
        Let several substeps pass, but stop where the episode ends.

        :param n_substeps: at least 1
        :param judge: of every substep
        """
        done = contacts = 0
        outcome = Outcome.RUNNING
        while done < n_substeps and outcome is Outcome.RUNNING:
            state = self.substep()
            done += 1
            contacts += state.in_contact
            outcome = judge(state)
        return Stretch(done, contacts, outcome)

    def appear(self, simulation: Simulation) -> None:
        """
        Be where ``state`` says in the pictures of a simulation; only a robot that does not live in it has to do anything.

        :param simulation: that will take the picture
        """
