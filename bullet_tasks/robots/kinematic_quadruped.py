"""The quadruped as one PyBullet body that follows its command exactly: fast, and the reference for the compiled one."""

import math

from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped_body import (
    BODY_HEIGHT,
    BODY_RADIUS,
    CONTACT_FORCE,
    HALF_TRUNK_HEIGHT,
    MASS,
    MAX_YAW_RATE,
    SUBSTEP,
    YAW_GAIN,
    LeglessQuadruped,
    looks,
)
from bullet_tasks.shapes import Cylinder
from bullet_tasks.simulation import quaternion
from bullet_tasks.world import World

_YAW_INERTIA = 0.3  # kg m^2; only scales torques, which contacts of a round body without friction do not exert
_PIN_TOLERANCE = 1e-6  # m and quaternion units
_FREE_TOLERANCE = 1e-3 * CONTACT_FORCE * SUBSTEP / MASS  # m/s; a force that counts changes the velocity by 1,000 times as much


class KinematicQuadruped(LeglessQuadruped):
    """
    A body that follows its command exactly unless something is in its way: no legs, but PyBullet's collisions.

    The heading follows its target with a proportional law of limited rate. The velocity is set at every substep, gravity
    is off, and the body cannot tilt, so that a 1/20 s substep is exact on free ground. At a wall the impact sinks in by less
    than one substep's way (3.5 cm), which the next substeps push out again.

    :param world: the body is created in its simulation
    """

    def __init__(self, world: World) -> None:
        super().__init__()
        simulation = world.simulation
        simulation.configure(SUBSTEP, gravity=0.0)
        # Of two walls that are touched at once, the one that is solved first must not depend on the episodes before.
        simulation.client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        body = Cylinder("body", (0.0, 0.0, 0.0), BODY_RADIUS, HALF_TRUNK_HEIGHT)
        self._body = simulation.add_body(self.name, body, looks(), (0.0, 0.0, BODY_HEIGHT), mass=MASS)
        simulation.client.changeDynamics(
            self._body,
            -1,
            lateralFriction=0.0,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
            # No response to torques about the horizontal axes: the body cannot tilt.
            localInertiaDiagonal=(0.0, 0.0, _YAW_INERTIA),
        )
        self._simulation = simulation

    def reset(self, x: float, y: float, ground: float, yaw: float) -> RobotState:
        """
        Put the robot somewhere, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        state = super().reset(x, y, ground, yaw)
        self._simulation.place(self.name, (x, y, state.z), yaw)
        return state

    def substep(self) -> RobotState:
        """Let 1/20 s pass (see base class)."""
        simulation, body = self._simulation, self._body
        x0, y0, height, yaw = self.state[:4]
        rate = max(-MAX_YAW_RATE, min(MAX_YAW_RATE, YAW_GAIN * (self._target_yaw - yaw)))
        # The mean heading of the substep makes an arc of chords of the right radius.
        heading = yaw + 0.5 * rate * SUBSTEP
        told_vx, told_vy = self._speed * math.cos(heading), self._speed * math.sin(heading)
        simulation.set_velocity(body, (told_vx, told_vy, 0.0), (0.0, 0.0, rate))
        simulation.step()
        (x, y, z), (qx, qy, qz, qw) = simulation.pose(body)
        yaw += math.remainder(2.0 * math.atan2(qz, qw) - yaw, math.tau)
        if abs(z - height) > _PIN_TOLERANCE or abs(qx) > _PIN_TOLERANCE or abs(qy) > _PIN_TOLERANCE:
            simulation.set_pose(body, (x, y, height), quaternion(yaw))
        vx, vy = (x - x0) / SUBSTEP, (y - y0) / SUBSTEP
        # Reading the contacts takes as long as a step on free ground: only where the body did not go as it was told.
        off = max(abs(vx - told_vx), abs(vy - told_vy), abs(z - height) / SUBSTEP)
        pressed = off > _FREE_TOLERANCE and simulation.pressed(body, CONTACT_FORCE)
        self.state = RobotState(x, y, height, yaw, vx, vy, pressed, self._pitched(SUBSTEP))
        return self.state
