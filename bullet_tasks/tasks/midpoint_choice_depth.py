"""Midpoint Choice with a depth camera instead of scandots, on a larger platform."""

from collections.abc import Mapping
from typing import Any

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.sensors.camera import SMALL, Intrinsics
from bullet_tasks.simulation import Camera
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.midpoint_choice import MidpointChoice, MidpointChoiceConfig
from bullet_tasks.tasks.seeing import make_seeing_env

LARGE = MidpointChoiceConfig(half_side=2.55, corner=2.45, column_near=2.34, column_far=2.70, column_outer=1.06)
"""The platform of the release's task with images."""


class MidpointChoiceDepth(MidpointChoice):
    """
    Midpoint Choice with a depth camera (task card).

    Description
        As ``MidpointChoice``, on a square platform of 5.1 m: before three of the four corners stands a pair of columns,
        2.34 m from the middle, and the goal is behind the second tallest pair, which is 0.1 to 0.25 m higher than the lowest
        and 0.1 to 0.15 m lower than the tallest.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(2) in [-0.25, 0.25]: signs of the
        goal's x and y times 0.25. ``target`` uint8 Box(1, 36, 48): depth image of 82 degrees across, 0 to 2 m ahead of the
        camera on the robot's head as 0 to 255. The goal's marker is not seen.

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
        Without the privileged observation: turn round near the middle until the camera has seen the heights of all columns,
        then walk to the corner behind the second tallest.

    Differences from the paper and its release
        As for ``MidpointChoice``. Images have 48 x 36 pixels of the same view instead of 87 x 58, which are there with
        ``lens="release"``; they are of the moment of the decision instead of renewed every 0.1 s, and the camera has no
        random pitch.

    Source
        Uncertainty-Sensitive Privileged Learning, task Midpoint Choice (image); geometry and rewards measured in the authors'
        release (``middle_choose_image``).

    :param config: sizes, times and weights, whole or the values that differ from ``LARGE``
    :raises ValueError: if the configuration is not a possible world
    """

    camera = Camera(eye=(0.0, -11.0, 16.5), target=(0.0, -0.3, 0.0), up=(0.0, 1.0, 0.0), fov=22.0)

    def __init__(self, config: MidpointChoiceConfig | Mapping[str, Any] | None = None) -> None:
        super().__init__(configured(LARGE, config))


def make_env(
    physics: str = "kinematic",
    render_mode: str | None = None,
    config: MidpointChoiceConfig | Mapping[str, Any] | None = None,
    lens: Intrinsics | str = SMALL,
    back_end: str = "compiled",
) -> RobotTaskEnv:
    """
    Build ``MidpointChoiceDepth-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that differ from ``LARGE``
    :param lens: of the camera, or the name of one of ``bullet_tasks.sensors.camera.LENSES``
    :param back_end: who takes the images, see ``DepthCamera``
    :raises ValueError: if an argument is not a possible choice
    """
    return make_seeing_env(MidpointChoiceDepth(config), physics, render_mode, lens, back_end)
