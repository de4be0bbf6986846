"""Notices when numba compiles a loop, in this process or in a worker process of it, and how long that takes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numba.core.event

COMPILE_EVENT = "numba:compile"
_listening: list[Compiling] = []


class Compiling(numba.core.event.Listener):
    """Calls a function once, when the first loop is about to be compiled, and adds up the time that compiling takes."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._calls = [call]
        self._lock = threading.Lock()  # threads compile too
        self._open, self._since_s, self._own_s, self._workers_s = 0, 0.0, 0.0, 0.0
        self._stored, self._unstored = 0, 0

    @property
    def kept(self) -> bool:
        """False if no loop that was compiled here can be stored: no cache folder is writable."""
        return self._stored > 0 or not self._unstored  # inlined loops are never stored themselves

    @property
    def seconds(self) -> float:
        """Time during which this process has compiled up to now, and the longest such time of its workers."""
        with self._lock:
            running_s = time.monotonic() - self._since_s if self._open else 0.0
            return self._own_s + running_s + self._workers_s

    def on_start(self, event: numba.core.event.Event) -> None:
        """Call the function, if it has not been called; note the time."""
        self.tell()
        with self._lock:
            if not self._open:
                self._since_s = time.monotonic()
            self._open += 1

    def on_end(self, event: numba.core.event.Event) -> None:
        """Add the time since the first of the compilations that run at once."""
        stats = getattr(event.data.get("dispatcher"), "stats", None)
        with self._lock:
            stored = getattr(stats, "cache_path", None) is not None
            self._stored, self._unstored = self._stored + stored, self._unstored + (not stored)
            self._open -= 1
            if not self._open:
                self._own_s += time.monotonic() - self._since_s

    def tell(self, workers_s: float = 0.0) -> None:
        """Call the function, if it has not been called; note how long worker processes have compiled."""
        self._workers_s = max(self._workers_s, workers_s)
        while self._calls:
            self._calls.pop()()


@contextlib.contextmanager
def before_compiling(call: Callable[[], None]) -> Iterator[Compiling]:
    """Call a function before the first loop is compiled within the block; never if all come from the cache.

    A loop of a worker process counts too; the function is called a moment later then. Gives the object that holds the
    time that compiling took.
    """
    listener = Compiling(call)
    _listening.append(listener)
    try:
        with numba.core.event.install_listener(COMPILE_EVENT, listener):
            yield listener
    finally:
        _listening.remove(listener)


class _Marking(Compiling):
    """Keeps a shared number at the seconds that this worker process has compiled, if no other has compiled longer."""

    def __init__(self, shared: Any) -> None:
        super().__init__(self._mark)
        self._shared = shared

    def _mark(self) -> None:
        with self._shared.get_lock():
            self._shared.value = max(self._shared.value, self.seconds or 1e-3)  # above 0 from the first moment

    def on_end(self, event: numba.core.event.Event) -> None:
        """Note the end of a compilation, and pass on the time."""
        super().on_end(event)
        self._mark()


def mark_compiling(shared: Any) -> None:
    """Keep a shared number, a `multiprocessing.Value`, at the longest time in seconds that a worker has compiled.

    It is above 0 as soon as the first loop of this process is about to be compiled.
    """
    register: Any = numba.core.event.register
    register(COMPILE_EVENT, _Marking(shared))


def tell_of_workers(seconds: float) -> None:
    """Tell all `before_compiling` blocks that a worker process compiles, and for how long up to now."""
    for listener in _listening:
        listener.tell(seconds)


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """Record the names of loops compiled within the block; those read from the cache are not listed."""
    with numba.core.event.install_recorder(COMPILE_EVENT) as recorder:
        names: list[str] = []
        yield names
        names += [str(event.data["dispatcher"]) for _, event in recorder.buffer if event.is_start]
