"""Tests the rosette: directions and packets, decoded by this project's parser, and keys that a plan cannot have."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, PacketParser
from swath.sim.plan.errors import PlanError
from swath.sim.scanners.rosette import GPS_EPOCH_UNIX_S, RosetteHead, RosetteWire
from tests.drivers.builders import clock_of, feed, returns_of
from tests.sim.heads import measured_of, plan_of, pulse

HEAD: dict[str, Any] = {"scan_hz": 47.0, "prf_hz": 20_000.0, "half_angle_deg": 35.0, "prism_ratio": -0.63}


def head_of(**keys: Any) -> RosetteHead:
    """Return the head of a plan."""
    return RosetteHead(plan_of("rosette", **(HEAD | keys)).tables.scanner["left"], "left")


def test_pulses_fill_a_rosette_about_the_x_axis() -> None:
    pulses = head_of().pulses(0.0, 1.0)
    assert len(pulses) == 20_000
    assert len(head_of().pulses(0.5, 1.0)) == 10_000
    np.testing.assert_allclose(np.linalg.norm(pulses.direction_s, axis=1), 1.0, atol=1e-12)
    off_rad = np.arccos(pulses.direction_s[:, 0])
    assert math.radians(34.9) < off_rad.max() <= math.radians(35.0) + 1e-9
    assert off_rad.min() < math.radians(0.5)
    # the second prism makes 29.61 turns; the part of a turn leaves at most 0.35 · 2 / (2π · 29.61)
    np.testing.assert_allclose(pulses.direction_s.mean(axis=0)[1:], 0.0, atol=3.8e-3)
    # at the beginning both prisms deflect to the left
    assert pulses.direction_s[0] == pytest.approx([math.cos(math.radians(35)), math.sin(math.radians(35)), 0])


@pytest.mark.parametrize("wired", [True, False])
def test_packets_hold_the_strongest_return_and_the_time_of_each_pulse(wired: bool) -> None:
    plan = plan_of("rosette", **HEAD, oscillator={"offset_ppm": 20.0})
    wire = RosetteWire(plan, "left", pulse(plan) if wired else None)
    shots = measured_of(RosetteHead(plan.tables.scanner["left"], "left").pulses(0.0, 1.4))
    units, truth = wire.units(*shots)
    parser = find_driver("scanner", "livox-mid360").make_parser(DeviceSettings("scanner/left"))
    assert isinstance(parser, PacketParser)
    records = feed(parser, [unit.data for unit in units])
    rows, clock = returns_of(records), clock_of(records)
    assert not parser.counters.errors
    number = truth["pulse"]
    assert len(rows) == len(truth)
    place = shots.pulses.number.searchsorted(number)
    np.testing.assert_allclose(rows["range_m"], truth["range_m"], atol=1e-3)
    np.testing.assert_array_equal(rows["channel"], shots.pulses.channel[place])
    flat = np.cos(rows["elevation_rad"])
    ray = [flat * np.cos(rows["encoder_rad"]), flat * np.sin(rows["encoder_rad"]), np.sin(rows["elevation_rad"])]
    missed_m = np.linalg.norm(np.stack(ray, axis=1) - shots.pulses.direction_s[place], axis=1) * rows["range_m"]
    assert missed_m.max() < 1e-3
    if wired:
        begin_ns = plan.start_gps_ns - 1_000_000_000 * (plan.leap_seconds - GPS_EPOCH_UNIX_S)
        assert (clock["locked"] == 1).all()
        assert np.isin(clock["pps_time_ns"] - begin_ns, [0, 1_000_000_000]).all()
        late_ns = rows["device_time_ns"] - begin_ns - 1e9 * shots.pulses.time_s[place]
        assert np.abs(late_ns).max() < 150.0  # a packet says the time from its first to its last pulse in 0.1 µs
    else:
        assert (clock["locked"] == -1).all()
        assert rows["device_time_ns"].max() < 1e12


def test_a_plan_cannot_ask_for_what_such_a_head_does_not_have() -> None:
    with pytest.raises(PlanError, match=r"scanner\.left\.prf_hz: got 5000, want at least 14497"):
        head_of(prf_hz=5000.0)
    with pytest.raises(PlanError, match=r"true\.encoder_latency_us: got 3, want 0"):
        head_of(true={"encoder_latency_us": 3.0})
