"""The laws that tie USPLPPO to PPO and its two learners to each other, and what it refuses."""

import itertools

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_uspl import RMA, USPLPPO
from sb3_uspl._threads import torch_threads
from sb3_uspl.buffers import USPLRolloutBuffer
from tests.sb3_uspl.toy import FAST, ToyEnv, assert_equal_parameters, make_model, make_venv, parameters

# -- the same as PPO ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_space", [spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)], ids=["box", "discrete"])
def test_with_everything_off_it_is_stock_ppo(action_space):
    """Same seed, same networks, same samples, same updates: the actor's and critic's weights are identical."""
    common = dict(n_steps=16, batch_size=32, n_epochs=2, seed=3, gamma=0.9, max_grad_norm=0.5)
    kwargs = dict(action_space=action_space, terminate=False)  # time-outs: bootstrapping has to agree too
    stock = PPO("MultiInputPolicy", make_venv(4, 3, **kwargs), policy_kwargs=dict(net_arch=[32]), **common)
    stock.learn(4 * 16 * 4)  # before the other model is built, as both draw from the same generator
    ours = USPLPPO(
        "MlpPolicy",
        make_venv(4, 3, **kwargs),
        learning_rate_floor=1.0,
        action_std=None,
        blur=False,
        reward_scaling=False,
        uncertainty_input=False,
        mismatch_fraction=0.0,
        encoder_batch_size=64,
        policy_kwargs=dict(
            net_arch=[32],
            activation_fn=th.nn.Tanh,
            privileged_gain=1.0,
            normalize_common=False,
            bounded_mean=False,
            optimizer_kwargs=dict(fused=False),
        ),
        **common,
    )
    ours.learn(4 * 16 * 4)
    theirs = stock.policy.state_dict()
    mine = ours.policy.state_dict()
    for name in theirs:
        th.testing.assert_close(mine[name], theirs[name], msg=name)
    np.testing.assert_allclose(stock.rollout_buffer.returns, ours.rollout_buffer.returns, rtol=1e-5)
    np.testing.assert_array_equal(stock.rollout_buffer.actions, ours.rollout_buffer.actions)
    assert ours.policy.encoder_optimizer.state  # the encoder did learn meanwhile


@pytest.mark.parametrize("algorithm", [USPLPPO, RMA])
def test_same_seed_same_run(algorithm):
    runs = [make_model(algorithm=algorithm, warmup_timesteps=128, ramp_timesteps=128).learn(512) for _ in range(2)]
    assert_equal_parameters(parameters(runs[0]), parameters(runs[1]))
    other = make_model(algorithm=algorithm, **{"seed": 1}).learn(512)
    assert any(not th.equal(a, b) for a, b in zip(parameters(runs[0]).values(), parameters(other).values(), strict=True))


# -- separation of the two learners ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_once", [5, 30, 8192])
def test_the_critic_is_asked_when_a_rollout_is_over(at_once, monkeypatch):
    """However many observations at once; a policy that is called outside of rollouts asks its critic at once."""
    monkeypatch.setattr(USPLRolloutBuffer, "VALUED_AT_ONCE", at_once)
    model, seen = make_model(), []

    class Look(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            buffer = model.rollout_buffer
            obs = {key: th.as_tensor(array[:, :6]).flatten(0, 1) for key, array in buffer.observations.items()}
            with th.no_grad():
                seen.append((th.as_tensor(buffer.values[:, :6]).flatten(), model.policy.predict_values(obs)[:, 0]))

    model.learn(2 * 8 * 16, callback=Look())
    for stored, expected in seen:
        th.testing.assert_close(stored, expected)
        assert expected.std() > 0.0
    obs = {key: th.as_tensor(value) for key, value in model._last_obs.items()}
    th.testing.assert_close(model.policy(obs)[1], model.policy.predict_values(obs))


def test_ppo_and_encoder_never_touch_each_others_weights():
    model = make_model()
    model.learn(256)
    encoder_ids = {id(parameter) for parameter in model.policy.encoder.parameters()}
    held_by_ppo = {id(parameter) for group in model.policy.optimizer.param_groups for parameter in group["params"]}
    assert not encoder_ids & held_by_ppo
    assert all(parameter.grad is None for parameter in model.policy.encoder.parameters())

    before = parameters(model)
    PPO.train(model)
    assert_equal_parameters(before, parameters(model), "encoder.")
    assert all(parameter.grad is None for parameter in model.policy.encoder.parameters())

    before = parameters(model)
    model._train_encoder(model.policy.encoder)
    after = parameters(model)
    assert_equal_parameters(before, after, "mlp_extractor.")
    assert_equal_parameters(before, after, "action_net.")
    assert any(not th.equal(before[name], after[name]) for name in before if name.startswith("encoder."))


@pytest.mark.parametrize("algorithm", [USPLPPO, RMA])
def test_updates_side_by_side_are_those_of_one_after_the_other(algorithm, monkeypatch):
    def learn():
        with torch_threads(2):
            model = make_model(algorithm=algorithm, warmup_timesteps=128, ramp_timesteps=128, max_grad_norm=0.1)
            return parameters(model.learn(512))

    def one_after_the_other(functions, device):
        with torch_threads(1):  # the share of each, as other threads add up in another order
            for function in functions:
                function()

    side_by_side = learn()
    monkeypatch.setattr("sb3_uspl.uspl_ppo.run_side_by_side", one_after_the_other)
    assert_equal_parameters(side_by_side, learn())


def test_ppo_does_not_clip_by_the_encoders_gradients():
    runs = []
    for gradient in (0.0, 1e6):
        model = make_model(encoder_updates=0, max_grad_norm=0.1)
        for parameter in model.policy.encoder.parameters():
            parameter.grad = th.full_like(parameter, gradient)
        runs.append(model.learn(128))
    assert_equal_parameters(parameters(runs[0]), parameters(runs[1]))


def test_no_encoder_updates_in_warmup_if_asked_so():
    model = make_model(encoder_warmup=False, warmup_timesteps=10_000)
    before = parameters(model)
    model.learn(256)
    assert_equal_parameters(before, parameters(model), "encoder.")


def test_no_policy_updates_in_warmup_if_asked_so():
    """The encoder learns from an untrained policy, whose behaviour gives nothing away: also from matched episodes."""
    model = make_model(policy_warmup=False, warmup_timesteps=512, ramp_timesteps=0)
    before = parameters(model)
    model.learn(256)
    after = parameters(model)
    for module in ("mlp_extractor.", "action_net.", "value_net."):
        assert_equal_parameters(before, after, module)
    assert any(not th.equal(before[name], after[name]) for name in before if name.startswith("encoder."))
    assert not model.rollout_buffer.episodes.telltale
    model.learn(768, reset_num_timesteps=False)
    later = parameters(model)
    assert all(not th.equal(before[name], later[name]) for name in ("action_net.weight", "value_net.weight"))


def test_schedules_reach_their_ends():
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            seen.append((self.model.progress, self.model.policy.log_std.exp().item()))

    model = make_model(warmup_timesteps=256, ramp_timesteps=256, action_std=0.4, action_std_floor=0.25)
    model.learn(1024, callback=Watch())
    progress, stds = zip(*seen, strict=True)
    assert progress[:3] == (0.0, 0.0, 0.0) and progress[3] == pytest.approx(0.5) and progress[4:] == (1.0,) * 4
    assert all(a >= b for a, b in itertools.pairwise(stds)) and stds[0] > 0.39 and stds[-1] > 0.1


def test_each_action_has_its_own_standard_deviation_if_asked_so():
    space = spaces.Box(-1, 1, (2,), np.float32)
    model = make_model(env_kwargs={"action_space": space}, action_std=[0.1, 0.5], action_std_floor=0.5)
    th.testing.assert_close(model.policy.log_std.exp(), th.tensor([0.1, 0.5]))
    model.learn(512)
    std = model.policy.log_std.exp()
    assert std[1] / std[0] == pytest.approx(5.0) and 0.05 < std[0] < 0.09


def test_correlation_of_the_action_noise_falls_to_nothing():
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append(self.model.policy.action_dist.correlation)
            return True

    model = make_model(action_noise_time=1.0, action_noise_timesteps=256, warmup_timesteps=256)
    model.learn(1024, callback=Watch())
    per_rollout = seen[::16]
    assert per_rollout[:3] == pytest.approx([np.exp(-0.2)] * 3) and per_rollout[3] == pytest.approx(np.exp(-0.4))
    assert per_rollout[4:] == [0.0] * 4
    assert all(a >= b for a, b in itertools.pairwise(seen))


# -- bad input ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(env_kwargs={"bounded": False}), "blur_noise='gaussian'"),
        (dict(n_envs=2, mismatch_fraction=0.25), "n_envs >= 6"),
        (dict(discrete_privileged={1: [0.0, 0.25]}), "names dimension 1"),
        (dict(discrete_privileged={0: [0.0, 3.0]}), "within the bounds"),
        (dict(discrete_privileged={0: [0.1]}), "two values or more, each once"),
        (dict(discrete_privileged={0: [0.0, 0.0, 0.25]}), "two values or more, each once"),
        (dict(blur_noise="pink"), "choose 'uniform' or 'gaussian'"),
        (dict(replay="none"), "'mismatched' or 'all'"),
        (dict(decision_period=0.0), "decision_period=0.0 is outside"),
        (dict(mismatch_fraction=1.5), "mismatch_fraction=1.5 is outside"),
        (dict(n_envs=4, mismatch_fraction=0.9), "leaves none whose episodes PPO learns from"),
        (dict(mismatch_hold_time=()), "two positive numbers"),
        (dict(replay_bytes=-1), "replay_bytes=-1 is outside"),
        (dict(encoder_max_grad_norm=0.0), "encoder_max_grad_norm=0.0 is outside"),
        (dict(policy_kwargs=dict(mean_input=False)), "mean_input.*to USPLPPO itself"),
        (dict(smoothing_time=-1.0), "smoothing_time=-1.0 is outside"),
        (dict(action_std=0.0), "one positive number"),
        (dict(action_std=[0.1, 0.2]), "one for each of the 1 action"),
        (dict(use_sde=True), "use_sde"),
        (dict(policy="CnnPolicy"), "needs a uint8 image"),
        (dict(policy_kwargs=dict(memory="lstm")), "the memories"),
    ],
)
def test_bad_arguments_are_explained_at_construction(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_a_box_environment_is_sent_to_the_wrapper():
    with pytest.raises(ValueError, match="PrivilegedObservation"):
        USPLPPO("MlpPolicy", "Pendulum-v1")


def test_an_episode_beyond_the_context_is_explained():
    with pytest.raises(ValueError, match="context of 5 decisions"):
        make_model(context_length=5).learn(256)


def test_one_environment_works_with_a_warning():
    with pytest.warns(UserWarning, match="mismatch_fraction=0"):
        model = make_model(n_envs=1)
    assert model.n_mismatched == 0
    model.learn(64)


def test_wandering_without_mismatched_environments_is_pointed_out():
    with pytest.warns(UserWarning, match="only mismatched environments wander"):
        make_model(mismatch_fraction=0.0, wander_share=0.5)


def test_without_a_replay_the_encoder_learns_from_each_rollout():
    model = make_model(replay_bytes=0).learn(512)
    assert not len(model.rollout_buffer.episodes.replay) and model.policy.encoder_optimizer.state


def test_a_training_in_parts_updates_the_encoder_as_often_as_one_in_a_whole():
    def updates(model):
        return max(float(state["step"]) for state in model.policy.encoder_optimizer.state.values())

    whole, parts = (make_model(replay_bytes=0, encoder_batch_size=2048) for _ in range(2))
    whole.learn(4 * 128)
    for part in range(4):
        parts.learn(128, reset_num_timesteps=part == 0)
    assert updates(parts) == updates(whole)


def test_a_training_of_no_decisions_ends_at_once():
    assert make_model().learn(0).num_timesteps == 0


class SilentEnv(ToyEnv):
    """Does not say how long a decision lasts."""

    @property
    def decision_period(self):
        raise AttributeError


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_decision_period_comes_from_the_environment(vec_env_cls):
    assert make_model().decision_period == ToyEnv.decision_period
    assert make_model(decision_period=0.1).decision_period == 0.1
    venv_kwargs = dict(start_method="fork") if vec_env_cls is SubprocVecEnv else {}
    silent = make_vec_env(SilentEnv, 8, vec_env_cls=vec_env_cls, vec_env_kwargs=venv_kwargs)
    assert USPLPPO("MlpPolicy", silent, **FAST).decision_period == 0.02
    silent.close()


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (0.0, 10.0)])
def test_mean_actions_stay_where_sampling_still_matters(low, high):
    model = make_model(env_kwargs=dict(action_space=spaces.Box(low, high, (2,), np.float32)))
    for bias, expected in ((50.0, high), (-50.0, low), (0.0, 0.5 * (low + high))):
        with th.no_grad():
            model.policy.action_net.weight.zero_()
            model.policy.action_net.bias.fill_(bias)
        actions, _ = model.predict({"common": np.zeros((4, 2), np.float32)}, deterministic=True)
        np.testing.assert_allclose(actions, expected, atol=1e-5)


def test_a_chosen_uncertainty_of_zero_is_certainty_not_nan():
    model, obs = make_model(), {"common": np.ones((4, 2), np.float32)}
    certain, least = (model.policy.act(obs, deterministic=True, uncertainty=u)[0] for u in (0.0, 0.005))
    np.testing.assert_array_equal(certain, least)
    assert np.isfinite(certain).all()


@pytest.mark.parametrize("name", ["wander_time", "mismatch_hold_time"])
@pytest.mark.parametrize("times", ["(0.5, 2.0)", (3.0, 1.0), [1.0], (0.0, 1.0)])
def test_a_range_of_times_is_two_positive_numbers(name, times):
    venv = DummyVecEnv([ToyEnv] * 2)
    with pytest.raises(ValueError, match=f"{name}=.*two positive numbers"):
        USPLPPO("MlpPolicy", venv, n_steps=8, batch_size=16, mismatch_fraction=0.0, **{name: times})


@pytest.mark.parametrize("until", [None, 2 * 128])
def test_the_encoder_learns_from_windows_at_first_and_from_whole_episodes_then(until):
    model = make_model(encoder_window=2, encoder_window_timesteps=until, warmup_timesteps=3 * 128, ramp_timesteps=0)
    longest, batches = [], model.rollout_buffer.episodes.batches

    def watched(*args):
        for batch in batches(*args):
            longest.append((model.num_timesteps >= (until or 3 * 128), int(batch.lengths.max())))
            yield batch

    model.rollout_buffer.episodes.batches = watched
    model.learn(6 * 128)
    assert set(longest) == {(False, 2), (True, 8)}
