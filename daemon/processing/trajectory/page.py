"""Writes the page of a navigated flight: verdict, tables and pictures in one file that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from swath.daemon.processing.pages.style import QUICKLOOK_STYLE
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
from swath.daemon.processing.trajectory.series import Flight, course_of, separation_of
from swath.daemon.processing.trajectory.verdict import Found, judge
from swath.georef.trajectory.trajectory import gps_text
from swath.georef.verdicts import Level, Verdict

MOST_REASONS = 40
NARROW_PX = 640  # window width up to which the narrow pictures are shown
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
    return _estimated(drawn) and max(drawn.flight.setup.noise.gyro_scale, drawn.flight.setup.noise.accel_scale) > 0.0


def _leaning(drawn: Drawn) -> bool:
    return len(drawn.flight.best.gyro_misalignment) > 0


PICTURES: tuple[tuple[str, str, Callable[[Drawn, Format], bytes], Wanted], ...] = (
    ("Map", "Positions used, by fix type; where none was used for long, grey.", draw_map, _always),
    ("Height and speed", "Grey: no position was used. Red: inertial samples made up.", draw_height, _always),
    ("Attitude", "", draw_attitude, _always),
    ("Sigma of position", "One standard deviation, as predicted.", draw_position_sigma, _always),
    ("Sigma of attitude", "", draw_attitude_sigma, _always),
    ("Sigma of velocity", "", draw_velocity_sigma, _always),
    (
        "Innovations",
        "Observed − computed, whitened: nine in ten of honest ones lie within ±1.6. Dashed: the gate. What lies beyond "
        "the panel stands at its edge.",
        draw_innovations,
        _observed,
    ),
    (
        "Filter − smoother: position",
        "The band is three times the sigma that the difference should have; beyond it, the noise or a sensor is not "
        "what it was said to be.",
        draw_position_separation,
        _smoothed,
    ),
    ("Filter − smoother: attitude", "", draw_attitude_separation, _smoothed),
    ("Sensor biases", "With bands of one sigma.", draw_biases, _estimated),
    ("Scale factors", "With bands of one sigma.", draw_scales, _scaled),
    ("Misalignments", "x: of axes y and z towards each other, and so on.", draw_misalignments, _leaning),
    (
        "Lever arm",
        "Body to antenna, as estimated, with bands of one sigma.",
        draw_lever_arm,
        lambda drawn: _estimated(drawn) and drawn.flight.setup.estimate_lever_arm > 0.0,
    ),
    (
        "Time offset",
        "Positive: what GNSS stamps name was observed so much earlier.",
        draw_time_offset,
        lambda drawn: _estimated(drawn) and drawn.flight.setup.estimate_time_offset_s > 0.0,
    ),
    ("Satellites and fix types", "", draw_satellites, _observed),
)
OWN_STYLE = """
.verdict { border-left: 6px solid; border-radius: 8px; background: var(--card); padding: .8rem 1.1rem; margin: 1.2rem 0;
  font-size: 1.1rem; } .verdict.good { border-color: var(--good); } .verdict.care { border-color: #e0a100; }
.verdict.unusable { border-color: var(--bad); }
h2 + p.muted { margin-top: -.3rem; } td.left { min-width: 15rem; }
@media (max-width: 640px) { body { padding: 1rem .7rem 3rem; } h1 { font-size: 1.25rem; overflow-wrap: anywhere; }
  h2 { margin-top: 1.6rem; } .figures { gap: .5rem; }
  .figures div { min-width: 0; flex: 1 1 42%; padding: .45rem .6rem; }
  .figures b { font-size: 1.1rem; } th, td { padding: .28rem .45rem; } td.left { min-width: 11rem; }
  .reasons tr { display: block; border-bottom: 1px solid var(--line); padding: .3rem 0; }
  .reasons thead { display: none; }
  .reasons td { display: block; border: 0; text-align: left; padding: .1rem 0; } }
"""


def write_page(path: Path, flight: Flight, findings: Iterable[Found] = ()) -> tuple[Verdict, Figures]:
    """Write the page of a flight; return its verdict and its figures, as `summary_of` puts them into JSON.

    Raises:
        OSError: the file cannot be written.
    """
    separation = separation_of(flight)
    figures = figures_of(flight, separation)
    verdict = judge(figures, findings)
    drawn = Drawn(flight, course_of(flight), separation)
    pictures = [
        (words, under, draw(drawn, WIDE), draw(drawn, NARROW))
        for words, under, draw, wanted in PICTURES
        if wanted(drawn)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page_of(flight, figures, verdict, pictures), encoding="utf-8")
    return verdict, figures


def summary_of(flight: Flight, findings: Iterable[Found] = ()) -> dict[str, object]:
    """Return verdict and figures for JSON, without a page."""
    figures = figures_of(flight, separation_of(flight))
    return {"verdict": judge(figures, findings).as_dict(), "figures": figures}


def page_of(
    flight: Flight, figures: Figures, verdict: Verdict, pictures: Sequence[tuple[str, str, bytes, bytes]]
) -> str:
    """Return the HTML text of the page; pictures are title, words, wide and narrow PNG."""
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(flight.title)}: trajectory</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<style>{QUICKLOOK_STYLE}{OWN_STYLE}</style></head><body>",
        f"<h1>{escape(flight.title)}</h1>",
        f"<p class='muted'>{escape(_span_words(figures))}</p>",
        f"<p class='verdict {verdict.level.name.lower()}'>{escape(verdict.sentence)}</p>",
        _cards(figures),
        _reasons(verdict),
        _notes(flight),
        *(_picture(*picture) for picture in pictures),
        _sigmas(figures),
        _observations(figures),
        _sensors(figures),
        _run(figures),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _span_words(figures: Figures) -> str:
    method = "filtered, not smoothed" if figures["solution"] == "filter" else "filtered and smoothed"
    return f"{gps_text(figures['start_gps_ns'])} to {gps_text(figures['end_gps_ns'])}, {method}"


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
    return f"{metres:.2f} m" if metres >= 1.0 else f"{100 * metres:.2f} cm"


def _number(value: float | None, pattern: str = ".3g") -> str:
    return "–" if value is None else format(value, pattern).replace("-", "−")


def _cards(figures: Figures) -> str:
    rms, positions = figures["sigma_rms"], figures["positions"]
    rate = figures["rate_hz"]
    place = [rms["north_m"], rms["east_m"], rms["down_m"]]
    flat = None if None in place else float(np.hypot(place[0], place[1]))
    cards = [
        (_duration(figures["duration_s"]), "flight"),
        (f"{_number(rate)} Hz", f"{thousands(figures['epochs'])} epochs"),
        (f"{_length(flat)}", "sigma, horizontal"),
        (f"{_length(place[2])}", "sigma, vertical"),
        (f"{_number(rms['heading_deg'], '.4f')}°", "sigma of heading"),
        (thousands(positions["used"]), "positions used"),
        (str(positions["outages"]), f"outages, longest {_duration(positions['longest_outage_s'])}"),
    ]
    told = "".join(
        f"<div><b>{escape(value)}</b><span class='muted'>{escape(word)}</span></div>" for value, word in cards
    )
    return f"<div class='figures'>{told}</div>"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table of words, which are escaped here."""
    head = "".join(f"<th>{escape(word)}</th>" for word in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<div class='scroll'><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _reasons(verdict: Verdict) -> str:
    if not verdict.reasons:
        return ""
    rows = "".join(
        f"<tr><td class='left {'no' if reason.level is Level.UNUSABLE else ''}'>{escape(reason.what)}</td>"
        f"<td class='left muted'>{escape(reason.change)}</td></tr>"
        for reason in verdict.reasons[:MOST_REASONS]
    )
    more = len(verdict.reasons) - MOST_REASONS
    tail = f"<p class='muted'>and {more} more</p>" if more > 0 else ""
    head = "<thead><tr><th class='left'>what</th><th class='left'>what to change</th></tr></thead>"
    return f"<h2>Reasons</h2><table class='reasons'>{head}<tbody>{rows}</tbody></table>{tail}"


def _notes(flight: Flight) -> str:
    notes = [*((f"Start: {flight.start}",) if flight.start else ()), *flight.notes]
    return f"<ul class='notes'>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>" if notes else ""


def _picture(words: str, under: str, wide: bytes, narrow: bytes) -> str:
    data = {name: base64.b64encode(png).decode("ascii") for name, png in (("wide", wide), ("narrow", narrow))}
    told = f"<p class='muted'>{escape(under)}</p>" if under else ""
    return (
        f"<h2>{escape(words)}</h2>{told}<figure><picture>"
        f"<source media='(max-width: {NARROW_PX}px)' srcset='data:image/png;base64,{data['narrow']}'>"
        f"<img alt='{escape(words)}' src='data:image/png;base64,{data['wide']}'></picture></figure>"
    )


def _sigmas(figures: Figures) -> str:
    rows = []
    for key, words, unit, factor, pattern in (
        *((f"{axis}_m", f"position {axis}", "cm", 100.0, ".2f") for axis in AXES_L),
        *((f"velocity_{axis}_mps", f"velocity {axis}", "cm/s", 100.0, ".2f") for axis in AXES_L),
        *((f"{angle}_deg", angle, "°", 1.0, ".4f") for angle in ANGLES),
    ):
        columns = [figures[name][key] for name in ("sigma_rms", "sigma_p95", "sigma_largest", "filter_sigma_rms")]
        told = [_number(None if value is None else factor * value, pattern) for value in columns]
        rows.append([f"{words} ({unit})", *told])
    heads: tuple[str, ...] = ("", "RMS", "95 %", "largest", "filter, RMS")
    if figures["solution"] == "filter":
        heads, rows = heads[:4], [row[:4] for row in rows]
    return "<h2>Sigmas over the flight</h2>" + _table(heads, rows)


FATES = ("taken", "inflated", "reacquired", "rejected", "unusable", "outside")


def _observations(figures: Figures) -> str:
    rows = [
        [
            kind.replace("_", " "),
            thousands(row["seen"]),
            *(thousands(row[fate]) for fate in FATES),
            _number(row["sigma_factor"], ".2f"),
            _number(row["correlation"], ".2f"),
        ]
        for kind, row in figures["observations"].items()
    ]
    heads = ("observation", "seen", *FATES, "size / sigma", "correlation")
    under = (
        "<p class='muted'>Size / sigma: how large innovations are against their sigmas, 1 where these are honest. "
        "Correlation: of an innovation with the next, 0 where they are white.</p>"
    )
    return "<h2>Observations</h2>" + _table(heads, rows) + under if rows else ""


def _sensors(figures: Figures) -> str:
    rows = []
    units = {
        "gyro_bias": ("gyro bias", "°/h", np.degrees(1.0) * 3600.0),
        "accel_bias": ("accelerometer bias", "mg", 1e3 / 9.80665),
        "gyro_scale": ("gyro scale", "ppm", 1e6),
        "accel_scale": ("accelerometer scale", "ppm", 1e6),
        "gyro_misalignment": ("gyro misalignment", "mrad", 1e3),
        "accel_misalignment": ("accelerometer misalignment", "mrad", 1e3),
    }
    for name, axes in figures["sensors"].items():
        words, unit, factor = units[name]
        for axis, row in axes.items():
            value, sigma = factor * row["estimate"], factor * row["sigma"]
            told = _number(row["largest_over_expected"], ".2f")
            rows.append([f"{words} {axis} ({unit})", _number(value, ".3f"), _number(sigma, ".3f"), told])
    arm, offset = figures["lever_arm"], figures["time_offset"]
    if arm is not None:
        for i, axis in enumerate(AXES_B):
            told = f"given {_number(arm['given_m'][i], '.3f')}"
            value, sigma = arm["estimate_m"][i], arm["sigma_m"][i]
            rows.append([f"lever arm {axis} (m)", _number(value, ".3f"), _number(sigma, ".3f"), told])
    if offset is not None:
        value, sigma = 1e3 * offset["estimate_s"], 1e3 * offset["sigma_s"]
        rows.append(["time offset of GNSS (ms)", _number(value, ".2f"), _number(sigma, ".2f"), ""])
    heads = ("at the end", "estimate", "sigma", "largest / expected")
    return "<h2>Sensors</h2>" + _table(heads, rows) if rows else ""


def _run(figures: Figures) -> str:
    bridged, positions, separation = figures["bridged"], figures["positions"], figures["separation"] or {}
    rows = [
        ["inertial samples made up", f"{thousands(bridged['epochs'])} ({bridged['share']:.3%})"],
        ["longest run of them", _duration(bridged["longest_s"])],
        ["time in outages", _duration(positions["outages_s"])],
        *([f"positions, {name.replace('_', ' ')}", thousands(n)] for name, n in positions["fix_types"].items()),
        ["satellites, median", _number(positions["satellites_median"])],
        *([f"filter − smoother / sigma, {name}", _number(value, ".2f")] for name, value in separation.items()),
        *([f"noise found, {name}", f"× {_number(value)}"] for name, value in figures["noise_found"].items()),
        ["share of positions' variance that lasts", _number(figures["lasting_share"], ".2f")],
        ["share of velocities' variance that lasts", _number(figures["lasting_velocity_share"], ".2f")],
        ["how long velocities' errors last, s", _number(figures["lasting_velocity_s"], ".1f")],
        ["share of headings' variance that lasts", _number(figures["lasting_heading_share"], ".2f")],
        ["how long headings' errors last, s", _number(figures["lasting_heading_s"], ".1f")],
        *([name.replace("_", " "), thousands(count)] for name, count in figures["counts"].items()),
    ]
    return "<h2>The run</h2>" + _table(("", ""), rows)
