"""What a camera is, apart from what it sees: where it looks from, and which way each pixel looks."""

import dataclasses
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bullet_tasks.shapes import Vector3


class CameraPose(NamedTuple):
    """
    Where a camera is and how it looks: level or pitched, never rolled.

    The camera's axes are forward, left and up.
    """

    x: float
    """m"""
    y: float
    """m"""
    z: float
    """m"""
    yaw: float
    """rad"""
    pitch: float = 0.0
    """rad, nose down positive"""

    def moved(self, offset: Vector3, pitch: float = 0.0) -> "CameraPose":
        """
        The pose of what is fixed to a body that has this pose.

        :param offset: where it is fixed, in the body's frame (forward, left, up), m
        :param pitch: against the body, rad, nose down positive
        """
        forward, left, up = offset
        level = math.cos(self.pitch) * forward + math.sin(self.pitch) * up
        rise = math.cos(self.pitch) * up - math.sin(self.pitch) * forward
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + c * level - s * left, self.y + s * level + c * left
        return CameraPose(x, y, self.z + rise, self.yaw, self.pitch + pitch)


@dataclass(frozen=True)
class Intrinsics:
    """
    A pinhole camera: the pixel in row i and column j looks through the point (j + 1/2, i + 1/2) of the image plane.

    :param width: pixels
    :param height: pixels
    :param focal_x: focal length in pixel widths
    :param focal_y: focal length in pixel heights
    :param centre_x: where the optical axis meets the image, pixel widths from the left rim
    :param centre_y: the same, pixel heights from the upper rim
    :raises ValueError: if a size or focal length is not positive, or a number not finite
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float

    def __post_init__(self) -> None:
        for name, size in (("width", self.width), ("height", self.height)):
            if size != int(size) or size < 1:
                raise ValueError(f"`{name}` must be a whole number of at least one pixel, got {size}.")
        for name, focal in (("focal_x", self.focal_x), ("focal_y", self.focal_y)):
            if not (focal > 0.0 and math.isfinite(focal)):
                raise ValueError(f"`{name}` must be positive and finite, in pixels, got {focal}.")
        if not (math.isfinite(self.centre_x) and math.isfinite(self.centre_y)):
            raise ValueError(f"The optical axis must meet the image somewhere, got ({self.centre_x}, {self.centre_y}).")

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal: float) -> "Intrinsics":
        """
        A camera with square pixels and a centred axis.

        :param width: pixels
        :param height: pixels
        :param horizontal: opening angle from the left to the right rim, rad
        :raises ValueError: if the angle is not between 0 and pi
        """
        if not 0.0 < horizontal < math.pi:
            raise ValueError(f"`horizontal` must be an angle between 0 and pi rad, got {horizontal}.")
        focal = 0.5 * width / math.tan(0.5 * horizontal)
        return cls(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def cropped(self, left: int = 0, right: int = 0, top: int = 0, bottom: int = 0) -> "Intrinsics":
        """
        The camera without some rows and columns at its rims.

        :param left: columns
        :param right: columns
        :param top: rows
        :param bottom: rows
        :raises ValueError: if nothing is left
        """
        return dataclasses.replace(
            self,
            width=self.width - left - right,
            height=self.height - top - bottom,
            centre_x=self.centre_x - left,
            centre_y=self.centre_y - top,
        )

    def resized(self, width: int, height: int) -> "Intrinsics":
        """
        The same view in another number of pixels.

        :param width: pixels
        :param height: pixels
        """
        x, y = width / self.width, height / self.height
        return Intrinsics(width, height, x * self.focal_x, y * self.focal_y, x * self.centre_x, y * self.centre_y)

    @property
    def right(self) -> np.ndarray:
        """How far each column looks to the right, per unit of depth, float32 ``(width,)``."""
        return ((np.arange(self.width) + 0.5 - self.centre_x) / self.focal_x).astype(np.float32)

    @property
    def up(self) -> np.ndarray:
        """How far each row looks upwards, per unit of depth, float32 ``(height,)``."""
        return ((self.centre_y - np.arange(self.height) - 0.5) / self.focal_y).astype(np.float32)


RELEASE = Intrinsics.from_field_of_view(106, 42, math.radians(87.0)).cropped(left=4, right=4, bottom=2).resized(87, 58)
"""The authors' release's camera: 106 x 42 pixels, cropped, resized to 87 x 58. The resizing is bicubic
there; here the pixels are cast as they are."""

SMALL = RELEASE.resized(48, 36)
"""The same view in a third of the pixels: at 1.5 m, 5.5 cm across and 3 cm up and down. Stable-Baselines3's own
networks take no image with fewer than 36 rows or columns."""

LENSES = {"small": SMALL, "release": RELEASE}
"""By the names that a configuration file or a command line can give."""
