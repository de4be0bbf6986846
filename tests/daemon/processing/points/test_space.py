"""Tests the estimate of the space that a log's returns will take, from a few of its chunks."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.points.space import IN_STRIPS, LAZ_BYTES, estimated_returns
from swath.daemon.processing.setup.setup import Options, Setup
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("line"))


def test_the_number_of_returns_is_estimated_from_a_few_chunks(flown: Flown) -> None:
    (session,) = open_logs([flown.log])
    setup = Setup.of_log(session.attachments(), Options(datum="same", crs="EPSG:32632"))
    assert estimated_returns(session, setup) == pytest.approx(len(flown.truth["left.gps_ns"]), rel=0.1)


def test_a_disk_without_room_for_the_points_is_refused_before_the_log_is_read(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = IN_STRIPS * LAZ_BYTES[0] * len(flown.truth["left.gps_ns"])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=int(0.5 * needed)))
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path / "out")) == ExitCode.IO
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"swath: {tmp_path / 'out'}: points need ")
    assert "are free; make room, or choose a folder on another disk" in line
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=int(2.0 * needed)))
    assert run_app(flown.arguments(tmp_path / "out")) == 0
    assert "points may need " in capsys.readouterr().err
