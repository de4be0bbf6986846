"""Defines how long work reports how far it has come. Nothing is shown here; the caller decides what becomes of it."""

from __future__ import annotations

from typing import Protocol

BYTES = "B"  # unit of amounts that are bytes


class Tell(Protocol):
    """Takes the state of long work."""

    def __call__(self, what: str, done: int, total: int, unit: str = "", /) -> None:
        """Take the state.

        Args:
            what: the phase; another text begins another phase.
            done: amount done.
            total: amount in all; 0: unknown, and 1 with ``done`` 0: the phase has no steps.
            unit: of both amounts, such as `BYTES` or "planes".
        """


def silent(what: str, done: int, total: int, unit: str = "", /) -> None:
    """Ignore the state of long work."""
