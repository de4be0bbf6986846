"""Limits of lidar specifications for strips and heights, as a table, and the judgement of numbers by them (FORMULAS 8).

The limits are those of the editions named. If a contract names another edition, its text decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

TO_CONFIRM = "the limits are those of the editions named; confirm them against the edition in the contract"
USGS = "USGS Lidar Base Specification 2.x"
ASPRS_2014 = "ASPRS Positional Accuracy Standards, edition 1, 2014"


@dataclass(frozen=True, slots=True)
class QualityLevel:
    """Limits of a USGS quality level, metres.

    Attributes:
        name: as ``QL2``.
        pulses_m2: least aggregate density of pulses.
        within_m: smooth-surface repeatability within a strip, RMSDz.
        overlap_m: RMSDz between overlapping strips.
        overlap_max_m: largest difference between them.
        rmse_z_m: RMSEz of heights in open terrain against check points.
    """

    name: str
    pulses_m2: float
    within_m: float
    overlap_m: float
    overlap_max_m: float
    rmse_z_m: float


QUALITY_LEVELS = (
    QualityLevel("QL0", 8.0, 0.03, 0.04, 0.08, 0.05),
    QualityLevel("QL1", 8.0, 0.06, 0.08, 0.16, 0.10),
    QualityLevel("QL2", 2.0, 0.06, 0.08, 0.16, 0.10),
    QualityLevel("QL3", 0.5, 0.12, 0.16, 0.32, 0.20),
)
# ASPRS 2014, vertical classes; its coarser ones, of 33.3 to 333.3 cm, are for other products than lidar's strips
ASPRS_CLASSES_M = (0.01, 0.025, 0.05, 0.10, 0.15, 0.20)
ASPRS_WITHIN, ASPRS_OVERLAP, ASPRS_OVERLAP_MAX = 0.6, 0.8, 1.6  # of a class: its limits within and between strips


@dataclass(frozen=True, slots=True)
class Judged:
    """The judgement of numbers by one level or class of a standard.

    Attributes:
        standard: the standard, with its edition.
        level: quality level or class.
        limits: by word, metres (density: pulses per m²).
        kept: likewise whether the limit is kept; None: there is no number to judge.
    """

    standard: str
    level: str
    limits: dict[str, float]
    kept: dict[str, bool | None]

    @property
    def all_kept(self) -> bool:
        """True if all limits that could be judged are kept, and at least one could be judged."""
        known = [one for one in self.kept.values() if one is not None]
        return bool(known) and all(known)


def judge(
    *,
    overlap_rms_m: float | None,
    overlap_max_m: float | None = None,
    within_rms_m: float | None = None,
    pulses_m2: float | None = None,
    rmse_z_m: float | None = None,
) -> tuple[Judged, ...]:
    """Judge numbers by every USGS quality level and by the ASPRS 2014 class that fits; None: not measured.

    Args:
        overlap_rms_m: RMSDz between strips on slopes below 10°.
        overlap_max_m: largest difference there.
        within_rms_m: repeatability within strips.
        pulses_m2: density.
        rmse_z_m: of heights against check points.
    """
    measured = {
        "pulses_m2": pulses_m2,
        "within_m": within_rms_m,
        "overlap_m": overlap_rms_m,
        "overlap_max_m": overlap_max_m,
        "rmse_z_m": rmse_z_m,
    }
    judged = []
    for level in QUALITY_LEVELS:
        limits = {word: float(getattr(level, word)) for word in measured}
        judged.append(Judged(USGS, level.name, limits, _kept(measured, limits)))
    return (*judged, _asprs(measured))


def _kept(measured: dict[str, float | None], limits: dict[str, float]) -> dict[str, bool | None]:
    kept: dict[str, bool | None] = {}
    for word, limit in limits.items():
        value = measured[word]
        kept[word] = None if value is None else bool(value >= limit if word == "pulses_m2" else value <= limit)
    return kept


def _asprs(measured: dict[str, float | None]) -> Judged:
    """Return the smallest class that is kept, otherwise the largest class, which is then not kept.

    Its limit within strips applies to the largest difference, which a repeatability (RMS) does not show.
    """
    measured = measured | {"within_m": None}
    for size in ASPRS_CLASSES_M:
        limits = {
            "within_m": ASPRS_WITHIN * size,
            "overlap_m": ASPRS_OVERLAP * size,
            "overlap_max_m": ASPRS_OVERLAP_MAX * size,
            "rmse_z_m": size,
        }
        found = Judged(ASPRS_2014, f"{100.0 * size:g} cm", limits, _kept(measured, limits))
        if found.all_kept:
            break
    return found


def best_of(judged: Sequence[Judged]) -> str | None:
    """Return the strictest USGS level that is kept; None if none is kept."""
    return next((one.level for one in judged if one.standard == USGS and one.all_kept), None)
