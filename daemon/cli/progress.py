"""Shows on stderr how far long work has come: a bar on a terminal, elsewhere a line for each phase.

Work that ends within `AFTER_S` writes no line, so that scripts read nothing but errors on stderr.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from swath.daemon.errors import one_line
from swath.daemon.system import ended_in_order
from swath.georef.progress import BYTES, Tell

if TYPE_CHECKING:
    from rich.console import Console

AFTER_S = 5.0  # phases are written once the work has taken so long
EVERY_S = 60.0  # between two lines of a phase where there is no bar
TICK_S = 0.5
FROM_S = 2.0  # a phase has to last so long before its remaining time is estimated
SLOWEST = 10.0  # of anything but bytes in a second; a lower rate says less than the percentage
BAR_WIDTH = 24
PAPER_COLUMNS = 1000  # of what no terminal shows: a file or a pipe cuts and folds nothing
LEAST_TOLD_S = 1.0  # of compiling
COMPILING = (
    "compiling for this computer: this takes a minute or more and happens once; swath warm-up does it beforehand"
)


def page_console() -> Console:
    """Return the console for tables on stdout: as wide as the terminal, or where there is none as they need, unless
    COLUMNS says otherwise.
    """
    from rich.console import Console

    free = not sys.stdout.isatty() and not os.environ.get("COLUMNS", "").isdigit()
    return Console(width=PAPER_COLUMNS) if free else Console()


@dataclass(slots=True)
class _Phase:
    """A phase of the work, and the latest that it told."""

    what: str
    began_s: float
    said_s: float
    done: int = 0
    total: int = 0
    unit: str = ""
    compiled_s: float = 0.0  # time that compiling had taken when it began
    compiled: bool = False  # its pace says nothing of the rest

    def ended(self, now_s: float) -> str:
        """Return the line of a phase that has ended: its seconds, amount and rate."""
        took_s = now_s - self.began_s
        amount = max(self.total, self.done)
        facts = [f"{took_s:.1f} s", *([_amount(amount, self.unit)] if self.unit and amount else [])]
        return f"{self.what}: {', '.join([*facts, *self._rate(amount, took_s)])}"

    def state(self, now_s: float) -> str:
        """Return percentage, amount, rate, time and remaining time of a phase that goes on."""
        took_s = now_s - self.began_s
        facts: list[str] = []
        if self.total and self.unit:
            facts = [f"{100 * self.done / self.total:.0f} %"]
            if self.unit != BYTES:
                facts.append(f"{self.done:,} of {self.total:,} {self.unit}")
        elif self.done and self.unit:
            facts = [_amount(self.done, self.unit)]
        facts += [*self._rate(self.done, took_s), f"{_time(took_s)} so far"]
        if self.unit and 0 < self.done < self.total and took_s >= FROM_S and not self.compiled:
            facts.append(f"about {_time(took_s * (self.total - self.done) / self.done)} remaining")
        return ", ".join(facts)

    def _rate(self, amount: int, took_s: float) -> list[str]:
        rate = amount / took_s if took_s >= 0.1 and not self.compiled else 0.0
        if self.unit == BYTES and rate:
            return [f"{rate / 1e6:,.1f} MB/s"]
        return [f"{rate:,.0f} {self.unit}/s"] if rate >= SLOWEST and " " not in self.unit else []


def _amount(amount: int, unit: str) -> str:
    if unit == BYTES:
        return f"{amount / 1e6:,.1f} MB"
    return f"{amount:,} {unit.removesuffix('s') if amount == 1 and len(unit) > 1 else unit}"


def _time(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


class Display:
    """Turns what work tells into lines for people; threads may tell.

    Args:
        say: writes a line.
        show: updates the bar: phase, share done (None: unknown), and the other facts; None: there is no bar.
        clock: returns seconds.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        show: Callable[[str, float | None, str], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._say, self._show, self._clock = say, show, clock
        self.compile_s: Callable[[], float] = lambda: 0.0  # returns the time that compiling has taken up to now
        self._lock = threading.Lock()
        self._began_s = clock()
        self._phase: _Phase | None = None
        self._waiting: list[str] = []

    def tell(self, what: str, done: int, total: int, unit: str = "", /) -> None:
        """Take the state of the work, as `swath.georef.progress.Tell`."""
        with self._lock:
            now_s = self._clock()
            if self._phase is None or self._phase.what != what:
                self._end(now_s)
                self._phase = _Phase(one_line(what), now_s, now_s, compiled_s=self.compile_s())
            self._phase.done, self._phase.total, self._phase.unit = done, total, unit

    def compiling(self) -> None:
        """Say that loops are compiled, so that it takes longer."""
        self._say(COMPILING)

    def tick(self) -> None:
        """Write the lines that are due, and update the bar."""
        with self._lock:
            now_s, phase = self._clock(), self._phase
            late = now_s - self._began_s >= AFTER_S
            if late:
                for line in self._waiting:
                    self._say(line)
                self._waiting.clear()
            if phase is None:
                return
            self._note_compiling(phase)
            if self._show is not None:
                share = phase.done / phase.total if phase.total and phase.unit else None
                self._show(phase.what, share, phase.state(now_s))
            elif late and now_s - phase.said_s >= EVERY_S:
                phase.said_s = now_s
                self._say(f"{phase.what}: {phase.state(now_s)}")

    def close(self) -> None:
        """End the last phase: the work is done."""
        with self._lock:
            self._end(self._clock())
        self.tick()

    def _end(self, now_s: float) -> None:
        if self._phase is not None:
            self._note_compiling(self._phase)
            self._waiting.append(self._phase.ended(now_s))
        self._phase = None

    def _note_compiling(self, phase: _Phase) -> None:
        phase.compiled |= self.compile_s() > phase.compiled_s


@contextmanager
def progress_bar(*, compiling: bool = False) -> Iterator[Tell]:
    """Show the progress of the block on stderr; give the function that updates it.

    SIGTERM and SIGHUP end the block as Ctrl-C does.

    Args:
        compiling: True if loops may have to be compiled within the block: a line then says so, and another at the end
            how long that took. This loads the compiler, which a command beside a recording has no time for.
    """
    from rich.console import Console

    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with (
        ended_in_order(),
        _display(console) as display,
        _compiling_noticed(display, console.print) if compiling else nullcontext(),
        _ticking(display),
    ):
        yield display.tell
        display.close()


@contextmanager
def _display(console: Console) -> Iterator[Display]:
    from rich.progress import BarColumn, Progress, TextColumn

    if not console.is_terminal:
        yield Display(console.print)
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(BAR_WIDTH), TextColumn("{task.fields[state]}"))
    # a redirected stdout must go where the user sent it, not to the terminal
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as bar:
        task = bar.add_task("", total=None, state="")

        def show(what: str, share: float | None, state: str) -> None:
            total = None if share is None else 1.0
            bar.update(task, description=what, total=total, completed=share or 0.0, state=state)

        yield Display(lambda line: console.print(line, style="dim"), show)


@contextmanager
def _ticking(display: Display) -> Iterator[None]:
    """Update the display from a thread: work that computes does not tell often."""
    over = threading.Event()

    def tick() -> None:
        while not over.wait(TICK_S):
            display.tick()

    ticker = threading.Thread(target=tick, name="progress", daemon=True)
    ticker.start()
    try:
        yield
    finally:
        over.set()
        ticker.join()


@contextmanager
def _compiling_noticed(display: Display, say: Callable[[str], None]) -> Iterator[None]:
    """Write a line when loops have to be compiled within the block, as on a new installation, and one at its end."""
    try:
        from swath.daemon.processing.compiling import before_compiling
    except ImportError:  # nothing is compiled without numba; the command reports what it needs
        yield
        return

    with before_compiling(display.compiling) as compiling:
        display.compile_s = lambda: compiling.seconds
        yield
    if compiling.seconds >= LEAST_TOLD_S:
        again = "later runs use the stored code"
        if not compiling.kept:
            again = "no cache folder is writable, so every run compiles; set NUMBA_CACHE_DIR"
        say(f"compiling took {compiling.seconds:.0f} s; {again}")
