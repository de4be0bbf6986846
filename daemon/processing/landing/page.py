"""Writes the verdict before landing as a page and PDF, with a map of the lines, the area and the gaps."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.png import png
from swath.daemon.processing.landing.command import (
    AGAIN,
    FLY_AGAIN,
    GOOD,
    HOME,
    OPEN,
    REMARK,
    UNKNOWN,
    VERDICT,
    VERSION,
)
from swath.daemon.processing.landing.gaps import Ground, between, inside
from swath.daemon.processing.live.tiles import SIDE, Placement, TileReader
from swath.daemon.processing.pages.blocks import Block, Card, Cell, Image, Judged, Table, Words, data_uri
from swath.daemon.processing.pages.head import PageHead, flown_words
from swath.daemon.processing.pages.render import Page, html_of, render
from swath.daemon.processing.pages.words import round_down, size_words
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.verdicts import Level, Verdict

LINES = "lines.json"  # of `swath.daemon.processing.live.lines`, which is slow to import
MAP, MARGIN = 1000, 0.07  # longer side of the map, and its margin in parts of it
LABEL = 26.0  # from a line's begin to its name, there
RASTER = 800  # cells along the longer side at most
COVERED, TWICE = (201, 214, 222, 255), (159, 182, 198, 255)
GAP, WATER = (215, 25, 28, 255), (127, 179, 213, 255)
COLOURS = {"planned": "#5b6770", "flying": "#0072b2", "good": "#00598c", "remarks": "#8a4b00", "again": "#b3261e"}
STATES = {
    "planned": "not flown",
    "flying": "being flown",
    "good": "good",
    "remarks": "good, with remarks",
    "again": "fly again",
}
ANSWERS = {GOOD: "good", REMARK: "look at it", AGAIN: "fly again", UNKNOWN: "not known", OPEN: "still to do"}
HEAD = ("aircraft", "author", "crs", "calibrations")  # of a page's head, as live knows them
KEYS = {
    "omega_deg": "roll (ω)",
    "phi_deg": "pitch (φ)",
    "kappa_deg": "heading (κ)",
    "range_offset_m": "range offset",
    "range_scale_ppm": "range scale",
    "scan_angle_scale_ppm": "scan-angle scale",
    "scan_plane_tilt_deg": "scan-plane tilt",
    "time_offset_us": "time offset",
}
PREDICTED_HOW = (
    "By the equations of swath plan-calibration, for {strips} strips and {planes} squares of the map that lie in one "
    "plane, with live's sigmas. Roofs smaller than three cells of the map are not among them, and the office smooths "
    "the trajectory: swath calibrate may determine more, hardly less."
)
ALT = "Map of the lines, the area and the gaps"
LEGEND = (
    "Pale: cells with points, darker where several strips have some. Red: cells that have none and should. Light blue: "
    "no echo came back, as over water. "
    "Numbers: gaps of the table, blue where swaths have covered them. Lines: blue good, brown with remarks, red to be "
    "flown again, dotted not flown."
)
HOW = (
    "Made in flight by swath live, by the points, trajectory and clocks that it had then. The office smooths the "
    "trajectory and looks at everything again. What is not known is said, and is not good."
)


def read_verdict(live: Path) -> dict[str, Any]:
    """Return the verdict in a folder of live's files.

    Raises:
        UserError: there is none, or it is another version's.
    """
    path = live / VERDICT
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; swath live writes it while it runs", ExitCode.IO) from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: is no verdict; swath live writes it anew", ExitCode.DAMAGE) from error
    if not isinstance(found, dict) or found.get("version") != VERSION:
        raise UserError(f"{path}: is of another version of Swath; use that version", ExitCode.DAMAGE)
    return found


def landing_page(live: Path, found: Mapping[str, Any]) -> str:
    """Return the HTML text of a verdict.

    Args:
        live: folder of live's files, for the map.
        found: content of ``verdict.json``.
    """
    states = [check["state"] for check in found["checks"]]
    clear = found["state"] == HOME and all(state == GOOD for state in states)
    level = Level.UNUSABLE if found["state"] == FLY_AGAIN else Level.GOOD if clear else Level.CARE
    span = found["flown_gps_ns"]
    known = {key: value for key, value in found["head"].items() if key in HEAD}
    head = PageHead(flown=flown_words([tuple(span)]) if span else "", logs=[found["session_id"]], **known)
    picture = map_svg(live, found)
    blocks: list[Block] = [
        Words(HOW, muted=True),
        _checks(found),
        *(
            [
                Image(
                    "Map of the lines and gaps",
                    data_uri(picture, "image/svg+xml"),
                    title="Map",
                    words=LEGEND,
                    limited=True,
                )
            ]
            if picture
            else []
        ),
        *_gaps(found),
        _lines(found),
        *_prediction(found.get("predicted") or {}),
    ]
    page = Page(
        "Before landing",
        found["session_id"],
        head,
        blocks,
        Verdict(level, f"{found['sentence']}.", ()),
        _cards(found),
        subtitle=f"Plan {found['plan']}" if found["plan"] else "without a plan",
    )
    return html_of(page)


def _cards(found: Mapping[str, Any]) -> list[Card]:
    lines, area = found["lines"], found["area"] or {}
    states = [line["state"] for line in lines]
    cards: list[Card] = [(f"{sum(s in ('good', 'remarks') for s in states)} of {len(lines)}", "lines good")]
    if area:
        cards.append((str(len(area["gaps"]) + area["more_gaps"]), "gaps"))
        if area["planned"]:
            cards.append(
                (f"{100.0 * area['covered_m2'] / max(area['wanted_m2'], 1.0):.1f} %", "of the area has points")
            )
        if area["density_per_m2"]:
            cards.append((f"{area['density_per_m2']['p50']:.1f} per m²", "first returns, median"))
    return cards


def _checks(found: Mapping[str, Any]) -> Table:
    rows: list[list[Cell]] = []
    for check in found["checks"]:
        state = check["state"]
        answer = ANSWERS.get(state, state)
        judged: Cell = Judged(answer, good=state == GOOD) if state in (GOOD, AGAIN) else answer
        details = [] if check["code"] in ("gaps", "lines") else check["details"]  # these have tables
        rows.append([check["title"], judged, "; ".join([check["text"], *details])])
    return Table("Checks", ("what", "answer", "why"), rows, left=(0, 1, 2), stacked=True)


def _gaps(found: Mapping[str, Any]) -> list[Block]:
    area = found["area"]
    waters = (area or {}).get("waters", [])
    if not area or not (area["gaps"] or waters):
        return []
    rows: list[list[Cell]] = []
    for gap in [*area["gaps"], *waters]:
        place = "" if gap["lat_deg"] is None else f"{gap['lat_deg']:.5f}°, {gap['lon_deg']:.5f}°"
        said: Cell = (
            f"flown over on {', '.join(gap['under'])}: water?" if gap["under"] else Judged("not covered", good=False)
        )
        number = str(gap["number"])
        if gap.get("water"):
            number, said = f"water {number}", "no echo: water?"
        size, width = size_words(gap["area_m2"]), f"{gap['width_m']:.0f} m"
        rows.append([number, size, width, gap["line"], place, said])
    heads = ("gap", "size", "width", "nearest line", "latitude, longitude", "why")
    note = f"In cells of {area['cell_m']:g} m; what is narrower is not seen."
    return [Table("Gaps", heads, rows, note, left=(0, 4, 5), omitted=area["more_gaps"])]


def _lines(found: Mapping[str, Any]) -> Table:
    rows: list[list[Cell]] = []
    for line in found["lines"]:
        state = STATES.get(line["state"], line["state"])
        good = line["state"] == "good"
        said: Cell = Judged(state, good=good) if line["state"] in ("good", "again", "planned") else state
        why = list(line["why"])
        if line["overruled"]:
            note = f": {line['overruled']['note']}" if line["overruled"]["note"] else ""
            why.insert(0, f"operator says {line['overruled']['verdict']}{note}")
        flown = "" if line["flown_fraction"] is None else f"{100 * line['flown_fraction']:.0f} %"
        rows.append([line["name"], said, flown, "; ".join(why)])
    return Table("Lines", ("line", "state", "flown", "why"), rows, left=(0, 1, 3))


def _prediction(predicted: Mapping[str, Any]) -> list[Block]:
    title = "Calibration by the lines flown"
    if not predicted.get("rows"):
        return [Words(f"Not predicted: {predicted['why']}.", title, muted=True)] if predicted.get("why") else []
    rows: list[list[Cell]] = []
    for row in predicted["rows"]:
        verdict: Cell = Judged("yes", good=True) if row["determined"] else "not shown"
        words = f"{row['scanner']} {KEYS.get(row['name'], row['name'])}"
        rows.append([words, row["unit"], _digits(row["sigma"]), f"{row['wanted']:g}", verdict])
    heads = ("parameter", "unit", "predicted sigma", "largest useful sigma", "determined")
    return [Table(title, heads, rows, PREDICTED_HOW.format(**predicted))]


def prediction_lines(predicted: Mapping[str, Any]) -> list[str]:
    """Return the prediction for a terminal, a line for each parameter."""
    if not predicted.get("rows"):
        return [f"calibration by the lines flown: not predicted, {predicted['why']}"] if predicted.get("why") else []
    return [
        f"{row['scanner']} {KEYS.get(row['name'], row['name'])}: ±{_digits(row['sigma'])} {row['unit']} by the lines "
        f"flown, ±{row['wanted']:g} is useful: {'determined' if row['determined'] else 'not shown to be determined'}"
        for row in predicted["rows"]
    ]


def _digits(sigma: float | None) -> str:
    return "none" if sigma is None else f"{sigma:.0f}" if sigma >= 100.0 else f"{sigma:.2g}"


# ---------------------------------------------------------------------------------------------- map


def map_svg(live: Path, found: Mapping[str, Any]) -> bytes:
    """Return the map of lines, area, covered cells and gaps as SVG; empty if its place is not known."""
    reader = TileReader(live)
    reader.refresh()
    placement = Placement.of(reader.index)
    if placement is None:
        return b""
    lines, area = _drawn(live, placement)
    places = [*lines.values(), *(ring for rings in area for ring in rings)]
    extent = reader.extent_m()
    if not places and extent is None:
        return b""
    corners = np.concatenate([*places, np.reshape(extent, (2, 2))] if extent and not places else places)
    low, high = corners.min(axis=0), corners.max(axis=0)
    side_m = float((high - low).max()) or 1.0
    low, high = low - MARGIN * side_m, high + MARGIN * side_m
    scale = MAP / float((high - low).max())
    width, height = (round(float(size) * scale) for size in high - low)

    def on_map(points: FloatArray) -> list[tuple[float, float]]:
        return [(round((e - low[0]) * scale, 1), round((high[1] - n) * scale, 1)) for e, n in points.tolist()]

    bar_m = round_down(0.2 * float(high[0] - low[0]))
    states = {line["name"]: line["state"] for line in found["lines"]}
    gaps = (found["area"] or {}).get("gaps", [])
    raster, size_m = _raster(reader, low, high, area, float((found["area"] or {}).get("cell_m", 0.0)))
    return render(
        "landing_map.svg",
        width=width,
        height=height,
        raster=raster,
        raster_width=round(float(size_m[0]) * scale, 2),
        raster_height=round(float(size_m[1]) * scale, 2),
        area=[[on_map(ring) for ring in rings] for rings in area],
        lines=[_line(name, states.get(name, "planned"), on_map(points)) for name, points in lines.items()],
        gaps=[
            dict(zip("xy", on_map(np.array([[gap["east_m"], gap["north_m"]]]))[0], strict=True))
            | {"number": gap["number"], "colour": "#0072b2" if gap["under"] else "#b3261e"}
            for gap in gaps
        ],
        bar=round(bar_m * scale, 1),
        bar_words=f"{bar_m / 1000:g} km" if bar_m >= 1000 else f"{bar_m:g} m",
    ).encode()


def _line(name: str, state: str, places: Sequence[tuple[float, float]]) -> dict[str, Any]:
    (x, y), (next_x, next_y) = places[0], places[min(1, len(places) - 1)]
    away = max(1.0, math.hypot(next_x - x, next_y - y))
    label = round(x - LABEL * (next_x - x) / away, 1), round(y - LABEL * (next_y - y) / away, 1)
    return {
        "name": name,
        "colour": COLOURS.get(state, "#5b6770"),
        "width": 4 if state == "again" else 2,
        "dashes": {"planned": "3 6", "again": "12 5"}.get(state, ""),
        "weight": "bold" if state in ("again", "planned") else "normal",
        "label": label,
        "places": places,
    }


def _drawn(live: Path, placement: Placement) -> tuple[dict[str, FloatArray], list[list[FloatArray]]]:
    """Return lines by name and polygons of rings (n, 2), east and north, metres; nothing if there is no such file."""
    try:
        geometry = json.loads((live / LINES).read_bytes())["geometry"]
        lines = {
            name: placement.local(np.array([place[:2] for place in places], np.float64))
            for name, places in geometry["lines"].items()
            if places
        }
        area = [[placement.local(np.array(ring, np.float64)) for ring in rings] for rings in geometry["area"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}, []
    return lines, area


def _raster(
    reader: TileReader, low: FloatArray, high: FloatArray, area: list[list[FloatArray]], cell_m: float
) -> tuple[str, FloatArray]:
    """Return a picture of the cells from two corners on as data URI, and its size (2,); nothing without a map.

    They are not narrower than ``cell_m``, in which gaps were looked for.
    """
    if not reader.cell_m:
        return "", np.zeros(2)
    step = 1
    least_m = max(float((high - low).max()) / RASTER, cell_m)
    while step < SIDE and step * reader.cell_m < least_m:
        step *= 2
    cell_m = step * reader.cell_m
    columns, rows = (math.ceil(float(size) / cell_m) for size in high - low)
    covered, strips = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.int64)
    water = np.zeros_like(covered)
    ground = Ground(float(low[0]), float(low[1]), cell_m, covered, water, 1, np.zeros((rows, columns)))
    (west_m, south_m), (east_m, north_m) = low.tolist(), high.tolist()
    view = reader.view(west_m, south_m, east_m, north_m, cell_m, ("points", "no_return", "strips"))
    if view is not None:
        where = ground.centres_m(np.arange(max(rows, columns)), np.arange(max(rows, columns)))
        across = np.floor((where[:columns, 0] - view.west_m) / view.cell_m).astype(np.int64)
        up = np.floor((where[:rows, 1] - view.south_m) / view.cell_m).astype(np.int64)
        there = ((up >= 0) & (up < view.shape[0]))[:, None] & ((across >= 0) & (across < view.shape[1]))[None, :]
        at = np.ix_(up.clip(0, view.shape[0] - 1), across.clip(0, view.shape[1] - 1))
        covered[:] = there & (view.layers["points"][at] > 0)
        water[:] = there & ~covered & (view.layers["no_return"][at] > 0)
        strips[:] = np.where(there, view.layers["strips"][at], 0)
    wanted: BoolArray = inside(ground, area) if area else between(ground)
    image = np.full((rows, columns, 4), 255, np.uint8)
    image[ground.covered] = COVERED
    image[ground.covered & (strips > 1)] = TWICE
    image[wanted & ~ground.covered] = GAP
    image[water] = WATER
    times = max(1, 2 * RASTER // max(rows, columns))  # printers smooth what they enlarge
    large = np.ascontiguousarray(image[::-1].repeat(times, axis=0).repeat(times, axis=1))
    return data_uri(png(large), "image/png"), np.array([columns, rows]) * cell_m
