"""Tests the origin of a head's stamps: PTP in TAI or UTC, the UTC hour, its own start; found or configured."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import DEVICE_CLOCK_DTYPE
from swath.georef.timescales import DeviceClock, Stamps, StampScale
from swath.georef.timescales.stamp_scale import judge
from tests.builders import NS, START_S, host_clock, host_ns

UNIX_MINUS_GPS_S = 315_964_800  # without leap seconds
LEAP = 18
HOUR = 3600 * NS


def truth_ns(seconds: float = 60.0, step_s: float = 0.02) -> Int64Array:
    """Return GPS times of pulses, ns."""
    times: Int64Array = START_S * NS + np.rint(np.arange(10.0, seconds, step_s) * NS).astype(np.int64)
    return times


def latencies(count: int, least_ms: float = 0.3, typical_ms: float = 0.8) -> Int64Array:
    """Return latencies (n,), ns, between pulse and arrival of a datagram: a minimum and an exponential tail."""
    drawn = least_ms + np.random.default_rng(4).exponential(typical_ms, count)
    return np.rint(drawn * 1e6).astype(np.int64)


def judged(
    stamps: Int64Array,
    gps: Int64Array,
    *,
    past_hour: bool = False,
    sigma_ns: float = 2e3,
    off_ns: int = 0,
    **more: object,
) -> Stamps:
    """Return the judgement by arrivals, where the host's clock is wrong by `off_ns`."""
    near = gps + latencies(len(gps)) + off_ns
    wanted = more.get("wanted", StampScale.AUTO)
    assert isinstance(wanted, StampScale)
    found = judge(stamps, near, np.full(len(gps), sigma_ns), LEAP, past_hour=past_hour, wanted=wanted)
    assert found is not None
    return found


def absolute(gps: Int64Array, beside_gps_s: int) -> Int64Array:
    """Return stamps since 1970, ns, on a scale that differs from GPS time: TAI by +19 s, UTC by −18 s."""
    return gps + (UNIX_MINUS_GPS_S + beside_gps_s) * NS


@pytest.mark.parametrize(("beside_s", "scale"), [(19, StampScale.TAI), (-LEAP, StampScale.UTC)])
@pytest.mark.parametrize(("sigma_ns", "off_ns"), [(2e3, 0), (3e8, 250_000_000), (3e8, -250_000_000)])
def test_ptp_timestamps_are_recognised_and_keep_their_fraction(
    beside_s: int, scale: StampScale, sigma_ns: float, off_ns: int
) -> None:
    """This works with a host clock that is accurate to some tenths of a second only."""
    gps = truth_ns()
    stamps = absolute(gps, beside_s)
    found = judged(stamps, gps, sigma_ns=sigma_ns, off_ns=off_ns)
    assert (found.scale, found.sigma_ns) == (scale, 20_000.0)
    assert np.array_equal(stamps + found.offset_ns, gps)
    assert f"from 1970 in {scale.value[4:].upper()}" in found.text


def test_a_capture_of_two_seconds_is_enough() -> None:
    gps = truth_ns(12)
    assert judged(absolute(gps, 19), gps).scale is StampScale.TAI
    assert judged(hour_stamps(gps), gps, past_hour=True).scale is StampScale.HOUR


def test_absolute_timestamps_of_unknown_scale_run_free_until_configured() -> None:
    """A PTP master whose date is a second off has right fractions, so arrivals decide the second once configured."""
    gps = truth_ns()
    stamps = absolute(gps, 20)
    found = judged(stamps, gps)
    assert found.scale is StampScale.FREE
    assert "GPS +20 s" in found.text
    said = judged(stamps, gps, wanted=StampScale.TAI)
    assert said.scale is StampScale.TAI
    assert "whole seconds come from their arrival" in said.text
    assert np.array_equal(stamps + said.offset_ns, gps)


def test_a_clock_that_nobody_set_is_named_with_its_date() -> None:
    """Pandar64 and Helios heads without GPS or PTP start in 2017 (HesaiLidar_General_ROS #16, rslidar_sdk #210)."""
    gps = truth_ns()
    shown = absolute(gps, 0) - gps[0] + 1_488_416_400 * NS  # 2017-03-02 01:00:00
    shown -= UNIX_MINUS_GPS_S * NS
    found = judged(shown + 628_000_000, gps)
    assert (found.scale, found.never_set) == (StampScale.FREE, True)
    assert found.text.startswith("they show 2017-03-02 01:00:0")
    assert found.text.endswith(": neither PTP nor a receiver has set its clock")


def test_a_date_a_day_off_is_shown_and_can_be_configured() -> None:
    """An Ouster head may add a day to the date of NMEA (ouster-sdk #154); the fraction is right."""
    gps = truth_ns()
    found = judged(absolute(gps, 86_400 - LEAP), gps)
    assert (found.scale, found.never_set) == (StampScale.FREE, False)
    assert "configure it (clock)" in found.text


def test_configured_stamps_without_a_plausible_fraction_are_doubted() -> None:
    gps = truth_ns()
    found = judged(absolute(gps, 19) - 600_000_000, gps, wanted=StampScale.TAI)
    assert found.text.endswith("so these may be up to a second off")


def test_a_counter_since_power_on_runs_free() -> None:
    gps = truth_ns()
    assert judged(gps - gps[0] + 77 * NS, gps).scale is StampScale.FREE


def hour_stamps(gps: Int64Array, off_ns: int = 0, drift_ppm: float = 0.0) -> Int64Array:
    """Return time past the UTC hour, µs."""
    drifted = np.rint((gps - gps[0]) * drift_ppm * 1e-6).astype(np.int64)
    past: Int64Array = (gps - LEAP * NS + off_ns + drifted) % HOUR
    return past


def test_timestamps_of_a_locked_head_are_recognised_as_hours_of_utc() -> None:
    """The stamps cross the turn of the hour."""
    gps = truth_ns() + 3570 * NS
    found = judged(hour_stamps(gps), gps, past_hour=True)
    assert (found.scale, found.sigma_ns) == (StampScale.HOUR, 20_000.0)
    assert "they count from the hour of UTC" in found.text


@pytest.mark.parametrize(("off_s", "drift_ppm"), [(1.0, 0.0), (-1.0, 0.0), (0.3, 0.0), (777.7, 12.0), (0.0, 30.0)])
def test_timestamps_that_do_not_follow_the_hour_run_free(off_s: float, drift_ppm: float) -> None:
    """They are a second off, or elsewhere in the hour, or drift by 30 ppm without a pulse, 9 ms in five minutes."""
    gps = truth_ns(310, 0.1)
    found = judged(hour_stamps(gps, round(off_s * NS), drift_ppm), gps, past_hour=True)
    assert found.scale is StampScale.FREE


def test_a_drift_within_the_limit_is_included_in_the_sigma() -> None:
    """3 ppm over five minutes are 0.9 ms, so the stamps are less accurate than those of a head known to be locked."""
    gps = truth_ns(310, 0.1)
    stamps = hour_stamps(gps, 0, 3.0)
    found = judged(stamps, gps, past_hour=True)
    assert found.scale is StampScale.HOUR
    worst_ns = 3e-6 * 300 * NS
    assert found.sigma_ns >= worst_ns / 3


def test_free_counters_are_rarely_taken_for_the_hour() -> None:
    """Of 600 starts spread evenly over the hour, 0.1 s in 3600 s would fit by chance."""
    gps = truth_ns(20, 0.1)
    off = np.linspace(0, 3600, 600, endpoint=False) + 0.6
    taken = [judged(hour_stamps(gps, round(s * NS)), gps, past_hour=True).scale is StampScale.HOUR for s in off]
    assert sum(taken) == 0


@pytest.mark.parametrize("wanted", [StampScale.HOUR, StampScale.FREE])
def test_the_configured_scale_has_precedence(wanted: StampScale) -> None:
    gps = truth_ns()
    found = judged(hour_stamps(gps), gps, past_hour=True, wanted=wanted)
    assert found.scale is wanted
    assert found.text.startswith("as configured")


def test_without_enough_data_or_a_time_no_scale_is_found() -> None:
    gps = truth_ns(10.9)
    sigma = np.full(len(gps), 2e3)
    assert judge(absolute(gps, 19), gps, sigma, LEAP, past_hour=False) is None
    gps = truth_ns()
    assert judge(absolute(gps, 19), gps, np.full(len(gps), np.inf), LEAP, past_hour=False) is None


# ---------------------------------------------------------------------- while they come


def rows_of(stamps: Int64Array, gps: Int64Array, locked: int = -1) -> StructArray:
    """Return clock samples as they arrive at the host."""
    rows = np.zeros(len(gps), DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"] = host_ns((gps + latencies(len(gps)) - START_S * NS) / NS)
    rows["device_time_ns"] = stamps
    rows["pps_time_ns"] = rows["pps_count"] = -1
    rows["locked"] = locked
    return rows


def errors(clock: DeviceClock, rows: StructArray, gps: Int64Array) -> tuple[FloatArray, FloatArray]:
    placed, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
    return (placed - gps).astype(np.float64), sigma


@pytest.mark.parametrize("hour", [False, True])
def test_a_growing_clock_finds_the_scale_after_some_seconds(hour: bool) -> None:
    """Before that, the sigma is the arrivals' 2 ms, then the stamps' own; batches of rows do not matter."""
    gps = truth_ns(60)
    stamps = hour_stamps(gps) if hour else absolute(gps, 19)
    rows = rows_of(stamps, gps)
    clock = DeviceClock(host_clock(70), past_utc_hour=hour, wanted=StampScale.AUTO)
    for first in range(0, len(rows), 100):
        clock.add(rows[first : first + 100])
        error, sigma = errors(clock, rows[first : first + 100], gps[first : first + 100])
        if first >= 600:
            assert np.abs(error).max() < 1_000
            assert sigma.max() == 20_000.0
        elif first < 400:
            assert sigma.min() > 1e6
    assert clock.stamps is not None
    assert clock.stamps.scale is (StampScale.HOUR if hour else StampScale.TAI)


def test_a_head_that_reports_no_lock_is_not_judged() -> None:
    gps = truth_ns(60)
    rows = rows_of(hour_stamps(gps), gps, locked=0)
    clock = DeviceClock(host_clock(70), past_utc_hour=True, wanted=StampScale.AUTO)
    clock.add(rows)
    assert clock.stamps is None
    assert errors(clock, rows, gps)[1].min() > 1e6


def test_timestamps_that_jump_away_from_their_arrival_are_refused() -> None:
    """A PTP master's date changes in flight; those stamps are counted and get a sigma too large to be used."""
    gps = truth_ns(60)
    stamps = absolute(gps, 19)
    stamps[len(stamps) // 2 :] += 5 * NS
    rows = rows_of(stamps, gps)
    known = Stamps(StampScale.TAI, "", -(UNIX_MINUS_GPS_S + 19) * NS)
    clock = DeviceClock(host_clock(70), wanted=StampScale.AUTO, stamps=known, keep_history=True)
    clock.add(rows)
    _, sigma = errors(clock, rows, gps)
    half = len(gps) // 2
    assert sigma[:half].max() == 20_000.0
    assert sigma[half:].min() > 1e6
    assert clock.status().refused["stamp_jump"] == len(gps) - half


def test_a_head_set_by_ptp_after_its_start_has_time_from_then_on() -> None:
    gps = truth_ns()
    stamps = absolute(gps, 19)
    begun = len(gps) // 3
    stamps[:begun] = gps[:begun] - gps[0] + 7 * NS
    found = judged(stamps, gps)
    assert found.scale is StampScale.TAI
    assert np.array_equal((stamps + found.offset_ns)[begun:], gps[begun:])
    assert "but for 33 % of them, which count from its own start" in found.text
    stamps[:-10] = gps[:-10] - gps[0] + 7 * NS  # too few stamps to determine a scale
    assert judged(stamps, gps).scale is StampScale.FREE


def test_timestamps_that_change_their_scale_are_refused() -> None:
    gps = truth_ns()
    stamps = np.where(np.arange(len(gps)) < len(gps) // 2, absolute(gps, 19), absolute(gps, -LEAP))
    found = judged(stamps, gps)
    assert found.scale is StampScale.FREE
    assert "their time scale changes during the log" in found.text
    assert "neither" not in found.text


@pytest.mark.parametrize("later", [0, 1])
def test_a_late_lock_report_does_not_change_the_judgement_of_earlier_timestamps(later: int) -> None:
    """Hour timestamps before the first position packet hold, whatever the packets report later."""
    gps = truth_ns(60)
    rows, half = rows_of(hour_stamps(gps), gps), len(gps) // 2
    rows["locked"][half:] = later
    clock = DeviceClock(host_clock(70), past_utc_hour=True, wanted=StampScale.AUTO, keep_history=True)
    clock.add(rows)
    error, sigma = errors(clock, rows, gps)
    assert clock.stamps is not None
    assert clock.stamps.scale is StampScale.HOUR
    assert np.abs(error[:half]).max() < 1_000
    assert sigma[:half].max() == 20_000.0
    assert (sigma[half:].max() == 20_000.0) == later
