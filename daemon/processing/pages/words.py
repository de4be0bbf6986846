"""Shortens numbers for pictures, and names the colours that all pictures share."""

from __future__ import annotations

DPI = 140
INK, MUTED, EMPTY = "#1d242b", "#5d6770", "#f3f4f2"


def thousands(value: float, digits: int = 0) -> str:
    """Return a number whose thousands stand apart, with a real minus."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def shortened(name: str, most: int) -> str:
    """Return a name of so many letters at most."""
    return name if len(name) <= most else f"{name[: most - 1]}…"
