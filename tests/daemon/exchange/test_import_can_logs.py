"""Tests `swath import` of logs of CAN buses by other programs, and the way back through an export."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import pytest

from swath.daemon.config import Config
from swath.daemon.errors import UserError
from swath.daemon.exchange.capture_files import ImportOptions
from swath.daemon.exchange.export import export_session
from swath.daemon.log.reader import open_logs
from swath.drivers.can_frames import encode_can_frame
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import content_of, run_import, write_config
from tests.drivers.captures.can_logs import (
    ASC_HEAD,
    ASC_LINES,
    BLF_CLASSIC,
    BLF_FD_64,
    TRC_HEAD,
    blf_container,
    blf_file,
    blf_object,
)

START_NS = 1_700_000_000_000_000_000
ZURICH = dt.timezone(dt.timedelta(hours=1))
SHOWN = " (2023-11-14 23:13:20.000001)  can1  120  [12]  " + "07 " * 12 + "\n"
TRC = TRC_HEAD.format("2.1", "N,O,T,B,I,d,R,L,D") + "1 1.0005 FB 1 0300 Rx - 9 " + "00 " * 12 + "\n"
LOGS: dict[str, str | bytes] = {
    "a.asc": ASC_HEAD + ASC_LINES.replace(" 2  18FF", " 1  18FF").replace("CANFD   2", "CANFD   1"),
    "a.blf": blf_file(blf_container(blf_object(1, BLF_CLASSIC, (2, 7)) + blf_object(1, BLF_CLASSIC, (2, 8)))),
    "a.trc": TRC,
    "a.log": SHOWN,
}


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.fixture
def config(tmp_path: Path) -> Config:
    """Return a configuration with one CAN bus, can1."""
    return write_config(tmp_path)


@pytest.mark.parametrize("name", LOGS)
def test_the_only_bus_takes_a_log_which_comes_back_exactly(tmp_path: Path, config: Config, name: str) -> None:
    path = write(tmp_path / name, LOGS[name])
    told = ImportOptions(zone=ZURICH)
    report, [capture] = run_import(config, [path], tmp_path / "logs", told)
    assert (report.units["imu/main"] > 0, capture.passed, capture.warnings()) == (True, {}, [])
    content = content_of(tmp_path / "logs")
    assert 0 <= content["/imu/main/raw"][0][0] - START_NS < 2_000_000_000
    [session] = open_logs([tmp_path / "logs"])
    folder = export_session(session, tmp_path / "out").folder
    run_import(config, [folder], tmp_path / "back")
    assert content_of(tmp_path / "back") == content


def test_local_times_without_a_zone_are_read_as_utc_with_a_warning(tmp_path: Path, config: Config) -> None:
    path = write(tmp_path / "a.trc", TRC)
    _, [capture] = run_import(config, [path], tmp_path / "logs")
    assert capture.warnings() == [
        f"{path}: its times are local times without a zone and were read as UTC; --zone names another"
    ]
    hour_ns = 3_600_000_000_000
    assert content_of(tmp_path / "logs")["/imu/main/raw"][0][0] // hour_ns == (START_NS + hour_ns) // hour_ns
    _, [capture] = run_import(config, [path], tmp_path / "start", ImportOptions(start_ns={"imu/main": 5}))
    assert capture.warnings() == []
    assert content_of(tmp_path / "start")["/imu/main/raw"][0][0] == 5 + 1_000_500


def test_times_since_an_unknown_beginning_need_a_start(tmp_path: Path, config: Config) -> None:
    path = write(tmp_path / "a.log", "(000.000000) can1 123#00\n(000.500000) can1 123#00\n")
    with pytest.raises(
        UserError, match=r"a\.log: its times count from its beginning, which it does not tell; give --st"
    ):
        run_import(config, [path], tmp_path / "none")
    run_import(config, [path], tmp_path / "logs", ImportOptions(start_ns={"": START_NS}))
    times = [time_ns - START_NS for time_ns, _, _ in content_of(tmp_path / "logs")["/imu/main/raw"]]
    assert times == [0, 500_000_000]


def test_a_log_of_two_channels_needs_the_devices(tmp_path: Path, config: Config) -> None:
    objects = blf_object(1, BLF_CLASSIC) + blf_object(101, BLF_FD_64)
    path = write(tmp_path / "a.blf", blf_file(blf_container(objects)))
    with pytest.raises(UserError, match=r"holds channels 2 \(1\), 3 \(1\); give --source imu/main:CHANNEL="):
        run_import(config, [path], tmp_path / "none")
    named = ImportOptions([f"imu/main:3={path}"], zone=ZURICH)
    report, [capture] = run_import(config, [], tmp_path / "logs", named)
    assert (report.units, capture.passed) == ({"imu/main": 1}, {"2": 1})
    [(_, data, _)] = content_of(tmp_path / "logs")["/imu/main/raw"]
    assert data == encode_can_frame(0x18FF50E5, b"\1\2", extended=True)


@pytest.mark.slow
def test_files_that_do_not_fit_are_refused_in_a_line(tmp_path: Path) -> None:
    write_config(tmp_path)
    path, mf4 = write(tmp_path / "a.blf", LOGS["a.blf"]), write(tmp_path / "a.mf4", b"MDF     4.10    ")
    command = ["import", str(tmp_path / "swath.toml"), "-o", str(tmp_path / "logs")]
    for words, code, line in (
        (
            ["--source", f"gnss/rover={path}"],
            2,
            "a.blf: is a BLF log, but gnss/rover uses serial; want a file of serial",
        ),
        ([str(path), "--zone", "Atlantis"], 2, "--zone Atlantis: want an offset such as +02:00, or a zone such as Eur"),
        ([str(mf4)], 3, "a.mf4: MF4 files need asammdf, which is not installed: pip install '.[import]' in the folder"),
        ([str(write(tmp_path / "b.blf", LOGS["a.blf"][:60]))], 4, "b.blf: ends in its header; everything readable"),
    ):
        done = swath(*command, *words)
        assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr
        assert line in done.stderr
    for zone in ("+01:00", "Europe/Zurich"):
        done = swath(*command[:3], str(tmp_path / zone[:6]), str(path), "--zone", zone)
        assert (done.returncode, "warning" in done.stdout) == (0, False), done.stderr
