"""An uncertainty that a person chooses, shown to the policy in place of the encoder's (Figs. 7 and 15-18)."""

import bisect
import csv
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

SECONDS, DECISIONS, SIGMA = "seconds", "decisions", "sigma"


@dataclass(frozen=True)
class ChosenUncertainty:
    """
    Steps over the time of an episode.

    :param times: since its start at which a value begins to hold, ascending
    :param sigmas: the values, in privileged units, for all dimensions; None for the encoder's own
    :param unit: of the times, "seconds" or "decisions"
    :raises ValueError: for no value or another number of them than of times, an unknown unit, times that are negative or not
        ascending, or a negative or infinite value
    """

    times: Sequence[float]
    sigmas: Sequence[float | None]
    unit: str = DECISIONS

    def __post_init__(self) -> None:
        if self.unit not in (SECONDS, DECISIONS):
            raise ValueError(f"unit='{self.unit}': choose '{SECONDS}' or '{DECISIONS}'.")
        if not self.times or len(self.times) != len(self.sigmas):
            raise ValueError(f"{len(self.times)} times and {len(self.sigmas)} uncertainties; expected one of each or more.")
        ascending = all(earlier < later for earlier, later in itertools.pairwise(self.times))
        if not ascending or not all(0.0 <= time < math.inf for time in self.times):
            raise ValueError(f"The times are {list(self.times)}; expected ascending ones from 0 on.")
        wrong = [sigma for sigma in self.sigmas if sigma is not None and not 0.0 <= sigma < math.inf]
        if wrong:
            raise ValueError(f"The uncertainties {wrong} are no standard deviations; expected finite numbers of at least 0.")

    def at(self, decision: int, period: float) -> float | None:
        """
        :param decision: number of decisions before this one
        :param period: s per decision
        :return: what to show to the policy; None for the encoder's own, as before the first time
        """
        now = decision * period if self.unit == SECONDS else float(decision)
        # A row at 0.3 s is meant for the third decision of 0.1 s, though floats say that 3 * 0.1 is not 0.3.
        index = bisect.bisect_right(self.times, now + 1e-9 * max(1.0, now)) - 1
        return None if index < 0 else self.sigmas[index]


def read_uncertainty(text: str) -> ChosenUncertainty:
    """
    Read the value of ``--uncertainty``: a number, or a CSV file with the columns ``seconds`` or ``decisions``, and ``sigma``.

    A row holds from its time until the next row's; before the first one, and where ``sigma`` is left empty, the policy is
    shown the encoder's own.

    :param text: number, or path of a .csv file
    :return: what it says
    :raises ValueError: if it is neither, or the file does not hold what it should
    """
    try:
        return ChosenUncertainty((0.0,), (float(text),))
    except ValueError as error:
        if not text.endswith(".csv"):
            raise ValueError(f"--uncertainty {text}: expected a number of at least 0, e.g. 0.3, or a .csv file.") from error
    path = Path(text)
    if not path.is_file():
        raise ValueError(f"--uncertainty {path}: there is no such file.")
    with path.open(newline="") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        columns = set(reader.fieldnames or ())
        rows = list(reader)
    if columns not in ({SECONDS, SIGMA}, {DECISIONS, SIGMA}):
        raise ValueError(
            f"{path} has the columns {sorted(columns)}; expected '{SIGMA}' and either '{SECONDS}' or '{DECISIONS}', e.g.\n"
            f"{SECONDS},{SIGMA}\n0,0.3\n5,0.02"
        )
    (unit,) = columns - {SIGMA}
    try:
        sigmas = [float(row[SIGMA]) if (row[SIGMA] or "").strip() else None for row in rows]
        return ChosenUncertainty([float(row[unit]) for row in rows], sigmas, unit)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
