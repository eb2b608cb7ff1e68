"""Lateral Choice: the goal is at one of the two ends of a corridor, and nothing the robot senses says at which."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.quadruped import check_physics, make_quadruped
from bullet_tasks.robots.quadruped_body import BODY_RADIUS
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Colour, Cylinder
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start
from bullet_tasks.tasks.configuration import check_positive, configured
from bullet_tasks.tasks.navigation import NavigationReward, NavigationTask

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_BLOCK: Colour = (0.42, 0.50, 0.60, 1.0)
_POST: Colour = (0.93, 0.74, 0.16, 1.0)
_GOAL: Colour = (0.20, 0.72, 0.38, 1.0)
_MARKER_HALF_HEIGHT = 0.01  # m; the goal's disc lies on the floor


@dataclass(frozen=True)
class LateralChoiceConfig:
    """
    Sizes, times and weights; lengths in m, times in s. Geometry of the authors' release.

    :param corridor_half_width: the floor's half-width; beyond it is a drop
    :param drop: height of the floor above the ground beside it
    :param block_near: distance of the end blocks' inner face from the middle
    :param block_far: distance of their outer face, where the floor ends too
    :param block_height: height of the end blocks
    :param post_distance: distance of the post behind the goal from the middle
    :param post_width: edge of the square post
    :param post_height: height of the post
    :param goal_distance: least and greatest distance of the goal from the middle
    :param goal_radius: the base's centre within this distance of the goal has reached it
    :param spawn_distance: greatest distance of the start from the middle
    :param privileged_scale: length that counts as 1 in the privileged observation
    :param privileged_bound: bound of the privileged observation
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    """

    corridor_half_width: float = 0.8
    drop: float = 0.8
    block_near: float = 4.6
    block_far: float = 5.3
    block_height: float = 1.0
    post_distance: float = 4.4
    post_width: float = 0.2
    post_height: float = 2.5
    goal_distance: tuple[float, float] = (3.9, 3.95)
    goal_radius: float = 0.4
    spawn_distance: float = 0.5
    privileged_scale: float = 16.0
    privileged_bound: float = 0.25
    decision_period: float = 0.25
    time_limit: float = 20.0
    reward: NavigationReward = field(default_factory=NavigationReward)

    def __post_init__(self) -> None:
        check_positive(self, "privileged_scale", "privileged_bound")
        near, far = self.goal_distance
        if not 0.0 < near <= far < self.block_near:
            raise ValueError(
                f"`goal_distance` must be 0 < least <= greatest < {self.block_near} m, where the floor meets the end "
                f"block, got {self.goal_distance}: the goal must lie on its platform."
            )
        if far > self.privileged_bound * self.privileged_scale:
            raise ValueError(
                f"A goal at {far} m is {far / self.privileged_scale:.3f} in the privileged observation, beyond its bound "
                f"{self.privileged_bound}: raise `privileged_scale` or `privileged_bound`."
            )
        if not 0.0 <= self.spawn_distance < near - self.goal_radius:
            raise ValueError(
                f"`spawn_distance` must be at least 0 and less than {near - self.goal_radius:.2f} m, where the goal "
                f"circle begins, got {self.spawn_distance}."
            )
        if self.corridor_half_width <= BODY_RADIUS or self.post_distance < far:
            raise ValueError(
                f"`corridor_half_width` must be more than the robot's {BODY_RADIUS} m, and `post_distance` at least {far} m, "
                f"behind the goal; got {self.corridor_half_width} and {self.post_distance}."
            )


class LateralChoice(NavigationTask):
    """
    Lateral Choice (task card).

    Description
        A quadruped stands in the middle of a corridor 1.6 m wide with a drop on either side and a block at either end.
        The goal is 3.9 m away, to the left or to the right with equal chance. The robot has no sensor but its pose.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(1) in [-0.25, 0.25]: x of the goal
        / 16 m; its standard deviation, 0.245, is the scale of uncertainty that the paper's constants are made for.
        There is no ``target``.

    Action
        Box(1) in [-1, 1]: turn by action * pi/4 from the present yaw, held for 0.25 s. The robot always walks at 0.7 m/s;
        it turns at up to 2 rad/s, so a half turn takes 0.7 m of the corridor's width.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal; ``heading_progress`` +2 per rad of heading error removed;
        ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or a fall, when there is no floor under the base's centre. After 20 s the episode is truncated.
        The wrong end does not end the episode.

    Optimal behaviour
        Without the privileged observation: walk to one end, and if the episode does not end there, turn round and walk
        to the other. Beginning with the end that the robot faces, that takes 11 s on average and up to 18.3 s of the 20 s.

    Differences from the paper and its release
        Decisions every 0.25 s instead of 20 ms, and turns of pi/4 instead of pi, which at 2 rad/s is all that a decision can
        turn. No legs in ``physics="kinematic"`` and ``"compiled"``, hence none of the small locomotion rewards, no falls by
        tipping over, and a flat floor without the +-2 cm roughness. The goal counts at once, not after three control steps.
        The goal is one privileged number (x), as its y is always 0.

    Source
        Uncertainty-Sensitive Privileged Learning, task Lateral Choice; geometry and rewards measured in the authors'
        release (``left_right_choose``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.0, -6.0, 18.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov=9.6)
    picture_size = (800, 208)

    def __init__(self, config: LateralChoiceConfig | Mapping[str, Any] | None = None) -> None:
        self.config = config = configured(LateralChoiceConfig(), config)
        super().__init__(config.decision_period, config.time_limit, config.goal_radius, config.reward)
        self.privileged_space = spaces.Box(-config.privileged_bound, config.privileged_bound, (1,), np.float32)
        self.scene = self._scene()

    def _scene(self) -> SceneSpec:
        c = self.config
        half_length = 0.5 * (c.block_far - c.block_near)
        block = (half_length, c.corridor_half_width, 0.5 * c.block_height)
        block_x = c.block_near + half_length
        post = (0.5 * c.post_width, 0.5 * c.post_width, 0.5 * c.post_height)
        floor = (c.block_far, c.corridor_half_width, 0.5 * c.drop)
        return SceneSpec(
            (
                Box("corridor", (0.0, 0.0, -0.5 * c.drop), floor, colour=_FLOOR, floor=True),
                Box("left_block", (-block_x, 0.0, 0.5 * c.block_height), block, colour=_BLOCK),
                Box("right_block", (block_x, 0.0, 0.5 * c.block_height), block, colour=_BLOCK),
                Box("post", (c.post_distance, 0.0, 0.5 * c.post_height), post, colour=_POST),
                Cylinder(
                    "goal", (c.goal_distance[0], 0.0, 0.0), c.goal_radius, _MARKER_HALF_HEIGHT, colour=_GOAL, solid=False
                ),
            ),
            lower_ground=-c.drop,
        )

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the goal's side and the start (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        side = 1.0 if rng.random() < 0.5 else -1.0
        self.goal = (side * float(rng.uniform(*c.goal_distance)), 0.0)
        x = float(rng.uniform(0.0, c.spawn_distance)) * (1.0 if rng.random() < 0.5 else -1.0)
        yaw = 0.0 if rng.random() < 0.5 else math.pi
        placements = {
            "post": ((side * c.post_distance, 0.0, 0.5 * c.post_height), 0.0),
            "goal": ((*self.goal, 0.0), 0.0),
        }
        return Start(x, 0.0, yaw, placements)

    def privileged(self) -> np.ndarray:
        """The goal's x in units of 16 m, float32 ``(1,)``."""
        return np.array((self.goal[0] / self.config.privileged_scale,), dtype=np.float32)

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put a belief over the goal on the map: uncertain along the corridor, certain across it (see base class).

        :param mean: ``(1,)``
        :param std: ``(1,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation, m
        """
        scale = self.config.privileged_scale
        return np.array((float(mean[0]) * scale, 0.0)), np.array((float(std[0]) * scale, 0.0))


def make_env(
    physics: str = "kinematic", render_mode: str | None = None, config: LateralChoiceConfig | Mapping[str, Any] | None = None
) -> RobotTaskEnv:
    """
    Build ``LateralChoice-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    return RobotTaskEnv(functools.partial(make_quadruped, physics=physics), LateralChoice(config), render_mode=render_mode)
