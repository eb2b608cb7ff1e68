"""
What a trained agent comes to know before it acts, and how much success it has with and without: why a baseline succeeds.

``python -m benchmarks.gathering --algo rma --env SignpostNav-v0 -f logs``
"""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from benchmarks.harness import Row, show
from bullet_tasks.tasks.midpoint_choice import MidpointChoiceConfig
from sb3_uspl._zoo import register
from sb3_uspl.evaluate import load_agent
from sb3_uspl.evaluation import EpisodeRecord, run_episodes, success_rate

_ABOVE_FEET = 0.05  # m; what stands higher than this in Signpost Nav is the signpost
_AT_A_CORNER = 1.7  # m from the goal there: the columns before it are within the scandots' reach, 1.2 m
_POSITION_SCALE = 8.0  # m that count as 1 in the observation
_READINGS = slice(19, 22)  # of the scale: the green cube, the left and the right one of the others
_CORNERS = MidpointChoiceConfig().corner * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])

Observation = dict[str, np.ndarray]


def signpost(obs: Observation) -> np.ndarray:
    """Whether each robot has the signpost in sight, ``(n_envs, 1)``."""
    in_sight: np.ndarray = np.any(obs["target"] < -_ABOVE_FEET, axis=1, keepdims=True)
    return in_sight


def corners(obs: Observation) -> np.ndarray:
    """At which of the four corners each robot is, ``(n_envs, 4)``."""
    position = _POSITION_SCALE * obs["common"][:, None, :2]
    return np.linalg.norm(position - _CORNERS, axis=2) < _AT_A_CORNER


def weighed(obs: Observation) -> np.ndarray:
    """Which cube hangs on each arm's scale: green, left, right one of the others, ``(n_envs, 3)``."""
    return obs["common"][:, _READINGS] != 0.0


def _seen(ever: np.ndarray) -> str:
    return "signpost seen" if ever[0] else "signpost never seen"


def _visited(ever: np.ndarray) -> str:
    return f"{ever.sum()} of 4 corners"


def _scales(ever: np.ndarray) -> str:
    return f"green {'weighed' if ever[0] else 'not weighed'}, {ever[1:].sum()} of the other two"


TASKS: dict[str, tuple[Callable[[Observation], np.ndarray], Callable[[np.ndarray], str]]] = {
    "SignpostNav-v0": (signpost, _seen),
    "MidpointChoice-v0": (corners, _visited),
    "BlindMassStack-v0": (weighed, _scales),
}
"""Environment -> what an observation shows, and what all that an episode has shown is called."""


class Watch(VecEnvWrapper):
    """
    Remembers what the first episode of every environment has shown.

    :param venv: environments
    :param shows: what an observation shows, ``(n_envs, n)``
    """

    def __init__(self, venv: VecEnv, shows: Callable[[Observation], np.ndarray]) -> None:
        super().__init__(venv)
        self._shows = shows
        self.ever = np.zeros((venv.num_envs, 0), dtype=bool)
        """What each episode has shown at any time, ``(n_envs, n)``."""
        self._alive = np.ones(venv.num_envs, dtype=bool)

    def reset(self) -> Any:
        """Begin to watch (see base class)."""
        obs: Any = self.venv.reset()
        self.ever, self._alive[:] = self._shows(obs), True
        return obs

    def step_wait(self) -> VecEnvStepReturn:
        """Watch what still runs (see base class)."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self._alive &= ~dones
        self.ever[self._alive] |= self._shows(obs)[self._alive]  # type: ignore[arg-type]
        return obs, rewards, dones, infos


def table(names: Sequence[str], records: Sequence[EpisodeRecord]) -> list[Row]:
    """
    Success by what was gathered.

    :param names: of what each episode has gathered
    :param records: the episodes
    :return: a row for each name, and one for all episodes
    """
    groups = {name: [record for record, its in zip(records, names, strict=True) if its == name] for name in sorted(set(names))}
    return [
        {
            "gathered": name,
            "episodes": len(among),
            "success": success_rate(among)[0],
            "decisions": float(np.mean([len(record) for record in among])),
        }
        for name, among in [*groups.items(), ("all", records)]
    ]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gathering", description=__doc__)
    parser.add_argument("--algo", default="uspl_ppo")
    parser.add_argument("--env", choices=sorted(TASKS), required=True)
    parser.add_argument("-f", "--folder", required=True, help="log folder")
    parser.add_argument("--load-best", action="store_true", help="best model of the training's evaluations")
    parser.add_argument("-n", "--episodes", type=int, default=500)
    given = parser.parse_args()
    if given.episodes < 1:
        parser.error(f"--episodes {given.episodes}: must be at least 1.")
    th.set_num_threads(1)
    register()
    shows, name = TASKS[given.env]
    model, venv = load_agent(given.algo, given.env, given.folder, 0, given.load_best, given.episodes, {"physics": "compiled"})
    watched = Watch(venv, shows)
    records = run_episodes(model, watched, given.episodes)
    watched.close()
    print(show(f"{given.algo}, {given.env}", table([name(row) for row in watched.ever], records)))


if __name__ == "__main__":
    main()
