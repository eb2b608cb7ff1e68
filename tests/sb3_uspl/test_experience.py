"""Between two trainings the environments are the user's; what is learned from is whole episodes and nothing else."""

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from bullet_tasks.vec_env import BulletVecEnv
from sb3_uspl import USPLPPO, RESeLPPO
from tests.sb3_uspl.test_symmetries import MirroredEnv
from tests.sb3_uspl.toy import ToyEnv

LENGTH, N_ENVS, N_STEPS = 10, 4, 13
ALGORITHMS = pytest.mark.parametrize("algorithm", [USPLPPO, RESeLPPO])


def long_env():
    return ToyEnv(length=LENGTH)


def make_model(algorithm, env=None, **kwargs):
    kwargs = {"n_steps": N_STEPS, "batch_size": N_STEPS * N_ENVS, "n_epochs": 1, "seed": 0} | kwargs
    if algorithm is USPLPPO:
        kwargs = {"mismatch_fraction": 0.0, "encoder_updates": 1} | kwargs
    return algorithm("MlpPolicy", env or make_vec_env(long_env, N_ENVS), **kwargs)


def evaluated(model):
    evaluate_policy(model, model.get_env(), n_eval_episodes=6)


def looked_at(model):
    """SB3's usual loop."""
    env, state = model.get_env(), None
    obs = env.reset()
    for _ in range(5):
        actions, state = model.predict(obs, state)
        obs, *_ = env.step(actions)


def stepped(model):
    for _ in range(3):  # no episode ends
        model.get_env().step([model.action_space.sample()] * N_ENVS)


class SameInfo(ToyEnv):
    """Gives the same info at every reset."""

    info = {}

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0], self.info


@pytest.mark.parametrize("use", [evaluated, looked_at, stepped])
@pytest.mark.parametrize("make_env", [ToyEnv, SameInfo])
@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv, BulletVecEnv])
def test_no_episode_goes_on_from_before_others_used_the_environments(use, make_env, vec_env):
    env = make_vec_env(make_env, N_ENVS, env_kwargs={"length": LENGTH}, vec_env_cls=vec_env)
    model = make_model(USPLPPO, env).learn(N_STEPS * N_ENVS)
    use(model)
    model.learn(2 * N_STEPS * N_ENVS, reset_num_timesteps=False)
    episodes = model.rollout_buffer.episodes.replay
    assert len(episodes) >= 2 * N_ENVS
    for episode in episodes:
        truth, count = episode.arrays["truth"], LENGTH * episode.arrays["common"][:, 0]
        assert (truth == truth[0]).all() and count.round().astype(int).tolist() == list(range(LENGTH))
    env.close()


def test_an_episode_goes_on_where_nobody_has_used_the_environments():
    model = make_model(USPLPPO).learn(N_STEPS * N_ENVS)
    model.learn(N_STEPS * N_ENVS, reset_num_timesteps=False)
    counts = LENGTH * model.rollout_buffer.episodes.replay[-1].arrays["common"][:, 0]
    assert counts.round().astype(int).tolist() == list(range(LENGTH))
    assert LENGTH * model.rollout_buffer.observations["common"][0, 0] == pytest.approx(N_STEPS % LENGTH)


def test_sequences_begin_anew_after_others_used_the_environments():
    model = make_model(RESeLPPO, context_length=LENGTH).learn(N_STEPS * N_ENVS)
    evaluated(model)
    model.learn(2 * N_STEPS * N_ENVS, reset_num_timesteps=False)  # an episode beyond the context would be refused


@ALGORITHMS
def test_the_first_rollout_of_every_training_has_the_noise_of_its_time(algorithm):
    seen = []

    class Watch(BaseCallback):
        def _on_rollout_start(self):
            seen.append(float(self.model.policy.log_std.exp()[0]))

        def _on_step(self):
            return True

    model, n = make_model(algorithm, action_std=1.0, action_std_floor=0.1), N_STEPS * N_ENVS
    model.learn(4 * n)
    model.learn(4 * n, callback=Watch())
    assert seen[0] == pytest.approx(1.0) and sorted(seen, reverse=True) == seen
    seen.clear()
    model.learn(4 * n, callback=Watch(), reset_num_timesteps=False)
    assert seen[0] == pytest.approx(0.55), "half of all decisions are over"


@ALGORITHMS
def test_set_env_brings_no_normalisation_that_the_constructor_refuses(algorithm):
    model = make_model(algorithm)
    model.set_env(VecNormalize(make_vec_env(long_env, N_ENVS)))
    with pytest.raises(ValueError, match="privileged"):
        model.learn(N_STEPS * N_ENVS)


def test_set_env_brings_no_other_scale_than_the_symmetries():
    model = make_model(USPLPPO, make_vec_env(MirroredEnv, N_ENVS), symmetries=True)
    model.set_env(VecNormalize(make_vec_env(MirroredEnv, N_ENVS), norm_obs_keys=["common"]))
    with pytest.raises(ValueError, match="norm_obs_keys"):
        model.learn(N_STEPS * N_ENVS)
