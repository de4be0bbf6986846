"""Formats numbers and names for pictures, and defines the colours that all pictures share."""

from __future__ import annotations

import math

DPI = 180
INK, MUTED, EMPTY = "#1d242b", "#5d6770", "#f3f4f2"


def thousands(value: float, digits: int = 0) -> str:
    """Return a number with separated thousands and a real minus sign."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def shortened(name: str, most: int) -> str:
    """Return a name cut to at most so many letters."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def round_down(size: float) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ that is not above a size."""
    power = 10.0 ** math.floor(math.log10(size))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= size * (1 + 1e-9))


def size_words(area_m2: float) -> str:
    """Return an area with a unit that suits it."""
    if area_m2 < 10_000.0:
        return f"{area_m2:.0f} m²"
    return f"{area_m2 / 1e4:.1f} ha" if area_m2 < 1e6 else f"{area_m2 / 1e6:.2f} km²"
