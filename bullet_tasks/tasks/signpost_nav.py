"""Signpost Nav: the goal is somewhere on a disc, and a block at its rim tells where by its direction and its length."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.quadruped import BODY_RADIUS, check_physics, make_quadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors.scandots import Scandots
from bullet_tasks.shapes import Box, Colour, Cylinder, Vector3
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start
from bullet_tasks.tasks.configuration import check_positive, configured
from bullet_tasks.tasks.navigation import NavigationReward, NavigationTask

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_POST: Colour = (0.93, 0.74, 0.16, 1.0)
_GOAL: Colour = (0.20, 0.72, 0.38, 1.0)
_MARKER_HALF_HEIGHT = 0.01  # m; the goal's disc lies on the floor

# A shape cannot change its size, so the signpost is several blocks in line, which overlap the more the shorter it is.
_BLOCKS = ("post_near", "post_middle", "post_far")


@dataclass(frozen=True)
class SignpostNavConfig:
    """
    Sizes, times and weights; lengths in m, times in s. Geometry of the authors' release.

    :param platform_radius: of the disc; beyond it is a drop
    :param drop: height of the disc above the ground beside it
    :param goal_distance: least and greatest distance of the goal from the middle
    :param goal_radius: the base's centre within this distance of the goal has reached it
    :param post_x: x of the signpost's centre, at y = 0
    :param post_height: height of the signpost above the disc
    :param post_thickness: of the signpost
    :param post_base_length: length of a signpost whose goal is at its centre
    :param post_length_per_metre: what it is longer for every m to the goal
    :param spawn_distance: greatest distance of the start from the middle
    :param privileged_scale: length that counts as 1 in the privileged observation
    :param privileged_bound: bound of the privileged observation
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    """

    platform_radius: float = 4.5
    drop: float = 0.8
    goal_distance: tuple[float, float] = (1.3, 3.325)
    goal_radius: float = 0.4
    post_x: float = 4.65
    post_height: float = 0.5
    post_thickness: float = 0.3
    post_base_length: float = 0.8
    post_length_per_metre: float = 0.2
    spawn_distance: float = 3.0
    privileged_scale: float = 8.0
    privileged_bound: float = 0.42
    decision_period: float = 0.25
    time_limit: float = 20.0
    reward: NavigationReward = field(default_factory=NavigationReward)

    def post_length(self, distance: float) -> float:
        """
        Length of the signpost, m.

        :param distance: from its centre to the goal, m
        """
        return self.post_base_length + self.post_length_per_metre * distance

    def __post_init__(self) -> None:
        check_positive(self, "privileged_scale", "privileged_bound")
        near, far = self.goal_distance
        rim = self.platform_radius - self.goal_radius
        if not 0.0 <= near <= far <= rim:
            raise ValueError(
                f"`goal_distance` must be 0 <= least <= greatest <= {rim:.2f} m, where the goal circle meets the rim of the "
                f"disc, got {self.goal_distance}."
            )
        if far > self.privileged_bound * self.privileged_scale:
            raise ValueError(
                f"A goal at {far} m is {far / self.privileged_scale:.3f} in the privileged observation, beyond its bound "
                f"{self.privileged_bound}: raise `privileged_scale` or `privileged_bound`."
            )
        if not (self.post_base_length > 0.0 and self.post_length_per_metre >= 0.0):
            raise ValueError(
                "`post_base_length` must be positive and `post_length_per_metre` at least 0, got "
                f"{self.post_base_length} and {self.post_length_per_metre}."
            )
        shortest, longest = self.post_length(self.post_x - far), self.post_length(self.post_x + far)
        if longest > len(_BLOCKS) * shortest:
            raise ValueError(
                f"The longest signpost ({longest:.2f} m) must not exceed {len(_BLOCKS)} times the shortest "
                f"({shortest:.2f} m), as it is made of so many blocks: raise `post_base_length` or lower "
                "`post_length_per_metre`."
            )
        furthest = self.platform_radius + 0.5 * shortest
        if self.post_x > furthest:
            raise ValueError(f"`post_x` must be at most {furthest:.2f} m, where the disc ends, got {self.post_x}.")
        room = self.post_x - 0.5 * longest - BODY_RADIUS
        if not 0.0 <= self.spawn_distance <= room:
            raise ValueError(
                f"`spawn_distance` must be from 0 to {room:.2f} m, where the body meets the longest signpost, "
                f"got {self.spawn_distance}."
            )


class SignpostNav(NavigationTask):
    """
    Signpost Nav (task card).

    Description
        The goal is somewhere on a disc of 4.5 m radius with a drop around it, 1.3 to 3.325 m from the middle in any
        direction, and cannot be perceived. A signpost tells where it is: a block 0.5 m high and 0.3 m thick, always at the
        same place on the rim, (4.65, 0) m, which lies along the line from there to the goal and is 0.8 m + 0.2 * (distance to
        the goal) long, i.e. 1.07 to 2.4 m. The robot starts within 3 m of the middle (uniform in distance), facing anywhere.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(2) in [-0.42, 0.42]: x and y of the
        goal / 8 m; their standard deviation, 0.21, is the scale of uncertainty that the paper's constants are made for.
        ``target`` Box(132): scandots, in m, how far the terrain lies below the robot's feet at 12 x 11 points from 0.45 m
        behind to 1.2 m before it and 0.75 m to either side.

    Action
        Box(1) in [-1, 1]: turn by action * pi/4 from the present yaw, held for 0.25 s. The robot always walks at 0.7 m/s and
        turns at up to 2 rad/s.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal; ``heading_progress`` +2 per rad of heading error removed;
        ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or a fall, when there is no floor under the base's centre. After 20 s the episode is truncated. There are no
        dead zones.

    Optimal behaviour
        Without the privileged observation: walk to the signpost, read its direction and its length off the scandots, walk to
        the goal. A simple script does so in 10 s on average and finds 99 % of the goals in time, and in 4 s
        knowing the goal.

    Differences from the paper and its release
        Decisions every 0.25 s instead of 20 ms, and turns of pi/4 instead of pi, which at 2 rad/s is all that a decision can
        turn. No legs in ``physics="kinematic"``, hence none of the small locomotion rewards, no falls by tipping over, and a
        flat floor without the +-2 cm roughness. The goal counts at once, not after three control steps. Goal and signpost
        have exact coordinates instead of those of a grid of 5 cm, so the signpost tells the distance exactly. Scandots are
        exact and of the moment (see ``Scandots``). As in the release, some 1 % of the starts lie in the goal circle.

    Source
        Uncertainty-Sensitive Privileged Learning, task Signpost Nav; geometry and rewards measured in the authors' release
        (``circle``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.68, -6.0, 20.0), target=(0.68, -0.1, 0.0), up=(0.0, 1.0, 0.0), fov=25.0)
    picture_size = (680, 580)

    def __init__(self, config: SignpostNavConfig | Mapping[str, Any] | None = None) -> None:
        self.config = c = configured(SignpostNavConfig(), config)
        super().__init__(c.decision_period, c.time_limit, c.goal_radius, c.reward)
        self.privileged_space = spaces.Box(-c.privileged_bound, c.privileged_bound, (2,), np.float32)
        # As long as the shortest signpost, and from the ground up, as they reach beyond the rim.
        self._block_length = c.post_length(c.post_x - c.goal_distance[1])
        self._post_z = 0.5 * (c.post_height - c.drop)
        self.scene = self._scene()

    def _scene(self) -> SceneSpec:
        c = self.config
        block = (0.5 * self._block_length, 0.5 * c.post_thickness, 0.5 * (c.post_height + c.drop))
        goal = (c.goal_distance[0], 0.0, 0.0)
        return SceneSpec(
            (
                Cylinder("platform", (0.0, 0.0, -0.5 * c.drop), c.platform_radius, 0.5 * c.drop, colour=_FLOOR, floor=True),
                *(Box(name, (c.post_x, 0.0, self._post_z), block, colour=_POST) for name in _BLOCKS),
                Cylinder("goal", goal, c.goal_radius, _MARKER_HALF_HEIGHT, colour=_GOAL, solid=False),
            ),
            lower_ground=-c.drop,
        )

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the goal and the start, and point the signpost at the goal (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        distance, angle = rng.uniform(*c.goal_distance), rng.uniform(-math.pi, math.pi)
        self.goal = (float(distance * math.cos(angle)), float(distance * math.sin(angle)))
        placements: dict[str, tuple[Vector3, float]] = {"goal": ((*self.goal, 0.0), 0.0), **self._signpost()}
        spawn, bearing = rng.uniform(0.0, c.spawn_distance), rng.uniform(-math.pi, math.pi)
        yaw = float(rng.uniform(-math.pi, math.pi))
        return Start(float(spawn * math.cos(bearing)), float(spawn * math.sin(bearing)), yaw, placements)

    def _signpost(self) -> dict[str, tuple[Vector3, float]]:
        """Where the blocks of the signpost stand for the present goal."""
        post_x = self.config.post_x
        dx, dy = self.goal[0] - post_x, self.goal[1]
        distance, yaw = math.hypot(dx, dy), math.atan2(dy, dx)
        shift = 0.5 * (self.config.post_length(distance) - self._block_length)
        return {
            name: ((post_x + along * shift * dx / distance, along * shift * dy / distance, self._post_z), yaw)
            for name, along in zip(_BLOCKS, (1.0, 0.0, -1.0), strict=True)
        }

    def privileged(self) -> np.ndarray:
        """The goal's x and y in units of 8 m, float32 ``(2,)``."""
        return np.array(self.goal, dtype=np.float32) / np.float32(self.config.privileged_scale)

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put a belief over the goal on the map (see base class).

        :param mean: ``(2,)``
        :param std: ``(2,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation, m
        """
        scale = self.config.privileged_scale
        return np.asarray(mean) * scale, np.asarray(std) * scale


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: SignpostNavConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``SignpostNav-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    make_robot = functools.partial(make_quadruped, physics=physics)
    return RobotTaskEnv(make_robot, SignpostNav(config), sensors=(Scandots(),), render_mode=render_mode)
