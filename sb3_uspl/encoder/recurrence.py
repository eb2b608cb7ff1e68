"""
The GRU's recurrence over whole sequences on a CPU, compiled.

One step of a small GRU is so little work that torch spends most of its time between its operations, the more of it the longer
the sequences are. All in one file, as numba keeps compiled functions between runs and notices changes of their file only.
"""

import functools
from typing import Any

import numba
import numpy as np
import torch as th
from torch.autograd.function import once_differentiable

# Loops are vectorised only if sums may be reordered and, with numpy's error model, no divisor is checked. PPO's update goes on
# beside it, as it does without the interpreter's lock.
_compiled = functools.partial(
    numba.njit, cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"}
)

# Rational approximation of tanh within +-_LIMIT, beyond which float32's is +-1 (Eigen's `ptanh_float`, error of some 4e-7).
# Unlike the C library's, it is vectorised.
_LIMIT = np.float32(7.90531110763549805)
_A1, _A3, _A5, _A7, _A9, _A11, _A13 = np.array(
    [
        4.89352455891786e-03,
        6.37261928875436e-04,
        1.48572235717979e-05,
        5.12229709037114e-08,
        -8.60467152213735e-11,
        2.00018790482477e-13,
        -2.76076847742355e-16,
    ],
    dtype=np.float32,
)
_B0, _B2, _B4, _B6 = np.array(
    [4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06], dtype=np.float32
)
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


@_compiled()
def _tanh(number: Any) -> Any:
    x = min(max(number, -_LIMIT), _LIMIT)
    square = x * x
    odd = _A1 + square * (_A3 + square * (_A5 + square * (_A7 + square * (_A9 + square * (_A11 + square * _A13)))))
    return x * odd / (_B0 + square * (_B2 + square * (_B4 + square * _B6)))


@_compiled()
def _add_product(row: np.ndarray, matrix: np.ndarray, out: np.ndarray) -> None:
    """Add ``row @ matrix``, four rows of the matrix at a time, for fewer passes over the sum."""
    n_fours = len(row) - len(row) % 4
    for k in range(0, n_fours, 4):
        a, b, c, d = row[k], row[k + 1], row[k + 2], row[k + 3]
        first, second, third, fourth = matrix[k], matrix[k + 1], matrix[k + 2], matrix[k + 3]
        for j in range(len(out)):
            out[j] += a * first[j] + b * second[j] + c * third[j] + d * fourth[j]
    for k in range(n_fours, len(row)):
        for j in range(len(out)):
            out[j] += row[k] * matrix[k, j]


@_compiled()
def _run(
    gates: np.ndarray,
    weight: np.ndarray,
    bias: np.ndarray,
    lengths: np.ndarray,
    hidden: np.ndarray,
    switches: np.ndarray,
    candidate: np.ndarray,
    recurrent: np.ndarray,
) -> None:
    """Fill the last four arrays; ``weight`` is transposed, ``(width, 3 * width)``."""
    width = hidden.shape[1]
    own, nothing = np.empty_like(bias), np.zeros_like(bias[:width])
    token = 0
    for length in lengths:
        before = nothing
        for _ in range(length):
            gate, switch, state = gates[token], switches[token], hidden[token]
            proposal, old = candidate[token], recurrent[token]
            own[:] = bias
            _add_product(before, weight, own)
            for j in range(2 * width):
                switch[j] = _HALF + _HALF * _tanh(_HALF * (gate[j] + own[j]))  # the logistic function
            for j in range(width):
                old[j] = own[2 * width + j]
                proposal[j] = _tanh(gate[2 * width + j] + switch[j] * old[j])
                state[j] = proposal[j] + switch[width + j] * (before[j] - proposal[j])
            before = state
            token += 1


@_compiled()
def _run_back(
    gradient: np.ndarray,
    weight: np.ndarray,
    lengths: np.ndarray,
    hidden: np.ndarray,
    switches: np.ndarray,
    candidate: np.ndarray,
    recurrent: np.ndarray,
    by_input: np.ndarray,
    by_hidden: np.ndarray,
) -> None:
    """Fill the last two arrays: gradients of the gates' input part and hidden part."""
    width = hidden.shape[1]
    carried, nothing = np.empty_like(weight[0]), np.zeros_like(weight[0])
    end = 0
    for length in lengths:
        start, end = end, end + length
        carried[:] = 0.0
        for token in range(end - 1, start - 1, -1):
            before = hidden[token - 1] if token > start else nothing
            arriving, switch, proposal, old = gradient[token], switches[token], candidate[token], recurrent[token]
            to_input, to_hidden = by_input[token], by_hidden[token]
            for j in range(width):
                state = carried[j] + arriving[j]
                reset, update = switch[j], switch[width + j]
                to_proposal = state * (_ONE - update) * (_ONE - proposal[j] * proposal[j])
                to_reset = to_proposal * old[j] * reset * (_ONE - reset)
                to_update = state * (before[j] - proposal[j]) * update * (_ONE - update)
                to_input[j] = to_hidden[j] = to_reset
                to_input[width + j] = to_hidden[width + j] = to_update
                to_input[2 * width + j], to_hidden[2 * width + j] = to_proposal, to_proposal * reset
                carried[j] = state * update
            _add_product(to_hidden, weight, carried)


def _arrays(*tensors: th.Tensor) -> list[np.ndarray]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


class CompiledGRU(th.autograd.Function):
    """
    A one-layer GRU over sequences of any lengths, one after another. Same results as ``torch.nn.GRU``, the reference in the
    tests.

    What the gates add from the input comes in from outside, as one matrix product over all tokens.
    """

    @staticmethod
    @th.amp.custom_fwd(device_type="cpu", cast_inputs=th.float32)
    def forward(  # type: ignore[override]
        ctx: Any, gates: th.Tensor, weight: th.Tensor, bias: th.Tensor, lengths: th.Tensor
    ) -> th.Tensor:
        """
        :param ctx: autograd's
        :param gates: input part of reset, update and candidate gate with its bias, ``(n_tokens, 3 * width)``
        :param weight: hidden part, ``(3 * width, width)``
        :param bias: hidden part, ``(3 * width,)``
        :param lengths: of the sequences, ``(n_sequences,)``; their sum is ``n_tokens``
        :return: hidden states after each token, ``(n_tokens, width)``
        :raises ValueError: if they are not
        """
        n_tokens, width = len(gates), weight.shape[1]
        if int(lengths.sum()) != n_tokens:
            raise ValueError(f"There are {n_tokens} tokens, but the lengths of the sequences add up to {int(lengths.sum())}.")
        hidden, candidate, recurrent = (gates.new_empty(n_tokens, width) for _ in range(3))
        switches = gates.new_empty(n_tokens, 2 * width)  # reset and update gate
        inputs = gates, weight.t(), bias, lengths
        _run(*_arrays(*inputs, hidden, switches, candidate, recurrent))
        ctx.save_for_backward(weight, lengths, hidden, switches, candidate, recurrent)
        return hidden

    @staticmethod
    @once_differentiable
    @th.amp.custom_bwd(device_type="cpu")
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, None]:  # type: ignore[override]
        """
        :param ctx: autograd's
        :param gradient: of the hidden states, ``(n_tokens, width)``
        :return: gradients of ``gates``, ``weight`` and ``bias``
        """
        weight, lengths, hidden, switches, candidate, recurrent = ctx.saved_tensors
        by_input = gradient.new_empty(len(gradient), len(weight))
        by_hidden = th.empty_like(by_input)
        inputs = gradient, weight, lengths, hidden, switches, candidate, recurrent
        _run_back(*_arrays(*inputs, by_input, by_hidden))
        before = hidden.roll(1, 0)
        before[(lengths.cumsum(0) - lengths)[lengths > 0]] = 0.0
        return by_input, by_hidden.t() @ before, by_hidden.sum(0), None
