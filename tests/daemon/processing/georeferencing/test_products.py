"""Tests what `swath georef` plans before it works."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from swath.daemon.processing.georeferencing.run import _numbers


def session(*scanners: str) -> Any:
    return SimpleNamespace(setup=SimpleNamespace(scanners=list(scanners)))


def test_a_scanner_keeps_its_number_in_sessions_that_lack_another() -> None:
    """Strips of a run are one product, so channel 0 of one must not be channel 1 of the next."""
    assert _numbers([session("right"), session("left", "right")]) == {"left": 0, "right": 1}
