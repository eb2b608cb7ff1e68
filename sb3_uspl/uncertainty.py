"""Eq. 2-4 and App. C.3.1 as pure functions of arrays. Eq. 1 is :func:`sb3_uspl.encoder.gaussian_nll`."""

import math

import numpy as np

INITIAL_STD = 0.5
"""Smoothed uncertainty before the first observation; also what an untrained encoder reports (release: 0.5)."""

C_MIN = math.log(0.2)
C_MAX = math.log(0.2) - math.log(0.01)
DELTA = 0.05


def smoothing_factor(time_constant: float, decision_period: float) -> float:
    """
    Share of the old value that survives one decision of exponential smoothing.

    The release smooths with 0.95 per 20 ms, i.e. a time constant of 0.39 s.

    :param time_constant: s; 0 turns smoothing off
    :param decision_period: s
    :return: factor in [0, 1)
    """
    return math.exp(-decision_period / time_constant) if time_constant > 0.0 else 0.0


def smooth(previous: np.ndarray, current: np.ndarray, factor: float) -> np.ndarray:
    """
    Uncertainty smoothing (App. C.3.1), per dimension.

    :param previous: smoothed standard deviation one decision ago, ``(n_envs, n_privileged)``
    :param current: the encoder's standard deviation now, same shape
    :param factor: see :func:`smoothing_factor`
    :return: smoothed standard deviation now
    """
    return factor * previous + (1.0 - factor) * current


def reward_coefficient(
    std: np.ndarray, progress: float, c_min: float = C_MIN, c_max: float = C_MAX, delta: float = DELTA
) -> np.ndarray:
    """
    Reward transformation, Eq. 2 with the schedule of App. C.3.1: ``r_hat = [(1 - d)(1 - l) + d] r``.

    :param std: standard deviation per dimension, ``(n_envs, n_privileged)``; its mean over dimensions counts
    :param progress: l in [0, 1]
    :param c_min: C_min; below ``exp(c_min)`` of mean uncertainty the reward starts to grow
    :param c_max: C_max; upper limit of the logarithmic gain
    :param delta: keeps the reward from vanishing
    :return: factor on the reward, ``(n_envs,)``
    """
    d = np.clip(c_min - np.log(std.mean(axis=1)), 0.0, c_max) + delta
    return (1.0 - d) * (1.0 - progress) + d


def blur_continuous(
    privileged: np.ndarray,
    std: np.ndarray,
    noise: np.ndarray,
    gain: float,
    progress: float,
    low: np.ndarray | float = -np.inf,
    high: np.ndarray | float = np.inf,
) -> np.ndarray:
    """
    Privileged blurring of continuous values, Eq. 3 with the schedule of App. C.3.1, clipped to the valid range.

    :param privileged: o_p, ``(n_envs, n_privileged)``
    :param std: sigma_p, same shape
    :param noise: epsilon_c, same shape: uniform in [-1, 1] or standard normal
    :param gain: K
    :param progress: l in [0, 1]
    :param low: lower bound of the valid range
    :param high: upper bound of the valid range
    :return: o_p as the privileged policy sees it
    """
    # With l = 0 nothing may change, not even a value outside of its declared bounds.
    return np.clip(privileged + progress * gain * std * noise, low, high) if progress > 0.0 else privileged


def blur_discrete(
    privileged: np.ndarray, std: np.ndarray, noise: np.ndarray, replacement: np.ndarray, progress: float
) -> np.ndarray:
    """
    Privileged blurring of discrete values, Eq. 4 with the schedule of App. C.3.1.

    :param privileged: o_p, ``(n_envs, n_privileged)``
    :param std: sigma_p, same shape
    :param noise: epsilon_d, uniform in [0, 1), same shape
    :param replacement: values drawn uniformly from the valid ones, same shape
    :param progress: l in [0, 1]
    :return: o_p as the privileged policy sees it
    """
    return np.where(noise < progress * std, replacement, privileged)
