"""The observation encoder's memory: one interface, three implementations, registered by name in ``MEMORIES``."""

from abc import ABC, abstractmethod

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_uspl.encoder.recurrence import CompiledGRU

MemoryState = tuple[th.Tensor, ...]
"""What a memory carries from one decision to the next; every tensor has the environments as its first axis."""


def reset_rows(state: MemoryState, rows: th.Tensor) -> None:
    """
    Forget everything in some environments, in place. All-zero is every memory's initial state.

    :param state: memory state
    :param rows: boolean mask or indices of environments
    """
    for tensor in state:
        tensor[rows] = 0


def take_rows(state: MemoryState, rows: th.Tensor) -> MemoryState:
    """
    Independent copy of some environments' state.

    :param state: memory state
    :param rows: indices of environments
    :return: state of those environments
    """
    return tuple(tensor[rows] for tensor in state)


def token_mask(lengths: th.Tensor) -> th.Tensor:
    """
    Which places of a table of sequences hold a token.

    :param lengths: of the sequences, ``(n_sequences,)``
    :return: ``(n_sequences, longest)``
    """
    return th.arange(int(lengths.max()), device=lengths.device) < lengths[:, None]


def _padded(features: th.Tensor, mask: th.Tensor) -> th.Tensor:
    table = features.new_zeros(*mask.shape, features.shape[1])
    table[mask] = features
    return table


class Memory(nn.Module, ABC):
    """
    Turns the features seen so far in an episode into one vector per decision.

    ``forward`` over whole sequences and ``step`` over their tokens one by one give the same outputs.

    :param width: number of features of input and output
    """

    def __init__(self, width: int):
        super().__init__()
        self.width = width

    @abstractmethod
    def initial_state(self, n_envs: int) -> MemoryState:
        """
        :param n_envs: number of environments
        :return: all-zero state
        """

    def forward(self, features: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        """
        :param features: whole sequences, one after another, ``(n_tokens, width)``
        :param lengths: of the sequences, ``(n_sequences,)``; 0 is allowed
        :return: outputs, same shape as the features, and the state after each sequence's last token
        """
        if len(features) == 0:
            return features, self.initial_state(len(lengths))
        return self._remember(features, lengths)

    @abstractmethod
    def _remember(self, features: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        """:meth:`forward` with at least one token."""

    @abstractmethod
    def step(self, features: th.Tensor, state: MemoryState, longest: int | None = None) -> tuple[th.Tensor, MemoryState]:
        """
        :param features: one token per environment, ``(n_envs, width)``
        :param state: memory state; may be overwritten
        :param longest: most tokens that any environment has had before; None looks it up in the state, which makes the host
            wait for the device
        :return: outputs ``(n_envs, width)`` and the next state
        """


class GRUMemory(Memory):
    """
    Gated recurrent unit. One token costs the same at any position.

    :param width: number of features of input and output
    """

    def __init__(self, width: int):
        super().__init__(width)
        self.gru = nn.GRU(width, width, batch_first=True)

    def initial_state(self, n_envs: int) -> MemoryState:
        return (th.zeros(n_envs, self.width, device=next(self.parameters()).device),)

    # A compiler would unroll the loop over time, anew for every length; cuDNN's recurrence is beyond its reach anyway.
    @th.compiler.disable  # type: ignore[untyped-decorator]
    def _remember(self, features: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        outputs = self._on_gpu(features, lengths) if features.is_cuda else self._on_cpu(features, lengths)
        # The output of a one-layer GRU is its state; an empty sequence leaves the initial state.
        last = outputs[(lengths.cumsum(0) - 1).clamp(min=0)]
        return outputs, (th.where(lengths[:, None] > 0, last, th.zeros_like(last)),)

    def _on_gpu(self, features: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        mask = token_mask(lengths)
        return self.gru(_padded(features, mask))[0][mask]

    def _on_cpu(self, features: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        input_weight, hidden_weight, input_bias, hidden_bias = self.gru.parameters()
        gates = F.linear(features, input_weight, input_bias)
        return CompiledGRU.apply(gates, hidden_weight, hidden_bias, lengths)

    def step(self, features: th.Tensor, state: MemoryState, longest: int | None = None) -> tuple[th.Tensor, MemoryState]:
        hidden = th.gru_cell(features, state[0], *self.gru.parameters())
        return hidden, (hidden.clone(),)


class MaxMemory(Memory):
    """
    Largest value so far of each of a number of learned features (Zaheer et al. 2017; Qi et al. 2017), beside the present ones.

    Whatever was noticed once is remembered for the rest of the episode, however rarely it happens, and the gradient goes
    straight to the decision at which it was noticed: what a robot must find and compare is learned from far fewer finds than
    with a recurrence. It cannot average or count.

    :param width: number of features of input and output
    :param n_features: number of remembered features; None stands for twice the width
    """

    def __init__(self, width: int, n_features: int | None = None):
        super().__init__(width)
        self.n_features = 2 * width if n_features is None else n_features
        self.notice = nn.Linear(width, self.n_features)
        self.out = nn.Linear(self.n_features + width, width)

    def initial_state(self, n_envs: int) -> MemoryState:
        return (th.zeros(n_envs, self.n_features, device=self.out.weight.device),)

    def _remember(self, features: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        # Zero is where every memory begins, so nothing below it is noticed.
        noticed = F.relu(self.notice(features))
        largest = noticed.clone()
        # Sequences of about the same length together: a table of single decisions and long episodes would be mostly padding.
        octave = (lengths.clamp(min=1) - 1).float().log2().floor()  # minus infinity for sequences of one token
        of_token = octave.repeat_interleave(lengths)
        for group in octave.unique().tolist():
            if group >= 0.0:
                tokens, mask = of_token == group, token_mask(lengths[octave == group])
                largest[tokens] = th.cummax(_padded(noticed[tokens], mask), dim=1).values[mask]
        last = largest.detach()[(lengths.cumsum(0) - 1).clamp(min=0)]
        return self._output(largest, features), (th.where(lengths[:, None] > 0, last, th.zeros_like(last)),)

    def step(self, features: th.Tensor, state: MemoryState, longest: int | None = None) -> tuple[th.Tensor, MemoryState]:
        largest = th.maximum(F.relu(self.notice(features)), state[0])
        return self._output(largest, features), (largest,)

    def _output(self, largest: th.Tensor, features: th.Tensor) -> th.Tensor:
        return F.elu(self.out(th.cat((largest, features), dim=-1)))


class TransformerMemory(Memory):
    """
    Causal Transformer with a cache of keys and values (paper, App. C.3.3), pre-norm with RMSNorm as in the release.

    Positions enter as ALiBi, a penalty on attention that grows with distance, rather than as learned vectors: an episode may
    be longer than any seen in training, cached keys stay valid as the episode grows, and there is no table to size.

    :param width: number of features of input and output
    :param n_heads: attention heads
    :param head_width: features per head; None shares the width among them
    :param n_layers: Transformer blocks
    :param dropout: share of dropped residual features while training
    :param shared_keys: whether all heads look up the same keys and values (multi-query attention, Shazeer 2019). Late in
        an episode, a rollout's time is that of reading the cache, which is smaller by the factor ``n_heads``
    """

    CACHE_BLOCK = 64
    """The cache grows by doubling from this many tokens."""

    def __init__(
        self,
        width: int,
        n_heads: int = 4,
        head_width: int | None = None,
        n_layers: int = 1,
        dropout: float = 0.0,
        shared_keys: bool = True,
    ):
        super().__init__(width)
        self.n_heads, self.n_layers = n_heads, n_layers
        self.head_width = max(1, width // n_heads) if head_width is None else head_width
        self.n_key_heads = 1 if shared_keys else n_heads
        self.blocks: list[_Block] = nn.ModuleList(  # type: ignore[assignment]
            _Block(width, n_heads, self.head_width, dropout, self.n_key_heads) for _ in range(n_layers)
        )
        self.norm = nn.RMSNorm(width)
        self.out = nn.Linear(width, width)
        slopes = 2.0 ** (-8.0 * th.arange(1, n_heads + 1) / n_heads)
        self.register_buffer("slopes", slopes, persistent=False)
        self.slopes: th.Tensor

    def initial_state(self, n_envs: int) -> MemoryState:
        shape = (n_envs, self.n_layers, self.n_key_heads, self.CACHE_BLOCK, self.head_width)
        device = self.slopes.device
        return (
            th.zeros(shape, device=device),
            th.zeros(shape, device=device),
            th.zeros(n_envs, dtype=th.long, device=device),
        )

    def _remember(self, features: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, MemoryState]:
        mask = token_mask(lengths)
        n_tokens = mask.shape[1]
        padded = _padded(features, mask)
        # Not of the features' type: bfloat16, which they may have, cannot tell 256 from 257.
        position = th.arange(n_tokens, dtype=self.slopes.dtype, device=features.device)
        bias = self.slopes[:, None, None] * _recency(position[:, None], position)
        keys, values = [], []
        for block in self.blocks:
            q, k, v = block.project(padded)
            attended = F.scaled_dot_product_attention(q, k.expand_as(q), v.expand_as(q), attn_mask=bias)
            padded = block.finish(padded, attended)
            keys.append(k)
            values.append(v)
        capacity = self.CACHE_BLOCK
        while capacity < n_tokens:
            capacity *= 2
        padding = (0, 0, 0, capacity - n_tokens)
        state = (F.pad(th.stack(keys, 1).detach(), padding), F.pad(th.stack(values, 1).detach(), padding), lengths.clone())
        return self.out(self.norm(padded[mask])), state

    def step(self, features: th.Tensor, state: MemoryState, longest: int | None = None) -> tuple[th.Tensor, MemoryState]:
        keys, values, length = state
        n_tokens = (int(length.max()) if longest is None else longest) + 1
        while n_tokens > keys.shape[3]:
            padding = (0, 0, 0, keys.shape[3])
            keys, values = F.pad(keys, padding), F.pad(values, padding)
        rows = th.arange(len(features), device=features.device)
        position = th.arange(n_tokens, dtype=self.slopes.dtype, device=features.device)
        recency = _recency(length[:, None], position)
        bias = self._grouped(self.slopes[:, None] * recency[:, None])
        features = features[:, None]
        for index, block in enumerate(self.blocks):
            q, k, v = block.project(features)
            keys[rows, index, :, length] = k[:, :, 0]
            values[rows, index, :, length] = v[:, :, 0]
            attended = F.scaled_dot_product_attention(
                self._grouped(q), keys[:, index, :, :n_tokens], values[:, index, :, :n_tokens], attn_mask=bias
            )
            features = block.finish(features, attended.reshape(q.shape))
        return self.out(self.norm(features))[:, 0], (keys, values, length + 1)

    def _grouped(self, by_head: th.Tensor) -> th.Tensor:
        """
        What every head has for one token, ``(n_envs, n_heads, n)`` with any axes of length 1 between; where heads share their
        keys as ``(n_envs, 1, n_heads, n)``: the queries of one head, for which the keys are read once.
        """
        return by_head.reshape(len(by_head), self.n_key_heads, -1, by_head.shape[-1])


def _recency(query: th.Tensor, key: th.Tensor) -> th.Tensor:
    """What ALiBi's slopes are multiplied with: minus the distance of two positions, minus infinity for the future."""
    recency = key - query
    return recency.masked_fill_(recency > 0.0, -th.inf)


class _Block(nn.Module):
    """One pre-norm Transformer block without its attention product, which differs between ``forward`` and ``step``."""

    def __init__(self, width: int, n_heads: int, head_width: int, dropout: float, n_key_heads: int):
        super().__init__()
        self.heads = (n_heads, n_key_heads, n_key_heads)
        self.attention_norm = nn.RMSNorm(width)
        self.qkv = nn.Linear(width, sum(self.heads) * head_width)
        self.merge = nn.Linear(n_heads * head_width, width)
        self.mlp = nn.Sequential(nn.RMSNorm(width), nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.dropout = nn.Dropout(dropout)

    def project(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Queries, keys and values, each ``(n, n_heads, n_tokens, head_width)``, or with a single head for keys and values."""
        qkv = self.qkv(self.attention_norm(features)).unflatten(-1, (sum(self.heads), -1))
        q, k, v = qkv.transpose(1, 2).split(self.heads, dim=1)
        return q, k, v

    def finish(self, features: th.Tensor, attended: th.Tensor) -> th.Tensor:
        features = features + self.dropout(self.merge(attended.transpose(1, 2).flatten(2)))
        return features + self.dropout(self.mlp(features))


MEMORIES: dict[str, type[Memory]] = {"gru": GRUMemory, "transformer": TransformerMemory, "max": MaxMemory}
