"""Active T-Maze, the paper's credit assignment task (App. D.2, Table 9)."""

from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces


class ActiveTMazeEnv(gym.Env):
    """
    **Description.** A corridor of cells ends in a junction, above or below which, equally likely, is the goal. The agent
    starts one cell to the right of an oracle that shows on which side. There is time for the detour to the oracle and then
    straight on to the goal, and not for one wrong step more::

                                  goal?
        oracle start ........ junction
                                  goal?

    **Observation.** ``common`` (2,): whether the agent is at the junction or beyond; then its y if so, else what the oracle
    says. That is +1 or -1 at the first visit to the oracle, and 0 at later ones and everywhere else: all cells before the
    junction look the same, also the start. The observation is the original's, where the hint is no part of its own either.
    ``privileged`` (1,): y of the goal / 4 (so that a guess without information has a standard deviation of 0.25).

    **Action**, discrete: 0 right, 1 up, 2 left, 3 down, by one cell; nothing happens at a wall.

    **Reward.** -1 / ``corridor_length`` for every decision but the last after which the agent is behind the time table,
    x < t - ``ORACLE_LENGTH`` (cells, decisions since the start); +1 if it is at the goal when the episode ends.

    **Success.** At the goal when the episode ends. **End** after exactly ``corridor_length`` + 2 ``ORACLE_LENGTH`` + 1
    decisions, told by ``terminated``: the horizon is part of the task, nothing of value lies beyond it.

    **Optimal behaviour.** Left, right along the corridor, to the goal: return 1. Without the detour: right at once, in half of
    the episodes to the goal, with two decisions to spare.

    **Source.** Ni et al., "When Do Transformers Shine in RL? Decoupling Memory from Credit Assignment", NeurIPS 2023;
    ``TMazeClassicActive`` in their code, with their experiments' penalty. A decision lasts ``decision_period`` by our choice:
    the uncertainty, smoothed over 0.39 s, then falls by half a decision.

    **Training on shorter corridors.** With ``shortest_corridor``, every episode draws its length L between that and
    ``corridor_length`` with a probability of about 1 / L^2: corridors of 2-3, 4-7, 8-15, ... steps then get about as many
    decisions each. What to do does not depend on the length, but only in a short corridor can an agent that still strays find
    out what the oracle is worth.

    :param corridor_length: number of steps from the start to the junction (paper: 500)
    :param shortest_corridor: see above; None: all corridors have ``corridor_length``
    :param render_mode: None or "rgb_array"
    :raises ValueError: for a corridor without a step, a shortest one that is longer, or an unknown ``render_mode``
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (gymnasium's convention)

    decision_period = 0.25
    """s"""
    ORACLE_LENGTH = 1
    """Cells from the oracle to the start."""
    GOAL_REWARD = 1.0
    PRIVILEGED_SCALE = 0.25
    MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))

    PICTURE_WIDTH = 480
    """pixels, at least; no cell is smaller than ``SMALLEST_CELL``"""
    SMALLEST_CELL = 4
    """pixels"""

    def __init__(
        self, corridor_length: int = 500, shortest_corridor: int | None = None, render_mode: str | None = None
    ) -> None:
        if not isinstance(corridor_length, int | np.integer) or corridor_length < 1:
            raise ValueError(
                f"corridor_length={corridor_length!r}: give the number of steps to the junction, an integer >= 1."
            )
        shortest = corridor_length if shortest_corridor is None else shortest_corridor
        if not isinstance(shortest, int | np.integer) or not 1 <= shortest <= corridor_length:
            raise ValueError(f"shortest_corridor={shortest_corridor!r}: give an integer from 1 to {corridor_length}, or None.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"Unknown render_mode {render_mode!r}; known: None, 'rgb_array'.")
        self.render_mode = render_mode
        self.longest, self.shortest = int(corridor_length), int(shortest)
        self._build(self.longest)
        # Made once: an episode of 503 decisions should cost the learner's time, not the maze's.
        self._before_junction = np.zeros(2, np.float32)
        self._hints = {y: np.array([0.0, y], np.float32) for y in (-1, 1)}
        self._beyond = {y: np.array([1.0, y], np.float32) for y in (-1, 0, 1)}
        self._goals = {y: np.array([self.PRIVILEGED_SCALE * y], np.float32) for y in (-1, 1)}
        self.observation_space = spaces.Dict(
            {
                "common": spaces.Box(np.array([0.0, -1.0], np.float32), np.array([1.0, 1.0], np.float32)),
                "privileged": spaces.Box(-self.PRIVILEGED_SCALE, self.PRIVILEGED_SCALE, (1,), np.float32),
            }
        )
        self.action_space = spaces.Discrete(len(self.MOVES))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        if self.shortest < self.longest:
            self._build(int(1.0 / self.np_random.uniform(1.0 / (self.longest + 1), 1.0 / self.shortest)))
        self.x, self.y, self.time = self.ORACLE_LENGTH, 0, 0
        self.goal_y = 1 if self.np_random.random() < 0.5 else -1
        self.oracle_visited = False
        return self._observe(), {"is_success": False, "position": (self.x, self.y)}

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        if not 0 <= action < len(self.MOVES):
            raise ValueError(f"An action must be a whole number from 0 and below {len(self.MOVES)}, got {action}.")
        self.time += 1
        dx, dy = self.MOVES[action]
        if dx and self.y == 0:
            self.x = min(max(self.x + dx, 0), self.junction)
        elif dy and self.x == self.junction:
            self.y = min(max(self.y + dy, -1), 1)
        over = self.time >= self.episode_length
        success = over and self.y == self.goal_y
        if over:
            reward = self.GOAL_REWARD * success
        else:
            reward = self.penalty if self.x < self.time - self.ORACLE_LENGTH else 0.0
        return self._observe(), reward, over, False, {"is_success": success, "position": (self.x, self.y)}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        The maze from above: oracle grey, goal green, agent orange.

        :return: uint8 ``(height, width, 3)``; None without ``render_mode="rgb_array"``
        """
        if self.render_mode is None:
            return None
        n_columns = self.junction + 1
        cell = max(self.SMALLEST_CELL, self.PICTURE_WIDTH // n_columns)
        cells = np.full((3, n_columns, 3), 60, dtype=np.uint8)
        cells[1] = cells[:, -1] = 235
        for (x, y), colour in (
            ((0, 0), (160, 160, 160)),
            ((self.junction, self.goal_y), (51, 184, 97)),
            ((self.x, self.y), (214, 94, 0)),
        ):
            cells[1 - y, x] = colour
        return cv2.resize(cells, None, fx=cell, fy=cell, interpolation=cv2.INTER_NEAREST)

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Draw a belief about the privileged observation on the map.

        :param mean: ``(1,)``
        :param std: ``(1,)``
        :return: centre and half-widths, ``(2,)`` each, in cells
        """
        scale = self.PRIVILEGED_SCALE
        return np.array([self.junction, mean[0] / scale]), np.array([0.0, std[0] / scale])

    def _build(self, corridor_length: int) -> None:
        self.corridor_length = min(max(corridor_length, self.shortest), self.longest)  # against rounding at the ends
        self.junction = self.ORACLE_LENGTH + self.corridor_length
        self.episode_length = self.corridor_length + 2 * self.ORACLE_LENGTH + 1
        self.penalty = -1.0 / self.corridor_length

    def _observe(self) -> dict[str, np.ndarray]:
        if self.x == self.junction:
            common = self._beyond[self.y]
        elif self.x == 0 and not self.oracle_visited:
            self.oracle_visited = True
            common = self._hints[self.goal_y]
        else:
            common = self._before_junction
        return {"common": common.copy(), "privileged": self._goals[self.goal_y].copy()}
