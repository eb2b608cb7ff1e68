"""PyBullet's Panda: loaded from ``pybullet_data``, its inverse kinematics, and its joints set without dynamics."""

import os

import pybullet_data

from bullet_tasks.robots.panda_arm import NOTHING, ArmState
from bullet_tasks.shapes import Vector3
from bullet_tasks.simulation import Simulation

ARM_JOINTS = (0, 1, 2, 3, 4, 5, 6)
FINGER_JOINTS = (9, 10)
"""``panda_finger_joint1`` and ``2`` of ``franka_panda/panda.urdf``."""
JOINTS = (*ARM_JOINTS, *FINGER_JOINTS)
HAND = 11
"""Link ``panda_grasptarget``, the middle of the fingers."""
OPEN, CLOSED = 0.04, 0.026
"""Way of each finger from the middle, m. Closed, it is 1 mm from a cube's face: what holds a cube is not friction."""

_REST = (0.0, 0.3, 0.0, -2.0, 0.0, 2.3, 0.785, OPEN, OPEN)  # rad and m; elbow up, hand down, above the middle of the table
_DOWN = (1.0, 0.0, 0.0, 0.0)  # quaternion of a hand that points down, fingers along y
# One round misses by up to 0.7 mm at the rim of what the arm reaches, two by 0.01 mm.
_IK_ITERATIONS, _IK_ROUNDS = 100, 2
_IK_RESIDUAL = 1e-5  # m
_GREATEST_CACHE = 256  # poses; an episode has about 13


class PandaBody:
    """
    The arm's body in a simulation, its base at the origin.

    :param simulation: where it is loaded
    """

    def __init__(self, simulation: Simulation) -> None:
        client = self._client = simulation.client
        self.id: int = client.loadURDF(
            os.path.join(pybullet_data.getDataPath(), "franka_panda", "panda.urdf"), useFixedBase=True
        )
        # PyBullet's inverse kinematics miss by where the base's centre of mass is in its frame (measured: by 5 cm).
        self._base_offset: Vector3 = client.getDynamicsInfo(self.id, -1)[3]
        self._poses: dict[Vector3, tuple[float, ...]] = {}

    def joints_at(self, hand: Vector3) -> tuple[float, ...]:
        """
        Angles of the arm's joints that bring the hand to a point, rad ``(7,)``; they depend on nothing else.

        :param hand: middle of the fingers, m, above the part of the table that ``BlindMassStackConfig`` allows
        """
        joints = self._poses.get(hand)
        if joints is None:
            joints = self._solve(hand)
            if len(self._poses) >= _GREATEST_CACHE:
                self._poses.clear()
            self._poses[hand] = joints
        return joints

    def _solve(self, hand: Vector3) -> tuple[float, ...]:
        target = tuple(h - o for h, o in zip(hand, self._base_offset, strict=True))
        joints = _REST
        for _ in range(_IK_ROUNDS):
            joints = self._client.calculateInverseKinematics(
                self.id,
                HAND,
                target,
                _DOWN,
                currentPositions=joints,
                maxNumIterations=_IK_ITERATIONS,
                residualThreshold=_IK_RESIDUAL,
            )
        return joints[: len(ARM_JOINTS)]

    def hand(self) -> Vector3:
        """Where the middle of the fingers is, m."""
        return self._client.getLinkState(self.id, HAND, computeForwardKinematics=True)[4]

    def set_joints(self, joints: tuple[float, ...], opening: float = OPEN) -> None:
        """
        Put the joints somewhere, at rest.

        :param joints: rad, ``(7,)``
        :param opening: of each finger, m
        """
        values = [(value,) for value in (*joints, opening, opening)]
        self._client.resetJointStatesMultiDof(self.id, JOINTS, values, [(0.0,)] * len(JOINTS))

    def appear(self, state: ArmState) -> None:
        """
        Be where a state says.

        :param state: of the arm
        """
        hand = (state.x, state.y, state.z)
        self.set_joints(self.joints_at(hand), OPEN if state.held == NOTHING else CLOSED)
