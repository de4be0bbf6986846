"""Tests the maps of a calibration's report: coordinates, colours and words are measured as drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from pyproj import Transformer

from swath.calib.features import ControlPoint
from swath.calib.need import Need
from swath.calib.summary import ReportInput
from swath.daemon.processing.calibration.report.cuts import cut_picture
from swath.daemon.processing.calibration.report.maps import (
    PLANE_COLOURS,
    difference_picture,
    map_picture,
    plane_means_m,
    strip_colours,
)
from swath.daemon.processing.calibration.report.pictures import (
    control_picture,
    correlation_picture,
    strips_picture,
    trajectory_pictures,
)
from swath.daemon.processing.calibration.report.residuals import normal_picture, residual_picture
from swath.daemon.processing.pages.canvas import NARROW, PAPER, WIDE, Canvas, Format, Picture
from swath.georef.mapping.chart import chart_of
from swath.georef.mapping.frame import Mapping
from tests.calib.made_outcome import Outcome, made_report
from tests.daemon.processing.pages.builders import overlapping, texts_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]
REQUIRED_M = 0.015


@pytest.fixture(scope="module")
def report(outcome: Outcome) -> ReportInput:
    """Return the input of a report with every part, on the map of UTM zone 32."""
    made = made_report(outcome)
    assert made.differences is not None
    chart = chart_of(Mapping("EPSG:25832", datum="same"), made.flight.trajectories[0].position_e)
    middle = chart.map_from_e(made.flight.frame.origin_e[np.newaxis])[0]
    grid = replace(made.differences, west_m=float(middle[0]) - 240.0, south_m=float(middle[1]) - 200.0)
    need = Need(REQUIRED_M, {}, 0.03, {})
    return replace(made, chart=chart, differences=grid, need=need)


def drawn(picture: Picture | None, form: Format = WIDE) -> Figure:
    """Return the figure of a picture in a format."""
    assert picture is not None
    height_in = picture.height_in(form)
    figure = Figure(figsize=(form.width_in, height_in), facecolor="white")
    picture.draw(Canvas(figure, form, height_in))
    return figure


def maps_of(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.get_xlabel().startswith("Easting")]


def number(text: str) -> float:
    return float(text.replace("\u202f", "").replace("−", "-"))


@pytest.mark.parametrize("form", [WIDE, NARROW, PAPER], ids=["wide", "narrow", "paper"])
def test_no_texts_of_any_picture_overlap(report: ReportInput, form: Format) -> None:
    pictures = [
        map_picture(report),
        difference_picture(report),
        cut_picture(report),
        correlation_picture(report),
        strips_picture(report),
        control_picture(report),
        residual_picture(report),
        normal_picture(report),
        *trajectory_pictures(report),
    ]
    found = {picture.title: overlapping(drawn(picture, form)) for picture in pictures if picture is not None}
    assert {title: pairs for title, pairs in found.items() if pairs} == {}


def test_no_legend_names_a_mark_twice(report: ReportInput) -> None:
    first, *others = report.features.planes
    of_control = replace(first, kind="control", control=(ControlPoint("K1", first.centre_t, 0.02),))
    shown = replace(report, features=replace(report.features, planes=(of_control, *others)))
    words = [text.get_text() for legend in drawn(map_picture(shown)).legends for text in legend.get_texts()]
    assert "control" in words
    named = [word for word in words if word.strip()]
    assert sorted(named) == sorted(set(named))


def test_minus_signs_are_no_hyphens(report: ReportInput) -> None:
    for picture in (difference_picture(report), correlation_picture(report), control_picture(report)):
        words = [text.get_text() for text in texts_of(drawn(picture))]
        assert any("−" in word for word in words)
        assert [word for word in words if word.startswith("-") or " -" in word] == []


@pytest.mark.parametrize("make", [map_picture, difference_picture])
def test_the_axes_bear_the_coordinates_of_the_crs(report: ReportInput, make: object) -> None:
    assert callable(make)
    place = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    east_m, north_m = place.transform(*report.flight.frame.origin_e)[:2]
    for axes in maps_of(drawn(make(report))):
        for axis, middle_m in ((axes.xaxis, east_m), (axes.yaxis, north_m)):
            low, high = axis.get_view_interval()
            assert low < middle_m < high
            ticks = list(zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True))
            shown = [(tick, label.get_text()) for tick, label in ticks if low <= tick <= high]
            assert len(shown) >= 2
            assert [number(text) for _, text in shown] == [tick for tick, _ in shown]


def test_differences_lie_where_they_were_measured(report: ReportInput) -> None:
    grid = report.differences
    assert grid is not None
    axes = maps_of(drawn(difference_picture(report)))[0]
    (image,) = axes.images
    corner = image.get_transform().transform([[0.0, 0.0], [1.0, 1.0]])
    low, high = axes.transData.inverted().transform(corner)
    rows, columns = grid.before_m.shape
    assert low == pytest.approx([grid.west_m, grid.south_m], abs=0.01)
    assert high - low == pytest.approx([grid.cell_m * columns, grid.cell_m * rows], abs=0.01)


def test_a_grid_in_t_is_turned_onto_the_map(report: ReportInput) -> None:
    """Without a CRS the cells lie in t, whose north differs from grid north."""
    assert report.differences is not None
    grid = replace(report.differences, west_m=-240.0, south_m=-200.0, in_t=True)
    axes = maps_of(drawn(difference_picture(replace(report, chart=None, differences=grid))))[0]
    (image,) = axes.images
    share = [[0.5, 200.0 / (grid.before_m.shape[0] * grid.cell_m)]]
    place = axes.transData.inverted().transform(image.get_transform().transform(share))[0]
    middle = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True).transform(*report.flight.frame.origin_e)
    assert place == pytest.approx(middle[:2], abs=0.5)  # t's plane is level, at the height of the ground


def test_the_colour_of_a_plane_is_the_class_of_its_mean(report: ReportInput) -> None:
    """1.5 cm are required, so limits are 0.75, 1.5 and 3 cm; strip 3 is 6 mm off, single returns scatter by 2 cm."""
    axes = maps_of(drawn(map_picture(report)))[0]
    counts = dict.fromkeys(PLANE_COLOURS, 0)
    for line in axes.lines:
        if line.get_marker() in ("^", "o") and to_hex(line.get_color()) in counts:
            counts[to_hex(line.get_color())] += len(np.atleast_1d(line.get_xdata()))
    means_m = plane_means_m(report)
    expected, _ = np.histogram(means_m[np.isfinite(means_m)], [0.0, 0.0075, 0.015, 0.03, np.inf])
    assert list(counts.values()) == expected.tolist()
    words = [text.get_text() for text in texts_of(drawn(map_picture(report)))]
    for word in ("≤ 0.75 cm", "0.75–1.5 cm", "1.5–3 cm", "> 3 cm"):
        assert words.count(word) == 1


def test_strips_over_one_village_have_different_colours(report: ReportInput) -> None:
    colours = strip_colours(report.flight)
    assert len(colours) == len(report.flight.swaths) == len(set(colours))
