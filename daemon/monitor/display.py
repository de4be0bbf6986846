"""Shows a recorder's state from its growing log alone: every source, the disk, the last events."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import AsyncGenerator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swath.daemon.log.claim import is_being_written
from swath.daemon.log.follow import LogFollower, LogListening, PartFollower
from swath.daemon.log.format import LogError, SessionInfo, source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.log.parsers import stored_config, stored_drivers
from swath.daemon.log.parts import Sign
from swath.daemon.log.session import read_boot_id
from swath.daemon.log.words import duration_text, source_trouble
from swath.daemon.monitor.source import Decoding, SourceWatch, decoded_trouble
from swath.drivers.listening import Measured

TAIL_S = 5.0
QUEUE_BYTES = 16 << 20  # read, but not yet taken
EVENTS_KEPT = 50
STALE_S = 5.0  # a status is written each second; a disk may delay it
LITTLE_LEFT_S = 900.0
RECORDING, DEGRADED, NOT_RECORDING = "recording", "degraded", "not recording"


@dataclass(frozen=True, slots=True)
class News:
    """Messages of the log, or the end of a look at it.

    Attributes:
        part: the file that is read; None: there is none yet.
        batch: messages of it; None: all that could be read has been.
        sign: of the directory; None: nothing is being recorded.
        bytes_per_s: highest rate of the last half hour, at the end of a look.
    """

    part: PartFollower | None
    batch: LogBatch | None
    sign: Sign | None = None
    bytes_per_s: float = 0.0


def news(follower: LogFollower) -> Iterator[Measured[News]]:
    """Look at a log once: yield what has become readable, then the end of this look."""
    for batch in follower.poll():
        size_bytes = batch.units.nbytes + batch.log_time_ns.nbytes
        yield Measured(News(follower.part, batch), size_bytes, len(batch.units), size_bytes)
    end = News(follower.part, None, follower.sign, follower.growth.highest_bytes_per_s())
    yield Measured(end, 0, 0, 0)


def follower_of(directory: Path) -> LogFollower:
    """Return what reads the recording in a directory for a monitor."""
    return LogFollower(directory, TAIL_S, every_part=False)


async def watch(directory: Path, every_s: float, *, decode: bool = True) -> AsyncGenerator[Monitor, None]:
    """Yield the monitor of a directory after each look at its log, every so many seconds."""
    monitor = Monitor(directory, decode=decode)
    async with LogListening(follower_of(directory), news, poll_s=every_s, queue_bytes=QUEUE_BYTES) as listening:
        while (found := await listening.take()) is not None:
            monitor.take(found)
            if found.batch is None:
                yield monitor


class Monitor:
    """Keeps the state of the recording in a directory; `take` takes what was read, `snapshot` gives the state."""

    def __init__(self, directory: Path, *, decode: bool = True) -> None:
        """Prepare; with ``decode``, run the sources' parsers, for rates of records, damaged messages and gaps."""
        self._directory = directory
        self._decode = decode
        self._part: PartFollower | None = None
        self._sign: Sign | None = None
        self._highest_bytes_per_s = 0.0
        self._sources: dict[str, SourceWatch] = {}
        self._inside: dict[str, list[str]] = {}  # devices by the stream that contains their data
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self._notes: list[str] = []
        self._reserve_bytes = 0
        self._damaged = 0
        self._newest_ns = 0
        self._looked_ns: int | None = None  # newest time at the end of the last look; None: there was no file
        self._began_s = time.monotonic()
        self._grown_s: float | None = None  # when a message newer than those at the beginning was read

    # ------------------------------------------------------------------ reading

    def take(self, found: News) -> None:
        """Take messages or the end of a look; if nothing has been recorded yet, read the end of the newest log."""
        if found.batch is not None:
            if found.part is not self._part:
                self._begin_part(found.part)
            self._take(found.batch)
            return
        self._sign, self._highest_bytes_per_s = found.sign, found.bytes_per_s
        if self._looked_ns is not None and self._newest_ns != self._looked_ns:
            self._grown_s = time.monotonic()
        self._looked_ns = None if self._part is None else self._newest_ns
        if self._part is None and found.part is None:
            self._read_latest()

    def _begin_part(self, part: PartFollower | None) -> None:
        before, self._part = self._part, part
        if before is not None:
            self._damaged += before.damaged
        if part is None or (before is not None and before.info.session_id == part.info.session_id):
            return
        self._sources.clear()
        self._newest_ns = self._damaged = 0
        drivers, self._notes = stored_drivers(part.attachments) if self._decode else ({}, [])
        for source, make_parser in drivers.items():
            self._sources[source] = SourceWatch(source, Decoding(make_parser))
        self._reserve_bytes, self._inside = 0, {}
        try:
            config = stored_config(part.attachments)
        except LogError:
            config = None  # another version's, as the notes report
        if config is not None:
            self._reserve_bytes = int(config.session.reserve_mb * 1e6)
            for kind, name, table in config.device_tables():
                carrier, _, carrier_name = table.transport.partition(":")
                if carrier in ("gnss", "imu", "scanner"):
                    self._inside.setdefault(f"{carrier}/{carrier_name}", []).append(f"{kind}/{name}")

    def _take(self, batch: LogBatch) -> None:
        topic = batch.channel.topic
        self._newest_ns = max(self._newest_ns, int(batch.log_time_ns[-1]))
        source = source_of_topic(topic)
        if source is not None:
            self._watch(source).add_units(batch)
            head = source.removesuffix("/aux")
            for other in [*([head] if head != source else []), *self._inside.get(head, ())]:
                self._watch(other).decode(batch)
        elif topic.startswith("/status/"):
            watch = self._watch(topic.removeprefix("/status/"))
            for time_ns, value in json_objects(batch):
                watch.add_status(time_ns, value)
        elif topic == "/events":
            self._events.extend(value for _, value in json_objects(batch))

    def _watch(self, source: str) -> SourceWatch:
        return self._sources.setdefault(source, SourceWatch(source, None))

    def _read_latest(self) -> None:
        """Read the events of the directory's newest log, which tell why nothing is being recorded now."""
        paths = sorted(self._directory.glob("*.mcap"), key=_modified, reverse=True)
        for path in paths[:1]:
            try:
                part = PartFollower(path)
            except (LogError, OSError):
                return
            self._events.clear()
            for batch in part.tail(TAIL_S):
                if batch.channel.topic == "/events":
                    self._events.extend(value for _, value in json_objects(batch))
            part.close()

    # ------------------------------------------------------------------ report

    @property
    def is_undecided(self) -> bool:
        """True if growth of the log could still prove a recording whose recorder cannot be asked."""
        waiting = self._grown_s is None and time.monotonic() - self._began_s < STALE_S
        return waiting and self._sign is not None and not _is_of_this_boot(self._sign.boot_id)

    def snapshot(self) -> dict[str, Any]:
        """Return the present state as plain values, the form of ``--json``."""
        now_ns = None if self._part is None else self._now_ns(self._part.info)
        why_not = self._why_not_recording(now_ns)
        sources = {} if now_ns is None else self._plain_sources(now_ns)
        if why_not is not None:  # what they last did says nothing about now
            sources = {source: _stale(values) for source, values in sources.items()}
        rate = sum(values["bytes_per_s"] or 0.0 for values in sources.values())
        room = self._room(max(rate, self._highest_bytes_per_s))
        troubles = self._troubles(sources, room) if why_not is None else [why_not]
        verdict = NOT_RECORDING if why_not is not None else DEGRADED if troubles else RECORDING
        found: dict[str, Any] = {
            "verdict": verdict,
            "directory": str(self._directory),
            "session_id": None if self._part is None else self._part.info.session_id,
            "part": None if self._part is None else self._part.number,
            "begun_ns": None if self._part is None else self._part.info.realtime_ns,
            "troubles": troubles,
            "sources": sources,
            "bytes_per_s": round(rate),
            **room,
            "damaged_chunks": self._damaged_chunks,
            "events": list(self._events),
            "notes": self._notes,
        }
        return found | {"sentence": _sentence(found)}

    @property
    def _damaged_chunks(self) -> int:
        return self._damaged + (0 if self._part is None else self._part.damaged)

    def _now_ns(self, session: SessionInfo) -> int:
        """Return the session's host time now; for a log of another computer or boot, the time of the newest message."""
        own = _is_of_this_boot(session.boot_id)
        return time.monotonic_ns() + session.realtime_ns - session.monotonic_ns if own else self._newest_ns

    def _plain_sources(self, now_ns: int) -> dict[str, dict[str, Any]]:
        inside = {source: stream for stream, sources in self._inside.items() for source in sources}
        found = {}
        for source, watch in sorted(self._sources.items()):
            if watch.status:
                found[source] = watch.plain(now_ns)
            elif source in inside:
                found[source] = watch.plain(now_ns) | {"state": f"in {inside[source]}"}
        return found

    def _room(self, bytes_per_s: float) -> dict[str, Any]:
        try:
            disk = os.statvfs(self._directory)
            free = disk.f_bavail * disk.f_frsize
        except OSError:  # gone, for example an unplugged disk
            free = 0
        left_s = max(0, free - self._reserve_bytes) / bytes_per_s if bytes_per_s > 0 else None
        hours = None if left_s is None else round(left_s / 3600, 2)
        return {"free_bytes": free, "reserve_bytes": self._reserve_bytes, "hours_left": hours}

    def _why_not_recording(self, now_ns: int | None) -> str | None:
        sign = self._sign
        if sign is None:
            last = self._events[-1] if self._events else None
            reason = "" if last is None else f"; last event: {last.get('code')}: {last.get('text')}"
            return f"no recording in {self._directory}{reason}"
        if self._part is None or now_ns is None:
            return f"{sign.path.name} cannot be read yet"
        own = _is_of_this_boot(sign.boot_id)  # locks of another computer may be invisible here
        if own and sign.path == self._part.path and not is_being_written(sign.path):
            if self._part.ended:  # before it says that it waits for space, or has ended
                return f"{sign.path.name} is complete, and no other part has begun"
            return f"the recorder of {sign.path.name} has stopped without completing the log"
        if own:
            age_s = (now_ns - self._newest_ns) * 1e-9
        elif self._grown_s is not None:
            age_s = time.monotonic() - self._grown_s
        else:
            looked_s = time.monotonic() - self._began_s
            return f"{sign.path.name} (of another computer or before a restart) has not grown for {looked_s:.0f} s"
        if self._newest_ns and age_s > STALE_S:
            return f"no data were written for {age_s:.0f} s"
        return None

    def _troubles(self, sources: dict[str, dict[str, Any]], room: dict[str, Any]) -> list[str]:
        troubles = []
        for source, values in sources.items():
            status = self._sources[source].status
            words = [source_trouble(source, status) if status else ""]
            if "decoded" in values and (trouble := decoded_trouble(values["decoded"])):
                words.append(trouble if words[0] else f"{source} {trouble}")
            troubles.append(", ".join(filter(None, words)))
        if self._damaged_chunks:
            troubles.append(f"{self._damaged_chunks} DAMAGED chunks in the log")
        hours = room["hours_left"]
        if hours is not None and hours * 3600 < LITTLE_LEFT_S:
            troubles.append(f"space for only {duration_text(hours * 3600)}")
        return list(filter(None, troubles))


def _stale(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a source of which nothing is recorded now."""
    kept = {key: value for key, value in values.items() if key not in ("time_state", "time_sigma_ns", "decoded")}
    return kept | {"state": "stale", "rate_hz": None, "bytes_per_s": None}


def _is_of_this_boot(boot_id: str) -> bool:
    return boot_id == read_boot_id()


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed meanwhile
        return 0.0


def _sentence(found: dict[str, Any]) -> str:
    """Return the line of ``--once``."""
    troubles = "; ".join(found["troubles"])
    if found["verdict"] == NOT_RECORDING:
        return f"NOT RECORDING: {troubles}"
    count = len(found["sources"])
    coming = f"all {count} sources deliver data" if count else "starting"
    room = f"{found['free_bytes'] / 1e9:.1f} GB free"
    if found["hours_left"] is not None:
        room += f" ({duration_text(found['hours_left'] * 3600)})"
    word = "recording" if found["verdict"] == RECORDING else "DEGRADED: recording"
    return f"{word} {found['session_id']} part {found['part']}: {troubles or coming}; {room}"
