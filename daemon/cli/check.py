"""The command `swath check`: validates a configuration and checks that every device answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode

if TYPE_CHECKING:
    from swath.daemon.config import Config
    from swath.daemon.devices.check import Report


def command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, for example /etc/swath/swath.toml.")],
    offline: Annotated[bool, typer.Option("--offline", help="Validate only; do not open any device.")] = False,
    seconds: Annotated[float, typer.Option(help="Seconds to listen to the devices.", min=0.1, max=3600.0)] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Validate CONFIG, then listen to every device and report what it sends, its time status and its problems.

    Prints where the devices are mounted. Exit code 1 when a device has a problem or a setting is hardly meant.
    """
    from swath.daemon.config import load_config
    from swath.daemon.config.findings import configuration_findings
    from swath.daemon.config.geometry import drawing, geometry_lines, placed_devices

    loaded = load_config(config, to_record=True)
    planned, plan_findings = _planned(loaded)
    findings = [*configuration_findings(loaded), *_crs_findings(loaded), *plan_findings]
    placed = placed_devices(loaded)
    reports = [] if offline else _listen(loaded, seconds)
    wrong = bool(findings) or not all(report.ok for report in reports)
    if as_json:
        found = {"config": str(config), "ok": not wrong, "findings": findings, "geometry": geometry_lines(placed)}
        found |= {"plan": planned} if planned else {}
        found |= {"sources": _sources(loaded)} if offline else {"devices": [report.plain() for report in reports]}
        print(json.dumps(found, indent=2))
    else:
        if offline:
            sources = _sources(loaded)
            count = "1 source" if len(sources) == 1 else f"{len(sources)} sources"
            print(f"{loaded.path}: valid; {count}: {', '.join(sources) or 'none'}")
        else:
            _print_reports(reports)
        for line in [*planned, *geometry_lines(placed), *drawing(placed)]:
            print(line)
        _print_findings(findings)
    if wrong:
        raise typer.Exit(int(ExitCode.PROBLEM))


def _print_findings(findings: list[str]) -> None:
    from rich.console import Console

    console = Console(soft_wrap=True)
    for line in findings:
        console.print(line, style="red", markup=False, highlight=False)


def _crs_findings(config: Config) -> list[str]:
    """Return a line for each CRS that PROJ does not know or Swath refuses; PROJ may be absent on a recorder."""
    if config.output.crs is None:
        return []
    try:
        from swath.georef.mapping.datums import MappingError, read_source, read_target
    except ImportError:
        return []
    lines = []
    try:
        target = read_target(config.output.crs)
    except MappingError as error:
        return [str(error)]
    for name, gnss in config.gnss.items():
        try:
            read_source(gnss.datum, target)
        except MappingError as error:
            lines.append(f"gnss.{name}: {error}")
    return lines


def _planned(config: Config) -> tuple[list[str], list[str]]:
    """Return the size of the flight plan and what was assumed, a line each, and what is wrong; PROJ may be absent."""
    if config.tables.plan.file is None:
        return [], []
    try:
        from swath.daemon.processing.flightplan.geometry import LineGeometry
        from swath.daemon.processing.flightplan.plan import PlanError
        from swath.daemon.processing.flightplan.read import plan_of
    except ImportError:
        return [], []
    try:
        plan = plan_of(config, {name: data for name, _, data in config.attachments()})
    except PlanError as error:
        return [], [f"plan.file: {error}"]
    if plan is None:
        return [], []
    km = float(LineGeometry(plan.lines).length_m.sum()) / 1000.0
    polygons = len(plan.area)
    area = {0: "no area", 1: "an area of 1 polygon"}.get(polygons, f"an area of {polygons} polygons")
    lines = "1 line" if len(plan.lines) == 1 else f"{len(plan.lines)} lines"
    return [f"plan {plan.name}: {lines}, {km:.1f} km, {area}", *plan.notes], []


def _listen(config: Config, seconds: float) -> list[Report]:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.devices.check import check_everything

    with progress_bar() as tell:
        tell(f"listening for {seconds:g} s", 0, 0)
        return check_everything(config, seconds)


def _sources(config: Config) -> list[str]:
    return [f"pps/{name}" for name in config.pps] + [device.source for device in config.devices()]


def _print_reports(reports: list[Report]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from swath.daemon.cli.progress import page_console

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("source", "protocol", "opens", "bytes", "records", "time", ""):
        table.add_column(title, justify="right" if title == "bytes" else "left", no_wrap=title in ("source", "opens"))
    for report in reports:
        records = ", ".join(f"{name} {count}" for name, count in report.records.most_common() if count)
        count = f"{report.bytes:,}" if report.bytes else ""
        verdict = Text("ok", style="green") if report.ok else Text("doubtful", style="yellow")
        if report.problems:
            verdict = Text("wrong", style="red")
        opens = "yes" if report.opens else "no"
        table.add_row(report.source, report.protocol, opens, count, records, report.time, verdict)
    console = page_console()
    console.print(table)
    for report in reports:
        for problem in report.problems:
            console.print(f"{report.source}: {problem}", style="red", markup=False, highlight=False, soft_wrap=True)
        for doubt in report.doubts:
            console.print(f"{report.source}: {doubt}", style="yellow", markup=False, highlight=False, soft_wrap=True)
        for note in [*report.facts, *report.notes]:
            console.print(f"{report.source}: {note}", style="dim", markup=False, highlight=False, soft_wrap=True)
