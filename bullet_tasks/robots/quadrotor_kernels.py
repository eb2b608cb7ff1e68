"""
Compiled flight: a rigid body that follows its inner loop, the ground it may land on, and what ends a flight.

Without constants of other files and with explicit signatures, for the reasons given in ``bullet_tasks.kernels``.
"""

import math

import numba
import numpy as np

X, Y, Z, YAW, VX, VY, VZ, ROLL, PITCH, ROLL_RATE, PITCH_RATE, YAW_RATE, TOUCHING, LANDED, IMPACT, IMPACT_TILT, TIME = range(17)
"""
Entries of a flight's array: position of the centre (m; Z above the ground), angles (rad; roll after pitch after yaw) and their
rates (rad/s), velocity (m/s); 1 or 0 for: touches the ground, stands on it; in the substep of a touchdown its speed (m/s) and
tilt (rad), else 0; time since the start (s).
"""
N_FLIGHT = 17

TARGET_ROLL, TARGET_PITCH, TARGET_ALTITUDE = range(3)
"""Entries of a command's array: rad, rad, m."""

(
    PERIOD,
    HALF_X,
    HALF_Y,
    HALF_Z,
    BANDWIDTH,
    ALTITUDE_GAIN,
    MAX_CLIMB,
    MAX_SINK,
    SPEED_GAIN,
    MAX_ACCELERATION,
    DRAG,
    SETTLING,
    GRAVITY,
) = range(13)
"""
Entries of a body's array: time of a substep (s); half edges (m); bandwidth of the attitude loop (rad/s); gain (1/s) and limits
(m/s) of the altitude loop; gain (1/s) and limit (m/s^2) of the vertical speed loop; horizontal drag (1/s); time constant in
which a body falls on its feet (s); m/s^2.
"""
N_BODY = 13

INERTIA_X, INERTIA_Y, INERTIA_Z, MASS, ARM, MAX_THRUST, YAW_DRAG, LAG, YAW_DAMPING = range(9)
"""
Entries of the array of rotors: inertia about the body's axes (kg m^2); kg; distance of a rotor from the axes of roll and pitch
(m); limit of a thrust (N); torque of a rotor's drag per thrust (m); share of its error that a thrust loses in a substep;
damping of the yaw rate (1/s).
"""
N_ROTORS = 9

HOVER_ALTITUDE, ALTITUDE_TOLERANCE, LEVEL_TOLERANCE, HOLD_TIME, CRASH_SPEED, CRASH_TILT, FLIP_TILT = range(7)
"""
Entries of the array of ends: m; how far from it (m) and from level, in roll and in pitch (rad), still counts, and for how long
(s); a touchdown beyond this speed (m/s) or tilt (rad) is a crash, as is any tilt beyond the last entry (rad).
"""
N_ENDS = 7

RUNNING, SUCCESS, FAILURE = range(3)
"""Codes of how an episode stands, those of ``bullet_tasks.kernels``."""

NOT_HOVERING = -1.0
"""Since when a flight hovers that does not."""

# Bodies nearer to the ground than this touch it; exact contact would depend on rounding.
TOUCH = 1e-4  # m
# A body on the ground that is tilted less than this stands on all its feet.
_STANDS = 0.01  # rad
_TIME_ROUNDING = 1e-9  # s

_ARRAY = "float64[::1]"


@numba.njit(f"float64({_ARRAY}, float64, float64)", cache=True)
def reach_down(body: np.ndarray, roll: float, pitch: float) -> float:
    """
    How far a tilted body reaches below its centre, m.

    :param body: ``(N_BODY,)``
    :param roll: rad
    :param pitch: rad
    """
    along_x = body[HALF_X] * abs(math.sin(pitch))
    along_y = body[HALF_Y] * abs(math.cos(pitch) * math.sin(roll))
    return along_x + along_y + body[HALF_Z] * abs(math.cos(pitch) * math.cos(roll))


@numba.njit(f"float64(float64, float64, float64, {_ARRAY})", cache=True)
def vertical_acceleration(altitude: float, speed: float, target: float, body: np.ndarray) -> float:
    """
    What the altitude loop asks for, m/s^2: a climbing speed from the altitude, an acceleration from the speed.

    :param altitude: m
    :param speed: vertical, m/s
    :param target: altitude, m
    :param body: ``(N_BODY,)``
    """
    wanted = max(-body[MAX_SINK], min(body[MAX_CLIMB], body[ALTITUDE_GAIN] * (target - altitude)))
    return max(-body[MAX_ACCELERATION], min(body[MAX_ACCELERATION], body[SPEED_GAIN] * (wanted - speed)))


@numba.njit(f"void({_ARRAY}, {_ARRAY}, {_ARRAY})", cache=True)
def fly(flight: np.ndarray, command: np.ndarray, body: np.ndarray) -> None:
    """
    Let a substep pass in free air. Angles and altitude do not act on each other, as with an autopilot that compensates for it.

    :param flight: ``(N_FLIGHT,)``, changed
    :param command: ``(3,)``
    :param body: ``(N_BODY,)``
    """
    dt, w = body[PERIOD], body[BANDWIDTH]
    lift = vertical_acceleration(flight[Z] - body[HALF_Z], flight[VZ], command[TARGET_ALTITUDE], body)
    flight[VZ] += dt * lift
    flight[Z] += dt * flight[VZ]
    flight[ROLL_RATE] += dt * (w * w * (command[TARGET_ROLL] - flight[ROLL]) - 2.0 * w * flight[ROLL_RATE])
    flight[PITCH_RATE] += dt * (w * w * (command[TARGET_PITCH] - flight[PITCH]) - 2.0 * w * flight[PITCH_RATE])
    flight[ROLL] += dt * flight[ROLL_RATE]
    flight[PITCH] += dt * flight[PITCH_RATE]
    # Thrust leans with the body; its vertical part is what the altitude loop asks for.
    force = body[GRAVITY] + lift
    forward = force * math.tan(flight[PITCH])
    left = -force * math.tan(flight[ROLL]) / math.cos(flight[PITCH])
    c, s = math.cos(flight[YAW]), math.sin(flight[YAW])
    flight[VX] += dt * (c * forward - s * left - body[DRAG] * flight[VX])
    flight[VY] += dt * (s * forward + c * left - body[DRAG] * flight[VY])
    flight[X] += dt * flight[VX]
    flight[Y] += dt * flight[VY]
    flight[TIME] += dt


@numba.njit(f"boolean({_ARRAY}, {_ARRAY})", cache=True)
def touches(flight: np.ndarray, body: np.ndarray) -> bool:
    """
    Whether a body is on flat ground.

    :param flight: ``(N_FLIGHT,)``
    :param body: ``(N_BODY,)``
    """
    return flight[Z] - reach_down(body, flight[ROLL], flight[PITCH]) <= TOUCH


@numba.njit(f"void({_ARRAY}, {_ARRAY}, boolean)", cache=True)
def ground(flight: np.ndarray, body: np.ndarray, touching: bool) -> None:
    """
    What the ground does to a body after a substep: carries it, brakes it and sets it on its feet, unless it climbs.

    :param flight: ``(N_FLIGHT,)``, changed
    :param body: ``(N_BODY,)``
    :param touching: whether it touches the ground
    """
    was_touching, was_standing = flight[TOUCHING], flight[LANDED]
    flight[TOUCHING] = flight[LANDED] = flight[IMPACT] = flight[IMPACT_TILT] = 0.0
    if not touching:
        return
    flight[TOUCHING] = 1.0
    if was_touching == 0.0:
        flight[IMPACT] = max(0.0, -flight[VZ])
        flight[IMPACT_TILT] = math.hypot(flight[ROLL], flight[PITCH])
    if flight[VZ] <= 0.0:
        dt = body[PERIOD]
        left = math.exp(-dt / body[SETTLING])
        if was_standing != 0.0:
            left = 0.0
        roll, pitch = left * flight[ROLL], left * flight[PITCH]
        if math.hypot(roll, pitch) < _STANDS:
            roll = pitch = 0.0
            flight[LANDED] = 1.0
        flight[ROLL_RATE] = -roll / body[SETTLING]
        flight[PITCH_RATE] = -pitch / body[SETTLING]
        flight[ROLL], flight[PITCH] = roll, pitch
        flight[VX] *= left
        flight[VY] *= left
        flight[VZ] = 0.0
        flight[Z] = reach_down(body, roll, pitch)
    else:
        flight[Z] = max(flight[Z], reach_down(body, flight[ROLL], flight[PITCH]))


@numba.njit(f"UniTuple(float64, 3)({_ARRAY}, {_ARRAY}, float64, float64, float64)", cache=True)
def _torque(
    flight: np.ndarray, rotors: np.ndarray, roll_acceleration: float, pitch_acceleration: float, yaw_acceleration: float
) -> tuple[float, float, float]:
    """
    Torque about the body's axes that accelerates the angles, N m (3 numbers): Euler's equations.

    :param flight: ``(N_FLIGHT,)``
    :param rotors: ``(N_ROTORS,)``
    :param roll_acceleration: rad/s^2
    :param pitch_acceleration: rad/s^2
    :param yaw_acceleration: rad/s^2
    """
    cr, sr, cp, sp = math.cos(flight[ROLL]), math.sin(flight[ROLL]), math.cos(flight[PITCH]), math.sin(flight[PITCH])
    roll_rate, pitch_rate, yaw_rate = flight[ROLL_RATE], flight[PITCH_RATE], flight[YAW_RATE]
    p = roll_rate - yaw_rate * sp
    q = pitch_rate * cr + yaw_rate * sr * cp
    r = yaw_rate * cr * cp - pitch_rate * sr
    p_dot = roll_acceleration - yaw_acceleration * sp - yaw_rate * pitch_rate * cp
    q_dot = (
        pitch_acceleration * cr
        - pitch_rate * roll_rate * sr
        + yaw_acceleration * sr * cp
        + yaw_rate * (roll_rate * cr * cp - pitch_rate * sr * sp)
    )
    r_dot = (
        yaw_acceleration * cr * cp
        - yaw_rate * (roll_rate * sr * cp + pitch_rate * cr * sp)
        - pitch_acceleration * sr
        - pitch_rate * roll_rate * cr
    )
    x, y, z = rotors[INERTIA_X], rotors[INERTIA_Y], rotors[INERTIA_Z]
    return x * p_dot + (z - y) * q * r, y * q_dot + (x - z) * r * p, z * r_dot + (y - x) * p * q


@numba.njit(f"UniTuple(float64, 6)({_ARRAY}, {_ARRAY}, {_ARRAY}, {_ARRAY}, {_ARRAY})", cache=True)
def spin(
    flight: np.ndarray, command: np.ndarray, body: np.ndarray, rotors: np.ndarray, thrusts: np.ndarray
) -> tuple[float, float, float, float, float, float]:
    """
    Let four thrusts follow the inner loop for a substep; it asks for the same accelerations as that of ``fly``.

    :param flight: ``(N_FLIGHT,)``
    :param command: ``(3,)``
    :param body: ``(N_BODY,)``
    :param rotors: ``(N_ROTORS,)``
    :param thrusts: of the rotors left front, right front, left rear, right rear, N; ``(4,)``, changed
    :return: force of rotors and air (N) and torque of the rotors (N m) in the world, three numbers each
    """
    w = body[BANDWIDTH]
    roll, pitch, yaw = flight[ROLL], flight[PITCH], flight[YAW]
    lift = vertical_acceleration(flight[Z] - body[HALF_Z], flight[VZ], command[TARGET_ALTITUDE], body)
    total = rotors[MASS] * (body[GRAVITY] + lift) / (math.cos(roll) * math.cos(pitch))
    about_x, about_y, about_z = _torque(
        flight,
        rotors,
        w * w * (command[TARGET_ROLL] - roll) - 2.0 * w * flight[ROLL_RATE],
        w * w * (command[TARGET_PITCH] - pitch) - 2.0 * w * flight[PITCH_RATE],
        -rotors[YAW_DAMPING] * flight[YAW_RATE],
    )
    up, left, forward, turning = 0.0, 0.0, 0.0, 0.0
    for i in range(4):
        on_left = 1.0 if i % 2 == 0 else -1.0
        in_front = 1.0 if i < 2 else -1.0
        # Rotors at opposite corners turn the same way.
        sense = -on_left * in_front
        wanted = 0.25 * (total + (on_left * about_x - in_front * about_y) / rotors[ARM] + sense * about_z / rotors[YAW_DRAG])
        thrusts[i] += rotors[LAG] * (max(0.0, min(rotors[MAX_THRUST], wanted)) - thrusts[i])
        up += thrusts[i]
        left += on_left * thrusts[i]
        forward += in_front * thrusts[i]
        turning += sense * thrusts[i]
    torque_x, torque_y, torque_z = rotors[ARM] * left, -rotors[ARM] * forward, rotors[YAW_DRAG] * turning
    cr, sr, cp, sp, cy, sy = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    # Columns of the rotation: yaw, then pitch, then roll.
    xx, xy, xz = cy * cp, sy * cp, -sp
    yx, yy, yz = cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr
    zx, zy, zz = cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr
    air = rotors[MASS] * body[DRAG]
    return (
        up * zx - air * flight[VX],
        up * zy - air * flight[VY],
        up * zz,
        torque_x * xx + torque_y * yx + torque_z * zx,
        torque_x * xy + torque_y * yy + torque_z * zy,
        torque_x * xz + torque_y * yz + torque_z * zz,
    )


@numba.njit(
    f"Tuple((int64, float64))({_ARRAY}, float64, float64, float64, float64, float64, float64, float64)",
    cache=True,
)
def judge(
    ends: np.ndarray,
    altitude: float,
    roll: float,
    pitch: float,
    impact: float,
    impact_tilt: float,
    time: float,
    since: float,
) -> tuple[int, float]:
    """
    How an episode stands after a substep.

    :param ends: ``(N_ENDS,)``
    :param altitude: m
    :param roll: rad
    :param pitch: rad
    :param impact: speed of a touchdown, m/s
    :param impact_tilt: tilt of a touchdown, rad
    :param time: since the start, s
    :param since: time from which on it has hovered where it should, s; ``NOT_HOVERING`` if it does not
    :return: code, and the new ``since``
    """
    if impact > ends[CRASH_SPEED] or impact_tilt > ends[CRASH_TILT] or math.hypot(roll, pitch) > ends[FLIP_TILT]:
        return FAILURE, NOT_HOVERING
    level = abs(roll) <= ends[LEVEL_TOLERANCE] and abs(pitch) <= ends[LEVEL_TOLERANCE]
    if not level or abs(altitude - ends[HOVER_ALTITUDE]) > ends[ALTITUDE_TOLERANCE]:
        return RUNNING, NOT_HOVERING
    if since == NOT_HOVERING:
        since = time
    return (SUCCESS if time - since >= ends[HOLD_TIME] - _TIME_ROUNDING else RUNNING), since


@numba.njit(f"Tuple((int64, int64, int64, float64))({_ARRAY}, {_ARRAY}, {_ARRAY}, {_ARRAY}, float64, int64)", cache=True)
def advance(
    flight: np.ndarray, command: np.ndarray, body: np.ndarray, ends: np.ndarray, since: float, n_substeps: int
) -> tuple[int, int, int, float]:
    """
    Fly until substeps or the episode are over, above flat ground.

    :param flight: ``(N_FLIGHT,)``, changed
    :param command: ``(3,)``
    :param body: ``(N_BODY,)``
    :param ends: ``(N_ENDS,)``
    :param since: see ``judge``
    :param n_substeps: at least 1
    :return: number of substeps done, number of those that touched the ground, code, the new ``since``
    """
    done, n_touching, code = 0, 0, RUNNING
    while done < n_substeps and code == RUNNING:
        fly(flight, command, body)
        ground(flight, body, touches(flight, body))
        done += 1
        if flight[TOUCHING] != 0.0:
            n_touching += 1
        altitude = flight[Z] - body[HALF_Z]
        code, since = judge(
            ends, altitude, flight[ROLL], flight[PITCH], flight[IMPACT], flight[IMPACT_TILT], flight[TIME], since
        )
    return done, n_touching, code, since
