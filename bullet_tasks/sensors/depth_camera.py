"""A depth camera on a body: its images are the ``target`` observation, ready for Stable-Baselines3."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors.base import Sensor
from bullet_tasks.sensors.camera import RELEASE, CameraPose, Intrinsics
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.sensors.pybullet_depth import PyBulletDepth
from bullet_tasks.shapes import Vector3

BACK_ENDS = ("compiled", "tiny", "egl")
"""Who takes the images: our ray caster, PyBullet's software renderer (the reference), PyBullet on a GPU."""

_WHITE = 255
# In updates; a reading is due for an update that is less than this away, as periods are not exact in binary.
_DUE = 1e-6


@dataclass(frozen=True)
class DepthNoise:
    """
    What is wrong with images; by default nothing.

    :param deviation: standard deviation of Gaussian noise on every depth that is measured, i.e. less than ``far``, m
    :param dropout: probability that a pixel measures nothing; it reads 0
    :param latency: a reading is the image taken this many images ago, or the episode's first
    :raises ValueError: if a number is not a possible choice
    """

    deviation: float = 0.0
    dropout: float = 0.0
    latency: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.deviation < math.inf:
            raise ValueError(f"`deviation` must be a finite length in metres, 0 or more, got {self.deviation}.")
        if not 0.0 <= self.dropout <= 1.0:
            raise ValueError(f"`dropout` must be a probability in [0, 1], got {self.dropout}.")
        if self.latency != int(self.latency) or self.latency < 0:
            raise ValueError(f"`latency` must be a whole number of images, 0 or more, got {self.latency}.")


class DepthCamera(Sensor):
    """
    Depth images, uint8 ``(1, height, width)``: 0 for ``near`` or less, 255 for ``far`` or more, linear between.

    Depth is measured along the optical axis. The camera sees the scene's solid shapes and the lower ground: neither its own
    robot nor what only guides the eye, such as a goal's marker. A camera within a shape sees black, except with PyBullet's
    renderers, which look through a wall that is closer than 1 cm.

    Defaults are the authors' release's camera, but for its random pitch of +-1 degree.

    :param intrinsics: size of the images and directions of their pixels
    :param position: of the camera in the frame of the body that carries it (forward, left, up), m
    :param pitch: of the camera against the body, rad, nose down positive
    :param near: depth that reads as 0, m
    :param far: depth that reads as 255, m
    :param noise: what is wrong with images
    :param update_period: an image is taken once in this time and kept until the next, s
    :param read_period: time between two readings, i.e. the task's decision period, s; if it is no shorter than
        ``update_period``, every reading is an image of the moment
    :param back_end: one of ``BACK_ENDS``; ``"egl"`` is there only if a GPU is
    :raises ValueError: if an argument is not a possible choice
    """

    def __init__(
        self,
        intrinsics: Intrinsics = RELEASE,
        position: Vector3 = (0.27, 0.0, 0.03),
        pitch: float = 0.0,
        near: float = 0.0,
        far: float = 2.0,
        noise: DepthNoise | None = None,
        update_period: float = 0.1,
        read_period: float = 0.25,
        back_end: str = "compiled",
    ) -> None:
        if len(position) != 3 or not all(map(math.isfinite, (*position, pitch))):
            raise ValueError(f"The camera's place must be 3 finite lengths and an angle, got {position} and {pitch}.")
        if not 0.0 <= near < far < math.inf:
            raise ValueError(f"Depths must be 0 <= `near` < `far`, finite, in metres, got {near} and {far}.")
        for name, value in (("update_period", update_period), ("read_period", read_period)):
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"`{name}` must be a positive finite time in seconds, got {value}.")
        if back_end not in BACK_ENDS:
            raise ValueError(f"Unknown back end {back_end!r}; known: {BACK_ENDS}.")
        self.intrinsics = intrinsics
        self.position = position
        self.pitch = pitch
        self.near = near
        self.far = far
        self.noise = noise or DepthNoise()
        self.space = spaces.Box(0, _WHITE, (1, intrinsics.height, intrinsics.width), np.uint8)
        self._updates_per_reading = read_period / update_period
        self._renderer: CompiledDepth | PyBulletDepth
        if back_end == "compiled":
            self._renderer = CompiledDepth(intrinsics, far)
        else:
            self._renderer = PyBulletDepth(intrinsics, far, egl=back_end == "egl")
        self._rng = np.random.default_rng(0)
        self._images: deque[np.ndarray] = deque(maxlen=self.noise.latency + 1)
        self._readings = 0
        self._updates = 0

    def reset(self, scene: SceneSpec, rng: np.random.Generator) -> None:
        """
        Take the scene of an episode (see base class).

        :param scene: the world of this episode
        :param rng: source of all randomness; the task's own draws do not depend on whether there is noise
        """
        self._renderer.reset(scene)
        self._rng = rng.spawn(1)[0]
        self._images.clear()
        self._readings, self._updates = 0, 0

    def read(self, state: RobotState) -> np.ndarray:
        """
        The image that the camera shows now (see base class).

        :param state: of the robot that carries the camera
        :return: uint8 ``(1, height, width)``
        :raises RuntimeError: before the first ``reset``
        """
        updates = 1 + int(self._readings * self._updates_per_reading + _DUE)
        if updates > self._updates:
            self._images.append(self._image(self.depth(CameraPose(state.x, state.y, state.z, state.yaw, state.pitch))))
        self._readings, self._updates = self._readings + 1, updates
        return self._images[0].copy()

    def depth(self, body: CameraPose) -> np.ndarray:
        """
        Measure without noise, now.

        :param body: pose of the body that carries the camera, whichever it is
        :return: depth, float32 ``(height, width)``, m, at most ``far``
        :raises RuntimeError: before the first ``reset``
        """
        return self._renderer.render(body.moved(self.position, self.pitch))

    def metres(self, reading: np.ndarray) -> np.ndarray:
        """
        The depths that an image stands for, to within half of a step of (``far`` - ``near``) / 255.

        :param reading: uint8, any shape
        :return: float32, the same shape, m
        """
        return (self.near + reading * ((self.far - self.near) / _WHITE)).astype(np.float32)

    def _image(self, depth: np.ndarray) -> np.ndarray:
        noise = self.noise
        if noise.deviation:
            measured = depth < self.far
            depth[measured] += self._rng.normal(0.0, noise.deviation, depth.shape)[measured]
        scale = np.float32(_WHITE / (self.far - self.near))
        levels = np.clip((depth - np.float32(self.near)) * scale + np.float32(0.5), 0.0, np.float32(_WHITE))
        image = levels.astype(np.uint8)
        if noise.dropout:
            image[self._rng.random(depth.shape) < noise.dropout] = 0
        return image[None]

    def close(self) -> None:
        """Free what a renderer holds; a second call does nothing."""
        self._renderer.close()
