"""Target Reaching, the paper's motivating example (Fig. 1)."""

from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces


class TargetReachingEnv(gym.Env):
    """
    **Description.** A point in a square room looks for a target that is at the left or, slightly less often, at the right
    wall. It sees only itself; the episode ends when it touches the target.

    **Observation.** ``common`` (2,): position, room half-widths. ``privileged`` (1,): x of the target / 4 (so that a guess
    without information has a standard deviation of 0.2).

    **Action** (2,): velocity, in units of ``SPEED`` room half-widths per decision.

    **Reward.** 5 per half-width that the target comes closer; +2 when it is reached.

    **Success.** Within ``RADIUS`` of the target. **Time-out** after ``MAX_STEPS`` decisions counts as failure.

    **Optimal behaviour.** Walk to the left wall; if the episode goes on, the target is at the right: turn and walk there.

    **Source.** Fig. 1; sizes are ours, the paper gives none.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (gymnasium's convention)

    decision_period = 0.2
    """s"""
    MAX_STEPS = 50
    SPEED = 0.1
    RADIUS = 0.15
    TARGET_X = 0.8
    LEFT_PROBABILITY = 0.55
    PROGRESS_WEIGHT = 5.0
    SUCCESS_BONUS = 2.0

    PICTURE_SIZE = 240
    """pixels"""

    def __init__(self, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"Unknown render_mode {render_mode!r}; known: None, 'rgb_array'.")
        self.render_mode = render_mode
        limit = 0.25 * self.TARGET_X
        self.observation_space = spaces.Dict(
            {
                "common": spaces.Box(-1.0, 1.0, (2,), np.float32),
                "privileged": spaces.Box(-limit, limit, (1,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-0.2, 0.2, 2)
        left = self.np_random.random() < self.LEFT_PROBABILITY
        self.target = np.array([-self.TARGET_X if left else self.TARGET_X, 0.0])
        return self._observe(), {"is_success": False, "position": self.position.copy()}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        action = np.asarray(action)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"An action must be two finite numbers, got {action.tolist()}.")
        before = np.linalg.norm(self.target - self.position)
        self.position = np.clip(self.position + self.SPEED * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        after = np.linalg.norm(self.target - self.position)
        success = bool(after < self.RADIUS)
        reward = self.PROGRESS_WEIGHT * (before - after) + self.SUCCESS_BONUS * success
        return self._observe(), float(reward), success, False, {"is_success": success, "position": self.position.copy()}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        The room from above: target green, point orange.

        :return: uint8 ``(240, 240, 3)``; None without ``render_mode="rgb_array"``
        """
        if self.render_mode is None:
            return None
        picture = np.full((self.PICTURE_SIZE, self.PICTURE_SIZE, 3), 235, dtype=np.uint8)
        radius = int(0.5 * self.RADIUS * self.PICTURE_SIZE)
        for place, size, colour in ((self.target, radius, (51, 184, 97)), (self.position, radius // 3, (214, 94, 0))):
            x, y = (0.5 * (1.0 + place * np.array([1.0, -1.0])) * self.PICTURE_SIZE).astype(int).tolist()
            cv2.circle(picture, (x, y), size, colour, thickness=-1, lineType=cv2.LINE_AA)
        return picture

    def belief_in_world(self, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Draw a belief about the privileged observation on the map.

        :param mean: ``(1,)``
        :param std: ``(1,)``
        :return: centre and half-widths, ``(2,)`` each, in room half-widths
        """
        return np.array([4.0 * mean[0], 0.0]), np.array([4.0 * std[0], 0.0])

    def _observe(self) -> dict[str, np.ndarray]:
        return {
            "common": self.position.astype(np.float32),
            "privileged": (0.25 * self.target[:1]).astype(np.float32),
        }
