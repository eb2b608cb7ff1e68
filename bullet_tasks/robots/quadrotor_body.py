"""The quadrotor as a high-level policy sees it, whatever physics moves it: sizes, inner loop, command, state, looks."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pybullet

from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.base import Robot, RobotState
from bullet_tasks.shapes import Box, Colour, Shape

HALF_EXTENTS = (0.12, 0.12, 0.05)
"""Half edges of the box that stands for frame and legs in collisions, m."""
MASS = 0.5
"""kg"""
GRAVITY = 9.81
"""m/s^2"""
DRAG = 1.0
"""Horizontal deceleration per speed, 1/s: a hull in the way of the wind, so that a drift ends at 1 m/s for 0.1 rad of tilt."""
BANDWIDTH = 6.0
"""Of the critically damped attitude loop, rad/s."""
ALTITUDE_GAIN = 1.5
"""Climbing speed asked for per m of altitude error, 1/s."""
MAX_CLIMB = 1.5
"""m/s"""
MAX_SINK = 1.2
"""m/s"""
SPEED_GAIN = 5.0
"""Vertical acceleration asked for per error of the climbing speed, 1/s."""
MAX_ACCELERATION = 5.0
"""Vertical, m/s^2; half of what hanging in the air takes."""
SETTLING_TIME = 0.05
"""Time constant in which a tilted body falls on its feet, s."""
SUBSTEP = 1.0 / 50.0
"""Time that a substep takes without rotors, s (the paper's control step)."""

_FRAME: Colour = (0.16, 0.20, 0.28, 1.0)
_ROTOR: Colour = (0.55, 0.60, 0.68, 1.0)
_NOSE: Colour = (1.0, 0.45, 0.08, 1.0)
_ROTOR_DISTANCE = 0.12  # m along x and along y, for the eye


class QuadrotorCommand(NamedTuple):
    """What a high-level policy tells the inner loop, in true quantities."""

    roll: float
    """rad, right side down positive"""
    pitch: float
    """rad, nose down positive"""
    altitude: float
    """Height above where the quadrotor would stand on the ground, m."""


class Aloft(NamedTuple):
    """How a flight begins, at rest."""

    altitude: float
    """m"""
    roll: float
    """rad"""
    pitch: float
    """rad"""


Launch = Callable[[], Aloft]
"""Asked at every reset where in the air the flight begins."""


class QuadrotorState(RobotState):
    """A robot's base after a substep, and its flight."""

    altitude: float
    """Height above where it would stand on the ground, m."""
    roll: float
    """rad"""
    roll_rate: float
    """Of the angle, rad/s."""
    pitch_rate: float
    """rad/s"""
    yaw_rate: float
    """rad/s"""
    vz: float
    """m/s"""
    landed: bool
    """Whether it stands on all its feet."""
    impact: float
    """Speed with which it touched down in this substep, m/s; 0 in others."""
    impact_tilt: float
    """Tilt with which it touched down in this substep, rad; 0 in others."""
    time: float
    """Since the start, s."""

    @property
    def position(self) -> tuple[float, ...]:
        """x, y and altitude, m."""
        return self.x, self.y, self.altitude


def state_of(flight: np.ndarray, floor: float) -> QuadrotorState:
    """
    A flight as others see it.

    :param flight: as in ``quadrotor_kernels``
    :param floor: height of the floor, m
    """
    # In the order of the kernels' entries; a list of floats is read much faster than an array.
    (
        x,
        y,
        z,
        yaw,
        vx,
        vy,
        vz,
        roll,
        pitch,
        roll_rate,
        pitch_rate,
        yaw_rate,
        touching,
        landed,
        impact,
        impact_tilt,
        time,
    ) = flight.tolist()
    state = QuadrotorState(x, y, z + floor, yaw, vx, vy, touching != 0.0, pitch)
    state.altitude = z - HALF_EXTENTS[2]
    state.roll = roll
    state.roll_rate, state.pitch_rate, state.yaw_rate = roll_rate, pitch_rate, yaw_rate
    state.vz = vz
    state.landed = landed != 0.0
    state.impact, state.impact_tilt = impact, impact_tilt
    state.time = time
    return state


def orientation(state: QuadrotorState) -> tuple[float, float, float, float]:
    """
    Rotation of the body in PyBullet's order (x, y, z, w): roll after pitch after yaw.

    :param state: of the quadrotor
    """
    quaternion: tuple[float, float, float, float] = pybullet.getQuaternionFromEuler((state.roll, state.pitch, state.yaw))
    return quaternion


def body_array() -> np.ndarray:
    """The body and its inner loop as the compiled functions take them, ``(N_BODY,)``."""
    body = np.empty(kernels.N_BODY)
    body[kernels.PERIOD] = SUBSTEP
    body[[kernels.HALF_X, kernels.HALF_Y, kernels.HALF_Z]] = HALF_EXTENTS
    body[kernels.BANDWIDTH] = BANDWIDTH
    body[kernels.ALTITUDE_GAIN] = ALTITUDE_GAIN
    body[kernels.MAX_CLIMB] = MAX_CLIMB
    body[kernels.MAX_SINK] = MAX_SINK
    body[kernels.SPEED_GAIN] = SPEED_GAIN
    body[kernels.MAX_ACCELERATION] = MAX_ACCELERATION
    body[kernels.DRAG] = DRAG
    body[kernels.SETTLING] = SETTLING_TIME
    body[kernels.GRAVITY] = GRAVITY
    return body


def looks() -> tuple[Shape, ...]:
    """Frame, rotors and nose for the eye, in the body's frame."""
    arms = tuple(
        Box(f"arm_{i}", (0.0, 0.0, 0.02), (0.17, 0.012, 0.01), yaw=yaw, colour=_FRAME)
        for i, yaw in enumerate((0.25 * math.pi, -0.25 * math.pi))
    )
    corners = [(i * _ROTOR_DISTANCE, j * _ROTOR_DISTANCE) for i in (1, -1) for j in (1, -1)]
    rotors = tuple(Box(f"rotor_{i}", (x, y, 0.04), (0.08, 0.08, 0.006), colour=_ROTOR) for i, (x, y) in enumerate(corners))
    legs = tuple(
        Box(f"leg_{i}", (0.8 * x, 0.8 * y, -0.02), (0.008, 0.008, 0.03), colour=_FRAME) for i, (x, y) in enumerate(corners)
    )
    hull = Box("hull", (0.0, 0.0, 0.02), (0.07, 0.05, 0.03), colour=_FRAME)
    nose = Box("nose", (0.08, 0.0, 0.02), (0.02, 0.03, 0.02), colour=_NOSE)
    return (hull, nose, *arms, *rotors, *legs)


class Quadrotor(Robot[QuadrotorCommand]):
    """
    What all quadrotors share: a flight as an array, a start in the air, a command.

    :param launch: where in the air a flight begins, asked at every reset
    """

    state: QuadrotorState

    def __init__(self, launch: Launch) -> None:
        self._launch = launch
        self._floor = 0.0
        self._flight = np.zeros(kernels.N_FLIGHT)
        self._body = body_array()
        self._command = np.zeros(3)
        self.state = state_of(self._flight, self._floor)

    def reset(self, x: float, y: float, ground: float, yaw: float) -> QuadrotorState:
        """
        Begin a flight above a place, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        aloft = self._launch()
        flight = self._flight
        flight[:] = 0.0
        flight[kernels.X], flight[kernels.Y], flight[kernels.YAW] = x, y, yaw
        flight[kernels.Z] = aloft.altitude + HALF_EXTENTS[2]
        flight[kernels.ROLL], flight[kernels.PITCH] = aloft.roll, aloft.pitch
        self._floor = ground
        self.command(QuadrotorCommand(aloft.roll, aloft.pitch, aloft.altitude))
        self.state = state_of(flight, ground)
        return self.state

    def command(self, command: QuadrotorCommand) -> None:
        """
        Hold an attitude and an altitude (see base class).

        :param command: true roll, pitch and altitude
        """
        self._command[:] = command
