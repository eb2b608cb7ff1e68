"""Stairway Search: four corner platforms look alike, but stairs lead down from one, which is seen only over the edge."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.base import RobotState
from bullet_tasks.robots.quadruped import QuadrupedCommand
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors.camera import SMALL, Intrinsics
from bullet_tasks.shapes import Box, Colour, Cylinder, Vector3
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.base import Start
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.corners import CORNERS, CornerTask, quarter_turns
from bullet_tasks.tasks.navigation import FALL_HEIGHT, MAX_TURN, NavigationReward
from bullet_tasks.tasks.seeing import make_seeing_env

MAX_PITCH = math.pi / 6.0
"""Body pitch that the action 1 asks for, rad: what the authors' release clips it to."""

_FLOOR: Colour = (0.86, 0.87, 0.84, 1.0)
_STEP: Colour = (0.93, 0.74, 0.16, 1.0)
_GOAL: Colour = (0.20, 0.72, 0.38, 1.0)
_MARKER_HALF_HEIGHT = 0.01  # m; the goal's disc lies on the floor

_STEPS = ("upper", "lower")
_SIDES = {"left": 1.0, "right": -1.0}


@dataclass(frozen=True)
class StairwaySearchConfig:
    """
    Sizes, times and weights; lengths in m, times in s. Geometry of the authors' release.

    :param half_side: of the square platform
    :param corner: x and y of the middle of a corner platform, up to their signs
    :param corner_reach: distance of the tips of a corner platform, a square on its tip, from its middle
    :param drop: height of the platforms above the ground beside them
    :param step_height: height of a step; there are two on either flank of the goal's platform
    :param step_reach: distance, as that of the tips, at which the upper and the lower step end
    :param cut: least and greatest sum of a point's coordinates towards the corner where the stairs end
    :param goal_radius: the base's centre within this distance of the goal has reached it; radius of the dead zones too
    :param spawn_distance: greatest distance of the start from the middle
    :param speed: of the robot, m/s
    :param decision_period: time that one action holds
    :param time_limit: length of an episode that nothing ends
    :param reward: reward weights
    """

    half_side: float = 2.1
    corner: float = 2.0
    corner_reach: float = 1.0
    drop: float = 0.8
    step_height: float = 0.26
    step_reach: tuple[float, float] = (1.6, 2.2)
    cut: tuple[float, float] = (3.675, 4.41)
    goal_radius: float = 0.4
    spawn_distance: float = 1.0
    speed: float = 0.5
    decision_period: float = 0.25
    time_limit: float = 20.0
    reward: NavigationReward = field(default_factory=NavigationReward)

    def __post_init__(self) -> None:
        if not self.half_side - 0.5 * self.corner_reach < self.corner < self.half_side + 0.5 * self.corner_reach:
            raise ValueError(
                f"`corner` must be within half of `corner_reach` of `half_side` ({self.half_side} m), where a corner platform "
                f"is joined to the square one, got {self.corner}."
            )
        if not -FALL_HEIGHT < self.step_height < 0.5 * self.drop:
            raise ValueError(
                f"`step_height` must be more than {-FALL_HEIGHT} m, or who steps down has not fallen, and less than half of "
                f"`drop` ({self.drop} m), as there are two steps, got {self.step_height}."
            )
        upper, lower = self.step_reach
        if not self.corner_reach < upper < lower < 2.0 * self.corner:
            raise ValueError(
                f"`step_reach` must be two lengths that rise from `corner_reach` ({self.corner_reach} m) to less than "
                f"{2.0 * self.corner} m, where stairs of two corners meet, got {self.step_reach}."
            )
        shortest, longest = 2.0 * self.half_side - self.corner_reach, 2.0 * self.corner + self.corner_reach
        if not shortest < self.cut[0] <= self.cut[1] <= longest:
            raise ValueError(
                f"`cut` must be {shortest:.2f} m < least <= greatest <= {longest:.2f} m, from where a flank leaves the "
                f"platform to its tip, got {self.cut}."
            )
        if not (self.speed > 0.0 and math.isfinite(self.speed)):
            raise ValueError(f"`speed` must be positive and finite in m/s, got {self.speed}.")
        room = min(self.half_side, math.sqrt(2.0) * self.corner - self.goal_radius)
        if not 0.0 <= self.spawn_distance < room:
            raise ValueError(
                f"`spawn_distance` must be at least 0 and less than {room:.2f} m, on the platform outside of the goal circle, "
                f"got {self.spawn_distance}."
            )


class StairwaySearch(CornerTask):
    """
    Stairway Search (task card).

    Description
        A square platform of 4.2 m with a smaller one, a square on its tip, at each corner, 0.8 m above the ground. From one
        of the corner platforms stairs of two steps, 0.26 m each, lead down on both flanks; it is the goal, and which one it
        is, is drawn anew in every episode. From above all four look alike: the stairs are seen only over the edge. The robot
        starts within 1 m of the middle (uniform in distance), facing anywhere.

    Observation spaces
        ``common`` Box(5): x / 8 m, y / 8 m, cos(yaw), sin(yaw), body pitch / pi. ``privileged`` Box(2) in [-0.25, 0.25]:
        signs of the goal's x and y times 0.25, so their standard deviation, 0.25, is the scale of uncertainty that the
        paper's constants are made for. ``target`` uint8 Box(1, 36, 48): depth image of 82 degrees across, 0 to 2 m ahead of
        the camera on the robot's head as 0 to 255. The goal's marker is not seen.

    Action
        Box(2) in [-1, 1]: turn by action * pi/4 from the present yaw, and pitch the body by action * pi/6, nose down
        positive; held for 0.25 s. The robot always walks at 0.5 m/s, turns at up to 2 rad/s and pitches at up to 0.8 rad/s.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal; ``heading_progress`` +2 per rad of heading error removed;
        ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or the base's centre comes within 0.4 m of the middle of one of the other three corner platforms; or a fall,
        when there is no floor under it, stairs included. After 20 s the episode is truncated.

    Optimal behaviour
        Without the privileged observation: walk along the edges with the nose down until stairs are seen beside a corner, or
        none beside the other three, then walk to that corner.

    Differences from the paper and its release
        Decisions every 0.25 s instead of 20 ms, of which the release's walking controller heeds one in 15, and turns of pi/4
        instead of pi/2. In ``physics="full"`` the body pitches by no more than 0.35 rad, which the trot can hold. No legs in
        ``physics="kinematic"``, hence none of the small locomotion rewards, no falls by tipping over, and a flat floor
        without the +-2 cm roughness. Goal and dead zones count at once, not after three and six control steps, and the
        goal's circle is not wider for who stays there. One who steps down the stairs has fallen. Images have 48 x 36 pixels
        of the same view instead of 87 x 58, which are there with ``lens="release"``; they are of the moment of the
        decision instead of renewed every 0.1 s, and the camera has no random pitch.

    Source
        Uncertainty-Sensitive Privileged Learning, task Stairway Search; geometry and rewards measured in the authors' release
        (``stair_find_image``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.0, -9.0, 13.5), target=(0.0, -0.25, 0.0), up=(0.0, 1.0, 0.0), fov=22.0)
    picture_size = (640, 540)

    def __init__(self, config: StairwaySearchConfig | Mapping[str, Any] | None = None) -> None:
        self.config = c = configured(StairwaySearchConfig(), config)
        super().__init__((c.corner, c.corner), c.decision_period, c.time_limit, c.goal_radius, c.reward)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.common_space = spaces.Box(-1.0, 1.0, (5,), np.float32)
        self.symmetries = quarter_turns(5)
        # A shape cannot change its length: all stairs are as long as the longest, and the rest is under the platform.
        self._flight_length = (c.cut[1] + c.step_reach[1] - 2.0 * c.half_side) / math.sqrt(2.0)
        self.scene = self._scene()

    def _steps(self) -> dict[str, tuple[float, float, float]]:
        """Name -> distances of the inner and the outer rim from the corner's diagonal, height of the top, m."""
        c = self.config
        rims = [reach / math.sqrt(2.0) for reach in (c.corner_reach, *c.step_reach)]
        return {name: (rims[i], rims[i + 1], -(i + 1) * c.step_height) for i, name in enumerate(_STEPS)}

    def _scene(self) -> SceneSpec:
        c = self.config
        floor_z, half_drop = -0.5 * c.drop, 0.5 * c.drop
        edge = c.corner_reach / math.sqrt(2.0)
        steps = []
        for name, (inner, outer, top) in self._steps().items():
            half = (0.5 * self._flight_length, 0.5 * (outer - inner), 0.5 * (top + c.drop))
            steps += [Box(f"{name}_{side}", (0.0, 0.0, top - half[2]), half, colour=_STEP, floor=True) for side in _SIDES]
        return SceneSpec(
            (
                Box("platform", (0.0, 0.0, floor_z), (c.half_side, c.half_side, half_drop), colour=_FLOOR, floor=True),
                *(
                    Box(name, (x * c.corner, y * c.corner, floor_z), (edge, edge, half_drop), math.pi / 4, _FLOOR, floor=True)
                    for name, (x, y) in zip(("north_east", "south_east", "north_west", "south_west"), CORNERS, strict=True)
                ),
                *steps,
                Cylinder("goal", (c.corner, c.corner, 0.0), c.goal_radius, _MARKER_HALF_HEIGHT, colour=_GOAL, solid=False),
            ),
            lower_ground=-c.drop,
        )

    def reset(self, rng: np.random.Generator) -> Start:
        """
        Draw the goal's corner, the length of its stairs, and the start (see base class).

        :param rng: source of all randomness
        """
        c = self.config
        corner = self.draw_corner(rng)
        placements: dict[str, tuple[Vector3, float]] = {"goal": ((*self.goal, 0.0), 0.0)}
        placements |= self._stairs(corner, float(rng.uniform(*c.cut)))
        spawn, bearing = rng.uniform(0.0, c.spawn_distance), rng.uniform(-math.pi, math.pi)
        yaw = float(rng.uniform(-math.pi, math.pi))
        return Start(float(spawn * math.cos(bearing)), float(spawn * math.sin(bearing)), yaw, placements)

    def _stairs(self, corner: tuple[float, float], cut: float) -> dict[str, tuple[Vector3, float]]:
        """Where the steps lie, along the diagonal of their corner."""
        x, y = (sign / math.sqrt(2.0) for sign in corner)
        along = cut / math.sqrt(2.0) - 0.5 * self._flight_length
        placements: dict[str, tuple[Vector3, float]] = {}
        for name, (inner, outer, _) in self._steps().items():
            for side, sign in _SIDES.items():
                beside, z = sign * 0.5 * (inner + outer), self.scene[f"{name}_{side}"].centre[2]
                centre = (x * along - y * beside, y * along + x * beside, z)
                placements[f"{name}_{side}"] = (centre, math.atan2(y, x))
        return placements

    def command(self, action: Sequence[float], state: RobotState) -> QuadrupedCommand:
        """
        Turn by up to ``MAX_TURN`` either way and pitch the body by up to ``MAX_PITCH``, always walking (see base class).

        :param action: turn in units of ``MAX_TURN``, pitch in units of ``MAX_PITCH``, ``(2,)``
        :param state: of the robot, now
        """
        return QuadrupedCommand(self.config.speed, state.yaw + MAX_TURN * action[0], MAX_PITCH * action[1])

    def common(self, state: RobotState) -> np.ndarray:
        """
        Pose of the base: x and y in units of 8 m, cosine and sine of the yaw, pitch in units of pi; float32 ``(5,)``.

        :param state: of the robot
        """
        return np.append(super().common(state), np.float32(state.pitch / math.pi))


def make_env(
    physics: str = "kinematic",
    render_mode: str | None = None,
    config: StairwaySearchConfig | Mapping[str, Any] | None = None,
    lens: Intrinsics | str = SMALL,
    back_end: str = "compiled",
) -> RobotTaskEnv:
    """
    Build ``StairwaySearchDepth-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :param lens: of the camera, or the name of one of ``bullet_tasks.sensors.camera.LENSES``
    :param back_end: who takes the images, see ``DepthCamera``
    :raises ValueError: if an argument is not a possible choice
    """
    return make_seeing_env(StairwaySearch(config), physics, render_mode, lens, back_end)
