"""Policies: actor and critic for PPO, and the observation encoder that turns the actor into the deployment policy."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_uspl.contract_policy import ContractPolicy
from sb3_uspl.distributions import CorrelatedGaussianDistribution
from sb3_uspl.encoder import MemoryState, ObservationEncoder, encode_actions, reset_rows
from sb3_uspl.observations import (
    BELIEF,
    COMMON,
    POLICY_KEYS,
    PREVIOUS_ACTION,
    PRIVILEGED,
    TARGET,
    TRUTH,
    UNCERTAINTY,
    check_observation_space,
    is_image,
    policy_observation_space,
)
from sb3_uspl.policy_features import PolicyFeatures
from sb3_uspl.symmetries import Symmetry, SymmetryGroup
from sb3_uspl.uncertainty import INITIAL_STD, smooth


class DeploymentState(NamedTuple):
    """What the deployment policy carries from one decision to the next; numpy arrays, environments first."""

    belief_mean: np.ndarray
    """Mean of the belief after the last observation, ``(n_envs, n_privileged)``."""
    uncertainty: np.ndarray
    """Smoothed standard deviation of the belief, ``(n_envs, n_privileged)``."""
    previous_action: np.ndarray
    """Encoded last action, ``(n_envs, n_action)``."""
    memory: tuple[np.ndarray, ...]
    """The encoder's memory."""


class USPLPolicy(ContractPolicy):
    """
    Privileged policy and observation encoder (Sec. 3.1).

    PPO trains the actor, which sees the common observation, the blurred privileged observation and the uncertainty, and the
    critic, which sees the true privileged observation. The encoder has its own optimizer and learns by maximum likelihood.
    :meth:`predict` is the deployment policy: encoder and actor on ``common`` and ``target`` alone.

    :param observation_space: the environment's observation space (the contract)
    :param action_space: action space
    :param lr_schedule: learning rate of actor and critic
    :param net_arch: layers of actor and critic, as in SB3
    :param activation_fn: their activation (ELU in the paper)
    :param encoder: preset of the encoder, "small" or "paper" (App. C.3.3)
    :param memory: the encoder's memory, "gru", "transformer" or "max"
    :param encoder_kwargs: replaces single entries of the preset
    :param discrete_privileged: discrete dimensions of the privileged observation and their values, for an encoder with
        ``encoder_kwargs=dict(categorical=True)`` and for ``one_hot``
    :param one_hot: whether actor and critic see discrete dimensions as one number for each value: what to do is often not in
        the order of the values, and whether the third of three things is in the hand is hard to read off one number
    :param encoder_learning_rate: initial learning rate of the encoder
    :param encoder_weight_decay: weight decay of the encoder (Tables 4 and 5)
    :param uncertainty_input: whether actor and critic see the uncertainty ("UI" in Table 2)
    :param mean_input: whether they also see the encoder's mean, as in the authors' release
    :param privileged_gain: factor that brings privileged values to unit scale
    :param normalize_common: whether actor and critic see the common observation with zero mean and unit variance: a corridor's
        width in units of the whole arena would otherwise take PPO long to notice
    :param symmetries: of the world, see ``SymmetryGroup``: actor and critic see situations that look the same as one of them
    :param bounded_mean: whether the mean of continuous actions is squashed into the action space by a tanh, as in the authors'
        release, with the gradient of ``recoverable_tanh``. Without it the mean drifts beyond the bounds, where sampling
        changes nothing any more and a habit of the warm-up cannot be unlearned.
    :param initial_action: mean of continuous actions before any training, in units of the action space, inside its bounds. A
        robot that looks down from the beginning shows its encoder what is to be seen there. None: the middle of the action
        space, or 0 without ``bounded_mean``.
    :param noise_correlation: of the noise of continuous actions from one decision to the next, see
        ``CorrelatedGaussianDistribution``
    :param smoothing: share of the old uncertainty that survives a decision (App. C.3.1)
    :param kwargs: further arguments of ``ActorCriticPolicy``
    :raises ValueError: for a space outside the contract, an unknown preset, ``one_hot`` without discrete dimensions, or an
        ``initial_action`` that the action space does not hold
    """

    critic_waits = False
    """Whether ``forward`` leaves the critic out, see :meth:`without_critic`."""

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ELU,
        *,
        encoder: str = "small",
        memory: str = "gru",
        encoder_kwargs: dict[str, Any] | None = None,
        discrete_privileged: dict[int, list[float]] | None = None,
        encoder_learning_rate: float = 1e-3,
        encoder_weight_decay: float = 0.0,
        uncertainty_input: bool = True,
        mean_input: bool = True,
        privileged_gain: float = 4.0,
        normalize_common: bool = True,
        one_hot: bool = False,
        symmetries: Sequence[Symmetry] = (),
        bounded_mean: bool = True,
        initial_action: Sequence[float] | None = None,
        noise_correlation: float = 0.0,
        smoothing: float = 0.0,
        **kwargs: Any,
    ):
        self.contract = check_observation_space(observation_space)
        if one_hot and not discrete_privileged:
            raise ValueError(
                "policy_kwargs=dict(one_hot=True), but no dimension of the privileged observation is discrete: give "
                "`discrete_privileged`, e.g. {0: [0.0, 0.25, 0.5]}, or leave `one_hot` out."
            )
        self.encoder_arguments: dict[str, Any] = dict(
            encoder=encoder,
            memory=memory,
            encoder_kwargs=encoder_kwargs,
            discrete_privileged=discrete_privileged,
            encoder_learning_rate=encoder_learning_rate,
            encoder_weight_decay=encoder_weight_decay,
            bounded_mean=bounded_mean,
            initial_action=initial_action,
            noise_correlation=noise_correlation,
            smoothing=smoothing,
        )
        self.feature_arguments: dict[str, Any] = dict(
            uncertainty_input=uncertainty_input,
            mean_input=mean_input,
            privileged_gain=privileged_gain,
            normalize_common=normalize_common,
            one_hot=one_hot,
            symmetries=symmetries,
        )
        self._own_features(kwargs)
        if kwargs.get("optimizer_class", th.optim.Adam) is th.optim.Adam:
            # SB3's epsilon. Small networks' minibatches spend a tenth of their time in Adam's loop over the parameters.
            kwargs["optimizer_kwargs"] = {"eps": 1e-5, "fused": True, **(kwargs.get("optimizer_kwargs") or {})}
        super().__init__(
            policy_observation_space(self.contract),
            action_space,
            lr_schedule,
            net_arch=[128, 128] if net_arch is None else net_arch,
            activation_fn=activation_fn,
            features_extractor_class=PolicyFeatures,
            features_extractor_kwargs=None,
            share_features_extractor=False,
            **kwargs,
        )
        self._bound_mean(bounded_mean)
        self.initial_action = initial_action
        if initial_action is not None:
            self._begin_with(initial_action)
        if noise_correlation > 0.0 and isinstance(action_space, spaces.Box):
            self.action_dist = CorrelatedGaussianDistribution(get_flattened_obs_dim(action_space), noise_correlation)
        # Built after super().__init__, whose optimizer must not hold the encoder.
        self.smoothing = smoothing
        n_action = get_flattened_obs_dim(action_space)
        with th.random.fork_rng(devices=[]):  # leaves the random numbers of the actions as they are in stock PPO
            self.encoder = ObservationEncoder(self.contract, n_action, encoder, memory, encoder_kwargs, discrete_privileged)
        self.encoder_optimizer = th.optim.AdamW(
            self.encoder.parameters(), lr=encoder_learning_rate, weight_decay=encoder_weight_decay, fused=True
        )

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """ActorCriticPolicy asks for the actor's features first, then for the critic's."""
        key = TRUTH if hasattr(self, "pi_features_extractor") else PRIVILEGED
        discrete = self.encoder_arguments["discrete_privileged"] or {}
        arguments = {**self.feature_arguments, "one_hot": discrete if self.feature_arguments["one_hot"] else {}}
        return PolicyFeatures(self.observation_space, key, **arguments)  # type: ignore[arg-type]

    @property
    def symmetries(self) -> SymmetryGroup | None:
        """Those of the world that are made use of."""
        assert isinstance(self.pi_features_extractor, PolicyFeatures)
        return self.pi_features_extractor.symmetries

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.pop("features_extractor_class")
        data.pop("features_extractor_kwargs")
        return {**data, "observation_space": self.contract, **self.encoder_arguments, **self.feature_arguments}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        obs = self._only_policy_keys(obs)
        if not self.critic_waits:
            return super().forward(obs, deterministic)  # type: ignore[arg-type]
        distribution = self.get_distribution(obs)
        actions = distribution.get_actions(deterministic)
        nothing = actions.new_zeros((len(actions), 1), dtype=th.float32)
        return actions.reshape((-1, *self.action_space.shape)), nothing, distribution.log_prob(actions)  # type: ignore[misc]

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        return super().predict_values(self._only_policy_keys(obs))

    @staticmethod
    def _only_policy_keys(obs: PyTorchObs) -> PyTorchObs:
        assert isinstance(obs, dict)
        return {key: obs[key] for key in POLICY_KEYS if key in obs}

    def _begin_with(self, action: Sequence[float]) -> None:
        """Choose the bias of an untrained actor so that its mean action is the given one."""
        space = self.action_space
        given = np.asarray(action, dtype=np.float32)
        if not (
            isinstance(space, spaces.Box)
            and given.shape == space.shape
            and (space.low < given).all()
            and (given < space.high).all()
        ):
            raise ValueError(
                f"`initial_action` must be of the shape of a Box action space and inside its bounds, got {list(action)} for "
                f"{space}."
            )
        bias = th.as_tensor(given.flatten(), device=self.device)
        if self.bounded_mean:
            bias = th.atanh((bias - self.action_centre) / self.action_half_range)
        assert isinstance(self.action_net, nn.Linear)
        with th.no_grad():
            self.action_net.bias.copy_(bias)

    def update_normalizers(self, common: np.ndarray) -> None:
        """
        Let actor and critic know more common observations; between PPO's updates only, which compare old and new policy.

        :param common: ``(..., n_common)``
        """
        seen = th.as_tensor(common.reshape(-1, common.shape[-1]), dtype=th.float32, device=self.device)
        for features in (self.pi_features_extractor, self.vf_features_extractor):
            assert isinstance(features, PolicyFeatures)
            features.update_normalizer(seen)

    @contextlib.contextmanager
    def without_encoder(self) -> Iterator[ObservationEncoder]:
        """Within this context, this module's parameters are those of actor and critic. Yields the encoder."""
        encoder = self.encoder
        del self.encoder
        try:
            yield encoder
        finally:
            self.encoder = encoder

    @contextlib.contextmanager
    def without_critic(self) -> Iterator[None]:
        """Within this context, ``forward`` returns zeros for values: a rollout needs them only when it is over."""
        self.critic_waits = True
        try:
            yield
        finally:
            self.critic_waits = False

    def restart(self, lr_schedule: Schedule) -> None:
        """
        Forget what actor and critic have learned; the encoder and the statistics of observations stay.

        :param lr_schedule: learning rate of actor and critic
        """
        device = self.device  # of the first parameter, which is a new one below
        with self.without_encoder():
            self._build(lr_schedule)
            self.to(device)
            if self.initial_action is not None:
                self._begin_with(self.initial_action)

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, DeploymentState]:
        """
        Action of the deployment policy. A ``privileged`` key in the observation is ignored.

        :param observation: ``common`` (and ``target``), of one environment or stacked
        :param state: what the last call returned; None at the start
        :param episode_start: which environments have just been reset, ``(n_envs,)``
        :param deterministic: the actor's mode instead of a sample
        :return: action(s) and the next state
        :raises ValueError: for a missing key, a value that is not finite, or a state or ``episode_start`` of another number of
            environments or of another memory
        """
        return self.act(observation, state, episode_start, deterministic)

    def act(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        *,
        privileged: np.ndarray | None = None,
        uncertainty: np.ndarray | float | None = None,
    ) -> tuple[np.ndarray, DeploymentState]:
        """
        :meth:`predict`, with a chosen privileged observation or uncertainty put in the place of the encoder's.

        With the true privileged observation this is the privileged policy; a chosen uncertainty gives the paper's Fig. 7.

        :param observation: see :meth:`predict`
        :param state: see :meth:`predict`
        :param episode_start: see :meth:`predict`
        :param deterministic: see :meth:`predict`
        :param privileged: shown to the actor instead of the encoder's mean, ``(n_envs, n_privileged)``
        :param uncertainty: shown to the actor instead of the encoder's, broadcast to ``(n_envs, n_privileged)``
        :return: action(s) and the next state
        """
        self.set_training_mode(False)
        tokens, vectorized = self._as_tokens(observation)
        n_envs = len(tokens[COMMON])
        mean, std, previous_action, memory = self._unpack_state(state, n_envs)
        if episode_start is not None:
            rows = self._starts(episode_start, n_envs)
            std[rows], previous_action[rows] = INITIAL_STD, 0.0
            reset_rows(memory, th.as_tensor(rows, device=self.device))
        tokens[PREVIOUS_ACTION] = th.as_tensor(previous_action, device=self.device)
        with th.no_grad():
            belief, memory = self.encoder.step(tokens, memory)
            mean = belief.mean.cpu().numpy()
            std = smooth(std, belief.std.cpu().numpy(), self.smoothing)
            shown = mean if privileged is None else np.asarray(privileged, dtype=np.float32).reshape(mean.shape)
            felt = std if uncertainty is None else np.broadcast_to(np.asarray(uncertainty, dtype=np.float32), std.shape)
            obs = {PRIVILEGED: shown, TRUTH: shown, UNCERTAINTY: felt, BELIEF: mean}
            tensors = {key: th.as_tensor(value.copy(), device=self.device) for key, value in obs.items()}
            distribution = self.get_distribution({COMMON: tokens[COMMON], **tensors})
            if isinstance(distribution, CorrelatedGaussianDistribution):
                distribution = distribution.independent()  # the noise of the training's environments is not touched
            actions = distribution.get_actions(deterministic=deterministic).cpu().numpy()
        actions = actions.reshape((n_envs, *self.action_space.shape))  # type: ignore[misc, arg-type]
        if isinstance(self.action_space, spaces.Box):
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        next_state = DeploymentState(
            mean, std, encode_actions(actions, self.action_space), tuple(part.cpu().numpy() for part in memory)
        )
        return (actions if vectorized else actions[0]), next_state

    def _unpack_state(
        self, state: tuple[np.ndarray, ...] | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, MemoryState]:
        """Copies, because the memory is updated in place while the caller may keep the state."""
        n_privileged = self.contract[PRIVILEGED].shape[0]  # type: ignore[index]
        if state is None:
            mean = np.zeros((n_envs, n_privileged), dtype=np.float32)
            previous_action = np.zeros((n_envs, get_flattened_obs_dim(self.action_space)), dtype=np.float32)
            return mean, np.full_like(mean, INITIAL_STD), previous_action, self.encoder.memory.initial_state(n_envs)
        mean, std, previous_action, memory = state  # type: ignore[misc]
        if len(std) != n_envs:
            raise ValueError(
                f"The state holds {len(std)} environments but {n_envs} observations were given: pass the state that predict "
                "returned for the same environments, or None to start anew."
            )
        return mean, std.copy(), previous_action.copy(), self._as_memory(memory, self.encoder.memory.initial_state(n_envs))


class USPLCnnPolicy(USPLPolicy):
    """
    :class:`USPLPolicy` for image targets; the same network, with a clear error if there is no image.

    :raises ValueError: if the observation space has no image under ``target``
    """

    def __init__(self, observation_space: spaces.Space, *args: Any, **kwargs: Any):
        space = check_observation_space(observation_space)
        if TARGET not in space.spaces or not is_image(space[TARGET]):
            raise ValueError(
                f"CnnPolicy needs a uint8 image (channels, height, width) or a float16 one under 'target', but the space is "
                f"{space}. Use MlpPolicy or MultiInputPolicy."
            )
        super().__init__(observation_space, *args, **kwargs)


MlpPolicy = USPLPolicy
CnnPolicy = USPLCnnPolicy
MultiInputPolicy = USPLPolicy
