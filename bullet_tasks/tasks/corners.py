"""What tasks share whose goal is at one of four mirrored corners: the other three are dead zones."""

import numpy as np
from gymnasium import spaces

from bullet_tasks.tasks.navigation import NavigationReward, NavigationTask

PRIVILEGED_SIZE = 0.25
"""A corner is observed as the signs of its coordinates times this (the authors' release), so that knowing nothing is a
standard deviation of 0.25."""

CORNERS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Signs of x and y."""


def quarter_turns(n_common: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """
    Symmetries of a square world whose four corners look alike.

    :param n_common: size of ``common``, which begins with x, y, cos(yaw) and sin(yaw); the rest does not turn
    :return: matrices for ``common`` and ``privileged`` for turns by 90, 180 and 270 degrees
    """
    pairs = []
    for angle in (1, 2, 3):
        matrix = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), angle)
        common = np.eye(n_common)
        common[:2, :2] = common[2:4, 2:4] = matrix
        pairs.append((common, matrix))
    return tuple(pairs)


class CornerTask(NavigationTask):
    """
    Walk to the right one of four corners; a wrong one ends the episode as a failure.

    A subclass sets ``scene`` and calls ``draw_corner`` in ``reset``.

    :param corner: x and y of the corner where both are positive, m
    :param decision_period: s
    :param time_limit: s
    :param goal_radius: radius of the goal and of the dead zones, m
    :param reward: weights
    :raises ValueError: if a number is not positive, the circles of two corners touch, or the periods do not fit into the
        time limit
    """

    def __init__(
        self,
        corner: tuple[float, float],
        decision_period: float,
        time_limit: float,
        goal_radius: float,
        reward: NavigationReward,
    ) -> None:
        super().__init__(decision_period, time_limit, goal_radius, reward)
        if not min(corner) > goal_radius:
            raise ValueError(
                f"Both coordinates of a corner must be greater than `goal_radius` ({goal_radius} m), as the circles of "
                f"mirrored corners touch otherwise, got {corner}."
            )
        self.corner = corner
        self.privileged_space = spaces.Box(-PRIVILEGED_SIZE, PRIVILEGED_SIZE, (2,), np.float32)

    def draw_corner(self, rng: np.random.Generator) -> tuple[float, float]:
        """
        Choose the goal, each corner with equal chance; the others become dead zones.

        :param rng: source of all randomness
        :return: signs of the goal's x and y
        """
        chosen = int(rng.integers(len(CORNERS)))
        places = tuple((sign_x * self.corner[0], sign_y * self.corner[1]) for sign_x, sign_y in CORNERS)
        self.goal = places[chosen]
        self.dead_zones = places[:chosen] + places[chosen + 1 :]
        return CORNERS[chosen]

    def privileged(self) -> np.ndarray:
        """Signs of the goal's x and y, each times 0.25; float32 ``(2,)``."""
        return PRIVILEGED_SIZE * np.sign(np.array(self.goal, dtype=np.float32))

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Put a belief over the goal's corner on the map (see base class).

        :param mean: ``(2,)``
        :param std: ``(2,)``
        :return: centre ``(2,)`` and half-widths ``(2,)`` of one standard deviation, m
        """
        scale = np.array(self.corner) / PRIVILEGED_SIZE
        return np.asarray(mean) * scale, np.asarray(std) * scale
