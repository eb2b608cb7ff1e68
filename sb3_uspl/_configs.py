"""Hyperparameters in ``zoo_configs/``: the zoo's files, which may also inherit from one another."""

from pathlib import Path
from typing import Any

import yaml

CONFIGS = Path(__file__).resolve().parents[1] / "zoo_configs"

INHERIT, KEEP, EVERY = "inherit", "keep", "every"


def load_entries(path: Path) -> dict[str, dict[str, Any]]:
    """
    Read a zoo file, one entry an environment. Three more keys let algorithms share what should not differ between them::

        inherit: uspl_ppo.yml    # the entries of that file; what this file says goes over them
        keep: [env_kwargs, gamma]  # of those entries nothing else; without it, all
        every: {blur: false}     # goes over every entry, inherited or not
        LateralChoice-v0: {...}  # goes over that entry, after ``every``

    What is inherited from lies beside the file, or else in ``zoo_configs/``.

    :param path: YAML file
    :return: hyperparameters by environment
    :raises ValueError: for a file that does not exist or is no mapping of mappings, that inherits from itself, or that keeps
        what no inherited entry has
    """
    return _load(path, ())


def _beside(path: Path, name: str) -> Path:
    beside, ours = path.parent / name, CONFIGS / name
    return ours if ours.is_file() and not beside.is_file() else beside


def _load(path: Path, heirs: tuple[Path, ...]) -> dict[str, dict[str, Any]]:
    path = path.resolve()
    if path in heirs:
        raise ValueError(f"{path} inherits from itself, by way of {[heir.name for heir in heirs]}.")
    if not path.is_file():
        by = f", which {heirs[-1]} inherits from" if heirs else ""
        raise ValueError(f"There is no file {path}{by}.")
    given = yaml.safe_load(path.read_text()) or {}
    if not isinstance(given, dict):
        raise ValueError(f"{path} holds a {type(given).__name__}; expected a mapping of environments to hyperparameters.")
    parent, every = given.pop(INHERIT, None), given.pop(EVERY, None) or {}
    keep = given.pop(KEEP, None)
    entries = _load(_beside(path, parent), (*heirs, path)) if parent else {}
    if keep is not None:
        unknown = sorted(set(keep) - {name for entry in entries.values() for name in entry})
        if unknown:
            raise ValueError(f"{path} keeps {unknown}, which no entry of {parent} has.")
        entries = {env: {name: value for name, value in entry.items() if name in keep} for env, entry in entries.items()}
    wrong = [name for name, entry in {EVERY: every, **given}.items() if not isinstance(entry, dict)]
    if wrong:
        raise ValueError(f"{path}: the entries {wrong} are no mappings of hyperparameters.")
    own = {name: {**entries.get(name, {}), **every, **entry} for name, entry in given.items()}
    return {name: {**entry, **every} for name, entry in entries.items()} | own
