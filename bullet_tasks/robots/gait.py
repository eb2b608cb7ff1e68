"""
Analytic trot of a quadruped: its parameters, and the controller that turns commands into joint angles.

A phase clock, footholds on known terrain, foot trajectories and leg inverse kinematics; the computation is in
``gait_kernels``.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from bullet_tasks.robots import gait_kernels as kernels
from bullet_tasks.robots.gait_kernels import (
    FOOT_RADIUS,
    FORE,
    FORWARD,
    HIP_LENGTH,
    HIP_X,
    HIP_Y,
    LEAST_REACH,
    LINK_LENGTH,
    MOST_REACH,
    N_LEGS,
    N_MEASUREMENTS,
    PITCH,
    ROLL,
    SIDE,
    SIDEWAYS,
    STANCE_WIDTH,
    TRUNK_X,
    TRUNK_Y,
    TRUNK_Z,
    YAW,
    YAW_RATE,
)

__all__ = [
    "FOOT_RADIUS",
    "FORE",
    "FORWARD",
    "HIP_LENGTH",
    "HIP_X",
    "HIP_Y",
    "LINK_LENGTH",
    "N_LEGS",
    "N_MEASUREMENTS",
    "PITCH",
    "ROLL",
    "SIDE",
    "SIDEWAYS",
    "STANCE_WIDTH",
    "TRUNK_X",
    "TRUNK_Y",
    "TRUNK_Z",
    "YAW",
    "YAW_RATE",
    "Gait",
    "Trot",
]


@dataclass(frozen=True)
class Gait:
    """
    How the quadruped trots. Defaults are those of the light model at 120 Hz, tuned by ``benchmarks.calibrate_quadruped``.

    :param period: of a stride: every leg steps once, s
    :param duty: part of the stride that a foot is on the ground
    :param height: of the trunk's centre above the feet's, m
    :param clearance: how high a foot is lifted above the line between its footholds, m
    :param neutral_shift: how far ahead of the hips the feet stand, m
    :param forward_capture: how much further ahead a foot is set for every m/s that the trunk is too fast, s (Raibert)
    :param sideways_capture: the same to the side, s
    :param speed_feedback: how much faster the feet are moved for every m/s that the trunk is too slow
    :param sideways_feedback: the same to the side: in a turn, it keeps the trunk from sliding outwards
    :param turn_feedback: the same for the yaw rate
    :param lean: how far feet are set outwards in a turn, relative to what centrifugal force asks for
    :param speed_trim: gain that removes lasting errors of the speed, 1/s
    :param speed_trim_limit: m/s
    :param turn_trim: the same for the yaw rate, 1/s
    :param turn_trim_limit: rad/s
    :param pitch_trim: the same for the pitch, 1/s
    :param pitch_trim_limit: rad
    :param pitch_feedback: extra pitch of the feet for every rad of error
    :param roll_feedback: the same for the roll
    :param speed_filter: time constant that the measured velocity is smoothed with, s
    :param turn_filter: the same for the yaw rate, s
    :param height_filter: time constant with which the trunk's height follows the ground under the feet, s
    :param slope_filter: the same for the trunk's pitch on stairs, s
    :param slope_gain: part of the terrain's slope that the trunk takes on
    :param edge: how far from an edge or a wall a foot is set down, m
    :param edge_reflex: how fast the trunk is moved to the side for every m that a foot is set down beside its place, 1/s
    :param acceleration: greatest change of the speed, m/s^2
    :param pitch_rate: greatest change of the body pitch, rad/s: a jerk of the trunk would throw the robot over
    :param turn_limit: greatest yaw rate that the feet are moved for, rad/s
    :param turn_acceleration: greatest change of the yaw rate, rad/s^2
    :param reach: how far from its neutral place a foot may get along either axis, m
    :param heading_feedback: extra yaw rate for every rad that the heading lags behind, 1/s
    :param heading_slack: how far the heading may lag behind before what it follows waits for it, rad
    :param wall_time: time in which the way that is left to a wall would be walked, s: the nearer it is, the slower
    :param sidestep: greatest speed at which the trunk is moved out of a wall's way, m/s
    :param turn_room: how much further from walls the trunk is kept for every rad/s above a slow turn's 0.8, so that no
        shoulder or knee is caught, m s/rad
    :raises ValueError: if a number is not a possible choice
    """

    period: float = 0.26
    duty: float = 0.74
    height: float = 0.2825
    clearance: float = 0.073
    neutral_shift: float = -0.008
    forward_capture: float = 0.034
    sideways_capture: float = 0.088
    speed_feedback: float = 0.0
    sideways_feedback: float = 0.4
    turn_feedback: float = 0.0
    lean: float = 0.1
    speed_trim: float = 1.16
    speed_trim_limit: float = 0.24
    turn_trim: float = 0.0
    turn_trim_limit: float = 0.4
    pitch_trim: float = 1.28
    pitch_trim_limit: float = 0.3
    pitch_feedback: float = 0.0
    roll_feedback: float = 0.1
    speed_filter: float = 0.08
    turn_filter: float = 0.04
    height_filter: float = 0.25
    slope_filter: float = 0.255
    slope_gain: float = 0.8
    edge: float = 0.06
    edge_reflex: float = 5.0
    acceleration: float = 6.0
    pitch_rate: float = 0.8
    turn_limit: float = 2.2
    turn_acceleration: float = 60.0
    reach: float = 0.16
    heading_feedback: float = 4.0
    heading_slack: float = 0.3
    wall_time: float = 0.15
    sidestep: float = 0.4
    turn_room: float = 0.03

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not math.isfinite(value):
                raise ValueError(f"`{name}` must be a finite number, got {value}.")
            if value < 0.0 and name != "neutral_shift":
                raise ValueError(f"`{name}` must be 0 or more, got {value}.")
        for name in (
            "period",
            "clearance",
            "speed_filter",
            "turn_filter",
            "height_filter",
            "slope_filter",
            "acceleration",
            "pitch_rate",
            "wall_time",
        ):
            if getattr(self, name) == 0.0:
                raise ValueError(f"`{name}` must be positive, got 0.")
        if not 0.5 <= self.duty < 1.0:
            raise ValueError(
                f"`duty` must be at least 0.5, so that two feet are always down, and less than 1, got {self.duty}."
            )
        if not LEAST_REACH < self.height < MOST_REACH:
            raise ValueError(
                f"`height` must be between {LEAST_REACH} and {MOST_REACH} m, which the legs can reach, got {self.height}."
            )

    def packed(self) -> np.ndarray:
        """The numbers in the order of the fields, float64 ``(n_fields,)``, as the compiled functions take them."""
        return np.array(dataclasses.astuple(self), dtype=np.float64)


class Trot:
    """
    A trotting quadruped's feet: told what the trunk does, it says where the joints are to be.

    :param gait: how to trot
    """

    def __init__(self, gait: Gait) -> None:
        self.gait = gait
        self.angles = np.zeros((N_LEGS, 3))
        """What the joints are to be, rad, ``(4, 3)``: hip, upper, lower of each leg."""
        self._gait = gait.packed()
        self._memory = np.zeros(kernels.N_MEMORY)
        self._feet = np.zeros((N_LEGS, kernels.N_FOOT))

    def reset(self, ground: float, phase: float = 0.0) -> None:
        """
        Stand on level ground.

        :param ground: its height, m
        :param phase: of the stride to begin with, 0 to 1
        """
        kernels.stand(self._gait, self._memory, self._feet, self.angles, ground, phase % 1.0)

    @property
    def feet(self) -> np.ndarray:
        """Where the feet are to be, seen from the trunk's centre in the level frame, m, ``(4, 3)``."""
        return self._feet[:, : kernels.FOOT_Z + 1].copy()

    @property
    def swinging(self) -> np.ndarray:
        """Which feet are in the air, bool ``(4,)``."""
        return self._feet[:, kernels.SWINGS] != 0.0

    @property
    def ground(self) -> float:
        """Mean height of the ground that the feet stand on, m."""
        return float(self._feet[:, kernels.GROUND].mean())

    def step(
        self,
        dt: float,
        command: tuple[float, float, float, float],
        measured: np.ndarray,
        shapes: np.ndarray,
        lower_ground: float,
    ) -> np.ndarray:
        """
        Let time pass.

        :param dt: s
        :param command: speed ahead and to the left (m/s), yaw rate (rad/s), body pitch (rad, nose down positive)
        :param measured: of the trunk, ``(N_MEASUREMENTS,)``
        :param shapes: the scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``: feet keep off edges and walls
        :param lower_ground: height of the ground beside all floors, m
        :return: ``angles``
        """
        kernels.step(self._gait, self._memory, self._feet, measured, shapes, lower_ground, dt, command, self.angles)
        return self.angles
