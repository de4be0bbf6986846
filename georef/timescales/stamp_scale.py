"""Find the origin of a scanner's own stamps, if it does not report its lock: by their arrival, or as configured.

A head set by PTP stamps nanoseconds since 1970 in TAI or UTC; a locked Velodyne stamps the time past the UTC hour,
whether or not its position packets are recorded. Such stamps differ from GPS time by a constant, and from their arrival
by some milliseconds. A counter that runs from power-on is within a tenth of a second of the UTC hour once in 36 000
cases, and never within that of TAI since 1970. Only the whole seconds come from the arrival; the fraction is the
head's.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.timescales.gps_time import GPS_EPOCH_UNIX_S, HOUR_NS, SECOND_NS

TAI_MINUS_GPS_S = 19  # since 1980, by definition
# from 2001-09-09 on: counted from 1970; a counter needs 30 years to get there
ABSOLUTE_FROM_NS = 1_000_000_000 * SECOND_NS
# minimum span of stamps: after one second their origin is not chance; their drift is given from five on
LEAST_SPAN_S = 1.0
LEAST_SECONDS = 5
GREATEST_LATENCY_NS = 100_000_000  # greatest latency of the quickest datagram of a second
AHEAD_NS = 5_000_000  # a datagram cannot come before its pulse, but the host's clock may have this error
LOCKED_SIGMA_NS = 20_000.0  # makers state 10 µs to 50 µs for a head locked to PPS; PTP is better
# over the log, of the head's stamps against GPS time: a greater drift means a free-running head
GREATEST_DRIFT_NS = 2_000_000.0
SIGMAS = 3.0
DATED_FROM_S = 60  # from GPS time: differences from this size on are shown by both dates
NEVER_SET_S = 2 * 86_400  # a wrong time zone or date of a PTP master is smaller; a head that nobody set is years away
UNIX_EPOCH = dt.datetime(1970, 1, 1)  # noqa: DTZ001  the scale of the stamps is what is to be found


class StampScale(StrEnum):
    """The origin from which stamps count."""

    AUTO = "auto"  # in the configuration: the origin is to be found
    FREE = "free"
    HOUR = "utc-hour"
    TAI = "ptp-tai"
    UTC = "ptp-utc"


@dataclass(frozen=True, slots=True)
class Stamps:
    """The origin of a head's stamps, found or configured.

    offset_ns: GPS time less stamp, of absolute stamps. sigma_ns: of one stamp. text: the reason, with figures. brief:
    they cover less than a second, before the head itself reports its origin. never_set: they show a date days from GPS
    time, so that neither PTP nor a receiver has set the head's clock.
    """

    scale: StampScale
    text: str
    offset_ns: int = 0
    sigma_ns: float = LOCKED_SIGMA_NS
    brief: bool = False
    never_set: bool = False


def judge(
    device_ns: Int64Array,
    near_gps_ns: Int64Array,
    near_sigma_ns: FloatArray,
    leap_seconds: int,
    *,
    past_hour: bool,
    wanted: StampScale = StampScale.AUTO,
) -> Stamps | None:
    """Return the origin of stamps; None if there are too few of them, or without a time beside them.

    Args:
        device_ns: (n,) stamps.
        near_gps_ns: (n,) GPS time of their arrival.
        near_sigma_ns: (n,) its sigma.
        leap_seconds: GPS − UTC there.
        past_hour: whether the head stamps the time past the hour while locked.
        wanted: the configured origin; AUTO: to be found.
    """
    if wanted is StampScale.FREE:
        return Stamps(StampScale.FREE, "as configured")
    known = np.isfinite(near_sigma_ns)
    device, near, sigma = device_ns[known], near_gps_ns[known], near_sigma_ns[known]
    if not len(device) or int(near.max() - near.min()) < LEAST_SPAN_S * SECOND_NS:
        return None
    begun = ""
    if not past_hour:
        own = device < ABSOLUTE_FROM_NS
        if own.all() or int(np.ptp(near[~own])) < LEAST_SPAN_S * SECOND_NS:
            return Stamps(StampScale.FREE, "its stamps count from its own start")
        if own.any():
            begun = f"but for {100.0 * own.mean():.0f} % of them, which count from its own start, "
            device, near, sigma = device[~own], near[~own], sigma[~own]
    if past_hour:
        ahead = (device % HOUR_NS + leap_seconds * SECOND_NS - near + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    else:
        ahead = device - GPS_EPOCH_UNIX_S * SECOND_NS - near
    at, quickest = _quickest(near, ahead)
    slack_ns = SIGMAS * float(np.median(sigma))
    if past_hour:
        return _of_hour(at, quickest, slack_ns, wanted)
    found = _absolute(at, quickest, slack_ns, leap_seconds, wanted)
    return replace(found, text=begun + found.text)


def _quickest(near: Int64Array, ahead: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return GPS time, and stamp less arrival, of the least delayed datagram of each second."""
    second = near // SECOND_NS
    order = np.lexsort((ahead, second))
    last = np.append(np.flatnonzero(np.diff(second[order])), len(order) - 1)
    return near[order][last], ahead[order][last]


def _of_hour(at: Int64Array, quickest: Int64Array, slack_ns: float, wanted: StampScale) -> Stamps:
    drift_ns, why = _drift(at, quickest, slack_ns)
    least_ms, most_ms = -int(quickest.max()) / 1e6, -int(quickest.min()) / 1e6
    within = (quickest >= -GREATEST_LATENCY_NS - slack_ns) & (quickest <= AHEAD_NS + slack_ns)
    told = f"they count from the hour of UTC and lie {least_ms:.1f} to {most_ms:.1f} ms before their arrival, {why}"
    if wanted is StampScale.HOUR:
        return Stamps(StampScale.HOUR, f"as configured; {told}", 0, max(LOCKED_SIGMA_NS, drift_ns / 2))
    if not within.all():
        return Stamps(StampScale.FREE, f"{told}: a locked head sends no such stamps")
    if drift_ns > GREATEST_DRIFT_NS:
        return Stamps(StampScale.FREE, f"{told}: they drift like those of a head that has lost its pulse")
    return Stamps(StampScale.HOUR, told, 0, max(LOCKED_SIGMA_NS, drift_ns / 2))


def _absolute(at: Int64Array, quickest: Int64Array, slack_ns: float, leap_seconds: int, wanted: StampScale) -> Stamps:
    names = {TAI_MINUS_GPS_S: StampScale.TAI, -leap_seconds: StampScale.UTC}
    latest_ns = int(np.median(quickest))
    whole_s = -(-(latest_ns - AHEAD_NS) // SECOND_NS)  # the stamps' second; they precede their arrival by some ms
    nearest = min(names, key=lambda count: abs(count * SECOND_NS - latest_ns))
    if abs(nearest * SECOND_NS - latest_ns) <= GREATEST_LATENCY_NS + slack_ns:
        whole_s = nearest  # a coarse host clock determines the second no better than the scale does
    beside = quickest - whole_s * SECOND_NS
    drift_ns, why = _drift(at, quickest, slack_ns)
    offset_ns = -(GPS_EPOCH_UNIX_S + whole_s) * SECOND_NS
    sigma_ns = max(LOCKED_SIGMA_NS, drift_ns / 2)
    least_ms, most_ms = -int(beside.max()) / 1e6, -int(beside.min()) / 1e6
    scale = names.get(whole_s)
    named = scale.value.removeprefix("ptp-").upper() if scale is not None else f"GPS {whole_s:+d} s"
    told = f"they count from 1970 in {named}, {least_ms:.1f} to {most_ms:.1f} ms before their arrival, {why}"
    within = (beside >= -GREATEST_LATENCY_NS - slack_ns) & (beside <= AHEAD_NS + slack_ns)
    usual = "stamps set by PTP lie 0 to 100 ms before their arrival"
    if wanted in (StampScale.TAI, StampScale.UTC):
        other = "" if scale is wanted else "; the whole seconds come from their arrival"
        other += "" if within.all() else f"; {usual}, so these may be up to a second off"
        return Stamps(wanted, f"as configured; {told}{other}", offset_ns, sigma_ns)
    dates = _dates(int(at[0]), whole_s)
    if abs(whole_s) >= NEVER_SET_S:
        return Stamps(StampScale.FREE, f"{dates}: neither PTP nor a receiver has set its clock", never_set=True)
    if abs(whole_s) >= DATED_FROM_S:
        told = f"{dates}, {least_ms:.1f} to {most_ms:.1f} ms before their arrival, {why}"
    doubts = (
        (int(np.ptp(beside)) > SECOND_NS // 2, "their time scale changes during the log"),
        (scale is None, "neither TAI nor UTC; if PTP set them, configure it (clock)"),
        (not within.all(), f"{usual}; if PTP set these, configure it (clock)"),
        (drift_ns > GREATEST_DRIFT_NS, "they drift like those of a head that has lost PTP"),
    )
    doubt = next((text for holds, text in doubts if holds), "")
    if doubt or scale is None:
        return Stamps(StampScale.FREE, f"{told}: {doubt}")
    return Stamps(scale, told, offset_ns, sigma_ns)


def _dates(gps_ns: int, ahead_s: int) -> str:
    """Return the date that stamps show at a GPS time (ns), and that time, for a difference of whole seconds."""
    there_ns = GPS_EPOCH_UNIX_S * SECOND_NS + gps_ns
    return f"they show {date_text(there_ns + ahead_s * SECOND_NS)} at GPS time {date_text(there_ns)}"


def date_text(since_1970_ns: int) -> str:
    """Return date and time of nanoseconds since 1970, in the time scale that they are given in."""
    return f"{UNIX_EPOCH + dt.timedelta(seconds=since_1970_ns // SECOND_NS):%Y-%m-%d %H:%M:%S}"


def _drift(at: Int64Array, quickest: Int64Array, slack_ns: float) -> tuple[float, str]:
    """Return the significant drift of stamps against GPS time over the log, ns, and its description.

    A host without edges drifts itself, so that the head's drift is then not determined.
    """
    span_s = float(at.max() - at.min()) / SECOND_NS
    x = (at - at.min()).astype(np.float64) / SECOND_NS - span_s / 2
    y = (quickest - quickest[0]).astype(np.float64)
    if len(at) < LEAST_SECONDS or slack_ns > SIGMAS * AHEAD_NS:
        return 0.0, f"over {span_s:.0f} s"
    x = x - x.mean()
    slope = float(x @ (y - y.mean()) / (x @ x))
    residual = y - y.mean() - slope * x
    sigma = float(np.sqrt(residual @ residual / max(1, len(x) - 2) / (x @ x)))
    drift_ns = max(0.0, abs(slope) - SIGMAS * sigma) * span_s
    return drift_ns, f"steady to {(abs(slope) + sigma) * 1e-3:.1f} ppm over {span_s:.0f} s"
