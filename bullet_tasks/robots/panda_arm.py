"""The Franka Panda as a high-level policy sees it, whatever physics moves it: sizes, command, state, where the hand stops."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

from bullet_tasks.robots.base import Robot, RobotState
from bullet_tasks.shapes import Vector3
from bullet_tasks.world import World

CUBES = ("red", "green", "blue")
"""Names of the cubes' shapes in a scene."""
N_PLACES = 3
"""On the table, each with one cube at the start; from left to right, which is from least to greatest y."""
EDGE = 0.05
"""Of a cube, m (``cube_small.urdf``)."""
CARRY_HEIGHT = 0.18
"""Of the middle of a carried cube above the table, m: its lower face clears two cubes on one another by 5 cm."""
HEIGHTS = (0.5 * EDGE, 1.5 * EDGE, CARRY_HEIGHT)
"""That a policy can send the hand to, m: a cube on the table, one on top of another, carrying."""
AT_REST: Vector3 = (0.5, 0.0, CARRY_HEIGHT)
"""Where the hand is before the first episode, m."""
NOTHING = -1
"""Index of the held cube when there is none."""
REACH = 0.015
"""How far from the middle of the fingers a cube's centre may be to be grasped, or from a place's to stand there, m."""
DECISION_PERIOD = 2.5
"""Within which every motion ends, s; the longest one takes ``physics="full"`` 1.7 s (places as by default)."""


class ArmCommand(NamedTuple):
    """What a high-level policy tells the arm's controller."""

    place: int
    """To which of the places the hand goes."""
    height: int
    """Index into ``HEIGHTS``."""
    close: bool
    """Whether the gripper is to hold after the motion; else to let go."""


class ArmState(RobotState):
    """
    A robot's state whose position is the middle of the fingers, with what is on the table and in the hand.

    Being a tuple, it compares and unpacks as a ``RobotState``.
    """

    cubes: tuple[Vector3, ...]
    """Centres in the order of the places where they stood at the start, m."""
    held: int
    """Index of the cube in the hand, or ``NOTHING``."""
    load: float
    """Mass that the hand bears, kg: zero while nothing is held or the held cube stands on something."""

    @classmethod
    def of(cls, hand: Vector3, cubes: Sequence[Vector3], held: int, load: float) -> "ArmState":
        """
        Put a state together.

        :param hand: middle of the fingers, m
        :param cubes: centres, m
        :param held: index of the cube in the hand, or ``NOTHING``
        :param load: mass that the hand bears, kg
        """
        state = cls(*hand, 0.0, 0.0, 0.0, False)
        state.cubes, state.held, state.load = tuple(cubes), held, load
        return state


def standing_height(n_below: int) -> float:
    """
    Height of the centre of a cube that stands on others, m.

    :param n_below: how many
    """
    return (n_below + 0.5) * EDGE


def from_left_to_right(world: World) -> list[str]:
    """
    Names of the cubes in the order of their places.

    :param world: at the start of an episode
    """
    return sorted(CUBES, key=lambda name: world.scene[name].centre[1])


class PandaArm(Robot[ArmCommand]):
    """
    What the arms share, which is what a command means.

    The hand goes up, over to the place and down to the height, but no further than to the top cube there, or until the cube
    in the hand stands on something. Then the gripper acts. Two interlocks keep it from what no other decision could mend: it
    closes only around a cube, and lets go only of one that stands.

    :param world: the scene in it holds the cubes
    :param masses: asked at every reset for the masses of the cubes in the order of their places, kg
    """

    name = "panda"
    substep_period = DECISION_PERIOD
    state: ArmState

    def __init__(self, world: World, masses: Callable[[], Sequence[float]]) -> None:
        self.world = world
        self._ask_masses = masses
        self.masses: tuple[float, ...] = ()
        self.places: list[tuple[float, float]] = []
        self.cubes: list[Vector3] = []
        self.names: list[str] = []
        self.held = NOTHING
        self._command = ArmCommand(0, len(HEIGHTS) - 1, False)
        self.state = ArmState.of(AT_REST, (), NOTHING, 0.0)

    def reset(self, x: float, y: float, ground: float, yaw: float) -> ArmState:
        """
        Put the hand somewhere at carrying height, open, and look where the cubes are (see base class).

        :param x: m
        :param y: m
        :param ground: height of the table, which must be 0, m
        :param yaw: unused, the hand always points down
        """
        self.names = from_left_to_right(self.world)
        self.cubes = [self.world.scene[name].centre for name in self.names]
        self.places = [(cx, cy) for cx, cy, _ in self.cubes]
        self.masses = tuple(self._ask_masses())
        self.held = NOTHING
        self.state = ArmState.of((x, y, CARRY_HEIGHT), self.cubes, NOTHING, 0.0)
        return self.state

    def command(self, command: ArmCommand) -> None:
        """
        Set the next motion (see base class).

        :param command: place, height, gripper
        """
        self._command = command

    @abstractmethod
    def substep(self) -> ArmState:
        """Let ``substep_period`` pass (see base class)."""

    def n_standing(self, place: int) -> int:
        """
        Number of cubes at a place, without the one in the hand.

        :param place: its index
        """
        x, y = self.places[place]
        # Nearer to this place than half a cube, so that a cube that was knocked over the edge of another is not counted.
        return sum(
            index != self.held and abs(cx - x) < 0.5 * EDGE and abs(cy - y) < 0.5 * EDGE
            for index, (cx, cy, _) in enumerate(self.cubes)
        )

    def stop_height(self) -> tuple[float, bool]:
        """Where the hand stops, m, and whether the cube in it hangs free there."""
        place, height, _ = self._command
        n_standing = self.n_standing(place)
        wanted = HEIGHTS[height]
        if self.held == NOTHING:
            return max(wanted, standing_height(n_standing - 1)), False
        rest = standing_height(n_standing)
        return max(wanted, rest), wanted > rest

    def within_reach(self, hand: Vector3) -> int:
        """
        Index of the cube between the fingers, or ``NOTHING``.

        :param hand: middle of the fingers, m
        """
        for index, centre in enumerate(self.cubes):
            if math.dist(hand, centre) < REACH:
                return index
        return NOTHING
