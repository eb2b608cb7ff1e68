"""
Compiled functions of the trot: leg inverse kinematics, footholds on known terrain, and one step of the gait.

Legs are ordered front right, front left, rear right, rear left. Feet are reckoned in the *level frame*: at the trunk's centre,
x ahead, y to the left, turned with the trunk's yaw but neither pitched nor rolled.

All in one file, and without constants of other files, for the reasons that ``bullet_tasks.kernels`` gives.
"""

import functools
import math

import numba
import numpy as np

N_LEGS = 4
FORE = np.array([1.0, 1.0, -1.0, -1.0])
"""1 for a front leg, -1 for a rear one."""
SIDE = np.array([-1.0, 1.0, -1.0, 1.0])
"""1 for a left leg, -1 for a right one."""
HIP_X = 0.183
"""Distance of the hips ahead of or behind the trunk's centre, m (a1.urdf)."""
HIP_Y = 0.047
"""Distance of the hips beside the trunk's centre, m (a1.urdf)."""
HIP_LENGTH = 0.08505
"""From the hip's axis sideways to the leg's plane, m (a1.urdf)."""
LINK_LENGTH = 0.2
"""Length of the upper and of the lower leg, m (a1.urdf)."""
FOOT_RADIUS = 0.02
"""m (a1.urdf)."""
STANCE_WIDTH = HIP_Y + HIP_LENGTH
"""Distance of the feet beside the trunk's centre, m: the legs stand upright."""

LEAST_REACH, MOST_REACH = 0.10, 0.395
"""Least and greatest distance of a foot from its hip, m; a straight leg (0.4 m) has no knee left to bend."""
_MOST_HIP_ANGLE = 0.8  # rad, joint limit (a1.urdf)
_LEAST_FOLD, _MOST_FOLD = 0.93, 2.68  # rad, joint limits of the knee

# Columns of a scene's array, as in ``bullet_tasks.kernels``.
_X, _Y, _COS, _SIN, _HALF_X, _HALF_Y, _BOTTOM, _TOP, _ROUND, _SOLID, _FLOOR = range(11)

# Places that a foot may be moved to, nearest first: fine rings of eight, so that it moves smoothly as the trunk goes along.
_RINGS = np.arange(0.01, 0.165, 0.01)  # m
_DIRECTIONS = np.arange(8) * (math.pi / 4.0)  # rad
_PLACES = np.concatenate(
    [np.zeros((1, 2)), *(r * np.stack((np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)), axis=1) for r in _RINGS)]
)
_STEP_CLIMBED = 0.13  # m; what differs more in height from where the foot stands is no place for it
_GRAVITY = 9.81  # m/s^2
_NOTICED = 0.1  # part of a new foothold's displacement that the edge reflex takes in at every step
_TOUCH_DOWN_LATEST = -0.10  # m; a foot comes no nearer to the trunk than this

# Entries of a packed ``Gait``: its fields, in their order.
(
    _PERIOD,
    _DUTY,
    _HEIGHT,
    _CLEARANCE,
    _NEUTRAL_SHIFT,
    _FORWARD_CAPTURE,
    _SIDEWAYS_CAPTURE,
    _SPEED_FEEDBACK,
    _SIDEWAYS_FEEDBACK,
    _TURN_FEEDBACK,
    _LEAN,
    _SPEED_TRIM,
    _SPEED_TRIM_LIMIT,
    _TURN_TRIM,
    _TURN_TRIM_LIMIT,
    _PITCH_TRIM,
    _PITCH_TRIM_LIMIT,
    _PITCH_FEEDBACK,
    _ROLL_FEEDBACK,
    _SPEED_FILTER,
    _TURN_FILTER,
    _HEIGHT_FILTER,
    _SLOPE_FILTER,
    _SLOPE_GAIN,
    _EDGE,
    _EDGE_REFLEX,
    _ACCELERATION,
    _PITCH_RATE,
    _TURN_LIMIT,
    _TURN_ACCELERATION,
    _REACH,
    _HEADING_FEEDBACK,
    _HEADING_SLACK,
    _WALL_TIME,
    _SIDESTEP,
    _TURN_ROOM,
) = range(36)

# Entries of the gait's memory.
(
    _PHASE,  # of the stride, 0 to 1
    _RAMPED,  # commanded speed after the limit of its change, m/s
    _RAMPED_ASIDE,  # the same for the speed to the left, m/s
    _RAMPED_PITCH,  # the same for the body pitch, rad
    _RAMPED_TURN,  # commanded yaw rate after the limit of its change, rad/s
    _SPEED_ERROR,  # trims: integrals of errors
    _TURN_ERROR,
    _PITCH_ERROR,
    _FORWARD,  # smoothed measured velocity, m/s
    _SIDEWAYS,
    _TURNING,  # smoothed measured yaw rate, rad/s
    _BESIDE,  # how far to the left of their places feet were set down of late, m
    _SLOPE,  # pitch that the terrain asks for, rad
    _TRUNK_Z,  # wanted height of the trunk's centre in the world, m
) = range(14)
N_MEMORY = 14

# Entries of the measurements.
TRUNK_X, TRUNK_Y, TRUNK_Z, ROLL, PITCH, YAW, FORWARD, SIDEWAYS, YAW_RATE = range(9)
"""Entries of the measurements that ``Trot.step`` takes: position in the world (m), attitude (rad), velocity in the level frame
(m/s) and yaw rate (rad/s) of the trunk's centre."""
N_MEASUREMENTS = 9

FOOT_X, FOOT_Y, FOOT_Z, _LIFT_X, _LIFT_Y, _LIFT_Z, GROUND, SWINGS = range(8)
"""Columns of the feet: where they are to be in the level frame, where they left the ground (height: in the world), the height
of the ground that they stand on or left (m), and 1 if they are in the air."""
N_FOOT = 8

_compiled = functools.partial(numba.njit, cache=True, error_model="numpy")
_ROW = "float64[::1]"
_TABLE = "float64[:, ::1]"


@_compiled(f"void(float64, float64, float64, float64, {_ROW})")
def leg_angles(x: float, y: float, z: float, side: float, out: np.ndarray) -> None:
    """
    Joint angles that put a foot somewhere; a place out of reach is pulled into it.

    :param x: from the hip ahead, in the trunk's frame, m
    :param y: from the hip to the left, m
    :param z: from the hip upwards, m
    :param side: 1 for a left leg, -1 for a right one
    :param out: hip, upper and lower joint, rad, ``(3,)``
    """
    sideways = side * HIP_LENGTH
    below = math.sqrt(max(y * y + z * z - sideways * sideways, 1e-4))
    reach = math.sqrt(x * x + below * below)
    scale = max(LEAST_REACH, min(MOST_REACH, reach)) / reach
    ahead, down = x * scale, below * scale
    reach = reach * scale
    fold = math.acos(max(-1.0, min(1.0, reach * reach / (2.0 * LINK_LENGTH * LINK_LENGTH) - 1.0)))
    fold = max(_LEAST_FOLD, min(_MOST_FOLD, fold))
    # The angle from the upright leg's plane, (sideways, -below), to (y, z).
    hip = math.atan2(sideways * z + below * y, sideways * y - below * z)
    out[0] = max(-_MOST_HIP_ANGLE, min(_MOST_HIP_ANGLE, hip))
    # Both links are equally long, so the line from hip to foot halves the knee's angle.
    out[1] = math.atan2(-ahead, down) + 0.5 * fold
    out[2] = -fold


@_compiled(f"UniTuple(float64, 3)({_ROW}, float64)")
def foot_place(angles: np.ndarray, side: float) -> tuple[float, float, float]:
    """
    Where a foot is, seen from its hip in the trunk's frame: the inverse of ``leg_angles``, m.

    :param angles: hip, upper and lower joint, rad, ``(3,)``
    :param side: 1 for a left leg, -1 for a right one
    """
    upper, lower = angles[1], angles[1] + angles[2]
    ahead = -LINK_LENGTH * (math.sin(upper) + math.sin(lower))
    down = LINK_LENGTH * (math.cos(upper) + math.cos(lower))
    c, s = math.cos(angles[0]), math.sin(angles[0])
    sideways = side * HIP_LENGTH
    return ahead, sideways * c + down * s, sideways * s - down * c


@_compiled(f"float64({_TABLE}, float64, float64, float64, float64)")
def standing_height(shapes: np.ndarray, lower_ground: float, x: float, y: float, margin: float) -> float:
    """
    Height at which a foot can stand at a point, m: the highest floor there; infinity within ``margin`` of a wall.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param lower_ground: m, minus infinity if there is none
    :param x: m
    :param y: m
    :param margin: how far to keep from walls, m
    """
    height, wall = lower_ground, -math.inf
    for i in range(shapes.shape[0]):
        is_floor = shapes[i, _FLOOR] != 0.0
        if not is_floor and shapes[i, _SOLID] == 0.0:
            continue
        dx, dy = x - shapes[i, _X], y - shapes[i, _Y]
        room = 0.0 if is_floor else margin
        if shapes[i, _ROUND] != 0.0:
            radius = shapes[i, _HALF_X] + room
            covered = dx * dx + dy * dy <= radius * radius
        else:
            c, s = shapes[i, _COS], shapes[i, _SIN]
            covered = abs(c * dx + s * dy) <= shapes[i, _HALF_X] + room and abs(c * dy - s * dx) <= shapes[i, _HALF_Y] + room
        if covered and is_floor:
            height = max(height, shapes[i, _TOP])
        elif covered:
            wall = max(wall, shapes[i, _TOP])
    return math.inf if wall > height + FOOT_RADIUS else height


@_compiled(f"boolean({_TABLE}, float64, float64, float64, float64, float64)")
def _firm(shapes: np.ndarray, lower_ground: float, x: float, y: float, height: float, edge: float) -> bool:
    """Whether the ground is level within ``edge`` of a point, where it has a height."""
    for dx, dy in ((edge, 0.0), (-edge, 0.0), (0.0, edge), (0.0, -edge)):
        if abs(standing_height(shapes, lower_ground, x + dx, y + dy, 0.0) - height) > FOOT_RADIUS:
            return False
    return True


@_compiled(f"UniTuple(float64, 3)({_TABLE}, float64, float64, float64, float64, float64, float64)")
def foothold(
    shapes: np.ndarray, lower_ground: float, x: float, y: float, ground: float, edge: float, yaw: float
) -> tuple[float, float, float]:
    """
    The place nearest to a point where a foot can stand, and its height, m; the point itself if there is none.

    :param shapes: a scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param lower_ground: m, minus infinity if there is none
    :param x: m
    :param y: m
    :param ground: height that the foot comes from, m
    :param edge: how far to keep from edges and walls, m
    :param yaw: of the robot; other places are looked for ahead of it, behind, beside and between, rad
    """
    c, s = math.cos(yaw), math.sin(yaw)
    for k in range(_PLACES.shape[0]):
        place_x, place_y = x + c * _PLACES[k, 0] - s * _PLACES[k, 1], y + s * _PLACES[k, 0] + c * _PLACES[k, 1]
        height = standing_height(shapes, lower_ground, place_x, place_y, edge)
        if abs(height - ground) <= _STEP_CLIMBED and _firm(shapes, lower_ground, place_x, place_y, height, edge):
            return place_x, place_y, height
    height = standing_height(shapes, lower_ground, x, y, 0.0)
    return x, y, height if abs(height - ground) <= _STEP_CLIMBED else ground


@_compiled("float64(float64)")
def _smooth(part: float) -> float:
    """From 0 to 1 with no speed at either end."""
    part = max(0.0, min(1.0, part))
    return part * part * (3.0 - 2.0 * part)


@_compiled("float64(float64, float64)")
def _clipped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


@_compiled(f"UniTuple(float64, 3)({_ROW}, {_ROW}, {_ROW}, float64, UniTuple(float64, 4))")
def _trimmed(
    gait: np.ndarray, memory: np.ndarray, measured: np.ndarray, dt: float, command: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Speed ahead, speed to the left and yaw rate that the feet are moved for, so that the trunk's are as they are wanted."""
    speed, sidestep, yaw_rate, _ = command
    change = gait[_ACCELERATION] * dt
    memory[_RAMPED] += _clipped(speed - memory[_RAMPED], change)
    memory[_RAMPED_ASIDE] += _clipped(sidestep - memory[_RAMPED_ASIDE], change)
    change = gait[_TURN_ACCELERATION] * dt
    memory[_RAMPED_TURN] += _clipped(yaw_rate - memory[_RAMPED_TURN], change)
    part = min(1.0, dt / gait[_SPEED_FILTER])
    memory[_FORWARD] += part * (measured[FORWARD] - memory[_FORWARD])
    memory[_SIDEWAYS] += part * (measured[SIDEWAYS] - memory[_SIDEWAYS])
    memory[_TURNING] += min(1.0, dt / gait[_TURN_FILTER]) * (measured[YAW_RATE] - memory[_TURNING])
    error = memory[_RAMPED] - memory[_FORWARD]
    memory[_SPEED_ERROR] = _clipped(memory[_SPEED_ERROR] + dt * gait[_SPEED_TRIM] * error, gait[_SPEED_TRIM_LIMIT])
    ahead = memory[_RAMPED] + memory[_SPEED_ERROR] + gait[_SPEED_FEEDBACK] * error
    error = memory[_RAMPED_TURN] - memory[_TURNING]
    memory[_TURN_ERROR] = _clipped(memory[_TURN_ERROR] + dt * gait[_TURN_TRIM] * error, gait[_TURN_TRIM_LIMIT])
    turn = _clipped(memory[_RAMPED_TURN] + memory[_TURN_ERROR] + gait[_TURN_FEEDBACK] * error, gait[_TURN_LIMIT])
    aside = memory[_RAMPED_ASIDE] + gait[_EDGE_REFLEX] * memory[_BESIDE]
    aside += gait[_SIDEWAYS_FEEDBACK] * (memory[_RAMPED_ASIDE] - memory[_SIDEWAYS])
    return ahead, aside, turn


@_compiled(f"UniTuple(float64, 2)({_ROW}, {_ROW}, {_TABLE}, {_ROW}, float64, float64)")
def _posture(
    gait: np.ndarray, memory: np.ndarray, feet: np.ndarray, measured: np.ndarray, dt: float, pitch: float
) -> tuple[float, float]:
    """Pitch and roll that the standing feet are turned by; the trunk's height follows the ground under the feet."""
    front = 0.5 * (feet[0, GROUND] + feet[1, GROUND])
    rear = 0.5 * (feet[2, GROUND] + feet[3, GROUND])
    slope = gait[_SLOPE_GAIN] * math.atan2(rear - front, 2.0 * HIP_X)
    memory[_SLOPE] += min(1.0, dt / gait[_SLOPE_FILTER]) * (slope - memory[_SLOPE])
    height = 0.5 * (front + rear) + FOOT_RADIUS + gait[_HEIGHT]
    memory[_TRUNK_Z] += min(1.0, dt / gait[_HEIGHT_FILTER]) * (height - memory[_TRUNK_Z])
    memory[_RAMPED_PITCH] += _clipped(pitch - memory[_RAMPED_PITCH], gait[_PITCH_RATE] * dt)
    wanted = memory[_RAMPED_PITCH] + memory[_SLOPE]
    error = wanted - measured[PITCH]
    memory[_PITCH_ERROR] = _clipped(memory[_PITCH_ERROR] + dt * gait[_PITCH_TRIM] * error, gait[_PITCH_TRIM_LIMIT])
    return wanted + memory[_PITCH_ERROR] + gait[_PITCH_FEEDBACK] * error, -gait[_ROLL_FEEDBACK] * measured[ROLL]


@_compiled(f"UniTuple(float64, 3)({_ROW}, {_ROW}, {_ROW}, {_ROW}, {_TABLE}, float64, float64, UniTuple(float64, 4))")
def _touch_down(
    gait: np.ndarray,
    memory: np.ndarray,
    foot: np.ndarray,
    measured: np.ndarray,
    shapes: np.ndarray,
    lower_ground: float,
    time_left: float,
    leg: tuple[float, float, float, float],
) -> tuple[float, float, float]:
    """
    Where a swinging foot is to land: x and y in the level frame of now, height in the world, m.

    :param leg: where the foot stands when nothing moves (2 numbers, m), speed (m/s), yaw rate (rad/s)
    """
    neutral_x, neutral_y, speed, yaw_rate = leg
    half_stance = 0.5 * gait[_PERIOD] * gait[_DUTY]
    # Half of the stance ahead of neutral, so that the foot passes neutral in the middle of it.
    c, s = math.cos(yaw_rate * half_stance), math.sin(yaw_rate * half_stance)
    x = c * neutral_x - s * neutral_y + half_stance * speed
    y = s * neutral_x + c * neutral_y + half_stance * memory[_RAMPED_ASIDE]
    x += gait[_FORWARD_CAPTURE] * (memory[_FORWARD] - memory[_RAMPED])
    y += gait[_SIDEWAYS_CAPTURE] * (memory[_SIDEWAYS] - memory[_RAMPED_ASIDE])
    y -= gait[_LEAN] * gait[_HEIGHT] / _GRAVITY * memory[_FORWARD] * yaw_rate
    x = neutral_x + _clipped(x - neutral_x, gait[_REACH])
    y = neutral_y + _clipped(y - neutral_y, gait[_REACH])
    # Where that is in the world at the time of landing.
    yaw = measured[YAW] + time_left * measured[YAW_RATE]
    c, s = math.cos(measured[YAW]), math.sin(measured[YAW])
    base_x = measured[TRUNK_X] + time_left * (c * memory[_FORWARD] - s * memory[_SIDEWAYS])
    base_y = measured[TRUNK_Y] + time_left * (s * memory[_FORWARD] + c * memory[_SIDEWAYS])
    c, s = math.cos(yaw), math.sin(yaw)
    world_x, world_y = base_x + c * x - s * y, base_y + s * x + c * y
    place_x, place_y, height = foothold(shapes, lower_ground, world_x, world_y, foot[GROUND], gait[_EDGE], yaw)
    dx, dy = place_x - world_x, place_y - world_y
    beside = c * dy - s * dx
    memory[_BESIDE] += _NOTICED * (beside - memory[_BESIDE])
    return x + c * dx + s * dy, y + beside, height


@_compiled(f"void({_ROW}, {_ROW}, {_TABLE}, {_TABLE}, float64, float64)")
def stand(gait: np.ndarray, memory: np.ndarray, feet: np.ndarray, angles: np.ndarray, ground: float, phase: float) -> None:
    """
    Forget everything and stand on level ground.

    :param gait: packed
    :param memory: of the gait, ``(N_MEMORY,)``
    :param feet: ``(4, N_FOOT)``
    :param angles: joint angles, rad, ``(4, 3)``
    :param ground: its height, m
    :param phase: of the stride to begin with, 0 to 1
    """
    memory[:] = 0.0
    memory[_PHASE] = phase
    memory[_TRUNK_Z] = ground + FOOT_RADIUS + gait[_HEIGHT]
    feet[:] = 0.0
    for i in range(N_LEGS):
        foot = feet[i]
        foot[FOOT_X], foot[FOOT_Y] = FORE[i] * HIP_X + gait[_NEUTRAL_SHIFT], SIDE[i] * STANCE_WIDTH
        foot[FOOT_Z], foot[GROUND] = -gait[_HEIGHT], ground
        leg_angles(foot[FOOT_X] - FORE[i] * HIP_X, foot[FOOT_Y] - SIDE[i] * HIP_Y, foot[FOOT_Z], SIDE[i], angles[i])


@_compiled(f"void({_ROW}, {_ROW}, {_TABLE}, {_ROW}, {_TABLE}, float64, float64, UniTuple(float64, 4), {_TABLE})")
def step(
    gait: np.ndarray,
    memory: np.ndarray,
    feet: np.ndarray,
    measured: np.ndarray,
    shapes: np.ndarray,
    lower_ground: float,
    dt: float,
    command: tuple[float, float, float, float],
    angles: np.ndarray,
) -> None:
    """
    Let ``dt`` pass; see ``Trot.step``.

    :param gait: packed
    :param memory: of the gait, ``(N_MEMORY,)``
    :param feet: ``(4, N_FOOT)``
    :param measured: of the trunk, ``(N_MEASUREMENTS,)``
    :param shapes: the scene, ``(n, bullet_tasks.kernels.N_COLUMNS)``
    :param lower_ground: height of the ground beside all floors, m
    :param dt: s
    :param command: speed ahead and to the left (m/s), yaw rate (rad/s), pitch (rad)
    :param angles: joint angles, rad, ``(4, 3)``
    """
    speed, sideways, yaw_rate = _trimmed(gait, memory, measured, dt, command)
    pitch, roll = _posture(gait, memory, feet, measured, dt, command[3])
    memory[_PHASE] = (memory[_PHASE] + dt / gait[_PERIOD]) % 1.0
    duty = gait[_DUTY]
    turn_c, turn_s = math.cos(yaw_rate * dt), math.sin(yaw_rate * dt)
    for i in range(N_LEGS):
        foot = feet[i]
        # Diagonal legs step together.
        neutral_x, neutral_y = FORE[i] * HIP_X + gait[_NEUTRAL_SHIFT], SIDE[i] * STANCE_WIDTH
        phase = (memory[_PHASE] + (0.0 if i in (0, 3) else 0.5)) % 1.0
        if phase < duty:
            foot[SWINGS] = 0.0
            x, y = foot[FOOT_X] - speed * dt, foot[FOOT_Y] - sideways * dt
            x, y = turn_c * x + turn_s * y, turn_c * y - turn_s * x
            foot[FOOT_X] = neutral_x + _clipped(x - neutral_x, gait[_REACH])
            foot[FOOT_Y] = neutral_y + _clipped(y - neutral_y, gait[_REACH])
            z = foot[GROUND] + FOOT_RADIUS - memory[_TRUNK_Z]
            tilt, lean = pitch, roll
        else:
            part = (phase - duty) / (1.0 - duty)
            if foot[SWINGS] == 0.0:
                foot[SWINGS] = 1.0
                foot[_LIFT_X], foot[_LIFT_Y], foot[_LIFT_Z] = foot[FOOT_X], foot[FOOT_Y], foot[GROUND]
            leg = (neutral_x, neutral_y, speed, yaw_rate)
            time_left = (1.0 - part) * (1.0 - duty) * gait[_PERIOD]
            x, y, height = _touch_down(gait, memory, foot, measured, shapes, lower_ground, time_left, leg)
            way = _smooth(part)
            foot[FOOT_X] = foot[_LIFT_X] + way * (x - foot[_LIFT_X])
            foot[FOOT_Y] = foot[_LIFT_Y] + way * (y - foot[_LIFT_Y])
            # Up before, and down after most of the way, to clear the edge of a step.
            rise = height - foot[_LIFT_Z]
            way = _smooth(2.0 * part) if rise > 0.0 else _smooth((part - 0.4) / 0.6)
            z = foot[_LIFT_Z] + rise * way + FOOT_RADIUS + gait[_CLEARANCE] * 4.0 * part * (1.0 - part)
            z = min(_TOUCH_DOWN_LATEST, z - measured[TRUNK_Z])
            foot[GROUND] = height
            tilt, lean = measured[PITCH], measured[ROLL]
        foot[FOOT_Z] = z
        c, s = math.cos(tilt), math.sin(tilt)
        x, down = c * foot[FOOT_X] - s * z, s * foot[FOOT_X] + c * z
        c, s = math.cos(lean), math.sin(lean)
        y, z = c * foot[FOOT_Y] + s * down, c * down - s * foot[FOOT_Y]
        leg_angles(x - FORE[i] * HIP_X, y - SIDE[i] * HIP_Y, z, SIDE[i], angles[i])
