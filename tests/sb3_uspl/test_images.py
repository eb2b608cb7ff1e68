"""Images as targets: seen by the encoder alone, stored once in their own dtype, never normalised by anybody else."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uspl import RMA, USPLPPO, RESeLPPO
from sb3_uspl.encoder import MEMORIES, ImageCNN, ObservationEncoder, gaussian_nll
from sb3_uspl.encoder import features as features_module
from sb3_uspl.observations import POLICY_KEYS, TARGET, check_observation_space, is_image
from tests.sb3_uspl.toy import ToyEnv

SMALL = ((16, 8, 4, 1), (32, 3, 2, 1))
PAPER = ((32, 5, 1, 2), (64, 3, 1, 1))
BYTES = spaces.Box(0, 255, (1, 36, 48), np.uint8)
HALVES = spaces.Box(-1.0, 1.0, (1, 36, 48), np.float16)
IMAGES = pytest.mark.parametrize("image", [BYTES, HALVES], ids=["uint8", "float16"])


class SignEnv(ToyEnv):
    """The sign that is to be found out is on the image of the third observation, and nowhere else."""

    def _observe(self):
        obs = super()._observe()
        obs["common"][1] = 0.0
        space = self.observation_space["target"]
        # Nothing on the others: 64 episodes of noise would be learned by heart.
        obs["target"] = np.full_like(obs["target"], 0.5 * (space.low.min() + space.high.max()))
        if self.t == 2:
            half = space.shape[2] // 2
            obs["target"][..., :half] = space.high.max() if self.hidden[0] > 0 else space.low.min()
        return obs


def make_encoder(image, preset="small", memory="gru", **overrides):
    th.manual_seed(0)
    encoder = ObservationEncoder(ToyEnv(target=image).observation_space, 1, preset, memory, overrides)
    for head in (encoder.mean[-1], encoder.log_std[-1]):  # a belief that moves visibly with every token
        th.nn.init.normal_(head.weight, std=1.0)
    return encoder


def make_tokens(image, n):
    target = np.stack([image.sample() for _ in range(n)])
    return {"common": th.randn(n, 2), "previous_action": th.randn(n, 1), "target": th.as_tensor(target)}


def make_model(image=BYTES, algorithm=USPLPPO, env=SignEnv, **kwargs):
    venv = make_vec_env(env, n_envs=4, env_kwargs={"target": image})
    kwargs = {"n_steps": 16, "batch_size": 32, "n_epochs": 2, "mismatch_fraction": 0.5, "encoder_updates": 3} | kwargs
    return algorithm("CnnPolicy", venv, encoder_batch_size=64, seed=0, device="cpu", **kwargs)


def test_the_papers_cnn_hand_counted():
    cnn = ImageCNN(spaces.Box(0, 255, (1, 58, 87), np.uint8), PAPER, (128, 128))
    # (58, 87) - conv 5 -> (54, 83) - pool -> (27, 41) - conv 3 -> (25, 39), the 64 x 25 x 39 of the release.
    shapes = [tuple(part.shape) for part in cnn.parameters()]
    expected = [(32, 1, 5, 5), (32,), (64, 32, 3, 3), (64,), (128, 64 * 25 * 39), (128,), (128, 128), (128,)]
    assert shapes == expected
    kinds = [type(layer).__name__ for layer in (*cnn.convolutions, *cnn.fully_connected)]
    assert kinds == ["Conv2d", "MaxPool2d", "ELU", "Conv2d", "ELU", "Linear", "ELU", "Linear", "RecoverableTanh"]


@pytest.mark.parametrize("dtype", [np.uint8, np.float16])
def test_the_fast_layout_changes_nothing(dtype):
    cnn = ImageCNN(spaces.Box(0, 255 if dtype is np.uint8 else 1, (3, 36, 48), dtype), SMALL, (64,))
    images = th.as_tensor(np.random.default_rng(0).integers(0, 2, (5, 3, 36, 48)).astype(dtype))
    given = images.clone()
    features = cnn(images)
    plain = copy.deepcopy(cnn).to(memory_format=th.contiguous_format)
    pixels = plain.convolutions((images.float() - cnn.low) / cnn.range - 0.5)
    expected = plain.fully_connected(pixels.permute(0, 2, 3, 1).flatten(1))
    th.testing.assert_close(features, expected, rtol=1e-4, atol=1e-5)
    assert th.equal(images, given)


def test_saturated_image_features_learn_on():
    cnn = ImageCNN(spaces.Box(0, 255, (1, 36, 48), np.uint8), SMALL, (64,))
    with th.no_grad():
        cnn.fully_connected[-2].bias.fill_(12.0)
    cnn(th.randint(0, 256, (4, 1, 36, 48), dtype=th.uint8)).sum().backward()
    assert max(p.grad.abs().max().item() for p in cnn.convolutions.parameters()) > 1e-4  # tanh(12) has a slope of 1e-10


def test_the_papers_layers_beside_the_image():
    def widths(**kwargs):
        encoder = make_encoder(kwargs.pop("image", BYTES), **kwargs)
        return [layer.out_features for layer in encoder.features.common if isinstance(layer, th.nn.Linear)]

    assert widths(preset="paper") == [512, 256]
    assert widths(preset="paper", image=None) == [512, 256, 128]
    assert widths(preset="small", hidden=(32,)) == [32]
    assert widths(preset="paper", hidden_beside_image=(16,)) == [16]


@IMAGES
def test_numbers_reach_the_cnn_within_one_unit(image):
    cnn, seen = ImageCNN(image, SMALL, (64,)), []
    cnn.convolutions[0].register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    cnn(th.as_tensor(np.stack([image.low, image.high])))
    assert (seen[0][0] == -0.5).all() and (seen[0][1] == 0.5).all() and seen[0].dtype == th.float32


@IMAGES
def test_a_column_scan_hand_counted(image):
    cnn = ImageCNN(image, SMALL, (64,), scan=(8,))
    seen = []
    cnn.scan_normalizer.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    picture = image.high.copy()
    middle = 0.5 * (image.low[0, 0, 0] + image.high[0, 0, 0])
    picture[0, 9:, 3] = middle  # three quarters of the fourth column
    assert cnn(th.as_tensor(picture[None])).shape == (1, cnn.width) == (1, 64 + 8)
    least, mean, share = seen[0].view(3, 48)
    one_unit = 1.0 / 255.0
    assert abs(least[3]) <= one_unit and abs(mean[3] - 0.125) <= one_unit and share[3] == 0.75
    others = th.arange(48) != 3
    assert (least[others] > 0.499).all() and (mean[others] > 0.499).all() and (share[others] == 0.0).all()


@pytest.mark.parametrize("preset, scan", [("small", False), ("small", True), ("paper", False)])
@pytest.mark.parametrize("memory", MEMORIES)
@IMAGES
def test_steps_equal_whole_episodes(preset, scan, memory, image):
    encoder, lengths = make_encoder(image, preset, memory, scan=scan), [5, 3]
    tokens = make_tokens(image, sum(lengths))
    with th.no_grad():
        whole, _ = encoder(tokens, th.tensor(lengths))
        for episode, start in ((0, 0), (1, 5)):
            state = encoder.memory.initial_state(1)
            for t in range(start, start + lengths[episode]):
                belief, state = encoder.step({key: value[t : t + 1] for key, value in tokens.items()}, state)
                th.testing.assert_close(belief.mean[0], whole.mean[t], atol=1e-4, rtol=1e-3)
                th.testing.assert_close(belief.std[0], whole.std[t], atol=1e-4, rtol=1e-3)
    assert whole.mean.std() > 1e-3


def test_parts_of_many_images_equal_all_at_once(monkeypatch):
    encoder, tokens = make_encoder(BYTES), make_tokens(BYTES, 25)
    lengths = th.tensor([20, 5])
    at_once = encoder(tokens, lengths)[0].mean.detach()
    calls = []
    encoder.features.image.register_forward_hook(lambda module, inputs, output: calls.append(len(output)))
    monkeypatch.setattr(features_module, "IMAGE_TOKENS", 10)
    with th.no_grad():
        th.testing.assert_close(encoder(tokens, lengths)[0].mean, at_once, atol=1e-5, rtol=1e-4)
    assert calls == [10, 10, 5]
    encoder(tokens, lengths)
    assert calls[3:] == [25], "gradients need all of them"


def test_the_image_matters_and_is_learned_from():
    encoder = make_encoder(BYTES)
    tokens = make_tokens(BYTES, 4)
    lengths = th.tensor([4])
    before = encoder(tokens, lengths)[0].mean
    changed = tokens | {"target": 255 - tokens["target"]}
    assert not th.allclose(encoder(changed, lengths)[0].mean, before)
    gaussian_nll(encoder(tokens, lengths)[0], th.zeros(4, 1)).backward()
    assert all(part.grad is not None and part.grad.abs().max() > 0 for part in encoder.features.image.parameters())


@IMAGES
@pytest.mark.parametrize("algorithm", [USPLPPO, RMA])
def test_only_the_encoder_holds_images(image, algorithm):
    model = make_model(image, algorithm)
    model.learn(4 * 16 * 2)
    assert set(model.rollout_buffer.observations) == set(POLICY_KEYS)
    assert model.policy.observation_space[POLICY_KEYS[0]].shape == (2,) and TARGET not in model.policy.observation_space.spaces
    for part in (model.policy.pi_features_extractor, model.policy.vf_features_extractor, model.policy.mlp_extractor):
        assert not any(isinstance(layer, th.nn.Conv2d) for layer in part.modules())
    episodes = model.rollout_buffer.episodes
    assert len(episodes.replay) > 3
    for arrays in (episodes.running, *(episode.arrays for episode in episodes.replay)):
        assert arrays["target"].dtype == image.dtype
        assert [key for key, array in arrays.items() if array.shape[-3:] == image.shape] == [TARGET], "once"
    # Beside the image, an episode holds a few numbers.
    pixels = sum(episode.arrays["target"].nbytes for episode in episodes.replay)
    assert pixels < episodes.nbytes < 1.05 * pixels


def test_ppos_networks_are_never_given_an_image(monkeypatch):
    model, keys = make_model(), set()
    extractors = (model.policy.pi_features_extractor, model.policy.vf_features_extractor)
    for extractor in extractors:
        extractor.register_forward_pre_hook(lambda module, inputs: keys.update(inputs[0]))
    model.learn(4 * 16)
    assert keys == set(POLICY_KEYS)


@IMAGES
def test_what_an_image_shows_is_found_out(image):
    """The encoder is certain after the third image, the only one that tells, and not before."""
    th.manual_seed(0)
    encoder = ObservationEncoder(SignEnv(target=image).observation_space, 1)
    optimizer, env = th.optim.Adam(encoder.parameters(), 2e-3), SignEnv(target=image)
    env.observation_space.seed(0)
    episodes = []
    for seed in range(64):
        observations = [env.reset(seed=seed)[0]] + [env.step(env.action_space.low)[0] for _ in range(4)]
        episodes += observations
    tokens = {key: th.as_tensor(np.stack([obs[key] for obs in episodes])) for key in ("common", "target")}
    tokens["previous_action"] = th.zeros(len(episodes), 1)
    truth = th.as_tensor(np.stack([obs["privileged"] for obs in episodes]))
    lengths = th.full((64,), 5)
    for _ in range(80):
        loss = gaussian_nll(encoder(tokens, lengths)[0], truth)
        optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(encoder.parameters(), 1.0)
        optimizer.step()
    std = encoder(tokens, lengths)[0].std.view(64, 5).mean(0)
    assert std[3:].max() < 0.5 * std[:1].min()


def test_the_deployment_policy_sees_the_image_and_nothing_privileged():
    model = make_model()
    for head in (model.policy.encoder.mean[-1],):
        th.nn.init.normal_(head.weight, std=1.0)
    obs = model.env.reset()
    action, _ = model.predict(obs, deterministic=True)
    other, _ = model.predict(obs | {"privileged": -obs["privileged"]}, deterministic=True)
    assert np.array_equal(action, other)
    other, _ = model.predict(obs | {"target": 255 - obs["target"]}, deterministic=True)
    assert not np.allclose(action, other)


def test_an_image_that_is_predicted_on_stays_what_it_was():
    """Also one of another type than the space's, seen backwards through a view."""
    model = make_model(HALVES)
    image = np.linspace(-1.0, 1.0, 36 * 48, dtype=np.float32).reshape(1, 36, 48)
    before = image.copy()
    actions = [model.predict({"common": np.zeros(2, np.float32), "target": image[..., ::-1]}, deterministic=True)[0]]
    actions.append(
        model.predict({"common": np.zeros(2, np.float32), "target": before[..., ::-1].copy()}, deterministic=True)[0]
    )
    assert (image == before).all() and actions[0] == actions[1]


@pytest.mark.parametrize(
    ("size", "preset", "least"), [((1, 15, 40), "small", 16), ((1, 40, 15), "small", 16), ((1, 9, 20), "paper", 10)]
)
def test_images_that_the_cnn_cannot_take_are_refused(size, preset, least):
    def image(size):
        return spaces.Box(0, 255, size, np.uint8)

    with pytest.raises(ValueError, match=rf"too small.*{least} x {least}.*convolutions"):
        make_encoder(image(size), preset)
    make_encoder(image((1, least, least)), preset)
    make_encoder(image(size), preset, convolutions=((8, 3, 1, 1),))


@pytest.mark.parametrize(
    "overrides", [{"convolutions": ((8, 3, 1),)}, {"convolutions": ((8, 0, 1, 1),)}, {"image_layers": ()}]
)
def test_impossible_layers_are_refused(overrides):
    with pytest.raises(ValueError, match=r"channels, kernel, stride, max-pooling"):
        make_encoder(BYTES, **overrides)


def test_what_is_an_image():
    assert is_image(BYTES) and is_image(HALVES)
    unbounded = spaces.Box(-np.inf, np.inf, (1, 36, 48), np.float16)
    floats = spaces.Box(0.0, 1.0, (1, 36, 48), np.float32)
    for space in (unbounded, floats, spaces.Box(0.0, 1.0, (36,), np.float16), spaces.Discrete(3)):
        assert not is_image(space)
    with pytest.raises(ValueError, match=r"float16 one with finite bounds.*norm_obs_keys=\['common'\]"):
        check_observation_space(ToyEnv(target=unbounded).observation_space)


@pytest.mark.parametrize("image", [BYTES, HALVES], ids=["uint8", "float16"])
def test_normalised_images_and_privileged_observations_are_refused(image):
    def venv(keys):
        return VecNormalize(make_vec_env(ToyEnv, n_envs=4, env_kwargs={"target": image}), norm_obs_keys=keys)

    few = {"n_steps": 8, "batch_size": 32, "device": "cpu"}
    for algorithm in (USPLPPO, RESeLPPO):
        for key, reason in (("target", ""), ("privileged", "units and bounds")):
            with pytest.raises(ValueError, match=rf"VecNormalize.*{reason}.*norm_obs_keys=\['common'\]"):
                algorithm("MultiInputPolicy", venv(["common", key]), **few)
    model = USPLPPO(
        "MultiInputPolicy", venv(["common"]), mismatch_fraction=0.5, encoder_updates=1, encoder_batch_size=32, **few
    ).learn(32)
    model.set_env(venv(["common", "privileged"]))
    with pytest.raises(ValueError, match="units and bounds"):
        model.learn(32)


def test_images_with_the_channels_last_are_predicted_on_as_they_were_trained_on():
    image = spaces.Box(0, 255, (36, 48, 3), np.uint8)
    few = {"n_steps": 8, "batch_size": 32, "encoder_updates": 1, "encoder_batch_size": 32, "seed": 0}
    venv = make_vec_env(ToyEnv, n_envs=4, env_kwargs={"target": image})
    model = USPLPPO("CnnPolicy", venv, mismatch_fraction=0.5, device="cpu", **few).learn(64)
    pixels = np.random.default_rng(0).integers(0, 256, (2, *image.shape)).astype(np.uint8)
    obs = {"common": np.zeros((2, 2), np.float32), "target": pixels}
    transposed = {**obs, "target": pixels.transpose(0, 3, 1, 2)}
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], model.predict(transposed, deterministic=True)[0])
    alone = {key: value[0] for key, value in obs.items()}
    assert model.predict(alone, deterministic=True)[0].shape == (1,)
