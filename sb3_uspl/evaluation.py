"""How well the deployment policy does, counted honestly: every episode that is started counts, a time-out is a failure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import binomtest
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_uspl.observations import COMMON, PRIVILEGED
from sb3_uspl.policies import DeploymentState, USPLPolicy

EVALUATION_SEED = 1_000_000
"""First evaluation seed; training seeds stay far below."""


@dataclass
class EpisodeRecord:
    """One evaluated episode; per-decision lists start with the first observation and leave out the last one."""

    seed: int
    success: bool = False
    success_is_known: bool = False
    """Whether the environment says so in ``info["is_success"]``."""
    reward: float = 0.0
    positions: list[np.ndarray] = field(default_factory=list)
    """``info["position"]`` of the robot, or the common observation if the environment gives none."""
    truth: list[np.ndarray] = field(default_factory=list)
    """Privileged observation, ``(n_privileged,)``."""
    belief_mean: list[np.ndarray] = field(default_factory=list)
    belief_std: list[np.ndarray] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def prediction_error(self) -> np.ndarray:
        """Mean absolute error of the belief over time, ``(length,)``; empty for policies without a belief."""
        if not self.belief_mean:
            return np.zeros(0)
        return np.abs(np.stack(self.belief_mean) - np.stack(self.truth)).mean(axis=1)


def run_episodes(
    model: BaseAlgorithm,
    venv: VecEnv,
    n_episodes: int,
    seed: int = EVALUATION_SEED,
    policy: str = "deployment",
    deterministic: bool = True,
    uncertainty: float | None = None,
) -> list[EpisodeRecord]:
    """
    Run episodes ``seed, seed + 1, ...``. The environments start in waves and a wave ends when all of its episodes have, so
    that short episodes are not counted more often than long ones.

    :param model: trained model; without a ``USPLPolicy`` only its ``predict`` is used
    :param venv: environments, of any number
    :param n_episodes: number of episodes
    :param seed: seed of the first episode
    :param policy: "deployment", or "privileged": the true privileged observation replaces the belief's mean
    :param deterministic: the mode of the actor instead of a sample
    :param uncertainty: shown to the actor instead of the encoder's
    :return: one record an episode, in the order of the seeds
    :raises ValueError: for an unknown policy, or if the model has no privileged policy
    """
    act = _actor(model, policy, deterministic, uncertainty)
    records = []
    for first in range(0, n_episodes, venv.num_envs):
        wave = [EpisodeRecord(seed + first + i) for i in range(venv.num_envs)]
        alive = np.arange(venv.num_envs) < n_episodes - first
        venv.seed(seed + first)
        obs: Any = venv.reset()
        infos: list[dict[str, Any]] = venv.unwrapped.reset_infos  # a wrapper's own are empty
        placed = ["position" in info for info in infos]
        state: tuple[np.ndarray, ...] | None = None
        starts = np.ones(venv.num_envs, dtype=bool)
        while alive.any():
            actions, state = act(obs, state, starts)
            for i in np.flatnonzero(alive).tolist():
                wave[i].positions.append(np.array(infos[i]["position"] if placed[i] else obs[COMMON][i]))
                if isinstance(state, DeploymentState):
                    wave[i].truth.append(obs[PRIVILEGED][i].copy())
                    wave[i].belief_mean.append(state.belief_mean[i])
                    wave[i].belief_std.append(state.uncertainty[i])
            obs, rewards, starts, infos = venv.step(actions)  # type: ignore[assignment]
            assert isinstance(obs, dict)
            for i in np.flatnonzero(alive).tolist():
                wave[i].reward += float(rewards[i])
                if starts[i]:
                    wave[i].success_is_known = "is_success" in infos[i]
                    wave[i].success = bool(infos[i].get("is_success", False))
                    alive[i] = False
        records += wave[: n_episodes - first]
    return records


Act = Callable[[Any, Any, np.ndarray], tuple[np.ndarray, Any]]


def _actor(model: BaseAlgorithm, policy: str, deterministic: bool, uncertainty: float | None) -> Act:
    if policy not in ("deployment", "privileged"):
        raise ValueError(f"policy='{policy}': choose 'deployment' or 'privileged'.")
    network = model.policy
    if isinstance(network, USPLPolicy):
        return lambda obs, state, starts: network.act(
            obs,
            state,
            starts,
            deterministic,
            privileged=obs[PRIVILEGED] if policy == "privileged" else None,
            uncertainty=uncertainty,
        )
    if policy == "privileged" or uncertainty is not None:
        raise ValueError(f"{type(model).__name__} has no observation encoder, so it has a deployment policy only.")
    return lambda obs, state, starts: model.predict(obs, state, starts, deterministic)


def success_rate(records: Sequence[EpisodeRecord]) -> tuple[float, float, float]:
    """
    :param records: evaluated episodes
    :return: share of successes and its 95 % Wilson interval
    """
    successes = sum(record.success for record in records)
    interval = binomtest(successes, len(records)).proportion_ci(0.95, method="wilson")
    return successes / len(records), float(interval.low), float(interval.high)


def trajectory_divergence(first: Sequence[EpisodeRecord], second: Sequence[EpisodeRecord]) -> np.ndarray:
    """
    Distance between two policies' robots that started alike, over time (Fig. 4).

    :param first: episodes of one policy
    :param second: episodes of the other, with the same seeds
    :return: mean distance at each decision over the pairs in which both episodes still run, ``(longest such,)``
    """
    assert [record.seed for record in first] == [record.seed for record in second]
    curves = []
    for a, b in zip(first, second, strict=True):
        length = min(len(a), len(b))
        curves.append(np.linalg.norm(np.stack(a.positions[:length]) - np.stack(b.positions[:length]), axis=1))
    return mean_over_time(curves)


def mean_over_time(curves: Sequence[np.ndarray]) -> np.ndarray:
    """
    :param curves: one curve an episode, of different lengths
    :return: mean at each decision over the episodes that reach it
    """
    longest = max(len(curve) for curve in curves)
    padded = np.full((len(curves), longest), np.nan)
    for row, curve in zip(padded, curves, strict=True):
        row[: len(curve)] = curve
    return np.nanmean(padded, axis=0)


def evaluate(
    model: BaseAlgorithm, venv: VecEnv, n_episodes: int, seed: int = EVALUATION_SEED, policy: str = "both"
) -> dict[str, Any]:
    """
    Success, return, length, PP-DP trajectory divergence and prediction error.

    :param model: trained model
    :param venv: environments
    :param n_episodes: number of episodes, of each policy
    :param seed: seed of the first episode
    :param policy: "deployment", "privileged" or "both"; a model without a privileged policy is evaluated without it in "both"
    :return: numbers by name, ready for JSON; None is what was not measured, and success where the environment does not say
    """
    if policy == "both" and not isinstance(model.policy, USPLPolicy):
        policy = "deployment"
    runs = {
        name: run_episodes(model, venv, n_episodes, seed, name)
        for name in ("deployment", "privileged")
        if policy in (name, "both")
    }
    result: dict[str, Any] = {"episodes": n_episodes, "seed": seed}
    for name, prefix in (("deployment", ""), ("privileged", "privileged_")):
        records = runs.get(name, [])
        rate, *interval = success_rate(records) if any(record.success_is_known for record in records) else (None,)
        result[f"{prefix}success_rate"] = rate
        result[f"{prefix}success_interval"] = interval or None
        result[f"{prefix}mean_return"] = float(np.mean([r.reward for r in records])) if records else None
        result[f"{prefix}mean_length"] = float(np.mean([len(r) for r in records])) if records else None
    errors = [record.prediction_error for record in runs.get("deployment", []) if record.belief_mean]
    result["prediction_error_over_time"] = mean_over_time(errors).tolist() if errors else None
    result["prediction_error_final"] = float(np.mean([error[-1] for error in errors])) if errors else None
    divergence = trajectory_divergence(runs["deployment"], runs["privileged"]) if len(runs) == 2 else None
    result["divergence_over_time"] = None if divergence is None else divergence.tolist()
    result["divergence_mean"] = None if divergence is None else float(divergence.mean())
    return result
