"""What ``USPLPPO`` is given: checked before anything is built, and completed from the environments and in decisions."""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_uspl.buffers import USPLRolloutBuffer
from sb3_uspl.observations import COMMON, PRIVILEGED, check_observation_space, check_vec_wrappers
from sb3_uspl.policies import USPLPolicy
from sb3_uspl.symmetries import Symmetry, SymmetryGroup

if TYPE_CHECKING:
    from sb3_uspl.uspl_ppo import USPLPPO

PAPER_DECISION_PERIOD = 0.02
"""s; assumed for an environment that does not say how long a decision lasts."""


def check_arguments(model: "USPLPPO") -> None:
    """
    Refuse what cannot be trained with, before anything is built from it.

    :param model: with its arguments and spaces, and ``discrete_privileged`` looked up
    :raises ValueError: for a space outside the contract or an argument outside its range, naming what to do
    """
    space = check_observation_space(model.observation_space)[PRIVILEGED]
    if model.env is not None:
        check_vec_wrappers(model.env)
    assert isinstance(space, spaces.Box)
    if not issubclass(model.policy_class, USPLPolicy):
        raise ValueError(f"USPLPPO needs a subclass of sb3_uspl.USPLPolicy as policy; {model.policy_class} was given.")
    if not issubclass(model.rollout_buffer_class or USPLRolloutBuffer, USPLRolloutBuffer):
        raise ValueError(f"USPLPPO needs a subclass of USPLRolloutBuffer; {model.rollout_buffer_class} was given.")
    if model.blur_noise not in ("uniform", "gaussian"):
        raise ValueError(f"blur_noise='{model.blur_noise}': choose 'uniform' or 'gaussian'.")
    assert model.discrete_privileged is not None
    for dim, values in model.discrete_privileged.items():
        if not 0 <= dim < space.shape[0]:
            raise ValueError(f"discrete_privileged names dimension {dim}, but the privileged observation has {space.shape[0]}")
        distinct = 1 < len(values) == len(set(values))
        if not distinct or min(values) < space.low[dim] - 1e-6 or max(values) > space.high[dim] + 1e-6:
            raise ValueError(
                f"discrete_privileged={{{dim}: {values}}}: give two values or more, each once, within the bounds "
                f"[{space.low[dim]}, {space.high[dim]}] of that dimension."
            )
    continuous = [dim for dim in range(space.shape[0]) if dim not in model.discrete_privileged]
    bounded = np.isfinite(space.low[continuous]) & np.isfinite(space.high[continuous])
    if model.blur and model.blur_noise == "uniform" and not bounded.all():
        raise ValueError(
            f"The privileged space {space} has unbounded dimensions, which uniform blurring cannot clip (Eq. 3): give "
            "them finite bounds, or use blur_noise='gaussian'."
        )
    check_action_std(model.action_std, model.action_space, model.policy_kwargs)
    model.wander_actions = checked_wander_actions(model.wander_actions, model.action_space)
    ranges = {
        "warmup_timesteps": (model.warmup_timesteps or 0, 0, np.inf),
        "ramp_timesteps": (model.ramp_timesteps or 0, 0, np.inf),
        "blur_gain": (model.blur_gain, 0, np.inf),
        "blur_hold_time": (model.blur_hold_time, 0, np.inf),
        "smoothing_time": (model.smoothing_time, 0, np.inf),
        "action_noise_time": (model.action_noise_time, 0, np.inf),
        "action_noise_timesteps": (model.action_noise_timesteps, 0, np.inf),
        "c_max": (model.c_max, 0, np.inf),
        "delta": (model.delta, 0, np.inf),
        "encoder_updates": (model.encoder_updates, 0, np.inf),
        "encoder_batch_size": (model.encoder_batch_size, 1, np.inf),
        "context_length": (model.context_length, 1, np.inf),
        "encoder_window": (1 if model.encoder_window is None else model.encoder_window, 1, np.inf),
        "encoder_window_timesteps": (model.encoder_window_timesteps or 0, 0, np.inf),
        "encoder_max_grad_norm": (model.encoder_max_grad_norm, 1e-12, np.inf),
        "replay_bytes": (model.replay_bytes, 0, np.inf),
        "encoder_beta": (model.encoder_beta, 0, 1),
        "wander_share": (model.wander_share, 0, 1),
        "mismatch_fraction": (model.mismatch_fraction or 0.0, 0, 0.9),
        "decision_period": (1.0 if model.decision_period is None else model.decision_period, 1e-6, np.inf),
    }
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise ValueError(f"{name}={value} is outside of its range [{low}, {high}].")


def checked_wander_actions(chosen: dict[int, float] | None, space: spaces.Space) -> dict[int, float] | None:
    """
    :param chosen: components of the action and what each is drawn around; as text where a saved model had them as numbers
    :param space: action space
    :return: the same, as numbers
    :raises ValueError: if the space is not a Box with these components and values
    """
    if chosen is None:
        return None
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1 and isinstance(chosen, dict) and chosen):
        raise ValueError(f"wander_actions={chosen}: a dict {{component: middle}}, for a flat Box action space, not {space}.")
    chosen = {int(component): float(middle) for component, middle in chosen.items()}
    for component, middle in chosen.items():
        if not (0 <= component < space.shape[0] and space.low[component] <= middle <= space.high[component]):
            raise ValueError(f"wander_actions={chosen}: no component {component} that can be {middle} in {space}.")
    return chosen


def check_policy_kwargs(given: dict[str, Any], derived: dict[str, Any]) -> None:
    """
    Refuse what would be replaced without a word.

    :param given: by the user
    :param derived: from the algorithm's own arguments
    :raises ValueError: naming what to do
    """
    both = sorted(given.keys() & derived.keys())
    if both:
        raise ValueError(
            f"policy_kwargs sets {both}, which USPLPPO derives from arguments of its own: give uncertainty_input, mean_input, "
            "discrete_privileged, smoothing_time, symmetries, action_noise_time, encoder_learning_rate, encoder_weight_decay "
            "to USPLPPO itself."
        )


def count_mismatched(model: "USPLPPO", lenient: bool = False) -> int:
    """
    How many environments are shown another one's privileged observation.

    :param model: with its ``mismatch_fraction``; None: a quarter, or none with a warning if that is no pair
    :param lenient: whether to do without if the environments are too few, and not to say so
    :raises ValueError: if a fraction that was asked for is no pair, or leaves no environment to PPO
    """
    n_envs, automatic = model.n_envs, model.mismatch_fraction is None
    fraction = 0.25 if model.mismatch_fraction is None else model.mismatch_fraction
    count = round(fraction * n_envs)
    if 2 <= count < n_envs:
        return count
    if lenient:
        return 0
    if model.wander_share > 0.0 and count < 2:
        warnings.warn(f"wander_share={model.wander_share} has no effect: only mismatched environments wander; there are none.")
    if fraction == 0.0:
        return 0
    if count >= 2:
        raise ValueError(
            f"mismatch_fraction={fraction} of {n_envs} environments leaves none whose episodes PPO learns from: use more "
            "environments or a smaller fraction."
        )
    needed = int(np.ceil(1.5 / fraction))
    if automatic:
        warnings.warn(
            f"{n_envs} environment(s) are too few to give some a mismatched privileged observation, without which the encoder "
            f"may learn to read it off the policy's behaviour (App. C.3.1). Use at least {needed}, or silence this with "
            "mismatch_fraction=0."
        )
        return 0
    raise ValueError(
        f"mismatch_fraction={fraction} of {n_envs} environment(s) is no pair to swap privileged observations: "
        f"use n_envs >= {needed}, a larger fraction, or mismatch_fraction=0."
    )


def check_action_std(
    action_std: float | Sequence[float] | None, action_space: spaces.Space, policy_kwargs: dict[str, Any]
) -> None:
    """
    :param action_std: of a model
    :param action_space: its actions
    :param policy_kwargs: of a model
    :raises ValueError: if it is neither a positive number nor one for each number of an action, or is given twice
    """
    if action_std is None:
        return
    if "log_std_init" in policy_kwargs:
        raise ValueError(
            f"policy_kwargs sets log_std_init, but action_std={action_std} fixes the standard deviation of the actions: give "
            "that, or action_std=None to have it learned from log_std_init on."
        )
    n_action = get_flattened_obs_dim(action_space)
    stds = np.asarray(action_std, dtype=float)
    if stds.shape not in ((), (n_action,)) or not (np.isfinite(stds) & (stds > 0.0)).all():
        raise ValueError(
            f"action_std={action_std}: give one positive number, or one for each of the {n_action} action values."
        )


def in_decisions(name: str, times: tuple[float, float], decision_period: float) -> tuple[float, float]:
    """
    Least and greatest time in decisions, at least one.

    :param name: of the argument
    :param times: least and greatest, s
    :param decision_period: s
    :raises ValueError: if they are no range of times
    """
    if not (isinstance(times, list | tuple) and len(times) == 2 and 0.0 < times[0] <= times[1]):
        raise ValueError(f"{name}={times!r}: give the least and the greatest time in s as two positive numbers.")
    low, high = (time / decision_period for time in times)
    return max(low, 1.0), max(high, 1.0)


def ask_discrete_privileged(env: VecEnv | None, given: dict[int, list[float]] | None) -> dict[int, list[float]]:
    """
    Values of the discrete privileged dimensions.

    :param env: asked if nothing is given
    :param given: what the user says
    """
    # Asked for first, because a missing attribute ends a worker of SubprocVecEnv.
    if given is None and env is not None and env.has_attr("discrete_privileged"):
        given = env.get_attr("discrete_privileged", indices=[0])[0]
    return {int(dim): [float(value) for value in values] for dim, values in (given or {}).items()}


def ask_symmetries(env: VecEnv | None, given: Sequence[Symmetry] | bool) -> tuple[Symmetry, ...]:
    """
    Symmetries of the environment's world.

    :param env: is asked for them if ``given`` is True
    :param given: wins over the environment's; False: none are used
    :raises ValueError: if there are none or nobody to ask, they do not fit the observations, or ``common`` is normalised
    """
    if env is None and given is True:
        raise ValueError("symmetries=True asks the environment for them: pass `env`, too.")
    if env is None or not given:
        return tuple(given or ())  # type: ignore[arg-type]
    if given is True:
        given = env.get_attr("symmetries", indices=[0])[0] if env.has_attr("symmetries") else ()
        if not given:
            raise ValueError(
                "symmetries=True, but the environment lists none: give it an attribute `symmetries`, pairs of matrices for "
                "`common` and `privileged`, or leave the argument out."
            )
    assert isinstance(env.observation_space, spaces.Dict)
    SymmetryGroup(given, *(get_flattened_obs_dim(env.observation_space[key]) for key in (COMMON, PRIVILEGED)))
    normalize = unwrap_vec_normalize(env)
    if normalize is not None and normalize.norm_obs and COMMON in (normalize.norm_obs_keys or ()):
        raise ValueError(
            "`symmetries` are given, but VecNormalize normalises `common`, which then has others: leave it out of "
            "norm_obs_keys; encoder and policy normalise it themselves."
        )
    return tuple(given)


def ask_decision_period(env: VecEnv | None, given: float | None) -> float:
    """
    How long a decision lasts, s.

    :param env: asked if nothing is given
    :param given: what the user says
    """
    if given is None and env is not None and env.has_attr("decision_period"):
        given = float(env.get_attr("decision_period", indices=[0])[0])
    return PAPER_DECISION_PERIOD if given is None else given
