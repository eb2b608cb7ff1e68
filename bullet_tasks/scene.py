"""A scene as data: named shapes that physics, pictures and sensors all read."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bullet_tasks import kernels
from bullet_tasks.shapes import Box, Colour, Shape, Vector3

if TYPE_CHECKING:
    from bullet_tasks.simulation import Simulation

# Where shapes go that an episode does not use: far below everything, so that no robot and no camera meets them.
PARKED: Vector3 = (0.0, 0.0, -100.0)

_GROUND_COLOUR: Colour = (0.21, 0.25, 0.31, 1.0)
_GROUND_HALF_SIZE = 20.0  # m, only for the eye
_GROUND_HALF_THICKNESS = 0.01  # m


def _elsewhere(shape: Shape, centre: Vector3, yaw: float) -> Shape:
    """``dataclasses.replace`` at a tenth of its time, which is what most of a reset would go into."""
    x, y, z = centre
    if not math.isfinite(x + y + z + yaw):
        return dataclasses.replace(shape, centre=centre, yaw=yaw)
    moved: Shape = object.__new__(type(shape))
    moved.__dict__.update(shape.__dict__, centre=centre, yaw=yaw)
    return moved


def _packed_row(shape: Shape) -> tuple[float, ...]:
    """Columns as in ``kernels``."""
    x, y, z = shape.centre
    if isinstance(shape, Box):
        half_x, half_y, half_z = shape.half_extents
        cos, sin, is_round = math.cos(shape.yaw), math.sin(shape.yaw), False
    else:
        half_x, half_y, half_z = shape.radius, shape.radius, shape.half_height
        cos, sin, is_round = 1.0, 0.0, True
    return (x, y, cos, sin, half_x, half_y, z - half_z, z + half_z, is_round, shape.solid, shape.floor)


def _packed(shapes: Sequence[Shape]) -> np.ndarray:
    return np.array([_packed_row(shape) for shape in shapes], dtype=np.float64).reshape(-1, kernels.N_COLUMNS)


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
        self._remember({name: i for i, name in enumerate(names)}, _packed(self.shapes))

    def _remember(self, rows: dict[str, int], packed: np.ndarray) -> None:
        # The fields are all that a scene is; these only make them quick to use.
        object.__setattr__(self, "_rows", rows)
        object.__setattr__(self, "_packed", packed)

    @property
    def packed(self) -> np.ndarray:
        """The shapes as the functions of ``kernels`` take them, ``(n_shapes, kernels.N_COLUMNS)``; not to be written to."""
        return self._packed  # type: ignore[attr-defined]

    def __getitem__(self, name: str) -> Shape:
        """
        Look a shape up.

        :param name: its name
        :raises KeyError: if there is none of that name
        """
        return self.shapes[self._row(name)]

    def _row(self, name: str) -> int:
        row = self._rows.get(name)  # type: ignore[attr-defined]
        if row is None:
            raise KeyError(f"No shape {name!r} in this scene, only {[shape.name for shape in self.shapes]}.")
        return row

    def moved(self, placements: Mapping[str, tuple[Vector3, float]]) -> "SceneSpec":
        """
        The same scene with some shapes elsewhere.

        :param placements: name -> (centre in m, yaw in rad)
        :raises KeyError: if a name is unknown
        :raises ValueError: if a placement is not made of finite numbers
        """
        shapes, rows = list(self.shapes), [self._row(name) for name in placements]
        for row, (centre, yaw) in zip(rows, placements.values(), strict=True):
            shapes[row] = _elsewhere(shapes[row], centre, yaw)
        packed = self.packed.copy()
        packed[rows] = _packed([shapes[row] for row in rows])
        # Names and the lower ground are those of a scene that has been checked.
        scene = object.__new__(SceneSpec)
        object.__setattr__(scene, "shapes", tuple(shapes))
        object.__setattr__(scene, "lower_ground", self.lower_ground)
        scene._remember(self._rows, packed)  # type: ignore[attr-defined]
        return scene

    def ground_height(self, x: float, y: float) -> float:
        """
        Height of what would carry a robot at a point: the highest floor there, else the lower ground.

        :param x: world x, m
        :param y: world y, m
        :return: height, m (``lower_ground`` where no floor is, so possibly minus infinity)
        """
        return kernels.ground_height(self._packed, self.lower_ground, x, y)  # type: ignore[attr-defined]

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
