"""Shows profiles in the report: their results beside the adjustment's, each with its formula, and pictures of the most
precise.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.labels import decimals_of, number, unknown, with_sigma
from swath.calib.profiles.check import Check, Comparison
from swath.calib.profiles.measure import Ground
from swath.calib.profiles.sections import Corridor, fit_pieces
from swath.calib.profiles.stepwise import Profile, Section
from swath.calib.summary import Profile as Picture
from swath.daemon.processing.pages.blocks import Table, Words
from swath.daemon.processing.pages.canvas import INK, MOST_MARKS, MUTED, RASTER_DPI

PAGE_IN = (9.6, 4.2)
COLOURS = ("#0072b2", "#d55e00")  # first, second; their marks differ too, for readers who cannot see the colours
MARKS = ("o", "^")
MOST_POINTS = 1500  # of each section; more would only enlarge the file
WINDOW_M = 160.0  # length of a profile along track that is shown: the part with the most relief
_SVG: Any = {"svg.hashsalt": "profile", "svg.fonttype": "path", "axes.unicode_minus": True}

MOST_DRAWN = 6
MOST_RETURNS = 8000
DOUBTFUL = 3.0
TITLE = "Profiles as an independent check"
UNDER = (
    "Roll, pitch, heading and range from profile pairs over the areas of the stepwise procedure, on the uncorrected "
    "trajectory, with all other parameters as adjusted. Both methods share the flight and its trajectory's errors: "
    "the sigma of the difference covers only the errors that they do not share."
)


def comparison_table(checked: Check) -> Table | Words | None:
    """Return a table of profiles' results, the adjustment's, and the difference in sigmas; also kinds without a
    profile. If no kind has one, there are only words.
    """
    if not checked.comparisons and not checked.missing:
        return None
    several = len({one.scanner for one in checked.comparisons} | {scanner for scanner, _ in checked.missing}) > 1
    rows = [_compared(one, several=several) for one in checked.comparisons]
    lost = "; ".join(f"{kind} has no profiles: {why}" for (_, kind), why in checked.missing.items())
    under = f"{UNDER} {lost[:1].upper()}{lost[1:]}{'.' if lost else ''}".strip()
    if not rows:
        return Words(under, TITLE)
    heads = ("parameter", "unit", "profiles", "by profiles", "sigma", "by adjustment", "sigma", "difference / sigma")
    return Table(TITLE, heads, rows, under)


def _compared(one: Comparison, *, several: bool) -> list[str]:
    named = unknown(f"{one.scanner}.{one.parameter}")
    results = ((one.told, one.told_sigma), (one.adjusted, one.adjusted_sigma or one.told_sigma))
    patterns = [f".{decimals_of(sigma * named.factor)}f" for _, sigma in results]
    told, adjusted = (
        number(named.factor * value, pattern) for (value, _), pattern in zip(results, patterns, strict=True)
    )
    told_sigma, sigma = (
        number(named.factor * value, pattern)
        for value, pattern in zip((one.told_sigma, one.adjusted_sigma), patterns, strict=True)
    )
    words = f"{one.scanner}: {named.words}" if several else named.words
    apart = number(one.normalised, "+.1f") + (" !" if abs(one.normalised) > DOUBTFUL else "")
    return [words, named.unit, str(one.profiles), told, told_sigma, adjusted, sigma, apart]


def profiles_table(checked: Check) -> Table | None:
    """Return a table of every profile: strips, separation, baseline."""
    rows = [
        [
            profile.kind,
            f"{profile.names[0]} and {profile.names[1]}",
            number(profile.separation_m, f"+.{decimals_of(profile.separation_sigma_m)}f"),
            number(profile.separation_sigma_m, f".{decimals_of(profile.separation_sigma_m)}f"),
            "–" if profile.kind == "range" else number(profile.baseline_m, ".1f"),
            str(profile.pieces),
        ]
        for profile in checked.profiles
    ]
    heads = ("kind", "strips", "separation, m", "sigma, m", "baseline, m", "pieces")
    under = "Measured on the adjusted points: the separations are residual. The appendix gives each one's formula."
    return Table("", heads, rows, under, left=(0, 1)) if rows else None


def formulas_table(checked: Check) -> Table | None:
    """Return a table of the formula of every profile, with its numbers."""
    rows = [
        [profile.kind, f"{profile.names[0]} and {profile.names[1]}", profile.formula] for profile in checked.profiles
    ]
    return Table("Formulas of the profiles", ("kind", "strips", "formula"), rows, left=(0, 1, 2)) if rows else None


def pictures(checked: Check, at_start: Flight, control: Sequence[ControlPoint] = ()) -> list[Picture]:
    """Return pictures of the profiles that `most_precise` chooses."""
    return [
        Picture(f"Profile for {shown.kind}: {shown.names[0]} and {shown.names[1]}", "", svg(shown))
        for shown in most_precise(checked, at_start, control)
    ]


def most_precise(checked: Check, at_start: Flight, control: Sequence[ControlPoint] = ()) -> list[Profile]:
    """Return the most precise profiles of each kind, with points before as at the start and after as adjusted.

    The result of a profile is not applied to the points after, so that they show the errors that the adjustment left.

    Args:
        checked: profiles, measured with the points as adjusted.
        at_start: the flight with its points as placed at the start.
        control: the surveyed points, which range profiles compare the ground with.
    """
    found = []
    for profile in _surest(checked.profiles):
        before = _targets if profile.kind == "range" else _sections
        found.append(replace(profile, before=before(profile, at_start, control), after=profile.before))
    return found


def _surest(profiles: Sequence[Profile]) -> list[Profile]:
    """Return the most precise profile of every pair and kind, kinds in turn, up to `MOST_DRAWN`."""
    pairs: dict[tuple[str, int, int], Profile] = {}
    for profile in sorted(profiles, key=lambda one: one.noise_sigma):
        pairs.setdefault((profile.kind, profile.first, profile.second), profile)
    kinds: dict[str, list[Profile]] = {}
    for profile in pairs.values():
        kinds.setdefault(profile.kind, []).append(profile)
    deepest = max((len(several) for several in kinds.values()), default=0)
    in_turn = [several[depth] for depth in range(deepest) for several in kinds.values() if depth < len(several)]
    return in_turn[:MOST_DRAWN]


def _sections(profile: Profile, flight: Flight, control: Sequence[ControlPoint]) -> tuple[Section, Section]:
    """Return both strips' returns along the profile, as this flight places them."""
    corridor = Corridor.between(profile.ends_t[0], profile.ends_t[1], profile.cells[0].half_width_m)
    first, second = (_section(corridor, Ground.of(flight.swaths[swath])) for swath in (profile.first, profile.second))
    return first, second


def _section(corridor: Corridor, ground: Ground) -> Section:
    rows = ground.rows_near(corridor)
    rows = rows[:: max(1, math.ceil(len(rows) / MOST_RETURNS))]
    points_t = ground.swath.points_t[rows]
    return Section(corridor.coordinates(points_t)[0], points_t[:, 2])


def _targets(profile: Profile, flight: Flight, control: Sequence[ControlPoint]) -> tuple[Section, Section]:
    """Return the flight's ground at the profile's targets less the surveyed heights; targets without ground are left
    out.
    """
    surveyed = {point.name: point.position_t for point in control}
    ground = Ground.of(flight.swaths[profile.first])
    right = profile.ends_t[1, :2] - profile.ends_t[0, :2]
    ordered = sorted(
        zip(profile.targets, profile.cells, strict=True), key=lambda one: float(right @ surveyed[one[0]][:2])
    )
    height_m = np.full(len(ordered), np.nan)
    for row, (name, cell) in enumerate(ordered):
        points_t = np.asarray(ground.swath.points_t[ground.rows_near(cell)])
        if len(points_t):
            along_m, aside_m = cell.coordinates(points_t)
            piece = fit_pieces(along_m, aside_m, points_t[:, 2], 2.0 * cell.half_width_m, 1, 3)
            height_m[row] = piece.height_m[0] - surveyed[name][2]
    shown = np.isfinite(height_m)
    distance_m = profile.before[0].distance_m[shown]  # in the order from left to right
    return Section(distance_m, height_m[shown]), Section(distance_m, np.zeros(len(distance_m)))


def draw(profile: Profile) -> Figure:
    """Return a figure of two panels, before and after, over the distance along the profile (range profiles: right of
    track).
    """
    figure = Figure(figsize=PAGE_IN, facecolor="white")
    panels: list[Axes] = list(figure.subplots(1, 2, sharex=True, sharey=True))
    low, high = _window(profile)
    for axes, sections, title in zip(panels, (profile.before, profile.after), ("Before", "After"), strict=True):
        for section, name, colour, mark in zip(sections, profile.names, COLOURS, MARKS, strict=True):
            distance_m, height_m = _thinned(section, low, high)
            size = float(np.clip(5000.0 / max(len(distance_m), 1), 2.0, 30.0))
            points = axes.scatter(distance_m, height_m, s=size, marker=mark, color=colour, lw=0, alpha=0.6, label=name)
            points.set_rasterized(len(distance_m) > MOST_MARKS)
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
    handles = [
        Line2D([], [], marker=mark, ls="", ms=5, color=colour, label=name)
        for name, colour, mark in zip(profile.names, COLOURS, MARKS, strict=True)
    ]
    panels[1].legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=2,
        fontsize=8,
        frameon=False,
        labelcolor=INK,
        handletextpad=0.3,
        columnspacing=1.2,
        borderaxespad=0.2,
    )
    _words(figure, profile)
    return figure


def svg(profile: Profile) -> str:
    """Return the figure as SVG; the same profile gives the same text."""
    text = io.StringIO()
    with mpl.rc_context(_SVG):
        draw(profile).savefig(text, format="svg", metadata={"Date": None, "Creator": None}, dpi=RASTER_DPI)
    return text.getvalue()


def _window(profile: Profile) -> tuple[float, float]:
    """Return the first and last distance that are drawn."""
    section = profile.after[0] if profile.kind == "range" else profile.before[0]  # all targets are seen at the end
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
    inside = inside[:: max(1, -(-len(inside) // MOST_POINTS))]
    return section.distance_m[inside], section.height_m[inside]


def _words(figure: Figure, profile: Profile) -> None:
    figure.subplots_adjust(left=0.075, right=0.985, top=0.83, bottom=0.12, wspace=0.06)
    unit, factor = ("m", 1.0) if profile.kind == "range" else ("°", float(np.degrees(1.0)))
    found = with_sigma(factor * profile.found, factor * profile.sigma)
    measured = (
        f"separation {with_sigma(profile.separation_m, profile.separation_sigma_m)} m, "
        f"found {found}{'' if unit == '°' else ' '}{unit}, "
        f"{profile.pieces} {'targets' if profile.kind == 'range' else 'pieces of ground'}"
    )
    figure.text(0.02, 0.97, measured, fontsize=8.5, color=MUTED, va="top")
