"""RMA, RewReg and PrivRecons: where they differ from USPL, and that nothing else does."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_uspl import RMA, USPLPPO, PrivRecons, RESeLPPO, RewReg
from sb3_uspl.baselines.rewreg import MAX_KL
from sb3_uspl.observations import HidePrivileged
from sb3_uspl.wrappers import UncertaintyVecWrapper
from tests.sb3_uspl.toy import IMAGE, ToyEnv

ALGORITHMS = (USPLPPO, RMA, RewReg, PrivRecons)
FAST = dict(n_steps=16, batch_size=32, n_epochs=2, encoder_updates=2, encoder_batch_size=64, seed=0)
NO_WARMUP = dict(warmup_timesteps=0, ramp_timesteps=0)
SPACES = {
    "box": (spaces.Box(-1, 1, (2,), np.float32), None),
    "discrete, image": (spaces.Discrete(3), IMAGE),
    "multidiscrete": (spaces.MultiDiscrete([2, 3]), None),
    "multibinary": (spaces.MultiBinary(2), None),
}


def make_model(algorithm, n_envs=8, env_kwargs=None, **kwargs):
    return algorithm("MlpPolicy", make_vec_env(ToyEnv, n_envs, seed=0, env_kwargs=env_kwargs or {}), **{**FAST, **kwargs})


def parameters(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


# -- the contract that all share ---------------------------------------------------------------------------------------------


OURS = (*ALGORITHMS, RESeLPPO)
ANY = dict(n_steps=16, batch_size=32, n_epochs=2, seed=0)


@pytest.mark.parametrize("algorithm", [RMA, RewReg, PrivRecons])
def test_a_learning_rate_is_not_taken_for_something_else(algorithm):
    with pytest.raises(TypeError, match="positional"):
        algorithm("MlpPolicy", make_vec_env(ToyEnv, 4), 1e-3)


@pytest.mark.parametrize("algorithm", OURS)
def test_tensorboard_tells_the_algorithms_apart(algorithm, tmp_path):
    model = algorithm("MlpPolicy", make_vec_env(ToyEnv, 8), tensorboard_log=str(tmp_path), **ANY)
    model.learn(128)
    model.learn(128, tb_log_name="mine")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([f"{algorithm.__name__}_1", "mine_1"])


@pytest.mark.parametrize("algorithm", (USPLPPO, RESeLPPO))
def test_what_would_be_ignored_or_misunderstood_is_refused(algorithm):
    venv = make_vec_env(ToyEnv, 8)
    with pytest.raises(ValueError, match="VecFrameStack stacks the privileged observation"):
        algorithm("MlpPolicy", VecFrameStack(venv, 3), **ANY)
    with pytest.raises(ValueError, match="action_std=None to have it learned from log_std_init"):
        algorithm("MlpPolicy", venv, policy_kwargs=dict(log_std_init=-2.0), **ANY)
    learned = algorithm("MlpPolicy", venv, policy_kwargs=dict(log_std_init=-2.0), action_std=None, **ANY)
    assert float(learned.policy.log_std.detach().mean()) == -2.0
    with pytest.raises(ValueError, match=r"experience is made into.*`predict`"):
        learned.policy.get_distribution(obs_as_tensor(venv.reset(), learned.device))
    with pytest.raises(ValueError, match=r"experience is made into.*`predict`"):
        learned.policy(obs_as_tensor(venv.reset(), learned.device))


@pytest.mark.parametrize("algorithm", (USPLPPO, RESeLPPO))
@pytest.mark.parametrize("net_arch", ([], dict(pi=[16], vf=[]), dict(pi=[], vf=[8, 4])))
def test_actor_and_critic_may_have_any_layers(algorithm, net_arch):
    model = algorithm("MlpPolicy", make_vec_env(ToyEnv, 8), policy_kwargs=dict(net_arch=net_arch), **ANY)
    model.learn(128)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_save_load_predict_and_learning_on(algorithm, tmp_path):
    model = make_model(algorithm, **NO_WARMUP).learn(200)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=make_vec_env(ToyEnv, 8, seed=0))
    mine, theirs = parameters(loaded), parameters(model)
    assert mine.keys() == theirs.keys() and all(th.equal(mine[name], theirs[name]) for name in mine)
    obs = model.get_env().reset()
    wrong = {**obs, "privileged": np.full_like(obs["privileged"], 9.0)}
    actions = [m.predict(o, deterministic=True)[0] for m, o in ((model, obs), (loaded, obs), (loaded, wrong))]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])
    before = model.num_timesteps
    loaded.learn(256, reset_num_timesteps=False)
    assert loaded.num_timesteps >= before + 256
    assert any(not th.equal(mine[name], value) for name, value in parameters(loaded).items())


@pytest.mark.parametrize("algorithm", [RewReg, PrivRecons])
@pytest.mark.parametrize(("action_space", "target"), SPACES.values(), ids=SPACES)
def test_every_action_space_and_images(algorithm, action_space, target):
    make_model(algorithm, env_kwargs=dict(action_space=action_space, target=target), n_epochs=1, **NO_WARMUP).learn(128)


@pytest.mark.parametrize("algorithm", [RewReg, PrivRecons])
def test_same_seed_same_run(algorithm):
    first, second, other = (make_model(algorithm, **NO_WARMUP, **{"seed": seed}).learn(384) for seed in (0, 0, 1))
    weights = [parameters(model) for model in (first, second, other)]
    assert all(th.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert any(not th.equal(weights[0][name], weights[2][name]) for name in weights[0])


# -- RewReg ------------------------------------------------------------------------------------------------------------------


def test_without_a_weight_it_is_rma():
    rma, rewreg = (make_model(algorithm, **NO_WARMUP, **kwargs) for algorithm, kwargs in ((RMA, {}), (RewReg, {})))
    rewreg.penalty_weight = 0.0
    weights = []
    for model in (rma, rewreg):
        model.set_random_seed(3)
        weights.append(parameters(model.learn(256)))
    assert all(th.equal(weights[0][name], weights[1][name]) for name in weights[0])


def wrapper_of(**kwargs):
    model = make_model(RewReg, **{"action_std": 0.5, **NO_WARMUP, **kwargs})
    model._setup_learn(100)
    return model, model._rollout_env


def test_the_penalty_is_the_divergence_between_truth_and_belief():
    """Actor reduced to a known linear law of the privileged observation: mean = 0.3 + 2 o_p, so KL = (2 d)^2 / (2 std^2)."""
    model, wrapper = wrapper_of(penalty_weight=0.1)
    wrapper.progress = 0.5
    policy = model.policy

    def distribution(obs):
        mean = 0.3 + 2.0 * obs["privileged"]
        return policy.action_dist.proba_distribution(mean, policy.log_std)

    policy.get_distribution = distribution
    std = math.exp(float(policy.log_std))
    for _ in range(5):
        difference = (wrapper._last["privileged"] - wrapper._last["belief"])[:, 0]
        kl = np.minimum((2.0 * difference) ** 2 / (2.0 * std**2), MAX_KL)
        action = np.full((8, 1), 0.7, np.float32)
        hidden = wrapper._last["truth"][:, 0]
        _, rewards, _, _ = wrapper.step(action)
        assert kl.max() > 0.1
        np.testing.assert_allclose(rewards, np.sign(hidden) * 0.7 - 0.5 * 0.1 * kl, atol=1e-5)


def test_the_penalty_of_prediction():
    _, wrapper = wrapper_of(penalty_weight=2.0, divergence="prediction", env_kwargs=dict(n_privileged=2))
    wrapper.progress = 1.0
    last = wrapper._last
    error = last["belief"] - last["truth"]
    expected = np.sign(last["truth"][:, 0]) * 0.5 - 2.0 * np.sqrt((error[:, 0] ** 2 + error[:, 1] ** 2) / 2.0)
    _, rewards, _, _ = wrapper.step(np.full((8, 1), 0.5, np.float32))
    np.testing.assert_allclose(rewards, expected, atol=1e-5)


def test_no_penalty_in_the_warm_up_and_none_for_a_policy_that_ignores_the_privileged_observation():
    model, wrapper = wrapper_of(penalty_weight=10.0)
    for progress, gain in ((0.0, 1.0), (1.0, 0.0)):
        wrapper.progress = progress
        model.policy.pi_features_extractor.privileged_gain = gain
        hidden = wrapper._last["truth"][:, 0]
        _, rewards, _, _ = wrapper.step(np.full((8, 1), 0.5, np.float32))
        np.testing.assert_allclose(rewards, np.sign(hidden) * 0.5, atol=1e-6)


def test_a_great_divergence_counts_no_more_than_the_limit():
    _, wrapper = wrapper_of(penalty_weight=1.0, action_std_floor=1.0)
    wrapper.policy.set_action_std(1e-5)
    assert wrapper._divergence().max() == pytest.approx(MAX_KL)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(penalty_weight=-1.0), "penalty_weight=-1.0"),
        (dict(penalty_weight=math.nan), "penalty_weight=nan"),
        (dict(divergence="action"), "choose one of"),
    ],
)
def test_bad_arguments_of_rewreg_are_explained(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(RewReg, **kwargs)


# -- PrivRecons --------------------------------------------------------------------------------------------------------------


def test_it_acts_on_the_mean_and_its_critic_sees_the_truth():
    model = make_model(PrivRecons, env_kwargs=dict(terminate=False), **NO_WARMUP).learn(256)
    stored = model.rollout_buffer.observations
    np.testing.assert_array_equal(stored["privileged"], stored["belief"])
    assert set(np.unique(stored["truth"])) == {-0.25, 0.25}
    assert not np.isclose(stored["privileged"], stored["truth"]).all()


def test_its_rollout_is_the_deployment_policy():
    """The actions of the rollout and of ``predict`` are the same along the same history."""
    model = make_model(PrivRecons).learn(256)
    wrapper = model._rollout_env
    obs = wrapper.begin(model.env.reset())
    state, starts = None, np.ones(8, dtype=bool)
    for _ in range(20):
        actions, state = model.predict({"common": obs["common"]}, state, starts, deterministic=True)
        tensors = {key: th.as_tensor(value) for key, value in obs.items()}
        expected = model.policy(tensors, deterministic=True)[0].detach().numpy()
        np.testing.assert_allclose(actions, np.clip(expected, -1.0, 1.0), atol=1e-5)
        obs, _, starts, _ = wrapper.step(actions)


def test_a_time_out_is_told_what_the_policy_would_have_seen():
    model = make_model(PrivRecons, env_kwargs=dict(length=5))
    model._setup_learn(100)
    wrapper = model._rollout_env
    for _ in range(5):
        _, _, dones, infos = wrapper.step(np.zeros((8, 1), np.float32))
    assert dones.all()
    for info in infos:
        last = info["terminal_observation"]
        np.testing.assert_array_equal(last["privileged"], last["belief"])
        assert abs(last["truth"][0]) == 0.25


def test_blurring_what_is_not_there_is_refused():
    with pytest.raises(ValueError, match="Leave `blur` off"):
        make_model(PrivRecons, blur=True)


def test_the_others_keep_uspls_wrapper():
    for algorithm in (USPLPPO, RMA):
        model = make_model(algorithm)
        model._setup_learn(100)
        assert type(model._rollout_env) is UncertaintyVecWrapper


# -- what SB3's own algorithms may see ---------------------------------------------------------------------------------------


def test_hide_privileged_hides_it_and_nothing_else():
    env = HidePrivileged(ToyEnv(target=IMAGE))
    check_env(env, warn=False)
    assert set(env.observation_space.spaces) == {"common", "target"}
    obs, _ = env.reset(seed=1)
    full, _ = ToyEnv(target=IMAGE).reset(seed=1)
    assert obs.keys() == {"common", "target"}
    for key in obs:
        np.testing.assert_array_equal(obs[key], full[key])
    with pytest.raises(ValueError, match="PrivilegedObservation"):
        HidePrivileged(gym.make("Pendulum-v1"))
