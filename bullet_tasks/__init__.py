"""Small PyBullet worlds in which a robot must gather information before it acts; importing registers them with gymnasium."""

import importlib
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from bullet_tasks.env import RobotTaskEnv
from bullet_tasks.tasks.biased_quadrotor import BiasedQuadrotor
from bullet_tasks.tasks.blind_mass_stack import BlindMassStack
from bullet_tasks.tasks.lateral_choice import LateralChoice
from bullet_tasks.tasks.midpoint_choice import MidpointChoice
from bullet_tasks.tasks.midpoint_choice_depth import MidpointChoiceDepth
from bullet_tasks.tasks.signpost_nav import SignpostNav
from bullet_tasks.tasks.signpost_nav_depth import SignpostNavDepth
from bullet_tasks.tasks.square_maze import SquareMaze
from bullet_tasks.tasks.stairway_search import StairwaySearch

# Environment id -> task class. The task module's ``make_env`` builds the environment.
_TASKS: dict[str, type[Any]] = {
    "LateralChoice-v0": LateralChoice,
    "SquareMaze-v0": SquareMaze,
    "SignpostNav-v0": SignpostNav,
    "MidpointChoice-v0": MidpointChoice,
    "SignpostNavDepth-v0": SignpostNavDepth,
    "MidpointChoiceDepth-v0": MidpointChoiceDepth,
    "StairwaySearchDepth-v0": StairwaySearch,
    "BiasedQuadrotor-v0": BiasedQuadrotor,
    "BlindMassStack-v0": BlindMassStack,
}

ENV_IDS = tuple(_TASKS)

for _env_id, _task_class in _TASKS.items():
    # Where it may ask a class for its render modes, "rgb_array_list" and the like work.
    importlib.import_module(_task_class.__module__).make_env.metadata = RobotTaskEnv.metadata
    gymnasium.register(
        id=_env_id,
        entry_point=f"{_task_class.__module__}:make_env",
        additional_wrappers=(WrapperSpec("TaskTimeLimit", "bullet_tasks.env:TaskTimeLimit", {}),),
        # The checks cost time at every step; the test suite runs them once for every registered task.
        disable_env_checker=True,
        order_enforce=False,
    )

__all__ = ["ENV_IDS"]
