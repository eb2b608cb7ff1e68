"""An ordinary environment becomes a task with hidden parameters, and the guide's programs train it."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_uspl import USPLPPO, HiddenParameters
from sb3_uspl.observations import check_observation_space

GUIDE = Path(__file__).parents[2] / "docs" / "your_own_environment.md"


def pendulum():
    return HiddenParameters(gym.make("Pendulum-v1"), {"m": (0.5, 2.0), "l": (0.7, 1.3)}, decision_period=0.05)


def cart_pole():
    return HiddenParameters(gym.make("CartPole-v1"), {"force_mag": [-10.0, 10.0]}, decision_period=0.02)


@pytest.mark.parametrize("make", [pendulum, cart_pole])
def test_wrapped_environments_follow_the_contract_and_their_seed(make):
    env, other = make(), make()
    check_observation_space(env.observation_space)
    check_env(env)
    for seed in (3, 4):
        first, second = env.reset(seed=seed), other.reset(seed=seed)
        np.testing.assert_equal(first, second)
        assert env.observation_space.contains(first[0])
    assert env.reset(seed=3)[1]["hidden"] != env.reset()[1]["hidden"] or make is cart_pole


@pytest.mark.parametrize("make", [pendulum, cart_pole])
def test_a_guess_has_the_papers_scale_and_says_nothing_of_the_start(make):
    env = make()
    starts = [env.reset(seed=seed)[0] for seed in range(2000)]
    hidden = np.array([obs["privileged"] for obs in starts])
    np.testing.assert_allclose(hidden.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(hidden.std(axis=0), 0.25, atol=0.02)
    common = np.array([obs["common"] for obs in starts])
    correlation = np.corrcoef(hidden.T, common.T)[: hidden.shape[1], hidden.shape[1] :]
    assert np.abs(correlation).max() < 0.1, "the same seed, but not the same random numbers"


def test_what_is_observed_is_what_the_environment_has():
    env = pendulum()
    for _ in range(5):
        obs, info = env.reset()
        assert env.unwrapped.m == info["hidden"]["m"] and env.unwrapped.l == info["hidden"]["l"]
        scale = 0.25 * np.sqrt(12.0)
        expected = [(env.unwrapped.m - 1.25) / 1.5 * scale, (env.unwrapped.l - 1.0) / 0.6 * scale]
        np.testing.assert_allclose(obs["privileged"], expected, atol=1e-6)
        np.testing.assert_array_equal(env.step(env.action_space.sample())[0]["privileged"], obs["privileged"])


def test_a_whole_number_stays_one():
    env = gym.make("CartPole-v1")
    env.unwrapped.n_skip = 1
    wrapped = HiddenParameters(env, {"n_skip": [1, 2, 4]})
    drawn = {repr(wrapped.reset(seed=seed)[1]["hidden"]["n_skip"]): env.unwrapped.n_skip for seed in range(20)}
    assert drawn == {"1.0": 1, "2.0": 2, "4.0": 4} and all(type(value) is int for value in drawn.values())


def test_the_hidden_sign_turns_the_carts_push_round():
    env, pushed = cart_pole(), {}
    for seed in range(20):
        _, info = env.reset(seed=seed)
        pushed[info["hidden"]["force_mag"]] = env.step(1)[0]["common"][1]
    assert set(pushed) == {-10.0, 10.0} and pushed[-10.0] < -0.1 < 0.1 < pushed[10.0]


@pytest.mark.parametrize("make", [pendulum, cart_pole])
def test_uspl_trains_them(make):
    venv = make_vec_env(make, n_envs=8, seed=0)
    model = USPLPPO("MlpPolicy", venv, n_steps=64, batch_size=128, n_epochs=2, encoder_updates=2, seed=0, device="cpu")
    assert model.discrete_privileged == ({} if make is pendulum else {0: [-0.25, 0.25]})
    assert model.decision_period == (0.05 if make is pendulum else 0.02)
    before = model.policy.encoder.mean[-1].weight.clone()
    model.learn(2048)
    assert model.num_timesteps == 2048 and not (model.policy.encoder.mean[-1].weight == before).all()
    reward, _ = evaluate_policy(model, venv, n_eval_episodes=2)
    assert np.isfinite(reward)


def test_the_guides_programs_run(monkeypatch):
    programs = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.S)
    program = programs[0].replace("500_000", "2048").replace("n_steps=128", "n_steps=64, n_epochs=1")
    program = program.replace("encoder_updates=8", "encoder_updates=1")
    assert program != programs[0] and len([line for line in programs[0].splitlines() if line]) <= 10
    namespace = {}
    exec(program, namespace)
    assert namespace["model"].num_timesteps == 2048
    assert namespace["make"](render_mode="rgb_array").discrete_privileged == {0: [-0.25, 0.25]}
    exec(programs[1], namespace)
    env = namespace["make"]()
    env.reset(seed=0)
    rewards = [env.step(env.action_space.sample())[1] for _ in range(200)]
    assert env.discrete_privileged == {} and min(rewards) > 0.0


def test_bad_parameters_are_refused():
    make = gym.make
    with pytest.raises(ValueError, match=r"no attribute 'mass'; its numbers are .*'m'"):
        HiddenParameters(make("Pendulum-v1"), {"mass": (0.5, 2.0)})
    for values in ((2.0, 0.5), [1.0], [1.0, 1.0], (1.0, 2.0, 3.0), (0.0, np.inf), ["a", "b"], 5.0):
        with pytest.raises(ValueError, match=r"'m': .*expected a range"):
            HiddenParameters(make("Pendulum-v1"), {"m": values})
    with pytest.raises(ValueError, match="at least one"):
        HiddenParameters(make("Pendulum-v1"), {})
    with pytest.raises(ValueError, match="one-dimensional Box"):
        HiddenParameters(gym.wrappers.ReshapeObservation(make("Pendulum-v1"), (3, 1)), {"m": (0.5, 2.0)})
    with pytest.raises(ValueError, match="one of its sensors: name all"):
        HiddenParameters(pendulum(), {"l": (0.5, 2.0)})
    with pytest.raises(ValueError, match=r"'mass' of .* cannot be set; give the property a setter"):
        HiddenParameters(Sealed(), {"mass": (0.5, 2.0)})


class Sealed(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(2)
    mass = property(lambda self: 1.0)
