"""Prepares a log for navigation: increments of the IMU in b, observations, setup; and accounts for refused data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.navigation.input_checks import (
    TIME_IS_KNOWN_S,
    height_findings,
    input_doubts,
    no_time,
    refuse_elsewhere,
    refuse_nothing,
)
from swath.daemon.processing.navigation.log import NavigationLog, read_navigation_log, session_holes
from swath.daemon.processing.navigation.observations import (
    Observed,
    fix_observations,
    gps_times,
    heading_observations,
    heading_times,
    ins_observations,
    joined,
)
from swath.daemon.processing.navigation.outside_positions import (
    OutsidePositions,
    outside_observations,
    refuse_shifted,
    refuse_unreadable,
)
from swath.daemon.processing.navigation.sources import NavigationSources, config_of_log, files_of
from swath.daemon.processing.navigation.times import LEAST_HOLE_S, ImuTimes, Stretch, imu_times, stretches
from swath.daemon.processing.points.time_checks import refuse_no_time
from swath.georef.arrays import StructArray
from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.filter.stores import IN_MEMORY, Storage
from swath.georef.navigation.inputs import Inertial, Kind, NavigationError, Setup
from swath.georef.navigation.samples import Sampler
from swath.georef.records import EventMark, GnssFix, GnssHeading, TimeTag
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.buffer import SOLUTION_STATUS

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.daemon.log.reader import Session

ROWS_AT_ONCE = 1 << 16
MIN_LEG_S = 10.0  # shorter pieces between gaps of the IMU are not navigated
LEG_MARGIN_NS = SECOND_NS
INS_USES = ("ignore", "observe", "as-is")


@dataclass(frozen=True, slots=True)
class Mark:
    """An event mark and its time; None: it could not be placed."""

    source: str
    event: EventMark
    gps_ns: int | None


@dataclass(frozen=True, eq=False)
class Leg:
    """A piece of a session without a gap of the IMU that is too long to be bridged."""

    inertial: Inertial
    observations: StructArray

    @property
    def span(self) -> tuple[int, int]:
        """GPS ns of its first and last sample."""
        return int(self.inertial.time_ns[0]), int(self.inertial.time_ns[-1])


@dataclass(frozen=True, eq=False)
class NavigationInputs:
    """The inputs of navigation from a session.

    Attributes:
        legs: pieces to be navigated one by one, in order.
        setup: setup of the filter.
        ins: solutions of the device's own INS, `INS_DTYPE`, attitude of b.
        marks: event marks of all receivers.
        imu_time: source of the times of the IMU's samples, see `ImuTimes`, and their usual sigma, s.
        samples: number of the IMU's samples by fate.
        observed: number of observations by kind (lower case).
        refused: number of fixes, headings and solutions that gave no observation, by kind and reason.
        assumed: number of observations with default sigmas, by kind.
        warnings: lines for the user; holes: missing data, one line each.
        missing: stretches of samples longer than `LEAST_HOLE_S` that no leg holds; each is a hole too.
        findings: errors that the receiver's messages themselves show, for the verdict.
    """

    session: Session
    sources: NavigationSources
    legs: list[Leg]
    setup: Setup
    ins: StructArray
    marks: list[Mark]
    imu_time: tuple[str, float]
    samples: Counter[str]
    observed: Counter[str]
    refused: Counter[str]
    assumed: Counter[str]
    counts: dict[str, Counter[str]]
    warnings: list[str] = field(default_factory=list)
    holes: list[str] = field(default_factory=list)
    missing: list[Stretch] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def log(self) -> Path:
        """The session's first part, which names the log in messages."""
        return self.session.parts[0].path


@dataclass(frozen=True, slots=True)
class InputOptions:
    """The options for the inputs from the command line.

    Attributes:
        imu, gnss: names; None: the first of each.
        config: configuration instead of the log's own.
        positions: file of an antenna's positions instead of the receiver's; None: the receiver's.
        week: GPS week of such a file without one.
        arm_b: x, y, z from the body's origin to its antenna, m; None: the receiver's in the configuration.
        ins: ``observe``: also use the attitude of the device's own INS; ``ignore``: do not.
    """

    imu: str | None = None
    gnss: str | None = None
    config: Config | None = None
    positions: Path | None = None
    week: int | None = None
    arm_b: tuple[float, float, float] | None = None
    ins: str = "ignore"


def read_inputs(session: Session, request: InputOptions, storage: Storage = IN_MEMORY) -> NavigationInputs:
    """Read a session's inputs of navigation; its samples are kept in the storage.

    Raises:
        UserError: the session cannot be navigated; one line per reason.
        LogError, OSError: the log cannot be read.
    """
    log = session.parts[0].path
    if request.positions is not None:
        refuse_unreadable(request.positions)
    sources = _sources(session, request)
    found = read_navigation_log(session, sources)
    refuse_nothing(found, sources, log, outside=request.positions is not None)
    times = imu_times(found.imu, found.host, sources.clock, sources.imu.rate_hz)
    if not len(times.gps_ns):
        raise UserError(no_time(found, sources, log))
    if times.by != "gps" and sources.clock is not None:
        last_ns = int(found.imu["host_time_ns"][-1])
        refuse_no_time(log, sources.clock, found.host.status(sources.clock, last_ns), sources.config)
    inertial, sampler = _sampled(times, sources, storage)
    placed = _Placed(found, sources)
    outside = None if request.positions is None else _outside(request.positions, request.week, inertial, placed)
    parts = placed.observations(outside, use_ins=request.ins == "observe")
    observations = joined(list(parts.values()))
    refuse_elsewhere(inertial, observations, sources, request.positions, log)
    legs, short = legs_of(inertial, observations)
    warnings = input_doubts(found, sources, times, parts, log)
    missing = _missing(times, sampler, short, sources.imu.rate_hz)
    holes = [*session_holes(session), *(f"{log}: {sources.imu_source}: {part.text}" for part in missing)]
    samples = sampler.counts + times.refused + Counter(taken=len(inertial))
    kinds = {int(kind): kind.name.lower() for kind in Kind}
    return NavigationInputs(
        session=session,
        sources=sources,
        legs=legs,
        setup=sources.setup(time_sigma_s=times.sigma_s if times.sigma_s > TIME_IS_KNOWN_S else 0.0),
        ins=found.ins,
        marks=placed.marks(),
        imu_time=(times.by, times.sigma_s),
        samples=+samples,
        observed=Counter(kinds[int(kind)] for kind in observations["kind"]),
        refused=Counter(
            {f"{name}_{why}": count for name, part in parts.items() for why, count in part.refused.items() if count}
        ),
        assumed=sum((part.assumed for part in parts.values()), Counter()),
        counts=found.counts,
        warnings=warnings,
        holes=holes,
        missing=missing,
        findings=height_findings(found, sources) if outside is None else [],
    )


def _sources(session: Session, request: InputOptions) -> NavigationSources:
    log = session.parts[0].path
    try:
        files = files_of(session, request.config)
        config, outside = request.config or config_of_log(files), request.positions is not None
        return NavigationSources(config, files, request.imu, request.gnss, outside=outside, arm_b=request.arm_b)
    except UserError as error:
        prefix = "" if request.config is not None or error.message.startswith("--") else f"{log}: "
        lines = [f"{prefix}{line}" for line in error.message.splitlines()]
        raise UserError("\n".join(lines), error.exit_code) from error


# ---------------------------------------------------------------------- samples


def _sampled(times: ImuTimes, sources: NavigationSources, storage: Storage) -> tuple[Inertial, Sampler]:
    """Return increments of all samples; gaps between them show in their times."""
    table = sources.imu
    try:
        sampler = Sampler(table.rate_hz, table.sample, table.stamp, sources.rot_b_from_imu)
    except NavigationError as error:
        raise UserError(f"imu.{sources.imu_name}: {error}", ExitCode.USAGE) from error
    pieces = [
        sampler.feed(times.rows[first : first + ROWS_AT_ONCE], times.gps_ns[first : first + ROWS_AT_ONCE])
        for first in range(0, len(times.gps_ns), ROWS_AT_ONCE)
    ]
    names = ("time_ns", "interval_s", "angle_b", "velocity_b", "bridged")
    columns = [
        storage.empty((sum(map(len, pieces)), *getattr(pieces[0], name).shape[1:]), getattr(pieces[0], name).dtype)
        for name in names
    ]
    for name, column in zip(names, columns, strict=True):
        np.concatenate([getattr(piece, name) for piece in pieces], out=column)
    return Inertial(*columns), sampler


def _missing(times: ImuTimes, sampler: Sampler, short: Sequence[Stretch], rate_hz: float) -> list[Stretch]:
    """Return the stretches of samples that no leg holds, by time; a gap left by unused samples is listed once."""
    rows = times.rows
    finite = np.isfinite(rows["specific_force_b"]).all(axis=1) & np.isfinite(rows["angular_rate_b"]).all(axis=1)
    stretches_without = [*times.discarded]
    stretches_without += stretches(
        rows["host_time_ns"], finite, times.gps_ns[finite], rate_hz, "samples that are not numbers"
    )
    gaps = [Stretch(begin, end, "no samples") for begin, end in sampler.gaps]
    gaps = [
        gap
        for gap in gaps
        if not any(
            min(gap.end_ns, one.end_ns) - max(gap.begin_ns, one.begin_ns) > 0.5 * (gap.end_ns - gap.begin_ns)
            for one in stretches_without
        )
    ]
    return sorted([*stretches_without, *_explained(gaps, sampler, rate_hz), *short], key=lambda part: part.begin_ns)


def _explained(gaps: Sequence[Stretch], sampler: Sampler, rate_hz: float) -> list[Stretch]:
    """Return the gaps, and runs of samples dropped for their stamps: each as the gap that it
    leaves, or by its stamps.
    """
    words = {
        "time_jumped_back": "samples whose time jumped back",
        "out_of_order": "samples out of order",
        "duplicate": "samples of a time that another had",
        "stamp_outlier": "samples whose time stands alone",
    }
    runs: list[list[tuple[int, int, str]]] = []
    for one in sampler.left_out:
        before = runs[-1][-1] if runs else (-1, -1, "")
        near = one[1] == before[1] or abs(one[0] - before[0]) < LEAST_HOLE_S * SECOND_NS
        if near and one[2] == before[2]:
            runs[-1].append(one)
        else:
            runs.append([one])
    left, found = {gap.begin_ns: gap for gap in gaps}, []
    for run in runs:
        (stamp_ns, after_ns, reason), length_s = run[0], len(run) / rate_hz
        if length_s <= LEAST_HOLE_S:
            continue
        gap = left.get(after_ns)
        if gap is not None and length_s > 0.5 * gap.seconds:
            found.append(replace(left.pop(after_ns), why=words[reason]))
        else:
            found.append(Stretch(stamp_ns, stamp_ns + round(length_s * SECOND_NS), words[reason]))
    return [*found, *left.values()]


def legs_of(inertial: Inertial, observations: StructArray) -> tuple[list[Leg], list[Stretch]]:
    """Return the pieces between gaps that are not bridged, with their observations; and pieces that are too short."""
    begins_ns = inertial.time_ns - np.rint(inertial.interval_s * SECOND_NS).astype(np.int64)
    apart = np.flatnonzero(begins_ns[1:] - inertial.time_ns[:-1] > inertial.interval_s[1:] * SECOND_NS / 2) + 1
    bounds = [0, *apart.tolist(), len(inertial)]
    legs: list[Leg] = []
    short: list[Stretch] = []
    for first, last in pairwise(bounds):
        piece = inertial.between(first, last)
        if len(piece) < 2 or piece.time_ns[-1] - piece.time_ns[0] < MIN_LEG_S * SECOND_NS:
            part = Stretch(
                int(piece.time_ns[0]), int(piece.time_ns[-1]), f"shorter than {MIN_LEG_S:.0f} s between gaps"
            )
            short += [part] if part.seconds > LEAST_HOLE_S else []
            continue
        inside = slice(
            int(np.searchsorted(observations["time_ns"], piece.time_ns[0] - LEG_MARGIN_NS)),
            int(np.searchsorted(observations["time_ns"], piece.time_ns[-1] + LEG_MARGIN_NS)),
        )
        legs.append(Leg(piece, observations[inside]))
    return legs, short


# ---------------------------------------------------------------------- observations


class _Placed:
    """A receiver's fixes, headings and marks in GPS time."""

    def __init__(self, found: NavigationLog, sources: NavigationSources) -> None:
        self.found, self.sources = found, sources
        source = sources.gnss_source
        self.fix_ns = gps_times(found.host, source, *_arrived(found.fixes))
        given = gps_times(found.host, source, *_arrived(found.headings))
        self.heading_ns = heading_times(found.headings, given, found.fixes, self.fix_ns)

    def observations(self, outside: OutsidePositions | None, *, use_ins: bool) -> dict[str, Observed]:
        """Return observations by source: fix, outside, heading, ins."""
        found, sources = self.found, self.sources
        setup = sources.setup()
        fixes = fix_observations(found.fixes, self.fix_ns, len(setup.lever_arms_b))
        parts = {"fix": fixes}
        if outside is not None:
            refuse_shifted(outside, fixes.rows)
            replaced = np.isin(fixes.rows["kind"], np.unique(outside.observed.rows["kind"]))
            fixes.refused["replaced_from_outside"] += int(replaced.sum())
            fixes.rows = fixes.rows[~replaced]
            parts["outside"] = outside.observed
        length_m = None if setup.baseline_b is None else float(np.linalg.norm(setup.baseline_b))
        parts["heading"] = heading_observations(found.headings, self.heading_ns, length_m)
        if use_ins:
            protocol = protocol_of(sources, sources.ins_source)
            parts["ins"] = ins_observations(found.ins, SOLUTION_STATUS.get(protocol))
        return parts

    def leap_seconds(self) -> int | None:
        """Return GPS − UTC as the receiver sent it; None if it is only a guess."""
        if self.sources.gnss_source is None:
            return None
        newest = max([int(self.found.imu["host_time_ns"][-1]), *(fix.host_time_ns for fix in self.found.fixes)])
        status = self.found.host.status(self.sources.gnss_source, newest)
        return status.leap_seconds if status.leap_origin != "guess" else None

    def marks(self) -> list[Mark]:
        """Return event marks of all receivers, by time of arrival."""
        marks: list[Mark] = []
        for source in sorted({source for source, _ in self.found.marks}):
            if source not in self.found.host.by_source:
                continue
            own = [event for name, event in self.found.marks if name == source]
            marks += [
                Mark(source, event, at if event.valid else None)
                for event, at in zip(own, gps_times(self.found.host, source, *_arrived(own)), strict=True)
            ]
        marks.sort(key=lambda mark: mark.event.host_time_ns)
        return marks


def _arrived(
    records: Sequence[GnssFix] | Sequence[GnssHeading] | Sequence[EventMark],
) -> tuple[list[int], list[TimeTag | None]]:
    """Return host times and tags of records."""
    return [record.host_time_ns for record in records], [record.time for record in records]


def protocol_of(sources: NavigationSources, source: str | None) -> str:
    """Return the protocol of ``gnss/name`` or ``imu/name``; empty for None."""
    kind, _, name = (source or "").partition("/")
    tables: Mapping[str, object] = sources.config.imu if kind == "imu" else sources.config.gnss
    return str(getattr(tables.get(name), "protocol", ""))


def _outside(file: Path, week: int | None, inertial: Inertial, placed: _Placed) -> OutsidePositions:
    span = int(inertial.time_ns[0]), int(inertial.time_ns[-1])
    return outside_observations(file, span, week, placed.leap_seconds())
