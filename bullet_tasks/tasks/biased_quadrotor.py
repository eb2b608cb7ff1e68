"""Biased Quadrotor: hover level at an altitude by instruments that lie, unless one lands to see by how much."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from bullet_tasks.ends import Outcome
from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadrotor import check_quadrotor_physics, make_quadrotor
from bullet_tasks.robots.quadrotor_body import DRAG, GRAVITY, Aloft, QuadrotorCommand, QuadrotorState
from bullet_tasks.robots.quadrotor_ends import HoverEnds, HoverLimits
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Colour, Shape
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start, Task
from bullet_tasks.tasks.configuration import check_positive, configured

PRIVILEGED_BOUND = 0.4
"""Bound of each privileged number; a uniform distribution within has the standard deviation 0.231."""
ALTITUDE_SCALE = 4.0
"""m that count as 1 in the observation."""
ANGLE_SCALE = 0.5
"""rad"""
RATE_SCALE = 4.0
"""rad/s"""
SPEED_SCALE = 2.0
"""m/s"""

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_LINE: Colour = (0.62, 0.64, 0.68, 1.0)
_POST: Colour = (0.42, 0.50, 0.60, 1.0)
_BAND: Colour = (0.20, 0.72, 0.38, 1.0)
_FLOOR_PER_TIME = 70.0 / (12.0 * math.tan(0.5))  # m/s for a tilt of 45 degrees; further than it drifts
_GREATEST_TILT = 1.4  # rad; near a right angle nothing flies far
_FLOOR_HALF_HEIGHT = 0.05  # m
_LINE_DISTANCE, _N_LINES = 2.0, 6  # m; lines on either side of the middle one
_POST_DISTANCE, _N_POSTS = 4.0, 3
_HALF_WIDTH = 0.02  # m, of lines and posts
_CAMERA_DISTANCE, _CAMERA_HEIGHT = 4.4, 1.9  # m


@dataclass(frozen=True)
class HoverReward:
    """
    Reward weights.

    Flying rightly pays in every second and is made up for at the end of a successful episode, so that an early success is
    worth more than a long flight. The rewards are positive in the air, because Eq. 2 magnifies them when the uncertainty is
    low: if they were costs, knowing the biases would be dear.

    :param altitude: per s at the true altitude; decays with the distance from it
    :param level: per s at true level; decays with the tilt
    :param altitude_decay: distance at which the reward is 1/e, m
    :param level_decay: tilt at which the reward is 1/e, rad
    :param low: per s below ``low_altitude``
    :param low_altitude: m
    :param success: once, for a hover that has been held
    :param time_bonus: once, at success, times the fraction of the episode's time that is left
    :param crash: once, for a crash
    :raises ValueError: if a decay is not positive
    """

    altitude: float = 0.5
    level: float = 0.5
    altitude_decay: float = 0.5
    level_decay: float = 0.15
    low: float = -1.5
    low_altitude: float = 0.3
    success: float = 8.0
    time_bonus: float = 12.0
    crash: float = -6.0

    def __post_init__(self) -> None:
        check_positive(self, "altitude_decay", "level_decay")


@dataclass(frozen=True)
class BiasedQuadrotorConfig:
    """
    Sizes, times and weights; lengths in m, times in s, angles in rad.

    :param altitude_bias: greatest absolute bias of the altitude sensor
    :param angle_bias: greatest absolute bias of the roll and the pitch sensor, each
    :param start_altitude: least and greatest altitude that is *read* at the start
    :param start_tilt: greatest absolute roll and pitch that is read at the start
    :param middle_altitude: target altitude, as read, of the action 0
    :param altitude_range: by how much the actions -1 and 1 differ from that
    :param angle_range: target roll and pitch, as read, of the action 1
    :param hover: what counts as a success, and what as a crash
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    :raises ValueError: if the configuration is not a possible world
    """

    altitude_bias: float = 0.6
    angle_bias: float = 0.2
    start_altitude: tuple[float, float] = (1.3, 2.3)
    start_tilt: float = 0.1
    middle_altitude: float = 1.25
    altitude_range: float = 2.5
    angle_range: float = 0.3
    hover: HoverLimits = field(default_factory=HoverLimits)
    decision_period: float = 0.2
    time_limit: float = 12.0
    reward: HoverReward = field(default_factory=HoverReward)

    def __post_init__(self) -> None:
        check_positive(self, "altitude_bias", "angle_bias", "altitude_range", "angle_range", "decision_period", "time_limit")
        if self.decision_period > self.time_limit:
            raise ValueError(
                f"`decision_period` ({self.decision_period} s) must not exceed `time_limit` ({self.time_limit} s)."
            )
        least, greatest = self.start_altitude
        if not self.altitude_bias < least <= greatest <= ALTITUDE_SCALE:
            raise ValueError(
                f"`start_altitude` must be {self.altitude_bias} < least <= greatest <= {ALTITUDE_SCALE} m, got "
                f"{self.start_altitude}: with the greatest `altitude_bias` the flight must still begin above the ground, and "
                "what is read within what can be observed."
            )
        if not 0.0 <= self.start_tilt <= ANGLE_SCALE:
            raise ValueError(
                f"`start_tilt` must be from 0 to {ANGLE_SCALE} rad, all that can be observed, got {self.start_tilt}."
            )
        lowest, highest = self.middle_altitude - self.altitude_range, self.middle_altitude + self.altitude_range
        if not (lowest < -self.altitude_bias and highest >= self.hover.altitude + self.altitude_bias):
            raise ValueError(
                f"Target altitudes from {lowest} to {highest} m do not reach from the ground to the hover at "
                f"{self.hover.altitude} m for all biases up to {self.altitude_bias} m: raise `altitude_range`."
            )
        if self.angle_range < self.angle_bias:
            raise ValueError(
                f"`angle_range` ({self.angle_range} rad) must be at least `angle_bias` ({self.angle_bias} rad), or some "
                "quadrotors could not be levelled."
            )


class BiasedQuadrotor(Task):
    """
    Biased Quadrotor (task card).

    Description
        A quadrotor is in the air above a plain when its altitude, roll and pitch sensors begin to read false by amounts that
        stay the same: up to 0.6 m and 0.2 rad, uniform and independent. Its inner loop flies by the same sensors, so what a
        command leads to reads right and is wrong. The reading at the start, 1.3-2.3 m and up to 0.1 rad, is drawn apart from
        the biases, the truth is that less the biases. Hence nothing in the readings of a flight depends on the biases, until
        it touches the ground. On the ground, altitude and attitude are zero, and the readings are the biases.

    Observation spaces
        ``common`` Box(8) in [-1, 1]: read altitude / 4 m, read roll and pitch / 0.5 rad, rates of roll, pitch and yaw
        / 4 rad/s, vertical velocity / 2 m/s, landed flag (standing on the ground). ``privileged`` Box(3) in [-0.4, 0.4]:
        biases of altitude / 1.5 m, roll and pitch / 0.5 rad; their standard deviation, 0.231, is the scale of uncertainty that
        the paper's constants are made for. There is no ``target``.

    Action
        Box(3) in [-1, 1]: target pitch and roll in units of 0.3 rad, target altitude 1.25 m + action * 2.5 m, all as the
        sensors read them, held for 0.2 s. The quadrotor climbs at up to 1.5 m/s and sinks at up to 1.2 m/s, in proportion to
        the altitude error.

    Rewards
        ``altitude`` 0.5 exp(-error / 0.5 m) and ``level`` 0.5 exp(-tilt / 0.15 rad) per s, of the true values (those of a
        varied body shake on the ground); ``low`` -1.5 per s below a true altitude of 0.3 m; ``success`` 8 + 12 * (fraction of
        the time left); ``crash`` -6.

    Success
        For 1 s on end, within 0.15 m of the true altitude 1.5 m and within 0.05 rad of true level in roll and in pitch.

    Termination
        Success; or a crash, which is a touchdown faster than 1.1 m/s or tilted by more than 0.35 rad. After 12 s the episode
        is truncated.

    Optimal behaviour
        Without the privileged observation: sink slowly, land, read the biases off, climb and hover by the corrected
        readings; a simple script needs 5.6 s on average and up to 7.5 s. Whoever trusts the sensors hovers in the wrong place.

    Differences from the paper
        The paper gives no numbers; all of them are ours. Decisions every 0.2 s instead of 20 ms, 60 an episode. Success ends
        the episode. Angular velocity is that of the angles. Horizontal speed is neither observed nor rewarded, as in
        the paper; strong air drag keeps the drift of a quadrotor that reads level below 3 m/s. In ``physics="kinematic"`` and
        ``"compiled"`` altitude and attitude do not act on each other; in ``"full"`` they do through the lag of the
        rotors, which changes the readings of a flight by up to 1 mm, 0.1 mrad and 3 mm/s.

    Source
        Uncertainty-Sensitive Privileged Learning, App. C.1.7, Table 3, Figures 7 and 14; not in the authors' release.

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    picture_size = (640, 400)

    def __init__(self, config: BiasedQuadrotorConfig | Mapping[str, Any] | None = None) -> None:
        self.config = c = configured(BiasedQuadrotorConfig(), config)
        self.decision_period, self.time_limit = c.decision_period, c.time_limit
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.common_space = spaces.Box(-1.0, 1.0, (8,), np.float32)
        self.privileged_space = spaces.Box(-PRIVILEGED_BOUND, PRIVILEGED_BOUND, (3,), np.float32)
        self.biases = (0.0, 0.0, 0.0)
        """Of altitude (m), roll and pitch (rad): what is read is the truth plus these."""
        self._scales = np.array((c.altitude_bias, c.angle_bias, c.angle_bias)) / PRIVILEGED_BOUND
        self._aloft = Aloft(c.hover.altitude, 0.0, 0.0)
        self._seen = (0.0, 0.0)
        self.judge = HoverEnds(c.hover)
        self.scene = self._scene()

    def _scene(self) -> SceneSpec:
        """A floor with lines, and posts with a band at the altitude of the hover: without them nothing shows a drift."""
        c, hover = self.config, self.config.hover
        # A body tilted further than by `flip_tilt` has turned over.
        tilt = min(c.angle_range + c.angle_bias, hover.flip_tilt, _GREATEST_TILT)
        half_size = _FLOOR_PER_TIME * c.time_limit * math.tan(tilt)
        shapes: list[Shape] = [
            Box(
                "floor",
                (0.0, 0.0, -_FLOOR_HALF_HEIGHT),
                (half_size, half_size, _FLOOR_HALF_HEIGHT),
                colour=_FLOOR,
                floor=True,
            )
        ]
        length = _N_LINES * _LINE_DISTANCE
        for i in range(-_N_LINES, _N_LINES + 1):
            at = i * _LINE_DISTANCE
            shapes.append(Box(f"line_x_{i}", (at, 0.0, 0.0), (_HALF_WIDTH, length, 0.005), colour=_LINE, solid=False))
            shapes.append(Box(f"line_y_{i}", (0.0, at, 0.0), (length, _HALF_WIDTH, 0.005), colour=_LINE, solid=False))
        bottom, half_band = hover.altitude - hover.altitude_tolerance, hover.altitude_tolerance
        for i in range(-_N_POSTS, _N_POSTS + 1):
            at = i * _POST_DISTANCE
            post = (_HALF_WIDTH, _HALF_WIDTH, 0.5 * bottom)
            band = (2.0 * _HALF_WIDTH, 2.0 * _HALF_WIDTH, half_band)
            for j in (0, 1):
                y = (0.5 + j) * _POST_DISTANCE
                shapes.append(Box(f"post_{i}_{j}", (at, y, 0.5 * bottom), post, colour=_POST, solid=False))
                shapes.append(Box(f"band_{i}_{j}", (at, y, hover.altitude), band, colour=_BAND, solid=False))
        return SceneSpec(tuple(shapes))

    @property
    def camera(self) -> Camera:  # type: ignore[override]
        """Beside the quadrotor, wherever it has drifted; its height does not follow, so that pictures show the altitude."""
        x, y = self._seen
        middle = self.config.hover.altitude
        return Camera((x, y - _CAMERA_DISTANCE, _CAMERA_HEIGHT), (x, y, middle), fov=40.0)

    def launch(self) -> Aloft:
        """Where this episode begins in the air, in true quantities."""
        return self._aloft

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the biases, and apart from them what is read at the start (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        first, second, third, altitude, roll, pitch = rng.uniform(-1.0, 1.0, 6).tolist()
        self.biases = altitude_bias, roll_bias, pitch_bias = (
            c.altitude_bias * first,
            c.angle_bias * second,
            c.angle_bias * third,
        )
        least, greatest = c.start_altitude
        altitude = least + 0.5 * (greatest - least) * (1.0 + altitude)
        roll, pitch = c.start_tilt * roll, c.start_tilt * pitch
        self._aloft = Aloft(altitude - altitude_bias, roll - roll_bias, pitch - pitch_bias)
        return Start(0.0, 0.0, 0.0, {})

    def begin(self, state: RobotState, scene: SceneSpec) -> None:
        """
        Begin to wait for a hover or a crash (see base class).

        :param state: of the robot
        :param scene: the world of this episode
        """
        self.judge = HoverEnds(self.config.hover)

    def command(self, action: Sequence[float], state: RobotState) -> QuadrotorCommand:
        """
        Attitude and altitude that the false sensors will read right (see base class).

        :param action: target pitch, roll and altitude, ``(3,)``
        :param state: of the robot, now
        """
        c = self.config
        altitude_bias, roll_bias, pitch_bias = self.biases
        return QuadrotorCommand(
            c.angle_range * action[1] - roll_bias,
            c.angle_range * action[0] - pitch_bias,
            c.middle_altitude + c.altitude_range * action[2] - altitude_bias,
        )

    def reward_terms(self, state: RobotState, contact_time: float, time_left: float, outcome: Outcome) -> dict[str, float]:
        """
        Altitude, level, flying low and the end (see base class and ``HoverReward``).

        :param state: of the quadrotor, after the decision
        :param contact_time: s
        :param time_left: fraction of the episode's time that is left
        :param outcome: how the episode stands
        """
        assert isinstance(state, QuadrotorState)
        reward, period = self.config.reward, self.decision_period
        error, tilt = abs(state.altitude - self.config.hover.altitude), math.hypot(state.roll, state.pitch)
        success, failure = outcome is Outcome.SUCCESS, outcome is Outcome.FAILURE
        return {
            "altitude": reward.altitude * math.exp(-error / reward.altitude_decay) * period,
            "level": reward.level * math.exp(-tilt / reward.level_decay) * period,
            "low": reward.low * period if state.altitude < reward.low_altitude else 0.0,
            "success": reward.success + reward.time_bonus * time_left if success else 0.0,
            "crash": reward.crash if failure else 0.0,
        }

    def common(self, state: RobotState) -> np.ndarray:
        """
        What the sensors read, float32 ``(8,)``; see the task card.

        :param state: of the quadrotor
        """
        assert isinstance(state, QuadrotorState)
        self._seen = (state.x, state.y)
        altitude_bias, roll_bias, pitch_bias = self.biases
        readings = (
            (state.altitude + altitude_bias) / ALTITUDE_SCALE,
            (state.roll + roll_bias) / ANGLE_SCALE,
            (state.pitch + pitch_bias) / ANGLE_SCALE,
            state.roll_rate / RATE_SCALE,
            state.pitch_rate / RATE_SCALE,
            state.yaw_rate / RATE_SCALE,
            state.vz / SPEED_SCALE,
            float(state.landed),
        )
        return np.array([max(-1.0, min(1.0, reading)) for reading in readings], dtype=np.float32)

    def privileged(self) -> np.ndarray:
        """Biases of altitude, roll and pitch, each in [-0.4, 0.4], float32 ``(3,)``."""
        return (np.array(self.biases) / self._scales).astype(np.float32)

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put the belief over roll and pitch on a map: how far a quadrotor that reads level drifts in a second at its final
        speed (see base class). The altitude, which has no place on a map, is left out.

        :param mean: ``(3,)``
        :param std: ``(3,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation, m
        """
        drift = GRAVITY / DRAG * self._scales[1:]
        (_, roll, pitch), (_, roll_std, pitch_std) = mean, std
        # A sensor that reads too much tilt is levelled by a tilt the other way.
        centre = np.array((-float(pitch) * drift[1], float(roll) * drift[0]))
        return centre, np.array((float(pitch_std) * drift[1], float(roll_std) * drift[0]))


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: BiasedQuadrotorConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``BiasedQuadrotor-v0``.

    :param physics: of the robot, see ``make_quadrotor``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_quadrotor_physics(physics)
    task = BiasedQuadrotor(config)
    return RobotTaskEnv(functools.partial(make_quadrotor, launch=task.launch, physics=physics), task, render_mode=render_mode)
