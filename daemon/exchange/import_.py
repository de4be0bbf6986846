"""Imports captures into an ordinary log, as a recorder would have written it; the captures' stamps become log times.

Files are merged by time, each read in its own order and never held in memory as a whole.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from swath import __version__
from swath.daemon.config import Config
from swath.daemon.exchange.captures import Capture, ImportUnit
from swath.daemon.exchange.log_maker import MadeLog
from swath.daemon.exchange.routes import Routes
from swath.daemon.log.events import Severity
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.session import read_boot_id, session_name


def merge(captures: Iterable[Capture], routes: Routes) -> Iterator[ImportUnit]:
    """Yield the units of all files merged by time; each file keeps its own order."""
    streams = [capture.read(routes) for capture in captures]
    waiting = []
    for number, stream in enumerate(streams):
        unit = next(stream, None)
        if unit is not None:
            waiting.append((unit.time_ns, number, unit))
    heapq.heapify(waiting)
    while waiting:
        _, number, unit = waiting[0]
        yield unit
        following = next(streams[number], None)
        if following is None:
            heapq.heappop(waiting)
        else:
            heapq.heapreplace(waiting, (following.time_ns, number, following))


def import_session_info(name: str, first_ns: int) -> SessionInfo:
    """Return the session of captures that begin at ``first_ns``; its host time is the wall clock of the captures."""
    boot_id = read_boot_id()
    return SessionInfo(
        session_id=session_name(name, first_ns, boot_id),
        software=f"swath {__version__}",
        host=platform.node(),
        boot_id=boot_id,
        realtime_ns=first_ns,
        monotonic_ns=first_ns,
        origin="import",
    )


class ImportLog(MadeLog):
    """The log of an import; raises as `MadeLog` does."""

    def __init__(self, config: Config, directory: Path, first_ns: int) -> None:
        super().__init__(config, directory, import_session_info(config.session.name, first_ns), "import")
        self.event(Severity.INFO, "session_started", f"session {self.info.session_id}, imported from captures")

    def add(self, unit: ImportUnit) -> None:
        """Add one unit; raises OSError if the disk refuses a chunk."""
        self.go_on(unit.time_ns)
        source = self.sources.get(unit.port.source) or self.add_source(unit.port)
        self.add_unit(source, unit.peer, unit.time_ns, unit.data)


@dataclass(frozen=True, slots=True)
class ImportReport:
    """The result of an import; ``session_id`` and ``paths`` are empty if no capture held a unit."""

    session_id: str
    paths: list[Path]
    units: dict[str, int]


def import_captures(
    config: Config,
    routes: Routes,
    captures: list[Capture],
    directory: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ImportReport:
    """Make a log from captures.

    Args:
        config: describes the devices; it is stored in the log.
        routes: of the same configuration.
        captures: read here, once; each holds the counts of its units afterwards.
        directory: of the log; created if necessary.
        progress: called occasionally with the bytes of the files that are read, and those of all.

    Raises:
        UserError: the log exists already.
        OSError: it cannot be written; nothing is left of it.
    """
    log: ImportLog | None = None
    read_so_far = ReadSoFar(captures)
    try:
        for number, unit in enumerate(merge(captures, routes)):
            log = log or ImportLog(config, directory, unit.time_ns)
            log.add(unit)
            if number % 10_000 == 0:
                progress(read_so_far(), read_so_far.total)
        if log is None:
            return ImportReport("", [], {})
        for capture in captures:
            _note(log, capture)
        log.finish()
    except BaseException:
        if log is not None:
            log.give_up()
        raise
    return ImportReport(log.info.session_id, log.paths, log.units())


class ReadSoFar:
    """Measures how far files are read, by the positions at which this process has them open.

    Attributes:
        total: bytes of all files; a compressed file counts as it is on the disk.
    """

    def __init__(self, captures: Iterable[Capture]) -> None:
        paths = [path.resolve() for capture in captures for path in capture.files()]
        self._sizes = Counter({path: path.stat().st_size for path in set(paths) if path.exists()})
        self._readers = Counter(path for path in paths if path in self._sizes)
        self.total = sum(self._sizes[path] * count for path, count in self._readers.items())

    def __call__(self) -> int:
        """Return the bytes that are read; a file that is no longer open is read to its end."""
        done, still_open = 0, Counter[Path]()
        for entry in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError, ValueError):  # the descriptor of this very loop is closed already
                path = Path(os.readlink(entry))
                if path in self._readers:
                    still_open[path] += 1
                    done += os.lseek(int(entry.name), 0, os.SEEK_CUR)
        ended = self._readers - still_open
        return min(self.total, done + sum(self._sizes[path] * count for path, count in ended.items()))


def _note(log: ImportLog, capture: Capture) -> None:
    counts = ", ".join(f"{count} units of {source}" for source, count in capture.units.items()) or "no units"
    claims = "".join(f"; {head.words()}" for head in capture.heads.values())
    log.event(Severity.INFO, "capture_imported", f"{capture.path.name}: {counts}{claims}")
    if capture.tally.damage:
        text = (
            f"{capture.path.name} is damaged in {capture.tally.damage} places; the first: {capture.tally.first_damage}"
        )
        log.event(Severity.WARNING, "capture_damaged", text)
