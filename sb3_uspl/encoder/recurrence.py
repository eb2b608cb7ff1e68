"""The GRU's recurrence with a backward pass of its own: on a CPU, torch's spends most of its time in tiny operations."""

from typing import Any

import torch as th


class PackedGRU(th.autograd.Function):
    """
    A one-layer GRU over packed sequences: all tokens of time 0, then all of time 1, ..., the longest sequences first.

    What every gate adds from the input comes in from outside, as one matrix product over all tokens; a step of time then is a
    product, three activations and an interpolation. The backward pass needs four operations a step, because all factors that
    do not depend on later steps are computed beforehand for all tokens at once. Same results as ``torch.nn.GRU``, which
    remains the reference in the tests.
    """

    @staticmethod
    @th.amp.custom_fwd(device_type="cpu", cast_inputs=th.float32)
    def forward(  # type: ignore[override]
        ctx: Any, gates: th.Tensor, weight: th.Tensor, bias: th.Tensor, batch_sizes: list[int]
    ) -> th.Tensor:
        """
        :param ctx: autograd's
        :param gates: input part of reset, update and candidate gate with its bias, ``(n_tokens, 3 * width)``
        :param weight: hidden part, ``(3 * width, width)``
        :param bias: hidden part, ``(3 * width,)``
        :param batch_sizes: number of running sequences at each time, not increasing, no zeros; their sum is ``n_tokens``
        :return: hidden states after each token, ``(n_tokens, width)``
        """
        width = weight.shape[1]
        n_tokens = len(gates)
        hidden, previous = gates.new_empty(n_tokens, width), gates.new_zeros(n_tokens, width)
        switches = gates.new_empty(n_tokens, 2 * width)  # reset and update gate
        candidate, recurrent = th.empty_like(hidden), th.empty_like(hidden)
        transposed = weight.t()
        parts = [
            *(tensor.split(batch_sizes) for tensor in (gates[:, : 2 * width], gates[:, 2 * width :], hidden, previous)),
            *(tensor.split(batch_sizes) for tensor in (switches, switches[:, :width], switches[:, width:])),
            *(tensor.split(batch_sizes) for tensor in (candidate, recurrent)),
        ]
        last = None
        for gate, proposal, state, before, switch, reset, update, new, old in zip(*parts, strict=True):
            if last is not None:
                before.copy_(last[: len(before)])
            switch_part, candidate_part = th.addmm(bias, before, transposed).split((2 * width, width), 1)
            th.add(gate, switch_part, out=switch).sigmoid_()
            old.copy_(candidate_part)
            th.addcmul(proposal, reset, candidate_part, out=new).tanh_()
            last = th.lerp(new, before, update, out=state)
        ctx.save_for_backward(weight, previous, switches, candidate, recurrent)
        ctx.batch_sizes = batch_sizes
        return hidden

    @staticmethod
    @th.amp.custom_bwd(device_type="cpu")
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, None]:  # type: ignore[override]
        """
        :param ctx: autograd's
        :param gradient: of the hidden states, ``(n_tokens, width)``
        :return: gradients of ``gates``, ``weight`` and ``bias``
        """
        weight, previous, switches, candidate, recurrent = ctx.saved_tensors
        width = weight.shape[1]
        reset, update = switches[:, :width], switches[:, width:]
        kept = 1.0 - update
        # Derivative of the new state by each pre-activation: candidate (hidden part), reset, update, candidate (input part).
        local = gradient.new_empty(len(gradient), 4, width)
        to_recurrent, to_reset, to_update, to_candidate = local.unbind(1)
        th.mul(candidate, candidate, out=to_candidate).neg_().add_(1.0).mul_(kept)
        th.mul(to_candidate, reset, out=to_recurrent)
        th.mul(to_recurrent, recurrent, out=to_reset).mul_(1.0 - reset)
        th.sub(previous, candidate, out=to_update).mul_(update).mul_(kept)
        back = th.empty_like(local)
        # The candidate's rows first, as above.
        weight = weight.roll(width, 0)
        by_hidden, by_input = back.flatten(1)[:, : 3 * width], back.flatten(1)[:, width:]
        carried = gradient.new_zeros(ctx.batch_sizes[0], width)
        parts = [tensor.split(ctx.batch_sizes) for tensor in (local, back, by_hidden, update, gradient)]
        for factors, result, hidden_result, surviving, arriving in reversed(list(zip(*parts, strict=True))):
            state = carried[: len(arriving)].add_(arriving)
            th.mul(factors, state[:, None], out=result)
            state.mul_(surviving).addmm_(hidden_result, weight)
        return by_input, (by_hidden.t() @ previous).roll(-width, 0), by_hidden.sum(0).roll(-width, 0), None
