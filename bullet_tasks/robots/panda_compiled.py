"""The arm without PyBullet: after every decision, hand and cubes are where the motion ends."""

from bullet_tasks.robots.panda_arm import NOTHING, ArmState, PandaArm
from bullet_tasks.robots.panda_body import PandaBody
from bullet_tasks.simulation import Simulation


class CompiledPanda(PandaArm):
    """An arm whose motions take no computing; a body is loaded for pictures only."""

    _body: PandaBody | None = None

    def substep(self) -> ArmState:
        """Let one whole motion pass (see base class)."""
        height, hanging = self.stop_height()
        x, y = self.places[self._command.place]
        hand = (x, y, height)
        if self.held != NOTHING:
            self.cubes[self.held] = hand
            if not (self._command.close or hanging):
                self.held = NOTHING
        elif self._command.close:
            self.held = self.within_reach(hand)
        load = self.masses[self.held] if hanging else 0.0
        self.state = ArmState.of(hand, self.cubes, self.held, load)
        return self.state

    def appear(self, simulation: Simulation) -> None:
        """
        Be where ``state`` says in the pictures of a simulation, the cubes too (see base class).

        :param simulation: that will take the picture
        """
        if self._body is None:
            self._body = PandaBody(simulation)
        self._body.appear(self.state)
        for name, centre in zip(self.names, self.cubes, strict=True):
            simulation.place(name, centre)
