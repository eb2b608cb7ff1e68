"""The benchmarks run at tiny sizes, and what they compare is comparable. No time is asserted."""

import json

import numpy as np
import pytest
import torch as th

from benchmarks import __main__ as command_line
from benchmarks import encoder, environments, gpu, growth, harness, phases, start_up, to_success, training
from benchmarks.contenders import METHODS, build, hides_privileged, make_venv, memory_width, zoo_settings
from benchmarks.synthetic import SyntheticEnv
from sb3_uspl import USPLPPO
from sb3_uspl.encoder import MEMORIES

LATERAL_CHOICE = training.Task("LateralChoice-v0", {"physics": "compiled"}, 8)
ONE_EPISODE = 8 * 80
"""Decisions of the task's environments in the time of an episode."""


def check_table(table, unit=None):
    assert table
    for row in table:
        numbers = [value for value in row.values() if isinstance(value, float)]
        assert numbers and np.isfinite(numbers).all() and min(numbers) >= 0.0
        assert unit is None or (row["unit"] == unit and row["least"] <= row["median"] <= row["greatest"])


# -- harness -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("warm_up", [True, False])
def test_contenders_are_measured_in_turn(warm_up):
    order = []

    def contender(name):
        return lambda: order.append(name) or float(len(order))

    values = harness.interleave({"a": contender("a"), "b": contender("b")}, 3, warm_up)
    assert order == ["a", "b"] * (3 + warm_up)
    first = 2 * warm_up + 1
    assert values == {"a": [first, first + 2, first + 4], "b": [first + 1, first + 3, first + 5]}
    for contenders, repetitions in (({}, 1), ({"a": contender("a")}, 0)):
        with pytest.raises(ValueError, match="at least one"):
            harness.interleave(contenders, repetitions)


def test_ratios_are_taken_within_a_round():
    """Every round but the first is three times as slow for both: the ratio does not notice, that of the medians would."""
    values = {"ours": [8.0, 30.0, 30.0], "theirs": [4.0, 10.0, 15.0]}
    assert harness.ratio(values, "ours", "theirs") == 2.0
    ours, theirs = harness.rows(values, "speed", "1/s", "theirs")
    assert (ours["median"], ours["least"], ours["greatest"], ours["/ theirs"]) == (30.0, 8.0, 30.0, 2.0)
    assert theirs["/ theirs"] == 1.0


def test_targets_are_met_at_their_limit():
    assert harness.target("fast", 2.0, at_least=2.0)["met"] and not harness.target("fast", 1.9, at_least=2.0)["met"]
    assert harness.target("slow", 2.0, at_most=2.0)["met"] and not harness.target("slow", 2.1, at_most=2.0)["met"]
    for limits in ({}, {"at_least": 1.0, "at_most": 2.0}):
        with pytest.raises(ValueError, match="either"):
            harness.target("neither or both", 1.0, **limits)


def test_tables_as_text():
    table = [{"name": "a", "value": 12345.6, "met": True}, {"name": "bbb", "met": False}]
    assert harness.show("T", table).splitlines() == ["T", "-", "name   value  met", "a     12,346  yes", "bbb            NO"]
    markdown = harness.show("T", table, markdown=True).splitlines()
    assert markdown[2:] == ["| name | value | met |", "| :--- | ---: | ---: |", "| a | 12,346 | yes |", "| bbb |  | NO |"]


def test_a_section_that_fails_costs_no_other_its_results(tmp_path, monkeypatch, capsys):
    def broken():
        raise RuntimeError("no such luck")

    def fine(size):
        return {"Fine": [{"size": size}], harness.TARGETS: [harness.target("t", 1.0, at_most=2.0)]}

    monkeypatch.setattr(command_line, "SECTIONS", {"broken": (broken, {}), "fine": (fine, {"size": 1})})
    path = tmp_path / "folder" / "results.json"
    assert not command_line.run_sections(["broken", "fine"], True, {"size": None, "threads": 3}, path)
    sections = json.loads(path.read_text())["sections"]
    assert "no such luck" in sections["broken"]["failed"]
    assert sections["fine"]["tables"]["Fine"] == [{"size": 1}]
    assert {"processor", "cores", "packages", "commit", "load"} <= set(sections["fine"]["machine"])
    assert "Targets" in capsys.readouterr().out


def test_what_is_not_measured_again_stays(tmp_path, monkeypatch, capsys):
    def first():
        return {"First": [{"speed": 12.0}], harness.TARGETS: [harness.target("old target", 1.0, at_most=2.0)]}

    monkeypatch.setattr(command_line, "SECTIONS", {"first": (first, {}), "second": (lambda: {"Second": [{"n": 1}]}, {})})
    path = tmp_path / "results.json"
    assert command_line.run_sections(["first"], False, {}, path)
    before = json.loads(path.read_text())["sections"]["first"]
    capsys.readouterr()
    assert command_line.run_sections(["second"], False, {}, path)
    assert json.loads(path.read_text())["sections"]["first"] == before
    assert "old target" not in capsys.readouterr().out  # of what was not measured now
    command_line.show_sections(path)
    shown = capsys.readouterr().out
    assert "old target" in shown and "12" in shown and shown.index("First") < shown.index("Second")


# -- phases ------------------------------------------------------------------------------------------------------------------


def test_phases_never_overlap(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(phases.time, "perf_counter", lambda: now[0])
    stopwatch = phases.Stopwatch()

    def wait(seconds):
        now[0] += seconds

    with stopwatch.phase("outer"):
        wait(1.0)
        stopwatch.timed(wait, "inner")(2.0)
        wait(4.0)
        with stopwatch.phase("whole", whole=True):
            wait(8.0)
            stopwatch.timed(wait, "inner")(16.0)
    wait(32.0)
    assert stopwatch.seconds == {"outer": 5.0, "inner": 2.0, "whole": 24.0}


def test_every_phase_of_an_iteration_is_seen():
    short = dict(n_epochs=1, batch_size=320, encoder_updates=2, encoder_batch_size=64)
    settings = training.settings_for(LATERAL_CHOICE, decisions=ONE_EPISODE, **short)
    with training.ready("USPLPPO", LATERAL_CHOICE, 8, settings) as model:
        original = model.train.__func__
        training.iteration_seconds(model)
        with phases.watch_phases(model) as stopwatch:
            whole = training.iteration_seconds(model)
        assert set(stopwatch.seconds) == set(phases.PHASES) and min(stopwatch.seconds.values()) > 0.0
        assert 0.5 * whole < sum(stopwatch.seconds.values()) <= whole
        assert model.train.__func__ is original  # nothing stays timed


# -- contenders --------------------------------------------------------------------------------------------------------------


def test_contenders_have_the_same_sizes_and_settings():
    settings = training.settings_for(LATERAL_CHOICE, decisions=8 * 64)
    width = memory_width(settings)
    for method in METHODS:
        venv = make_venv("LateralChoice-v0", 8, hide_privileged=hides_privileged(method), physics="compiled")
        model = build(method, venv, settings)
        assert (model.n_steps, model.n_epochs, model.gamma) == (settings["n_steps"], settings["n_epochs"], settings["gamma"])
        assert model.batch_size == settings["batch_size"]
        actor = [layer.out_features for layer in model.policy.mlp_extractor.policy_net if isinstance(layer, th.nn.Linear)]
        assert actor == [128, 128]
        if method == "RecurrentPPO":
            assert model.policy.lstm_actor.hidden_size == width
        elif method != "PPO":
            assert model.policy.encoder.memory.width == width
        venv.close()
    with pytest.raises(ValueError, match="Unknown method"):
        build("DQN", venv, settings)


def test_entries_that_wrap_environments_are_refused(tmp_path, monkeypatch):
    (tmp_path / "uspl_ppo.yml").write_text("default:\n  n_steps: 8\n  normalize: true\n")
    monkeypatch.setattr("benchmarks.contenders.CONFIGS", tmp_path)
    with pytest.raises(ValueError, match="normalize"):
        zoo_settings("uspl_ppo", "LateralChoice-v0")


def test_the_lstm_that_we_compare_with_is_one():
    """Whole ragged episodes, stepped or in one call, and token by token: the same beliefs."""
    th.manual_seed(0)
    stepped, lengths = encoder.LSTMEncoder(8), th.tensor([3, 1, 5])
    # Beliefs start out nearly alike, whatever was seen.
    th.nn.init.normal_(stepped.mean[-1].weight)
    at_once = encoder.LSTMEncoder(8, stepped=False)
    at_once.load_state_dict(stepped.state_dict())
    tokens = encoder.random_tokens(9)
    with th.no_grad():
        belief, _ = stepped(tokens, lengths)
        th.testing.assert_close(at_once(tokens, lengths)[0].mean, belief.mean)
        for episode, expected in zip(range(3), belief.mean.split(lengths.tolist()), strict=True):
            first, state = int(lengths[:episode].sum()), stepped.initial_state(1)
            for i in range(int(lengths[episode])):
                token = {key: value[first + i : first + i + 1] for key, value in tokens.items()}
                one, state = stepped.step(token, state)
                th.testing.assert_close(one.mean[0], expected[i])
    assert belief.mean.std() > 0.01


@pytest.mark.parametrize("longest", [1, 4, 80])
def test_ragged_episodes(longest):
    lengths = encoder.ragged_lengths(longest, 100)
    assert lengths.max() == longest and lengths.min() >= max(1, longest // 4) and 100 <= lengths.sum() < 100 + longest


def test_synthetic_environment():
    env = SyntheticEnv(5, image=8)
    observation, _ = env.reset(seed=0)
    ends = []
    while not any(ends):
        assert env.observation_space.contains(observation)
        observation, _, *ends, _ = env.step(env.action_space.sample())
    assert env._time == 5 and ends == [True, False]
    with pytest.raises(ValueError, match="at least 1"):
        SyntheticEnv(0)


# -- sections ----------------------------------------------------------------------------------------------------------------


def test_environments():
    tables = environments.run(1, n_envs=2, n_many=2, n_steps=4, n_resets=2, env_ids=["LateralChoice-v0"], start_up_env=None)
    check_table(tables["A second process"], "million additions / s")
    speed = tables["Environments, random actions"]
    check_table(speed, "decisions / s")
    assert [row["contender"] for row in speed[:4]] == list(start_up.VEC_ENVS)
    assert {row["contender"] for row in tables["Reset"]} == set(environments.PHYSICS)
    check_table(tables[harness.TARGETS])


@pytest.mark.parametrize("name", start_up.VEC_ENVS)
def test_start_up(name):
    measured = start_up.measure_here(name, "LateralChoice-v0", 2, {"physics": "compiled"})
    assert measured.seconds > 0.0 and (measured.memory is None or np.isfinite(measured.memory))


@pytest.mark.slow
def test_start_up_in_a_fresh_process():
    for name in ("DummyVecEnv", start_up.DEFAULT_SUBPROC):
        measured = start_up.measure(name, "LateralChoice-v0", 2, {"physics": "kinematic"})
        # A PyBullet world alone takes 20 MiB.
        assert measured.seconds > 0.0 and (measured.memory is None or measured.memory > 10.0)
    with pytest.raises(RuntimeError, match="NoSuchEnv"):
        start_up.measure("DummyVecEnv", "NoSuchEnv-v0", 2, {})


def test_encoder():
    tables = encoder.run(**encoder.QUICK)
    rollout, update, targets = tables.values()
    check_table(rollout, "us / token")
    check_table(update, "tokens / s")
    assert [row["what"] for row in targets] == [f"{memory}, 8 envs: a token at position 500 / at 10" for memory in MEMORIES]


def test_training(monkeypatch):
    short = dict(n_epochs=1, batch_size=320, encoder_updates=1, encoder_batch_size=64)
    monkeypatch.setattr(training, "ALL_AT_ONCE", {**training.ALL_AT_ONCE, **short})
    seeing = [training.Task("SignpostNavDepth-v0", {"physics": "compiled"}, 8)]
    quick = dict(rollout_envs=8, env_counts=(8,), thread_counts=(1,))
    few = [LATERAL_CHOICE]
    tables = training.run(1, few, ONE_EPISODE, **quick, default_tasks=few, image_tasks=seeing)
    speed, by_phase, rollouts, whole, targets = tables.values()
    check_table(speed, "samples / s")
    assert {row["contender"] for row in speed} == set(METHODS)
    assert [row["phase"] for row in by_phase] == 2 * list(phases.PHASES)
    for task in (LATERAL_CHOICE, *seeing):
        shares = [row["share"] for row in by_phase if row["what"] == f"{task}, {task.n_envs} envs"]
        assert len(shares) == len(phases.PHASES) and sum(shares) == pytest.approx(1.0)
    check_table(rollouts, "s / rollout")
    check_table(whole, "decisions / s")
    assert len(targets) == 5


def test_iterations_cover_an_episode():
    maze = training.Task("ActiveTMaze-v0", {"corridor_length": 10}, 8)
    assert [training.iterations_per_episode(maze, n) for n in (4, 13, 14)] == [4, 1, 1]
    assert training.iterations_per_episode(LATERAL_CHOICE, 32) == 3


def test_growth():
    (table,) = growth.run(1, (1, 8), (4,), (8,), (None, 16), n_envs=8, length=4).values()
    check_table(table, "us / decision")
    assert all(0.0 < row["of which rollout"] < row["median"] for row in table)
    assert len(table) == 2 + 2 + len(MEMORIES) * (1 + 1)


def test_gpu_section_runs_anywhere_but_shows_nothing_without_one():
    (table,) = gpu.run(1, 8, 10, 1, encoder="small", variants=["float32"], device="cpu").values()
    check_table(table, "s / iteration")
    assert bool(gpu.run(**gpu.QUICK, variants=["float32"])) == th.cuda.is_available()


def test_until_success():
    task = training.Task("TargetReaching-v0", {})
    small = dict(every=1, n_episodes=4, n_steps=8, n_epochs=1, batch_size=512, encoder_updates=1, encoder_batch_size=64)
    for method in to_success.METHODS:
        at_once = to_success.learn(method, task, success=0.0, **small)
        assert at_once.reached and at_once.seconds > 0.0 and 0 < at_once.decisions <= 1024
    never = to_success.learn("USPLPPO", task, success=1.1, limit=0.5, **small)
    assert not never.reached and never.decisions > 0


def test_summary_of_trainings():
    def row(reached, seconds):
        return dict(task="t", method="m", reached=reached, seconds=seconds, decisions=10, success=0.5)

    (line,) = to_success.summary([row(True, 3.0), row(False, 1.0), row(True, 5.0)])
    assert (line["reached"], line["seconds"], line["decisions"]) == ("2 of 3", 5.0, 10.0)
    (line,) = to_success.summary([row(True, 3.0), row(False, 9.0)])
    assert line["seconds"] is None


def test_growth_builds_what_it_says():
    model = growth.make_model(growth.Size(n_envs=8, length=6, width=16, image=16, memory="transformer"))
    assert isinstance(model, USPLPPO) and (model.n_envs, model.n_steps, model.n_mismatched) == (8, 6, 2)
    assert model.policy.encoder.memory.width == 16 and model.policy.encoder.features.has_image
    model.get_env().close()
