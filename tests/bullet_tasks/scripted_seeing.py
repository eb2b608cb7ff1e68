"""Hand-written policies for the tasks with a depth camera, which read nothing but the pose and the image."""

import math

import numpy as np
from scripted_policies import NEAR, Route, position, through_the_gap, towards

from bullet_tasks.robots.quadruped import BODY_HEIGHT
from bullet_tasks.sensors import CameraPose, DepthCamera
from bullet_tasks.sensors.compiled_depth import CompiledDepth
from bullet_tasks.sensors.scene_arrays import pack
from bullet_tasks.tasks.signpost_nav import SignpostNav

CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


def lens_pose(observation, camera):
    """
    Where the camera is, from what the robot knows of itself.

    :param observation: ``common`` is read, nothing else
    :param camera: of the environment
    """
    x, y = position(observation)
    yaw = math.atan2(float(observation["common"][3]), float(observation["common"][2]))
    pitch = math.pi * float(observation["common"][4]) if len(observation["common"]) > 4 else 0.0
    return CameraPose(x, y, BODY_HEIGHT, yaw, pitch).moved(camera.position, camera.pitch)


def points_in_world(observation, camera):
    """
    What the image shows, m, ``(n_points, 3)``.

    :param observation: ``common`` and ``target`` are read, nothing else
    :param camera: of the environment
    """
    image, lens = observation["target"][0], lens_pose(observation, camera)
    depth = camera.metres(image).astype(float)
    right, up = camera.intrinsics.right[None, :], camera.intrinsics.up[:, None]
    cos_pitch, sin_pitch = math.cos(lens.pitch), math.sin(lens.pitch)
    ahead, left = depth * (cos_pitch + sin_pitch * up), -depth * right
    rise = depth * (cos_pitch * up - sin_pitch)
    c, s = math.cos(lens.yaw), math.sin(lens.yaw)
    points = np.stack((lens.x + c * ahead - s * left, lens.y + s * ahead + c * left, lens.z + rise), axis=-1)
    return points[image < 255]


def along_and_beside(points, corner):
    """
    Coordinates of points along a corner's diagonal and how far to its left they are, m.

    :param points: ``(n, 3)``
    :param corner: signs of its x and y
    """
    x, y = corner
    return points[:, :2] @ np.array((x, y)) / math.sqrt(2.0), points[:, :2] @ np.array((-y, x)) / math.sqrt(2.0)


class SignSeer:
    """
    Solve Signpost Nav by sight: walk to the signpost and keep the goals whose signposts would look most like it.

    :param camera: of the environment
    """

    N_GOALS = 800
    POST = (4.65, 0.0)  # m
    READING_PLACE = (2.9, 0.0)  # m
    IN_SIGHT = 2.6  # m
    GREATEST_ERROR = 0.3  # m; a pixel beside an edge counts no more than this
    BEST = 8  # goals that are averaged

    def __init__(self, camera: DepthCamera) -> None:
        task, rng = SignpostNav(), np.random.default_rng(0)
        scenes, goals = [], []
        for _ in range(self.N_GOALS):
            scenes.append(task.scene.moved(task.reset(rng).placements))
            goals.append(task.goal)
        self.camera, self.scenes, self.goals = camera, pack(scenes), np.array(goals)
        self.caster = CompiledDepth(camera.intrinsics, camera.far)
        self.errors = np.zeros(self.N_GOALS)
        self.has_read = False

    def estimate(self) -> tuple[float, float]:
        """The middle of the goals that fit best, m."""
        x, y = self.goals[np.argsort(self.errors)[: self.BEST]].mean(axis=0)
        return float(x), float(y)

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` and ``target`` are read, nothing else
        """
        here = position(observation)
        if math.dist(here, self.POST) < self.IN_SIGHT:
            lens = lens_pose(observation, self.camera)
            expected = self.caster.render_all(self.scenes, np.tile(lens, (self.N_GOALS, 1)))
            error = np.abs(expected - self.camera.metres(observation["target"]))
            self.errors += np.minimum(error, self.GREATEST_ERROR).mean(axis=(1, 2))
        self.has_read = self.has_read or math.dist(here, self.READING_PLACE) < NEAR
        return towards(observation, self.estimate() if self.has_read else self.READING_PLACE)


class ColumnSeer:
    """
    Solve Midpoint Choice by sight: walk round the middle until a column before every corner, or none, has been seen.

    :param camera: of the environment
    """

    HALF_SQUARE = 0.75  # m
    ALONG, BESIDE = 2.52, 0.74  # m, middle of a column
    HALF_SIZE = (0.22, 0.36)  # m, of its footprint, along and beside
    AHEAD = (0.9, 1.75)  # m; in between, the whole of a column is in the image
    ASIDE = 0.65  # of what is ahead
    ROUNDING = 0.02  # m

    def __init__(self, camera: DepthCamera) -> None:
        self.camera = camera
        self.heights: dict[tuple[float, float], float] = {}
        self.route: Route | None = None
        self.choice: tuple[float, float] | None = None

    def look(self, observation: dict[str, np.ndarray]) -> None:
        """
        Measure the columns that are before the camera.

        :param observation: ``common`` and ``target`` are read, nothing else
        """
        points, lens = points_in_world(observation, self.camera), lens_pose(observation, self.camera)
        c, s = math.cos(lens.yaw), math.sin(lens.yaw)
        for corner in CORNERS:
            along, beside = along_and_beside(points, corner)
            for side in (1.0, -1.0):
                x, y = (np.array(corner) * self.ALONG + side * self.BESIDE * np.array((-corner[1], corner[0]))) / math.sqrt(
                    2.0
                )
                ahead, left = c * (x - lens.x) + s * (y - lens.y), c * (y - lens.y) - s * (x - lens.x)
                if self.AHEAD[0] < ahead < self.AHEAD[1] and abs(left) < self.ASIDE * ahead:
                    on_column = np.abs(along - self.ALONG) < self.HALF_SIZE[0]
                    on_column &= np.abs(side * beside - self.BESIDE) < self.HALF_SIZE[1]
                    heights = np.append(points[on_column, 2], self.ROUNDING) - self.ROUNDING
                    self.heights[corner] = max(float(heights.max()), self.heights.get(corner, 0.0))

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` and ``target`` are read, nothing else
        """
        self.look(observation)
        if self.choice is None and len(self.heights) == len(CORNERS):
            self.choice = sorted(self.heights, key=lambda corner: -self.heights[corner])[1]
        if self.choice is not None:
            return towards(observation, through_the_gap(observation, self.choice))
        if self.route is None:
            way = [(x * self.HALF_SQUARE, y * self.HALF_SQUARE) for x, y in CORNERS]
            first = min(range(4), key=lambda i: math.dist(position(observation), way[i]))
            self.route = Route((way[first:] + way[:first]) * 4)
        return self.route(observation)


class StairFinder:
    """
    Solve Stairway Search by sight: look over the middle of an edge, which shows both of its corners, then over the opposite.

    :param camera: of the environment
    :param pitch: of the body while it looks, in units of the action
    """

    EDGES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
    OUTSIDE = 2.12  # m
    TURNING = 1.72  # m from the middle; the edge is at 2.1 m
    AHEAD = 0.6  # m
    # Where stairs are if a corner has any, however short: along the diagonal at most, beside it at least and at most, m.
    ALONG, BESIDE = 2.55, (0.74, 1.52)
    STEPS, GROUND = (-0.6, -0.15), -0.74  # m
    ENOUGH = 3  # pixels

    def __init__(self, camera: DepthCamera, pitch: float = 1.0) -> None:
        self.camera, self.pitch = camera, pitch
        self.steps = dict.fromkeys(CORNERS, 0)
        self.ground = dict.fromkeys(CORNERS, 0)
        self.edge: tuple[float, float] | None = None
        self.choice: tuple[float, float] | None = None

    def look(self, observation: dict[str, np.ndarray]) -> None:
        """
        Count the pixels that show steps, or ground where steps would be.

        :param observation: ``common`` and ``target`` are read, nothing else
        """
        points = points_in_world(observation, self.camera)
        points = points[np.abs(points[:, :2]).max(axis=1) > self.OUTSIDE]
        for corner in CORNERS:
            along, beside = along_and_beside(points, corner)
            there = (
                (along > 0.0) & (along < self.ALONG) & (self.BESIDE[0] < np.abs(beside)) & (np.abs(beside) < self.BESIDE[1])
            )
            heights = points[there, 2]
            self.steps[corner] += int(((self.STEPS[0] < heights) & (heights < self.STEPS[1])).sum())
            self.ground[corner] += int((heights < self.GROUND).sum())
        possible = [corner for corner in CORNERS if self.ground[corner] < max(self.ENOUGH, self.steps[corner] + 1)]
        most = max(CORNERS, key=lambda corner: self.steps[corner])
        if self.steps[most] >= self.ENOUGH:
            self.choice = most
        elif len(possible) == 1:
            self.choice = possible[0]

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: ``common`` and ``target`` are read, nothing else
        """
        self.look(observation)
        x, y = position(observation)
        if self.choice is not None:
            return np.append(towards(observation, (2.0 * self.choice[0], 2.0 * self.choice[1])), np.float32(0.0))
        if self.edge is None:
            c, s = map(float, observation["common"][2:4])
            self.edge = max(self.EDGES, key=lambda edge: edge[0] * (c + 0.5 * x) + edge[1] * (s + 0.5 * y))
        if x * self.edge[0] + y * self.edge[1] > self.TURNING:
            self.edge = (-self.edge[0], -self.edge[1])
        ahead = x * self.edge[0] + y * self.edge[1] + self.AHEAD
        walk = towards(observation, (ahead * self.edge[0], ahead * self.edge[1]))
        return np.append(walk, np.float32(self.pitch))
