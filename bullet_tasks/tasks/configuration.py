"""A task's configuration, whole or by the values that differ: ``config={"spawn_distance": 1.0}``, as YAML can say it."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

C = TypeVar("C")


def configured(default: C, given: C | Mapping[str, Any] | None) -> C:
    """
    Take a configuration as it is, or replace values of the default one.

    :param default: dataclass
    :param given: a dataclass of that kind; or names and values, with names and values again for a dataclass within, and lists
        for tuples; or None
    :return: the configuration
    :raises ValueError: for a name that is not there, or a value that the dataclass refuses
    """
    if given is None:
        return default
    if not isinstance(given, Mapping):
        return given
    assert dataclasses.is_dataclass(default) and not isinstance(default, type)
    known = [field.name for field in dataclasses.fields(default)]
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise ValueError(f"{type(default).__name__} has no {unknown}; it has {known}.")
    return dataclasses.replace(default, **{name: _value(getattr(default, name), value) for name, value in given.items()})


def _value(default: Any, given: Any) -> Any:
    if isinstance(given, Mapping) and dataclasses.is_dataclass(default):
        return configured(default, given)
    return tuple(given) if isinstance(given, list) and isinstance(default, tuple) else given
