"""Reads the JSON file beside products for a page: the software, the calibration and the warnings."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pyproj import CRS

Json = dict[str, Any]
LARGEST_BYTES = 50_000_000
MOST_FILES = 50
UNITS = {"deg": "°", "m": " m", "c": " °C", "hpa": " hPa", "percent": " %", "ppm": " ppm", "s": " s"}  # ends of keys
CRS_KEYS = ("crs", "name", "heights", "datum", "realisation", "epoch", "operation", "accuracy_m", "grids")


def sidecar_of(path: Path) -> Json:
    """Return the JSON object that is named after a file or lists it among its strips; empty if there is none."""
    named = (path.with_suffix(".json"), path.with_name(f"{path.name}.json"))
    for beside in named:
        if found := read_sidecar(beside):
            return found
    others = sorted(one for one in path.parent.glob("*.json") if one not in named)
    return next((read for one in others[:MOST_FILES] if path.name in _files_of(read := read_sidecar(one))), {})


def read_sidecar(path: Path) -> Json:
    """Return the JSON object of a file; empty if it is missing or cannot be read."""
    try:
        if not path.is_file() or path.stat().st_size > LARGEST_BYTES:
            return {}
        read = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return read if isinstance(read, dict) else {}


def _files_of(sidecar: Json) -> set[str]:
    strips = sidecar.get("strips")
    entries = strips if isinstance(strips, list) else []
    return {Path(str(entry.get("file"))).name for entry in entries if isinstance(entry, dict) and entry.get("file")}


def find_key(tree: Any, name: str) -> Iterator[Any]:
    """Yield every value of a key anywhere in a JSON tree."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            if key == name:
                yield value
            else:
                yield from find_key(value, name)
    elif isinstance(tree, list):
        for value in tree:
            yield from find_key(value, name)


def crs_of(systems: Iterable[CRS | None]) -> str:
    """Return name and code of the files' coordinate system; empty if no file states one."""
    crs = next((one for one in systems if one is not None), None)
    if crs is None:
        return ""
    code = crs.to_authority(min_confidence=100)
    return f"{crs.name}{f' ({code[0]}:{code[1]})' if code else ''}"


def warnings_in(sidecar: Json) -> list[str]:
    """Return a sidecar's warnings, and its lines on missing data."""
    values = [value for key in ("warnings", "holes") for value in find_key(sidecar, key)]
    lines = [one for value in values for one in (value if isinstance(value, list) else [value])]
    return [_text(line) for line in lines if line]


def calibrations_in(sidecar: Json) -> list[str]:
    """Return ids of the calibrations, with the scanners' names if given."""
    ids = [_text(value) for value in find_key(sidecar, "calibration_id")]
    for value in find_key(sidecar, "calibrations"):
        if isinstance(value, dict):
            ids += [f"{name}: {_text(one.get('id', '?'))}" for name, one in value.items() if isinstance(one, dict)]
    if not ids:
        values = find_key(sidecar, "calibration")
        ids = [_text(value.get("id", "")) if isinstance(value, dict) else _text(value) for value in values]
    return list(dict.fromkeys(line for line in ids if line))


def sessions_in(sidecar: Json) -> list[str]:
    """Return the sessions of a sidecar's run; empty if it does not name them."""
    flights = sidecar.get("flights")
    entries = flights if isinstance(flights, list) else []
    return [str(entry["session"]) for entry in entries if isinstance(entry, dict) and entry.get("session")]


def height_unit_in(sidecar: Json) -> float | None:
    """Return metres per unit of the heights, which a CRS without a vertical part cannot give; None if not stated."""
    crs = sidecar.get("crs")
    units = crs.get("units") if isinstance(crs, dict) else None
    metres = units.get("metres") if isinstance(units, dict) else None
    up_m = metres[2] if isinstance(metres, list) and len(metres) == 3 else None
    return float(up_m) if isinstance(up_m, int | float) and 0.0 < up_m < math.inf else None


def rows_of(sidecar: Json) -> list[tuple[str, str]]:
    """Return the rows about a sidecar for a reader of the page: labels and texts, unchanged."""
    rows = [("software", _text(sidecar["software"]))] if sidecar.get("software") else []
    if "complete" in sidecar:
        rows.append(("complete", "yes" if sidecar["complete"] is True else "no, partial"))
    rows += [("calibration", line) for line in calibrations_in(sidecar)]
    for key, label in (("atmosphere", "atmosphere"), ("atmosphere_at_edge", "atmosphere at the swath's edge")):
        rows += [(label, _text(value)) for value in _distinct(find_key(sidecar, key))]
    crs = sidecar.get("crs")
    if isinstance(crs, dict):
        crs_rows = [(key, crs[key]) for key in CRS_KEYS if crs.get(key) not in (None, [], "")]
        rows += [_crs_row(key, value) for key, value in crs_rows]
    counts = sidecar.get("counts")
    if isinstance(counts, dict):
        rows += [(f"returns of {name}", _text(value)) for name, value in counts.items()]
    return rows


def _crs_row(key: str, value: Any) -> tuple[str, str]:
    if key == "accuracy_m" and isinstance(value, int | float):
        return "CRS: accuracy", f"{_text(value)} m"
    return ("CRS" if key == "crs" else f"CRS: {key.replace('_', ' ')}"), _text(value)


def _distinct(values: Iterator[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if value and value not in found:
            found.append(value)
    return found


def _named(key: str, value: Any) -> str:
    """Return a key and its value in words; the unit at the key's end stands behind the number."""
    words, _, ending = key.rpartition("_")
    if words and ending in UNITS and isinstance(value, int | float) and not isinstance(value, bool):
        return f"{words.replace('_', ' ')} {_text(value)}{UNITS[ending]}"
    return f"{key.replace('_', ' ')} {_text(value)}"


def _text(value: Any) -> str:
    """Return a JSON value as text for people."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(_named(str(key), one) for key, one in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(_text(one) for one in value) or "none"
    return str(value)
