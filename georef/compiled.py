"""How loops over single returns are compiled by numba: quick to run, in tolerable time, and kept for later processes.

Nothing is compiled with fast-math or in parallel: a return's result depends on the return alone, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Compiled = TypeVar("Compiled", bound=Callable[..., Any])
_njit: Any = numba.njit


def kernel(function: Compiled) -> Compiled:
    """Compile a function into those that call it; x / 0 is infinite, which spares a branch."""
    compiled: Compiled = _njit(forceinline=True, nogil=True, error_model="numpy")(function)
    return compiled


def kept(function: Compiled) -> Compiled:
    """Compile an outermost function, and keep it on disk.

    Numba knows it again by the age of its file. Where no folder can be written to, it is compiled anew in every
    process.
    """
    compiled: Compiled
    try:
        compiled = _njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        compiled = _njit(nogil=True, error_model="numpy")(function)
    return compiled
