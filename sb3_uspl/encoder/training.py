"""Updates of the observation encoder."""

from collections.abc import Iterable

import torch as th

from sb3_uspl.buffers import EpisodeBatch
from sb3_uspl.encoder.encoder import ObservationEncoder


def fit(
    encoder: ObservationEncoder,
    optimizer: th.optim.Optimizer,
    batches: Iterable[EpisodeBatch],
    beta: float,
    max_grad_norm: float,
    bf16: bool = False,
    compiled: bool = False,
) -> dict[str, float]:
    """
    Maximum likelihood, Eq. 1, one update a batch; leaves no gradients behind.

    :param encoder: in training mode
    :param optimizer: of its parameters
    :param batches: the first one also updates the encoder's normalisers
    :param beta: of the loss, see ``gaussian_nll``
    :param max_grad_norm: gradient clipping
    :param bf16: whether torch's autocast computes in bfloat16
    :param compiled: whether ``torch.compile`` translates the encoder
    :return: means of nll, error, std and, of discrete dimensions, accuracy; empty if there was no batch
    """
    # A compiled function cannot be saved, but torch remembers what it has compiled: asking again is cheap.
    forward = th.compile(encoder.__call__, dynamic=True) if compiled else encoder
    metrics = []
    for update, (tokens, truth, lengths) in enumerate(batches):
        if update == 0:
            encoder.features.update_normalizers(tokens)
        with th.autocast(truth.device.type, th.bfloat16, enabled=bf16):
            belief, _ = forward(tokens, lengths)
        belief = belief.float()
        loss = encoder.loss(belief, truth, beta)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        th.nn.utils.clip_grad_norm_(encoder.parameters(), max_grad_norm)
        optimizer.step()
        with th.no_grad():
            error = (belief.mean - truth).abs().mean()
            numbers = (encoder.loss(belief, truth), error, belief.std.mean(), encoder.accuracy(belief, truth))
            metrics.append(th.stack(numbers))
    optimizer.zero_grad(set_to_none=True)
    if not metrics:
        return {}
    means = dict(zip(("nll", "error", "std", "accuracy"), th.stack(metrics).mean(0).tolist(), strict=True))
    return means if encoder.discrete else {name: value for name, value in means.items() if name != "accuracy"}
