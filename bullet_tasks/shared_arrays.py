"""Named numpy arrays that several processes see."""

import contextlib
import mmap
import os
import tempfile
from collections.abc import Mapping

import numpy as np

Layout = Mapping[str, tuple[tuple[int, ...], np.dtype]]
"""Name -> (shape, dtype)."""

_MEMORY_FILES = "/dev/shm"  # Linux keeps files of this folder in memory; elsewhere the folder for temporary files will do
_ALIGNMENT = 64  # bytes, a cache line, so that two arrays never share one


class SharedArrays:
    """
    Arrays in one mapped file.

    One process makes it with ``create``, the others map it by ``path`` and the same layout. Once all have done so the
    creator calls ``unlink``: from then on the memory belongs to the mappings alone and cannot be leaked, however the
    processes end. (``multiprocessing.shared_memory`` leaves its segments behind when a process is killed.)

    :param path: of the file
    :param layout: the arrays in it
    """

    def __init__(self, path: str, layout: Layout) -> None:
        self.path = path
        with open(path, "r+b") as file:
            self._map = mmap.mmap(file.fileno(), _size(layout))
        self._arrays: dict[str, np.ndarray] = {}
        offset = 0
        for name, (shape, dtype) in layout.items():
            count = int(np.prod(shape, dtype=np.int64))
            self._arrays[name] = np.frombuffer(self._map, dtype, count, offset).reshape(shape)
            offset += _padded(count * dtype.itemsize)

    @classmethod
    def create(cls, layout: Layout) -> "SharedArrays":
        """
        Make the file, filled with zeros, and map it.

        :param layout: the arrays in it
        """
        size = _size(layout)
        for folder in (_MEMORY_FILES, None):
            if folder is not None and not os.path.isdir(folder):
                continue
            handle, path = tempfile.mkstemp(prefix=f"bullet_tasks_{os.getpid()}_", dir=folder)
            try:
                if hasattr(os, "posix_fallocate"):
                    # Reserved now: memory that runs out later would end the process instead of raising an error.
                    os.posix_fallocate(handle, 0, size)
                else:
                    os.ftruncate(handle, size)
                return cls(path, layout)
            except OSError:
                os.unlink(path)
                if folder is None:
                    raise
            finally:
                os.close(handle)
        raise AssertionError("the loop above returns or raises")

    def __getitem__(self, name: str) -> np.ndarray:
        """
        The array itself, not a copy.

        :param name: as in the layout
        """
        return self._arrays[name]

    def unlink(self) -> None:
        """Remove the file's name; where that is impossible while it is mapped (Windows), call it again at the end."""
        with contextlib.suppress(OSError):
            os.unlink(self.path)


def _padded(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _size(layout: Layout) -> int:
    total = sum(_padded(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize) for shape, dtype in layout.values())
    return max(total, _ALIGNMENT)
