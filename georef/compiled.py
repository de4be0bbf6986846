"""Compile loops over single returns with numba, and cache them on disk for later processes.

Nothing is compiled with fast-math or in parallel: a return's result depends on the return alone, bit for bit.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

Compiled = TypeVar("Compiled", bound=Callable[..., Any])
_njit: Any = numba.njit


_HERE = Path(__file__).parent


@cache
def _digest(folder: Path) -> int:
    """Return a number that changes with the text of every module that may be compiled into another one's functions.

    The modules are those of this folder, and those of ``folder`` if it lies elsewhere: a package that builds on this
    one.
    """
    digest = 0
    for one in (_HERE, *(() if folder.is_relative_to(_HERE) else (folder,))):
        for path in sorted(one.rglob("*.py")):
            if "timescales" not in path.parts:
                digest = zlib.crc32(path.read_bytes(), digest)
    return digest


def jit_inline(function: Compiled) -> Compiled:
    """Compile a function to be inlined into its callers; x / 0 is infinite, which spares a branch."""
    compiled: Compiled = _njit(forceinline=True, nogil=True, error_model="numpy")(function)
    return compiled


def jit_cached(function: Compiled) -> Compiled:
    """Compile an outermost function, and keep it on disk.

    Numba takes a cached function as current by the age of its own file, though kernels of other files are compiled into
    it. The digest of all these files is therefore added to the stamp; otherwise a new version would run the old loops.
    Where no folder is writable, or numba keeps its stamp elsewhere, every process compiles the function anew.
    """
    options = {"nogil": True, "error_model": "numpy"}
    compiled: Any
    try:
        compiled = _njit(cache=True, **options)(function)
        _store_if_possible(compiled._cache)  # noqa: SLF001  (numba has no other way in)
        index = compiled._cache._cache_file  # noqa: SLF001
        stamp = _digest(Path(function.__code__.co_filename).parent)
        index._source_stamp = (index._source_stamp, stamp)  # noqa: SLF001  (nor for its stamp)
    except (RuntimeError, AttributeError):
        compiled = _njit(**options)(function)
    kept_one: Compiled = compiled
    return kept_one


def _store_if_possible(cache: Any) -> None:
    """Let a loop that cannot be stored be compiled again by the next process, instead of ending this one.

    Numba has no machine code to store where another process stored the same loop while this one compiled it; and a
    disk may be full.
    """
    store = cache.save_overload

    def save_overload(signature: Any, data: Any) -> None:
        with suppress(RuntimeError, OSError):
            store(signature, data)

    cache.save_overload = save_overload


def whole(value: int) -> int:
    """Return a constant for calls between compiled functions: numba compiles a function anew for every bare number."""
    return cast(int, np.int64(value))
