"""
What the quadruped on its legs does beside what the body without legs does: ``python -m benchmarks.calibrate_quadruped``.

The body without legs is the model that policies are trained with, so the gait is tuned towards it, not the other way round.
"""

import argparse
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Row, Tables, show
from bullet_tasks.robots.base import Robot
from bullet_tasks.robots.quadruped import BODY_HEIGHT, BODY_RADIUS, SUBSTEP, WALKING_SPEED, QuadrupedCommand, make_quadruped
from bullet_tasks.robots.walking_quadruped import WalkingQuadruped
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

DECISION = 5
"""Substeps that a command holds: 0.25 s, the tasks' decision period."""
MAX_TURN = math.pi / 4.0
"""Greatest turn of a command, rad, as in the tasks."""
FLOOR = SceneSpec((Box("floor", (0.0, 0.0, -0.5), (50.0, 50.0, 0.5), floor=True),))
START_UP = 4
"""Decisions straight ahead before anything is measured."""
_WALL_AT = 1.0  # m


class Way(NamedTuple):
    """Where a robot went: one row a substep, seen from where and how it stood after the start-up."""

    x: np.ndarray
    """m"""
    y: np.ndarray
    """m"""
    z: np.ndarray
    """m"""
    yaw: np.ndarray
    """rad"""
    fallen: bool


def random_turns(rng: np.random.Generator, n_decisions: int = 20) -> list[float]:
    """
    Turns as policies ask for them: a value that holds for some decisions, then another one.

    :param rng: source of all randomness
    :param n_decisions: length, 20 are 5 s
    :return: rad
    """
    turns: list[float] = []
    while len(turns) < n_decisions:
        turns += [MAX_TURN * float(rng.uniform(-1.0, 1.0))] * int(rng.integers(1, 7))
    return turns[:n_decisions]


def walk(robot: Robot[QuadrupedCommand], turns: Sequence[float], phase: float = 0.0, speed: float = WALKING_SPEED) -> Way:
    """
    Walk straight on for 1 s, then turn.

    :param robot: on the floor
    :param turns: from the present heading, one a decision, rad
    :param phase: of the stride to begin with
    :param speed: m/s
    """
    if isinstance(robot, WalkingQuadruped):
        robot.reset(0.0, 0.0, 0.0, 0.0, phase)
    else:
        robot.reset(0.0, 0.0, 0.0, 0.0)
    for _ in range(START_UP):
        robot.command(QuadrupedCommand(speed, 0.0))
        for _ in range(DECISION):
            robot.substep()
    start = robot.state
    states = [start]
    for turn in turns:
        robot.command(QuadrupedCommand(speed, robot.state.yaw + turn))
        states += [robot.substep() for _ in range(DECISION)]
    x, y, z, yaw = np.array([state[:4] for state in states]).T
    c, s = math.cos(start.yaw), math.sin(start.yaw)
    dx, dy = x - start.x, y - start.y
    return Way(c * dx + s * dy, c * dy - s * dx, z, yaw - start.yaw, isinstance(robot, WalkingQuadruped) and robot.fallen)


def differences(physics: str, n: int = 50, n_decisions: int = 20, seed: int = 0) -> dict[str, np.ndarray]:
    """
    How far the legs end from the body without legs when both are told the same turns.

    :param physics: of the robot with legs
    :param n: number of command sequences
    :param n_decisions: length of each
    :param seed: of the sequences
    :return: ``position`` (m, at the end), ``path`` (m, mean over the time), ``heading`` (rad, at the end, absolute) and
        ``fallen`` (0 or 1), each ``(n,)``
    """
    rng = np.random.default_rng(seed)
    found: dict[str, list[float]] = {"position": [], "path": [], "heading": [], "fallen": []}
    legs, model = (World(FLOOR) for _ in range(2))
    with_legs, without = make_quadruped(legs, physics), make_quadruped(model, "compiled")
    for _ in range(n):
        turns, phase = random_turns(rng, n_decisions), float(rng.random())
        ours, reference = walk(with_legs, turns, phase), walk(without, turns)
        apart = np.hypot(ours.x - reference.x, ours.y - reference.y)
        found["position"].append(float(apart[-1]))
        found["path"].append(float(apart.mean()))
        found["heading"].append(float(abs(ours.yaw[-1] - reference.yaw[-1])))
        found["fallen"].append(float(ours.fallen))
    for world in (legs, model):
        world.close()
    return {name: np.array(values) for name, values in found.items()}


def measures(physics: str, n_phases: int = 4) -> dict[str, float]:
    """
    What a body can do, in few numbers; means over several phases of the stride.

    :param physics: of the robot
    :param n_phases: number of phases
    """
    world = World(FLOOR)
    robot = make_quadruped(world, physics)
    phases = np.arange(n_phases) / n_phases
    straight = [walk(robot, [0.0] * 20, phase) for phase in phases]
    turning = [walk(robot, [MAX_TURN] * 16, phase) for phase in phases]
    world.close()
    steady = slice(4 * DECISION, None)
    n = len(straight[0].x[steady]) - 1
    rates = [float(way.yaw[-1] - way.yaw[steady][0]) / (SUBSTEP * (len(way.yaw[steady]) - 1)) for way in turning]
    ahead = [
        way.yaw[steady] - rate * SUBSTEP * np.arange(len(way.yaw))[steady] for way, rate in zip(turning, rates, strict=True)
    ]

    def speed(ways: Sequence[Way]) -> float:
        return float(np.mean([np.hypot(np.diff(w.x[steady]), np.diff(w.y[steady])).mean() / SUBSTEP for w in ways]))

    return {
        "speed, straight on (m/s)": float(np.mean([way.x[-1] - way.x[steady][0] for way in straight])) / (n * SUBSTEP),
        "drift to the side in 5 s (m)": float(np.mean([abs(way.y[-1]) for way in straight])),
        "speed along the path, full turn (m/s)": speed(turning),
        "yaw rate, full turn (rad/s)": float(np.mean(rates)),
        "lag of the yaw (s)": float(np.mean([-a.mean() / rate for a, rate in zip(ahead, rates, strict=True)])),
        "half turn: width (m)": float(np.mean([way.y.max() for way in turning])),
        "half turn: way ahead (m)": float(np.mean([way.x.max() for way in turning])),
        "height of the trunk (m)": float(np.mean([way.z[steady].mean() for way in straight])),
        "bob, standard deviation (m)": float(np.mean([way.z[steady].std() for way in straight])),
        "sway of the yaw, standard deviation (rad)": float(np.mean([way.yaw[steady].std() for way in straight])),
        "head-on: centre to wall (m)": footprint(physics, 0.0),
        "at 45 degrees: centre to wall (m)": footprint(physics, math.pi / 4.0),
    }


def footprint(physics: str, angle: float) -> float:
    """
    Distance of the trunk's centre from a wall that the robot walks against, m.

    :param physics: of the robot
    :param angle: between its heading and the wall's normal, rad
    """
    wall = Box("wall", (_WALL_AT + 0.1, 0.0, 0.5), (0.1, 20.0, 0.5))
    world = World(SceneSpec((*FLOOR.shapes, wall)))
    robot = make_quadruped(world, physics)
    robot.reset(0.0, 0.0, 0.0, angle)
    distances = []
    for _ in range(16):
        robot.command(QuadrupedCommand(WALKING_SPEED, angle))
        distances += [_WALL_AT - robot.substep().x for _ in range(DECISION)]
    world.close()
    return float(np.mean(distances[-4 * DECISION :]))


def run(physics: str = "full", n: int = 50) -> Tables:
    """
    Both bodies side by side.

    :param physics: of the robot with legs
    :param n: number of random command sequences
    """
    legs, model = measures(physics), measures("compiled", n_phases=1)
    table: list[Row] = [{"what": what, "without legs": model[what], "on legs": legs[what]} for what in legs]
    table += [
        {"what": "radius in collisions (m)", "without legs": BODY_RADIUS},
        {"what": "height of a camera's body (m)", "without legs": BODY_HEIGHT},
    ]
    found = differences(physics, n)
    stayed = found["fallen"] == 0.0
    apart: list[Row] = [
        {
            "what": what,
            "mean": float(values.mean()),
            "median": float(np.median(values)),
            "9 in 10": float(np.quantile(values, 0.9)),
        }
        for what, values in (
            ("distance after 5 s (m)", found["position"][stayed]),
            ("distance, mean over the 5 s (m)", found["path"][stayed]),
            ("difference of heading after 5 s (rad)", found["heading"][stayed]),
        )
    ]
    apart.append({"what": f"falls in {n} sequences", "mean": float(found["fallen"].mean())})
    return {"The body without legs and the one on legs": table, f"{n} random sequences of turns": apart}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--physics", default="full", choices=("full", "full_accurate"), help="of the robot with legs")
    parser.add_argument("-n", type=int, default=50, help="random command sequences")
    parser.add_argument("--markdown", action="store_true", help="print tables as Markdown")
    options: Any = parser.parse_args()
    for title, table in run(options.physics, options.n).items():
        print("\n" + show(title, table, options.markdown), flush=True)


if __name__ == "__main__":
    main()
