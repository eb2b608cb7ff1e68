"""Every task has a card, whose sections come in the same order."""

import inspect

import gymnasium
import pytest

import bullet_tasks  # noqa: F401

TASKS = sorted(name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("bullet_tasks"))
SECTIONS = (
    "Description",
    "Observation spaces",
    "Action",
    "Rewards",
    "Success",
    "Termination",
    "Optimal behaviour",
    "Differences from the paper",
    "Source",
)


@pytest.mark.parametrize("env_id", TASKS)
def test_the_task_card_is_complete(env_id):
    env = gymnasium.make(env_id, physics="compiled")
    lines = inspect.cleandoc(type(env.unwrapped.task).__doc__).splitlines()  # a section's text is indented
    env.close()
    positions = [next(i for i, line in enumerate(lines) if line.startswith(section)) for section in SECTIONS]
    assert positions == sorted(positions)


def test_all_tasks_are_looked_at():
    assert len(TASKS) >= 6
