"""The encoder: cached steps equal whole episodes, Eq. 1 by hand, sizes of the presets."""

import itertools
import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_uspl.activations import RecoverableTanh
from sb3_uspl.encoder import (
    MAX_STD,
    MEMORIES,
    MIN_STD,
    Belief,
    DiscreteHead,
    FourierFeatures,
    ObservationEncoder,
    RunningNormalizer,
    TransformerMemory,
    gaussian_nll,
    reset_rows,
    soft_clamp,
    take_rows,
)
from tests.sb3_uspl.toy import IMAGE, ToyEnv

OWN_KEYS = "transformer, each head with keys of its own"


def make_memory(name):
    th.manual_seed(0)
    if name in ("transformer", OWN_KEYS):
        return TransformerMemory(16, n_heads=2, head_width=8, n_layers=2, shared_keys=name != OWN_KEYS)
    return MEMORIES[name](16)


@pytest.mark.parametrize("name", [*MEMORIES, OWN_KEYS])
def test_steps_equal_whole_episodes_across_resets_and_cache_growth(name):
    memory, n_tokens = make_memory(name), TransformerMemory.CACHE_BLOCK + 20
    features = th.randn(3, n_tokens, 16)
    resets = {0: (), 1: (5,), 2: (40, n_tokens - 2)}
    state, outputs = memory.initial_state(3), []
    with th.no_grad():
        for t in range(n_tokens):
            rows = th.tensor([t in resets[env] for env in range(3)])
            reset_rows(state, rows)
            out, state = memory.step(features[:, t], state)
            outputs.append(out)
        outputs = th.stack(outputs, 1)
        for env, times in resets.items():
            edges = [0, *times, n_tokens]
            for start, stop in itertools.pairwise(edges):
                whole, _ = memory(features[env, start:stop], th.tensor([stop - start]))
                th.testing.assert_close(outputs[env, start:stop], whole, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", MEMORIES)
def test_sequences_do_not_reach_into_each_other(name):
    memory, lengths = make_memory(name), th.tensor([3, 0, 7, 1, 2, 17, 16, 7])
    features = th.randn(int(lengths.sum()), 16)
    with th.no_grad():
        together, _ = memory(features, lengths)
        alone = [memory(part, th.tensor([len(part)]))[0] for part in features.split(lengths.tolist())]
    th.testing.assert_close(together, th.cat(alone), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", MEMORIES)
@pytest.mark.parametrize("longest", [None, 10, 200])
def test_state_after_whole_sequences_continues_like_single_steps(name, longest):
    memory = make_memory(name)
    lengths, token = th.tensor([10, 4, 0]), th.randn(3, 16)
    parts = [th.randn(int(length), 16) for length in lengths]
    with th.no_grad():
        _, state = memory(th.cat(parts), lengths)
        after_pass, _ = memory.step(token, state, longest)
        for env, part in enumerate(parts):
            single = memory.initial_state(1)
            for features in part:
                _, single = memory.step(features[None], single)
            expected, _ = memory.step(token[env : env + 1], single)
            th.testing.assert_close(after_pass[env], expected[0], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", MEMORIES)
def test_no_tokens_leave_the_initial_state(name):
    memory = make_memory(name)
    outputs, state = memory(th.zeros(0, 16), th.tensor([0, 0]))
    assert len(outputs) == 0 and all((part == 0).all() and len(part) == 2 for part in state)


@pytest.mark.parametrize("width", [16, 7])
@pytest.mark.parametrize("scale", [1.0, 30.0], ids=["usual", "saturated"])
def test_the_compiled_recurrence_is_torchs_gru(width, scale):
    """Outputs, state and all gradients, on sequences of any lengths."""
    th.manual_seed(0)
    memory, lengths = MEMORIES["gru"](width), [5, 0, 9, 1, 9, 0]
    features = scale * th.randn(sum(lengths), width)
    features.requires_grad = True
    weights = th.randn(sum(lengths), width)
    inputs = [features, *memory.parameters()]
    ours, (state,) = memory(features, th.tensor(lengths))
    parts = [memory.gru(part[None])[0][0] for part in features.split(lengths) if len(part)]
    reference = th.cat(parts)
    th.testing.assert_close(ours, reference, atol=2e-6, rtol=1e-5)
    th.testing.assert_close(state[[0, 2, 3, 4]], th.stack([part[-1] for part in parts]), atol=2e-6, rtol=1e-5)
    assert (state[[1, 5]] == 0.0).all()
    gradients = [th.autograd.grad((outputs * weights).sum(), inputs) for outputs in (ours, reference)]
    for mine, theirs in zip(*gradients, strict=True):
        th.testing.assert_close(mine, theirs, atol=scale * 1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", MEMORIES)
def test_taken_rows_are_independent(name):
    memory = make_memory(name)
    with th.no_grad():
        _, state = memory(th.randn(10, 16), th.tensor([5, 5]))
        before = [part.clone() for part in state]
        memory.step(th.randn(1, 16), take_rows(state, th.tensor([1])))
    for part, old in zip(state, before, strict=True):
        th.testing.assert_close(part, old)


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
@pytest.mark.parametrize("now", [4, 600])
def test_the_future_does_not_reach_the_past(now, dtype):
    memory, lengths = make_memory("transformer"), th.tensor([now + 3])
    features = th.randn(now + 3, 16, dtype=dtype)
    changed = features.clone()
    changed[now:] += 1.0
    with th.no_grad(), th.autocast("cpu", th.bfloat16, enabled=dtype is th.bfloat16):
        a, b = memory(features, lengths)[0], memory(changed, lengths)[0]
    th.testing.assert_close(a[:now], b[:now], atol=0.0, rtol=0.0)
    assert not th.allclose(a[now:], b[now:])


def test_what_is_not_a_number_stays_so_until_the_end_of_its_episode_and_no_longer():
    features = th.randn(12, 16)
    features[7, 3] = th.nan
    remembered = make_memory("gru")(features, th.tensor([5, 5, 2]))[0]
    assert remembered.isnan().any(1).tolist() == [False] * 7 + [True] * 3 + [False] * 2


def test_lengths_that_do_not_add_up_are_refused():
    for lengths in ([3, 4], [3, 1]):
        with pytest.raises(ValueError, match="There are 6 tokens"):
            make_memory("gru")(th.randn(6, 16), th.tensor(lengths))


def test_eq_1_hand_computed():
    belief = Belief(th.tensor([[0.0, 1.0], [5.0, 5.0]]), th.log(th.tensor([[0.5, 2.0], [1.0, 1.0]])))
    truth = th.tensor([[0.5, 1.0], [5.0, 6.0]])
    # Half squared z: 0.5, 0, 0, 0.5.
    expected = (0.5 + math.log(0.5) + math.log(2.0) + 0.5 + 2 * math.log(2 * math.pi)) / 2
    assert gaussian_nll(belief, truth).item() == pytest.approx(expected)


def test_beta_weighs_a_dimension_by_its_own_uncertainty():
    truth = th.tensor([[0.5, 1.0]])
    gradients = {}
    for beta in (0.0, 0.5, 1.0):
        mean = th.zeros(1, 2, requires_grad=True)
        gaussian_nll(Belief(mean, th.log(th.tensor([[0.01, 0.5]]))), truth, beta).backward()
        gradients[beta] = mean.grad[0]
    # -z / std = -error / std**2, times std ** (2 beta): at beta = 1 the error itself, however certain the belief.
    for beta, gradient in gradients.items():
        expected = -th.tensor([0.5, 1.0]) * th.tensor([0.01, 0.5]) ** (2 * beta - 2)
        th.testing.assert_close(gradient, expected, rtol=1e-4, atol=0.0)


def test_fourier_features_tell_apart_what_is_close():
    features = FourierFeatures(4)
    near = th.tensor([[1.0], [1.1]])
    plain, rich = FourierFeatures(0)(near), features(near)
    assert rich.shape == (2, features.width(1)) == (2, 9)
    th.testing.assert_close(rich[:, :1], plain)
    th.testing.assert_close(rich[0, 1], th.sin(th.tensor(0.5 * math.pi)))
    assert (rich[0] - rich[1]).norm() > 10 * (plain[0] - plain[1]).norm()


def test_fourier_features_of_some_inputs_leave_the_others_as_they_are():
    features, x = FourierFeatures(3, [2]), th.randn(5, 4)
    rich = features(x)
    assert rich.shape == (5, features.width(4)) == (5, 10)
    th.testing.assert_close(rich[:, :4], x)
    th.testing.assert_close(rich[:, 4:], FourierFeatures(3)(x[:, 2:3])[:, 1:])


def test_soft_clamp_stays_inside_and_keeps_a_gradient():
    x = th.linspace(-20, 20, 101, requires_grad=True)
    y = soft_clamp(x, math.log(MIN_STD), math.log(MAX_STD))
    assert (y.exp() >= MIN_STD - 1e-6).all() and (y.exp() <= MAX_STD + 0.01).all()
    y.sum().backward()
    assert (x.grad > 0).all()
    assert soft_clamp(th.zeros(1), math.log(MIN_STD), 0.0).exp().item() == pytest.approx(0.505, abs=0.005)  # release


def test_untrained_belief_is_wide_and_centred():
    encoder = ObservationEncoder(ToyEnv().observation_space, 1)
    belief, _ = encoder.step({"common": th.randn(4, 2), "previous_action": th.randn(4, 1)}, encoder.memory.initial_state(4))
    assert belief.mean.abs().max() < 0.1 and (belief.std - 0.5).abs().max() < 0.05


VALUES = (-0.3, 0.0, 0.3)


def categorical_encoder(memory="gru", **overrides):
    th.manual_seed(0)
    space = ToyEnv(n_privileged=3).observation_space
    return ObservationEncoder(space, 1, "small", memory, {"categorical": True, **overrides}, {1: VALUES})


def test_a_categorical_belief_has_the_moments_of_its_distribution():
    head = DiscreteHead(th.nn.Identity(), VALUES)
    log_probs = head(th.log(th.tensor([[0.2, 0.3, 0.5], [0.5, 0.0, 0.5], [0.0, 1.0, 0.0]])))
    th.testing.assert_close(log_probs.exp().sum(-1), th.ones(3))
    mean, log_std = head.moments(log_probs)
    th.testing.assert_close(mean, th.tensor([0.09, 0.0, 0.0]))
    variance = th.tensor([0.2 * 0.39**2 + 0.3 * 0.09**2 + 0.5 * 0.21**2, 0.09, 0.0])
    th.testing.assert_close(log_std.exp(), th.sqrt(variance + MIN_STD**2))
    assert head.index(th.tensor([0.3, -0.29, 0.01])).tolist() == [2, 0, 1]


def test_the_loss_of_a_mixed_belief_is_gaussian_and_cross_entropy():
    encoder = categorical_encoder()
    tokens = {"common": th.randn(6, 2), "previous_action": th.randn(6, 1)}
    truth = th.tensor([[0.1, value, -0.2] for value in (*VALUES, *VALUES)])
    belief, _ = encoder(tokens, th.tensor([4, 2]))
    gaussian = Belief(belief.mean[:, [0, 2]], belief.log_std[:, [0, 2]])
    for beta in (0.0, 0.75):
        of_true_values = belief.log_probs[0][th.arange(6), [0, 1, 2, 0, 1, 2]]
        expected = gaussian_nll(gaussian, truth[:, [0, 2]], beta) - of_true_values.mean()
        th.testing.assert_close(encoder.loss(belief, truth, beta), expected)
    mean, log_std = encoder.discrete["1"].moments(belief.log_probs[0])
    th.testing.assert_close((belief.mean[:, 1], belief.log_std[:, 1]), (mean, log_std))
    best = th.tensor(VALUES)[belief.log_probs[0].argmax(-1)]
    assert encoder.accuracy(belief, truth).item() == pytest.approx((best == truth[:, 1]).float().mean().item())


def test_without_categorical_the_loss_is_eq_1():
    th.manual_seed(0)
    encoder = ObservationEncoder(ToyEnv().observation_space, 1, discrete={0: VALUES})
    belief, _ = encoder({"common": th.randn(5, 2), "previous_action": th.randn(5, 1)}, th.tensor([5]))
    truth = th.randn(5, 1)
    assert belief.log_probs == () and not any("discrete" in name for name in encoder.state_dict())
    th.testing.assert_close(encoder.loss(belief, truth, 0.5), gaussian_nll(belief, truth, 0.5))
    assert encoder.accuracy(belief, truth).isnan()


@pytest.mark.parametrize("memory", MEMORIES)
def test_categorical_beliefs_step_by_step_are_those_of_whole_episodes(memory):
    encoder = categorical_encoder(memory)
    tokens = {"common": th.randn(6, 2), "previous_action": th.randn(6, 1)}
    with th.no_grad():
        whole, _ = encoder(tokens, th.tensor([6]))
        state = encoder.memory.initial_state(1)
        for t in range(6):
            belief, state = encoder.step({key: value[t : t + 1] for key, value in tokens.items()}, state)
            th.testing.assert_close(belief.mean[0], whole.mean[t])
            th.testing.assert_close(belief.std[0], whole.std[t])


def test_a_categorical_belief_learns_a_value_between_others():
    """The sign of a product says whether it is the middle value or one of the others, and nothing says which."""
    encoder = categorical_encoder("max", hidden=(32,), trunk=(32,), embedding=(32,), orthogonal=True)
    optimizer = th.optim.Adam(encoder.parameters(), 3e-3)
    common = th.randn(512, 2)
    index = th.where(common.prod(-1) > 0.0, 1, 2 * th.randint(0, 2, (512,)))
    truth = 0.2 * th.randn(512, 3)
    truth[:, 1] = th.tensor(VALUES)[index]
    tokens, lengths = {"common": common, "previous_action": th.zeros(512, 1)}, th.ones(512, dtype=th.long)
    for _ in range(200):
        loss = encoder.loss(encoder(tokens, lengths)[0], truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    std = encoder(tokens, lengths)[0].std[:, 1]
    assert std[index == 1].mean() < 0.1 and std[index != 1].mean() > 0.2


def test_an_orthogonal_start_keeps_lengths_up_to_its_gain():
    for memory in MEMORIES:
        encoder = categorical_encoder(memory, orthogonal=True)
        layers = [encoder.features.trunk[0], encoder.embedding[0]]
        layers += [encoder.memory.notice, encoder.memory.out] if memory == "max" else []
        for layer in layers:
            weight = layer.weight.detach() if layer.in_features >= layer.out_features else layer.weight.detach().t()
            th.testing.assert_close(weight @ weight.t(), 2.0 * th.eye(len(weight)), atol=1e-4, rtol=0.0)
            assert (layer.bias == 0.0).all()


def test_without_normalisation_the_common_observation_keeps_its_scale():
    encoder = categorical_encoder(normalize=False, frequencies=0)
    tokens = {"common": 100.0 * th.randn(50, 2), "previous_action": th.randn(50, 1)}
    features = encoder.features
    before = features(tokens)
    features.update_normalizers(tokens)
    th.testing.assert_close(features(tokens), before)
    vector = th.cat((tokens["common"], tokens["previous_action"]), -1)
    th.testing.assert_close(features.trunk(features.common(vector)), before)


def test_normalizer_statistics_equal_those_of_all_data():
    normalizer, rng = RunningNormalizer(3), np.random.default_rng(0)
    batches = [th.as_tensor(rng.normal([1, -2, 0], [3, 0.5, 1], (n, 3)), dtype=th.float32) for n in (5, 50, 500)]
    for batch in batches:
        normalizer.update(batch)
    everything = th.cat(batches)
    th.testing.assert_close(normalizer.mean, everything.mean(0), atol=1e-4, rtol=1e-4)
    th.testing.assert_close(normalizer.var, everything.var(0, correction=0), atol=1e-4, rtol=1e-4)
    normalized = normalizer(everything)
    assert normalized.mean(0).abs().max() < 1e-4 and (normalized.std(0) - 1).abs().max() < 0.01


@pytest.mark.parametrize("preset", ["small", "paper"])
@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("target", [None, spaces.Box(-1, 1, (7,), np.float32), IMAGE], ids=["blind", "vector", "image"])
def test_every_preset_handles_every_input(preset, memory, target):
    encoder = ObservationEncoder(ToyEnv(target=target, n_privileged=2).observation_space, 3, preset, memory)
    tokens = {"common": th.randn(7, 2), "previous_action": th.randn(7, 3)}
    if target is not None:
        tokens["target"] = th.as_tensor(np.stack([target.sample() for _ in range(7)]))
    belief, _ = encoder(tokens, th.tensor([4, 3]))
    assert belief.mean.shape == belief.std.shape == (7, 2)


def test_the_paper_preset_has_the_papers_transformer():
    memory = ObservationEncoder(ToyEnv().observation_space, 1, "paper", "transformer").memory
    assert (memory.n_heads, memory.n_key_heads, memory.head_width, memory.width) == (16, 16, 64, 256)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"preset": "huge"},
        {"memory": "lstm"},
        {"overrides": {"depth": 3}},
        {"overrides": {"categorical": True}},
        {"overrides": {"fourier_inputs": (0, 2)}},
        {"overrides": {"memory_kwargs": {"n_heads": 8}}},
        {"overrides": {"hidden": ()}},
    ],
)
def test_impossible_architecture_is_refused(kwargs):
    with pytest.raises(ValueError, match=r"presets are|unknown entries|discrete_privileged|which has 2 numbers|is empty"):
        ObservationEncoder(ToyEnv().observation_space, 1, **kwargs)


@pytest.mark.parametrize("memory", MEMORIES)
def test_either_memory_learns_what_was_revealed_and_says_when(memory):
    """A sign is shown at the third token only: before it the belief is the prior, after it (nearly) certain."""
    th.manual_seed(0)
    encoder = ObservationEncoder(ToyEnv().observation_space, 1, memory=memory)
    optimizer = th.optim.Adam(encoder.parameters(), 1e-3)
    sign = 2.0 * th.randint(0, 2, (256, 1)) - 1.0
    common = th.zeros(256, 8, 2)
    common[:, 2, 1] = sign[:, 0]
    tokens = {"common": common.flatten(0, 1), "previous_action": th.zeros(256 * 8, 1)}
    truth = (0.25 * sign).repeat_interleave(8, dim=0)
    lengths = th.full((256,), 8)
    for _ in range(150):
        loss = gaussian_nll(encoder(tokens, lengths)[0], truth)
        optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(encoder.parameters(), 1.0)
        optimizer.step()
    std = encoder(tokens, lengths)[0].std.view(256, 8).mean(0)
    assert std[:2].min() > 3 * std[3:].max()


@pytest.mark.parametrize("leak", [0.0, 0.3, 1.0])
def test_the_embeddings_leak_is_ones_choice(leak):
    encoder = ObservationEncoder(ToyEnv().observation_space, 1, overrides=dict(leak=leak))
    assert [part.leak for part in encoder.modules() if isinstance(part, RecoverableTanh)] == [leak]
    with pytest.raises(ValueError, match=r"leak=2.0.*\[0, 1\]"):
        ObservationEncoder(ToyEnv().observation_space, 1, overrides=dict(leak=2.0))
