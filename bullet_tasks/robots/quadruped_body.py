"""The Unitree A1 as a high-level policy sees it, whatever physics moves it: sizes, limits, command, looks."""

import math
from typing import NamedTuple

from bullet_tasks.robots.base import Robot, RobotState
from bullet_tasks.shapes import Box, Colour

BODY_RADIUS = 0.22
"""Radius of the upright cylinder that stands for the body in collisions, m. Being round, it never wedges in a turn."""
BODY_HEIGHT = 0.30
"""Height of the trunk's centre above the ground, m (A1, standing)."""
MAX_YAW_RATE = 2.0
"""rad/s"""
WALKING_SPEED = 0.7
"""m/s, the constant forward speed command of the authors' release."""
CONTACT_FORCE = 0.1
"""A normal force above this counts as a collision, N (the authors' release)."""
HALF_TRUNK_HEIGHT = 0.10
"""Half the height of the cylinder that stands for the body, m."""
MASS = 12.46
"""kg (a1.urdf)."""
YAW_GAIN = 8.0
"""Of the proportional heading law, 1/s."""
PITCH_RATE = 0.8
"""Greatest change of the body pitch, rad/s, that of the walking robot's gait."""
SUBSTEP = 1.0 / 20.0
"""Time that a substep takes without legs, s."""

_HALF_TURN = math.pi + 1e-6  # rad; beyond it a heading is nearer the other way round

_TRUNK: Colour = (0.16, 0.22, 0.36, 1.0)
_HEAD: Colour = (1.0, 0.45, 0.08, 1.0)
_LEG: Colour = (0.10, 0.11, 0.13, 1.0)


class QuadrupedCommand(NamedTuple):
    """What a high-level policy tells the walking controller."""

    speed: float
    """Forward speed, m/s."""
    target_yaw: float
    """Heading, rad, on the same continuous scale as ``RobotState.yaw``."""
    pitch: float = 0.0
    """Body pitch, rad, nose down positive."""


def looks() -> tuple[Box, ...]:
    """Trunk, head and legs for the eye, in the body's frame."""
    legs = tuple(
        Box(f"leg_{i}", (fore * 0.18, side * 0.13, -0.17), (0.025, 0.025, 0.13), colour=_LEG)
        for i, (fore, side) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1)))
    )
    trunk = Box("trunk", (0.0, 0.0, 0.0), (0.25, 0.13, 0.07), colour=_TRUNK)
    head = Box("head", (0.25, 0.0, 0.03), (0.07, 0.09, 0.07), colour=_HEAD)
    return (trunk, head, *legs)


class LeglessQuadruped(Robot[QuadrupedCommand]):
    """What the quadrupeds without legs share: an upright round body that follows its command exactly on free ground."""

    substep_period = SUBSTEP

    def __init__(self) -> None:
        self.state = RobotState(0.0, 0.0, BODY_HEIGHT, 0.0, 0.0, 0.0, False)
        self._speed = 0.0
        self._target_yaw = 0.0
        self._target_pitch = 0.0

    def reset(self, x: float, y: float, ground: float, yaw: float) -> RobotState:
        """
        Put the robot somewhere, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        self._speed, self._target_yaw, self._target_pitch = 0.0, yaw, 0.0
        self.state = RobotState(x, y, ground + BODY_HEIGHT, yaw, 0.0, 0.0, False)
        return self.state

    def command(self, command: QuadrupedCommand) -> None:
        """
        Walk at a speed, turn towards a heading and a body pitch (see base class). The pitch only matters to sensors and legs.

        :param command: a target more than half a turn away is reached the shorter way round
        """
        self._speed = command.speed
        turn = command.target_yaw - self.state.yaw
        if abs(turn) > _HALF_TURN:
            turn = math.remainder(turn, math.tau)
        self._target_yaw = self.state.yaw + turn
        self._target_pitch = command.pitch

    def _pitched(self, time: float) -> float:
        """
        Body pitch, rad.

        :param time: after the present state, s
        """
        pitch, most = self.state.pitch, PITCH_RATE * time
        return pitch + max(-most, min(most, self._target_pitch - pitch))
