"""Tests the pictures of a navigated flight: coordinates, times and strips are measured as drawn."""

from __future__ import annotations

import datetime as dt
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from pyproj import Transformer

from swath.daemon.processing.trajectory import panels
from swath.daemon.processing.trajectory.page import PICTURES, page_of
from swath.daemon.processing.trajectory.panels import NARROW, WIDE, Drawn, Format
from swath.daemon.processing.trajectory.pictures import draw_height, map_of
from swath.daemon.processing.trajectory.series import (
    Flight,
    course_of,
    determined_axes,
    separation_of,
    straight_flight,
)
from swath.georef.mapping.frame import Mapping
from swath.georef.timescales.gps_time import SECOND_NS, gps_ns_from_utc
from tests.daemon.navigation_flights import sound_flight
from tests.daemon.processing.pages.builders import overlapping, texts_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Return a flight whose products are on the map of UTM zone 32."""
    return replace(sound_flight(every=4), mapping=Mapping("EPSG:25832", datum="same"))


@pytest.fixture(scope="module")
def drawn(flight: Flight) -> Drawn:
    return Drawn(flight, course_of(flight), separation_of(flight))


def figures_of_pictures(drawn: Drawn, form: Format, monkeypatch: pytest.MonkeyPatch) -> dict[str, Figure]:
    """Return the figures of all pictures of the page."""
    figures: list[Figure] = []

    def keep(figure: Figure, form: Format) -> bytes:
        figure.set_dpi(form.dpi)
        figures.append(figure)
        return b""

    monkeypatch.setattr(panels, "picture_of", keep)
    monkeypatch.setattr("swath.daemon.processing.trajectory.pictures.picture_of", keep)
    names = [title for title, _, draw, wanted in PICTURES if wanted(drawn) and draw(drawn, form) == b""]
    return dict(zip(names, figures, strict=True))


def number(text: str) -> float:
    return float(text.replace("\u202f", "").replace("−", "-"))


@pytest.mark.parametrize("form", [WIDE, NARROW], ids=["wide", "narrow"])
def test_no_texts_of_any_picture_overlap(drawn: Drawn, form: Format, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {title: overlapping(figure) for title, figure in figures_of_pictures(drawn, form, monkeypatch).items()}
    assert len(found) > 8
    assert {title: pairs for title, pairs in found.items() if pairs} == {}


def test_the_map_is_in_the_crs_of_the_products(flight: Flight, drawn: Drawn) -> None:
    assert drawn.course.chart.name == "ETRS89 / UTM zone 32N"
    axes = map_of(drawn, WIDE).axes[0]
    east_m, north_m = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True).transform(
        *flight.best.position_e.T
    )[:2]
    for axis, values in ((axes.xaxis, east_m), (axes.yaxis, north_m)):
        low, high = axis.get_view_interval()
        assert low < values.min() < values.max() < high
        ticks = [
            (tick, label.get_text()) for tick, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
        ]
        shown = [(tick, text) for tick, text in ticks if low <= tick <= high]
        assert len(shown) >= 3
        assert [number(text) for _, text in shown] == [tick for tick, _ in shown]
    assert drawn.course.place[:, 0] == pytest.approx([east_m[0], north_m[0]], abs=0.01)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Easting (m), ETRS89 / UTM zone 32N", "Northing (m)")


def test_without_a_crs_the_map_is_in_the_zone_of_the_flight(flight: Flight) -> None:
    assert course_of(replace(flight, mapping=None)).chart.name == "WGS 84 / UTM zone 32N"


def test_time_axes_say_utc_and_the_time_since_the_start(
    flight: Flight, drawn: Drawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    for figure in figures_of_pictures(drawn, WIDE, monkeypatch).values():
        for axes in figure.axes:
            if not axes.get_xlabel().startswith("Time since the start (min)"):
                continue
            assert axes.get_xlabel().endswith(f"from {drawn.utc_date}")
            ticks = zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
            for minutes, label in ticks:
                if not 0.0 <= minutes <= flight.duration_s / 60.0:
                    continue
                since, clock = label.get_text().split("\n")
                assert number(since) == minutes
                hours, mins, seconds = (int(part) for part in clock.split(":"))
                of_day_ns = ((hours * 60 + mins) * 60 + seconds) * SECOND_NS
                gps_ns = gps_ns_from_utc(dt.date.fromisoformat(drawn.utc_date), of_day_ns, 18)
                assert gps_ns == pytest.approx(flight.start_ns + minutes * 60 * SECOND_NS, abs=0.51 * SECOND_NS)


def test_straight_flight_is_shaded_and_numbered(flight: Flight, drawn: Drawn, monkeypatch: pytest.MonkeyPatch) -> None:
    spans_ns = straight_flight(flight)
    assert len(spans_ns) > 1
    roll = np.degrees(flight.best.trajectory().attitude()[0])
    inside = np.zeros(len(roll), bool)
    for begin_ns, end_ns in spans_ns:
        inside |= (flight.best.time_ns >= begin_ns) & (flight.best.time_ns < end_ns)
    assert np.abs(roll[inside]).mean() < 5.0
    figure = figures_of_pictures(drawn, WIDE, monkeypatch)["Height and speed"]
    numbers = [text for text in texts_of(figure) if text.get_gid() == "strip"]
    unit_s = 60.0
    for text in numbers:
        begin_s, end_s = drawn.strips_s[int(text.get_text()) - 1]
        assert begin_s / unit_s < text.get_position()[0] < end_s / unit_s
    bars = [one for axes in figure.axes for one in axes.collections if len(one.get_paths()) == len(spans_ns)]
    assert len(bars) == len(figure.axes)
    assert len(draw_height(drawn, NARROW)) == 0


def test_scale_errors_are_drawn_only_where_the_flight_determines_them(flight: Flight) -> None:
    best = flight.best
    assert len(best.gyro_scale_sigma)
    prior = flight.setup.noise.gyro_scale
    sigmas = np.full_like(best.gyro_scale_sigma, prior)
    sigmas[-1, 1] = 0.5 * prior
    known = replace(flight, smoothed=replace(best, gyro_scale_sigma=sigmas, accel_scale_sigma=sigmas * 0.0 + 1.0))
    assert determined_axes(known, "gyro_scale") == [1]
    assert determined_axes(known, "accel_scale") == []
    wanted = {title: wanted for title, _, _, wanted in PICTURES}["Scale factors"]
    assert wanted(Drawn(known, course_of(known), None))
    unknown = replace(
        flight, smoothed=replace(best, gyro_scale_sigma=sigmas * 0.0 + 1.0, accel_scale_sigma=sigmas * 0.0 + 1.0)
    )
    assert not wanted(Drawn(unknown, course_of(unknown), None))


def test_only_doubts_are_notes(flight: Flight) -> None:
    from swath.daemon.processing.trajectory.figures import figures_of
    from swath.daemon.processing.trajectory.verdict import judge

    figures = figures_of(flight, None)
    facts = replace(flight, facts=("Noise by grade tactical",))
    page = page_of(facts, figures, judge(figures, ()), [])
    assert 'class="notes"' not in page
    assert "Noise by grade tactical." in page
    doubted = page_of(replace(facts, notes=("GNSS: a doubt",)), figures, judge(figures, ()), [])
    assert '<ul class="notes">\n<li>GNSS: a doubt</li>' in doubted
