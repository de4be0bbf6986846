"""The command `swath devices`: lists the supported protocols."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from swath.drivers.driver import Driver
    from swath.drivers.plugins import NotLoaded


def describe_driver(driver: Driver) -> dict[str, Any]:
    """Return a driver as plain values, the form of ``--json``."""
    fields = {} if driver.options is None else driver.options.model_fields
    return {
        "protocol": driver.protocol,
        "kind": driver.kind,
        "transports": list(driver.transports),
        "yields": [record.__name__ for record in driver.yields],
        "gives_time": driver.kind == "gnss",  # only receivers name the seconds of the clock
        "names_edge": str(driver.names_edge) if driver.names_edge is not None else None,
        "needs": list(driver.needs),
        "options": {key: field.description for key, field in fields.items()},
        "summary": driver.summary,
        "package": None if driver.package is None else str(driver.package),
    }


def command(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """List the supported protocols: their transports, their records and the configuration keys they need.

    Drivers of other packages are listed too, also those that cannot be loaded, with the reason.
    """
    from swath.drivers.driver import KINDS, all_drivers, not_loaded, raw_driver

    listed = [describe_driver(driver) for kind in KINDS for driver in all_drivers(kind).values()]
    listed.append(describe_driver(raw_driver("raw")))
    refused = not_loaded()
    if as_json:
        plain = [{"protocol": one.protocol, "package": str(one.package), "reason": one.reason} for one in refused]
        print(json.dumps({"devices": listed, "not_loaded": plain}, indent=2))
        return
    _print_table(listed)
    _print_refused(refused)


def _print_table(listed: list[dict[str, Any]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from swath.daemon.cli.progress import page_console

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("kind", "protocol", "transports", ""):
        table.add_column(title, no_wrap=title != "")
    kind = ""
    for row in listed:
        first = row["kind"] if row["kind"] != kind else ""
        kind = row["kind"]
        what = Text(row["summary"])
        what.append("\nyields " + (", ".join(row["yields"]) or "no records"), style="dim")
        if row["needs"]:
            what.append("\nneeds " + ", ".join(row["needs"]), style="yellow")
        if row["options"]:
            what.append("\noptions " + ", ".join(row["options"]), style="dim")
        if row["package"]:
            what.append(f"\nfrom the package {row['package']}", style="dim")
        table.add_row(first, row["protocol"], ", ".join(row["transports"]), what)
    page_console().print(table)


def _print_refused(refused: list[NotLoaded]) -> None:
    from swath.daemon.cli.progress import page_console
    from swath.daemon.errors import one_line

    for one in refused:
        line = one_line(f"{one.protocol}: {one}" if one.protocol else str(one))
        page_console().print(line, style="red", markup=False, highlight=False, soft_wrap=True)
