"""A card says what was measured of this very model, and the README's table is what the cards say."""

import json
from pathlib import Path

import pytest
import yaml

from sb3_uspl.model_card import (
    BEGIN,
    END,
    EVALUATION,
    ROOT,
    TRAINED_AGENTS,
    Agent,
    agents,
    card,
    ship,
    table,
    with_table,
)

RESULT = {
    "episodes": 200,
    "seed": 1_000_000,
    "decision_period": 0.25,
    "success_rate": 0.98,
    "success_interval": [0.95, 0.992],
    "mean_length": 46.0,
    "privileged_success_rate": 1.0,
    "privileged_success_interval": [0.981, 1.0],
    "divergence_mean": 0.02,
    "prediction_error_final": 0.015,
}


def write_agent(logs, evaluated=True, algo="uspl_ppo", env="LateralChoice-v0", number=3):
    folder = logs / algo / f"{env}_{number}"
    (folder / env).mkdir(parents=True)
    (folder / f"{env}.zip").write_bytes(b"weights")
    (folder / "best_model.zip").write_bytes(b"better weights")
    arguments = {"seed": 7, "n_timesteps": -1, "eval_freq": 50_000, "n_eval_envs": 25, "hyperparams": {"n_epochs": 3}}
    (folder / env / "args.yml").write_text(yaml.dump(arguments))
    (folder / env / "config.yml").write_text(yaml.dump({"n_envs": 256, "env_kwargs": {"physics": "compiled"}}))
    (folder / "progress.csv").write_text("time/total_timesteps,time/time_elapsed,x\n8192,2,\n,,1\n2000896,299,\n")
    agent = Agent(folder)
    if evaluated:
        (folder / EVALUATION).write_text(json.dumps({**RESULT, "model_sha256": agent.digest}))
    return agent


def test_a_card_has_every_number_the_command_and_the_notes(tmp_path):
    agent = write_agent(tmp_path)
    (agent.folder / "notes.md").write_text("It looks first.\n")
    text = card(agent)
    for part in ("98.0 % (95.0-99.2)", "100.0 % (98.1-100.0)", "200 episodes", "11.5 s", "seed 7", "2.00 M", "4:59 min"):
        assert part in text
    assert "--seed 7 --eval-freq 50000 --n-eval-envs 25 -params n_epochs:3`" in text and "It looks first." in text
    assert 'physics="compiled"' in text and "n_envs: 256" in text


def test_numbers_of_another_model_are_not_shown(tmp_path):
    agent = write_agent(tmp_path)
    agent.model.write_bytes(b"other weights")
    assert agent.evaluation() is None
    with pytest.raises(ValueError, match="of this model"):
        card(agent)
    assert table([agent]).count("not evaluated") == 2


def test_what_is_shipped_is_what_was_asked_for(tmp_path):
    run = write_agent(tmp_path / "logs")
    last = ship(run.folder, folder=tmp_path / "agents")
    assert last.folder == tmp_path / "agents" / "uspl_ppo" / "LateralChoice-v0_1"
    assert last.digest == run.digest and last.training() == run.training() == (2_000_896, 299.0)
    assert last.evaluation() is None, "it is evaluated where it is shipped"
    best = ship(run.folder, best=True, folder=tmp_path / "agents")
    assert best.model.read_bytes() == b"better weights" and best.commands() == run.commands()
    (run.folder / "best_model.zip").unlink()
    with pytest.raises(ValueError, match="best_model"):
        ship(run.folder, best=True, folder=tmp_path / "agents")


def test_an_agent_that_was_trained_on_is_shipped_with_both_commands_and_times(tmp_path):
    first = ship(write_agent(tmp_path / "logs").folder, folder=tmp_path / "agents")
    run = write_agent(tmp_path / "more")
    arguments = {
        "seed": 8,
        "n_timesteps": 1000,
        "trained_agent": str(first.model),
        "conf_file": str(tmp_path / "zoo_configs" / "uspl_ppo.yml"),
        "log_folder": str(tmp_path / "more"),
        "hyperparams": {"gamma": 0.98},
    }
    (run.settings / "args.yml").write_text(yaml.dump(arguments))
    (run.folder / "progress.csv").write_text("time/total_timesteps,time/time_elapsed\n2001896,100\n")
    begun_with, last = first.commands()[0], ship(run.folder, folder=tmp_path / "agents")
    assert last.folder == first.folder and last.training() == (2_001_896, 399.0)
    model = "-i logs/uspl_ppo/LateralChoice-v0_1/LateralChoice-v0.zip"
    assert last.commands() == [
        begun_with,
        f"python -m sb3_uspl.train --algo uspl_ppo --env LateralChoice-v0 --seed 8 {model} -n 1000 -params gamma:0.98",
    ]
    for settings in ("args.yml", "first_args.yml"):
        assert str(tmp_path) not in (last.settings / settings).read_text(), "another machine has other paths"
    (first.settings / "args.yml").unlink()
    with pytest.raises(ValueError, match="trained on from"):
        ship(run.folder, folder=tmp_path / "elsewhere")


def test_a_folder_that_is_no_agent_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"args\.yml"):
        Agent(tmp_path / "uspl_ppo" / "LateralChoice-v0_1")


def test_the_table_has_a_row_for_each_agent_in_order(tmp_path):
    write_agent(tmp_path, env="SquareMaze-v0")
    write_agent(tmp_path, algo="rma")
    write_agent(tmp_path)
    rows = table(agents(tmp_path)).splitlines()[2:]
    assert [("SquareMaze" in row, "RMA" in row) for row in rows] == [(False, False), (False, True), (True, False)]
    assert all(row.count("|") == 7 and "98.0 % (95.0-99.2)" in row for row in rows)


def test_the_table_takes_its_place_and_nothing_else():
    text = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    new = with_table(text, "| new |")
    assert new == f"before\n{BEGIN}\n| new |\n{END}\nafter\n" and with_table(new, "| new |") == new
    with pytest.raises(ValueError, match="agents: begin"):
        with_table("no place", "| new |")


def test_the_projects_readme_has_the_table_of_the_shipped_agents():
    found = agents()
    assert found and {agent.folder.parents[1] for agent in found} == {TRAINED_AGENTS}
    text = (ROOT / "README.md").read_text()
    assert with_table(text, table(found)) == text, "run: python -m sb3_uspl.model_card --readme"


@pytest.mark.parametrize("agent", [agent for agent in agents() if agent.evaluation()], ids=lambda agent: agent.env)
def test_cards_of_shipped_agents_are_up_to_date(agent):
    assert (agent.folder / "README.md").read_text() == card(agent), f"run: python -m sb3_uspl.model_card {Path(agent.folder)}"
