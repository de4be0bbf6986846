"""Tests names of coordinate systems as people write them: which are understood, and which are proposed."""

from __future__ import annotations

import pytest

from swath.georef.mapping.crs_names import plain_code, proposals
from swath.georef.mapping.datums import UnknownCrsError, read_target

ZURICH, GERMANY, SANTIAGO, CALIFORNIA = (47.5, 8.9), (50.0, 9.0), (-33.4, -70.6), (40.0, -123.0)


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("EPSG: 25832", "EPSG:25832"),
        (" 25832 ", "EPSG:25832"),
        ("EPSG 25832", "EPSG:25832"),
        ("epsg:25832 + 7837", "EPSG:25832+7837"),
        ("EPSG:25832+EPSG:7837", "EPSG:25832+7837"),
        ("25832+7837", "EPSG:25832+7837"),
        ("ESRI:102100", "ESRI:102100"),
        ("CH1903+ / LV95", "CH1903+ / LV95"),
    ],
)
def test_codes_are_understood_however_they_are_written(written: str, meant: str) -> None:
    assert plain_code(written) == meant


def test_a_code_with_blanks_is_the_crs_of_the_plain_code() -> None:
    target = read_target("epsg: 25832 + 7837")
    assert (target.text, target.crs.name) == ("EPSG:25832+7837", "ETRS89 / UTM zone 32N + DHHN2016 height")


@pytest.mark.parametrize(
    ("text", "place", "codes"),
    [
        ("UTM32", ZURICH, ["EPSG:25832", "EPSG:32632"]),
        ("UTM32", None, ["EPSG:32632", "EPSG:25832"]),
        ("utm zone 32u", GERMANY, ["EPSG:25832", "EPSG:32632"]),
        ("UTM 19", SANTIAGO, ["EPSG:31979", "EPSG:32719"]),
        ("UTM 33S", None, ["EPSG:32733"]),
        ("UTM10", CALIFORNIA, ["EPSG:6339", "EPSG:32610"]),
        ("ETRS89 / UTM 32N", None, ["EPSG:25832"]),
        ("WGS84 UTM32", None, ["EPSG:32632"]),
        ("RD New", None, ["EPSG:28992"]),
        ("LV 95", ZURICH, ["EPSG:2056"]),
        ("GK 3", GERMANY, ["EPSG:31467"]),
        ("Gauß-Krüger Zone 3", GERMANY, ["EPSG:31467"]),
        ("Gauss-Krüger 3", GERMANY, ["EPSG:31467"]),
        ("ETRS89/UTM32 + DHHN2016", None, ["EPSG:25832+7837"]),
        ("Mount Everest", None, []),
        ("UTM 61", None, []),
    ],
)
def test_the_likely_code_is_proposed_first(text: str, place: tuple[float, float] | None, codes: list[str]) -> None:
    found = [one.split(" (")[0] for one in proposals(text, place)]
    assert found[: len(codes)] == codes
    assert len(found) <= 3
    assert bool(found) == bool(codes)


def test_the_error_of_an_unknown_name_proposes_codes() -> None:
    with pytest.raises(UnknownCrsError) as refused:
        read_target("UTM32", "--control-crs")
    assert str(refused.value).startswith(
        '--control-crs = "UTM32" is unknown to PROJ; write EPSG:32632 (WGS 84 / UTM zone 32N), or EPSG:25832 (ETRS89'
    )
    with pytest.raises(UnknownCrsError, match=r"write EPSG:CODE, EPSG:CODE\+CODE with heights"):
        read_target("Mount Everest")
