"""The world of an environment: its scene as it is in the present episode, and PyBullet's copy of it where one is needed."""

from collections.abc import Mapping

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Vector3
from bullet_tasks.simulation import Simulation


class World:
    """
    A scene whose shapes may be moved.

    The simulation, which costs 20 ms and 30 MB, is opened by the first who asks for it.

    :param scene: everything except the robot
    :param gui: let the simulation open PyBullet's window
    """

    def __init__(self, scene: SceneSpec, gui: bool = False) -> None:
        self.scene = scene
        """As it is now."""
        self.closed = False
        self._base = scene
        self._moved: Mapping[str, tuple[Vector3, float]] = {}
        self._gui = gui
        self._simulation: Simulation | None = None

    @property
    def simulation(self) -> Simulation:
        """
        The scene in PyBullet.

        :raises RuntimeError: if the world is closed, or there is no display for the window
        """
        if self.closed:
            raise RuntimeError("This world is closed; make a new one.")
        if self._simulation is None:
            simulation = Simulation(gui=self._gui)
            try:
                self.scene.build(simulation)
            except BaseException:
                simulation.close()
                raise
            self._simulation = simulation
        return self._simulation

    @property
    def simulated(self) -> bool:
        """Whether the simulation has been opened."""
        return self._simulation is not None

    def place(self, placements: Mapping[str, tuple[Vector3, float]]) -> None:
        """
        Start anew from the scene that the world was made of, with some shapes elsewhere.

        :param placements: name -> (centre in m, yaw in rad)
        :raises KeyError: if a name is unknown
        """
        self.scene = self._base.moved(placements)
        if self._simulation is not None:
            for name in {**self._moved, **placements}:
                shape = self.scene[name]
                self._simulation.place(name, shape.centre, shape.yaw)
        self._moved = placements

    def close(self) -> None:
        """Close the simulation; a second call does nothing."""
        self.closed = True
        if self._simulation is not None:
            self._simulation.close()
