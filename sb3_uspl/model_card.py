"""
``python -m sb3_uspl.model_card <folder>``: evaluates a trained agent and writes its model card; the table of all agents.

An agent's folder is the zoo's: ``<algo>/<env>_<n>/`` with ``<env>.zip``, ``<env>/args.yml``, ``<env>/config.yml`` and
``progress.csv``. Beside them this writes ``evaluation.json`` and ``README.md``; what ``notes.md`` says is taken into the card.
An agent that was trained on (``-i``) is shipped with the command line of the training before, ``<env>/first_args.yml``, and
with the progress of both.
"""

import argparse
import contextlib
import hashlib
import itertools
import json
import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from sb3_uspl._configs import CONFIGS

ROOT = Path(__file__).resolve().parents[1]
TRAINED_AGENTS = ROOT / "trained_agents"
EPISODES = 500
EVALUATION, CARD, NOTES, PROGRESS = "evaluation.json", "README.md", "notes.md", "progress.csv"
ARGUMENTS, FIRST_ARGUMENTS = "args.yml", "first_args.yml"
BEGIN, END = "<!-- agents: begin -->", "<!-- agents: end -->"
"""Between these lines of the project's README lies the table."""

_NAMES = {"uspl_ppo": "USPL", "rma": "RMA", "rewreg": "RewReg", "privrecons": "PrivRecons", "resel_ppo": "RESeL-PPO"}
_COMMAND_OPTIONS = {
    "n_timesteps": ("-n", -1),
    "eval_freq": ("--eval-freq", 25000),
    "eval_episodes": ("--eval-episodes", 5),
    "n_eval_envs": ("--n-eval-envs", 1),
}
"""Of the training command: the zoo's name of an argument, its option and its default."""


@dataclass(frozen=True)
class Agent:
    """
    A trained agent in the zoo's layout.

    :param folder: ``<algo>/<env>_<n>/``
    :raises ValueError: if it does not hold what a training leaves there
    """

    folder: Path

    def __post_init__(self) -> None:
        missing = [
            path for path in (self.model, self.settings / ARGUMENTS, self.settings / "config.yml") if not path.is_file()
        ]
        if missing:
            names = ", ".join(str(path.relative_to(self.folder)) for path in missing)
            raise ValueError(f"{self.folder} has no {names}; expected the folder <algo>/<env>_<n>/ of a training by the zoo.")

    @property
    def algo(self) -> str:
        """Zoo name of the algorithm."""
        return self.folder.resolve().parent.name

    @property
    def env(self) -> str:
        """Environment."""
        return self.folder.resolve().name.rpartition("_")[0]

    @property
    def number(self) -> int:
        """Experiment number."""
        return int(self.folder.resolve().name.rpartition("_")[2])

    @property
    def model(self) -> Path:
        """The last model of the training."""
        return self.folder / f"{self.env}.zip"

    @property
    def settings(self) -> Path:
        """Folder of ``args.yml`` and ``config.yml``."""
        return self.folder / self.env

    @property
    def digest(self) -> str:
        """SHA-256 of the model."""
        return hashlib.sha256(self.model.read_bytes()).hexdigest()

    def arguments(self) -> dict[str, Any]:
        """:return: command line of the training"""
        return _read_settings(self.settings / ARGUMENTS)

    def hyperparameters(self) -> dict[str, Any]:
        """:return: of the training"""
        return _read_settings(self.settings / "config.yml")

    def evaluation(self) -> dict[str, Any] | None:
        """:return: what :func:`measure` wrote for this model; None if there is none, or it is another model's"""
        path = self.folder / EVALUATION
        result = json.loads(path.read_text()) if path.is_file() else {}
        return result if result.get("model_sha256") == self.digest else None

    def training(self) -> tuple[int | None, float | None]:
        """:return: decisions and wall time (s) of the training, as ``progress.csv`` has them"""
        path = self.folder / PROGRESS
        if not path.is_file():
            return None, None
        frame = pd.read_csv(path)
        values = [frame[name].dropna() if name in frame else [] for name in ("time/total_timesteps", "time/time_elapsed")]
        decisions, seconds = (max(column) if len(column) else None for column in values)
        return (None if decisions is None else int(decisions)), (None if seconds is None else float(seconds))

    def commands(self) -> list[str]:
        """:return: what trained it: one command, or two if it was trained on"""
        given = self.arguments()
        first = self.settings / FIRST_ARGUMENTS
        if not given.get("trained_agent") or not first.is_file():
            return [self._command(given)]
        return [
            self._command(_read_settings(first)),
            self._command(given, f"-i {shlex.quote(self.in_logs(given['trained_agent']))}"),
        ]

    def in_logs(self, model: str) -> str:
        """
        :param model: of an earlier training in this environment, somewhere
        :return: where the README's commands leave it
        """
        return f"logs/{self.algo}/{self.env}_1/{Path(model).name}"

    def _command(self, given: dict[str, Any], *more: str) -> str:
        parts = ["python -m sb3_uspl.train", "--algo", self.algo, "--env", self.env, "--seed", str(given.get("seed")), *more]
        for name, (option, default) in _COMMAND_OPTIONS.items():
            if given.get(name, default) != default:
                parts += [option, str(given[name])]
        for name, option in (("env_kwargs", "--env-kwargs"), ("hyperparams", "-params")):
            if given.get(name):
                parts += [option, *(shlex.quote(f"{key}:{value!r}") for key, value in given[name].items())]
        return " ".join(parts)


def _read_settings(path: Path) -> dict[str, Any]:
    """The zoo writes OrderedDicts, which YAML's safe loader does not know."""
    return dict(yaml.unsafe_load(path.read_text()))


def agents(folder: Path = TRAINED_AGENTS) -> list[Agent]:
    """
    :param folder: log folder
    :return: the agents in it, by environment and algorithm
    """
    found = (Agent(path.parent.parent) for path in folder.glob(f"*/*_*/*/{ARGUMENTS}"))
    return sorted(
        found, key=lambda agent: (agent.env, list(_NAMES).index(agent.algo) if agent.algo in _NAMES else 99, agent.number)
    )


def ship(run: Path, best: bool = False, folder: Path = TRAINED_AGENTS) -> Agent:
    """
    Copy what an agent needs from a training's logs, over what is there.

    :param run: ``<log folder>/<algo>/<env>_<n>/``
    :param best: the best model of the training's evaluations instead of the last one
    :param folder: where to
    :return: the agent
    :raises ValueError: if the run does not hold what a training leaves there
    """
    given = Agent(run)
    model = run / "best_model.zip" if best else given.model
    if not model.is_file():
        raise ValueError(f"{run} has no {model.name}; was it trained with --eval-freq?")
    target = folder / given.algo / f"{given.env}_1"
    (target / given.env).mkdir(parents=True, exist_ok=True)
    _ship_history(given, target)
    shutil.copy(model, target / given.model.name)
    _ship_arguments(given, given.settings / ARGUMENTS, target / given.env / ARGUMENTS)
    for path in (given.settings / "config.yml", given.settings / "vecnormalize.pkl"):
        if path.is_file():
            shutil.copy(path, target / given.env / path.name)
    return Agent(target)


def _ship_arguments(run: Agent, source: Path, target: Path) -> None:
    """A command line, with the README's paths instead of those of the machine that it was run on."""
    arguments = yaml.unsafe_load(source.read_text())
    arguments["log_folder"] = "logs"
    if arguments.get("conf_file"):
        arguments["conf_file"] = f"{CONFIGS.name}/{Path(arguments['conf_file']).name}"
    if arguments.get("trained_agent"):
        arguments["trained_agent"] = run.in_logs(arguments["trained_agent"])
    target.write_text(yaml.dump(arguments))


def _ship_history(run: Agent, target: Path) -> None:
    """The progress of a training, and of the one that it went on from; the latter's folder may be ``target`` itself."""
    history = [run.folder / PROGRESS]
    (target / run.env / FIRST_ARGUMENTS).unlink(missing_ok=True)
    if run.arguments().get("trained_agent"):
        first = Path(run.arguments()["trained_agent"]).parent
        if not (first / run.env / ARGUMENTS).is_file():
            raise ValueError(f"{run.folder} was trained on from {first}, where there is no {run.env}/{ARGUMENTS}.")
        _ship_arguments(run, first / run.env / ARGUMENTS, target / run.env / FIRST_ARGUMENTS)
        history.insert(0, first / PROGRESS)
    frames = [pd.read_csv(path) for path in history if path.is_file()]
    for before, after in itertools.pairwise(frames):
        after["time/time_elapsed"] += before["time/time_elapsed"].max()
    if frames:
        pd.concat(frames).to_csv(target / PROGRESS, index=False)


def measure(agent: Agent, episodes: int = EPISODES) -> dict[str, Any]:
    """
    Evaluate both policies and write ``evaluation.json``.

    :param agent: to evaluate
    :param episodes: of each policy
    :return: what was written
    :raises ValueError: if the agent cannot be loaded
    """
    import torch as th

    import sb3_uspl
    from sb3_uspl._zoo import register
    from sb3_uspl.evaluate import load_agent
    from sb3_uspl.evaluation import evaluate
    from sb3_uspl.experiments.provenance import commit

    register()
    th.set_num_threads(1)
    with contextlib.redirect_stdout(sys.stderr):  # the zoo prints too
        folder = str(agent.folder.resolve().parents[1])
        model, venv = load_agent(agent.algo, agent.env, folder, agent.number, n_envs=min(32, episodes))
        try:
            period = venv.get_attr("decision_period", [0])[0] if venv.has_attr("decision_period") else None
            result = evaluate(model, venv, episodes)
        finally:
            venv.close()
    curves = [name for name in result if name.endswith("_over_time")]
    kept = {name: value for name, value in result.items() if name not in curves}
    made_by = {"version": sb3_uspl.__version__, "commit": commit(), "model_sha256": agent.digest}
    kept = {"algo": agent.algo, "env": agent.env, "decision_period": period, **kept, **made_by}
    (agent.folder / EVALUATION).write_text(json.dumps(kept, indent=2) + "\n")
    return kept


def card(agent: Agent) -> str:
    """
    :param agent: evaluated
    :return: its model card, Markdown
    :raises ValueError: if this model has not been evaluated
    """
    result = agent.evaluation()
    if result is None:
        raise ValueError(f"{agent.folder} has no {EVALUATION} of this model: python -m sb3_uspl.model_card {agent.folder}")
    hyperparameters = agent.hyperparameters()
    decisions, seconds = agent.training()
    physics = (hyperparameters.get("env_kwargs") or {}).get("physics")
    episodes, period = result["episodes"], result["decision_period"]
    where = f"`{agent.env}`" + (
        f', trained with `physics="{physics}"`, evaluated with the environment\'s default' if physics else ""
    )
    time = f", {result['mean_length'] * period:.1f} s" if period else ""
    rows = [
        ("environment", where),
        ("algorithm", f"{_NAMES.get(agent.algo, agent.algo)} (`{agent.algo}`), seed {agent.arguments().get('seed')}"),
        ("training", f"{_decisions(decisions)} decisions, {_clock(seconds)} of wall time, evaluations included"),
        (
            "deployment policy",
            f"{_success(result, '')} of {episodes} episodes; {result['mean_length']:.1f} decisions{time} on average",
        ),
        ("privileged policy", f"{_success(result, 'privileged_')} of the same episodes"),
    ]
    if result.get("divergence_mean") is not None:
        rows.append(("distance between the two policies' robots", f"{result['divergence_mean']:.2f}, mean over time"))
    if result.get("prediction_error_final") is not None:
        rows.append(("prediction error at the end", f"{result['prediction_error_final']:.3f} privileged units"))
    rows += [
        ("made by", ", then ".join(f"`{command}`" for command in agent.commands())),
        ("check it", f"`python -m sb3_uspl.evaluate --algo {agent.algo} --env {agent.env}`"),
        ("watch it", f"`python -m sb3_uspl.record_video --algo {agent.algo} --env {agent.env} --film film.mp4`"),
    ]
    notes = agent.folder / NOTES
    return "\n".join(
        [
            f"# {_NAMES.get(agent.algo, agent.algo)} on {agent.env}",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {text} |" for name, text in rows),
            "",
            f"Success with 95 % Wilson intervals over episodes of seeds from {result['seed']:,} on, which no training uses; "
            "deterministic actions, every started episode counted, time-outs as failures.",
            "",
            *([notes.read_text().strip(), ""] if notes.is_file() else []),
            "## Hyperparameters",
            "",
            "As in `config.yml`; what is not listed is the algorithm's default.",
            "",
            "```yaml",
            *(f"{name}: {value}" for name, value in sorted(hyperparameters.items())),
            "```",
            "",
            "*Written by `python -m sb3_uspl.model_card`; text of your own belongs into `notes.md`.*",
            "",
        ]
    )


def table(found: list[Agent]) -> str:
    """
    :param found: agents
    :return: one row each, Markdown
    """
    lines = [
        "| environment | algorithm, seed | deployment policy | privileged policy | decisions | wall time |",
        "|---|---|---|---|---|---|",
    ]
    for agent in found:
        result = agent.evaluation()
        rates = [_success(result, prefix) if result else "not evaluated" for prefix in ("", "privileged_")]
        decisions, seconds = agent.training()
        name = f"{_NAMES.get(agent.algo, agent.algo)}, {agent.arguments().get('seed')}"
        numbers = (_decisions(decisions), _clock(seconds))
        link = f"[`{agent.env}`](trained_agents/{agent.algo}/{agent.env}_{agent.number}/README.md)"
        lines.append("| " + " | ".join((link, name, *rates, *numbers)) + " |")
    return "\n".join(lines)


def with_table(text: str, rows: str) -> str:
    """
    :param text: of the project's README
    :param rows: what :func:`table` returned
    :return: the README with that table in the place of its own
    :raises ValueError: if the README has no place for it
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(END) < text.index(BEGIN):
        raise ValueError(
            f"The README must have one line '{BEGIN}' and after it one line '{END}', between which the table lies."
        )
    return f"{text[: text.index(BEGIN)]}{BEGIN}\n{rows}\n{text[text.index(END) :]}"


def _success(result: dict[str, Any], prefix: str) -> str:
    rate, interval = result[f"{prefix}success_rate"], result[f"{prefix}success_interval"]
    return "none" if rate is None else f"{100 * rate:.1f} % ({100 * interval[0]:.1f}-{100 * interval[1]:.1f})"


def _decisions(number: int | None) -> str:
    return "?" if number is None else f"{number / 1e6:.2f} M"


def _clock(seconds: float | None) -> str:
    return "?" if seconds is None else f"{int(seconds) // 60}:{int(seconds) % 60:02} min"


def parse_arguments() -> argparse.Namespace:
    """:return: command line"""
    parser = argparse.ArgumentParser(prog="python -m sb3_uspl.model_card", description="Evaluate an agent, write its card.")
    parser.add_argument("folder", nargs="*", type=Path, help="of a training, <log folder>/<algo>/<env>_<n>")
    parser.add_argument("--ship", action="store_true", help="first copy the agent into trained_agents/")
    parser.add_argument("--best", action="store_true", help="with --ship: the best model of the training's evaluations")
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, help="of each policy; evaluated before with as many: not again"
    )
    parser.add_argument("--table", action="store_true", help="print the table of the agents in trained_agents/")
    parser.add_argument("--readme", action="store_true", help="write that table into README.md")
    arguments = parser.parse_args()
    if not arguments.folder and not arguments.table and not arguments.readme:
        parser.error("name the folder of an agent, or give --table or --readme")
    if arguments.episodes < 1:
        parser.error(f"--episodes {arguments.episodes}: at least one is needed")
    return arguments


def main() -> None:
    """Do what the command line says."""
    arguments = parse_arguments()
    try:
        for folder in arguments.folder:
            agent = ship(folder, arguments.best) if arguments.ship else Agent(folder)
            known = agent.evaluation()
            if known is None or known["episodes"] != arguments.episodes:
                measure(agent, arguments.episodes)
            (agent.folder / CARD).write_text(card(agent))
            print(agent.folder / CARD)
        if arguments.readme:
            readme = ROOT / "README.md"
            readme.write_text(with_table(readme.read_text(), table(agents())))
        if arguments.table:
            print(table(agents()))
    except ValueError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
