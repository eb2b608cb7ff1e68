"""tanh that is tanh, and that training can leave again."""

import pytest
import torch as th

from sb3_uspl.activations import recoverable_tanh
from sb3_uspl.encoder import ObservationEncoder
from tests.sb3_uspl.toy import ToyEnv


@pytest.mark.parametrize("leak", [0.0, 0.01, 1.0])
def test_recoverable_tanh_is_tanh_but_for_the_way_back_to_zero(leak):
    x = th.tensor([-3.0, -0.5, 0.5, 3.0], requires_grad=True)
    y, slope = recoverable_tanh(x, leak), 1.0 - th.tanh(x.detach()) ** 2
    assert th.equal(y, th.tanh(x))
    inwards = th.autograd.grad(y, x, th.sign(x), retain_graph=True)[0]
    outwards = th.autograd.grad(y, x, -th.sign(x))[0]
    assert th.allclose(inwards, th.sign(x.detach()) * slope.clamp(min=leak))
    assert th.allclose(outwards, -th.sign(x.detach()) * slope)


@pytest.mark.parametrize(("squash", "recovers"), [(recoverable_tanh, True), (th.tanh, False)])
def test_a_saturated_mean_can_be_unlearned(squash, recovers):
    x = th.tensor([6.0, -6.0], requires_grad=True)
    optimizer = th.optim.SGD([x], lr=0.1)
    for _ in range(200):
        loss = squash(x).square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert bool((th.tanh(x).abs() < 0.1).all()) is recovers


def test_a_saturated_encoder_learns_on():
    th.manual_seed(0)
    encoder = ObservationEncoder(ToyEnv().observation_space, 1)
    with th.no_grad():
        encoder.embedding[-2].bias.fill_(12.0)
    common = th.randn(64, *ToyEnv().observation_space["common"].shape)
    belief, _ = encoder({"common": common, "previous_action": th.zeros(64, 1)}, th.full((8,), 8))
    belief.mean.sum().backward()
    slopes = [parameter.grad.abs().max().item() for parameter in encoder.memory.parameters() if parameter.grad is not None]
    assert max(slopes) > 1e-4  # tanh(12) has a slope of 1e-10
