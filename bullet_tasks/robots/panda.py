"""The Franka Panda as seen by a high-level policy that commands places, heights and the gripper."""

from collections.abc import Callable, Sequence

from bullet_tasks.robots.panda_arm import PandaArm
from bullet_tasks.robots.panda_compiled import CompiledPanda
from bullet_tasks.robots.panda_full import FullPanda
from bullet_tasks.robots.panda_kinematic import KinematicPanda
from bullet_tasks.world import World

_PHYSICS: dict[str, type[PandaArm]] = {"full": FullPanda, "kinematic": KinematicPanda, "compiled": CompiledPanda}


def make_panda(world: World, masses: Callable[[], Sequence[float]], physics: str = "kinematic") -> PandaArm:
    """
    Create the arm in a world.

    :param world: where
    :param masses: asked at every reset for the masses of the cubes in the order of their places, kg
    :param physics: ``"full"``: motors, a grasp by constraint, masses felt through its force; ``"kinematic"``: put where the
        inverse kinematics say; ``"compiled"``: the same without PyBullet, for training
    :raises ValueError: if the physics is unknown
    """
    check_physics(physics)
    return _PHYSICS[physics](world, masses)


def check_physics(physics: str) -> None:
    """
    Reject an unknown kind of physics before anything is built.

    :param physics: its name
    :raises ValueError: if it is unknown
    """
    if physics not in _PHYSICS:
        raise ValueError(f"Unknown physics {physics!r} for the arm; available: {sorted(_PHYSICS)}.")
