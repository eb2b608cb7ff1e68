"""Exploration: bounded means that do not get stuck at their bounds, and Gaussian noise that is correlated in time."""

import math
from typing import Any

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution


class RecoverableTanh(th.autograd.Function):
    """
    tanh whose gradient towards zero is that of the identity; away from zero it is tanh's own.

    With a fixed standard deviation, nothing keeps PPO from driving the mean of a steering action deep into saturation, where
    tanh passes on a ten-thousandth of the gradient: a habit of the warm-up, with the privileged observation at hand, could not
    be unlearned when that is blurred. (Midpoint Choice: after 2 M decisions, 30 % of all decisions had inputs beyond 1.6,
    after 8 M 44 %, and a privileged policy that had been perfect lost one of the four corners for good.)
    """

    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """
        :param ctx: autograd's
        :param x: any shape
        :return: tanh(x)
        """
        y = th.tanh(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """
        :param ctx: autograd's
        :param gradient: of the result; descent goes against it, so towards zero where the two have the same sign
        """
        (y,) = ctx.saved_tensors
        return th.where(gradient * y > 0.0, gradient, gradient * (1.0 - y**2))


def recoverable_tanh(x: th.Tensor) -> th.Tensor:
    """
    See :class:`RecoverableTanh`.

    :param x: any shape
    :return: tanh(x)
    """
    return RecoverableTanh.apply(x)  # type: ignore[no-untyped-call, no-any-return]


class CorrelatedGaussianDistribution(DiagGaussianDistribution):
    """
    Diagonal Gaussian whose samples, from call to call, share an autoregressive noise.

    Each sample by itself has the Gaussian's mean and standard deviation, of which PPO computes the probability, as if samples
    were independent (Hollenstein et al. 2024, coloured noise in PPO). In a row they lead away from where the mean leads:
    independent noise of 15 degrees a decision averages out before a robot has passed a turning.

    :param action_dim: number of action values
    :param correlation: of the noise of two decisions in a row, in [0, 1); 0 is SB3's distribution
    """

    def __init__(self, action_dim: int, correlation: float):
        super().__init__(action_dim)
        self.correlation = correlation
        self.noise: th.Tensor | None = None

    def sample(self) -> th.Tensor:
        """
        :return: actions, ``(n_envs, action_dim)``
        """
        mean, std = self.distribution.mean, self.distribution.stddev
        fresh = th.randn_like(mean)
        if self.noise is None or self.noise.shape != mean.shape:
            self.noise = fresh
        else:
            self.noise = self.correlation * self.noise + math.sqrt(1.0 - self.correlation**2) * fresh
        return mean + std * self.noise
