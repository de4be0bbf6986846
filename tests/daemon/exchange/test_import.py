"""Tests ``swath import``: real captures become logs like a recorder's, and faults are reported in a line."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.errors import UserError
from swath.daemon.exchange.capture_files import ImportOptions
from swath.daemon.exchange.captures import Capture
from swath.daemon.exchange.export import export_session
from swath.daemon.exchange.import_ import ReadSoFar
from swath.daemon.exchange.sidecar import read_sidecar, sidecar_of
from swath.daemon.log.directory import take_directory
from swath.daemon.log.reader import open_logs
from swath.daemon.replay.units import timed_units
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.base import CaptureDamageError
from swath.drivers.captures.opening import read_candump, read_pcap, read_serial
from swath.drivers.captures.pcap.writer import FILE_HEADER, pcap_frames
from tests.builders import ROOT
from tests.daemon.builders import mcap_doctor, run_python
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import CONFIG, content_of, run_import, write_config, write_log
from tests.daemon.log_check import official_counts, read_log
from tests.drivers.captures.can_logs import BLF_CLASSIC, blf_container, blf_file, blf_object
from tests.drivers.captures.network import DEVICE, SYN, acknowledging, from_device, write_frames

FIXTURES = ROOT / "fixtures"
VELODYNE = FIXTURES / "velodyne" / "mrpt_vlp16_gps.pcap.gz"
CANDUMP = FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz"
NOVATEL = FIXTURES / "novatel" / "propak6-basic-fix.gps.gz"
RTKLIB = FIXTURES / "rtklib"
UBX = FIXTURES / "ubx" / "ublox-neo-m8t.log.gz"
START_NS = 1_800_000_000_000_000_000
HEAD = ("192.168.1.201", 2368)


def write_pcap(
    path: Path, payloads: list[bytes], port: int = 2368, first_ns: int = START_NS, step_ns: int = 10**6
) -> Path:
    """Write datagrams of a head to a port, one step apart."""
    data = FILE_HEADER
    for number, payload in enumerate(payloads):
        times = np.array([first_ns + number * step_ns], np.int64)
        data += pcap_frames(times, number, HEAD, ("10.0.0.1", port), np.frombuffer(payload, np.uint8)[None]).tobytes()
    path.write_bytes(data)
    return path


def test_progress_counts_the_bytes_read_of_files_as_they_are_on_the_disk(tmp_path: Path) -> None:
    plain, packed = write_pcap(tmp_path / "a.pcap", [bytes(1000)] * 100), tmp_path / "b.pcap.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    captures = [Capture(path, "pcap") for path in (plain, packed, plain)]
    sizes = [capture.path.stat().st_size for capture in captures]
    read = ReadSoFar(captures)
    assert read.total == sum(sizes)
    with plain.open("rb") as first, packed.open("rb", buffering=0) as second, plain.open("rb", buffering=0) as third:
        assert read() == 0
        first.read()
        second.read(10)
        assert read() == sizes[0] + 10
        first.close()
        third.read(5)
        assert read() == sizes[0] + 15
    assert read() == read.total


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Import captures of a scanner, a bus and a receiver, of different years, into one log."""
    folder = tmp_path_factory.mktemp("real")
    write_config(folder)
    result = swath(
        "import", str(folder / "swath.toml"), str(VELODYNE), str(CANDUMP), "--source", f"gnss/rover={NOVATEL}",
        "-o", str(folder / "logs"),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "5367 from unknown devices: can2 (5367)" in result.stdout
    return folder / "logs"


class TestRealCaptures:
    def test_every_unit_is_imported_with_its_timestamp(self, made: Path) -> None:
        content = content_of(made)
        datagrams = list(read_pcap(VELODYNE))
        for topic, port in (("/scanner/top/raw", 2368), ("/scanner/top/aux/raw", 8308)):
            wanted = [(one.time_ns, one.data) for one in datagrams if one.destination and one.destination[1] == port]
            assert [(time_ns, data) for time_ns, data, _ in content[topic]] == wanted
        frames = [(one.time_ns, one.data) for one in read_candump(CANDUMP, channel="can1")]
        assert [(time_ns, data) for time_ns, data, _ in content["/imu/main/raw"]] == frames
        reads = [(one.time_ns, one.data) for one in read_serial(NOVATEL)]
        assert [(time_ns, data) for time_ns, data, _ in content["/gnss/rover/raw"]] == reads
        assert dict(content["/scanner/top/raw"][0][2]) == {
            "protocol": "velodyne-vlp16", "transport": "udp:0.0.0.0:2368", "port": "2368",
            "source_address": "10.0.0.100", "source_port": "2368",
        }  # fmt: skip
        assert dict(content["/imu/main/raw"][0][2])["protocol"] == "canmod-gps"

    def test_info_decodes_it_and_accounts_for_every_unit(self, made: Path) -> None:
        result = swath("info", "--json", str(made))
        assert result.returncode == 0, result.stdout
        [session] = json.loads(result.stdout)["sessions"]
        assert session["origin"] == "import"
        assert session["attachments"] == ["config.toml"]
        sources = session["sources"]
        assert {name: one["units"] for name, one in sources.items()} == {
            "gnss/rover": 10_051, "imu/main": 221, "scanner/top": 293, "scanner/top/aux": 57,
        }  # fmt: skip
        assert sum(one["account_errors"] for one in sources.values()) == 0
        assert sources["scanner/top"]["decoded"]["records"]["ScannerReturns"] == 73_486
        assert session["damage"] == []

    @pytest.mark.slow
    def test_other_readers_accept_it(self, made: Path) -> None:
        for log in made.glob("*.mcap"):
            assert mcap_doctor(log).returncode == 0
            assert sum(count for topic, count in official_counts(log).items() if topic.endswith("/raw")) > 200
        assert read_log(made).damage == 0  # `read_log` compares each status with the units before it
        assert swath("recover", str(made)).returncode == 0
        assert not (made / "recording.json").exists()

    def test_replay_plays_it_in_time_order(self, made: Path) -> None:
        [session] = open_logs([made])
        times = [unit.time_ns for unit in timed_units(session, with_pps=True)]
        assert len(times) == 10_051 + 221 + 293 + 57
        assert times == sorted(times)

    def test_parts_refer_to_each_other_and_to_the_captures(self, made: Path) -> None:
        content = read_log(made)
        names = [one["text"] for one in content.events("part_closed")]
        assert names == sorted(path.name for path in made.glob("*.mcap"))[1:]
        told = [one["text"] for one in content.events("capture_imported")]
        assert f"{VELODYNE.name}: 293 units of scanner/top, 57 units of scanner/top/aux" in told

    def test_importing_the_same_captures_again_overwrites_nothing(self, made: Path) -> None:
        before = {path.name: path.stat().st_mtime_ns for path in made.glob("*.mcap")}
        named = f"gnss/rover={NOVATEL}"
        result = swath("import", str(made.parent / "swath.toml"), "--source", named, "-o", str(made))
        assert result.returncode == 3
        assert "already exists; remove it or choose another directory" in result.stderr
        assert {path.name: path.stat().st_mtime_ns for path in made.glob("*.mcap")} == before


class TestDeviceAssignment:
    def test_units_are_assigned_by_port_sender_interface_or_name(self, tmp_path: Path) -> None:
        text = CONFIG.replace("udp:0.0.0.0:2368", "udp:0.0.0.0:2368?source=192.168.1.201")
        config = write_config(tmp_path, text)
        path = write_pcap(tmp_path / "one.pcap", [b"a", b"b"])
        other = (
            FILE_HEADER
            + pcap_frames(
                np.array([START_NS]), 9, ("1.2.3.4", 5), ("1.1.1.1", 2368), np.zeros((1, 3), np.uint8)
            ).tobytes()
        )[24:]
        path.write_bytes(path.read_bytes() + other)
        _, [capture] = run_import(config, [path], tmp_path / "logs")
        assert (capture.units, capture.passed) == ({"scanner/top": 2}, {"port 2368": 1})

    def test_a_source_with_a_port_or_an_interface_takes_only_those(self, tmp_path: Path) -> None:
        config = write_config(tmp_path)
        both = tmp_path / "both.pcap"
        one, two = write_pcap(tmp_path / "1.pcap", [b"a"], 7000), write_pcap(tmp_path / "2.pcap", [b"b"], 7001)
        both.write_bytes(one.read_bytes() + two.read_bytes()[24:])
        told = ImportOptions([f"scanner/top:7000={both}", f"scanner/top/aux:7001={both}", f"imu/main:can2={CANDUMP}"])
        report, _ = run_import(config, [], tmp_path / "logs", told)
        assert report.units == {"scanner/top": 1, "scanner/top/aux": 1, "imu/main": 5367}
        assert [data for _, data, _ in content_of(tmp_path / "logs")["/scanner/top/aux/raw"]] == [b"b"]
        report, _ = run_import(config, [], tmp_path / "all", ImportOptions([f"imu/main={CANDUMP}"]))
        assert report.units == {"imu/main": 5588}

    def test_a_name_shared_by_two_buses_is_assigned_to_neither(self, tmp_path: Path) -> None:
        text = CONFIG.replace("can:socketcan:can1?bitrate=500000", "can:udp_multicast:239.74.163.2?port=1")
        text += '[imu.other]\ntransport = "can:udp_multicast:239.74.163.2?port=2"\nprotocol = "canmod-gps"\n'
        config, path = write_config(tmp_path, text), tmp_path / "bus.log"
        path.write_text("(1.000000) 239.74.163.2 123#00\n")
        report, [capture] = run_import(config, [path], tmp_path / "none")
        assert (report.units, capture.passed) == ({}, {"239.74.163.2": 1})
        report, _ = run_import(config, [], tmp_path / "logs", ImportOptions([f"imu/other={path}"]))
        assert report.units == {"imu/other": 1}

    def test_each_sender_has_its_own_channel(self, tmp_path: Path) -> None:
        """Senders beyond 256 share one channel, as in the recorder."""
        data = FILE_HEADER
        for number in range(300):
            peer = (f"10.1.{number // 256}.{number % 256}", 2368)
            row = np.full((1, 4), number % 256, np.uint8)
            data += pcap_frames(np.array([START_NS + number]), number, peer, ("10.0.0.1", 2368), row).tobytes()
        (tmp_path / "many.pcap").write_bytes(data)
        run_import(write_config(tmp_path), [tmp_path / "many.pcap"], tmp_path / "logs")
        units = content_of(tmp_path / "logs")["/scanner/top/raw"]
        assert [time_ns - START_NS for time_ns, _, _ in units] == list(range(300))
        assert len({metadata for _, _, metadata in units}) == 257
        assert "source_address" not in dict(units[-1][2])

    def test_two_heads_of_a_real_capture_are_distinguished_by_their_senders(self, tmp_path: Path) -> None:
        """Both send to port 7502, in fragments; after export and import they are the same."""
        capture = FIXTURES / "captures" / "same_ports.pcap.gz"
        text = CONFIG.replace("udp:0.0.0.0:2368", "udp:0.0.0.0:7502")
        config = write_config(tmp_path, text)
        run_import(config, [capture], tmp_path / "logs")
        units = content_of(tmp_path / "logs")["/scanner/top/raw"]
        assert [(time_ns, data) for time_ns, data, _ in units] == [
            (one.time_ns, one.data) for one in read_pcap(capture)
        ]
        assert len({metadata for _, _, metadata in units}) == 4  # each head sends from two ports
        [session] = open_logs([tmp_path / "logs"])
        folder = export_session(session, tmp_path / "out").folder
        run_import(config, [folder], tmp_path / "back")
        assert content_of(tmp_path / "back") == content_of(tmp_path / "logs")

    def test_more_files_than_the_initial_limit_can_be_opened(self, tmp_path: Path) -> None:
        files = [write_pcap(tmp_path / f"{n:03}.pcap", [bytes([n])], first_ns=START_NS + n) for n in range(100)]
        write_config(tmp_path)
        words = ["import", str(tmp_path / "swath.toml"), *map(str, files), "-o", str(tmp_path / "logs")]
        code = "import resource; most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]\n"
        code += f"resource.setrlimit(resource.RLIMIT_NOFILE, (64, most)); sys.exit(cli.run_app({words!r}))"
        assert run_python(code).returncode == 0
        units = content_of(tmp_path / "logs")["/scanner/top/raw"]
        assert [data for _, data, _ in units] == [bytes([n]) for n in range(100)]

    def test_rotated_captures_are_imported_in_time_order(self, tmp_path: Path) -> None:
        config = write_config(tmp_path)
        late = write_pcap(tmp_path / "a.pcap", [b"3", b"4"], first_ns=START_NS + 10**9)
        early = write_pcap(tmp_path / "b.pcap", [b"1", b"2"])
        run_import(config, [late, early, late], tmp_path / "logs")
        units = content_of(tmp_path / "logs")["/scanner/top/raw"]
        assert [data for _, data, _ in units] == [b"1", b"2", b"3", b"4"]


class TestTimestamps:
    """With any timestamps every unit is imported, and parts and statuses stay few."""

    def test_two_alternating_clocks_years_apart_give_few_parts_and_statuses(self, tmp_path: Path) -> None:
        """Two interfaces of one pcapng may have such clocks; a part and a status for each unit would be absurd."""
        data, row = FILE_HEADER, np.zeros((1, 3), np.uint8)
        times = [START_NS // (1 + n % 2) + n * 10**6 for n in range(3000)]
        for n, time_ns in enumerate(times):
            data += pcap_frames(np.array([time_ns]), n, HEAD, ("10.0.0.1", 2368), row).tobytes()
        (tmp_path / "two.pcap").write_bytes(data)
        report, _ = run_import(write_config(tmp_path), [tmp_path / "two.pcap"], tmp_path / "logs")
        assert len(report.paths) <= 2
        content = read_log(tmp_path / "logs")
        assert [time_ns for time_ns, _ in content.units["scanner/top"]] == times
        assert len(content.messages["/status/scanner/top"]) < 10

    def test_statuses_continue_after_an_absurd_timestamp(self, tmp_path: Path) -> None:
        times = [START_NS + n * 10**7 for n in range(3000)]
        times[10] = 4_000_000_000 * 10**9
        data, row = FILE_HEADER, np.zeros((1, 3), np.uint8)
        for n, time_ns in enumerate(times):
            data += pcap_frames(np.array([time_ns]), n, HEAD, ("10.0.0.1", 2368), row).tobytes()
        (tmp_path / "jump.pcap").write_bytes(data)
        run_import(write_config(tmp_path), [tmp_path / "jump.pcap"], tmp_path / "logs")
        content = read_log(tmp_path / "logs")
        assert [time_ns for time_ns, _ in content.units["scanner/top"]] == times
        assert len(content.messages["/status/scanner/top"]) >= 19  # the second after the jump, then one a second

    def test_timestamps_before_1970_and_after_2262_are_damage(self, tmp_path: Path) -> None:
        path = tmp_path / "rover.bin"
        path.write_bytes(b"abcdef")
        rows = ["-5.5,0,2", "1.5,2,2", "9999999999.0,4,2"]
        (tmp_path / "rover.chunks.csv").write_text("\n".join(["arrival_unix_s,offset,length", *rows]) + "\n")
        _, [capture] = run_import(write_config(tmp_path), [], tmp_path / "logs", ImportOptions([f"gnss/rover={path}"]))
        assert [data for _, data, _ in content_of(tmp_path / "logs")["/gnss/rover/raw"]] == [b"cd"]
        assert capture.tally.damage == 2
        assert "no time between 1970 and 2262" in capture.tally.first_damage
        (tmp_path / "rover.chunks.csv").unlink()
        told = ImportOptions([f"gnss/rover={path}"], {"": 9_999_999_999 * 10**9})
        report, [capture] = run_import(write_config(tmp_path), [], tmp_path / "none", told)
        assert (report.units, capture.tally.damage) == ({}, 1)


class TestSerialTimes:
    """The times of a serial stream come from a table, from RTKLIB's tags, or from the user."""

    def test_times_are_taken_from_rtklib_tags(self, tmp_path: Path) -> None:
        data = gzip.decompress(UBX.read_bytes())
        path = tmp_path / "rover.ubx"
        path.write_bytes(data)
        ends = [*range(500, len(data), 500), len(data)]
        tags = b"TIMETAG RTKLIB demo5".ljust(64, b"\0") + struct.pack("<Id", 1_800_000_018, 0.5)
        tags += b"".join(struct.pack("<II", 20 * n, end) for n, end in enumerate(ends))
        (tmp_path / "rover.ubx.tag").write_bytes(tags)
        text = CONFIG.replace('"novatel"', '"ubx"')
        run_import(write_config(tmp_path, text), [], tmp_path / "logs", ImportOptions([f"gnss/rover={path}"]))
        units = content_of(tmp_path / "logs")["/gnss/rover/raw"]
        assert b"".join(unit for _, unit, _ in units) == data
        assert [time_ns for time_ns, _, _ in units] == [
            START_NS + 500_000_000 + 20_000_000 * n for n in range(len(ends))
        ]

    @pytest.mark.slow
    def test_a_capture_of_rtklib_is_imported(self, tmp_path: Path) -> None:
        """It has nine minutes of an IMU on a serial line; CR, which upstream lost, is restored before each LF."""
        data = gzip.decompress((RTKLIB / "imu_1934.csv.gz").read_bytes()).replace(b"\n", b"\r\n")
        (tmp_path / "imu_1934.csv").write_bytes(data)
        (tmp_path / "imu_1934.csv.tag").write_bytes(gzip.decompress((RTKLIB / "imu_1934.csv.tag.gz").read_bytes()))
        write_config(tmp_path)
        named = f"gnss/rover={tmp_path / 'imu_1934.csv'}"
        result = swath("import", str(tmp_path / "swath.toml"), "--source", named, "-o", str(tmp_path / "logs"))
        assert result.returncode == 0, result.stderr
        units = content_of(tmp_path / "logs")["/gnss/rover/raw"]
        assert len(units) == 37_632
        assert b"".join(unit for _, unit, _ in units) == data
        opened = dt.datetime(2025, 7, 8, 19, 34, 21, 854_000, dt.UTC) - dt.timedelta(seconds=18)  # its clock is GPS
        assert units[0][0] == (round(opened.timestamp() * 1000) + 131) * 1_000_000
        assert units[-1][0] - units[0][0] == 548_600_000_000

    @pytest.mark.parametrize(
        ("options", "first_after_ns"),
        [
            (["--start", "2027-01-15T08:00:00Z"], round(512 * 10 / 115_200 * 1e9)),
            (
                ["--start", "gnss/rover=2027-01-15T10:00:00.5+02:00", "--baud", "9600"],
                round(512 / 960 * 1e9) + 5 * 10**8,
            ),
            (["--start", "1800000000.000000007", "--baud", "gnss/rover=0"], 7),
        ],
    )
    def test_times_follow_from_a_start_and_a_rate(
        self, tmp_path: Path, options: list[str], first_after_ns: int
    ) -> None:
        path = tmp_path / "rover.bin"
        path.write_bytes(bytes(1200))
        write_config(tmp_path)
        named = ["--source", f"gnss/rover={path}"]
        result = swath("import", str(tmp_path / "swath.toml"), *named, *options, "-o", str(tmp_path / "logs"))
        assert result.returncode == 0, result.stderr
        units = content_of(tmp_path / "logs")["/gnss/rover/raw"]
        assert units[0][0] - START_NS == first_after_ns
        assert sum(len(data) for _, data, _ in units) == 1200

    def test_corrections_of_a_caster_come_from_their_bytes(self, tmp_path: Path) -> None:
        path = tmp_path / "base.rtcm"
        path.write_bytes(bytes(600))
        text = '[corrections.base]\ntransport = "ntrip:caster.example:2101/MOUNT"\nprotocol = "rtcm3"\n'
        config = write_config(tmp_path, CONFIG + text)
        options = ImportOptions([f"corrections/base={path}"], {"": START_NS})
        report, _ = run_import(config, [], tmp_path / "logs", options)
        assert report.units == {"corrections/base": 2}

    @pytest.mark.parametrize(
        "option",
        [["--start", "yesterday"], ["--start", "2027-01-15T08:00:00"], ["--start", "1969-01-01T00:00:00Z"],
         ["--start", "imu/nobody=1800000000"], ["--baud", "fast"], ["--baud", "-3"], ["--baud", "nan"], []],
    )  # fmt: skip
    def test_missing_times_are_refused_in_one_line(self, tmp_path: Path, option: list[str]) -> None:
        path = tmp_path / "rover.bin"
        path.write_bytes(b"bytes")
        write_config(tmp_path)
        named = ["--source", f"gnss/rover={path}"]
        given = option if "--start" in option or not option else [*option, "--start", "1800000000"]
        result = swath("import", str(tmp_path / "swath.toml"), *named, *given, "-o", str(tmp_path / "logs"))
        assert result.returncode == 2
        assert result.stderr.startswith("swath: ")
        assert "want" in result.stderr or "--start" in result.stderr or "is not a source" in result.stderr
        assert not list((tmp_path / "logs").glob("*.mcap"))


class TestRefusals:
    """Wrong input is refused in one line, with the documented exit code."""

    def run(self, folder: Path, *arguments: str, text: str = CONFIG) -> tuple[int, str, dict[str, Any]]:
        """Return exit code, stderr and the JSON object of an import into ``logs``."""
        write_config(folder, text)
        result = swath("import", str(folder / "swath.toml"), *arguments, "-o", str(folder / "logs"), "--json")
        assert "Traceback" not in result.stderr
        assert all(line.startswith("swath: ") for line in result.stderr.splitlines())
        return result.returncode, result.stderr, json.loads(result.stdout) if result.stdout else {}

    def test_unreadable_input_exits_with_3_and_with_2_beside_wrong_usage(self, tmp_path: Path) -> None:
        """docs/commands.md documents these exit codes."""
        nowhere, folder = str(tmp_path / "nowhere.pcap"), f"gnss/rover={tmp_path}"
        (tmp_path / "cut.gz").write_bytes(gzip.compress(bytes(100))[:15])
        code, error, _ = self.run(tmp_path, str(tmp_path / "cut.gz"))
        assert (code, error.count("\n")) == (3, 1)
        assert "cannot be read" in error
        assert self.run(tmp_path, nowhere)[:2] == (3, f"swath: {nowhere}: No such file or directory\n")
        assert self.run(tmp_path, "--source", folder)[:2] == (3, f"swath: {tmp_path}: Is a directory\n")
        assert not (tmp_path / "logs").exists()
        assert self.run(tmp_path, nowhere, "--source", f"gnss/nobody={nowhere}")[0] == 2

    def test_a_short_truncated_gzip_capture_is_read_to_its_end(self, tmp_path: Path) -> None:
        """A larger truncated capture is read in part; this one is shorter than the bytes that detect its format."""
        frames = [
            f"({1_700_000_000 + i}.{i * 7919 % 10**6:06}) can1 {i * 37 % 2048:03X}#{i * i:08X}" for i in range(200)
        ]
        whole = gzip.compress("\n".join(frames).encode())
        (tmp_path / "short.log.gz").write_bytes(whole[: len(whole) // 2])
        code, error, found = self.run(tmp_path, str(tmp_path / "short.log.gz"))
        assert (code, error.count("\n")) == (4, 1)
        assert "short.log.gz: cannot be read further: " in error
        assert 50 < found["units"]["imu/main"] < 150

    def test_candump_output_without_times_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "shown.log").write_text("  can0  120   [8]  00 11 22 33 44 55 66 77\n" * 2)
        want = "shown.log: its frames have no times; record with candump -L, or with -t a"
        code, error, _ = self.run(tmp_path, str(tmp_path / "shown.log"))
        assert (code, error) == (2, f"swath: {tmp_path}/{want}\n")

    @pytest.mark.parametrize(
        ("begins", "what"),
        [
            (b"\x28\xb5\x2f\xfd", "compressed with zstd; of a bag give the folder with its metadata.yaml"),
            (b"\x89MCAP0\r\n\x01", "MCAP, but no ROS 2 bag"),
            (b"snoop\0\0\0", "a snoop file, which Wireshark's editcap turns into pcapng"),
        ],
    )
    def test_a_container_of_another_format_is_named(self, tmp_path: Path, begins: bytes, what: str) -> None:
        """Formats are recognised by the first bytes written by zstd, MCAP and snoop (RFC 1761)."""
        (tmp_path / "flight.bag").write_bytes(begins + bytes(100))
        code, error, _ = self.run(tmp_path, str(tmp_path / "flight.bag"))
        kinds = "pcap, pcapng, candump, ASC, BLF, TRC, MF4, lvx, CSV, Parquet or a ROS bag"
        want = f"swath: {tmp_path}/flight.bag: is {what}; want {kinds}\n"
        assert (code, error) == (2, want)

    def test_a_capture_of_other_ports_is_reported(self, tmp_path: Path) -> None:
        path = write_pcap(tmp_path / "other.pcap", [b"x"] * 3, 5000)
        code, error, found = self.run(tmp_path, str(path))
        want = f"{path}: holds port 5000 (3), but the configuration has 2368 (scanner/top), 8308 (scanner/top/aux), "
        want += "can1 (imu/main); give --source kind/name=FILE"
        assert (code, error, found["log"]) == (1, f"swath: {want}\n", [])
        assert found["captures"][0]["of_no_device"] == {"port 5000": 3}

    def test_of_two_captures_the_truncated_one_is_reported(self, tmp_path: Path) -> None:
        good = write_pcap(tmp_path / "good.pcap", [b"good"])
        cut = write_pcap(tmp_path / "cut.pcap", [b"one", b"two"])
        cut.write_bytes(cut.read_bytes()[:-1])
        code, error, found = self.run(tmp_path, str(good), str(cut))
        assert (code, error.count("\n")) == (4, 1)
        assert "cut.pcap: ends in a packet, or is damaged, at byte" in error
        assert found["units"] == {"scanner/top": 2}
        [event] = read_log(tmp_path / "logs").events("capture_damaged")
        assert "cut.pcap" in event["text"]

    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (
                ["{}/port.bin"],
                "lvx, CSV, Parquet or a ROS bag; if it holds the bytes of a device, use --source kind/name=",
            ),
            (["{}"], "has no swath-export.json"),
            ([], "nothing to import"),
            (["--source", "gnss/rover"], "want kind/name=FILE"),
            (
                ["--source", "gnss/base={}/port.bin"],
                "gnss/base is not a source of the configuration; there are: pps/main",
            ),
            (
                ["--source", "gnss/rover={}/a.pcap"],
                "a.pcap: is a pcap file, but gnss/rover uses serial; want a file of serial bytes",
            ),
            (["--source", "scanner/top={}/port.bin"], "scanner/top uses udp; want a pcap file"),
            (["--source", "gnss/rover={}/port.bin"], "has no times"),
        ],
    )
    def test_unusable_files_are_refused(self, tmp_path: Path, arguments: list[str], line: str) -> None:
        (tmp_path / "port.bin").write_bytes(b"$GPGGA,")
        write_pcap(tmp_path / "a.pcap", [b"x"])
        code, error, _ = self.run(tmp_path, *(one.replace("{}", str(tmp_path)) for one in arguments))
        assert (code, error.count("\n")) == (2, 1), error
        assert line in error
        assert not (tmp_path / "logs").exists()

    def test_a_configuration_without_port_or_bus_for_a_capture_is_refused(self, tmp_path: Path) -> None:
        path = write_pcap(tmp_path / "a.pcap", [b"x"])
        text = '[session]\nname = "none"\ndirectory = "logs"\n'
        code, error, _ = self.run(tmp_path, str(path), str(CANDUMP), text=text)
        assert code == 2
        assert error.splitlines() == [
            f"swath: {path}: the configuration has no UDP or TCP port and no CAN bus for it",
            f"swath: {CANDUMP}: the configuration has no CAN bus for it",
        ]

    def test_a_recorder_at_work_in_the_directory_is_not_disturbed(self, tmp_path: Path) -> None:
        path = write_pcap(tmp_path / "a.pcap", [b"x"])
        lock = take_directory(tmp_path / "logs")
        code, error, _ = self.run(tmp_path, str(path))
        assert (code, lock > 0) == (3, True)
        assert "another recorder is running there" in error

    def test_a_full_disk_leaves_no_files(self, tmp_path: Path) -> None:
        path = write_pcap(tmp_path / "a.pcap", [bytes(60_000)] * 100)
        write_config(tmp_path)
        words = ["import", str(tmp_path / "swath.toml"), str(path), "-o", str(tmp_path / "logs")]
        code = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        code += "resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))\n"
        code += f"sys.exit(cli.run_app({words!r}))"
        done = run_python(code)
        assert done.returncode == 3, done.stderr
        assert "nothing written" in done.stderr
        assert not list((tmp_path / "logs").glob("*.mcap"))

    @pytest.mark.slow
    def test_a_modified_export_is_reported(self, tmp_path: Path) -> None:
        config = write_config(tmp_path)
        log = write_log(
            tmp_path / "log", config, [("gnss/rover", START_NS + n, bytes([n]) * 10, None) for n in range(9)]
        )
        assert swath("export", str(log), str(tmp_path / "out")).returncode == 0
        [folder] = (tmp_path / "out").iterdir()
        serial = folder / "gnss-rover.gps"
        serial.write_bytes(serial.read_bytes()[:-1])
        code, error, found = self.run(tmp_path, str(tmp_path / "out"))
        assert code == 4
        assert "gnss-rover.gps.swath.csv.gz: names unit 8, but the file beside it ends before" in error
        assert found["units"] == {"gnss/rover": 8}
        manifest = folder / "swath-export.json"
        for text, line in (
            ("{", "is not a manifest"),
            ('{"files": {"../x": {"kind": "serial"}}}', "which is not in its folder"),
            ('{"files": {"gone.log": {"kind": "candump"}}}', "does not exist, but swath-export.json names it"),
            ('{"files": {"gnss-rover.gps": {"kind": "strange"}}}', "does not describe gnss-rover.gps"),
            ('{"files": {"gnss-rover.gps": {"kind": "serial", "source": "gnss/base"}}}', "is not a source"),
            ('{"files": {"gnss-rover.gps": {"kind": "serial", "source": "imu/main"}}}', "uses can"),
        ):
            manifest.write_text(text)
            code, error, _ = self.run(tmp_path, str(folder))
            assert (code, error.count("\n")) == (2, 1)
            assert line in error


@pytest.mark.parametrize("row", ["0,5,3,2,010203", "0,5,3,?,", "0,5,3,0,", "1,5,2,0,010203"])
def test_an_impossible_row_of_a_sidecar_is_reported(tmp_path: Path, row: str) -> None:
    """The row's mark of native entries has an invalid value, or its bytes contradict its length."""
    with gzip.open(sidecar_of(tmp_path / "a.log"), "wt") as stream:
        stream.write(f"unit,time_ns,length,native,data\n{row}\n")
    with pytest.raises(CaptureDamageError, match="line 2: want unit,time_ns,length,native,data"):
        list(read_sidecar(tmp_path / "a.log"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pcap", "tcp", "candump", "blf", "rtklib", "table", "bytes", "sidecar"])
def test_truncated_and_damaged_captures_never_break_an_import(tmp_path: Path, kind: str) -> None:
    """Any fault is counted or refused in one line, and the resulting log is whole."""
    config = write_config(tmp_path)
    rng = np.random.default_rng(5)
    folder = tmp_path / "captures"
    folder.mkdir()
    told = ImportOptions()
    if kind == "pcap":
        target = write_pcap(folder / "a.pcap", [bytes([n]) * 30 for n in range(5)])
    elif kind == "tcp":
        config = write_config(tmp_path, CONFIG.replace("serial:/dev/ttyUSB0?baud=115200", f"tcp:{DEVICE.host}:28784"))
        target = write_frames(
            folder / "a.pcap", [from_device(99, b"abc", SYN), from_device(110, b"d"), acknowledging(103)]
        )
    elif kind == "blf":
        target = folder / "a.blf"
        target.write_bytes(blf_file(blf_container(blf_object(1, BLF_CLASSIC) * 4, 0)))
    elif kind == "candump":
        target = folder / "a.log"
        target.write_text("".join(f"(1.{n:06d}) can1 12{n}#0011\n" for n in range(8)))
    elif kind == "rtklib":
        (folder / "a.gps").write_bytes(bytes(60))
        target = folder / "a.gps.tag"
        tags = b"TIMETAG RTKLIB".ljust(64, b"\0") + struct.pack("<Id", 1_800_000_018, 0.5)
        target.write_bytes(tags + b"".join(struct.pack("<II", n, 10 * n + 10) for n in range(6)))
        told = ImportOptions([f"gnss/rover={folder / 'a.gps'}"])
    elif kind in ("table", "bytes"):
        (folder / "a.gps.gz").write_bytes(gzip.compress(bytes(range(60))))
        rows = [f"{1_800_000_000 + n}.5,{n * 10},10" for n in (0, 1, 3, 2, 5)]  # as a table may have them: not in order
        (folder / "a.chunks.csv").write_text("\n".join(["arrival_unix_s,offset,length", *rows]) + "\n")
        target = folder / ("a.chunks.csv" if kind == "table" else "a.gps.gz")
        told = ImportOptions([f"gnss/rover={folder / 'a.gps.gz'}"])
    else:
        log = write_log(
            tmp_path / "log", config, [("imu/main", START_NS + n, encode_can_frame(n, b"ab"), None) for n in range(9)]
        )
        assert swath("export", str(log), str(tmp_path / "out")).returncode == 0
        [exported] = (tmp_path / "out").iterdir()
        shutil.copytree(exported, folder, dirs_exist_ok=True)
        target = folder / "imu-main.log.swath.csv.gz"
    whole, made = target.read_bytes(), 0
    files = [] if told.named else [folder if kind == "sidecar" else target]
    for at in range(0, len(whole), 3):
        flipped = whole[:at] + bytes([whole[at] ^ int(rng.integers(1, 256))]) + whole[at + 1 :]
        for number, data in enumerate((whole[:at], flipped, whole[:at] + rng.bytes(50) + whole[at:])):
            target.write_bytes(data)
            output = tmp_path / f"logs{at}-{number}"
            try:
                report, captures = run_import(config, files, output, told)
            except (UserError, OSError):
                continue
            assert sum(report.units.values()) == sum(capture.units.total() for capture in captures)
            if report.paths:
                made += 1
                assert read_log(output).damage == 0
            shutil.rmtree(output, ignore_errors=True)
    assert made > 0
