"""Laws of what ends an episode."""

import math

import pytest

from bullet_tasks.ends import OUTCOMES, Ends, Outcome
from bullet_tasks.robots.base import RobotState
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box

SCENE = SceneSpec((Box("floor", (0.0, 0.0, -0.5), (2.0, 2.0, 0.5), floor=True),), lower_ground=-0.8)


def at(x, y):
    return RobotState(x, y, 0.3, 0.0, 0.0, 0.0, False)


def test_the_first_circle_that_holds_the_robot_decides_and_its_rim_counts():
    ends = Ends([(0.0, 0.0, 0.5, Outcome.SUCCESS), (0.5, 0.0, 0.5, Outcome.FAILURE)], SCENE, fall_height=-0.25)
    assert ends(at(0.5, 0.0)) is Outcome.SUCCESS
    assert ends(at(0.51, 0.0)) is Outcome.FAILURE
    assert ends(at(1.0, 0.0)) is Outcome.FAILURE
    assert ends(at(1.01, 0.0)) is Outcome.RUNNING


def test_a_circle_counts_before_a_fall():
    ends = Ends([(3.0, 0.0, 0.5, Outcome.SUCCESS)], SCENE, fall_height=-0.25)
    assert ends(at(3.0, 0.0)) is Outcome.SUCCESS
    assert ends(at(2.1, 0.0)) is Outcome.FAILURE
    assert ends(at(1.9, 0.0)) is Outcome.RUNNING


def test_ground_below_the_fall_height_is_a_fall_and_there_need_be_none():
    assert Ends([], SCENE, fall_height=-0.25)(at(2.1, 0.0)) is Outcome.FAILURE
    assert Ends([], SCENE, fall_height=-0.9)(at(2.1, 0.0)) is Outcome.RUNNING
    assert Ends([], SCENE)(at(2.1, 0.0)) is Outcome.RUNNING
    bottomless = SceneSpec(())
    assert Ends([], bottomless, fall_height=-0.25)(at(0.0, 0.0)) is Outcome.FAILURE


def test_every_outcome_has_a_code():
    assert set(OUTCOMES) == set(Outcome)


@pytest.mark.parametrize("circle", [(math.nan, 0.0, 0.4), (0.0, math.inf, 0.4), (0.0, 0.0, 0.0), (0.0, 0.0, math.nan)])
def test_impossible_circles_are_refused(circle):
    with pytest.raises(ValueError, match="finite centre and a positive radius"):
        Ends([(*circle, Outcome.SUCCESS)], SCENE)
