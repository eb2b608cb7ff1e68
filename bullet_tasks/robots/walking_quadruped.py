"""The quadruped on its legs: twelve motors, contacts and gravity, under the same commands as the bodies without legs."""

import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data

from bullet_tasks.ends import Judge, Outcome
from bullet_tasks.robots import a1_model, gait
from bullet_tasks.robots.base import Robot, RobotState, Stretch
from bullet_tasks.robots.gait import FOOT_RADIUS, Gait, Trot
from bullet_tasks.robots.gait_walls import FOOTPRINT, give_way
from bullet_tasks.robots.quadruped_body import CONTACT_FORCE, MAX_YAW_RATE, SUBSTEP, YAW_GAIN, QuadrupedCommand
from bullet_tasks.simulation import quaternion
from bullet_tasks.world import World

MAX_SPEED = 1.0
"""Commanded speeds are clipped to this, m/s, either way."""
MAX_PITCH = 0.35
"""Commanded body pitches are clipped to this, rad, either way."""
FALLEN_TILT = 0.9
"""A robot that rolls or pitches further has fallen, rad."""
FALLEN_HEIGHT = 0.15
"""A robot whose trunk's centre is nearer than this to the ground that its feet stand on has fallen, m."""

_GRAVITY = 9.81  # m/s^2
_EFFORT = 33.5  # N m, the motors' limit (a1.urdf)
_FOOT_FRICTION = 2.0  # times that of floors, which is PyBullet's 0.5: 1.0, the release's ground
_BODY_FRICTION = 0.2  # the trunk slides along walls
_PLACED_ABOVE = 0.002  # m
_AWAY = 1000.0  # m
_OTHER_BODY, _NORMAL_FORCE = 2, 9  # fields of a record of getContactPoints
_HALF_TURN = math.pi + 1e-6  # rad; beyond it a heading is nearer the other way round


@dataclass(frozen=True)
class WalkingPreset:
    """
    How exactly a walking quadruped is simulated.

    :param physics_rate: physics steps, and decisions of the gait, in a second; a multiple of 20
    :param iterations: of the contact solver
    :param motor_gain: part of its error that a joint makes good in a physics step, 0 to 1
    :param meshes: the A1 of ``pybullet_data`` with all its shapes, instead of the light model
    :param gait: how to trot
    :raises ValueError: if a number is not a possible choice
    """

    physics_rate: int
    iterations: int
    motor_gain: float
    meshes: bool
    gait: Gait = field(default_factory=Gait)

    def __post_init__(self) -> None:
        steps = self.physics_rate * SUBSTEP
        if steps < 1.0 or steps != int(steps):
            raise ValueError(f"`physics_rate` must be a multiple of {1.0 / SUBSTEP:g} in a second, got {self.physics_rate}.")
        if self.iterations < 1:
            raise ValueError(f"`iterations` must be at least 1, got {self.iterations}.")
        if not 0.0 < self.motor_gain <= 1.0:
            raise ValueError(f"`motor_gain` must be greater than 0 and at most 1, got {self.motor_gain}.")


FAST = WalkingPreset(physics_rate=120, iterations=20, motor_gain=0.5, meshes=False)
"""The light model at 120 Hz."""
ACCURATE = WalkingPreset(physics_rate=240, iterations=50, motor_gain=0.2, meshes=True)
"""The A1 of ``pybullet_data`` at 240 Hz; its legs have all their shapes, which may hook on walls."""


class WalkingQuadruped(Robot[QuadrupedCommand]):
    """
    The A1 with twelve motors, driven by an analytic trot.

    The heading follows its target with the same law as the bodies without legs. Contacts count with everything but floors:
    a robot that only walks touches nothing. A fall ends the episode as a failure, see ``advance``.

    :param world: the robot is created in its simulation
    :param preset: how exactly it is simulated
    """

    name = "robot"
    substep_period = SUBSTEP

    def __init__(self, world: World, preset: WalkingPreset = FAST) -> None:
        self.preset = preset
        self.trot = Trot(preset.gait)
        self.roll = 0.0
        """Of the trunk, rad."""
        self.pitch = 0.0
        """Of the trunk, rad, nose down positive."""
        self.fallen = False
        """Whether the robot has fallen since it was placed."""
        self.state = RobotState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False)
        self._world = world
        self._dt = 1.0 / preset.physics_rate
        self._steps = round(SUBSTEP * preset.physics_rate)
        self._speed = self._target_yaw = self._reference = self._pitch = 0.0
        self._phase = 0.0
        self._height = FOOT_RADIUS + preset.gait.height
        self._limits = (preset.gait.wall_time, preset.gait.sidestep, preset.gait.turn_room)
        self._measured = np.zeros(gait.N_MEASUREMENTS)
        simulation = world.simulation
        simulation.configure(self._dt, _GRAVITY)
        self._client = client = simulation.client
        client.setPhysicsEngineParameter(numSolverIterations=preset.iterations, deterministicOverlappingPairs=1)
        self._body = self._load()
        self._floors = {simulation.body_id(shape.name) for shape in world.scene.shapes if shape.floor}
        if math.isfinite(world.scene.lower_ground):
            self._floors.add(simulation.body_id("lower_ground"))
        # PyBullet reckons in the frame of the centre of mass, which has the trunk's directions.
        self._centre_of_mass = np.array(client.getDynamicsInfo(self._body, -1)[3])
        names = {client.getJointInfo(self._body, j)[1].decode(): j for j in range(client.getNumJoints(self._body))}
        self._joints = [names[name] for name in a1_model.JOINTS]
        # The light model's feet are the ends of its lower legs.
        feet = {names.get(f"{leg}_toe_fixed", names[f"{leg}_lower_joint"]) for leg, _, _ in a1_model.LEGS}
        for link in range(-1, client.getNumJoints(self._body)):
            friction = _FOOT_FRICTION if link in feet else _BODY_FRICTION
            client.changeDynamics(self._body, link, lateralFriction=friction, linearDamping=0.0, angularDamping=0.0)
        self._forces = [_EFFORT] * len(self._joints)
        self._gains = [preset.motor_gain] * len(self._joints)
        self._damping = [1.0] * len(self._joints)
        self._step = simulation.step
        self._get_pose = client.getBasePositionAndOrientation
        self._get_velocity = client.getBaseVelocity
        self._contacts = client.getContactPoints
        self._set_motors = client.setJointMotorControlArray
        self.reset(0.0, 0.0, 0.0, 0.0)

    def _load(self) -> int:
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        place = (0.0, 0.0, _AWAY)
        if self.preset.meshes:
            path = Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf"
            # Merging its fixed links would save a third of the time, but prints a line for each.
            return self._client.loadURDF(str(path), place, flags=flags)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a1_light.urdf"
            path.write_text(a1_model.urdf())
            return self._client.loadURDF(str(path), place, flags=flags | pybullet.URDF_USE_MATERIAL_COLORS_FROM_MTL)

    def vary(self, rng: np.random.Generator) -> None:
        """
        Begin the next episode anywhere in the stride (see base class). Where the start is always the same, as in Square Maze,
        so would every episode be that has the same goal.

        :param rng: the episode's random generator
        """
        self._phase = float(rng.uniform())

    def reset(self, x: float, y: float, ground: float, yaw: float, phase: float | None = None) -> RobotState:
        """
        Put the robot somewhere, standing (see base class).

        :param x: m
        :param y: m
        :param ground: height of the floor there, m
        :param yaw: rad
        :param phase: of the stride that the robot will begin with, 0 to 1; None: what ``vary`` has drawn, else 0
        """
        self.trot.reset(ground, self._phase if phase is None else phase)
        self._speed, self._target_yaw, self._reference, self._pitch = 0.0, yaw, yaw, 0.0
        z = ground + self._height
        angles = self.trot.angles.ravel().tolist()
        # Where nothing is in touch first, so that PyBullet forgets the contacts of the episode before.
        for height in (_AWAY, z + _PLACED_ABOVE):
            centre = self._rotated(quaternion(yaw)) + np.array((x, y, height))
            self._client.resetBasePositionAndOrientation(self._body, centre.tolist(), quaternion(yaw))
            self._client.resetBaseVelocity(self._body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            self._client.resetJointStatesMultiDof(self._body, self._joints, [[q] for q in angles], [[0.0]] * len(angles))
            self._client.performCollisionDetection()
        self.fallen = False
        self.state = RobotState(x, y, z, yaw, 0.0, 0.0, False)
        self._measure(yaw)
        return self.state

    def command(self, command: QuadrupedCommand) -> None:
        """
        Walk at a speed, turn towards a heading and hold a body pitch (see base class). Numbers beyond ``MAX_SPEED`` and
        ``MAX_PITCH`` are clipped.

        :param command: a target more than half a turn away is reached the shorter way round
        :raises ValueError: if a number is not finite
        """
        if not all(map(math.isfinite, command)):
            raise ValueError(f"A command must be made of finite numbers (m/s, rad, rad), got {command}.")
        self._speed = max(-MAX_SPEED, min(MAX_SPEED, command.speed))
        self._pitch = max(-MAX_PITCH, min(MAX_PITCH, command.pitch))
        turn = command.target_yaw - self.state.yaw
        if abs(turn) > _HALF_TURN:
            turn = math.remainder(turn, math.tau)
        self._target_yaw = self.state.yaw + turn
        # What the heading still lacks of the last turn is forgotten: whoever commands has seen it.
        self._reference = self.state.yaw

    def advance(self, n_substeps: int, judge: Judge) -> Stretch:
        """
        Let several substeps pass, but stop where the episode ends (see base class); a fall is a failure.

        :param n_substeps: at least 1
        :param judge: of every substep; a robot that falls at the goal has reached it
        """

        def outcome(state: RobotState) -> Outcome:
            judged = judge(state)
            return Outcome.FAILURE if judged is Outcome.RUNNING and self.fallen else judged

        return super().advance(n_substeps, outcome)

    def substep(self) -> RobotState:
        """Let 1/20 s pass (see base class)."""
        x0, y0 = self.state.x, self.state.y
        scene, measured = self._world.scene, self._measured
        pressed = False
        yaw = self.state.yaw
        for _ in range(self._steps):
            rate = self._turn(yaw)
            x, y, z = measured[: gait.TRUNK_Z + 1].tolist()
            ahead, left = give_way(
                scene.packed,
                scene.lower_ground,
                FOOTPRINT,
                (x, y, yaw),
                z - self._height,
                (self._speed, rate),
                self._limits,
            )
            command = (ahead, left, rate, self._pitch)
            angles = self.trot.step(self._dt, command, measured, scene.packed, scene.lower_ground)
            self._set_motors(
                self._body,
                self._joints,
                pybullet.POSITION_CONTROL,
                angles.ravel().tolist(),
                forces=self._forces,
                positionGains=self._gains,
                velocityGains=self._damping,
            )
            self._step()
            pressed = pressed or self._pressed()
            yaw = self._measure(yaw)
        x, y, z = measured[: gait.TRUNK_Z + 1].tolist()
        self.state = RobotState(x, y, z, yaw, (x - x0) / SUBSTEP, (y - y0) / SUBSTEP, pressed, self.pitch)
        tilted = max(abs(self.roll), abs(self.pitch)) > FALLEN_TILT
        self.fallen = self.fallen or tilted or z - self.trot.ground < FALLEN_HEIGHT
        return self.state

    def push(self, vx: float, vy: float) -> None:
        """
        Hit the trunk: its velocity changes at once, and the gait has to cope.

        :param vx: change along the world's x axis, m/s
        :param vy: change along the world's y axis, m/s
        """
        (x, y, z), spin = self._get_velocity(self._body)
        self._client.resetBaseVelocity(self._body, (x + vx, y + vy, z), spin)

    def _turn(self, yaw: float) -> float:
        """
        Yaw rate that keeps the heading up with a body without legs.

        :param yaw: rad
        :return: rad/s
        """
        walking = self.preset.gait
        error = self._target_yaw - self._reference
        rate = max(-MAX_YAW_RATE, min(MAX_YAW_RATE, YAW_GAIN * error))
        self._reference += rate * self._dt
        # Held back by a wall, say, the robot is not to swing round once it is free.
        slack = walking.heading_slack
        self._reference = max(yaw - slack, min(yaw + slack, self._reference))
        return rate + walking.heading_feedback * (self._reference - yaw)

    def _pressed(self) -> bool:
        """Whether anything but a floor pressed on the robot during the last physics step."""
        for point in self._contacts(self._body):
            if point[_NORMAL_FORCE] > CONTACT_FORCE and point[_OTHER_BODY] not in self._floors:
                return True
        return False

    def _rotated(self, orientation: tuple[float, float, float, float]) -> np.ndarray:
        """From the trunk's centre to the centre of mass in the world, m, ``(3,)``."""
        return np.array(pybullet.rotateVector(orientation, self._centre_of_mass.tolist()))

    def _measure(self, yaw: float) -> float:
        """
        Read the trunk's pose and velocity.

        :param yaw: before, rad
        :return: yaw now, on the same continuous scale, rad
        """
        measured = self._measured
        (x, y, z), orientation = self._get_pose(self._body)
        (vx, vy, _), (_, _, yaw_rate) = self._get_velocity(self._body)
        self.roll, self.pitch, wrapped = pybullet.getEulerFromQuaternion(orientation)
        yaw += math.remainder(wrapped - yaw, math.tau)
        dx, dy, dz = pybullet.rotateVector(orientation, self._centre_of_mass)
        c, s = math.cos(yaw), math.sin(yaw)
        measured[:] = (x - dx, y - dy, z - dz, self.roll, self.pitch, yaw, c * vx + s * vy, c * vy - s * vx, yaw_rate)
        return yaw
