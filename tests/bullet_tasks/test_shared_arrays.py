"""Laws of shared arrays: what one mapping writes the others read, and nothing stays behind."""

import os

import numpy as np
import pytest

from bullet_tasks.shared_arrays import SharedArrays

LAYOUT = {
    "a": ((3, 5), np.dtype(np.float32)),
    "flag": ((3,), np.dtype(bool)),
    "empty": ((3, 0), np.dtype(np.float64)),
    "b": ((2,), np.dtype(np.int64)),
}


def test_what_one_mapping_writes_the_other_reads_even_without_a_name():
    one = SharedArrays.create(LAYOUT)
    other = SharedArrays(one.path, LAYOUT)
    one.unlink()
    assert not os.path.exists(one.path)
    one.unlink()
    for name, (shape, dtype) in LAYOUT.items():
        assert other[name].shape == shape and other[name].dtype == dtype
        assert not other[name].any()
    one["a"][1, 2], one["b"][:], one["flag"][2] = 0.5, (7, -8), True
    assert other["a"][1, 2] == 0.5 and other["a"].sum() == 0.5
    assert other["b"].tolist() == [7, -8] and other["flag"].tolist() == [False, False, True]


def test_arrays_start_on_cache_lines():
    arrays = SharedArrays.create(LAYOUT)
    arrays.unlink()
    start = arrays["a"].ctypes.data
    assert all((arrays[name].ctypes.data - start) % 64 == 0 for name in LAYOUT)


def test_memory_that_is_not_there_is_an_error_and_leaves_no_file(monkeypatch):
    paths = []
    original = os.unlink
    monkeypatch.setattr(os, "unlink", lambda path: (paths.append(path), original(path)))

    def refuse(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "posix_fallocate", refuse, raising=False)
    with pytest.raises(OSError, match="no space"):
        SharedArrays.create(LAYOUT)
    assert paths and not any(map(os.path.exists, paths))
