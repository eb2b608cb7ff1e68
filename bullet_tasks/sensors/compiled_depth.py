"""Depth images that compiled ray casting takes."""

import math

import numpy as np

from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import ray_casting
from bullet_tasks.sensors.camera import CameraPose, Intrinsics
from bullet_tasks.sensors.scene_arrays import SceneArrays, pack


class CompiledDepth:
    """
    Depth images of one kind of camera.

    From inside a solid shape, or below the ground, the depth is 0.

    :param intrinsics: of the camera
    :param far: what is further away is not seen and reads as ``far``, m
    :raises ValueError: if ``far`` is not positive and finite
    """

    def __init__(self, intrinsics: Intrinsics, far: float) -> None:
        if not (far > 0.0 and math.isfinite(far)):
            raise ValueError(f"`far` must be a positive finite depth in metres, got {far}.")
        self.intrinsics = intrinsics
        self.far = far
        self._right, self._up = intrinsics.right, intrinsics.up
        k = intrinsics
        self._lens = (float(k.focal_x), float(k.focal_y), float(k.centre_x), float(k.centre_y))
        self._scene: SceneArrays | None = None

    def reset(self, scene: SceneSpec) -> None:
        """
        Look at another scene.

        :param scene: its solid shapes are seen
        """
        self._scene = pack((scene,))

    def render(self, pose: CameraPose) -> np.ndarray:
        """
        Take an image.

        :param pose: of the camera
        :return: depth along the optical axis, float32 ``(height, width)``, m, at most ``far``
        :raises RuntimeError: before the first ``reset``
        """
        if self._scene is None:
            raise RuntimeError("There is no scene to look at yet; call `reset` first.")
        return self._cast(self._scene, np.array((pose,), dtype=np.float64))[0]

    def render_all(self, scenes: SceneArrays, poses: np.ndarray) -> np.ndarray:
        """
        Take one image in each of several scenes.

        :param scenes: from ``pack``
        :param poses: x, y, z (m), yaw and pitch (rad, nose down positive) of a camera for each scene, ``(n, 5)``
        :return: depth along the optical axis, float32 ``(n, height, width)``, m, at most ``far``
        :raises ValueError: if there is not one pose for every scene
        """
        poses = np.ascontiguousarray(poses, dtype=np.float64)
        wanted = (len(scenes.ground), 5)
        if poses.shape != wanted:
            raise ValueError(f"`poses` must have shape {wanted}, x, y, z, yaw, pitch per scene; got {poses.shape}.")
        return self._cast(scenes, poses)

    def _cast(self, scenes: SceneArrays, poses: np.ndarray) -> np.ndarray:
        images = np.empty((len(poses), self.intrinsics.height, self.intrinsics.width), dtype=np.float32)
        ray_casting.cast(*scenes, poses, self._right, self._up, self._lens, self.far, images)
        return images

    def close(self) -> None:
        """Nothing is held open."""
