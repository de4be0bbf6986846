"""Histories of calibrations as a picture."""

from __future__ import annotations

import datetime as dt
import io
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swath.calib.validation.history import BORESIGHT, History

INK, MUTED, COLOURS = "#1d242b", "#5d6770", ("#0072b2", "#d55e00", "#009e73")
DPI, DAY_S = 140, 86_400.0


def history_png(histories: Sequence[History]) -> bytes:
    """Boresight angles with one sigma over time, a column a history."""
    figure = Figure(figsize=(1.0 + 5.0 * max(len(histories), 1), 6.6), facecolor="white", layout="constrained")
    axes = figure.subplots(len(BORESIGHT), max(len(histories), 1), squeeze=False, sharex="col")
    for column, one in enumerate(histories):
        axes[0, column].set_title(f"{one.scanner}, {one.installation}", fontsize=10, color=INK)
        for row, name in enumerate(BORESIGHT):
            _draw(axes[row, column], one, row, name)
    made = io.BytesIO()
    figure.savefig(made, dpi=DPI)
    return made.getvalue()


def _draw(axes: Axes, one: History, row: int, name: str) -> None:
    days = np.array(one.times) / DAY_S  # matplotlib's dates: days since 1970
    key = name.replace("_rad", "_deg")
    table = one.table()
    known = [number for number, entry in enumerate(table) if entry[f"{key}_sigma"]]
    axes.errorbar(
        days[known],
        [table[number][key] for number in known],
        [table[number][f"{key}_sigma"] for number in known],
        fmt="o-",
        color=COLOURS[row],
        ecolor=MUTED,
        capsize=3,
        lw=1.0,
        ms=4.5,
    )
    for trend in one.trends:
        if trend.name == name:
            text = f"{math.degrees(trend.per_year):+.4f} ± {math.degrees(trend.sigma):.4f}° a year"
            axes.text(0.98, 0.04, text, transform=axes.transAxes, ha="right", fontsize=8, color=MUTED)
    axes.set_ylabel(f"{key.removesuffix('_deg')} (°)", fontsize=9, color=INK)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.tick_params(labelsize=8, colors=MUTED)
    axes.xaxis_date(dt.UTC)
    axes.grid(color="#c9cecb", lw=0.4)
    axes.spines[["top", "right"]].set_visible(False)
