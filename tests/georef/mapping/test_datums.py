"""Tests which datum operations are chosen and which are refused; the figures come from PROJ directly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
import pytest
from pyproj.datadir import get_user_data_dir
from pyproj.network import is_network_enabled, set_network_enabled

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.mapping import datums
from swath.georef.mapping.frame import Mapping, MappingError

pytestmark = pytest.mark.xdist_group("kernels")


def proj(source: str, target: str) -> pyproj.Transformer:
    """Transform with the best operation of PROJ, in traditional axis order."""
    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def at(lat_deg: float, lon_deg: float, height_m: float = 500.0) -> FloatArray:
    """Return one position (1, 3) in e."""
    return np.atleast_2d(e_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), height_m))


def refusal(crs: str, **settings: Any) -> str:
    """Return the single line with which a mapping frame is refused."""
    with pytest.raises(MappingError) as caught:
        Mapping(crs, **settings)
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.slow
def test_itrf_to_etrs89_is_not_the_identity() -> None:
    """EPSG:7912 at 2026.47 → EPSG:25832 at 47.55° N 9° E moves points by −0.729 m east and −0.581 m north.

    This is relative to what PROJ considers best for WGS 84.
    """
    itrf = np.array(proj("EPSG:7912", "EPSG:7789").transform(9.0, 47.55, 500.0))[None]
    identity = np.array(proj("EPSG:4979", "EPSG:25832").transform(9.0, 47.55, 500.0))
    mapping = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.47)
    np.testing.assert_allclose((mapping.map_from_e(itrf) - identity)[0, :2], [-0.729, -0.581], atol=5e-4)
    directly = proj("EPSG:7912", "EPSG:25832").transform(9.0, 47.55, 500.0, 2026.47)[:3]
    np.testing.assert_allclose(mapping.exact(itrf)[0], directly, atol=1e-6)
    stated = mapping.description()
    assert (stated["realisation"], stated["epoch"]) == ("ETRF2020", 2026.47)
    assert (stated["accuracy_m"], stated["stated_accuracy_m"]) == (0.0, 0.1)


def test_wgs_84_of_unknown_realisation_is_not_etrs89() -> None:
    line = refusal("EPSG:25832")
    assert "accurate to 1 m only" in line
    assert 'gnss.datum or --trajectory-datum, such as "EPSG:7912"' in line
    assert 'or set "same" if they are already in ETRS89' in line
    assert refusal("EPSG:25832", datum="EPSG:4979").count("accurate to 1 m only") == 1


def test_a_time_dependent_operation_needs_its_epoch() -> None:
    assert "output.epoch = 2026.9" in refusal("EPSG:25832", datum="EPSG:7912")
    assert "26.47 is not a decimal year" in refusal("EPSG:25832", datum="EPSG:7912", epoch=26.47)
    assert "nan is not a decimal year" in refusal("EPSG:32632", epoch=float("nan"))
    early, late = (
        Mapping("EPSG:25832", datum="EPSG:7912", epoch=epoch).exact(at(47.55, 9.0)) for epoch in (2016, 2026)
    )
    assert 0.2 < float(np.linalg.norm(late - early)) < 0.3  # ten years of the Eurasian plate


@pytest.mark.parametrize("datum", [None, "EPSG:4978", "EPSG:4979", "EPSG:4326", "same"])
def test_wgs_84_to_utm_on_wgs_84_is_taken(datum: str | None) -> None:
    mapping = Mapping("EPSG:32632", datum=datum)
    expected = proj("EPSG:4979", "EPSG:32632").transform(9.1, 47.5, 500.0)
    np.testing.assert_allclose(mapping.exact(at(47.5, 9.1))[0], expected, atol=1e-6)


@pytest.mark.slow
def test_itrf_to_utm_on_wgs_84_names_the_realisation() -> None:
    """G2139 equals ITRF2014 to 1 cm (EPSG) and is a member of the ensemble on which EPSG:32632 is based."""
    mapping = Mapping("EPSG:32632", datum="EPSG:7912")
    mapping.settle(at(47.5, 9.0))
    assert mapping.description()["realisation"] == "WGS 84 (G2139)"
    assert mapping.description()["accuracy_m"] == pytest.approx(0.01)


def test_datum_same_is_accepted_on_the_users_word() -> None:
    mapping = Mapping("EPSG:25832", datum="same")
    expected = proj("EPSG:4937", "EPSG:25832").transform(9.1, 47.5, 500.0)
    etrs = np.array(proj("EPSG:4937", "EPSG:4936").transform(9.1, 47.5, 500.0))[None]
    np.testing.assert_allclose(mapping.map_from_e(etrs)[0], expected, atol=1e-5)
    assert "by the user's word" in mapping.description()["datum"]
    assert "ETRS89" in mapping.description()["datum"]


@pytest.mark.parametrize(
    ("crs", "datum", "ellipsoid"),
    [
        ("EPSG:2056", "same", "Bessel 1841"),
        ("EPSG:2056", "EPSG:4150", "Bessel 1841"),
        ("EPSG:31467", "EPSG:4314", "Bessel 1841"),
        ("EPSG:26717", "same", "Clarke 1866"),
        ("EPSG:32632", "EPSG:7677", "PZ-90"),
    ],
)
def test_a_datum_on_another_ellipsoid_is_refused(crs: str, datum: str, ellipsoid: str) -> None:
    """Latitudes on Bessel's ellipsoid read as WGS 84's would be off by 67 m in Switzerland, and heights by 700 m."""
    line = refusal(crs, datum=datum, accuracy_m=1000.0)
    assert line.startswith(f'datum = "{datum}": ')
    assert f"is on the ellipsoid {ellipsoid}, but positions are read on that of WGS 84 and GRS 1980" in line


def test_datum_same_is_not_suggested_if_it_would_be_refused() -> None:
    assert '"same"' not in refusal("EPSG:2056")
    assert '"same"' not in refusal("EPSG:2056", datum="EPSG:4932")
    assert '"same"' in refusal("EPSG:25832")


def test_an_accuracy_of_a_decimetre_is_accepted_if_the_user_allows_it() -> None:
    """EPSG states 0.1 m for CHTRS95 → CH1903+; heights stay on the ellipsoid of the positions, as in PROJ."""
    line = refusal("EPSG:2056", datum="EPSG:4932")
    assert "accurate to 0.1 m only" in line
    assert line.endswith("output.datum_accuracy_m = 0.1")
    mapping = Mapping("EPSG:2056", datum="EPSG:4933", accuracy_m=0.1)
    swiss = np.array(proj("EPSG:4933", "EPSG:4932").transform(8.5, 47.1, 480.0))[None]
    expected = proj("EPSG:4933", "EPSG:2056").transform(8.5, 47.1, 480.0)
    np.testing.assert_allclose(mapping.exact(swiss)[0], expected, atol=1e-6)
    assert mapping.exact(swiss)[0, 2] == pytest.approx(480.0)
    assert mapping.description()["heights"] == "ellipsoidal (GRS 1980)"


def test_an_operation_of_a_single_step_is_checked() -> None:
    """To a geocentric frame PROJ's operation is one transformation, without conversions before and after it."""
    assert "accurate to 1 m only" in refusal("EPSG:4936")
    stated = Mapping("EPSG:7789", datum="EPSG:9988", epoch=2020.0).description()
    assert stated["operation"] == "Inverse of ITRF2014 to ITRF2020 (1)"
    assert stated["accuracy_m"] == pytest.approx(0.001)


def test_a_ballpark_transformation_is_refused() -> None:
    assert "would guess" in refusal("EPSG:2056", datum="EPSG:7912")
    assert "would guess" in refusal("EPSG:2056", datum="EPSG:7912", accuracy_m=1000.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crs", "datum", "grid"),
    [
        ("EPSG:25832+7837", "same", "de_bkg_gcg2016.tif"),
        ("EPSG:25832+7837", None, "de_bkg_gcg2016.tif"),
        ("EPSG:2056+5728", "EPSG:4932", "ch_swisstopo_chgeo2004_ETRS89_LN02.tif"),
        ("EPSG:32632+3855", None, "us_nga_egm08_25.tif"),
        ("EPSG:27700", "EPSG:4937", "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
    ],
)
def test_error_for_a_missing_grid_shows_how_to_get_it(crs: str, datum: str | None, grid: str) -> None:
    line = refusal(crs, datum=datum)
    assert f"`projsync --file {grid}" in line
    assert f"copy it to {get_user_data_dir()}" in line


def test_a_vertical_frame_without_any_model_is_refused() -> None:
    assert "no geoid model" in refusal("EPSG:32632+5195")


@pytest.mark.parametrize(
    ("crs", "said"),
    [
        ("EPSG:4326", "is geographic, in degrees"),
        ("EPSG:4979", "is geographic, in degrees"),
        ("EPSG:4326+5773", "is geographic, in degrees"),
        ("EPSG:5773", "has heights only"),
        ("EPSG:2048", "counts towards the west and south"),
        ("EPSG:5513", "counts towards the west and south"),
        ("EPSG:32632+5715", "counts depths"),
        ("EPSG:999999", "is unknown to PROJ"),
        ("UTM 32", "is unknown to PROJ"),
    ],
)
def test_an_unusable_mapping_frame_is_refused(crs: str, said: str) -> None:
    line = refusal(crs)
    assert line.startswith(f'output.crs = "{crs}"')
    assert said in line


def test_an_unusable_datum_is_refused() -> None:
    assert 'name its geodetic CRS, "EPSG:4258"' in refusal("EPSG:25832", datum="EPSG:25832")
    assert 'datum = "ITRF14" is unknown to PROJ' in refusal("EPSG:25832", datum="ITRF14")


def test_the_first_point_chooses_among_several_operations() -> None:
    """Around the Baltic PROJ's best operation to ETRS89 needs a grid of velocities; in Germany it needs none."""
    mapping = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.0)
    assert mapping.description()["operation"] is None
    with pytest.raises(MappingError, match="not yet chosen"):
        mapping.e_from_map(np.zeros((1, 3)))
    mapping.map_from_e(at(47.5, 9.0))
    west, south, east, north = mapping.description()["area"]
    assert west < 9.0 < east
    assert south < 47.5 < north
    told = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.0, area=(8.0, 47.0, 10.0, 48.0))
    assert told.description()["pipeline"] == mapping.description()["pipeline"]
    norway = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.0)
    with pytest.raises(MappingError, match="eur_nkg_nkgrf17vel"):
        norway.map_from_e(at(60.5, 9.0))


def test_no_grid_is_downloaded() -> None:
    before = is_network_enabled()
    set_network_enabled(True)
    try:
        datums._candidates.cache_clear()
        assert "de_bkg_gcg2016.tif" in refusal("EPSG:25832+7837", datum="same")
        assert not is_network_enabled()
    finally:
        set_network_enabled(before)
