"""The deployment policy: encoder and actor on what the robot sees, with a memory that starts with each episode."""

import numpy as np
import pytest

from tests.sb3_uspl.toy import IMAGE, make_model, make_venv


@pytest.mark.parametrize("memory", ["gru", "transformer"])
@pytest.mark.parametrize("target", [None, IMAGE], ids=["blind", "image"])
def test_deployment_policy_ignores_privileged(memory, target):
    policy = "CnnPolicy" if target is IMAGE else "MlpPolicy"
    model = make_model(policy=policy, env_kwargs={"target": target}, policy_kwargs=dict(memory=memory)).learn(256)
    obs = model.get_env().reset()
    hidden = {key: value for key, value in obs.items() if key != "privileged"}
    wrong = {**obs, "privileged": np.full_like(obs["privileged"], 9.0)}
    actions = [model.predict(o, deterministic=True)[0] for o in (obs, hidden, wrong)]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])


@pytest.mark.parametrize("memory", ["gru", "transformer"])
def test_predict_carries_its_memory_and_forgets_at_episode_starts(memory):
    model = make_model(policy_kwargs=dict(memory=memory)).learn(256)
    venv = make_venv(3)
    obs, state, states = venv.reset(), None, []
    for _ in range(5):
        action, state = model.predict(obs, state, deterministic=True)
        states.append(state)
        obs, *_ = venv.step(action)
    fresh_action, fresh = model.predict(obs, deterministic=True)
    reset_action, reset = model.predict(obs, state, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_allclose(fresh_action, reset_action, atol=1e-6)
    np.testing.assert_allclose(fresh.uncertainty, reset.uncertainty, atol=1e-6)
    # predict is a function of its arguments: an old state still gives what it gave.
    again = model.predict(obs, states[-1], deterministic=True)
    np.testing.assert_array_equal(model.predict(obs, state, deterministic=True)[0], again[0])
    # One environment alone equals the same one among others.
    single = {key: value[1] for key, value in obs.items()}
    state_1 = tuple(part[1:2] if isinstance(part, np.ndarray) else tuple(p[1:2] for p in part) for part in state)
    alone, _ = model.predict(single, state_1, deterministic=True)
    np.testing.assert_allclose(alone, again[0][1], atol=1e-5)
    assert alone.shape == (1,)


def test_deployment_sees_the_uncertainty_that_training_showed():
    """The belief and smoothed uncertainty of ``predict`` equal those of the rollout wrapper for the same history."""
    model = make_model(mismatch_fraction=0.0, blur=False).learn(256)
    wrapper = model._rollout_env
    obs = wrapper.begin(model.env.reset())
    state, starts = None, np.ones(8, dtype=bool)
    for _ in range(20):
        _, state = model.predict({"common": obs["common"]}, state, starts, deterministic=True)
        np.testing.assert_allclose(state.uncertainty, obs["uncertainty"], atol=1e-5)
        np.testing.assert_allclose(state.belief_mean, obs["belief"], atol=1e-5)
        obs, _, starts, _ = wrapper.step(np.clip(state.previous_action, -1, 1))


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(2), "expected a dict"),
        (({"common": np.zeros(2)}, {}), "pass only obs"),
        ({"privileged": np.zeros(1)}, r"also needs \['common'\]"),
        ({"common": np.array([np.nan, 0.0], np.float32)}, "holds nan"),
    ],
)
def test_bad_observations_are_explained(observation, message):
    with pytest.raises(ValueError, match=message):
        make_model().predict(observation)


def test_a_state_of_other_environments_is_refused():
    model = make_model()
    _, state = model.predict({"common": np.zeros((3, 2), np.float32)})
    with pytest.raises(ValueError, match="holds 3 environments but 2"):
        model.predict({"common": np.zeros((2, 2), np.float32)}, state)


def test_a_state_of_another_memory_is_refused():
    _, state = make_model(policy_kwargs=dict(memory="gru")).predict({"common": np.zeros((3, 2), np.float32)})
    with pytest.raises(ValueError, match="memory has 1 parts but this policy's has 3"):
        make_model(policy_kwargs=dict(memory="transformer")).predict({"common": np.zeros((3, 2), np.float32)}, state)


def test_starts_of_other_environments_are_refused():
    with pytest.raises(ValueError, match="about 2 environments but 3 observations"):
        make_model().predict({"common": np.zeros((3, 2), np.float32)}, None, np.ones(2, bool))
