"""Tells on the terminal what is being done, how much of it, how fast, and how long it will take."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from swath.daemon.cli.progress import transfer_bar

Tell = Callable[[str, int, int], None]  # what is done, how much, of how much


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A bar on stderr while the block runs, where that is a terminal; takes what it shall show."""
    with transfer_bar() as bar:
        task = bar.add_task("reading", total=None)

        def tell(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        yield tell
