"""Draws the profile of a quick look: heights along a line, and strips against their mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from swath.daemon.processing.pages.words import DPI, INK, MUTED, shortened, thousands
from swath.daemon.processing.quicklook.profile import Profile, steps_of
from swath.daemon.processing.quicklook.run import Look

PAGE_IN = (9.6, 5.4)
MOST_DRAWN = 150_000
MOST_IN_LEGEND = 12
LEAST_HEIGHT_M = 1.0  # minimum height that the upper panel spans


def draw_profile(look: Look, path: Path) -> None:
    """Draw heights of the corridor's points by strip; below, if strips overlap, the deviation of
    each from their mean.
    """
    profile = look.profile
    assert profile is not None
    line, steps = profile.line, steps_of(profile)
    figure = Figure(figsize=PAGE_IN, facecolor="white")
    if steps.offset_m:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.3, 1.0))
    else:
        upper, lower = figure.subplots(1, 1), None
    figure.subplots_adjust(left=0.085, right=0.885, top=0.855, bottom=0.1, hspace=0.12)
    _points(upper, look, profile)
    if lower is not None:
        for strip, offset_m in steps.offset_m.items():
            lower.plot(steps.along_m, 100 * offset_m, "o-", ms=3.2, lw=1.1, color=look.colours[strip])
        lower.axhline(0.0, color=INK, lw=0.6)
        lower.margins(y=0.15)
        lower.set_ylabel("strip − mean (cm)", fontsize=8.5, color=MUTED)
        lower.yaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value, 0 if value % 1 == 0 else 1)))
    last = upper if lower is None else lower
    last.set_xlabel("Distance from A (m)", fontsize=8.5, color=MUTED)
    last.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value)))
    upper.set_xlim(0.0, line.length_m)
    for axes in figure.axes:
        axes.tick_params(labelsize=8, colors=MUTED, length=3)
        axes.yaxis.set_major_locator(MaxNLocator(7 if axes is upper else 5, steps=[1, 2, 5, 10]))
        axes.grid(color="#7c858c", lw=0.4, alpha=0.35)
        axes.spines[:].set_color("#b9bdb8")
    _legend(upper, look, profile)
    _words(figure, upper, look, profile)
    figure.savefig(path, dpi=DPI)


def _points(axes: Axes, look: Look, profile: Profile) -> None:
    every = max(1, -(-len(profile.along_m) // MOST_DRAWN))
    along_m, height_m, strip = profile.along_m[::every], profile.height_m[::every], profile.strip[::every]
    size = float(np.clip(9000.0 / max(len(along_m), 1), 0.5, 9.0))
    mixed = np.arange(len(along_m)) % 7  # so that no strip lies entirely over another
    for layer in range(7):
        for number in np.unique(strip):
            chosen = (strip == number) & (mixed == layer)
            axes.scatter(along_m[chosen], height_m[chosen], s=size, color=look.colours[int(number)], lw=0, alpha=0.75)
    low, high = float(height_m.min()), float(height_m.max())
    border = max(LEAST_HEIGHT_M - (high - low), 0.08 * (high - low)) / 2
    axes.set_ylim(low - border, high + border)
    digits = 0 if high - low > 6.0 else 1 if high - low > 0.6 else 2
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value, digits)))
    axes.set_ylabel("Height (m)", fontsize=8.5, color=MUTED)


def _legend(axes: Axes, look: Look, profile: Profile) -> None:
    numbers, counts = np.unique(profile.strip, return_counts=True)
    order = numbers[np.argsort(-counts, kind="stable")][:MOST_IN_LEGEND]
    handles = [
        Line2D([], [], ls="", marker="o", ms=5, color=look.colours[number], label=shortened(look.names[number], 16))
        for number in sorted(int(number) for number in order)
    ]
    made = axes.legend(
        handles=handles,
        title="strip" if len(numbers) <= MOST_IN_LEGEND else f"strip ({len(numbers)} in all)",
        loc="upper left",
        bbox_to_anchor=(1.005, 1.0),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )
    made.get_title().set(fontsize=8.5, color=MUTED)
    made.set_alignment("left")


def _words(figure: Figure, axes: Axes, look: Look, profile: Profile) -> None:
    line, units = profile.line, look.units
    width_in = PAGE_IN[0] * axes.get_position().width
    height_in = PAGE_IN[1] * axes.get_position().height
    low, high = axes.get_ylim()
    exaggeration = (line.length_m / width_in) / ((high - low) / height_in)
    digits = 5 if units.name == "°" else 1
    ends = [
        f"{letter} {thousands(end[0] / units.east_m, digits)}, {thousands(end[1] / units.north_m, digits)}"
        for letter, end in (("A", line.start_m), ("B", line.end_m))
    ]
    parts = [
        *ends,
        f"{thousands(line.length_m)} m long, {2 * line.half_width_m:g} m wide",
        f"{thousands(len(profile.along_m))}{'' if profile.complete else ' of the first'} points",
        f"heights {float(f'{exaggeration:.2g}'):g} × exaggerated" if exaggeration >= 1.05 else "",
    ]
    figure.text(0.02, 0.955, f"Profile {line.title}", fontsize=15, weight="bold", color=INK, va="center")
    text = "   ·   ".join(words for words in parts if words)
    figure.text(0.02, 0.907, text, fontsize=9, color=MUTED, va="center")
