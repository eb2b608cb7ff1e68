"""The arm in PyBullet, without dynamics: it is put where its inverse kinematics say, and the cubes with it."""

from bullet_tasks.robots.panda_arm import ArmState
from bullet_tasks.robots.panda_compiled import CompiledPanda
from bullet_tasks.simulation import Simulation


class KinematicPanda(CompiledPanda):
    """The compiled arm with its body always in the simulation, so that every motion is one that the arm's joints can make."""

    def reset(self, x: float, y: float, ground: float, yaw: float) -> ArmState:
        """
        Put the hand somewhere, and the body there (see base class).

        :param x: m
        :param y: m
        :param ground: height of the table, m
        :param yaw: unused
        """
        state = super().reset(x, y, ground, yaw)
        self._show()
        return state

    def substep(self) -> ArmState:
        """Let one whole motion pass, and put the body there (see base class)."""
        state = super().substep()
        self._show()
        return state

    def _show(self) -> None:
        super().appear(self.world.simulation)

    def appear(self, simulation: Simulation) -> None:
        """
        Nothing to do, the body is there already (see base class).

        :param simulation: that will take the picture
        """
