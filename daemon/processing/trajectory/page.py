"""Writes the page of a navigated flight: verdict, tables and pictures in one file that needs no network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from swath.calib.labels import decimals_of, number, share
from swath.daemon.processing.pages.blocks import Block, Card, Image, Judged, Notes, Table, Words, data_uri
from swath.daemon.processing.pages.head import NOTHING_KNOWN, PageHead
from swath.daemon.processing.pages.render import Page, html_of
from swath.daemon.processing.pages.words import thousands
from swath.daemon.processing.trajectory.figures import ANGLES, AXES_B, AXES_L, Figures, figures_of
from swath.daemon.processing.trajectory.panels import NARROW, WIDE, Drawn, Format
from swath.daemon.processing.trajectory.pictures import (
    draw_attitude,
    draw_attitude_separation,
    draw_attitude_sigma,
    draw_biases,
    draw_height,
    draw_innovations,
    draw_lever_arm,
    draw_map,
    draw_misalignments,
    draw_position_separation,
    draw_position_sigma,
    draw_satellites,
    draw_scales,
    draw_time_offset,
    draw_velocity_sigma,
)
from swath.daemon.processing.trajectory.series import Flight, course_of, determined_axes, separation_of
from swath.daemon.processing.trajectory.verdict import Found, judge
from swath.georef.trajectory.trajectory import gps_span_text
from swath.georef.verdicts import Level, Verdict

MOST_REASONS = 40
Wanted = Callable[[Drawn], bool]


def _always(drawn: Drawn) -> bool:
    return True


def _observed(drawn: Drawn) -> bool:
    return len(drawn.flight.forward.innovations) > 0


def _smoothed(drawn: Drawn) -> bool:
    return drawn.separation is not None


def _estimated(drawn: Drawn) -> bool:
    return len(drawn.flight.best.node_time_ns) > 0


def _scaled(drawn: Drawn) -> bool:
    return _estimated(drawn) and _determines(drawn, "gyro_scale", "accel_scale")


def _leaning(drawn: Drawn) -> bool:
    return _estimated(drawn) and _determines(drawn, "gyro_misalignment", "accel_misalignment")


def _determines(drawn: Drawn, *names: str) -> bool:
    return any(determined_axes(drawn.flight, name) for name in names)


PICTURES: tuple[tuple[str, str, Callable[[Drawn, Format], bytes], Wanted], ...] = (
    (
        "Map",
        "Colour: fix type of the positions used; grey: none was used for long. Numbers: straight flight; swath georef "
        "makes strips of it where the laser was on.",
        draw_map,
        _always,
    ),
    (
        "Height and speed",
        "Blue, numbered: straight flight. Grey: no position was used. Red: inertial samples made up.",
        draw_height,
        _always,
    ),
    ("Attitude", "", draw_attitude, _always),
    ("Sigma of position", "One standard deviation, as predicted.", draw_position_sigma, _always),
    ("Sigma of attitude", "", draw_attitude_sigma, _always),
    ("Sigma of velocity", "", draw_velocity_sigma, _always),
    (
        "Innovations",
        "Observed − computed, divided by their sigmas: nine in ten lie within ±1.6 if these are right. Dashed: the "
        "limit beyond which an observation is rejected. Values beyond the panel are drawn at its edge.",
        draw_innovations,
        _observed,
    ),
    (
        "Filter − smoother: position",
        "The band is three times the sigma that the difference should have; where the line leaves it, the configured "
        "noise or a sensor is wrong.",
        draw_position_separation,
        _smoothed,
    ),
    ("Filter − smoother: attitude", "", draw_attitude_separation, _smoothed),
    ("Sensor biases", "With bands of one sigma.", draw_biases, _estimated),
    (
        "Scale factors",
        "With bands of one sigma; axes that the flight does not determine are left out.",
        draw_scales,
        _scaled,
    ),
    (
        "Misalignments",
        "x: of axes y and z towards each other, and so on; those that the flight does not determine are left out.",
        draw_misalignments,
        _leaning,
    ),
    (
        "Lever arm",
        "Body to antenna, as estimated, with bands of one sigma.",
        draw_lever_arm,
        lambda drawn: _estimated(drawn) and drawn.flight.setup.estimate_lever_arm > 0.0,
    ),
    (
        "Time offset",
        "Positive: a GNSS observation was made this much before the time that its stamp gives.",
        draw_time_offset,
        lambda drawn: _estimated(drawn) and drawn.flight.setup.estimate_time_offset_s > 0.0,
    ),
    ("Satellites and fix types", "", draw_satellites, _observed),
)


def make_page(
    flight: Flight, findings: Iterable[Found] = (), head: PageHead = NOTHING_KNOWN
) -> tuple[str, Verdict, Figures]:
    """Return the HTML page of a flight, its verdict, and its figures as `summary_of` puts them into JSON."""
    separation = separation_of(flight)
    figures = figures_of(flight, separation)
    verdict = judge(figures, findings)
    drawn = Drawn(flight, course_of(flight), separation)
    pictures = [
        Image(
            title,
            data_uri(draw(drawn, WIDE), "image/png"),
            data_uri(draw(drawn, NARROW), "image/png"),
            title=title,
            words=words,
        )
        for title, words, draw, wanted in PICTURES
        if wanted(drawn)
    ]
    return page_of(flight, figures, verdict, pictures, head), verdict, figures


def summary_of(flight: Flight, findings: Iterable[Found] = ()) -> dict[str, object]:
    """Return verdict and figures for JSON, without a page."""
    figures = figures_of(flight, separation_of(flight))
    return {"verdict": judge(figures, findings).as_dict(), "figures": figures}


def page_of(
    flight: Flight, figures: Figures, verdict: Verdict, pictures: Sequence[Image], head: PageHead = NOTHING_KNOWN
) -> str:
    """Return the HTML text of the page."""
    blocks: list[Block | None] = [
        _reasons(verdict),
        _notes(flight),
        *pictures,
        _sigmas(figures),
        _observations(figures),
        _sensors(figures),
    ]
    shown = [block for block in blocks if block is not None]
    page = Page(
        "Trajectory",
        flight.title,
        head,
        shown,
        verdict,
        _cards(figures),
        subtitle=_span_words(figures),
        appendix=[*_facts(flight), _run(figures)],
    )
    return html_of(page)


def _span_words(figures: Figures) -> str:
    method = "filtered, not smoothed" if figures["solution"] == "filter" else "filtered and smoothed"
    return f"{gps_span_text(figures['start_gps_ns'], figures['end_gps_ns'])}, {method}"


def _duration(seconds: float) -> str:
    whole = round(seconds)
    if whole < 120:
        return f"{seconds:.1f} s"
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {whole % 60:02d} s"


def _length(metres: float | None) -> str:
    """Return the text of a sigma: below a metre in centimetres."""
    if metres is None:
        return "–"
    return f"{_sigma_number(metres)} m" if metres >= 1.0 else f"{_sigma_number(100.0 * metres)} cm"


def _sigma_number(value: float | None) -> str:
    """Return a sigma with two digits."""
    return "–" if value is None else number(value, f".{decimals_of(value)}f")


def _cards(figures: Figures) -> list[Card]:
    rms, positions = figures["sigma_rms"], figures["positions"]
    rate = figures["rate_hz"]
    place = [rms["north_m"], rms["east_m"], rms["down_m"]]
    flat = None if None in place else float(np.hypot(place[0], place[1]))
    return [
        (_duration(figures["duration_s"]), "flight"),
        (f"{number(rate)} Hz", f"{thousands(figures['epochs'])} epochs"),
        (_length(flat), "sigma, horizontal"),
        (_length(place[2]), "sigma, vertical"),
        (f"{_sigma_number(rms['heading_deg'])}°", "sigma of heading"),
        (thousands(positions["used"]), "positions used"),
        (
            str(positions["outages"]),
            f"outages, longest {_duration(positions['longest_outage_s'])}" if positions["outages"] else "outages",
        ),
    ]


def _reasons(verdict: Verdict) -> Table | None:
    if not verdict.reasons:
        return None
    rows = [
        [Judged(reason.what, good=False) if reason.level is Level.UNUSABLE else reason.what, reason.change]
        for reason in verdict.reasons[:MOST_REASONS]
    ]
    omitted = len(verdict.reasons) - len(rows)
    return Table("Reasons", ("what", "what to change"), rows, left=(0, 1), stacked=True, omitted=omitted)


def _notes(flight: Flight) -> Notes | None:
    """Return what casts doubt on the trajectory; nothing else is set in amber."""
    return Notes(flight.notes) if flight.notes else None


def _facts(flight: Flight) -> list[Words]:
    """Return how the flight began and with which noise: what the reader may want to know, without any doubt in it."""
    lines = [*((f"Start: {flight.start}.",) if flight.start else ()), *(f"{line}." for line in flight.facts)]
    return [Words(" ".join(lines), "Start and noise", muted=True)] if lines else []


def _sigmas(figures: Figures) -> Table:
    rows = []
    for key, words, unit, factor in (
        *((f"{axis}_m", f"position {axis}", "cm", 100.0) for axis in AXES_L),
        *((f"velocity_{axis}_mps", f"velocity {axis}", "cm/s", 100.0) for axis in AXES_L),
        *((f"{angle}_deg", angle, "°", 1.0) for angle in ANGLES),
    ):
        columns = [figures[name][key] for name in ("sigma_rms", "sigma_p95", "sigma_largest", "filter_sigma_rms")]
        shown = [_sigma_number(None if value is None else factor * value) for value in columns]
        rows.append([f"{words} ({unit})", *shown])
    heads: tuple[str, ...] = ("sigma of", "RMS", "95 % are below", "largest", "filter, RMS")
    if figures["solution"] == "filter":
        heads, rows = heads[:4], [row[:4] for row in rows]
    return Table("Sigmas over the flight", heads, rows)


FATES = ("taken", "inflated", "reacquired", "rejected", "unusable", "outside")


def _observations(figures: Figures) -> Table | None:
    rows = [
        [
            kind.replace("_", " "),
            thousands(row["seen"]),
            *(thousands(row[fate]) for fate in FATES),
            number(row["sigma_factor"], ".2f"),
            number(row["correlation"], ".2f"),
        ]
        for kind, row in figures["observations"].items()
    ]
    heads = ("observation", "seen", *FATES, "size / sigma", "correlation")
    under = (
        "Size / sigma: how large innovations are against their sigmas, 1 where these are honest. Correlation: of an "
        "innovation with the next, 0 where they are white."
    )
    return Table("Observations", heads, rows, under) if rows else None


SENSORS = {
    "gyro_bias": ("gyro bias", "°/h", np.degrees(1.0) * 3600.0),
    "accel_bias": ("accelerometer bias", "mg", 1e3 / 9.80665),
    "gyro_scale": ("gyro scale", "ppm", 1e6),
    "accel_scale": ("accelerometer scale", "ppm", 1e6),
    "gyro_misalignment": ("gyro misalignment", "mrad", 1e3),
    "accel_misalignment": ("accelerometer misalignment", "mrad", 1e3),
}


def _sensors(figures: Figures) -> Table | None:
    rows = []
    for name, axes in figures["sensors"].items():
        words, unit, factor = SENSORS[name]
        for axis, row in axes.items():
            ratio = number(row["largest_over_expected"], ".2f")
            estimated = _estimated_words(factor * row["estimate"], factor * row["sigma"])
            rows.append([f"{words} {axis} ({unit})", "–", *estimated, ratio])
    arm, offset = figures["lever_arm"], figures["time_offset"]
    if arm is not None:
        for i, axis in enumerate(AXES_B):
            estimated = _estimated_words(arm["estimate_m"][i], arm["sigma_m"][i])
            rows.append([f"lever arm {axis} (m)", number(arm["given_m"][i], ".3f"), *estimated, "–"])
    if offset is not None:
        estimated = _estimated_words(1e3 * offset["estimate_s"], 1e3 * offset["sigma_s"])
        rows.append(["time offset of GNSS (ms)", "–", *estimated, "–"])
    heads = ("at the end of the flight", "given", "estimate", "sigma", "largest / expected")
    return Table("Sensors", heads, rows) if rows else None


def _estimated_words(value: float, sigma: float) -> tuple[str, str]:
    """Return an estimate and its sigma, which has two digits."""
    pattern = f".{decimals_of(sigma)}f"
    return number(value, pattern), number(sigma, pattern)


def _fix_words(name: str) -> str:
    """Return the name of a fix type, alone or within other words, for people."""
    return name.replace("_", " ").replace("rtk", "RTK").replace("ppp", "PPP")


def _run(figures: Figures) -> Table:
    bridged, positions, separation = figures["bridged"], figures["positions"], figures["separation"] or {}
    shown = {f"{kind}_{fate}" for kind in figures["observations"] for fate in FATES}  # in the table of observations
    rows = [
        ["inertial samples made up", f"{thousands(bridged['epochs'])} ({share(bridged['share'])})"],
        ["longest run of them", _duration(bridged["longest_s"])],
        ["time in outages", _duration(positions["outages_s"])],
        *([f"positions, {_fix_words(name)}", thousands(n)] for name, n in positions["fix_types"].items()),
        ["satellites, median", number(positions["satellites_median"])],
        *([f"filter − smoother / sigma, {name}", number(value, ".2f")] for name, value in separation.items()),
        *(
            [f"noise found, {_fix_words(name)}", f"× {number(value, '.2f')}"]
            for name, value in figures["noise_found"].items()
        ),
        ["share of positions' variance that lasts", number(figures["lasting_share"], ".2f")],
        ["share of velocities' variance that lasts", number(figures["lasting_velocity_share"], ".2f")],
        ["how long velocities' errors last, s", number(figures["lasting_velocity_s"], ".1f")],
        ["share of headings' variance that lasts", number(figures["lasting_heading_share"], ".2f")],
        ["how long headings' errors last, s", number(figures["lasting_heading_s"], ".1f")],
        *([name.replace("_", " "), thousands(count)] for name, count in figures["counts"].items() if name not in shown),
    ]
    return Table("The run", ("", ""), [row for row in rows if row[1] != "–"])
