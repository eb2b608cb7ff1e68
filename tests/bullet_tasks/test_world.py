"""Laws of the world: the scene of the present episode, the same in PyBullet."""

import math

import pytest

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box
from bullet_tasks.world import World

SCENE = SceneSpec((Box("a", (0.0, 0.0, 0.0), (1.0, 0.5, 0.5)), Box("b", (5.0, 0.0, 0.0), (1.0, 0.5, 0.5))))


@pytest.fixture
def world():
    world = World(SCENE)
    yield world
    world.close()


def poses(world):
    """Position and yaw of every shape in PyBullet."""
    client, simulation = world.simulation.client, world.simulation
    found = {}
    for shape in SCENE.shapes:
        position, (_, _, z, w) = client.getBasePositionAndOrientation(simulation.body_id(shape.name))
        found[shape.name] = (*position, 2.0 * math.atan2(z, w))
    return found


def test_pybullet_holds_the_scene_of_the_episode(world):
    episodes = [{}, {"a": ((1.0, 2.0, 0.0), 0.5)}, {"b": ((3.0, 0.0, 1.0), -0.5)}, {}]
    for placements in episodes:
        world.place(placements)
        for name, pose in poses(world).items():
            # A shape that an episode says nothing of is where the scene has it, wherever the last episode put it.
            centre, yaw = placements.get(name, (SCENE[name].centre, 0.0))
            assert pose == pytest.approx((*centre, yaw))
            assert (world.scene[name].centre, world.scene[name].yaw) == (centre, yaw)


def test_a_simulation_that_is_opened_late_is_up_to_date(world):
    world.place({"a": ((1.0, 2.0, 0.0), 0.5)})
    assert not world.simulated
    assert poses(world)["a"] == pytest.approx((1.0, 2.0, 0.0, 0.5))
    assert world.simulated


def test_closing_twice_is_harmless_and_a_closed_world_opens_nothing():
    for opened in (False, True):
        world = World(SCENE)
        if opened:
            assert not world.simulation.closed
        world.close()
        world.close()
        with pytest.raises(RuntimeError, match="closed"):
            _ = world.simulation


def test_unknown_shapes_are_refused(world):
    with pytest.raises(KeyError, match="no_such"):
        world.place({"no_such": ((0.0, 0.0, 0.0), 0.0)})
