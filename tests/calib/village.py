"""Flies a small calibration flight over houses with the virtual aircraft, and reads it as a calibration does."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from swath.calib.flight import Flight
from swath.daemon.processing.calibration.returns import read_flight
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.scanner.calibration import Calibration, read_calibration
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.short_flight import Flown, fly_short

HEADER = """
[flight]
name = "village"
seed = {seed}
origin_deg = [47.182, 9.005]
crs = "EPSG:25832"
speed_mps = 50.0
bank_max_deg = 38.0
climb_max_mps = 12.0
lead_s = 3.0

[terrain]
height_m = 450.0
relief_m = 0.0

[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [260.0, 240.0]
heading_deg = 25.0
houses = 40

[[terrain.road]]
points_m = [[-320.0, -150.0], [30.0, -130.0], [60.0, 300.0]]
width_m = 7.0

[control]
points = 12

[gnss.rover]
rate_hz = 5
ins = true

[imu.main]
grade = "tactical"
rate_hz = 200

[scanner.left]
prf_hz = {prf_hz}
scan_hz = 50.0
half_angle_deg = 30.0
range_max_m = 1500.0
reference_range_m = 500.0

[scanner.left.true]
{true}
"""
LINE = """
[[line]]
name = "{name}"
from_m = [{x0}, {y0}]
to_m = [{x1}, {y1}]
height_m = {height}
"""
# name, from, to, height: lines that are opposite, crossing and parallel; the last two are higher
LINES = (
    ("east", (-300, 0), (300, 0), 850),
    ("west", (300, 60), (-300, 60), 850),
    ("south", (0, 300), (0, -300), 850),
    ("north", (120, -300), (120, 300), 850),
    ("high_west", (320, -60), (-320, -60), 1150),
    ("high_south", (-80, 320), (-80, -320), 1150),
)
# Options of `swath calibrate` that state how well the village's scanner is known apart from boresight and range offset
KNOWN = (
    *("--fix", "range_scale_ppm,scan_angle_scale_ppm,scan_plane_tilt_deg,time_offset_us"),
    *("--prior", "range_scale_ppm=1", "--prior", "scan_angle_scale_ppm=2"),
    *("--prior", "scan_plane_tilt_deg=0.0002", "--prior", "time_offset_us=5"),
)
TRUE = {"omega_deg": 0.25, "phi_deg": -0.4, "kappa_deg": 0.6, "range_offset_m": 0.12}


@dataclass(frozen=True, eq=False)
class Made:
    """Flight with its truth.

    Attributes:
        flight: as read, with nominal calibration, on the true trajectory with the INS's sigmas.
        truth: the true calibration.
        trajectory: the true trajectory.
        flown: the log and the files beside it: ``flown.folder / "truth.npz"``, ``control.csv``.
        plan: the plan's text.
    """

    flight: Flight
    truth: Calibration
    trajectory: Trajectory
    flown: Flown
    plan: str

    def at_truth(self) -> Flight:
        """Return the flight with its points placed by the true calibration."""
        return self.flight.placed({"left": self.truth})


def village(
    folder: Path,
    *,
    seed: int = 4,
    prf_hz: float = 10_000.0,
    lines: tuple[int, ...] = (0, 1, 2, 3),
    true: dict[str, float] | None = None,
    plan_more: str = "",
    sigma_m: float = 0.02,
    sigma_deg: float = 0.003,
) -> Made:
    """Fly some of `LINES` and read the log on the true trajectory.

    Args:
        folder: holds the log and what is derived from it.
        seed, prf_hz: seed of the flight, and pulse rate.
        lines: indexes of `LINES`.
        true: the true calibration, by keys of its file; None: `TRUE`.
        plan_more: tables added to the plan.
        sigma_m, sigma_deg: sigmas stated by the true trajectory for each coordinate and angle (heading: twice).
    """
    tables = "\n".join(f"{key} = {value}" for key, value in (TRUE if true is None else true).items())
    text = HEADER.format(seed=seed, prf_hz=prf_hz, true=tables)
    for index in lines:
        name, (x0, y0), (x1, y1), height = LINES[index]
        text += LINE.format(name=name, x0=x0, y0=y0, x1=x1, y1=y1, height=height)
    text += plan_more
    flown = fly_short(folder, text)
    trajectory = told(flown.truth(), sigma_m, sigma_deg)
    file = folder / "true_trajectory.csv"
    file.write_text(csv_text(trajectory))
    kept = folder / "kept"
    kept.mkdir()
    options = GeorefOptions([flown.log], kept, TrajectoryOptions(file), Options(datum="same", uncertainty=False))
    read = read_flight(options, kept, lambda *_: None)
    truth = read_calibration((folder / "left.true.toml").read_text(), "left.true.toml")
    flight = replace(read.flight, trajectories=(trajectory,))
    return Made(flight, truth, trajectory, flown, text)


def told(trajectory: Trajectory, sigma_m: float, sigma_deg: float) -> Trajectory:
    """Return the trajectory with stated sigmas."""
    position = np.full((len(trajectory), 3), sigma_m)
    attitude = np.radians(np.tile([sigma_deg, sigma_deg, 2.0 * sigma_deg], (len(trajectory), 1)))
    return replace(trajectory, position_sigma_l=position, attitude_sigma_rad=attitude)


def judge_unusable(file: Path, why: str) -> None:
    """Write the summary of `swath trajectory` beside a trajectory's file: not to be used."""
    verdict = {"level": "unusable", "sentence": why, "reasons": [{"level": "unusable", "name": "x", "what": why}]}
    summary = {"format": "swath.trajectory", "solution": "smoothed", "sessions": [{"legs": [{"verdict": verdict}]}]}
    file.with_suffix(".json").write_text(json.dumps(summary))
