"""Hand-written policies for Blind-Mass Stack: what knowing, weighing and guessing are worth."""

import math

import numpy as np

LOW, MIDDLE, HIGH = range(3)
OPEN, CLOSE = range(2)
GREEN_MASS, RED_MASS = 1.0, 0.75  # kg
GREATEST_BIAS = 2.0
TOLERANCE = 0.07  # relative; half of the least difference between red and blue


def green_cube(observation: dict[str, np.ndarray]) -> int:
    """
    Which cube is green.

    :param observation: ``common`` is read, nothing else
    """
    return int(np.argmax(observation["common"][12:15]))


def reading(observation: dict[str, np.ndarray]) -> float:
    """
    What the scale says, kg.

    :param observation: ``common`` is read, nothing else
    """
    shown = float(observation["common"][19:22].max())
    return 0.25 * math.exp(0.5 * shown) if shown > 0.0 else 0.0


def others(observation: dict[str, np.ndarray]) -> list[int]:
    """
    Which cubes are not green.

    :param observation: ``common`` is read, nothing else
    """
    return [i for i in range(3) if i != green_cube(observation)]


def pick_and_stack(cube: int, green: int) -> list[tuple[int, int, int]]:
    """
    Actions that put a cube onto the green one.

    :param cube: its index
    :param green: index of the green cube
    """
    return [(cube, LOW, CLOSE), (green, MIDDLE, OPEN)]


class Script:
    """A policy that carries out a list of actions and plans anew when it is at its end."""

    def __init__(self) -> None:
        self.actions: list[tuple[int, int, int]] = []
        self.readings: dict[int, float] = {}
        self.lifted: int | None = None

    def weigh(self, cube: int) -> None:
        """
        Plan to lift a cube and put it down again.

        :param cube: its index
        """
        self.actions = [(cube, LOW, CLOSE), (cube, HIGH, CLOSE), (cube, LOW, OPEN)]

    def plan(self, observation: dict[str, np.ndarray]) -> None:
        """
        Fill ``actions``.

        :param observation: the present one
        """
        raise NotImplementedError

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else, unless the plan says so
        """
        if reading(observation) > 0.0 and self.lifted is not None:
            self.readings[self.lifted] = reading(observation)
        if not self.actions:
            self.plan(observation)
        action = self.actions.pop(0)
        self.lifted = action[0]
        return np.array(action)


class Oracle(Script):
    """Stack the red cube, which only a privileged robot knows."""

    def plan(self, observation: dict[str, np.ndarray]) -> None:
        """
        :param observation: with ``privileged``
        """
        self.actions = pick_and_stack(round(float(observation["privileged"][0]) / 0.3) + 1, green_cube(observation))


class Guess(Script):
    """
    Stack a cube without weighing.

    :param rng: of the guess
    """

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self.rng = rng

    def plan(self, observation: dict[str, np.ndarray]) -> None:
        """
        :param observation: ``common`` is read, nothing else
        """
        self.actions = pick_and_stack(int(self.rng.choice(others(observation))), green_cube(observation))


class Weigh(Script):
    """The optimal behaviour: calibrate on green, weigh another, stack red."""

    def plan(self, observation: dict[str, np.ndarray]) -> None:
        """
        :param observation: ``common`` is read, nothing else
        """
        green, (first, second) = green_cube(observation), others(observation)
        if green not in self.readings:
            self.weigh(green)
        elif first not in self.readings:
            self.actions = [(first, LOW, CLOSE), (first, HIGH, CLOSE)]
        elif abs(GREEN_MASS * self.readings[first] / self.readings[green] / RED_MASS - 1.0) < TOLERANCE:
            self.actions = [(green, MIDDLE, OPEN)]
        else:
            self.actions = [(first, LOW, OPEN), *pick_and_stack(second, green)]


class WeighWithoutGreen(Script):
    """
    Weigh the two others only, and exclude what would need a bias beyond its range; where both are possible, guess.

    That is all that two readings tell, as both assignments are equally likely otherwise.

    :param rng: of the guess
    """

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self.rng = rng

    def plan(self, observation: dict[str, np.ndarray]) -> None:
        """
        :param observation: ``common`` is read, nothing else
        """
        cubes = others(observation)
        unknown = [cube for cube in cubes if cube not in self.readings]
        if unknown:
            self.weigh(unknown[0])
            return
        possible = [cube for cube in cubes if abs(math.log(self.readings[cube] / RED_MASS)) <= math.log(GREATEST_BIAS) + 1e-6]
        self.actions = pick_and_stack(int(self.rng.choice(possible or cubes)), green_cube(observation))
