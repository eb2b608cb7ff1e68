"""Named boxes and cylinders as data: what a scene is made of, whoever reads it (physics, pictures, ray casters)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector3 = tuple[float, float, float]
Colour = tuple[float, float, float, float]

GREY: Colour = (0.62, 0.64, 0.68, 1.0)


def _check_numbers(owner: str, field: str, values: Sequence[float], length: int, positive: bool = False) -> None:
    """
    Reject anything but ``length`` finite (and, on request, positive) numbers.

    :param owner: name of the shape, for the message
    :param field: name of the field, for the message
    :param values: the numbers given
    :param length: how many are expected
    :param positive: whether each must be greater than 0
    :raises ValueError: if they are not what was asked for
    """
    wanted = f"{length} finite{' positive' if positive else ''} number(s)"
    if len(values) != length or not all(math.isfinite(v) and (v > 0.0 or not positive) for v in values):
        raise ValueError(f"Shape {owner!r}: `{field}` must be {wanted}, got {tuple(values)!r}.")


@dataclass(frozen=True)
class Box:
    """
    A box that may be turned about the vertical axis.

    :param name: unique name in its scene
    :param centre: centre, m (in the world, or in the body's frame for a part of a robot)
    :param half_extents: half of each edge length, m
    :param yaw: rotation about the vertical axis, rad
    :param colour: red, green, blue, opacity, each in [0, 1]
    :param solid: whether things collide with it; what only guides the eye is not solid
    :param floor: whether its top carries a robot
    """

    name: str
    centre: Vector3
    half_extents: Vector3
    yaw: float = 0.0
    colour: Colour = GREY
    solid: bool = True
    floor: bool = False

    def __post_init__(self) -> None:
        _check_numbers(self.name, "centre", self.centre, 3)
        _check_numbers(self.name, "half_extents", self.half_extents, 3, positive=True)
        _check_numbers(self.name, "yaw", (self.yaw,), 1)
        _check_numbers(self.name, "colour", self.colour, 4)

    @property
    def top(self) -> float:
        """Height of the upper face, m."""
        return self.centre[2] + self.half_extents[2]

    def covers(self, x: float, y: float) -> bool:
        """
        Whether the vertical line through (x, y) meets the box; its rim counts.

        :param x: world x, m
        :param y: world y, m
        """
        dx, dy = x - self.centre[0], y - self.centre[1]
        if self.yaw:
            c, s = math.cos(self.yaw), math.sin(self.yaw)
            dx, dy = c * dx + s * dy, c * dy - s * dx
        return abs(dx) <= self.half_extents[0] and abs(dy) <= self.half_extents[1]


@dataclass(frozen=True)
class Cylinder:
    """
    An upright cylinder.

    :param name: unique name in its scene
    :param centre: centre, m (in the world, or in the body's frame for a part of a robot)
    :param radius: m
    :param half_height: half of the height, m
    :param yaw: rotation about the vertical axis, rad (only the pose of the body that is built from it)
    :param colour: red, green, blue, opacity, each in [0, 1]
    :param solid: whether things collide with it; what only guides the eye is not solid
    :param floor: whether its top carries a robot
    """

    name: str
    centre: Vector3
    radius: float
    half_height: float
    yaw: float = 0.0
    colour: Colour = GREY
    solid: bool = True
    floor: bool = False

    def __post_init__(self) -> None:
        _check_numbers(self.name, "centre", self.centre, 3)
        _check_numbers(self.name, "radius and half_height", (self.radius, self.half_height), 2, positive=True)
        _check_numbers(self.name, "yaw", (self.yaw,), 1)
        _check_numbers(self.name, "colour", self.colour, 4)

    @property
    def top(self) -> float:
        """Height of the upper face, m."""
        return self.centre[2] + self.half_height

    def covers(self, x: float, y: float) -> bool:
        """
        Whether the vertical line through (x, y) meets the cylinder; its rim counts.

        :param x: world x, m
        :param y: world y, m
        """
        return math.hypot(x - self.centre[0], y - self.centre[1]) <= self.radius


Shape = Box | Cylinder
