"""Collects what the console shows: the recorder's state, live's files, the last ten minutes as graphs."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from swath.daemon.console.background import Background
from swath.daemon.console.painting import Painter
from swath.daemon.monitor.display import DEGRADED, NOT_RECORDING, RECORDING, Monitor, follower_of, news
from swath.daemon.processing.landing.command import PREDICTED, VERDICT
from swath.daemon.processing.live.tiles import INDEX, TILES

EVERY_S = 1.0
MAP_EVERY_S, LEAST_S = 1.3, 0.6  # while the map changes: at the latest, and from when on for the map's sake
SOON_S = 0.2  # between two looks at how to steer, and at whether the map has changed: nobody should wait for these
HISTORY_S = 600
EVENTS_KEPT = 500
STALE_S = 5.0  # live writes its status each second
MOST_BYTES = 1 << 23  # of one of live's files
WORDS = {RECORDING: "RECORDING", DEGRADED: "DEGRADED", NOT_RECORDING: "NOT RECORDING"}
LIVE_STATUS, LIVE_LINES, LIVE_STEERING = "live.json", "lines.json", "steering.json"
OVERLAP_MEDIAN, OVERLAP_RMS = "overlap, median dz m", "overlap, RMSDz m"  # as look.js names them
LOOKS = {"profile": ("profile.json", "application/json"), "recent": ("recent.bin", "application/octet-stream")}

Plain = dict[str, Any]


@dataclass(slots=True)
class JsonFile:
    """A file that another process replaces; it is read only when it has changed.

    Attributes:
        age_s: seconds since it was written; infinite if there is none.
    """

    path: Path
    age_s: float = float("inf")
    _read: tuple[int, int] = (-1, -1)
    _content: Plain | None = None

    @property
    def sign(self) -> str:
        """A text that changes when the file does."""
        return "-".join(f"{number:x}" for number in self._read)

    def content(self) -> Plain | None:
        """Return the newest readable content; None if there is no such file."""
        try:
            found = self.path.stat()
        except OSError:
            self._content, self.age_s = None, float("inf")
            return None
        self.age_s = max(0.0, time.time() - found.st_mtime)
        key = found.st_mtime_ns, found.st_size
        if key != self._read and found.st_size <= MOST_BYTES:
            try:
                content = json.loads(self.path.read_bytes())
            except (OSError, ValueError, RecursionError):
                return self._content
            if isinstance(content, dict):
                self._content, self._read = content, key
        return self._content


@dataclass(frozen=True, slots=True)
class LookFile:
    """A file of the last moments, which live replaces and pages read as it is."""

    path: Path
    media_type: str

    def read(self, known: str) -> tuple[str, bytes | None]:
        """Return the file's sign and its content; None if the sign is ``known`` already. No sign: no such file."""
        try:
            found = self.path.stat()
            sign = f'"{found.st_mtime_ns:x}-{found.st_size:x}"'
            if sign == known or found.st_size > MOST_BYTES:
                return sign, None
            return sign, self.path.read_bytes()
        except OSError:
            return "", None


def sign_of(path: Path) -> str:
    """Return a text that changes when a file is replaced; empty: there is none."""
    try:
        found = path.stat()
    except OSError:
        return ""
    return f"{found.st_mtime_ns:x}-{found.st_size:x}"


@dataclass(slots=True)
class Numbered:
    """Numbers the events of a recording, so that pages can acknowledge them; the monitor forgets old ones."""

    events: deque[Plain] = field(default_factory=lambda: deque(maxlen=EVENTS_KEPT))
    _seen: deque[tuple[Any, ...]] = field(default_factory=lambda: deque(maxlen=2 * EVENTS_KEPT))
    _number: int = 0

    def take(self, events: list[Plain]) -> None:
        """Take the monitor's latest events, some of which may be known."""
        for event in events:
            key = tuple(str(event.get(name)) for name in ("time_ns", "source", "code", "text"))
            if key in self._seen:
                continue
            self._seen.append(key)
            self._number += 1
            time_ns = event.get("time_ns")
            time_ms = time_ns // 1_000_000 if isinstance(time_ns, int) else None
            shown = {name: str(event.get(name, ""))[:400] for name in ("source", "code", "text", "severity")}
            self.events.append({"number": self._number, "time_ms": time_ms, **shown})


class Watch(threading.Thread):
    """Reads once a second; `latest` is the newest snapshot, `steering` how to steer; both are replaced, never changed.

    Args:
        directory: log directory of the recorder.
        live: folder of live's files.
        tell: called after each reading, in this thread.
    """

    def __init__(self, directory: Path, live: Path, tell: Callable[[], None] = lambda: None) -> None:
        super().__init__(name="watch", daemon=True)
        self.latest: Plain = {}
        self.painter = Painter(live)
        self.background: Background | None = None
        self._follower, self._monitor = follower_of(directory), Monitor(directory)
        self.steering: Plain = {}
        self._live, self._lines = JsonFile(live / LIVE_STATUS), JsonFile(live / LIVE_LINES)
        self._steering = JsonFile(live / LIVE_STEERING)
        self._map = live / TILES / INDEX
        self.live, self._verdict, self._predicted = live, JsonFile(live / VERDICT), JsonFile(live / PREDICTED)
        self.looks = {name: LookFile(live / file, kind) for name, (file, kind) in LOOKS.items()}
        self.tell = tell
        self._events = Numbered()
        self._session: str | None = None
        self._geometry: tuple[tuple[str, int], Plain | None] = (("", 0), None)
        self._history: deque[tuple[int, dict[str, float]]] = deque(maxlen=HISTORY_S)
        self._ended, self._reading = threading.Event(), threading.Lock()

    def run(self) -> None:
        """Read until `close`: how to steer as often as live tells it, all once a second, with the map's changes.

        These are shown as soon as they are there: a page should not wait for the next second.
        """
        read_s = next_s = time.monotonic()
        while not self._ended.wait(SOON_S):
            steering, map_sign = self._steering.content() or {}, sign_of(self._map)
            now_s, has_changed = time.monotonic(), map_sign != self.latest.get("map", map_sign)
            is_due = now_s >= (read_s + LEAST_S if has_changed else next_s)
            if is_due:
                read_s, next_s = now_s, now_s + (MAP_EVERY_S if has_changed else EVERY_S)
                self.read()
            if is_due or steering != self.steering:
                self.steering = steering
                self.tell()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        if self.is_alive():
            self.join()
        self._follower.close()

    def read(self) -> None:
        """Read once and replace `latest`."""
        for one in news(self._follower):
            if one.item is not None:
                self._monitor.take(one.item)
        found = self._monitor.snapshot()
        if found["session_id"] != self._session:
            self._session = found["session_id"]
            self._events = Numbered()
        self._events.take(found["events"])
        map_sign = sign_of(self._map)  # before its content is read
        live, lines = self._live.content(), self._lines.content()
        live_age_s = self._live.age_s if live is not None else None
        is_live = live_age_s is not None and live_age_s < STALE_S
        now_ms = time.time_ns() // 1_000_000
        snapshot = {
            "now_ms": now_ms,
            "header": header(found, live if is_live else None, lines if is_live else None),
            "sources": found["sources"],
            "notes": found["notes"],
            "events": list(self._events.events),
            "live": live or {},
            "live_is_current": is_live,
            "lines": lines or {},
            "landing": self._landing(),
            "legend": self.painter.legend(),
            "map": map_sign,
            "drawn": self._drawn(lines),
            "extent_m": self.painter.extent_m,
            "background": None if self.background is None else self.background.plain(),
        }
        series = series_of(found, live if is_live else None)
        snapshot["series"] = series
        self._history.append((now_ms, series))
        self.latest = snapshot

    def verdict(self) -> tuple[Plain | None, str]:
        """Return live's newest verdict before landing, and its sign, which changes with it; None, no sign: none.

        ``predicted`` is what the lines flown would determine of the calibration, if live has computed it.
        """
        with self._reading:
            content, predicted = self._verdict.content(), self._predicted.content()
            if content is None:
                return None, ""
            sign = self._verdict.sign if predicted is None else f"{self._verdict.sign}.{self._predicted.sign}"
            return content | {"predicted": predicted or {}}, sign

    def _landing(self) -> Plain | None:
        """Return the verdict in short, for every page."""
        content, sign = self.verdict()
        if content is None:
            return None
        return {"sign": sign, "state": str(content.get("state")), "sentence": str(content.get("sentence"))}

    def _drawn(self, lines: Plain | None) -> Plain | None:
        """Return lines and area in metres of the map's frame; None: there are none, or the map's place is not known."""
        geometry = (lines or {}).get("geometry")
        key = json.dumps(geometry), self.painter.generation
        if key != self._geometry[0] or self._geometry[1] is None:
            try:
                self._geometry = key, None if geometry is None else self.painter.local_m(geometry)
            except (KeyError, TypeError, ValueError):  # of another version
                self._geometry = key, None
        return self._geometry[1]

    def history(self) -> Plain:
        """Return the series of the last ten minutes: ``time_ms`` and for each name values of the same length."""
        rows = list(self._history)
        names = sorted({name for _, series in rows for name in series})
        return {
            "time_ms": [time_ms for time_ms, _ in rows],
            "series": {name: [series.get(name) for _, series in rows] for name in names},
        }


def header(found: Plain, live: Plain | None, lines: Plain | None) -> Plain:
    """Return what one glance has to tell."""
    clocks = {name: one for name, one in found["sources"].items() if "time_state" in one}
    order = ("LOST", "NO_TIME", "COARSE", "HOLDOVER", "LOCKED")
    worst = min(clocks, key=lambda name: _place(order, clocks[name]["time_state"]), default=None)
    return {
        "state": WORDS[found["verdict"]],
        "sentence": worst_thing(found, live, lines),
        "time": None if worst is None else {"source": worst} | _time_of(clocks[worst]),
        "free_bytes": found["free_bytes"],
        "hours_left": found["hours_left"],
        "session_id": found["session_id"],
        "part": found["part"],
        "begun_ms": found["begun_ns"] // 1_000_000 if found["begun_ns"] else None,
    }


def _place(order: tuple[str, ...], state: str) -> int:
    return order.index(state) if state in order else 0


def _time_of(values: Mapping[str, Any]) -> Plain:
    return {"state": values["time_state"], "sigma_ns": values.get("time_sigma_ns")}


def worst_thing(found: Plain, live: Plain | None, lines: Plain | None) -> str:
    """Return the worst thing now in one sentence: of the recorder first, then of live, then of the lines."""
    if found["verdict"] == NOT_RECORDING and found["events"] and found["events"][-1].get("code") == "session_ended":
        return "The recording has ended in order; its log is complete"
    if found["troubles"]:
        return str(found["troubles"][0])
    if live is None:
        return "Everything is recording; swath live does not run, so that neither map nor lines are shown"
    for key in ("trouble", "without_time"):
        said = live.get(key)
        if said:
            return str(said[0] if isinstance(said, list) else said)
    if live.get("live_skipped_s"):
        return f"The map lacks {live['live_skipped_s']:.0f} s, which this computer was too slow for; the log has them"
    again = [str(line.get("name")) for line in (lines or {}).get("lines", []) if line.get("state") == "again"]
    if again:
        return f"Everything is recording; fly again: {', '.join(again)}"
    return "Everything is recording"


def series_of(found: Plain, live: Plain | None) -> dict[str, float]:
    """Return the numbers that the graphs show, each with its unit in the name."""
    series: dict[str, float | None] = {
        "disk free, GB": found["free_bytes"] / 1e9,
        "data, MB/s": found["bytes_per_s"] / 1e6,
    }
    for source, one in found["sources"].items():
        series[f"{source}, units/s"] = one["rate_hz"]
        series[f"{source}, age s"] = one["age_s"]
    if live is not None:
        _add_live(series, live)
    return {name: round(float(value), 4) for name, value in series.items() if isinstance(value, (int, float))}


def _add_live(series: dict[str, float | None], live: Plain) -> None:
    for scanner, rate in live.get("points_per_s", {}).items():
        series[f"scanner/{scanner}, points/s"] = rate
    for source, one in live.get("latency_s", {}).items():
        if one.get("pulse"):
            series[f"{source}, latency s"] = one["pulse"].get("p95")
    for scanner, ground in (live.get("ground") or {}).items():
        for key, words in (
            ("height_above_ground_m", "height above ground m"),
            ("nadir_range_m", "nadir range m"),
            ("returns_per_pulse", "returns per pulse"),
            ("intensity_mean", "intensity"),
        ):
            series[f"scanner/{scanner}, {words}"] = ground.get(key)
    overlap = live.get("overlap") or {}
    series[OVERLAP_MEDIAN], series[OVERLAP_RMS] = overlap.get("median_m"), overlap.get("rms_m")
    sigma = (live.get("pose") or {}).get("sigma_m")
    if sigma:
        series["position sigma, m"] = max(sigma)
