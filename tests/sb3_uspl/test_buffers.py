"""What goes into the buffers comes out of them, and nothing else."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_uspl.buffers import EpisodeReplayBuffer, USPLRolloutBuffer
from tests.sb3_uspl.toy import IMAGE, ToyEnv

N_ENVS = 4


def make_episodes(**kwargs):
    target = kwargs.pop("target", None)
    kwargs = {"n_mismatched": 2, "context_length": 100, "max_bytes": 10**6, "seed": 0, **kwargs}
    return EpisodeReplayBuffer(ToyEnv(target=target).observation_space, 1, N_ENVS, **kwargs)


def observation(steps, value, target=None):
    obs = {
        "common": np.full((N_ENVS, 2), value, np.float32),
        "privileged": np.full((N_ENVS, 1), -1.0, np.float32),
        "truth": np.arange(N_ENVS, dtype=np.float32)[:, None],
        "uncertainty": np.full((N_ENVS, 1), 0.5, np.float32),
        "belief": np.zeros((N_ENVS, 1), np.float32),
        "previous_action": np.full((N_ENVS, 1), value - 1, np.float32),
        "episode_step": np.array(steps),
    }
    return obs | ({"target": np.full((N_ENVS, *target.shape), value, target.dtype)} if target else {})


def fill(episodes, lengths, n_steps, target=None):
    for t in range(n_steps):
        episodes.add(observation([t % length for length in lengths], t, target))


def replayed_and_fresh():
    """As many replayed episodes as fresh ones, of five decisions each; values of fresh ones are 20 and more."""
    episodes = make_episodes(keep="all")
    fill(episodes, [5] * 4, 21)
    episodes.end_iteration()
    for t in range(21, 42):
        episodes.add(observation([t % 5] * 4, t))
    return episodes


def test_episodes_come_out_as_they_went_in():
    episodes = make_episodes(target=IMAGE)
    fill(episodes, [3, 5, 80, 7], 81, IMAGE)  # 80: the running arrays have to grow
    by_env = {env: [e for e in episodes.fresh if e.arrays["truth"][0, 0] == env] for env in range(N_ENVS)}
    assert [len(by_env[env]) for env in range(N_ENVS)] == [26, 16, 1, 11]
    for env, length in enumerate([3, 5, 80, 7]):
        for number, episode in enumerate(by_env[env]):
            assert len(episode) == length
            assert episode.mismatched == (env >= 2)
            np.testing.assert_array_equal(episode.arrays["common"][:, 0], number * length + np.arange(length))
            np.testing.assert_array_equal(episode.arrays["previous_action"][:, 0], number * length + np.arange(length) - 1)
            assert episode.arrays["target"].dtype == np.uint8
            np.testing.assert_array_equal(episode.arrays["target"][:, 0, 0, 0], number * length + np.arange(length))


def test_batches_are_whole_episodes_one_after_another():
    episodes = make_episodes()
    fill(episodes, [3, 5, 9, 7], 20)
    stored = {(e.arrays["truth"][0, 0], *e.arrays["common"][:, 0]) for e in episodes.fresh}
    batches = list(episodes.batches(EpisodeReplayBuffer.STAGED_BATCHES + 2, 50))
    assert len(batches) == EpisodeReplayBuffer.STAGED_BATCHES + 2
    for batch in batches:
        lengths = batch.lengths.tolist()
        assert 50 <= sum(lengths) == len(batch.truth) < 50 + 9
        for truth, common in zip(batch.truth.split(lengths), batch.tokens["common"].split(lengths), strict=True):
            assert (truth == truth[0]).all() and (truth[0, 0].item(), *common[:, 0].tolist()) in stored
    assert len({tuple(batch.tokens["common"][:, 0].tolist()) for batch in batches}) > 1


@pytest.mark.parametrize("window", [1, 4])
def test_windows_are_decisions_in_a_row_from_anywhere_in_an_episode(window):
    episodes = make_episodes()
    fill(episodes, [3, 5, 9, 7], 20)
    stored = {(e.arrays["truth"][0, 0], *e.arrays["common"][i : i + window, 0]) for e in episodes.fresh for i in range(9)}
    stored = {piece for piece in stored if len(piece) == 1 + window}
    seen = set()
    for batch in episodes.batches(5 * EpisodeReplayBuffer.STAGED_BATCHES, 50, window=window):
        lengths = batch.lengths.tolist()
        assert max(lengths) == window and 50 <= sum(lengths) == len(batch.truth) < 50 + window
        for truth, common in zip(batch.truth.split(lengths), batch.tokens["common"].split(lengths), strict=True):
            seen |= {(truth[0, 0].item(), *common[:, 0].tolist())} if len(common) == window else set()
    assert seen == stored


def test_half_of_a_batch_is_fresh_and_half_replayed():
    episodes = replayed_and_fresh()
    (batch,) = episodes.batches(1, 10_000)
    first_value = batch.tokens["common"][::5, 0]
    assert ((first_value >= 20).float().mean() - 0.5).abs() < 0.05


@pytest.mark.parametrize(("keep", "expected"), [("mismatched", {True}), ("all", {True, False})])
def test_what_is_replayed(keep, expected):
    episodes = make_episodes(keep=keep)
    fill(episodes, [5] * 4, 11)
    episodes.end_iteration()
    assert {episode.mismatched for episode in episodes.replay} == expected and episodes.fresh == []


def test_everything_is_replayed_if_nothing_is_mismatched():
    episodes = make_episodes(n_mismatched=0)
    fill(episodes, [5] * 4, 11)
    episodes.end_iteration()
    assert len(episodes.replay) == 8


def test_oldest_episodes_leave_first_within_the_byte_budget():
    episodes = make_episodes(keep="all", n_mismatched=0)
    fill(episodes, [5] * 4, 51)
    newest, size = episodes.fresh[-1], episodes.fresh[0].nbytes
    episodes.max_bytes = 7 * size
    episodes.end_iteration()
    assert len(episodes.replay) == 7 and episodes.nbytes == 7 * size
    assert episodes.replay[-1] is newest


def test_an_episode_longer_than_the_context_is_refused():
    episodes = make_episodes(context_length=5)
    with pytest.raises(ValueError, match=r"longer than the encoder's context of 5.*context_length"):
        fill(episodes, [100] * 4, 6)


def test_nothing_to_sample_before_the_first_end():
    assert list(make_episodes().batches(3, 10)) == []


def test_mismatched_environments_never_enter_the_loss():
    buffer = USPLRolloutBuffer(
        6, ToyEnv().observation_space, spaces.Box(-1, 1, (1,)), n_mismatched=2, n_envs=N_ENVS, gamma=0.9, gae_lambda=0.8
    )
    buffer.episodes = make_episodes()
    for round_ in range(2):
        buffer.reset()
        for t in range(6):
            values = th.arange(N_ENVS).float()
            obs = observation([t] * 4, t)
            buffer.add(obs, np.arange(N_ENVS)[:, None], np.arange(N_ENVS), np.zeros(N_ENVS), values, values)
        buffer.compute_returns_and_advantage(th.zeros(N_ENVS), np.zeros(N_ENVS))
        for _ in range(2):  # PPO passes over the buffer several times
            samples = list(buffer.get(5))
            truth = th.cat([sample.observations["truth"] for sample in samples]).flatten()
            assert sorted(truth.tolist()) == [0.0] * 6 + [1.0] * 6
            actions = th.cat([sample.actions for sample in samples]).flatten()
            assert th.equal(actions, truth), round_
    assert len(buffer.episodes.fresh) == N_ENVS  # the encoder gets them all


@pytest.mark.parametrize("telltale", [False, True])
def test_behaviour_that_gives_the_truth_away_is_not_learned_from(telltale):
    episodes = make_episodes(n_mismatched=1)
    fill(episodes, lengths=[5] * N_ENVS, n_steps=6)
    episodes.telltale = telltale
    matched = [not episode.mismatched for episode in episodes.fresh]
    truth = th.cat([batch.truth[:, 0] for batch in episodes.batches(20, 40)])
    assert any(matched) and not all(matched)
    assert (truth != N_ENVS - 1).any() != telltale
