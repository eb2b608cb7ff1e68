"""The Unitree A1 as seen by a high-level policy that commands its speed, heading and body pitch."""

import math
from typing import NamedTuple

from bullet_tasks.robots.base import Robot, RobotState
from bullet_tasks.shapes import Box, Colour, Cylinder
from bullet_tasks.simulation import Simulation, quaternion

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

_HALF_TRUNK_HEIGHT = 0.10  # m
_MASS = 12.46  # kg, a1.urdf
_YAW_INERTIA = 0.3  # kg m^2; only scales torques, which contacts of a round body without friction do not exert
_YAW_GAIN = 8.0  # 1/s, proportional heading law
_KINEMATIC_SUBSTEP = 1.0 / 20.0  # s
_PIN_TOLERANCE = 1e-6  # m and quaternion units
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


def _looks() -> tuple[Box, ...]:
    """Trunk, head and legs for the eye, in the body's frame."""
    legs = tuple(
        Box(f"leg_{i}", (fore * 0.18, side * 0.13, -0.17), (0.025, 0.025, 0.13), colour=_LEG)
        for i, (fore, side) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1)))
    )
    trunk = Box("trunk", (0.0, 0.0, 0.0), (0.25, 0.13, 0.07), colour=_TRUNK)
    head = Box("head", (0.25, 0.0, 0.03), (0.07, 0.09, 0.07), colour=_HEAD)
    return (trunk, head, *legs)


class KinematicQuadruped(Robot[QuadrupedCommand]):
    """
    A body that follows its command exactly unless something is in its way: no legs, but PyBullet's collisions.

    The heading follows its target with a proportional law of limited rate. The velocity is set at every substep, gravity
    is off, and the body cannot tilt, so that a 1/20 s substep is exact on free ground. At a wall the impact sinks in by less
    than one substep's way (3.5 cm), which the next substeps push out again.

    :param simulation: where the body is created
    """

    substep_period = _KINEMATIC_SUBSTEP

    def __init__(self, simulation: Simulation) -> None:
        simulation.configure(_KINEMATIC_SUBSTEP, gravity=0.0)
        body = Cylinder("body", (0.0, 0.0, 0.0), BODY_RADIUS, _HALF_TRUNK_HEIGHT)
        self._body = simulation.add_body(self.name, body, _looks(), (0.0, 0.0, BODY_HEIGHT), mass=_MASS)
        client = simulation.client
        client.changeDynamics(
            self._body,
            -1,
            lateralFriction=0.0,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
            # No response to torques about the horizontal axes: the body cannot tilt.
            localInertiaDiagonal=(0.0, 0.0, _YAW_INERTIA),
        )
        self._set_velocity = client.resetBaseVelocity
        self._set_pose = client.resetBasePositionAndOrientation
        self._get_pose = client.getBasePositionAndOrientation
        self._step = simulation.step
        self._pressed = simulation.pressed
        self._speed = 0.0
        self._target_yaw = 0.0
        self._height = BODY_HEIGHT
        self.state = RobotState(0.0, 0.0, BODY_HEIGHT, 0.0, 0.0, 0.0, False)

    def reset(self, x: float, y: float, ground: float, yaw: float) -> RobotState:
        """
        Put the robot somewhere, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        self._height = ground + BODY_HEIGHT
        self._set_pose(self._body, (x, y, self._height), quaternion(yaw))
        self._set_velocity(self._body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._speed, self._target_yaw = 0.0, yaw
        self.state = RobotState(x, y, self._height, yaw, 0.0, 0.0, False)
        return self.state

    def command(self, command: QuadrupedCommand) -> None:
        """
        Walk at a speed and turn towards a heading (see base class). The pitch only matters to sensors and legs.

        :param command: a target more than half a turn away is reached the shorter way round
        """
        self._speed = command.speed
        turn = command.target_yaw - self.state.yaw
        if abs(turn) > _HALF_TURN:
            turn = math.remainder(turn, math.tau)
        self._target_yaw = self.state.yaw + turn

    def substep(self) -> RobotState:
        """Let 1/20 s pass (see base class)."""
        x0, y0, _, yaw, _, _, _ = self.state
        rate = max(-MAX_YAW_RATE, min(MAX_YAW_RATE, _YAW_GAIN * (self._target_yaw - yaw)))
        # The mean heading of the substep makes an arc of chords of the right radius.
        heading = yaw + 0.5 * rate * _KINEMATIC_SUBSTEP
        velocity = (self._speed * math.cos(heading), self._speed * math.sin(heading), 0.0)
        self._set_velocity(self._body, velocity, (0.0, 0.0, rate))
        self._step()
        (x, y, z), (qx, qy, qz, qw) = self._get_pose(self._body)
        yaw += math.remainder(2.0 * math.atan2(qz, qw) - yaw, math.tau)
        if abs(z - self._height) > _PIN_TOLERANCE or abs(qx) > _PIN_TOLERANCE or abs(qy) > _PIN_TOLERANCE:
            self._set_pose(self._body, (x, y, self._height), quaternion(yaw))
        self.state = RobotState(
            x,
            y,
            self._height,
            yaw,
            (x - x0) / _KINEMATIC_SUBSTEP,
            (y - y0) / _KINEMATIC_SUBSTEP,
            self._pressed(self._body, CONTACT_FORCE),
        )
        return self.state


_PHYSICS = {"kinematic": KinematicQuadruped}
_PLANNED_PHYSICS = ("full",)


def make_quadruped(simulation: Simulation, physics: str = "kinematic") -> Robot[QuadrupedCommand]:
    """
    Create the robot in a simulation.

    :param simulation: where
    :param physics: ``"kinematic"``: the body follows the command, collisions are PyBullet's
    :raises ValueError: if the physics is unknown or not available yet
    """
    check_physics(physics)
    return _PHYSICS[physics](simulation)


def check_physics(physics: str) -> None:
    """
    Reject an unknown kind of physics before anything is built.

    :param physics: its name
    :raises ValueError: if it is unknown or not available yet
    """
    if physics in _PLANNED_PHYSICS:
        raise ValueError(f"physics={physics!r} is not available yet for the quadruped; available: {sorted(_PHYSICS)}.")
    if physics not in _PHYSICS:
        raise ValueError(f"Unknown physics {physics!r} for the quadruped; available: {sorted(_PHYSICS)}.")
