"""Reads logs into a `swath.calib.flight.Flight`: all returns of the strips, as measured, in memory-mapped files.

The first pass and the strips are those of `swath georef`; then each strip is a job, whose returns are kept as measured
beside their points in t.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from swath.calib.equations.trajectory_prior import TrajectoryPrior, from_smoother, knots_of
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.daemon.config.config import Config
from swath.daemon.config.tables import ScannerConfig
from swath.daemon.errors import UserError
from swath.daemon.log.reader import Session
from swath.daemon.processing.flights.read import Check, GeorefOptions, note_times, read_flights
from swath.daemon.processing.flights.read import Flight as LoggedFlight
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.points.jobs import MARGIN_NS, Job, JobPlan, JobResult, feed_job
from swath.daemon.processing.points.space import check_space_for_returns
from swath.daemon.processing.points.workers import run_jobs
from swath.daemon.processing.setup.models import motion_of
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.written import Reached, room_noted
from swath.drivers.driver import find_driver
from swath.georef.arrays import ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.georeference import Georeferencer
from swath.georef.points import Fate, Points
from swath.georef.progress import BYTES, Tell, silent
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.uncertainty import Noise
from swath.georef.stream.stream import GivenMotion
from swath.georef.strips import Segment, segments
from swath.georef.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from swath.georef.navigation.cross_covariance import ErrorChain

KNOT_S = 0.2  # time between knots of the trajectory's errors
TRAJECTORY_MARGIN_NS = 2_000_000_000
PLACED_ROWS = 1 << 18

COLUMNS: dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]] = {  # one file each
    "rows": (RETURN_DTYPE, ()),
    "time_ns": (np.dtype(np.int64), ()),
    "points_t": (np.dtype(np.float64), (3,)),
    "encoder_rate": (np.dtype(np.float64), ()),
    "encoder_acceleration": (np.dtype(np.float64), ()),
}


KEPT_BYTES = sum(dtype.itemsize * math.prod(shape) for dtype, shape in COLUMNS.values())  # of a return
PLACED_BYTES = COLUMNS["points_t"][0].itemsize * 3  # of a return each time that a flight is placed anew


@dataclass(frozen=True)
class KeepPlan(JobPlan):
    """A plan of jobs that keep returns, with the frame of their points."""

    frame: Tangent


@dataclass(frozen=True, eq=False)
class KeptFlight:
    """A flight that was read for calibration.

    Attributes:
        flight: input of the adjustment; its arrays are mapped from files in the folder.
        logged: the sessions behind it, in the order of ``flight.trajectories``.
        results: results of the jobs.
    """

    flight: Flight
    logged: list[LoggedFlight]
    results: list[JobResult]

    @property
    def notes(self) -> list[str]:
        """Holes in the data asked for, then doubts about the data read, one line each."""
        holes = [line for flight in self.logged for line in flight.holes]
        return [*holes, *dict.fromkeys(line for flight in self.logged for line in flight.warnings)]


def refuse_without_noise(kept: KeptFlight) -> None:
    """Refuse with `UserError` a scanner that is configured without noise: an adjustment weighs returns by it."""
    for head in kept.flight.heads:
        noise = head.noise
        if not max(noise.range_m, noise.angle_rad, noise.divergence_rad):
            raise UserError(
                f"{kept.logged[0].log}: scanner.{head.name}: range_sigma_m, angle_sigma_deg and divergence_mrad are "
                "all 0; set the scanner's values, because the adjustment weights returns by them"
            )


def smoothed_prior(kept: KeptFlight) -> TrajectoryPrior | None:
    """Return the joint covariance of trajectories that were smoothed here; None if one was not, or has several legs."""
    chains: list[ErrorChain] = []
    knots = knots_of(kept.flight, KNOT_S)
    for number, flight in enumerate(kept.logged):
        legs = [] if flight.navigated is None else flight.navigated.legs
        if len(legs) != 1:
            return None
        chains.append(legs[0].solved.error_chain(knots.time_ns[knots.trajectory_index == number]))
    return from_smoother(kept.flight, chains, KNOT_S)


def read_flight(
    request: GeorefOptions, folder: Path, tell: Tell, check: Check = lambda sessions, setups: None
) -> KeptFlight:
    """Read logs into a flight with all returns of its strips.

    Args:
        request: options as of `swath georef`; those about products are ignored.
        folder: folder for the files, which take 104 bytes per return, 112 of a head that gives two angles.
        tell: called with the progress.
        check: called as by `read_flights`.

    Raises:
        UserError: for the reasons of `read_flights`; StripError, MappingError, LogError, OSError.
    """
    logged = read_flights(request, tell, check)
    frame = Tangent.at(_middle(logged[0]))
    plans = [KeepPlan(flight.index, flight.setup, flight.clocks.clocks, frame) for flight in logged]
    jobs = [job for number, flight in enumerate(logged) for job in _jobs(flight, number, folder)]
    total = sum(job.size for job in jobs)
    reached = Reached(lambda done, total: tell("returns", done, total, BYTES))
    with room_noted(folder, reached.share):
        results = run_jobs(
            plans,
            jobs,
            workers=request.workers,
            scheduler=None,
            progress=lambda done: reached(done, total),
            do=keep_job,
        )
    note_times(logged, results)
    heads = _heads(logged)
    swaths = [
        swath
        for job, result in zip(jobs, results, strict=True)
        for swath in _swaths(job, result, heads, logged[job.session])
    ]
    trajectories = tuple(flight.trajectory for flight in logged if flight.trajectory is not None)
    return KeptFlight(Flight(frame, heads, trajectories, tuple(swaths)), logged, results)


def check_space_to_keep(folder: Path, placed: int, sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
    """Compare the space for the returns of a flight, which is placed anew so many times, with the space there is.

    Raises:
        UserError: as of `swath.daemon.processing.points.space.check_space_for_returns`.
    """
    tables = [setup.config.scanner[name] for setup in setups for name in setup.scanners]
    aimed = any(find_driver("scanner", table.protocol).aimed for table in tables)
    least = KEPT_BYTES + (AIMED_RETURN_DTYPE.itemsize - RETURN_DTYPE.itemsize if aimed else 0)
    most = least + placed * PLACED_BYTES
    what = "temporary files of the strips' returns"
    check_space_for_returns(folder, what, (least, most), sessions, setups)


def _middle(flight: LoggedFlight) -> FloatArray:
    assert flight.trajectory is not None
    within = flight.trajectory.between(*flight.span)
    middle: FloatArray = within.position_e[len(within) // 2]
    return middle


def _jobs(flight: LoggedFlight, number: int, folder: Path) -> list[Job]:
    tiles = segments(flight.strips, *flight.host_span, first_number=flight.first_number)
    return [_job(flight, number, tile, folder) for tile in tiles if tile.strip]


def _job(flight: LoggedFlight, number: int, tile: Segment, folder: Path) -> Job:
    assert flight.trajectory is not None
    places = flight.index.between(tile.start_ns - MARGIN_NS, tile.end_ns + MARGIN_NS)
    begin, end = flight.gps_from_host([tile.start_ns, tile.end_ns]).tolist()
    reach = MARGIN_NS + TRAJECTORY_MARGIN_NS
    return Job(number, tile, places, flight.trajectory.between(begin - reach, end + reach), folder)


def _heads(logged: Sequence[LoggedFlight]) -> tuple[Head, ...]:
    """Return the scanner heads of all sessions, which are of one installation.

    A scanner's settings are those of its first session; gimbal angles cover the times of all sessions.
    """
    found: dict[str, Head] = {}
    for flight in logged:
        for name in flight.setup.scanners:
            model = flight.setup.georeferencer(name).model
            table = flight.setup.config.scanner[name]
            noise = Noise(
                table.range_sigma_m, np.radians(table.angle_sigma_deg), divergence_rad=1e-3 * table.divergence_mrad
            )
            start = _under(flight.setup.config, table, model.calibration)
            head = Head(name, start, model.geometry, noise, model.range_gate, model.mount, model.air)
            there = found.setdefault(name, head)
            if len(there.mount.stages) != len(head.mount.stages):
                raise UserError(
                    f"{flight.log}: scanner.{name}.gimbal: has {len(head.mount.stages)} stages, in {logged[0].log} "
                    f"{len(there.mount.stages)}; use logs of one installation"
                )
            if there is not head:
                found[name] = replace(there, mount=there.mount.joined(head.mount))
    return tuple(found.values())


def _under(config: Config, table: ScannerConfig, calibration: Calibration) -> Calibration:
    """Return a calibration with the settings that it is used under; a calibration estimated from it is then refused
    under others.
    """
    factor = calibration.mirror_factor if table.mirror_factor is None else table.mirror_factor
    air = config.atmosphere
    return replace(calibration, ranges=air.ranges, refraction=air.refraction, mirror_factor=factor)


def _swaths(job: Job, result: JobResult, heads: Sequence[Head], flight: LoggedFlight) -> list[Swath]:
    assert job.path is not None
    several = len(flight.setup.scanners) > 1
    made = []
    for number, head in enumerate(heads):
        if head.name not in result.fates:
            continue
        aimed = {"rows": (AIMED_RETURN_DTYPE, ())} if head.model(head.start).aimed else {}
        columns: dict[str, Any] = {
            name: _mapped(_file(job.path, job.segment.strip, head.name, name), dtype, shape)
            for name, (dtype, shape) in (COLUMNS | aimed).items()
        }
        if not len(columns["rows"]):
            continue
        strip = job.segment.strip
        name = f"{head.name} {strip:02d}" if several else f"{strip:02d}"
        made.append(Swath(name, number, strip, job.session, **columns))
    return made


def _file(folder: Path, strip: int, scanner: str, column: str) -> Path:
    return folder / f"{strip:03d}.{scanner}.{column}"


def _mapped(path: Path, dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> Any:
    if not path.stat().st_size:
        return np.empty((0, *shape), dtype)
    return np.memmap(path, dtype, "r").reshape(-1, *shape)


def replaced(
    flight: Flight,
    calibrations: Mapping[str, Calibration],
    folder: Path,
    name: str,
    workers: int | None = None,
    tell: Tell = silent,
) -> Flight:
    """Return `Flight.placed` with the points in newly written, mapped files of this name.

    Strips are placed by ``workers`` threads, by default one per processor: nearly all of the work runs without the
    interpreter's lock.
    """

    done, total, counting = 0, sum(map(len, flight.swaths)), Lock()
    tell("placing returns", 0, total, "returns")

    def placed(number: int) -> Swath:
        nonlocal done
        swath = flight.swaths[number]
        calibration = calibrations[flight.heads[swath.head].name]
        path = folder / f"{number:03d}.{name}.points_t"
        path.unlink(missing_ok=True)  # a reader that still has the old file mapped keeps it
        with path.open("wb") as file:
            for start in range(0, len(swath), PLACED_ROWS):
                points_t = flight.place(swath, calibration, slice(start, start + PLACED_ROWS))
                file.write(np.ascontiguousarray(points_t).data)
                with counting:
                    done += len(points_t)
                    tell("placing returns", done, total, "returns")
        return replace(swath, points_t=_mapped(path, *COLUMNS["points_t"]))

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        swaths = tuple(pool.map(placed, range(len(flight.swaths))))
    return replace(flight, swaths=swaths)


# ---------------------------------------------------------------------- a strip


class _Keeper(Georeferencer):
    """Replaces the georeferencer of a chain: places returns in t and keeps them, with their points, as measured.

    No calibration estimates range offsets by pulse rate: the ranges that are kept include them, so that code that
    places returns anew need not know their rates.
    """

    def __init__(self, georeferencer: Georeferencer, frame: Tangent, given: GivenMotion, files: dict[str, BinaryIO]):
        super().__init__(georeferencer.model)
        self._frame, self._given, self._files = frame, given, files

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> tuple[Points, ByteArray]:
        """Keep the returns and their points; return no points, and the fate of every row."""
        given, rows = self._given, self._with_offsets_by_rate(rows)
        rays = self.model.rays(
            rows, time_ns, trajectory, encoder_rate=given.rate, encoder_acceleration=given.acceleration
        )
        if self.model.air is not None:
            self.model.air.apply(rays.origin_e, rays.points_e)
        kept = rays.fate == Fate.GEOREFERENCED
        values = {
            "rows": rows,
            "time_ns": time_ns,
            "points_t": self._frame.t_from_e(rays.points_e),
            "encoder_rate": given.rate,
            "encoder_acceleration": given.acceleration,
        }
        for name, column in values.items():
            self._files[name].write(np.ascontiguousarray(column[kept]).tobytes())
        return Points.empty(0, with_sigmas=False), rays.fate

    def _with_offsets_by_rate(self, rows: StructArray) -> StructArray:
        if self.rates is None or all(row.prf_hz is None for row in self.model.calibration.range_offsets):
            return rows
        rows = rows.copy()
        for start, stop, prf_hz, _ in self.rates.runs(rows["pulse_id"]):
            part = slice(start, stop)
            rows["range_m"][part] += self.model.offsets_by_rate_m(rows[part], prf_hz)
        return rows


def keep_job(plan: KeepPlan, job: Job, tell: Callable[[int], None]) -> JobResult:
    """Keep a strip's returns in files of the job's folder.

    Raises:
        OSError: the log cannot be read or a file cannot be written.
    """
    result = JobResult(job.session, job.segment.strip, job.segment.start_ns, job.segment.end_ns)
    assert job.trajectory is not None
    assert job.path is not None
    stream = plan.setup.office_stream(plan.clocks, job.trajectory)
    opened: list[BinaryIO] = []
    try:
        for name in stream.scanners:
            files: dict[str, BinaryIO] = {
                column: _file(job.path, job.segment.strip, name, column).open("wb") for column in COLUMNS
            }
            opened += files.values()
            chain = stream.chain(name)
            chain.given, chain.motion = GivenMotion(), motion_of(plan.setup.config.scanner[name])
            chain.georeferencer = _Keeper(plan.setup.georeferencer(name), plan.frame, chain.given, files)
        feed_job(plan, job, result, LogFeed(plan.setup, stream), lambda placed: None, tell)
    finally:
        for file in opened:
            file.close()
    return result


def refuse_installations(logged: Sequence[Any]) -> None:
    """Refuse with `UserError` logged flights that are not of one installation."""
    places = [flight.setup.config.profile.installation for flight in logged]
    for flight, place in zip(logged, places, strict=True):
        if place != places[0]:
            raise UserError(
                f'{flight.log}: was recorded with installation "{place}", {logged[0].log} with "{places[0]}"; use '
                "logs of one installation"
            )
