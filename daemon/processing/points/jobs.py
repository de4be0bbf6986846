"""Runs a segment of a log as an independent job: it reads its chunks, decodes, georeferences, and writes its own file.

A job's result depends on its input only, so it does not matter which process or computer runs it, or when.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import lazrs
import numpy as np

from swath.daemon.log.chunk_index import SCANNER, ChunkPlace, LogIndex, read_chunks
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import PartDamage
from swath.daemon.processing.points.coverage import Coverage, Covered
from swath.daemon.processing.points.discarded import DiscardedPoints
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.points.surfaces import SurfaceSigmas
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.undecoded import Undecoded
from swath.georef.formats.copc import CopcWriter
from swath.georef.formats.las import Clipped, LasError, LasSettings, LasWriter
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.mapping.frame import MappingError
from swath.georef.points import Fate, Points
from swath.georef.records import ChunkBatch, ScannerReturns
from swath.georef.stream.clocks import FrozenClocks
from swath.georef.strips import Segment
from swath.georef.trajectory.trajectory import Trajectory

MARGIN_NS = 5_000_000_000  # of log time read on either side: edges a device latched, revolutions, pulses in air
BETWEEN_STRIPS = "between_strips"
EDGE_SAMPLES = 50  # points of a tick that are looked at
MAX_EDGE_RAD = 1.31  # 75°; beams of spinning heads go to the horizon
LEAST_ROOM_BYTES = 1 << 20  # with less room a disk is full for files of points
Tell = Callable[[int], None]  # called with the bytes of the log that were read


class JobError(Exception):
    """Raised for a strip that cannot be written; its text is one line."""


@dataclass(frozen=True)
class JobPlan:
    """The data that all jobs of a session share; pickles.

    Attributes:
        index: places of the chunks.
        setup: setup of the georeferencing.
        clocks: clocks of the host, complete.
    """

    index: LogIndex
    setup: Setup
    clocks: FrozenClocks


@dataclass(frozen=True)
class SessionPlan(JobPlan):
    """A plan of jobs that write files of points.

    Attributes:
        las: settings of the files.
        intensity_factors: factors on intensities, by scanner.
        numbers: numbers of scanners in the files.
        copc: write cloud optimised files.
    """

    las: LasSettings
    intensity_factors: dict[str, float]
    numbers: dict[str, int]
    copc: bool = False


@dataclass(frozen=True)
class Job:
    """A segment to be processed; pickles.

    Attributes:
        session: index of its plan.
        segment: segment in log time.
        places: places of its chunks, and of those of the margin.
        trajectory: the part of the trajectory that it needs; None between strips, where returns are only counted.
        path: file to be written; None: no file.
        discarded: file for the list of returns without a place; None: they are only counted.
    """

    session: int
    segment: Segment
    places: list[ChunkPlace]
    trajectory: Trajectory | None = None
    path: Path | None = None
    discarded: Path | None = None

    @property
    def size(self) -> int:
        """Bytes of the log that it reads."""
        return sum(place.length for place in self.places)


@dataclass
class JobResult:
    """The outcome of a segment, in plain values.

    Attributes:
        fates: by scanner, number of returns by fate.
        time_refused: by scanner, number of stamps that its clock rejected, by reason.
        undecoded: by scanner, messages that its parser refused, by reason, and those missing from its own sequence.
        first_gps_ns, last_gps_ns: times of the points; None: there are none.
        bounds: smallest and largest coordinates.
        last_returns: number of points that are the last return of their pulse.
        covered: ground that the points lie on; None: not known.
        edges: by scanner, for the sampled point seen farthest from nadir: the angle, rad, the height of the scanner
            above the point, m, and the point's ellipsoidal height, m.
        surface: by scanner, `swath.daemon.processing.points.surfaces.SurfaceSigmas.counts`.
        file_bytes: size of the file written.
        withheld, listed: number of returns left out that are withheld points of the file, and rows of the list.
        failed: why the job failed; empty: it did not.
        seconds: CPU time.
    """

    session: int
    strip: int
    start_ns: int
    end_ns: int
    fates: dict[str, Counter[str]] = field(default_factory=dict)
    time_refused: dict[str, dict[str, int]] = field(default_factory=dict)
    undecoded: dict[str, Counter[str]] = field(default_factory=dict)
    clipped: Clipped = field(default_factory=Clipped)
    points: int = 0
    withheld: int = 0
    listed: int = 0
    first_gps_ns: int | None = None
    last_gps_ns: int | None = None
    bounds: list[list[float]] = field(default_factory=list)
    last_returns: int = 0
    covered: Covered | None = None
    edges: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    surface: dict[str, dict[str, Any]] = field(default_factory=dict)
    file_bytes: int = 0
    damage: list[PartDamage] = field(default_factory=list)
    failed: str = ""
    seconds: float = 0.0


class PointSink(Protocol):
    """A writer of a strip's points: a LAZ or a COPC file."""

    @property
    def clipped(self) -> Clipped:
        """Numbers of values that did not fit their fields."""

    def write(self, points: Points, *, scanner: int = 0, intensity_factor: float = 1.0, withheld: bool = False) -> None:
        """Append points to the file."""

    def close(self) -> None:
        """Finish the file."""


def run_job(plan: SessionPlan, job: Job, tell: Tell = lambda size: None) -> JobResult:
    """Run a job that writes a file of points, or counts returns between strips.

    Raises:
        JobError: its points cannot be stored in a file.
        OSError: the log cannot be read or the file cannot be written.
    """
    began = time.process_time()
    result = JobResult(job.session, job.segment.strip, job.segment.start_ns, job.segment.end_ns)
    if job.trajectory is None or job.path is None:
        _count(plan, job, result, tell)
    else:
        try:
            with ExitStack() as opened:
                stream = opened.enter_context(job.path.open("x+b"))
                sink = _sink(plan, job, stream, opened)
                _write(plan, job, job.trajectory, result, sink, opened, tell)
                result.file_bytes = stream.tell()
        except (LasError, MappingError) as error:
            raise JobError(f"{job.path.name}: {error}") from error
        except lazrs.LazrsError as error:  # this error does not give the file system's reason
            if shutil.disk_usage(job.path.parent).free < LEAST_ROOM_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(job.path)) from error
            raise OSError(errno.EIO, "cannot be written; is the disk full?", str(job.path)) from error
        finally:
            if not result.points and not result.withheld:
                job.path.unlink(missing_ok=True)
    result.seconds = time.process_time() - began
    return result


def _write(
    plan: SessionPlan,
    job: Job,
    trajectory: Trajectory,
    result: JobResult,
    sink: PointSink,
    opened: ExitStack,
    tell: Tell,
) -> None:
    setup = plan.setup
    georeferenced = setup.office_stream(plan.clocks, trajectory)
    feed, sigmas = LogFeed(setup, georeferenced), SurfaceSigmas(setup)
    coverage = (
        None if setup.mapping is None or setup.mapping.is_geocentric else Coverage(float(setup.mapping.unit_m[0]))
    )

    def put(*, last: bool = False) -> None:
        for name, points, withheld in sigmas.ready(last=last):
            factor = plan.intensity_factors.get(name, 1.0)
            sink.write(points, scanner=plan.numbers[name], intensity_factor=factor, withheld=withheld)
            if withheld:
                continue
            result.last_returns += int(np.count_nonzero(points.return_number == points.number_of_returns))
            if coverage is not None:
                coverage.add(points.points_map[:, 0], points.points_map[:, 1])
            _note_span(result, points)
            _note_edge(result, name, points, setup, trajectory)

    def take(placed: list[tuple[str, Points]]) -> None:
        for name, points in placed:
            sigmas.take(name, points)
        put()

    dropped_file = None
    if job.discarded is not None:
        dropped_file = DiscardedPoints(job.discarded, georeferenced, partial(sigmas.take, withheld=True))
        opened.callback(dropped_file.close)
    feed_job(plan, job, result, feed, take, tell)
    put(last=True)
    sink.close()
    result.clipped = sink.clipped
    result.surface = sigmas.counts()
    result.covered = None if coverage is None else coverage.covered()
    if dropped_file is not None:
        result.withheld, result.listed = dropped_file.withheld, dropped_file.rows


def feed_job(
    plan: JobPlan,
    job: Job,
    result: JobResult,
    feed: LogFeed,
    write: Callable[[list[tuple[str, Points]]], None],
    tell: Tell,
) -> None:
    """Pass a job's messages through its own feed, close the feed, and count the fates of returns."""
    for placed in placed_points(plan, job, result, feed, tell):
        write(placed)


def placed_points(
    plan: JobPlan, job: Job, result: JobResult, feed: LogFeed, tell: Tell = lambda size: None
) -> Iterator[list[tuple[str, Points]]]:
    """Yield a job's points as they are placed, with their scanner's names; at the end, count the fates of returns."""
    stream = feed.stream
    undecoded = Undecoded({name: feed.parser(f"scanner/{name}") for name in stream.scanners})
    was_own = False
    for batch, own in _messages(plan, job, result, tell):
        if own is not was_own:
            feed.flush()  # units are decoded and counted as own or context, as when they came
            undecoded.note(own=was_own)
            was_own = own
        yield feed.take(batch, context=not own)
    yield feed.close()
    undecoded.note(own=was_own)
    result.undecoded = undecoded.counts
    for name in stream.scanners:
        fates = stream.fates(name)
        result.fates[name] = Counter({fate.name.lower(): count for fate, count in fates.items()})
        result.points += fates.get(Fate.GEOREFERENCED, 0)
        result.time_refused[name] = stream.clocks.refused(f"scanner/{name}")


def _sink(plan: SessionPlan, job: Job, stream: BinaryIO, opened: ExitStack) -> PointSink:
    if not plan.copc:
        return LasWriter(stream, plan.las, job.segment.strip)
    assert job.path is not None
    folder = job.path.parent
    spools = (
        opened.enter_context(tempfile.TemporaryFile(dir=folder)),
        opened.enter_context(tempfile.TemporaryFile(dir=folder)),
    )
    return CopcWriter(stream, spools, plan.las, job.segment.strip)


def _note_span(result: JobResult, points: Points) -> None:
    columns = points.points_map.T  # one by one: all at once takes ten times as long
    least, largest = np.array([column.min() for column in columns]), np.array([column.max() for column in columns])
    first, last = int(points.time_ns.min()), int(points.time_ns.max())
    if result.first_gps_ns is not None and result.last_gps_ns is not None:
        least, largest = np.minimum(least, result.bounds[0]), np.maximum(largest, result.bounds[1])
        first, last = min(first, result.first_gps_ns), max(last, result.last_gps_ns)
    result.first_gps_ns, result.last_gps_ns = first, last
    result.bounds = [least.tolist(), largest.tolist()]


def _note_edge(result: JobResult, name: str, points: Points, setup: Setup, trajectory: Trajectory) -> None:
    """Note the sampled point that is farthest from nadir, as seen from the body."""
    assert setup.mapping is not None
    some = points.take(slice(None, None, max(1, len(points) // EDGE_SAMPLES)))
    some = some.take(trajectory.fates(some.time_ns) == Fate.GEOREFERENCED)
    if not len(some):
        return
    ground_e = setup.mapping.e_from_map(some.points_map)
    beam_e = ground_e - trajectory.poses(some.time_ns).position_e
    lat, lon, height_m = geodetic_from_e(ground_e)
    down_e = -np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    above_m = (beam_e * down_e).sum(axis=1)
    angle = np.arccos(above_m / np.linalg.norm(beam_e, axis=1))
    angle[angle > MAX_EDGE_RAD] = 0.0
    at = int(np.argmax(angle))
    if angle[at] > result.edges.get(name, (0.0,))[0]:
        result.edges[name] = (float(angle[at]), float(above_m[at]), float(height_m[at]))


def _count(plan: SessionPlan, job: Job, result: JobResult, tell: Tell) -> None:
    """Count returns between strips: they are decoded, but not georeferenced."""
    parsers = plan.setup.sources.parsers(("scanner",))
    counts = dict.fromkeys(parsers, 0)
    start_ns, end_ns = job.segment.start_ns, job.segment.end_ns

    def count(source: str, records: Sequence[object]) -> None:
        for record in records:
            if isinstance(record, ScannerReturns):
                host_ns = record.rows["host_time_ns"]
                counts[source] += int(np.count_nonzero((host_ns >= start_ns) & (host_ns < end_ns)))

    undecoded = Undecoded({source.removeprefix("scanner/"): parser for source, parser in parsers.items()})
    for batch, own in _messages(plan, job, result, tell):
        wire = source_of_topic(batch.channel.topic) or ""
        source = wire.removesuffix("/aux")
        if source in parsers:
            count(source, parsers[source].feed_batch(ChunkBatch(wire, batch.log_time_ns, batch.units)))
        undecoded.note(own=own)
    result.undecoded = undecoded.counts
    for source, parser in parsers.items():
        count(source, parser.close())
        result.fates[source.removeprefix("scanner/")] = Counter({BETWEEN_STRIPS: counts[source]})


def _messages(plan: JobPlan, job: Job, result: JobResult, tell: Tell) -> Iterator[tuple[LogBatch, bool]]:
    """Yield messages of the job's chunks in the order of the file, each with whether it is the job's own or of the
    margin.
    """
    start_ns, end_ns = job.segment.start_ns, job.segment.end_ns
    own_damage: list[PartDamage] = []
    for place in job.places:
        mine = place.start_ns < end_ns and place.end_ns >= start_ns
        damage = own_damage if mine else []
        for batch in read_chunks(plan.index, [place], lambda topic: topic.startswith(SCANNER), damage):
            yield from _runs(batch, start_ns, end_ns)
        tell(place.length)
    result.damage = own_damage


def _runs(batch: LogBatch, start_ns: int, end_ns: int) -> Iterator[tuple[LogBatch, bool]]:
    """Yield a batch in runs of messages inside and outside the span."""
    own = (batch.log_time_ns >= start_ns) & (batch.log_time_ns < end_ns)
    changes = np.flatnonzero(np.diff(own)) + 1
    for first, last in pairwise([0, *changes.tolist(), len(own)]):
        yield batch.between(first, last), bool(own[first])
