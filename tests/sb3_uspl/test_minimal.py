"""The method in one file, against the package: same equations, same world, same inputs."""

import ast
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_uspl import encoder, minimal, schedules, uncertainty
from sb3_uspl.envs import TargetReachingEnv
from sb3_uspl.observations import BELIEF, COMMON, PRIVILEGED, TRUTH, UNCERTAINTY, policy_observation_space
from sb3_uspl.policy_features import PolicyFeatures

RNG = np.random.default_rng(3)
TINY = replace(minimal.USPL, iterations=3, episodes=8, encoder_episodes=4, encoder_updates=2, epochs=2, width=16)


def test_it_is_short_and_needs_numpy_and_torch_only():
    source = Path(minimal.__file__).read_text()
    assert len(source.splitlines()) <= 400
    imported = {
        name.split(".")[0]
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert "torch" in imported and imported <= {"numpy", "torch", *sys.stdlib_module_names}


def test_eq_1_is_the_packages():
    mean, log_std, truth = (th.as_tensor(RNG.normal(size=(20, 3))) for _ in range(3))
    expected = encoder.gaussian_nll(encoder.Belief(mean, log_std), truth)
    th.testing.assert_close(minimal.gaussian_nll(mean, log_std, truth).mean(), expected)


@pytest.mark.parametrize("progress", [0.0, 0.3, 1.0])
def test_eq_2_and_3_are_the_packages(progress):
    settings = minimal.USPL
    std = np.exp(RNG.uniform(np.log(0.005), 0.0, (200, 2)))
    np.testing.assert_allclose(
        minimal.reward_coefficient(std, progress, settings), uncertainty.reward_coefficient(std, progress)
    )
    truth, noise = RNG.uniform(-0.2, 0.2, std.shape), RNG.uniform(-1.0, 1.0, std.shape)
    expected = uncertainty.blur_continuous(truth, std, noise, settings.blur_gain, progress, -0.2, 0.2)
    np.testing.assert_allclose(minimal.blur(truth, std, noise, progress, settings.blur_gain, 0.2), expected)


def test_the_schedule_is_the_packages():
    for step in np.linspace(0.0, 1.0, 41):
        assert minimal.cosine_progress(step, 0.15, 0.4) == pytest.approx(schedules.cosine_progress(step, 0.15, 0.4))


def test_advantages_are_sb3s():
    time, n, gamma, gae_lambda = 6, 4, 0.9, 0.8
    rewards, values = RNG.normal(size=(time, n)), RNG.normal(size=(time + 1, n))
    ended = RNG.random((time, n)) < 0.3
    box = spaces.Box(-1.0, 1.0, (1,))
    buffer = RolloutBuffer(time, box, box, "cpu", gae_lambda, gamma, n)
    starts = np.concatenate([np.ones((1, n)), ended])
    for t in range(time):
        zero = np.zeros((n, 1))
        buffer.add(zero, zero, rewards[t], starts[t], th.as_tensor(values[t]), th.zeros(n))
    buffer.compute_returns_and_advantage(th.as_tensor(values[-1]), starts[-1])
    result = minimal.advantages(rewards, values, ended, gamma, gae_lambda)
    np.testing.assert_allclose(result, buffer.advantages, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss"), [(1.5, 1.0, -1.2), (1.5, -1.0, 1.5), (0.5, 1.0, -0.5), (0.5, -1.0, 0.8)]
)
def test_ppo_loss_hand_computed(ratio, advantage, loss):
    new, old, gain = th.tensor([np.log(ratio) - 2.0]), th.tensor([-2.0]), th.tensor([advantage])
    assert float(minimal.ppo_loss(new, old, gain, 0.2)) == pytest.approx(loss)


def test_the_world_is_the_packages():
    world = minimal.TargetReaching(16, np.random.default_rng(0))
    n_ended = 0
    for i in range(world.position.shape[0]):
        env = TargetReachingEnv()
        env.reset(seed=0)
        assert world.HORIZON == env.MAX_STEPS and world.DECISION_PERIOD == env.decision_period
        single = minimal.TargetReaching(16, np.random.default_rng(0))
        env.position, env.target = single.position[i].copy(), single.target[i].copy()
        for _ in range(world.HORIZON):
            actions = np.stack([RNG.normal(-0.7, 1.0, 16), -5.0 * single.position[:, 1]], axis=1)
            reward, ended = single.step(actions)
            obs, expected, terminated, _, _ = env.step(actions[i])
            common, privileged = single.observe()
            np.testing.assert_allclose(common[i], obs["common"], atol=1e-6)
            np.testing.assert_array_equal(privileged[i], obs["privileged"])
            assert reward[i] == pytest.approx(expected) and ended[i] == terminated
            n_ended += terminated
            if terminated:
                break
    assert n_ended > 0


def test_beliefs_are_clamped_as_the_packages():
    network = minimal.Encoder(8)
    raw = th.linspace(-12.0, 6.0, 7)
    th.nn.init.zeros_(network.head.weight)
    for value in raw:
        network.head.bias.data[1] = value
        _, log_std, _ = network(th.zeros(1, 1, 4))
        limits = np.log(encoder.MIN_STD), np.log(encoder.MAX_STD)
        th.testing.assert_close(log_std[0, 0, 0].detach(), encoder.soft_clamp(value, *limits))


@pytest.mark.parametrize("settings", [minimal.USPL, minimal.VANILLA])
def test_actor_and_critic_see_what_the_packages_see(settings):
    space = TargetReachingEnv().observation_space
    see = settings.uncertainty_input
    reference = PolicyFeatures(policy_observation_space(space), PRIVILEGED, see, see, 4.0, normalize_common=False)
    common, shown, mean = (RNG.normal(size=(9, k)).astype(np.float32) for k in (2, 1, 1))
    std = RNG.uniform(0.001, 1.0, (9, 1)).astype(np.float32)
    obs = {COMMON: common, PRIVILEGED: shown, TRUTH: shown, UNCERTAINTY: std, BELIEF: mean}
    expected = reference({key: th.as_tensor(value) for key, value in obs.items()})
    th.testing.assert_close(minimal.Agent(settings).inputs(common, shown, std, mean), expected)


def test_playing_step_by_step_is_the_sequence_and_smoothing_the_packages():
    agent = minimal.Agent(minimal.USPL)
    for parameter in agent.encoder.parameters():
        th.nn.init.normal_(parameter, std=0.5)
    episodes = minimal.play(agent, minimal.USPL, 5, np.random.default_rng(0), action_std=0.5)
    with th.no_grad():
        mean, log_std, _ = agent.encoder(th.as_tensor(episodes["tokens"]))
    np.testing.assert_allclose(mean, episodes["mean"], atol=1e-5)
    factor = uncertainty.smoothing_factor(minimal.USPL.smoothing_time, TargetReachingEnv.decision_period)
    std = np.full((5, 1), uncertainty.INITIAL_STD)
    for now, recorded in zip(log_std.exp().numpy(), episodes["std"], strict=True):
        std = uncertainty.smooth(std, now, factor)
        np.testing.assert_allclose(std, recorded, rtol=1e-4)
    assert np.ptp(episodes["std"]) > 0.01


def test_what_is_shown():
    agent, rng = minimal.Agent(minimal.USPL), np.random.default_rng(0)
    deployed = minimal.play(agent, minimal.USPL, 12, rng)
    np.testing.assert_array_equal(deployed["shown"], deployed["mean"])
    clear = minimal.play(agent, minimal.USPL, 12, rng, "privileged", n_mismatched=4)
    np.testing.assert_allclose(clear["shown"][:, :8], clear["truth"][:, :8], atol=1e-7)
    np.testing.assert_allclose(clear["shown"][:, 8:], np.roll(clear["truth"][:, 8:], 1, axis=1), atol=1e-7)
    blurred = minimal.play(agent, minimal.USPL, 12, rng, "privileged", progress=1.0)
    assert (np.abs(blurred["shown"] - blurred["truth"]) > 1e-6).mean() > 0.3
    with pytest.raises(ValueError, match="deployment"):
        minimal.play(agent, minimal.USPL, 2, rng, "teacher")


@pytest.mark.parametrize("settings", [TINY, replace(TINY, mismatch_fraction=0.0), replace(TINY, divergence_penalty=1.0)])
def test_training_changes_every_network_and_can_be_repeated(settings):
    th.manual_seed(settings.seed)
    before = minimal.Agent(settings)
    (agent, log), (_, again) = minimal.train(settings), minimal.train(settings)
    assert log == again and len(log) == settings.iterations
    assert np.isfinite([list(row.values()) for row in log]).all()
    for old, new in ((before.actor, agent.actor), (before.critic, agent.critic), (before.encoder, agent.encoder)):
        assert all((a != b).any() for a, b in zip(old.parameters(), new.parameters(), strict=True))


def test_one_mismatched_episode_is_refused():
    with pytest.raises(ValueError, match="at least 2"):
        minimal.train(replace(TINY, mismatch_fraction=0.1))


@pytest.mark.slow
def test_uspl_finds_the_target_and_its_ancestor_does_not():
    rates = []
    for settings in (minimal.USPL, minimal.VANILLA):
        agent, _ = minimal.train(settings)
        rates.append(minimal.success_rate(minimal.play(agent, settings, 300, np.random.default_rng(0))))
    assert rates[0] > 0.95 and rates[1] < 0.6
