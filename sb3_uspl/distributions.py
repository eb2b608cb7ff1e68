"""Exploration: Gaussian noise that is correlated in time."""

import math

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution


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

    def independent(self) -> DiagGaussianDistribution:
        """
        :return: the same Gaussian, whose samples do not depend on each other
        """
        other = DiagGaussianDistribution(self.action_dim)
        other.distribution = self.distribution
        return other

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
