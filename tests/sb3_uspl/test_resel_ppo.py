"""RESeLPPO: what it recomputes is what it did, nothing leaks, and PPO learns to remember."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uspl import RESeLPolicy, RESeLPPO, USPLPolicy
from sb3_uspl._zoo import ALGORITHMS
from sb3_uspl.baselines.sequences import EMBEDDING
from tests.sb3_uspl.toy import IMAGE, ToyEnv

SMALL = dict(net_arch=[32], encoder_kwargs=dict(hidden=(32,), trunk=(32,), embedding=(32,)))
FAST = dict(n_steps=16, batch_size=32, n_epochs=2, encoder_learning_rate=1e-3, seed=0)
MEMORIES = ["gru", "transformer"]
DELAY = 8


class RecallEnv(ToyEnv):
    """The first observation of an episode holds a hint; only the last action, eight decisions later, is rewarded by it."""

    def __init__(self):
        super().__init__(length=DELAY + 1, action_space=spaces.Discrete(2), terminate=True)

    def step(self, action):
        self.t += 1
        over = self.t == self.length
        right = over and bool(action == (self.hidden[0] > 0))
        return self._observe(), float(right), over, False, {"is_success": right}

    def _observe(self):
        hint = 4 * self.hidden[0] if self.t == 0 else 0.0
        return {**super()._observe(), "common": np.array([self.t / self.length, hint], np.float32)}


def make_venv(n_envs=6, seed=0, **kwargs):
    return make_vec_env(ToyEnv, n_envs, seed=seed, env_kwargs=kwargs)


def make_model(n_envs=6, policy="MlpPolicy", memory="gru", env_kwargs=None, policy_kwargs=None, **kwargs):
    policy_kwargs = {"memory": memory, **SMALL, **(policy_kwargs or {})}
    return RESeLPPO(policy, make_venv(n_envs, **(env_kwargs or {})), **{**FAST, "policy_kwargs": policy_kwargs, **kwargs})


def parameters(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def changed(before, after, start):
    """Whether any weight under ``start`` changed; the running statistics of the normalisers are no weights."""
    names = [name for name in before if name.startswith(start) and "normalizer" not in name]
    assert names
    return any(not th.equal(before[name], after[name]) for name in names)


class Recompute(BaseCallback):
    """Before every update, compares what the update will recompute with what the rollout did."""

    def __init__(self):
        super().__init__()
        self.ratio_error, self.value_error, self.longest_past, self.n_decisions = [], [], [], []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer, policy = self.model.rollout_buffer, self.model.policy
        batches = list(buffer.get(self.model.batch_size))
        self.n_decisions.append(sum(len(batch.actions) for batch in batches))
        self.longest_past.append(max(len(past["common"]) for past in buffer.past))
        for batch in batches:
            discrete = isinstance(self.model.action_space, spaces.Discrete)
            actions = batch.actions.long().flatten() if discrete else batch.actions
            with th.no_grad():
                values, log_prob, _ = policy.evaluate_actions(batch.observations, actions)
            self.ratio_error.append(float((th.exp(log_prob - batch.old_log_prob) - 1).abs().max()))
            self.value_error.append(float((values.flatten() - batch.old_values).abs().max()))

    def check(self):
        assert self.ratio_error
        np.testing.assert_allclose(self.ratio_error, 0.0, atol=1e-4)
        np.testing.assert_allclose(self.value_error, 0.0, atol=1e-4)


# -- whole sequences ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("length", [5, 8, 40], ids=["over a boundary", "up to a boundary", "over several rollouts"])
@pytest.mark.parametrize(
    "env_kwargs",
    [{}, {"target": IMAGE, "action_space": spaces.Discrete(3)}, {"action_space": spaces.MultiDiscrete([2, 3])}],
    ids=["box", "discrete, image", "multidiscrete"],
)
def test_the_first_ratio_is_one(memory, length, env_kwargs):
    """Across the ends of episodes and of rollouts; with weights and normalisers that change in between."""
    model = make_model(n_envs=4, memory=memory, env_kwargs={"length": length, **env_kwargs}, learning_rate=1e-2)
    watch = Recompute()
    model.learn(4 * 16 * 4, callback=watch)
    watch.check()
    assert watch.n_decisions == [4 * 16] * 4
    # All environments run in step: what is left of the episode at each rollout's start.
    assert watch.longest_past == [16 * i % length for i in range(4)]


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_first_ratio_is_one_after_stopping_loading_and_new_weights(memory, tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 21

    model, watch = make_model(memory=memory, env_kwargs={"length": 11}), Recompute()
    model.learn(10_000, callback=CallbackList([watch, Stop()]))
    model.learn(6 * 16 * 2, callback=watch, reset_num_timesteps=False)
    model.set_parameters(make_model(memory=memory, seed=5).get_parameters())
    model.learn(6 * 16 * 2, callback=watch, reset_num_timesteps=False)
    model.learn(6 * 16 * 2, callback=watch)
    model.save(tmp_path / "model")
    for force_reset in (False, True):
        loaded = RESeLPPO.load(tmp_path / "model", env=model.get_env(), force_reset=force_reset)
        loaded.learn(6 * 16 * 2, callback=watch, reset_num_timesteps=False)
    watch.check()
    assert len(watch.n_decisions) == 11


def test_after_a_callback_stopped_it_episodes_start_anew():
    """SB3 does not store the decision at which it stops, so no history may go on across it."""

    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 21

    model = make_model(env_kwargs={"length": 11})
    model.learn(10_000, callback=Stop())
    model.learn(6 * 16, reset_num_timesteps=False)
    buffer = model.rollout_buffer
    starts = [step % 11 == 0 for step in range(16)]
    assert buffer.episode_starts.astype(bool).tolist() == [[start] * 6 for start in starts]
    np.testing.assert_array_equal(buffer.observations["common"][:, 0, 0] == 0.0, starts)
    assert not any(len(past["common"]) for past in buffer.past)


@pytest.mark.parametrize("memory", MEMORIES)
def test_a_decision_depends_on_the_past_of_its_own_episode_alone(memory):
    model = make_model(n_envs=2, memory=memory, env_kwargs={"length": 11}).learn(2 * 16 * 2)
    buffer, policy = model.rollout_buffer, model.policy
    batch = next(buffer.get())

    def log_probs(touched=None):
        tokens = {key: value.clone() for key, value in batch.observations.tokens.items()}
        if touched is not None:
            tokens["common"][touched] += 1.0
        return policy.evaluate_actions(batch.observations._replace(tokens=tokens), batch.actions)[1].detach()

    # 32 decisions an environment: episodes of 11, 11 and 10; the last rollout saw 5 of its first one's past as context.
    assert batch.observations.lengths.tolist() == [11, 10] * 2
    assert batch.observations.sampled.tolist() == ([False] * 5 + [True] * 16) * 2
    reference = log_probs()
    differs = (log_probs(touched=2) != reference).tolist()  # a past decision of the first environment's first episode
    assert any(differs[:6]) and not any(differs[6:])
    differs = (log_probs(touched=5 + 8) != reference).tolist()  # the third decision of its second episode
    assert not any(differs[:8]) and differs[8] and any(differs[9:16]) and not any(differs[16:])


def test_minibatches_return_what_went_in():
    model = make_model(n_envs=5).learn(5 * 16)
    buffer = model.rollout_buffer
    batches = list(buffer.get(32))
    assert [len(batch.actions) for batch in batches] == [32, 32, 16]
    got = {
        "actions": th.cat([batch.actions for batch in batches])[:, 0],
        "values": th.cat([batch.old_values for batch in batches]),
        "returns": th.cat([batch.returns for batch in batches]),
        "advantages": th.cat([batch.advantages for batch in batches]),
        "log_probs": th.cat([batch.old_log_prob for batch in batches]),
    }
    rows = {tuple(row) for row in th.stack(list(got.values()), 1).tolist()}
    stored = np.stack([getattr(buffer, name).reshape(16, 5) for name in got], -1)
    assert rows == {tuple(row) for row in stored.reshape(-1, len(got)).tolist()} and len(rows) == 16 * 5
    privileged = th.cat([batch.observations.privileged for batch in batches])
    assert len(privileged) == 16 * 5 and set(privileged.flatten().tolist()) == {-0.25, 0.25}


# -- who learns what ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_encoder_has_a_learning_rate_of_its_own(memory):
    heads = ("mlp_extractor.policy_net", "action_net", "mlp_extractor.value_net", "value_net")
    encoder = ("encoder.features", "encoder.memory", "encoder.embedding")
    for moving, still, rates in ((heads, encoder, (1e-3, 0.0)), (encoder, heads, (0.0, 1e-3))):
        model = make_model(memory=memory, learning_rate=rates[0], learning_rate_floor=1.0, encoder_learning_rate=rates[1])
        before = parameters(model)
        model.learn(6 * 16 * 2)
        after = parameters(model)
        assert [group["lr"] for group in model.policy.optimizer.param_groups] == list(rates)
        assert all(changed(before, after, part) for part in moving)
        assert not any(changed(before, after, part) for part in still)


def test_every_weight_is_in_one_group_of_the_optimizer():
    policy = make_model().policy
    held = [[id(parameter) for parameter in group["params"]] for group in policy.optimizer.param_groups]
    assert len(held) == 2 and set(held[1]) == {id(parameter) for parameter in policy.encoder.parameters()}
    assert sorted(held[0] + held[1]) == sorted(id(parameter) for parameter in policy.parameters())


@pytest.mark.parametrize("memory", MEMORIES)
def test_privileged_reaches_the_critic_and_never_the_actor(memory):
    model = make_model(memory=memory).learn(6 * 16 * 2)
    batch = next(model.rollout_buffer.get())
    values, log_prob, _ = model.policy.evaluate_actions(batch.observations, batch.actions)
    other = batch.observations._replace(privileged=-batch.observations.privileged)
    other_values, other_log_prob, _ = model.policy.evaluate_actions(other, batch.actions)
    assert th.equal(log_prob, other_log_prob) and not th.isclose(values, other_values).any()

    obs = model.get_env().reset()
    hidden = {key: value for key, value in obs.items() if key != "privileged"}
    wrong = {**obs, "privileged": np.full_like(obs["privileged"], 9.0)}
    actions = [model.predict(o, deterministic=True)[0] for o in (obs, hidden, wrong)]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])


@pytest.mark.parametrize("memory", MEMORIES)
def test_it_learns_to_remember(memory):
    """A hint, acted on eight decisions later: nothing that the critic knows could make up for forgetting it."""
    venv = make_vec_env(RecallEnv, 16, seed=0)
    model = RESeLPPO(
        "MlpPolicy",
        venv,
        n_steps=45,
        batch_size=180,
        learning_rate=1e-3,
        encoder_learning_rate=1e-3 if memory == "gru" else 3e-4,
        seed=0,
        policy_kwargs=dict(memory=memory, **SMALL),
    ).learn(10_000)
    success, _ = evaluate_policy(model, make_vec_env(RecallEnv, 20, seed=1000), n_eval_episodes=200)
    assert success > 0.9


def test_ppo_without_a_memory_does_not_learn_it():
    venv, test_venv = (
        make_vec_env(RecallEnv, n, seed=seed, wrapper_class=FilterObservation, wrapper_kwargs=dict(filter_keys=["common"]))
        for n, seed in ((16, 0), (20, 1000))
    )
    model = PPO("MultiInputPolicy", venv, n_steps=45, batch_size=180, learning_rate=1e-3, seed=0).learn(10_000)
    success, _ = evaluate_policy(model, test_venv, n_eval_episodes=200)
    assert 0.35 < success < 0.65


# -- deployment --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", MEMORIES)
def test_predict_does_what_the_rollout_does(memory):
    """Along the same history, with episodes that end on the way, the state of ``predict`` is that of the rollout's memory."""
    model = make_model(memory=memory, env_kwargs={"length": 7}).learn(6 * 16)
    wrapper = model._rollout_env
    obs = wrapper.begin(model.env.reset())
    state, starts = None, np.ones(6, dtype=bool)
    for _ in range(20):
        actions, state = model.predict({"common": obs["common"]}, state, starts, deterministic=True)
        tensors = {key: th.as_tensor(value) for key, value in obs.items()}
        expected = model.policy(tensors, deterministic=True)[0].detach().numpy()
        np.testing.assert_allclose(actions, expected, atol=1e-5)
        for mine, theirs in zip(state.memory, wrapper.memory, strict=True):
            np.testing.assert_allclose(mine, theirs.numpy(), atol=1e-5)
        obs, _, starts, _ = wrapper.step(actions)


@pytest.mark.parametrize("memory", MEMORIES)
def test_predict_carries_its_memory_and_forgets_at_episode_starts(memory):
    model, venv = make_model(memory=memory).learn(6 * 16), make_venv(3)
    obs, state, states = venv.reset(), None, []
    for _ in range(5):
        action, state = model.predict(obs, state, deterministic=True)
        states.append(state)
        obs, *_ = venv.step(action)
    fresh, _ = model.predict(obs, deterministic=True)
    reset, _ = model.predict(obs, state, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_allclose(fresh, reset, atol=1e-6)
    remembering, _ = model.predict(obs, state, deterministic=True)
    assert not np.isclose(fresh, remembering).all()
    # predict is a function of its arguments: an old state still gives what it gave.
    np.testing.assert_array_equal(remembering, model.predict(obs, states[-1], deterministic=True)[0])
    single = {key: value[1] for key, value in obs.items()}
    state_1 = (state.previous_action[1:2], tuple(part[1:2] for part in state.memory))
    alone, _ = model.predict(single, state_1, deterministic=True)
    np.testing.assert_allclose(alone, remembering[1], atol=1e-5)
    with pytest.raises(ValueError, match="holds 3 environments but 2"):
        model.predict({key: value[:2] for key, value in obs.items()}, state)


# -- saving ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", MEMORIES)
def test_save_and_load_restore_everything(memory, tmp_path):
    model = make_model(memory=memory).learn(6 * 16 * 2)
    model.save(tmp_path / "model")
    loaded = RESeLPPO.load(tmp_path / "model", env=make_venv(4))
    ours, theirs = parameters(loaded), parameters(model)
    assert ours.keys() == theirs.keys() and all(th.equal(ours[name], theirs[name]) for name in ours)
    mine, saved = (m.policy.optimizer.state_dict() for m in (loaded, model))
    assert len(mine["state"]) and mine["param_groups"] == saved["param_groups"]
    for key in mine["state"]:
        th.testing.assert_close(mine["state"][key], saved["state"][key], rtol=0, atol=0)
    obs = model.get_env().reset()
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    model.policy.save(tmp_path / "policy")
    alone = RESeLPolicy.load(tmp_path / "policy")
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], alone.predict(obs, deterministic=True)[0])
    loaded.learn(4 * 16 * 2, reset_num_timesteps=False)
    assert loaded.num_timesteps == 6 * 16 * 2 + 4 * 16 * 2


def test_same_seed_same_run():
    runs = [parameters(make_model(memory="transformer", seed=seed).learn(6 * 16 * 3)) for seed in (0, 0, 1)]
    assert all(th.equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert changed(runs[0], runs[2], "")


# -- with the rest of SB3 ----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_callbacks_vecnormalize_set_env_and_logs(tmp_path):
    venv, eval_env = make_venv(6), make_venv(3, seed=100)
    venv = VecNormalize(venv, norm_obs_keys=["common"])
    eval_env = VecNormalize(eval_env, norm_obs_keys=["common"], training=False, norm_reward=False)
    model = RESeLPPO("MultiInputPolicy", venv, tensorboard_log=str(tmp_path), **FAST)
    watch = Recompute()
    evaluate = EvalCallback(eval_env, n_eval_episodes=6, eval_freq=16, best_model_save_path=tmp_path, verbose=0)
    model.learn(6 * 16 * 3, callback=CallbackList([watch, evaluate]))
    RESeLPPO.load(tmp_path / "best_model", env=venv).learn(6 * 16)
    model.set_env(VecNormalize(make_venv(6, seed=9), norm_obs_keys=["common"]))
    model.learn(6 * 16, reset_num_timesteps=False, callback=watch)
    watch.check()
    assert EMBEDDING not in model.get_env().reset()
    written = b"".join(path.read_bytes() for path in tmp_path.rglob("events*"))
    for name in ("train/approx_kl", "train/learning_rate", "encoder/learning_rate", "rollout/success_rate"):
        assert name.encode() in written


def test_timeouts_are_bootstrapped_with_the_true_privileged_observation():
    """The terminal observation reaches the critic; with image targets it goes through SB3's preprocessing too."""
    for env_kwargs in ({}, {"target": IMAGE}):
        model = make_model(n_envs=2, env_kwargs={"length": 8, **env_kwargs}, gamma=0.9, n_epochs=1, learning_rate=0.0)
        model.learn(2 * 16)
        buffer, raw = model.rollout_buffer, []
        for env in range(2):
            hidden = th.as_tensor(buffer.observations["privileged"][7, env])[None]
            last = {"common": th.tensor([[1.0, 0.0]]), "privileged": hidden}
            # The normalisers have seen the rollout by now, so the critic is asked through an untrained copy.
            critic = make_model(n_envs=2, env_kwargs={"length": 8, **env_kwargs}).policy
            with th.no_grad():
                value = float(critic.predict_values(last))
            action = np.clip(buffer.actions[7, env, 0], -1, 1)
            raw.append(np.sign(float(hidden)) * action + 0.9 * value)
        np.testing.assert_allclose(buffer.rewards[7], raw, atol=1e-5)


def test_the_zoo_knows_it():
    assert ALGORITHMS["resel_ppo"] is RESeLPPO


# -- bad input ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(batch_size=40), "multiple of n_steps"),
        (dict(batch_size=8), "multiple of n_steps"),
        (dict(use_sde=True), "use_sde"),
        (dict(action_std=0.0), "one positive number"),
        (dict(action_std=[0.2, 0.3, 0.4]), "one positive number"),
        (dict(context_length=0), "context_length=0"),
        (dict(learning_rate_floor=2.0), "share of its initial value"),
        (dict(policy=USPLPolicy), "subclass of RESeLPolicy"),
        (dict(policy_kwargs=dict(memory="lstm")), "the memories"),
        (dict(policy_kwargs=dict(share_features_extractor=True)), "builds its own features"),
        (
            dict(
                memory="transformer",
                policy_kwargs=dict(encoder_kwargs=dict(memory_kwargs={"transformer": {"dropout": 0.2}})),
            ),
            "remove 'dropout'",
        ),
    ],
)
def test_bad_arguments_are_explained_at_construction(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_a_box_environment_is_sent_to_the_wrapper():
    with pytest.raises(ValueError, match="PrivilegedObservation"):
        RESeLPPO("MlpPolicy", "Pendulum-v1")


def test_an_episode_beyond_the_context_is_explained():
    make_model(context_length=8).learn(6 * 16)
    with pytest.raises(ValueError, match="beyond the context of 7"):
        make_model(context_length=7).learn(6 * 16)


def test_bad_observations_are_explained():
    model = make_model()
    with pytest.raises(ValueError, match=r"also needs \['common'\]"):
        model.predict({"privileged": np.zeros(1)})
    with pytest.raises(ValueError, match="holds nan"):
        model.predict({"common": np.array([np.nan, 0.0], np.float32)})
