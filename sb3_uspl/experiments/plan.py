"""What has to be trained for a table or a figure: a grid of cells, each with its complete configuration."""

import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import yaml

from sb3_uspl._configs import CONFIGS, load_entries

ALL = "all"
PRIVILEGED_SUFFIX = "-p"
"""A column "rma-p" shows the privileged policies of the cells of "rma"."""
AVERAGE = "average"
HASH_LENGTH = 8


@dataclass(frozen=True)
class Variant:
    """
    A training recipe.

    :param name: in ``experiments.yml``
    :param label: in tables and pictures
    :param algo: zoo name of the algorithm
    :param file: hyperparameters by environment, in ``zoo_configs/``
    :param override: goes over them
    """

    name: str
    label: str
    algo: str
    file: str
    override: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """
    A table or a figure.

    :param name: "table1", ...
    :param title: what it shows
    :param kind: how it is shown, see ``tables`` and ``figures``
    :param columns: variants, with ``PRIVILEGED_SUFFIX`` for their privileged policies
    :param envs: environments
    :param average: whether the table has a row of averages
    :param paper: the paper's numbers by environment and column
    """

    name: str
    title: str
    kind: str
    columns: list[str]
    envs: list[str]
    average: bool = False
    paper: dict[str, dict[str, str | float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Budget:
    """
    How much of everything.

    :param name: "smoke", "cpu" or "paper"
    :param episodes: of the final evaluation, of each policy
    :param evaluations: during the training
    :param evaluation_episodes: of each evaluation during the training
    :param timesteps: decisions of a training by environment; without an entry there or under "all": as in ``zoo_configs/``
    :param override: hyperparameters by algorithm, "all" under the others
    :param env_override: the same by environment, on top
    :param env_kwargs: by environment, for training and evaluation
    """

    name: str
    episodes: int
    evaluations: int
    evaluation_episodes: int
    timesteps: dict[str, float] = field(default_factory=dict)
    override: dict[str, dict[str, Any]] = field(default_factory=dict)
    env_override: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    env_kwargs: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """
    One training and its evaluation.

    :param variant: name
    :param algo: zoo name
    :param env: environment
    :param seed: of the training
    :param budget: name
    :param hyperparameters: the whole entry for the zoo, ``n_timesteps`` among them
    :param env_kwargs: of the evaluation
    :param episodes: of the final evaluation
    :param evaluations: during the training
    :param evaluation_episodes: of each of them
    """

    variant: str
    algo: str
    env: str
    seed: int
    budget: str
    hyperparameters: dict[str, Any]
    env_kwargs: dict[str, Any]
    episodes: int
    evaluations: int
    evaluation_episodes: int

    @property
    def timesteps(self) -> int:
        """Decisions of the training."""
        return int(self.hyperparameters["n_timesteps"])

    @property
    def configuration(self) -> str:
        """Hash of all that the trained model depends on but seed and code."""
        what = [self.algo, self.env, self.hyperparameters, self.env_kwargs]
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:HASH_LENGTH]

    @property
    def name(self) -> str:
        """Unique within a budget; another configuration has another name, so that no result is taken for another's."""
        return f"{self.variant}__{self.env}__seed{self.seed}__{self.configuration}"

    def to_json(self) -> dict[str, Any]:
        """:return: fields, ready for JSON"""
        return asdict(self)


class Plan:
    """``experiments.yml``, checked. Raises ValueError for what does not fit together."""

    def __init__(self) -> None:
        path = CONFIGS / "experiments.yml"
        data = yaml.safe_load(path.read_text())
        self.variants = {name: Variant(name, **given) for name, given in data["variants"].items()}
        self.budgets = {name: Budget(name, **given) for name, given in data["budgets"].items()}
        self.experiments = {name: Experiment(name, **given) for name, given in data["experiments"].items()}
        self._entries = functools.cache(lambda file: load_entries(CONFIGS / file))
        for experiment in self.experiments.values():
            unknown = [column for column in experiment.columns if variant_of(column) not in self.variants]
            if unknown:
                raise ValueError(f"{path}: {experiment.name} has the columns {unknown}, which are no variants.")

    def label(self, column: str) -> str:
        """
        :param column: of an experiment
        :return: its heading
        """
        label = self.variants[variant_of(column)].label
        return label + PRIVILEGED_SUFFIX if column.endswith(PRIVILEGED_SUFFIX) else label

    def cells(self, experiment: Experiment, envs: Sequence[str], seeds: Sequence[int], budget: Budget) -> list[Cell]:
        """
        :param experiment: table or figure
        :param envs: environments
        :param seeds: of the trainings
        :param budget: how much of everything
        :return: in the order in which they should run: every variant once before any has a second seed
        """
        variants = dict.fromkeys(variant_of(column) for column in experiment.columns)
        return [self.cell(name, env, seed, budget) for seed in seeds for env in envs for name in variants]

    def cell(self, name: str, env: str, seed: int, budget: Budget) -> Cell:
        """
        :param name: of the variant
        :param env: environment
        :param seed: of the training
        :param budget: how much of everything
        :return: cell
        :raises ValueError: if the variant has no hyperparameters for that environment
        """
        variant = self.variants[name]
        entries = self._entries(variant.file)
        entry = entries.get(env, entries.get("default"))
        if entry is None:
            raise ValueError(f"{variant.file} has no entry for {env} and no default, only {sorted(entries)}.")
        overrides = [budget.override, budget.env_override.get(env, {})]
        budgeted = [given.get(key, {}) for given in overrides for key in (ALL, variant.algo)]
        hyperparameters = dict(entry)
        for given in (*budgeted, variant.override):
            hyperparameters |= given
        timesteps = budget.timesteps.get(env, budget.timesteps.get(ALL, entry["n_timesteps"]))
        hyperparameters["n_timesteps"] = int(timesteps)
        env_kwargs = budget.env_kwargs.get(env, {})
        if env_kwargs:
            hyperparameters["env_kwargs"] = env_kwargs
        return Cell(
            name,
            variant.algo,
            env,
            seed,
            budget.name,
            hyperparameters,
            env_kwargs,
            budget.episodes,
            budget.evaluations,
            budget.evaluation_episodes,
        )


def variant_of(column: str) -> str:
    """
    :param column: of an experiment
    :return: name of the variant whose cells it shows
    """
    return column.removesuffix(PRIVILEGED_SUFFIX)
