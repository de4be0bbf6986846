"""Notices when numba compiles a loop, in this process or in a worker process of it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numba.core.event

COMPILE_EVENT = "numba:compile"
_listening: list[_FirstCompilation] = []


class _FirstCompilation(numba.core.event.Listener):
    """Calls a function once, when the first loop is about to be compiled."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._calls = [call]

    def on_start(self, event: numba.core.event.Event) -> None:
        self.tell()

    def on_end(self, event: numba.core.event.Event) -> None:
        """Ignore the end of a compilation."""

    def tell(self) -> None:
        """Call the function, if it has not been called."""
        while self._calls:
            self._calls.pop()()


@contextlib.contextmanager
def before_compiling(call: Callable[[], None]) -> Iterator[None]:
    """Call a function before the first loop is compiled within the block; never if all come from the cache.

    A loop of a worker process counts too; the function is called a moment later then.
    """
    listener = _FirstCompilation(call)
    _listening.append(listener)
    try:
        with numba.core.event.install_listener(COMPILE_EVENT, listener):
            yield
    finally:
        _listening.remove(listener)


def mark_compiling(flag: Any) -> None:
    """Set a shared flag, a `multiprocessing.Value`, when the first loop of this process is about to be compiled."""

    def mark() -> None:
        flag.value = True

    register: Any = numba.core.event.register
    register(COMPILE_EVENT, _FirstCompilation(mark))


def tell_of_worker() -> None:
    """Call the functions of all `before_compiling` blocks, because a worker process compiles."""
    for listener in _listening:
        listener.tell()


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """Record the names of loops compiled within the block; those read from the cache are not listed."""
    with numba.core.event.install_recorder(COMPILE_EVENT) as recorder:
        names: list[str] = []
        yield names
        names += [str(event.data["dispatcher"]) for _, event in recorder.buffer if event.is_start]
