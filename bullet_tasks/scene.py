"""A scene as data: named shapes that physics, pictures and ray casters all read."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bullet_tasks.shapes import Box, Colour, Shape, Vector3

if TYPE_CHECKING:
    from bullet_tasks.simulation import Simulation

# Where shapes go that an episode does not use: far below everything, so that no robot and no camera meets them.
PARKED: Vector3 = (0.0, 0.0, -100.0)

_GROUND_COLOUR: Colour = (0.21, 0.25, 0.31, 1.0)
_GROUND_HALF_SIZE = 20.0  # m, only for the eye
_GROUND_HALF_THICKNESS = 0.01  # m


@dataclass(frozen=True)
class SceneSpec:
    """
    Everything in a world except the robot.

    :param shapes: boxes and cylinders, each with a name of its own
    :param lower_ground: height of the ground beside all floors, m; minus infinity if there is none
    """

    shapes: tuple[Shape, ...]
    lower_ground: float = -math.inf

    def __post_init__(self) -> None:
        names = [shape.name for shape in self.shapes]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"Shape names must be unique in a scene, but {repeated} occur(s) more than once.")
        if math.isnan(self.lower_ground) or self.lower_ground == math.inf:
            raise ValueError(f"`lower_ground` must be a height in metres or minus infinity, got {self.lower_ground}.")
        # Highest floor first: the first one that covers a point is its support.
        floors = sorted((shape for shape in self.shapes if shape.floor), key=lambda shape: -shape.top)
        object.__setattr__(self, "_floors", tuple((shape.covers, shape.top) for shape in floors))

    def __getitem__(self, name: str) -> Shape:
        """
        Look a shape up.

        :param name: its name
        :raises KeyError: if there is none of that name
        """
        for shape in self.shapes:
            if shape.name == name:
                return shape
        raise KeyError(f"No shape {name!r} in this scene, only {[shape.name for shape in self.shapes]}.")

    def moved(self, placements: Mapping[str, tuple[Vector3, float]]) -> "SceneSpec":
        """
        The same scene with some shapes elsewhere.

        :param placements: name -> (centre in m, yaw in rad)
        :raises KeyError: if a name is unknown
        """
        for name in placements:
            self[name]
        shapes = tuple(
            dataclasses.replace(shape, centre=placements[shape.name][0], yaw=placements[shape.name][1])
            if shape.name in placements
            else shape
            for shape in self.shapes
        )
        return SceneSpec(shapes, self.lower_ground)

    def ground_height(self, x: float, y: float) -> float:
        """
        Height of what would carry a robot at a point: the highest floor there, else the lower ground.

        :param x: world x, m
        :param y: world y, m
        :return: height, m (``lower_ground`` where no floor is, so possibly minus infinity)
        """
        for covers, top in self._floors:  # type: ignore[attr-defined]
            if covers(x, y):
                return top
        return self.lower_ground

    def build(self, simulation: "Simulation") -> None:
        """
        Create a body of the same name for every shape.

        :param simulation: where to create them
        """
        for shape in self.shapes:
            # A body's parts are given in the body's own frame.
            part = dataclasses.replace(shape, centre=(0.0, 0.0, 0.0), yaw=0.0)
            simulation.add_body(
                shape.name, collision=part if shape.solid else None, visuals=(part,), position=shape.centre, yaw=shape.yaw
            )
        if math.isfinite(self.lower_ground):
            slab = Box(
                "lower_ground",
                (0.0, 0.0, 0.0),
                (_GROUND_HALF_SIZE, _GROUND_HALF_SIZE, _GROUND_HALF_THICKNESS),
                colour=_GROUND_COLOUR,
            )
            height = self.lower_ground - _GROUND_HALF_THICKNESS
            simulation.add_body(slab.name, collision=slab, visuals=(slab,), position=(0.0, 0.0, height))
