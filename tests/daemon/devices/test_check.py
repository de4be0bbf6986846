"""Tests `swath check` on real ptys, UDP ports, CAN buses and FIFOs, with right, silent and wrong devices."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import can
import numpy as np
import pytest

from swath.daemon.config import DeviceEntry, parse_config
from swath.daemon.devices.check import Report, bitrate_problems, check_everything
from swath.daemon.devices.identify import describe_tag, identify
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.opening import read_pcap
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.hesai.models import XT32
from swath.drivers.scanner.robosense.heads import HELIOS32
from swath.drivers.scanner.robosense.parser import encode_msop
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.velodyne.position import PPS_ABSENT, PPS_LOCKED, encode_position_packet
from swath.drivers.transports.spec import parse_transport
from swath.georef.records import ChunkBatch, TimeScale, TimeTag
from tests.daemon.builders import nmea_sentence
from tests.daemon.rig import HANGS_S, free_udp_port
from tests.daemon.wires import pty, repeating, udp_sender
from tests.drivers.scanner.hesai.builders import packet
from tests.drivers.vnb import read_messages

ROOT = Path(__file__).parents[3]
CANMOD = ROOT / "fixtures/canmod-gps/3BA199E2_00000164_00000005_candump.log.gz"
GROUP = "239.74.163.2"
LISTEN_S = 1.2


def epoch(second: int, valid: bool = True) -> bytes:
    """Return the messages of a receiver for one second."""
    status = "A" if valid else "V"
    clock = f"1015{second % 60:02}.00"
    return nmea_sentence(f"GPRMC,{clock},{status},4730.0000,N,00900.0000,E,0.0,0.0,211126,,,A") + nmea_sentence(
        f"GPGGA,{clock},4730.0000,N,00900.0000,E,{int(valid)},12,0.8,500.0,M,47.0,M,,"
    )


def srep_datagram(sequence: int, pps_count: int = 3) -> bytes:
    header = SrepHeader(
        sequence=sequence,
        flags=int(pps_count > 0),
        pps_count=pps_count,
        pps_ticks=1_000_000,
        first_ticks=1_500_000 + 1000 * sequence,
    )
    ticks = np.arange(10) * 50
    return encode_datagram(header, ticks, np.arange(10) * 100, np.full((10, 1), 9_000_000))


@contextmanager
def pps_fifo(path: Path, spacing_ns: int = 1_000_000_000) -> Iterator[str]:
    """Make a FIFO whose edges come faster than real ones, to save time, but have stamps at the real spacing."""
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    start_ns = time.time_ns() // 1_000_000_000 * 1_000_000_000

    def write(number: int) -> None:
        os.write(fd, f"{start_ns + number * spacing_ns} {number}\n".encode())

    try:
        with repeating(write, 0.1):
            yield f"fixed:{path}"
    finally:
        os.close(fd)


def check(text: str, folder: Path, seconds: float = LISTEN_S) -> dict[str, Report]:
    """Return reports of a configuration by source."""
    config = parse_config(f'[session]\nname = "x"\ndirectory = "."\nreserve_mb = 1\n{text}', folder / "swath.toml")
    return {report.source: report for report in check_everything(config, seconds)}


def gnss(path: str, protocol: str = "nmea", more: str = "") -> str:
    return f'[gnss.rover]\ntransport = "serial:{path}?baud=115200"\nprotocol = "{protocol}"\n{more}\n'


def srep(port: int, more: str = "") -> str:
    transport = f"udp:127.0.0.1:{port}?buffer_mb=1"
    return f'[scanner.left]\ntransport = "{transport}"\nprotocol = "srep"\nmirror_factor = 2\n{more}\n'


class TestWorkingDevices:
    def test_every_device_responds_and_gives_its_time(self, tmp_path: Path) -> None:
        port = free_udp_port()
        with pty(epoch) as path, pps_fifo(tmp_path / "edges") as edges, udp_sender(port, srep_datagram):
            pps = f'[pps.main]\nsource = "{edges}"\n'
            reports = check(pps + gnss(path, more='pps = "main"') + srep(port, 'pps = "main"'), tmp_path)
        assert list(reports) == ["pps/main", "gnss/rover", "scanner/left", "log"]
        assert {source: report.problems for source, report in reports.items() if report.problems} == {}
        assert all(report.opens for report in reports.values())
        assert reports["pps/main"].time == "every 1.0000 s"
        assert reports["gnss/rover"].records["GnssFix"] > 0
        assert reports["gnss/rover"].time.startswith("2026-11-21 10:15:")
        assert reports["scanner/left"].records["ScannerReturns"] == 10 * reports["scanner/left"].units
        assert reports["scanner/left"].time == "PPS seen"

    def test_both_ports_of_a_real_head_are_one_device(self, tmp_path: Path) -> None:
        """The VLP-16 is locked to its PPS, which only the position packets report, on their own port."""
        data, position = free_udp_port(), free_udp_port()
        recorded = list(read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz"))
        streams = [[unit.data for unit in recorded if len(unit.data) == length] for length in (1206, 512)]
        text = (
            f'[scanner.roof]\ntransport = "udp:127.0.0.1:{data}?buffer_mb=1"\nprotocol = "velodyne-vlp16"\n'
            f'auxiliary = "udp:127.0.0.1:{position}?buffer_mb=1"\npps = "main"\n'
            'installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n[pps.main]\nsource = "/dev/pps0"\n'
        )
        with (
            udp_sender(data, lambda n: streams[0][n % len(streams[0])]),
            udp_sender(position, lambda n: streams[1][n % len(streams[1])]),
        ):
            reports = check(text, tmp_path, 0.5)
        assert reports["scanner/roof"].records["ScannerReturns"] > 0
        assert reports["scanner/roof"].time in {"PPS seen", "2016-01-21 08:18:02 UTC (position RMC)"}
        assert reports["scanner/roof"].problems == []
        assert reports["scanner/roof/aux"].bytes == 512 * reports["scanner/roof/aux"].units > 0

    @pytest.mark.parametrize(
        ("pps", "status", "said"),
        [
            (PPS_LOCKED, "V", "the time sentences at its input are void; wait until the receiver has a fix"),
            (PPS_ABSENT, "A", "it reports that it is not locked to a pulse; wire the receiver's PPS to it"),
        ],
    )
    def test_a_head_without_fix_or_pulse_is_reported(self, tmp_path: Path, pps: int, status: str, said: str) -> None:
        data, position = free_udp_port(), free_udp_port()
        recorded = list(read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz"))
        packets = [unit.data for unit in recorded if len(unit.data) == 1206]
        text = (
            f'[scanner.roof]\ntransport = "udp:127.0.0.1:{data}?buffer_mb=1"\nprotocol = "velodyne-vlp16"\n'
            f'auxiliary = "udp:127.0.0.1:{position}?buffer_mb=1"\ninstallation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
        )

        def told(second: int) -> bytes:
            sentence = nmea_sentence(
                f"GPRMC,1015{second % 60:02}.00,{status},4730.0,N,00900.0,E,0.0,0.0,211126,,,A"
            ).decode()
            return encode_position_packet((15 * 60 + second % 60) * 1_000_000, pps, sentence.strip())

        with udp_sender(data, lambda n: packets[n % len(packets)]), udp_sender(position, told):
            (note,) = check(text, tmp_path, 0.5)["scanner/roof"].notes
        assert note == said

    def test_a_head_whose_lock_cannot_be_known_is_reported(self, tmp_path: Path) -> None:
        """The head's data port is alone: the report recommends `auxiliary`, or names the clock if one is configured."""
        data = free_udp_port()
        recorded = list(read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz"))
        packets = [unit.data for unit in recorded if len(unit.data) == 1206]
        text = (
            f'[scanner.roof]\ntransport = "udp:127.0.0.1:{data}?buffer_mb=1"\nprotocol = "velodyne-vlp16"\n'
            "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
        )
        with udp_sender(data, lambda n: packets[n % len(packets)]):
            (note,) = check(text, tmp_path, 0.5)["scanner/roof"].notes
            (configured,) = check(text + 'clock = "utc-hour"\n', tmp_path, 0.5)["scanner/roof"].notes
        assert "no position packet (Velodyne port 8308" in note
        assert "set auxiliary" in note
        assert 'clock = "utc-hour"' in configured

    def test_a_head_whose_clock_nobody_set_is_doubtful(self, tmp_path: Path) -> None:
        """Without GPS or PTP the heads of several makers show a date of 2017 (HesaiLidar_General_ROS #16)."""
        data = free_udp_port()
        text = (
            f'[scanner.roof]\ntransport = "udp:127.0.0.1:{data}?buffer_mb=1"\nprotocol = "hesai-xt32"\n'
            "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
        )
        time = dt.datetime(2017, 3, 2, 1, 0, 0, tzinfo=dt.UTC)
        with udp_sender(data, lambda n: packet(XT32, time=time + dt.timedelta(milliseconds=n), sequence=n + 1)):
            report = check(text, tmp_path, 0.5)["scanner/roof"]
        (doubt,) = [line for line in report.doubts if "clock" in line]
        assert doubt.startswith("its clock shows 2017-03-02 01:00:0")
        assert "neither PTP nor a receiver has set it" in doubt
        assert report.notes == []

    def test_two_heads_on_one_port_are_a_problem(self, tmp_path: Path) -> None:
        """Two heads as delivered send to the same port of the same computer (ros-drivers/velodyne #346)."""
        data = free_udp_port()
        with udp_sender(data, srep_datagram, "127.0.0.2"), udp_sender(data, srep_datagram, "127.0.0.3"):
            mixed = check(srep(data), tmp_path, 0.3)["scanner/left"]
            told_apart = check(srep(data).replace("?", "?source=127.0.0.3&"), tmp_path, 0.3)["scanner/left"]
        (problem,) = mixed.problems
        assert problem.startswith("2 devices send to its port at the same time and are read as one: 127.0.0.")
        assert told_apart.problems == []

    def test_a_head_is_read_by_the_metadata_beside_the_configuration(self, tmp_path: Path) -> None:
        """The head is an OS0 with its own IMU, on two ports."""
        lidar, imu = free_udp_port(), free_udp_port()
        capture = ROOT / "fixtures/ouster/crc_test.pcap.gz"
        metadata = (ROOT / "fixtures/ouster/crc_test.json").read_text()
        (tmp_path / "os0.json").write_text(metadata.replace("TIME_FROM_INTERNAL_OSC", "TIME_FROM_SYNC_PULSE_IN"))
        streams = [[unit.data for unit in read_pcap(capture, port=port)] for port in (7502, 7503)]
        text = (
            f'[scanner.roof]\ntransport = "udp:127.0.0.1:{lidar}?buffer_mb=1"\nprotocol = "ouster"\n'
            f'auxiliary = "udp:127.0.0.1:{imu}?buffer_mb=1"\ninstallation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
            'pps = "main"\n[scanner.roof.geometry]\nfile = "os0.json"\n[pps.main]\nsource = "/dev/pps0"\n'
        )
        with (
            udp_sender(lidar, lambda n: streams[0][n % len(streams[0])]),
            udp_sender(imu, lambda n: streams[1][n % len(streams[1])]),
        ):
            reports = check(text, tmp_path, 0.5)
        assert reports["scanner/roof"].problems == []
        assert reports["scanner/roof"].records["ScannerReturns"] > 0
        assert reports["scanner/roof"].time == ""  # its packets do not say whether pulses come
        assert reports["scanner/roof"].records["ImuSamples"] == reports["scanner/roof/aux"].units > 0

    def test_an_imu_inside_a_gnss_stream_is_checked_on_the_same_wire(self, tmp_path: Path) -> None:
        """A NovAtel SPAN recording carries two devices on one wire."""
        data = (ROOT / "fixtures/novatel/ins1.gps").read_bytes()
        imu = '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\n'
        with pty(lambda number: data[number * 2000 % len(data) :][:2000]) as path:
            reports = check(gnss(path, "novatel") + imu, tmp_path)
        assert list(reports) == ["gnss/rover", "imu/main", "log"]
        assert reports["imu/main"].records["InsSolution"] > 0
        assert reports["imu/main"].bytes == reports["gnss/rover"].bytes > 0
        assert reports["imu/main"].problems == []

    def test_an_imu_on_a_serial_line_is_checked(self, tmp_path: Path) -> None:
        data = gzip.decompress((ROOT / "fixtures/xsens/1_output.bin.gz").read_bytes())
        with pty(lambda number: data[number * 2000 % len(data) :][:2000]) as path:
            report = check(f'[imu.main]\ntransport = "serial:{path}"\nprotocol = "xsens-xbus"\n', tmp_path)["imu/main"]
        assert report.problems == []
        assert report.records["ImuSamples"] > 10
        assert report.time.startswith("2019-01-20 13:47:2")

    def test_the_auxiliary_port_has_its_own_line(self, tmp_path: Path) -> None:
        port, auxiliary = free_udp_port(), free_udp_port()
        with udp_sender(port, srep_datagram), udp_sender(auxiliary, lambda _: bytes(512)):
            more = f'auxiliary = "udp:127.0.0.1:{auxiliary}?buffer_mb=1"'
            reports = check(srep(port, more), tmp_path, 0.5)
        assert reports["scanner/left/aux"].bytes == 512 * reports["scanner/left/aux"].units > 0
        assert reports["scanner/left/aux"].problems == []


class TestAbsentDevices:
    def test_a_missing_device_is_reported(self, tmp_path: Path) -> None:
        report = check(gnss(str(tmp_path / "ttyNone")), tmp_path, 0.3)["gnss/rover"]
        assert not report.opens
        [problem] = report.problems
        assert "ttyNone" in problem

    def test_a_missing_pps_is_reported(self, tmp_path: Path) -> None:
        report = check(f'[pps.main]\nsource = "{tmp_path}/pps9"\n', tmp_path, 0.3)["pps/main"]
        assert not report.opens
        assert "pps9" in report.problems[0]

    def test_a_silent_device_is_reported(self, tmp_path: Path) -> None:
        with pty() as path:
            report = check(gnss(path), tmp_path, 0.3)["gnss/rover"]
        assert report.opens
        assert report.problems == ["opened, but sent nothing in 0.3 s; check its power, wiring and output port"]

    def test_a_pps_without_edges_is_reported(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "edges")
        report = check(f'[pps.main]\nsource = "fixed:{tmp_path}/edges"\n', tmp_path, 0.3)["pps/main"]
        assert report.problems[0].startswith("no assert edge in 0.3 s")

    def test_a_port_held_by_another_program_is_reported(self, tmp_path: Path) -> None:
        with socket(AF_INET, SOCK_DGRAM) as holder:
            holder.bind(("127.0.0.1", 0))
            port = holder.getsockname()[1]
            report = check(srep(port), tmp_path, 0.3)["scanner/left"]
        assert not report.opens
        assert f"port {port} is in use" in report.problems[0]


class TestOtherProtocols:
    def test_a_receiver_of_another_protocol_is_named(self, tmp_path: Path) -> None:
        with pty(epoch) as path:
            report = check(gnss(path, "novatel"), tmp_path)["gnss/rover"]
        assert report.problems == ["sends nmea, but novatel is configured"]

    def test_a_scanner_of_another_protocol_is_named(self, tmp_path: Path) -> None:
        port = free_udp_port()
        text = srep(port).replace('"srep"', '"velodyne-vlp16"').replace("mirror_factor = 2", "")
        with udp_sender(port, srep_datagram):
            identity = "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
            report = check(text + identity, tmp_path, 0.5)["scanner/left"]
        assert report.problems == ["sends srep, but velodyne-vlp16 is configured"]

    def test_real_recordings_of_other_receivers_are_named(self, tmp_path: Path) -> None:
        told = (
            ("nmea", "novatel/propak6-basic-fix.gps.gz", "novatel"),
            ("nmea", "ubx/ublox-zed-f9p-hp.log.gz", "ubx"),
            ("novatel", "ubx/ublox-zed-f9p-hp.log.gz", "ubx"),
            ("novatel", "nmea/nmea-rtk.log.gz", "nmea"),
            ("ubx", "novatel/propak6-basic-fix.gps.gz", "novatel"),
            ("novatel", "sbf/sbfdata.log.gz", "sbf"),
            ("nmea", "sbf/sbfdata.log.gz", "sbf"),
            ("ubx", "sbf/pygpsdata_x5status.log.gz", "sbf"),
            ("sbf", "nmea/polarx2.log.gz", "nmea"),
            ("sbf", "ubx/ublox-zed-f9p-hp.log.gz", "ubx"),
            ("ubx", "nmea/nmea-rtk.log.gz", "nmea"),
            ("novatel", "unicore/um982_n4.bin", "unicore"),
            ("nmea", "gsof/bx992.bin", "gsof"),
            ("ubx", "applanix/pos_lv.bin", "applanix-pos"),
        )

        def part_of(recording: str) -> Callable[[int], bytes]:
            content = (ROOT / "fixtures" / recording).read_bytes()
            data = gzip.decompress(content) if recording.endswith(".gz") else content
            return lambda number: data[number * 2000 % len(data) :][:2000]

        text, wanted = "", {}
        with ExitStack() as ports:
            for number, (configured, recording, answers_as) in enumerate(told):
                path = ports.enter_context(pty(part_of(recording)))
                text += gnss(path, configured).replace("[gnss.rover]", f"[gnss.r{number}]")
                wanted[f"gnss/r{number}"] = [f"sends {answers_as}, but {configured} is configured"]
            reports = check(text, tmp_path)
        assert {source: reports[source].problems for source in wanted} == wanted

    def test_a_real_recording_of_another_scanner_is_named(self, tmp_path: Path) -> None:
        """A VLP-16 sends where a line scanner is configured."""
        port = free_udp_port()
        recorded = [unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/nebula_vlp16.pcap.gz")]
        with udp_sender(port, lambda number: recorded[number % len(recorded)]):
            report = check(srep(port), tmp_path, 0.5)["scanner/left"]
        assert report.problems == ["sends velodyne-vlp16, but srep is configured"]

    def test_a_head_that_needs_metadata_is_recognised_by_its_packet_format(self, tmp_path: Path) -> None:
        port = free_udp_port()
        recorded = [unit.data for unit in read_pcap(ROOT / "fixtures/ouster/crc_test.pcap.gz", port=7502)]
        with udp_sender(port, lambda number: recorded[number % len(recorded)]):
            report = check(srep(port), tmp_path, 0.5)["scanner/left"]
        assert report.problems == ["sends ouster, but srep is configured"]

    @pytest.mark.parametrize(
        ("unit", "frames", "protocol"),
        [
            (2048, gzip.decompress((ROOT / "fixtures/xsens/2_output.bin.gz").read_bytes()), "xsens-xbus"),
            (512, b"".join(read_messages(ROOT / "fixtures/vectornav/FixedSize_vn310-imu.vnb.gz")), "vectornav"),
            (
                2048,
                gzip.decompress((ROOT / "fixtures/microstrain/mip_data.bin.gz").read_bytes())[:65536],
                "microstrain",
            ),
            (1024, gzip.decompress((ROOT / "fixtures/sbg-ecom/made.bin.gz").read_bytes()), "sbg-ecom"),
            (1024, gzip.decompress((ROOT / "fixtures/oxts-ncom/made.bin.gz").read_bytes()), "oxts-ncom"),
            (16, b"".join(encode_can_frame(number, bytes(8)) for number in (0x120, 0x121, 0x122)) * 20, "sbg-ellipse"),
            (16, b"".join(encode_can_frame(number, bytes(8)) for number in (0x005, 0x032, 0x034)) * 20, "xsens-mti"),
        ],
        ids=["xsens-xbus", "vectornav", "microstrain", "sbg-ecom", "oxts-ncom", "sbg-ellipse", "xsens-mti"],
    )
    def test_an_imu_of_another_protocol_is_named(self, unit: int, frames: bytes, protocol: str) -> None:
        whole = len(frames) // unit
        rows = np.frombuffer(frames[: whole * unit], np.uint8).reshape(whole, unit)
        kept = [ChunkBatch("imu/main", np.arange(whole, dtype=np.int64) * 1_000_000, rows)]
        spec = parse_transport("serial:/dev/ttyUSB0")
        entry = DeviceEntry("imu", "main", spec, None, "nmea2000", None, DeviceSettings("imu/main"), {})
        assert identify(entry, kept, than=0) == protocol

    def test_heads_whose_packets_are_alike_are_named_together(self) -> None:
        """A packet of a Helios does not show whether it has 16 or 32 lasers."""
        time = dt.datetime(2026, 11, 21, tzinfo=dt.UTC)
        unit = encode_msop(time, np.arange(12) * 20, np.full((12, 32), 1000), 7, HELIOS32)
        rows = np.frombuffer(unit * 20, np.uint8).reshape(20, -1)
        kept = [ChunkBatch("scanner/left", np.arange(20, dtype=np.int64) * 1_000_000, rows)]
        spec = parse_transport("udp:0.0.0.0:6699")
        entry = DeviceEntry("scanner", "left", spec, None, "robosense-rs16", None, DeviceSettings("scanner/left"), {})
        assert identify(entry, kept, than=0) == "robosense-helios16p or robosense-helios32"

    @pytest.mark.slow
    def test_heads_of_other_models_are_named_despite_an_identical_second_port(self, tmp_path: Path) -> None:
        """Velodyne's position packets are the same for all models, but the data packets are another model's."""
        models = (
            ("velodyne/nebula_vlp32.pcap.gz", "velodyne-vlp32c"),
            ("hesai/nebula_xt32.pcap.gz", "hesai-xt32"),
            ("hesai/nebula_qt64.pcap.gz", "hesai-qt64"),
            ("hesai/nebula_xt16.pcap.gz", "hesai-xt16"),
            ("hesai/nebula_xt32m.pcap.gz", "hesai-xt32m2x"),
            ("hesai/nebula_qt128.pcap.gz", "hesai-qt128"),
        )
        packets = [unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz", port=8308)]

        def turns_of(recording: str) -> Callable[[int], bytes]:
            recorded = [unit.data for unit in read_pcap(ROOT / "fixtures" / recording)]
            return lambda number: recorded[number % len(recorded)]

        text, wanted = "", {}
        with ExitStack() as ports:
            for recording, answers_as in models:
                data, position = free_udp_port(), free_udp_port()
                text += (
                    f'[scanner.{answers_as}]\ntransport = "udp:127.0.0.1:{data}?buffer_mb=1"\n'
                    f'protocol = "velodyne-vlp16"\nauxiliary = "udp:127.0.0.1:{position}?buffer_mb=1"\n'
                    "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
                )
                wanted[f"scanner/{answers_as}"] = [f"sends {answers_as}, but velodyne-vlp16 is configured"]
                ports.enter_context(udp_sender(data, turns_of(recording)))
                ports.enter_context(
                    udp_sender(position, lambda number: packets[number % len(packets)] if number % 9 == 0 else b"")
                )
            reports = check(text, tmp_path)
        assert {source: reports[source].problems for source in wanted} == wanted

    def test_garbage_matches_no_protocol_and_suggests_the_baud_rate(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(7).integers(128, 255, 4000, dtype=np.uint8).tobytes()
        with pty(lambda _: noise) as path:
            report = check(gnss(path), tmp_path, 0.5)["gnss/rover"]
        want = "its data are neither nmea nor another known gnss protocol; check the baud rate"
        assert report.problems == [want]

    def test_damaged_messages_are_counted(self, tmp_path: Path) -> None:
        with pty(lambda number: epoch(number) + epoch(number).replace(b"4730", b"4731")) as path:
            report = check(gnss(path), tmp_path)["gnss/rover"]
        assert any("messages damaged" in problem for problem in report.problems)


class TestCan:
    """A real CANmod.gps recording is sent on its own bus."""

    @pytest.fixture
    def port(self) -> Iterator[int]:
        with gzip.open(CANMOD, "rt") as log:
            frames = [line.split()[2].split("#") for line in log if " can2 " in line]
        messages = [
            can.Message(arbitration_id=int(name, 16), data=bytes.fromhex(data), is_extended_id=False)
            for name, data in frames
        ]
        port = free_udp_port()
        with can.Bus(interface="udp_multicast", channel=GROUP, port=port, ignore_config=True) as bus:

            def send(number: int) -> None:
                for message in messages[number * 100 % len(messages) :][:100]:
                    bus.send(message)

            with repeating(send):
                yield port

    def test_a_real_recording_on_a_bus_is_checked(self, port: int, tmp_path: Path) -> None:
        text = f'[imu.main]\ntransport = "can:udp_multicast:{GROUP}?port={port}"\nprotocol = "canmod-gps"\n'
        report = check(text, tmp_path)["imu/main"]
        assert report.problems == []
        assert report.records["ImuSamples"] > 100
        assert report.bytes == 16 * report.units

    @pytest.mark.parametrize(("tick_hz", "rate"), [(1_000_000, None), (10_000, 100.0), (100_000_000, 0.01)])
    def test_a_counter_in_the_wrong_unit_is_reported(self, tick_hz: int, rate: float | None, tmp_path: Path) -> None:
        """The MTi's SampleTime is in microseconds, but its documents state two different units."""
        port = free_udp_port()
        with can.Bus(interface="udp_multicast", channel=GROUP, port=port, ignore_config=True) as bus:

            def send(_: int) -> None:
                ticks = (time.monotonic_ns() // 1000 % 2**32).to_bytes(4, "big")
                for identifier, data in ((0x005, ticks), (0x032, bytes(6)), (0x034, bytes(6))):
                    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

            with repeating(send, 0.02):
                transport = f"can:udp_multicast:{GROUP}?port={port}"
                table = f'transport = "{transport}"\nprotocol = "xsens-mti"\ntick_hz = {tick_hz}\n'
                report = check(f"[imu.main]\n{table}", tmp_path)["imu/main"]
        assert report.records["ImuSamples"] > 10
        if rate is None:
            assert report.problems == []
        else:
            [problem] = report.problems
            said = re.fullmatch(r"its counter runs (\S+) times as fast as time; check tick_hz", problem)
            assert said
            assert float(said[1]) == pytest.approx(rate, rel=0.1)

    def test_a_device_of_another_protocol_is_named(self, port: int, tmp_path: Path) -> None:
        (tmp_path / "imu.dbc").write_bytes((ROOT / "fixtures/config/imu.dbc").read_bytes())
        text = (
            f'[imu.main]\ntransport = "can:udp_multicast:{GROUP}?port={port}"\nprotocol = "dbc"\ndbc = "imu.dbc"\n'
            '[imu.main.signals]\nspecific_force = ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"]\n'
            'angular_rate = ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"]\n'
        )
        report = check(text, tmp_path)["imu/main"]
        assert report.problems == ["sends canmod-gps, but dbc is configured"]


class TestTime:
    def test_a_receiver_without_valid_time_is_reported(self, tmp_path: Path) -> None:
        with pty(lambda number: epoch(number, valid=False)) as path:
            report = check(gnss(path), tmp_path)["gnss/rover"]
        assert report.problems == ["its time is not valid yet"]
        assert report.time == "not valid"

    def test_a_receiver_in_local_time_is_reported_and_not_refused(self, tmp_path: Path) -> None:
        """The receiver is two hours east of UTC; the computer's clock is set but not synchronised."""

        def local(_: int) -> bytes:
            now = dt.datetime.now(dt.UTC) + dt.timedelta(hours=2)
            return nmea_sentence(f"GPRMC,{now:%H%M%S}.00,A,4730.0000,N,00900.0000,E,0.0,0.0,{now:%d%m%y},,,A")

        with pty(local) as path:
            report = check(gnss(path), tmp_path)["gnss/rover"]
        assert report.problems == []
        (note,) = report.notes
        assert note.startswith("its time is 2 h ahead of this computer's clock")

    def test_a_scanner_that_does_not_see_its_pps_is_reported(self, tmp_path: Path) -> None:
        port = free_udp_port()
        pps = '[pps.main]\nsource = "/dev/pps0"\n'
        with udp_sender(port, lambda number: srep_datagram(number, pps_count=0)):
            report = check(pps + srep(port, 'pps = "main"'), tmp_path, 0.5)["scanner/left"]
        assert report.problems == ["does not see its PPS (main)"]

    def test_edges_of_another_pulse_are_reported(self, tmp_path: Path) -> None:
        with pps_fifo(tmp_path / "edges", spacing_ns=200_000_000) as edges:
            report = check(f'[pps.main]\nsource = "{edges}"\n', tmp_path)["pps/main"]
        assert report.problems == ["edges are 0.2000 s apart, want 1 s; check for noise or another signal"]

    @pytest.mark.parametrize(
        ("tag", "text"),
        [
            (TimeTag(TimeScale.GPS, 555_303_000_000_000, week=2443), "GPS week 2443, 555303.0 s"),
            (TimeTag(TimeScale.GPS, 555_303_000_000_000), "GPS week ?, 555303.0 s"),
            (TimeTag(TimeScale.UTC, 86_400_000_000_000), "24:00:00 UTC"),
        ],
    )
    def test_a_time_tag_is_described_as_far_as_it_is_known(self, tag: TimeTag, text: str) -> None:
        assert describe_tag(tag) == text


class TestComputer:
    def test_a_full_directory_is_reported(self, tmp_path: Path) -> None:
        config = parse_config('[session]\nname = "x"\ndirectory = "."\nreserve_mb = 10000000\n', tmp_path / "a.toml")
        [report] = check_everything(config, 0.1)
        assert "MB free, reserve_mb is 1e+07" in report.problems[0]

    def test_a_can_interface_of_another_bit_rate_is_reported_with_the_command(self) -> None:
        spec = parse_transport("can:socketcan:can0?bitrate=1000000")
        command = "ip link set can0 down && ip link set can0 up type can bitrate 1000000"
        assert bitrate_problems(spec, 250_000) == [
            f"can0 runs at 250000 bit/s, but 1000000 is configured; run `{command}`"
        ]
        assert bitrate_problems(spec, 1_000_000) == []
        assert bitrate_problems(spec, None) == []

    def test_a_receive_buffer_that_is_not_granted_is_reported(self, tmp_path: Path) -> None:
        """The process may not force the buffer's size, like the service."""
        config = tmp_path / "swath.toml"
        port = free_udp_port()
        text = srep(port).replace("buffer_mb=1", "buffer_mb=1023")
        config.write_text(f'[session]\nname = "x"\ndirectory = "."\nreserve_mb = 1\n{text}')
        with udp_sender(port, srep_datagram):
            run = _unprivileged("check", str(config), "--seconds", "0.5", "--json")
        assert run.returncode == 1, run.stderr
        found = json.loads(run.stdout)
        assert found["ok"] is False
        [problem] = found["devices"][0]["problems"]
        limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
        want = (
            f"receive buffer: asked for {1023 << 20} bytes, got {limit}; run `sysctl -w net.core.rmem_max={1023 << 20}`"
        )
        assert problem.startswith(want)

    def test_the_table_has_a_line_for_each_device_and_each_problem(self, tmp_path: Path) -> None:
        config = tmp_path / "swath.toml"
        port = free_udp_port()
        config.write_text(
            f'[session]\nname = "x"\ndirectory = "."\nreserve_mb = 1\n{gnss(f"{tmp_path}/ttyNone")}{srep(port)}'
        )
        with udp_sender(port, srep_datagram):
            run = subprocess.run(
                [sys.executable, "-m", "swath.daemon.cli.main", "check", str(config), "--seconds", "0.5"],
                cwd=ROOT,
                env=os.environ | {"COLUMNS": "100"},
                capture_output=True,
                text=True,
                timeout=HANGS_S,
                check=False,
            )
        assert run.returncode == 1
        lines = run.stdout.splitlines()
        assert [
            line.split()[-1] for line in lines if line.lstrip().startswith(("gnss/rover ", "scanner/left ", "log "))
        ] == [
            "wrong",
            "ok",
            "ok",
        ]
        assert sum(line.startswith("gnss/rover: ") for line in lines) == 1


def _unprivileged(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line without CAP_NET_ADMIN."""
    drop = ["setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin"] if os.getuid() == 0 else []
    return subprocess.run(
        [*drop, sys.executable, "-m", "swath.daemon.cli.main", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
