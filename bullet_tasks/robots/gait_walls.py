"""
How a walking robot gives way: near a wall, its trunk is moved along it, as a round body slides, and aside from drops.

Compiled, without constants of other files, for the reasons that ``bullet_tasks.kernels`` gives.
"""

import math

import numba
import numpy as np

FOOTPRINT = np.array(
    [(0.0, 0.0, 0.21), (0.183, 0.081, 0.050), (0.183, -0.081, 0.050), (-0.28, 0.11, 0.07), (-0.28, -0.11, 0.07)]
)
"""
Discs that stand for the robot, seen from above in the level frame: centre and radius, m. The first is nearly as wide as the
body without legs, so that the robot keeps as far from walls beside it. Then shoulders, half a centimetre more than they are,
as one that rubs on a wall stops what should slide along it; and the knees of the rear legs, which bend backwards.
"""

# Columns of a scene's array, as in ``bullet_tasks.kernels``.
_X, _Y, _COS, _SIN, _HALF_X, _HALF_Y, _BOTTOM, _TOP, _ROUND, _SOLID, _FLOOR = range(11)

_LOW = 0.04  # m; what rises less above the ground is no wall
_TALL = 0.35  # m above the ground; what hangs higher is passed under
_NEAR = 0.75  # m from the trunk's centre; what is further away does not matter yet
_JOINED = 1e-6  # m; walls that near are one
_MOST = 64  # discs near walls that are reckoned with
_SWEEPS = 6
_STEP = 0.13  # m; floors that much lower are a drop
_HALF_LENGTH = 0.12  # m ahead of and behind the trunk's centre, where drops are looked for
_EDGE_SEEN, _EDGE_STEP = 0.2, 0.02  # m to either side, and how finely
_EDGE_TIME, _EDGE_SPEED = 0.5, 0.2  # s, m/s
_SLOW_TURN, _FAST_TURN = 0.8, 2.0  # rad/s; slower turns need no room, and faster ones no more

_TABLE = "float64[:, ::1]"
_TWO, _THREE = "UniTuple(float64, 2)", "UniTuple(float64, 3)"


@numba.njit(f"{_THREE}({_TABLE}, int64, float64, float64)", cache=True, error_model="numpy")
def clearance(shapes: np.ndarray, i: int, x: float, y: float) -> tuple[float, float, float]:
    """
    Horizontal way from a point to a shape, negative inside.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param i: index of the shape
    :param x: m
    :param y: m
    :return: length (m), and the direction away from the shape (2 numbers)
    """
    dx, dy = x - shapes[i, _X], y - shapes[i, _Y]
    if shapes[i, _ROUND] != 0.0:
        centre = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        return centre - shapes[i, _HALF_X], dx / centre, dy / centre
    c, s = shapes[i, _COS], shapes[i, _SIN]
    u, v = c * dx + s * dy, c * dy - s * dx
    over_u, over_v = abs(u) - shapes[i, _HALF_X], abs(v) - shapes[i, _HALF_Y]
    side_u, side_v = math.copysign(1.0, u), math.copysign(1.0, v)
    if over_u > 0.0 and over_v > 0.0:
        gap = math.sqrt(over_u * over_u + over_v * over_v)
        side_u, side_v = side_u * over_u / gap, side_v * over_v / gap
    elif over_u > over_v:
        gap, side_v = over_u, 0.0
    else:
        gap, side_u = over_v, 0.0
    return gap, c * side_u - s * side_v, s * side_u + c * side_v


@numba.njit(f"boolean({_TABLE}, float64, float64, float64)", cache=True, error_model="numpy")
def carried(shapes: np.ndarray, least: float, x: float, y: float) -> bool:
    """
    Whether there is no drop at a point, but a floor, or a wall that one cannot fall over.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param least: what is lower does not count, m
    :param x: m
    :param y: m
    """
    for i in range(shapes.shape[0]):
        if shapes[i, _SOLID] != 0.0 and shapes[i, _TOP] >= least and clearance(shapes, i, x, y)[0] <= 0.0:
            return True
    return False


@numba.njit(f"float64({_TABLE}, float64, {_THREE}, float64)", cache=True, error_model="numpy")
def off_edges(shapes: np.ndarray, lower_ground: float, pose: tuple[float, float, float], ground: float) -> float:
    """
    Speed to the left that takes a robot away from drops beside it; between two drops, or before one, it stays on its way.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param lower_ground: height of the ground beside all floors, m
    :param pose: x and y (m) and yaw (rad) of the trunk's centre
    :param ground: height of what the robot stands on, m
    :return: m/s
    """
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    least = ground - _STEP
    if lower_ground >= least:
        return 0.0
    total = 0.0
    for side in (-1.0, 1.0):
        for ahead in (-_HALF_LENGTH, _HALF_LENGTH):
            # Most robots are nowhere near: the far end is looked at first.
            left = side * _EDGE_SEEN
            if carried(shapes, least, x + c * ahead - s * left, y + s * ahead + c * left):
                continue
            reach = 0.0
            while reach < _EDGE_SEEN:
                left = side * (reach + _EDGE_STEP)
                if not carried(shapes, least, x + c * ahead - s * left, y + s * ahead + c * left):
                    break
                reach += _EDGE_STEP
            total -= side * 0.5 * (_EDGE_SEEN - reach) / _EDGE_TIME
    return max(-_EDGE_SPEED, min(_EDGE_SPEED, total))


@numba.njit(f"boolean({_TABLE}, int64, float64)", cache=True)
def _is_wall(shapes: np.ndarray, i: int, ground: float) -> bool:
    if shapes[i, _SOLID] == 0.0 or shapes[i, _FLOOR] != 0.0:
        return False
    return shapes[i, _TOP] >= ground + _LOW and shapes[i, _BOTTOM] <= ground + _TALL


@numba.njit(f"boolean({_TABLE}, float64, int64, float64, float64)", cache=True, error_model="numpy")
def _hidden(shapes: np.ndarray, ground: float, i: int, x: float, y: float) -> bool:
    """
    Whether the point of a wall that is nearest to another point is part of another wall, which is nearer.

    Where two walls meet in line, the corner of the one ahead would else stop what slides along the other.
    """
    gap, away_x, away_y = clearance(shapes, i, x, y)
    nearest_x, nearest_y = x - gap * away_x, y - gap * away_y
    for j in range(shapes.shape[0]):
        if j == i or not _is_wall(shapes, j, ground) or clearance(shapes, j, nearest_x, nearest_y)[0] > _JOINED:
            continue
        other = clearance(shapes, j, x, y)[0]
        if other < gap - _JOINED or (j < i and other <= gap + _JOINED):
            return True
    return False


@numba.njit(
    f"{_TWO}({_TABLE}, float64, {_TABLE}, {_THREE}, float64, {_TWO}, {_THREE})",
    cache=True,
    error_model="numpy",
)
def give_way(
    shapes: np.ndarray,
    lower_ground: float,
    footprint: np.ndarray,
    pose: tuple[float, float, float],
    ground: float,
    motion: tuple[float, float],
    limits: tuple[float, float, float],
) -> tuple[float, float]:
    """
    Velocity that keeps a robot off walls and drops beside it, as near as possible to the one that it is told.

    No disc of the footprint may approach a wall faster than its distance in ``wall_time``; one that is too near is moved away.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param lower_ground: height of the ground beside all floors, m
    :param footprint: ``(n, 3)``, see ``FOOTPRINT``
    :param pose: x and y (m) and yaw (rad) of the trunk's centre
    :param ground: height of what the robot stands on, m
    :param motion: commanded speed ahead (m/s) and yaw rate (rad/s)
    :param limits: ``wall_time`` (s), greatest speed out of a wall's way (m/s), and how much further off the robot is to be for
        every rad/s that it turns faster than slowly (m)
    :return: speed ahead and to the left, m/s
    """
    x, y, yaw = pose
    speed, rate = motion
    wall_time, most, turn_room = limits
    room = turn_room * max(0.0, min(_FAST_TURN, abs(rate)) - _SLOW_TURN)
    c, s = math.cos(yaw), math.sin(yaw)
    # One row each: direction away from the wall, in the level frame, and least speed along it.
    walls = np.empty((_MOST, 3))
    n = 0
    for i in range(shapes.shape[0]):
        if not _is_wall(shapes, i, ground) or clearance(shapes, i, x, y)[0] > _NEAR:
            continue
        for k in range(footprint.shape[0]):
            ahead, left = footprint[k, 0], footprint[k, 1]
            gap, away_x, away_y = clearance(shapes, i, x + c * ahead - s * left, y + s * ahead + c * left)
            gap -= footprint[k, 2] + room
            least = min(most, -gap / wall_time)
            if least < -most - abs(speed) or n == _MOST:
                continue
            if _hidden(shapes, ground, i, x + c * ahead - s * left, y + s * ahead + c * left):
                continue
            away_ahead, away_left = c * away_x + s * away_y, c * away_y - s * away_x
            # What the turn does to the disc is not left to the trunk's velocity.
            walls[n, 0], walls[n, 1] = away_ahead, away_left
            walls[n, 2] = least - rate * (ahead * away_left - left * away_ahead)
            n += 1
    ahead, left = speed, off_edges(shapes, lower_ground, pose, ground)
    for _ in range(_SWEEPS):
        for k in range(n):
            lacking = min(most, walls[k, 2]) - (ahead * walls[k, 0] + left * walls[k, 1])
            if lacking > 0.0:
                ahead += lacking * walls[k, 0]
                left += lacking * walls[k, 1]
    ahead = max(min(speed, -most), min(max(speed, most), ahead))
    return ahead, max(-most, min(most, left))
