"""Reads plans, TOML files or presets by name, into tables; each error is one line that names the plan's key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import ValidationError

from swath.georef.text_encoding import decoded
from swath.georef.timescales import gps_ns_from_unix, table_leap_seconds
from swath.georef.toml_tables import TomlError, toml_tables
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import Tables

PRESETS = ("small", "calibration", "corridor", "block", "bench")


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan whose keys are all valid.

    `swath.sim.flight.trajectory` and `swath.sim.scene.scene` decide whether it can be flown.

    Attributes:
        tables: every key.
        folder: folder to which its paths are relative.
        text: as it was read.
        leap_seconds: GPS − UTC on its day.
        start_gps_ns: GPS time of its start, from which all ``_s`` count.
    """

    tables: Tables
    folder: Path
    text: str
    leap_seconds: int
    start_gps_ns: int

    def with_seed(self, seed: int) -> Plan:
        """Return the same flight with other noise, as on another day."""
        return self.changed({"flight": {"seed": seed}})

    def changed(self, changes: dict[str, Any]) -> Plan:
        """Return the plan with other values; nested tables are merged, lists are replaced whole."""
        document = _merged(self.tables.model_dump(exclude_unset=True), changes)
        return replace(self, tables=_validated(document), text=tomlkit.dumps(_set_keys(document)))


def load_plan(name: str | Path) -> Plan:
    """Return a preset by its name, or else the plan in a file.

    Raises:
        PlanError: there is no such plan, it is not TOML, or a key is wrong; one line.
    """
    path = Path(name)
    if str(name) in PRESETS and not path.is_file():
        text = (resources.files("swath.sim") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
        return parse_plan(text, Path.cwd())
    try:
        text = decoded(path.read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8"
        presets = ", ".join(PRESETS)
        raise PlanError(str(name), f"{reason}; give a plan file or one of the presets {presets}") from None
    return parse_plan(text, path.resolve().parent)


def parse_plan(text: str, folder: Path) -> Plan:
    """Return the plan in a text; raises `PlanError`."""
    try:
        document = toml_tables(text)
    except TomlError as error:
        raise PlanError("plan", str(error)) from None
    tables = _validated(document)
    start = tables.flight.start
    if start.tzinfo is None:
        raise PlanError("flight.start", f"{start} has no UTC offset; write UTC as {start.isoformat()}Z")
    leap_seconds, _ = table_leap_seconds(start.date())
    start_gps_ns = gps_ns_from_unix(round(start.timestamp()) * 1_000_000_000, leap_seconds)
    return Plan(tables, folder, text, leap_seconds, start_gps_ns)


def _set_keys(value: Any) -> Any:
    """Return a document without the keys whose value is None: TOML has no null, and such a key has its default."""
    if isinstance(value, dict):
        return {key: _set_keys(one) for key, one in value.items() if one is not None}
    return [_set_keys(one) for one in value] if isinstance(value, list) else value


def _validated(document: dict[str, Any]) -> Tables:
    try:
        return Tables.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise PlanError(_key(first["loc"]), _what(first)) from None


def _key(location: Sequence[int | str]) -> str:
    key = ""
    for part in location:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else part
    return key or "plan"


def _what(error: Any) -> str:
    if error["type"] == "extra_forbidden":
        return "unknown key"
    if error["type"] == "missing":
        return "is missing"
    text = str(error["msg"]).removeprefix("Input should be ")
    return f"got {error['input']!r}, want {text}"


def _merged(document: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(document)
    for key, value in changes.items():
        there = merged.get(key)
        merged[key] = _merged(there, value) if isinstance(there, dict) and isinstance(value, dict) else value
    return merged
