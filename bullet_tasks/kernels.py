"""
Compiled geometry: scenes as arrays, what carries and what stops a round upright body.

All in one file, and without constants of other files: numba keeps compiled functions between runs and notices changes of the
file that a function is in, but not of others. Signatures are explicit, so that everything is compiled when this is imported,
which is before worker processes are forked.
"""

import math

import numba
import numpy as np

X, Y, COS, SIN, HALF_X, HALF_Y, BOTTOM, TOP, ROUND, SOLID, FLOOR = range(11)
"""
Columns of a scene's array, one row a shape: centre (m), direction of the shape's x axis, half edges or the radius twice (m),
heights of the lower and the upper face (m); 1 or 0 for: a cylinder, others collide with it, its top carries a robot.
"""
N_COLUMNS = 11

CIRCLE_X, CIRCLE_Y, CIRCLE_RADIUS, CIRCLE_CODE = range(4)
"""Columns of an array of circles: centre and radius (m), and what becomes of an episode within."""
RUNNING, SUCCESS, FAILURE = range(3)
"""Codes of how an episode stands."""

RADIUS, MAX_YAW_RATE, YAW_GAIN, YAW_ACCELERATION, PERIOD, PRESSED = range(6)
"""
Entries of a body's array: radius (m), limit (rad/s) and gain (1/s) of the heading law, greatest change of the yaw rate
(rad/s^2), time of a substep (s), change of speed in a substep that counts as a collision (m/s).
"""
N_BODY = 6

# How Bullet treats a contact, measured on its own cylinder at a wall (PyBullet 3.2.7): it sees one this much ahead, relative
# to the radius of the smaller shape's bounding sphere; lets bodies sink in by so much; and takes that part of a deeper
# penetration away in a step.
_SEEN_AHEAD = 0.02
_SLOP = 1e-5  # m
_CORRECTION = 0.08
_ITERATIONS = 50
_CONVERGED = 1e-12  # m/s

_SHAPES = "float64[:, ::1]"
_CIRCLES = "float64[:, ::1]"
_BODY = "float64[::1]"


@numba.njit(f"float64({_SHAPES}, float64, float64, float64)", cache=True)
def ground_height(shapes: np.ndarray, lower_ground: float, x: float, y: float) -> float:
    """
    Height of what carries a robot at a point: the highest floor there, else the lower ground, m.

    :param shapes: a scene, ``(n, N_COLUMNS)``
    :param lower_ground: m, possibly minus infinity
    :param x: m
    :param y: m
    """
    height = lower_ground
    for i in range(shapes.shape[0]):
        if shapes[i, FLOOR] == 0.0 or shapes[i, TOP] <= height:
            continue
        dx, dy = x - shapes[i, X], y - shapes[i, Y]
        if shapes[i, ROUND] != 0.0:
            covered = dx * dx + dy * dy <= shapes[i, HALF_X] * shapes[i, HALF_X]
        else:
            c, s = shapes[i, COS], shapes[i, SIN]
            covered = abs(c * dx + s * dy) <= shapes[i, HALF_X] and abs(c * dy - s * dx) <= shapes[i, HALF_Y]
        if covered:
            height = shapes[i, TOP]
    return height


@numba.njit(f"int64({_CIRCLES}, float64, {_SHAPES}, float64, float64, float64)", cache=True)
def judge(circles: np.ndarray, fall_height: float, shapes: np.ndarray, lower_ground: float, x: float, y: float) -> int:
    """
    How an episode stands with the robot at a point: the first circle that holds the point decides, else a fall.

    :param circles: ``(n, 4)``
    :param fall_height: a robot over ground lower than this has fallen, m
    :param shapes: a scene, ``(n, N_COLUMNS)``
    :param lower_ground: m
    :param x: m
    :param y: m
    :return: ``RUNNING`` or the code of a circle or ``FAILURE``
    """
    for i in range(circles.shape[0]):
        if math.hypot(circles[i, CIRCLE_X] - x, circles[i, CIRCLE_Y] - y) <= circles[i, CIRCLE_RADIUS]:
            return int(circles[i, CIRCLE_CODE])
    if fall_height > -math.inf and ground_height(shapes, lower_ground, x, y) < fall_height:
        return FAILURE
    return RUNNING


@numba.njit(f"UniTuple(float64, 3)({_SHAPES}, int64, float64, float64)", cache=True)
def distance(shapes: np.ndarray, i: int, x: float, y: float) -> tuple[float, float, float]:
    """
    Horizontal distance from a shape's outline to a point, negative inside.

    :param shapes: a scene, ``(n, N_COLUMNS)``
    :param i: index of the shape
    :param x: m
    :param y: m
    :return: distance (m), and the direction from the nearest point of the outline outwards (2 numbers)
    """
    dx, dy = x - shapes[i, X], y - shapes[i, Y]
    if shapes[i, ROUND] != 0.0:
        length = math.sqrt(dx * dx + dy * dy)
        if length == 0.0:
            return -shapes[i, HALF_X], 1.0, 0.0
        return length - shapes[i, HALF_X], dx / length, dy / length
    c, s = shapes[i, COS], shapes[i, SIN]
    along, across = c * dx + s * dy, c * dy - s * dx
    out_x, out_y = abs(along) - shapes[i, HALF_X], abs(across) - shapes[i, HALF_Y]
    away_x, away_y = math.copysign(1.0, along), math.copysign(1.0, across)
    if out_x > 0.0 and out_y > 0.0:
        length = math.sqrt(out_x * out_x + out_y * out_y)
        away_x, away_y = away_x * out_x / length, away_y * out_y / length
    elif out_x > out_y:
        length, away_y = out_x, 0.0
    else:
        length, away_x = out_y, 0.0
    return length, c * away_x - s * away_y, s * away_x + c * away_y


@numba.njit(f"Tuple((float64, float64, boolean))({_SHAPES}, {_BODY}, float64[:, ::1], UniTuple(float64, 6))", cache=True)
def _blocked(
    shapes: np.ndarray, body: np.ndarray, contacts: np.ndarray, motion: tuple[float, float, float, float, float, float]
) -> tuple[float, float, bool]:
    """
    What walls leave of a velocity, as Bullet's solver has it for a body without friction that keeps upright and its height.

    :param shapes: a scene
    :param body: of the robot
    :param contacts: room for the contacts, ``(n_shapes, 4)``: normal, least speed along it (m/s), change of speed along it
    :param motion: x, y (m), velocity along x and y (m/s), heights of the body's lower and upper face (m)
    :return: velocity (m/s), and whether anything presses
    """
    x, y, vx, vy, bottom, top = motion
    radius, period = body[RADIUS], body[PERIOD]
    half_height = 0.5 * (top - bottom)
    body_reach = math.sqrt(2.0 * radius * radius + half_height * half_height)
    pressed = False
    n = 0
    for i in range(shapes.shape[0]):
        overlap = min(top - shapes[i, BOTTOM], shapes[i, TOP] - bottom)
        if shapes[i, SOLID] == 0.0 or overlap <= 0.0:
            continue
        outside, normal_x, normal_y = distance(shapes, i, x, y)
        gap = outside - radius
        half_x, half_y, half_z = shapes[i, HALF_X], shapes[i, HALF_Y], 0.5 * (shapes[i, TOP] - shapes[i, BOTTOM])
        reach = min(body_reach, math.sqrt(half_x * half_x + half_y * half_y + half_z * half_z))
        if gap > _SEEN_AHEAD * reach:
            continue
        depth = -(gap + _SLOP)
        if depth > overlap:
            # The shortest way out is up or down, which is barred: the body wades through.
            pressed = pressed or _CORRECTION * overlap > body[PRESSED] * period
            continue
        contacts[n, 0], contacts[n, 1] = normal_x, normal_y
        contacts[n, 2] = depth / period if depth < 0.0 else _CORRECTION * depth / period
        contacts[n, 3] = 0.0
        n += 1
    for _ in range(_ITERATIONS):
        largest = 0.0
        for k in range(n):
            normal_x, normal_y = contacts[k, 0], contacts[k, 1]
            wanted = contacts[k, 2] - (vx * normal_x + vy * normal_y)
            # A contact pushes and never pulls, in sum.
            change = max(-contacts[k, 3], wanted)
            contacts[k, 3] += change
            vx += change * normal_x
            vy += change * normal_y
            largest = max(largest, abs(change))
        if largest <= _CONVERGED:
            break
    for k in range(n):
        pressed = pressed or contacts[k, 3] > body[PRESSED]
    return vx, vy, pressed


@numba.njit(
    "Tuple((float64, float64, float64, float64, float64, float64, boolean, int64, int64, int64))"
    f"({_SHAPES}, float64, {_CIRCLES}, float64, {_BODY}, "
    "float64, float64, float64, float64, float64, float64, float64, float64, int64)",
    cache=True,
)
def walk(
    shapes: np.ndarray,
    lower_ground: float,
    circles: np.ndarray,
    fall_height: float,
    body: np.ndarray,
    x: float,
    y: float,
    yaw: float,
    yaw_rate: float,
    speed: float,
    target_yaw: float,
    bottom: float,
    top: float,
    n_substeps: int,
) -> tuple[float, float, float, float, float, float, bool, int, int, int]:
    """
    Walk at a speed and turn towards a heading until substeps or the episode are over; walls stop a body or let it slide.

    :param shapes: a scene, ``(n, N_COLUMNS)``
    :param lower_ground: m
    :param circles: that end the episode, ``(n, 4)``
    :param fall_height: a robot over ground lower than this has fallen, m; minus infinity: there are no falls
    :param body: of the robot, ``(N_BODY,)``
    :param x: m
    :param y: m
    :param yaw: rad
    :param yaw_rate: in the substep before, rad/s
    :param speed: m/s
    :param target_yaw: rad, on the same continuous scale as ``yaw``
    :param bottom: height of the body's lower face, m
    :param top: height of the body's upper face, m
    :param n_substeps: at least 1
    :return: x, y, yaw, yaw rate, mean velocity over the last substep (2 numbers), whether something pressed in it; number of
        substeps done, number of those in which something pressed; code of how the episode stands
    """
    period, limit = body[PERIOD], body[MAX_YAW_RATE]
    change = body[YAW_ACCELERATION] * period
    contacts = np.empty((shapes.shape[0], 4))
    vx, vy = 0.0, 0.0
    pressed = False
    done, n_pressed = 0, 0
    code = RUNNING
    while done < n_substeps and code == RUNNING:
        wanted = max(-limit, min(limit, body[YAW_GAIN] * (target_yaw - yaw)))
        yaw_rate = max(yaw_rate - change, min(yaw_rate + change, wanted))
        # The mean heading of the substep makes an arc of chords of the right radius.
        heading = yaw + 0.5 * yaw_rate * period
        motion = (x, y, speed * math.cos(heading), speed * math.sin(heading), bottom, top)
        vx, vy, pressed = _blocked(shapes, body, contacts, motion)
        x += vx * period
        y += vy * period
        yaw += yaw_rate * period
        done += 1
        n_pressed += pressed
        code = judge(circles, fall_height, shapes, lower_ground, x, y)
    return x, y, yaw, yaw_rate, vx, vy, pressed, done, n_pressed, code
