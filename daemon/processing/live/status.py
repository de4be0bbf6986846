"""Reports how the live georeferencer does: rates, fates, latencies, time, coverage; as plain values
and as a sentence.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swath.calib.strips.standards import QUALITY_LEVELS
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.processing.carried_verdict import first_lines
from swath.daemon.processing.live.files import exchange_file
from swath.daemon.processing.live.follow import BEHIND_NS, LiveFollower
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.points.time_checks import time_trouble
from swath.daemon.processing.setup.setup import Setup
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import FATE_NAMES
from swath.georef.records import GnssFix
from swath.georef.stream.stream import Stream

STATUS = "live.json"
WINDOW_S = 10.0  # period that latencies are reported for
EVERY = 97  # one of so many of a block's points is timed
LATE_S = 1.0
ASK_NS = 1_000_000_000
SHOWN_LINES = 6  # to be flown again, in the sentence
LATENCIES = ("p50", "p95", "max")


class Latencies:
    """Time differences in seconds of the last moments."""

    def __init__(self) -> None:
        self._blocks: deque[tuple[float, FloatArray | float]] = deque()

    def add(self, seconds: FloatArray | float) -> None:
        """Add time differences of the present moment."""
        now_s = time.monotonic()
        self._blocks.append((now_s, seconds))
        while self._blocks and now_s - self._blocks[0][0] > WINDOW_S:
            self._blocks.popleft()

    def plain(self) -> dict[str, float] | None:
        """Return p50, p95 and max; None if there are no recent values."""
        now_s = time.monotonic()
        latest = [seconds for at_s, seconds in self._blocks if now_s - at_s <= WINDOW_S]
        if not latest:
            return None
        values = np.quantile(np.hstack(latest), [0.5, 0.95, 1.0])
        return dict(zip(LATENCIES, np.round(values, 4).tolist(), strict=True))


class LiveStatus:
    """Collects the status of one recording; `plain` returns it.

    Attributes:
        navigation: what the navigator waits for, or how it began, in words; None: the device's own INS is used.
    """

    def __init__(
        self, setup: Setup, stream: Stream, products: LiveProducts, fixes: Mapping[str, GnssFix] | None = None
    ) -> None:
        self.navigation: str | None = None
        self._fixes_seen = {} if fixes is None else fixes
        self._setup, self._stream, self._products = setup, stream, products
        self._overlap_limits = {
            "wanted": setup.config.tables.plan.wanted.quality_level,
            "limits_m": {level.name: level.overlap_m for level in QUALITY_LEVELS},
        }
        self._pulse: dict[str, Latencies] = {}
        self._log: dict[str, Latencies] = {}
        self._newest_ns: dict[str, int] = {}  # log time of a source's newest unit
        self._sources: dict[str, str | None] = {}  # by topic
        self._offsets: dict[str, tuple[int, int | None]] = {}  # by scanner: host time, and GPS time minus host time
        self._points_before: Counter[str] = Counter()
        self._brief_before: Counter[str] = Counter()
        self._fates_before: dict[str, Counter[str]] = {}
        self._refused_before: dict[str, Counter[str]] = {}
        self._told_s = time.monotonic()

    def note_batch(self, batch: LogBatch, now_ns: int) -> None:
        """Note that messages have been read, at a host time."""
        topic = batch.channel.topic
        if topic not in self._sources:
            self._sources[topic] = source_of_topic(topic)
        source = self._sources[topic]
        if source is None:
            return
        newest_ns = int(batch.log_time_ns[-1])
        if source not in self._log:
            self._log[source], self._newest_ns[source] = Latencies(), newest_ns
        self._newest_ns[source] = max(self._newest_ns[source], newest_ns)
        self._log[source].add((now_ns - newest_ns) * 1e-9)

    def note_points(self, name: str, time_ns: Int64Array, now_ns: int) -> None:
        """Note that points have come out, at a host time; time_ns (n,) are their pulses' times."""
        offset_ns = self._gps_minus_host_ns(name, now_ns)
        if offset_ns is not None:
            latest: FloatArray = (now_ns + offset_ns - time_ns[::EVERY]) / 1e9
            self._pulse.setdefault(f"scanner/{name}", Latencies()).add(latest)

    def _gps_minus_host_ns(self, name: str, host_ns: int) -> int | None:
        """Return GPS minus host time by the scanner's clock, asked once a second: clock drift within that is
        negligible.
        """
        asked_ns, offset_ns = self._offsets.get(name, (0, None))
        if offset_ns is not None and abs(host_ns - asked_ns) < ASK_NS:
            return offset_ns
        host = self._stream.clocks.host
        device = host.plan.devices.get(f"scanner/{name}")
        if device is None:
            return None
        gps_ns, sigma_ns = host.gps_from_host(device.clock, np.array([host_ns]))
        offset_ns = int(gps_ns[0]) - host_ns if np.isfinite(sigma_ns[0]) else None
        self._offsets[name] = host_ns, offset_ns
        return offset_ns

    def plain(self, follower: LiveFollower | None, now_ns: int) -> dict[str, Any]:
        """Return the status at a host time; without a follower, finished logs are being read."""
        stream, products = self._stream, self._products
        now_s = time.monotonic()
        passed_s = max(1e-3, now_s - self._told_s)
        rates = {
            name: round((products.points[name] - self._points_before[name]) / passed_s) for name in stream.scanners
        }
        self._told_s, self._points_before = now_s, products.points.copy()
        found: dict[str, Any] = {
            "points": {name: products.points[name] for name in stream.scanners},
            "points_per_s": rates,
            "waiting": {name: stream.waiting(name) for name in stream.scanners},
            "navigation": self.navigation,
            "fates": {name: self._fates(name) for name in stream.scanners},
            "without_time": [line for name in stream.scanners if (line := self._without_time(name, now_ns))],
            "latency_s": {
                source: {
                    "pulse": self._pulse[source].plain() if source in self._pulse else None,
                    "log": latencies.plain(),
                    "newest_age": round((now_ns - self._newest_ns[source]) * 1e-9, 3),
                }
                for source, latencies in sorted(self._log.items())
            },
            "time": self._clock_states(now_ns),
            "trajectory": {"source": self._trajectory_source, "covered_until_gps_ns": stream.path.covered_until_ns},
            "pose": products.pose(),
            "ground": products.look.ground(),
            "gnss": {source: fix_in_words(fix, now_ns) for source, fix in sorted(self._fixes_seen.items())},
            "overlap": products.map.comparison.present() | self._overlap_limits,
            "live_mcap": {"points_written": products.shown, "points_not_written": products.unwritten},
            "free_bytes": products.room.free_bytes,
            "stops_writing_at_bytes": products.room.least_bytes,
            "tiles": {"sequence": products.map.sequence, "trouble": products.map.trouble},
            "trouble": products.trouble,
        } | products.origin()
        if follower is not None:
            found |= {
                "behind_s": round(max(0, follower.newest_ns - follower.read_ns) * 1e-9, 3),
                "live_skipped_s": round(follower.skipped_ns * 1e-9, 3),
                "damaged_chunks": follower.damaged + (follower.part.damaged if follower.part else 0),
            }
        return found

    def brief(self, now_ns: int, passed_s: float) -> dict[str, Any]:
        """Return what `sentence` tells, of the log's time only: ``passed_s`` have passed since the last call."""
        points, names = self._products.points, self._stream.scanners
        rates = {name: round((points[name] - self._brief_before[name]) / max(passed_s, 1e-3)) for name in names}
        self._brief_before = points.copy()
        return {
            "points": {name: points[name] for name in names},
            "points_per_s": rates,
            "fates": {name: self._fates(name) for name in names},
            "latency_s": {},
            "time": self._clock_states(now_ns),
            "trouble": self._products.trouble,
        }

    def _fates(self, name: str) -> dict[str, int]:
        return {FATE_NAMES[fate]: count for fate, count in self._stream.fates(name).items()}

    def _without_time(self, name: str, now_ns: int) -> str:
        """Return why new returns of a scanner have no time; empty if there are few or none."""
        source, clocks = f"scanner/{name}", self._stream.clocks
        fates, refused = Counter(self._fates(name)), Counter(clocks.refused(source))
        new_fates = fates - self._fates_before.get(name, Counter())
        new_refused = refused - self._refused_before.get(name, Counter())
        self._fates_before[name], self._refused_before[name] = fates, refused
        device = clocks.host.plan.devices.get(source)
        status = None if device is None else clocks.host.status(device.clock, now_ns)
        return time_trouble(name, new_fates, new_refused, status, clocks.stamps(source))

    @property
    def _trajectory_source(self) -> str | None:
        """The source of the trajectory; a receiver that could send INS solutions but sends none is not the source."""
        return self._setup.sources.ins_source if self.navigation is None else "navigated"

    def _clock_states(self, now_ns: int) -> dict[str, Any]:
        host = self._stream.clocks.host
        states = {}
        for source in host.by_source:
            status = host.status(source, now_ns)
            sigma_ns = round(status.sigma_ns, 1) if np.isfinite(status.sigma_ns) else None
            states[source] = {"state": status.state.name, "sigma_ns": sigma_ns}
        return states


def fix_in_words(fix: GnssFix, now_ns: int) -> dict[str, Any]:
    """Return a receiver's newest position for people, at a host time.

    ``sigma_m`` is that of north, east, down; it and ``satellites`` are None where the receiver does not give them.
    """
    sigma_m = None
    if fix.position_cov_l is not None and np.isfinite(fix.position_cov_l.diagonal()).all():
        sigma_m = np.round(np.sqrt(np.maximum(fix.position_cov_l.diagonal(), 0.0)), 4).tolist()
    return {
        "fix": fix.fix_type.name.lower(),
        "valid": fix.valid,
        "satellites": fix.satellites,
        "sigma_m": sigma_m,
        "age_s": round((now_ns - fix.host_time_ns) * 1e-9, 3),
    }


def sentence(found: dict[str, Any]) -> str:
    """Return the status as one line for people."""
    if "points" not in found:
        return str(found["state"])
    rate = sum(found["points_per_s"].values())
    unusable = first_lines(found.get("verdict") or {})[:1]
    parts = [
        *unusable,
        f"{found['state']} {found['session_id']}",
        f"{sum(found['points'].values()):,} points, {rate:,} a second",
    ]
    worst_s = _behind_s(found)
    if worst_s is not None:
        late = "LATE: " if worst_s > LATE_S else ""
        parts.append(f"{late}{worst_s:.2f} s behind the pulse")
    parts += _lines(found.get("lines") or {})
    left_out = Counter[str]()
    for fates in found["fates"].values():
        left_out.update({fate: count for fate, count in fates.items() if fate != "georeferenced"})
    parts += [f"{count:,} {fate.replace('_', ' ')}" for fate, count in left_out.most_common(3)]
    if found.get("live_skipped_s"):
        parts.append(f"{found['live_skipped_s']:.1f} s SKIPPED, more than {BEHIND_NS / 1e9:.0f} s behind")
    if found.get("damaged_chunks"):
        parts.append(f"{found['damaged_chunks']} chunks of the log DAMAGED")
    parts += [*found.get("without_time", []), *_not_locked(found)[:3]]
    parts += [str(found[key]) for key in ("trouble", "points_file") if found.get(key)]
    return "; ".join(parts)


def _lines(lines: dict[str, Any]) -> list[str]:
    """Return the line that is flown, and those to be flown again, in words."""
    parts = [f"on {_named(lines['current'])}"] if lines.get("current") else []
    again = lines.get("fly_again") or []
    if again:
        more = f" and {len(again) - SHOWN_LINES} more" if len(again) > SHOWN_LINES else ""
        parts.append(f"FLY AGAIN: {', '.join(again[:SHOWN_LINES])}{more}")
    return [*parts, *([lines["trouble"]] if lines.get("trouble") else [])]


def _named(name: str) -> str:
    return name if name.startswith("strip ") else f"line {name}"


def is_well(found: dict[str, Any]) -> bool:
    """Return True if points of every scanner come in time and there is no trouble, so that an operator need not act."""
    if "points" not in found:
        return False
    wrong = [found.get(key) for key in ("trouble", "points_file", "live_skipped_s", "damaged_chunks", "without_time")]
    comes = all(rate > 0 for rate in found["points_per_s"].values()) and (_behind_s(found) or 0.0) <= LATE_S
    return comes and not any(wrong) and not _not_locked(found)


def _behind_s(found: dict[str, Any]) -> float | None:
    """Return how far points are behind their pulses: the worst scanner's 95 % quantile; None if there are no points."""
    return max((value["pulse"]["p95"] for value in found["latency_s"].values() if value["pulse"]), default=None)


def _not_locked(found: dict[str, Any]) -> list[str]:
    return [f"{source} {one['state']}" for source, one in found["time"].items() if one["state"] != "LOCKED"]


def write_status(folder: Path, found: dict[str, Any]) -> None:
    """Replace ``live.json`` by the newest status.

    Raises:
        OSError: the file cannot be written.
    """
    exchange_file(folder, STATUS, (json.dumps(found, indent=2) + "\n").encode())
