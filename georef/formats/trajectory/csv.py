"""Read and write trajectory CSV, the project's own text format: CONVENTIONS, "Trajectory and text files".

A header line has the ten columns of `HEADER`, then any of `SIGMAS` (those of the position may also be in degrees of
latitude and longitude); other columns are refused.
"""

from __future__ import annotations

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.formats.trajectory.columns import TrajectoryColumns, unsaid
from swath.georef.geodesy.earth import meridian_radius_m, prime_vertical_radius_m
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError

HEADER = "gps_ns,lat_deg,lon_deg,height_m,vel_n_mps,vel_e_mps,vel_d_mps,roll_deg,pitch_deg,heading_deg"
COLUMNS = HEADER.split(",")
POSITION_SIGMAS = ("sigma_n_m", "sigma_e_m", "sigma_d_m")
ATTITUDE_SIGMAS = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")
OTHER_NAMES = {"sigma_lat_m": "sigma_n_m", "sigma_lon_m": "sigma_e_m", "sigma_height_m": "sigma_d_m"}
IN_DEGREES = ("sigma_lat_deg", "sigma_lon_deg")
UNUSED = ("sigma_vel_n_mps", "sigma_vel_e_mps", "sigma_vel_d_mps")
SIGMAS = (*POSITION_SIGMAS, *ATTITUDE_SIGMAS)


def is_csv(text: str) -> bool:
    """Return whether the first line is that of a trajectory CSV."""
    return text.lstrip("\ufeff \r\n").startswith("gps_ns")


def read_csv(text: str, name: str) -> TrajectoryColumns:
    """Return rows of a trajectory CSV.

    Raises:
        TrajectoryError: names the faulty line.
    """
    lines = text.lstrip("\ufeff").splitlines()
    first = next(i for i, line in enumerate(lines) if line.strip())
    header = [column.strip() for column in lines[first].split(",")]
    if header[: len(COLUMNS)] != COLUMNS:
        raise TrajectoryError(f"{name}: the header of a trajectory CSV begins with {HEADER}")
    unknown = set(header[len(COLUMNS) :]) - {*SIGMAS, *OTHER_NAMES, *IN_DEGREES, *UNUSED}
    if unknown:
        raise TrajectoryError(f"{name}: column {min(unknown)} is unknown; sigmas are {', '.join(SIGMAS)}")
    if len(set(header)) < len(header):
        twice = next(column for column in header if header.count(column) > 1)
        raise TrajectoryError(f"{name}: column {twice} is given twice; give each column once")
    table = _numbers(lines[first + 1 :], header, name, first + 2)
    degrees = {column: np.radians(table[column]) for column in header if column.endswith("_deg")}
    position_sigma_l, attitude_sigma_rad = _sigmas(table, degrees)
    return TrajectoryColumns(
        time_ns=np.ascontiguousarray(table["gps_ns"]),
        lat_rad=degrees["lat_deg"],
        lon_rad=degrees["lon_deg"],
        height_m=table["height_m"],
        velocity_l=np.stack([table[column] for column in COLUMNS[4:7]], axis=1),
        roll_rad=degrees["roll_deg"],
        pitch_rad=degrees["pitch_deg"],
        heading_rad=degrees["heading_deg"],
        position_sigma_l=position_sigma_l,
        attitude_sigma_rad=attitude_sigma_rad,
        row="line",
        first_row=first + 2,
    )


def csv_text(trajectory: Trajectory) -> str:
    """Return the trajectory with its sigmas as CSV; latitude and longitude to 0.1 mm or better, angles to 1e-8°."""
    trajectory.require_attitude()
    lat, lon, height = trajectory.geodetic()
    columns = (
        *(np.degrees(lat), np.degrees(lon), height),
        *trajectory.velocity_l().T,
        *(np.degrees(angle) for angle in trajectory.attitude()),
        *trajectory.position_sigma_l.T,
        *np.degrees(trajectory.attitude_sigma_rad).T,
    )
    form = "{},{:.11f},{:.11f},{:.5f}" + ",{:.5f}" * 3 + ",{:.8f}" * 3 + ",{:.5f}" * 3 + ",{:.7f}" * 3
    rows = zip(trajectory.time_ns.tolist(), *(column.tolist() for column in columns), strict=True)
    return "\n".join([",".join((*COLUMNS, *SIGMAS)), *(form.format(*row) for row in rows), ""])


def _numbers(lines: list[str], header: list[str], name: str, first_line: int) -> StructArray:
    dtype = [(column, "i8" if column == "gps_ns" else "f8") for column in header]
    if not any(line.strip() for line in lines):
        return np.empty(0, dtype)
    try:
        return np.atleast_1d(np.loadtxt(lines, dtype=dtype, delimiter=",", comments=None))
    except ValueError as error:
        for number, line in enumerate(lines, first_line):
            if not line.strip():
                continue
            try:
                np.loadtxt([line], dtype=dtype, delimiter=",", comments=None)
            except ValueError as one:
                what = str(one).split(" at row")[0].split(";")[0]
                raise TrajectoryError(f"{name}: line {number}: {what}; {len(header)} numbers are expected") from None
        raise TrajectoryError(f"{name}: {error}") from None


def _sigmas(table: StructArray, degrees: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return sigmas (n, 3) of position in metres and of attitude in radians."""
    position, attitude = unsaid(len(table)), unsaid(len(table))
    for column in table.dtype.names or ():
        metres = OTHER_NAMES.get(column, column)
        if metres in POSITION_SIGMAS:
            position[:, POSITION_SIGMAS.index(metres)] = table[column]
        elif column in ATTITUDE_SIGMAS:
            attitude[:, ATTITUDE_SIGMAS.index(column)] = degrees[column]
    lat = degrees["lat_deg"]
    if "sigma_lat_deg" in degrees:
        position[:, 0] = degrees["sigma_lat_deg"] * meridian_radius_m(lat)
    if "sigma_lon_deg" in degrees:
        position[:, 1] = degrees["sigma_lon_deg"] * prime_vertical_radius_m(lat) * np.cos(lat)
    return position, attitude
