"""Depth images that PyBullet renders: with its software renderer, or on a GPU through its EGL plugin."""

import glob
import importlib.util
import math

import numpy as np
import pybullet

from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors.camera import CameraPose, Intrinsics
from bullet_tasks.simulation import Simulation

NEAR_PLANE = 0.01
"""PyBullet draws nothing that is closer than this, m. A camera closer to a wall sees through it."""

_GPU_FILES = ("/dev/nvidia[0-9]*", "/dev/dri/renderD*")
_EGL_MODULE, _EGL_SYMBOL = "eglRenderer", "_eglRendererPlugin"
# TinyRenderer samples pixels at their lower left corners; half a pixel's shift of the image plane makes them centres.
_TINY_SHIFT = 0.5


def gpu_found() -> bool:
    """Whether this machine has a GPU that the EGL plugin could use (PyBullet's wheels bring the plugin for Linux only)."""
    return any(glob.glob(pattern) for pattern in _GPU_FILES) and importlib.util.find_spec(_EGL_MODULE) is not None


class PyBulletDepth:
    """
    Depth images of one kind of camera, rendered by PyBullet in a world of its own, which holds a scene's solid shapes only.

    That world costs about 30 MB. Cylinders are drawn with 24 sides.

    :param intrinsics: of the camera
    :param far: what is further away is not seen and reads as ``far``, m
    :param egl: render on the GPU through EGL instead of with TinyRenderer
    :raises ValueError: if ``far`` is not beyond PyBullet's near plane, or EGL is asked for and there is no GPU
    :raises RuntimeError: if the EGL plugin does not load
    """

    def __init__(self, intrinsics: Intrinsics, far: float, egl: bool = False) -> None:
        if not (far > NEAR_PLANE and math.isfinite(far)):
            raise ValueError(f"`far` must be a finite depth beyond {NEAR_PLANE} m, got {far}.")
        if egl and not gpu_found():
            raise ValueError(
                'The back end "egl" needs a GPU and PyBullet\'s EGL plugin, and at least one of them is not here: use '
                '"compiled", the default, or "tiny".'
            )
        self.intrinsics = intrinsics
        self.far = far
        self._egl = egl
        self._projection = self._projection_matrix()
        self._scene: SceneSpec | None = None
        self._simulation: Simulation | None = None

    def _projection_matrix(self) -> tuple[float, ...]:
        k, shift = self.intrinsics, 0.0 if self._egl else _TINY_SHIFT
        left, right = (shift - k.centre_x) / k.focal_x, (shift + k.width - k.centre_x) / k.focal_x
        bottom, top = (k.centre_y - k.height + shift) / k.focal_y, (k.centre_y + shift) / k.focal_y
        bounds = (NEAR_PLANE * side for side in (left, right, bottom, top))
        return pybullet.computeProjectionMatrix(*bounds, NEAR_PLANE, self.far)

    def reset(self, scene: SceneSpec) -> None:
        """
        Show another scene.

        :param scene: its solid shapes are drawn
        """
        scene = SceneSpec(tuple(shape for shape in scene.shapes if shape.solid), scene.lower_ground)
        if scene == self._scene:
            return
        self.close()
        self._simulation = Simulation()
        self._scene = scene
        if self._egl:
            self._load_plugin(self._simulation)
        scene.build(self._simulation)

    @staticmethod
    def _load_plugin(simulation: Simulation) -> None:
        found = importlib.util.find_spec(_EGL_MODULE)
        if found is None or simulation.client.loadPlugin(found.origin, _EGL_SYMBOL) < 0:
            raise RuntimeError("PyBullet could not load its EGL plugin; is the GPU's EGL library (libEGL) installed?")

    def render(self, pose: CameraPose) -> np.ndarray:
        """
        Take an image.

        :param pose: of the camera
        :return: depth along the optical axis, float32 ``(height, width)``, m, at most ``far``
        :raises RuntimeError: before the first ``reset``
        """
        if self._simulation is None:
            raise RuntimeError("There is no scene to render yet; call `reset` first.")
        eye = (pose.x, pose.y, pose.z)
        ahead, above = pose.moved((1.0, 0.0, 0.0)), pose.moved((0.0, 0.0, 1.0))
        up = tuple(b - a for a, b in zip(eye, above[:3], strict=True))
        view = pybullet.computeViewMatrix(eye, ahead[:3], up)
        width, height = self.intrinsics.width, self.intrinsics.height
        _, _, _, depth, _ = self._simulation.client.getCameraImage(
            width,
            height,
            view,
            self._projection,
            shadow=0,
            renderer=pybullet.ER_BULLET_HARDWARE_OPENGL if self._egl else pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
        )
        buffer = np.asarray(depth, dtype=np.float64).reshape(height, width)
        # The depth buffer is affine in the inverse depth (OpenGL's convention).
        metres = self.far * NEAR_PLANE / (self.far - (self.far - NEAR_PLANE) * buffer)
        return metres.astype(np.float32)

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._simulation is not None:
            self._simulation.close()
        self._simulation, self._scene = None, None
