"""Draws pictures of a navigated flight, each in two formats: for a desktop and for a telephone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter
from scipy.stats import chi2

from swath.daemon.processing.pages.map_axes import HALO, coordinates, north_arrow, place_names, scale_bar
from swath.daemon.processing.pages.words import INK, MUTED
from swath.daemon.processing.trajectory.figures import AXES_B, AXES_L
from swath.daemon.processing.trajectory.panels import NARROW, Drawn, Format, Sheet, dress, picture_of
from swath.daemon.processing.trajectory.series import COLUMNS, Pixels, determined_axes, fix_types_at
from swath.georef.arrays import FloatArray
from swath.georef.navigation.inputs import Fate, Kind
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS

TRIPLE = ("#0072b2", "#d55e00", "#009e73")  # north, east, down; x, y, z; roll, pitch, heading
FILTER, SMOOTHER = "#d55e00", "#0072b2"
EDGE = 8.0  # larger normalised innovations are drawn at the panel's edge
FIX_LOOK: dict[int, tuple[str, str]] = {  # fix type, -1 for outages: colour, words
    FixType.RTK_FIXED: ("#1d7a38", "RTK fixed"),
    FixType.RTK_FLOAT: ("#e0a100", "RTK float"),
    FixType.PPP: ("#009e9e", "PPP"),
    FixType.DIFFERENTIAL: ("#0072b2", "differential"),
    FixType.SINGLE: ("#cc79a7", "single"),
    FixType.DEAD_RECKONING: ("#8b1a1a", "dead reckoning"),
    FixType.MANUAL: ("#5b4fc4", "manual"),
    FixType.SIMULATED: ("#7a5c00", "simulated"),
    FixType.NONE: ("#444444", "unsaid"),
    -1: ("#9aa0a6", "outage"),
}
FATE_LOOK: dict[Fate, tuple[str, str, float, str]] = {  # marker, colour, size, words
    Fate.TAKEN: (".", "#7d8f9e", 2.0, "taken"),
    Fate.INFLATED: ("o", "#e0a100", 3.0, "inflated"),
    Fate.REACQUIRED: ("D", "#5b4fc4", 3.5, "re-acquired"),
    Fate.REJECTED: ("x", "#b3261e", 4.0, "rejected"),
}


def draw_map(drawn: Drawn, form: Format) -> bytes:
    """Return the flight's map, coloured by the fix type of its positions, with the numbers of its strips."""
    return picture_of(map_of(drawn, form), form)


def map_of(drawn: Drawn, form: Format) -> Figure:
    """Return the figure of the flight's map."""
    flight, course = drawn.flight, drawn.course
    east, north = course.place
    low, high = np.nanmin(course.place, axis=1), np.nanmax(course.place, axis=1)
    size = np.maximum(high - low, 1.0)
    across = form.width_in - 1.05
    up = float(np.clip(across * size[1] / size[0], 0.35 * across, min(across, 6.5)))
    top_in = 0.72 if form is NARROW else 0.45
    height = up + 0.5 + top_in
    figure = Figure(figsize=(form.width_in, height), facecolor="white", dpi=form.dpi)
    axes = figure.add_axes((0.9 / form.width_in, 0.5 / height, across / form.width_in, up / height))
    dress(axes)
    half = 0.55 * np.maximum(size, size[::-1] * [across / up, up / across])
    middle = (low + high) / 2
    axes.set_xlim(float(middle[0] - half[0]), float(middle[0] + half[0]))
    axes.set_ylim(float(middle[1] - half[1]), float(middle[1] + half[1]))
    types = fix_types_at(flight, course.place_ns)
    handles = []
    for code, (colour, word) in FIX_LOOK.items():
        if (types == code).any():
            shown = (types == code) | np.append(False, types[:-1] == code)  # extends to the next type's first point
            axes.plot(np.where(shown, east, np.nan), np.where(shown, north, np.nan), color=colour, lw=1.3)
            handles.append(Line2D([], [], color=colour, lw=2.0, label=word))
    _map_marks(drawn, axes, handles)
    coordinates(axes, course.chart.unit, (form.ticks - 1, 6))
    axes.set_xlabel(f"Easting ({course.chart.unit}), {course.chart.name}", fontsize=8.5, color=MUTED)
    scale_bar(axes, 2.0 * float(half[0]) * course.chart.unit_m, _empty_corner(axes, course.place))
    north_arrow(axes)
    _strip_numbers(drawn, axes)
    figure.legend(
        handles=handles, loc="upper left", ncols=3 if form is NARROW else 8, frameon=False, fontsize=8, labelcolor=INK
    )
    return figure


def _strip_numbers(drawn: Drawn, axes: Axes) -> None:
    """Write the numbers of the strips beside their tracks, as far as they have room."""
    times_s, names = drawn.since_start_s(drawn.course.place_ns), []
    for number, (begin_s, end_s) in enumerate(drawn.strips_s.tolist(), start=1):
        share = np.array([0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8])
        at_s = begin_s + share * (end_s - begin_s)
        places = [np.interp(at_s, times_s, values) for values in drawn.course.place]
        text = axes.text(0.0, 0.0, str(number), fontsize=8.5, weight="bold", color=INK, ha="center", va="center")
        text.set(zorder=8, path_effects=HALO)
        names.append((text, np.transpose(places).tolist()))
    place_names(axes, names)


def _empty_corner(axes: Axes, place: FloatArray) -> tuple[float, float]:
    """Return the place of a scale bar in the lower corner that holds less of the flight."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    across, up = (place[0] - west) / (east - west), (place[1] - south) / (north - south)
    low = up < 0.2
    return (0.025, 0.035) if (low & (across < 0.35)).sum() <= (low & (across > 0.65)).sum() else (0.775, 0.035)


def _map_marks(drawn: Drawn, axes: Axes, handles: list[Line2D]) -> None:
    flight, (east, north) = drawn.flight, drawn.course.place
    ends: dict[str, Any] = {"mec": "white", "mew": 0.8, "ls": "", "zorder": 5}
    axes.plot(east[:1], north[:1], marker="o", ms=7, color=INK, **ends)
    axes.plot(east[-1:], north[-1:], marker="s", ms=6.5, color=INK, **ends)
    handles.append(Line2D([], [], marker="o", ls="", ms=5, color=INK, label="start"))
    handles.append(Line2D([], [], marker="s", ls="", ms=5, color=INK, label="end"))
    rows = flight.forward.innovations
    bad_ns = rows["time_ns"][(rows["kind"] == Kind.POSITION) & (rows["fate"] == Fate.REJECTED)]
    if len(bad_ns):
        times = drawn.course.place_ns
        marker, colour, size, word = FATE_LOOK[Fate.REJECTED]
        place = np.interp(bad_ns, times, east), np.interp(bad_ns, times, north)
        axes.plot(*place, marker, color=colour, ms=size + 0.5, mew=1.0, zorder=6)
        handles.append(Line2D([], [], marker=marker, ls="", ms=5, color=colour, label=word))


def draw_height(drawn: Drawn, form: Format) -> bytes:
    """Return a picture of height, ground speed and climb."""
    course = drawn.course
    sheet = Sheet(drawn, form, ("Ellipsoidal height (m)", "Speed over ground (m/s)", "Climb (m/s)"))
    for axes, band in zip(sheet.panels, (course.height_m, course.speed_mps, course.climb_mps), strict=True):
        sheet.line(axes, course.pixels, band, SMOOTHER)
    return sheet.picture()


def draw_attitude(drawn: Drawn, form: Format) -> bytes:
    """Return a picture of roll, pitch and heading."""
    course = drawn.course
    sheet = Sheet(drawn, form, ("Roll (°)", "Pitch (°)", "Heading (°)"))
    for i, axes in enumerate(sheet.panels[:2]):
        sheet.line(axes, course.pixels, course.attitude_deg[..., i], SMOOTHER)
    heading = course.attitude_deg[..., 2]
    passed = np.abs(np.diff(heading.mean(axis=0))) > 180.0  # through north
    sheet.line(sheet.panels[2], course.pixels, heading, SMOOTHER, broken=passed)
    sheet.panels[2].set_ylim(-8.0, 368.0)
    sheet.panels[2].set_yticks([0, 90, 180, 270, 360])
    return sheet.picture()


def _draw_sigmas(column: str, words: Sequence[str], factor: float) -> Callable[[Drawn, Format], bytes]:
    """Return a function that draws sigmas of filter and smoother on logarithmic scales."""

    def draw(drawn: Drawn, form: Format) -> bytes:
        flight = drawn.flight
        sheet = Sheet(drawn, form, words)
        curves = [(drawn.filter_pixels, flight.forward, FILTER, "filter")]
        if flight.smoothed is not None:
            curves.append((drawn.course.pixels, flight.smoothed, SMOOTHER, "smoother"))
        for pixels, solution, colour, _ in curves:
            band = factor * drawn.band(pixels, solution, column)
            for i, axes in enumerate(sheet.panels):
                sheet.line(axes, pixels, np.where(band[..., i] > 0.0, band[..., i], np.nan), colour)
        for axes in sheet.panels:
            axes.set_yscale("log")
            axes.yaxis.set_minor_formatter(NullFormatter())
            _few_decades(axes)
        sheet.legend(sheet.panels[0], [(colour, word) for *_, colour, word in curves])
        return sheet.picture()

    return draw


def _few_decades(axes: Axes) -> None:
    """Scale an axis to whole decades, at least one, with ticks that read as numbers."""
    low, high = axes.get_ylim()
    low, high = 10 ** math.floor(math.log10(low) + 1e-9), 10 ** math.ceil(math.log10(high) - 1e-9)
    axes.set_ylim(low, high)
    decades = round(math.log10(high / low))
    steps = (1, 2, 5) if decades <= 1 else (1,)
    every = max(1, decades // 4)
    ticks = [s * 10.0**d for d in range(round(math.log10(low)), round(math.log10(high)) + 1, every) for s in steps]
    ticks = [tick for tick in ticks if low <= tick <= high * (1 + 1e-9)]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])


def draw_innovations(drawn: Drawn, form: Format) -> bytes:
    """Return a picture of whitened innovations by kind, with the gate and the fates."""
    flight = drawn.flight
    rows = flight.forward.innovations
    kinds = [Kind(int(code)) for code in np.unique(rows["kind"])]
    sheet = Sheet(drawn, form, [f"{kind.name.replace('_', ' ').capitalize()} (sigmas)" for kind in kinds])
    seen = set()
    for axes, kind in zip(sheet.panels, kinds, strict=True):
        mine = rows[rows["kind"] == kind]
        for fate, (marker, colour, size, _) in FATE_LOOK.items():
            chosen = mine[mine["fate"] == fate]
            if not len(chosen):
                continue
            seen.add(fate)
            at = np.repeat(drawn.since_start_s(chosen["time_ns"]) / sheet.unit_s, 3)
            values = np.clip(chosen["normalised"].reshape(-1), -EDGE, EDGE)
            axes.plot(at, values, marker, color=colour, ms=size, mew=0.8 if marker == "x" else 0.0, rasterized=True)
        dimension = int(np.clip(np.median(mine["dimension"]), 1, 3))
        gate = math.sqrt(float(chi2.isf(flight.setup.gate_probability, dimension)))
        for level in (-gate, gate):
            axes.axhline(level, color=INK, lw=0.7, ls=(0, (5, 3)))
        axes.set_ylim(-EDGE - 0.6, EDGE + 0.6)
        axes.set_yticks([-8, -4, 0, 4, 8])
    handles = [
        Line2D([], [], marker=marker, ls="", ms=5, color=colour, label=word)
        for fate, (marker, colour, _, word) in FATE_LOOK.items()
        if fate in seen
    ]
    sheet.legend_of(sheet.panels[0], handles)
    return sheet.picture()


def _draw_sensors(
    names: Sequence[tuple[str, str, str, float]], *, determined: bool = False
) -> Callable[[Drawn, Format], bytes]:
    """Return a function that draws estimates by axis, each with a band of one sigma.

    Args:
        names: field of the solution, field of its sigma, title of the panel, and factor to the unit there.
        determined: True to leave out axes, and panels, that the flight does not determine.
    """

    def draw(drawn: Drawn, form: Format) -> bytes:
        best, pixels = drawn.flight.best, drawn.node_pixels
        axes_of = {name: determined_axes(drawn.flight, name) for name, *_ in names} if determined else {}
        shown = [one for one in names if axes_of.get(one[0], [0])]
        sheet = Sheet(drawn, form, [words for _, _, words, _ in shown], panel=1.35)
        for axes, (name, sigma, _, factor) in zip(sheet.panels, shown, strict=True):
            values, sigmas = (factor * getattr(best, key).reshape(len(pixels.time_ns), -1) for key in (name, sigma))
            band, low, high = pixels.band(values), pixels.band(values - sigmas)[0], pixels.band(values + sigmas)[1]
            numbers = axes_of.get(name, range(values.shape[1]))
            for i in numbers:
                sheet.fill(axes, pixels, low[:, i], high[:, i], TRIPLE[i])
                sheet.line(axes, pixels, band[..., i], TRIPLE[i])
            if values.shape[1] > 1:
                sheet.legend(axes, [(TRIPLE[i], AXES_B[i]) for i in numbers])
        return sheet.picture()

    return draw


def draw_satellites(drawn: Drawn, form: Format) -> bytes:
    """Return a picture of the satellites used and the fix types of the positions."""
    flight = drawn.flight
    rows = flight.forward.innovations
    rows = rows[rows["kind"] == Kind.POSITION]
    sheet = Sheet(drawn, form, ("Satellites used", "Fix type"))
    if len(rows):
        pixels = Pixels(rows["time_ns"], flight.start_ns)
        satellites = np.where(rows["satellites"] > 0, rows["satellites"], np.nan).astype(np.float64)
        sheet.line(sheet.panels[0], pixels, pixels.band(satellites), SMOOTHER)
    sheet.panels[0].set_ylim(bottom=0.0)
    span_s = max(flight.duration_s, 1e-3)
    edges_s = np.linspace(0.0, span_s, 2 * COLUMNS + 1)
    middle_ns = flight.start_ns + ((edges_s[1:] + edges_s[:-1]) / 2 * SECOND_NS).astype(np.int64)
    types = fix_types_at(flight, middle_ns)
    starts = np.flatnonzero(np.append(True, types[1:] != types[:-1]))
    ends = np.append(starts[1:], len(types))
    axes, handles = sheet.panels[1], []
    for code, (colour, word) in FIX_LOOK.items():
        mine = types[starts] == code
        if mine.any():
            begin_s, end_s = edges_s[starts[mine]] / sheet.unit_s, edges_s[ends[mine]] / sheet.unit_s
            axes.broken_barh(list(zip(begin_s, end_s - begin_s, strict=True)), (0.0, 1.0), color=colour, lw=0.0)
            handles.append(Patch(fc=colour, ec="none", label=word))
    axes.set_yticks([])
    axes.set_ylim(0.0, 1.0)
    sheet.legend_of(axes, handles)
    return sheet.picture()


def _draw_separation(name: str, words: Sequence[str], factor: float) -> Callable[[Drawn, Format], bytes]:
    """Return a function that draws filter − smoother with three times its predicted sigma."""

    def draw(drawn: Drawn, form: Format) -> bytes:
        separation = drawn.separation
        assert separation is not None
        values, sigmas = (factor * getattr(separation, key) for key in name.split())
        pixels = Pixels(separation.time_ns, drawn.flight.start_ns)
        sheet = Sheet(drawn, form, words)
        band, three = pixels.band(values), 3.0 * pixels.band(np.nan_to_num(sigmas))[1]
        for i, axes in enumerate(sheet.panels):
            sheet.fill(axes, pixels, -three[:, i], three[:, i], MUTED)
            sheet.line(axes, pixels, band[..., i], TRIPLE[i])
            half = max(float(np.nanmax(np.abs(band[..., i]))), float(np.percentile(three[:, i], 95.0)), 1e-9)
            axes.set_ylim(-1.1 * half, 1.1 * half)  # a poorly known start would hide the rest
        handles = [Patch(fc=MUTED, alpha=0.18, ec="none", label="3 sigmas predicted")]
        sheet.legend_of(sheet.panels[0], handles)
        return sheet.picture()

    return draw


DEG, HOUR_S, MILLI_G = math.degrees(1.0), 3600.0, 1e3 / 9.80665
draw_position_sigma = _draw_sigmas("position_sigma_l", [f"{axis.capitalize()} (m)" for axis in AXES_L], 1.0)
draw_velocity_sigma = _draw_sigmas("velocity_sigma_l", [f"{axis.capitalize()} (m/s)" for axis in AXES_L], 1.0)
draw_attitude_sigma = _draw_sigmas("attitude_sigma_rad", ("Roll (°)", "Pitch (°)", "Heading (°)"), DEG)
draw_biases = _draw_sensors(
    (
        ("gyro_bias", "gyro_bias_sigma", "Gyro bias (°/h)", DEG * HOUR_S),
        ("accel_bias", "accel_bias_sigma", "Accelerometer bias (mg)", MILLI_G),
    )
)
draw_scales = _draw_sensors(
    (
        ("gyro_scale", "gyro_scale_sigma", "Gyro scale error (ppm)", 1e6),
        ("accel_scale", "accel_scale_sigma", "Accelerometer scale error (ppm)", 1e6),
    ),
    determined=True,
)
draw_misalignments = _draw_sensors(
    (
        ("gyro_misalignment", "gyro_misalignment_sigma", "Gyro axes towards each other (mrad)", 1e3),
        ("accel_misalignment", "accel_misalignment_sigma", "Accelerometer axes (mrad)", 1e3),
    ),
    determined=True,
)
draw_lever_arm = _draw_sensors((("lever_arm_b", "lever_arm_sigma", "Lever arm (m)", 1.0),))
draw_time_offset = _draw_sensors((("time_offset_s", "time_offset_sigma_s", "Time offset of GNSS (ms)", 1e3),))
draw_position_separation = _draw_separation(
    "position_m position_sigma_m", [f"{axis.capitalize()} (m)" for axis in AXES_L], 1.0
)
draw_attitude_separation = _draw_separation(
    "attitude_rad attitude_sigma_rad", ("Roll (°)", "Pitch (°)", "Heading (°)"), DEG
)
