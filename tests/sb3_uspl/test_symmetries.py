"""An episode in a mirrored world is another of the same world, whole and as likely; who acts knows one world for all."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uspl import USPLPPO
from sb3_uspl.buffers import EpisodeReplayBuffer
from sb3_uspl.observations import BELIEF, COMMON, PRIVILEGED, TRUTH, UNCERTAINTY
from sb3_uspl.symmetries import SymmetryGroup
from tests.sb3_uspl.test_buffers import N_ENVS, observation
from tests.sb3_uspl.toy import ToyEnv

MIRROR = (np.diag([1.0, -1.0]), np.array([[-1.0]]))  # what is revealed changes its sign with what is hidden
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
TURNS = [(np.kron(np.eye(2), t), t) for t in (TURN, TURN @ TURN, TURN.T)]  # of a position, a heading and a place


class MirroredEnv(ToyEnv):
    symmetries = (MIRROR,)


def make_model(env_class=MirroredEnv, wrap=lambda venv: venv, **kwargs):
    fast = dict(n_steps=16, batch_size=32, n_epochs=2, encoder_updates=4, encoder_batch_size=64, seed=0)
    return USPLPPO("MlpPolicy", wrap(make_vec_env(env_class, 8, seed=0)), **{**fast, "symmetries": True, **kwargs})


def situations(n, n_common=4, n_privileged=2, seed=0):
    rng = np.random.default_rng(seed)
    obs = {COMMON: rng.normal(size=(n, n_common)), UNCERTAINTY: rng.uniform(0.01, 0.25, (n, n_privileged))}
    obs |= {key: rng.normal(size=(n, n_privileged)) for key in (PRIVILEGED, TRUTH, BELIEF)}
    return {key: th.as_tensor(value, dtype=th.float32) for key, value in obs.items()}


def test_whole_episodes_are_turned_half_of_them():
    episodes = EpisodeReplayBuffer(ToyEnv().observation_space, 1, N_ENVS, 0, 100, 10**6, "all", 0)
    episodes.symmetries = SymmetryGroup([MIRROR], 2, 1)
    for t in range(41):
        episodes.add(observation([t % 5] * N_ENVS, 1 + t))
    signs = []
    for tokens, truth, lengths in episodes.batches(20, 50):
        env = truth[:, 0].abs()
        assert (tokens["common"][:, 0] > 0.0).all() and (tokens["previous_action"] >= 0.0).all()
        sign = tokens["common"][:, 1].sign()
        assert (truth[:, 0] == sign * env).all()
        assert (tokens["common"][:, 1].abs() == tokens["common"][:, 0]).all()
        of_episode = [part for part in sign.split(lengths.tolist())]
        assert all((part == part[0]).all() for part in of_episode)
        signs += [float(part[0]) for part in of_episode]
    assert 0.4 < np.mean(np.array(signs) > 0.0) < 0.6


def test_an_encoder_learns_the_mirrored_world_that_it_has_never_seen():
    class OneSided(MirroredEnv):
        def reset(self, **kwargs):
            super().reset(**kwargs)
            self.hidden = np.abs(self.hidden)
            return self._observe(), {}

    model = make_model(OneSided, encoder_learning_rate=3e-3).learn(4096)
    state, shown = None, np.array([0.0, 0.0, -1.0, 0.0], np.float32)  # the other side is revealed
    for t, revealed in enumerate(shown):
        common = np.array([t / 8, revealed], np.float32)
        _, state = model.predict({"common": common}, state, np.array([t == 0]), deterministic=True)
    assert state.belief_mean[0, 0] < -0.15


def test_one_of_all_that_look_the_same_is_seen():
    group, obs = SymmetryGroup(TURNS, 4, 2), situations(50)
    seen = group.turn(obs, group.canonical(obs[COMMON]))
    assert (seen[COMMON][:, 0] >= 0.98 * seen[COMMON][:, 1].abs()).all()
    for which in range(4):
        turned = group.turn(obs, th.full((50,), which))
        again = group.turn(turned, group.canonical(turned[COMMON]))
        for key, value in seen.items():
            th.testing.assert_close(again[key], value)
    # The belief is where it was, seen from the place.
    for a, b in ((PRIVILEGED, COMMON), (BELIEF, TRUTH)):
        dot = [(o[a] * o[b][:, :2]).sum(1) for o in (obs, seen)]
        th.testing.assert_close(*dot)
    one_side = SymmetryGroup([MIRROR], 2, 1)
    obs = situations(50, 2, 1)
    assert (one_side.turn(obs, one_side.canonical(obs[COMMON]))[COMMON][:, 1] >= 0.0).all()


@pytest.mark.parametrize(("n_common", "mirrored"), [(2, 0), (6, 5), (30, 25)])
def test_wherever_the_mirrored_coordinate_stands(n_common, mirrored):
    matrix = np.eye(n_common)
    matrix[mirrored, mirrored] = -1.0
    group, obs = SymmetryGroup([(matrix, np.eye(2))], n_common, 2), situations(100, n_common)
    seen = group.turn(obs, group.canonical(obs[COMMON]))
    assert (seen[COMMON][:, mirrored] >= 0.0).all()
    others = [i for i in range(n_common) if i != mirrored]
    assert (seen[COMMON][:, others] == obs[COMMON][:, others]).all()


def test_symmetries_of_no_environment_cannot_be_asked_for(tmp_path):
    make_model(symmetries=False).save(tmp_path / "model")
    with pytest.raises(ValueError, match="pass `env`"):
        USPLPPO.load(tmp_path / "model", symmetries=True)


@pytest.mark.parametrize("symmetries", [False, True])
def test_actor_and_critic_do_alike_where_the_world_looks_the_same_if_they_are_told(symmetries):
    class Turned(ToyEnv):
        symmetries = ((np.diag([-1.0, 1.0]), np.array([[-1.0]])),)

    model = make_model(Turned, symmetries=symmetries).learn(512)
    obs = situations(20, 2, 1)
    turned = SymmetryGroup(Turned.symmetries, 2, 1).turn(obs, th.ones(20, dtype=th.long))
    with th.no_grad():
        model.policy.set_training_mode(False)
        for value in (lambda o: model.policy(o, deterministic=True)[0], model.policy.predict_values):
            assert th.allclose(value(obs), value(turned), atol=1e-5) == symmetries
    if symmetries:
        assert model.policy.pi_features_extractor.common_normalizer.mean[0] > 0.3  # of what is seen: t is never negative


@pytest.mark.parametrize(
    "env_class, wrap, message",
    [
        (ToyEnv, lambda venv: venv, "the environment lists none"),
        (type("Wrong", (ToyEnv,), {"symmetries": ((np.eye(3), np.eye(1)),)}), lambda venv: venv, r"of the shapes \(2, 2\)"),
        (MirroredEnv, lambda venv: VecNormalize(venv, norm_obs_keys=["common"]), "leave it out of norm_obs_keys"),
    ],
)
def test_symmetries_that_there_are_not_are_refused(env_class, wrap, message):
    with pytest.raises(ValueError, match=message):
        make_model(env_class, wrap)


def test_half_a_group_is_refused():
    with pytest.raises(ValueError, match="all of a group: number 1 after number 1"):
        SymmetryGroup(TURNS[:1], 4, 2)


def test_a_loaded_model_plays_without_an_environment_and_learns_on_with_one(tmp_path):
    model = make_model().learn(128)
    model.save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model")
    obs = {"common": np.array([[0.1, 0.2], [0.1, -0.2]], np.float32)}
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    loaded.set_env(make_vec_env(MirroredEnv, 8, seed=0))
    loaded.learn(256, reset_num_timesteps=False)
    assert loaded.rollout_buffer.episodes.symmetries is not None


def test_rewards_may_be_normalised():
    make_model(wrap=lambda venv: VecNormalize(venv, norm_obs=False))
