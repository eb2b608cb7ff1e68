"""The arm with motors, gravity and cubes that weigh: the judge of policies that were trained without."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import pybullet

from bullet_tasks.ends import Judge
from bullet_tasks.robots.base import Stretch
from bullet_tasks.robots.panda_arm import (
    CARRY_HEIGHT,
    CUBES,
    EDGE,
    NOTHING,
    REACH,
    ArmCommand,
    ArmState,
    PandaArm,
)
from bullet_tasks.robots.panda_body import ARM_JOINTS, CLOSED, FINGER_JOINTS, HAND, JOINTS, OPEN, PandaBody
from bullet_tasks.scene import PARKED
from bullet_tasks.shapes import Vector3
from bullet_tasks.simulation import Simulation
from bullet_tasks.world import World

SUBSTEP = 1.0 / 60.0
"""s; the largest at which stacks of cubes and the arm are stable (five of five at 60 Hz)."""
GRAVITY = 9.81
"""m/s^2"""
SPEED = 0.6
"""Of the hand, m/s."""

_ARM_FORCE, _FINGER_FORCE = 240.0, 40.0  # N m and N
_POSITION_GAIN = 0.4  # of the joints' motors, per step: at 60 Hz a time constant of 0.04 s
_SETTLE = 0.25  # s at the end of a motion, before the gripper or the scale
_GRIP = 0.15  # s for the fingers
_WEIGH = 0.2  # s over which the constraint's force is averaged
_CLEARANCE = 0.001  # m above its support at which a cube is let go
_WAYPOINT = 0.05  # m between points of a motion that inverse kinematics are solved at; straight to 0.3 mm between them
_FRICTION = 0.8
_GRASP_FORCE = 500.0  # N that the constraint may exert

Targets = Iterator[tuple[float, ...] | None]


def _steps(seconds: float) -> int:
    return max(1, math.ceil(seconds / SUBSTEP))


class FullPanda(PandaArm):
    """
    The arm in dynamics: joint motors follow a straight motion of the hand, a fixed constraint stands for the grasp (friction
    of simulated fingers creeps), and the load is what that constraint's force says.

    The scene's cubes cannot move by themselves; the ones that weigh are bodies of their own.

    :param world: see base class
    :param masses: see base class
    """

    substep_period = SUBSTEP

    def __init__(self, world: World, masses: Callable[[], Sequence[float]]) -> None:
        super().__init__(world, masses)
        simulation = world.simulation
        simulation.configure(SUBSTEP, GRAVITY)
        self._client = simulation.client
        # Else the order in which stacked cubes are solved, and with it the last digits, depends on earlier episodes.
        self._client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        self._step = simulation.step
        self._body = PandaBody(simulation)
        self._bodies = {name: self._add_cube(simulation, name) for name in CUBES}
        for body in self._bodies.values():
            self._client.changeDynamics(body, -1, lateralFriction=_FRICTION, restitution=0.0)
        self._constraint: int | None = None
        self._targets: Targets = iter(())
        self._load = 0.0
        self._pristine = simulation.save()

    def _add_cube(self, simulation: Simulation, name: str) -> int:
        shape = self.world.scene[name]
        cube = dataclasses.replace(shape, centre=(0.0, 0.0, 0.0))
        return simulation.add_body(f"{name}_body", cube, (cube,), shape.centre, mass=1.0)

    def reset(self, x: float, y: float, ground: float, yaw: float) -> ArmState:
        """
        Put the hand and the cubes somewhere, at rest (see base class).

        :param x: m
        :param y: m
        :param ground: height of the table, m
        :param yaw: unused
        """
        self._let_go()
        for index in range(len(self.names)):
            self._fingers_touch(index, True)
        # Contacts of the last episode would leave traces in this one.
        self.world.simulation.restore(self._pristine)
        state = super().reset(x, y, ground, yaw)
        for name, centre, mass in zip(self.names, self.cubes, self.masses, strict=True):
            inertia = mass * EDGE * EDGE / 6.0
            self._client.changeDynamics(self._bodies[name], -1, mass=mass, localInertiaDiagonal=(inertia, inertia, inertia))
            self._client.resetBasePositionAndOrientation(self._bodies[name], centre, (0.0, 0.0, 0.0, 1.0))
            self._client.resetBaseVelocity(self._bodies[name], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._joints = self._body.joints_at((x, y, CARRY_HEIGHT))
        self._body.set_joints(self._joints)
        self._opening = OPEN
        self._targets = iter(())
        self._load = 0.0
        return state

    def command(self, command: ArmCommand) -> None:
        """
        Plan the next motion (see base class).

        :param command: place, height, gripper
        """
        super().command(command)
        self._targets = self._plan()

    def advance(self, n_substeps: int, judge: Judge) -> Stretch:
        """
        Let the motion end, then judge (see base class). The rest of the time passes at rest.

        :param n_substeps: that it may take at most, and that count as passed
        :param judge: of the state after the motion
        """
        done = 0
        while done < n_substeps and self._advance_targets():
            self._step()
            done += 1
        self.state = self._measure()
        return Stretch(n_substeps, 0, judge(self.state))

    def substep(self) -> ArmState:
        """Let 1/60 s pass (see base class)."""
        self._advance_targets()
        self._step()
        self.state = self._measure()
        return self.state

    def _advance_targets(self) -> bool:
        """Tell the motors where to be after the next step; False once the motion has ended."""
        joints = next(self._targets, None)
        if joints is None:
            return False
        self._joints = joints
        client = self._client
        client.setJointMotorControlArray(
            self._body.id,
            JOINTS,
            pybullet.POSITION_CONTROL,
            targetPositions=(*joints, self._opening, self._opening),
            positionGains=[_POSITION_GAIN] * len(JOINTS),
            forces=[_ARM_FORCE] * len(ARM_JOINTS) + [_FINGER_FORCE] * len(FINGER_JOINTS),
        )
        return True

    # -- motion ------------------------------------------------------------------------------------------------------------

    def _plan(self) -> Targets:
        """Joint angles for every step of the motion; between them, what the gripper and the scale do."""
        self._see()
        height, hanging = self.stop_height()
        x, y = self.places[self._command.place]
        if self.held != NOTHING and not hanging:
            height += _CLEARANCE
        here = self._body.hand()
        self._load = 0.0
        yield from self._move(here, (x, y, height))
        yield from self._wait(_SETTLE)
        if self.held == NOTHING and self._command.close:
            yield from self._grasp()
        elif self.held != NOTHING and not (self._command.close or hanging):
            index = self._let_go()
            self._opening = OPEN
            yield from self._wait(_GRIP)
            self._fingers_touch(index, True)
        elif hanging:
            yield from self._weigh()

    def _move(self, start: Vector3, end: Vector3) -> Targets:
        """Up, over and down; straight up or down if the hand is above the place already."""
        corners = [start]
        if math.dist(start[:2], end[:2]) > REACH:
            corners += [(start[0], start[1], CARRY_HEIGHT), (end[0], end[1], CARRY_HEIGHT)]
        corners.append(end)
        for a, b in itertools.pairwise(corners):
            n_points = max(1, math.ceil(math.dist(a, b) / _WAYPOINT))
            n_steps = _steps(math.dist(a, b) / n_points / SPEED)
            for k in range(1, n_points + 1):
                share = k / n_points
                point = (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))
                before, after = self._joints, self._body.joints_at(point)
                for i in range(1, n_steps + 1):
                    part = i / n_steps
                    yield tuple(p + part * (q - p) for p, q in zip(before, after, strict=True))

    def _wait(self, seconds: float) -> Targets:
        for _ in range(_steps(seconds)):
            yield self._joints

    # -- gripper and scale -------------------------------------------------------------------------------------------------

    def _grasp(self) -> Targets:
        self._see()
        index = self.within_reach(self._body.hand())
        if index == NOTHING:
            return
        self._opening = CLOSED
        yield from self._wait(_GRIP)
        client, cube = self._client, self._bodies[self.names[index]]
        # Of the link's centre of mass, which constraints are relative to.
        position, orientation = client.getLinkState(self._body.id, HAND, computeForwardKinematics=True)[:2]
        cube_position, cube_orientation = client.getBasePositionAndOrientation(cube)
        offset, turn = client.multiplyTransforms(
            *client.invertTransform(position, orientation), cube_position, cube_orientation
        )
        self._constraint = client.createConstraint(
            self._body.id, HAND, cube, -1, pybullet.JOINT_FIXED, (0.0, 0.0, 0.0), offset, (0.0, 0.0, 0.0), turn
        )
        client.changeConstraint(self._constraint, maxForce=_GRASP_FORCE)
        self._fingers_touch(index, False)
        self.held = index

    def _fingers_touch(self, index: int, touch: bool) -> None:
        """Whether fingers collide with a cube; not while the constraint holds it, or their friction would bear some of it."""
        for finger in FINGER_JOINTS:
            self._client.setCollisionFilterPair(self._body.id, self._bodies[self.names[index]], finger, -1, int(touch))

    def _let_go(self) -> int:
        """Remove the constraint, but keep the fingers from the cube until they have opened; the cube's index."""
        index = self.held
        if self._constraint is not None:
            self._client.removeConstraint(self._constraint)
        self._constraint, self.held = None, NOTHING
        return index

    def _weigh(self) -> Targets:
        force = [0.0, 0.0, 0.0]
        n_steps = _steps(_WEIGH)
        for _ in range(n_steps):
            yield self._joints
            force = [f + g / n_steps for f, g in zip(force, self._client.getConstraintState(self._constraint), strict=False)]
        self._load = math.hypot(*force) / GRAVITY

    def _see(self) -> None:
        """Look where the cubes are."""
        self.cubes = [self._client.getBasePositionAndOrientation(self._bodies[name])[0] for name in self.names]

    def _measure(self) -> ArmState:
        self._see()
        return ArmState.of(self._body.hand(), self.cubes, self.held, self._load)

    def appear(self, simulation: Simulation) -> None:
        """
        Take the scene's cubes out of the picture, which shows the ones that weigh (see base class).

        :param simulation: that will take the picture
        """
        for name in CUBES:
            simulation.place(name, PARKED)
