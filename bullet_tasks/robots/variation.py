"""What domain randomisation draws from: ranges, and errors either way."""

from typing import Any

Range = tuple[float, float]
"""Least and greatest value; an episode's is drawn evenly between them."""


def check_variation(variation: Any) -> None:
    """
    Reject what nothing can be drawn from.

    :param variation: dataclass whose tuples are ranges and whose numbers are greatest errors either way
    :raises ValueError: if a range is empty or not positive, or an error negative
    """
    for name, value in vars(variation).items():
        if not isinstance(value, tuple):
            if not value >= 0.0:
                raise ValueError(f"`{name}` must be 0 or more, got {value}.")
        elif not 0.0 < value[0] <= value[1]:
            raise ValueError(f"`{name}` must be a range of positive numbers, (least, greatest), got {value}.")
