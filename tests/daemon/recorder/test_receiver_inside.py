"""Tests an inertial unit that contains a receiver: one wire, two sections, on a real bus."""

from __future__ import annotations

import gzip
import json
import time
from pathlib import Path

import can
import pytest

from swath.daemon.config import parse_config
from swath.daemon.devices.check import check_everything
from swath.daemon.errors import ConfigError
from tests.builders import ROOT
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.rig import Recorder, free_udp_port, session_table
from tests.daemon.wires import repeating

CANMOD = ROOT / "fixtures/canmod-gps/3BA199E2_00000164_00000005_candump.log.gz"
GROUP = "239.74.163.2"
UNIT = '[imu.main]\ntransport = "can:udp_multicast:{group}?port={port}"\nprotocol = "canmod-gps"\nrate_hz = 100\n'
RECEIVER = '[gnss.rover]\ntransport = "imu:main"\nprotocol = "canmod-gps"\n'


def frames(seconds: int) -> list[can.Message]:
    """Return the frames of the device's bus in the first seconds of the recording."""
    with gzip.open(CANMOD, "rt") as log:
        rows = [line.split()[2].split("#") for line in log if " can2 " in line]
    messages = [can.Message(arbitration_id=int(name, 16), data=bytes.fromhex(data)) for name, data in rows]
    for message in messages:
        message.is_extended_id = False
    return messages[: seconds * 118]


@pytest.mark.slow  # 5 s of its messages name a second
def test_a_unit_alone_sets_the_time_and_is_checked_monitored_and_read_as_a_receiver(tmp_path: Path) -> None:
    port = free_udp_port()
    config = session_table(tmp_path / "logs") + UNIT.format(group=GROUP, port=port) + RECEIVER
    messages = frames(7)
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port, ignore_config=True) as bus:
        with Recorder(tmp_path / "rig", config) as recorder:
            recorder.wait_said("imu/main device_opened")
            for message in messages:
                bus.send(message)
                time.sleep(1.0 / 118)  # the device's own rate, so that its seconds last a second
            shown = json.loads(swath("monitor", str(tmp_path / "logs"), "--once", "--json").stdout)["sources"]
            assert recorder.stop() == 0, recorder.stderr()
    content = read_log(tmp_path / "logs")
    assert len(content.units["imu/main"]) == len(messages)
    assert set(content.units) == {"imu/main"}  # logged once
    status = content.messages["/status/imu/main"][-1][1]
    assert status["time_state"] == "COARSE"  # named by the receiver inside, without a pulse
    assert shown["imu/main"]["decoded"]["records_hz"]["ImuSamples"] > 10.0
    assert shown["gnss/rover"]["state"] == "in imu/main"
    assert set(shown["gnss/rover"]["decoded"]["records_hz"]) == {"TimeMessage", "GnssFix"}


def test_check_gives_the_receiver_a_line_of_its_own(tmp_path: Path) -> None:
    port = free_udp_port()
    text = session_table(tmp_path) + UNIT.format(group=GROUP, port=port) + RECEIVER
    messages = frames(30)
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port, ignore_config=True) as bus:

        def send(number: int) -> None:
            for message in messages[number * 100 % len(messages) :][:100]:
                bus.send(message)

        with repeating(send):
            found = check_everything(parse_config(text, tmp_path / "swath.toml"), 1.2)
    reports = {report.source: report for report in found}
    assert [reports[source].problems for source in ("imu/main", "gnss/rover")] == [[], []]
    assert reports["gnss/rover"].records.keys() == {"TimeMessage", "GnssFix"}
    assert reports["gnss/rover"].time.startswith("2021-07-26 05:")
    assert reports["imu/main"].records["ImuSamples"] > 100


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            '[gnss.rover]\ntransport = "imu:other"\nprotocol = "canmod-gps"\n',
            'gnss.rover.transport: got "imu:other", want the name of a [imu.<name>]; there are: main',
        ),
        (
            '[gnss.rover]\ntransport = "imu:main"\nprotocol = "nmea2000"\n',
            'gnss.rover.protocol: got "nmea2000", want "canmod-gps" like [imu.main], whose stream carries it',
        ),
        (
            '[gnss.rover]\ntransport = "imu:main"\nprotocol = "nmea"\n',
            'gnss.rover.transport: got "imu:main"; nmea supports: serial, udp, tcp',
        ),
        (
            '[gnss.rover]\ntransport = "imu:inner"\nprotocol = "canmod-gps"\n'
            '[imu.inner]\ntransport = "gnss:rover"\nprotocol = "sbf"\n',
            'gnss.rover.transport: got "imu:inner", but [imu.inner] has no wire of its own; name one that has',
        ),
    ],
)
def test_a_receiver_inside_a_wrong_unit_is_refused(tmp_path: Path, text: str, says: str) -> None:
    whole = session_table(tmp_path) + UNIT.format(group=GROUP, port=1) + text
    with pytest.raises(ConfigError) as caught:
        parse_config(whole, tmp_path / "a.toml")
    assert f"{tmp_path}/a.toml: {says}" in caught.value.lines
