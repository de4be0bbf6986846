"""Defines the classes by which pictures colour what is judged; their limits are round numbers.

Height differences of strips are judged by RMSDz, so their classes end at its limits in the USGS quality levels, at half
the strictest of them, and further out at doublings. Misfits of planes are judged by the accuracy that the calibration
has to have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from swath.calib.strips.standards import QUALITY_LEVELS

LEVEL_LIMITS_M = tuple(sorted({level.overlap_m for level in QUALITY_LEVELS}))
DZ_LIMITS_M = (LEVEL_LIMITS_M[0] / 2, *LEVEL_LIMITS_M, 2 * LEVEL_LIMITS_M[-1], 4 * LEVEL_LIMITS_M[-1])
# From good to bad; brightness tells them apart too, for readers who do not see green and red
SIZE_COLOURS = ("#1b7f79", "#8fd3a8", "#f6d55c", "#ed7d31", "#b3202a", "#6a1b4d", "#2b0a3d")
SIGNED_COLOURS = (
    "#3b0f70",
    "#2166ac",
    "#67a9cf",
    "#c6dbef",
    "#e9f1e4",
    "#fddbc7",
    "#ef8a62",
    "#b2182b",
    "#67001f",
)
ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # factors of a power of ten
SHARE_INSIDE = 0.995  # of what is shown must lie below the last limit, as far as there are limits
FEWEST_CLASSES = 4


def class_number(value: float, limits: Sequence[float]) -> int:
    """Return the number of the class of a size: how many limits it exceeds."""
    return sum(value > limit for limit in limits)


def limits_for(inside: float, limits: Sequence[float] = DZ_LIMITS_M) -> tuple[float, ...]:
    """Return the first of the limits, until one is not below a size that most values keep; a few in any case."""
    return tuple(limits[: max(FEWEST_CLASSES, class_number(inside, limits) + 1)])


def size_words(limits_m: Sequence[float]) -> list[str]:
    """Return the words of each class of sizes, in centimetres, and the quality levels whose limit its end is."""
    limits = [f"{100 * limit:g}" for limit in limits_m]
    spans = [f"≤ {limits[0]}", *(f"{low}–{high}" for low, high in pairwise(limits))]
    words = [f"{span} cm{_level_words(limit)}" for span, limit in zip(spans, limits_m, strict=True)]
    return [*words, f"> {limits[-1]} cm"]


def _level_words(limit_m: float) -> str:
    names = [level.name for level in QUALITY_LEVELS if math.isclose(level.overlap_m, limit_m)]
    return f" ({', '.join(names)})" if names else ""


def around_required(required_m: float) -> tuple[float, ...]:
    """Return limits at half, once and twice a required accuracy, which is rounded down to a round number."""
    power = 10.0 ** math.floor(math.log10(required_m) + 1e-9)
    base = max(step * power for step in ROUND if step * power <= required_m * (1.0 + 1e-9))
    return tuple(float(f"{share * base:.6g}") for share in (0.5, 1.0, 2.0))
