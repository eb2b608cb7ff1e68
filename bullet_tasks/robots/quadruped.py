"""The Unitree A1 as seen by a high-level policy that commands its speed, heading and body pitch."""

import functools
from collections.abc import Callable

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
from bullet_tasks.robots.varied_quadruped import Variation, VariedQuadruped
from bullet_tasks.robots.walking_quadruped import ACCURATE, FAST, WalkingQuadruped
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
    "Variation",
    "VariedQuadruped",
    "WalkingQuadruped",
    "check_physics",
    "make_quadruped",
]

_PHYSICS: dict[str, Callable[[World], Robot[QuadrupedCommand]]] = {
    "kinematic": KinematicQuadruped,
    "compiled": CompiledQuadruped,
    "varied": VariedQuadruped,
    "full": functools.partial(WalkingQuadruped, preset=FAST),
    "full_accurate": functools.partial(WalkingQuadruped, preset=ACCURATE),
}


def make_quadruped(world: World, physics: str = "kinematic") -> Robot[QuadrupedCommand]:
    """
    Create the robot in a world.

    :param world: where
    :param physics: ``"kinematic"``: the body follows the command, collisions are PyBullet's; ``"compiled"``: the same model,
        several times faster, without PyBullet; ``"varied"``: that with another body in every episode (domain randomisation,
        see :class:`Variation`); ``"full"``: it walks on its legs, with gravity and contacts;
        ``"full_accurate"``: the same with the A1 of ``pybullet_data`` and shorter steps, several times slower
    :raises ValueError: if the physics is unknown
    """
    check_physics(physics)
    return _PHYSICS[physics](world)


def check_physics(physics: str) -> None:
    """
    Reject an unknown kind of physics before anything is built.

    :param physics: its name
    :raises ValueError: if it is unknown
    """
    if physics not in _PHYSICS:
        raise ValueError(f"Unknown physics {physics!r} for the quadruped; available: {sorted(_PHYSICS)}.")
