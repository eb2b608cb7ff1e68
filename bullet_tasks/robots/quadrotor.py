"""A quadrotor as seen by a high-level policy that commands its attitude and altitude."""

from collections.abc import Callable

from bullet_tasks.robots.base import Robot
from bullet_tasks.robots.quadrotor_body import Launch, QuadrotorCommand
from bullet_tasks.robots.quadrotor_compiled import CompiledQuadrotor
from bullet_tasks.robots.quadrotor_full import FullQuadrotor
from bullet_tasks.robots.quadrotor_kinematic import KinematicQuadrotor
from bullet_tasks.robots.varied_quadrotor import VariedQuadrotor
from bullet_tasks.world import World

_PHYSICS: dict[str, Callable[[World, Launch], Robot[QuadrotorCommand]]] = {
    "compiled": CompiledQuadrotor,
    "full": FullQuadrotor,
    "kinematic": KinematicQuadrotor,
    "varied": VariedQuadrotor,
}


def make_quadrotor(world: World, launch: Launch, physics: str = "kinematic") -> Robot[QuadrotorCommand]:
    """
    Create the robot in a world.

    :param world: where
    :param launch: where in the air a flight begins, asked at every reset
    :param physics: ``"full"``: rotors with thrust, lag and drag on PyBullet's rigid body; ``"kinematic"``: a rigid body that
        follows the inner loop, contacts are PyBullet's; ``"compiled"``: the same above flat ground, without PyBullet;
        ``"varied"``: that with another body in every episode (domain randomisation, see ``FlightVariation``)
    :raises ValueError: if the physics is unknown
    """
    check_quadrotor_physics(physics)
    return _PHYSICS[physics](world, launch)


def check_quadrotor_physics(physics: str) -> None:
    """
    Reject an unknown kind of physics before anything is built.

    :param physics: its name
    :raises ValueError: if it is unknown
    """
    if physics not in _PHYSICS:
        raise ValueError(f"Unknown physics {physics!r} for the quadrotor; available: {sorted(_PHYSICS)}.")
