"""Tests what `swath check` derives from values of devices at rest, on real wires and real recordings."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest
from numpy.typing import ArrayLike

from swath.daemon.config import parse_config
from swath.daemon.devices.check import Report, check_everything
from swath.daemon.devices.values import Values, gravity_doubts
from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.records import (
    IMU_DTYPE,
    RETURN_DTYPE,
    ChunkBatch,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    ScannerReturns,
    TimeScale,
    TimeTag,
)
from tests.daemon.builders import nmea_sentence
from tests.daemon.rig import free_udp_port
from tests.daemon.wires import pty, repeating

ROOT = Path(__file__).parents[3]
GROUP = "239.74.163.2"
NOW = TimeTag(TimeScale.GPS, 0, week=2443)
UP_IS_X: list[list[float]] = [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # the IMU's x axis points up
IDENTITY: list[list[float]] = [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]


def imu(
    force: tuple[float, float, float], rate_deg_s: float = 0.0, noise: float = 0.02, rate_hz: float = 100.0
) -> ImuSamples:
    rows = np.zeros(200, IMU_DTYPE)
    rows["host_time_ns"] = np.arange(200) * int(1e9 / rate_hz)
    rows["specific_force_b"] = force + noise * np.random.default_rng(1).standard_normal((200, 3))
    rows["angular_rate_b"][:, 2] = np.radians(rate_deg_s)
    return ImuSamples(rows)


def judge(record: ImuSamples, rotation: list[list[float]] | None = None) -> list[str]:
    values = Values()
    values.add([record])
    return values.judge("imu", {"rate_hz": 100.0, "rotation_b_imu": rotation or IDENTITY})[1]


def test_an_imu_at_rest_reads_gravity_upwards_and_no_rate() -> None:
    assert judge(imu((0.1, -0.2, -9.80), 0.3)) == []
    assert judge(imu((2.0, 0.0, -9.60))) == [], "an aircraft on its tail wheel"
    assert judge(imu((9.81, 0.0, 0.0)), UP_IS_X) == []
    (line,) = judge(imu((0.0, 0.0, -1.0), noise=0.0))
    assert line == "its specific force is 1.00 m/s² at rest, want 9.81 ± 0.3; it looks like g: correct its unit"
    (line,) = judge(imu((0.0, 0.0, -9.81), 57.3))
    assert line.startswith("its angular rate is 57.3 °/s at rest, want below 1; check its unit")
    (line,) = judge(imu((0.0, 0.0, -9.81), noise=2.0))
    assert line.startswith("its specific force varies by 3.")
    (line,) = judge(imu((0.0, 0.0, -9.81), rate_hz=200.0))
    assert line == "sends 200.0 samples/s, but rate_hz is 100; set one like the other"


@pytest.mark.parametrize(
    ("force", "rotation", "said"),
    [
        (
            [0, 0, 1],
            IDENTITY,
            "+z, down, want −z, up; row 3 of rotation_b_imu must be [0, 0, -1]: change the sign of row 1",
        ),
        (
            [1, 0, 0],
            IDENTITY,
            "+x, forward, want −z, up; row 3 of rotation_b_imu must be [-1, 0, 0]: choose row 1 anew",
        ),
        ([0, -1, 0], IDENTITY, "−y, right, want −z, up; row 3 of rotation_b_imu must be [0, 1, 0]: choose row 2 anew"),
        ([0, 0, -1], UP_IS_X, "−x, forward, want −z, up; row 3 of rotation_b_imu must be [0, 0, 1]: choose row 1 anew"),
    ],
)
def test_the_row_to_turn_brings_gravity_to_the_body_s_z(
    force: list[float], rotation: list[list[float]], said: str
) -> None:
    unit = np.array(force, np.float64)
    (line,) = gravity_doubts(np.array(rotation, np.float64), unit)
    assert said in line
    row = np.array([float(word) for word in line.split("must be [")[1].split("]")[0].split(",")])
    assert row @ unit == -1.0, "z down reads -1 g (georef.navigation.diagnosis)"


def returns(pulses: ArrayLike, range_m: float) -> ScannerReturns:
    rows = np.zeros(np.size(pulses), RETURN_DTYPE)
    rows["pulse_id"], rows["range_m"] = pulses, range_m
    return ScannerReturns(rows)


def test_pulses_without_a_return_and_odd_ranges_are_counted() -> None:
    config = {"range_min_m": 0.0, "range_max_m": 100.0}
    head = Values()
    head.add([returns(np.arange(0, 1000, 4), 20.0), returns(np.arange(3000, 4000, 4), 20.0)])
    assert head.judge("scanner", config) == (["13 % of its pulses have a return, median range 20.00 m"], [])
    dark = Values()
    dark.add([returns(np.array([0, 900.0]), 200.0)])
    first, second = dark.judge("scanner", config)[1]
    assert first.startswith("only 0.22 % of its pulses have a return; check that its window is clean")
    assert second.startswith("its median range is 200.00 m, outside range_min_m 0 to range_max_m 100")
    line = Values(line_scanner=True)
    line.add([returns(np.array([5 << 16, (5 << 16) + 9, 6 << 16, (6 << 16) + 1.0]), 20.0)])
    assert line.judge("scanner", config)[0] == ["33 % of its pulses have a return, median range 20.00 m"]


def test_the_share_of_a_real_head_is_that_of_its_packets() -> None:
    """The share is counted from the distances in the packets that are not zero (VLP-16 manual, 9.3.1.3)."""
    packets = [
        unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz") if len(unit.data) == 1206
    ]
    rows = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
    pairs = rows[:, :1200].reshape(-1, 12, 100)[:, :, 4:].reshape(-1, 32, 3).astype(np.int64)
    share = ((pairs[:, :, 0] + 256 * pairs[:, :, 1]) > 0).mean()
    settings = DeviceSettings("scanner/roof", {"installation": IDENTITY, "clock": "auto"})
    parser, values = find_driver("scanner", "velodyne-vlp16").make_parser(settings), Values()
    for begin in range(0, len(rows), 7):
        host = np.arange(begin, min(begin + 7, len(rows))) * 1_300_000
        values.add(parser.feed_batch(ChunkBatch("scanner/roof", host, rows[begin : begin + 7])))
    (fact,), doubts = values.judge("scanner", {})
    assert fact.startswith(f"{100 * share:.0f} % of its pulses have a return, median range 1.3")
    assert doubts == []


def test_fix_heading_and_baseline_are_judged() -> None:
    config = {"lever_arm_m": [0.1, 0.0, -1.2], "secondary_lever_arm_m": [0.1, 1.0, -1.2]}
    values = Values()
    values.add([GnssFix(0, NOW, 0.8, 0.1, 500.0, fix_type=FixType.RTK_FIXED, satellites=14)])
    facts, (doubt,) = values.judge("gnss", config)
    assert facts == ["fix: RTK fixed, 14 satellites"]
    assert doubt.startswith("secondary_lever_arm_m is configured, but no valid heading came")
    values.add([GnssHeading(0, NOW, np.radians(271.5), baseline_m=1.02)])
    assert values.judge("gnss", config) == ([*facts, "heading 271.50°"], [])
    values.add([GnssHeading(0, NOW, 0.0, baseline_m=0.6)])
    assert values.judge("gnss", config)[1][0].startswith("its antennas are 0.60 m apart, but 1.00 m by lever_arm_m")
    for fix, said in (
        (GnssFix(0, NOW, None, None, None, satellites=2, valid=False), "has no position yet (fix none, 2 satellites)"),
        (GnssFix(0, NOW, 0.8, 0.1, 5.0, fix_type=FixType.SINGLE, satellites=4), "uses 4 satellites only"),
        (GnssFix(0, NOW, 0.8, 0.1, 5.0, fix_type=FixType.SIMULATED, satellites=9), "its position is simulated"),
    ):
        values.add([fix])
        assert values.judge("gnss", {})[1][0].startswith(said)


def check(text: str, folder: Path, seconds: float) -> dict[str, Report]:
    config = parse_config(f'[session]\nname = "x"\ndirectory = "."\nreserve_mb = 1\n{text}', folder / "swath.toml")
    return {report.source: report for report in check_everything(config, seconds)}


def test_a_receiver_and_an_imu_on_real_wires_are_judged(tmp_path: Path) -> None:
    """A pty carries a fix, and a CAN bus an IMU whose z axis points up and whose PPS nothing confirms."""

    def epoch(second: int) -> bytes:
        clock = f"1015{second % 60:02}.00"
        return nmea_sentence(f"GPRMC,{clock},A,4730.0,N,00900.0,E,0.0,0.0,211126,,,A") + nmea_sentence(
            f"GPGGA,{clock},4730.0,N,00900.0,E,4,12,0.8,500.0,M,47.0,M,,"
        )

    port = free_udp_port()
    dbc = (ROOT / "fixtures/dbc/j1939-source-address/imu.dbc").read_bytes()
    (tmp_path / "imu.dbc").write_bytes(dbc)
    up = (32000 + 981).to_bytes(2, "little")
    still = (32000).to_bytes(2, "little")
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port, ignore_config=True) as bus:

        def send(_: int) -> None:
            for identifier, data in ((0x0CF02A80, still * 3), (0x08F02D80, still * 2 + up)):
                bus.send(can.Message(arbitration_id=identifier, data=data + b"\xff\xff", is_extended_id=True))

        text = (
            f'[imu.main]\ntransport = "can:udp_multicast:{GROUP}?port={port}"\nprotocol = "dbc"\ndbc = "imu.dbc"\n'
            'rate_hz = 1000\npps = "main"\n'
            '[imu.main.signals]\nspecific_force = ["ACCS.ax", "ACCS.ay", "ACCS.az"]\n'
            'angular_rate = ["ARI.gx", "ARI.gy", "ARI.gz"]\n[pps.main]\nsource = "/dev/null/none"\n'
        )
        with pty(epoch) as path, repeating(send, 0.005):
            receiver = f'[gnss.rover]\ntransport = "serial:{path}?baud=115200"\nprotocol = "nmea"\n'
            reports = check(text + receiver, tmp_path, 2.0)
    assert reports["gnss/rover"].facts == ["fix: RTK fixed, 12 satellites"]
    assert reports["gnss/rover"].ok
    main = reports["imu/main"]
    assert main.problems == ["nothing shows that it sees its PPS (main); check the wiring, or remove pps"]
    rate, gravity = main.doubts
    assert rate.endswith("samples/s, but rate_hz is 1000; set one like the other")
    assert "points to +z, down, want −z, up; row 3 of rotation_b_imu must be [0, 0, -1]" in gravity
    assert not main.plain()["ok"]
