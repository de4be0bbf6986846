"""Tests the table of docs/adding-a-device.md: what a scanner's driver fills in decides how its returns are timed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import DEVICE_CLOCK_DTYPE, NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import SECOND_NS, DeviceClock, PpsClock, StampScale

GPS_NS, HOST_NS = 1_400_000_000 * SECOND_NS, 1_700_000_000 * SECOND_NS  # of the first edge
LEAP_SECONDS, TAI_MINUS_GPS_S, GPS_EPOCH_UNIX_S = 18, 19, 315_964_800
POWER_ON_NS = 77_000_000_123  # the device's counter at the first edge
SECONDS = 40
HOUR_NS = 3600 * SECOND_NS

Fill = Callable[[StructArray, Int64Array], None]


def host_clock() -> PpsClock:
    """Return the host's clock: edges, and a message of each second 150 ms after its edge."""
    clock = PpsClock(keep_history=True)
    for number in range(SECONDS):
        host_ns = HOST_NS + number * SECOND_NS
        week, of_week_ns = divmod(GPS_NS + number * SECOND_NS, 604_800 * SECOND_NS)
        tag = TimeTag(TimeScale.GPS, of_week_ns, week, leap_seconds=LEAP_SECONDS)
        clock.add_edge(host_ns, number)
        clock.add_message("gnss/rover", TimeMessage(host_ns + 150_000_000, tag, NamesEdge.PREVIOUS))
    return clock


def latched(rows: StructArray, since_ns: Int64Array) -> None:
    rows["device_time_ns"] = since_ns + POWER_ON_NS
    rows["pps_time_ns"] = since_ns // SECOND_NS * SECOND_NS + POWER_ON_NS


def past_hour(rows: StructArray, since_ns: Int64Array) -> None:
    rows["device_time_ns"] = (GPS_NS + since_ns - LEAP_SECONDS * SECOND_NS) % HOUR_NS
    rows["locked"] = 1


def since_1970(rows: StructArray, since_ns: Int64Array) -> None:
    rows["device_time_ns"] = GPS_NS + since_ns + (GPS_EPOCH_UNIX_S + TAI_MINUS_GPS_S) * SECOND_NS


def since_1970_and_locked(rows: StructArray, since_ns: Int64Array) -> None:
    since_1970(rows, since_ns)
    rows["locked"] = 1


def counting(rows: StructArray, since_ns: Int64Array) -> None:
    rows["device_time_ns"] = since_ns + POWER_ON_NS


@pytest.mark.parametrize(
    ("fill", "largest_error_ns", "sigma_ns"),
    [
        (latched, 1.0, 100.0),
        (past_hour, 1.0, 20_000.0),
        (since_1970, 1.0, 20_000.0),
        (since_1970_and_locked, 2e6, 2e6),  # by arrival: the page warns of it
        (counting, 2e6, 2e6),
    ],
)
def test_the_fields_that_a_driver_fills_decide_how_returns_are_timed(
    fill: Fill, largest_error_ns: float, sigma_ns: float
) -> None:
    """Datagrams are 1 ms to 4 ms on their way; only times by arrival show it."""
    device = DeviceClock(host_clock(), past_utc_hour=fill is past_hour, keep_history=True, wanted=StampScale.AUTO)
    since_ns = np.arange(0, (SECONDS - 1) * SECOND_NS, 20_000_000) + 3_123_456
    rows = np.zeros(len(since_ns), DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"] = HOST_NS + since_ns + np.random.default_rng(1).integers(1_000_000, 4_000_000, len(since_ns))
    rows["pps_time_ns"] = rows["pps_count"] = rows["locked"] = -1
    fill(rows, since_ns)
    for second in np.split(rows, SECONDS - 1):
        device.add(second)
    gps_ns, sigmas_ns = device.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
    settled = slice(len(rows) // 2, None)
    assert np.abs(gps_ns - GPS_NS - since_ns)[settled].max() <= largest_error_ns
    assert 0.2 * sigma_ns < np.median(sigmas_ns[settled]) < 1.01 * sigma_ns
