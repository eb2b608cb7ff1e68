"""Laws of shapes and scenes."""

import dataclasses
import math

import numpy as np
import pytest

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Cylinder
from bullet_tasks.simulation import Simulation

LOW = Box("low", (0.0, 0.0, 0.0), (2.0, 2.0, 0.5), floor=True)
HIGH = Box("high", (1.0, 0.0, 0.5), (0.5, 0.5, 0.5), floor=True)
WALL = Box("wall", (0.0, 1.0, 1.0), (0.5, 0.1, 1.0))
DISC = Cylinder("disc", (-5.0, 0.0, 0.0), 1.0, 0.1, floor=True)


def test_the_highest_floor_carries():
    scene = SceneSpec((LOW, HIGH, WALL, DISC), lower_ground=-0.8)
    assert scene.ground_height(0.0, 0.0) == 0.5
    assert scene.ground_height(1.0, 0.0) == 1.0
    assert scene.ground_height(0.0, 1.0) == 0.5, "a wall is no floor"
    assert scene.ground_height(-5.7, 0.7) == pytest.approx(0.1)
    assert scene.ground_height(-5.8, 0.8) == -0.8
    assert SceneSpec((LOW,)).ground_height(3.0, 0.0) == -math.inf


def test_a_turned_box_covers_its_own_footprint():
    box = Box("plank", (1.0, 2.0, 0.0), (1.0, 0.1, 0.1), yaw=math.pi / 4)
    assert box.covers(1.6, 2.6)
    assert not box.covers(1.6, 1.4)
    assert box.covers(1.0 + 0.99 * math.cos(math.pi / 4), 2.0 + 0.99 * math.sin(math.pi / 4))
    assert not box.covers(1.9, 2.0)


def test_moving_a_shape_leaves_the_others_and_the_original():
    scene = SceneSpec((LOW, WALL), lower_ground=-1.0)
    moved = scene.moved({"wall": ((3.0, 0.0, 1.0), 0.5)})
    assert moved["wall"].centre == (3.0, 0.0, 1.0) and moved["wall"].yaw == 0.5
    assert moved["low"] is LOW and scene["wall"] is WALL
    with pytest.raises(KeyError, match="no_such"):
        scene.moved({"no_such": ((0.0, 0.0, 0.0), 0.0)})


def test_the_compiled_ground_is_that_of_the_shapes():
    rng = np.random.default_rng(0)
    shapes = [
        Box(f"b{i}", tuple(rng.uniform(-2, 2, 3)), tuple(rng.uniform(0.1, 1, 3)), yaw=rng.uniform(-4, 4), floor=i % 3 > 0)
        for i in range(12)
    ] + [Cylinder(f"c{i}", tuple(rng.uniform(-2, 2, 3)), *rng.uniform(0.1, 1, 2), floor=i % 3 > 0) for i in range(6)]
    scene = SceneSpec(tuple(shapes), lower_ground=-3.0)
    placements = {name: (tuple(rng.uniform(-2, 2, 3)), rng.uniform(-4, 4)) for name in ("b1", "b2", "b3", "c4", "c5")}
    heights = set()
    for present in (scene, scene.moved(placements), scene.moved(placements).moved({"b1": ((0.0, 0.0, 9.0), 1.0)})):
        for x, y in rng.uniform(-2.5, 2.5, (500, 2)):
            tops = [shape.top for shape in present.shapes if shape.floor and shape.covers(x, y)]
            assert present.ground_height(x, y) == max([-3.0, *tops])
            heights.add(max([-3.0, *tops]))
    assert len(heights) > 12, "many floors were met"


def test_a_moved_scene_is_one_made_of_moved_shapes():
    moved = SceneSpec((LOW, WALL, DISC), -1.0).moved({"wall": ((3.0, 0.0, 1.0), 0.5), "disc": ((0.0, 1.0, 2.0), 0.0)})
    wall = dataclasses.replace(WALL, centre=(3.0, 0.0, 1.0), yaw=0.5)
    made = SceneSpec((LOW, wall, dataclasses.replace(DISC, centre=(0.0, 1.0, 2.0))), -1.0)
    assert moved == made and hash(moved) == hash(made)
    assert moved.packed.tobytes() == made.packed.tobytes()
    assert moved.moved({}) == moved


@pytest.mark.parametrize("placement", [((math.nan, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), math.inf), ((0.0, 0.0), 0.0)])
def test_impossible_placements_are_refused(placement):
    with pytest.raises(ValueError):
        SceneSpec((WALL,)).moved({"wall": placement})


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Box("b", (0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), "'b'.*half_extents"),
        (lambda: Box("b", (0.0, float("nan"), 0.0), (1.0, 1.0, 1.0)), "centre"),
        (lambda: Box("b", (0.0, 0.0), (1.0, 1.0, 1.0)), "centre"),
        (lambda: Box("b", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), yaw=math.inf), "yaw"),
        (lambda: Cylinder("c", (0.0, 0.0, 0.0), -1.0, 1.0), "'c'.*radius"),
        (lambda: SceneSpec((LOW, LOW)), "unique.*low"),
        (lambda: SceneSpec((LOW,), lower_ground=float("nan")), "lower_ground"),
    ],
)
def test_bad_geometry_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_what_only_guides_the_eye_stops_nobody():
    scene = SceneSpec(
        (
            Box("real", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5)),
            Box("picture", (5.0, 0.0, 0.0), (0.5, 0.5, 0.5), solid=False),
        )
    )
    simulation = Simulation()
    scene.build(simulation)
    for x, expected in ((0.0, "real"), (5.0, None)):
        hit = simulation.client.rayTest((x, 0.0, 5.0), (x, 0.0, -5.0))[0][0]
        assert hit == (simulation.body_id(expected) if expected else -1)
    simulation.close()
