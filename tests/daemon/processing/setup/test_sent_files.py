"""Tests that a RoboSense head's own DIFOP packets give its beams: in the office wherever they are, live by waiting."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from swath.daemon.config import Config, parse_config
from swath.daemon.config.checks import check_devices
from swath.daemon.config.tables import LiveConfig
from swath.daemon.errors import ConfigError
from swath.daemon.exchange.captures import ImportUnit
from swath.daemon.exchange.import_ import ImportLog
from swath.daemon.exchange.routes import Routes
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.live import session as live_module
from swath.daemon.processing.live.session import Live
from swath.daemon.processing.setup.sent_files import example_files
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.scanner.robosense.heads import RS32
from swath.drivers.scanner.robosense.parser import encode_difop, encode_msop
from swath.georef.scanner.beams import SpinningGeometry
from tests.drivers.recordings import FIXTURES

BEGUN = dt.datetime(2026, 11, 21, 12, tzinfo=dt.UTC)
ANGLES_DEG = np.linspace(-25, 15, 32)
SCANNER = """
[scanner.left]
transport = "udp:0.0.0.0:6699"
auxiliary = "udp:0.0.0.0:7788"
protocol = "robosense-rs32"
installation = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
"""


def config_of(folder: Path, more: str = "") -> Config:
    folder.mkdir(exist_ok=True)
    text = f'[session]\nname = "x"\ndirectory = "logs"\n{SCANNER}{more}'
    return parse_config(text, folder / "swath.toml")


def recorded(folder: Path, *difops: tuple[float, bytes], seconds: float = 3.0) -> Session:
    """Return a log of data packets every 0.1 s, and of these DIFOP packets at their second."""
    config = config_of(folder)
    begin_ns = int(BEGUN.timestamp()) * 1_000_000_000
    units = [(at, "scanner/left/aux", data) for at, data in difops]
    for number in range(int(10 * seconds)):
        when = BEGUN + dt.timedelta(milliseconds=100 * number)
        data = encode_msop(when, 20 * np.arange(12), np.full((12, 32), 4000), 9, RS32)
        units.append((0.1 * number, "scanner/left", data))
    wires, log = Routes.of(config).ports, ImportLog(config, folder / "logs", begin_ns)
    for at_s, source, data in sorted(units):
        log.add(ImportUnit(begin_ns + int(at_s * 1e9), wires[source], data))
    log.finish()
    (session,) = open_logs([folder / "logs"])
    return session


def is_scanners(topic: str) -> bool:
    return topic.startswith("/scanner/") and topic.endswith("/raw")


def elevations_deg(setup: Setup) -> Any:
    geometry = setup.georeferencer("left").model.geometry
    assert isinstance(geometry, SpinningGeometry)
    return geometry.elevation_deg


def test_the_first_packet_of_a_log_gives_the_beams_of_all_its_returns(tmp_path: Path) -> None:
    """It comes last here; one of another model before it has no angles, one after it has others."""
    other = encode_difop(RS32, ANGLES_DEG + 1)
    session = recorded(tmp_path, (1.0, bytes(1248)), (2.5, encode_difop(RS32, ANGLES_DEG)), (2.8, other))
    setup = Setup.of_session(session, None)
    np.testing.assert_allclose(elevations_deg(setup), ANGLES_DEG, atol=6e-4)
    parser = setup.sources.parsers(("scanner",))["scanner/left"]
    for batch in session.batches(is_scanners):
        parser.feed_batch(Mock(units=batch.units, host_time_ns=batch.log_time_ns))
    assert parser.counters.errors == {"angles_differ": 1, "bad_header": 1}
    assert parser.counters.messages == {"data": 30, "difop": 2}


def test_a_file_of_the_configuration_counts_before_the_packets(tmp_path: Path) -> None:
    session = recorded(tmp_path, (0.5, encode_difop(RS32, ANGLES_DEG)))
    (tmp_path / "rs32.difop").write_bytes((FIXTURES / "robosense" / "rs32.difop").read_bytes())
    config = config_of(tmp_path, '[scanner.left.geometry]\nfile = "rs32.difop"\n')
    setup = Setup.of_session(session, config)
    assert setup.sources.sent == {}
    assert np.abs(elevations_deg(setup) - ANGLES_DEG).max() > 0.1


def test_a_log_without_such_a_packet_is_refused_in_one_line(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    with pytest.raises(ConfigError, match=r"scanner\.left: no DIFOP packet .* was received.*geometry\.file") as refused:
        Setup.of_session(recorded(tmp_path), config)
    assert len(str(refused.value).splitlines()) == 1
    assert check_devices(config) == []
    assert len(elevations_deg(Setup.of_config(config, None, example_files(config)))) == 32


def test_live_waits_for_the_packet_and_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = recorded(tmp_path, (1.25, encode_difop(RS32, ANGLES_DEG)))
    batches = [
        part
        for batch in session.batches_by_time(is_scanners)
        for part in (batch.between(at, at + 1) for at in range(len(batch.units)))
    ]
    taken: list[Any] = []
    setups: list[Setup] = []

    def made(setup: Setup, *_: object, **__: object) -> Any:
        setups.append(setup)
        return SimpleNamespace(take=lambda batch, live: taken.append(batch))

    monkeypatch.setattr(live_module, "made_session", made)
    live = Live(tmp_path, LiveConfig(), lambda _: None)
    part = SimpleNamespace(attachments=session.attachments(), info=session.info, number=0)
    monkeypatch.setattr(live, "_follower", SimpleNamespace(part=part, ended="", close=lambda: None))
    for number, batch in enumerate(batches):
        live._take(batch)
        assert (number >= 13) == bool(setups)
        assert len(taken) == (number + 1 if setups else 0)
    assert [batch.log_time_ns[0] for batch in taken] == [batch.log_time_ns[0] for batch in batches]
    np.testing.assert_allclose(elevations_deg(setups[0]), ANGLES_DEG, atol=6e-4)


def test_live_refuses_a_head_that_never_sends_the_packet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = recorded(tmp_path, seconds=12)
    part = SimpleNamespace(attachments=session.attachments(), info=session.info, number=0)
    told: list[dict[str, Any]] = []
    live = Live(tmp_path, LiveConfig(), told.append)
    monkeypatch.setattr(live, "_follower", SimpleNamespace(part=part, ended="", close=lambda: None))
    batches = list(session.batches_by_time(is_scanners))
    live._take(batches[0].between(0, 2))
    live._look_at_clock()
    assert told[-1]["sentence"] == "waiting for the angles of scanner left"
    with pytest.raises(ConfigError, match="no DIFOP packet"):
        live._take(batches[-1])
