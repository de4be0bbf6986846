"""Formats numbers and names for pictures, and defines the colours that all pictures share."""

from __future__ import annotations

DPI = 180
INK, MUTED, EMPTY = "#1d242b", "#5d6770", "#f3f4f2"


def thousands(value: float, digits: int = 0) -> str:
    """Return a number with separated thousands and a real minus sign."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def shortened(name: str, most: int) -> str:
    """Return a name cut to at most so many letters."""
    return name if len(name) <= most else f"{name[: most - 1]}…"
