"""Tests the last lines of `swath georef`, from the sidecar alone."""

from __future__ import annotations

from typing import Any

import pytest

from swath.daemon.processing.georeferencing.console import crs_line, density_words, trajectory_words

CRS = {"crs": "EPSG:25832+7837", "name": "ETRS89 / UTM zone 32N + DHHN2016 height", "datum": "ETRS89"}
HGRID = "proj=hgridshift grids=de_adv_BETA2007.tif"
VGRID = "inv proj=vgridshift grids=de_bkg_gcg2016.tif multiplier=1"
SIGMAS = {"north_m": 0.03, "east_m": 0.04, "down_m": 0.06, "roll_deg": 0.003, "pitch_deg": 0.003, "heading_deg": 0.02}


@pytest.mark.parametrize(
    ("pipeline", "words"),
    [
        (f"proj=pipeline step {HGRID} step {VGRID}", "heights DHHN2016 height, geoid de_bkg_gcg2016.tif; from ETRS89"),
        (f"proj=pipeline step {HGRID} step proj=utm zone=32", "heights DHHN2016 height; from ETRS89"),
        (None, "heights DHHN2016 height; from ETRS89"),
    ],
)
def test_the_geoid_is_that_of_the_heights_and_no_grid_of_the_plane(pipeline: str | None, words: str) -> None:
    line = crs_line(CRS | {"heights": "DHHN2016 height", "pipeline": pipeline, "grids": ["some"]})
    assert line == f"ETRS89 / UTM zone 32N + DHHN2016 height (EPSG:25832+7837); {words}"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "navigated from IMU and GNSS; sigmas 5.0 cm in plan, 6.0 cm in height, 0.0030° roll and pitch, 0.0200° "),
        ({"source": "file", "name": "a.sbet"}, "from a file (a.sbet); sigmas 5.0 cm in plan, "),
        ({"quality": {"sigma_rms": None, "fixed_share": None}}, "navigated from IMU and GNSS; no sigmas; no doubts"),
        ({"verdict": [{"level": "usable with care", "what": "a"}]}, "; 97 % of positions fixed; usable with care"),
    ],
)
def test_a_trajectory_has_source_sigmas_fixed_share_and_doubts(changed: dict[str, Any], words: str) -> None:
    known = {"sigma_rms": SIGMAS, "fixed_share": 0.97}
    entry = {"source": "navigated", "name": "n", "verdict": [], "quality": known} | changed
    assert words in trajectory_words(entry).replace("\u00a0", " ")


def test_last_returns_are_told_where_they_differ() -> None:
    assert density_words({"all": 12.34, "last": 12.31}) == "12.3 per m²"
    assert density_words({"all": 12.3, "last": 9.8}) == "12.3 per m² (9.80 last returns)"
