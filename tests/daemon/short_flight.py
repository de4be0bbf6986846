"""Makes a log of a flight of seconds over flat land with event marks, for tests of navigation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.daemon.config import Config, load_config
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.simulate.into_log import fly_into_log
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel.encoder import encode_log
from swath.drivers.gnss.novatel.tables import CLOCK_VALID
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight, open_truth
from swath.sim.gnss.novatel import NovatelMessages
from swath.sim.plan.plan import parse_plan

MARK_AFTER_NS = 123_456_789  # of each whole second
CLOCK_OFFSET_S = 2.5e-7  # error of the receiver's clock, as its marks state it
CLOCK_SIGMA_S = 1e-4
S = 1_000_000_000
POS_HEAD = """% program   : RTKLIB
%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio
"""
PPK_M = np.array([0.003, 0.003, 0.006])  # north, east, up
ARM_B = np.array([0.1, -0.05, -1.2])


@dataclass(frozen=True)
class Flown:
    """The log, its configuration and the truth."""

    folder: Path
    config: Config

    @property
    def log(self) -> Path:
        """Return the only part."""
        return next(self.folder.glob("logs/*.mcap"))

    def session(self) -> Session:
        """Open the log again."""
        (session,) = open_logs([self.folder / "logs"])
        return session

    def truth(self) -> Trajectory:
        """Return the truth of the body at 200 Hz."""
        told: Any = np.load(self.folder / "truth.npz")
        keys = ("gps_ns", "lat_rad", "lon_rad", "height_m", "velocity_l", "roll_rad", "pitch_rad", "heading_rad")
        return Trajectory.from_geodetic(*(told[f"trajectory.{key}"] for key in keys), name="truth")

    def changed(self, name: str, **changes: str) -> Config:
        """Write its configuration under another name with words replaced."""
        text = (self.folder / "swath.toml").read_text()
        for old, new in changes.items():
            assert old in text, old
            text = text.replace(old, new)
        path = self.folder / name
        path.write_text(text)
        return load_config(path)


def two_lines(
    name: str,
    *,
    flight: str = "seed = 5",
    half_m: float = 500.0,
    norths_m: tuple[float, float] = (0.0, 400.0),
    height_m: float = 700.0,
    gnss: str,
    imu: str = "rate_hz = 100",
    prf_hz: int = 500,
) -> str:
    """Return the plan of two opposite lines at 50 m/s, with a receiver, an IMU and a scanner.

    Args:
        name: the flight's name.
        flight, gnss, imu: text added to these tables.
        half_m: half of a line's length.
        norths_m: north coordinate of each line; the first is flown to the east.
        height_m: ellipsoidal height of both lines.
        prf_hz: the scanner's pulse rate.
    """
    lines = [
        f'[[line]]\nname = "{number}"\nfrom_m = [{-east}, {north}]\nto_m = [{east}, {north}]\nheight_m = {height_m}\n'
        for number, east, north in zip((1, 2), (half_m, -half_m), norths_m, strict=True)
    ]
    tables = f"[gnss.rover]\n{gnss}\n\n[imu.main]\n{imu}\n\n[scanner.left]\nprf_hz = {prf_hz}\n"
    return f'[flight]\nname = "{name}"\nspeed_mps = 50.0\n{flight}\n\n' + "\n".join([*lines, tables])


@contextmanager
def marking() -> Iterator[None]:
    """Let virtual NovAtel receivers stamp an event some time after each whole second."""
    plain = NovatelMessages.epoch

    def epoch(self: NovatelMessages, epochs: Any, row: int) -> list[bytes]:
        messages = plain(self, epochs, row)
        stamp = self._calendar.at(float(epochs.time_s[row]))
        if stamp.second is not None:
            second = stamp.tow_ms // 1000 - 1 + MARK_AFTER_NS * 1e-9 + CLOCK_OFFSET_S
            mark = nov.MarkTime(stamp.week, second, CLOCK_OFFSET_S, CLOCK_SIGMA_S, -18.0, CLOCK_VALID)
            messages.append(encode_log("MARK2TIME", mark, stamp.week, stamp.tow_ms))
        return messages

    with patch.object(NovatelMessages, "epoch", epoch):
        yield


def fly_short(folder: Path, plan_text: str, seconds: float = math.inf) -> Flown:
    """Fly a plan into a log; all of it, or its first seconds."""
    plan = parse_plan(plan_text, Path())
    truth = open_truth(plan, folder / "truth.npz")
    flight = VirtualFlight(plan, truth, seconds)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / name).write_bytes(data)
    (folder / "swath.toml").write_text(config_text(plan, default_wires(plan), "logs"))
    config = load_config(folder / "swath.toml")
    with marking():
        fly_into_log(config, folder / "logs", flight, plan.tables.flight.seed)
    flight.finish_truth()
    return Flown(folder, config)


def errors(trajectory: Trajectory, truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (n, 3) of position, north, east, down, m, and of attitude, rad, where both say something."""
    inside = truth.fates(trajectory.time_ns) == 0
    part = Trajectory(
        *(
            getattr(trajectory, name)[inside]
            for name in ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")
        )
    )
    poses = truth.poses(part.time_ns)
    true = Trajectory(
        part.time_ns,
        poses.position_e,
        poses.q_e_from_b,
        poses.velocity_e,
        part.position_sigma_l,
        part.attitude_sigma_rad,
    )
    lat, lon, _ = true.geodetic()
    down = np.stack([-np.cos(lat) * np.cos(lon), -np.cos(lat) * np.sin(lon), -np.sin(lat)], axis=1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], axis=1)
    north = np.cross(east, down)
    apart = part.position_e - true.position_e
    position = np.stack([(apart * axis).sum(axis=1) for axis in (north, east, down)], axis=1)
    angles = np.stack(part.attitude(), axis=1) - np.stack(true.attitude(), axis=1)
    return position, (angles + np.pi) % (2 * np.pi) - np.pi


def post_processed(truth: Trajectory, span_ns: tuple[int, int]) -> str:
    """Return what RTKLIB would write: the antenna each half second, wrong by `PPK_M`, white."""
    rng = np.random.default_rng(12)
    time_ns = np.arange(-(-span_ns[0] // S) * S, span_ns[1], S // 2)
    poses = truth.poses(time_ns)
    antenna_e = poses.position_e + Rotation.from_quat(poses.q_e_from_b[:, [1, 2, 3, 0]]).apply(ARM_B)
    lon, lat, height = Transformer.from_crs(4978, 4979, always_xy=True).transform(*antenna_e.T)
    off = PPK_M * rng.standard_normal((len(time_ns), 3))
    lat, lon = lat + off[:, 0] / 111_200.0, lon + off[:, 1] / (111_320.0 * np.cos(np.radians(lat)))
    text = POS_HEAD
    for k, at in enumerate(time_ns.tolist()):
        day = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(microseconds=at // 1000)
        sigma = " ".join(f"{value:.4f}" for value in PPK_M)
        text += (
            f"{day:%Y/%m/%d %H:%M:%S}.{day.microsecond // 1000:03d} {lat[k]:.9f} {lon[k]:.9f} "
            f"{height[k] + off[k, 2]:.4f} 1 14 {sigma} 0 0 0 0.00 99.9\n"
        )
    return text
