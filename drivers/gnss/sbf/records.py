"""Converts Septentrio SBF blocks to records.

Time stamps are in the receiver's time scale (4.1.3), up to half a millisecond off GNSS time where the receiver's clock
runs free. PVTGeodetic and ExtEvent contain the clock's bias themselves; for the other blocks it is the bias of the last
position, extrapolated with its drift.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite, nan, radians, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np

from swath.drivers.gnss.sbf import blocks as sbf
from swath.drivers.parser import ParserCounters
from swath.drivers.record_rows import Row
from swath.georef.arrays import FloatArray
from swath.georef.records import (
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

WEEK_MS = 604_800_000
WEEK_NS = WEEK_MS * MILLISECOND_NS
CLOCK_MODEL_MS = 600_000  # validity of a bias, as long as the receiver itself uses one (ExtEvent)
GREATEST_BIAS_MS = 1000.0  # beyond these two limits the receiver would have set its clock
GREATEST_DRIFT_PPM = 1000.0
GREATEST_EVENT_OFFSET_S = 1.0  # fraction of a millisecond plus a delay set by the user
ERROR_SHIFT = 16  # INS status: the block's info in the low bits, its error above

# Type of solution (mode, bits 0-3) -> the coarse class; other types are NONE. The reference guide lacks 9 and 11:
# Septentrio's sbfdef.h calls them PPP with fixed ambiguities, and RTK float with fixed widelane ambiguities
FIX_TYPES: dict[int, FixType] = {
    1: FixType.SINGLE,
    2: FixType.DIFFERENTIAL,
    3: FixType.MANUAL,  # fixed location
    4: FixType.RTK_FIXED,
    5: FixType.RTK_FLOAT,
    6: FixType.DIFFERENTIAL,  # SBAS
    7: FixType.RTK_FIXED,  # moving base
    8: FixType.RTK_FLOAT,
    9: FixType.PPP,
    10: FixType.PPP,
    11: FixType.RTK_FLOAT,
}
EVENT_CHANNELS = {1: "EventA", 2: "EventB"}


class Stamp(NamedTuple):
    """Name, arrival and time stamp of a block; the week is None where unset or before the date floor."""

    name: str
    host_time_ns: int
    tow_ms: int | None
    week: int | None

    @property
    def epoch(self) -> int:
        """Number that is equal for all blocks of one epoch."""
        return (self.week or 0) * WEEK_MS + (self.tow_ms or 0)

    def tag(self, bias_ns: int = 0) -> TimeTag | None:
        """Return GPS time, corrected for the clock's bias; None while the receiver has no time."""
        if self.tow_ms is None:
            return None
        weeks, time_ns = divmod(self.tow_ms * MILLISECOND_NS - bias_ns, WEEK_NS)
        return TimeTag(TimeScale.GPS, time_ns, week=None if self.week is None else self.week + weeks)


FixPart: TypeAlias = tuple[Stamp, sbf.PvtGeodetic | sbf.PosCovGeodetic | sbf.VelCovGeodetic]
HeadingPart: TypeAlias = tuple[Stamp, sbf.AttEuler | sbf.AttCovEuler]


@dataclass(slots=True)
class ReceiverClock:
    """Models the receiver's clock from the bias and drift of the last position.

    Attributes:
        counters: the parser's counters.
    """

    counters: ParserCounters
    _tow_ms: int | None = None
    _bias_ns: float = 0.0
    _drift_ppm: float = 0.0

    def learn(self, stamp: Stamp, pvt: sbf.PvtGeodetic | sbf.PvtCartesian) -> None:
        """Take the clock bias of a position block, where it contains one."""
        bias_ms, drift_ppm = usable(pvt.clock_bias_ms), usable(pvt.clock_drift_ppm)
        if stamp.tow_ms is not None and abs(bias_ms) < GREATEST_BIAS_MS:
            self._tow_ms, self._bias_ns = stamp.tow_ms, bias_ms * MILLISECOND_NS
            self._drift_ppm = drift_ppm if abs(drift_ppm) < GREATEST_DRIFT_PPM else 0.0

    def tag(self, stamp: Stamp) -> TimeTag | None:
        """Return GPS time of a block without its own bias; count the blocks for which no bias is known."""
        if stamp.tow_ms is None:
            return None
        since_ms = CLOCK_MODEL_MS + 1
        if self._tow_ms is not None:
            since_ms = (stamp.tow_ms - self._tow_ms + WEEK_MS // 2) % WEEK_MS - WEEK_MS // 2
        if abs(since_ms) > CLOCK_MODEL_MS:
            self.counters.errors["clock_bias_unknown"] += 1
            return stamp.tag()
        return stamp.tag(round(self._bias_ns + self._drift_ppm * since_ms))


def usable(value: float) -> float:
    """Return the value, or nan where it is the do-not-use value or not a finite number."""
    return value if value != sbf.FLOAT_UNSET and isfinite(value) else nan


def usable_triple(values: sbf.Triple | None) -> sbf.Triple:
    """Return the three values, nan where unset or where ``values`` is None."""
    return (usable(values[0]), usable(values[1]), usable(values[2])) if values is not None else (nan, nan, nan)


# --- fixes ---


def geodetic_fix(parts: dict[str, FixPart]) -> GnssFix | None:
    """Return the fix of an epoch; None without a PVTGeodetic or without time."""
    stamp, pvt = parts.get("PVTGeodetic", (None, None))
    if stamp is None or not isinstance(pvt, sbf.PvtGeodetic):
        return None
    bias_ms = usable(pvt.clock_bias_ms)
    tag = stamp.tag(round(bias_ms * MILLISECOND_NS) if abs(bias_ms) < GREATEST_BIAS_MS else 0)
    if tag is None:
        return None
    lat, lon, height = usable_triple((pvt.lat_rad, pvt.lon_rad, pvt.height_m))
    there = isfinite(lat) and isfinite(lon) and pvt.mode & sbf.MODE_TYPE_BITS != 0
    north, east, up = usable_triple((pvt.north_mps, pvt.east_mps, pvt.up_mps))
    return GnssFix(
        host_time_ns=stamp.host_time_ns,
        time=tag,
        lat_rad=lat if there else None,
        lon_rad=lon if there else None,
        height_m=height if there and isfinite(height) else None,
        velocity_l=(north, east, -up) if isfinite(north) else None,
        position_cov_l=_position_cov(parts, pvt) if there else None,
        velocity_cov_l=_velocity_cov(parts) if isfinite(north) else None,
        fix_type=FIX_TYPES.get(pvt.mode & sbf.MODE_TYPE_BITS, FixType.NONE),
        satellites=pvt.satellites if pvt.satellites != sbf.U1_UNSET else None,
        valid=there and pvt.error == 0,
        message=stamp.name,
        undulation_m=usable(pvt.undulation_m) if there and isfinite(usable(pvt.undulation_m)) else None,
    )


def _position_cov(parts: dict[str, FixPart], pvt: sbf.PvtGeodetic) -> FloatArray | None:
    """Return the covariance of PosCovGeodetic, else one from the accuracies: h² = 4 (NN + EE), v² = 4 DD."""
    _, cov = parts.get("PosCovGeodetic", (None, None))
    if isinstance(cov, sbf.PosCovGeodetic):
        return _ned_cov(cov.lat_lat, cov.lon_lon, cov.height_height, cov.lat_lon, cov.lat_height, cov.lon_height)
    if sbf.U2_UNSET in (pvt.horizontal_accuracy_cm, pvt.vertical_accuracy_cm):
        return None
    horizontal, vertical = pvt.horizontal_accuracy_cm / 100.0, pvt.vertical_accuracy_cm / 100.0
    return np.diag([horizontal**2 / 8.0, horizontal**2 / 8.0, vertical**2 / 4.0])


def _velocity_cov(parts: dict[str, FixPart]) -> FloatArray | None:
    _, cov = parts.get("VelCovGeodetic", (None, None))
    if not isinstance(cov, sbf.VelCovGeodetic):
        return None
    return _ned_cov(cov.north_north, cov.east_east, cov.up_up, cov.north_east, cov.north_up, cov.east_up)


def _ned_cov(nn: float, ee: float, uu: float, ne: float, nu: float, eu: float) -> FloatArray | None:
    """Convert a covariance of north, east, up to north, east, down; return None where any element is unset."""
    values = [usable(value) for value in (nn, ee, uu, ne, nu, eu)]
    if not all(map(isfinite, values)):
        return None
    return np.array([[nn, ne, -nu], [ne, ee, -eu], [-nu, -eu, uu]])


# --- events and attitude ---


def event_mark(stamp: Stamp, event: sbf.ExtEvent) -> EventMark | None:
    """Return an event with its GPS time, not valid without the clock's bias; None without time."""
    bias_s, offset_s = usable(event.clock_bias_s), usable(event.offset_s)
    known = abs(bias_s) * 1000.0 < GREATEST_BIAS_MS and abs(offset_s) < GREATEST_EVENT_OFFSET_S
    tag = stamp.tag(round(bias_s * SECOND_NS) - round(offset_s * SECOND_NS) if known else 0)
    if tag is None:
        return None
    return EventMark(
        stamp.host_time_ns,
        tag,
        channel=EVENT_CHANNELS.get(event.source, f"Event{event.source}"),
        rising=event.polarity == 0,
        valid=known,
        message=stamp.name,
    )


def antenna_heading(parts: dict[str, HeadingPart], clock: ReceiverClock) -> GnssHeading | None:
    """Return the heading of an epoch, None where it has none. Sigmas are those of AttCovEuler."""
    stamp, attitude = parts.get("AttEuler", (None, None))
    if stamp is None or not isinstance(attitude, sbf.AttEuler) or not isfinite(usable(attitude.heading_deg)):
        return None
    _, cov = parts.get("AttCovEuler", (None, None))
    pitch = usable(attitude.pitch_deg)
    return GnssHeading(
        stamp.host_time_ns,
        clock.tag(stamp),
        heading_rad=radians(attitude.heading_deg),
        pitch_rad=radians(pitch) if isfinite(pitch) else None,
        heading_sigma_rad=_sigma_rad(cov.heading_heading) if isinstance(cov, sbf.AttCovEuler) else None,
        pitch_sigma_rad=_sigma_rad(cov.pitch_pitch) if isinstance(cov, sbf.AttCovEuler) else None,
        valid=attitude.mode != 0 and attitude.error == 0,
        message=stamp.name,
    )


def _sigma_rad(variance_deg2: float) -> float | None:
    value = usable(variance_deg2)
    return radians(sqrt(value)) if value >= 0.0 else None


# --- INS and IMU ---


def ins_row(stamp: Stamp, tag: TimeTag, block: sbf.InsNavGeod, triples: dict[int, sbf.Triple]) -> Row | None:
    """Return a row of `INS_DTYPE`; None where the block has neither position nor attitude nor velocity."""
    position = usable_triple((block.lat_rad, block.lon_rad, block.height_m))
    heading, pitch, roll = usable_triple(triples.get(sbf.INS_ATTITUDE))
    east, north, up = usable_triple(triples.get(sbf.INS_VELOCITY))
    if not any(map(isfinite, (*position, heading, pitch, roll, north, east, up))):
        return None
    heading_sigma, pitch_sigma, roll_sigma = usable_triple(triples.get(sbf.INS_ATTITUDE_SIGMA))
    east_sigma, north_sigma, up_sigma = usable_triple(triples.get(sbf.INS_VELOCITY_SIGMA))
    values = (
        stamp.host_time_ns,
        (tag.week or 0) * WEEK_NS + tag.time_ns,
        *position,
        (north, east, -up),
        radians(roll),
        radians(pitch),
        radians(heading),
        usable_triple(triples.get(sbf.INS_POSITION_SIGMA)),
        (north_sigma, east_sigma, up_sigma),
        (radians(roll_sigma), radians(pitch_sigma), radians(heading_sigma)),
        block.info | block.error << ERROR_SHIFT,
    )
    return Row(InsSolution, values)


@dataclass(slots=True)
class _Halves:
    """Parts of a sample that have arrived so far."""

    stamp: Stamp
    force: sbf.Triple | None = None
    rate: sbf.Triple | None = None
    status: int = 0


@dataclass(slots=True)
class ImuPairs:
    """Joins acceleration and angular rate of one sensor and time stamp to a sample.

    Attributes:
        counters: the parser's counters; a half without the other counts as ``imu_incomplete``, one with an unset value
            as ``imu_value_unset``.
    """

    counters: ParserCounters
    _halves: dict[int, _Halves] = field(default_factory=dict)
    _temperatures: dict[int, float] = field(default_factory=dict)  # °C, by source

    def add(self, stamp: Stamp, tag: TimeTag | None, sets: list[sbf.SensorSet]) -> list[Row]:
        """Take the measurements of a block; return the samples that they completed."""
        rows: list[Row] = []
        for one in sets:
            if one.kind == sbf.SENSOR_INFO:
                hundredths = sbf.SENSOR_TEMPERATURE.unpack(one.data)[0]
                self._temperatures[one.source] = hundredths / 100.0 if hundredths != sbf.I2_UNSET else nan
            elif one.kind in (sbf.SENSOR_ACCELERATION, sbf.SENSOR_ANGULAR_RATE) and self._fill(stamp, one):
                rows.append(self._row(stamp, tag, one.source))
        return rows

    def _fill(self, stamp: Stamp, one: sbf.SensorSet) -> bool:
        """Store one measurement; return whether it completed a sample."""
        values = usable_triple(sbf.SENSOR_TRIPLE.unpack(one.data))
        if not all(map(isfinite, values)):
            self.counters.errors["imu_value_unset"] += 1
            return False
        is_force = one.kind == sbf.SENSOR_ACCELERATION
        halves = self._halves.get(one.source)
        if halves is not None and (
            halves.stamp.epoch != stamp.epoch or (halves.force if is_force else halves.rate) is not None
        ):
            self.counters.errors["imu_incomplete"] += 1
            halves = None
        if halves is None:
            halves = self._halves[one.source] = _Halves(stamp)
        if is_force:
            halves.force, halves.status = values, halves.status | one.info
        else:
            halves.rate, halves.status = values, halves.status | one.info << 8
        return halves.force is not None and halves.rate is not None

    def _row(self, stamp: Stamp, tag: TimeTag | None, source: int) -> Row:
        """Return the sample, in the axes of the wire."""
        halves = self._halves.pop(source)
        rate = usable_triple(halves.rate)
        values = (
            stamp.host_time_ns,
            tag.time_ns if tag is not None else -1,
            -1,
            halves.force,
            (radians(rate[0]), radians(rate[1]), radians(rate[2])),
            self._temperatures.get(source, nan),
            halves.status,
            tag.week if tag is not None and tag.week is not None else -1,
        )
        return Row(ImuSamples, values)
