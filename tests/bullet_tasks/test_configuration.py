"""A task can be configured by the values that differ from its own, as a YAML file or a command line does."""

import dataclasses

import gymnasium
import pytest

from bullet_tasks import ENV_IDS
from bullet_tasks.tasks.configuration import configured
from bullet_tasks.tasks.midpoint_choice import MidpointChoiceConfig


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
