"""Episodes recorded for the figures, also under an uncertainty that changes as somebody else decides."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl.evaluation import EVALUATION_SEED, EpisodeRecord, run_episodes
from sb3_uspl.observations import COMMON, PRIVILEGED
from sb3_uspl.policies import DeploymentState, USPLPolicy

N_EPISODES = 8
HIGH, LOW = 0.25, 0.01
"""Uncertainty of one who knows nothing, and of one who knows; privileged units."""
SWITCH_SHARE = 0.25
"""Share of the time limit after which the chosen uncertainty changes (Fig. 7: 250 of 1000 steps)."""

Schedule = Callable[[int], float | None]
"""Decision -> uncertainty shown to the actor; None: the encoder's."""

Forced = dict[str, tuple[bool, Schedule]]
"""Setting -> whether the actor is shown the true privileged observation, and the uncertainty."""


def settings(limit: int) -> Forced:
    """
    :param limit: decisions in the longest episode
    :return: of Fig. 7 (privileged policy) and Figs. 15 to 18 (deployment policy)
    """
    switch = max(1, round(SWITCH_SHARE * limit))

    def step(t: int) -> float:
        return HIGH if t < switch else LOW

    def periodic(t: int) -> float:
        return HIGH if (t // switch) % 2 == 0 else LOW

    def encoder(t: int) -> None:
        return None

    return {
        "privileged, step": (True, step),
        "privileged, periodic": (True, periodic),
        "privileged, encoder's": (True, encoder),
        "deployment, step": (False, step),
    }


def run_forced(
    model: BaseAlgorithm, venv: VecEnv, n_episodes: int, privileged: bool, schedule: Schedule, seed: int = EVALUATION_SEED
) -> tuple[list[EpisodeRecord], list[np.ndarray]]:
    """
    Run episodes ``seed, seed + 1, ...``, deterministically, under a chosen uncertainty.

    :param model: with a ``USPLPolicy``
    :param venv: as many environments as episodes, or more
    :param n_episodes: number of episodes
    :param privileged: whether the actor is shown the true privileged observation instead of the belief's mean
    :param schedule: uncertainty over the decisions
    :param seed: of the first episode
    :return: one record an episode, and the uncertainty shown at each of its decisions (nan: the encoder's)
    :raises ValueError: for more episodes than environments
    """
    if n_episodes > venv.num_envs:
        raise ValueError(f"{n_episodes} episodes in {venv.num_envs} environments: one wave at most.")
    policy = model.policy
    assert isinstance(policy, USPLPolicy)
    records = [EpisodeRecord(seed + i) for i in range(n_episodes)]
    shown: list[list[float]] = [[] for _ in records]
    alive = np.arange(venv.num_envs) < n_episodes
    venv.seed(seed)
    obs: Any = venv.reset()
    infos: list[dict[str, Any]] = venv.unwrapped.reset_infos
    state: tuple[Any, ...] | None = None
    starts, t = np.ones(venv.num_envs, dtype=bool), 0
    while alive.any():
        uncertainty = schedule(t)
        truth = obs[PRIVILEGED] if privileged else None
        actions, state = policy.act(obs, state, starts, True, privileged=truth, uncertainty=uncertainty)
        for i in np.flatnonzero(alive).tolist():
            records[i].positions.append(np.array(infos[i].get("position", obs[COMMON][i])))
            records[i].truth.append(obs[PRIVILEGED][i].copy())
            assert isinstance(state, DeploymentState)
            records[i].belief_mean.append(state.belief_mean[i])
            records[i].belief_std.append(state.uncertainty[i])
            shown[i].append(np.nan if uncertainty is None else uncertainty)
        obs, _, starts, infos = venv.step(actions)  # type: ignore[assignment]
        for i in np.flatnonzero(alive & starts).tolist():
            records[i].success = bool(infos[i].get("is_success", False))
            alive[i] = False
        t += 1
    return records, [np.array(values) for values in shown]


def record_all(model: BaseAlgorithm, venv: VecEnv, env: gym.Env) -> dict[str, np.ndarray]:
    """
    Both policies as they are, and under every setting of the uncertainty.

    :param model: with a ``USPLPolicy``
    :param venv: ``N_EPISODES`` environments or more
    :param env: one more, for what its map looks like
    :return: arrays by "<group>/<episode>/<what>", for ``numpy.savez``
    """
    world: Any = env.unwrapped
    belief_in_world = getattr(getattr(world, "task", world), "belief_in_world", None)
    limit = env.spec.max_episode_steps if env.spec and env.spec.max_episode_steps else 0
    arrays: dict[str, np.ndarray] = {"decision_period": np.array(getattr(world, "decision_period", 1.0))}
    for policy in ("deployment", "privileged"):
        records = run_episodes(model, venv, N_EPISODES, policy=policy)
        limit = max(limit, *(len(record) for record in records))
        arrays |= _arrays(policy, records, belief_in_world)
    for name, (privileged, schedule) in settings(limit).items():
        records, shown = run_forced(model, venv, N_EPISODES, privileged, schedule)
        arrays |= _arrays(name, records, belief_in_world)
        arrays |= {f"{name}/{i}/shown": values for i, values in enumerate(shown)}
    return arrays


def _arrays(group: str, records: Sequence[EpisodeRecord], belief_in_world: Any) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    for i, record in enumerate(records):
        what = {
            "position": np.stack(record.positions),
            "truth": np.stack(record.truth),
            "mean": np.stack(record.belief_mean),
            "std": np.stack(record.belief_std),
            "success": np.array(record.success),
        }
        if belief_in_world is not None:
            steps = [belief_in_world(mean, std) for mean, std in zip(what["mean"], what["std"], strict=True)]
            what["map_centre"], what["map_half_widths"] = (np.array(part) for part in zip(*steps, strict=True))
            what["map_truth"] = np.asarray(belief_in_world(what["truth"][0], np.zeros_like(what["std"][0]))[0])
        # Half precision of what is only drawn keeps the files small.
        out |= {
            f"{group}/{i}/{name}": array.astype(np.float32) if array.dtype.kind == "f" else array
            for name, array in what.items()
        }
    return out


def episodes(records: dict[str, np.ndarray], group: str) -> list[dict[str, np.ndarray]]:
    """
    :param records: as written by :func:`record_all`
    :param group: "deployment", "privileged" or a setting
    :return: arrays by name, one dict an episode
    """
    found: dict[int, dict[str, np.ndarray]] = {}
    for key, array in records.items():
        parts = key.rsplit("/", 2)
        if len(parts) == 3 and parts[0] == group:
            found.setdefault(int(parts[1]), {})[parts[2]] = array
    return [found[i] for i in sorted(found)]
