"""Tests every driver, found by its declaration: it has recordings, and random bytes never raise in it.

A driver's recordings lie in ``fixtures/<protocol>/`` or in that of its family, the protocol's name up to a hyphen
(``velodyne-vlp16`` in ``fixtures/velodyne/``), with a SOURCE.md that says where they come from.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swath.drivers.driver import KINDS, Driver, UnknownProtocolError, all_drivers, find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings, DriverSettingsError, Parser
from swath.georef.records import Chunk, ChunkBatch
from tests.drivers.recordings import FIXTURES
from tests.fuzz.recordings import settings_of

DRIVERS = [driver for kind in KINDS for driver in all_drivers(kind).values()]


def families(protocol: str) -> list[str]:
    """Return the protocol's name and its beginnings before each hyphen."""
    return list(accumulate(protocol.split("-"), lambda head, part: f"{head}-{part}"))


def of_protocol(driver: Driver) -> str:
    return driver.protocol


def test_every_kind_of_driver_is_registered() -> None:
    assert {driver.kind for driver in DRIVERS} == set(KINDS)


@pytest.mark.parametrize("driver", DRIVERS, ids=of_protocol)
def test_every_driver_has_recordings_with_a_named_source(driver: Driver) -> None:
    folders = [FIXTURES / name for name in families(driver.protocol)]
    found = [folder for folder in folders if (folder / "SOURCE.md").is_file()]
    assert found, f"{driver.protocol}: no fixtures/{driver.protocol}/SOURCE.md, nor of its family"
    captures = [path for path in found[-1].iterdir() if path.name != "SOURCE.md"]
    assert captures, f"{found[-1]} holds no recording"
    assert (found[-1] / "SOURCE.md").read_text().strip()


@pytest.mark.parametrize("driver", DRIVERS, ids=of_protocol)
def test_every_driver_declares_its_identity(driver: Driver) -> None:
    assert driver.summary
    assert len(driver.summary) <= 110
    assert driver.transports
    assert driver.yields
    assert find_driver(driver.kind, driver.protocol) is driver


@pytest.mark.parametrize("driver", all_drivers("scanner").values(), ids=of_protocol)
def test_every_scanner_declares_its_beam_geometry(driver: Driver) -> None:
    parsers = []
    for found in settings_of(driver):
        with suppress(DriverSettingsError):  # the fixture's file belongs to another head
            parsers.append(driver.make_parser(found))
    assert parsers
    for parser in parsers:
        told = (driver.line_scanner, driver.aimed, hasattr(parser, "beams") or hasattr(parser, "head"))
        assert sum(told) == 1, told


def test_a_driver_without_a_documentation_page_is_reported() -> None:
    driver = replace(find_driver("gnss", "ubx"), protocol="unwritten")
    with pytest.raises(AssertionError, match=r"unwritten: write docs/devices/unwritten\.md first"):
        settings_of(driver)


def refusal(driver: Driver) -> str:
    """Return the error of a driver made without settings, or an empty text."""
    try:
        driver.make_parser(DeviceSettings(f"{driver.kind}/test"))
    except DriverSettingsError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("driver", DRIVERS, ids=of_protocol)
def test_only_drivers_that_declare_needs_refuse_empty_settings(driver: Driver) -> None:
    said = refusal(driver)
    assert not said or any(key in said for key in driver.needs), f"names none of {driver.needs}: {said}"


@pytest.mark.parametrize(
    ("kind", "wanted", "meant"),
    [
        ("scanner", "vlp16", "velodyne-vlp16?"),
        ("scanner", "VLP-16", "velodyne-vlp16?"),
        ("scanner", "Velodyne_VLP32C", "velodyne-vlp32c?"),
        ("scanner", "xt32", "hesai-xt32?"),
        ("scanner", "hesai xt-32", "hesai-xt32?"),
        ("scanner", "PandarXT-16", "hesai-xt16?"),
        ("scanner", "puck hi-res", "velodyne-vlp16-hires?"),
        ("scanner", "OS1", "ouster?"),
        ("scanner", "velodyne-vpl16", "did you mean velodyne-vlp16 or "),
        ("gnss", "septentrio", "sbf?"),
        ("gnss", "u-blox", "ubx?"),
        ("gnss", "OEM7", "novatel?"),
        ("gnss", "nema", "nmea?"),
        ("imu", "ellipse", "sbg-ellipse?"),
        ("imu", "xsens", "xsens-mti or xsens-xbus?"),
        ("scanner", "hesai", "did you mean hesai-at128 or hesai-ot128 or "),
        ("gnss", "-", "there are: "),
        ("gnss", "qqq", "there are: "),
        ("scanner", "vlp-16\0\n", "velodyne-vlp16?"),
    ],
)
def test_error_for_an_unknown_protocol_names_the_probable_one(kind: DeviceKind, wanted: str, meant: str) -> None:
    with pytest.raises(UnknownProtocolError) as refused:
        find_driver(kind, wanted)
    text = str(refused.value)
    assert text.startswith(f"unknown {kind} protocol {wanted!r}; ")
    assert f"did you mean {meant}" in text if meant.endswith("?") else meant in text


def make_and_feed(parser: Parser, units: list[bytes]) -> None:
    """Feed one by one and as batches, then close, and check that every byte is counted."""
    for index, unit in enumerate(units):
        parser.feed(Chunk("test/test", index, unit))
    for index, unit in enumerate(units):
        rows = np.frombuffer(unit * 2, dtype=np.uint8).reshape(2, -1)
        parser.feed_batch(ChunkBatch("test/test", np.array([index, index], dtype=np.int64), rows))
    parser.close()
    assert parser.counters.bytes == 3 * sum(map(len, units))


@pytest.mark.slow
@pytest.mark.parametrize("driver", [driver for driver in DRIVERS if not refusal(driver)], ids=of_protocol)
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(units=st.lists(st.one_of(st.binary(max_size=300), st.binary(min_size=16, max_size=16)), max_size=8))
def test_random_bytes_never_raise(driver: Driver, units: list[bytes]) -> None:
    for make in (driver.make_parser, driver.make_time_parser):
        if make is not None:
            make_and_feed(make(DeviceSettings(f"{driver.kind}/test")), units)
