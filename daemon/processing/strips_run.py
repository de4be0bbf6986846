"""`swath strips`: how far strips are from each other, what it looks like, and what specifications say to it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from calib.accuracy_standards import ASPRS_2014, TO_CONFIRM, USGS, Judged, best_of, judge
from calib.flight import FlightError
from calib.signatures import Signatures, record_of, signatures
from calib.strip_cells import StripRules
from calib.strips import Numbers, StripReport, report_of
from daemon.errors import ExitCode, UserError
from daemon.processing.calibration_flight import read_flight
from daemon.processing.flights import Wish
from daemon.processing.json_values import finite
from daemon.processing.strips_inputs import Strips, strips_of_files, strips_of_flight
from daemon.processing.user_errors import told_in_a_line
from georef.mapping import MappingError
from georef.strips import StripError

Told = Callable[[str, int, int], None]

RECORD = "strips.json"
LOG_SUFFIX = ".mcap"
POINT_SUFFIXES = (".las", ".laz")
LIMITS = {
    "pulses_m2": "{:g} pulses per m²",
    "within_m": "{:g} m within strips",
    "overlap_m": "{:g} m RMSDz",
    "overlap_max_m": "{:g} m for the largest difference",
    "rmse_z_m": "{:g} m RMSEz",
}


@dataclass(frozen=True)
class StripsWish:
    """What the command line asks for.

    Attributes:
        paths: logs, or LAS or LAZ files, or folders of either.
        before: likewise, of the same strips before; none: there is nothing to compare with.
        logs: how logs are read; its logs are not looked at.
        rules: of the comparison.
        output: folder for pictures and record; None: none.
        level: a USGS level that must be kept; None: none must.
    """

    paths: Sequence[Path]
    logs: Wish
    before: Sequence[Path] = ()
    rules: StripRules = field(default_factory=StripRules)
    output: Path | None = None
    level: str | None = None


@dataclass(frozen=True)
class Compared:
    """The record for scripts, lines for people, and what is wrong: nothing, or a line."""

    record: dict[str, Any]
    lines: list[str]
    problem: str


def compare_strips(wish: StripsWish, folder: Path, told: Told) -> Compared:
    """Compare.

    Args:
        wish: what is asked for.
        folder: for returns of logs, while it goes on.
        told: is told how far it is.

    Raises:
        UserError: it cannot be, one line.
    """
    with told_in_a_line(folder, FlightError, StripError, MappingError):
        now = _judged(_read(wish.paths, wish, folder / "now", told), wish, told)
        then = _judged(_read(wish.before, wish, folder / "before", told), wish, told) if wish.before else None
    record = finite(now.record() | ({"before": then.record()} if then is not None else {}))
    pictures = _draw(wish, now, then)
    if wish.output is not None:
        record["pictures"] = [str(path) for path in pictures]
        path = wish.output / RECORD
        path.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    lines = [*now.lines(then), *map(str, pictures)]
    return Compared(record, lines, now.problem(wish.level))


def most_cells(count: int) -> StripRules:
    """Rules by which so many cells are looked into."""
    return StripRules(most_cells=count)


def is_of_logs(paths: Sequence[Path]) -> bool:
    """Whether paths are logs rather than points; UserError where they are neither, or both.

    A folder with points in it is one of points.
    """
    kinds = {_kind(path) for path in paths}
    if len(kinds) > 1:
        raise UserError("logs and points together; want logs, or LAS or LAZ files", ExitCode.USAGE)
    return kinds == {"logs"}


def _kind(path: Path) -> str:
    if path.is_dir():
        inside = {one.suffix.lower() for one in path.rglob("*") if one.is_file()}
        if inside & set(POINT_SUFFIXES):
            return "points"
        if LOG_SUFFIX in inside:
            return "logs"
        raise UserError(f"{path}: holds neither LAS or LAZ files nor logs", ExitCode.IO)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder", ExitCode.IO)
    return "points" if path.suffix.lower() in POINT_SUFFIXES else "logs"


def _read(paths: Sequence[Path], wish: StripsWish, folder: Path, told: Told) -> Strips:
    if not is_of_logs(paths):
        return strips_of_files(paths, wish.rules, told)
    folder.mkdir(parents=True, exist_ok=True)
    kept = read_flight(replace(wish.logs, logs=paths), folder, told)
    refuse_installations(kept.logged)
    strips = strips_of_flight(", ".join(map(str, paths)), kept.flight, wish.rules)
    strips.notes.extend(kept.holes)
    return strips


def refuse_installations(logged: Sequence[Any]) -> None:
    """UserError where flights as logged are not of one installation."""
    places = [flight.setup.config.profile.installation for flight in logged]
    for flight, place in zip(logged, places, strict=True):
        if place != places[0]:
            raise UserError(
                f'{flight.log}: is of installation "{place}", {logged[0].log} of "{places[0]}"; want logs of one'
            )


# ---------------------------------------------------------------------- what is made of it


@dataclass(frozen=True, eq=False)
class Judgement:
    """Strips, their differences, what these look like, and what they keep."""

    strips: Strips
    report: StripReport
    signatures: Signatures | None
    judged: tuple[Judged, ...]

    @property
    def grid(self) -> Numbers | None:
        """Gridded dZ of all pairs: means of the pairs' squares, cell by cell."""
        rows = [_gridded(row) for row in self.strips.look.overlap.rows]
        cells = sum(row["cells"] for row in rows)
        if not cells:
            return None
        mean = sum(row["cells"] * row["mean_m"] for row in rows) / cells
        rms = math.sqrt(sum(row["cells"] * row["rms_m"] ** 2 for row in rows) / cells)
        told = self.strips.look.overlap.numbers()
        assert told is not None
        std = math.sqrt(max(rms**2 - mean**2, 0.0))
        return Numbers(cells, mean, std, rms, told["max_m"], told["median_m"], told["p95_m"])

    def significant(self) -> list[str]:
        """Sentences of effects that are in the strips and matter."""
        found = () if self.signatures is None else self.signatures.found
        return [one.words for one in found if one.level == "significant"]

    def problem(self, level: str | None) -> str:
        """What is wrong, a line; empty: nothing."""
        wrong = self.significant()
        if level is not None:
            named = next(one for one in self.judged if one.level == level)
            if broken := _broken(named):
                wrong.append(f"{level} is not kept, for its limit of {', '.join(broken)}")
        return f"{self.strips.what}: {'; '.join(wrong)}" if wrong else ""

    def record(self) -> dict[str, Any]:
        """For JSON."""
        names, grid = self.strips.look.names, self.grid
        gridded = {(names[row["first"]], names[row["second"]]): row for row in self.strips.look.overlap.rows}
        return {
            "input": self.strips.what,
            "strips": [
                {
                    "name": name,
                    "roughness_m": self.report.roughness_m.get(name),
                    "repeatability_m": self.report.repeatability_m.get(name),
                }
                for name in self.report.names
            ],
            "cell_m": self.report.cell_m,
            "pairs": [
                {
                    "first": pair.first,
                    "second": pair.second,
                    "point_to_plane": _values(pair.distance),
                    "dz": _values(pair.height),
                    "noise_m": pair.noise_m,
                    "systematic_m": pair.systematic_m,
                    "gridded": _gridded(row) if (row := gridded.get((pair.first, pair.second))) else None,
                }
                for pair in self.report.pairs
            ],
            "all": {
                "point_to_plane": _values(self.report.all.distance),
                "dz": _values(self.report.all.height),
                "noise_m": _number(self.report.all.noise_m),
                "systematic_m": _number(self.report.all.systematic_m),
                "gridded": None if grid is None else _values(grid),
            },
            "refused": dict(self.report.refused),
            "signatures": None if self.signatures is None else record_of(self.signatures),
            "quality": {
                "levels": [
                    {"standard": one.standard, "level": one.level, "limits": one.limits, "kept": one.kept}
                    for one in self.judged
                ],
                "best": best_of(self.judged),
                "note": TO_CONFIRM,
            },
            "notes": self.strips.notes,
        }

    def lines(self, before: Judgement | None) -> list[str]:
        """For people."""
        lines = [_row("strips", "n", "mean", "std", "RMS", "max", "noise", "dZ RMS") + "  cm"]
        for pair in (*self.report.pairs, self.report.all):
            name = f"{pair.first} − {pair.second}" if pair.first else "all"
            d = pair.distance
            values = (d.mean_m, d.std_m, d.rms_m, d.max_m, pair.noise_m, pair.height.rms_m)
            lines.append(_row(name, f"{d.count:,}", *(f"{100.0 * value:.1f}" for value in values)))
        grid = self.grid
        if grid is not None:
            lines.append(
                f"gridded dZ of {grid.count:,} cells: mean {100 * grid.mean_m:.1f} std {100 * grid.std_m:.1f} "
                f"RMS {100 * grid.rms_m:.1f} max {100 * grid.max_m:.1f} cm"
            )
        lines += [one.words for one in (self.signatures.found if self.signatures else ())]
        lines += self.verdicts()
        if before is not None:
            was, now = before.report.all.distance, self.report.all.distance
            lines.append(
                f"before: RMS {100 * was.rms_m:.1f} cm, largest {100 * was.max_m:.1f} cm; "
                f"now: {100 * now.rms_m:.1f} cm, {100 * now.max_m:.1f} cm"
            )
        return lines + self.strips.notes

    def verdicts(self) -> list[str]:
        """What specifications say."""
        best = best_of(self.judged)
        usgs = f"strips keep {best}" if best else "strips keep no quality level"
        levels = [one for one in self.judged if one.standard == USGS]
        above = levels[: next((k for k, one in enumerate(levels) if one.level == best), len(levels))]
        if above:
            usgs += f"; {above[-1].level} not for its limit of {', '.join(_broken(above[-1]))}"
        asprs = next(one for one in self.judged if one.standard == ASPRS_2014)
        fits = f"strips keep the {asprs.level} class" if asprs.all_kept else "strips keep no class"
        return [f"{USGS}: {usgs}", f"{ASPRS_2014}: {fits}", TO_CONFIRM]


def _broken(one: Judged) -> list[str]:
    """Limits that are not kept, in words."""
    return [LIMITS[word].format(one.limits[word]) for word, kept in one.kept.items() if kept is False]


def _judged(strips: Strips, wish: StripsWish, told: Told) -> Judgement:
    told(f"comparing {strips.what}", 0, 1)
    report = report_of(strips.look.names, strips.gathered, wish.rules, strips.cell_m)
    if not report.pairs:
        why = ", ".join(f"{count:,} {reason}" for reason, count in report.refused.items()) or "none overlap"
        raise UserError(
            f"{strips.what}: no two strips share planar ground ({why}); differences want strips that overlap"
        )
    found = None if strips.seen is None else signatures(report.checks, strips.seen)
    all_pairs = strips.look.overlap.numbers()
    within = list(report.repeatability_m.values())
    judged = judge(
        overlap_rms_m=None if all_pairs is None else all_pairs["rms_m"],
        overlap_max_m=None if all_pairs is None else all_pairs["max_m"],
        within_rms_m=math.sqrt(sum(one**2 for one in within) / len(within)) if within else None,
        pulses_m2=strips.look.density if strips.look.sources else None,
    )
    return Judgement(strips, report, found, judged)


def _draw(wish: StripsWish, now: Judgement, then: Judgement | None) -> list[Path]:
    if wish.output is None:
        return []
    from daemon.processing.quicklook_maps import draw_differences

    made = []
    try:
        wish.output.mkdir(parents=True, exist_ok=True)
        for name, one in (("differences.png", now), ("differences_before.png", then)):
            if one is not None:
                draw_differences(one.strips.look, wish.output / name)
                made.append(wish.output / name)
    except OSError as error:
        raise UserError(f"{wish.output}: cannot be written to ({error.strerror or error})", ExitCode.IO) from error
    return made


def _row(name: str, *values: str) -> str:
    return f"{name:<14}" + "".join(f"{value:>9}" for value in values)


def _gridded(row: dict[str, Any]) -> dict[str, Any]:
    std_m = math.sqrt(max(row["rms_m"] ** 2 - row["mean_m"] ** 2, 0.0))
    return {key: value for key, value in row.items() if key not in ("first", "second")} | {"std_m": std_m}


def _values(numbers: Numbers) -> dict[str, Any]:
    names = ("count", "mean_m", "std_m", "rms_m", "max_m", "median_m", "p95_m")
    return {name: _number(getattr(numbers, name)) for name in names}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
