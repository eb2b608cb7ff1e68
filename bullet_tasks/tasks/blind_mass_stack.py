"""Blind-Mass Stack: which cube is the red one is felt by weighing, with a scale that has to be calibrated first."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.panda import check_physics, make_panda
from bullet_tasks.robots.panda_arm import (
    CUBES,
    DECISION_PERIOD,
    EDGE,
    HEIGHTS,
    N_PLACES,
    NOTHING,
    ArmCommand,
    ArmState,
)
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Colour, Vector3
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Outcome, Start, Task
from bullet_tasks.tasks.configuration import configured

_COLOURS: dict[str, Colour] = {
    "red": (0.84, 0.16, 0.14, 1.0),
    "green": (0.16, 0.66, 0.30, 1.0),
    "blue": (0.15, 0.35, 0.80, 1.0),
}
_TABLE: Colour = (0.82, 0.80, 0.76, 1.0)
_TABLE_HALF: Vector3 = (0.45, 0.55, 0.02)  # m
_TABLE_X = 0.35  # m
_FLOOR_HEIGHT = -0.6  # m

POSITION_SCALE = 0.3
"""Length that counts as 1 in the observed positions, m."""
READINGS = (0.25, 2.5)
"""Least and greatest reading that the observation can show, kg; it lies between 0.28 and 2.03 kg."""
READING_STEP = 0.5
"""Of the reading's logarithm that counts as 1 in the observation: readings span 4 units, red and blue differ by 0.3-0.6."""
INDEX_SCALE = 0.3
"""Of the red cube's index (-1, 0, 1) in the privileged observation. Its standard deviation is 0.24, and 0.21 for a robot that
knows which cube is green."""
BIAS_SCALE = 0.4
"""Of the logarithm of the bias, in units of its bound, in the privileged observation: a standard deviation of 0.23."""
_ROOM = 0.13  # m between the centres of neighbours: half the hand's breadth (0.10 m), half a cube
_ON_TOP = 0.01  # m; how much the difference of two cubes' heights may differ from an edge when one stands on the other


@dataclass(frozen=True)
class BlindMassStackReward:
    """
    Reward weights, for the four parts that App. C.1.3 names. The first three are differences of potentials: what is undone
    is paid back, so that weighing costs nothing but time.

    :param approach: the hand's way to the red cube, from the far end of the table to the cube
    :param lift: the red cube leaves the table
    :param carry: the lifted red cube's way to the green one, from the far end of the table
    :param success_bonus: once, when the red cube stands on the green one
    :param time_bonus: once, at success, times the fraction of the episode's time that is left
    """

    approach: float = 1.0
    lift: float = 1.0
    carry: float = 1.0
    success_bonus: float = 4.0
    time_bonus: float = 2.0


@dataclass(frozen=True)
class BlindMassStackConfig:
    """
    Masses, sizes, times and weights; lengths in m, masses in kg.

    :param green_mass: known (paper)
    :param red_mass: known, but not which cube has it (paper)
    :param blue_ratio: least and greatest ratio of the blue cube's mass and the red one's, either way with equal chance
    :param greatest_bias: of the scale, which multiplies by a log-uniform factor between 1 / this and this
    :param spacing: of the places, along y
    :param place_x: of the middle of the row of places
    :param jitter: greatest distance of a place from its point in the row, along x and y
    :param n_decisions: length of an episode that nothing ends
    :param reward: reward weights
    """

    green_mass: float = 1.0
    red_mass: float = 0.75
    blue_ratio: tuple[float, float] = (1.15, 1.35)
    greatest_bias: float = 2.0
    spacing: float = 0.2
    place_x: float = 0.5
    jitter: float = 0.03
    n_decisions: int = 24
    reward: BlindMassStackReward = field(default_factory=BlindMassStackReward)

    def __post_init__(self) -> None:
        for name in ("green_mass", "red_mass"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"`{name}` must be a positive mass in kg, got {getattr(self, name)}.")
        near, far = self.blue_ratio
        if not 1.0 < near <= far < math.inf:
            raise ValueError(
                f"`blue_ratio` must be 1 < least <= greatest, got {self.blue_ratio}: a blue cube as heavy as the red one "
                "cannot be told from it."
            )
        if not 1.0 < self.greatest_bias < math.inf:
            raise ValueError(f"`greatest_bias` must be a factor above 1, got {self.greatest_bias}.")
        greatest = self.greatest_bias * max(self.green_mass, self.red_mass * far)
        if greatest > READINGS[1]:
            raise ValueError(
                f"A reading can be {greatest:.2f} kg, beyond the {READINGS[1]} kg that the observation can show: lower "
                "`greatest_bias` or the masses."
            )
        least = min(self.green_mass, self.red_mass / far) / self.greatest_bias
        if least <= READINGS[0]:
            raise ValueError(
                f"A reading can be {least:.2f} kg, which must be above the {READINGS[0]} kg that the observation shows as 0: "
                "lower `greatest_bias` or raise the masses."
            )
        most = 0.5 * (self.spacing - _ROOM)
        if not 0.0 <= self.jitter <= most:
            raise ValueError(
                f"`jitter` must be at least 0 and at most {most:.3f} m with a `spacing` of {self.spacing} m, got "
                f"{self.jitter}: the hand needs {_ROOM} m from cube to cube."
            )
        if self.spacing + self.jitter > POSITION_SCALE or not 0.4 <= self.place_x <= 0.6:
            raise ValueError(
                f"The arm must reach every place: `place_x` between 0.4 and 0.6 m, `spacing` + `jitter` at most "
                f"{POSITION_SCALE} m, got {self.place_x} and {self.spacing + self.jitter:.3f}."
            )
        if self.n_decisions < 1:
            raise ValueError(f"`n_decisions` must be at least 1, got {self.n_decisions}.")


class BlindMassStack(Task):
    """
    Blind-Mass Stack (task card).

    Description
        Three cubes of equal size stand in a row before a Franka Panda; one is red, one green, one blue. The robot knows
        which is the green one. Green weighs 1 kg, red 0.75 kg; blue weighs 0.75 kg times or divided by a factor between 1.15
        and 1.35. The arm weighs what it lifts, but its scale multiplies by an unknown factor between 1/2 and 2
        (log-uniform), the same all episode. Places (within 3 cm), colours, blue's mass and the factor are drawn at reset.

    Observation spaces
        ``common`` Box(22): positions of the three cubes and of the hand (middle of the fingers) relative to the table below
        the row's middle, / 0.3 m; which cube is green (one-hot, 3); whether a cube is held; which one (one-hot, 3, zeros if
        none); reading of the scale, if it is the green cube, the left or the right one of the others that is held (3, zeros
        for the rest), as log(reading / 0.25 kg) / 0.5. The scale reads bias times mass while a held cube hangs free;
        otherwise all three are 0.
        Cubes are numbered from left to right. ``privileged`` Box(2): index of the red cube as -0.3, 0 or 0.3, discrete
        (Eq. 4); the scale's bias as 0.4 log(bias) / log(2), continuous. Standard deviations 0.21 (to a robot that knows the
        green cube) and 0.23. There is no ``target``.

    Action
        MultiDiscrete([3, 3, 2]): where to, namely above which place (that of a cube at the start); how low: to a cube on the
        table, to one on top of another, or carrying height; gripper 0 open, 1 close. One action is one whole motion of at
        most 2.5 s: up, over, down, then the gripper. The hand stops at the top cube of a place, or when the cube in it
        stands on something. The gripper closes only around a cube and opens only when the held cube stands.

    Rewards
        ``approach`` +1 for the hand's way to the red cube; ``lift`` +1 when that is lifted; ``carry`` +1 for its way to the
        green cube; all three are taken back when undone. ``success_bonus`` 4 + 2 * (fraction of the time left).

    Success
        The red cube stands on the green one, released.

    Termination
        Success; or the blue cube stands on the green one, released, which is a failure: otherwise both could be tried
        without weighing. After 24 decisions the episode is truncated.

    Optimal behaviour
        Lift the green cube, which tells the bias; put it down, lift another, which tells whether that is red; put the red
        one onto the green one. With an average of 7 decisions; a robot that knows red needs 2.

    Differences from the paper
        Decisions are whole motions instead of 20 ms steps. Indices in ``common`` are one-hot, and the reading is a logarithm
        with a place for each cube, green first: bias and red are told by the difference from green's. The paper states
        neither the ranges of bias and blue mass nor what becomes of a wrong stack. Ours are chosen so that without the green
        cube little can be told: the ratio of blue and red is as likely one way as the other, and the bias spreads readings
        over a factor of 4; comparing the two raw readings and knowing the bias' range is right in 58 % of the episodes.
        In ``physics="full"``, a grasp is a fixed constraint between hand and cube, and the mass is read from its force.

    Source
        Uncertainty-Sensitive Privileged Learning, App. C.1.3, task Blind-Mass Stack; not in the authors' release.

    :param config: masses, sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(1.45, 0.0, 0.65), target=(0.4, 0.0, 0.13), fov=36.0)
    picture_size = (640, 480)
    decision_period = DECISION_PERIOD
    discrete_privileged = {0: (-INDEX_SCALE, 0.0, INDEX_SCALE)}  # noqa: RUF012 (a mapping that nobody writes to)

    def __init__(self, config: BlindMassStackConfig | Mapping[str, Any] | None = None) -> None:
        self.config = config = configured(BlindMassStackConfig(), config)
        self.time_limit = config.n_decisions * DECISION_PERIOD
        self.action_space = spaces.MultiDiscrete([N_PLACES, len(HEIGHTS), 2])
        # Positions of cubes and hand, green cube, grasp, held cube; readings.
        self._low = np.array([-1.0] * 12 + [0.0] * 10, dtype=np.float32)
        self._high = np.array([1.0] * 19 + [_shown(READINGS[1])] * N_PLACES, dtype=np.float32)
        self.common_space = spaces.Box(self._low, self._high, dtype=np.float32)
        bounds = np.array((INDEX_SCALE, BIAS_SCALE), dtype=np.float32)
        self.privileged_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        self.scene = self._scene()
        self.judge = self._judge
        self.red = self.green = self.blue = 0
        self.masses: tuple[float, ...] = ()
        self.bias = 1.0
        self._green_one_hot: tuple[float, ...] = ()
        self._scale_order: tuple[int, ...] = ()
        self._potentials = (0.0, 0.0, 0.0)
        # From one end of the row to the other; no way between two places is longer by more than the jitter.
        self._row_length = 2.0 * (config.spacing + config.jitter)

    def _scene(self) -> SceneSpec:
        c, half = self.config, 0.5 * EDGE
        thickness = _TABLE_HALF[2]
        table = Box("table", (_TABLE_X, 0.0, -thickness), _TABLE_HALF, colour=_TABLE, floor=True)
        # Not solid: where anything collides with the cubes, they are bodies of the robot's physics.
        cubes = [
            Box(name, (c.place_x, (i - 1) * c.spacing, half), (half, half, half), colour=_COLOURS[name], solid=False)
            for i, name in enumerate(CUBES)
        ]
        return SceneSpec((table, *cubes), lower_ground=_FLOOR_HEIGHT)

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw places, colours, the blue cube's mass and the bias (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        order = [CUBES[i] for i in rng.permutation(N_PLACES)]
        self.red, self.green, self.blue = (order.index(name) for name in CUBES)
        least, greatest = c.blue_ratio
        ratio = math.exp(rng.uniform(math.log(least), math.log(greatest)))
        blue_mass = c.red_mass * (ratio if rng.random() < 0.5 else 1.0 / ratio)
        masses = {"red": c.red_mass, "green": c.green_mass, "blue": blue_mass}
        self.masses = tuple(masses[name] for name in order)
        self.bias = c.greatest_bias ** rng.uniform(-1.0, 1.0)
        jitter = rng.uniform(-c.jitter, c.jitter, (N_PLACES, 2)).tolist()
        self._green_one_hot = tuple(float(i == self.green) for i in range(N_PLACES))
        self._scale_order = (self.green, *sorted((self.red, self.blue)))
        placements = {
            name: ((c.place_x + dx, (i - 1) * c.spacing + dy, 0.5 * EDGE), 0.0)
            for i, (name, (dx, dy)) in enumerate(zip(order, jitter, strict=True))
        }
        return Start(c.place_x, 0.0, 0.0, placements)

    def begin(self, state: RobotState, scene: SceneSpec) -> None:
        """
        Note how far the hand is from the red cube (see base class).

        :param state: of the arm
        :param scene: the world of this episode
        """
        self._potentials = self._measure(state)

    def command(self, action: Sequence[float], state: RobotState) -> ArmCommand:
        """
        A motion (see base class).

        :param action: place, height, gripper, ``(3,)``
        :param state: of the arm, now
        """
        return ArmCommand(int(action[0]), int(action[1]), action[2] == 1.0)

    def _judge(self, state: RobotState) -> Outcome:
        assert isinstance(state, ArmState)
        if state.held != NOTHING:
            return Outcome.RUNNING
        for index, outcome in ((self.red, Outcome.SUCCESS), (self.blue, Outcome.FAILURE)):
            if _stands_on(state.cubes[index], state.cubes[self.green]):
                return outcome
        return Outcome.RUNNING

    def _measure(self, state: RobotState) -> tuple[float, float, float]:
        """What the approach, the lifted cube and its way to the green cube are worth, each in [0, 1] times its weight."""
        assert isinstance(state, ArmState)
        reward, length = self.config.reward, self._row_length
        red, green = state.cubes[self.red], state.cubes[self.green]
        approach = reward.approach * max(0.0, 1.0 - math.hypot(state.x - red[0], state.y - red[1]) / length)
        if state.held != self.red or red[2] < EDGE:
            return approach, 0.0, 0.0
        carry = max(0.0, 1.0 - math.hypot(red[0] - green[0], red[1] - green[1]) / length)
        return approach, reward.lift, reward.carry * carry

    def reward_terms(self, state: RobotState, contact_time: float, time_left: float, outcome: Outcome) -> dict[str, float]:
        """
        Progress and bonus (see base class and ``BlindMassStackReward``).

        :param state: of the arm, after the decision
        :param contact_time: s
        :param time_left: fraction of the episode's time that is left
        :param outcome: how the episode stands
        """
        reward, before = self.config.reward, self._potentials
        if outcome is Outcome.SUCCESS:
            # What was lifted is where it should be: releasing it there completes the three parts.
            now, bonus = (reward.approach, reward.lift, reward.carry), reward.success_bonus + reward.time_bonus * time_left
        else:
            now, bonus = self._measure(state), 0.0
        self._potentials = now
        return {
            "approach": now[0] - before[0],
            "lift": now[1] - before[1],
            "carry": now[2] - before[2],
            "success_bonus": bonus,
        }

    def common(self, state: RobotState) -> np.ndarray:
        """
        Cubes, hand, green cube, grasp and reading (see the task card), float32 ``(22,)``.

        :param state: of the arm
        """
        assert isinstance(state, ArmState)
        values: list[float] = []
        middle = self.config.place_x
        for x, y, z in (*state.cubes, (state.x, state.y, state.z)):
            values += ((x - middle) / POSITION_SCALE, y / POSITION_SCALE, z / POSITION_SCALE)
        held = state.held
        values += self._green_one_hot
        values += (held != NOTHING, held == 0, held == 1, held == 2)
        reading = _shown(self.bias * state.load) if state.load > 0.0 else 0.0
        values += (reading if held == i else 0.0 for i in self._scale_order)
        # A cube may be knocked off its place.
        return np.clip(np.array(values, dtype=np.float32), self._low, self._high)

    def privileged(self) -> np.ndarray:
        """Index of the red cube and bias (see the task card), float32 ``(2,)``."""
        bias = math.log(self.bias) / math.log(self.config.greatest_bias)
        return np.array(((self.red - 1) * INDEX_SCALE, bias * BIAS_SCALE), dtype=np.float32)

    def true_masses(self) -> tuple[float, ...]:
        """Masses of the cubes in the order of their places, kg."""
        return self.masses

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put a belief over the red cube's index on the row of places; the bias has no place on the map (see base class).

        :param mean: ``(2,)``
        :param std: ``(2,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation, m
        """
        c = self.config
        spacing = c.spacing / INDEX_SCALE
        return np.array((c.place_x, float(mean[0]) * spacing)), np.array((0.0, float(std[0]) * spacing))


def _shown(reading: float) -> float:
    """The scale's reading as it is observed."""
    return math.log(reading / READINGS[0]) / READING_STEP


def _stands_on(upper: Vector3, lower: Vector3) -> bool:
    """Whether a cube is on top of another: their centres less than half an edge apart, seen from above."""
    return abs(upper[2] - lower[2] - EDGE) < _ON_TOP and math.hypot(upper[0] - lower[0], upper[1] - lower[1]) < 0.5 * EDGE


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: BlindMassStackConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``BlindMassStack-v0``.

    :param physics: of the arm, see ``make_panda``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: masses, sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    task = BlindMassStack(config)
    return RobotTaskEnv(functools.partial(make_panda, masses=task.true_masses, physics=physics), task, render_mode=render_mode)
