"""Signpost Nav with a depth camera instead of scandots."""

from collections.abc import Mapping
from typing import Any

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.sensors.camera import SMALL, Intrinsics
from bullet_tasks.tasks.seeing import make_seeing_env
from bullet_tasks.tasks.signpost_nav import SignpostNav, SignpostNavConfig


class SignpostNavDepth(SignpostNav):
    """
    Signpost Nav with a depth camera (task card).

    Description
        As ``SignpostNav``: the goal is somewhere on a disc of 4.5 m radius and cannot be perceived. A block on the rim, at
        (4.65, 0) m, points to it and is the longer the further away it is.

    Observation spaces
        ``common`` Box(4): x / 8 m, y / 8 m, cos(yaw), sin(yaw). ``privileged`` Box(2) in [-0.42, 0.42]: x and y of the
        goal / 8 m. ``target`` uint8 Box(1, 36, 48): depth image of 82 degrees across, 0 to 2 m ahead of the camera on the
        robot's head as 0 to 255. The goal's marker is not seen.

    Action
        Box(1) in [-1, 1]: turn by action * pi/4 from the present yaw, held for 0.25 s. The robot always walks at 0.7 m/s and
        turns at up to 2 rad/s.

    Rewards
        ``goal_progress`` +4 per m nearer to the goal; ``heading_progress`` +2 per rad of heading error removed;
        ``collision`` -3 per s of contact; ``goal_bonus`` 4 + 2 * (fraction of the time left) at the goal.

    Success
        The base's centre comes within 0.4 m of the goal.

    Termination
        Success; or a fall, when there is no floor under the base's centre. After 20 s the episode is truncated.

    Optimal behaviour
        Without the privileged observation: walk towards the signpost until the camera has seen both of its ends, which tell
        direction and distance, then walk to the goal.

    Differences from the paper and its release
        As for ``SignpostNav``. Images have 48 x 36 pixels of the same view instead of 87 x 58, which are there with
        ``lens="release"``; they are of the moment of the decision instead of renewed every 0.1 s, and the camera has no
        random pitch.

    Source
        Uncertainty-Sensitive Privileged Learning, task Signpost Nav (image); geometry and rewards measured in the authors'
        release (``circle_image``).

    :param config: sizes, times and weights, whole or the values that are different
    :raises ValueError: if the configuration is not a possible world
    """


def make_env(
    physics: str = "kinematic",
    render_mode: str | None = None,
    config: SignpostNavConfig | Mapping[str, Any] | None = None,
    lens: Intrinsics | str = SMALL,
    back_end: str = "compiled",
) -> RobotTaskEnv:
    """
    Build ``SignpostNavDepth-v0``.

    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param config: sizes, times and weights, whole or the values that are different
    :param lens: of the camera, or the name of one of ``bullet_tasks.sensors.camera.LENSES``
    :param back_end: who takes the images, see ``DepthCamera``
    :raises ValueError: if an argument is not a possible choice
    """
    return make_seeing_env(SignpostNavDepth(config), physics, render_mode, lens, back_end)
