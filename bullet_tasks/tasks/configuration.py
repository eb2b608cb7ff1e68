"""A task's configuration, whole or by the values that differ: ``config={"spawn_distance": 1.0}``, as YAML can say it."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, TypeVar

C = TypeVar("C")


def configured(default: C, given: C | Mapping[str, Any] | None) -> C:
    """
    Take a configuration as it is, or replace values of the default one.

    :param default: dataclass
    :param given: a dataclass of that kind; or names and values, with names and values again for a dataclass within, and lists
        for tuples; or None
    :return: the configuration
    :raises ValueError: for a name that is not there, a value of another kind, or one that the dataclass refuses
    """
    if given is None:
        return default
    assert dataclasses.is_dataclass(default) and not isinstance(default, type)
    kind = type(default)
    if isinstance(given, kind):
        for name, value in vars(given).items():
            _value(name, getattr(default, name), value)
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"Expected a {kind.__name__}, or names and values of what is different, got {given!r}.")
    known = [field.name for field in dataclasses.fields(default)]
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise ValueError(f"{kind.__name__} has no {unknown}; it has {known}.")
    return dataclasses.replace(default, **{name: _value(name, getattr(default, name), value) for name, value in given.items()})


def check_positive(config: Any, *names: str) -> None:
    """
    :param config: a configuration, or a task
    :param names: of its values that must be positive
    :raises ValueError: for one that is not, or not finite
    """
    for name in names:
        value = getattr(config, name)
        if not (value > 0.0 and math.isfinite(value)):
            raise ValueError(f"`{name}` must be positive and finite, got {value}.")


def _value(name: str, default: Any, given: Any) -> Any:
    if dataclasses.is_dataclass(default):
        return configured(default, given)
    if isinstance(default, tuple):
        if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != len(default):
            raise ValueError(f"`{name}` must be {len(default)} numbers, got {given!r}.")
        return tuple(_value(name, *pair) for pair in zip(default, given, strict=True))
    if isinstance(given, bool) or not isinstance(given, Real) or not math.isfinite(given):
        raise ValueError(f"`{name}` must be a finite number, got {given!r}.")
    if isinstance(default, int) and not float(given).is_integer():
        raise ValueError(f"`{name}` must be a whole number, got {given!r}.")
    return given
