"""Sensors: what a robot can perceive of the scene; their readings are the ``target`` observation."""

from bullet_tasks.sensors.base import Sensor
from bullet_tasks.sensors.camera import CameraPose, Intrinsics
from bullet_tasks.sensors.depth_camera import DepthCamera, DepthNoise
from bullet_tasks.sensors.scandots import Scandots

__all__ = ["CameraPose", "DepthCamera", "DepthNoise", "Intrinsics", "Scandots", "Sensor"]
