"""Tests ``swath export``: other tools read the wire's content from its files, and import restores the log."""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import can
import dpkt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.daemon.config import Config, load_config
from swath.daemon.exchange.export import MANIFEST, ExportReport, export_session
from swath.daemon.exchange.sidecar import SUFFIX
from swath.daemon.log.reader import open_logs
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.pcap.writer import FILE_HEADER, pcap_frames
from tests.builders import ROOT
from tests.daemon.builders import ROVER_CONFIG, SREP, Pty, mcap_doctor, nmea_zda
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import Unit, content_of, run_import, write_config, write_log
from tests.daemon.log_check import official_counts, read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, one_processor, session_table

START_NS = 1_800_000_000_123_456_789
BUS = "239.74.163.2"
HEAD, OTHER_HEAD = ("192.168.1.201", 2368), ("192.168.1.202", 40_000)
EDGE = b'{"edge_time_ns":1800000000000000123,"sequence":7,"edge":"assert","realtime_ns":1800000000000000999}'


def export(log: Path, folder: Path) -> ExportReport:
    """Export the only session of a log."""
    [session] = open_logs([log])
    return export_session(session, folder)


UNITS: list[Unit] = [
    ("gnss/rover", START_NS, b"\xaa\x44\x12", None),
    ("scanner/top", START_NS + 1, bytes(1206), HEAD),
    ("imu/main", START_NS + 2, encode_can_frame(0x123, b"\1\2\3"), None),
    ("scanner/top/aux", START_NS + 3, bytes(512), HEAD),
    ("pps/main", START_NS + 4, EDGE, None),
    ("imu/main", START_NS + 1003, encode_can_frame(0x1234567, bytes(24), extended=True, fd=True), None),
    ("scanner/top", START_NS + 5, b"\1" * 1206, OTHER_HEAD),
    ("gnss/rover", START_NS + 2_000_000, b"rest", None),
    ("scanner/top", START_NS + 6, b"\2" * 1206, HEAD),
]


@pytest.fixture
def exported(tmp_path: Path) -> ExportReport:
    config = write_config(tmp_path)
    return export(write_log(tmp_path / "log", config, UNITS), tmp_path / "out")


class TestFiles:
    def test_dpkt_reads_the_datagrams_of_a_head_with_two_ports(self, exported: ExportReport) -> None:
        found = []
        with (exported.folder / "scanner-top.pcap").open("rb") as stream:
            for seconds, frame in dpkt.pcap.Reader(stream):
                ip = dpkt.ethernet.Ethernet(frame).data
                found.append((round(seconds), socket.inet_ntoa(ip.src), ip.data.sport, ip.data.dport, ip.data.data))
        assert found == [
            (START_NS // 10**9, HEAD[0], HEAD[1], 2368, bytes(1206)),
            (START_NS // 10**9, HEAD[0], HEAD[1], 8308, bytes(512)),
            (START_NS // 10**9, OTHER_HEAD[0], OTHER_HEAD[1], 2368, b"\1" * 1206),
            (START_NS // 10**9, HEAD[0], HEAD[1], 2368, b"\2" * 1206),
        ]

    def test_datagrams_of_two_ports_are_merged_by_time_and_keep_their_own_order(self, tmp_path: Path) -> None:
        """A log has them block by block; the stamps of a port that step back stay where they are."""
        main, aux, second = "scanner/top", "scanner/top/aux", 10**9
        stamps = [(main, n * 10) for n in range(40)] + [(aux, n * 45 + 5) for n in range(8)]
        stamps += [(main, 400 + n * 10) for n in range(40)] + [(aux, 5 * second), (main, 5 * second + 1)]
        stamps += [(main, 5 * second - 7), (aux, 5 * second + 2), (main, 9 * second), (aux, 9 * second - 1)]
        units: list[Unit] = [(source, START_NS + at, source.encode(), HEAD) for source, at in stamps]
        report = export(write_log(tmp_path / "log", write_config(tmp_path), units), tmp_path / "out")
        found = []
        with (report.folder / "scanner-top.pcap").open("rb") as stream:
            stream.seek(24)
            while head := stream.read(16):
                seconds, fraction, length, _ = struct.unpack("<IIII", head)
                frame = dpkt.ethernet.Ethernet(stream.read(length))
                found.append((frame.data.data.data.decode(), seconds * second + fraction - START_NS))
        stepped = found.index((main, 5 * second - 7))
        assert found[stepped - 1] == (main, 5 * second + 1)
        for source in (main, aux):
            assert [unit for unit in found if unit[0] == source] == [unit for unit in stamps if unit[0] == source]
        del found[stepped]
        assert [at for _, at in found] == sorted(at for _, at in found)

    def test_timestamps_of_a_pcap_are_in_nanoseconds(self, exported: ExportReport) -> None:
        data = (exported.folder / "scanner-top.pcap").read_bytes()
        assert struct.unpack_from("<I", data) == (0xA1B23C4D,)
        assert struct.unpack_from("<II", data, 24) == divmod(START_NS + 1, 10**9)

    def test_python_can_reads_the_frames(self, exported: ExportReport) -> None:
        with can.CanutilsLogReader(str(exported.folder / "imu-main.log")) as reader:
            first, second = list(reader)
        assert (first.arbitration_id, bytes(first.data), first.channel) == (0x123, b"\1\2\3", "can1")
        assert (second.arbitration_id, second.is_extended_id, second.is_fd) == (0x1234567, True, True)
        assert first.timestamp == pytest.approx(START_NS // 1000 / 1e6, abs=1e-6)

    def test_serial_bytes_are_one_stream_with_a_tag_for_each_read(self, exported: ExportReport) -> None:
        """The tag's layout is documented in drivers/transports/rtklib_tag.py from RTKLIB's source."""
        assert (exported.folder / "gnss-rover.gps").read_bytes() == b"\xaa\x44\x12rest"
        tags = (exported.folder / "gnss-rover.gps.tag").read_bytes()
        assert tags.startswith(b"TIMETAG RTKLIB")
        seconds, fraction = struct.unpack_from("<Id", tags, 64)
        assert (seconds, fraction) == (START_NS // 10**9 + 18, pytest.approx(0.123, abs=1e-12))
        assert struct.unpack("<IIII", tags[76:]) == (0, 3, 2, 7)

    def test_edges_are_lines_of_a_fixed_source(self, exported: ExportReport) -> None:
        assert (exported.folder / "pps-main.txt").read_text() == "1800000000000000123 7\n"

    def test_the_manifest_names_every_file_and_unit(self, exported: ExportReport) -> None:
        manifest = json.loads((exported.folder / MANIFEST).read_text())
        assert {name: entry["units"] for name, entry in manifest["files"].items()} == {
            "gnss-rover.gps": 2, "scanner-top.pcap": 4, "imu-main.log": 2, "pps-main.txt": 1,
        }  # fmt: skip
        assert exported.units == Counter(source for source, *_ in UNITS)
        assert not (exported.folder / f"scanner-top.pcap{SUFFIX}").exists()  # the pcap is complete without it

    def test_the_exported_configuration_can_be_loaded_in_place(self, tmp_path: Path) -> None:
        shutil.copytree(ROOT / "fixtures/config", tmp_path / "config", ignore=shutil.ignore_patterns("bad"))
        config = load_config(tmp_path / "config/aircraft.toml")
        report = export(write_log(tmp_path / "log", config, [("gnss/rover", START_NS, b"$", None)]), tmp_path / "out")
        again = load_config(report.folder / "config/config.toml")
        assert again.text == config.text
        assert (report.folder / "config/imu.dbc").read_bytes() == (tmp_path / "config/imu.dbc").read_bytes()
        assert report.notes == []

    def test_a_file_that_lies_elsewhere_is_noted(self, tmp_path: Path) -> None:
        dbc = tmp_path / "far/imu.dbc"
        dbc.parent.mkdir()
        shutil.copy(ROOT / "fixtures/config/imu.dbc", dbc)
        text = (ROOT / "fixtures/config/aircraft.toml").read_text().replace('"imu.dbc"', f'"{dbc}"')
        config = write_config(tmp_path / "here", text.replace('calibration = "left.toml"\n', ""))
        report = export(write_log(tmp_path / "log", config, [("gnss/rover", START_NS, b"$", None)]), tmp_path / "out")
        assert (report.folder / "config/dbc/imu.dbc").read_bytes() == dbc.read_bytes()
        assert report.notes == ["config.toml names another path for dbc/imu.dbc; change it before `swath import`"]


# --- there and back -------------------------------------------------------------------------------------------------

NEAR = st.integers(START_NS, START_NS + 10**10)
TIMES = st.one_of(NEAR, NEAR, NEAR, NEAR, NEAR, st.sampled_from([0, 2**32 * 10**9, 2**62]))
FRAMES = (
    st.binary(min_size=16, max_size=16)
    | st.binary(min_size=72, max_size=72)
    | st.binary(max_size=20)
    | st.builds(encode_can_frame, st.integers(0, 0x7FF), st.binary(max_size=8))
)
EDGES = st.binary(max_size=30) | st.builds(
    lambda time_ns, sequence: json.dumps({"edge_time_ns": time_ns, "sequence": sequence}).encode(), TIMES, st.integers()
)
PEERS = st.sampled_from([HEAD, OTHER_HEAD, ("fe80::1", 1), None])
ANY_UNIT = st.one_of(
    st.tuples(st.just("gnss/rover"), TIMES, st.binary(max_size=40), st.none()),
    st.tuples(st.just("imu/main"), TIMES, FRAMES, st.none()),
    st.tuples(st.just("pps/main"), TIMES, EDGES, st.none()),
    st.tuples(st.sampled_from(["scanner/top", "scanner/top/aux"]), TIMES, st.binary(max_size=40), PEERS),
)


def there_and_back(folder: Path, config: Config, units: list[Unit]) -> None:
    """Export a log and import it by the exported configuration, and check that log and files are the same again."""
    log = write_log(folder / "log", config, units)
    report = export(log, folder / "out")
    again = load_config(report.folder / "config/config.toml")
    imported, captures = run_import(again, [report.folder], folder / "back")
    assert [capture.tally.damage for capture in captures] == [0] * len(captures)
    assert content_of(folder / "back") == content_of(log)
    assert imported.units == dict(report.units)
    second = export(folder / "back", folder / "out2")
    names = {path.name for path in report.folder.iterdir() if path.is_file()} - {MANIFEST}
    for name in names:
        if len(report.units) == 1 or ".pcap" not in name:  # datagrams of a head's two ports may be in another order
            assert (second.folder / name).read_bytes() == (report.folder / name).read_bytes(), name


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.lists(ANY_UNIT, min_size=1, max_size=25))
def test_any_log_is_restored_exactly(units: list[Unit]) -> None:
    """These include timestamps that step back or exceed 2106, empty reads, non-candump frames and unnamed senders."""
    with tempfile.TemporaryDirectory() as folder:
        there_and_back(Path(folder), write_config(Path(folder)), units)


def test_a_datagram_longer_than_ip_can_carry_is_restored(tmp_path: Path) -> None:
    units: list[Unit] = [
        ("scanner/top", START_NS, bytes(n), peer) for n in (65_507, 65_508, 70_000) for peer in (HEAD, None)
    ]
    there_and_back(tmp_path, write_config(tmp_path), units)


def test_two_heads_on_one_port_are_distinguished_by_their_groups(tmp_path: Path) -> None:
    head = 'protocol = "velodyne-vlp16"\ninstallation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
    text = session_table(tmp_path / "logs")
    for name, where in (("left", "udp:0.0.0.0:2368?group=239.1.2.3"), ("right", "udp:0.0.0.0:2368?group=239.1.2.4")):
        text += f'[scanner.{name}]\ntransport = "{where}"\n{head}'
    units: list[Unit] = [
        (f"scanner/{name}", START_NS + n, bytes([n]), HEAD) for n in range(9) for name in ("left", "right")
    ]
    there_and_back(tmp_path, write_config(tmp_path, text), units)


def frame_of(number: int) -> can.Message:
    """Return frames of every kind in turn."""
    kinds = [
        can.Message(arbitration_id=0x100 + number, data=bytes([number]) * (number % 9), is_extended_id=False),
        can.Message(arbitration_id=0x1000000 + number, data=bytes(8), is_extended_id=True),
        can.Message(arbitration_id=0x200 + number, data=bytes([number]) * 48, is_extended_id=False, is_fd=True),
        can.Message(arbitration_id=0x300 + number, is_remote_frame=True, dlc=4, is_extended_id=False),
    ]
    return kinds[number % len(kinds)]


def parts_of(message: can.Message) -> tuple[int, bytes, bool, bool, bool]:
    """Return the parts of a frame that were on the bus."""
    data = bytes(message.data)
    return message.arbitration_id, data, message.is_extended_id, message.is_fd, message.is_remote_frame


@pytest.mark.slow
def test_units_on_the_wire_are_exported_and_restored(tmp_path: Path) -> None:
    """A real recorder records sentences on a pty, datagrams, frames and edges; its log is exported and imported."""
    port, link, fifo = free_udp_port(), tmp_path / "rover", tmp_path / "pps"
    os.mkfifo(fifo)
    pty = Pty(link)
    can_port = free_udp_port()
    bus_table = f'[imu.main]\ntransport = "can:udp_multicast:{BUS}?port={can_port}"\nprotocol = "canmod-gps"\n'
    config = (
        session_table(tmp_path / "logs")
        + SREP.format(port=port)
        + ROVER_CONFIG.format(path=link, fifo=fifo)
        + bus_table
    )
    sent_bytes, sent, edges, frames = b"", [], [], []
    with (
        Recorder(tmp_path, config) as recorder,
        fifo.open("w") as pps,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        can.Bus(interface="udp_multicast", channel=BUS, port=can_port, ignore_config=True) as bus,
        one_processor(),
    ):
        recorder.wait_said("device_opened", times=4)
        for number in range(40):
            sent.append(bytes([number]) * (100 + number % 3 * 700))
            sender.sendto(sent[-1], ("127.0.0.1", port))
            frames.append(frame_of(number))
            bus.send(frames[-1])
            sentence = nmea_zda(40_000 + number)
            sent_bytes += sentence
            pty.write(sentence)
            edges.append(f"{time.time_ns()} {number}")
            pps.write(edges[-1] + "\n")
            pps.flush()
            time.sleep(0.03)
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    pty.unplug()
    result = swath("export", str(tmp_path / "logs"), str(tmp_path / "out"), "--json")
    assert result.returncode == 0, result.stderr
    [session] = json.loads(result.stdout)["sessions"]
    folder = Path(session["folder"])
    [serial] = folder.glob("gnss-*.nmea")
    assert serial.read_bytes() == sent_bytes
    [pcap] = folder.glob("scanner-*.pcap")
    with pcap.open("rb") as stream:
        assert [bytes(dpkt.ethernet.Ethernet(frame).data.data.data) for _, frame in dpkt.pcap.Reader(stream)] == sent
    with can.CanutilsLogReader(str(folder / "imu-main.log")) as reader:
        assert [parts_of(message) for message in reader] == [parts_of(message) for message in frames]
    [text] = folder.glob("pps-*.txt")
    assert [line.split()[1] for line in text.read_text().splitlines()] == [edge.split()[1] for edge in edges]
    back = swath("import", str(folder / "config/config.toml"), str(tmp_path / "out"), "-o", str(tmp_path / "back"))
    assert back.returncode == 0, back.stderr
    assert content_of(tmp_path / "back") == content_of(tmp_path / "logs")
    for log in (tmp_path / "back").glob("*.mcap"):
        assert mcap_doctor(log).returncode == 0
        assert official_counts(log).total() > 120
    read_log(tmp_path / "back")


# --- what is wrong --------------------------------------------------------------------------------------------------


class TestCommand:
    def test_several_logs_and_a_directory_are_exported(self, tmp_path: Path) -> None:
        config = write_config(tmp_path)
        one = write_log(tmp_path / "a", config, UNITS, "one-20261121T101500Z-ab12")
        write_log(tmp_path / "b", config, UNITS[:3], "two-20261121T101500Z-ab12")
        result = swath("export", str(one), str(tmp_path / "b"), str(tmp_path / "out"))
        assert result.returncode == 0, result.stderr
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
            "one-20261121T101500Z-ab12", "two-20261121T101500Z-ab12",
        ]  # fmt: skip
        assert "gnss-rover.gps: serial, 2 units" in result.stdout
        config_file = tmp_path / "out/one-20261121T101500Z-ab12/config/config.toml"
        one_export = tmp_path / "out/one-20261121T101500Z-ab12"
        result = swath("import", str(config_file), str(one_export), "-o", str(tmp_path / "back"))
        assert result.returncode == 0, result.stderr
        assert content_of(tmp_path / "back") == content_of(one)

    def test_an_existing_export_is_replaced_only_if_asked(self, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", write_config(tmp_path), UNITS)
        assert swath("export", str(log), str(tmp_path / "out")).returncode == 0
        before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}
        result = swath("export", str(log), str(tmp_path / "out"))
        assert result.returncode == 2
        target = tmp_path / "out" / log.stem[:-2]
        assert result.stderr.startswith(f"swath: {target}: already exists; choose another folder or use --overwrite")
        assert result.stderr.count("\n") == 1
        assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")} == before
        (target / "earlier.txt").touch()
        assert swath("export", str(log), str(tmp_path / "out"), "--overwrite").returncode == 0
        assert set((tmp_path / "out").rglob("*")) == set(before)
        (target / "swath-export.json").unlink()  # a folder of the user's own
        result = swath("export", str(log), str(tmp_path / "out"), "--overwrite")
        assert (result.returncode, result.stderr.count("is not an export")) == (2, 1)

    def test_the_intact_part_of_a_damaged_log_is_exported(self, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", write_config(tmp_path), UNITS)
        data = bytearray(log.read_bytes())
        data[data.index(bytes(1206)) + 5] ^= 1
        log.write_bytes(data)
        result = swath("export", str(log), str(tmp_path / "out"), "--json")
        assert result.returncode == 4
        assert result.stderr.startswith(f"swath: {log} at byte ")
        assert result.stderr.count("\n") == 1
        [session] = json.loads(result.stdout)["sessions"]
        assert session["units"] == {"gnss/rover": 2, "imu/main": 2, "pps/main": 1}

    @pytest.mark.parametrize(
        ("arguments", "code", "line"),
        [
            (["nowhere", "out"], 3, "nowhere: no such file or directory"),
            (["README.md", "out"], 3, "README.md"),
            (["only-one"], 2, "Missing argument"),
        ],
    )
    def test_a_file_that_is_not_a_log_is_refused_in_one_line(
        self, tmp_path: Path, arguments: list[str], code: int, line: str
    ) -> None:
        result = swath("export", *(str(tmp_path / one) if one == "out" else one for one in arguments))
        assert result.returncode == code
        assert line in result.stderr
        assert result.stderr.count("\n") == 1
        assert not (tmp_path / "out").exists()

    def test_a_name_that_leads_out_of_the_folder_is_refused(self, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", write_config(tmp_path), UNITS, "x")
        data = log.read_bytes().replace(b"session_id\x01\0\0\0x", b"session_id\x02\0\0\0..")
        head = data.index(b"\x0c", 8)  # the metadata record grows by one byte
        [length] = struct.unpack_from("<Q", data, head + 1)
        log.write_bytes(data[: head + 1] + struct.pack("<Q", length + 1) + data[head + 9 :])
        result = swath("export", str(log), str(tmp_path / "out"))
        assert result.returncode in (3, 4)
        assert "Traceback" not in result.stderr
        assert not list(tmp_path.glob("*.part"))
        assert not (tmp_path / "swath-export.json").exists()


@pytest.mark.long
@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Files are read and written as streams, so four times the datagrams need no more memory."""
    config = write_config(tmp_path)
    payloads = np.random.default_rng(1).integers(0, 256, (500, 1206), dtype=np.uint8)
    peaks: dict[str, list[int]] = {"import": [], "export": []}
    for blocks in (20, 80):
        capture, logs = tmp_path / f"{blocks}.pcap", tmp_path / f"logs{blocks}"
        with capture.open("wb") as stream:
            stream.write(FILE_HEADER)
            for block in range(blocks):
                times = START_NS + (block * 500 + np.arange(500, dtype=np.int64)) * 50_000
                stream.write(pcap_frames(times, block * 500, HEAD, ("10.0.0.1", 2368), payloads).tobytes())
        peaks["import"].append(peak_kib("import", config.path, capture, "-o", logs))
        peaks["export"].append(peak_kib("export", logs, tmp_path / f"out{blocks}"))
    assert capture.stat().st_size > 48_000_000
    assert all(more - less < 15_000 for less, more in peaks.values()), peaks


def peak_kib(*arguments: object) -> int:
    """Return the peak memory of a command in KiB."""
    code = (
        "import resource, sys; from swath.daemon.cli.main import run_app; assert run_app(sys.argv[1:]) == 0; "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    words = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.splitlines()[-1])
