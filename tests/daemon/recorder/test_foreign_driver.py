"""Tests a recorder, `swath check` and counts of undecoded messages with a driver of another package that fails."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config import Config, load_config
from swath.daemon.config.findings import configuration_findings
from swath.daemon.devices.check import check_everything
from swath.daemon.doctor import Verdict, other_drivers
from swath.daemon.errors import ConfigError
from swath.daemon.log.parsers import stored_drivers
from swath.daemon.processing.undecoded import refused_by, undecoded_lines
from swath.daemon.recorder.assembly import assemble
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.transports.base import UnitBlock
from swath.georef.records import Chunk
from tests.daemon.journal import journal_of
from tests.daemon.rig import session_table
from tests.daemon.wires import pty
from tests.drivers.site import site_at

FAILING = """
from swath.drivers.interface import *
class Failing(StreamParser):
    def feed(self, chunk):
        raise ValueError("it never works")
DRIVER = Driver(protocol="acme", kind="gnss", transports=("serial",), yields=(TimeMessage,), summary="Acme",
                make_parser=lambda settings: Failing(), interface=1)
"""
LINE = (
    "its driver, package acme 1.0, fails on its data and loses records: ValueError: it never works; tell the "
    "package's makers"
)


@pytest.fixture(autouse=True)
def failing(tmp_path: Path) -> Iterator[None]:
    with site_at(tmp_path / "site") as site:
        site.install("acme", {"acme": "acme:DRIVER"}, FAILING)
        yield


def config_of(folder: Path, port: str) -> Config:
    text = session_table(folder / "logs") + f'[gnss.rover]\ntransport = "serial:{port}"\nprotocol = "acme"\n'
    (folder / "swath.toml").write_text(text)
    return load_config(folder / "swath.toml")


def test_a_driver_that_fails_is_reported_once_and_recording_goes_on(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO", "swath")
    assembly = assemble(config_of(tmp_path, "/dev/ttyS9"))
    feed = assembly.timekeeper.units_seen("gnss/rover")
    for number in range(3):
        host_ns = assembly.clock.now_ns() + number
        feed(np.array([host_ns], np.int64), UnitBlock(np.frombuffer(b"0123", np.uint8)[np.newaxis]))
    events = [(event.source, event.code, event.severity) for event in journal_of(caplog)]
    assert events == [("gnss/rover", "time_parser_failed", "error")]
    assert LINE in caplog.text


def test_a_device_whose_package_cannot_be_loaded_is_recorded_as_it_comes(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """Its clock, and a receiver inside its stream, keep nothing from being recorded."""
    caplog.set_level("INFO", "swath")
    with site_at(tmp_path / "broken") as site:
        site.install("broken", {"shattered": "broken:DRIVERS"}, "import nowhere\n")
        path = tmp_path / "swath.toml"
        path.write_text(
            session_table(tmp_path / "logs")
            + '[imu.main]\ntransport = "serial:/dev/ttyS9"\nprotocol = "shattered"\noptions = { rate = 5 }\n'
            + '[gnss.rover]\ntransport = "imu:main"\nprotocol = "shattered"\n'
            + '[scanner.left]\ntransport = "udp:127.0.0.1:2999"\nprotocol = "shattered"\nclock = "utc-hour"\n'
        )
        with pytest.raises(ConfigError, match="meanwhile swath run records the device as it comes"):
            load_config(path)
        config = load_config(path, to_record=True)
        assembly = assemble(config)
        assert [receiver.source for receiver in assembly.receivers] == ["imu/main", "scanner/left"]
        assert assembly.timekeeper.receivers == set()
        events = [(event.source, event.code, event.severity) for event in journal_of(caplog)]
        assert events == [(one, "driver_not_loaded", "error") for one in ("gnss/rover", "imu/main", "scanner/left")]
        lines = configuration_findings(config)
        assert len(lines) == 3
        assert all("package broken 1.0 is not loaded: ModuleNotFoundError" in line for line in lines)
        assert [one.verdict for one in other_drivers(config)] == [Verdict.WRONG]
        attachments = {name: data for name, _, data in config.attachments()}
    makers, troubles = stored_drivers(attachments)
    assert (len(makers), len(troubles)) == (0, 3)
    assert all("that of the package broken 1.0, which is not installed here" in line for line in troubles)


def test_check_names_the_package_of_a_driver_that_fails(tmp_path: Path) -> None:
    with pty(lambda number: b"some bytes") as path:
        [report, *_] = check_everything(config_of(tmp_path, path), 0.4)
    assert (report.source, report.problems) == ("gnss/rover", [LINE])


def test_units_of_a_driver_that_fails_count_as_missing() -> None:
    parser = find_driver("gnss", "acme").make_parser(DeviceSettings("gnss/rover"))
    parser.feed(Chunk("gnss/rover", 0, b"0123"))
    holes, warnings = undecoded_lines("a.mcap", {"left": refused_by(parser)})
    assert warnings == []
    [line] = holes
    assert line.startswith("a.mcap: 1 messages of scanner/left were not read: their driver, which is not Swath's own, ")
