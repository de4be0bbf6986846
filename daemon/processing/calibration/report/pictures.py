"""Draws the estimates: correlations, strips before and after, control, trajectory, tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FuncFormatter, NullFormatter

from swath.calib.labels import number, unknown
from swath.calib.outcome import TrajectoryFit
from swath.calib.summary import Pair, ReportInput
from swath.daemon.processing.pages.canvas import (
    AFTER,
    BAD,
    BEFORE,
    INK,
    MOST_MARKS,
    MUTED,
    SERIES,
    Canvas,
    Format,
    Panels,
    Picture,
    colour_of,
)
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.timescales.gps_time import SECOND_NS

MOST_CELLS = 60  # maximum unknowns in the correlation matrix
MOST_PAIRS = 30
MOST_CONTROL = 60
SUSPECT = 3.29  # exceeded by |w| of one sound observation in a thousand (Baarda 1968)
# RMSDz of swath overlap, USGS Lidar Base Specification
SWATH_LIMITS_CM = ((4.0, "QL0"), (8.0, "QL1, QL2"), (16.0, "QL3"))


def correlation_picture(report: ReportInput) -> Picture | None:
    """Return the correlation matrix of the unknowns with its numbers; None if there are fewer than two."""
    adjusted = report.adjusted
    if len(adjusted.names) < 2:
        return None
    count = min(len(adjusted.names), MOST_CELLS)
    several = len(adjusted.calibrations) > 1
    words = [_symbol(name, several=several) for name in adjusted.names[:count]]
    long = [unknown(name).words for name in adjusted.names[:count]]
    matrix = adjusted.correlation[:count, :count]
    room = 0.95 if several or any(len(word) > 4 for word in words) else 0.55

    def left_in(form: Format) -> float:
        return room if form.narrow or several or count > 20 else 1.7

    def cell_in(form: Format) -> float:
        return min((form.width_in - left_in(form) - 0.15) / count, 0.62)

    def draw(canvas: Canvas) -> None:
        cell = cell_in(canvas.form)
        left = left_in(canvas.form)
        axes = canvas.panel(left, room, cell * count, cell * count)
        axes.grid(visible=False)
        axes.set(xlim=(0, count), ylim=(count, 0))
        _cells(axes, matrix, cell)
        size = min(9.0, max(4.0, cell * 24.0))
        axes.xaxis.tick_top()
        axes.set_xticks(np.arange(count) + 0.5, words, rotation=90 if room > 0.6 else 0, fontsize=size, color=INK)
        axes.set_yticks(np.arange(count) + 0.5, words if left == room else long, fontsize=size, color=INK)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)

    more = f" The first {count} of {len(adjusted.names)} unknowns." if len(adjusted.names) > count else ""
    text = (
        "Correlations of the unknowns after the adjustment; beyond ±0.95 two unknowns can hardly be separated." + more
    )
    return Picture("Correlations", text, lambda form: room + cell_in(form) * count + 0.1, draw)


def _symbol(name: str, *, several: bool) -> str:
    one = unknown(name)
    return f"{one.scanner} {one.symbol}" if several else one.symbol


def _cells(axes: Axes, matrix: FloatArray, cell_in: float) -> None:
    colours, norm = colormaps["RdBu_r"], Normalize(-1.25, 1.25)
    size = min(8.5, cell_in * 17.0)
    for (row, column), value in np.ndenumerate(matrix):
        own = row == column
        face = "#e4e7e2" if own else colours(norm(float(value)))
        axes.add_patch(Rectangle((column + 0.03, row + 0.03), 0.94, 0.94, fc=face, ec="none"))
        if size >= 3.4:
            text = "1" if own else number(float(value), ".2f").replace("0.", ".", 1)
            ink = MUTED if own else "white" if abs(value) > 0.75 else INK
            axes.text(column + 0.5, row + 0.52, text, fontsize=size, color=ink, ha="center", va="center")


def strips_picture(report: ReportInput) -> Picture | None:
    """Return the root mean square of height differences by pair of strips, before and after; None without pairs."""
    pairs: list[Pair] = sorted(report.after, key=lambda pair: -report.after[pair].rms_m)[:MOST_PAIRS]
    if not pairs:
        return None
    row_in = 0.21

    def draw(canvas: Canvas) -> None:
        words = [f"{first} – {second}" for first, second in pairs]
        room = 0.25 + 0.075 * max(len(word) for word in words)
        axes = canvas.panel(room, 0.35, canvas.form.width_in - room - 0.15, row_in * len(pairs))
        at = np.arange(len(pairs))
        after_cm = np.array([100.0 * report.after[pair].rms_m for pair in pairs])
        for i, pair in enumerate(pairs):
            if pair in report.before:
                before_cm = 100.0 * report.before[pair].rms_m
                axes.plot([before_cm, after_cm[i]], [i, i], color="#c9ccc7", lw=1.4, zorder=2)
                axes.plot(before_cm, i, "o", ms=5, color="white", mec=BEFORE, mew=1.3, zorder=3)
        axes.plot(after_cm, at, "o", ms=5.5, color=AFTER, zorder=4)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(min(low, 1.0), max(high, 10.0))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        for limit_cm, word in SWATH_LIMITS_CM:
            axes.axvline(limit_cm, color=MUTED, lw=0.8, ls=(0, (4, 3)), zorder=1)
            axes.text(limit_cm, 1.01, word, transform=axes.get_xaxis_transform(), fontsize=7, color=MUTED, ha="center")
        axes.set_yticks(at, words, fontsize=8, color=INK)
        axes.set_ylim(len(pairs) - 0.5, -0.5)
        axes.set_xlabel("RMSDz (cm)", fontsize=8.5, color=MUTED)
        canvas.legend(
            [
                Line2D([], [], marker="o", ls="", ms=5, color="white", mec=BEFORE, mew=1.3, label="before"),
                Line2D([], [], marker="o", ls="", ms=5.5, color=AFTER, label="after"),
            ]
        )

    more = f" The {MOST_PAIRS} worst of {len(report.after)}." if len(report.after) > MOST_PAIRS else ""
    words = "Dashed lines: limits of RMSDz in swath overlap, USGS Lidar Base Specification." + more
    return Picture("Strips against each other", words, lambda form: 0.35 + row_in * len(pairs) + 0.55, draw)


def control_picture(report: ReportInput) -> Picture | None:
    """Return how far the laser lies above control points; None if there are none."""
    points = report.adjusted.control[:MOST_CONTROL]
    if not points:
        return None

    def draw(canvas: Canvas) -> None:
        axes = canvas.panel(0.6, 0.3, canvas.form.width_in - 0.7, 1.7)
        at = np.arange(len(points))
        value_cm = np.array([-100.0 * point.misclosure_m for point in points])
        sigma_cm = np.array([100.0 * point.sigma_m for point in points])
        bad = np.array([abs(point.normalised) > SUSPECT for point in points])
        for mine, colour in ((~bad, AFTER), (bad, BAD)):
            style: dict[str, Any] = {"fmt": "o", "ms": 4.5, "lw": 0.0, "elinewidth": 1.1, "capsize": 2.5}
            axes.errorbar(at[mine], value_cm[mine], sigma_cm[mine], color=colour, **style)
        axes.axhline(0.0, color=INK, lw=0.7)
        steep = canvas.form.narrow or len(points) > 16
        names = [point.name for point in points]
        axes.set_xticks(at, names, fontsize=7.5, rotation=90 if steep else 0)
        axes.set_xlim(-0.6, len(points) - 0.4)
        axes.set_ylabel("Laser above control (cm)", fontsize=8.5, color=MUTED)
        axes.margins(y=0.15)

    room = 0.07 * max(len(point.name) for point in points)

    def height_in(form: Format) -> float:
        return 2.35 + (room if form.narrow or len(points) > 16 else 0.0)

    return Picture("Control", "Height of the laser above the surveyed points, with one sigma.", height_in, draw)


def trajectory_pictures(report: ReportInput) -> list[Picture]:
    """Return a picture of the corrections of each session's trajectory."""
    fit = report.adjusted.trajectory
    if fit is None:
        return []
    sessions = np.unique(fit.trajectory_index)
    return [_trajectory_picture(fit, int(number), several=len(sessions) > 1) for number in sessions]


TURNS = ("Turn about north (0.001°)", "Turn about east (0.001°)", "Turn about down (0.001°)")
SHIFTS = ("North (cm)", "East (cm)", "Down (cm)")


def _trajectory_picture(fit: TrajectoryFit, trajectory_index: int, *, several: bool) -> Picture:
    mine = np.flatnonzero(fit.trajectory_index == trajectory_index)
    mine = mine[np.argsort(fit.time_ns[mine], kind="stable")]
    minutes = (fit.time_ns[mine] - fit.time_ns[mine[0]]) / (60.0 * SECOND_NS)
    broken = _breaks(minutes)
    thousandths = 1000.0 * math.degrees(1.0)
    rows = [
        *zip(*(100.0 * table[mine].T for table in _tables(fit, "position")), strict=True),
        *zip(*(thousandths * table[mine].T for table in _tables(fit, "attitude")), strict=True),
    ]
    at, on_strips = np.insert(minutes, broken, np.nan), np.insert(fit.strip[mine], broken, 0) > 0
    titles = [*SHIFTS, *TURNS]
    panel_in = 1.25

    def draw(canvas: Canvas) -> None:
        order = range(6) if canvas.form.columns == 1 else (0, 3, 1, 4, 2, 5)
        panels = Panels(canvas, [titles[k] for k in order], panel_in, 0.3)
        for axes, k in zip(panels.axes, order, strict=True):
            value, sigma, prior = (np.insert(row, broken, np.nan) for row in rows[k])
            axes.fill_between(at, -prior, prior, color=MUTED, alpha=0.13, lw=0.0)
            axes.fill_between(at, value - sigma, value + sigma, color=AFTER, alpha=0.25, lw=0.0)
            axes.plot(at, value, color=AFTER, lw=1.0)
            axes.axhline(0.0, color=INK, lw=0.5)
            (dots,) = axes.plot(at[on_strips], value[on_strips], ".", ms=2.6, color=SERIES[1])
            dots.set_rasterized(bool(6 * np.count_nonzero(on_strips) > MOST_MARKS))
            axes.margins(x=0.0)
        for axes in panels.axes[-canvas.form.columns :]:
            axes.set_xlabel("Time since the first knot (min)", fontsize=8.5, color=MUTED)
        canvas.legend(
            [
                Line2D([], [], color=AFTER, lw=1.4, label="correction"),
                Patch(fc=AFTER, alpha=0.25, label="± its sigma"),
                Patch(fc=MUTED, alpha=0.2, label="± sigma before"),
                Line2D([], [], color=SERIES[1], marker=".", ls="", label="on strips"),
            ]
        )

    title = f"Corrections of the trajectory{f', session {trajectory_index + 1}' if several else ''}"
    words = "Corrections that are added to the trajectory, estimated together with the calibration."
    return Picture(title, words, lambda form: 0.3 + Panels.height_in(form, 6, panel_in), draw)


def _breaks(minutes: FloatArray) -> Int64Array:
    """Return the indexes at which a line would join stretches flown long apart."""
    steps = np.diff(minutes)
    return np.flatnonzero(steps > 5.0 * np.median(steps)) + 1 if len(steps) else np.zeros(0, np.int64)


def _tables(fit: TrajectoryFit, kind: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    if kind == "position":
        return fit.position_l, fit.position_sigma_l, fit.prior_position_sigma_l
    return fit.attitude_rad, fit.attitude_sigma_rad, fit.prior_attitude_sigma_rad


def intensity_picture(report: ReportInput) -> Picture | None:
    """Return range corrections by intensity if they were estimated or given; else None."""
    known = [(name, one.ibrc) for name, one in report.adjusted.calibrations.items() if one.ibrc is not None]
    if not known:
        return None

    def draw(canvas: Canvas) -> None:
        axes = canvas.panel(0.6, 0.3, canvas.form.width_in - 0.7, 1.7)
        for i, (_, (intensity, correction_m)) in enumerate(known):
            axes.plot(intensity, 1000.0 * correction_m, "-", lw=1.1, color=colour_of(i))
        axes.set_xlabel("Intensity (no unit)", fontsize=8.5, color=MUTED)
        axes.set_ylabel("Correction (mm)", fontsize=8.5, color=MUTED)
        canvas.legend([Line2D([], [], color=colour_of(i), label=name) for i, (name, _) in enumerate(known)])

    return Picture(
        "Range correction by intensity", "This correction is subtracted from the range.", lambda form: 2.55, draw
    )
