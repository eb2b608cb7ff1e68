"""
How fast it is: prints tables and writes JSON. ``make benchmark``; all cores should be free, else the numbers mean little.

Every comparison is measured in one run, its contenders in turn, round after round: ratios are medians of the ratios within a
round. ``targets`` holds the ratios against what the project wants to reach.
"""

import argparse
import inspect
import json
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import encoder, environments, gpu, growth, training
from benchmarks.harness import TARGETS, Tables, show, write_json
from benchmarks.machine import ROOT, busy, describe, load


def sensors(repetitions: int = 5) -> Tables:
    """
    Sensors against PyBullet's own, see ``benchmarks.sensors``.

    :param repetitions: rounds
    """
    try:
        from benchmarks.sensors import run
    except ImportError as error:
        print(f"No benchmark of the sensors here: {error}")
        return {}
    return {"Sensors": run(repetitions=repetitions)}


SECTIONS: dict[str, tuple[Callable[..., Tables], dict[str, Any]]] = {
    "environments": (environments.run, environments.QUICK),
    "sensors": (sensors, {"repetitions": 1}),
    "encoder": (encoder.run, encoder.QUICK),
    "training": (training.run, training.QUICK),
    "growth": (growth.run, growth.QUICK),
    "gpu": (gpu.run, gpu.QUICK),
}
"""Function and its sizes with ``--quick``."""


def run_sections(names: list[str], quick: bool, overrides: dict[str, Any], path: Path, markdown: bool = False) -> bool:
    """
    Measure, print and keep; what has been measured is kept even if a later section fails.

    :param names: of the sections
    :param quick: with small sizes, once
    :param overrides: arguments for those sections that know them; None is left out
    :param path: JSON file to write; sections in it that are not measured now stay
    :param markdown: tables as Markdown
    :return: whether no section failed
    """
    sections, succeeded = read_sections(path), True
    print(busy() or "The machine is quiet.", flush=True)
    for name in names:
        function, small = SECTIONS[name]
        known = inspect.signature(function).parameters
        arguments = {**(small if quick else {}), **{k: v for k, v in overrides.items() if k in known and v is not None}}
        section: dict[str, Any] = {"machine": describe(), "quick": quick, "overrides": overrides}
        begin = time.perf_counter()
        try:
            section["tables"] = function(**arguments)
        except Exception:
            traceback.print_exc()
            section["failed"], succeeded = traceback.format_exc(), False
        sections[name] = {**section, "seconds": time.perf_counter() - begin, "load_after": load()}
        for title, table in section.get("tables", {}).items():
            if title != TARGETS:
                print("\n" + show(title, table, markdown), flush=True)
        write_json(path, {"sections": sections})
    show_targets({name: sections[name] for name in names}, markdown)
    print(f"\nLoad average now {load()}. Written to {path}.")
    return succeeded


def read_sections(path: Path) -> dict[str, Any]:
    """
    :param path: file that :func:`run_sections` wrote; need not exist
    :return: by name, in the order of ``SECTIONS``
    """
    kept = json.loads(path.read_text())["sections"] if path.exists() else {}
    return {name: kept[name] for name in SECTIONS if name in kept}


def show_targets(sections: dict[str, Any], markdown: bool = False) -> None:
    """
    :param sections: from :func:`read_sections`
    :param markdown: whether as Markdown
    """
    targets = [row for section in sections.values() for row in section.get("tables", {}).get(TARGETS, [])]
    if targets:
        print("\n" + show("Targets", targets, markdown), flush=True)


def show_sections(path: Path, markdown: bool = False) -> None:
    """
    Print what was measured at some time.

    :param path: file that :func:`run_sections` wrote
    :param markdown: whether as Markdown
    """
    sections = read_sections(path)
    show_targets(sections, markdown)
    for name, section in sections.items():
        machine, quick = section["machine"], ", quick" * section["quick"]
        on = f"{machine['processor']}, {machine['cores']} cores"
        print(f"\n{name}: {machine['time']}, commit {machine['commit']}, {on}{quick}")
        for title, table in section.get("tables", {}).items():
            if title != TARGETS:
                print("\n" + show(title, table, markdown))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", help=f"some of: {', '.join(SECTIONS)} (all by default)")
    parser.add_argument("--quick", action="store_true", help="small sizes, once: whether it runs, not how fast")
    parser.add_argument("--repetitions", type=int, help="rounds of every comparison (5)")
    parser.add_argument("--threads", type=int, help="of torch (1), where they are not compared")
    results = ROOT / "benchmarks" / "results.json"
    parser.add_argument("--json", type=Path, default=results, help="file to write; what is not measured stays in it")
    parser.add_argument("--markdown", action="store_true", help="print tables as Markdown")
    parser.add_argument("--show", action="store_true", help="print what the file holds, measure nothing")
    options = parser.parse_args()
    unknown = sorted(set(options.sections) - set(SECTIONS))
    if unknown:
        parser.error(f"unknown sections {unknown}; known: {list(SECTIONS)}")
    if options.show:
        if not options.json.exists():
            parser.error(f"nothing to show: no file {options.json}")
        return show_sections(options.json, options.markdown)
    overrides = {"repetitions": options.repetitions, "threads": options.threads}
    if not run_sections(options.sections or list(SECTIONS), options.quick, overrides, options.json, options.markdown):
        sys.exit(1)


if __name__ == "__main__":
    main()
