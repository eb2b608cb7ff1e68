"""Laws of the trot: legs reach what they are told to, feet follow their clock, footholds keep off edges and walls."""

import dataclasses
import math

import numpy as np
import pytest

from bullet_tasks import kernels
from bullet_tasks.robots import gait, gait_kernels, gait_walls
from bullet_tasks.robots.gait import FORE, HIP_X, HIP_Y, N_LEGS, SIDE, STANCE_WIDTH, Gait, Trot
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Cylinder

DT = 1.0 / 120.0
PLATFORM = SceneSpec((Box("platform", (0.0, 0.0, -0.5), (2.0, 1.0, 0.5), floor=True),), lower_ground=-1.0)
HALL = SceneSpec((Box("hall", (0.0, 0.0, -0.5), (50.0, 50.0, 0.5), floor=True),))


def standing(x=0.0, y=0.0, yaw=0.0, forward=0.0, z=None):
    """Measurements of a level trunk."""
    measured = np.zeros(gait.N_MEASUREMENTS)
    measured[gait.TRUNK_X], measured[gait.TRUNK_Y], measured[gait.YAW] = x, y, yaw
    measured[gait.TRUNK_Z] = Gait().height + gait.FOOT_RADIUS if z is None else z
    measured[gait.FORWARD] = forward
    return measured


def feet_from_angles(angles):
    """Where joint angles put the feet in the trunk's frame, ``(4, 3)``."""
    places = np.array([gait_kernels.foot_place(angles[i], SIDE[i]) for i in range(N_LEGS)])
    places[:, 0] += FORE * HIP_X
    places[:, 1] += SIDE * HIP_Y
    return places


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_leg_angles_and_foot_place_are_inverse(side):
    rng = np.random.default_rng(0)
    angles = np.empty(3)
    for _ in range(200):
        place = (rng.uniform(-0.1, 0.1), side * rng.uniform(0.05, 0.15), rng.uniform(-0.3, -0.2))
        gait_kernels.leg_angles(*place, side, angles)
        assert gait_kernels.foot_place(angles, side) == pytest.approx(place, abs=1e-9)
        assert angles[2] < 0.0, "the knee bends backwards"


def test_an_upright_leg_by_hand():
    """A foot 0.2 m below the hip's plane of two links of 0.2 m: an equilateral triangle."""
    angles = np.empty(3)
    gait_kernels.leg_angles(0.0, gait.HIP_LENGTH, -0.2, 1.0, angles)
    assert angles == pytest.approx([0.0, math.pi / 3.0, -2.0 * math.pi / 3.0], abs=1e-9)


def test_a_place_out_of_reach_is_pulled_into_it():
    angles = np.empty(3)
    for place in ((0.0, gait.HIP_LENGTH, -1.0), (0.6, 0.3, -0.1), (0.0, 0.0, 0.0), (0.0, 0.1, 0.3)):
        gait_kernels.leg_angles(*place, 1.0, angles)
        assert np.isfinite(angles).all()
        assert abs(angles[0]) <= 0.802851 and -2.696534 <= angles[2] <= -0.916298, "joint limits of a1.urdf"


def test_diagonal_legs_step_together_and_the_duty_is_kept():
    trot = Trot(Gait())
    trot.reset(0.0)
    swinging = []
    # A whole number of strides.
    n = round(100 * trot.gait.period / DT)
    for _ in range(n):
        trot.step(DT, (0.5, 0.0, 0.0, 0.0), standing(forward=0.5), HALL.packed, HALL.lower_ground)
        swinging.append(trot.swinging)
    swinging = np.array(swinging)
    assert np.array_equal(swinging[:, 0], swinging[:, 3]) and np.array_equal(swinging[:, 1], swinging[:, 2])
    assert (swinging.sum(axis=1) <= 2).all(), "two feet are always down"
    assert swinging.mean(axis=0) == pytest.approx(1.0 - trot.gait.duty, abs=0.01)


@pytest.mark.parametrize("speed, aside, yaw_rate", [(0.7, 0.0, 0.0), (0.0, 0.0, 1.0), (0.5, 0.0, -1.0), (0.2, 0.3, 0.0)])
def test_standing_feet_stay_in_place_on_the_ground(speed, aside, yaw_rate):
    """The trunk moves as commanded, so a standing foot moves backwards in its frame and not at all in the world."""
    trot = Trot(Gait(acceleration=1e6, turn_acceleration=1e6))
    trot.reset(0.0)
    x = y = yaw = 0.0
    before, drifts = None, []
    for _ in range(240):
        measured = standing(x, y, yaw, speed)
        measured[gait.SIDEWAYS], measured[gait.YAW_RATE] = aside, yaw_rate
        trot.step(DT, (speed, aside, yaw_rate, 0.0), measured, HALL.packed, HALL.lower_ground)
        yaw += yaw_rate * DT
        x += (speed * math.cos(yaw) - aside * math.sin(yaw)) * DT
        y += (speed * math.sin(yaw) + aside * math.cos(yaw)) * DT
        c, s = math.cos(yaw), math.sin(yaw)
        feet = trot.feet[:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
        down = ~trot.swinging
        if before is not None:
            both = down & before[1]
            drifts += np.hypot(*(feet - before[0])[both].T).tolist()
        before = feet, down
    # Filters are settled in the second half; 0.5 mm a step is 6 cm/s, the filters' remaining error.
    assert len(drifts) > 400
    assert max(drifts[len(drifts) // 2 :]) < 5e-4


def test_joint_angles_put_the_feet_where_they_are_to_be():
    trot = Trot(Gait())
    trot.reset(0.0)
    for _ in range(100):
        angles = trot.step(DT, (0.7, 0.0, 0.5, 0.0), standing(forward=0.7), HALL.packed, HALL.lower_ground)
        assert feet_from_angles(angles) == pytest.approx(trot.feet, abs=1e-6)


def test_a_commanded_pitch_tilts_the_standing_feet():
    """Nose down: front feet higher in the trunk's frame, rear feet lower."""
    trot = Trot(Gait(pitch_rate=1e6))
    trot.reset(0.0)
    angles = trot.step(DT, (0.0, 0.0, 0.0, 0.3), standing(), HALL.packed, HALL.lower_ground)
    heights = feet_from_angles(angles)[:, 2]
    down = ~trot.swinging
    assert down[FORE > 0].any() and down[FORE < 0].any()
    assert heights[down & (FORE > 0)].mean() > heights[down & (FORE < 0)].mean() + 2.0 * HIP_X * math.sin(0.25)


def test_columns_of_a_scene_are_those_of_the_kernels():
    names = ("X", "Y", "COS", "SIN", "HALF_X", "HALF_Y", "BOTTOM", "TOP", "ROUND", "SOLID", "FLOOR")
    for module in (gait_kernels, gait_walls):
        assert [getattr(module, f"_{name}") for name in names] == [getattr(kernels, name) for name in names]
    assert len(names) == kernels.N_COLUMNS


def test_a_foot_can_stand_where_a_floor_is_and_no_wall():
    shapes = (
        Box("floor", (0.0, 0.0, -0.5), (2.0, 1.0, 0.5), floor=True),
        Box("wall", (1.0, 0.0, 0.5), (0.1, 1.0, 0.5)),
        Cylinder("column", (-1.0, 0.0, 0.5), 0.2, 0.5),
        Cylinder("marker", (0.0, 0.5, 0.0), 0.3, 0.2, solid=False),
    )
    scene = SceneSpec(shapes, lower_ground=-1.0)

    def at(x, y):
        return gait_kernels.standing_height(scene.packed, scene.lower_ground, x, y, 0.05)

    assert at(0.0, 0.0) == 0.0 and at(0.0, 0.5) == 0.0, "a marker is not solid"
    assert at(0.0, 1.5) == -1.0
    assert at(0.94, 0.0) == at(1.0, 0.5) == at(1.14, 0.0) == math.inf
    assert at(-0.76, 0.0) == math.inf and at(-0.74, 0.0) == 0.0
    assert at(0.84, 0.0) == 0.0


@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.0])
def test_a_foothold_beyond_an_edge_is_moved_back_by_as_little_as_possible(yaw):
    margin = 0.05
    for over in (-0.2, -0.06, -0.04, 0.0, 0.05):
        x, y, height = gait_kernels.foothold(PLATFORM.packed, PLATFORM.lower_ground, 0.3, 1.0 + over, 0.0, margin, yaw)
        moved = math.hypot(x - 0.3, y - 1.0 - over)
        assert height == 0.0 and y <= 1.0 - margin + 1e-9
        needed = max(0.0, over + margin)
        # Places are 1 cm apart along eight directions, of which one is within an eighth of a half turn.
        assert needed - 1e-9 <= moved <= needed / math.cos(math.pi / 8.0) + 0.011
    nowhere = gait_kernels.foothold(PLATFORM.packed, PLATFORM.lower_ground, 0.3, 2.0, 0.0, margin, yaw)
    assert nowhere == (0.3, 2.0, 0.0), "the foot is put down where it was to go, at its old height"


def test_a_step_is_taken_at_its_height():
    stairs = SceneSpec(
        (
            Box("low", (0.0, 0.0, -0.5), (1.0, 1.0, 0.5), floor=True),
            Box("high", (2.0, 0.0, -0.45), (1.0, 1.0, 0.53), floor=True),
        )
    )
    assert gait_kernels.foothold(stairs.packed, stairs.lower_ground, 1.5, 0.0, 0.0, 0.05, 0.0)[2] == pytest.approx(0.08)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"duty": 0.4}, "duty.*0.5.*0.4"),
        ({"duty": 1.0}, "duty"),
        ({"height": 0.5}, "height.*reach.*0.5"),
        ({"period": 0.0}, "period.*positive"),
        ({"wall_time": 0.0}, "wall_time.*positive"),
        ({"clearance": -0.1}, "clearance.*0 or more.*-0.1"),
        ({"speed_trim": math.nan}, "speed_trim.*finite"),
    ],
)
def test_impossible_gaits_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        Gait(**change)


def test_every_field_has_its_place_in_the_packed_gait():
    fields = [field.name for field in dataclasses.fields(Gait)]
    packed = Gait().packed()
    assert len(packed) == len(fields)
    for i, name in enumerate(fields):
        assert getattr(gait_kernels, f"_{name.upper()}") == i and packed[i] == getattr(Gait(), name)


def test_the_trot_stands_under_its_hips_after_a_reset():
    trot = Trot(Gait())
    trot.reset(0.3, phase=0.25)
    assert trot.ground == pytest.approx(0.3)
    assert trot.feet[:, 1] == pytest.approx(SIDE * STANCE_WIDTH)
    assert trot.feet[:, 2] == pytest.approx(-trot.gait.height)
    assert not trot.swinging.any()
