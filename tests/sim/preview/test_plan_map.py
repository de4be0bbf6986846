"""Tests a plan's page: coordinates, colours and words are measured as drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from pyproj import Transformer

from swath.sim.plan.plan import parse_plan
from swath.sim.preview.chart import Chart
from swath.sim.preview.coverage import Survey
from swath.sim.preview.picture import draw_plan
from tests.daemon.processing.pages.builders import overlapping, texts_of
from tests.sim.preview.builders import FLAT, flat_plan, line


def parallel(count: int) -> list[str]:
    """Return lines side by side, whose swaths overlap, and one across them."""
    lines = [line(f"{n:02d}", f"-2000.0, {200.0 * n}", f"2000.0, {200.0 * n}") for n in range(count)]
    return [*lines, line("cross", "0.0, -500.0", f"0.0, {200.0 * count}", 900.0)]


def drawn(text: str, monkeypatch: pytest.MonkeyPatch) -> Figure:
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw_plan(parse_plan(text, Path()), Path("unused.png"))
    return figures[0]


def number(text: str) -> float:
    return float(text.replace("\u202f", "").replace("−", "-"))


def test_places_are_those_of_the_crs_also_far_from_the_origin() -> None:
    survey = Survey(flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0")))
    chart = Chart(survey)
    assert chart.name == "WGS 84 / UTM zone 32N"
    places = np.array([[0.0, 0.0], [30_000.0, -20_000.0], [-200_000.0, 100_000.0]])
    ground = survey.site.site_from_ground(places[:, 0], places[:, 1], np.full(3, 400.0))
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    expected = np.column_stack(to_map.transform(*survey.site.e_from_site(ground).T)[:2])
    assert chart.place(places) == pytest.approx(expected, abs=1e-3)
    assert chart.back(chart.place(places)) == pytest.approx(places, abs=0.05)


def test_without_metres_the_map_is_in_the_utm_zone() -> None:
    plan = flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0")).changed({"flight": {"crs": "EPSG:4326"}})
    assert Chart(Survey(plan)).name == "WGS 84 / UTM zone 32N"


def test_lines_side_by_side_have_different_colours() -> None:
    colours = Chart(Survey(flat_plan(*parallel(12)))).colours
    assert len(colours) == 13
    assert all(colours[n] != colours[m] for n in range(12) for m in (n + 1, n + 2) if m < 12)
    assert colours[12] not in colours[:12]


def test_the_axes_of_the_map_bear_the_coordinates_of_the_crs(monkeypatch: pytest.MonkeyPatch) -> None:
    figure = drawn(FLAT + line("a", "-500.0, 0.0", "500.0, 0.0"), monkeypatch)
    axes = next(axes for axes in figure.axes if axes.get_xlabel() == "Easting (m)")
    assert axes.get_ylabel() == "Northing (m)"
    survey = Survey(flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0")))
    middle = Chart(survey).place(np.zeros((1, 2)))[0]
    for axis, middle_m in zip((axes.xaxis, axes.yaxis), middle, strict=True):
        low, high = axis.get_view_interval()
        assert low < middle_m < high
        ticks = zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
        shown = [(tick, label.get_text()) for tick, label in ticks if low <= tick <= high]
        assert len(shown) >= 3
        assert [number(text) for _, text in shown] == [tick for tick, _ in shown]


def test_small_maps_bear_the_coordinates_of_the_crs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each coordinate is written where the line of its easting or northing meets the edge."""
    lines = line("a", "-500.0, 0.0", "500.0, 0.0"), line("b", "0.0, -500.0", "0.0, 500.0")
    figure, chart = drawn(FLAT + "".join(lines), monkeypatch), Chart(Survey(flat_plan(*lines)))
    maps = [axes for axes in figure.axes if not axes.get_xlabel() and axes.images and len(axes.get_xticks()) == 0]
    assert len(maps) == 2
    for axes in maps:
        words = [text for text in axes.texts if "\u202f" in text.get_text()]
        upright = [text.get_rotation() == 90.0 for text in words]
        assert True in upright
        assert False in upright
        for text in words:
            x, y = axes.transData.inverted().transform(axes.transAxes.transform(text.get_position()))
            edge = [axes.get_xlim()[0], y] if text.get_rotation() else [x, axes.get_ylim()[0]]
            place = chart.place(np.array([edge]))[0][int(text.get_rotation() == 90.0)]
            assert number(text.get_text()) == pytest.approx(place, abs=2.0)


def test_names_of_lines_that_begin_at_one_place_do_not_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = [("500.0, 0.0", "-500.0, 0.0"), ("500.0, 20.0", "-500.0, 20.0"), ("-500.0, 10.0", "500.0, 10.0")]
    names = ["low-west-aside", "high-west-aside", "low-east"]
    lines = [line(name, *both) for name, both in zip(names, ends, strict=True)]
    figure = drawn(FLAT + "".join(lines), monkeypatch)
    assert set(names) <= {text.get_text() for text in texts_of(figure)}
    assert overlapping(figure) == []


@pytest.mark.slow
@pytest.mark.parametrize("lines", [1, 12])
def test_no_texts_overlap(lines: int, monkeypatch: pytest.MonkeyPatch) -> None:
    figure = drawn(FLAT + "".join(parallel(lines)), monkeypatch)
    assert overlapping(figure) == []


def test_a_column_without_any_number_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [text.get_text() for text in texts_of(drawn(FLAT + line("a", "-500.0, 0.0", "500.0, 0.0"), monkeypatch))]
    assert "overlap of\nneighbour" not in alone
    assert "–" not in alone
    beside = [text.get_text() for text in texts_of(drawn(FLAT + "".join(parallel(2)), monkeypatch))]
    assert "overlap of\nneighbour" in beside
