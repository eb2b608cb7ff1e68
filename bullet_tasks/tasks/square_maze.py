"""Square Maze: where the roads of a walled maze go on beyond its junctions tells a blind robot which corner is the goal."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.quadruped import BODY_HEIGHT, BODY_RADIUS, check_physics, make_quadruped
from bullet_tasks.scene import PARKED, SceneSpec
from bullet_tasks.shapes import Box, Colour, Cylinder, Vector3
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.corners import CornerTask
from bullet_tasks.tasks.navigation import NavigationReward

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_CURB: Colour = (0.42, 0.50, 0.60, 1.0)
_HINT: Colour = (0.93, 0.74, 0.16, 1.0)
_GOAL: Colour = (0.20, 0.72, 0.38, 1.0)
_Range = tuple[float, float]
_MARKER_HALF_HEIGHT = 0.01  # m; the goal's disc lies on the floor

# Where a road can go on beyond a junction -> unit vector from the middle of the maze. Names as on a map, where +y is up: the
# robot starts facing south.
_POCKETS = {"south": (0.0, -1.0), "east": (1.0, 0.0), "west": (-1.0, 0.0)}


@dataclass(frozen=True)
class SquareMazeConfig:
    """
    Sizes, times and weights; lengths in m, times in s. Geometry of the authors' release.

    :param road_half_width: half of the width between two curbs
    :param arm: distance from the middle of the maze to the start of the trunk, to the middle lines of the side roads, and
        along these to their ends
    :param south_pocket: how far the trunk goes on beyond the first junction where it does
    :param east_pocket: how far the crossing road goes on beyond the eastern (+x) side road where it does
    :param west_pocket: how far the crossing road goes on beyond the western (-x) side road where it does
    :param curb_height: height of the curbs above the roads
    :param curb_width: thickness of the curbs
    :param drop: height of the roads above the ground outside
    :param goal: x and y of the goal, up to their signs
    :param goal_radius: the base's centre within this distance of the goal has reached it; radius of the dead zones too
    :param spawn_y: y of the start, at x = 0
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    """

    road_half_width: float = 0.65
    arm: float = 2.24
    south_pocket: float = 0.975
    east_pocket: float = 0.975
    west_pocket: float = 0.65
    curb_height: float = 0.35
    curb_width: float = 0.15
    drop: float = 0.9
    goal: tuple[float, float] = (2.4, 1.55)
    goal_radius: float = 0.4
    spawn_y: float = 1.45
    decision_period: float = 0.25
    time_limit: float = 20.0
    reward: NavigationReward = field(default_factory=NavigationReward)

    def __post_init__(self) -> None:
        half, arm = self.road_half_width, self.arm
        for name in ("south_pocket", "east_pocket", "west_pocket", "curb_width", "drop"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"`{name}` must be a positive length in metres, got {getattr(self, name)}.")
        if not self.curb_height > BODY_HEIGHT:
            raise ValueError(
                f"`curb_height` must be greater than the height of the body's centre ({BODY_HEIGHT} m), so that a curb stops "
                f"the robot, got {self.curb_height}."
            )
        if not BODY_RADIUS < half < 0.5 * arm:
            raise ValueError(
                f"`road_half_width` must be more than the body's radius ({BODY_RADIUS} m) and less than half of `arm` "
                f"({0.5 * arm} m), where two roads meet, got {half}."
            )
        x, y = self.goal
        if not (abs(x - arm) < half and half + self.goal_radius < y < arm):
            raise ValueError(
                f"`goal` must lie on the side road, {arm - half:.2f} < x < {arm + half:.2f} m, and between the circle's "
                f"clearance from the crossing road and the end, {half + self.goal_radius:.2f} < y < {arm} m, got {self.goal}."
            )
        if not half < self.spawn_y < arm - BODY_RADIUS:
            raise ValueError(
                f"`spawn_y` must be on the trunk before the junction, {half} < spawn_y < {arm - BODY_RADIUS:.2f} m, "
                f"got {self.spawn_y}."
            )


class SquareMaze(CornerTask):
    """
    Square Maze (task card).

    Description
        A maze of roads 1.3 m wide between curbs: a trunk leads to a first junction with a crossing road, which ends on
        either side at a second junction with a side road. The goal is at one of the four ends of the side roads, with equal
        chance. The trunk goes on beyond the first junction if and only if the goal is on the +x side. The crossing road
        goes on beyond the goal's side road if and only if the goal is on the +y side. The robot is blind: it has no sensor
        but its pose, so it finds out by walking straight on. It starts on the trunk, 1.45 m before the junction, facing it.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(2) in [-0.25, 0.25]: signs of the
        goal's x and y times 0.25, so their standard deviation, 0.25, is the scale of uncertainty that the paper's constants
        are made for. There is no ``target``.

    Action
        Box(1) in [-1, 1]: turn by action * pi/4 from the present yaw, held for 0.25 s. The robot always walks at 0.7 m/s and
        turns at up to 2 rad/s.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal (as the crow flies); ``heading_progress`` +2 per rad of heading error
        removed; ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or the base's centre comes within 0.4 m of one of the other three corners. After 20 s the episode is
        truncated.

    Optimal behaviour
        Without the privileged observation: walk straight through the first junction. Stopped by a curb, turn right (towards
        -x), else left. Walk straight through the second junction as well. Stopped by a curb, go to
        the corner with y < 0, else to the one with y > 0. A simple script needs 12.2 to 13.3 s for it, and 7 s knowing
        the goal.

    Differences from the paper and its release
        Decisions every 0.25 s instead of 20 ms, and turns of pi/4 instead of pi, which at 2 rad/s is all that a decision can
        turn. No legs in ``physics="kinematic"``, hence none of the small locomotion rewards, no falls and no stumbling, and
        a flat floor without the +-2 cm roughness. Goal and dead zones count at once, not after three and six control steps.
        Heights count from the road, which is 0.1 m high in the release. The curbs are straight where the release
        rounds their outer corners. As in the release, and other than the paper says, "T means right" holds at the first
        junction and on the +x side, while on the -x side a T means left.

    Source
        Uncertainty-Sensitive Privileged Learning, task Square Maze; geometry and rewards measured in the authors' release
        (``four_corners``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.15, -5.0, 18.0), target=(0.15, -0.05, 0.0), up=(0.0, 1.0, 0.0), fov=17.0)
    picture_size = (720, 480)

    def __init__(self, config: SquareMazeConfig | Mapping[str, Any] | None = None) -> None:
        self.config = c = configured(SquareMazeConfig(), config)
        super().__init__(c.goal, c.decision_period, c.time_limit, c.goal_radius, c.reward)
        self._closed = {name: self._closing(name) for name in _POCKETS}
        self._open = {name: self._pocket(name) for name in _POCKETS}
        hints = (*self._closed.values(), *(shape for pocket in self._open.values() for shape in pocket))
        marker = Cylinder("goal", (*c.goal, 0.0), c.goal_radius, _MARKER_HALF_HEIGHT, colour=_GOAL, solid=False)
        self.scene = SceneSpec((*self._roads(), *self._curbs(), *hints, marker), lower_ground=-c.drop)

    def _road(self, name: str, x: _Range, y: _Range) -> Box:
        """Floor over a rectangle, from the ground up to height 0."""
        return self._block(name, x, y, 0.0, _FLOOR, floor=True)

    def _curb(self, name: str, x: _Range, y: _Range, colour: Colour = _CURB) -> Box:
        """Wall over a rectangle, from the ground up."""
        return self._block(name, x, y, self.config.curb_height, colour, floor=False)

    def _block(self, name: str, x: _Range, y: _Range, top: float, colour: Colour, floor: bool) -> Box:
        bottom = -self.config.drop
        centre = (0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), 0.5 * (bottom + top))
        half_extents = (0.5 * abs(x[1] - x[0]), 0.5 * abs(y[1] - y[0]), 0.5 * (top - bottom))
        return Box(name, centre, half_extents, colour=colour, floor=floor)

    def _roads(self) -> tuple[Box, ...]:
        c = self.config
        half, arm = c.road_half_width, c.arm
        return (
            self._road("trunk", (-half, half), (-half, arm)),
            self._road("crossing", (-arm - half, arm + half), (-half, half)),
            self._road("east_road", (arm - half, arm + half), (-arm, arm)),
            self._road("west_road", (-arm - half, -arm + half), (-arm, arm)),
        )

    def _curbs(self) -> tuple[Box, ...]:
        """Everything that stands in every layout."""
        c = self.config
        half, arm, width = c.road_half_width, c.arm, c.curb_width
        near, far = arm - half, arm + half
        curbs = [self._curb("start", (-half - width, half + width), (arm, arm + width))]
        for side, s in (("east", 1.0), ("west", -1.0)):
            curbs += [
                self._curb(f"trunk_{side}", (s * half, s * (half + width)), (half, arm)),
                self._curb(f"crossing_{side}_north", (s * half, s * near), (half, half + width)),
                self._curb(f"crossing_{side}_south", (s * half, s * near), (-half, -half - width)),
            ]
            for end, e in (("north", 1.0), ("south", -1.0)):
                curbs += [
                    self._curb(f"{side}_{end}_inner", (s * (near - width), s * near), (e * half, e * arm)),
                    self._curb(f"{side}_{end}_outer", (s * far, s * (far + width)), (e * half, e * arm)),
                    self._curb(f"{side}_{end}_end", (s * (near - width), s * (far + width)), (e * arm, e * (arm + width))),
                ]
        return tuple(curbs)

    def _ahead(self, pocket: str, along: _Range, across: _Range) -> tuple[_Range, _Range]:
        """Ranges of x and y of a rectangle given as distances beyond a pocket's mouth and from its middle line."""
        c = self.config
        dx, dy = _POCKETS[pocket]
        mouth = c.road_half_width if pocket == "south" else c.arm + c.road_half_width
        beyond = (mouth + along[0], mouth + along[1])
        if dx:
            return (dx * beyond[0], dx * beyond[1]), across
        return across, (dy * beyond[0], dy * beyond[1])

    def _closing(self, pocket: str) -> Box:
        """What makes a junction a T."""
        c = self.config
        x, y = self._ahead(pocket, (0.0, c.curb_width), (-c.road_half_width, c.road_half_width))
        return self._curb(f"{pocket}_t", x, y, _HINT)

    def _pocket(self, pocket: str) -> tuple[Box, ...]:
        """What makes a junction go on: a piece of road, curbs on both sides and at its end."""
        c = self.config
        half, width = c.road_half_width, c.curb_width
        depth = {"south": c.south_pocket, "east": c.east_pocket, "west": c.west_pocket}[pocket]
        beside = (0.0, depth + width)
        return (
            self._road(f"{pocket}_pocket", *self._ahead(pocket, (0.0, depth), (-half, half))),
            self._curb(f"{pocket}_pocket_side_0", *self._ahead(pocket, beside, (-half - width, -half))),
            self._curb(f"{pocket}_pocket_side_1", *self._ahead(pocket, beside, (half, half + width))),
            self._curb(f"{pocket}_pocket_end", *self._ahead(pocket, (depth, depth + width), (-half, half)), _HINT),
        )

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the goal's corner and lay the roads accordingly (see base class).

        :param rng: source of all randomness
        """
        sign_x, sign_y = self.draw_corner(rng)
        goes_on = set()
        if sign_x > 0.0:
            goes_on.add("south")
        if sign_y > 0.0:
            goes_on.add("east" if sign_x > 0.0 else "west")
        placements: dict[str, tuple[Vector3, float]] = {"goal": ((*self.goal, 0.0), 0.0)}
        for name in _POCKETS:
            parked = (self._closed[name],) if name in goes_on else self._open[name]
            placements |= {shape.name: (PARKED, 0.0) for shape in parked}
        return Start(0.0, self.config.spawn_y, -0.5 * math.pi, placements)


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: SquareMazeConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``SquareMaze-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    return RobotTaskEnv(functools.partial(make_quadruped, physics=physics), SquareMaze(config), render_mode=render_mode)
