"""Laws of giving way: free robots do as they are told, walls are slid along, drops beside the robot are kept away from."""

import math

import numpy as np
import pytest

from bullet_tasks import kernels
from bullet_tasks.robots.gait_walls import FOOTPRINT, clearance, give_way, off_edges
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Cylinder

HALL = Box("hall", (0.0, 0.0, -0.5), (50.0, 50.0, 0.5), floor=True)
WALL = Box("wall", (2.0, 0.0, 0.2), (1.0, 20.0, 0.2))
WALL_TIME, MOST, TURN_ROOM = 0.15, 0.4, 0.03
FRONT = FOOTPRINT[1, 0] + FOOTPRINT[1, 2]


def given_way(shapes, pose, speed=0.7, rate=0.0, lower_ground=-math.inf):
    """Speed ahead and to the left."""
    scene = SceneSpec(tuple(shapes), lower_ground)
    limits = (WALL_TIME, MOST, TURN_ROOM)
    return give_way(scene.packed, scene.lower_ground, FOOTPRINT, pose, 0.0, (speed, rate), limits)


def nearest(pose, at=1.0):
    """Distance of the footprint from a wall that begins at an x, m."""
    x, _, yaw = pose
    return min(at - x - math.cos(yaw) * ahead + math.sin(yaw) * left - radius for ahead, left, radius in FOOTPRINT)


@pytest.mark.parametrize("speed", [0.7, -0.7, 0.0])
def test_a_free_robot_does_as_it_is_told(speed):
    for rate in (0.0, 2.0):
        assert given_way([HALL, WALL], (0.0, 0.0, 0.3), speed, rate) == (speed, 0.0)
    assert given_way([HALL, WALL], (0.6, 0.0, math.pi), abs(speed)) == (abs(speed), 0.0), "a wall behind it is left"


@pytest.mark.parametrize("gap", [0.06, 0.02, 0.0, -0.01])
def test_a_wall_ahead_stops_it_by_hand(gap):
    """At a distance d from a wall, the speed towards it is d / wall_time, and less than nothing beyond it."""
    ahead, left = given_way([HALL, WALL], (1.0 - FRONT - gap, 0.0, 0.0))
    assert ahead == pytest.approx(gap / WALL_TIME, abs=1e-9) and left == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("angle", [0.3, -0.6, 1.0])
def test_it_slides_along_a_wall_as_the_body_without_legs(angle):
    """What is along the wall of the commanded velocity is left alone."""
    pose = (0.0, 0.0, angle)
    pose = (nearest(pose), 0.0, angle)
    ahead, left = given_way([HALL, WALL], pose)
    along = ahead * math.sin(angle) + left * math.cos(angle)
    towards = ahead * math.cos(angle) - left * math.sin(angle)
    assert towards == pytest.approx(0.0, abs=1e-6)
    assert along == pytest.approx(0.7 * math.sin(angle), abs=1e-6)


def test_a_turn_takes_it_further_off():
    pose = (1.0 - FRONT, 0.0, 0.4)
    straight, turning = (given_way([HALL, WALL], pose, 0.3, rate) for rate in (0.0, 1.5))
    towards = [ahead * math.cos(0.4) - left * math.sin(0.4) for ahead, left in (straight, turning)]
    assert towards[1] < towards[0] < 0.0


@pytest.mark.parametrize("angle", [0.1, -0.3, 0.6])
def test_it_slides_over_the_seam_of_two_walls_in_line(angle):
    """The corner of the wall ahead, flush with the one that is slid along, is no obstacle."""
    halves = [Box(f"half_{side}", (2.0, side * 10.0, 0.2), (1.0, 10.0, 0.2)) for side in (-1.0, 1.0)]
    pose = (0.0, 0.0, angle)
    x = nearest(pose)
    for y in np.linspace(-0.5, 0.5, 41):
        assert given_way([HALL, *halves], (x, y, angle)) == pytest.approx(given_way([HALL, WALL], (x, y, angle)), abs=1e-6)


def test_nothing_in_sight_is_approached_faster_than_allowed():
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        x, y = rng.uniform(-1.0, 1.0, 2)
        box = Box("box", (x, y, 0.1), (0.2, 0.1, 0.2), yaw=float(rng.uniform(0.0, 3.0)))
        shapes = SceneSpec((HALL, box)).packed
        yaw = float(rng.uniform(-3.0, 3.0))
        c, s = math.cos(yaw), math.sin(yaw)
        ahead, left = given_way([HALL, box], (0.0, 0.0, yaw))
        for place, side, radius in FOOTPRINT:
            gap, away_x, away_y = clearance(shapes, 1, c * place - s * side, s * place + c * side)
            gap -= radius
            if gap < 0.0:
                continue  # pushed out: limited
            towards = -((c * ahead - s * left) * away_x + (s * ahead + c * left) * away_y)
            assert towards <= gap / WALL_TIME + 0.05
            held += towards > 0.9 * gap / WALL_TIME
        assert abs(ahead) <= 0.7 and abs(left) <= MOST
    assert held > 10


@pytest.mark.parametrize(
    "shape",
    [
        Box("low", (0.3, 0.0, 0.0), (0.1, 1.0, 0.03)),
        Box("high", (0.3, 0.0, 1.0), (0.1, 1.0, 0.2)),
        Box("marker", (0.3, 0.0, 0.2), (0.1, 1.0, 0.2), solid=False),
        Box("step", (0.3, 0.0, 0.0), (0.1, 1.0, 0.08), floor=True),
    ],
)
def test_what_is_no_wall_stops_nobody(shape):
    assert given_way([HALL, shape], (0.0, 0.0, 0.0)) == (0.7, 0.0)


def test_clearance_is_the_distance_of_the_kernels():
    rng = np.random.default_rng(1)
    shapes = SceneSpec((Box("box", (0.3, 0.1, 0.0), (0.5, 0.2, 0.1), yaw=0.7), Cylinder("post", (0.0, 0.4, 0.0), 0.3, 0.1)))
    for x, y in rng.uniform(-1.0, 1.0, (100, 2)):
        for i in range(2):
            assert clearance(shapes.packed, i, x, y) == pytest.approx(kernels.distance(shapes.packed, i, x, y), abs=1e-9)


def test_it_keeps_away_from_drops_beside_it_and_no_others():
    road = SceneSpec((Box("road", (0.0, 0.0, -0.5), (5.0, 0.5, 0.5), floor=True),), lower_ground=-1.0)

    def aside(x, y, yaw=0.0):
        return off_edges(road.packed, road.lower_ground, (x, y, yaw), 0.0)

    assert aside(0.0, 0.0) == aside(0.0, 0.2) == 0.0
    assert aside(0.0, 0.4) < aside(0.0, 0.33) < 0.0 < aside(0.0, -0.4)
    assert aside(0.0, 0.4, math.pi) == pytest.approx(-aside(0.0, 0.4)), "left is the other side"
    assert aside(4.95, 0.0) == 0.0, "before a drop it is told what to do"
    steps = SceneSpec((road.shapes[0], Box("lower", (0.0, 1.0, -0.58), (5.0, 0.5, 0.5), floor=True)), lower_ground=-1.0)
    assert off_edges(steps.packed, steps.lower_ground, (0.0, 0.45, 0.0), 0.0) == 0.0, "a step is no drop"
    fenced = SceneSpec((road.shapes[0], Box("curb", (0.0, 0.6, 0.1), (5.0, 0.1, 0.1))), lower_ground=-1.0)
    assert off_edges(fenced.packed, fenced.lower_ground, (0.0, 0.4, 0.0), 0.0) == 0.0, "nobody falls over a wall"
