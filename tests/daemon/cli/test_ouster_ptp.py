"""Tests an Ouster head set by PTP, from packets to points: on either scale, and only on a known one."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from unittest.mock import patch

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.drivers.scanner.ouster.head import read_head
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.scanners import ouster_wire
from swath.sim.scanners.spinning_wire import HeadClock
from tests.daemon.one_line import PLAN, Flown, fly

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

START = dt.datetime(2026, 6, 15, 9, 0, 0, tzinfo=dt.UTC)  # the default of a plan
UNIX_NS = int(START.timestamp()) * 1_000_000_000
SCALES_S = {"ptp-utc": 0, "ptp-tai": 37}  # of 1970 against UTC: TAI − UTC since 2017
OFF_S = 3.0  # the error of a head that counts from another moment
SHORT = (
    PLAN.replace("-1000.0, -80.0", "-50.0, -80.0")
    .replace("[1000.0, -80.0]", "[50.0, -80.0]")
    .replace("height_m = 780.0", "height_m = 560.0")
    .replace('kind = "oscillating"\nprf_hz = 1500.0', 'kind = "os1"')
)


def flown_by(folder: Path, beside_utc_s: float) -> Flown:
    """Return a flight of 8 s whose head counts nanoseconds since 1970, `beside_utc_s` ahead of UTC."""

    def ticks(clock: HeadClock, time_s: FloatArray) -> Int64Array:
        return UNIX_NS + np.floor((np.asarray(time_s) + beside_utc_s) * 1e9).astype(np.int64)

    with (
        patch.object(HeadClock, "ticks", ticks),
        patch.object(ouster_wire, "SYNC_PULSE", "TIME_FROM_PTP_1588"),
    ):
        flown = fly(folder, SHORT)
    assert read_head((flown.folder / "left.json").read_bytes()).timestamp_mode == "TIME_FROM_PTP_1588"
    return flown


@pytest.mark.parametrize("scale", list(SCALES_S))
def test_points_have_the_time_and_place_of_their_pulses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: str
) -> None:
    flown = flown_by(tmp_path, SCALES_S[scale])
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path / "out", "--strips", "whole")) == 0
    assert f"scanner/left: its stamps are read as {scale}: " in capsys.readouterr().out
    las = laspy.read(next((tmp_path / "out").glob("*_strip01.laz")))
    truth = flown.truth
    assert len(las) == len(truth["left.gps_ns"]) > 100_000
    gps_s = (truth["left.gps_ns"] - 10**18) / 1e9
    assert np.abs(np.asarray(las.gps_time) - gps_s).max() < 1e-6
    expected = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True).transform(*truth["left.point_e"].T)
    assert np.abs(las.xyz - np.stack(expected, axis=1)).max() < 0.01


def test_a_head_with_unknown_time_scale_is_named_and_gives_no_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its clock was set by hand, or by a master that is wrong by 3 s."""
    flown = flown_by(tmp_path, OFF_S)
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path / "out", "--strips", "whole", "--json")) == 1
    told = capsys.readouterr()
    assert "returns have no time: its stamps run free" in told.err
    assert not list((tmp_path / "out").glob("*.laz"))
    assert json.loads(told.out or "{}") == {}
