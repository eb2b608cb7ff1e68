"""USPLPPO as an SB3 user meets it: saved and loaded, with callbacks, normalisation, subprocesses and other environments."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_uspl import USPLPPO, MlpPolicy
from sb3_uspl.observations import BELIEF, UNCERTAINTY
from tests.sb3_uspl.toy import FAST, ToyEnv, assert_equal_parameters, make_model, make_venv, parameters

# -- saving ------------------------------------------------------------------------------------------------------------------


def test_save_and_load_restore_everything(tmp_path):
    model = make_model(policy_kwargs=dict(memory="transformer"), warmup_timesteps=0, ramp_timesteps=256).learn(
        200
    )  # mid-episode
    model.save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv())
    assert_equal_parameters(parameters(model), parameters(loaded))
    for name in ("optimizer", "encoder_optimizer"):
        theirs, mine = getattr(model.policy, name).state_dict(), getattr(loaded.policy, name).state_dict()
        assert theirs["state"].keys() == mine["state"].keys() and len(mine["state"])
        for key in mine["state"]:
            th.testing.assert_close(theirs["state"][key], mine["state"][key])
    assert loaded.progress == model.progress > 0
    obs = model.get_env().reset()
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    loaded.learn(256, reset_num_timesteps=False)
    assert loaded.num_timesteps > model.num_timesteps


def test_load_with_another_number_of_environments_goes_on(tmp_path):
    make_model().learn(256).save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv(12))
    assert loaded.n_mismatched == 3
    loaded.learn(512)


def test_policy_alone_can_be_saved(tmp_path):
    model = make_model(policy_kwargs=dict(memory="transformer", net_arch=[16], encoder_kwargs=dict(embedding=(24,)))).learn(
        256
    )
    model.policy.save(tmp_path / "policy")
    policy = MlpPolicy.load(tmp_path / "policy")
    obs = model.get_env().reset()
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], policy.predict(obs, deterministic=True)[0])


def test_set_parameters_restores_a_model():
    model, other = make_model().learn(256), make_model(seed=5)
    other.set_parameters(model.get_parameters())
    assert_equal_parameters(parameters(model), parameters(other))


# -- with the rest of SB3 ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.filterwarnings("error")
def test_callbacks_and_vecnormalize(tmp_path, normalize):
    venv, eval_env = make_venv(8), make_venv(3, seed=100)
    if normalize:
        venv = VecNormalize(venv, norm_obs_keys=["common"])
        eval_env = VecNormalize(eval_env, norm_obs_keys=["common"], training=False, norm_reward=False)
    model = USPLPPO("MlpPolicy", venv, **FAST)
    callbacks = [
        EvalCallback(eval_env, n_eval_episodes=6, eval_freq=16, best_model_save_path=tmp_path, log_path=tmp_path, verbose=0),
        CheckpointCallback(16, str(tmp_path)),
    ]
    model.learn(512, callback=callbacks)
    assert "successes" in np.load(tmp_path / "evaluations.npz")
    best = USPLPPO.load(tmp_path / "best_model", env=venv)
    best.learn(256)
    evaluate_policy(model, eval_env, n_eval_episodes=4)


def test_subprocesses_and_discrete_actions_and_logs(tmp_path):
    venv = make_vec_env(
        ToyEnv,
        4,
        env_kwargs=dict(action_space=spaces.MultiDiscrete([2, 3])),
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs=dict(start_method="fork"),
    )
    model = USPLPPO("MultiInputPolicy", venv, tensorboard_log=str(tmp_path), mismatch_fraction=0.5, **FAST)
    model.learn(256)
    names = {
        "encoder/nll",
        "encoder/error",
        "encoder/std",
        "encoder/learning_rate",
        "encoder/replay_fill",
        "uspl/progress",
        "uspl/uncertainty",
        "uspl/prediction_error",
        "uspl/reward_scale",
        "uspl/blur",
    }
    written = b"".join(path.read_bytes() for path in tmp_path.rglob("events*"))
    assert all(name.encode() in written for name in names)
    venv.close()


def test_set_env_and_learning_on(tmp_path):
    model = make_model().learn(256)
    model.learn(256, reset_num_timesteps=False)
    assert model.num_timesteps == 512
    model.set_env(make_venv(8, seed=9))
    model.learn(256, reset_num_timesteps=False)
    model.set_env(model.get_env())
    model.learn(256)
    assert isinstance(model.get_env(), DummyVecEnv)  # never the uncertainty wrapper


def test_training_goes_on_after_a_callback_stopped_it():
    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 21

    model = make_model()
    model.learn(10_000, callback=Stop())
    model.learn(512, reset_num_timesteps=False)


@pytest.mark.parametrize("length", [5, 8])
def test_after_an_update_every_memory_holds_its_own_episode_and_nothing_else(length):
    """Episodes of 8 decisions end with the rollout of 16: their successors must start with an empty memory."""
    model = make_model(env_kwargs=dict(length=length))
    model.learn(8 * 16 * 2)
    wrapper, episodes = model._rollout_env, model.rollout_buffer.episodes
    np.testing.assert_array_equal(episodes.lengths, wrapper.step_count)
    assert wrapper.step_count[0] == 32 % length
    encoder = model.policy.encoder
    with th.no_grad():
        memory = encoder.memory.initial_state(8)
        for t in range(32 % length):
            _, memory = encoder.step({key: th.as_tensor(episodes.running[key][:, t]) for key in wrapper._tokens}, memory)
        _, memory = encoder.step(wrapper._tokens, memory)
    th.testing.assert_close(wrapper.memory, memory, atol=1e-5, rtol=1e-4)


def test_success_of_the_privileged_policy_leaves_out_mismatched_environments():
    model = make_model(mismatch_fraction=0.25)
    model._setup_learn(100)
    infos = [{"is_success": i < 6} for i in range(8)]
    model._update_info_buffer(infos, np.ones(8, dtype=bool))
    assert list(model.ep_success_buffer) == [True] * 6


@pytest.mark.parametrize(
    ("given", "seen"),
    [
        ({}, {UNCERTAINTY, BELIEF}),
        (dict(mean_input=False), {UNCERTAINTY}),
        (dict(uncertainty_input=False), set()),
        (dict(uncertainty_input=False, mean_input=True), {BELIEF}),
    ],
    ids=["as the release", "no mean", "neither", "mean only"],
)
def test_what_actor_and_critic_see_of_the_belief_is_ones_choice(given, seen):
    policy = make_model(**given).policy
    obs = {key: th.full((1, *space.shape), 0.1) for key, space in policy.observation_space.spaces.items()}
    for key in (UNCERTAINTY, BELIEF):
        other = {**obs, key: obs[key] + 0.05}
        assert th.equal(policy.predict_values(obs), policy.predict_values(other)) == (key not in seen)
        assert th.equal(*(policy.get_distribution(o).mode() for o in (obs, other))) == (key not in seen)
