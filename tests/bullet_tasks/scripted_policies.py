"""Hand-written policies that show what a task allows, and a loop that runs them."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import gymnasium
import numpy as np

from bullet_tasks.tasks.navigation import MAX_TURN

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]

POSITION_SCALE = 8.0  # m, of the pose in `common`
LOOK_AHEAD = 1.0  # m
NEAR = 0.35  # m; a waypoint this near is passed, as is the turning radius
GOAL_BEHIND = 3.56  # m; walking on the middle line, a robot this far out has passed the rim of any goal circle


class Episode(NamedTuple):
    """What became of an episode."""

    success: bool
    decisions: int
    terminated: bool
    rewards: list[float]
    infos: list[dict]


def walk(observation: dict[str, np.ndarray], direction: float) -> np.ndarray:
    """
    Walk along the middle line of the corridor.

    :param observation: ``common`` is read, nothing else
    :param direction: 1 towards +x, -1 towards -x
    """
    _, y, cos_yaw, sin_yaw = map(float, observation["common"])
    heading = math.atan2(-y * POSITION_SCALE, direction * LOOK_AHEAD)
    turn = math.remainder(heading - math.atan2(sin_yaw, cos_yaw), math.tau)
    return np.array([max(-1.0, min(1.0, turn / MAX_TURN))], dtype=np.float32)


def informed(observation: dict[str, np.ndarray]) -> np.ndarray:
    """
    Walk straight to the goal, which only a privileged robot can.

    :param observation: with ``privileged``
    """
    return walk(observation, math.copysign(1.0, float(observation["privileged"][0])))


def misled(observation: dict[str, np.ndarray]) -> np.ndarray:
    """
    Walk straight to the wrong end.

    :param observation: with ``privileged``
    """
    return walk(observation, -math.copysign(1.0, float(observation["privileged"][0])))


class Blind:
    """
    The best that a robot without privileged knowledge can do: one end first, then the other.

    :param first: the end to look at first, 1 or -1; by default the one that the robot faces at the start
    """

    def __init__(self, first: float | None = None) -> None:
        self.direction = first

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else
        """
        x = float(observation["common"][0]) * POSITION_SCALE
        if self.direction is None:
            self.direction = math.copysign(1.0, float(observation["common"][2]))
        if self.direction * x > GOAL_BEHIND:
            self.direction = -self.direction
        return walk(observation, self.direction)


def position(observation: dict[str, np.ndarray]) -> tuple[float, float]:
    """
    Where the robot is, m.

    :param observation: ``common`` is read, nothing else
    """
    return float(observation["common"][0]) * POSITION_SCALE, float(observation["common"][1]) * POSITION_SCALE


def towards(observation: dict[str, np.ndarray], point: tuple[float, float]) -> np.ndarray:
    """
    Walk straight to a point.

    :param observation: ``common`` is read, nothing else
    :param point: m
    """
    x, y = position(observation)
    heading = math.atan2(point[1] - y, point[0] - x)
    turn = math.remainder(heading - math.atan2(float(observation["common"][3]), float(observation["common"][2])), math.tau)
    return np.array([max(-1.0, min(1.0, turn / MAX_TURN))], dtype=np.float32)


class Route:
    """
    Walk from point to point.

    :param points: m; the last one is walked to for ever
    """

    def __init__(self, points: Sequence[tuple[float, float]] = ()) -> None:
        self.points = list(points)

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else
        """
        while len(self.points) > 1 and math.dist(position(observation), self.points[0]) < NEAR:
            del self.points[0]
        return towards(observation, self.points[0])


def maze_route(sign_x: float, sign_y: float) -> list[tuple[float, float]]:
    """
    The roads of Square Maze to a corner, from the trunk or the crossing road.

    :param sign_x: of the corner
    :param sign_y: of the corner
    """
    return [(0.0, 0.0), (sign_x * 2.2, 0.0), (sign_x * 2.4, sign_y * 1.55)]


class MazeProbe:
    """Solve Square Maze blind: walk straight into each junction and feel whether the road goes on."""

    # Where a base that walks straight on is stopped by the curb of a T is 0.43 and 2.67 m from the middle.
    OPEN_SOUTH, OPEN_SIDE = 0.6, 2.8  # m
    STOPPED = 0.05  # m; less way than this within a decision, with 0.175 m asked for

    def __init__(self) -> None:
        self.side: float | None = None
        self.route: Route | None = None
        self.last = (math.inf, math.inf)

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` is read, nothing else
        """
        x, y = here = position(observation)
        stopped = math.dist(here, self.last) < self.STOPPED
        self.last = here
        if self.side is None and (stopped or y < -self.OPEN_SOUTH):
            self.side = -1.0 if stopped else 1.0
            self.last = (math.inf, math.inf)
        if self.side is None:
            return towards(observation, (0.0, y - LOOK_AHEAD))
        beyond = abs(x) > self.OPEN_SIDE
        if self.route is None and (beyond or (stopped and abs(x) > self.OPEN_SIDE - 0.2)):
            self.route = Route(maze_route(self.side, 1.0 if beyond else -1.0)[1:])
        if self.route is None:
            return towards(observation, (x + self.side * LOOK_AHEAD, 0.0))
        return self.route(observation)


def scandots_in_world(observation: dict[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """
    Where the scandots of an observation are, m, ``(n_points, 2)``.

    :param observation: ``common`` is read, nothing else
    :param points: forward and left coordinates of the scandots, m, ``(n_points, 2)``
    """
    c, s = map(float, observation["common"][2:])
    return np.array(position(observation)) + points @ np.array([[c, s], [-s, c]])


class SignReader:
    """
    Solve Signpost Nav without privileged knowledge: walk to the signpost and keep the goals that fit the scandots.

    :param points: of the scandots, m, ``(n_points, 2)``
    """

    N_GOALS = 2500
    POST = np.array([4.65, 0.0])  # m
    HALF_THICKNESS = 0.15  # m
    READING_PLACE = (3.2, 0.0)  # m; the longest signpost ends 0.25 m further
    IN_SIGHT = 1.4  # m from the signpost's centre, a little more than half of the longest
    TALLER = -0.25  # m; a reading below this is on the signpost

    def __init__(self, points: np.ndarray) -> None:
        rng = np.random.default_rng(0)
        distance, angle = rng.uniform(1.3, 3.325, self.N_GOALS), rng.uniform(-math.pi, math.pi, self.N_GOALS)
        self.goals = np.stack((distance * np.cos(angle), distance * np.sin(angle)), axis=1)
        ways = self.goals - self.POST
        distances = np.hypot(*ways.T)
        self.axes = ways / distances[:, None]
        self.half_lengths = 0.4 + 0.1 * distances
        self.misfits = np.zeros(self.N_GOALS)
        self.points = points
        self.has_read = False

    def estimate(self) -> tuple[float, float]:
        """The middle of the goals that fit best, m."""
        x, y = self.goals[self.misfits == self.misfits.min()].mean(axis=0)
        return float(x), float(y)

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` and ``target`` are read, nothing else
        """
        offsets = scandots_in_world(observation, self.points) - self.POST
        near = np.hypot(*offsets.T) < self.IN_SIGHT
        if near.any():
            along = self.axes @ offsets[near].T
            across = np.stack((-self.axes[:, 1], self.axes[:, 0]), axis=1) @ offsets[near].T
            on_post = (np.abs(along) <= self.half_lengths[:, None]) & (np.abs(across) <= self.HALF_THICKNESS)
            self.misfits += (on_post != (observation["target"][near] < self.TALLER)).sum(axis=1)
        self.has_read = self.has_read or math.dist(position(observation), self.READING_PLACE) < NEAR
        return towards(observation, self.estimate() if self.has_read else self.READING_PLACE)


class ColumnReader:
    """
    Solve Midpoint Choice without privileged knowledge: walk a square past the corners until the heights of the columns are
    known, then to the corner of the second tallest.

    :param points: of the scandots, m, ``(n_points, 2)``
    """

    HALF_SQUARE = 0.75  # m
    # Footprint of a column along its corner's diagonal and beside it, m.
    ALONG, BESIDE = (1.65, 1.91), (0.425, 0.78)
    LEAST_HEIGHT = 0.02  # m; columns lower than this are as good as none

    def __init__(self, points: np.ndarray) -> None:
        self.points = points
        self.heights: dict[tuple[float, float], float] = {}
        self.route: Route | None = None
        self.choice: tuple[float, float] | None = None

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` and ``target`` are read, nothing else
        """
        corners = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
        if self.route is None:
            here = position(observation)
            way = [(x * self.HALF_SQUARE, y * self.HALF_SQUARE) for x, y in corners]
            first = min(range(4), key=lambda i: math.dist(here, way[i]))
            self.route = Route((way[first:] + way[:first]) * 3)
        scandots = scandots_in_world(observation, self.points)
        for corner in corners:
            along = scandots @ np.array(corner) / math.sqrt(2.0)
            beside = np.abs(scandots @ np.array((-corner[1], corner[0]))) / math.sqrt(2.0)
            on_column = (self.ALONG[0] < along) & (along < self.ALONG[1])
            on_column &= (self.BESIDE[0] < beside) & (beside < self.BESIDE[1])
            if on_column.any():
                self.heights[corner] = max(float(-observation["target"][on_column].min()), self.heights.get(corner, 0.0))
        ranking = sorted(self.heights, key=lambda corner: -self.heights[corner])
        # One corner has no columns, so three that have some are all.
        known = len(ranking) == 4 or (len(ranking) == 3 and self.heights[ranking[-1]] > self.LEAST_HEIGHT)
        if self.choice is None and known:
            self.choice = ranking[1]
        if self.choice is None:
            return self.route(observation)
        return towards(observation, through_the_gap(observation, self.choice))


def through_the_gap(observation: dict[str, np.ndarray], corner: tuple[float, float]) -> tuple[float, float]:
    """
    Where to walk to in Midpoint Choice to reach a corner between its columns, m.

    :param observation: ``common`` is read, nothing else
    :param corner: signs of its x and y
    """
    x, y = position(observation)
    along, beside = (x * corner[0] + y * corner[1]) / math.sqrt(2.0), (y * corner[0] - x * corner[1]) / math.sqrt(2.0)
    if abs(beside) > 0.3 and 0.6 < along < 1.65:
        # Beside the way between the columns: back, to come from the middle.
        return 0.0, 0.0
    ahead = (along + 0.7) / math.sqrt(2.0)
    return corner[0] * ahead, corner[1] * ahead


def run_episode(env: gymnasium.Env, policy: Policy, seed: int | None = None) -> Episode:
    """
    Run one episode.

    :param env: the environment
    :param policy: observation -> action
    :param seed: of the episode
    """
    observation, _ = env.reset(seed=seed)
    rewards, infos = [], []
    while True:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rewards.append(float(reward))
        infos.append(info)
        if terminated or truncated:
            return Episode(info["is_success"], len(rewards), terminated, rewards, infos)
