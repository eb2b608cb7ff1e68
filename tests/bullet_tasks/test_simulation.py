"""Laws of the simulation: names, contacts, saved states, pictures, closing."""

import copy
import pickle

import numpy as np
import pytest

from bullet_tasks.shapes import Box, Cylinder
from bullet_tasks.simulation import Camera, Simulation

CUBE = Box("cube", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), colour=(1.0, 0.0, 0.0, 1.0))
CAMERA = Camera((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))


@pytest.fixture
def simulation():
    simulation = Simulation()
    simulation.configure(1.0 / 60.0, gravity=9.81)
    yield simulation
    simulation.close()


def drop(simulation):
    simulation.add_body("table", CUBE, (CUBE,), (0.0, 0.0, 0.0))
    return simulation.add_body("cube", CUBE, (CUBE,), (0.0, 0.0, 1.2), mass=2.0)


def test_what_presses_on_a_body_is_felt_by_its_force(simulation):
    body = drop(simulation)
    simulation.step()
    assert not simulation.pressed(body, threshold=0.1)
    for _ in range(180):
        simulation.step()
    # Four corners bear the cube's weight.
    assert simulation.pressed(body, threshold=0.1) and not simulation.pressed(body, threshold=2.0 * 9.81)


def test_a_saved_state_comes_back(simulation):
    body = drop(simulation)
    for _ in range(5):
        simulation.step()
    handle = simulation.save()
    pose = simulation.client.getBasePositionAndOrientation(body)
    for _ in range(20):
        simulation.step()
    assert simulation.client.getBasePositionAndOrientation(body) != pose
    simulation.restore(handle)
    assert simulation.client.getBasePositionAndOrientation(body) == pose


def test_names_are_unique_and_unknown_ones_are_refused(simulation):
    drop(simulation)
    with pytest.raises(ValueError, match=r"already.*table"):
        drop(simulation)
    with pytest.raises(KeyError, match=r"no_such.*cube.*table"):
        simulation.place("no_such", (0.0, 0.0, 0.0))


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_an_open_world_cannot_be_copied(simulation, copied):
    with pytest.raises(TypeError, match=r"neither copied nor pickled.*compiled"):
        copied(simulation)


def test_a_time_step_must_be_positive(simulation):
    with pytest.raises(ValueError, match="substep"):
        simulation.configure(0.0, gravity=0.0)


@pytest.mark.parametrize("shape", [CUBE, Cylinder("disc", (0.0, 0.0, 0.0), 0.5, 0.5, colour=(1.0, 0.0, 0.0, 1.0))])
def test_a_picture_shows_a_body_in_its_colour_and_size(simulation, shape):
    simulation.add_body("thing", None, (shape,), (0.0, 0.0, 0.0))
    picture = simulation.picture(CAMERA, 120, 80)
    assert picture.shape == (80, 120, 3) and picture.dtype == np.uint8
    red = (picture[:, :, 0] > 100) & (picture[:, :, 1] < 60) & (picture[:, :, 2] < 60)
    assert red[40, 60] and not red[5, 5]
    # The top face is 1 m wide, 5.5 m away and seen at 40 degrees over 80 pixels: 20 pixels wide.
    assert red[40].sum() == pytest.approx(20, abs=2)


def test_closing_twice_closes_once():
    simulation = Simulation()
    simulation.close()
    simulation.close()
    assert simulation.closed


def test_a_window_without_a_display_is_refused(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="display"):
        Simulation(gui=True)
