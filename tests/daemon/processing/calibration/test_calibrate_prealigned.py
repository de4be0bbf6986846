"""Tests that pre-alignment reports a contradiction to a held angle's start and enlarges its sigma."""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import replace

import numpy as np
import pytest

from swath.calib.adjust import adjust
from swath.calib.calibration_file import Header, calibration_text
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Considered
from swath.calib.parameters import ParameterOptions
from swath.calib.planes.search import find_planes
from swath.calib.summary import Finding
from swath.daemon.processing.calibration.run import COARSE_RAD, _aligned, prealigned_otherwise
from swath.georef.scanner.calibration import INDEX, Calibration, read_calibration
from tests.calib.cast_flight import VILLAGE, Cast, Line, cast_flight

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

LINES: tuple[Line, ...] = ((-200, 0, 200, 0, 850), (200, 60, -200, 60, 850))
KNOWN_RAD = math.radians(0.02)  # the heading's stated sigma at the start
NOBODY: frozenset[str] = frozenset()


def through_a_file(calibration: Calibration) -> Calibration:
    """Return the calibration after writing it to a file and reading it back."""
    header = Header("2026-11-21T10:15:00Z-ab12", dt.datetime(2026, 11, 21, 10, 15, tzinfo=dt.UTC))
    return read_calibration(calibration_text(calibration, header), "left.toml")


@pytest.fixture(scope="module")
def cast() -> Cast:
    """Return a line flown there and back, over houses on level ground."""
    return cast_flight(VILLAGE.replace("relief_m = 8.0", "relief_m = 0.0"), LINES, prf_hz=12_000.0)


def begun(cast: Cast, heading_off_deg: float) -> Flight:
    """Start from an earlier calibration's file: the truth, except a heading that is wrong but counts as known."""
    sigmas = np.zeros(len(INDEX))
    sigmas[INDEX["kappa_rad"]] = KNOWN_RAD
    off = cast.truth.value("kappa_rad") + math.radians(heading_off_deg)
    told = cast.truth.changed(kappa_rad=off, scan_angle_scale=1.7e-4, time_offset_s=3.1e-5)
    start = through_a_file(replace(told, method="combined", sigmas=sigmas))
    return replace(cast.flight, heads=(replace(cast.flight.heads[0], start=start),)).placed({"left": start})


def held_heading(flight: Flight) -> tuple[dict[str, float], Considered, tuple[Finding, ...]]:
    """Adjust on the one level place nearest to the middle, which shows no heading.

    Return by how much pre-alignment moved each parameter from its start, the held heading, and the findings.
    """
    first, away = _aligned(flight, NOBODY)
    aligned = flight.placed(first)
    level = [plane for plane in find_planes(aligned).planes if plane.normal_t[2] > 0.9995]
    nearest = min(level, key=lambda plane: abs(plane.centre_t[1] - 30.0))
    doubted = {name: abs(apart) for name, apart in away.items()}
    prior = gauss_markov(flight, Taus(), 4.0)
    found = adjust(aligned, Features((nearest,)), ParameterOptions("basic"), prior, first=first, doubted=doubted)
    assert "kappa_rad" in [one.name for one in found.held]
    (heading,) = (one for one in found.considered if one.name == "kappa_rad")
    start, written = flight.heads[0].start, through_a_file(found.calibrations["left"])
    for one in found.considered:  # in the file too, bit for bit
        assert written.value(one.name) == start.value(one.name) == one.value, one.name
    assert written.value("omega_rad") != start.value("omega_rad")
    return away, heading, prealigned_otherwise(away, found)


def test_a_held_heading_contradicted_by_houses_makes_the_calibration_unusable(cast: Cast) -> None:
    away, heading, findings = held_heading(begun(cast, -0.6))
    assert set(away) == {"left.kappa_rad"}
    assert math.degrees(away["left.kappa_rad"]) == pytest.approx(0.6, abs=0.05)
    assert heading.sigma >= away["left.kappa_rad"] > 10.0 * KNOWN_RAD
    (one,) = findings
    assert one.unusable
    assert f"boresight κ (heading) {math.degrees(away['left.kappa_rad']):+.2f}° from the initial value" in one.what
    assert one.excess == pytest.approx(away["left.kappa_rad"] / COARSE_RAD)


def test_a_held_heading_that_is_right_is_not_contradicted(cast: Cast) -> None:
    away, heading, findings = held_heading(begun(cast, 0.0))
    assert (away, findings) == ({}, ())
    assert heading.sigma < 0.5 * math.radians(0.6)


def test_a_fixed_angle_keeps_its_start_while_the_others_are_found(cast: Cast) -> None:
    """The contradiction is not reported here, because the adjustment reports it for angles fixed by the user."""
    flight = begun(cast, -0.6)
    first, away = _aligned(flight, frozenset({"left.kappa_rad"}))
    start = flight.heads[0].start
    assert away == {}
    assert first["left"].value("kappa_rad") == pytest.approx(start.value("kappa_rad"), abs=1e-9)
    assert first["left"].value("range_offset_m") == start.value("range_offset_m")
