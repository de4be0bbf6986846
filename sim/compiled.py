"""Compiles loops over single rays with numba, so that they run quickly and are kept on disk for later processes."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import extending
from numba.core import cgutils
from numba.np import arrayobj
from numpy.typing import NDArray

Compiled = TypeVar("Compiled", bound=Callable[..., Any])
_njit: Any = numba.njit
_intrinsic: Any = extending.intrinsic
_make_array: Any = arrayobj.make_array
_null: Any = cgutils.get_null_value


def jit_inline(function: Compiled) -> Compiled:
    """Compile a function into the functions that call it; Python cannot call it directly.

    A division by zero gives infinity, which spares a branch.
    """
    options = {"nogil": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled: Compiled = _njit(forceinline=True, **options)(function)
    return compiled


def jit_cached(function: Compiled) -> Compiled:
    """Compile an outermost function and keep the result on disk.

    Numba identifies the cached result by the age of the function's file and by the values in its closure; `digest` in
    the closure stands for the other files. If no folder is writable, every process compiles the function anew.
    """
    options = {"nogil": True, "error_model": "numpy"}
    compiled: Compiled
    try:
        compiled = _njit(cache=True, **options)(function)
    except RuntimeError:
        compiled = _njit(**options)(function)
    return compiled


def digest(*modules: ModuleType) -> int:
    """Return a number that changes with the text of modules and is never 0."""
    return zlib.crc32(b"".join(Path(str(module.__file__)).read_bytes() for module in modules)) or 1


def whole(value: int) -> int:
    """Return a constant for calls between compiled functions; numba compiles a function anew for every bare number."""
    return cast(int, np.int64(value))


def _borrowed(context: Any, values: Any) -> Any:
    def without_owner(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = _make_array(signature.args[0])(context, builder, arguments[0])
        for name in ("meminfo", "parent"):
            setattr(array, name, _null(getattr(array, name).type))
        return array._getvalue()  # noqa: SLF001  (the name is what numba's own extensions use)

    return values(values), without_owner


borrowed: Callable[[NDArray[Any]], NDArray[Any]] = _intrinsic(_borrowed)
"""Within compiled code: the same array as one that owns nothing.

numba counts the references to an owner at every call, which took two thirds of the time. The owner must live on: an
argument of the outermost function does.
"""
