"""Tests the pictures of a quick look: coordinates, colours and words are measured as drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle

from swath.daemon.processing.pages.classes import DZ_LIMITS_M, SIZE_COLOURS
from swath.daemon.processing.quicklook.grids import smoothed
from swath.daemon.processing.quicklook.maps import draw_differences, draw_height
from swath.daemon.processing.quicklook.page import PICTURES
from swath.daemon.processing.quicklook.run import Look
from swath.daemon.processing.quicklook.strips import SHOWN_SIGMA_M
from tests.daemon.builders import EAST_M, NORTH_M, Array, plane
from tests.daemon.processing.pages.builders import overlapping, texts_of
from tests.daemon.processing.quicklook.builders import two_strips

pytestmark = pytest.mark.xdist_group("kernels")
SHIFT_M, NOISE_M = 0.03, 0.03


def noisy(x: Array, y: Array) -> Array:
    """Return heights of a plane with the noise of single returns."""
    return np.asarray(plane(x, y) + np.random.default_rng(len(x) + int(y[0])).normal(0.0, NOISE_M, x.shape))


@pytest.fixture(scope="module")
def look(tmp_path_factory: pytest.TempPathFactory) -> Look:
    return two_strips(tmp_path_factory.mktemp("noisy"), SHIFT_M, noisy)


def drawn(draw: Callable[[Look, Path], None], look: Look, monkeypatch: pytest.MonkeyPatch) -> Figure:
    """Return the figure that a function saves."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw(look, Path("unused.png"))
    return figures[0]


def map_of(figure: Figure) -> Axes:
    return next(axes for axes in figure.axes if axes.get_xlabel().startswith("Easting"))


def hex_of(colour: Any) -> str:
    return str(to_hex(colour))


def number(text: str) -> float:
    return float(text.replace("\u202f", "").replace("−", "-"))


@pytest.mark.parametrize("name", [name for name, *_ in PICTURES if name != "sigma"])
def test_no_texts_overlap_and_minus_signs_are_no_hyphens(
    name: str, look: Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, draw, wanted = next(picture for picture in PICTURES if picture[0] == name)
    assert wanted(look)
    figure = drawn(draw, look, monkeypatch)
    assert overlapping(figure) == []
    assert [text.get_text() for text in texts_of(figure) if text.get_text().startswith("-")] == []


def test_the_axes_of_a_map_bear_the_coordinates_of_the_crs(look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    axes = map_of(drawn(draw_height, look, monkeypatch))
    for axis, low_m, size_m in ((axes.xaxis, EAST_M, 300.0), (axes.yaxis, NORTH_M, 160.0)):
        low, high = axis.get_view_interval()
        told = [
            (tick, label.get_text()) for tick, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
        ]
        inside = [(tick, text) for tick, text in told if low <= tick <= high]
        assert len(inside) >= 3
        for tick, text in inside:
            assert number(text) == tick
            assert "\u202f" in text
            assert low_m - 20.0 <= tick <= low_m + size_m + 20.0


def test_the_scale_bar_is_as_long_as_its_words_say(look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    axes = map_of(drawn(draw_height, look, monkeypatch))
    (bar,) = [patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_gid() == "scale bar"]
    words = next(text.get_text() for text in axes.texts if text.get_text().endswith(" m"))
    west, east = axes.get_xlim()
    assert bar.get_width() * (east - west) == pytest.approx(float(words.removesuffix(" m")))
    assert "N" in [text.get_text() for text in axes.texts]


def test_the_map_of_differences_shows_the_shift_and_not_the_noise(look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second strip is 3 cm higher; a single cell errs by more than a centimetre."""
    cell_m = look.overlap.worst_m[np.isfinite(look.overlap.worst_m)]
    shown_m = look.overlap.shown_m[np.isfinite(look.overlap.shown_m)]
    sigma_m = look.overlap.shown_sigma_m[np.isfinite(look.overlap.shown_sigma_m)]
    assert len(cell_m) == len(shown_m)
    assert float(np.std(cell_m)) > 0.006
    assert float(sigma_m.max()) <= SHOWN_SIGMA_M
    assert float(np.std(shown_m)) < 1.3 * SHOWN_SIGMA_M
    assert float(np.abs(shown_m + SHIFT_M).max()) < 4.0 * SHOWN_SIGMA_M
    figure = drawn(draw_differences, look, monkeypatch)
    image = next(image for image in reversed(map_of(figure).images) if image.get_zorder() == 2.5)
    assert isinstance(image, AxesImage)
    values = np.ma.compressed(np.ma.masked_invalid(np.asarray(image.get_array(), float)))
    colours = {hex_of(image.cmap(image.norm(value))) for value in values.tolist()}
    assert colours == {SIZE_COLOURS[1]}  # 2 to 4 cm everywhere


def test_the_legend_of_differences_names_limits_of_quality_levels_once(
    look: Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [text.get_text() for text in texts_of(drawn(draw_differences, look, monkeypatch))]
    for words in ("|dZ|", "≤ 2 cm", "2–4 cm (QL0)", "4–8 cm (QL1, QL2)", "8–16 cm (QL3)", "> 16 cm"):
        assert texts.count(words) == 1


def test_bars_of_the_histogram_end_at_the_limits_of_classes(look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    figure = drawn(draw_differences, look, monkeypatch)
    axes = next(axes for axes in figure.axes if axes.get_xlabel().startswith("dZ of single cells"))
    bars = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    for bar in bars:
        low_cm, high_cm = sorted(abs(edge) for edge in (bar.get_x(), bar.get_x() + bar.get_width()))
        colour = SIZE_COLOURS.index(hex_of(bar.get_facecolor()))
        below = 0.0 if colour == 0 else 100.0 * DZ_LIMITS_M[colour - 1]
        assert below - 1e-6 <= low_cm < high_cm <= 100.0 * DZ_LIMITS_M[colour] + 1e-6


def test_sigmas_of_differences_predict_the_scatter_of_cells(look: Look) -> None:
    (pair,) = list(look.cells.pairs())
    size = (pair.dz_m + SHIFT_M) / pair.sigma_m
    assert 0.8 < float(np.sqrt(np.mean(size**2))) < 1.1


def test_smoothing_keeps_a_precise_step_and_averages_what_is_noise() -> None:
    row, column = (axis.ravel() for axis in np.indices((40, 40)))
    step = np.where(column < 20, 0.0, 0.1)
    kept, _ = smoothed(step, np.full(1600, 0.001), row, column, 0.002)
    assert kept.tolist() == step.tolist()
    noise = np.random.default_rng(3).normal(0.0, 0.01, 1600)
    mean, sigma = smoothed(step + noise, np.full(1600, 0.01), row, column, 0.004)
    inside = (row > 2) & (row < 37) & ((column < 17) | ((column > 23) & (column < 37)))
    assert float(sigma[inside].max()) == pytest.approx(0.01 / 3.0)  # squares of three by three cells
    assert float(np.std((mean - step)[inside])) == pytest.approx(0.01 / 3.0, rel=0.25)


def test_smoothing_says_when_there_are_too_few_cells() -> None:
    row = np.arange(4)
    _, sigma = smoothed(np.zeros(4), np.full(4, 0.02), row, row, 0.001)
    assert sigma.tolist() == pytest.approx([0.02 / math.sqrt(4)] * 4)
