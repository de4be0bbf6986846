"""Finds the device of protocol ``records`` that a table's rows belong to: as the user says, by its name, or by what
it holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from swath.daemon.errors import UserError
from swath.daemon.exchange.captures import Capture
from swath.daemon.exchange.export import MANIFEST
from swath.daemon.exchange.routes import Port, Routes
from swath.drivers.captures.opening import is_table, table_columns
from swath.drivers.captures.tables.columns import devices_of, plan_of
from swath.drivers.record_frames import RowKind

RECORDS = "records"
LEFT_OUT = ("_status.csv", "_status.parquet")  # of `swath export --records`: no driver reads them again


def table_of(routes: Routes, path: Path, port: Port | None) -> Capture:
    """Return a table with the device that its rows belong to.

    Args:
        routes: of the configuration.
        path: of the table.
        port: of the device of protocol ``records`` that the user named; None: found by the name of an export
            (``gnss-rover_fixes.csv``), else the only device of that protocol whose rows the table holds.

    Raises:
        UserError: there is no such device.
        TransportError: the table cannot be read, or its columns are not those of records.
    """
    names = table_columns(path)
    devices = devices_of(names)
    port = port or _named_port(routes, path, devices) or _only_port(routes, path, devices)
    plan = plan_of(path, names, port.source.partition("/")[0])
    capture = Capture(path, "table", port)
    if plan.unused:
        capture.tally.passed[f"columns ({', '.join(plan.unused)})"] = len(plan.unused)
    return capture


def _named_port(routes: Routes, path: Path, devices: Sequence[str]) -> Port | None:
    """Return the device that an export named the table after, if the configuration has it for such rows.

    INS solutions of a receiver become those of the inertial unit.
    """
    source = source_of(path)
    port = routes.ports.get(source)
    fits = port is not None and port.protocol == RECORDS and source.partition("/")[0] in devices
    return port if fits else None


def source_of(path: Path) -> str:
    """Return the device that an export named a table after: ``gnss-rover_fixes.csv`` is of ``gnss/rover``."""
    return path.name.partition(".")[0].rpartition("_")[0].replace("-", "/", 1)


def _only_port(routes: Routes, path: Path, devices: Sequence[str]) -> Port:
    ports = [port for port in routes.ports.values() if port.protocol == RECORDS]
    found = [port for port in ports if port.source.partition("/")[0] in devices] if devices else ports
    if len(found) == 1:
        return found[0]
    there = " or ".join(port.source for port in found) or "none"
    what = f"holds rows of {' and '.join(f'[{device}.…]' for device in devices)}" if devices else "is a table"
    option = f"--source {found[0].source}={path}" if found else f'a section with protocol = "{RECORDS}"'
    raise UserError(f'{path}: {what}; devices of protocol "{RECORDS}" that fit: {there}; want {option}')


def is_folder_of_tables(folder: Path) -> bool:
    """Return whether a folder is one that `swath export --records` wrote."""
    return not (folder / MANIFEST).exists() and any(is_table(path) for path in folder.iterdir())


def tables_of_folder(routes: Routes, folder: Path) -> list[Capture]:
    """Return the tables of a folder whose devices the configuration has with protocol ``records``.

    Raises:
        UserError: there are none.
        TransportError: a table cannot be read.
    """
    paths = [path for path in sorted(folder.iterdir()) if is_table(path) and not path.name.endswith(LEFT_OUT)]
    records = {port.source for port in routes.ports.values() if port.protocol == RECORDS}
    found = [path for path in paths if source_of(path) in records]
    if not found:
        raise UserError(
            f'{folder}: no table belongs to a device of protocol "{RECORDS}"; name the sections as the tables are '
            "(gnss-rover_fixes.csv: [gnss.rover]), or give --source kind/name=FILE"
        )
    return [table_of(routes, path, None) for path in found]


def settle_tables(captures: Iterable[Capture]) -> None:
    """Let fixes name seconds only where no table of time messages of the same receiver does."""
    tables = [capture for capture in captures if capture.kind == "table"]
    told = [capture.port for capture in tables if _names_seconds(capture)]
    for capture in tables:
        capture.tells_time = capture.port not in told


def _names_seconds(capture: Capture) -> bool:
    """Return whether a table holds time messages of a receiver."""
    if capture.port is None or not capture.port.source.startswith("gnss/"):
        return False
    return RowKind.TIME in plan_of(capture.path, table_columns(capture.path), "gnss").kinds
