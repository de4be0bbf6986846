"""Tests the sizes of a flight, and the cells that the plane search derives from them."""

from __future__ import annotations

import numpy as np
import pytest

from swath.calib.planes.fit import PlaneSettings
from swath.calib.scale import Scale, area_spacing_m, scale_of, spacing_m
from tests.calib.cast_flight import cast_flight
from tests.calib.surface_flight import swath_of

REFERENCE = Scale(800.0, 900.0, 0.8)
LOWEST = Scale(20.0, 28.0, 0.03)
HIGHEST = Scale(3000.0, 2500.0, 3.0)


def test_height_width_and_spacing_match_the_plan() -> None:
    """A scan of ±15° at 60 m is 32.2 m wide; 4,000 pulses a second are spread over that width at 10 m/s."""
    half_rad = np.radians(15.0)
    lines = ((-70, 0, 70, 0, 510), (70, 0, -70, 0, 510))
    made = cast_flight("height_m = 450.0", lines, prf_hz=4_000.0, half_angle_rad=half_rad, speed_mps=10.0)
    sizes = scale_of(made.flight)
    width_m = 2.0 * 60.0 * np.tan(half_rad)
    assert sizes is not None
    assert sizes.height_m == pytest.approx(60.0, abs=2.0)  # the aircraft heaves by 2 m
    assert sizes.width_m == pytest.approx(width_m, rel=0.1)
    assert sizes.spacing_m == pytest.approx(np.sqrt(width_m * 10.0 / 4_000.0), rel=0.1)


@pytest.mark.parametrize("side_m", [10.0, 300.0, 4000.0])
def test_spacing_matches_the_points_at_any_size(side_m: float) -> None:
    points = np.random.default_rng(3).uniform(0.0, side_m, (20_000, 2))
    assert area_spacing_m(points) == pytest.approx(side_m / np.sqrt(20_000), rel=0.05)


def test_spacing_of_a_diagonal_swath_is_not_that_of_its_bounding_box() -> None:
    """The strip is 10 m wide and runs 2 km to the north-east."""
    along, across = np.random.default_rng(4).uniform([0.0, 0.0], [2000.0, 10.0], (40_000, 2)).T
    points = np.stack([along - across, along + across, 0.0 * along], axis=1) / np.sqrt(2.0)
    assert spacing_m(swath_of(points)) == pytest.approx(np.sqrt(2000.0 * 10.0 / 40_000), rel=0.2)  # its box gives 70×


def test_a_swath_without_points_has_no_spacing() -> None:
    assert spacing_m(swath_of(np.full((200, 3), np.nan))) == np.inf


def test_settings_are_unchanged_at_the_reference_height() -> None:
    assert PlaneSettings().scaled(REFERENCE) == PlaneSettings()


def test_narrow_swaths_have_several_pieces_side_by_side() -> None:
    settings = PlaneSettings().scaled(LOWEST)
    assert settings.tile_m <= LOWEST.width_m / 4.0
    assert settings.cell_m < 0.6
    assert settings.displacement_m == PlaneSettings().displacement_m


def test_strips_flown_higher_may_lie_farther_apart() -> None:
    settings = PlaneSettings().scaled(HIGHEST)
    angle_rad = PlaneSettings().displacement_m / 800.0
    assert settings.displacement_m == pytest.approx(angle_rad * 3000.0)
    assert settings.tile_m == PlaneSettings().tile_m
