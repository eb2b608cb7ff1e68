"""The compiled quadruped with another body in every episode, for policies that are to walk on legs, or on a real robot."""

from dataclasses import dataclass

import numpy as np

from bullet_tasks import kernels
from bullet_tasks.robots.compiled_quadruped import CompiledQuadruped
from bullet_tasks.robots.quadruped_body import QuadrupedCommand
from bullet_tasks.robots.variation import Range, check_variation
from bullet_tasks.world import World


@dataclass(frozen=True)
class Variation:
    """
    What domain randomisation draws for every episode, evenly between two numbers. Defaults reach a little beyond what
    ``benchmarks.calibrate_quadruped`` measures of the robot on legs.

    :param radius: of the body in collisions, m
    :param max_yaw_rate: rad/s
    :param yaw_gain: of the heading law, 1/s
    :param yaw_acceleration: greatest change of the yaw rate, rad/s^2
    :param speed: relative to the commanded one
    :param heading_error: greatest error of a command's heading either way, drawn for every command, rad
    :param pitch_error: the same of the body pitch, which cameras follow, rad
    :raises ValueError: if a range is empty or not positive, or an error negative
    """

    radius: Range = (0.20, 0.25)
    max_yaw_rate: Range = (1.7, 2.1)
    yaw_gain: Range = (5.0, 9.0)
    yaw_acceleration: Range = (10.0, 60.0)
    speed: Range = (0.95, 1.05)
    heading_error: float = 0.1
    pitch_error: float = 0.02

    def __post_init__(self) -> None:
        check_variation(self)


class VariedQuadruped(CompiledQuadruped):
    """
    Domain randomisation: no two episodes have the same body, and no turn ends quite where it should.

    :param world: the scene in it is what the body collides with
    :param variation: what is drawn, and from where
    """

    def __init__(self, world: World, variation: Variation | None = None) -> None:
        super().__init__(world)
        self.variation = variation or Variation()
        self._pace = 1.0
        self._rng = np.random.default_rng(0)

    def vary(self, rng: np.random.Generator) -> None:
        """
        Draw the body of the next episode (see base class).

        :param rng: the episode's random generator
        """
        v, body, self._rng = self.variation, self._body, rng
        body[kernels.RADIUS] = rng.uniform(*v.radius)
        body[kernels.MAX_YAW_RATE] = rng.uniform(*v.max_yaw_rate)
        body[kernels.YAW_GAIN] = rng.uniform(*v.yaw_gain)
        body[kernels.YAW_ACCELERATION] = rng.uniform(*v.yaw_acceleration)
        self._pace = rng.uniform(*v.speed)

    def command(self, command: QuadrupedCommand) -> None:
        """
        Walk and turn, not quite as told (see base class).

        :param command: speed (m/s), heading and body pitch (rad)
        """
        v = self.variation
        yaw = command.target_yaw + self._rng.uniform(-v.heading_error, v.heading_error)
        pitch = command.pitch + self._rng.uniform(-v.pitch_error, v.pitch_error)
        super().command(QuadrupedCommand(self._pace * command.speed, yaw, pitch))
