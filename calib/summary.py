"""What a report is made of: the outcome of a calibration, and what was measured before and after it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from swath.calib.calibration_file import Header
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.need import Need
from swath.calib.outcome import Adjusted
from swath.calib.profiles.check import Check
from swath.georef.arrays import FloatArray

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
    """Height differences of overlapping strips on a grid in t.

    Attributes:
        west_m, south_m: of the first cell's corner, in t.
        cell_m: its side.
        before_m, after_m: (rows, columns) from south and west; nan: not compared. Where several pairs of strips meet,
            it is the largest difference.
        before_words, after_words: how far the strips differ, of all pairs, by the measure that the report tells.
    """

    west_m: float
    south_m: float
    cell_m: float
    before_m: FloatArray
    after_m: FloatArray
    before_words: str = ""
    after_words: str = ""


@dataclass(frozen=True, eq=False)
class Profile:
    """A picture somebody else drew.

    Attributes:
        title, caption: words above and below.
        svg: it, for the page.
        figure: makes it as a figure of Matplotlib, for the PDF; None: the page alone shows it.
    """

    title: str
    caption: str
    svg: str
    figure: Callable[[], Any] | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that speaks against a calibration, found beside its figures.

    Attributes:
        what: is the matter, with the figure.
        change: what to do about it.
        excess: by how much it is beyond what is expected, to put the worst first.
        unusable: whether the calibration must not be used with it.
    """

    what: str
    change: str
    excess: float = 1.0
    unusable: bool = False


@dataclass(frozen=True, eq=False)
class ReportInput:
    """All that a report shows.

    Attributes:
        flight: its swaths' points as placed with whatever calibrations.
        features, adjusted: as observed and as found.
        headers: of the calibration files, by scanner.
        before, after: height differences by pair of swath names, with the calibrations at the start and as found.
        differences: them on a map; None: not made.
        check: what profiles say beside the adjustment; None: not measured.
        profiles: more pictures.
        inputs: name and SHA-256 of every file that went in.
        settings: of the run, in words, among them software and versions.
        notes: for the reader, one sentence each.
        findings: reasons against it that its figures do not tell.
        need: how accurate it has to be, and what it leaves in the points; None: not looked into.
        title: of the whole; empty: made of installation and scanners.
        measure: what the height differences are, for people; empty: unsaid.
        level: the quality level that strips keep, or why there is none; empty: not judged.
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

    @property
    def heading(self) -> str:
        """Title of the report."""
        if self.title:
            return self.title
        scanners = " and ".join(self.adjusted.calibrations)
        places = sorted({header.installation for header in self.headers.values() if header.installation})
        return f"Calibration of {scanners}" + (f", {', '.join(places)}" if places else "")
