"""The quadrotor with rotors: PyBullet's rigid body, lifted by four thrusts, on legs that touch the ground."""

import math

import numpy as np
import pybullet

from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.quadrotor_body import (
    GRAVITY,
    HALF_EXTENTS,
    MASS,
    Launch,
    Quadrotor,
    QuadrotorState,
    looks,
    orientation,
    state_of,
)
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

SUBSTEP = 1.0 / 240.0
"""Time that a substep takes with rotors, s (PyBullet's own default)."""
INERTIA = (2.8e-3, 2.8e-3, 4.8e-3)
"""About the body's axes, kg m^2: a box of 0.24 m x 0.24 m x 0.1 m and 0.5 kg."""
ARM = 0.12
"""Distance of a rotor's axis from the body's axes of roll and of pitch, m."""
MAX_THRUST = 0.5 * MASS * GRAVITY
"""Of one rotor, N: twice what hanging in the air takes."""
YAW_DRAG = 0.02
"""Torque by which a rotor drags the body round, per thrust, m (0.025 m for the 27 g Crazyflie of gym-pybullet-drones)."""
ROTOR_LAG = 0.02
"""Time constant in which a thrust follows its command, s."""
YAW_DAMPING = 4.0
"""Of the yaw rate, 1/s."""
CONTACT_FORCE = 0.1
"""A normal force above this counts as a touch, N (that of the quadruped)."""
LANDED_TILT = 0.02
"""A body on the ground that is tilted less than this stands on all its feet, rad."""


class FullQuadrotor(Quadrotor):
    """
    A rigid body under four thrusts with lag and limits, the torques of rotor drag, and the drag of the air.

    The inner loop asks for the same accelerations as that of ``KinematicQuadrotor``; what becomes of them is up to rotors
    and contacts. Its thrust makes up for the tilt, which takes an accelerometer and no attitude.

    :param world: the body is created in its simulation
    :param launch: where in the air a flight begins, asked at every reset
    """

    substep_period = SUBSTEP

    def __init__(self, world: World, launch: Launch) -> None:
        super().__init__(launch)
        simulation = world.simulation
        simulation.configure(SUBSTEP, gravity=GRAVITY)
        client = simulation.client
        self._id = simulation.add_body(
            self.name, Box("body", (0.0, 0.0, 0.0), HALF_EXTENTS), looks(), (0.0, 0.0, 1.0), mass=MASS
        )
        client.changeDynamics(
            self._id, -1, linearDamping=0.0, angularDamping=0.0, restitution=0.0, localInertiaDiagonal=INERTIA
        )
        rotors = np.empty(kernels.N_ROTORS)
        rotors[[kernels.INERTIA_X, kernels.INERTIA_Y, kernels.INERTIA_Z]] = INERTIA
        rotors[kernels.MASS] = MASS
        rotors[kernels.ARM] = ARM
        rotors[kernels.MAX_THRUST] = MAX_THRUST
        rotors[kernels.YAW_DRAG] = YAW_DRAG
        rotors[kernels.LAG] = SUBSTEP / ROTOR_LAG
        rotors[kernels.YAW_DAMPING] = YAW_DAMPING
        self._rotors = rotors
        self._thrusts = np.zeros(4)
        self._client = client
        # Bound once: looking a function up through BulletClient costs as much as a short call.
        self._push, self._twist = client.applyExternalForce, client.applyExternalTorque
        self._get_pose, self._get_velocity = client.getBasePositionAndOrientation, client.getBaseVelocity
        self._step = simulation.step
        self._pressed = simulation.pressed

    def reset(self, x: float, y: float, ground: float, yaw: float) -> QuadrotorState:
        """
        Begin a flight above a place, at rest, with rotors that carry it (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        state = super().reset(x, y, ground, yaw)
        self._client.resetBasePositionAndOrientation(self._id, (x, y, state.z), orientation(state))
        self._client.resetBaseVelocity(self._id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._thrusts[:] = 0.25 * MASS * GRAVITY / (math.cos(state.roll) * math.cos(state.pitch))
        return state

    def substep(self) -> QuadrotorState:
        """Let 1/240 s pass (see base class)."""
        before = self.state
        wrench = kernels.spin(self._flight, self._command, self._body, self._rotors, self._thrusts)
        self._push(self._id, -1, wrench[:3], (before.x, before.y, before.z), pybullet.WORLD_FRAME)
        self._twist(self._id, -1, wrench[3:], pybullet.WORLD_FRAME)
        self._step()
        self.state = self._measured(before)
        return self.state

    def _measured(self, before: QuadrotorState) -> QuadrotorState:
        """The body as PyBullet left it."""
        (x, y, z), quaternion = self._get_pose(self._id)
        roll, pitch, yaw = pybullet.getEulerFromQuaternion(quaternion)
        (vx, vy, vz), angular = self._get_velocity(self._id)
        c, s = math.cos(yaw), math.sin(yaw)
        # Rates of the angles from the angular velocity in the world.
        ahead, aside = c * angular[0] + s * angular[1], c * angular[1] - s * angular[0]
        roll_rate = ahead / math.cos(pitch)
        yaw_rate = angular[2] + ahead * math.tan(pitch)
        touching = self._pressed(self._id, CONTACT_FORCE)
        tilt = math.hypot(roll, pitch)
        landed = touching and tilt < LANDED_TILT
        impact, impact_tilt = (max(0.0, -before.vz), tilt) if touching and not before.in_contact else (0.0, 0.0)
        yaw = before.yaw + math.remainder(yaw - before.yaw, math.tau)
        # In the order of the kernels' entries.
        self._flight[:] = (
            *(x, y, z - self._floor, yaw, vx, vy, vz, roll, pitch, roll_rate, aside, yaw_rate),
            *(touching, landed, impact, impact_tilt, before.time + SUBSTEP),
        )
        return state_of(self._flight, self._floor)
