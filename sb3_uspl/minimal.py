"""
Uncertainty-sensitive privileged learning in one file, to be read from top to bottom: numpy and torch, no Stable-Baselines3.

``python -m sb3_uspl.minimal`` trains USPL and two of its ancestors on Target Reaching, about a minute each on one core. What
the package adds is speed, generality and comfort: episodes that outlast a rollout, discrete values and images, Transformers,
callbacks, saving. Here an iteration plays whole episodes in step: arrays ``(time, episode, ...)`` and a mask of what counts.
"""

import argparse
import math
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch as th
import torch.nn.functional as F
from numpy.random import Generator as Rng
from torch import nn
from torch.distributions import Normal
from torch.optim import Adam

INITIAL_STD, MIN_STD, MAX_STD = 0.5, 0.005, 1.0
"""The uncertainty before the first observation, and the range of the encoder's."""


@dataclass(frozen=True)
class Settings:
    """One training. The defaults are USPL; ``VANILLA`` and ``REWARD_REGULARISED`` are its ancestors."""

    blur: bool = True
    reward_scaling: bool = True
    uncertainty_input: bool = True
    """Whether actor and critic see the encoder's standard deviation, and its mean."""
    divergence_penalty: float = 0.0
    """Reward lost for each unit of squared distance between the privileged and the deployment policy's action."""
    mismatch_fraction: float = 0.25
    """Share of the episodes whose policy sees another episode's privileged observation; only the encoder learns from them."""
    blur_gain: float = 10.0
    """K of Eq. 3."""
    c_min: float = math.log(0.2)
    c_max: float = math.log(0.2) - math.log(0.01)
    delta: float = 0.05
    smoothing_time: float = 0.39
    """s, time constant of the uncertainty's smoothing."""
    iterations: int = 80
    episodes: int = 192
    """An iteration."""
    warmup: float = 0.15
    ramp: float = 0.4
    """Shares of the iterations in which the progress coefficient l is 0 and in which it rises to 1."""
    gamma: float = 0.95
    gae_lambda: float = 0.97
    learning_rate: float = 5e-4
    action_std: float = 0.35
    final_share: float = 0.2
    """Of learning rate and action noise at the end; both fall along a cosine."""
    clip_range: float = 0.2
    epochs: int = 8
    minibatch: int = 512
    """Decisions."""
    encoder_learning_rate: float = 1e-3
    encoder_updates: int = 8
    encoder_episodes: int = 96
    """An update, half of them of this iteration, half replayed."""
    replay_iterations: int = 50
    """Whose mismatched episodes are kept."""
    width: int = 64
    seed: int = 1


VANILLA = Settings(blur=False, reward_scaling=False, uncertainty_input=False)
REWARD_REGULARISED = replace(VANILLA, divergence_penalty=1.0)
USPL = Settings()

# -- the equations -----------------------------------------------------------------------------------------------------------


def gaussian_nll(mean: th.Tensor, log_std: th.Tensor, truth: th.Tensor) -> th.Tensor:
    """Eq. 1: how surprised a belief is by the truth, all ``(..., n_privileged)``; summed over dimensions, ``(...)``."""
    z = (truth - mean) / log_std.exp()
    return (0.5 * z**2 + log_std + 0.5 * math.log(2.0 * math.pi)).sum(-1)


def reward_coefficient(std: np.ndarray, progress: float, settings: Settings) -> np.ndarray:
    """
    Eq. 2: what is gained while the encoder knows nothing counts little.

    :param std: uncertainty, ``(n, n_privileged)``
    :param progress: l in [0, 1]
    :param settings: C_min, C_max, delta
    :return: factor on the reward, ``(n,)``
    """
    d = np.clip(settings.c_min - np.log(std.mean(-1)), 0.0, settings.c_max) + settings.delta
    return (1.0 - d) * (1.0 - progress) + d


def blur(shown: np.ndarray, std: np.ndarray, noise: np.ndarray, progress: float, gain: float, limit: float) -> np.ndarray:
    """
    Eq. 3: what the encoder does not know, the privileged policy is not shown.

    :param shown: privileged observation, ``(n, n_privileged)``
    :param std: uncertainty, same shape
    :param noise: uniform in [-1, 1], same shape
    :param progress: l in [0, 1]
    :param gain: K
    :param limit: greatest absolute value of a privileged observation
    :return: what is shown instead
    """
    return np.clip(shown + progress * gain * std * noise, -limit, limit)


def cosine_progress(step: float, start: float, period: float) -> float:
    """App. C.3.1: the progress coefficient l, 0 before ``start``, then half a cosine wave up to 1 over ``period``."""
    return 0.5 * (1.0 - math.cos(math.pi * min(max((step - start) / period, 0.0), 1.0)))


def advantages(rewards: np.ndarray, values: np.ndarray, ended: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """
    Generalised advantage estimation (Schulman et al. 2016).

    :param rewards: ``(time, n)``
    :param values: of the states before each decision and after the last, ``(time + 1, n)``
    :param ended: whether the task ended with that decision, ``(time, n)``; a time-out does not end it
    :param gamma: discount factor
    :param gae_lambda: lambda
    :return: ``(time, n)``
    """
    result, last = np.zeros_like(rewards), np.zeros(rewards.shape[1])
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - ended[t]
        last = rewards[t] + gamma * values[t + 1] * goes_on - values[t] + gamma * gae_lambda * goes_on * last
        result[t] = last
    return result


def ppo_loss(log_prob: th.Tensor, old_log_prob: th.Tensor, advantage: th.Tensor, clip_range: float) -> th.Tensor:
    """PPO's clipped objective (Schulman et al. 2017), to be minimised; all ``(n,)``, old: of the policy that acted."""
    ratio = (log_prob - old_log_prob).exp()
    return -th.min(ratio * advantage, ratio.clamp(1.0 - clip_range, 1.0 + clip_range) * advantage).mean()


# -- world and networks ------------------------------------------------------------------------------------------------------


class TargetReaching:
    """``TargetReaching-v0`` (Fig. 1), ``n`` episodes in step: a point looks for a target at the left or the right wall."""

    N_COMMON, N_PRIVILEGED, N_ACTION, HORIZON = 2, 1, 2, 50
    LIMIT = 0.2
    """Of the privileged observation: x of the target / 4."""
    DECISION_PERIOD = 0.2  # s

    def __init__(self, n: int, rng: Rng):
        self.position = rng.uniform(-0.2, 0.2, (n, 2))
        self.target = np.stack([np.where(rng.random(n) < 0.55, -0.8, 0.8), np.zeros(n)], axis=1)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """:return: what the robot sees, its position, ``(n, 2)``, and what only the simulator knows, ``(n, 1)``"""
        return self.position.astype(np.float32), (0.25 * self.target[:, :1]).astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param action: velocity in [-1, 1], ``(n, 2)``; beyond is clipped
        :return: reward, and whether the target was reached, ``(n,)`` each
        """
        before = np.linalg.norm(self.target - self.position, axis=1)
        self.position = np.clip(self.position + 0.1 * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        after = np.linalg.norm(self.target - self.position, axis=1)
        return 5.0 * (before - after) + 2.0 * (after < 0.15), after < 0.15


class Encoder(nn.Module):
    """From the history of what is seen and done to a Gaussian belief about the privileged observation."""

    def __init__(self, width: int):
        super().__init__()
        self.features = nn.Sequential(nn.Linear(TargetReaching.N_COMMON + TargetReaching.N_ACTION, width), nn.ELU())
        self.memory = nn.GRU(width, width)
        self.head = nn.Linear(width, 2 * TargetReaching.N_PRIVILEGED)
        # Starting from zero, every belief is N(0, 0.5^2).
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)

    def forward(self, tokens: th.Tensor, state: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param tokens: common observations and previous actions, ``(time, n, n_common + n_action)``
        :param state: memory before them; None at the start
        :return: mean and log standard deviation, ``(time, n, n_privileged)``, and the memory after them
        """
        memory, state = self.memory(self.features(tokens), state)
        mean, log_std = self.head(memory).chunk(2, dim=-1)
        low, high = math.log(MIN_STD), math.log(MAX_STD)
        log_std = high - F.softplus(high - log_std)  # limits that never stop the gradient
        return mean, low + F.softplus(log_std - low), state


class Agent(nn.Module):
    """Actor, critic and encoder. The actor sees what it is shown, the critic the truth."""

    def __init__(self, settings: Settings):
        super().__init__()
        self.uncertainty_input = settings.uncertainty_input
        n_inputs = TargetReaching.N_COMMON + TargetReaching.N_PRIVILEGED * (3 if self.uncertainty_input else 1)
        self.actor, self.critic = (self._mlp(n_inputs, n, settings.width) for n in (TargetReaching.N_ACTION, 1))
        self.encoder = Encoder(settings.width)

    @staticmethod
    def _mlp(n_inputs: int, n_outputs: int, width: int) -> nn.Sequential:
        hidden = [nn.Linear(n_inputs, width), nn.ELU(), nn.Linear(width, width), nn.ELU()]
        last = nn.Linear(width, n_outputs)
        nn.init.normal_(last.weight, std=0.01)  # at the beginning: stand still, and try around
        return nn.Sequential(*hidden, last)

    def inputs(self, common: np.ndarray, shown: np.ndarray, std: np.ndarray, mean: np.ndarray) -> th.Tensor:
        """
        :param common: ``(n, n_common)``
        :param shown: privileged observation, or what stands for it, ``(n, n_privileged)``
        :param std: uncertainty, same shape
        :param mean: the encoder's mean, same shape
        :return: input of actor or critic, each part at about unit scale
        """
        parts = [common, 4.0 * shown]
        if self.uncertainty_input:
            # Logarithmic as in Eq. 2, and 0 for a beginner; the mean weaker than what is shown, which is to be trusted first.
            parts += [-np.log(np.maximum(std, MIN_STD) / INITIAL_STD) / math.log(MIN_STD / INITIAL_STD), 1.2 * mean]
        return th.as_tensor(np.concatenate(parts, axis=-1), dtype=th.float32)

    def action(self, inputs: th.Tensor) -> th.Tensor:
        """:return: mean of the action, in (-1, 1)"""
        return th.tanh(self.actor(inputs))


# -- experience and the two updates ------------------------------------------------------------------------------------------

Episodes = dict[str, np.ndarray]
"""``(time, n, ...)``: ``tokens`` for the encoder, ``truth``, ``mean`` and ``std`` (smoothed) of the belief, ``shown`` to the
actor, ``actor_inputs``, ``critic_inputs``, ``actions``, ``rewards``, ``ended`` (target reached), ``running`` (False from the
end on, when nothing counts any more), ``values`` (one more in time)."""


@th.no_grad()
def play(
    agent: Agent,
    settings: Settings,
    n: int,
    rng: Rng,
    policy: str = "deployment",
    progress: float = 0.0,
    action_std: float = 0.0,
    n_mismatched: int = 0,
) -> Episodes:
    """
    Alg. 1, lines 3-11: whole episodes. The defaults are an evaluation.

    :param policy: "deployment": the encoder's mean is shown; "privileged": the truth, blurred if ``progress`` is not 0
    :param progress: l in [0, 1]
    :param action_std: of the exploration noise
    :param n_mismatched: the last so many episodes are shown each other's privileged observation
    :return: the episodes
    :raises ValueError: for an unknown policy
    """
    if policy not in ("deployment", "privileged"):
        raise ValueError(f"policy='{policy}': choose 'deployment' or 'privileged'.")
    world, source = TargetReaching(n, rng), np.arange(n)
    source[n - n_mismatched :] = np.roll(source[n - n_mismatched :], 1)
    smoothing = math.exp(-world.DECISION_PERIOD / settings.smoothing_time) if settings.smoothing_time > 0.0 else 0.0
    action = np.zeros((n, world.N_ACTION), dtype=np.float32)
    std = np.full((n, world.N_PRIVILEGED), INITIAL_STD, dtype=np.float32)
    running, state, record = np.ones(n, dtype=bool), None, defaultdict(list)
    for t in range(world.HORIZON + 1):
        common, truth = world.observe()
        tokens = np.concatenate([common, np.clip(action, -1.0, 1.0)], axis=1)
        mean, log_std, state = agent.encoder(th.as_tensor(tokens)[None], state)
        mean, std = mean[0].numpy(), smoothing * std + (1.0 - smoothing) * log_std[0].exp().numpy()
        shown = mean if policy == "deployment" else truth[source]
        if settings.blur and policy == "privileged":
            shown = blur(shown, std, rng.uniform(-1.0, 1.0, shown.shape), progress, settings.blur_gain, world.LIMIT)
        actor_inputs, critic_inputs, deployed = (agent.inputs(common, part, std, mean) for part in (shown, truth, mean))
        record["values"].append(agent.critic(critic_inputs)[:, 0].numpy())
        if t == world.HORIZON:  # only the value of where a time-out leaves the robot is wanted
            break
        decided = agent.action(actor_inputs)
        action = (decided.numpy() + action_std * rng.standard_normal((n, world.N_ACTION))).astype(np.float32)
        rewards, ended = world.step(action)
        if settings.reward_scaling:
            rewards = rewards * reward_coefficient(std, progress, settings)
        if settings.divergence_penalty > 0.0:
            divergence = (decided - agent.action(deployed)).square().sum(1).numpy()
            rewards = rewards - progress * settings.divergence_penalty * divergence
        step = dict(tokens=tokens, truth=truth, mean=mean, std=std, shown=shown, actions=action, rewards=rewards, ended=ended)
        step |= dict(running=running, actor_inputs=actor_inputs.numpy(), critic_inputs=critic_inputs.numpy())
        for name, value in step.items():
            record[name].append(value)
        running = running & ~ended
    return {name: np.stack(values) for name, values in record.items()}


def success_rate(episodes: Episodes) -> float:
    """:return: share of the episodes in which the target was reached in time"""
    return float((episodes["ended"] & episodes["running"]).any(0).mean())


def update_policy(agent: Agent, optimizer: Adam, episodes: Episodes, settings: Settings, std: float, rng: Rng) -> None:
    """Alg. 1, line 12: PPO on the decisions that were really taken, with actions sampled around their mean with ``std``."""
    values, taken = episodes["values"], episodes["running"]
    gain = advantages(episodes["rewards"], values, episodes["ended"], settings.gamma, settings.gae_lambda)
    arrays = [*(episodes[name] for name in ("actor_inputs", "critic_inputs", "actions")), gain, gain + values[:-1]]
    data = [th.as_tensor(array[taken], dtype=th.float32) for array in arrays]
    with th.no_grad():
        data.append(Normal(agent.action(data[0]), std).log_prob(data[2]).sum(1))
    for _ in range(settings.epochs):
        for rows in th.as_tensor(rng.permutation(len(data[0]))).split(settings.minibatch):
            actor_inputs, critic_inputs, actions, advantage, returns, old = (part[rows] for part in data)
            log_prob = Normal(agent.action(actor_inputs), std).log_prob(actions).sum(1)
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
            value_loss = F.mse_loss(agent.critic(critic_inputs)[:, 0], returns)
            optimizer.zero_grad()
            (ppo_loss(log_prob, old, advantage, settings.clip_range) + 0.5 * value_loss).backward()
            optimizer.step()


def update_encoder(
    encoder: Encoder, optimizer: Adam, fresh: Episodes, replay: Sequence[Episodes], settings: Settings, rng: Rng
) -> float:
    """Alg. 1, line 13: Eq. 1, half on fresh episodes, half on an earlier iteration's; returns the mean loss."""
    losses = []
    for _ in range(settings.encoder_updates):
        sources = [fresh, replay[int(rng.integers(len(replay)))]] if replay else [fresh]
        n = settings.encoder_episodes // len(sources)
        drawn = [(source, rng.integers(source["truth"].shape[1], size=n)) for source in sources]
        tokens, truth, running = (
            th.as_tensor(np.concatenate([source[name][:, rows] for source, rows in drawn], axis=1))
            for name in ("tokens", "truth", "running")
        )
        mean, log_std, _ = encoder(tokens)
        loss = gaussian_nll(mean, log_std, truth)[running].mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(encoder.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
    return float(np.mean(losses))


def train(settings: Settings, verbose: bool = False) -> tuple[Agent, list[dict[str, float]]]:
    """
    Alg. 1.

    :param settings: of the training
    :param verbose: whether to print a line every ten iterations
    :return: the agent and what was logged in every iteration
    :raises ValueError: if a mismatched episode would have nobody to swap with, or none is left to train the policy
    """
    n_mismatched = round(settings.mismatch_fraction * settings.episodes)
    if n_mismatched == 1 or not 0 <= n_mismatched < settings.episodes:
        raise ValueError(f"{n_mismatched} of {settings.episodes} episodes mismatched: take none, or some but at least 2.")
    th.manual_seed(settings.seed)
    rng, agent, log = np.random.default_rng(settings.seed), Agent(settings), []
    policy_optimizer = Adam([*agent.actor.parameters(), *agent.critic.parameters()], settings.learning_rate, fused=True)
    encoder_optimizer = Adam(agent.encoder.parameters(), settings.encoder_learning_rate, fused=True)
    replay: deque[Episodes] = deque(maxlen=settings.replay_iterations)
    first_mismatched = settings.episodes - n_mismatched
    for iteration in range(settings.iterations):
        share = iteration / settings.iterations
        progress = cosine_progress(share, settings.warmup, settings.ramp)
        left = 1.0 - (1.0 - settings.final_share) * cosine_progress(share, 0.0, 1.0)
        policy_optimizer.param_groups[0]["lr"] = left * settings.learning_rate
        std = left * settings.action_std
        episodes = play(agent, settings, settings.episodes, rng, "privileged", progress, std, n_mismatched)
        matched = {name: array[:, :first_mismatched] for name, array in episodes.items()}
        update_policy(agent, policy_optimizer, matched, settings, std, rng)
        nll = update_encoder(agent.encoder, encoder_optimizer, episodes, replay, settings, rng)
        replay.append({name: array[:, first_mismatched if n_mismatched else 0 :] for name, array in episodes.items()})
        row = dict(progress=progress, nll=nll, uncertainty=float(matched["std"][matched["running"]].mean()))
        row |= dict(privileged=success_rate(matched), deployment=success_rate(play(agent, settings, 50, rng)))
        log.append(row)
        if verbose and (iteration + 1) % 10 == 0:
            print(f"{iteration + 1:5d}  " + "  ".join(f"{name} {value:5.2f}" for name, value in row.items()), flush=True)
    return agent, log


if __name__ == "__main__":
    argparse.ArgumentParser(prog="python -m sb3_uspl.minimal", description=__doc__).parse_args()
    th.set_num_threads(1)
    for title, chosen in {"vanilla": VANILLA, "reward-regularised": REWARD_REGULARISED, "USPL": USPL}.items():
        print(title)
        trained, _ = train(chosen, verbose=True)
        for who in ("privileged", "deployment"):
            print(f"{who} policy: {success_rate(play(trained, chosen, 500, np.random.default_rng(0), who)):.1%} of 500")
