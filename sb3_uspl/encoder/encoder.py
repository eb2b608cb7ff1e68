"""The observation encoder E_s: a belief about the privileged observation from the history of what is seen (Sec. 3.1)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from sb3_uspl.activations import LEAK, RecoverableTanh
from sb3_uspl.encoder.features import TokenFeatures, Tokens, mlp
from sb3_uspl.encoder.memory import MEMORIES, MemoryState
from sb3_uspl.observations import PRIVILEGED, TARGET, is_image

PRESETS: dict[str, dict[str, Any]] = {
    # Trains on two CPU cores.
    "small": dict(
        hidden=(128,),
        hidden_beside_image=None,
        convolutions=((16, 8, 4, 1), (32, 3, 2, 1)),
        image_layers=(64,),
        trunk=(128,),
        embedding=(128,),
        leak=LEAK,
        head=(),
        frequencies=4,
        fourier_inputs=None,
        normalize=True,
        extremes=True,
        scan=False,
        orthogonal=False,
        categorical=False,
        memory_kwargs={},
    ),
    # Sizes of App. C.3.3.
    "paper": dict(
        hidden=(512, 256, 128),
        hidden_beside_image=(512, 256),
        convolutions=((32, 5, 1, 2), (64, 3, 1, 1)),
        image_layers=(128, 128),
        trunk=(1024, 512, 256),
        embedding=(256, 128),
        leak=LEAK,
        head=(512, 256),
        frequencies=0,
        fourier_inputs=None,
        normalize=True,
        extremes=False,
        scan=False,
        orthogonal=False,
        categorical=False,
        memory_kwargs={"transformer": {"n_heads": 16, "head_width": 64, "shared_keys": False}},
    ),
}  # fmt: skip
"""
Sizes of the encoder: ``hidden`` layers for the common observation and for a vector target, ``hidden_beside_image`` for the
common observation if the target is an image (None: ``hidden``), the image's ``convolutions`` and ``image_layers`` (see
``ImageCNN``), the ``trunk`` before the memory, the ``embedding`` after it and the ``leak`` of its tanh (see
``RecoverableTanh``), the ``head`` of mean and standard deviation,
``frequencies`` of the Fourier features and ``fourier_inputs`` that have them, whether to ``normalize`` the common observation,
``extremes`` of a vector target and the ``scan`` of an image as inputs (all see ``TokenFeatures``), whether linear layers start
``orthogonal`` (gain sqrt(2), no bias) instead of in torch's way, which halves the signal in each, whether the belief about
discrete dimensions is ``categorical`` (see ``DiscreteHead``), and ``memory_kwargs`` by the memory's name.
"""

MIN_STD, MAX_STD = 0.005, 1.0
"""Range of the predicted standard deviation (release: log-std softly clamped to [ln 0.005, 0])."""


class Belief(NamedTuple):
    """
    What is believed of the privileged observation: ``mean`` and ``log_std``, both ``(..., n_privileged)``.

    Of a Gaussian, or of a distribution over the values of a discrete dimension, one of ``log_probs`` ``(..., n_values)``.
    """

    mean: th.Tensor
    log_std: th.Tensor
    log_probs: tuple[th.Tensor, ...] = ()

    def float(self) -> "Belief":
        """The same in float32."""
        return Belief(self.mean.float(), self.log_std.float(), tuple(part.float() for part in self.log_probs))

    @property
    def std(self) -> th.Tensor:
        """Standard deviation, between ``MIN_STD`` and ``MAX_STD``."""
        return self.log_std.exp()


def soft_clamp(x: th.Tensor, low: float, high: float) -> th.Tensor:
    """
    Smooth limits that never stop the gradient: softplus towards both ends.

    :param x: any value
    :param low: lower limit
    :param high: upper limit
    :return: value in (low, high)
    """
    x = high - F.softplus(high - x)
    return low + F.softplus(x - low)


def gaussian_nll(belief: Belief, truth: th.Tensor, beta: float = 0.0) -> th.Tensor:
    """
    Negative log-likelihood of the truth, Eq. 1: summed over privileged dimensions, averaged over tokens.

    With ``beta`` each dimension is weighted by ``std ** (2 * beta)``, through which no gradient flows (beta-NLL, Seitzer et
    al. 2022). In the plain likelihood (0) the errors of a dimension count by 1 / std**2: the noise of one that is known well
    drowns the first hints about another.

    :param belief: predicted Gaussians, ``(n_tokens, n_privileged)``
    :param truth: privileged observations, same shape
    :param beta: in [0, 1]
    :return: scalar loss
    """
    z = (truth - belief.mean) * th.exp(-belief.log_std)
    nll = 0.5 * z**2 + belief.log_std + 0.5 * math.log(2.0 * math.pi)
    if beta > 0.0:
        nll = nll * th.exp(2.0 * beta * belief.log_std.detach())
    return nll.sum(-1).mean()


class DiscreteHead(nn.Module):
    """
    Belief about a discrete dimension: a probability for each of its values, trained by cross-entropy.

    A Gaussian has to pass through the mean of two values on the way from one to the other, and pays for its errors by
    their squares; which of the values it is has no order.

    :param logits: network from the embedding to ``n_values`` numbers
    :param values: of the dimension, ``(n_values,)``
    """

    def __init__(self, logits: nn.Module, values: Sequence[float]):
        super().__init__()
        self.logits = logits
        self.values: th.Tensor
        self.register_buffer("values", th.tensor([float(value) for value in values]), persistent=False)

    def forward(self, embedding: th.Tensor) -> th.Tensor:
        """
        :param embedding: ``(..., width)``
        :return: logarithms of probabilities, ``(..., n_values)``
        """
        return F.log_softmax(self.logits(embedding), dim=-1)

    def moments(self, log_probs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param log_probs: ``(..., n_values)``
        :return: mean and logarithm of the standard deviation, each ``(...)``
        """
        probabilities = log_probs.exp()
        mean = (probabilities * self.values).sum(-1)
        variance = (probabilities * (self.values - mean[..., None]) ** 2).sum(-1)
        return mean, 0.5 * th.log(variance + MIN_STD**2)

    def index(self, truth: th.Tensor) -> th.Tensor:
        """
        :param truth: values of this dimension, ``(...)``
        :return: index of each, ``(...)``
        """
        return (truth[..., None] - self.values).abs().argmin(-1)


class ObservationEncoder(nn.Module):
    """
    Token features -> memory over the episode -> mean and log standard deviation.

    :param space: observation space of the environment (the contract)
    :param n_action: number of encoded action values; the previous action is an input
    :param preset: "small" or "paper", see ``PRESETS``
    :param memory: "gru", "transformer" or "max", see ``MEMORIES``
    :param overrides: replaces single entries of the preset
    :param discrete: discrete dimensions of the privileged observation and their values; they matter to ``categorical``
    :raises ValueError: for an unknown preset, memory or override, images that are too small for the CNN, Fourier features of
        inputs that there are not, or ``categorical`` without discrete dimensions
    """

    def __init__(
        self,
        space: spaces.Dict,
        n_action: int,
        preset: str = "small",
        memory: str = "gru",
        overrides: dict[str, Any] | None = None,
        discrete: Mapping[int, Sequence[float]] | None = None,
    ):
        super().__init__()
        if preset not in PRESETS or memory not in MEMORIES:
            raise ValueError(
                f"encoder='{preset}' with memory='{memory}': the presets are {sorted(PRESETS)}, "
                f"the memories {sorted(MEMORIES)}."
            )
        unknown = set(overrides or {}) - set(PRESETS[preset])
        if unknown:
            raise ValueError(
                f"encoder_kwargs has unknown entries {sorted(unknown)}; it may replace {sorted(PRESETS[preset])}."
            )
        sizes = {**PRESETS[preset], **(overrides or {})}
        unknown = set(sizes["memory_kwargs"]) - set(MEMORIES)
        if unknown:
            raise ValueError(
                f"memory_kwargs has unknown entries {sorted(unknown)}; they go by the memory's name, e.g. "
                "memory_kwargs={'transformer': {'n_heads': 8}}."
            )
        n_privileged = space[PRIVILEGED].shape[0]  # type: ignore[index]
        sees = TARGET in space.spaces and is_image(space[TARGET])
        self.features = TokenFeatures(
            space,
            n_action,
            sizes["hidden_beside_image" if sees and sizes["hidden_beside_image"] is not None else "hidden"],
            sizes["trunk"],
            sizes["frequencies"],
            sizes["convolutions"],
            sizes["image_layers"],
            sizes["extremes"],
            sizes["scan"],
            sizes["fourier_inputs"],
            sizes["normalize"],
        )
        self.memory = MEMORIES[memory](self.features.width, **sizes["memory_kwargs"].get(memory, {}))
        self.embedding = mlp(self.memory.width, sizes["embedding"])
        if sizes["embedding"]:
            # "the final embedding is activated using the Tanh function" (C.3.3)
            self.embedding[-1] = RecoverableTanh(sizes["leak"])
        width = sizes["embedding"][-1] if sizes["embedding"] else self.memory.width
        self.mean = self._head(width, sizes["head"], n_privileged)
        self.log_std = self._head(width, sizes["head"], n_privileged)
        if sizes["categorical"] and not discrete:
            raise ValueError(
                "encoder_kwargs=dict(categorical=True), but no dimension of the privileged observation is discrete: give "
                "`discrete_privileged`, e.g. {0: [0.0, 0.25, 0.5]}, or leave `categorical` out."
            )
        heads = discrete if sizes["categorical"] and discrete else {}
        self.discrete = nn.ModuleDict(
            {str(dim): DiscreteHead(self._head(width, sizes["head"], len(heads[dim])), heads[dim]) for dim in sorted(heads)}
        )
        """What is believed categorically, by dimension; ``mean`` and ``log_std`` do not count there."""
        self._continuous = [dim for dim in range(n_privileged) if dim not in heads]
        if sizes["orthogonal"]:
            _start_orthogonal(self.features, self.memory, self.embedding)

    @staticmethod
    def _head(n_inputs: int, hidden: tuple[int, ...], n_outputs: int) -> nn.Sequential:
        # Starting from zero, every belief is N(0, 0.5^2), the state that smoothing starts from.
        last = nn.Linear(hidden[-1] if hidden else n_inputs, n_outputs)
        nn.init.normal_(last.weight, std=0.01)
        nn.init.zeros_(last.bias)
        return nn.Sequential(*mlp(n_inputs, hidden), last)

    def forward(self, tokens: Tokens, lengths: th.Tensor) -> tuple[Belief, MemoryState]:
        """
        Beliefs along whole episodes.

        :param tokens: encoder inputs of whole episodes, one after another, ``(n_tokens, ...)``
        :param lengths: of the episodes, ``(n_episodes,)``
        :return: beliefs ``(n_tokens, n_privileged)`` and the memory after each episode's last token
        """
        memory, state = self.memory(self.features.in_parts(tokens), lengths)
        return self._belief(memory), state

    def step(self, tokens: Tokens, state: MemoryState, longest: int | None = None) -> tuple[Belief, MemoryState]:
        """
        Beliefs after one more token per environment.

        :param tokens: encoder inputs, ``(n_envs, ...)``
        :param state: memory state; may be overwritten
        :param longest: see :meth:`Memory.step`
        :return: beliefs ``(n_envs, n_privileged)`` and the next state
        """
        memory, state = self.memory.step(self.features(tokens), state, longest)
        return self._belief(memory), state

    def _belief(self, memory: th.Tensor) -> Belief:
        embedding = self.embedding(memory)
        mean = self.mean(embedding)
        log_std = soft_clamp(self.log_std(embedding), math.log(MIN_STD), math.log(MAX_STD))
        if not self.discrete:
            return Belief(mean, log_std)
        means, log_stds, log_probs = list(mean.unbind(-1)), list(log_std.unbind(-1)), []
        for dim, head in self._discrete_heads():
            log_probs.append(head(embedding))
            means[dim], log_stds[dim] = head.moments(log_probs[-1])
        return Belief(th.stack(means, -1), th.stack(log_stds, -1), tuple(log_probs))

    def _discrete_heads(self) -> list[tuple[int, DiscreteHead]]:
        return [(int(dim), head) for dim, head in self.discrete.items()]  # type: ignore[misc]

    def loss(self, belief: Belief, truth: th.Tensor, beta: float = 0.0) -> th.Tensor:
        """
        Negative log-likelihood of the truth, Eq. 1, with the probability of the true value where the belief is categorical.

        :param belief: this encoder's, of ``n_tokens`` decisions
        :param truth: privileged observations, ``(n_tokens, n_privileged)``
        :param beta: of the Gaussian part, see :func:`gaussian_nll`
        :return: scalar loss
        """
        if not self.discrete:
            return gaussian_nll(belief, truth, beta)
        dims = self._continuous
        loss = gaussian_nll(Belief(belief.mean[:, dims], belief.log_std[:, dims]), truth[:, dims], beta)
        for (dim, head), log_probs in zip(self._discrete_heads(), belief.log_probs, strict=True):
            loss = loss + F.nll_loss(log_probs, head.index(truth[:, dim]))
        return loss

    def accuracy(self, belief: Belief, truth: th.Tensor) -> th.Tensor:
        """
        :param belief: this encoder's, of ``n_tokens`` decisions
        :param truth: privileged observations, ``(n_tokens, n_privileged)``
        :return: share of the categorical beliefs whose most probable value is the true one; not a number without any
        """
        hits = [
            log_probs.argmax(-1) == head.index(truth[:, dim])
            for (dim, head), log_probs in zip(self._discrete_heads(), belief.log_probs, strict=True)
        ]
        return th.stack(hits).float().mean() if hits else truth.new_tensor(math.nan)


def _start_orthogonal(*parts: nn.Module) -> None:
    for layer in (layer for part in parts for layer in part.modules() if isinstance(layer, nn.Linear)):
        nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
