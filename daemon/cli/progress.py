"""Shows a progress bar on stderr, if that is a terminal, for work that is counted in bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

Tell = Callable[[str, int, int], None]  # description, bytes done, bytes in total
COMPILING = "compiling for this computer: this takes a minute or more and happens once"


def transfer_bar() -> Progress:
    """Return a bar with description, progress, speed and remaining time; it disappears when it ends."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def compiling_noticed(console: Console) -> Iterator[None]:
    """Write a line when loops have to be compiled within the block, as on a new installation."""
    try:
        from swath.daemon.processing.compiling import before_compiling
    except ImportError:  # nothing is compiled without numba; the command reports what it needs
        yield
        return
    with before_compiling(lambda: console.print(COMPILING, markup=False, highlight=False, soft_wrap=True)):
        yield


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """Show a bar on stderr, if that is a terminal, during the block; give the function that updates it.

    Where loops have to be compiled first, a line says so.
    """
    with transfer_bar() as bar, compiling_noticed(bar.console):
        task = bar.add_task("reading", total=None)

        def tell(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        yield tell
