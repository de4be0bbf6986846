"""Computes the verdict before landing while a recording is processed, and writes ``verdict.json``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.log.format import SessionInfo, source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.processing.flightplan.judge import LineVerdict
from swath.daemon.processing.flightplan.plan import FlightPlan
from swath.daemon.processing.flightplan.strips import StripWatch
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.daemon.processing.landing.checks import (
    Check,
    Covered,
    FoundGap,
    base_check,
    calibration_check,
    density_check,
    gaps_check,
    lines_check,
    log_check,
    overlap_check,
    sentence,
    static_check,
)
from swath.daemon.processing.landing.command import VERDICT, VERSION
from swath.daemon.processing.landing.facts import LogFacts
from swath.daemon.processing.landing.gaps import Gap, Ground, Painted, between, densities, gaps_of, inside, joined_cells
from swath.daemon.processing.landing.tracks import pairs_of, tracks_of
from swath.daemon.processing.live.files import replace_file
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.timescales.gps_time import SECOND_NS

EVERY_NS = 30 * SECOND_NS  # of log time; a mark and the end of the log do not wait for it
MOST_GAPS = 100  # whose place is looked at
UNDER_SHARE = 0.9  # of a gap that one or several swaths have covered

Local = Callable[[FloatArray], FloatArray]  # east and north (n, 2) of latitudes and longitudes (n, 2), degrees


@dataclass(frozen=True, slots=True)
class Places:
    """Conversions between the map's frame and the earth.

    Attributes:
        local_m: gives east and north (n, 2) of latitudes and longitudes (n, 2), degrees.
        geodetic_deg: the other way round; None: not known.
    """

    local_m: Local
    geodetic_deg: Local | None


class Outline:
    """The area of a plan on the map; which cells lie inside is kept as long as the cells stay."""

    def __init__(self, plan: FlightPlan | None, places: Places) -> None:
        """Place an area; a plan without one has none.

        Raises:
            ValueError: the mapping frame has no place for it.
        """
        area = () if plan is None else plan.area
        self.polygons = [[places.local_m(ring) for ring in rings] for rings in area]
        self._key: tuple[float, ...] = ()
        self._inside: BoolArray = np.zeros((0, 0), np.bool_)

    def edges_m(self) -> FloatArray:
        """Return west, south, east, north (4,)."""
        corners = np.concatenate([ring for rings in self.polygons for ring in rings])
        edges: FloatArray = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        return edges

    def wanted(self, ground: Ground) -> BoolArray:
        """Return the cells (rows, columns) that should have points; without an area, those between points."""
        if not self.polygons:
            return between(ground)
        key = ground.west_m, ground.south_m, ground.cell_m, *ground.covered.shape
        if key != self._key:
            self._key, self._inside = key, inside(ground, self.polygons)
        return self._inside


def covered_of(
    painted: Painted, watch: LineWatch | StripWatch, outline: Outline, places: Places, least_m2: float
) -> Covered | None:
    """Return how the area is covered; None: there is no point yet, and no area.

    Args:
        painted: cells of the map.
        watch: the lines and their swaths.
        outline: the area.
        places: of the map's frame.
        least_m2: smaller gaps are not looked for.
    """
    edges_m = outline.edges_m() if outline.polygons else painted.edges_m()
    if edges_m is None or not painted.has_points:
        return None
    if isinstance(watch, LineWatch):
        watch.refresh()
    ground = painted.ground(edges_m)
    wanted = outline.wanted(ground)
    gaps = gaps_of(ground, wanted, least_m2)
    waters = joined_cells(ground, wanted & ground.water, least_m2)
    cell_m2 = ground.cell_m**2
    return Covered(
        bool(outline.polygons),
        float(wanted.sum()) * cell_m2,
        float((wanted & ground.covered).sum()) * cell_m2,
        ground.cell_m,
        tuple(_found(number + 1, gap, watch, places) for number, gap in enumerate(gaps[:MOST_GAPS])),
        max(0, len(gaps) - MOST_GAPS),
        float((wanted & ground.water).sum()) * cell_m2,
        tuple(_found(number + 1, gap, None, places) for number, gap in enumerate(waters[:MOST_GAPS])),
        densities(ground, wanted),
    )


def _found(number: int, gap: Gap, watch: LineWatch | StripWatch | None, places: Places) -> FoundGap:
    """Return what is known of a gap; without a watch, of water."""
    lat_lon = None if places.geodetic_deg is None else places.geodetic_deg(gap.place_m[np.newaxis])[0].tolist()
    line, under = "", list[str]()
    if isinstance(watch, LineWatch) and places.geodetic_deg is not None:
        line, under = _lines_at(watch, places.geodetic_deg(gap.place_m[np.newaxis]), places.geodetic_deg(gap.sample_m))
    east_m, north_m = gap.place_m.round(1).tolist()
    lat, lon = (None, None) if lat_lon is None else (round(value, 7) for value in lat_lon)
    return FoundGap(
        number,
        east_m,
        north_m,
        lat,
        lon,
        round(gap.area_m2, 1),
        round(gap.width_m, 1),
        round(gap.length_m, 1),
        line,
        tuple(under),
        water=watch is None,
    )


def _lines_at(watch: LineWatch, place_deg: FloatArray, sample_deg: FloatArray) -> tuple[str, list[str]]:
    """Return the line that would close a gap, and the lines whose swaths have covered it nearly whole.

    The former is the nearest line that has to be flown anyway, if such lines cover the gap; otherwise the nearest one.

    Args:
        watch: the lines.
        place_deg, sample_deg: latitudes and longitudes of the gap's place (1, 2), and of a sample of it (n, 2).
    """
    here, at = (watch.geometry.places(*np.radians(places).T) for places in (place_deg, sample_deg))
    verdicts = [line.verdict for line in watch.lines]
    swept = [
        _swept(verdict, at.along_m[:, number], at.across_m[:, number])
        for number, verdict in enumerate(verdicts)
        if verdict is not None
    ]
    flown = [number for number, verdict in enumerate(verdicts) if verdict is not None]
    distance_m = here.distance_m[0].copy()
    due = np.array([line.is_open or line.state in ("planned", "again") for line in watch.lines])
    half_m = _half_m([verdict for verdict in verdicts if verdict is not None])
    reached = (at.along_m >= 0.0) & (at.along_m <= watch.geometry.length_m) & (np.abs(at.across_m) <= half_m)
    if float((reached & due).any(axis=1).mean()) >= UNDER_SHARE:
        distance_m[~due] = np.inf
    nearest = watch.lines[int(np.argmin(distance_m))].name
    if not swept or float(np.any(swept, axis=0).mean()) < UNDER_SHARE:
        return nearest, []
    return nearest, [watch.lines[number].name for number, seen in zip(flown, swept, strict=True) if seen.any()]


def _half_m(verdicts: Sequence[LineVerdict]) -> float:
    """Return half the width of a swath, of all lines that were flown; 0 if none was."""
    widths = np.concatenate([np.zeros(0), *(one.right_m - one.left_m for one in verdicts)])
    widths = widths[~np.isnan(widths)]
    return float(np.median(widths)) / 2.0 if len(widths) else 0.0


def _swept(verdict: LineVerdict, along_m: FloatArray, across_m: FloatArray) -> BoolArray:
    """Return which places (n,) beside a line its swath has covered with the laser on."""
    cell = np.floor(along_m / verdict.cell_m).astype(np.int64)
    on = (cell >= 0) & (cell < len(verdict.flown))
    cell = np.where(on, cell, 0)
    on &= verdict.flown[cell]
    found: BoolArray = on & (across_m >= verdict.left_m[cell]) & (across_m <= verdict.right_m[cell])
    return found


class Landing:
    """Keeps the verdict of one recording.

    Args:
        info: of the recording.
        folder: where ``verdict.json`` goes.
        config: table ``[plan]``.
        corrections: names of ``[corrections.*]``.
        calibration: entry of the verdict on the calibrations in use.
        head: for the page's head: ``aircraft``, ``author``, ``crs``, ``calibrations``.

    Attributes:
        facts: of the log.
    """

    def __init__(
        self,
        info: SessionInfo,
        folder: Path,
        config: PlanConfig,
        corrections: Sequence[str],
        calibration: Mapping[str, Any],
        head: Mapping[str, Any] | None = None,
    ) -> None:
        self.facts = LogFacts(info.realtime_ns)
        self._info, self._path, self._config = info, folder / VERDICT, config
        self._corrections, self._calibration = list(corrections), calibration
        self._head = dict(head or {})
        self._painted = Painted()
        self._outline: Outline | None = None
        self._saved_ns = -(1 << 62)
        self._marked_ns: int | None = None

    def note_batch(self, batch: LogBatch) -> None:
        """Note messages of any topic."""
        topic = batch.channel.topic
        source = source_of_topic(topic)
        if source is not None:
            self.facts.units(source, batch.log_time_ns)
        elif topic == "/events":
            for time_ns, event in json_objects(batch):
                self.facts.event(time_ns, event)
        elif topic.startswith("/status/"):
            for time_ns, status in json_objects(batch):
                self.facts.status(topic.removeprefix("/status/"), time_ns, status)

    @property
    def is_asked(self) -> bool:
        """True if the operator has asked for the verdict by a mark since it was last written."""
        return self.facts.marked_ns != self._marked_ns

    def is_due(self, log_time_ns: int) -> bool:
        """Return whether the verdict is to be written: by now and then, or because the operator asks."""
        return log_time_ns >= self._saved_ns + EVERY_NS or self.is_asked

    def verdict(
        self,
        watch: LineWatch | StripWatch,
        plan: FlightPlan | None,
        trouble: str,
        covered: Covered | None,
        differences: Mapping[str, Any],
        follower: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Return the verdict as plain values.

        Args:
            watch: the lines.
            plan: None: there is none.
            trouble: why there is none although one is configured; empty: it is used, or none is.
            covered: how the area is covered.
            differences: figures of all strips' height differences, as in ``coverage.json``.
            follower: what live knows of the log: ``part``, ``damaged_chunks``, ``live_skipped_s``.
        """
        lines, wanted, facts = watch.plain(), self._config.wanted, self.facts
        track = facts.track
        pairs = watch.overlap_pairs() if isinstance(watch, LineWatch) else []
        checks = [
            lines_check(lines, trouble),
            gaps_check(lines, covered, wanted.gap_m2),
            density_check(lines, wanted, covered),
            overlap_check(lines, wanted, differences, pairs),
            calibration_check(pairs_of(tracks_of(track)), self._calibration),
            base_check(facts, self._corrections),
            static_check(facts, wanted.static_s),
            log_check(facts, follower),
        ]
        state, said = sentence(lines, checks, covered)
        return {
            "version": VERSION,
            "session_id": self._info.session_id,
            "plan": lines["plan"],
            "head": self._head,
            "log_time_ns": facts.newest_ns,
            "flown_gps_ns": [int(track["gps_ns"][0]), int(track["gps_ns"][-1])] if len(track) else None,
            "has_ended": facts.has_ended,
            "state": state,
            "sentence": said,
            "checks": [_plain(check) for check in checks],
            "area": _plain_area(covered),
            "overlaps": {
                "wanted_percent": wanted.overlap_percent,
                "pairs": [
                    {"lines": [one.first, one.second], "least_percent": round(100.0 * one.least, 1)} for one in pairs
                ],
            },
            "lines": [
                {"name": line["name"], "state": line["state"], "flown_fraction": line["flown_fraction"]}
                | {"why": [reason["text"] for reason in line["reasons"]], "overruled": line["overruled"]}
                for line in lines["lines"]
            ],
        }

    def look(
        self,
        cells: tuple[float, Any],
        watch: LineWatch | StripWatch,
        plan: FlightPlan | None,
        places: Places | None,
    ) -> Covered | None:
        """Return how the area is covered now.

        Args:
            cells: side of the map's cells, and its tiles that have changed.
            watch, plan: the lines.
            places: of the map's frame; None: there is none yet.

        Raises:
            ValueError: the mapping frame has no place for the area.
        """
        self._painted.take(*cells)
        if places is None:
            return None
        if self._outline is None:  # the map's frame never changes
            self._outline = Outline(plan, places)
        return covered_of(self._painted, watch, self._outline, places, self._config.wanted.gap_m2)

    def save_flown(self) -> None:
        """Write what a prediction of the calibration needs.

        Raises:
            OSError: it cannot be written.
        """
        self.facts.flown.save(self._path.parent, tracks_of(self.facts.track))

    def save(self, found: Mapping[str, Any], log_time_ns: int) -> None:
        """Replace the file ``verdict.json``.

        Raises:
            OSError: it cannot be written.
        """
        self._saved_ns, self._marked_ns = log_time_ns, self.facts.marked_ns
        replace_file(self._path, (json.dumps(found) + "\n").encode())


def _plain(check: Check) -> dict[str, Any]:
    return asdict(check) | {"details": list(check.details)}


def _plain_area(covered: Covered | None) -> dict[str, Any] | None:
    if covered is None:
        return None
    values = covered.densities
    return {
        "planned": covered.has_area,
        "wanted_m2": round(covered.wanted_m2, 1),
        "covered_m2": round(covered.covered_m2, 1),
        "cell_m": covered.cell_m,
        "density_per_m2": None
        if not len(values)
        else dict(zip(("p05", "p50"), np.quantile(values, [0.05, 0.5]).round(2).tolist(), strict=True)),
        "gaps": [gap.plain() for gap in covered.gaps],
        "more_gaps": covered.more,
        "water_m2": round(covered.water_m2, 1),
        "waters": [one.plain() for one in covered.waters],
    }
