"""Our algorithms and environments in RL Baselines3 Zoo. For the command lines only: importing the zoo patches Gymnasium."""

import difflib
import functools
import importlib
import importlib.util
import itertools
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import yaml

try:
    import rl_zoo3
    import rl_zoo3.exp_manager
    import rl_zoo3.train
except ImportError as error:  # pragma: no cover
    raise SystemExit(f'{error}. The command lines need the zoo: pip install -e ".[zoo]"') from error
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat
from stable_baselines3.common.vec_env import VecEnv

import bullet_tasks as bullet_tasks  # registers the environments
from bullet_tasks.vec_env import BulletVecEnv
from sb3_uspl import RMA, USPLPPO, PrivRecons, RESeLPPO, RewReg
from sb3_uspl._agents import LOADING_ERRORS, why_not_loaded
from sb3_uspl._configs import CONFIGS, load_entries
from sb3_uspl._optimize import register_samplers

ROOT = Path(__file__).resolve().parents[1]
TRAINED_AGENTS = ROOT / "trained_agents"
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "uspl_ppo": USPLPPO,
    "rma": RMA,
    "rewreg": RewReg,
    "privrecons": PrivRecons,
    "resel_ppo": RESeLPPO,
}

_PACKAGES = ("bullet_tasks", "sb3_uspl")

EVALUATION_OFFSET = 500_000
"""The zoo seeds training and evaluation environments alike; ours are evaluated on other seeds than they are trained on."""


class ProgressCSV(BaseCallback):
    """
    Writes every logged metric to a CSV file beside the model, for learning curves.

    :param path: file to write
    """

    def __init__(self, path: str):
        super().__init__()
        self.path = path
        self._file: CSVOutputFormat | None = None

    def _on_training_start(self) -> None:
        self._file = CSVOutputFormat(self.path)
        self.logger.output_formats.append(self._file)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        # The zoo ends its first callback's training once more, even one that never started.
        if self._file is not None:
            self.logger.output_formats.remove(self._file)
            self._file.close()
            self._file = None


class ExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """
    The zoo's, with shared-memory workers, evaluation seeds of its own, metrics in ``progress.csv`` and files that inherit.

    A training that is continued (``-i``) goes on counting, and its schedules go on: ``-n`` says how many decisions more.
    """

    default_vec_env_cls = BulletVecEnv

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        if is_ours(self.env_name.gym_id):
            self.monitor_kwargs.setdefault("info_keywords", ("is_success",))  # for plot_train -y success
        seed = self.seed
        self.seed = seed + EVALUATION_OFFSET if eval_env else seed
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.seed = seed

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if not self.config.endswith((".yml", ".yaml")):
            return super().read_hyperparameters()
        print(f"Loading hyperparameters from: {self.config}")
        given = self.config
        try:
            entries = load_entries(Path(given))
        except ValueError as error:
            raise SystemExit(str(error)) from error
        with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
            yaml.safe_dump(entries, file)
            file.flush()
            try:
                self.config = file.name
                return super().read_hyperparameters()
            except ValueError as error:
                raise SystemExit(f"{given}: {str(error).replace(file.name, given)}") from error
            finally:
                self.config = given

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        # The zoo would make a constant schedule of a number, of which our algorithms make a cosine (learning_rate_floor).
        rate = hyperparams.get("learning_rate")
        hyperparams = rl_zoo3.exp_manager.ExperimentManager._preprocess_schedules(hyperparams)
        return {**hyperparams, "learning_rate": rate} if isinstance(rate, int | float) else hyperparams

    def learn(self, model: BaseAlgorithm) -> None:
        if not self.continue_training:
            super().learn(model)
            return
        # From zero again, blurring and reward transformation would start over with a warm-up, on a policy that is past it.
        learn = functools.partial(model.learn, reset_num_timesteps=False)
        super().learn(SimpleNamespace(learn=learn, env=model.env, policy=model.policy))  # type: ignore[arg-type]

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        try:
            return super()._load_pretrained_agent(hyperparams, env)
        except LOADING_ERRORS as error:
            env.close()
            raise SystemExit(why_not_loaded(self.algo, self.trained_agent, error)) from error

    def create_callbacks(self) -> None:
        super().create_callbacks()
        self.callbacks.append(ProgressCSV(os.path.join(self.save_path, "progress.csv")))


def register(packages: Iterable[str] = ()) -> None:
    """
    Make our algorithms (``--algo uspl_ppo``, ``rma``, ...) and environments known to the zoo's commands.

    :param packages: modules that register further environments when they are imported (``--gym-packages``)
    """
    for package in packages:
        importlib.import_module(package)
    rl_zoo3.ALGOS.update(ALGORITHMS)
    register_samplers()
    rl_zoo3.train.ExperimentManager = ExperimentManager  # type: ignore[misc]


def is_ours(env_id: str) -> bool:
    """
    :param env_id: name of a registered environment
    :return: whether it belongs to this project, so that its ``info`` has ``is_success``
    """
    return str(gym.registry[env_id].entry_point).startswith(_PACKAGES)


def check_names(algo: str, env_id: str) -> None:
    """
    :param algo: zoo name of an algorithm
    :param env_id: name of an environment
    :raises ValueError: if either is unknown, with those that exist
    """
    if algo not in rl_zoo3.ALGOS:
        stock = sorted(set(rl_zoo3.ALGOS) - set(ALGORITHMS))
        raise ValueError(f"There is no algorithm '{algo}'. Ours: {sorted(ALGORITHMS)}; the zoo's: {stock}.")
    if env_id not in gym.registry:
        ours = sorted(filter(is_ours, gym.registry))
        close = difflib.get_close_matches(env_id, gym.registry, n=1)
        raise ValueError(
            f"There is no environment '{env_id}'{f' (did you mean {close[0]}?)' if close else ''}. Ours: {ours}. One of your "
            "own is known after the module that registers it is imported: --gym-packages <module>, where the command has it."
        )


def _value_of(*names: str) -> str | None:
    """What an option on the command line says, "--option value" or "--option=value"; the last one counts, as in argparse."""
    value = None
    for argument, following in itertools.pairwise([*sys.argv[1:], ""]):
        name, equals, text = argument.partition("=")
        if name in names:
            value = text if equals else following
    return value


def check_command_line() -> None:
    """
    Have the command line say ``--algo uspl_ppo``, unless it names an algorithm, and end with a message, rather than with the
    zoo's traceback, if its environment is unknown, the model that is to be trained on is missing, or the tracker is not
    installed.
    """
    _put_first("--algo", "uspl_ppo")
    for package in _packages():
        importlib.import_module(package)
    env_id = _value_of("--env")
    if env_id:
        try:
            check_names("ppo", env_id)
        except ValueError as error:
            raise SystemExit(str(error)) from error
    model = _value_of("-i", "--trained-agent")
    if model and not (model.endswith(".zip") and os.path.isfile(model)):
        raise SystemExit(f"-i {model}: there is no such model; expected the .zip file that a training or model.save() wrote.")
    if "--track" in sys.argv and not _is_installed("wandb"):
        raise SystemExit('--track needs Weights & Biases, which the extra brings: pip install -e ".[track]", or wandb itself.')


def _is_installed(package: str) -> bool:
    spec = importlib.util.find_spec(package)
    # A folder that merely has the package's name, such as the one in which W&B stores its runs, has no file of its own.
    return spec is not None and spec.origin is not None


def _after(name: str) -> list[str]:
    return sys.argv[sys.argv.index(name) + 1 :] if name in sys.argv else []


def _packages() -> list[str]:
    return list(itertools.takewhile(lambda name: not name.startswith("-"), _after("--gym-packages")))


def drop_packages() -> None:
    """Take ``--gym-packages``, which the zoo's recorder does not know, off the command line when they have been imported."""
    if "--gym-packages" in sys.argv:
        first = sys.argv.index("--gym-packages")
        del sys.argv[first : first + 1 + len(_packages())]


def use_default_folder() -> None:
    """Have the command line say ``-f trained_agents``, unless it names a folder."""
    _put_first("-f", str(TRAINED_AGENTS))


def use_default_config() -> None:
    """Have the command line say ``-conf zoo_configs/<algo>.yml``, unless it names a configuration."""
    config = CONFIGS / f"{_value_of('--algo')}.yml"
    if config.is_file():
        _put_first("-conf", str(config))


def _put_first(*option: str) -> None:
    # What comes later counts, however it is abbreviated.
    sys.argv[1:1] = option
