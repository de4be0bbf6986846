"""`swath strips`: measures how far strips are apart, which errors that suggests, and which specifications they keep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from swath.calib.flight import FlightError
from swath.calib.strips.cells import StripRules
from swath.calib.strips.differences import Numbers, PairReport, StripReport, report_of
from swath.calib.strips.signatures import MATTERS_M, Signatures, record_of, signatures
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.returns import (
    check_space_to_keep,
    read_flight,
    refuse_installations,
    smoothed_prior,
)
from swath.daemon.processing.carried_verdict import points_verdicts, refusal, told_before, verdict_entry
from swath.daemon.processing.flights.read import GeorefOptions, verdicts_of
from swath.daemon.processing.pages.head import head_of_flights, head_of_sidecars
from swath.daemon.processing.quicklook.product_facts import crs_of
from swath.daemon.processing.strip_agreement import MORE_CELLS, Agreement, difference_of
from swath.daemon.processing.strips.inputs import Strips, strips_of_files, strips_of_flight
from swath.daemon.processing.user_errors import as_user_error, finite
from swath.georef.mapping.frame import MappingError
from swath.georef.progress import Tell
from swath.georef.strips import StripError
from swath.georef.verdicts import Level, Reason, Verdict, worst_first

RECORD = "strips.json"
WORST_PAIRS = 10  # shown first
LOG_SUFFIX = ".mcap"
POINT_SUFFIXES = (".las", ".laz")


@dataclass(frozen=True)
class StripsOptions:
    """The options of `swath strips` from the command line.

    Attributes:
        paths: logs, or LAS or LAZ files, or folders of either.
        before: paths of the same strips at an earlier state; empty: no comparison with one.
        logs: how logs are read; its list of logs is ignored.
        rules: rules of the comparison.
        level: a USGS level that must be kept; None: no level is required.
    """

    paths: Sequence[Path]
    logs: GeorefOptions
    before: Sequence[Path] = ()
    rules: StripRules = field(default_factory=StripRules)
    level: str | None = None


@dataclass(frozen=True)
class Compared:
    """The outcome of a comparison.

    Attributes:
        record: for scripts.
        problem: in a line; empty: no problem.
        now, before: strips with their differences; before: None if there is no earlier state.
    """

    record: dict[str, Any]
    problem: str
    now: Judgement
    before: Judgement | None = None


def compare_strips(request: StripsOptions, folder: Path, told: Tell) -> Compared:
    """Compare strips with each other, and with an earlier state of them.

    Args:
        request: options of the comparison.
        folder: temporary folder for returns of logs.
        told: called with the progress.

    Raises:
        UserError: the strips cannot be compared; one line.
    """
    with as_user_error(folder, FlightError, StripError, MappingError):
        now = _judged(_read(request.paths, request, folder / "now", told), request, told)
        then = (
            _judged(_read(request.before, request, folder / "before", told), request, told) if request.before else None
        )
    record = finite(now.record() | ({"before": then.record()} if then is not None else {}))
    record["verdict"] = verdict_entry(now.strips.carried, accepted=request.logs.accept_verdict)
    problem = "; ".join(filter(None, (refusal(record["verdict"]), now.problem(request.level))))
    return Compared(record, problem, now, then)


def rules_of(most_cells: int, cell_m: float | None) -> StripRules:
    """Return rules for at most so many cells of a side in metres; None: the side follows from the strips' density."""
    return StripRules(cell_m=cell_m, most_cells=most_cells)


def is_of_logs(paths: Sequence[Path]) -> bool:
    """Return True if paths are logs, False if they are points; refuse with `UserError` both together, or neither.

    A folder that holds points counts as points.
    """
    kinds = {_kind(path) for path in paths}
    if len(kinds) > 1:
        raise UserError("the input mixes logs and points; give logs only, or LAS or LAZ files only", ExitCode.USAGE)
    return kinds == {"logs"}


def _kind(path: Path) -> str:
    if path.is_dir():
        inside = {one.suffix.lower() for one in path.rglob("*") if one.is_file()}
        if inside & set(POINT_SUFFIXES):
            return "points"
        if LOG_SUFFIX in inside:
            return "logs"
        raise UserError(f"{path}: has neither LAS or LAZ files nor logs", ExitCode.IO)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder", ExitCode.IO)
    return "points" if path.suffix.lower() in POINT_SUFFIXES else "logs"


def _read(paths: Sequence[Path], request: StripsOptions, folder: Path, told: Tell) -> Strips:
    if not is_of_logs(paths):
        strips = strips_of_files(paths, request.rules, told, request.logs.trajectory.week)
        sidecars = [source.sidecar for source in strips.look.sources]
        strips.carried.extend(points_verdicts(sidecars))
        return replace(strips, head=head_of_sidecars(sidecars, crs_of(source.crs for source in strips.look.sources)))
    folder.mkdir(parents=True, exist_ok=True)
    kept = read_flight(
        replace(request.logs, logs=paths), folder, told, partial(check_space_to_keep, folder.parent.parent, 0)
    )
    refuse_installations(kept.logged)
    mapping = kept.logged[0].setup.mapping
    carried = verdicts_of(kept.logged)
    with told_before(carried, FlightError):
        strips = strips_of_flight(
            ", ".join(map(str, paths)), kept.flight, request.rules, mapping, smoothed_prior(kept), told
        )
    strips.notes.extend(kept.notes)
    strips.carried.extend(carried)
    return replace(strips, head=head_of_flights(kept.logged))


# ---------------------------------------------------------------------- results


@dataclass(frozen=True, slots=True)
class StripRow:
    """A strip against all others.

    Attributes:
        name: of the strip.
        neighbours: number of strips that it was compared with.
        cells: number of smooth cells.
        above_m, rms_m: its mean height above the others, and RMSDz; None: it was compared with none.
        scatter_m: sigma of its single returns about their planes, on the smoothest quarter of gentle ground.
        returns_m2: density of single returns on open ground.
    """

    name: str
    neighbours: int
    cells: int
    above_m: float | None
    rms_m: float | None
    scatter_m: float | None
    returns_m2: float | None


@dataclass(frozen=True, eq=False)
class Judgement:
    """Strips with their differences, the errors that these suggest, and their quality."""

    strips: Strips
    report: StripReport
    signatures: Signatures | None

    @property
    def agreement(self) -> Agreement:
        """The agreement of the strips, by which they are judged."""
        return self.strips.look.agreement

    def wrong(self) -> list[str]:
        """Return sentences on effects that matter, and on strips that are too far apart to tell an effect."""
        found = () if self.signatures is None else self.signatures.found
        return list(dict.fromkeys(one.words for one in found if one.level in ("significant", "rough")))

    def verdict(self, level: str | None) -> Verdict:
        """Return the verdict on the strips: what they are made with, effects that matter, and the level if it is asked.

        Args:
            level: quality level that they must meet; None: none is required.
        """
        reasons = [one.reason for one in self.strips.carried]
        found = () if self.signatures is None else self.signatures.found
        for one in {one.words: one for one in found if one.level in ("significant", "rough")}.values():
            far = one.level == "rough"
            remedy = "run swath calibrate" if far else "run swath calibrate; it estimates all parameters together"
            words, level_of = one.words.partition("; run swath")[0], Level.UNUSABLE if far else Level.CARE
            reasons.append(Reason(level_of, one.effect.name, words, remedy, 1.0 if far else one.edge_m / MATTERS_M))
        if self.agreement.no_verdict:
            what = self.agreement.no_verdict.removesuffix(f": {MORE_CELLS}")
            reasons.append(Reason(Level.CARE, "cells", what, MORE_CELLS, 0.0))
        elif level is not None and (broken := self.agreement.broken(level)):
            what = f"strips do not meet {level}, because of its limit of {', '.join(broken)}"
            reasons.append(Reason(Level.UNUSABLE, "level", what, "calibrate, or correct the trajectory (--adjust)"))
        worst, ordered = worst_first(reasons)
        return Verdict(worst, f"{worst.heading}: {self._agree(ordered)}.", ordered)

    def _agree(self, reasons: Sequence[Reason]) -> str:
        """Return the gravest reason, and how well the strips agree."""
        numbers, words = self.agreement.numbers, [reasons[0].what] if reasons else []
        if numbers is not None:
            best, judged = self.agreement.best, bool(self.agreement.judged)
            met = "" if not judged else f", and meet {best}" if best else ", and meet no quality level"
            verb = "differ by" if judged and not best else "agree to"
            count = len(self.pairs())
            pairs = f"{count} pairs" if count != 1 else "one pair"
            words.append(f"strips {verb} {100.0 * numbers['rms_m']:.1f} cm (RMSDz of {pairs}){met}")
        return "; ".join(words)

    def strip_rows(self) -> list[StripRow]:
        """Return every strip against all others."""
        look, rows = self.strips.look, []
        densities = dict(zip(look.names, look.cells.single_densities(), strict=False))
        for index, name in enumerate(look.names):
            own = [row for row in look.overlap.rows if index in (row["first"], row["second"])]
            cells = sum(row["cells"] for row in own)
            above = sum((1.0 if row["first"] == index else -1.0) * row["cells"] * row["mean_m"] for row in own)
            square = sum(row["cells"] * row["rms_m"] ** 2 for row in own)
            rows.append(
                StripRow(
                    name,
                    len(own),
                    cells,
                    above / cells if cells else None,
                    math.sqrt(square / cells) if cells else None,
                    self.agreement.repeatability_m.get(index),
                    densities.get(name) or None,
                )
            )
        return rows

    def pairs(self) -> list[tuple[str, str, dict[str, Any] | None, PairReport | None]]:
        """Return names, gridded numbers and point-to-plane numbers of every pair, the largest RMSDz first."""
        heights, to_plane = self._rows(), {(pair.first, pair.second): pair for pair in self.report.pairs}
        every = [(*pair, heights.get(pair), to_plane.get(pair)) for pair in {**heights, **to_plane}]
        return sorted(every, key=lambda one: (-one[2]["rms_m"] if one[2] else 0.0, *self._place(one[:2])))

    def problem(self, level: str | None) -> str:
        """Return the problem in a line; empty if there is none."""
        wrong = self.wrong()
        if self.agreement.no_verdict:
            wrong.append(self.agreement.no_verdict)
        elif level is not None and (broken := self.agreement.broken(level)):
            wrong.append(f"strips do not meet {level}, because of its limit of {', '.join(broken)}")
        return f"{self.strips.what}: {'; '.join(wrong)}" if wrong else ""

    def _rows(self) -> dict[tuple[str, str], dict[str, Any]]:
        """Return the rows of the overlap by pair of strip names."""
        names = self.strips.look.names
        return {(names[row["first"]], names[row["second"]]): row for row in self.strips.look.overlap.rows}

    def record(self) -> dict[str, Any]:
        """Return the comparison as values for JSON."""
        heights, to_plane = self._rows(), {(pair.first, pair.second): pair for pair in self.report.pairs}
        repeats = {self.strips.look.names[number]: one for number, one in self.agreement.repeatability_m.items()}
        densities = dict(zip(self.strips.look.names, self.strips.look.cells.single_densities(), strict=False))
        return {
            "input": self.strips.what,
            "strips": [
                {
                    "name": name,
                    "roughness_m": self.report.roughness_m.get(name),
                    "repeatability_m": repeats.get(name),
                    "single_returns_m2": densities.get(name) or None,
                }
                for name in self.report.names
            ],
            "cell_m": self.report.cell_m,
            "pairs": [
                {"first": first, "second": second}
                | _to_plane(to_plane.get((first, second)))
                | {"gridded": _gridded(heights.get((first, second)))}
                for first, second in sorted({*heights, *to_plane}, key=self._place)
            ],
            "all": _to_plane(self.report.all) | {"gridded": self.agreement.numbers},
            "refused": dict(self.report.refused),
            "signatures": None if self.signatures is None else record_of(self.signatures),
            "quality": self.agreement.record(),
            "notes": self.strips.notes,
        }

    def _place(self, pair: tuple[str, str]) -> tuple[int, int]:
        names = self.strips.look.names
        return names.index(pair[0]), names.index(pair[1])


def _judged(strips: Strips, request: StripsOptions, told: Tell) -> Judgement:
    told("differences", 0, 0)
    report = report_of(strips.look.names, strips.gathered, request.rules, strips.cell_m)
    found = None if strips.seen is None else signatures(report.checks, strips.seen, strips.prior)
    return Judgement(strips, report, found)


def _to_plane(pair: PairReport | None) -> dict[str, Any]:
    """Return point-to-plane numbers for JSON; ``dz`` is the vertical part, on slopes below 10°."""
    if pair is None:
        return dict.fromkeys(("point_to_plane", "dz", "noise_m", "systematic_m"))
    return {
        "point_to_plane": _values(pair.distance),
        "dz": _values(pair.height),
        "noise_m": _number(pair.noise_m),
        "systematic_m": _number(pair.systematic_m),
    }


def _gridded(row: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the height differences of planes for JSON, the measure that strips are judged by."""
    if row is None:
        return None
    kept = {key: value for key, value in row.items() if key not in ("first", "second")}
    return kept | {"std_m": difference_of(row).std_m}


def _values(numbers: Numbers) -> dict[str, Any]:
    names = ("count", "mean_m", "std_m", "rms_m", "max_m", "median_m", "p95_m")
    return {name: _number(getattr(numbers, name)) for name in names}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
