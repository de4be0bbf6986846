"""Tests Hesai heads with real recordings in dual return against nebula's clouds."""

from __future__ import annotations

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.hesai.gps import encode_gps_packet
from swath.drivers.scanner.hesai.heads import SEVERAL_NAMES
from swath.drivers.scanner.hesai.parser import HesaiParser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import (
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    DeviceClockSamples,
    DeviceStatus,
    ScannerReturns,
    TimeMessage,
)
from tests.drivers.builders import clock_of, feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.recordings import FIXTURES
from tests.drivers.scanner.hesai.builders import MODELS, NOON, Model
from tests.drivers.spinning import are_near, payloads, read_pcd, xyz

XYZ = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
EVERY_MODEL = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.protocol)


def raw_packets(model: Model) -> StructArray:
    return np.frombuffer(b"".join(payloads(model.capture)), dtype=model.head.packet_dtype())


def turns_rad(model: Model, rows: StructArray, raw: StructArray) -> FloatArray:
    """Return the turn between the reading of the azimuth and each return's firing."""
    head = model.head
    most = head.blocks * head.channels
    number, firing = np.divmod((rows["pulse_id"] - rows["pulse_id"][0] // most * most).astype(np.int64), most)
    if "sequence" in (raw.dtype.names or ()):
        number = np.searchsorted(raw["sequence"], raw["sequence"][0] + number)
    times = head.firing_ns(raw, head.blocks // 2)
    row = number * (head.blocks // 2) + firing // head.channels if len(times) > 1 else 0
    turns: FloatArray = times[row, rows["channel"]] * (model.motor_rpm / 60 * 2 * np.pi * 1e-9)
    return turns


@pytest.mark.slow
@EVERY_MODEL
def test_points_agree_with_the_golden_cloud_of_nebula(model: Model) -> None:
    """nebula omits the rotation between reading the azimuth and firing; without it every point is found."""
    parser = model.parser()
    rows = returns_of(feed(parser, payloads(model.capture)))
    assert parser.counters.errors == model.errors
    turned = turns_rad(model, rows, raw_packets(model))
    turn_ns = 60e9 / model.motor_rpm
    recent = rows["device_time_ns"] > rows["device_time_ns"].max() - 2.2 * turn_ns  # with the scan of the cloud
    rows, turned = rows[recent], turned[recent]
    theirs = xyz(read_pcd(FIXTURES / "hesai" / f"{model.cloud}.pcd.gz", XYZ))
    assert len(theirs) > 13_000
    unturned = rows.copy()
    unturned["encoder_rad"] -= turned
    assert are_near(theirs, beam_points(unturned, parser.beams), 1e-4).all()
    assert are_near(theirs[::50], beam_points(rows, parser.beams), 1e-4).mean() < 0.1


@EVERY_MODEL
def test_every_packet_of_a_recording_is_decoded(model: Model) -> None:
    units = payloads(model.capture)
    parser = model.parser()
    records = feed(parser, units)
    assert parser.counters.messages == {"points": len(units)}
    assert parser.counters.bytes == parser.counters.bytes_framed == sum(map(len, units))
    raw = raw_packets(model)
    assert (raw["mode"] == model.mode).all()
    np.testing.assert_allclose(raw["motor_rpm"], model.motor_rpm, atol=1)
    rows, clock = returns_of(records), clock_of(records)
    assert (clock["locked"] == -1).all()
    assert (clock["pps_time_ns"] == -1).all()
    pair = raw["blocks"]["returns"]["range"].reshape(len(units), -1, 2, model.head.channels)
    count = (pair.max(axis=2) > 0).sum() + ((pair.min(axis=2) > 0) & (pair[:, :, 0] != pair[:, :, 1])).sum()
    assert len(rows) == count
    steps_ns = np.diff(np.unique(rows["device_time_ns"]))
    assert np.percentile(steps_ns, 99) < 60_000
    rounds = model.head.blocks // 2
    period_ns = rounds * model.head.round_ns
    steps = np.diff(raw["sequence"].astype(np.int64))
    assert int((steps - 1).sum()) == model.errors.get("sequence_gap", 0)
    np.testing.assert_allclose(np.diff(clock["device_time_ns"])[steps == 1], period_ns, atol=1500)  # stamps are in µs
    first = rows[(rows["channel"] == rows["channel"][0]) & (rows["return_number"] == 1)]
    turn, time_s = np.diff(first["encoder_rad"]) % (2 * np.pi), np.diff(first["device_time_ns"]) * 1e-9
    assert np.median(turn / time_s) / (2 * np.pi) == pytest.approx(model.motor_rpm / 60, abs=0.02)


@EVERY_MODEL
def test_dual_returns_are_numbered_by_range(model: Model) -> None:
    rows = returns_of(feed(model.parser(), payloads(model.capture)[:300]))
    two = rows["number_of_returns"] == 2
    first, last = rows[two & (rows["return_number"] == 1)], rows[two & (rows["return_number"] == 2)]
    assert len(first) == len(last) > 600
    np.testing.assert_array_equal(first["pulse_id"], last["pulse_id"])
    np.testing.assert_array_equal(first["device_time_ns"], last["device_time_ns"])
    np.testing.assert_array_equal(first["encoder_rad"], last["encoder_rad"])
    assert (first["range_m"] < last["range_m"]).all()
    assert ((last["flags"] & RETURN_FLAG_LAST != 0) == SEVERAL_NAMES[model.mode][1]).all()
    assert ((first["flags"] & RETURN_FLAG_LAST) == 0).all()
    assert (rows["flags"][~two] == RETURN_FLAG_LAST | RETURN_FLAG_STRONGEST).all()
    assert len(np.unique(rows["pulse_id"])) == len(rows) - len(first)


@EVERY_MODEL
def test_returns_do_not_depend_on_how_batches_are_cut(model: Model) -> None:
    gps = [encode_gps_packet(NOON.replace(microsecond=40, second=second), locked=second > 1) for second in range(4)]
    units = payloads(model.capture)[:120]
    for at, unit in enumerate(gps):
        units.insert(9 + 31 * at, unit)
    check_packets(model.parser, units)
    check_packets(lambda: HesaiParser(model.settings(), model.head, clock_only=True), units)
    check_packet_damage(model.parser, units[:12], examples=30)


@EVERY_MODEL
def test_lost_and_repeated_packets_are_counted(model: Model) -> None:
    units = payloads(model.capture)[:60]
    parser = model.parser()
    rows = returns_of(feed(parser, units[:20] + units[23:40] + units[39:40] + units[41:]))
    assert parser.counters.errors == {"sequence_gap": 4, "duplicate": 1}
    whole = returns_of(feed(model.parser(), units))
    assert np.isin(rows["pulse_id"], whole["pulse_id"]).all()
    assert rows["pulse_id"][-1] == whole["pulse_id"][-1]


@EVERY_MODEL
def test_the_driver_declares_its_records(model: Model) -> None:
    driver = find_driver("scanner", model.protocol)
    assert driver.transports == ("udp",)
    assert driver.make_time_parser is not None
    units = [*payloads(model.capture)[:100], encode_gps_packet(NOON)]
    records = feed(driver.make_time_parser(model.settings()), units)
    given_types = {type(record) for record in records}
    assert given_types == {DeviceClockSamples, TimeMessage, DeviceStatus}
    assert given_types | {ScannerReturns} == set(driver.yields)
    parser = driver.make_parser(model.settings())
    assert isinstance(parser, HesaiParser)
    assert len(parser.beams) == model.head.channels
