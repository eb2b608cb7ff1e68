"""What the quadruped's tasks with a depth camera share: how their environment is put together."""

import functools

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.robots.quadruped import check_physics, make_quadruped
from bullet_tasks.sensors.camera import LENSES, Intrinsics
from bullet_tasks.sensors.depth_camera import DepthCamera
from bullet_tasks.tasks.navigation import NavigationTask


def make_seeing_env(
    task: NavigationTask, physics: str, render_mode: str | None, lens: Intrinsics | str, back_end: str
) -> RobotTaskEnv:
    """
    Put a quadruped with a depth camera on its head into a task.

    :param task: geometry, goal, rewards and ends
    :param physics: of the robot, see ``make_quadruped``
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param lens: of the camera, or the name of one of ``bullet_tasks.sensors.camera.LENSES``
    :param back_end: who takes the images, see ``DepthCamera``
    :raises ValueError: if an argument is not a possible choice
    """
    check_physics(physics)
    if isinstance(lens, str):
        if lens not in LENSES:
            raise ValueError(f"Unknown lens {lens!r}; known: {sorted(LENSES)}, or an `Intrinsics`.")
        lens = LENSES[lens]
    camera = DepthCamera(lens, read_period=task.decision_period, back_end=back_end)
    make_robot = functools.partial(make_quadruped, physics=physics)
    return RobotTaskEnv(make_robot, task, sensors=(camera,), render_mode=render_mode)
