"""The Unitree A1 as seen by a high-level policy that commands its speed, heading and body pitch."""

from bullet_tasks.robots.base import Robot
from bullet_tasks.robots.compiled_quadruped import CompiledQuadruped
from bullet_tasks.robots.kinematic_quadruped import KinematicQuadruped
from bullet_tasks.robots.quadruped_body import (
    BODY_HEIGHT,
    BODY_RADIUS,
    MAX_YAW_RATE,
    SUBSTEP,
    WALKING_SPEED,
    QuadrupedCommand,
)
from bullet_tasks.world import World

__all__ = [
    "BODY_HEIGHT",
    "BODY_RADIUS",
    "MAX_YAW_RATE",
    "SUBSTEP",
    "WALKING_SPEED",
    "CompiledQuadruped",
    "KinematicQuadruped",
    "QuadrupedCommand",
    "check_physics",
    "make_quadruped",
]

_PHYSICS: dict[str, type[KinematicQuadruped] | type[CompiledQuadruped]] = {
    "kinematic": KinematicQuadruped,
    "compiled": CompiledQuadruped,
}
_PLANNED_PHYSICS = ("full",)


def make_quadruped(world: World, physics: str = "kinematic") -> Robot[QuadrupedCommand]:
    """
    Create the robot in a world.

    :param world: where
    :param physics: ``"kinematic"``: the body follows the command, collisions are PyBullet's; ``"compiled"``: the same model,
        several times faster, without PyBullet
    :raises ValueError: if the physics is unknown or not available yet
    """
    check_physics(physics)
    return _PHYSICS[physics](world)


def check_physics(physics: str) -> None:
    """
    Reject an unknown kind of physics before anything is built.

    :param physics: its name
    :raises ValueError: if it is unknown or not available yet
    """
    if physics in _PLANNED_PHYSICS:
        raise ValueError(f"physics={physics!r} is not available yet for the quadruped; available: {sorted(_PHYSICS)}.")
    if physics not in _PHYSICS:
        raise ValueError(f"Unknown physics {physics!r} for the quadruped; available: {sorted(_PHYSICS)}.")
