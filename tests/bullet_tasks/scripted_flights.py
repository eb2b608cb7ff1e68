"""Hand-written pilots that show what Biased Quadrotor allows; they are run by ``scripted_policies.run_episode``."""

import numpy as np

from bullet_tasks.tasks.biased_quadrotor import ALTITUDE_SCALE, ANGLE_SCALE, PRIVILEGED_BOUND, BiasedQuadrotorConfig

CONFIG = BiasedQuadrotorConfig()
BIAS_BOUNDS = np.array((CONFIG.altitude_bias, CONFIG.angle_bias, CONFIG.angle_bias))
SINKING = 0.5  # m below the present reading: a descent of 0.75 m/s

Observation = dict[str, np.ndarray]


def readings(observation: Observation) -> np.ndarray:
    """
    Altitude (m), roll and pitch (rad) as they are read, ``(3,)``.

    :param observation: ``common`` is read, nothing else
    """
    return observation["common"][:3].astype(np.float64) * (ALTITUDE_SCALE, ANGLE_SCALE, ANGLE_SCALE)


def fly_to(altitude: float, roll: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """
    The action that asks for a reading.

    :param altitude: m
    :param roll: rad
    :param pitch: rad
    """
    c = CONFIG
    action = (pitch / c.angle_range, roll / c.angle_range, (altitude - c.middle_altitude) / c.altitude_range)
    return np.clip(action, -1.0, 1.0).astype(np.float32)


def hover(biases: np.ndarray) -> np.ndarray:
    """
    The action of a pilot who believes in some biases.

    :param biases: of altitude (m), roll and pitch (rad)
    """
    return fly_to(CONFIG.hover.altitude + biases[0], biases[1], biases[2])


def knowing(observation: Observation) -> np.ndarray:
    """
    Hover by the true biases, which only a privileged robot can.

    :param observation: with ``privileged``
    """
    return hover(observation["privileged"] / PRIVILEGED_BOUND * BIAS_BOUNDS)


def trusting(observation: Observation) -> np.ndarray:
    """
    Hover by what is read.

    :param observation: not looked at
    """
    return hover(np.zeros(3))


class Lander:
    """The best that a robot without privileged knowledge can do: sink slowly, land, read the biases off, climb and hover."""

    def __init__(self) -> None:
        self.biases: np.ndarray | None = None

    def __call__(self, observation: Observation) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else
        """
        if observation["common"][7] > 0.5:
            self.biases = readings(observation)
        if self.biases is None:
            return fly_to(readings(observation)[0] - SINKING)
        return hover(self.biases)
