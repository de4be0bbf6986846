"""Tests the page of a planned calibration: numbers have units and do not overlap lines or each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from swath.daemon.processing.calibration.plan.page import draw_planned
from swath.daemon.processing.calibration.plan.run import PlannedCalibration, PlanOptions, plan_calibration
from swath.sim.plan.plan import load_plan
from tests.daemon.processing.pages.builders import overlapping, texts_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]


@pytest.fixture(scope="module")
def planned() -> PlannedCalibration:
    return plan_calibration(load_plan("small"), PlanOptions(sigmas=(0.02, 0.004, 0.01)))


@pytest.fixture
def figure(planned: PlannedCalibration, monkeypatch: pytest.MonkeyPatch) -> Figure:
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw_planned(planned, Path("unused.png"))
    return figures[0]


def test_no_texts_overlap(figure: Figure) -> None:
    assert overlapping(figure) == []


def test_every_sigma_has_its_unit_and_two_digits(figure: Figure, planned: PlannedCalibration) -> None:
    words = [text.get_text() for text in texts_of(figure)]
    numbers = [word for word in words if word.startswith("± ")]
    assert len(numbers) == 2 * len(planned.rows)
    for word in numbers:
        assert word.endswith(("°", " m", " ppm", " µs", " µs²")), word
    assert "± 0.005°" in words
    assert "boresight ω (roll)" in words
    assert not [word for word in words if "omega_deg" in word or " deg" in word]


def test_numbers_stand_outside_the_bars_chart(figure: Figure) -> None:
    chart = next(axes for axes in figure.axes if axes.get_xlabel().startswith("predicted sigma"))
    right = chart.get_window_extent().x1
    for text in texts_of(figure):
        if text.get_text().startswith("± "):
            assert text.get_window_extent().x0 > right


def test_the_page_is_used_to_its_right_edge(figure: Figure) -> None:
    boxes = [text.get_window_extent() for text in texts_of(figure)]
    assert max(box.x1 for box in boxes) > 0.95 * figure.bbox.width


def test_planes_lie_on_the_map_of_the_crs(figure: Figure) -> None:
    axes = next(axes for axes in figure.axes if axes.get_xlabel() == "Easting (m)")
    offsets = [np.asarray(one.get_offsets(), float) for one in axes.collections if one.get_zorder() == 6]
    (dots,) = [places for places in offsets if len(places) > 50]
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    assert west < dots[:, 0].min() < dots[:, 0].max() < east
    assert south < dots[:, 1].min() < dots[:, 1].max() < north
