"""The quadrotor as a rigid body that follows its inner loop exactly: PyBullet says what it touches."""

import math

from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.quadrotor_body import (
    HALF_EXTENTS,
    MASS,
    SUBSTEP,
    Launch,
    Quadrotor,
    QuadrotorState,
    looks,
    orientation,
    state_of,
)
from bullet_tasks.shapes import Box
from bullet_tasks.simulation import Simulation
from bullet_tasks.world import World

_DISTANCE = 8  # index in a record of getClosestPoints (PyBullet Quickstart Guide)


class KinematicQuadrotor(Quadrotor):
    """
    A rigid body without rotors: its flight follows the inner loop, the ground it lands on is PyBullet's.

    :param world: the body is created in its simulation; what its floors carry it on
    :param launch: where in the air a flight begins, asked at every reset
    """

    substep_period = SUBSTEP

    def __init__(self, world: World, launch: Launch) -> None:
        super().__init__(launch)
        simulation = world.simulation
        simulation.configure(SUBSTEP, gravity=0.0)
        self._id = simulation.add_body(
            self.name, Box("body", (0.0, 0.0, 0.0), HALF_EXTENTS), looks(), (0.0, 0.0, 1.0), mass=MASS
        )
        # The margin rounds a box's corners; without it distances are exact, and the same as the compiled quadrotor's.
        simulation.client.changeDynamics(self._id, -1, collisionMargin=0.0)
        self._floors = [simulation.body_id(shape.name) for shape in world.scene.shapes if shape.floor]
        self._clear = math.inf
        self._world = world
        self._closest_points = simulation.client.getClosestPoints

    def reset(self, x: float, y: float, ground: float, yaw: float) -> QuadrotorState:
        """
        Begin a flight above a place, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        # So high nothing can be touched, however the body is tilted.
        highest = max((shape.top for shape in self._world.scene.shapes if shape.floor), default=-math.inf)
        self._clear = highest + math.hypot(*HALF_EXTENTS) + kernels.TOUCH
        return super().reset(x, y, ground, yaw)

    def substep(self) -> QuadrotorState:
        """Let 1/50 s pass (see base class)."""
        kernels.fly(self._flight, self._command, self._body)
        kernels.ground(self._flight, self._body, self._touches())
        self.state = state_of(self._flight, self._floor)
        return self.state

    def _touches(self) -> bool:
        if self._flight[kernels.Z] + self._floor > self._clear:
            return False
        self.state = state_of(self._flight, self._floor)
        self.appear(self._world.simulation)
        for floor in self._floors:
            for point in self._closest_points(self._id, floor, kernels.TOUCH):
                if point[_DISTANCE] <= kernels.TOUCH:
                    return True
        return False

    def appear(self, simulation: Simulation) -> None:
        """
        Be where ``state`` says; the body is in the world's simulation already (see base class).

        :param simulation: that will take the picture
        """
        state = self.state
        simulation.set_pose(self._id, (state.x, state.y, state.z), orientation(state))
