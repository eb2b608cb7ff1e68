"""The uncertainty wrapper: right history, right scale, right privileged observation."""

import itertools

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uspl.encoder import MEMORIES, ObservationEncoder
from sb3_uspl.observations import POLICY_KEYS
from sb3_uspl.uncertainty import INITIAL_STD, reward_coefficient
from sb3_uspl.wrappers import UncertaintyConfig, UncertaintyVecWrapper, Wandering
from tests.sb3_uspl.toy import ToyEnv


def make_wrapper(n_envs=4, memory="gru", env_kwargs=None, seed=0, **config):
    th.manual_seed(0)
    venv = DummyVecEnv([lambda: ToyEnv(**(env_kwargs or {})) for _ in range(n_envs)])
    venv.seed(seed)
    encoder = ObservationEncoder(venv.observation_space, 1, memory=memory)
    for head in (encoder.mean[-1], encoder.log_std[-1]):  # a belief that moves visibly with every token
        th.nn.init.normal_(head.weight, std=1.0)
    return UncertaintyVecWrapper(venv, encoder, UncertaintyConfig(**config), seed)


def beliefs_from_scratch(encoder, tokens):
    """Belief after the last of a list of (common, previous action), as one uncached pass."""
    common = th.as_tensor(np.stack([c for c, _ in tokens]))
    action = th.as_tensor(np.stack([a for _, a in tokens]))
    with th.no_grad():
        belief, _ = encoder({"common": common, "previous_action": action}, th.tensor([len(tokens)]))
    return belief.mean[-1].numpy(), belief.std[-1].numpy()


@pytest.mark.parametrize("memory", MEMORIES)
def test_every_belief_comes_from_its_own_episode(memory):
    """Two environments with episodes of different length; terminal observations are encoded with the history before reset."""
    wrapper = make_wrapper(2, memory)
    wrapper.venv.envs[1].length = 5
    obs, rng = wrapper.reset(), np.random.default_rng(1)
    history = [[(obs["common"][i], np.zeros(1, np.float32))] for i in range(2)]
    for _ in range(20):
        for i in range(2):
            mean, std = beliefs_from_scratch(wrapper.encoder, history[i])
            np.testing.assert_allclose(obs["belief"][i], mean, atol=1e-5)
            np.testing.assert_allclose(obs["uncertainty"][i], std, atol=1e-5)
        actions = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        obs, _, dones, infos = wrapper.step(actions)
        for i in range(2):
            if dones[i]:
                terminal = infos[i]["terminal_observation"]
                mean, std = beliefs_from_scratch(wrapper.encoder, [*history[i], (terminal["common"], actions[i])])
                np.testing.assert_allclose(terminal["belief"], mean, atol=1e-5)
                np.testing.assert_allclose(terminal["uncertainty"], std, atol=1e-5)
                assert set(terminal) == set(POLICY_KEYS)
                history[i] = [(obs["common"][i], np.zeros(1, np.float32))]
            else:
                history[i].append((obs["common"][i], actions[i]))
            assert obs["episode_step"][i] == len(history[i]) - 1


def test_only_what_was_cut_short_has_its_end_encoded():
    wrapper = make_wrapper(2)
    ending = wrapper.venv.envs[0]
    cut = ending.step
    ending.step = lambda action: (*(result := cut(action))[:2], result[3], False, result[4])  # time is up: a real end
    wrapper.reset()
    dones = np.zeros(2, dtype=bool)
    while not dones.any():
        obs, _, dones, infos = wrapper.step(np.ones((2, 1), np.float32))
    assert dones.all() and [info["TimeLimit.truncated"] for info in infos] == [False, True]
    assert set(infos[0]["terminal_observation"]) == set(wrapper.observation_space.spaces)
    assert set(infos[1]["terminal_observation"]) == set(POLICY_KEYS)
    for i in range(2):  # both begin anew
        mean, _ = beliefs_from_scratch(wrapper.encoder, [(obs["common"][i], np.zeros(1, np.float32))])
        np.testing.assert_allclose(obs["belief"][i], mean, atol=1e-5)


def test_smoothing_starts_wide_and_is_reset_with_the_episode():
    wrapper, raw = make_wrapper(2, smoothing=0.8), make_wrapper(2)
    obs, sharp = wrapper.reset(), raw.reset()
    expected = 0.8 * INITIAL_STD + 0.2 * sharp["uncertainty"]
    for _ in range(20):
        np.testing.assert_allclose(obs["uncertainty"], expected, rtol=1e-5)
        obs, _, dones, _ = wrapper.step(np.zeros((2, 1), np.float32))
        sharp, _, _, _ = raw.step(np.zeros((2, 1), np.float32))
        expected = 0.8 * np.where(dones[:, None], INITIAL_STD, expected) + 0.2 * sharp["uncertainty"]


def test_rewards_are_scaled_by_the_uncertainty_that_the_action_was_chosen_under():
    wrapper, plain = make_wrapper(3), make_wrapper(3, reward_scaling=False)
    wrapper.progress = plain.progress = 1.0
    obs, _ = wrapper.reset(), plain.reset()
    for _ in range(20):
        chosen_under = obs["uncertainty"].copy()
        obs, scaled, _, _ = wrapper.step(np.ones((3, 1), np.float32))
        _, rewards, _, _ = plain.step(np.ones((3, 1), np.float32))
        np.testing.assert_allclose(scaled, rewards * reward_coefficient(chosen_under, 1.0), rtol=1e-5)


def test_what_was_returned_does_not_change_later():
    wrapper = make_wrapper(2)
    obs = wrapper.reset()
    for _ in range(12):
        kept = {key: value.copy() for key, value in obs.items()}
        new_obs, *_ = wrapper.step(np.ones((2, 1), np.float32))
        for key, value in kept.items():
            np.testing.assert_array_equal(obs[key], value, err_msg=key)
        obs = new_obs


def test_truth_is_kept_and_blurring_grows_with_progress_within_bounds():
    wrapper = make_wrapper(64)
    obs = wrapper.reset()
    np.testing.assert_array_equal(obs["privileged"], obs["truth"])
    sizes = []
    for progress in (0.01, 0.05):  # small enough not to be clipped away
        wrapper.progress = progress
        obs, *_ = wrapper.step(np.zeros((64, 1), np.float32))
        assert (np.abs(obs["privileged"]) <= 0.25).all()
        sizes.append(np.abs(obs["privileged"] - obs["truth"]).mean())
    assert 0 < sizes[0] < sizes[1]
    np.testing.assert_array_equal(np.abs(obs["truth"]), 0.25)


def test_gaussian_noise_is_not_clipped_in_unbounded_dimensions():
    wrapper = make_wrapper(64, env_kwargs={"bounded": False}, noise="gaussian")
    wrapper.progress = 1.0
    assert np.abs(wrapper.reset()["privileged"]).max() > 1.0


def test_noise_is_held_within_an_episode():
    wrapper = make_wrapper(1, env_kwargs={"length": 12}, noise_hold=4)
    wrapper.reset()
    draws = []
    for _ in range(12):
        draws.append(wrapper.noise.continuous.item())
        wrapper.step(np.zeros((1, 1), np.float32))
    assert len(set(draws)) == 3 and all(len(set(draws[i : i + 4])) == 1 for i in (0, 4, 8))


def test_discrete_values_are_replaced_by_valid_ones_as_often_as_eq_4_says():
    values = [-0.25, 0.0, 0.25]
    wrapper = make_wrapper(2000, discrete_privileged={0: values})
    wrapper.progress = 1.0
    obs = wrapper.reset()
    assert set(np.unique(obs["privileged"])) <= {np.float32(v) for v in values}
    changed = (obs["privileged"] != obs["truth"]).mean()
    # Uncertainty counts in steps from one value to the next; a third draws the same value.
    assert changed == pytest.approx(np.minimum(obs["uncertainty"] / 0.25, 1.0).mean() * 2 / 3, abs=0.04)


def test_mismatched_environments_change_their_minds_at_their_own_rates():
    wrapper = make_wrapper(9, n_mismatched=4, mismatch_hold=(1.0, 64.0))
    wrapper.reset()
    changes, sources = np.zeros(9), []
    for _ in range(2000):
        before = wrapper._source
        wrapper._source = before.copy()
        wrapper.step(np.zeros((9, 1), np.float32))
        changes += wrapper._source != before
        sources.append(wrapper._source)
    np.testing.assert_array_equal(np.array(sources)[:, :5], np.tile(np.arange(5), (2000, 1)))
    assert np.min(sources, axis=0)[5:].min() >= 5 and (np.array(sources)[:, 5:] != np.arange(5, 9)).all()
    # A third of the draws repeats the last one; rates 1, 1/4, 1/16, 1/64.
    np.testing.assert_allclose(changes[5:] / 2000, 2 / 3 / np.array([1, 4, 16, 64]), rtol=0.35)


def test_mismatched_environments_see_another_ones_truth_and_the_rest_their_own():
    wrapper = make_wrapper(8, n_mismatched=5, env_kwargs={"n_privileged": 16})
    obs = wrapper.reset()
    for _ in range(3):
        shown, truth = obs["privileged"], obs["truth"]
        np.testing.assert_array_equal(shown[:3], truth[:3])
        sources = [np.flatnonzero((truth == shown[i]).all(axis=1)) for i in range(3, 8)]
        assert all(len(source) == 1 for source in sources)
        assert all(source[0] != env and source[0] >= 3 for env, source in enumerate(sources, start=3))
        assert len({int(source[0]) for source in sources}) == 5
        wrapper.redraw_mismatch()
        obs, *_ = wrapper.step(np.zeros((8, 1), np.float32))


@pytest.mark.parametrize("memory", MEMORIES)
def test_rebuilding_the_memory_with_the_same_encoder_changes_nothing(memory):
    wrapper = make_wrapper(3, memory)
    wrapper.venv.envs[2].length = 3
    obs = wrapper.reset()
    past = [[] for _ in range(3)]
    for _ in range(6):
        for i in range(3):
            past[i].append((obs["common"][i], obs["previous_action"][i]))
        obs, _, dones, _ = wrapper.step(np.random.default_rng(0).uniform(-1, 1, (3, 1)).astype(np.float32))
        past = [[] if done else p for done, p in zip(dones, past, strict=True)]
    common, action = (np.array([token[key] for tokens in past for token in tokens]) for key in (0, 1))
    tokens = {"common": th.as_tensor(common), "previous_action": th.as_tensor(action)}
    old = wrapper.encoder.step(wrapper._tokens, tuple(part.clone() for part in wrapper.memory))[0]
    wrapper.rebuild_memory(tokens, th.tensor([len(p) for p in past]))
    new = wrapper.encoder.step(wrapper._tokens, wrapper.memory)[0]
    th.testing.assert_close(old.mean, new.mean, atol=1e-5, rtol=1e-4)


def test_bad_numbers_are_refused_at_the_first_step():
    wrapper = make_wrapper(2)
    wrapper.reset()
    wrapper.venv.envs[1].hidden[:] = np.nan
    with pytest.raises(ValueError, match="'privileged' holds nan"):
        wrapper.step(np.zeros((2, 1), np.float32))


def test_a_privileged_value_beyond_its_bounds_is_refused_but_not_what_rounding_adds():
    wrapper = make_wrapper(2)
    wrapper.reset()
    bound = float(wrapper.high[0])
    wrapper.venv.envs[1].hidden[:] = bound * (1.0 + 1e-6)
    wrapper.step(np.zeros((2, 1), np.float32))
    wrapper.venv.envs[1].hidden[:] = 2.0 * bound
    with pytest.raises(ValueError, match=rf"value 0 of environment 1 is {2.0 * bound}.*bounds .* and {bound}.*widen"):
        wrapper.step(np.zeros((2, 1), np.float32))


def test_discrete_actions_reach_the_encoder_one_hot():
    venv = DummyVecEnv([lambda: ToyEnv(action_space=spaces.Discrete(3))] * 2)
    wrapper = UncertaintyVecWrapper(venv, ObservationEncoder(venv.observation_space, 3), UncertaintyConfig(), 0)
    wrapper.reset()
    obs, *_ = wrapper.step(np.array([2, 0]))
    np.testing.assert_array_equal(obs["previous_action"], [[0, 0, 1], [1, 0, 0]])


def test_wandering_repeats_actions_for_its_share_of_the_time():
    n_envs, n_steps = 200, 400
    wandering = Wandering(spaces.Box(-2.0, 1.0, (1,)), np.full(n_envs, 0.3), (2.0, 8.0), np.random.default_rng(0))
    taken, active = [], []
    for _ in range(n_steps):
        wandering.advance()
        active.append(wandering.active.copy())
        taken.append(wandering.replace(np.full((n_envs, 1), 9.0, np.float32))[:, 0])
    taken, away = np.array(taken), np.array(active)
    np.testing.assert_array_equal(taken == 9.0, ~away)
    assert away.mean() == pytest.approx(0.3, abs=0.02)
    assert taken[away].min() >= -2.0 and taken[away].max() <= 1.0 and taken[away].mean() == pytest.approx(-0.5, abs=0.05)
    runs = [[(action, len(list(run))) for action, run in itertools.groupby(column)] for column in taken.T]
    lengths = [length for column in runs for action, length in column[1:-1] if -2.0 < action < 1.0]
    assert min(lengths) >= 2 and 7 <= max(lengths) <= 8


def test_chosen_components_wander_around_their_values_and_the_others_are_the_policys():
    space, n_envs = spaces.Box(-1.0, 1.0, (3,)), 300
    wandering = Wandering(space, np.full(n_envs, 1.0), (2.0, 2.0), np.random.default_rng(0), {1: 0.6})
    policys, taken = np.random.default_rng(1).uniform(-1.0, 1.0, (50, n_envs, 3)), []
    for actions in policys:
        wandering.advance()
        taken.append(wandering.replace(actions))
    taken = np.array(taken)
    np.testing.assert_array_equal(taken[..., [0, 2]], policys[..., [0, 2]])
    assert np.median(taken[..., 1]) == pytest.approx(0.6, abs=0.01) and 0.1 < taken[..., 1].std() < 0.5
    assert taken[..., 1].min() >= -1.0 and taken[..., 1].max() <= 1.0
    assert (taken[::2, :, 1] == taken[1::2, :, 1]).all() and (taken[0, :, 1] != taken[2, :, 1]).mean() > 0.8


def test_only_mismatched_environments_wander():
    wrapper = make_wrapper(6, n_mismatched=2, wander_share=1.0, wander_hold=(3.0, 3.0))
    wrapper.reset()
    action = np.array([wrapper.action_space.low + 1e-3] * 6, dtype=np.float32)
    wrapper.step(action)
    np.testing.assert_array_equal((wrapper.previous_action != action).all(axis=1), [False] * 4 + [True] * 2)
