"""A task can be configured by the values that differ from its own, as a YAML file or a command line does."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest

from bullet_tasks import ENV_IDS
from bullet_tasks.tasks.blind_mass_stack import BlindMassStackConfig
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.lateral_choice import LateralChoiceConfig
from bullet_tasks.tasks.midpoint_choice import MidpointChoiceConfig
from bullet_tasks.tasks.navigation import NavigationReward


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_task_takes_the_values_that_differ(env_id):
    own = gymnasium.make(env_id).unwrapped.task.config
    assert gymnasium.make(env_id, config=vars(own)).unwrapped.task.config == own
    with pytest.raises(ValueError, match="no_such"):
        gymnasium.make(env_id, config={"no_such": 1.0})


def test_nested_values_and_lists():
    config = configured(MidpointChoiceConfig(), {"low_height": [0.1, 0.2], "reward": {"collision": -1.0}})
    reward = dataclasses.replace(MidpointChoiceConfig().reward, collision=-1.0)
    assert config == MidpointChoiceConfig(low_height=(0.1, 0.2), reward=reward)


def test_a_whole_configuration_is_taken_as_it_is():
    config = MidpointChoiceConfig(spawn_distance=0.5)
    assert configured(MidpointChoiceConfig(), config) is config
    assert configured(config, None) is config


def test_unknown_names_and_impossible_values_are_refused():
    with pytest.raises(ValueError, match=r"no \['spawn'\]; it has .*'spawn_distance'"):
        configured(MidpointChoiceConfig(), {"spawn": 1.0})
    with pytest.raises(ValueError, match="spawn_distance"):
        configured(MidpointChoiceConfig(), {"spawn_distance": 5.0})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (LateralChoiceConfig(), "Expected a MidpointChoiceConfig.*LateralChoiceConfig"),
        ("small", "Expected a MidpointChoiceConfig.*'small'"),
        ({"reward": 3.0}, "Expected a NavigationReward.*3.0"),
        ({"reward": {"goal_progress": math.nan}}, "`goal_progress`.*finite number, got nan"),
        (MidpointChoiceConfig(reward=NavigationReward(goal_bonus=math.inf)), "`goal_bonus`.*finite number, got inf"),
        ({"low_height": 0.1}, "`low_height` must be 2 numbers, got 0.1"),
        ({"low_height": [0.1, "0.2"]}, "`low_height`.*got '0.2'"),
        ({"spawn_distance": True}, "`spawn_distance`.*got True"),
    ],
)
def test_values_of_another_kind_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        configured(MidpointChoiceConfig(), given)


def test_a_number_of_decisions_is_whole():
    with pytest.raises(ValueError, match=r"`n_decisions`.*whole number, got 24.5"):
        configured(BlindMassStackConfig(), {"n_decisions": 24.5})


@pytest.mark.parametrize(
    ("env_id", "config", "words"),
    [
        ("LateralChoice-v0", {"drop": 0.25}, "has fallen: raise `drop`"),
        ("SignpostNav-v0", {"drop": 0.2}, "has fallen: raise `drop`"),
        ("StairwaySearchDepth-v0", {"step_height": 0.12}, "`step_height`"),
        ("SignpostNav-v0", {"platform_radius": 12.0, "post_x": 12.2, "post_base_length": 2.0}, "reaches 12.00 m"),
        ("BiasedQuadrotor-v0", {"reward": {"level_decay": 0.0}}, "level_decay"),
    ],
)
def test_worlds_that_break_the_rules_are_refused(env_id, config, words):
    with pytest.raises(ValueError, match=words):
        gymnasium.make(env_id, config=config)


def length(env, action=1):
    env.reset(seed=0)
    n, over = 0, False
    while not over:
        # The quadruped walks in circles, the arm stays.
        *_, terminated, truncated, _ = env.step(np.full(env.action_space.shape, action))
        n, over = n + 1, terminated or truncated
    assert truncated and not terminated
    return n


@pytest.mark.parametrize(
    ("env_id", "config", "n"),
    [
        ("LateralChoice-v0", {"time_limit": 40.0}, 160),
        ("LateralChoice-v0", {"time_limit": 5.0}, 20),
        ("LateralChoice-v0", {"decision_period": 0.2}, 100),
        ("BlindMassStack-v0", {"n_decisions": 40}, 40),
    ],
)
def test_a_configured_time_is_the_episodes_length_unless_steps_are_given(env_id, config, n):
    env = gymnasium.make(env_id, physics="compiled", config=config)
    assert length(env) == n == env.spec.max_episode_steps
    assert length(gymnasium.make(env.spec)) == n, "and of an environment that is made like it"
    for given in (n // 2, 2 * n):
        assert length(gymnasium.make(env_id, physics="compiled", config=config, max_episode_steps=given)) == given


def test_a_quadrotor_may_tilt_as_far_as_it_likes():
    config = {"hover": {"flip_tilt": 2.0}, "angle_range": 1.8}
    assert gymnasium.make("BiasedQuadrotor-v0", config=config).unwrapped.scene["floor"].half_extents[0] > 300.0


def test_a_long_flight_stays_above_the_floor():
    env = gymnasium.make("BiasedQuadrotor-v0", config={"time_limit": 24.0})
    env.reset(seed=0)
    over = False
    while not over:
        # As fast as it goes, sidewards.
        *_, terminated, over, info = env.step(np.array([1.0, 1.0, 1.0], np.float32))
        assert not terminated
    assert np.abs(info["position"][:2]).max() < env.unwrapped.scene["floor"].half_extents[0]
    env.close()
