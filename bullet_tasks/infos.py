"""Infos of many environments on their way between processes: pickling one array costs as much as all the rest of an info."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

_PLAIN_KINDS = "biufc"  # bool, integers, floats and complex numbers


class PackedInfos(NamedTuple):
    """Infos whose common arrays are stacked."""

    columns: dict[str, np.ndarray]
    """Key -> the arrays of all infos, ``(n_infos, *shape)``."""
    rests: Sequence[dict[str, Any]]
    """The infos with None in place of those arrays."""


def pack(infos: Sequence[dict[str, Any]]) -> PackedInfos:
    """
    Stack the arrays that all infos have, of the same shape and type. The infos themselves are left as they are.

    :param infos: one an environment
    """
    columns: dict[str, np.ndarray] = {}
    for key, first in infos[0].items() if infos else ():
        if not (type(first) is np.ndarray and first.ndim and first.dtype.kind in _PLAIN_KINDS):
            continue
        arrays = [info.get(key) for info in infos]
        if all(type(a) is np.ndarray and a.dtype == first.dtype and a.shape == first.shape for a in arrays):
            columns[key] = np.concatenate(arrays).reshape(len(infos), *first.shape)  # type: ignore[arg-type]
    if not columns:
        return PackedInfos(columns, infos)
    placeholders = dict.fromkeys(columns)
    return PackedInfos(columns, [{**info, **placeholders} for info in infos])


def unpack(packed: PackedInfos) -> Sequence[dict[str, Any]]:
    """
    The infos that were packed, keys in their old order.

    :param packed: from ``pack``; its infos are filled in
    """
    for key, column in packed.columns.items():
        for info, row in zip(packed.rests, column, strict=True):
            info[key] = row
    return packed.rests
