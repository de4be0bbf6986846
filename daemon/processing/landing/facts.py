"""Gathers from a log, as it grows, what only the whole flight can say: standing still, corrections, losses, tracks.

Everything follows from the log's messages in their order; no clock is read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.daemon.log.words import source_trouble
from swath.daemon.processing.flightplan.moments import empty_moments
from swath.daemon.processing.landing.command import MARK
from swath.daemon.processing.landing.flown import FlownTrack
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import FixType, GnssFix
from swath.georef.timescales.gps_time import SECOND_NS

STILL_MPS, FLYING_MPS = 0.5, 15.0  # slower, an aircraft stands; faster, it flies, or rolls to take off
APART_NS = 5 * SECOND_NS  # of two positions that give a speed, where the receiver gives none
PAUSE_NS = 30 * SECOND_NS  # a pause of corrections from here on is one
LOST_KEYS = ("lost_kernel", "lost_queue", "lost_write")
MISSED_NS = 3 * SECOND_NS  # units that were recorded so much before the first one that was read: these were not read
KEPT_TROUBLES = 20


@dataclass(slots=True)
class Standing:
    """How long the aircraft stood still before it took off, and since it landed.

    Attributes:
        before_s, after_s: the longest time at one go; of ``after_s``, since it flew last.
        has_flown: it has been faster than `FLYING_MPS`.
        is_flying: its newest speed is.
        first_ns: host time of the first position; None: there is none.
    """

    before_s: float = 0.0
    after_s: float = 0.0
    has_flown: bool = False
    is_flying: bool = False
    first_ns: int | None = None
    _since_ns: int | None = None
    _place: tuple[int, Any] | None = None

    def take(self, fix: GnssFix) -> None:
        """Take the next position of one receiver, in the order of time."""
        if fix.lat_rad is None or fix.lon_rad is None or not fix.valid or fix.fix_type is FixType.NONE:
            return
        now_ns = fix.host_time_ns
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        speed_mps = self._speed(fix, fix.lat_rad, fix.lon_rad)
        if speed_mps is None:
            return
        self.is_flying = speed_mps > FLYING_MPS
        if self.is_flying:
            self.has_flown, self.after_s = True, 0.0
        if speed_mps > STILL_MPS:
            self._since_ns = None
            return
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        seconds = (now_ns - self._since_ns) / SECOND_NS
        if self.has_flown:
            self.after_s = max(self.after_s, seconds)
        else:
            self.before_s = max(self.before_s, seconds)

    def _speed(self, fix: GnssFix, lat_rad: float, lon_rad: float) -> float | None:
        """Return the speed over the ground; None: it is not known yet."""
        if fix.velocity_l is not None and not any(map(math.isnan, fix.velocity_l[:2])):
            return math.hypot(*fix.velocity_l[:2])
        if self._place is None:
            self._place = fix.host_time_ns, e_from_geodetic(lat_rad, lon_rad, 0.0)
            return None
        before_ns, before_e = self._place
        passed_ns = fix.host_time_ns - before_ns
        if passed_ns < APART_NS:
            return None
        place_e = e_from_geodetic(lat_rad, lon_rad, 0.0)
        self._place = fix.host_time_ns, place_e
        return float(np.linalg.norm(place_e - before_e)) / (passed_ns / SECOND_NS)


@dataclass(slots=True)
class Heard:
    """When units of a source were recorded.

    Attributes:
        first_ns, last_ns: log times.
        units: number.
        longest_ns: the longest pause between two, and ``paused_ns`` the sum of those from `PAUSE_NS` on.
    """

    first_ns: int
    last_ns: int
    units: int = 0
    longest_ns: int = 0
    paused_ns: int = 0

    def take(self, times: Int64Array) -> None:
        """Take log times (n,)."""
        pauses = np.diff(np.concatenate([[self.last_ns], times]))
        self.units += len(times)
        self.longest_ns = max(self.longest_ns, int(pauses.max()))
        self.paused_ns += int(pauses[pauses >= PAUSE_NS].sum())
        self.last_ns = max(self.last_ns, int(times.max()))


@dataclass
class LogFacts:
    """Collects what the log says of a flight.

    Args:
        begun_ns: host time at which the recording began.

    Attributes:
        heard: by source, of those that are neither device nor pulse: corrections and raw ones.
        standing: by receiver.
        fixes: by receiver, number of positions by quality.
        statuses: by source, the newest account of the recorder.
        troubles: errors among the recording's events, in words, the first ones.
        read_from_ns: log time of the first message that was read.
        missed_ns: log time of a scanner's data that were recorded before live began, at least.
        marked_ns: log time of the newest mark that asks for the verdict; None: there is none.
        flown: what a prediction of the calibration needs.
    """

    begun_ns: int
    heard: dict[str, Heard] = field(default_factory=dict)
    standing: dict[str, Standing] = field(default_factory=dict)
    fixes: dict[str, Counter[str]] = field(default_factory=dict)
    statuses: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    troubles: list[str] = field(default_factory=list)
    errors: int = 0
    read_from_ns: int | None = None
    newest_ns: int = 0
    missed_ns: int = 0
    marked_ns: int | None = None
    has_ended: bool = False
    flown: FlownTrack = field(default_factory=FlownTrack)
    _recorded_ns: dict[str, int] = field(default_factory=dict)
    _seen: set[str] = field(default_factory=set)
    _rows: list[StructArray] = field(default_factory=list)

    # ------------------------------------------------------------------ messages

    def units(self, source: str, times: Int64Array) -> None:
        """Take log times (n,) of a source's units."""
        self._note_time(times)
        if source not in self._seen:
            self._seen.add(source)
            if source.startswith("scanner/") and source in self._recorded_ns:
                missed_ns = int(times[0]) - self._recorded_ns[source]
                self.missed_ns = max(self.missed_ns, missed_ns if missed_ns > MISSED_NS else 0)
        if source.startswith(("corrections/", "raw/")):
            if source not in self.heard:
                self.heard[source] = Heard(int(times[0]), int(times[0]))
            self.heard[source].take(times)

    def _note_time(self, times: Int64Array) -> None:
        self.read_from_ns = int(times[0]) if self.read_from_ns is None else self.read_from_ns
        self.newest_ns = max(self.newest_ns, int(times.max()))

    def event(self, time_ns: int, event: Mapping[str, Any]) -> None:
        """Take an event of the recording."""
        code, text = event.get("code"), str(event.get("text", ""))
        if code == "mark" and text.lower().startswith(MARK):
            self.marked_ns = time_ns
        if code == "session_ended":
            self.has_ended = True
        if event.get("severity") in ("error", "critical"):
            self.errors += 1
            if len(self.troubles) < KEPT_TROUBLES:
                self.troubles.append(f"{event.get('source', '')} {code}: {text}")

    def status(self, source: str, time_ns: int, status: Mapping[str, Any]) -> None:
        """Take the recorder's account of a source."""
        self.statuses[source] = status
        if status.get("units") and source not in self._recorded_ns:
            self._recorded_ns[source] = time_ns

    def fix(self, source: str, fix: GnssFix) -> None:
        """Take a position of a receiver's first antenna."""
        if fix.antenna == "primary" and (fix.lat_rad is not None or fix.fix_type is FixType.NONE):
            quality = fix.fix_type if fix.valid else FixType.NONE
            self.fixes.setdefault(source, Counter())[quality.name.lower()] += 1
            self.standing.setdefault(source, Standing()).take(fix)

    def moments(self, rows: StructArray) -> None:
        """Take moments (n,) whose returns are complete."""
        kept = rows[rows["gps_ns"] % SECOND_NS == 0]
        if len(kept):
            self._rows.append(kept)

    # ------------------------------------------------------------------ what follows

    @property
    def track(self) -> StructArray:
        """The moments of the flight so far, one a second."""
        if len(self._rows) > 1:
            self._rows = [np.concatenate(self._rows)]
        return self._rows[0] if self._rows else empty_moments(0)

    @property
    def lost(self) -> dict[str, int]:
        """Units lost by the recorder, by source; of those alone that lost any."""
        sums = {source: sum(int(status.get(key) or 0) for key in LOST_KEYS) for source, status in self.statuses.items()}
        return {source: count for source, count in sorted(sums.items()) if count}

    @property
    def unaccounted(self) -> dict[str, int]:
        """Units that the recorder's own counters do not account for, by source."""
        found = {}
        for source, status in sorted(self.statuses.items()):
            counts = [status.get(key) for key in ("units", "written", *LOST_KEYS)]
            if all(isinstance(count, int) for count in counts):
                units, *others = (int(str(count)) for count in counts)
                if units != sum(others):
                    found[source] = units - sum(others)
        return found

    @property
    def source_troubles(self) -> list[str]:
        """Present troubles of sources, in words."""
        found = []
        for source, status in sorted(self.statuses.items()):
            try:
                found.append(source_trouble(source, status))
            except (KeyError, TypeError, ValueError):  # of another version
                found.append(f"{source}: its status cannot be read")
        return [words for words in found if words]

    @property
    def late_ns(self) -> int:
        """How long the recording had run when live began, at least."""
        began_ns = 0 if self.read_from_ns is None else self.read_from_ns - self.begun_ns
        return max(self.missed_ns, began_ns if began_ns > PAUSE_NS else 0)
