"""`swath georef`: from logs and a trajectory to one file per strip, the trajectory and the sidecar.

Two passes. The first reads all data but the returns: clocks, the INS, turn rates; of returns it only notes where they
are stored. Then the time is cut into segments, and each is a job (daemon/processing/points/jobs.py). All files are
written to a temporary folder and moved to their place at the end, the sidecar last.
"""

from __future__ import annotations

import glob
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, NoReturn

import numpy as np

from swath import __version__
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.durable import sync_file, try_sync_directory
from swath.daemon.log.reader import Session
from swath.daemon.processing.earlier_runs import listed_files, refuse_existing, stale_pages
from swath.daemon.processing.error_model.build import build_model
from swath.daemon.processing.error_model.file import ENDING, RECORD, ModelFile
from swath.daemon.processing.files import put_in_place, sha256_of
from swath.daemon.processing.flights.read import (
    INTENSITY_FACTOR,
    Flight,
    GeorefOptions,
    note_times,
    read_flights,
    verdict_of,
)
from swath.daemon.processing.georeferencing.sidecar import count_undecoded, reasons_text, run_record, write_sidecar
from swath.daemon.processing.points.jobs import MARGIN_NS, Job, JobError, JobResult, SessionPlan
from swath.daemon.processing.points.space import LAZ_BYTES, check_space_for_returns
from swath.daemon.processing.points.workers import run_jobs
from swath.daemon.processing.quicklook.product_facts import read_sidecar, sessions_in
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.trajectory.files import TrajectoryFiles, write_trajectory
from swath.daemon.processing.undecoded import undecoded_lines
from swath.daemon.processing.user_errors import as_user_error
from swath.daemon.system import held_interrupts
from swath.daemon.written import Reached, make_folder, note_written, room_noted
from swath.drivers.driver import find_driver
from swath.georef.formats.las import LasSettings
from swath.georef.formats.las_header import append_evlr, encode_evlr
from swath.georef.mapping.frame import MappingError
from swath.georef.progress import BYTES, Tell
from swath.georef.strips import Segment, StripError, segments
from swath.georef.timescales.gps_time import table_leap_seconds, utc_from_gps

DROPPED = ".dropped.csv.gz"
ENDINGS = (".laz", DROPPED)  # endings of a strip's files
OFFSET_STEP = 1000.0  # files' offsets are whole kilometres
TRAJECTORY_MARGIN_NS = 2_000_000_000
REFUSED = (StripError, JobError, MappingError)


@dataclass(frozen=True)
class Report:
    """The outcome: the sidecar's content and path."""

    record: dict[str, Any]
    sidecar: Path


def georeference(request: GeorefOptions, tell: Tell) -> Report:
    """Make the products of a run.

    Raises:
        UserError: they cannot be made, one line; no file that looks like a product is left then.
    """

    def check(sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
        check_space_for_returns(request.output, "points", LAZ_BYTES, sessions, setups)

    with as_user_error(request.output, *REFUSED):
        flights = read_flights(request, tell, check)
    return write_points(request, flights, tell)


def write_points(request: GeorefOptions, flights: Sequence[Flight], tell: Tell) -> Report:
    """Make the products of a run whose flights have been read.

    Raises:
        UserError: they cannot be made, as in `georeference`.
    """
    names = [flight.session.session_id for flight in flights]
    with as_user_error(request.output, *REFUSED), _out_of_sight(request, names) as (partial, into_place):
        return _make(request, flights, names[0], partial, into_place, tell)


# ---------------------------------------------------------------------- jobs


def jobs_of(request: GeorefOptions, flight: Flight, number: int, partial: Path) -> list[Job]:
    """Return the jobs of a flight with its number: one a strip, and one a piece between strips.

    Each writes its files to the folder ``partial``.
    """
    tiles = segments(flight.strips, *flight.host_span, first_number=flight.first_number)
    return [_job(request, flight, number, tile, partial) for tile in tiles]


def _job(request: GeorefOptions, flight: Flight, number: int, tile: Segment, partial: Path) -> Job:
    places = flight.index.between(tile.start_ns - MARGIN_NS, tile.end_ns + MARGIN_NS)
    if not tile.strip:
        return Job(number, tile, places)
    assert flight.trajectory is not None
    begin, end = flight.gps_from_host([tile.start_ns, tile.end_ns]).tolist()
    reach = MARGIN_NS + TRAJECTORY_MARGIN_NS
    trajectory = flight.trajectory.between(begin - reach, end + reach)
    name = f"{flight.session.session_id}_strip{tile.strip:02d}"
    path = partial / (name + (".copc.laz" if request.copc else ".laz"))
    dropped_file = partial / f"{name}{DROPPED}" if request.write_dropped else None
    return Job(number, tile, places, trajectory, path, dropped_file)


def _numbers(flights: Sequence[Flight]) -> dict[str, int]:
    """Return numbers of scanners by name, the same in all files: a session may lack one that another has."""
    return {name: number for number, name in enumerate(sorted({n for one in flights for n in one.setup.scanners}))}


def _plan(
    request: GeorefOptions, flight: Flight, origin: tuple[float, float, float], numbers: dict[str, int]
) -> SessionPlan:
    setup = flight.setup
    assert setup.mapping is not None
    protocols = {name: setup.config.scanner[name].protocol for name in setup.scanners}
    near, _ = utc_from_gps(flight.span[0], 0)
    day, _ = utc_from_gps(flight.span[0], table_leap_seconds(near)[0])
    las = LasSettings(
        wkt=setup.mapping.wkt,
        offset=origin,
        scale=(request.scale, request.scale, request.scale),
        sigmas=request.sigmas,
        incidence=request.options.incidence,
        range_sigma=request.options.range_sigma,
        covariances=request.options.covariances,
        creation_date=day,
        software=f"swath {__version__}",
        system_identifier=" ".join(protocols.values()),
        provenance=json.dumps(
            {
                "software": f"swath {__version__}",
                "session": flight.session.session_id,
                "calibrations": {name: calibration.id for name, calibration in setup.calibrations.items()},
            }
        ),
    )
    eight_bit = [name for name, protocol in protocols.items() if find_driver("scanner", protocol).eight_bit_intensity]
    factors = dict.fromkeys(eight_bit, INTENSITY_FACTOR)
    return SessionPlan(flight.index, setup, flight.clocks.clocks, las, factors, numbers, request.copc)


def _origin(flights: Sequence[Flight]) -> tuple[float, float, float]:
    """Return the coordinate offset of all files: the rounded middle of the trajectory; heights have no offset."""
    flight = flights[0]
    assert flight.trajectory is not None
    assert flight.setup.mapping is not None
    within = flight.trajectory.between(*flight.span)
    middle = within.position_e[len(within) // 2]
    east, north, _ = np.round(flight.setup.mapping.map_from_e(middle[np.newaxis])[0] / OFFSET_STEP) * OFFSET_STEP
    return float(east), float(north), 0.0


# ---------------------------------------------------------------------- second pass and output


@contextmanager
def _out_of_sight(request: GeorefOptions, names: Sequence[str]) -> Iterator[tuple[Path, Callable[[list[Path]], None]]]:
    """Provide a temporary folder and a function that moves files to their place; the folder is always removed.

    Args:
        request: options of the run.
        names: names of the sessions.
    """
    output, name = request.output, names[0]
    _refuse_existing(request, names)
    make_folder(output)
    partial = output / f"{name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    stale = _stale(output, names)

    def into_place(files: list[Path]) -> None:
        for file in files:
            sync_file(file)
        with held_interrupts():
            for one in names:
                for ending in (".json", ENDING):
                    (output / f"{one}{ending}").unlink(missing_ok=True)
                for old in _strips(output, one):
                    old.unlink()
            for old in stale:
                old.unlink(missing_ok=True)
            for folder in {old.parent for old in stale} - {output}:
                with suppress(OSError):  # there are other files in it
                    folder.rmdir()
            for file in files:
                file.replace(output / file.name)
                note_written(output / file.name)
        try_sync_directory(output)

    try:
        yield partial, into_place
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _stale(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the pages of earlier runs that show the points or the trajectories that are replaced."""
    pages = stale_pages(folder, [path for name in names for path in _strips(folder, name)])
    for name in names:
        summary = TrajectoryFiles.in_folder(folder, name, csv=True).summary  # of `swath trajectory`
        replaced = (".sbet", ".smrmsg", ".csv")
        pages += [path for path in (*listed_files(summary), summary) if path.suffix not in replaced and path.exists()]
    return pages


def _strips(folder: Path, name: str) -> list[Path]:
    """Return the existing files of a session's strips."""
    return [file for file in sorted(folder.glob(f"{glob.escape(name)}_strip*")) if file.name.endswith(ENDINGS)]


def _refuse_existing(request: GeorefOptions, names: Sequence[str]) -> None:
    """Refuse with `UserError` to replace the sessions' products, or a trajectory of theirs that is read."""
    for name in names:
        files = TrajectoryFiles.in_folder(request.output, name, csv=True)
        trajectories = [path for path in (files.csv, files.sbet, files.smrmsg) if path is not None and path.exists()]
        read = request.trajectory.file
        if read is not None and read.exists() and any(path.samefile(read) for path in trajectories):
            raise UserError(f"{read}: is an input and would be overwritten; choose another folder", ExitCode.USAGE)
        there = [path for path in (request.output / f"{name}.json", *_strips(request.output, name)) if path.exists()]
        if (there or trajectories) and not request.overwrite:
            refuse_existing([*there, *trajectories], overwrite=False)
    _refuse_parts(request.output, names)


def _refuse_parts(folder: Path, names: Sequence[str]) -> None:
    """Refuse with `UserError` to replace a part of a run: its sidecar would then describe missing files."""
    for path in sorted(folder.glob("*.json")):
        sessions = sessions_in(read_sidecar(path))
        others = [session for session in sessions if session not in names]
        if others and len(others) < len(sessions):
            text = (
                f"{path}: belongs to one run with {', '.join(others)}; process all its sessions at once, or choose "
                "another folder"
            )
            raise UserError(text, ExitCode.USAGE)


def _make(
    request: GeorefOptions,
    flights: Sequence[Flight],
    name: str,
    partial: Path,
    into_place: Callable[[list[Path]], None],
    tell: Tell,
) -> Report:
    origin = _origin(flights)
    numbers = _numbers(flights)
    plans = [_plan(request, flight, origin, numbers) for flight in flights]
    jobs = [job for number, flight in enumerate(flights) for job in jobs_of(request, flight, number, partial)]
    total = sum(job.size for job in jobs)
    given_up, reached = Event(), Reached(lambda done, total: tell("points", done, total, BYTES))
    with ThreadPoolExecutor(1) as hasher, room_noted(partial, reached.share):
        paths = [part.path for flight in flights for part in flight.session.parts]
        hashes = [hasher.submit(sha256_of, path, given_up.is_set) for path in paths]
        try:
            results = run_jobs(
                plans,
                jobs,
                workers=request.workers,
                scheduler=request.scheduler,
                progress=lambda done: reached(done, total),
            )
            logs = [{"name": path.name, "sha256": found.result()} for path, found in zip(paths, hashes, strict=True)]
        except BaseException:  # an interrupt too: it must not wait for the hashes of large logs
            given_up.set()
            raise
    _note_troubles(flights, results)
    files = {job.segment.strip: _files(job, result) for job, result in zip(jobs, results, strict=True)}
    done = [path for made in files.values() for path in made if path is not None]
    tell("trajectory and sidecar", 0, 0)
    trajectories = [path for flight in flights for path in _write_trajectory(flight, partial)]
    models: list[Path] = []
    entry: dict[str, Any] = {}
    if request.error_model:
        tell("error model", 0, 0)
        models.append(partial / f"{name}{ENDING}")
        entry["error_model"] = _write_model(models[0], flights, jobs, results, numbers)
    record = run_record(flights, results, files)
    record["verdict"] = verdict_of(request, flights)
    others = [path.name for path in (*trajectories, *models)]
    record |= {"logs": logs, "files": others, "options": request.record()} | entry
    if stale := _stale(request.output, [flight.session.session_id for flight in flights]):
        record["warnings"].append(
            f"{request.output}: removed pages and pictures of the replaced points or trajectory: "
            + ", ".join(str(path.relative_to(request.output)) for path in stale)
        )
    sidecar = partial / f"{name}.json"
    write_sidecar(sidecar, record)
    into_place([*done, *trajectories, *models, sidecar])
    return Report(record, request.output / sidecar.name)


def _files(job: Job, result: JobResult) -> tuple[Path | None, Path | None]:
    """Return the files that a job made: points, and the list of returns without a place."""
    if result.failed:
        return None, None
    return job.path if result.points or result.withheld else None, job.discarded if result.listed else None


def _note_troubles(flights: Sequence[Flight], results: Sequence[JobResult]) -> None:
    """Note why returns have no time; raise `UserError` if not one return could be placed."""
    note_times(flights, results)
    if not any(result.points or result.failed for result in results):
        lines = [line for flight in flights for line in (*flight.troubles, *flight.holes)]
        lines += [line for part in undecoded_lines(str(flights[0].log), count_undecoded(results)) for line in part]
        became = reasons_text(fates for result in results for fates in result.fates.values())
        refuse_nothing(flights[0].log, lines, became)


def _write_model(
    path: Path, flights: Sequence[Flight], jobs: Sequence[Job], results: Sequence[JobResult], numbers: dict[str, int]
) -> dict[str, Any]:
    """Write the error model to a file and into each file of points; return its entry of the sidecar."""
    mapping = flights[0].setup.mapping
    assert mapping is not None
    built = build_model(flights, jobs, results)
    session = flights[0].session.session_id
    file = ModelFile(built.model, numbers, mapping.unit_m, mapping.wkt, f"swath {__version__}", session)
    path.write_text(file.text(), encoding="utf-8")
    record = encode_evlr(*RECORD, file.text().encode(), "error model, JSON")
    for job, result in zip(jobs, results, strict=True):
        points, _ = _files(job, result)
        if points is not None:
            with points.open("r+b") as stream:
                append_evlr(stream, record)
                result.file_bytes = stream.tell()
    return {"file": path.name, **built.summary()}


def _write_trajectory(flight: Flight, folder: Path) -> list[Path]:
    """Write the part of the trajectory that the returns needed: CSV, and SBET with smrmsg."""
    assert flight.trajectory is not None
    used = flight.trajectory.between(*flight.span)
    if flight.setup.deflection_rad is not None:  # back to the vertical of its source: it may be read again
        xi, eta = flight.setup.deflection_rad
        used = used.with_deflection(-xi, -eta)
    written = write_trajectory(TrajectoryFiles.in_folder(folder, flight.session.session_id, csv=True), used, None)
    put_in_place(written)
    return sorted(path for _, path in written)


def refuse_nothing(log: Path, troubles: Sequence[str], became: str) -> NoReturn:
    """Raise the error of a run in which not one return could be placed.

    Args:
        log: the first log.
        troubles: lines that give the reasons; empty: unknown.
        became: fates of the returns, for people.

    Raises:
        UserError: always.
    """
    raise UserError("\n".join(troubles) or f"{log}: no return could be georeferenced: {became}")
