"""Cosine schedules (App. C.3.1)."""

import math

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule


def cosine_progress(step: float, start: float, period: float) -> float:
    """
    Progress coefficient l: 0 until ``start``, then half a cosine wave up to 1 over ``period`` (App. C.3.1).

    :param step: decisions so far
    :param start: end of the warm-up, in decisions
    :param period: length of the ramp, in decisions; 0 is a step
    :return: l in [0, 1]
    """
    if step < start:
        return 0.0
    if step >= start + period:
        return 1.0
    return 0.5 * (1.0 - math.cos(math.pi * (step - start) / period))


class CosineSchedule:
    """
    SB3 schedule that falls along half a cosine wave over the whole training.

    :param initial: value at the start
    :param floor: share of ``initial`` that is left at the end, in [0, 1]
    """

    def __init__(self, initial: float, floor: float):
        if not 0.0 <= floor <= 1.0:
            raise ValueError(f"A schedule's floor is a share of its initial value, in [0, 1]; {floor} was given.")
        self.initial = initial
        self.floor = floor

    def __call__(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: 1 at the start of training, 0 at its end (SB3's convention)
        :return: value now
        """
        fall = cosine_progress(1.0 - progress_remaining, 0.0, 1.0)
        return self.initial * (1.0 - (1.0 - self.floor) * fall)

    def __repr__(self) -> str:
        return f"CosineSchedule(initial={self.initial}, floor={self.floor})"


def falling(rate: float | Schedule, floor: float) -> Schedule:
    """
    :param rate: learning rate, which falls along a cosine, or a schedule, which is used as it is
    :param floor: share of the learning rate that is left at the end
    :return: schedule
    """
    return FloatSchedule(CosineSchedule(float(rate), floor) if isinstance(rate, int | float) else rate)
