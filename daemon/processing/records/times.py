"""GPS times of records: those that they name, and those of their arrival; for whole logs and as records come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from swath.daemon.devices.listening import Times
from swath.daemon.processing.navigation.observations import gps_times
from swath.daemon.processing.records.tables import GUESSED_LEAP_S, NO_TIME_NS
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.records import EventMark, TimeScale
from swath.georef.stream.clocks import HostClocks
from swath.georef.timescales import SECOND_NS


def named_times(host: HostClocks, source: str, records: Sequence[Any]) -> Times:
    """Return the times (n,) that fixes, headings, marks or time messages of a source name themselves.

    Their sigma is 0, the receiver's own for a mark, and at least 1 s for UTC whose leap seconds are a guess.
    """
    if not records:
        return own_times(np.empty(0, np.int64), np.empty(0, np.bool_))
    clock = source if source in host.by_source else None
    tags = [record.time for record in records]
    named = gps_times(host, clock, [record.host_time_ns for record in records], tags)
    known = np.array([time is not None for time in named], np.bool_)
    times = own_times(np.array([0 if time is None else time for time in named], np.int64), known)
    marked = [record.sigma_s if isinstance(record, EventMark) else None for record in records]
    sigma_s = np.where(known, [sigma or 0.0 for sigma in marked], math.nan)
    if clock is not None and host.status(clock, records[-1].host_time_ns).leap_doubt:
        guessed = known & np.array([tag is not None and tag.scale is TimeScale.UTC for tag in tags], np.bool_)
        sigma_s[guessed] = np.maximum(sigma_s[guessed], GUESSED_LEAP_S)
    return times._replace(sigma_s=sigma_s)


def arrival_times(host: HostClocks, source: str, host_ns: Int64Array, first: str | None) -> Times:
    """Return the times (n,) at which records arrived, by the source's own clock, else by ``first``; None: unknown."""
    clock = source if source in host.by_source else first
    if clock is None:
        return own_times(np.zeros(len(host_ns), np.int64), np.zeros(len(host_ns), np.bool_))
    return clock_times(*host.gps_from_host(clock, host_ns))


def clock_times(gps_ns: Int64Array, sigma_ns: FloatArray) -> Times:
    """Return times (n,) of a clock that is not known where its sigma is not finite."""
    known = np.isfinite(sigma_ns)
    return Times(np.where(known, gps_ns, NO_TIME_NS), np.where(known, sigma_ns / SECOND_NS, math.nan))


def own_times(gps_ns: Int64Array, known: BoolArray) -> Times:
    """Return times (n,) that a device gives itself, where they are known."""
    return Times(np.where(known, gps_ns, NO_TIME_NS), np.where(known, 0.0, math.nan))
