"""The kinematic quadruped without PyBullet: the same commands and collisions, compiled."""

import numpy as np

from bullet_tasks import kernels
from bullet_tasks.ends import OUTCOMES, Ends, Judge
from bullet_tasks.robots.base import RobotState, Stretch
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
from bullet_tasks.simulation import Simulation
from bullet_tasks.world import World

_NO_CIRCLES = np.empty((0, 4))
_NO_FALLS = -np.inf


class CompiledQuadruped(LeglessQuadruped):
    """
    ``KinematicQuadruped`` computed by one compiled function instead of PyBullet.

    The body is a circle that the scene's solid boxes and cylinders stop, or let slide along them, if their heights overlap
    with the body's. What Bullet does at a wall is reproduced: how far ahead it sees one, how far an impact sinks in and how
    fast it is pushed out again. Where nothing is in the way, positions are the same to rounding errors.

    :param world: the scene in it is what the body collides with
    """

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world
        body = np.empty(kernels.N_BODY)
        body[kernels.RADIUS] = BODY_RADIUS
        body[kernels.MAX_YAW_RATE] = MAX_YAW_RATE
        body[kernels.YAW_GAIN] = YAW_GAIN
        body[kernels.YAW_ACCELERATION] = np.inf
        body[kernels.PERIOD] = SUBSTEP
        body[kernels.PRESSED] = CONTACT_FORCE * SUBSTEP / MASS
        self._body = body
        self._yaw_rate = 0.0
        self._appeared = False

    def reset(self, x: float, y: float, ground: float, yaw: float) -> RobotState:
        """
        Put the robot somewhere, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        """
        self._yaw_rate = 0.0
        return super().reset(x, y, ground, yaw)

    def substep(self) -> RobotState:
        """Let 1/20 s pass (see base class)."""
        self._walk(_NO_CIRCLES, _NO_FALLS, 1)
        return self.state

    def advance(self, n_substeps: int, judge: Judge) -> Stretch:
        """
        Let several substeps pass, but stop where the episode ends (see base class).

        :param n_substeps: at least 1
        :param judge: of every substep; compiled if it is an ``Ends``
        """
        if isinstance(judge, Ends):
            return self._walk(judge.circles, judge.fall_height, n_substeps)
        return super().advance(n_substeps, judge)

    def _walk(self, circles: np.ndarray, fall_height: float, n_substeps: int) -> Stretch:
        x, y, z, yaw = self.state[:4]
        scene = self._world.scene
        x, y, yaw, self._yaw_rate, vx, vy, pressed, done, contacts, code = kernels.walk(
            scene.packed,
            scene.lower_ground,
            circles,
            fall_height,
            self._body,
            x,
            y,
            yaw,
            self._yaw_rate,
            self._speed,
            self._target_yaw,
            z - HALF_TRUNK_HEIGHT,
            z + HALF_TRUNK_HEIGHT,
            n_substeps,
        )
        self.state = RobotState(x, y, z, yaw, vx, vy, pressed, self._pitched(done * SUBSTEP))
        return Stretch(done, contacts, OUTCOMES[code])

    def appear(self, simulation: Simulation) -> None:
        """
        Be where ``state`` says in the pictures of a simulation (see base class).

        :param simulation: that will take the picture
        """
        if not self._appeared:
            simulation.add_body(self.name, None, looks(), (0.0, 0.0, BODY_HEIGHT))
            self._appeared = True
        x, y, z, yaw = self.state[:4]
        simulation.place(self.name, (x, y, z), yaw, self.state.pitch)
