"""Reads strips to be compared from products of `swath georef`, other LAS or LAZ files, or logs, into one form.

The quick look, which is read for maps, tells where strips overlap; the returns there are read in a second pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.flight import Flight, Tangent
from swath.calib.strips.cells import (
    Cells,
    FlightStrip,
    Gathered,
    StripBlock,
    StripRules,
    blocks_of,
    gather,
    overlap_cells,
    thinned,
)
from swath.calib.strips.effects import SeenFrom
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.carried_verdict import Carried
from swath.daemon.processing.pages.head import NOTHING_KNOWN, PageHead
from swath.daemon.processing.point_times import PointClock
from swath.daemon.processing.quicklook.grids import Surface, cell_for, frame_of
from swath.daemon.processing.quicklook.point_files import UNREADABLE, PointReader, Selection
from swath.daemon.processing.quicklook.read import NOISE_CLASSES, QuickLookError, StripBook, Units
from swath.daemon.processing.quicklook.run import Look, StripFacts, look_at
from swath.daemon.processing.quicklook.strips import FEWEST_RETURNS, TILE
from swath.daemon.processing.strip_agreement import compare_flight, corners_of
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.formats.trajectory.columns import LATEST_NS
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.mapping.frame import Mapping, MappingError
from swath.georef.progress import Tell, silent
from swath.georef.timescales.gps_time import WEEK_NS
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError, gps_text

BLOCK_POINTS = 500_000
TRAJECTORY = "_trajectory.csv"
WANTED = Selection.XY_RETURNS_CHANNEL | Selection.Z | Selection.CLASSIFICATION | Selection.FLAGS
WANTED |= Selection.POINT_SOURCE_ID | Selection.GPS_TIME


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips as they were read for a comparison.

    Attributes:
        what: folder or log, for people.
        look: their quick look, for maps and gridded differences.
        gathered: returns in cells of the overlap, in t if it is known, otherwise in metres of the map.
        cell_m: side of these cells.
        seen: where the strips were seen from; None: no trajectory is known.
        prior: joint covariance of the trajectory's errors; None: it is not known.
        notes: what the user should know.
        carried: verdicts on inputs of the points, other than good.
        head: head of their page.
    """

    what: str
    look: Look
    gathered: Gathered
    cell_m: float
    seen: SeenFrom | None
    prior: TrajectoryPrior | None = None
    notes: list[str] = field(default_factory=list)
    carried: list[Carried] = field(default_factory=list)
    head: PageHead = NOTHING_KNOWN


def strips_of_files(paths: Sequence[Path], rules: StripRules, told: Tell, week: int | None = None) -> Strips:
    """Return the strips in LAS or LAZ files and folders.

    Args:
        paths: files and folders.
        rules: rules of the comparison.
        told: called with the progress.
        week: GPS week of times that have none; None: that of the trajectory beside the points.

    Raises:
        UserError: the files cannot be read, or hold one strip only.
    """
    what = ", ".join(map(str, paths))
    if week is not None and week > LATEST_NS // WEEK_NS:
        raise UserError(f"--week {week} is not a GPS week; give whole weeks since 1980, such as 2423", ExitCode.USAGE)
    try:
        look = look_at(paths, strip_cell_m=rules.cell_m, told=told)
    except QuickLookError as error:
        raise UserError(str(error), ExitCode.IO) from error
    notes = list(look.notes)
    refuse_one(what, look)
    cells = cells_of(look, rules)
    seen, place, trouble = None, None, "the points have no trajectory beside them; give a folder of swath georef"
    try:
        seen, place = _seen_from(look)
    except (TrajectoryError, MappingError, OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        trouble = str(error)
    clock = PointClock([source.times for source in look.sources], week, None if seen is None else _middle_ns(seen))
    notes += clock.notes
    told("points of the cells", 0, 0)
    gathered = gather(_file_blocks(look, clock), cells)
    if seen is None or place is None:
        notes.append(f"{what}: no signatures: {trouble}")
        return Strips(what, look, gathered, cells.cell_m, None, notes=notes)
    notes += _times_apart(gathered, seen)
    return Strips(what, look, replace(gathered, points=place(gathered.points)), cells.cell_m, seen, notes=notes)


def strips_of_flight(
    what: str,
    flight: Flight,
    rules: StripRules,
    mapping: Mapping | None = None,
    prior: TrajectoryPrior | None = None,
    told: Tell = silent,
) -> Strips:
    """Return the strips of a flight, as its points are placed.

    Args:
        what: the logs, for people.
        flight: a flight whose points are in t.
        rules: rules of the comparison.
        mapping: settled mapping of the products: cells for heights are those of their files; None: cells lie in t.
        prior: joint covariance of the trajectory's errors; None: it is not known.
        told: called with the progress.

    Raises:
        UserError: there is one strip only.
    """
    look = look_of_flight(flight, rules, mapping, told)
    refuse_one(what, look)
    told("points of the cells", 0, 0)
    strips = [FlightStrip(swath) for swath in flight.swaths]
    cells = overlap_cells(strips, replace(rules, cell_m=look.cells.frame.cell_m))
    return Strips(what, look, gather(blocks_of(strips), cells), cells.cell_m, SeenFrom.of(flight), prior)


def refuse_one(what: str, look: Look) -> None:
    """Refuse with `UserError` inputs that have no two different, overlapping strips."""
    if len(look.names) < 2:
        raise UserError(f"{what}: has one strip only; differences need at least two strips that overlap")
    if not look.overlap.cells:
        raise UserError(
            f"{what}: no two of the {len(look.names)} strips share smooth ground; differences need strips that overlap"
        )
    for row in look.overlap.rows:
        if row["max_m"] == 0.0:
            names = look.names[row["first"]], look.names[row["second"]]
            raise UserError(
                f"{what}: strips {names[0]} and {names[1]} contain the same returns under two names; give one of them"
            )


def cells_of(look: Look, rules: StripRules) -> Cells:
    """Return cells of the quick look in which two or more strips have enough returns."""
    cells = look.cells
    found = []
    for strip in range(len(cells.tiles)):
        up, across = np.nonzero(cells.tiles[strip] >= 0)
        tile, inside = np.nonzero(cells.moments[cells.tiles[strip, up, across], :, 1] >= FEWEST_RETURNS)
        row, column = up[tile] * TILE + inside // TILE, across[tile] * TILE + inside % TILE
        found.append((row.astype(np.int64) << 32) + column)
    numbers, strips = np.unique(np.concatenate([*found, np.zeros(0, np.int64)]), return_counts=True)
    origin = (cells.frame.west_m, cells.frame.south_m)
    return thinned(Cells(cells.frame.cell_m, numbers[strips > 1], origin), rules)


# ---------------------------------------------------------------------- files


def _file_blocks(look: Look, clock: PointClock) -> Iterator[tuple[int, StripBlock]]:
    """Yield blocks by strip, numbered as in the quick look, which read the same files in the same order."""
    book = StripBook()
    for source in look.sources:
        try:
            with PointReader(source.path, WANTED) as reader:
                while len(points := reader.read(BLOCK_POINTS)):
                    strip = book.numbers(source, np.asarray(points["point_source_id"]))
                    yield from _by_strip(points, strip, _time_ns(points, source.path, clock), look)
        except UNREADABLE:
            continue  # the quick look has already noted the damage


def _time_ns(points: Any, path: Path, clock: PointClock) -> Int64Array:
    """Return GPS times (n,) of a file's points; 0 if the file has no times."""
    if "gps_time" not in points.point_format.dimension_names:
        return np.zeros(len(points), np.int64)
    return clock.time_ns(path, np.asarray(points["gps_time"], np.float64))


def _by_strip(
    points: Any, strip: NDArray[np.int32], time_ns: Int64Array, look: Look
) -> Iterator[tuple[int, StripBlock]]:
    good = ~np.isin(np.asarray(points["classification"]), NOISE_CLASSES) & (np.asarray(points["withheld"]) == 0)
    units = look.units
    places = np.stack([points.x * units.east_m, points.y * units.north_m, points.z * units.up_m], axis=1)
    flag = np.asarray(points["scan_direction_flag"])
    direction = (2 * flag.astype(np.int8) - 1) * np.int8(flag.any() and not flag.all())
    single = np.asarray(points["number_of_returns"]) <= 1
    for number in np.unique(strip[good]):
        own = good & (strip == number)
        yield int(number), StripBlock(np.asarray(places[own]), time_ns[own], single[own], direction[own])


def _middle_ns(seen: SeenFrom) -> int | None:
    """Return the middle of the flight by its trajectories; None if they span half a week or more."""
    begin = min(trajectory.span[0] for trajectory in seen.trajectories)
    end = max(trajectory.span[1] for trajectory in seen.trajectories)
    return (begin + end) // 2 if end - begin < WEEK_NS // 2 else None


def _times_apart(strips: Gathered, seen: SeenFrom) -> list[str]:
    """Return a line if most returns have times outside their strips' trajectories."""
    outside = 0
    for number, trajectory_number in enumerate(seen.trajectory_index):
        begin, end = seen.trajectories[trajectory_number].span
        times = strips.time_ns[strips.strip == number]
        outside += int(((times < begin) | (times > end)).sum())
    if 2 * outside <= len(strips.time_ns):
        return []
    spans = [
        f"{gps_text(int(begin))} to {gps_text(int(end))}"
        for begin, end in (
            (strips.time_ns.min(), strips.time_ns.max()),
            (min(one.span[0] for one in seen.trajectories), max(one.span[1] for one in seen.trajectories)),
        )
    ]
    share = 100.0 * outside / len(strips.time_ns)
    return [
        f"{share:.0f} % of the points lie at other times, {spans[0]}, than the trajectory beside them, {spans[1]}, so "
        "the differences have no signatures; correct the GPS time type in the header, or give --week"
    ]


def _seen_from(look: Look) -> tuple[SeenFrom | None, Callable[[FloatArray], FloatArray]]:
    """Return the trajectories beside the points, and a function from the map's metres to t."""
    sidecars = [source.sidecar for source in look.sources]
    trajectories = trajectories_beside(look)
    of_session = [trajectory.name for trajectory in trajectories]
    if not trajectories or not all(sidecars):
        return None, lambda points: points
    mapping = mapping_of(sidecars[0]["crs"])
    middle = trajectories[0].position_e[len(trajectories[0]) // 2]
    mapping.settle(middle[np.newaxis])
    frame = Tangent.at(middle)
    unit_m = np.array([look.units.east_m, look.units.north_m, look.units.up_m])

    def place(points: FloatArray) -> FloatArray:
        return frame.t_from_e(mapping.e_from_map(points / unit_m)) if len(points) else points

    trajectory_numbers = [_flown(look, number, trajectories, of_session) for number in range(len(look.names))]
    # the files' scan directions refer to the body's right and left, whatever the mounting
    mounted = [np.eye(3)] * len(look.names)
    return SeenFrom(frame, trajectories, trajectory_numbers, [1.0] * len(look.names), mounted), place


def mapping_of(crs: dict[str, Any]) -> Mapping:
    """Return the mapping frame of a sidecar's points, with the datum given on the command line or
    in the configuration.
    """
    if "datum_said" not in crs or "accuracy_wanted_m" not in crs:
        raise MappingError("the sidecar beside the points does not give their datum; run swath georef again")
    return Mapping(crs["crs"], datum=crs["datum_said"], epoch=crs.get("epoch"), accuracy_m=crs["accuracy_wanted_m"])


def trajectories_beside(look: Look) -> list[Trajectory]:
    """Return the trajectories beside the points, named after their sessions."""
    folders = {source.path.parent for source in look.sources}
    files = sorted(file for folder in folders for file in folder.glob(f"*{TRAJECTORY}"))
    read = [(read_trajectory(file.read_bytes(), str(file)), file.name.removesuffix(TRAJECTORY)) for file in files]
    return [replace(trajectory, name=session) for trajectory, session in read]


def _flown(look: Look, number: int, trajectories: Sequence[Trajectory], of_session: Sequence[str]) -> int:
    """Return the index of a strip's trajectory: among those of its run's sessions, the one that covers its time in the
    sidecar.
    """
    sessions, source_id = look.origins[number]
    own = [at for at, session in enumerate(of_session) if session in sessions] or list(range(len(trajectories)))
    for source in look.sources:
        for entry in source.sidecar.get("strips", []) if source.sessions == sessions else []:
            if str(entry.get("number")) == str(source_id) and entry.get("first_gps_ns"):
                for at in own:
                    begin, end = trajectories[at].span
                    if begin <= entry["first_gps_ns"] <= end:
                        return at
    return own[0]


# ---------------------------------------------------------------------- a flight


def look_of_flight(flight: Flight, rules: StripRules, mapping: Mapping | None = None, told: Tell = silent) -> Look:
    """Return a quick look at a flight's points, on the map of its products or in t."""
    corners = low, high = corners_of(flight, mapping)
    area_m2 = max(float(np.prod((high - low)[:2])), 1.0)
    density = max((len(swath) for swath in flight.swaths), default=1) / area_m2
    surface = Surface(frame_of(low, high, float(np.clip(cell_for(density, 4), 0.25, 50.0))))
    strips = compare_flight(flight, mapping, cell_m=rules.cell_m, corners=corners, also=surface.add, tell=told)
    agreement, names = strips.agreement, list(strips.names)
    facts = [StripFacts(swath.name, len(swath), len(swath), 0.0, density, 0.0, None, None) for swath in flight.swaths]
    numbers = agreement.pulses_m2, agreement.area_m2
    return Look([], Units(), names, surface, strips.cells, strips.overlap, agreement, facts, None, *numbers, 0, [])
