"""Data of a report: the outcome of a calibration, and the measurements before and after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from swath.calib.calibration_file import Header
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.need import Need
from swath.calib.outcome import Adjusted
from swath.calib.profiles.check import Check
from swath.georef.arrays import FloatArray
from swath.georef.mapping.chart import Chart
from swath.georef.scanner.calibration import Calibration

Pair = tuple[str, str]


class Difference(Protocol):
    """Height differences of two strips, first − second, metres; RMS² = mean² + std² (FORMULAS 8)."""

    @property
    def mean_m(self) -> float: ...

    @property
    def std_m(self) -> float: ...

    @property
    def rms_m(self) -> float: ...

    @property
    def max_m(self) -> float: ...

    @property
    def count(self) -> int: ...


@dataclass(frozen=True, slots=True)
class PairDifference:
    """Height differences of two strips, metres: a plain `Difference`."""

    mean_m: float
    std_m: float
    rms_m: float
    max_m: float
    count: int


@dataclass(frozen=True, eq=False)
class DifferenceMap:
    """Height differences of overlapping strips on a grid.

    Attributes:
        west_m, south_m: of the first cell's corner, in metres of the map, or in t where the flight has no CRS.
        cell_m: its side.
        before_m, after_m: (rows, columns) from south and west, smoothed to a sigma that colours do not show; nan: not
            compared. Where several pairs of strips meet, it is the largest difference.
        in_t: True if the grid is one in t.
        before_words, after_words: overall difference of all pairs of strips, in the measure that the report states.
    """

    west_m: float
    south_m: float
    cell_m: float
    before_m: FloatArray
    after_m: FloatArray
    before_words: str = ""
    after_words: str = ""
    in_t: bool = False


@dataclass(frozen=True, eq=False)
class Profile:
    """A picture that another component drew for the report.

    Attributes:
        title, caption: text above and below.
        svg: the picture.
    """

    title: str
    caption: str
    svg: str


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding against a calibration that does not come from the adjustment's own figures.

    Attributes:
        what: the problem, with the figure.
        change: the remedy.
        excess: ratio to the expected value; the worst findings come first.
        unusable: whether the calibration must not be used with it.
    """

    what: str
    change: str
    excess: float = 1.0
    unusable: bool = False


@dataclass(frozen=True, eq=False)
class ReportInput:
    """All data that a report shows.

    Attributes:
        flight: its swaths' points as placed, with any calibrations.
        features, adjusted: observations and result.
        headers: of the calibration files, by scanner.
        before, after: height differences by pair of swath names, with the calibrations at the start and as found.
        differences: the height differences on a map; None: not made.
        check: independent check by profiles; None: not measured.
        profiles: more pictures.
        inputs: name and SHA-256 of every input file.
        settings: of the run, in words, among them software and versions.
        notes: for the reader, one sentence each.
        findings: reasons against the calibration that its figures do not show.
        need: required accuracy, and the errors that the calibration leaves in the points; None: not determined.
        title: of the whole; empty: made of installation and scanners.
        measure: what the height differences are, for display; empty: not stated.
        level: the quality level that strips keep, or why there is none; empty: not judged.
        prealigned: by scanner, angles from which the iterations began; without a scanner: from its start.
        chart: coordinates of the maps; None: those of the UTM zone in which the flight lies.
    """

    flight: Flight
    features: Features
    adjusted: Adjusted
    headers: Mapping[str, Header]
    before: Mapping[Pair, Difference] = field(default_factory=dict)
    after: Mapping[Pair, Difference] = field(default_factory=dict)
    differences: DifferenceMap | None = None
    check: Check | None = None
    profiles: Sequence[Profile] = ()
    inputs: Sequence[tuple[str, str]] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    findings: Sequence[Finding] = ()
    need: Need | None = None
    title: str = ""
    measure: str = ""
    level: str = ""
    prealigned: Mapping[str, Calibration] = field(default_factory=dict)
    chart: Chart | None = None

    @property
    def heading(self) -> str:
        """Title of the report."""
        if self.title:
            return self.title
        scanners = " and ".join(self.adjusted.calibrations)
        places = sorted({header.installation for header in self.headers.values() if header.installation})
        return f"Calibration of {scanners}" + (f", {', '.join(places)}" if places else "")
