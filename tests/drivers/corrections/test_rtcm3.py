"""Tests RTCM 3 on real recordings: pyrtcm's counts and station coordinates, every cut, damage."""

from __future__ import annotations

import io
from collections import Counter

import numpy as np
import pytest
from pyubx2 import ERR_IGNORE, RTCM3_PROTOCOL, UBXReader

from swath.drivers.corrections.rtcm3 import Rtcm3Parser
from swath.drivers.framing.checksums import crc24q
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Chunk, DeviceStatus
from tests.drivers.harness import check_damage, check_stream
from tests.drivers.recordings import expected, recording

STREAMS = [
    "rtcm3.2.log",
    "rtcm3.bndm.log",
    "pygpsdata-RTCM3.log",
    "pygpsdata-MIXED-RTCM3.log",
    "pygpsdata-NTRIP-4076.log",
    "GMSD7_20121014.rtcm3",
]


def make() -> Rtcm3Parser:
    return Rtcm3Parser(DeviceSettings("corrections/test"))


def parsed(data: bytes) -> tuple[Rtcm3Parser, list[DeviceStatus]]:
    parser = make()
    records = parser.feed(Chunk("corrections/test", 7, data)) + parser.close()
    return parser, [record for record in records if isinstance(record, DeviceStatus)]


@pytest.mark.parametrize("name", STREAMS)
def test_message_counts_match_another_decoder(name: str) -> None:
    parser, _ = parsed(recording("rtcm3", name))
    entry = expected("rtcm3")[name]
    assert parser.counters.messages.total() == entry["frame_scan_own"]["rtcm3_crc_ok"]
    named: Counter[str] = Counter()
    for key, count in entry["messages"].items():
        if key.startswith("RTCM3:"):
            named[f"RTCM{key[6:].partition('_')[0]}"] += count  # the other decoder counts subtypes of 4076 separately
    assert parser.counters.messages == named
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped


@pytest.mark.parametrize("name", STREAMS)
def test_station_positions_match_pyrtcm(name: str) -> None:
    data = recording("rtcm3", name)
    wanted = []
    for _, message in UBXReader(io.BytesIO(data), protfilter=RTCM3_PROTOCOL, quitonerror=ERR_IGNORE):
        if message is not None and message.identity in ("1005", "1006"):
            wanted.append((message.identity, message.DF003, message.DF025, message.DF026, message.DF027))
    found = [
        (one.message[4:], *(one.values[key] for key in ("station", "x_m", "y_m", "z_m"))) for one in parsed(data)[1]
    ]
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert one[:2] == other[:2]
        assert one[2:] == pytest.approx(other[2:], abs=1e-6)


def test_recordings_contain_stations_of_both_message_types() -> None:
    stations = [station for name in STREAMS for station in parsed(recording("rtcm3", name))[1]]
    assert {station.message for station in stations} == {"RTCM1005", "RTCM1006"}
    assert all(
        6.3e6 < float(np.hypot.reduce([station.values[f"{axis}_m"] for axis in "xyz"])) < 6.4e6 for station in stations
    )


@pytest.mark.parametrize("name", ["pygpsdata-RTCM3.log", "rtcm3.bndm.log"])
def test_messages_do_not_depend_on_how_the_stream_is_cut(name: str) -> None:
    data = recording("rtcm3", name)
    check_stream(make, data)
    check_damage(make, data)


def test_a_truncated_station_message_is_counted() -> None:
    body = bytes([0xD3, 0, 4, 0x3E, 0xD0, 1, 2])  # number 1005
    parser, stations = parsed(body + crc24q(body).to_bytes(3, "big"))
    assert (parser.counters.bad_messages, stations) == (1, [])
    assert parser.counters.messages == {"RTCM1005": 1}
