"""The policy of RESeL-PPO: it acts on its history and is trained through its memory."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_uspl.baselines.sequences import EMBEDDING, HistoryEncoder, SequenceBatch
from sb3_uspl.contract_policy import ContractPolicy
from sb3_uspl.encoder import Tokens, encode_actions, reset_rows
from sb3_uspl.observations import COMMON, PREVIOUS_ACTION, PRIVILEGED, check_observation_space
from sb3_uspl.policy_features import PolicyFeatures


class HistoryState(NamedTuple):
    """What the policy carries from one decision to the next; numpy arrays, environments first."""

    previous_action: np.ndarray
    """Encoded last action, ``(n_envs, n_action)``."""
    memory: tuple[np.ndarray, ...]
    """The encoder's memory."""


class RESeLPolicy(ContractPolicy):
    """
    Actor on the history of ``common``, ``target`` and actions; critic on the common and the true privileged observation.

    The actor is USPL's, with the memory's embedding at its full width in the place of the privileged observation. The
    optimizer has two parameter groups: actor and critic, then the encoder.

    :param observation_space: the environment's observation space (the contract)
    :param action_space: action space
    :param lr_schedule: initial learning rate
    :param net_arch: layers of actor and critic, as in SB3
    :param activation_fn: their activation (ELU in the paper)
    :param encoder: preset of the encoder, "small" or "paper" (App. C.3.3)
    :param memory: the encoder's memory, "transformer", "gru" or "max"
    :param encoder_kwargs: replaces single entries of the preset
    :param privileged_gain: factor that brings privileged values to unit scale
    :param normalize_common: as for ``USPLPolicy``
    :param bounded_mean: as for ``USPLPolicy``
    :param kwargs: further arguments of ``ActorCriticPolicy``
    :raises ValueError: for a space outside the contract, an unknown preset or memory, or dropout
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ELU,
        *,
        encoder: str = "small",
        memory: str = "transformer",
        encoder_kwargs: dict[str, Any] | None = None,
        privileged_gain: float = 4.0,
        normalize_common: bool = True,
        bounded_mean: bool = True,
        **kwargs: Any,
    ):
        self.contract = check_observation_space(observation_space)
        self.arguments: dict[str, Any] = dict(
            encoder=encoder,
            memory=memory,
            encoder_kwargs=encoder_kwargs,
            privileged_gain=privileged_gain,
            normalize_common=normalize_common,
            bounded_mean=bounded_mean,
        )
        self._own_features(kwargs)
        history = HistoryEncoder(self.contract, get_flattened_obs_dim(action_space), encoder, memory, encoder_kwargs)
        embedding = spaces.Box(-np.inf, np.inf, (history.width,), np.float32)
        super().__init__(
            spaces.Dict({**self.contract.spaces, EMBEDDING: embedding}),
            action_space,
            lr_schedule,
            net_arch=[128, 128] if net_arch is None else net_arch,
            activation_fn=activation_fn,
            features_extractor_class=PolicyFeatures,
            share_features_extractor=False,
            **kwargs,
        )
        self.encoder = history
        self.optimizer.add_param_group({"params": list(history.parameters())})
        self._bound_mean(bounded_mean)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """ActorCriticPolicy asks for the actor's features first, then for the critic's."""
        space, normalize = self.observation_space, self.arguments["normalize_common"]
        assert isinstance(space, spaces.Dict)
        if hasattr(self, "pi_features_extractor"):
            return PolicyFeatures(space, PRIVILEGED, False, False, self.arguments["privileged_gain"], normalize)
        seen = spaces.Dict({COMMON: space[COMMON], PRIVILEGED: space[EMBEDDING]})
        return PolicyFeatures(seen, EMBEDDING, False, False, 1.0, normalize)

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        # ActorCriticPolicy takes it that actor and critic have features of one width.
        n_inputs = self.vf_features_extractor.features_dim
        critic = MlpExtractor(n_inputs, self.net_arch, self.activation_fn, self.device)
        self.mlp_extractor.value_net, self.mlp_extractor.latent_dim_vf = critic.value_net, critic.latent_dim_vf

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.pop("features_extractor_class")
        data.pop("features_extractor_kwargs")
        return {**data, "observation_space": self.contract, **self.arguments}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        assert isinstance(obs, dict)
        return super().forward({key: obs[key] for key in (COMMON, PRIVILEGED, EMBEDDING) if key in obs}, deterministic)  # type: ignore[arg-type]

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        assert isinstance(obs, dict)
        return super().predict_values({key: obs[key] for key in (COMMON, PRIVILEGED) if key in obs})

    def evaluate_actions(  # type: ignore[override]
        self, obs: SequenceBatch, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        :param obs: whole sequences, encoded anew, with gradient
        :param actions: of the decisions of the rollout, ``(n_decisions, ...)``
        :return: values, log-probabilities and entropies, ``(n_decisions,)``
        """
        embedding, _ = self.encoder(obs.tokens, obs.lengths)
        seen = {COMMON: obs.tokens[COMMON][obs.sampled], PRIVILEGED: obs.privileged, EMBEDDING: embedding[obs.sampled]}
        return super().evaluate_actions(seen, actions)

    def update_normalizers(self, tokens: Tokens) -> None:
        """
        Take account of more observations; between PPO's updates only, which compare old and new policy.

        :param tokens: unpadded, ``(n_tokens, ...)`` by key
        """
        self.encoder.features.update_normalizers(tokens)
        for features in (self.pi_features_extractor, self.vf_features_extractor):
            assert isinstance(features, PolicyFeatures)
            features.update_normalizer(tokens[COMMON].float())

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, HistoryState]:
        """
        Action on the history. A ``privileged`` key in the observation is ignored.

        :param observation: ``common`` (and ``target``), of one environment or stacked
        :param state: what the last call returned; None at the start
        :param episode_start: which environments have just been reset, ``(n_envs,)``
        :param deterministic: the actor's mode instead of a sample
        :return: action(s) and the next state
        :raises ValueError: for a missing key, a value that is not finite, or a state or ``episode_start`` of another number of
            environments or of another memory
        """
        self.set_training_mode(False)
        tokens, vectorized = self._as_tokens(observation)
        n_envs = len(tokens[COMMON])
        if state is None:
            previous_action = np.zeros((n_envs, get_flattened_obs_dim(self.action_space)), dtype=np.float32)
            memory = self.encoder.memory.initial_state(n_envs)
        else:
            previous_action = state[0].copy()
            memory = self._as_memory(state[1], self.encoder.memory.initial_state(n_envs))
        if len(previous_action) != n_envs:
            raise ValueError(
                f"The state holds {len(previous_action)} environments but {n_envs} observations were given: pass the state "
                "that predict returned for the same environments, or None to start anew."
            )
        if episode_start is not None:
            rows = self._starts(episode_start, n_envs)
            previous_action[rows] = 0.0
            reset_rows(memory, th.as_tensor(rows, device=self.device))
        tokens[PREVIOUS_ACTION] = th.as_tensor(previous_action, device=self.device)
        with th.no_grad():
            embedding, memory = self.encoder.step(tokens, memory)
            distribution = self.get_distribution({COMMON: tokens[COMMON], EMBEDDING: embedding})
            actions = distribution.get_actions(deterministic=deterministic).cpu().numpy()
        actions = actions.reshape((n_envs, *self.action_space.shape))  # type: ignore[misc, arg-type]
        if isinstance(self.action_space, spaces.Box):
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        encoded = encode_actions(actions, self.action_space)
        next_state = HistoryState(encoded, tuple(part.cpu().numpy() for part in memory))
        return (actions if vectorized else actions[0]), next_state
