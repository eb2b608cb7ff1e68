"""
How many readings a second do the sensors take on one core? Scandots and depth images, against PyBullet's rays and renderer.

Random scenes of 20 boxes, half of them turned, within 6 m of the robot; depth images reach 10 m, so that most boxes are in
range. What is timed is the taking of readings, in CPU time of this process, medians over repetitions in which ours and the
reference take turns. Placing the boxes is not timed, neither ours nor PyBullet's.

Run: ``OMP_NUM_THREADS=1 python benchmarks/sensors.py [--repetitions 5]``
"""

import argparse
import functools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.sensors import CameraPose, DepthCamera, Intrinsics, Scandots
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.sensors.pybullet_depth import PyBulletDepth
from bullet_tasks.sensors.scene_arrays import pack
from bullet_tasks.shapes import Box
from bullet_tasks.simulation import Simulation

N_SCENES, N_POSES, N_BOXES, EXTENT, CLEARING, FAR = 5, 20, 20, 6.0, 1.2, 10.0
LENS = Intrinsics.from_field_of_view(64, 48, math.radians(87.0))
SKY = 20.0
"""m; where vertical rays start, and as far below the ground they end."""


def random_scene(rng: np.random.Generator) -> SceneSpec:
    """Boxes on the ground with a clearing for the robot in the middle."""
    boxes: list[Box] = []
    while len(boxes) < N_BOXES:
        half = rng.uniform(0.1, 0.8, 3)
        x, y = rng.uniform(-EXTENT, EXTENT, 2)
        if math.hypot(x, y) > CLEARING + math.hypot(half[0], half[1]):
            yaw = rng.uniform(-math.pi, math.pi) * (len(boxes) % 2)
            boxes.append(Box(f"box_{len(boxes)}", (x, y, half[2]), tuple(half), yaw=yaw))
    return SceneSpec(tuple(boxes), lower_ground=0.0)


def rate(take: Callable[[Any], object], poses: Sequence[Any], readings: int = 1) -> float:
    """Readings a second of CPU time; ``take`` takes ``readings`` of them for one of ``poses``."""
    take(poses[0])
    begin = time.process_time()
    for pose in poses:
        take(pose)
    return len(poses) * readings / (time.process_time() - begin)


def cast_rays(simulation: Simulation, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Where PyBullet's rays end, as fractions of their lengths."""
    return np.array([hit[2] for hit in simulation.client.rayTestBatch(begin, end)])


def vertical_rays(simulation: Simulation, points: np.ndarray, state: RobotState) -> np.ndarray:
    """Scandots by PyBullet."""
    c, s = math.cos(state.yaw), math.sin(state.yaw)
    x, y = state.x + c * points[:, 0] - s * points[:, 1], state.y + s * points[:, 0] + c * points[:, 1]
    begin, end = (np.column_stack([x, y, np.full(len(x), z)]) for z in (SKY, -SKY))
    return np.clip(state.z - 0.3 - (SKY - 2.0 * SKY * cast_rays(simulation, begin, end)), -2.0, 2.0)


def image_rays(simulation: Simulation, pose: CameraPose) -> np.ndarray:
    """A depth image by PyBullet's rays."""
    eye = np.array(pose[:3])
    ahead, left, above = (np.array(pose.moved(axis)[:3]) - eye for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)))
    rays = ahead - LENS.right[None, :, None] * left + LENS.up[:, None, None] * above
    ends = (eye + FAR * rays).reshape(-1, 3)
    return FAR * cast_rays(simulation, np.tile(eye, (len(ends), 1)), ends)


def one_repetition(rng: np.random.Generator) -> list[tuple[str, str, float, float]]:
    """Name, unit, and rates of ours and the reference, for every comparison and scene."""
    scandots, caster, tiny = Scandots(), CompiledDepth(LENS, FAR), PyBulletDepth(LENS, FAR)
    cameras = [DepthCamera(back_end=back_end) for back_end in ("compiled", "tiny")]
    rates = []
    for _ in range(N_SCENES):
        scene = random_scene(rng)
        for sensor in (scandots, *cameras):
            sensor.reset(scene, rng)
        caster.reset(scene)
        tiny.reset(scene)
        simulation = Simulation()
        scene.build(simulation)
        yaws, pitches = rng.uniform(-math.pi, math.pi, N_POSES), rng.uniform(-0.1, 0.3, N_POSES)
        poses = [CameraPose(0.0, 0.0, 0.35, yaw, pitch) for yaw, pitch in zip(yaws, pitches, strict=True)]
        # Among the boxes, where the terrain has heights.
        xy = rng.uniform(-0.5 * EXTENT, 0.5 * EXTENT, (N_POSES, 2))
        states = [RobotState(x, y, 0.3, yaw, 0.0, 0.0, False) for (x, y), yaw in zip(xy, yaws, strict=True)]
        together = functools.partial(caster.render_all, pack([scene] * N_POSES))

        rays = rate(functools.partial(vertical_rays, simulation, scandots.points), states)
        rates.append(("scandots, 132 points / rayTestBatch", "readings/s", rate(scandots.read, states * 10), rays))
        rays = rate(functools.partial(image_rays, simulation), poses[:4])
        drawn = rate(tiny.render, poses)
        cast = rate(caster.render, poses * 10)
        rates.append(("depth 64x48 / TinyRenderer", "frames/s", cast, drawn))
        rates.append(("depth 64x48 / rayTestBatch", "frames/s", cast, rays))
        batched = rate(together, [np.array(poses)] * 10, readings=N_POSES)
        rates.append((f"depth 64x48, {N_POSES} at once / TinyRenderer", "frames/s", batched, drawn))
        read, read_tiny = (rate(camera.read, states) for camera in cameras)
        rates.append(("release's camera, 2 m, as uint8 / TinyRenderer", "readings/s", read, read_tiny))
        simulation.close()
    for camera in cameras:
        camera.close()
    tiny.close()
    return rates


def run(repetitions: int = 5) -> list[dict[str, Any]]:
    """
    Measure.

    :param repetitions: medians are over so many times five scenes
    :return: a row for every comparison: ``name``, ``ours``, ``reference``, ``unit``, ``ratio`` (ours / reference)
    :raises ValueError: if there is no repetition
    """
    if repetitions < 1:
        raise ValueError(f"`repetitions` must be at least 1, got {repetitions}.")
    rng = np.random.default_rng(0)
    measured: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(repetitions):
        for name, unit, ours, reference in one_repetition(rng):
            measured.setdefault((name, unit), []).append((ours, reference))
    rows = []
    for (name, unit), pairs in measured.items():
        ours, reference = (statistics.median(values) for values in zip(*pairs, strict=True))
        rows.append({"name": name, "ours": ours, "reference": reference, "unit": unit, "ratio": ours / reference})
    return rows


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=5)
    arguments = parser.parse_args()
    print(f"{'':52}{'ours':>12}{'reference':>12}{'ratio':>9}")
    for row in run(arguments.repetitions):
        print(f"{row['name']:52}{row['ours']:>12,.0f}{row['reference']:>12,.0f}{row['ratio']:>9.0f}  {row['unit']}")


if __name__ == "__main__":
    main()
