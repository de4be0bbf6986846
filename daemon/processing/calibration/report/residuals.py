"""Draws residuals after the adjustment: by strip, scan angle, range and intensity, and against the
normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from swath.calib.outcome import Residuals
from swath.calib.summary import ReportInput
from swath.daemon.processing.pages.canvas import BAD, INK, MUTED, SERIES, Canvas, Format, Panels, Picture
from swath.georef.arrays import FloatArray, Int64Array

PANEL_IN, NORMAL_IN = 1.7, 2.0
MOST_COLUMNS, MOST_ROWS, EACH = 40, 41, 400  # of the shaded panels; observations per column at least, about
EDGE = 5.0  # sigmas shown
SPREAD = 4.0  # residuals are shown up to this multiple of their root mean square
FEWEST = 20  # observations in a column for which quantiles are drawn
BLUES = LinearSegmentedColormap.from_list("pale to deep", ["#ffffff", "#cfe0ec", "#6fa3c7", "#0b4f7d"])


@dataclass(frozen=True, eq=False)
class Seen:
    """Observations on returns, one row each (n,): the residual and quantities that it may depend on."""

    misclosure_m: FloatArray
    swath: Int64Array
    angle_deg: FloatArray
    range_m: FloatArray
    intensity: FloatArray


def seen_of(report: ReportInput) -> Seen:
    """Return the observations of all groups that were not rejected."""
    pieces: list[tuple[FloatArray, ...]] = []
    for group in report.adjusted.residuals:
        kept = (group.weight > 0.0) & (group.swath >= 0) & (group.at >= 0)
        for index in np.unique(group.swath[kept]).tolist():
            mine = kept & (group.swath == index)
            rows = report.flight.swaths[index].rows[group.at[mine]]
            angle = np.degrees(np.angle(np.exp(1j * rows["encoder_rad"])))  # of spinning heads −180 … 180
            columns = (group.misclosure_m[mine], np.full(len(rows), index), angle, rows["range_m"], rows["intensity"])
            pieces.append(tuple(np.asarray(column, np.float64) for column in columns))
    empty = tuple(np.zeros(0) for _ in range(5))
    values, swath, angle, range_m, intensity = (np.concatenate(parts) for parts in zip(empty, *pieces, strict=True))
    return Seen(values, swath.astype(np.int64), angle, range_m, intensity)


def residual_picture(report: ReportInput) -> Picture | None:
    """Return the distribution of residuals by strip, scan angle, range and intensity; None if there are none."""
    seen = seen_of(report)
    if not len(seen.misclosure_m):
        return None
    columns = int(np.clip(len(seen.misclosure_m) // EACH, 8, MOST_COLUMNS))
    half_cm = 100.0 * SPREAD * float(np.sqrt(np.mean(seen.misclosure_m**2))) + 1e-6
    names = [swath.name for swath in report.flight.swaths]
    titles = ("By strip", "By scan angle (°)", "By range (m)", "By intensity (no unit)")

    def draw(canvas: Canvas) -> None:
        panels = Panels(canvas, titles, PANEL_IN, 0.25)
        swaths = np.unique(seen.swath)
        _columns(panels.axes[0], np.searchsorted(swaths, seen.swath), seen, half_cm, np.arange(len(swaths) + 1) - 0.5)
        words = [names[index] for index in swaths.tolist()]
        long = max(len(word) for word in words) * len(words) > (44 if not canvas.form.narrow else 34)
        panels.axes[0].set_xticks(np.arange(len(swaths)), words, rotation=90 if long else 0, fontsize=7.5)
        for axes, values in zip(panels.axes[1:], (seen.angle_deg, seen.range_m, seen.intensity), strict=True):
            low, high = np.percentile(values, [0.2, 99.8])
            _columns(axes, values, seen, half_cm, np.linspace(low, max(high, low + 1e-6), columns + 1))
        for axes in panels.axes[:: 1 if canvas.form.narrow else 2]:
            axes.set_ylabel("Residual (cm)", fontsize=8.5, color=MUTED)
        canvas.legend(
            [
                Line2D([], [], color=BAD, lw=1.4, label="median"),
                Line2D([], [], color=BAD, lw=0.8, ls=(0, (3, 2)), label="limits of the middle two thirds"),
            ]
        )

    words = (
        "Residuals along the plane's normal, of all accepted observations. The shade shows how many lie at each "
        "place of a column; a median away from zero shows an error that the model does not describe."
    )
    return Picture("Residuals", words, lambda form: 0.25 + Panels.height_in(form, 4, PANEL_IN), draw)


def _columns(axes: Axes, values: NDArray[Any], seen: Seen, half_cm: float, edges: NDArray[Any]) -> None:
    """Draw shares of residuals (cm) by columns of a variable, with their median and the range of two thirds."""
    residual_cm = 100.0 * seen.misclosure_m
    rows = int(np.clip(len(values) // (10 * len(edges)), 11, MOST_ROWS))
    levels = np.linspace(-half_cm, half_cm, rows + 1)
    counts, _, _ = np.histogram2d(values, residual_cm, bins=(edges, levels))
    highest = counts.max(axis=1, keepdims=True)
    shades = np.where(counts > 0.0, counts / np.maximum(highest, 1.0), np.nan).T
    axes.pcolormesh(edges, levels, np.ma.masked_invalid(shades), cmap=BLUES, vmin=0.0, vmax=1.0, rasterized=True)
    order = np.argsort(values, kind="stable")
    cuts = np.searchsorted(values[order], edges)
    at, quantiles = [], []
    for i, (first, last) in enumerate(pairwise(cuts)):
        if last - first >= FEWEST:
            at.append(i)
            quantiles.append(np.percentile(residual_cm[order[first:last]], [16.0, 50.0, 84.0]))
    if at:
        low, middle, high = np.array(quantiles).T
        index = np.array(at)
        for line, width, style in ((low, 0.8, (0, (3, 2))), (middle, 1.4, "-"), (high, 0.8, (0, (3, 2)))):
            axes.hlines(line, edges[index], edges[index + 1], color=BAD, lw=width, ls=style)
    axes.axhline(0.0, color=INK, lw=0.5)
    axes.set_ylim(-half_cm, half_cm)
    axes.set_xlim(float(edges[0]), float(edges[-1]))


def normal_picture(report: ReportInput) -> Picture | None:
    """Return normalised residuals of each group beside the normal distribution; None if there are none."""
    groups = [group for group in report.adjusted.residuals if np.isfinite(group.normalised).any()]
    if not groups:
        return None

    def columns_of(form: Format) -> int:
        return 1 if form.narrow else min(3, len(groups))

    def draw(canvas: Canvas) -> None:
        titles = [f"{group.group.capitalize()}: {len(group.normalised):,}".replace(",", "\u202f") for group in groups]
        panels = Panels(canvas, titles, NORMAL_IN, 0.3, columns_of(canvas.form))
        for i, (axes, group) in enumerate(zip(panels.axes, groups, strict=True)):
            _bars(axes, group, SERIES[i])
            axes.set_xlabel("Residual / sigma", fontsize=8.5, color=MUTED)
        canvas.legend([Line2D([], [], color=INK, lw=1.1, label="normal distribution, sigma 1")])

    words = "Residuals divided by their sigmas (w of data snooping); those beyond ±5 are drawn at the edge."

    def height_in(form: Format) -> float:
        return 0.3 + Panels.height_in(form, len(groups), NORMAL_IN, columns_of(form))

    return Picture("Normalised residuals", words, height_in, draw)


def _bars(axes: Axes, group: Residuals, colour: str) -> None:
    known = group.normalised[np.isfinite(group.normalised)]
    step = 0.2 if len(known) > 2000 else 0.5 if len(known) > 60 else 1.0
    edges = np.arange(-EDGE, EDGE + 0.5 * step, step)
    counts, _ = np.histogram(np.clip(known, -EDGE, EDGE), edges)
    axes.bar(edges[:-1], counts / (len(known) * step), step, align="edge", color=colour, alpha=0.55, lw=0.0)
    middle = np.linspace(-EDGE, EDGE, 201)
    axes.plot(middle, np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi), color=INK, lw=1.1)
    axes.set_yticks([])
    axes.set_xlim(-EDGE, EDGE)
