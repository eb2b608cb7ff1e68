"""tanh that training can leave again."""

from typing import Any

import torch as th
from torch import nn

LEAK = 0.01
"""Least slope towards zero in an encoder. Adam divides by the size of the gradients, so that this little leads out of
saturation as well; with 1, an encoder that is saturated on purpose is torn down (see :class:`RecoverableTanh`)."""


class _RecoverableTanh(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: th.Tensor, leak: float) -> th.Tensor:  # type: ignore[override]
        y = th.tanh(x)
        ctx.save_for_backward(y)
        ctx.leak = leak
        return y

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        # Descent goes against the gradient of the result, so towards zero where the two have the same sign.
        (y,) = ctx.saved_tensors
        slope = 1.0 - y**2
        return gradient * th.where(gradient * y > 0.0, slope.clamp(min=ctx.leak), slope), None


def recoverable_tanh(x: th.Tensor, leak: float = 1.0) -> th.Tensor:
    """
    See :class:`RecoverableTanh`.

    :param x: any shape
    :param leak: least slope towards zero, in [0, 1]; with 1 it is that of the identity, with 0 tanh's own
    :return: tanh(x)
    """
    if th.jit.is_tracing() or not th.is_grad_enabled():  # TorchScript cannot hold a gradient of one's own
        return th.tanh(x)
    return _RecoverableTanh.apply(x, leak)  # type: ignore[no-untyped-call, no-any-return]


class RecoverableTanh(nn.Module):
    """
    tanh whose gradient towards zero never vanishes; away from zero it is tanh's own.

    - With a fixed standard deviation, nothing keeps PPO from driving the mean of a steering action deep into saturation, where
      tanh passes on a ten-thousandth of the gradient: a habit of the warm-up, with the privileged observation at hand, could
      not be unlearned when that is blurred. (Midpoint Choice: after 2 M decisions, 30 % of all decisions had inputs beyond
      1.6, after 8 M 44 %, and a privileged policy that had been perfect lost one of the four corners for good.)
    - An encoder that cannot know anything yet drives its embedding there by noise alone. (Signpost Nav: inputs of +-46 after
      3 M decisions. It learned nothing more from data from which a new encoder learned within 300 updates; with this gradient,
      the same saturated encoder did so, too. Image features of Signpost Nav with depth images: inputs of +-77 after
      0.8 M decisions, +-750 after 0.9 M with twice the learning rate.)

    It is not the gradient of the result where that is far from 0: what pulls an input towards zero counts for more than what
    pushes it away. The greater ``leak``, the more an embedding that is saturated on purpose is torn down, see "Training on,
    with legs" in ``docs/full_physics.md``.

    :param leak: least slope towards zero, in [0, 1]
    :raises ValueError: for any other
    """

    def __init__(self, leak: float = LEAK) -> None:
        super().__init__()
        if not 0.0 <= leak <= 1.0:
            raise ValueError(f"leak={leak}: the least slope of a tanh towards zero is a number in [0, 1].")
        self.leak = leak

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: any shape
        :return: tanh(x)
        """
        return recoverable_tanh(x, self.leak)
