"""One PyBullet client with names instead of ids: loading, stepping, contacts, save and restore, pictures."""

import functools
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from bullet_tasks.shapes import Box, Cylinder, Shape, Vector3

Quaternion = tuple[float, float, float, float]
"""A rotation in PyBullet's order: x, y, z, w."""

# Index of the normal force (N) in a record of getContactPoints (PyBullet Quickstart Guide, "getContactPoints").
_NORMAL_FORCE = 9
_NEAR, _FAR = 0.05, 60.0  # m, clipping planes of pictures
# A visual shape has at most 16 parts in PyBullet; 12 crossed boxes look like a cylinder with 24 sides.
_CYLINDER_BOXES = 12
_LIGHT: Vector3 = (-4.0, -6.0, 12.0)


@dataclass(frozen=True)
class Camera:
    """
    Where a picture is taken from.

    :param eye: m
    :param target: the point in the middle of the picture, m
    :param up: direction that points up in the picture
    :param fov: vertical opening angle, degrees
    """

    eye: Vector3
    target: Vector3
    up: Vector3 = (0.0, 0.0, 1.0)
    fov: float = 40.0


class _Client(BulletClient):
    """BulletClient without the line "argv[0]=" that its way of connecting prints for every client."""

    def __init__(self, mode: int) -> None:
        self._client = -1
        self._shapes: dict[str, int] = {}
        self._pid = os.getpid()
        self._client = pybullet.connect(mode)


def quaternion(yaw: float, pitch: float = 0.0) -> Quaternion:
    """
    Rotation about the vertical axis, after one about the axis to the left, in PyBullet's order (x, y, z, w).

    :param yaw: rad
    :param pitch: rad, nose down positive
    """
    s, c = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    if pitch == 0.0:
        return 0.0, 0.0, s, c
    s_pitch, c_pitch = math.sin(0.5 * pitch), math.cos(0.5 * pitch)
    return -s * s_pitch, c * s_pitch, s * c_pitch, c * c_pitch


def _facets(cylinder: Cylinder) -> tuple[Box, ...]:
    """A cylinder for the eye as crossed boxes, because PyBullet's own shades a flat disc like a cone."""
    angle = math.pi / _CYLINDER_BOXES
    half_length = cylinder.radius * math.cos(0.5 * angle)
    half_width = cylinder.radius * math.sin(0.5 * angle)
    return tuple(
        Box(
            f"{cylinder.name}_{i}",
            cylinder.centre,
            (half_length, half_width, cylinder.half_height),
            yaw=i * angle,
            colour=cylinder.colour,
        )
        for i in range(_CYLINDER_BOXES)
    )


class Simulation:
    """
    A physics world of named bodies.

    :param gui: open PyBullet's window instead of running without one
    :raises RuntimeError: if a window is asked for and there is no display to open it on
    """

    def __init__(self, gui: bool = False) -> None:
        # PyBullet ends the whole process when it cannot open its window, so the display is looked for first.
        if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise RuntimeError('render_mode="human" opens a window and needs a display; use render_mode="rgb_array" here.')
        self.client: Any = _Client(pybullet.GUI if gui else pybullet.DIRECT)
        self.closed = False
        self._ids: dict[str, int] = {}
        if gui:
            self.client.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0)
        # What is called in every substep is called without BulletClient, which takes as long to look a function up as a short
        # call takes, and a third of it to pass the client's number by name.
        self._client_id = self.client._client
        self.step: Callable[[], None] = functools.partial(pybullet.stepSimulation, self._client_id)
        """Let a substep pass."""

    def configure(self, substep: float, gravity: float) -> None:
        """
        Set the physics constants.

        :param substep: time that one ``step()`` takes, s
        :param gravity: downward acceleration, m/s^2
        :raises ValueError: if ``substep`` is not positive
        """
        if not substep > 0.0:
            raise ValueError(f"`substep` must be a positive time in seconds, got {substep}.")
        self.client.setTimeStep(substep)
        self.client.setGravity(0.0, 0.0, -gravity)

    def add_body(
        self,
        name: str,
        collision: Shape | None,
        visuals: Sequence[Shape],
        position: Vector3,
        yaw: float = 0.0,
        mass: float = 0.0,
    ) -> int:
        """
        Create one rigid body.

        :param name: unique name
        :param collision: what others collide with (centred on the body), or None for a body that only guides the eye
        :param visuals: what pictures show, each part placed in the body's frame
        :param position: of the body, m
        :param yaw: of the body, rad
        :param mass: kg; 0 for a body that never moves by itself
        :return: PyBullet's id of the body
        :raises ValueError: if the name is taken
        """
        if name in self._ids:
            raise ValueError(f"There is already a body named {name!r} in this simulation.")
        body = self.client.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=-1 if collision is None else self._collision_shape(collision),
            baseVisualShapeIndex=self._visual_shape(visuals),
            basePosition=position,
            baseOrientation=quaternion(yaw),
            # What never moves costs a step half of what it would as a multibody, with equal results.
            useMaximalCoordinates=int(mass == 0.0),
        )
        self._ids[name] = body
        return body

    def _collision_shape(self, shape: Shape) -> int:
        if isinstance(shape, Box):
            return self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=shape.half_extents)
        return self.client.createCollisionShape(pybullet.GEOM_CYLINDER, radius=shape.radius, height=2 * shape.half_height)

    def _visual_shape(self, shapes: Sequence[Shape]) -> int:
        """Several parts become one visual shape, so that a body with many parts costs physics nothing."""
        if not shapes:
            return -1
        boxes = [box for shape in shapes for box in ((shape,) if isinstance(shape, Box) else _facets(shape))]
        return self.client.createVisualShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[box.half_extents for box in boxes],
            rgbaColors=[box.colour for box in boxes],
            visualFramePositions=[box.centre for box in boxes],
            visualFrameOrientations=[quaternion(box.yaw) for box in boxes],
        )

    def body_id(self, name: str) -> int:
        """
        PyBullet's id of a body.

        :param name: its name
        :raises KeyError: if there is none of that name
        """
        try:
            return self._ids[name]
        except KeyError:
            raise KeyError(f"No body {name!r} in this simulation, only {sorted(self._ids)}.") from None

    def place(self, name: str, position: Vector3, yaw: float = 0.0, pitch: float = 0.0) -> None:
        """
        Put a body somewhere, at rest.

        :param name: its name
        :param position: m
        :param yaw: rad
        :param pitch: rad, nose down positive
        """
        body = self.body_id(name)
        self.set_pose(body, position, quaternion(yaw, pitch))
        self.set_velocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def set_pose(self, body: int, position: Vector3, orientation: Quaternion) -> None:
        """
        Put a body somewhere; its velocity stays what it is.

        :param body: PyBullet's id of the body
        :param position: m
        :param orientation: x, y, z, w
        """
        pybullet.resetBasePositionAndOrientation(body, position, orientation, self._client_id)

    def set_velocity(self, body: int, linear: Vector3, angular: Vector3) -> None:
        """
        Give a body a velocity.

        :param body: PyBullet's id of the body
        :param linear: of its centre of mass, m/s
        :param angular: rad/s
        """
        pybullet.resetBaseVelocity(body, linear, angular, self._client_id)

    def pose(self, body: int) -> tuple[Vector3, Quaternion]:
        """
        Where a body is.

        :param body: PyBullet's id of the body
        :return: position (m), orientation (x, y, z, w)
        """
        return pybullet.getBasePositionAndOrientation(body, self._client_id)  # type: ignore[no-any-return]

    def pressed(self, body: int, threshold: float) -> bool:
        """
        Whether anything pressed on a body during the last step.

        :param body: PyBullet's id of the body
        :param threshold: normal force that counts, N
        """
        return any(
            point[_NORMAL_FORCE] > threshold for point in pybullet.getContactPoints(body, physicsClientId=self._client_id)
        )

    def save(self) -> int:
        """
        Remember the poses and velocities of all bodies.

        :return: a handle for ``restore``
        """
        return self.client.saveState()

    def restore(self, handle: int) -> None:
        """
        Go back to a saved state.

        :param handle: from ``save``
        """
        self.client.restoreState(stateId=handle)

    def picture(self, camera: Camera, width: int, height: int) -> np.ndarray:
        """
        Take a picture with PyBullet's software renderer.

        :param camera: where from
        :param width: pixels
        :param height: pixels
        :return: uint8 array ``(height, width, 3)``
        """
        view = self.client.computeViewMatrix(camera.eye, camera.target, camera.up)
        projection = self.client.computeProjectionMatrixFOV(camera.fov, width / height, _NEAR, _FAR)
        _, _, rgba, _, _ = self.client.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=_LIGHT,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
        )
        return np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[:, :, :3].copy()

    def __reduce__(self) -> Any:
        # A copy would have the same client: a step in one would be a step in both.
        raise TypeError(
            "A PyBullet world that is open can be neither copied nor pickled. Make another environment instead, or take "
            'physics="compiled", of which copies are independent as long as no picture has been taken.'
        )

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        # A simulation that is dropped unclosed is disconnected by BulletClient, which knows whose process it is.
        self.client.disconnect()
