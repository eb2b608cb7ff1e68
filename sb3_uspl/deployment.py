"""The deployment policy as a pure function, for export: observation and memory in, action and memory out."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, preprocess_obs
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_uspl.baselines import RESeLPolicy
from sb3_uspl.baselines.sequences import EMBEDDING
from sb3_uspl.encoder.memory import MEMORIES, GRUMemory, MaxMemory, Memory, MemoryState, TransformerMemory
from sb3_uspl.observations import BELIEF, COMMON, PREVIOUS_ACTION, PRIVILEGED, TARGET, TRUTH, UNCERTAINTY
from sb3_uspl.policies import USPLPolicy
from sb3_uspl.uncertainty import INITIAL_STD

NEXT = "next_"
"""Prefix of a memory's output; the name of its input follows."""


@dataclass(frozen=True)
class Signal:
    """One input or output; its arrays are ``(n_robots, *shape)``."""

    name: str
    dtype: str
    """numpy's name of it."""
    shape: tuple[int, ...]
    meaning: str
    initial: float | None = None
    """Value of every number of it at the start of an episode; None for what is no memory."""

    def start(self, n_robots: int) -> th.Tensor:
        """
        :param n_robots: number of robots
        :return: the value at the start of an episode, ``(n_robots, *shape)``; zeros for what is no memory
        """
        return th.as_tensor(np.full((n_robots, *self.shape), self.initial or 0.0, dtype=self.dtype))


class DeploymentPolicy(nn.Module):
    """
    A copy of the deployment policy whose memory is an argument and a result, deterministic, for any number of robots.

    ``forward`` takes what ``inputs`` lists and returns what ``outputs`` lists, in these orders. What the environment returns
    goes in as it is, images with the channels first, and the action that comes out goes to the robot as it is: normalisation,
    uncertainty smoothing, previous action and clipping are inside.

    :param policy: trained policy, on any device
    :param horizon: decisions that a Transformer remembers; up to that many it acts as in training, then it forgets the oldest
    :param normalize: of the training's environments, if they were normalised
    :raises ValueError: if the policy is not one of this package's, the memory is of a class of its own or the horizon is not
        positive
    """

    def __init__(self, policy: nn.Module, horizon: int, normalize: VecNormalize | None = None):
        super().__init__()
        if not isinstance(policy, USPLPolicy | RESeLPolicy):
            raise ValueError(
                f"{type(policy).__name__} cannot be exported; expected a policy of USPLPPO, RMA or RESeLPPO. For stock SB3 "
                "policies see the guide 'Exporting models' in SB3's documentation."
            )
        if horizon < 1:
            raise ValueError(f"horizon={horizon}: the memory must hold at least one decision.")
        self.policy = _frozen_copy(policy)
        self.has_belief = isinstance(policy, USPLPolicy)
        self.memory = _as_function(self.policy.encoder.memory, horizon)
        self.policy.encoder.memory = self.memory
        self._add_normalizers(normalize)
        space: Any = policy.action_space
        contract: Any = policy.contract
        self.seen = tuple(key for key in (COMMON, TARGET) if key in contract.spaces)
        n_action, n_privileged = get_flattened_obs_dim(space), contract[PRIVILEGED].shape[0]
        recalled = [Signal(PREVIOUS_ACTION, "float32", (n_action,), "the last action; one-hot if discrete", 0.0)]
        if self.has_belief:
            text = "standard deviation of the belief, smoothed in time, privileged units"
            recalled.append(Signal(UNCERTAINTY, "float32", (n_privileged,), text, INITIAL_STD))
        for name, part in zip(self.memory.names, self.memory.initial_state(1), strict=True):
            dtype = str(part.dtype).removeprefix("torch.")
            recalled.append(Signal(name, dtype, tuple(part.shape[1:]), "the encoder's memory", 0.0))
        texts = {COMMON: "what the robot knows of itself", TARGET: "what its sensor reads"}
        self.inputs = [
            *(Signal(key, str(contract[key].dtype), contract[key].shape, texts[key]) for key in self.seen),
            *recalled,
        ]
        dtype = "float32" if isinstance(space, spaces.Box) else "int64"
        self.outputs = [Signal("action", dtype, space.shape, "for the robot, within its bounds")]
        if self.has_belief:
            self.outputs.append(Signal("belief_mean", "float32", (n_privileged,), "mean of the belief, privileged units"))
        self.outputs += [Signal(NEXT + part.name, part.dtype, part.shape, part.meaning) for part in recalled]
        self.eval()

    def forward(self, *arrays: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param arrays: as ``inputs`` lists them
        :return: as ``outputs`` lists them
        """
        given = dict(zip([part.name for part in self.inputs], arrays, strict=True))
        tokens = {key: self._normalized(key, given[key]) for key in self.seen}
        tokens[PREVIOUS_ACTION] = given[PREVIOUS_ACTION]
        state = tuple(given[name] for name in self.memory.names)
        if not self.has_belief:
            embedding, state = self.policy.encoder.step(tokens, state)
            actions, previous_action = self._act({COMMON: tokens[COMMON], EMBEDDING: embedding})
            return actions, previous_action, *state
        belief, state = self.policy.encoder.step(tokens, state)
        std = self.policy.smoothing * given[UNCERTAINTY] + (1.0 - self.policy.smoothing) * belief.std
        seen = {PRIVILEGED: belief.mean, TRUTH: belief.mean, UNCERTAINTY: std, BELIEF: belief.mean}
        actions, previous_action = self._act({COMMON: tokens[COMMON], **seen})
        return actions, belief.mean, previous_action, std, *state

    def _act(self, seen: dict[str, th.Tensor]) -> tuple[th.Tensor, th.Tensor]:
        """Actions for the robot and as the encoder sees them."""
        policy, space = self.policy, self.policy.action_space
        # Not get_distribution(): torch's exporter cannot follow torch.distributions.
        features = policy.pi_features_extractor({key: value.float() for key, value in seen.items()})
        raw = policy.action_net(policy.mlp_extractor.forward_actor(features))
        if isinstance(space, spaces.Box):
            if policy.bounded_mean:
                raw = policy.action_centre + policy.action_half_range * th.tanh(raw)
            low, high = th.as_tensor(space.low), th.as_tensor(space.high)
            actions = raw.reshape(-1, *space.shape).clamp(low, high).float()
        elif isinstance(space, spaces.Discrete):
            actions = raw.argmax(dim=1)
        elif isinstance(space, spaces.MultiDiscrete):
            actions = th.stack([part.argmax(dim=1) for part in raw.split(space.nvec.tolist(), dim=1)], dim=1)
        else:
            actions = (raw > 0.0).long()
        encoded = preprocess_obs(actions, space, normalize_images=False)
        assert isinstance(encoded, th.Tensor)
        return actions, encoded.reshape(actions.shape[0], -1).float()

    def _add_normalizers(self, normalize: VecNormalize | None) -> None:
        self.normalized: dict[str, float] = {}
        if normalize is None or not normalize.norm_obs:
            return
        statistics: Any = normalize.obs_rms
        for key in (COMMON, TARGET):
            if key in (normalize.norm_obs_keys or ()):
                moments: RunningMeanStd = statistics[key]
                self.normalized[key] = normalize.clip_obs
                self.register_buffer(f"{key}_mean", th.as_tensor(moments.mean, dtype=th.float32))
                std = np.sqrt(moments.var + normalize.epsilon)
                self.register_buffer(f"{key}_std", th.as_tensor(std, dtype=th.float32))

    def _normalized(self, key: str, x: th.Tensor) -> th.Tensor:
        if key not in self.normalized:
            return x
        limit = self.normalized[key]
        return ((x - getattr(self, f"{key}_mean")) / getattr(self, f"{key}_std")).clamp(-limit, limit)


class _GRUStep(nn.Module):
    """
    One step of a GRU, in plain operations.

    :param memory: whose weights are taken
    """

    names = ("memory",)

    def __init__(self, memory: GRUMemory):
        super().__init__()
        self.initial_state = memory.initial_state
        self.gru = memory.gru

    def step(self, features: th.Tensor, state: MemoryState, _longest: None = None) -> tuple[th.Tensor, MemoryState]:
        input_weight, hidden_weight, input_bias, hidden_bias = self.gru.parameters()
        (before,) = state
        reset, update, proposal = F.linear(features, input_weight, input_bias).chunk(3, dim=1)
        hidden_reset, hidden_update, hidden_proposal = F.linear(before, hidden_weight, hidden_bias).chunk(3, dim=1)
        kept = th.sigmoid(update + hidden_update)
        new = th.tanh(proposal + th.sigmoid(reset + hidden_reset) * hidden_proposal)
        after = kept * before + (1.0 - kept) * new
        return after, (after,)


class _MaxStep(nn.Module):
    """
    One step of a running maximum.

    :param memory: whose weights are taken
    """

    names = ("memory",)

    def __init__(self, memory: MaxMemory):
        super().__init__()
        self.initial_state, self.step = memory.initial_state, memory.step
        self.weights = memory


class _TransformerStep(nn.Module):
    """
    One step of a Transformer whose keys and values lie in a ring of fixed size: the newest takes the place of the oldest.

    :param memory: whose weights are taken
    :param horizon: size of the ring, in decisions
    """

    names = ("keys", "values", "n_tokens")

    def __init__(self, memory: TransformerMemory, horizon: int):
        super().__init__()
        self.transformer, self.horizon = memory, horizon

    def initial_state(self, n_envs: int) -> MemoryState:
        t = self.transformer
        ring = th.zeros(n_envs, t.n_layers, t.n_key_heads, self.horizon, t.head_width)
        return ring, ring.clone(), th.zeros(n_envs, dtype=th.long)

    def step(self, features: th.Tensor, state: MemoryState, _longest: None = None) -> tuple[th.Tensor, MemoryState]:
        keys, values, n_tokens = state
        places = th.arange(self.horizon)
        here = th.remainder(n_tokens, self.horizon)[:, None]
        newest = (places == here)[:, None, :, None]
        age = th.remainder(here - places, self.horizon)
        bias = -self.transformer.slopes[:, None] * age[:, None]
        bias = th.where((age <= n_tokens[:, None])[:, None], bias, -th.inf)[:, :, None]
        features = features[:, None]
        all_keys, all_values = [], []
        for index, block in enumerate(self.transformer.blocks):
            q, k, v = block.project(features)
            ring_keys, ring_values = th.where(newest, k, keys[:, index]), th.where(newest, v, values[:, index])
            scores = q @ ring_keys.transpose(2, 3) / self.transformer.head_width**0.5 + bias
            features = block.finish(features, th.softmax(scores, dim=-1) @ ring_values)
            all_keys.append(ring_keys)
            all_values.append(ring_values)
        output = self.transformer.out(self.transformer.norm(features))[:, 0]
        return output, (th.stack(all_keys, 1), th.stack(all_values, 1), n_tokens + 1)


def _frozen_copy(policy: nn.Module) -> Any:
    bare = copy.copy(policy)
    del bare.action_dist  # not needed, and it may hold tensors of PPO's last update, which cannot be copied
    return copy.deepcopy(bare).to("cpu").requires_grad_(False)


def _as_function(memory: Memory, horizon: int) -> _GRUStep | _MaxStep | _TransformerStep:
    if isinstance(memory, GRUMemory):
        return _GRUStep(memory)
    if isinstance(memory, MaxMemory):
        return _MaxStep(memory)
    if isinstance(memory, TransformerMemory):
        return _TransformerStep(memory, horizon)
    raise ValueError(f"{type(memory).__name__} cannot be exported; the memories {sorted(MEMORIES)} can.")
