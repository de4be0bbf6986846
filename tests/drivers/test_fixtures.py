"""Tests that each recording of the collection is here, and that its driver reads what others read in it."""

from __future__ import annotations

import csv
import gzip
import hashlib
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from swath.drivers.captures.opening import read_candump, read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.framing.framer import Framer
from swath.drivers.framing.kinds import NOVATEL_ASCII
from swath.drivers.gnss.novatel.parser import FRAME_KINDS, message_name
from swath.drivers.imu.nmea2000 import pgn_and_source
from swath.drivers.parser import DeviceKind, DeviceSettings, Parser, ParserCounters
from swath.drivers.scanner.ouster.head import read_head
from swath.georef.records import Chunk, ChunkBatch, Record, ScannerReturns, TimeMessage
from tests.drivers.builders import (
    NMEA2000_COUNTS,
    clock_of,
    comparable,
    feed,
    nmea2000_bus,
    others_messages,
    returns_of,
)
from tests.drivers.harness import packet_batches
from tests.drivers.imu_dbc import imu_rows
from tests.drivers.ouster_cases import metadata_of
from tests.drivers.recordings import FIXTURES, every_recording, expected, gpsd_lines

Entry = dict[str, Any]
Check = Callable[[Path, Entry], None]
ROOT = FIXTURES.parent
CAN_EFF_MASK = 0x1FFF_FFFF
# entries that belong to the processing of flights, not to their recording
LATER = {"las/": "point clouds", "trajectory/": "trajectories of others"}
WITHOUT_COPY = {
    "can/FACTS.json": "layouts of CAN messages with their sources: what the drivers were written from, no recording",
    "can/canmod-gps/canmod-gps.dbc": "the driver's own copy has the licence in it besides",
    "gnss/novatel-oem7-driver/README.upstream.md": "how the recordings were made, in words",
}


@cache
def files() -> dict[str, dict[str, str]]:
    """Return for each name in the collection bytes and SHA-256 of the unpacked content, and the copy in fixtures/."""
    with (FIXTURES / "FILES.csv").open(newline="") as file:
        return {row["file"]: row for row in csv.DictReader(file)}


@cache
def entries() -> dict[str, Entry]:
    """Return for each name in the collection what other decoders found in the recording."""
    table = json.loads(gzip.decompress((FIXTURES / "EXPECTED.json.gz").read_bytes()))
    return {entry["file"].removeprefix("share/"): entry for entry in table["files"]}


def content(path: Path) -> bytes:
    """Return the content of a copy as it was upstream."""
    data = path.read_bytes()
    return gzip.decompress(data) if path.suffix == ".gz" else data


def run(kind: DeviceKind, protocol: str, data: bytes) -> tuple[Parser, list[Record]]:
    """Return the parser of a stream after all of it."""
    parser = find_driver(kind, protocol).make_parser(DeviceSettings(f"{kind}/main"))
    return parser, [*parser.feed(Chunk(f"{kind}/main", 0, data)), *parser.close()]


# --- GNSS


def check_mixed_stream(copy: Path, entry: Entry) -> None:
    """Check NMEA, UBX and RTCM 3 with the family's driver against the counts of pyubx2, pynmeagps and pyrtcm."""
    family, name = copy.parent.name, copy.name.removesuffix(".gz")
    assert (family, name) in every_recording()
    excerpt = {key: value for key, value in expected(family)[name].items() if key != "origin"}
    assert excerpt == {key: entry[key] for key in excerpt}
    data = content(copy)[entry.get("comment_header_bytes_skipped", 0) :]
    parser, _ = run("gnss", "nmea" if family == "nmea" else "ubx", data)
    assert comparable(parser.counters.messages) == others_messages(name, entry)
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == len(data)
    if "gpsd_chk" in entry:
        reports = [json.loads(line)["class"] for line in gpsd_lines(family, name) if line.startswith(b"{")]
        wanted = entry["gpsd_chk"]["json_classes"]
        assert {kind: count for kind, count in Counter(reports).items() if kind in wanted} == wanted


def check_sbf(copy: Path, entry: Entry) -> None:
    name = copy.name.removesuffix(".gz")
    excerpt = expected("sbf")[name]
    assert excerpt == {key: entry[key] for key in excerpt}
    parser, _ = run("gnss", "sbf", content(copy))
    others = sum(count for message, count in entry["messages"].items() if not message.startswith("SBF:"))
    sbf = entry["frame_scan_own"]["sbf_crc_ok"]
    assert parser.counters.messages.total() >= sbf + others
    if sbf:
        assert parser.counters.messages.total() == sbf + others
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == entry["bytes"]


def check_novatel(copy: Path, entry: Entry) -> None:
    """Check logs by number, as in the bytes; the decoder's names are in the driver's test."""
    parser, _ = run("gnss", "novatel", content(copy))
    framed = Framer(FRAME_KINDS, ParserCounters())
    frames = [*framed.feed(content(copy), 0), *framed.close()]
    ascii_logs = Counter(NOVATEL_ASCII.message_name(frame.data) for frame in frames if frame.kind == NOVATEL_ASCII.name)
    logs = parser.counters.messages - ascii_logs  # the entry has those in binary
    wanted: Counter[str] = Counter()
    for number, count in entry["frame_scan_own"]["by_id"].items():
        wanted[message_name(b"\xaa\x44\x13\0" + int(number).to_bytes(2, "little"))] += count
    assert Counter({name.removesuffix("-response"): count for name, count in logs.items()}) == wanted
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == entry["bytes"]


# --- IMU


def check_xsens(copy: Path, entry: Entry) -> None:
    parser, _ = run("imu", "xsens-xbus", content(copy))
    assert entry["by_mid"] == {"0x36": 100}
    assert parser.counters.messages == {"MTData2": entry["xbus_messages_checksum_ok"]}
    assert parser.counters.bad_checksums == entry["sync_without_valid_checksum"] == 0
    assert parser.counters.bytes_framed == entry["bytes"]


def check_canmod(copy: Path, entry: Entry) -> None:
    units = list(read_candump(copy))
    assert len(units) == entry["frames"]
    assert [units[0].time_ns, units[-1].time_ns] == [round(entry[at] * 1e6) * 1000 for at in ("first", "last")]
    assert {unit.channel for unit in units} == {f"can{bus}" for bus in entry["buses"]}
    assert len({int.from_bytes(unit.data[:4], "little") & CAN_EFF_MASK for unit in units}) == entry["ids"]
    parser = find_driver("imu", "canmod-gps").make_parser(DeviceSettings("imu/main"))
    data = np.frombuffer(b"".join(unit.data for unit in units), np.uint8).reshape(len(units), -1)
    host_ns = np.array([unit.time_ns for unit in units], np.int64)
    records = parser.feed_batch(ChunkBatch("imu/main", host_ns, data))
    assert +parser.counters.messages == Counter(entry["by_message"])
    rows = imu_rows(records)
    values = np.hstack([rows["specific_force_b"], np.degrees(rows["angular_rate_b"])])
    np.testing.assert_allclose(values.mean(axis=0), entry["imu"]["mean"], atol=6e-6)
    period_s = np.diff(rows["host_time_ns"]) * 1e-9
    assert len(rows) == entry["imu"]["valid"]
    assert np.median(period_s) == pytest.approx(entry["imu"]["period_median_s"], abs=1e-6)
    assert period_s.max() == pytest.approx(entry["imu"]["period_max_s"], abs=1e-6)
    times = [record for record in records if isinstance(record, TimeMessage)]
    assert len(times) == entry["gnss_time"]["valid"]
    for time, epoch_s in ((times[0], entry["gnss_time"]["first_epoch"]), (times[-1], entry["gnss_time"]["last_epoch"])):
        assert time.time.time_ns * 1e-9 == pytest.approx(epoch_s % 86_400, abs=0.0011)


def check_nmea2000(copy: Path, entry: Entry) -> None:
    frames = nmea2000_bus(copy.name)
    messages = entry.get("messages") or entry["messages_after_fast_packet_reassembly"]
    parser = find_driver("imu", "nmea2000").make_parser(DeviceSettings("imu/main"))
    for batch in packet_batches(frames, lambda: len(frames)):
        parser.feed_batch(batch)
    read_here = set().union(*NMEA2000_COUNTS.values())
    assert parser.counters.messages == {pgn: count for pgn, count in messages.items() if pgn in read_here}
    if "lines" in entry:
        assert len(frames) == entry["lines"]
        return
    identifiers = np.frombuffer(b"".join(frame[:4] for frame in frames), "<u4") & np.uint32(CAN_EFF_MASK)
    pgn, source = pgn_and_source(identifiers.astype(np.uint32))
    assert len(frames) == entry["frames"]
    by_pgn = Counter(map(str, pgn.tolist()))
    assert {name: by_pgn[name] for name in entry["raw_frames_by_pgn"]} == entry["raw_frames_by_pgn"]
    by_source = Counter(f"{one} src {other}" for one, other in zip(pgn.tolist(), source.tolist(), strict=True))
    assert {name: by_source[name] for name in entry["inertial_by_pgn_source"]} == entry["inertial_by_pgn_source"]
    units = list(read_candump(copy))
    assert [units[0].time_ns, units[-1].time_ns] == [round(entry[at] * 1e6) * 1000 for at in ("first", "last")]


# --- scanners


def datagrams(copy: Path, entry: Entry) -> list[bytes]:
    """Return all datagrams of a capture, or the payloads laid end to end.

    There are as many of each port and length as other decoders found.
    """
    if copy.name.removesuffix(".gz").endswith(".bin"):
        data = content(copy)
        units = [data[at : at + 1206] for at in range(0, len(data), 1206)]
        assert entry["packets"] == {"concatenated 1206-byte payloads": len(units)}
        return units
    captured = list(read_pcap(copy))
    found = Counter((unit.destination[1], len(unit.data)) for unit in captured if unit.destination)
    assert {f"udp dport {port} len {length}": count for (port, length), count in found.items()} == entry["packets"]
    return [unit.data for unit in captured]


def check_velodyne(copy: Path, entry: Entry) -> None:
    product = next(iter(entry["factory_bytes_return_product"])).rpartition(",")[2]
    protocol = "velodyne-vlp32c" if product == "0x28" else "velodyne-vlp16"
    units = datagrams(copy, entry)
    data = [unit for unit in units if len(unit) == 1206]
    assert Counter(f"0x{unit[-2]:02x},0x{unit[-1]:02x}" for unit in data) == entry["factory_bytes_return_product"]
    parser = find_driver("scanner", protocol).make_parser(DeviceSettings("scanner/left"))
    records = feed(parser, data)
    assert +parser.counters.messages == {"data": len(data)}
    wanted = entry["data_packet_us_past_hour"]
    last_firing_us = clock_of(records)["device_time_ns"] / 1000  # the entry has the stamps, of the first firing
    behind_us = last_firing_us[[0, -1]] - [wanted["first"], wanted["last"]]
    assert behind_us[0] == pytest.approx(behind_us[1], abs=1e-3)
    assert 0.4 * wanted["min_step"] < behind_us[0] < wanted["min_step"]
    steps_us = np.rint(np.diff(last_firing_us))
    assert (steps_us.min(), steps_us.max()) == (wanted["min_step"], wanted["max_step"])
    if "n_points" in entry:
        assert len(returns_of(records)) == entry["n_points"] == sum(scan["n"] for scan in entry["scans"])
    positions = [unit for unit in units if len(unit) == 512]
    if "position_packets" in entry:
        assert len(positions) == entry["position_packets"]["n"]
        statuses = Counter(str(unit[202]) for unit in positions)
        assert statuses == entry["position_packets"]["pps_status"]


def check_hesai(copy: Path, entry: Entry) -> None:
    protocol = "hesai-xt32" if "xt32" in copy.name else "hesai-qt64"
    units = datagrams(copy, entry)
    assert units[0][:16].hex() == entry["first_16_payload_bytes"]
    captured = list(read_pcap(copy))
    span_s = (captured[-1].time_ns - captured[0].time_ns) * 1e-9
    assert span_s == pytest.approx(entry["capture_span_s"], abs=1e-6)
    parser = find_driver("scanner", protocol).make_parser(DeviceSettings("scanner/left"))
    assert any(isinstance(record, ScannerReturns) for record in feed(parser, units))
    assert parser.counters.messages.total() == len(units)
    cloud = content(FIXTURES / "hesai" / (Path(entry["golden_pcd"]["file"]).name + ".gz"))
    assert f"\nPOINTS {entry['golden_pcd']['points']}\n".encode() in cloud


def check_ouster(copy: Path, entry: Entry) -> None:
    name = copy.name.removesuffix(".pcap.gz")
    units, metadata = datagrams(copy, entry), metadata_of(name)
    head, sensor = read_head(metadata), entry["sensor"]
    ours = (head.model, str(head.serial), head.imu_profile, head.beams, head.columns_per_frame, head.columns_per_packet)
    theirs = ("prod", "sn", "imu_profile", "pixels", "columns_per_frame", "columns_per_packet")
    assert ours == tuple(sensor[key] for key in theirs)
    if sensor["profile"] != "OFF":  # the library's name for a head that sends no lidar packets
        assert head.profile == sensor["profile"]
    settings = DeviceSettings("scanner/left", {}, {"geometry": metadata})
    parser = find_driver("scanner", "ouster").make_parser(settings)
    feed(parser, units)
    kinds = {"LidarPacket": "lidar", "ImuPacket": "imu", "ZonePacket": "zone"}
    assert +parser.counters.messages == {kinds[kind]: count for kind, count in entry["sdk_packets"].items()}
    wanted = json.loads((FIXTURES / "ouster" / "expected.json").read_text())[f"{name}.pcap"]["scans"]
    for scan, whole in zip(wanted, entry["scans"], strict=True):
        assert {key: whole[key] for key in scan if key != "fields"} == {k: v for k, v in scan.items() if k != "fields"}
        for field, said in scan["fields"].items():
            assert said == {key: whole["fields"][field][key] for key in said}


def check_fragments(copy: Path, entry: Entry) -> None:
    """Check fragments, which are joined here; other decoders count the first fragment of a large datagram."""
    lengths = sorted(len(unit.data) for unit in read_pcap(copy, port=7502))
    assert lengths == [48, 48, 12_608, 16_640]
    assert entry["packets"] == {"udp dport 7502 len 48": 2, "udp dport 7502 len 1472": 2}


def check_datagrams(copy: Path, entry: Entry) -> None:
    datagrams(copy, entry)


CHECKS: dict[str, Check] = {  # by the beginning of an entry's name; the longest counts
    "can/canmod-gps/": check_canmod,
    "can/nmea2000-canboat/": check_nmea2000,
    "gnss/gpsd/": check_mixed_stream,
    "gnss/nmea-pynmeagps/": check_mixed_stream,
    "gnss/novatel-edie/": check_novatel,
    "gnss/novatel-oem7-driver/": check_novatel,
    "gnss/novatel-span/": check_novatel,
    "gnss/novatel-swri/": check_novatel,
    "gnss/rtcm3-pyrtcm/": check_mixed_stream,
    "gnss/rtklib/GMSD7_20121014.rtcm3": check_mixed_stream,
    "gnss/rtklib/oemv_200911218.gps": check_novatel,
    "gnss/sbf-pysbf2/": check_sbf,
    "gnss/ubx-pyubx2/": check_mixed_stream,
    "imu-serial/xsens-go/": check_xsens,
    "scanner/hesai/": check_hesai,
    "scanner/ouster/": check_ouster,
    "scanner/ouster/VLI-16-one-packet.pcap": check_datagrams,
    "scanner/ouster/empty_pcap.pcap": check_datagrams,
    "scanner/ouster/same_ports.pcap": check_fragments,
    "scanner/velodyne/": check_velodyne,
}
ACQUISITION = sorted(name for name in entries() if not name.startswith(tuple(LATER)))


def test_every_fixture_entry_is_tested() -> None:
    for name in ACQUISITION:
        assert name in files(), f"{name} is in EXPECTED.json and not in FILES.csv"
        assert files()[name]["copy"], f"{name} has no copy"
        assert name.startswith(tuple(CHECKS)), f"{name} has no check"
    for beginning in (*CHECKS, *LATER):
        assert any(name.startswith(beginning) for name in entries()), f"{beginning} is of no entry"


@pytest.mark.parametrize("name", ACQUISITION)
def test_each_fixture_entry_matches_the_output_of_its_driver(name: str) -> None:
    beginning = max((one for one in CHECKS if name.startswith(one)), key=len)
    CHECKS[beginning](FIXTURES / files()[name]["copy"], entries()[name])


def test_every_file_of_the_collection_has_a_copy_or_a_stated_reason() -> None:
    assert {name for name, row in files().items() if not row["copy"]} == set(WITHOUT_COPY)
    for name, row in files().items():
        if row["copy"]:
            data = content(FIXTURES / row["copy"])
            assert (len(data), hashlib.sha256(data).hexdigest()) == (int(row["bytes"]), row["sha256"]), name
    dbc = files()["can/canmod-gps/canmod-gps.dbc"]
    own = (ROOT / "drivers" / "imu" / "canmod-gps.dbc").read_bytes()
    without_licence = re.sub(rb'^CM_ "CSS Electronics.*?";\n', b"", own, count=1, flags=re.DOTALL | re.MULTILINE)
    assert hashlib.sha256(without_licence).hexdigest() == dbc["sha256"]


MF4_FRAMES = """
import json, sys
from can.io.mf4 import MF4Reader
from swath.drivers.transports.can.adapter import pack_frame

with MF4Reader(sys.argv[1]) as messages:
    frames = [(round(one.timestamp * 1e6) * 1000, f"can{one.channel}", pack_frame(one).hex()) for one in messages]
print(json.dumps(frames))
"""


@pytest.mark.parametrize("name", ["2F6913DB_00000004_00000001", "3BA199E2_00000164_00000005"])
def test_frames_of_a_candump_log_match_the_loggers_own_file(name: str, tmp_path: Path) -> None:
    """The reference is the logger's MF4, read by asammdf in another process; both have microseconds."""
    own = tmp_path / "own.MF4"
    own.write_bytes(content(FIXTURES / "canmod-gps" / f"{name}.MF4.gz"))
    command = [sys.executable, "-c", MF4_FRAMES, str(own)]
    with_asammdf = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=with_asammdf, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    frames = [(time_ns, channel, bytes.fromhex(data)) for time_ns, channel, data in json.loads(done.stdout)]
    units = read_candump(FIXTURES / "canmod-gps" / f"{name}_candump.log.gz")
    assert [(unit.time_ns, unit.channel, unit.data) for unit in units] == frames


@pytest.mark.parametrize(
    ("device", "name", "messages"),
    [
        ("hesai", "nebula_qt64", 4),
        ("hesai", "nebula_xt32", 4),
        ("hesai", "nebula_qt128", 2),
        ("velodyne", "nebula_vlp16", 4),
        ("velodyne", "nebula_vlp32", 5),
    ],
)
def test_captures_from_rosbags_span_the_time_of_their_bag(device: str, name: str, messages: int) -> None:
    """The bag's first message, a scan, came with the first scan's last packet; the last with the capture's last."""
    text = (FIXTURES / device / f"{name}_rosbag_metadata.yaml").read_text()
    bag = yaml.safe_load(text)["rosbag2_bagfile_information"]
    times = [unit.time_ns for unit in read_pcap(FIXTURES / device / f"{name}.pcap.gz")]
    first, span = bag["starting_time"]["nanoseconds_since_epoch"], bag["duration"]["nanoseconds"]
    assert bag["message_count"] == messages
    turn = (times[-1] - times[0]) / messages
    assert abs(first - times[0] - turn) < 0.5 * turn
    assert abs(first + span - times[-1]) < 0.5 * turn
