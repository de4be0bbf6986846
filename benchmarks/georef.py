"""Measure what georeferencing costs on one core: returns to ECEF, to a mapping frame, with covariances.

python -m benchmarks.georef [--repeats 7] [--json FILE]

Figures are returns a second of this process's own CPU time, medians over the repeats. A mirror scanner (400 000 returns
a second, ±30°, 1000 m above ground) moves along a rolling trajectory of 200 Hz. Its returns come in batches of a log's
chunk, and all parameters of the model are set. All rows together fit into the last cache, as they do when they come
from the decoder.

The kernel makes coordinates of returns; georeferencing makes points with all their columns and gives each return its
fate. The limit beside each rate is the cost of reading as many rows and writing as many results once.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.cpu_time import cpu_seconds
from swath.daemon.system import keep_freed_memory
from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.georeference import BLOCK_ROWS, Georeferencer
from swath.georef.mapping.frame import Mapping
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import PARAMETERS, Calibration, nominal
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from swath.georef.trajectory.trajectory import Trajectory

RETURNS = 400_000
PASSES = 5
BATCH = 40_000  # a chunk of 1 MiB holds some 50 000 returns
RATE_HZ = 400_000
START_NS = 1_479_297_618_000_000_000
VALUES = {
    "omega_rad": 0.0044,
    "phi_rad": -0.007,
    "kappa_rad": 0.0106,
    "range_offset_m": 0.35,
    "range_scale": 4e-5,
    "scan_angle_offset_rad": 9e-4,
    "scan_angle_scale": 3e-4,
    "scan_plane_tilt_rad": 3.5e-4,
    "lever_arm_x_m": 0.15,
    "lever_arm_y_m": -0.08,
    "lever_arm_z_m": 0.42,
    "time_offset_s": 1.5e-4,
    "imu_latency_s": 2e-4,
    "encoder_latency_s": 1e-6,
    "torsion_s2": 2e-9,
    "pitch_slope": 2e-4,
}
BASIC = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m", "lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m")
SIGMAS = {"omega_rad": 2e-5, "phi_rad": 2e-5, "kappa_rad": 5e-5} | dict.fromkeys(BASIC[3:], 0.01)
CRS = "EPSG:32632"


@dataclass
class Figure:
    """One line of the table; rates are returns a second of CPU."""

    name: str
    rate: float
    target: float | None
    limit: float


def rate(work: Callable[[], object], repeats: int) -> float:
    """Return the median of returns a second of CPU time."""
    return PASSES * RETURNS / cpu_seconds(lambda: [work() for _ in range(PASSES)], repeats)


def trajectory() -> Trajectory:
    """Make a line east at 60 m/s, 200 Hz, with roll of 2° in 7 s and 0.3° in 0.9 s, less pitch and heading."""
    time_s = np.arange(0.0, RETURNS / RATE_HZ + 1.0, 0.005) - 0.5
    roll = np.radians(2.0 * np.sin(2 * np.pi * time_s / 7.0) + 0.3 * np.sin(2 * np.pi * time_s / 0.9))
    pitch = np.radians(1.0 + 0.5 * np.sin(2 * np.pi * time_s / 5.0))
    heading = np.radians(90.0 + np.sin(2 * np.pi * time_s / 11.0))
    lat, lon = np.full_like(time_s, np.radians(47.5)), np.radians(9.0) + time_s * 60.0 / 4.32e6
    height = 1500.0 + np.sin(time_s)
    velocity = np.stack([np.zeros_like(time_s), np.full_like(time_s, 60.0), -np.cos(time_s)], axis=1)
    of_position = np.tile([0.02, 0.02, 0.03], (len(time_s), 1))
    of_attitude = np.tile([5e-5, 5e-5, 1e-4], (len(time_s), 1))
    time_ns = START_NS + np.rint(time_s * 1e9).astype(np.int64)
    return Trajectory.from_geodetic(
        time_ns,
        lat,
        lon,
        height,
        velocity,
        roll,
        pitch,
        heading,
        position_sigma_l=of_position,
        attitude_sigma_rad=of_attitude,
    )


def returns() -> tuple[StructArray, Int64Array, FloatArray, FloatArray]:
    """Make returns of a sine of 50 Hz over flat ground.

    Returns:
        The rows, their GPS times (ns), and the encoder's rate (rad/s) and acceleration (rad/s²).
    """
    time_s = np.arange(RETURNS) / RATE_HZ
    phase = 2 * np.pi * 50.0 * time_s
    rows = np.zeros(RETURNS, RETURN_DTYPE)
    rows["encoder_rad"] = np.radians(30.0) * np.sin(phase)
    rows["range_m"] = 1000.0 / np.cos(rows["encoder_rad"])
    rows["intensity"] = 800.0
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["pulse_id"] = np.arange(RETURNS)
    omega = 2 * np.pi * 50.0
    first, second = omega * np.radians(30.0) * np.cos(phase), -(omega**2) * np.radians(30.0) * np.sin(phase)
    return rows, START_NS + np.rint(time_s * 1e9).astype(np.int64), first, second


def calibration(names: tuple[str, ...]) -> Calibration:
    """Return a calibration with these parameters set and the sigmas of a usual adjustment."""
    sigmas = np.array([SIGMAS.get(parameter.name, 0.0) for parameter in PARAMETERS])
    changed = nominal("left", np.zeros(3), np.eye(3)).changed(**{name: VALUES[name] for name in names})
    return replace(changed, sigmas=sigmas)


class KnownMotion:
    """The encoder's true motion, because the cost of finding it from readings is not measured here."""

    def __init__(self, rate: FloatArray, acceleration: FloatArray) -> None:
        self._rate, self._acceleration = rate, acceleration

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        """Return the encoder's rate and acceleration for consecutive pulses."""
        del time_ns
        first = int(rows["pulse_id"][0])
        return self._rate[first : first + len(rows)], self._acceleration[first : first + len(rows)]


def measure(repeats: int) -> list[Figure]:
    """Measure all lines of the table."""
    rows, time_ns, first, second = returns()
    path = trajectory()
    full, basic = calibration(tuple(VALUES)), calibration(BASIC)
    air = Air(ranges="vacuum", refraction="ardc")

    limit = rate(partial(least, rows), repeats)
    mapping, sigmas = Mapping(CRS), Uncertainty(full, Noise())

    def model(of: Calibration, through: Air | None = None) -> SensorModel:
        return SensorModel(of, LineGeometry(), (20.0, 3000.0), air=through)

    def kernels(frame: Mapping | None, uncertainty: Uncertainty | None) -> None:
        for at in range(0, RETURNS, BLOCK_ROWS):
            block = slice(at, at + BLOCK_ROWS)
            rays = every.rays(
                rows[block],
                time_ns[block],
                path,
                encoder_rate=first[block],
                encoder_acceleration=second[block],
                uncertainty=uncertainty,
            )
            if frame is not None:
                frame.map_with_sigmas(rays.points_e, rays.covariance_e)

    def whole(georeferencer: Georeferencer) -> None:
        for at in range(0, RETURNS, BATCH):
            georeferencer.georeference(rows[at : at + BATCH], time_ns[at : at + BATCH], path)

    every, known = model(full), KnownMotion(first, second)
    cases: list[tuple[str, Callable[[], object], float | None]] = [
        ("kernel, ECEF, every parameter", partial(kernels, None, None), 12e6),
        ("kernel, map, every parameter", partial(kernels, mapping, None), 10e6),
        ("kernel, map, every parameter, covariance", partial(kernels, mapping, sigmas), 6e6),
    ]
    points = [
        ("points, ECEF, every parameter", Georeferencer(every, None, None, known)),
        ("points, map, every parameter", Georeferencer(every, mapping, None, known)),
        ("points, map, basic", Georeferencer(model(basic), mapping)),
        ("points, map, every parameter, air", Georeferencer(model(full, air), mapping, None, known)),
        ("points, map, every parameter, covariance", Georeferencer(every, mapping, sigmas, known)),
    ]
    cases += [(name, partial(whole, one), None) for name, one in points]
    return [Figure(name, rate(work, repeats), asked, limit) for name, work, asked in cases]


def least(rows: StructArray) -> None:
    """Read every row, and write a point of 24 bytes and a time of 8 bytes for each."""
    for at in range(0, RETURNS, BATCH):
        part = rows[at : at + BATCH]
        part.copy()
        np.zeros((len(part), 4))


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7, help="measurements per figure; the median counts")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    figures = measure(arguments.repeats)
    print(f"{'georeferencing, one core':<46} {'rate':>9} {'asked':>8} {'limit':>9}")
    for one in figures:
        asked = f"{one.target / 1e6:>4.0f} M/s" if one.target else ""
        print(f"{one.name:<46} {one.rate / 1e6:>5.2f} M/s {asked:>8} {one.limit / 1e6:>5.0f} M/s")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1))


if __name__ == "__main__":
    main()
