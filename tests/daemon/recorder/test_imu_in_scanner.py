"""Tests an inertial unit inside a scanner: among its packets, on its second port, or on a wire of its own."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.config import parse_config
from swath.daemon.devices.check import check_everything
from swath.daemon.errors import ConfigError
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.navigation.log import read_navigation_log
from swath.daemon.processing.navigation.sources import NavigationSources
from swath.daemon.processing.points.clocks import read_clocks
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.processing.setup.sources import Sources
from swath.drivers.scanner.livox.layout import IMU_2, NO_SYNC, POINTS_2, encode_packet_2
from swath.georef.records import ImuSamples
from tests.daemon.exchange.builders import Unit, write_config, write_log
from tests.daemon.log_check import read_log
from tests.daemon.monitor.builders import Looking
from tests.daemon.rig import Recorder, free_udp_port, session_table
from tests.daemon.wires import udp_sender
from tests.drivers.livox_cases import FILES

S = 1_000_000_000
START_NS = 1_800_000_000 * S
TURNED = "installation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\n"
HEAD = '[scanner.{}]\ntransport = "udp:127.0.0.1:{}"\nprotocol = "livox-{}"\n' + TURNED
INSIDE = '[imu.inner]\ntransport = "scanner:{}"\nprotocol = "livox-{}"\n'
GNSS = '[gnss.rover]\ntransport = "serial:/dev/ttyUSB0"\nprotocol = "ubx"\n'


def sample(number: int) -> bytes:
    """Return a sample of a head that stands upright and still, 5 ms after the one before."""
    return encode_packet_2(IMU_2, NO_SYNC, S + number * 5_000_000, [((0, 0, 0), (0, 0, 1))], span_100ns=0)


def points(number: int) -> bytes:
    """Return a packet of points."""
    return encode_packet_2(1, NO_SYNC, S + number * 480_000, np.ones(96, dtype=POINTS_2[1].dtype))


def test_samples_are_read_from_the_scanners_packets_only_where_an_imu_is_inside(tmp_path: Path) -> None:
    """A head of SDK 1 mixes them with its points; one of SDK 2 sends them to its second port; both give m/s²."""
    units: list[Unit] = [
        ("scanner/front", START_NS + number * 1_000_000, data, None) for number, data in enumerate(FILES["avia"]())
    ]
    second = [("scanner/top/aux", START_NS + number * 5_000_000, sample(number), None) for number in range(8)]
    third = [("scanner/top", START_NS + number * 480_000, points(number), None) for number in range(20)]
    heads = HEAD.format("front", 1, "avia") + HEAD.format("top", 2, "mid360")
    heads += 'auxiliary = "udp:127.0.0.1:3"\n'
    sent = sum(len(data) == 42 for _, _, data, _ in units)
    for head, protocol, count in (("front", "avia", sent), ("top", "mid360", 8)):
        config = write_config(tmp_path / head, session_table(tmp_path) + heads + INSIDE.format(head, protocol) + GNSS)
        write_log(tmp_path / head / "logs", config, [*units, *second, *third])
        (session,) = open_logs([tmp_path / head / "logs"])
        found = read_navigation_log(session, NavigationSources(config, {}))
        assert found.counts["imu/inner"] == {"ImuSamples": count, "DeviceClockSamples": count}
        assert found.counts.keys() == {"imu/inner"}
        np.testing.assert_allclose(np.median(found.imu["specific_force_b"][:, 2]), 9.80665, rtol=1e-6)
        clocks = read_clocks(session, Sources(config, {}), positions=True)
        assert clocks.counts["imu/inner"]["ImuSamples"] == count
        read = [one for records in LogRecords.of_session(session).records("imu/inner") for one in records]
        assert sum(len(one.rows) for one in read if isinstance(one, ImuSamples)) == count
    bare = write_config(tmp_path / "bare", session_table(tmp_path) + heads)
    (session,) = open_logs([tmp_path / "front" / "logs"])
    assert read_clocks(session, Sources(bare, {})).counts == {}


@pytest.mark.parametrize("own", [False, True])
def test_check_gives_the_imu_a_line_of_its_own(tmp_path: Path, own: bool) -> None:
    data, imu = free_udp_port(), free_udp_port()
    text = session_table(tmp_path) + HEAD.format("top", data, "mid360")
    wire = f'[imu.inner]\ntransport = "udp:127.0.0.1:{imu}"\nprotocol = "livox-mid360"\n'
    text += wire if own else f'auxiliary = "udp:127.0.0.1:{imu}"\n' + INSIDE.format("top", "mid360")
    with udp_sender(data, points), udp_sender(imu, sample):
        reports = {one.source: one for one in check_everything(parse_config(text, tmp_path / "a.toml"), 0.5)}
    assert reports["scanner/top"].problems == reports["imu/inner"].problems == []
    assert reports["scanner/top"].records["ScannerReturns"] > 0
    assert reports["imu/inner"].records.keys() == {"ImuSamples", "DeviceClockSamples"}
    assert ("scanner/top/aux" in reports) == (not own)


@pytest.mark.slow  # until rates are shown
def test_the_recorder_logs_it_once_and_the_monitor_shows_it(tmp_path: Path) -> None:
    data, second = free_udp_port(), free_udp_port()
    text = session_table(tmp_path / "logs") + HEAD.format("top", data, "mid360")
    text += f'auxiliary = "udp:127.0.0.1:{second}"\n' + INSIDE.format("top", "mid360")
    with udp_sender(data, points), udp_sender(second, sample), Recorder(tmp_path / "rig", text) as recorder:
        monitor, shown = Looking(tmp_path / "logs"), dict[str, Any]()
        until = time.monotonic() + 20
        while "ImuSamples" not in shown.get("imu/inner", {}).get("decoded", {}).get("records_hz", {}):
            assert time.monotonic() < until, shown
            time.sleep(0.2)
            monitor.poll()
            shown = monitor.snapshot()["sources"]
        monitor.close()
        assert recorder.stop() == 0, recorder.stderr()
    assert shown["imu/inner"]["state"] == "in scanner/top"
    assert set(read_log(tmp_path / "logs").units) == {"scanner/top", "scanner/top/aux"}


@pytest.mark.parametrize(
    ("imu", "problem"),
    [
        (INSIDE.format("left", "avia"), r"want the name of a \[scanner\.<name>\]; there are: top"),
        (
            INSIDE.format("top", "avia"),
            r'imu\.inner\.protocol: got "livox-avia", want "livox-mid360" like \[scanner\.top\]',
        ),
        ('[imu.inner]\ntransport = "scanner:top"\nprotocol = "canmod-gps"\n', "canmod-gps supports: can"),
        (INSIDE.replace("scanner:{}", "scanner:").format("mid360"), "want scanner:<name>"),
    ],
)
def test_an_imu_of_no_scanner_or_another_is_refused(tmp_path: Path, imu: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        parse_config(session_table(tmp_path) + HEAD.format("top", 1, "mid360") + imu, tmp_path / "a.toml")
