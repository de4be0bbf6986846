"""A profile as a picture: both swaths' heights along it, as the points lay and with what the profile found."""

from __future__ import annotations

import io
import textwrap
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from swath.calib.profiles.stepwise import Profile, Section
from swath.daemon.processing.pages.canvas import INK, MUTED

PAGE_IN = (9.6, 4.6)
COLOURS = ("#0072b2", "#d55e00")  # first, second; told apart without colour by their marks too
MARKS = ("o", "^")
MOST_DRAWN = 1500  # of each section; more would only make the file large
WINDOW_M = 160.0  # shown of a profile along track: the part with the most relief
_SVG: Any = {"svg.hashsalt": "profile", "svg.fonttype": "path"}


def draw(profile: Profile) -> Figure:
    """Two panels, before and after, over the distance along the profile (of a range: to the right of the track)."""
    figure = Figure(figsize=PAGE_IN, facecolor="white")
    panels: list[Axes] = list(figure.subplots(1, 2, sharex=True, sharey=True))
    low, high = _window(profile)
    for axes, sections, title in zip(panels, (profile.before, profile.after), ("Before", "After"), strict=True):
        for section, name, colour, mark in zip(sections, profile.names, COLOURS, MARKS, strict=True):
            distance_m, height_m = _thinned(section, low, high)
            size = float(np.clip(5000.0 / max(len(distance_m), 1), 2.0, 30.0))
            axes.scatter(distance_m, height_m, s=size, marker=mark, color=colour, lw=0, alpha=0.6, label=name)
        axes.set_title(title, loc="left", fontsize=9, color=INK)
        axes.set_xlabel(
            "To the right of the track (m)" if profile.kind == "range" else "Along the profile (m)",
            fontsize=8.5,
            color=MUTED,
        )
        axes.tick_params(labelsize=8, colors=MUTED, length=3)
        axes.grid(color="#7c858c", lw=0.4, alpha=0.35)
        axes.spines[:].set_color("#b9bdb8")
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    panels[0].set_ylabel(
        "Laser less survey (m)" if profile.kind == "range" else "Height (m)", fontsize=8.5, color=MUTED
    )
    panels[1].legend(loc="upper right", fontsize=8, frameon=False, labelcolor=INK, markerscale=1.5)
    _words(figure, profile)
    return figure


def svg(profile: Profile) -> str:
    """The picture as SVG, the same for the same profile."""
    text = io.StringIO()
    with mpl.rc_context(_SVG):
        draw(profile).savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def _window(profile: Profile) -> tuple[float, float]:
    """From where to where it is drawn."""
    section = profile.after[0] if profile.kind == "range" else profile.before[0]  # all targets are seen in the end
    low, high = (float(end) for end in (section.distance_m.min(), section.distance_m.max()))
    if profile.kind in ("roll", "range") or high - low <= WINDOW_M:
        return low - 0.5, high + 0.5
    begins = np.arange(low, high - WINDOW_M + 1.0, WINDOW_M / 8)
    relief = [np.std(section.height_m[_between(section, begin, begin + WINDOW_M)]) for begin in begins]
    begin = float(begins[int(np.nanargmax(relief))])
    return begin, begin + WINDOW_M


def _between(section: Section, low: float, high: float) -> Any:
    return (section.distance_m >= low) & (section.distance_m <= high)


def _thinned(section: Section, low: float, high: float) -> tuple[Any, Any]:
    inside = np.flatnonzero(_between(section, low, high))
    inside = inside[:: max(1, -(-len(inside) // MOST_DRAWN))]
    return section.distance_m[inside], section.height_m[inside]


def _words(figure: Figure, profile: Profile) -> None:
    figure.subplots_adjust(left=0.075, right=0.985, top=0.745, bottom=0.11, wspace=0.06)
    between = f"{profile.names[0]} and {profile.names[1]}"
    figure.text(0.02, 0.945, f"{profile.kind.capitalize()}: {between}", fontsize=13, weight="bold", color=INK)
    unit, factor = ("m", 1.0) if profile.kind == "range" else ("°", float(np.degrees(1.0)))
    digits = 4 if unit == "m" else 5
    measured = (
        f"separation {profile.separation_m:+.3f} ± {profile.separation_sigma_m:.3f} m, "
        f"found {factor * profile.found:+.{digits}f} ± {factor * profile.sigma:.{digits}f}{'' if unit == '°' else ' '}"
        f"{unit}, {profile.pieces} {'targets' if profile.kind == 'range' else 'pieces of ground'}"
    )
    lines = [*textwrap.wrap(profile.formula, 130), measured]
    figure.text(0.02, 0.92, "\n".join(lines), fontsize=8.5, color=MUTED, va="top", linespacing=1.35)
