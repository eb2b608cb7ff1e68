"""What the README and the guides say exists, and the commands and examples in them run."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import bullet_tasks  # noqa: F401
from sb3_uspl import RMA, USPLPPO, PrivRecons, RESeLPPO, RewReg
from tests.sb3_uspl.toy import ToyEnv

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("**/*.md"))]
ALGORITHMS = {"uspl_ppo": USPLPPO, "rma": RMA, "rewreg": RewReg, "privrecons": PrivRecons, "resel_ppo": RESeLPPO}
TINY = {
    "train": "-n 512 --eval-freq 256 --eval-episodes 2 -params n_envs:4 n_steps:64 batch_size:128".split(),
    "evaluate": "--episodes 2 --n-envs 2".split(),
    "plot_train": "-w 1".split(),
}
DRIVER = """
import runpy, shlex, sys
for line in sys.argv[1:]:
    print(line)
    _, _, module, *arguments = shlex.split(line)
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__")
    except SystemExit as end:
        if end.code:
            raise
"""
PREAMBLE = "import my_module\n"
MY_MODULE = """
import gymnasium as gym
import numpy as np

from sb3_uspl import HiddenParameters


class Plain(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (8,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def make(render_mode=None):
    return HiddenParameters(gym.make("Pendulum-v1"), {"m": (0.5, 2.0)}, decision_period=0.05)
"""


def name(page):
    return str(page.relative_to(ROOT))


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.S | re.M)


def commands(page):
    """Without what is behind a hash."""
    lines = (line.split("#")[0].strip() for block in blocks(page, "sh") for line in block.splitlines())
    return [line for line in lines if line]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files(page):
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_pages_are_in_the_table_of_contents():
    listed = set("\n".join(blocks(DOCS / "index.md", r"\{toctree\}")).split())
    made = DOCS / "results"  # by the experiments, and not on the site
    pages = {str(page.relative_to(DOCS).with_suffix("")) for page in DOCS.glob("**/*.md") if made not in page.parents}
    pages -= {"index"}
    assert len(pages) > 10 and pages <= listed


def test_commands_exist():
    found = [command for page in PAGES for command in commands(page)]
    assert len(found) > 10
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for command in found:
        words = command.split()
        if words[0] == "make":
            assert words[1] in targets
        else:
            assert words[:2] == ["python", "-m"], command
            assert (ROOT / (words[2].replace(".", "/") + ".py")).is_file(), command


def test_every_environment_and_algorithm_has_its_place():
    ours = [env for env, spec in gym.registry.items() if str(spec.entry_point).startswith(("bullet_tasks", "sb3_uspl"))]
    assert len(ours) >= 8
    text, readme = (DOCS / "environments.md").read_text(), (ROOT / "README.md").read_text()
    assert all(f"### {env}\n" in text and f"| `{env}` |" in readme for env in ours)
    for algo, algorithm in ALGORITHMS.items():
        page = (DOCS / "algorithms" / f"{algo}.md").read_text()
        assert "## Can I use?" in page and f"sb3_uspl.{algorithm.__name__}" in page
        assert f"`{algorithm.__name__}` (`{algo}`)" in readme


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_metric_of_ours_is_explained(algo, monkeypatch):
    kwargs = {"mismatch_fraction": 0.5} if algo != "resel_ppo" else {}
    model = ALGORITHMS[algo](
        "MlpPolicy", "TargetReaching-v0" if algo == "resel_ppo" else _venv(), n_steps=64, batch_size=64, **kwargs
    )
    logged = set()
    monkeypatch.setattr("stable_baselines3.common.logger.Logger.record", lambda logger, key, *rest, **more: logged.add(key))
    model.learn(400)
    ours = {key for key in logged if key.startswith(("uspl/", "encoder/"))}
    explained = set(re.findall(r"`([a-z_]+/[a-z_]+)`", (DOCS / "metrics.md").read_text()))
    assert ours and ours <= explained


def _venv():
    from stable_baselines3.common.env_util import make_vec_env

    return make_vec_env(ToyEnv, n_envs=4)


def run_in(folder, *arguments):
    env = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join((str(folder), str(ROOT)))}
    return subprocess.run([sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True, timeout=600)


def prepare(page, folder, entry_point):
    """What a page's commands and examples take for granted: a module of the reader's own, and files that the page shows."""
    (folder / "my_module.py").write_text(MY_MODULE + f'\n\ngym.register(id="MyTask-v0", entry_point={entry_point})\n')
    for block in blocks(page, "text"):
        if block.startswith("seconds,sigma"):
            (folder / "schedule.csv").write_text(block)


def small(command):
    """The command with a tiny budget, in words; None if it is one of make's."""
    words = shlex.split(command)
    if words[0] == "make":
        return None
    kind = "plot_train" if "plot_train" in words else words[2].rpartition(".")[2]
    return [*words, *(["-n", "60"] if "--no-render" in words else TINY.get(kind, []))]


def test_the_commands_of_the_readme_run_in_its_order(tmp_path):
    """In one process, which is quicker; the slow test below runs each in its own."""
    page = ROOT / "README.md"
    prepare(page, tmp_path, "make")
    lines = [shlex.join(words) for words in map(small, commands(page)) if words]
    assert len(lines) >= 5
    result = run_in(tmp_path, "-c", DRIVER, *lines)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-3000:]
    assert {"film.mp4", "replay.html", "policy.onnx", "policy.json"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name)
def test_commands_run(page, tmp_path):
    prepare(page, tmp_path, "make")
    for words in filter(None, map(small, commands(page))):
        result = run_in(tmp_path, *words[1:])
        assert result.returncode == 0, shlex.join(words) + "\n" + result.stdout[-2000:] + result.stderr[-2000:]


def with_python():
    """The README's examples in every run of the tests, the others' in those of the slow ones."""
    pages = [page for page in PAGES if blocks(page, "python")]
    return [page if page.name == "README.md" else pytest.param(page, marks=pytest.mark.slow) for page in pages]


@pytest.mark.parametrize("page", with_python(), ids=name)
def test_examples_run(page, tmp_path):
    """All of a page's, one after the other, with less of everything."""
    prepare(page, tmp_path, "Plain")
    program = PREAMBLE + "\n".join(blocks(page, "python"))
    program = re.sub(r"learn\([\d_]+\)", "learn(64)", re.sub(r"n_envs=\d+", "n_envs=6", program))
    program = re.sub(r"n_steps=\d+", "n_steps=16", program)
    program = re.sub(r"batch_size=\d+", "batch_size=32", program)
    result = run_in(tmp_path, "-c", program)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-3000:]
