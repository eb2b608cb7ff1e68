"""Training on: from a model that was saved, and from a shipped agent without legs to one with them."""

import csv
import warnings

import pytest
import yaml
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_uspl import USPLPPO, RESeLPPO
from sb3_uspl._zoo import TRAINED_AGENTS
from sb3_uspl.buffers import EpisodeReplayBuffer
from tests.sb3_uspl.commands import run
from tests.sb3_uspl.toy import make_model, make_venv

ENV = "LateralChoice-v0"
SHIPPED = TRAINED_AGENTS / "uspl_ppo" / f"{ENV}_1" / f"{ENV}.zip"
SMALL = ("n_envs:8", "n_steps:8", "batch_size:32", "encoder_updates:1")


@pytest.mark.skipif(not SHIPPED.is_file(), reason="the agent is not shipped with this copy")
def test_a_shipped_agent_is_trained_on_in_full_physics(tmp_path):
    before = USPLPPO.load(SHIPPED, device="cpu")
    result = run(
        *("sb3_uspl.train", "--algo", "uspl_ppo", "--env", ENV, "-f", str(tmp_path), "-n", "128", "--seed", "1"),
        *("-i", str(SHIPPED), "--env-kwargs", "physics:'full'", "--eval-freq", "-1", "-params", *SMALL),
    )
    assert result.returncode == 0, result.stdout + result.stderr
    folder = tmp_path / "uspl_ppo" / f"{ENV}_1"
    config = dict(yaml.load((folder / ENV / "config.yml").read_text(), Loader=yaml.UnsafeLoader))  # the zoo's own file
    assert config["env_kwargs"] == {"physics": "full"}
    after = USPLPPO.load(folder / f"{ENV}.zip", device="cpu")
    assert after.num_timesteps >= before.num_timesteps + 128, "it goes on counting, so that no warm-up begins anew"
    changed = [not (old == new).all() for old, new in zip(before.policy.parameters(), after.policy.parameters(), strict=True)]
    assert any(changed)
    with open(folder / "progress.csv") as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file) if row["time/total_timesteps"]]
    assert steps[0] > before.num_timesteps


def test_a_loaded_encoder_is_not_fitted_to_the_first_few_episodes_of_a_new_replay(tmp_path, monkeypatch):
    asked = []
    draw = EpisodeReplayBuffer.batches

    def count(self, n_batches, n_tokens, *args):
        asked.append((n_batches, self.n_decisions // n_tokens))
        return draw(self, n_batches, n_tokens, *args)

    monkeypatch.setattr(EpisodeReplayBuffer, "batches", count)
    model = make_model(encoder_batch_size=64, encoder_updates=3, replay="all")
    model.learn(8 * 16 * 2)
    model.learn(8 * 16 * 2, reset_num_timesteps=False)
    assert [n_batches for n_batches, _ in asked] == [3] * 4, "a model's own replay is there"
    model.save(tmp_path / "model")
    asked.clear()
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv(8), encoder_batch_size=96)
    loaded.learn(8 * 16 * 6, reset_num_timesteps=False)
    assert [n_batches for n_batches, _ in asked] == [min(3, one_pass) for _, one_pass in asked]
    assert asked[0][0] < 3 == asked[-1][0]
    asked.clear()
    full = USPLPPO.load(tmp_path / "model", env=make_venv(8), encoder_batch_size=10_000, replay_bytes=4_000)
    full.learn(8 * 16 * 6, reset_num_timesteps=False)
    assert asked[0][0] == 0 and asked[-1][0] == 3, "a replay that is full holds all that it ever will"
    asked.clear()
    USPLPPO.load(tmp_path / "model", env=make_venv(8)).learn(8 * 16)
    assert asked[0][0] == 3, "a training that begins anew is like any other"


@pytest.mark.parametrize(("rollouts", "anew"), [(1, True), (2, False), (3, False)])
def test_a_policy_starts_anew_after_the_warm_up_once_whenever_it_was_saved(tmp_path, rollouts, anew):
    model = make_model(policy_restart=True, warmup_timesteps=8 * 16, ramp_timesteps=0)
    model.learn(8 * 16 * rollouts)
    model.save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv(8), learning_rate=0.0)
    loaded.learn(8 * 16 * 2, reset_num_timesteps=False)
    assert (loaded.policy.action_net.weight != model.policy.action_net.weight).any() == anew


def test_a_policy_that_is_past_its_warm_up_does_not_start_anew_because_the_configuration_says_so(tmp_path):
    model = make_model(warmup_timesteps=8 * 16, ramp_timesteps=0).learn(8 * 16 * 3)
    model.save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv(8), learning_rate=0.0, policy_restart=True)
    loaded.learn(8 * 16 * 2, reset_num_timesteps=False)
    assert (loaded.policy.action_net.weight == model.policy.action_net.weight).all()


@pytest.mark.parametrize("algorithm", [USPLPPO, RESeLPPO])
def test_a_learning_rate_given_to_load_falls_as_one_given_before_does(tmp_path, algorithm):
    algorithm("MlpPolicy", make_venv(8), n_steps=16, batch_size=32, learning_rate_floor=0.1).save(tmp_path / "model")
    given = {"learning_rate": 1e-3, "learning_rate_floor": 0.5}
    for kwargs, ends in ({}, (3e-4, 3e-5)), ({"learning_rate": 1e-3}, (1e-3, 1e-4)), (given, (1e-3, 5e-4)):
        loaded = algorithm.load(tmp_path / "model", env=make_venv(8), **kwargs)
        assert (loaded.lr_schedule(1.0), loaded.lr_schedule(0.0)) == pytest.approx(ends)
    constant = algorithm.load(tmp_path / "model", env=make_venv(8), learning_rate=lambda _: 1e-3)
    assert constant.lr_schedule(0.0) == 1e-3


def test_a_ramp_given_to_load_replaces_the_first_one(tmp_path):
    make_model(warmup_timesteps=64).learn(256).save(tmp_path / "model")
    for kwargs, period in ({}, (64, 128)), ({"warmup_timesteps": 100, "ramp_timesteps": 1000}, (100, 1000)):
        loaded = USPLPPO.load(tmp_path / "model", env=make_venv(8), **kwargs)
        loaded.learn(512, reset_num_timesteps=False)
        assert loaded._progress_period == period


def test_the_first_observation_of_a_training_that_goes_on_is_blurred(tmp_path):
    make_model(warmup_timesteps=0, ramp_timesteps=0).learn(128).save(tmp_path / "model")
    loaded = USPLPPO.load(tmp_path / "model", env=make_venv(8))
    loaded._setup_learn(128, reset_num_timesteps=False)
    shown, truth = (loaded._last_obs[key][: 8 - loaded.n_mismatched] for key in ("privileged", "truth"))
    assert (shown != truth).any()  # not everywhere: the truth is at a bound, beyond which nothing is blurred


def test_a_trained_model_is_loaded_with_one_environment_but_not_trained_with_it(tmp_path):
    make_model(mismatch_fraction=0.5).learn(128).save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = USPLPPO.load(tmp_path / "model", env=make_venv(1))
        evaluate_policy(loaded, loaded.get_env(), n_eval_episodes=1)
    with pytest.raises(ValueError, match="no pair"):
        loaded.learn(128, reset_num_timesteps=False)


def test_an_interrupt_in_the_middle_of_a_step_leaves_no_episode_of_two(monkeypatch):
    """The environments have stepped, the history has not: going on must not join what came before to what comes after."""
    model = make_model()
    wait, calls = model.env.step_wait, []

    def interrupted():
        result = wait()
        calls.append(None)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(model.env, "step_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(512)
    model.learn(512, reset_num_timesteps=False)
    episodes = model.rollout_buffer.episodes
    assert len(episodes.replay)
    for episode in episodes.replay:
        truth = episode.arrays["truth"]
        assert len(truth) == 8 and (truth == truth[0]).all()
