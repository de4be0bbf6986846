"""Makes a short flight without noise along one line, with its log and its true trajectory as a file."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.cli.main import run_app
from swath.georef.formats.sbet import sbet_bytes, smrmsg_bytes
from swath.georef.trajectory.trajectory import Trajectory

PLAN = """
[flight]
name = "line"
origin_deg = [47.482, 8.905]
speed_mps = 50.0
lead_s = 3.0
noise = false

[[line]]
name = "east"
from_m = [-1000.0, -80.0]
to_m = [1000.0, -80.0]
height_m = 780.0

[terrain]
height_m = 470.0
relief_m = 30.0

[imu.main]
rate_hz = 100

[scanner.left]
kind = "oscillating"
prf_hz = 1500.0
scan_hz = 10.0

[scanner.left.true]
omega_deg = 0.2513
phi_deg = -0.4021
kappa_deg = 0.6110
range_offset_m = 0.35
"""


@dataclass(frozen=True)
class Flown:
    """A flight's folder and its contents."""

    folder: Path

    @property
    def log(self) -> Path:
        """Return the only part."""
        return next(self.folder.glob("*.mcap"))

    @property
    def name(self) -> str:
        """Return the name of the session."""
        return self.log.stem.removesuffix("_0")

    @property
    def truth(self) -> Any:
        """Return the arrays of the truth by name."""
        return np.load(self.folder / "truth.npz")

    @property
    def sbet(self) -> Path:
        """The true trajectory."""
        return self.folder / "truth.sbet"

    def trajectory(self) -> Trajectory:
        """Return the true trajectory with sigmas, as a table."""
        truth = self.truth
        n = len(truth["trajectory.gps_ns"])
        return Trajectory.from_geodetic(
            truth["trajectory.gps_ns"],
            truth["trajectory.lat_rad"],
            truth["trajectory.lon_rad"],
            truth["trajectory.height_m"],
            truth["trajectory.velocity_l"],
            truth["trajectory.roll_rad"],
            truth["trajectory.pitch_rad"],
            truth["trajectory.heading_rad"],
            position_sigma_l=np.full((n, 3), 0.02),
            attitude_sigma_rad=np.full((n, 3), 1e-4),
        )

    def arguments(self, output: Path, *more: str, log: Path | None = None) -> list[str]:
        """Return the arguments of `swath georef` with the truth."""
        given = ["georef", str(log or self.log), "-o", str(output), "--crs", "EPSG:32632", "--trajectory-datum", "same"]
        given += ["--trajectory", str(self.sbet), "--calibration", str(self.folder / "left.true.toml")]
        return [*given, *([] if "--workers" in more or "--scheduler" in more else ["--workers", "1"]), *more]

    def copy_of_log(self, folder: Path) -> Path:
        """Copy the log, to be damaged."""
        folder.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(self.log, folder))


def fly(folder: Path, text: str = PLAN) -> Flown:
    """Fly the plan into a folder."""
    plan = folder / "line.toml"
    plan.write_text(text)
    assert run_app(["sim", "fly", str(plan), "-o", str(folder / "flight")]) == 0
    flown = Flown(folder / "flight")
    flown.sbet.write_bytes(sbet_bytes(flown.trajectory()))
    flown.sbet.with_suffix(".smrmsg").write_bytes(smrmsg_bytes(flown.trajectory()))
    return flown
