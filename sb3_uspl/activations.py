"""tanh that training can leave again."""

from typing import Any

import torch as th
from torch import nn


class _RecoverableTanh(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:  # type: ignore[override]
        y = th.tanh(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:  # type: ignore[override]
        # Descent goes against the gradient of the result, so towards zero where the two have the same sign.
        (y,) = ctx.saved_tensors
        return th.where(gradient * y > 0.0, gradient, gradient * (1.0 - y**2))


def recoverable_tanh(x: th.Tensor) -> th.Tensor:
    """
    See :class:`RecoverableTanh`.

    :param x: any shape
    :return: tanh(x)
    """
    if th.jit.is_tracing() or not th.is_grad_enabled():  # TorchScript cannot hold a gradient of one's own
        return th.tanh(x)
    return _RecoverableTanh.apply(x)  # type: ignore[no-untyped-call, no-any-return]


class RecoverableTanh(nn.Module):
    """
    tanh whose gradient towards zero is that of the identity; away from zero it is tanh's own.

    - With a fixed standard deviation, nothing keeps PPO from driving the mean of a steering action deep into saturation, where
      tanh passes on a ten-thousandth of the gradient: a habit of the warm-up, with the privileged observation at hand, could
      not be unlearned when that is blurred. (Midpoint Choice: after 2 M decisions, 30 % of all decisions had inputs beyond
      1.6, after 8 M 44 %, and a privileged policy that had been perfect lost one of the four corners for good.)
    - An encoder that cannot know anything yet drives its embedding there by noise alone. (Signpost Nav: inputs of +-46 after
      3 M decisions. It learned nothing more from data from which a new encoder learned within 300 updates; with this gradient,
      the same saturated encoder did so, too. Image features of Signpost Nav with depth images: inputs of +-77 after
      0.8 M decisions, +-750 after 0.9 M with twice the learning rate.)

    It is not the gradient of the result where that is far from 0. An encoder that was trained with plain tanh, and whose
    embedding is saturated, is torn down by it (see "Training on, with legs" in ``docs/full_physics.md``).
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: any shape
        :return: tanh(x)
        """
        return recoverable_tanh(x)
