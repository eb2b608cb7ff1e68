"""What every benchmark shares: interleaved repetitions, rows and targets, and how results are shown and kept."""

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]
"""One line of a table: column -> text, number, truth value or None."""
Tables = dict[str, list[Row]]
"""Rows by title."""
Contender = Callable[[], float]
"""Measures once and returns the measured value."""

TARGETS = "targets"
"""Title of the rows that say what must be reached; every section may add some."""


def interleave(contenders: Mapping[str, Contender], repetitions: int, warm_up: bool = True) -> dict[str, list[float]]:
    """
    Measure all contenders in turn, round after round, so that a slow moment of the machine hits them all.

    :param contenders: by name
    :param repetitions: rounds that count
    :param warm_up: whether a round that does not count pays for what only happens once (compilation, caches)
    :return: values by name, ``repetitions`` each
    :raises ValueError: without a contender or a repetition
    """
    if not contenders or repetitions < 1:
        raise ValueError(f"{len(contenders)} contender(s), {repetitions} repetition(s): at least one of each is needed.")
    for measure in contenders.values() if warm_up else ():
        measure()
    values: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repetitions):
        for name, measure in contenders.items():
            values[name].append(measure())
    return values


def ratio(values: Mapping[str, Sequence[float]], name: str, reference: str) -> float:
    """
    How often one contender's value is that of another.

    :param values: from :func:`interleave`
    :param name: numerator
    :param reference: denominator
    :return: median of the ratios within a round
    """
    return statistics.median(a / b for a, b in zip(values[name], values[reference], strict=True))


def rows(values: Mapping[str, Sequence[float]], what: str, unit: str, reference: str | None = None) -> list[Row]:
    """
    One row a contender: median, range, and the ratio to the reference if there is one.

    :param values: from :func:`interleave`
    :param what: was measured
    :param unit: of the values
    :param reference: the contender that the others are compared with
    """
    table = []
    for name, measured in values.items():
        row: Row = {"what": what, "contender": name, "median": statistics.median(measured), "unit": unit}
        if reference is not None:
            row[f"/ {reference}"] = ratio(values, name, reference)
        table.append(row | {"least": min(measured), "greatest": max(measured), "repetitions": len(measured)})
    return table


def target(what: str, measured: float, at_least: float | None = None, at_most: float | None = None) -> Row:
    """
    Hold a measured number against what must be reached.

    :param what: was measured
    :param measured: value
    :param at_least: lower limit
    :param at_most: upper limit
    :raises ValueError: unless exactly one limit is given
    """
    if (at_least is None) == (at_most is None):
        raise ValueError(f"Target {what!r}: give either `at_least` or `at_most`.")
    if at_most is not None:
        return {"what": what, "measured": measured, "target": f"<= {at_most:g}", "met": measured <= at_most}
    return {"what": what, "measured": measured, "target": f">= {at_least:g}", "met": measured >= at_least}  # type: ignore[operator]


def show(title: str, table: Sequence[Row], markdown: bool = False) -> str:
    """
    A table as text.

    :param title: above the table
    :param table: rows; a column is empty where a row lacks it
    :param markdown: Markdown instead of aligned columns
    """
    columns = list(dict.fromkeys(column for row in table for column in row))
    cells = [columns, *([_cell(row.get(column)) for column in columns] for row in table)]
    numeric = [all(not isinstance(row.get(column), str) for row in table) for column in columns]
    if markdown:
        rule = ["---:" if right else ":---" for right in numeric]
        return "\n".join([f"### {title}", "", *("| " + " | ".join(line) + " |" for line in (cells[0], rule, *cells[1:]))])
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    lines = [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width) for cell, width, right in zip(line, widths, numeric, strict=True)
        ).rstrip()
        for line in cells
    ]
    return "\n".join([title, "-" * len(title), *lines])


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "NO"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"
    return str(value)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """
    Keep results, whole or not at all.

    :param path: of the file
    :param content: plain data
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_text(json.dumps(content, indent=1) + "\n")
    draft.replace(path)
