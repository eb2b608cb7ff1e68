"""The plan of the experiments: every cell has the hyperparameters that it should have, and a name of its own."""

import inspect
import math

import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from sb3_uspl import RMA, USPLPPO, PrivRecons, RESeLPPO, RewReg
from sb3_uspl._configs import CONFIGS, load_entries
from sb3_uspl.experiments.plan import Plan, variant_of
from sb3_uspl.policies import USPLPolicy

ALGORITHMS = {
    "uspl_ppo": USPLPPO,
    "rma": RMA,
    "rewreg": RewReg,
    "privrecons": PrivRecons,
    "resel_ppo": RESeLPPO,
    "ppo": PPO,
    "ppo_lstm": RecurrentPPO,
}
ZOO_KEYS = {"n_envs", "n_timesteps", "normalize", "env_wrapper", "frame_stack", "callback", "env_kwargs", "monitor_kwargs"}


@pytest.fixture(scope="module")
def plan():
    return Plan()


def all_cells(plan):
    for experiment in plan.experiments.values():
        for budget in plan.budgets.values():
            yield from plan.cells(experiment, experiment.envs, (1, 2), budget)


def test_every_cell_is_accepted_by_its_algorithm(plan):
    known = {name: set(inspect.signature(cls).parameters) for name, cls in ALGORITHMS.items()}
    for name in ("rma", "rewreg", "privrecons"):
        known[name] |= known["uspl_ppo"]
    known["resel_ppo"] |= known["ppo"]
    n = 0
    for cell in all_cells(plan):
        wrong = set(cell.hyperparameters) - ZOO_KEYS - known[cell.algo]
        assert not wrong, (cell.name, wrong)
        if cell.algo == "resel_ppo":
            assert cell.hyperparameters["batch_size"] % cell.hyperparameters["n_steps"] == 0, cell.name
        n += 1
    assert n > 500


def test_different_trainings_have_different_names(plan):
    seen = {}
    for cell in all_cells(plan):
        key = (cell.budget, cell.name)
        assert seen.setdefault(key, cell) == cell
    same_seed = [
        cell
        for cell in all_cells(plan)
        if (cell.seed, cell.env, cell.budget, cell.algo) == (1, "SignpostNav-v0", "cpu", "uspl_ppo")
    ]
    by_variant = {cell.variant: cell.configuration for cell in same_seed}
    assert len(by_variant) > 10 and len(set(by_variant.values())) == len(by_variant)


def test_an_ablation_changes_what_it_says_and_nothing_else(plan):
    budget = plan.budgets["cpu"]
    for env in ("LateralChoice-v0", "SignpostNav-v0"):
        base = plan.cell("uspl", env, 1, budget).hyperparameters
        for name, changed in (
            ("without_blur", {"blur": False}),
            ("without_rew", {"reward_scaling": False}),
            ("without_ui", {"uncertainty_input": False}),
            ("mean_not_ui", {"uncertainty_input": False, "mean_input": True}),
            ("only_ui", {"blur": False, "reward_scaling": False}),
            ("k_2.5", {"blur_gain": 2.5}),
        ):
            assert plan.cell(name, env, 1, budget).hyperparameters == {**base, **changed}


def test_the_baselines_share_uspls_entries(plan):
    for env in ("LateralChoice-v0", "TargetReaching-v0", "SignpostNav-v0"):
        entries = [
            plan.cell(name, env, 1, plan.budgets["cpu"]).hyperparameters for name in ("uspl", "rma", "rewreg", "privrecons")
        ]
        assert all(entry == entries[0] for entry in entries)


REFERENCES = ("resel_ppo", "recurrent_ppo", "frame_stacked_ppo")


@pytest.mark.parametrize("name", REFERENCES)
def test_those_without_a_privileged_policy_share_uspls_experience_and_discount(plan, name):
    shared = ("env_kwargs", "n_steps", "n_epochs", "gamma", "gae_lambda", "learning_rate", "ent_coef", "n_timesteps")
    for env in [env for name in ("table1", "table9", "figure5") for env in plan.experiments[name].envs]:
        ours, uspl = (plan.cell(each, env, 1, plan.budgets["cpu"]).hyperparameters for each in (name, "uspl"))
        if name == "resel_ppo" and env.startswith("SignpostNav"):
            ours = {**ours, "env_kwargs": {**ours["env_kwargs"], "max_episode_steps": 240}}  # episodes of its own
        for key in shared if name != "resel_ppo" else (*shared, "action_std", "action_std_floor"):
            assert ours.get(key) == uspl.get(key), (env, key)
        paper = [plan.cell(each, env, 1, plan.budgets["paper"]).hyperparameters for each in (name, "uspl")]
        for key in ("action_std", "action_std_floor", "learning_rate_floor") if name == "resel_ppo" else ():
            assert paper[0][key] == paper[1][key], (env, key)


def test_the_sweep_of_table_11_is_the_papers(plan):
    for env in plan.experiments["table11"].envs:
        cells = [plan.cell(column, env, 1, plan.budgets["cpu"]) for column in plan.experiments["table11"].columns]
        assert [cell.hyperparameters["blur_gain"] for cell in cells] == [1.0, 2.5, 5.0, 10.0, 20.0, 40.0]
        assert plan.cell("uspl", env, 1, plan.budgets["paper"]).hyperparameters["blur_gain"] == 10.0


def test_the_sweep_of_table_10_is_the_papers(plan):
    columns = plan.experiments["table10"].columns
    assert len(columns) == 7
    for column in columns:
        given = {**plan.variants[column].override}
        a, b = (0.2, 0.01) if column == "uspl" else map(float, column.split("_")[1:])
        signature = inspect.signature(USPLPPO).parameters
        assert given.get("c_min", signature["c_min"].default) == pytest.approx(math.log(a), abs=1e-5)
        assert given.get("c_max", signature["c_max"].default) == pytest.approx(math.log(a) - math.log(b), abs=1e-5)


def test_tables_1_and_2_have_the_papers_averages(plan):
    for name in ("table1", "table2"):
        experiment = plan.experiments[name]
        for column, average in experiment.paper["average"].items():
            values = [float(str(experiment.paper[env][column]).split("±")[0]) for env in experiment.envs]
            assert sum(values) / len(values) == pytest.approx(average, abs=0.06)


def test_the_first_seeds_come_first(plan):
    experiment = plan.experiments["table1"]
    cells = plan.cells(experiment, experiment.envs, (3, 4), plan.budgets["cpu"])
    assert [cell.seed for cell in cells] == [3] * (len(cells) // 2) + [4] * (len(cells) // 2)
    assert {cell.variant for cell in cells} == {variant_of(column) for column in experiment.columns}


def test_a_changed_hyperparameter_is_another_cell(plan):
    cell = plan.cell("uspl", "LateralChoice-v0", 1, plan.budgets["cpu"])
    changed = {**cell.hyperparameters, "gamma": 0.5}
    other = type(cell)(**{**cell.to_json(), "hyperparameters": changed})
    again = type(cell)(**cell.to_json())
    assert other.name != cell.name and again.name == cell.name


# -- files that inherit ------------------------------------------------------------------------------------------------------


def test_a_file_inherits(tmp_path):
    (tmp_path / "base.yml").write_text("A: {x: 1, y: 2}\ndefault: {x: 3}\n")
    (tmp_path / "heir.yml").write_text("inherit: base.yml\nevery: {z: 4, x: 5}\nA: {x: 6}\nB: {y: 7}\n")
    assert load_entries(tmp_path / "heir.yml") == {
        "A": {"x": 6, "y": 2, "z": 4},
        "default": {"x": 5, "z": 4},
        "B": {"x": 5, "y": 7, "z": 4},
    }


def test_a_file_keeps_only_what_it_names(tmp_path):
    (tmp_path / "base.yml").write_text("A: {x: 1, y: 2}\nB: {y: 3}\n")
    (tmp_path / "heir.yml").write_text("inherit: base.yml\nkeep: [y]\nevery: {z: 4}\nA: {x: 6}\n")
    assert load_entries(tmp_path / "heir.yml") == {"A": {"x": 6, "y": 2, "z": 4}, "B": {"y": 3, "z": 4}}
    (tmp_path / "heir.yml").write_text("inherit: base.yml\nkeep: [y, w]\n")
    with pytest.raises(ValueError, match=r"keeps \['w'\]"):
        load_entries(tmp_path / "heir.yml")


def test_a_file_elsewhere_inherits_from_the_projects(tmp_path):
    (tmp_path / "heir.yml").write_text("inherit: uspl_ppo.yml\n")
    assert load_entries(tmp_path / "heir.yml") == load_entries(CONFIGS / "uspl_ppo.yml")
    (tmp_path / "uspl_ppo.yml").write_text("A: {x: 1}\n")
    assert load_entries(tmp_path / "heir.yml") == {"A": {"x": 1}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("inherit: missing.yml", "which .*heir.yml inherits from"),
        ("inherit: heir.yml", "inherits from itself"),
        ("[1, 2]", "expected a mapping"),
        ("A: 3", "no mappings of hyperparameters"),
    ],
)
def test_files_that_make_no_sense_are_explained(tmp_path, text, message):
    (tmp_path / "heir.yml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_entries(tmp_path / "heir.yml")


@pytest.mark.parametrize("algo", ["rewreg", "privrecons"])
def test_every_inherited_configuration_is_accepted_by_its_algorithm(algo):
    known = set(inspect.signature(USPLPPO).parameters) | set(inspect.signature(ALGORITHMS[algo]).parameters)
    entries = load_entries(CONFIGS / f"{algo}.yml")
    assert set(entries) == set(load_entries(CONFIGS / "uspl_ppo.yml")) and entries
    for entry in entries.values():
        assert set(entry) - ZOO_KEYS <= known
        kwargs = eval(entry.get("policy_kwargs", "dict()"), {"dict": dict})
        assert set(kwargs) <= set(inspect.signature(USPLPolicy).parameters)
