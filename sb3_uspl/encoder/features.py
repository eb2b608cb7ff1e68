"""From one decision's observation to one feature vector."""

import math
from collections.abc import Sequence

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import nn

from sb3_uspl.activations import RecoverableTanh
from sb3_uspl.observations import COMMON, PREVIOUS_ACTION, TARGET, is_image

Tokens = dict[str, th.Tensor]
"""Encoder inputs by key (``common``, ``target``, ``previous_action``), each ``(..., *shape of the key)``."""


def encode_actions(actions: np.ndarray, space: spaces.Space) -> np.ndarray:
    """
    Actions as the encoder sees them: continuous ones as they are, discrete ones one-hot.

    :param actions: ``(n_envs, *shape)``, as passed to the environments
    :param space: action space
    :return: new array ``(n_envs, n_action)``, float32
    """
    encoded = preprocess_obs(th.as_tensor(actions), space, normalize_images=False)
    assert isinstance(encoded, th.Tensor)
    return encoded.reshape(len(actions), -1).numpy().copy()


def mlp(n_inputs: int, hidden: Sequence[int]) -> nn.Sequential:
    """
    Linear layers, each followed by ELU (App. C.3.3).

    :param n_inputs: number of inputs
    :param hidden: width of each layer
    :return: network; the identity without layers
    """
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(n_inputs, width), nn.ELU(inplace=True)]  # in place, its gradient needs no exponential
        n_inputs = width
    return nn.Sequential(*layers)


class RunningNormalizer(nn.Module):
    """
    Brings each input to zero mean and unit variance with statistics of all the data passed to :meth:`update`.

    Unscaled inputs cost the encoder a factor in learning speed (scandot heights of a few centimetres beside angles).

    :param n_inputs: number of inputs
    """

    LIMIT = 10.0
    MIN_STD = 1e-2

    def __init__(self, n_inputs: int):
        super().__init__()
        self.mean: th.Tensor
        self.var: th.Tensor
        self.count: th.Tensor
        self.register_buffer("mean", th.zeros(n_inputs))
        self.register_buffer("var", th.ones(n_inputs))
        self.register_buffer("count", th.zeros((), dtype=th.float64))

    @th.no_grad()
    def update(self, x: th.Tensor) -> None:
        """
        Merge a batch into the statistics (Chan et al.'s parallel variance).

        :param x: ``(n_samples, n_inputs)``
        """
        n = float(len(x))
        total = float(self.count) + n
        delta = x.mean(0) - self.mean
        share = n / total
        kept = float(self.count) / total
        self.var.copy_(kept * self.var + share * x.var(0, correction=0) + kept * share * delta**2)
        self.mean.add_(share * delta)
        self.count.fill_(total)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: ``(..., n_inputs)``
        :return: same shape, within +-``LIMIT``
        """
        return ((x - self.mean) / self.var.sqrt().clamp(min=self.MIN_STD)).clamp(-self.LIMIT, self.LIMIT)


class FourierFeatures(nn.Module):
    """
    Each input, and its sine and cosine at octaves from pi / 2 rad per unit on (Tancik et al. 2020).

    A metre in a maze of eight is a small part of the input's range, and an MLP takes long to find a sharp edge there.

    :param frequencies: number of octaves; 0 leaves the inputs as they are
    :param inputs: indices of the inputs that have sines and cosines; None: all
    """

    def __init__(self, frequencies: int, inputs: Sequence[int] | None = None):
        super().__init__()
        self.frequencies = frequencies
        self.inputs = None if inputs is None else list(inputs)
        self.octaves: th.Tensor
        self.register_buffer("octaves", 0.5 * math.pi * 2.0 ** th.arange(frequencies), persistent=False)

    def width(self, n_inputs: int) -> int:
        """
        :param n_inputs: number of inputs
        :return: number of features
        """
        return n_inputs + 2 * self.frequencies * (n_inputs if self.inputs is None else len(self.inputs))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: ``(..., n_inputs)``, of about unit variance
        :return: ``(..., width(n_inputs))``
        """
        if self.frequencies == 0:
            return x
        chosen = x if self.inputs is None else x[..., self.inputs]
        angles = chosen[..., None, :] * self.octaves[:, None]
        return th.cat((x, th.stack((angles.sin(), angles.cos()), dim=-2).flatten(-3)), dim=-1)


IMAGE_TOKENS = 2048
"""Without gradients, long sequences of images go through the CNN in parts of this size, for the memory that it takes."""

Convolutions = Sequence[tuple[int, int, int, int]]
"""Channels, kernel, stride and max-pooling (1: none) of each layer."""


def column_scan(pixels: th.Tensor) -> th.Tensor:
    """
    What a laser scanner would make of depth images: of every column the least value, the mean, and the share of pixels that
    show anything in reach, as they are less than the greatest. How near and how high something stands is in these.

    :param pixels: ``(n, channels, height, width)``, in [-0.5, 0.5]
    :return: ``(n, 3 * channels * width)``
    """
    return th.cat((pixels.amin(2), pixels.mean(2), (pixels < 0.499).float().mean(2)), dim=-1).flatten(1)


class ImageCNN(nn.Module):
    """
    Image features: convolutions and fully connected layers with ELU between them, Tanh at the end (App. C.3.3), one that
    training can leave again (:class:`sb3_uspl.activations.RecoverableTanh`).

    Images come as they are stored; here their numbers are brought from the bounds of the space to [-0.5, 0.5].

    :param space: image space ``(channels, height, width)``, uint8 or float16
    :param convolutions: see ``Convolutions``
    :param fully_connected: width of each layer, at least one
    :param scan: layers of an MLP over the images' normalised :func:`column_scan`, beside the convolutions; empty: none
    :raises ValueError: if a layer is impossible, or the images are too small for the convolutions
    """

    def __init__(
        self, space: spaces.Box, convolutions: Convolutions, fully_connected: Sequence[int], scan: Sequence[int] = ()
    ):
        super().__init__()
        if not fully_connected or not all(len(layer) == 4 and min(layer) >= 1 for layer in convolutions):
            raise ValueError(
                f"convolutions={convolutions}, image_layers={fully_connected}: every convolution is (channels, kernel, "
                "stride, max-pooling), at least 1 each, and there must be at least one fully connected layer."
            )
        n_channels, height, width = space.shape
        self.scan_normalizer = RunningNormalizer(3 * n_channels * width) if scan else None
        self.scan = mlp(3 * n_channels * width, scan)
        least = _least_size(convolutions)
        if min(height, width) < least:
            raise ValueError(
                f"Images of {height} x {width} pixels are too small for the encoder's convolutions {tuple(convolutions)} "
                f"(channels, kernel, stride, max-pooling): use at least {least} x {least} pixels, encoder='small', or "
                "policy_kwargs=dict(encoder_kwargs=dict(convolutions=...))."
            )
        layers: list[nn.Module] = []
        for channels, kernel, stride, pooling in convolutions:
            layers.append(nn.Conv2d(n_channels, channels, kernel, stride))
            layers += [nn.MaxPool2d(pooling)] if pooling > 1 else []
            layers.append(nn.ELU(inplace=True))
            height, width = (((size - kernel) // stride + 1) // pooling for size in (height, width))
            n_channels = channels
        # Channels last is the faster way round for oneDNN's convolutions of gray images.
        self.convolutions = nn.Sequential(*layers).to(memory_format=th.channels_last)  # type: ignore[call-overload]
        self.fully_connected = mlp(n_channels * height * width, fully_connected)
        self.fully_connected[-1] = RecoverableTanh()
        self.width = fully_connected[-1] + (scan[-1] if scan else 0)
        """Number of features."""
        self.low, self.range = float(space.low.min()), float(space.high.max()) - float(space.low.min())

    def update_normalizers(self, images: th.Tensor) -> None:
        """
        :param images: ``(n, channels, height, width)``, in the dtype of the space
        """
        if self.scan_normalizer is not None:
            self.scan_normalizer.update(column_scan(self._pixels(images)))

    def _pixels(self, images: th.Tensor) -> th.Tensor:
        pixels = images.float()  # several times as fast as a copy into another memory format
        return pixels.mul_(1.0 / self.range).sub_(self.low / self.range + 0.5)  # in place: the largest tensor that there is

    def forward(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: ``(n, channels, height, width)``, in the dtype of the space
        :return: ``(n, width)``
        """
        pixels = self._pixels(images)
        convolved = self.convolutions(pixels.contiguous(memory_format=th.channels_last))
        features = self.fully_connected(convolved.permute(0, 2, 3, 1).flatten(1))
        if self.scan_normalizer is None:
            return features
        return th.cat((features, self.scan(self.scan_normalizer(column_scan(pixels)))), dim=1)


def _least_size(convolutions: Convolutions) -> int:
    """Height and width of the smallest image of which one pixel is left."""
    size = 1
    for _, kernel, stride, pooling in reversed(convolutions):
        size = (size * pooling - 1) * stride + kernel
    return size


class TokenFeatures(nn.Module):
    """
    Features of one decision: normalised vectors through an MLP each, an image through a CNN, concatenated, then a trunk.

    :param space: observation space of the environment (the contract)
    :param n_action: number of encoded action values
    :param hidden: layers for each kind of input
    :param trunk: layers after the concatenation
    :param frequencies: of :class:`FourierFeatures` for the common observation and the action
    :param convolutions: of an image, see :class:`ImageCNN`
    :param image_layers: its fully connected layers
    :param extremes: whether a vector target's least and greatest value are inputs of their own beside the common
        observation: of scandots, how high the highest thing in sight is, which an MLP over all points takes long to find
    :param scan: whether an image's :func:`column_scan` has an MLP of its own beside the CNN
    :param fourier_inputs: indices of the common observation's numbers that have Fourier features; None: all, and the action
    :param normalize: whether the common observation and the action are brought to zero mean and unit variance. Where little
        of what varies matters, as a few centimetres of jitter beside a reading, their own scale tells the encoder more.
    :raises ValueError: if the image is too small for the convolutions, there are no such ``fourier_inputs``, or no layer is
        ``hidden``
    """

    def __init__(
        self,
        space: spaces.Dict,
        n_action: int,
        hidden: Sequence[int],
        trunk: Sequence[int],
        frequencies: int = 0,
        convolutions: Convolutions = (),
        image_layers: Sequence[int] = (128, 128),
        extremes: bool = False,
        scan: bool = False,
        fourier_inputs: Sequence[int] | None = None,
        normalize: bool = True,
    ):
        super().__init__()
        common, target = space[COMMON], space.spaces.get(TARGET)
        assert isinstance(common, spaces.Box)
        self.has_image = target is not None and is_image(target)
        self.has_vector_target = target is not None and not self.has_image
        self.extremes = extremes and self.has_vector_target
        n_common = common.shape[0] + n_action + 2 * self.extremes
        if not all(0 <= index < common.shape[0] for index in fourier_inputs or ()):
            raise ValueError(
                f"fourier_inputs={fourier_inputs}: indices of the common observation, which has {common.shape[0]} numbers."
            )
        if not hidden:
            raise ValueError("`hidden`, or `hidden_beside_image`, is empty: give each kind of input one layer or more.")
        self.common_normalizer = RunningNormalizer(n_common) if normalize else None
        self.common_fourier = FourierFeatures(frequencies, fourier_inputs)
        self.common = mlp(self.common_fourier.width(n_common), hidden)
        width = hidden[-1]
        if self.has_image:
            assert isinstance(target, spaces.Box)
            self.image = ImageCNN(target, convolutions, image_layers, hidden if scan else ())
            width += self.image.width
        if self.has_vector_target:
            assert isinstance(target, spaces.Box)
            self.target_normalizer = RunningNormalizer(target.shape[0])
            self.target = mlp(target.shape[0], hidden)
            width += hidden[-1]
        self.trunk = mlp(width, trunk)
        self.width = trunk[-1] if trunk else width

    def update_normalizers(self, tokens: Tokens) -> None:
        """
        :param tokens: a batch of unpadded tokens, ``(n_tokens, ...)``
        """
        if self.common_normalizer is not None:
            self.common_normalizer.update(self._common_vector(tokens))
        if self.has_vector_target:
            self.target_normalizer.update(tokens[TARGET].float())
        if self.has_image:
            self.image.update_normalizers(tokens[TARGET])

    def forward(self, tokens: Tokens) -> th.Tensor:
        """
        :param tokens: ``(..., *shape of the key)``
        :return: ``(..., width)``
        """
        vector = self._common_vector(tokens)
        if self.common_normalizer is not None:
            vector = self.common_normalizer(vector)
        parts = [self.common(self.common_fourier(vector))]
        if self.has_vector_target:
            parts.append(self.target(self.target_normalizer(tokens[TARGET].float())))
        if self.has_image:
            images = tokens[TARGET]
            batch = images.shape[:-3]
            parts.append(self.image(images.reshape(-1, *images.shape[-3:])).view(*batch, self.image.width))
        return self.trunk(th.cat(parts, dim=-1))

    def in_parts(self, tokens: Tokens) -> th.Tensor:
        """
        Features of whole sequences; without gradients, images go through the CNN by ``IMAGE_TOKENS``.

        :param tokens: ``(n_tokens, *shape of the key)``
        :return: ``(n_tokens, width)``
        """
        if th.is_grad_enabled() or not self.has_image:
            return self(tokens)  # type: ignore[no-any-return]
        parts = zip(*(tensor.split(IMAGE_TOKENS) for tensor in tokens.values()), strict=True)
        return th.cat([self(dict(zip(tokens, part, strict=True))) for part in parts])

    def _common_vector(self, tokens: Tokens) -> th.Tensor:
        parts = [tokens[COMMON].float(), tokens[PREVIOUS_ACTION]]
        if self.extremes:
            parts += th.aminmax(tokens[TARGET].float(), dim=-1, keepdim=True)
        return th.cat(parts, dim=-1)
