"""Tests wires, recorder and ``swath live`` end to end without a device's INS, and the same log smoothed."""

from __future__ import annotations

import time
from pathlib import Path

import laspy
import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.warm_up import warm_up
from swath.georef.points import Points
from tests.builders import Recorded, judged, running
from tests.daemon.processing.live.builders import config_of
from tests.daemon.rig import HANGS_S, Recorder, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.xdist_group("kernels")]

PLAN = """
[flight]
name = "navigated"
seed = 8
speed_mps = 50.0

[[line]]
name = "1"
from_m = [-600, 0]
to_m = [600, 0]
height_m = 700

[gnss.rover]
rate_hz = 5
secondary_lever_arm_m = [0.1, 1.15, -1.2]

[imu.main]
rate_hz = 200
rotation_b_imu = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]

[scanner.left]
prf_hz = 1000
on_lines_only = false
"""
SECONDS = 22.0
SETTLED_S = 8.0  # of the points: before, the filter has hardly begun


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Record a flight on wires and follow it live, in three processes."""
    warm_up([])  # otherwise the command first compiles at the lowest priority
    folder = tmp_path_factory.mktemp("end_to_end")
    logs, points, said, plan = (folder / name for name in ("logs", "points.npy", "said", "plan.toml"))
    logs.mkdir()
    plan.write_text(PLAN)
    wires = folder / "wires"
    fly = ("sim", "fly", plan, "--wire", "-o", wires, "--seconds", f"{SECONDS:g}", "--wait", f"{HANGS_S:g}")
    with (
        said.open("w") as output,
        running(*fly) as flying,
        running("live", logs, "--points", points, "--json", output=output) as live,
    ):
        config = config_of(wires, folder)
        wait_until(lambda: "waiting for a recording" in said.read_text(), "live waits")
        with Recorder(folder, config) as recorder:
            flying.communicate(timeout=HANGS_S)
            time.sleep(1.0)  # what is still on its way through the recorder
            assert recorder.stop() == 0
        _, trouble = live.communicate(timeout=HANGS_S)
    assert (flying.returncode, live.returncode) == (0, 0), trouble
    again = folder / "again"  # the same flight as a log, because the truth is not written for a flight on wires
    assert run_app(["sim", "fly", str(plan), "-o", str(again), "--seconds", f"{SECONDS:g}"]) == 0
    return Recorded(logs, np.load(points), np.load(again / "truth.npz"))


def test_points_in_flight_match_the_truth_within_their_sigmas(recorded: Recorded) -> None:
    """The points of ``swath live`` equal those of the replay, which has the sigmas too."""
    session = recorded.session()
    setup = Setup.of_log(session.attachments(), Options())
    feed = LogFeed(setup, setup.live_stream(session.info))
    assert feed.navigator is not None, "no INS of the device's"
    pieces = [piece for batch in session.batches() for _, piece in feed.take(batch)]
    placed = Points.concatenate([*pieces, *(piece for _, piece in feed.close())])
    live = recorded.points
    assert len(live) == len(placed) > 0.4 * SECONDS * 1000
    np.testing.assert_array_equal(live["points_map"], placed.points_map)
    np.testing.assert_array_equal(live["time_ns"], placed.time_ns)
    assert placed.sigma_map is not None
    settled = live["time_ns"] > live["time_ns"][0] + SETTLED_S * 1e9
    assert settled.sum() > 3000
    missed = recorded.missed(live["time_ns"][settled], live["return_number"][settled], live["points_map"][settled])
    judged(missed, placed.sigma_map[settled].astype(np.float64))


def test_smoothed_points_of_the_same_log_match_the_truth_within_their_sigmas(
    recorded: Recorded, tmp_path: Path
) -> None:
    """``swath georef`` navigates if no trajectory is given."""
    arguments = ["georef", str(recorded.logs), "-o", str(tmp_path), "--strips", "whole"]
    assert run_app(arguments) in (0, 1)  # partial: returns before the first or after the last sample have no pose
    las = laspy.read(next(tmp_path.glob("*.laz")))
    time_ns = np.rint(np.asarray(las.gps_time) * 1e9).astype(np.int64) + 10**18
    sigma = np.stack([np.asarray(las[f"sigma_{name}"]) for name in ("easting", "northing", "height")], axis=1)
    numbers = np.asarray(las.return_number)
    assert len(las) > 0.99 * len(recorded.points)
    missed = recorded.missed(time_ns, numbers, np.asarray(las.xyz))
    judged(missed, sigma)
