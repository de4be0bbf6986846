"""Navigation, georeferencing and calibration on opened logs and on arrays, as the commands do them."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from swath.calib.labels import unknown
from swath.daemon.errors import UserError
from swath.daemon.processing.calibration.model import model_of
from swath.daemon.processing.calibration.products import Told, write_products
from swath.daemon.processing.calibration.run import Calibrated, CalibrationOptions, paths_of
from swath.daemon.processing.calibration.run import calibrate as run_calibration
from swath.daemon.processing.control.files import read_control_file
from swath.daemon.processing.files import put_in_place
from swath.daemon.processing.flights.read import Flight, GeorefOptions, read_flights, verdict_of
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.georeferencing.run import REFUSED, Report, jobs_of, write_points
from swath.daemon.processing.navigation.arrays import navigate_arrays
from swath.daemon.processing.navigation.inputs import InputOptions
from swath.daemon.processing.navigation.navigate import (
    Navigated,
    NavigationOptions,
    joined_trajectory,
    navigate_session,
)
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.points.jobs import Job, JobPlan, JobResult, placed_points
from swath.daemon.processing.points.surfaces import SurfaceSigmas
from swath.daemon.processing.setup.setup import Options
from swath.daemon.processing.trajectory.files import TrajectoryFiles, write_trajectory
from swath.daemon.processing.user_errors import as_user_error
from swath.daemon.text_files import text_of
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.navigation.inputs import NavigationError, Solution
from swath.georef.points import Points
from swath.georef.progress import Tell, silent
from swath.georef.scanner.calibration import CalibrationError, read_calibration
from swath.georef.strips import StripRules
from swath.georef.trajectory.trajectory import Poses, Trajectory, TrajectoryError
from swath.logs import Log

__all__ = ["CalibrationResult", "Parameter", "PointCloud", "Track", "calibrate", "georeference", "navigate"]

POINT_TABLE = np.dtype(
    [
        ("gps_ns", "i8"),
        ("xyz", "f8", (3,)),  # easting, northing, height in the mapping frame
        ("sigma", "f4", (3,)),  # one standard deviation along the same axes; nan: not computed
        ("range_m", "f4"),
        ("scan_angle_rad", "f4"),
        ("intensity", "f4"),
        ("return_number", "u1"),
        ("number_of_returns", "u1"),
        ("channel", "u2"),
        ("mta_zone", "u1"),
        ("scanner", "u1"),  # index in `PointCloud.scanners`
        ("strip", "u2"),
    ],
    align=True,
)
_COPIED = ("range_m", "scan_angle_rad", "intensity", "return_number", "number_of_returns", "channel", "mta_zone")


class Track:
    """A trajectory of the body's origin, with sigmas; arrays are (n,) and (n, 3), one row an epoch.

    Attributes:
        trajectory: the trajectory (`swath.georef.trajectory.trajectory.Trajectory`).
        velocity_sigma_l: (n, 3) m/s, north, east, down.
        warnings: doubts about the data and the result, one line each.
        solutions: the navigations, one a leg: estimates of the sensors' errors, innovations, separation.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        solutions: Sequence[Solution],
        warnings: Sequence[str],
        navigated: Sequence[Navigated] = (),
    ) -> None:
        self.trajectory, self.solutions, self.warnings = trajectory, list(solutions), list(warnings)
        self.velocity_sigma_l = np.concatenate([one.velocity_sigma_l for one in solutions])
        self.navigated = {one.session_id: one for one in navigated}

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.trajectory)

    def __repr__(self) -> str:
        """Return the number of epochs and the length."""
        first, last = self.trajectory.span
        return f"<swath.Track of {len(self)} epochs, {(last - first) / 1e9:.1f} s>"

    @property
    def gps_ns(self) -> Int64Array:
        """GPS times, ns."""
        return self.trajectory.time_ns

    @cached_property
    def _geodetic(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.trajectory.geodetic()

    @property
    def lat_rad(self) -> FloatArray:
        """Geodetic latitude."""
        return self._geodetic[0]

    @property
    def lon_rad(self) -> FloatArray:
        """Geodetic longitude."""
        return self._geodetic[1]

    @property
    def height_m(self) -> FloatArray:
        """Ellipsoidal height."""
        return self._geodetic[2]

    @cached_property
    def velocity_l(self) -> FloatArray:
        """Velocity north, east, down, m/s."""
        return self.trajectory.velocity_l()

    @cached_property
    def attitude_rad(self) -> FloatArray:
        """Roll, pitch, heading of the axes forward, right, down against north, east, down."""
        return np.stack(self.trajectory.attitude(), axis=1)

    @property
    def position_sigma_l(self) -> FloatArray:
        """Standard deviations north, east, down, m."""
        return self.trajectory.position_sigma_l

    @property
    def attitude_sigma_rad(self) -> FloatArray:
        """Standard deviations of roll, pitch, heading."""
        return self.trajectory.attitude_sigma_rad

    def at(self, gps_ns: ArrayLike) -> Poses:
        """Return interpolated poses at GPS times (m,), ns.

        Raises:
            SwathError: a time lies outside the trajectory or in a gap.
        """
        with as_user_error(Path(), TrajectoryError):
            return self.trajectory.poses(np.asarray(gps_ns, np.int64))

    def write(self, path: Path | str, *, overwrite: bool = False) -> list[Path]:
        """Write SBET and smrmsg (``….sbet`` or ``….out``) or CSV (``….csv``), as `swath trajectory` writes them.

        Returns:
            The files.

        Raises:
            SwathError: a file exists and ``overwrite`` is not given, the name has another ending, the disk is full.
        """
        output = Path(path)
        with as_user_error(output, TrajectoryError):
            files = TrajectoryFiles.of_output(output, self.trajectory.name, csv=False)
            if files.sbet is not None and output.is_dir():
                raise UserError(f"{output}: is a folder; name a file that ends in .sbet, .out or .csv")
            named = [one for one in (files.sbet, files.smrmsg, files.csv) if one is not None]
            there = [one for one in named if one.exists()]
            if there and not overwrite:
                raise UserError(f"{there[0]}: already exists; choose another name or use overwrite=True")
            written = write_trajectory(files, self.trajectory, self.velocity_sigma_l)
            put_in_place(written)
        return [place for _, place in written]


def navigate(
    log: Log | None = None,
    *,
    smooth: bool = True,
    imu: str | StructArray | None = None,
    gnss: str | StructArray | None = None,
    lever_arm_b: Sequence[float] | None = None,
    rotation_b_imu: ArrayLike | None = None,
    rate_hz: float | None = None,
    noise: str = "tactical",
    use_ins: bool = False,
    attitude_rad: tuple[float, float, float] | None = None,
    tell: Tell = silent,
) -> Track:
    """Navigate a log, or arrays of an IMU and a receiver: align, filter, smooth, diagnose.

    Args:
        log: the log; its configuration gives lever arms, rotations and noise. None: ``imu`` and ``gnss`` are arrays.
        smooth: run the smoother too; False: the forward solution, as in real time.
        imu, gnss: with a log, names of the devices, None: the first of each. Without, structured arrays:
            ``imu`` with the fields ``gps_ns``, ``specific_force_b`` (n, 3) m/s², ``angular_rate_b`` (n, 3) rad/s of
            samples that end at their time; ``gnss`` with ``gps_ns``, ``lat_rad``, ``lon_rad``, ``height_m``, and, where
            there are any, ``velocity_l`` (n, 3), ``position_cov_l`` and ``velocity_cov_l`` (n, 3, 3) or
            ``position_sigma_l`` and ``velocity_sigma_l`` (n, 3), ``fix_type``, ``satellites``. The tables of
            `Source.samples` and `Source.fixes` have these fields.
        lever_arm_b: (3,) from the IMU to the antenna, m, in b; None: the configuration's, of arrays: it is estimated.
        rotation_b_imu: (3, 3) from the axes of ``imu`` to forward, right, down, for arrays; None: they are the same.
        rate_hz: nominal rate of ``imu``, for arrays; None: from its times.
        noise: grade of ``imu``, for arrays: navigation, tactical, mems or consumer.
        use_ins: also use the attitude of the device's own INS, of a log.
        attitude_rad: roll, pitch, heading at the start; None: they are found.
        tell: called with the progress.

    Raises:
        SwathError: there is no trajectory; a line per reason.
    """
    if log is None:
        if isinstance(imu, str) or isinstance(gnss, str) or imu is None or gnss is None:
            raise UserError("swath.navigate: give a log, or arrays of both imu= and gnss=")
        with as_user_error(Path(), NavigationError, TrajectoryError):
            solved, warnings = navigate_arrays(
                imu,
                gnss,
                arm_b=lever_arm_b,
                rot_b_from_imu=rotation_b_imu,
                rate_hz=rate_hz,
                grade=noise,
                attitude_rad=attitude_rad,
                tell=tell,
            )
            solutions = [one.smoothed if smooth else one.forward for one in solved]
            joined = joined_trajectory([solution.trajectory() for solution in solutions], "arrays")
        return Track(joined, solutions, warnings)
    if not isinstance(imu, str | None) or not isinstance(gnss, str | None):
        raise UserError("swath.navigate: imu= and gnss= are names of devices where a log is given")
    inputs = InputOptions(
        imu=imu,
        gnss=gnss,
        config=log.config,
        arm_b=None if lever_arm_b is None else _triple(lever_arm_b),
        ins="observe" if use_ins else "ignore",
    )
    options = NavigationOptions(inputs, smooth=smooth, attitude_rad=attitude_rad)
    with as_user_error(log.paths[0], TrajectoryError):
        flights = [navigate_session(session, options, tell) for session in log.recordings]
        flights.sort(key=lambda flight: int(flight.solutions()[0].time_ns[0]))
        parts = [flight.trajectory(flight.session_id) for flight in flights]
        joined = joined_trajectory(parts, parts[0].name)
    warnings = [line for flight in flights for line in _doubts(flight)]
    return Track(joined, [one for flight in flights for one in flight.solutions()], warnings, flights)


def _doubts(flight: Navigated) -> list[str]:
    findings = [finding.text for leg in flight.legs for finding in leg.findings]
    return [*flight.warnings, *flight.holes, *findings]


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def georeference(
    log: Log,
    track: Track | Path | str | None = None,
    *,
    calibration: Any = None,
    crs: str | None = None,
    scanners: Sequence[str] = (),
    strips: str = "auto",
    min_strip_s: float | None = None,
    sigmas: bool = True,
    surface: Literal["planes", "level", "none"] = "planes",
    datum: str | None = None,
    epoch: float | None = None,
    force_crs: bool = False,
    workers: int = 1,
    tell: Tell = silent,
) -> PointCloud:
    """Georeference a log's returns; the points are computed when they are asked for.

    Args:
        log: the log.
        track: of `navigate`, or a trajectory file; None: the device's own INS, else navigated, as `swath georef`
            chooses.
        calibration: a calibration file, several, a mapping from scanners to files, or a `CalibrationResult`; None: the
            log's own.
        crs: mapping frame, as ``EPSG:32632``; None: the configuration's.
        scanners: names of those to use; empty: all.
        strips: auto, whole, or a CSV file of times; ``min_strip_s``: the shortest strip.
        sigmas: compute three sigmas for each point.
        surface: what the sigmas take the beams' footprints to fall on: planes, level (ground) or none.
        datum, epoch: of the trajectory's positions, and of the products, as in `swath georef`.
        force_crs: accept a CRS that does not suit the place.
        workers: processes that write files; above 1, call it under ``if __name__ == "__main__":``.
        tell: called with the progress.

    Raises:
        SwathError: the log cannot be georeferenced; a line per reason.
    """
    rules = StripRules() if min_strip_s is None else StripRules(min_strip_s=min_strip_s)
    request = GeorefOptions(
        logs=log.paths,
        output=Path(),
        trajectory=_trajectory_options(track),
        options=Options(
            crs=crs,
            force_crs=force_crs,
            datum=datum,
            epoch=epoch,
            scanners=tuple(scanners),
            calibrations=_calibrations(calibration),
            uncertainty=sigmas,
            surface=surface,
        ),
        config=log.config,
        strips=strips,
        rules=rules,
        workers=workers,
        sigmas=sigmas,
    )
    with as_user_error(log.paths[0], *REFUSED, TrajectoryError):
        return PointCloud(request, read_flights(request, tell), tell)


def _trajectory_options(track: Track | Path | str | None, *, navigate: bool = False) -> TrajectoryOptions:
    if isinstance(track, Track):
        if track.navigated:
            return TrajectoryOptions(navigated=track.navigated)
        return TrajectoryOptions(given=track.trajectory)
    return TrajectoryOptions(None if track is None else Path(track), navigate=navigate)


def _calibrations(given: Any) -> dict[str, tuple[str, str]]:
    """Return text and name of calibration files by scanner."""
    if given is None:
        return {}
    if isinstance(given, CalibrationResult):
        return {name: (text, f"calibration of {name}") for name, text in given.texts.items()}
    if isinstance(given, Mapping):
        return {name: (text_of(Path(file), "a calibration file"), str(file)) for name, file in given.items()}
    files = [given] if isinstance(given, str | Path) else list(given)
    found: dict[str, tuple[str, str]] = {}
    for file in files:
        text = text_of(Path(file), "a calibration file")
        with as_user_error(Path(file), CalibrationError):
            found[read_calibration(text, str(file)).scanner] = (text, str(file))
    return found


class PointCloud:
    """Georeferenced returns of a log; iterate for tables of points, or write files.

    Attributes:
        scanners: names of the scanners.
        wkt: the mapping frame.
        warnings: doubts about data, time and trajectory, one line each.
        verdict: of calibration and trajectory: ``level`` and reasons, as in the sidecar.
        fates: number of returns by fate, of the last complete iteration.
    """

    def __init__(self, request: GeorefOptions, flights: Sequence[Flight], tell: Tell) -> None:
        self._request, self._flights, self._tell = request, list(flights), tell
        self.scanners = sorted({name for flight in flights for name in flight.setup.scanners})
        mapping = flights[0].setup.mapping
        self.wkt = "" if mapping is None else mapping.wkt
        self.warnings = [line for flight in flights for line in flight.warnings]
        self.verdict = verdict_of(request, flights)
        self.fates: Counter[str] = Counter()

    @property
    def strips(self) -> list[tuple[int, int]]:
        """GPS times of begin and end of each strip, ns; strips are numbered from 1."""
        return [
            (int(begin), int(end))
            for flight in self._flights
            for begin, end in (flight.gps_from_host(span).tolist() for span in flight.strips)
        ]

    def __iter__(self) -> Iterator[StructArray]:
        """Yield tables (n,) of points (`POINT_TABLE`) in order of strips; memory is bounded.

        Raises:
            SwathError: the log cannot be read.
        """
        self.fates = Counter()
        with as_user_error(self._request.logs[0], *REFUSED):
            for flight in self._flights:
                for job in jobs_of(self._request, flight, 0, Path()):
                    if job.trajectory is not None:
                        yield from self._points(flight, job, job.trajectory)

    def _points(self, flight: Flight, job: Job, trajectory: Trajectory) -> Iterator[StructArray]:
        plan = JobPlan(flight.index, flight.setup, flight.clocks.clocks)
        result = JobResult(job.session, job.segment.strip, job.segment.start_ns, job.segment.end_ns)
        feed = LogFeed(flight.setup, flight.setup.office_stream(plan.clocks, trajectory))
        sigmas = SurfaceSigmas(flight.setup)
        for placed in placed_points(plan, job, result, feed):
            for name, points in placed:
                sigmas.take(name, points)
            for held in sigmas.ready():
                yield self._table(held.points, self.scanners.index(held.name), job.segment.strip)
        for held in sigmas.ready(last=True):
            yield self._table(held.points, self.scanners.index(held.name), job.segment.strip)
        for fates in result.fates.values():
            self.fates.update(fates)

    def _table(self, points: Points, scanner: int, strip: int) -> StructArray:
        table = np.empty(len(points), POINT_TABLE)
        table["gps_ns"], table["xyz"] = points.time_ns, points.points_map
        table["sigma"] = np.nan if points.sigma_map is None else points.sigma_map
        for name in _COPIED:
            table[name] = getattr(points, name)
        table["scanner"], table["strip"] = scanner, strip
        return table

    def read(self) -> StructArray:
        """Return all points (n,) in memory, 80 bytes each."""
        pieces = list(self)
        return np.concatenate(pieces) if pieces else np.empty(0, POINT_TABLE)

    def write(
        self, folder: Path | str, *, overwrite: bool = False, copc: bool = False, scale: float = 0.001
    ) -> list[Path]:
        """Write one LAZ file a strip, the trajectory and the sidecar, the same bytes as `swath georef`.

        Args:
            folder: folder of the files; it is made.
            overwrite: replace files of an earlier run.
            copc: write cloud-optimised files.
            scale: resolution of the coordinates, in their unit.

        Returns:
            The files, the sidecar last.

        Raises:
            SwathError: the files cannot be written.
        """
        request = replace(self._request, output=Path(folder), overwrite=overwrite, copc=copc, scale=scale)
        flights = [replace(one, holes=list(one.holes), troubles=list(one.troubles)) for one in self._flights]
        report: Report = write_points(request, flights, self._tell)
        names = [strip["file"] for strip in report.record["strips"] if strip.get("file")] + report.record["files"]
        return [*(request.output / name for name in names), report.sidecar]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A calibration parameter that was estimated.

    Attributes:
        start, value, sigma: before, after, and one standard deviation, in ``unit``.
        unit: of the three: rad, m, s, or 1 for a ratio.
        words: name for people.
    """

    start: float
    value: float
    sigma: float
    unit: str
    words: str


class CalibrationResult:
    """The outcome of a calibration.

    Attributes:
        parameters: the estimated parameters by name, ``left.omega_rad``.
        names: their names, in the order of `correlation` and `covariance` (u, u).
        not_determined: the parameters that were held, with the reason and what would determine them.
        verdict: ``level`` and reasons, as `swath calibrate` prints them.
        record: everything, as `swath calibrate --json` prints it.
        texts: content of the calibration file of each scanner.
        warnings: notes, one line each.
    """

    def __init__(self, request: CalibrationOptions, done: Calibrated, told: Told, folder: Path, tell: Tell) -> None:
        self._request, self._done, self._folder, self._tell = request, done, folder, tell
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        adjusted = done.adjusted
        self.names = list(adjusted.names)
        rows = zip(adjusted.names, adjusted.start, adjusted.values, adjusted.sigmas, strict=True)
        self.parameters = {
            name: Parameter(float(start), float(value), float(sigma), *_unit(name))
            for name, start, value, sigma in rows
        }
        self.correlation, self.covariance = adjusted.correlation, adjusted.covariance
        self.not_determined = {
            f"{one.scanner}.{one.name}": "; ".join(filter(None, (one.why, one.remedy))) for one in adjusted.held
        }
        self.record, self.verdict = told.record, told.record["verdict"]
        self.texts = {name: path.read_text() for name, path in paths_of(request, adjusted.calibrations).items()}
        self.warnings = list(done.notes)

    def __repr__(self) -> str:
        """Return the parameters with their sigmas."""
        words = ", ".join(
            f"{name} {one.value:.4g} ± {one.sigma:.1g} {one.unit}" for name, one in self.parameters.items()
        )
        return f"<swath.CalibrationResult {self.verdict['level']}: {words}>"

    def write(self, path: Path | str, *, overwrite: bool = False) -> list[Path]:
        """Write the calibration file; of several scanners, a folder of them.

        Raises:
            SwathError: a file exists and ``overwrite`` is not given, or it cannot be written.
        """
        output = Path(path)
        named = {output if len(self.texts) == 1 else output / f"{name}.toml": text for name, text in self.texts.items()}
        for file in named:
            if file.exists() and not overwrite:
                raise UserError(f"{file}: already exists; choose another name or use overwrite=True")
        with as_user_error(output):
            for file, text in named.items():
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
        return list(named)

    def report(self, folder: Path | str) -> Path:
        """Write the report (HTML, PDF, pictures) and the record (ISO 19159) to a folder; return the page.

        Raises:
            SwathError: a file cannot be written.
        """
        request = replace(self._request, report=Path(folder), overwrite=True)
        with as_user_error(Path(folder)):
            write_products(request, self._done, self._tell)
        return Path(folder) / "report.html"


def _unit(name: str) -> tuple[str, str]:
    """Return the SI unit of a parameter, and its name for people."""
    suffix = name.rpartition("_")[2]
    return {"rad": "rad", "m": "m", "s": "s", "s2": "s²"}.get(suffix, "1"), unknown(name).words


def calibrate(
    log: Log,
    *,
    model: str = "scanner",
    track: Track | Path | str | None = None,
    start: Any = None,
    control: Path | str | None = None,
    control_crs: str | None = None,
    crs: str | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    observe: Sequence[str] = ("planes",),
    scanners: Sequence[str] = (),
    datum: str | None = None,
    epoch: float | None = None,
    force_crs: bool = False,
    workers: int = 1,
    tell: Tell = silent,
) -> CalibrationResult:
    """Calibrate the scanners of a calibration flight.

    Args:
        log: the log.
        model: the parameters to estimate: a name or a file, as in `swath calibrate --model`.
        track: as in `georeference`; None: navigated from IMU and GNSS.
        start: calibration to start from, as ``calibration`` of `georeference`; None: the log's own.
        control: file of surveyed points; ``control_crs``: their CRS, None: that of the products.
        crs: mapping frame; None: the configuration's.
        fix, free: parameters to hold or to estimate beside those of the model.
        observe: planes or ties, and markings.
        scanners: names of those to use; empty: all.
        datum, epoch, force_crs: as in `georeference`.
        workers: processes and threads that search; above 1, call it under ``if __name__ == "__main__":``.
        tell: called with the progress.

    Raises:
        SwathError: the flight cannot be calibrated; a line per reason.
    """
    folder = Path(tempfile.mkdtemp(prefix="swath-"))
    try:
        with as_user_error(log.paths[0], TrajectoryError):
            request = CalibrationOptions(
                logs=GeorefOptions(
                    logs=log.paths,
                    output=folder / "calibration.toml",
                    trajectory=_trajectory_options(track, navigate=True),
                    options=Options(
                        crs=crs,
                        force_crs=force_crs,
                        datum=datum,
                        epoch=epoch,
                        scanners=tuple(scanners),
                        calibrations=_calibrations(start),
                        uncertainty=False,
                    ),
                    config=log.config,
                    workers=workers,
                ),
                output=folder / "calibration.toml",
                model=model_of(model, ",".join(fix), ",".join(free)),
                control=read_control_file(None if control is None else Path(control), control_crs),
                observe=tuple(observe),
            )
            done = run_calibration(request, folder, tell)
            told = write_products(request, done, tell)
            return CalibrationResult(request, done, told, folder, tell)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
