"""The compiled quadrotor with another body in every episode, for policies that are to fly by rotors, or a real one."""

from dataclasses import dataclass

import numpy as np

from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.quadrotor_body import Launch, QuadrotorState, state_of
from bullet_tasks.robots.quadrotor_compiled import CompiledQuadrotor
from bullet_tasks.robots.variation import Range, check_variation
from bullet_tasks.world import World

_ANGLES, _RATES = [kernels.ROLL, kernels.PITCH], [kernels.ROLL_RATE, kernels.PITCH_RATE, kernels.YAW_RATE]


@dataclass(frozen=True)
class FlightVariation:
    """
    What domain randomisation draws for every episode, evenly between two numbers, and how readings are off on the ground.

    A body with rotors falls on its feet faster or slower than one without, and shakes. Where every landing is the same in
    training, an encoder takes biases from how fast a body falls on its feet, and is wrong and sure where that differs.

    :param bandwidth: of the attitude loop, rad/s
    :param altitude_gain: of the altitude loop, 1/s
    :param speed_gain: of the vertical speed loop, 1/s
    :param drag: of the air, 1/s
    :param settling: time constant in which a body falls on its feet, s
    :param shaking_rate: greatest error of the rates that are read on the ground either way, drawn for every reading, rad/s
    :param shaking_speed: the same of the vertical velocity, m/s
    :param shaking_tilt: the same of roll and pitch, rad
    :raises ValueError: if a range is empty or not positive, or an error negative
    """

    bandwidth: Range = (5.0, 7.0)
    altitude_gain: Range = (1.35, 1.65)
    speed_gain: Range = (4.0, 6.0)
    drag: Range = (0.8, 1.2)
    settling: Range = (0.02, 0.12)
    shaking_rate: float = 3.0
    shaking_speed: float = 0.6
    shaking_tilt: float = 0.01

    def __post_init__(self) -> None:
        check_variation(self)


class VariedQuadrotor(CompiledQuadrotor):
    """
    Domain randomisation: no two episodes have the same body, and no landing reads like another.

    :param world: see base class
    :param launch: where in the air a flight begins, asked at every reset
    :param variation: what is drawn, and from where
    """

    def __init__(self, world: World, launch: Launch, variation: FlightVariation | None = None) -> None:
        super().__init__(world, launch)
        self.variation = variation or FlightVariation()
        self._rng = np.random.default_rng(0)

    def vary(self, rng: np.random.Generator) -> None:
        """
        Draw the body of the next episode (see base class).

        :param rng: the episode's random generator
        """
        v, body, self._rng = self.variation, self._body, rng
        body[kernels.BANDWIDTH] = rng.uniform(*v.bandwidth)
        body[kernels.ALTITUDE_GAIN] = rng.uniform(*v.altitude_gain)
        body[kernels.SPEED_GAIN] = rng.uniform(*v.speed_gain)
        body[kernels.DRAG] = rng.uniform(*v.drag)
        body[kernels.SETTLING] = rng.uniform(*v.settling)

    def _measured(self) -> QuadrotorState:
        flight = self._flight
        if flight[kernels.TOUCHING] != 0.0:
            v, rng, flight = self.variation, self._rng, flight.copy()
            flight[_RATES] += rng.uniform(-v.shaking_rate, v.shaking_rate, 3)
            flight[kernels.VZ] += rng.uniform(-v.shaking_speed, v.shaking_speed)
            flight[_ANGLES] += rng.uniform(-v.shaking_tilt, v.shaking_tilt, 2)
        return state_of(flight, self._floor)
