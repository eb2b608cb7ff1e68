"""Laws of what domain randomisation is drawn from, for every robot that has it."""

import gymnasium
import pytest

import bullet_tasks  # noqa: F401 (registers the environments)
from bullet_tasks.robots.quadruped import Variation
from bullet_tasks.robots.varied_quadrotor import FlightVariation


@pytest.mark.parametrize("env_id", ["SquareMaze-v0", "BiasedQuadrotor-v0"])
def test_tasks_are_the_same_with_it(env_id):
    varied, compiled = (gymnasium.make(env_id, physics=physics) for physics in ("varied", "compiled"))
    for seed in range(5):
        (seen, _), (reference, _) = varied.reset(seed=seed), compiled.reset(seed=seed)
        assert {key: value.tolist() for key, value in seen.items()} == {
            key: value.tolist() for key, value in reference.items()
        }
    assert varied.observation_space == compiled.observation_space and varied.action_space == compiled.action_space
    varied.close()
    compiled.close()


@pytest.mark.parametrize(
    ("make", "arguments", "words"),
    [
        (Variation, dict(radius=(0.25, 0.2)), "`radius` must be a range of positive numbers"),
        (Variation, dict(speed=(0.0, 1.0)), "`speed` must be a range of positive numbers"),
        (Variation, dict(heading_error=-0.1), "`heading_error` must be 0 or more"),
        (Variation, dict(pitch_error=-0.1), "`pitch_error` must be 0 or more"),
        (FlightVariation, dict(settling=(0.1, 0.05)), "`settling` must be a range of positive numbers"),
        (FlightVariation, dict(drag=(0.0, 1.0)), "`drag` must be a range of positive numbers"),
        (FlightVariation, dict(shaking_rate=-0.1), "`shaking_rate` must be 0 or more"),
    ],
)
def test_impossible_variations_are_refused(make, arguments, words):
    with pytest.raises(ValueError, match=words):
        make(**arguments)
