"""The kinematic quadrotor without PyBullet: the same flight above flat ground, compiled."""

import numpy as np

from bullet_tasks.ends import OUTCOMES, Judge
from bullet_tasks.robots import quadrotor_kernels as kernels
from bullet_tasks.robots.base import Stretch
from bullet_tasks.robots.quadrotor_body import SUBSTEP, Launch, Quadrotor, QuadrotorState, looks, orientation, state_of
from bullet_tasks.robots.quadrotor_ends import HoverEnds
from bullet_tasks.simulation import Simulation
from bullet_tasks.world import World

# Limits that nothing reaches: a substep that nobody judges.
_NO_ENDS = np.full(kernels.N_ENDS, np.inf)


class CompiledQuadrotor(Quadrotor):
    """
    ``KinematicQuadrotor`` computed by one compiled function; the ground is flat and the only thing to touch.

    :param world: the scene in it is not touched but for the floor below the start
    :param launch: where in the air a flight begins, asked at every reset
    """

    substep_period = SUBSTEP

    def __init__(self, world: World, launch: Launch) -> None:
        super().__init__(launch)
        self._appeared = False

    def substep(self) -> QuadrotorState:
        """Let 1/50 s pass (see base class)."""
        kernels.advance(self._flight, self._command, self._body, _NO_ENDS, kernels.NOT_HOVERING, 1)
        self.state = self._measured()
        return self.state

    def advance(self, n_substeps: int, judge: Judge) -> Stretch:
        """
        Let several substeps pass, but stop where the episode ends (see base class).

        :param n_substeps: at least 1
        :param judge: of every substep; compiled if it is a ``HoverEnds``
        """
        if not isinstance(judge, HoverEnds):
            return super().advance(n_substeps, judge)
        done, contacts, code, judge.since = kernels.advance(
            self._flight, self._command, self._body, judge.limits, judge.since, n_substeps
        )
        self.state = self._measured()
        return Stretch(done, contacts, OUTCOMES[code])

    def _measured(self) -> QuadrotorState:
        return state_of(self._flight, self._floor)

    def appear(self, simulation: Simulation) -> None:
        """
        Be where ``state`` says in the pictures of a simulation (see base class).

        :param simulation: that will take the picture
        """
        state = self.state
        if not self._appeared:
            simulation.add_body(self.name, None, looks(), (0.0, 0.0, 0.0))
            self._appeared = True
        simulation.set_pose(simulation.body_id(self.name), (state.x, state.y, state.z), orientation(state))
