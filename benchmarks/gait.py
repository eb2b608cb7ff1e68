"""
How well the quadruped walks on its legs: falls under pushes, errors of speed and pitch, stairs, and how fast it is computed.

``python -m benchmarks.gait``: about 2 minutes on a quiet core.
"""

import argparse
import math
import time

import numpy as np

from benchmarks.calibrate_quadruped import DECISION, FLOOR, MAX_TURN
from benchmarks.harness import TARGETS, Row, Tables, show, target
from bullet_tasks.robots.quadruped import SUBSTEP, QuadrupedCommand, make_quadruped
from bullet_tasks.robots.walking_quadruped import WalkingQuadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

SPEED_ERROR, PITCH_ERROR, REAL_TIME = 0.05, 0.03, 60.0
"""Bars of the project: m/s, rad, seconds of walking in a second."""
_PUSH, _PUSH_EVERY = 0.3, 16  # m/s, decisions (4 s)
_TURN_EVERY, _PITCH_EVERY = 12, 8  # decisions (3 s, 2 s)
_MAX_PITCH = 0.3  # rad
_SPEED = 0.5  # m/s, the paper's
_MEAN_OVER = 8  # substeps (0.4 s): the speed within a stride is not what is commanded
_SETTLED = 4  # decisions after a change of pitch until it counts


def stairs(n_steps: int, rise: float, run: float) -> SceneSpec:
    """
    Stairs ahead of a platform, which lead up, or down if ``rise`` is negative, to another one.

    :param n_steps: number of steps
    :param rise: of a step, m
    :param run: depth of a step, m
    """
    floors = []
    for i in range(n_steps + 1):
        near = 1.0 + run * (i - 1) if i else -5.0
        far = 10.0 if i == n_steps else 1.0 + run * i
        top = rise * i
        floors.append(Box(f"step_{i}", (0.5 * (near + far), 0.0, top - 1.0), (0.5 * (far - near), 3.0, 1.0), floor=True))
    return SceneSpec(tuple(floors))


TERRAINS = {
    "one step up, 5 cm": stairs(1, 0.05, 0.3),
    "one step down, 5 cm": stairs(1, -0.05, 0.3),
    "5 steps up, 8 cm": stairs(5, 0.08, 0.3),
    "5 steps down, 8 cm": stairs(5, -0.08, 0.3),
}


def flat(physics: str, n_trials: int, seconds: float, push: float, seed: int = 0) -> dict[str, float]:
    """
    Walk on flat ground with turns, changes of pitch and pushes.

    :param physics: of the robot
    :param n_trials: number of trials
    :param seconds: length of a trial, s
    :param push: change of velocity in any direction, every 4 s, m/s
    :param seed: of the commands
    :return: ``falls``, ``speed_error`` (RMS, m/s), ``pitch_error`` (RMS, rad), ``real_time``
    """
    rng = np.random.default_rng(seed)
    world = World(FLOOR)
    robot = make_quadruped(world, physics)
    assert isinstance(robot, WalkingQuadruped)
    falls, speed_errors, pitch_errors, walked = 0, [], [], 0.0
    begin = time.process_time()
    for _ in range(n_trials):
        robot.reset(0.0, 0.0, 0.0, 0.0, float(rng.random()))
        heading = pitch = 0.0
        speeds: list[float] = []
        for decision in range(round(seconds / SUBSTEP / DECISION)):
            if decision % _TURN_EVERY == _TURN_EVERY - 1:
                heading += rng.uniform(-2.0, 2.0) * MAX_TURN
            if decision % _PITCH_EVERY == 0:
                pitch = rng.uniform(-_MAX_PITCH, _MAX_PITCH)
            if push and decision % _PUSH_EVERY == _PUSH_EVERY - 1:
                angle = rng.uniform(0.0, math.tau)
                robot.push(push * math.cos(angle), push * math.sin(angle))
            robot.command(QuadrupedCommand(_SPEED, heading, pitch))
            for _ in range(DECISION):
                state = robot.substep()
                # Along the trunk: a push to the side is no error of the speed.
                speeds.append(math.cos(state.yaw) * state.vx + math.sin(state.yaw) * state.vy)
                if decision % _PITCH_EVERY >= _SETTLED:
                    pitch_errors.append(robot.pitch - pitch)
            walked += SUBSTEP * DECISION
            if robot.fallen:
                falls += 1
                break
        smooth = np.convolve(speeds, np.ones(_MEAN_OVER) / _MEAN_OVER, mode="valid")[20:]
        speed_errors += (smooth - _SPEED).tolist()
    spent = time.process_time() - begin
    world.close()
    return {
        "falls": float(falls),
        "speed_error": float(np.sqrt(np.mean(np.square(speed_errors)))),
        "pitch_error": float(np.sqrt(np.mean(np.square(pitch_errors)))),
        "real_time": walked / spent,
    }


def crossings(physics: str, scene: SceneSpec, n_trials: int, far: float = 3.5, seconds: float = 10.0) -> int:
    """
    How often the robot gets over stairs.

    :param physics: of the robot
    :param scene: with stairs ahead
    :param n_trials: number of trials
    :param far: where the other side is, m
    :param seconds: time for it, s
    """
    rng = np.random.default_rng(0)
    world = World(scene)
    robot = make_quadruped(world, physics)
    assert isinstance(robot, WalkingQuadruped)
    crossed = 0
    for _ in range(n_trials):
        y = float(rng.uniform(-0.3, 0.3))
        robot.reset(0.0, y, 0.0, 0.0, float(rng.random()))
        for _ in range(round(seconds / SUBSTEP / DECISION)):
            robot.command(QuadrupedCommand(_SPEED, math.atan2(y - robot.state.y, 1.0)))
            for _ in range(DECISION):
                robot.substep()
            if robot.fallen or robot.state.x > far:
                break
        crossed += robot.state.x > far and not robot.fallen
    world.close()
    return crossed


def run(physics: str = "full", n_trials: int = 50, seconds: float = 10.0, n_stairs: int = 10) -> Tables:
    """
    All measurements.

    :param physics: of the robot
    :param n_trials: on flat ground, without and with pushes
    :param seconds: length of each, s
    :param n_stairs: trials of every kind of stairs
    """
    calm, pushed = (flat(physics, n_trials, seconds, push) for push in (0.0, _PUSH))
    table: list[Row] = [
        {"what": f"{n_trials} trials of {seconds:g} s, {name}", **found}
        for name, found in (("no pushes", calm), (f"pushes of {_PUSH} m/s", pushed))
    ]
    steps: list[Row] = [
        {"what": name, "crossed": crossings(physics, scene, n_stairs), "of": n_stairs} for name, scene in TERRAINS.items()
    ]
    targets = [
        target(f"falls in {n_trials} trials with pushes, {physics}", pushed["falls"], at_most=0.0),
        target(f"RMS error of the speed, {physics} (m/s)", calm["speed_error"], at_most=SPEED_ERROR),
        target(f"RMS error of the pitch, {physics} (rad)", calm["pitch_error"], at_most=PITCH_ERROR),
    ]
    if physics == "full":
        targets.append(target("times real time on one core, full", calm["real_time"], at_least=REAL_TIME))
    return {f"Walking, {physics}": table, f"Stairs, {physics}": steps, TARGETS: targets}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--physics", default="full", choices=("full", "full_accurate"))
    parser.add_argument("-n", type=int, default=50, help="trials on flat ground")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each")
    parser.add_argument("--stairs", type=int, default=10, help="trials of every kind of stairs")
    parser.add_argument("--markdown", action="store_true", help="print tables as Markdown")
    options = parser.parse_args()
    for title, table in run(options.physics, options.n, options.seconds, options.stairs).items():
        print("\n" + show(title, table, options.markdown), flush=True)


if __name__ == "__main__":
    main()
