"""
Compiled ray casting: the heights of a scene under points, and depth images of it.

All in one file, and without constants of other files, for the reasons that ``bullet_tasks.kernels`` gives. Only solid shapes
are met. What is not solid, such as a goal's marker, guides the eye; whether a shape is a floor does not matter.

Depth images: every shape is cast only within the image rectangle that its corners span. A ray goes one unit forward, ``right``
units to the right and ``up`` units upwards, so that the parameter along it is the depth. As cameras do not roll, all rays of a
row climb alike: what depends on heights is computed once a row.
"""

import functools
import math

import numba
import numpy as np

X, Y, COS, SIN, HALF_X, HALF_Y, BOTTOM, TOP, ROUND, SOLID = range(10)
"""Columns of a scene's array, as in ``bullet_tasks.kernels``."""

# A corner that is no further ahead of the image plane has no place in the image, m.
_AHEAD = 1e-3
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)

# Without "ninf" and "nnan", as a ray along a face divides by zero and there may be no ground. Numpy's error model returns
# infinity then instead of raising; with the check for it, loops would not be vectorised either.
_compiled = functools.partial(numba.njit, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})

_SHAPES = "float64[:, ::1], int64[::1], float64[::1]"
_POSES = "float64[:, ::1]"
_SHAPE = "float64[::1]"
_ROW = "float32[::1]"
_LENS = "UniTuple(float64, 4)"


@_compiled(f"void({_SHAPES}, {_POSES}, float64[:, ::1], float64, float64, float64, float32[:, ::1])")
def look_down(
    shapes: np.ndarray,
    starts: np.ndarray,
    ground: np.ndarray,
    poses: np.ndarray,
    points: np.ndarray,
    reach: float,
    level: float,
    limit: float,
    out: np.ndarray,
) -> None:
    """
    How far the scenes lie below points that go with robots.

    :param shapes: of ``SceneArrays``
    :param starts: of ``SceneArrays``
    :param ground: of ``SceneArrays``
    :param poses: x, y, z (m) and yaw (rad) of the robots, ``(n, 4)``
    :param points: forward and left coordinates, m, ``(2, n_points)``
    :param reach: distance of the furthest point from the robot, m
    :param level: what lies this far below the robot reads as 0, m
    :param limit: greatest absolute reading, m
    :param out: readings, m, ``(n, n_points)``
    """
    n_points = points.shape[1]
    along, across = points[0], points[1]
    heights = np.empty(n_points)
    for e in range(poses.shape[0]):
        x, y, yaw = poses[e, 0], poses[e, 1], poses[e, 3]
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        heights[:] = ground[e]
        for k in range(starts[e], starts[e + 1]):
            dx, dy = x - shapes[k, X], y - shapes[k, Y]
            half_x, half_y, top = shapes[k, HALF_X], shapes[k, HALF_Y], shapes[k, TOP]
            far = reach + math.sqrt(half_x * half_x + half_y * half_y)
            if shapes[k, SOLID] == 0.0 or dx * dx + dy * dy > far * far:
                continue
            # The points in the shape's own frame.
            c, s = shapes[k, COS], shapes[k, SIN]
            x0, y0 = c * dx + s * dy, c * dy - s * dx
            cos_turn, sin_turn = c * cos_yaw + s * sin_yaw, c * sin_yaw - s * cos_yaw
            if shapes[k, ROUND] != 0.0:
                square = half_x * half_x
                for j in range(n_points):
                    px = x0 + cos_turn * along[j] - sin_turn * across[j]
                    py = y0 + sin_turn * along[j] + cos_turn * across[j]
                    height = top if px * px + py * py <= square else -math.inf
                    heights[j] = height if height > heights[j] else heights[j]
            else:
                for j in range(n_points):
                    px = x0 + cos_turn * along[j] - sin_turn * across[j]
                    py = y0 + sin_turn * along[j] + cos_turn * across[j]
                    height = top if (abs(px) <= half_x) & (abs(py) <= half_y) else -math.inf
                    heights[j] = height if height > heights[j] else heights[j]
        floor = poses[e, 2] - level
        for j in range(n_points):
            out[e, j] = max(-limit, min(limit, floor - heights[j]))


@_compiled(f"UniTuple(int64, 4)({_SHAPE}{', float64' * 7}, {_LENS}, int64, int64, float64)")
def _window(
    shape: np.ndarray,
    cos_turn: float,
    sin_turn: float,
    x: float,
    y: float,
    z: float,
    cos_pitch: float,
    sin_pitch: float,
    lens: tuple[float, float, float, float],
    height: int,
    width: int,
    far: float,
) -> tuple[int, int, int, int]:
    """
    Where in the image a shape may be seen.

    :param shape: one row of a scene's array
    :param cos_turn: cosine of the camera's yaw in the shape's frame
    :param sin_turn: sine of it
    :param x: of the camera in the shape's frame, m
    :param y: of the camera in the shape's frame, m
    :param z: of the camera in the world, m
    :param cos_pitch: of the camera
    :param sin_pitch: of the camera
    :param lens: focal lengths and centre, see ``cast``
    :param height: pixels
    :param width: pixels
    :param far: m
    :return: first row, past the last row, first column, past the last column
    """
    nearest, furthest = math.inf, -math.inf
    left, right, lowest, highest = math.inf, -math.inf, math.inf, -math.inf
    for corner in range(8):
        dx = (shape[HALF_X] if corner & 1 else -shape[HALF_X]) - x
        dy = (shape[HALF_Y] if corner & 2 else -shape[HALF_Y]) - y
        dz = (shape[TOP] if corner & 4 else shape[BOTTOM]) - z
        forward = cos_turn * dx + sin_turn * dy
        depth = cos_pitch * forward - sin_pitch * dz
        nearest, furthest = min(nearest, depth), max(furthest, depth)
        if depth > _AHEAD:
            aside = (sin_turn * dx - cos_turn * dy) / depth
            climb = (sin_pitch * forward + cos_pitch * dz) / depth
            left, right = min(left, aside), max(right, aside)
            lowest, highest = min(lowest, climb), max(highest, climb)
    if furthest <= 0.0 or nearest >= far:
        return 0, 0, 0, 0
    if nearest <= _AHEAD:
        return 0, height, 0, width
    focal_x, focal_y, centre_x, centre_y = lens
    # Rounded outwards: a pixel too many costs little. Clipped before the rounding, as a corner may be far out of the image.
    first_row = math.floor(max(centre_y - focal_y * highest - 0.5, 0.0))
    past_row = math.ceil(min(centre_y - focal_y * lowest + 0.5, float(height)))
    first_column = math.floor(max(centre_x + focal_x * left - 0.5, 0.0))
    past_column = math.ceil(min(centre_x + focal_x * right + 0.5, float(width)))
    return int(first_row), int(past_row), int(first_column), int(past_column)


@_compiled(f"void({_ROW}, {_ROW}{', float32' * 9})")
def _box_row(
    depths: np.ndarray,
    right: np.ndarray,
    forward: float,
    cos_turn: float,
    sin_turn: float,
    x: float,
    y: float,
    half_x: float,
    half_y: float,
    enter_z: float,
    leave_z: float,
) -> None:
    """
    Put a box into a row of an image wherever it is nearer than what is there.

    :param depths: of the row, m, ``(n,)``
    :param right: of the row's rays, ``(n,)``
    :param forward: how far the row's rays go over the ground along the camera's yaw
    :param cos_turn: cosine of the camera's yaw in the box's frame
    :param sin_turn: sine of it
    :param x: of the camera in the box's frame, m
    :param y: of the camera in the box's frame, m
    :param half_x: half of the box's edge, m
    :param half_y: half of the box's edge, m
    :param enter_z: where the rays come between the box's lower and upper face, m
    :param leave_z: where they leave from there, m
    """
    forward_x, forward_y = cos_turn * forward, sin_turn * forward
    behind_x, ahead_x, behind_y, ahead_y = -half_x - x, half_x - x, -half_y - y, half_y - y
    for j in range(len(depths)):
        inverse_x, inverse_y = _ONE / (forward_x + sin_turn * right[j]), _ONE / (forward_y - cos_turn * right[j])
        a, b = behind_x * inverse_x, ahead_x * inverse_x
        c, d = behind_y * inverse_y, ahead_y * inverse_y
        enter_x, leave_x = (a, b) if a < b else (b, a)
        enter_y, leave_y = (c, d) if c < d else (d, c)
        enter = enter_x if enter_x > enter_y else enter_y
        enter = enter if enter > enter_z else enter_z
        leave = leave_x if leave_x < leave_y else leave_y
        leave = leave if leave < leave_z else leave_z
        depths[j] = enter if (enter <= leave) & (enter < depths[j]) else depths[j]


@_compiled(f"void({_ROW}, {_ROW}{', float32' * 6})")
def _cylinder_row(
    depths: np.ndarray, right: np.ndarray, forward: float, x: float, y: float, radius: float, enter_z: float, leave_z: float
) -> None:
    """
    Put an upright cylinder into a row of an image wherever it is nearer than what is there.

    :param depths: of the row, m, ``(n,)``
    :param right: of the row's rays, ``(n,)``
    :param forward: how far the row's rays go over the ground along the camera's yaw
    :param x: of the camera as seen from the axis, along the camera's yaw, m
    :param y: to the left of that, m
    :param radius: m
    :param enter_z: where the rays come between the cylinder's lower and upper face, m
    :param leave_z: where they leave from there, m
    """
    square = radius * radius
    for j in range(len(depths)):
        left = -right[j]
        length = forward * forward + left * left
        # Twice the area between the ray and the axis: more exact than the textbook's discriminant far from the axis.
        miss = x * left - y * forward
        room = square * length - miss * miss
        root = math.sqrt(room if room > _ZERO else _ZERO)
        middle = -(x * forward + y * left)
        inverse = _ONE / length
        enter, leave = (middle - root) * inverse, (middle + root) * inverse
        enter = enter if enter > enter_z else enter_z
        leave = leave if leave < leave_z else leave_z
        depths[j] = enter if (room > _ZERO) & (enter <= leave) & (enter < depths[j]) else depths[j]


@_compiled(f"void({_SHAPE}, float64[::1], {_ROW}, {_ROW}, {_LENS}, float64, float32[:, ::1])")
def _cast_shape(
    shape: np.ndarray,
    pose: np.ndarray,
    right: np.ndarray,
    up: np.ndarray,
    lens: tuple[float, float, float, float],
    far: float,
    image: np.ndarray,
) -> None:
    """
    Put a shape into an image wherever it is nearer than what is there.

    :param shape: one row of a scene's array
    :param pose: of the camera, ``(5,)``
    :param right: see ``cast``
    :param up: see ``cast``
    :param lens: see ``cast``
    :param far: see ``cast``
    :param image: depths, m, ``(height, width)``
    """
    x, y, z, yaw, pitch = pose[0], pose[1], pose[2], pose[3], pose[4]
    cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    is_round = shape[ROUND] != 0.0
    # A cylinder looks the same from everywhere: its x axis may as well be the camera's.
    c, s = (cos_yaw, sin_yaw) if is_round else (shape[COS], shape[SIN])
    dx, dy = x - shape[X], y - shape[Y]
    own_x, own_y = c * dx + s * dy, c * dy - s * dx
    cos_turn, sin_turn = c * cos_yaw + s * sin_yaw, c * sin_yaw - s * cos_yaw
    height, width = image.shape
    first_row, past_row, first_column, past_column = _window(
        shape, cos_turn, sin_turn, own_x, own_y, z, cos_pitch, sin_pitch, lens, height, width, far
    )
    if past_column <= first_column:
        return
    columns = right[first_column:past_column]
    half_x, half_y = shape[HALF_X], shape[HALF_Y]
    below, above = shape[BOTTOM] - z, shape[TOP] - z
    for i in range(first_row, past_row):
        climb = cos_pitch * up[i] - sin_pitch
        if climb != 0.0:
            a, b = below / climb, above / climb
            # From inside a shape nothing else is seen: the depth is 0.
            enter, leave = max(0.0, min(a, b)), max(a, b)
        elif below <= 0.0 <= above:
            enter, leave = 0.0, math.inf
        else:
            continue
        if leave < enter:
            continue
        forward = cos_pitch + sin_pitch * up[i]
        depths = image[i, first_column:past_column]
        # What is computed for every pixel is computed in single precision: the signatures convert.
        if is_round:
            _cylinder_row(depths, columns, forward, own_x, own_y, half_x, enter, leave)
        else:
            _box_row(depths, columns, forward, cos_turn, sin_turn, own_x, own_y, half_x, half_y, enter, leave)


@_compiled(f"void({_SHAPES}, {_POSES}, {_ROW}, {_ROW}, {_LENS}, float64, float32[:, :, ::1])")
def cast(
    shapes: np.ndarray,
    starts: np.ndarray,
    ground: np.ndarray,
    poses: np.ndarray,
    right: np.ndarray,
    up: np.ndarray,
    lens: tuple[float, float, float, float],
    far: float,
    images: np.ndarray,
) -> None:
    """
    Take depth images. From inside a shape, or below the ground, the depth is 0.

    :param shapes: of ``SceneArrays``
    :param starts: of ``SceneArrays``
    :param ground: of ``SceneArrays``
    :param poses: x, y, z (m), yaw and pitch (rad, nose down positive) of the cameras, ``(n, 5)``
    :param right: how far each column looks to the right, per unit of depth, ``(width,)``
    :param up: how far each row looks upwards, per unit of depth, ``(height,)``
    :param lens: focal lengths in pixel widths and heights, and where the optical axis meets the image, see ``Intrinsics``
    :param far: greatest depth, m
    :param images: depth along the optical axis, m, ``(n, height, width)``
    """
    for e in range(poses.shape[0]):
        pitch, above_ground = poses[e, 4], poses[e, 2] - ground[e]
        cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
        for i in range(len(up)):
            descent = sin_pitch - cos_pitch * up[i]
            depth = far
            if above_ground <= 0.0:
                depth = 0.0
            elif descent > 0.0:
                depth = min(far, above_ground / descent)
            images[e, i, :] = depth
        for k in range(starts[e], starts[e + 1]):
            if shapes[k, SOLID] != 0.0:
                _cast_shape(shapes[k], poses[e], right, up, lens, far, images[e])
