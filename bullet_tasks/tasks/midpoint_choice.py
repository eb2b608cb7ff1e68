"""Midpoint Choice: columns stand before three of four corners, and the goal is behind the second tallest."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.quadruped import BODY_RADIUS, check_physics, make_quadruped
from bullet_tasks.scene import PARKED, SceneSpec
from bullet_tasks.sensors.scandots import Scandots
from bullet_tasks.shapes import Box, Colour, Cylinder, Vector3
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.corners import CORNERS, CornerTask, quarter_turns
from bullet_tasks.tasks.navigation import NavigationReward

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_COLUMN: Colour = (0.93, 0.74, 0.16, 1.0)
_GOAL: Colour = (0.20, 0.72, 0.38, 1.0)
_MARKER_HALF_HEIGHT = 0.01  # m; the goal's disc lies on the floor

# The pairs of columns by height, and the sides of the way between the two of a pair.
_PAIRS = ("low", "middle", "tall")
_SIDES = {"left": 1.0, "right": -1.0}


@dataclass(frozen=True)
class MidpointChoiceConfig:
    """
    Sizes, times and weights; lengths in m, times in s. Geometry of the authors' release.

    :param half_side: of the square platform
    :param corner: x and y of the middle of a corner platform, up to their signs
    :param corner_reach: distance of the tips of a corner platform, a square on its tip, from its middle
    :param drop: height of the platforms above the ground beside them
    :param column_near: distance of the columns' inner face from the middle of the platform, along the diagonal
    :param column_far: distance of their outer face
    :param column_inner: distance of the columns' inner edges from the diagonal, half of the way between them
    :param column_outer: distance of their outer edges
    :param low_height: least and greatest height of the lowest pair
    :param middle_step: least and greatest height of the second tallest pair above the lowest one
    :param tall_step: least and greatest height of the tallest pair above the second tallest one
    :param goal_radius: the base's centre within this distance of the goal has reached it; radius of the dead zones too
    :param spawn_distance: greatest distance of the start from the middle
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    """

    half_side: float = 1.8
    corner: float = 1.7
    corner_reach: float = 1.0
    drop: float = 0.8
    column_near: float = 1.65
    column_far: float = 1.91
    column_inner: float = 0.425
    column_outer: float = 0.78
    low_height: tuple[float, float] = (0.0, 0.5)
    middle_step: tuple[float, float] = (0.1, 0.25)
    tall_step: tuple[float, float] = (0.1, 0.15)
    goal_radius: float = 0.4
    spawn_distance: float = 1.2
    decision_period: float = 0.25
    time_limit: float = 20.0
    reward: NavigationReward = field(default_factory=NavigationReward)

    def __post_init__(self) -> None:
        for name in ("low_height", "middle_step", "tall_step"):
            least, greatest = getattr(self, name)
            if not 0.0 <= least <= greatest < math.inf:
                raise ValueError(f"`{name}` must be 0 <= least <= greatest in metres, got {(least, greatest)}.")
        if not 0.0 < self.column_near < self.column_far:
            raise ValueError(
                f"`column_near` must be positive and less than `column_far`, got {self.column_near} and {self.column_far}."
            )
        if not BODY_RADIUS < self.column_inner < self.column_outer:
            raise ValueError(
                f"`column_inner` must be greater than the body's radius ({BODY_RADIUS} m), so that one can walk between two "
                f"columns, and less than `column_outer`, got {self.column_inner} and {self.column_outer}."
            )
        if not self.half_side - 0.5 * self.corner_reach < self.corner < self.half_side + 0.5 * self.corner_reach:
            raise ValueError(
                f"`corner` must be within half of `corner_reach` of `half_side` ({self.half_side} m), where a corner platform "
                f"is joined to the square one, got {self.corner}."
            )
        room = self.column_near - BODY_RADIUS
        if not 0.0 <= self.spawn_distance < min(room, math.sqrt(2.0) * self.corner - self.goal_radius, self.half_side):
            raise ValueError(
                f"`spawn_distance` must be at least 0 and less than {room:.2f} m, where the body meets a column, and on the "
                f"platform outside of the goal circle, got {self.spawn_distance}."
            )


class MidpointChoice(CornerTask):
    """
    Midpoint Choice (task card).

    Description
        A square platform of 3.6 m with a smaller one, a square on its tip, at each corner, and a drop around them. Before
        three of the corners stands a pair of columns with a way of 0.85 m between the two. The lowest pair is 0 to 0.5 m
        high, the middle one 0.1 to 0.25 m higher, and the tallest another 0.1 to 0.15 m higher. The goal is the middle of the
        corner platform behind the middle pair; which corner has which pair, or none, is drawn anew in every episode. The
        robot starts within 1.2 m of the middle (uniform in distance), facing anywhere.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(2) in [-0.25, 0.25]: signs of the
        goal's x and y times 0.25, so their standard deviation, 0.25, is the scale of uncertainty that the paper's constants
        are made for. ``target`` Box(132): scandots, in m, how far the terrain lies below the robot's feet at 12 x 11 points
        from 0.45 m behind to 1.2 m before it and 0.75 m to either side.

    Action
        Box(1) in [-1, 1]: turn by action * pi/4 from the present yaw, held for 0.25 s. The robot always walks at 0.7 m/s and
        turns at up to 2 rad/s.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal; ``heading_progress`` +2 per rad of heading error removed;
        ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or the base's centre comes within 0.4 m of the middle of one of the other three corner platforms; or a fall,
        when there is no floor under it. After 20 s the episode is truncated.

    Optimal behaviour
        Without the privileged observation: walk round near the corners until the heights of all columns are known, then
        walk to the corner behind the second tallest. A simple script needs 10 s on average and up to 14.5 s for it, and 4 s
        knowing the goal.

    Differences from the paper and its release
        Decisions every 0.25 s instead of 20 ms, and turns of pi/4 instead of pi, which at 2 rad/s is all that a decision can
        turn. No legs in ``physics="kinematic"``, hence none of the small locomotion rewards, no falls by tipping over, and a
        flat floor without the +-2 cm roughness. Goal and dead zones count at once, not after three and six control steps.
        Columns are blocks with the extent measured in the release, where they are bands cut off by the edge of the
        platforms. The robot's trunk, 0.2 to 0.4 m above the floor, passes over columns lower than that. Scandots
        are exact and of the moment (see ``Scandots``).

    Source
        Uncertainty-Sensitive Privileged Learning, task Midpoint Choice with scandots; geometry and rewards measured in the
        authors' release (``middle_choose``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.0, -8.0, 12.0), target=(0.0, -0.22, 0.0), up=(0.0, 1.0, 0.0), fov=22.0)
    picture_size = (640, 540)

    def __init__(self, config: MidpointChoiceConfig | Mapping[str, Any] | None = None) -> None:
        self.config = c = configured(MidpointChoiceConfig(), config)
        super().__init__((c.corner, c.corner), c.decision_period, c.time_limit, c.goal_radius, c.reward)
        self.symmetries = quarter_turns(4)
        # Columns cannot change their height: the tallest possible ones are sunk into the ground by what is too much.
        self._column_length = c.drop + c.low_height[1] + c.middle_step[1] + c.tall_step[1]
        self.scene = self._scene()

    def _scene(self) -> SceneSpec:
        c = self.config
        floor_z, half_drop = -0.5 * c.drop, 0.5 * c.drop
        edge = c.corner_reach / math.sqrt(2.0)
        column = (0.5 * (c.column_far - c.column_near), 0.5 * (c.column_outer - c.column_inner), 0.5 * self._column_length)
        return SceneSpec(
            (
                Box("platform", (0.0, 0.0, floor_z), (c.half_side, c.half_side, half_drop), colour=_FLOOR, floor=True),
                *(
                    Box(name, (x * c.corner, y * c.corner, floor_z), (edge, edge, half_drop), math.pi / 4, _FLOOR, floor=True)
                    for name, (x, y) in zip(("north_east", "south_east", "north_west", "south_west"), CORNERS, strict=True)
                ),
                *(Box(f"{pair}_{side}", PARKED, column, colour=_COLUMN) for pair in _PAIRS for side in _SIDES),
                Cylinder("goal", (c.corner, c.corner, 0.0), c.goal_radius, _MARKER_HALF_HEIGHT, colour=_GOAL, solid=False),
            ),
            lower_ground=-c.drop,
        )

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the goal's corner, the heights, the corners of the other columns, and the start (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        goal_corner = self.draw_corner(rng)
        low = rng.uniform(*c.low_height)
        middle = low + rng.uniform(*c.middle_step)
        tall = middle + rng.uniform(*c.tall_step)
        others = [corner for corner in CORNERS if corner != goal_corner]
        low_corner, tall_corner = (others[i] for i in rng.permutation(len(others))[:2])
        placements: dict[str, tuple[Vector3, float]] = {"goal": ((*self.goal, 0.0), 0.0)}
        for pair, corner, height in zip(_PAIRS, (low_corner, goal_corner, tall_corner), (low, middle, tall), strict=True):
            placements |= self._columns(pair, corner, float(height))
        spawn, bearing = rng.uniform(0.0, c.spawn_distance), rng.uniform(-math.pi, math.pi)
        yaw = float(rng.uniform(-math.pi, math.pi))
        return Start(float(spawn * math.cos(bearing)), float(spawn * math.sin(bearing)), yaw, placements)

    def _columns(self, pair: str, corner: tuple[float, float], height: float) -> dict[str, tuple[Vector3, float]]:
        """Where the two columns of a pair stand, turned along their corner's diagonal."""
        c = self.config
        ahead = 0.5 * (c.column_near + c.column_far) / math.sqrt(2.0)
        aside = 0.5 * (c.column_inner + c.column_outer) / math.sqrt(2.0)
        x, y = corner
        z = height - 0.5 * self._column_length
        yaw = math.atan2(y, x)
        return {
            f"{pair}_{side}": ((x * ahead - sign * y * aside, y * ahead + sign * x * aside, z), yaw)
            for side, sign in _SIDES.items()
        }


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: MidpointChoiceConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``MidpointChoice-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    make_robot = functools.partial(make_quadruped, physics=physics)
    return RobotTaskEnv(make_robot, MidpointChoice(config), sensors=(Scandots(),), render_mode=render_mode)
