"""Tests `swath import` of TCP connections and CAN buses in network captures, and the way back through an export."""

from __future__ import annotations

import gzip
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from swath.daemon.config import Config
from swath.daemon.exchange.capture_files import ImportOptions
from swath.daemon.exchange.export import export_session
from swath.daemon.log.reader import open_logs
from swath.drivers.captures.opening import read_candump
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import content_of, run_import, write_config
from tests.drivers.captures.network import (
    ACK,
    COMPUTER,
    DEVICE,
    ETHERNET,
    FIRST_NS,
    SYN,
    Side,
    a_ms_apart,
    acknowledging,
    from_device,
    tcp_packet,
    write_frames,
)
from tests.drivers.recordings import FIXTURES

CONFIG = """
[session]
name = "network"
directory = "logs"

[gnss.rover]
transport = "tcp:192.168.3.1:28784"
protocol = "novatel"

[corrections.base]
transport = "ntrip:caster.example:2101/ZIMM0"
protocol = "rtcm3"

[imu.main]
transport = "can:socketcan:can1?bitrate=500000"
protocol = "canmod-gps"
"""
CASTER = Side("203.0.113.7", 2101)


def back(folder: Path, config: Config) -> dict[str, object]:
    """Return the content of a log after export and import."""
    [session] = open_logs([folder / "logs"])
    exported = export_session(session, folder / "out").folder
    run_import(config, [exported], folder / "back")
    return dict(content_of(folder / "back"))


def caster_frames(writes: Iterable[bytes]) -> list[bytes]:
    """Return the packets of a caster's reply, a packet a write."""
    frames, at = [tcp_packet(CASTER, COMPUTER, 99, flags=SYN | ACK)], 100
    for data in writes:
        frames.append(tcp_packet(CASTER, COMPUTER, at, data))
        at += len(data)
    return [ETHERNET + frame for frame in frames]


def test_the_recorded_connection_is_imported_and_comes_back(tmp_path: Path) -> None:
    config = write_config(tmp_path, CONFIG.replace("192.168.3.1", "127.0.0.1"))
    report, [capture] = run_import(config, [FIXTURES / "captures" / "tcp.pcap.gz"], tmp_path / "logs")
    assert (report.units, capture.passed, capture.tally.damage) == ({"gnss/rover": 33}, {}, 0)
    content = content_of(tmp_path / "logs")
    sent = gzip.decompress((FIXTURES / "novatel" / "propak6-basic-fix.gps.gz").read_bytes())[:60_000]
    assert b"".join(data for _, data, _ in content["/gnss/rover/raw"]) == sent
    assert dict(content["/gnss/rover/raw"][0][2]) == {"protocol": "novatel", "transport": "tcp:127.0.0.1:28784"}
    assert back(tmp_path, config) == content


def test_streams_belong_to_the_device_of_their_address(tmp_path: Path) -> None:
    """A device of another address with the same port, other services and requests to devices are counted."""
    config = write_config(tmp_path, CONFIG)
    other = Side("192.168.3.2", DEVICE.port)
    frames = [
        from_device(99, b"abc", SYN), ETHERNET + tcp_packet(other, COMPUTER, 5, b"other"),
        acknowledging(103, data=b"log"), ETHERNET + tcp_packet(COMPUTER, Side("10.1.1.1", 80), 5, b"GET"),
        from_device(103, b"def"),
    ]  # fmt: skip
    path = write_frames(tmp_path / "a.pcap", frames)
    report, [capture] = run_import(config, [path], tmp_path / "logs")
    assert report.units == {"gnss/rover": 2}
    assert capture.passed == {"TCP port 28784": 1, "TCP port 80": 1}
    assert capture.tally.passed["segments of TCP sent to devices"] == 1
    named = ImportOptions([f"gnss/rover:28784={path}"])  # of any address
    report, [capture] = run_import(config, [], tmp_path / "named", named)
    assert (report.units, capture.warnings()) == ({"gnss/rover": 3}, [])


def test_a_gap_is_reported_with_its_size(tmp_path: Path) -> None:
    write_config(tmp_path, CONFIG)
    path = write_frames(tmp_path / "a.pcap", [from_device(99, b"abc", SYN), from_device(110, b"def")])
    done = swath("import", str(tmp_path / "swath.toml"), str(path), "-o", str(tmp_path / "logs"))
    assert done.returncode == 4
    assert done.stderr == (
        f"swath: {path}: 7 bytes of the TCP stream from 192.168.3.1:28784 to 192.168.3.10:40123 were not captured; "
        "everything readable is in the log\n"
    )
    assert "2 units of gnss/rover, 7 bytes of TCP not captured" in done.stdout


def test_several_connections_at_the_same_time_are_named(tmp_path: Path) -> None:
    config = write_config(tmp_path, CONFIG)
    frames = [from_device(99, flags=SYN)]
    for number in range(4):
        frames.append(from_device(100 + 3 * number, b"abc"))
        frames.append(ETHERNET + tcp_packet(DEVICE, Side("10.0.0.9", 1), 100 + 3 * number, b"abc"))
    _, [capture] = run_import(config, [write_frames(tmp_path / "a.pcap", frames)], tmp_path / "logs")
    [line] = capture.warnings()
    assert "gnss/rover: 2 connections at the same time are read as one stream: 192.168.3.1:28784 to 192.168" in line


def test_a_serial_device_takes_the_port_of_its_terminal_server(tmp_path: Path) -> None:
    write_config(tmp_path, CONFIG.replace("tcp:192.168.3.1:28784", "serial:/dev/ttyUSB0?baud=115200"))
    path = write_frames(tmp_path / "a.pcap", [from_device(99, b"abc", SYN)])
    words = ["import", str(tmp_path / "swath.toml"), "-o", str(tmp_path / "logs"), "--source"]
    refused = swath(*words, f"gnss/rover={path}")
    assert refused.returncode == 2
    assert "want a file of serial bytes, or the TCP port that sent them: --source gnss/rover:PORT=" in refused.stderr
    assert swath(*words, f"gnss/rover:28784={path}").returncode == 0
    assert [data for _, data, _ in content_of(tmp_path / "logs")["/gnss/rover/raw"]] == [b"abc"]


def test_a_casters_reply_gives_the_corrections_as_the_recorder_would(tmp_path: Path) -> None:
    """The log holds them without the reply's head and the lengths of its chunks, which begin and end anywhere."""
    config = write_config(tmp_path, CONFIG)
    data = bytes(range(256)) * 3
    chunked = b"".join(b"%X\r\n%s\r\n" % (len(part), part) for part in (data[:10], data[10:500], data[500:]))
    head = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\nContent-Type: gnss/data\r\n\r\n"
    for reply in (b"ICY 200 OK\r\n\r\n" + data, b"HTTP/1.0 200 OK\r\n\r\n" + data, head + chunked, data):
        for step in (7, 100, 2000):
            writes = [reply[at : at + step] for at in range(0, len(reply), step)]
            path = write_frames(tmp_path / "a.pcap", caster_frames(writes))
            folder = tmp_path / f"{len(reply)}-{step}"
            _, [capture] = run_import(config, [path], folder)
            assert b"".join(unit for _, unit, _ in content_of(folder)["/corrections/base/raw"]) == data
            assert capture.tally.damage == 0
    path = write_frames(tmp_path / "a.pcap", caster_frames([b"HTTP/1.1 401 Unauthorized\r\n\r\nno"]))
    _, [capture] = run_import(config, [path], tmp_path / "refused")
    assert "the caster answers HTTP/1.1 401 Unauthorized" in capture.tally.first_damage


def test_frames_of_a_bus_are_imported_and_come_back(tmp_path: Path) -> None:
    """The frames are those of a recorded candump log, with the layout that a capture of the bus has."""
    config = write_config(tmp_path, CONFIG)
    units = list(read_candump(FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz", "can1"))
    frames = [unit.data[3::-1] + unit.data[4:] for unit in units]
    path = write_frames(tmp_path / "can.pcap", frames, 227)
    report, [capture] = run_import(config, [path], tmp_path / "logs")
    assert (report.units, capture.passed) == ({"imu/main": len(units)}, Counter())
    content = content_of(tmp_path / "logs")
    assert [(time_ns, data) for time_ns, data, _ in content["/imu/main/raw"]] == [
        (time_ns, unit.data) for (time_ns, _), unit in zip(a_ms_apart(frames, FIRST_NS), units, strict=True)
    ]
    assert back(tmp_path, config) == content
    two = CONFIG + '\n[imu.other]\ntransport = "can:socketcan:can2"\nprotocol = "canmod-gps"\n'
    report, [capture] = run_import(write_config(tmp_path / "two", two), [path], tmp_path / "none")
    assert (report.units, capture.passed) == ({}, {"a CAN bus": len(units)})
    report, _ = run_import(config, [], tmp_path / "named", ImportOptions([f"imu/main={path}"]))
    assert report.units == {"imu/main": len(units)}
