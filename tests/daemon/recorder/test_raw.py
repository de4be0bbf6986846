"""Tests devices without a driver: recorded over every wire, healthy everywhere, read once there is a driver."""

from __future__ import annotations

import gzip
import json
import socket
from contextlib import ExitStack
from pathlib import Path

import can
import pytest

from swath.daemon.config import parse_config
from swath.daemon.devices.check import check_everything
from swath.daemon.errors import ConfigError
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.navigation.log import read_navigation_log
from swath.daemon.processing.navigation.sources import NavigationSources
from tests.builders import ROOT
from tests.daemon.builders import nmea_zda
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.rig import Recorder, free_udp_port, session_table
from tests.daemon.wires import pty, repeating, tcp_server, udp_sender

CANMOD = ROOT / "fixtures/canmod-gps/3BA199E2_00000164_00000005_candump.log.gz"
GROUP = "239.74.163.2"


@pytest.mark.slow
def test_raw_devices_are_recorded_over_every_wire_and_healthy_everywhere(tmp_path: Path) -> None:
    logs, udp, bus_port = tmp_path / "logs", free_udp_port(), free_udp_port()
    with ExitStack() as stack:
        path = stack.enter_context(pty(lambda number: b"any %d\n" % number))
        stack.enter_context(udp_sender(udp, lambda number: b"datagram %d" % number))
        tcp = stack.enter_context(tcp_server(lambda number: b"stream %d\n" % number))
        bus = stack.enter_context(can.Bus("239.74.163.2", "udp_multicast", port=bus_port, ignore_config=True))
        frame = can.Message(arbitration_id=0x123, data=b"12345678", is_extended_id=False)
        stack.enter_context(repeating(lambda _: bus.send(frame)))
        wires = {
            "raw.line": f"serial:{path}",
            "raw.net": f"udp:127.0.0.1:{udp}",
            "gnss.rover": f"tcp:127.0.0.1:{tcp}",
            "imu.main": f"can:udp_multicast:{GROUP}?port={bus_port}",
        }
        config = session_table(logs) + "".join(
            f'[{section}]\ntransport = "{transport}"\nprotocol = "raw"\n' for section, transport in wires.items()
        )
        config += '[scanner.left]\ntransport = "udp:127.0.0.1:1"\nprotocol = "raw"\n'  # nothing is needed of its kind
        reports = {report.source: report for report in check_everything(parse_config(config, tmp_path / "x"), 1.2)}
        for section in wires:
            report = reports[section.replace(".", "/")]
            assert report.problems == [], section
            assert report.units > 5
            assert not report.records
        with Recorder(tmp_path / "rig", config.split("[scanner.left]")[0]) as recorder:
            recorder.wait_said("device_opened", times=4)
            for _ in range(3):
                shown = json.loads(swath("monitor", str(logs), "--once", "--json").stdout)
            assert recorder.stop() == 0, recorder.stderr()
    assert shown["verdict"] == "recording", shown["sentence"]
    assert "wrong_protocol" not in recorder.stderr()
    content = read_log(logs)
    assert content.data("raw/line").count(b"any ") >= 3
    assert content.units["raw/net"][0][1].startswith(b"datagram ")
    assert content.data("gnss/rover").count(b"stream ") >= 3
    assert len(content.units["imu/main"][0][1]) == 16
    (session,) = json.loads(swath("info", "--json", str(logs)).stdout)["sessions"]
    assert session["notes"] == []
    for section in wires:
        numbers = session["sources"][section.replace(".", "/")]
        assert numbers["units"] == numbers["decoded"]["messages"]["unit"] > 0
        assert numbers["state"] == "receiving"


def test_a_raw_recording_is_read_once_there_is_a_driver(tmp_path: Path) -> None:
    """A unit is recorded as [raw.unit], a receiver as protocol raw; a later configuration names their protocols."""
    logs, port, bus_port = tmp_path / "logs", free_udp_port(), free_udp_port()
    unit = f'[raw.unit]\ntransport = "can:udp_multicast:{GROUP}?port={bus_port}"\n'
    rover = f'[gnss.rover]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "raw"\n'
    with gzip.open(CANMOD, "rt") as log:
        rows = [line.split()[2].split("#") for line in log if " can2 " in line][:350]
    with (
        can.Bus(GROUP, "udp_multicast", port=bus_port, ignore_config=True) as bus,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        Recorder(tmp_path / "rig", session_table(logs) + unit + rover) as recorder,
    ):
        recorder.wait_said("device_opened", times=2)
        for number, (name, data) in enumerate(rows):
            bus.send(can.Message(arbitration_id=int(name, 16), data=bytes.fromhex(data), is_extended_id=False))
            if number % 50 == 0:
                sender.sendto(nmea_zda(40_000 + number // 50), ("127.0.0.1", port))
        assert recorder.stop() == 0, recorder.stderr()
    known = unit + rover.replace('"raw"', '"nmea"')
    known += '[imu.main]\ntransport = "raw:unit"\nprotocol = "canmod-gps"\n'
    known += '[gnss.inside]\ntransport = "raw:unit"\nprotocol = "canmod-gps"\n'
    (session,) = open_logs([logs])
    sources = NavigationSources(parse_config(session_table(logs) + known, tmp_path / "later.toml"), {}, gnss="inside")
    counts = read_navigation_log(session, sources).counts
    assert counts["imu/main"]["ImuSamples"] > 250
    assert counts["gnss/inside"]["GnssFix"] >= 2
    assert counts["gnss/rover"]["TimeMessage"] == 7


def test_a_raw_section_with_another_protocol_is_refused(tmp_path: Path) -> None:
    text = session_table(tmp_path) + '[raw.radar]\ntransport = "udp:0.0.0.0:1"\nprotocol = "nmea"\n'
    with pytest.raises(ConfigError, match=r'raw\.radar\.protocol: got "nmea", want "raw"'):
        parse_config(text, tmp_path / "a.toml")
    text = session_table(tmp_path) + '[scanner.left]\ntransport = "raw:radar"\nprotocol = "srep"\nmirror_factor = 2.0\n'
    with pytest.raises(ConfigError, match=r"want the name of a \[raw\.<name>\]; there are: none"):
        parse_config(text, tmp_path / "a.toml")
