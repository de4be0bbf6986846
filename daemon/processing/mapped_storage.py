"""Arrays of a long flight in temporary files that are mapped: memory holds what is being worked on."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.navigation.filter.stores import Storage

SMALLEST_BYTES = 1 << 20  # smaller arrays are kept in memory


class MappedStorage(Storage):
    """Large arrays stand in files without a name, which go with the arrays; `rest` takes them out of memory.

    Space is taken when an array is made, so that a full disk is met there; such an array is kept in memory.

    Args:
        folder: of the files; None: that of temporary files.
        smallest_bytes: arrays from this size on are mapped.
    """

    def __init__(self, folder: Path | None = None, smallest_bytes: int = SMALLEST_BYTES) -> None:
        self._folder, self._smallest_bytes = folder, smallest_bytes
        self._mapped: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An array of zeros, mapped where it is large."""
        size = prod(shape) * np.dtype(dtype).itemsize
        if size < max(self._smallest_bytes, 1):
            return np.empty(shape, dtype)
        try:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                os.posix_fallocate(file.fileno(), 0, size)
                mapping = mmap.mmap(file.fileno(), size)
        except OSError:
            return np.empty(shape, dtype)
        self._mapped.add(mapping)
        return np.frombuffer(mapping, dtype).reshape(shape)

    def rest(self) -> None:
        """Take what is mapped out of memory; it comes back from its file where it is asked for."""
        for mapping in self._mapped:
            mapping.madvise(mmap.MADV_DONTNEED)
