"""Our algorithms and environments in RL Baselines3 Zoo. For the command lines only: importing the zoo patches Gymnasium."""

import os
import sys
from pathlib import Path

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
from sb3_uspl import RMA, USPLPPO, RESeLPPO

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "zoo_configs"
TRAINED_AGENTS = ROOT / "trained_agents"
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"uspl_ppo": USPLPPO, "rma": RMA, "resel_ppo": RESeLPPO}

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

    def _on_training_start(self) -> None:
        self.logger.output_formats.append(CSVOutputFormat(self.path))

    def _on_step(self) -> bool:
        return True


class ExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """The zoo's, with shared-memory workers, evaluation seeds of its own and metrics in ``progress.csv``."""

    default_vec_env_cls = BulletVecEnv

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        seed = self.seed
        self.seed = seed + EVALUATION_OFFSET if eval_env else seed
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.seed = seed

    def create_callbacks(self) -> None:
        super().create_callbacks()
        self.callbacks.append(ProgressCSV(os.path.join(self.save_path, "progress.csv")))


def register() -> None:
    """Make our algorithms (``--algo uspl_ppo``, ``rma``, ``resel_ppo``) and environments known to the zoo's commands."""
    rl_zoo3.ALGOS.update(ALGORITHMS)
    rl_zoo3.train.ExperimentManager = ExperimentManager  # type: ignore[misc]


def use_default_config() -> None:
    """Add ``-conf zoo_configs/<algo>.yml`` to the command line unless it names a configuration."""
    argv = sys.argv
    if {"-conf", "--conf-file"} & set(argv) or "--algo" not in argv[:-1]:
        return
    config = CONFIGS / f"{argv[argv.index('--algo') + 1]}.yml"
    if config.is_file():
        sys.argv += ["-conf", str(config)]
