"""Eq. 2-4 and the schedules, against numbers computed by hand."""

import math

import numpy as np
import pytest

from sb3_uspl.schedules import CosineSchedule, cosine_progress
from sb3_uspl.uncertainty import blur_continuous, blur_discrete, reward_coefficient, smooth, smoothing_factor


@pytest.mark.parametrize(
    ("std", "d"),
    [
        (0.25, 0.05),  # above 0.2 only delta is left
        (0.2, 0.05),
        (0.125, math.log(1.6) + 0.05),
        (0.05, math.log(4) + 0.05),
        (0.01, math.log(20) + 0.05),
        (0.005, math.log(20) + 0.05),  # C_max
    ],
)
def test_eq_2_hand_computed(std, d):
    assert reward_coefficient(np.array([[std]]), progress=1.0) == pytest.approx(d)
    assert reward_coefficient(np.array([[std]]), progress=0.0) == pytest.approx(1.0)
    assert reward_coefficient(np.array([[std]]), progress=0.25) == pytest.approx((1 - d) * 0.75 + d)


def test_eq_2_takes_the_mean_over_dimensions():
    # mean of 0.0 ... is 0.1, not the mean of the logarithms
    assert reward_coefficient(np.array([[0.05, 0.15]]), 1.0) == pytest.approx(math.log(2) + 0.05)


def test_eq_3_hand_computed_and_clipped():
    privileged, std, noise = np.array([[0.1, 0.1]]), np.array([[0.02, 0.02]]), np.array([[0.5, -1.0]])
    np.testing.assert_allclose(blur_continuous(privileged, std, noise, 10.0, 1.0), [[0.2, -0.1]])
    np.testing.assert_allclose(blur_continuous(privileged, std, noise, 10.0, 0.5), [[0.15, 0.0]])
    np.testing.assert_allclose(blur_continuous(privileged, std, noise, 10.0, 1.0, -0.05, 0.12), [[0.12, -0.05]])
    assert blur_continuous(np.array([[9.0]]), std[:, :1], noise[:, :1], 10.0, 0.0, -1.0, 1.0) == 9.0  # l = 0 changes nothing


def test_eq_4_replaces_below_the_threshold_only():
    privileged, std = np.array([[1.0, 1.0, 1.0]]), np.array([[0.4, 0.4, 0.4]])
    noise, replacement = np.array([[0.19, 0.2, 0.39]]), np.array([[7.0, 7.0, 7.0]])
    np.testing.assert_array_equal(blur_discrete(privileged, std, noise, replacement, 0.5), [[7.0, 1.0, 1.0]])
    np.testing.assert_array_equal(blur_discrete(privileged, std, noise, replacement, 1.0), [[7.0, 7.0, 7.0]])
    np.testing.assert_array_equal(blur_discrete(privileged, std, noise, replacement, 0.0), privileged)


def test_smoothing_is_the_releases_at_its_own_period():
    factor = smoothing_factor(0.39, 0.02)
    assert factor == pytest.approx(0.95, abs=1e-3)
    # One long decision forgets as much as the short ones that it replaces.
    assert smoothing_factor(0.39, 0.2) == pytest.approx(factor**10)
    assert smoothing_factor(0.0, 0.2) == 0.0
    np.testing.assert_allclose(smooth(np.array([0.5]), np.array([0.1]), 0.95), [0.48])


def test_progress_schedule_hand_computed():
    assert [cosine_progress(t, 100, 300) for t in (0, 100, 250, 400, 900)] == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert cosine_progress(175, 100, 300) == pytest.approx(0.5 * (1 - math.cos(math.pi / 4)))
    assert cosine_progress(100, 100, 0) == 1.0


def test_cosine_schedule_hand_computed():
    schedule = CosineSchedule(0.35, 0.2)
    assert [schedule(p) for p in (1.0, 0.5, 0.0)] == pytest.approx([0.35, 0.35 * 0.6, 0.07])
    with pytest.raises(ValueError, match="share of its initial value"):
        CosineSchedule(1.0, 2.0)
