"""The command ``swath sim``: flies the virtual aircraft."""

from __future__ import annotations

import json
import logging
import signal
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.written import Reached, error_words, make_folder, room_noted
from swath.georef.progress import Tell

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rich.console import Console

    from swath.daemon.replay.wire_player import Output, PlayReport
    from swath.daemon.simulate.ahead import Ahead, FlightFacts
    from swath.daemon.simulate.folder import FlightFolder
    from swath.daemon.simulate.into_log import SimReport
    from swath.daemon.simulate.plans import FlightOptions

PRESETS = "small, calibration, corridor, block, bench"  # as in swath.sim.plan.plan
CONFIG_NAME, TRUTH_NAME, LOGS_NAME = "swath.toml", "truth.npz", "logs"
SETTLE_S = 1.0  # from the last reader at a port to the first unit; readers of UDP and CAN cannot be detected
SECONDS = "s flown"
LATE_S = 0.5  # a time message later than this after its edge may be taken as the next edge's
INTERRUPTED = 130  # 128 + SIGINT

PlanArgument = Annotated[str, typer.Argument(metavar="PLAN", help=f"Plan file, or a preset: {PRESETS}.")]

app = typer.Typer(
    help="Simulate a survey flight from a plan, into a log or on wires, with known truth.",
    rich_markup_mode="markdown",
)


@app.callback(invoke_without_command=True)
def _callback(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(int(ExitCode.USAGE))


@app.command("fly", short_help="Fly a plan: into a log as fast as possible, or on wires in real time.")
def fly(
    plan: PlanArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="LOG",
            help="Folder, or file name of the log (….mcap). --wire: folder for ports and configuration.",
        ),
    ] = None,
    wire: Annotated[bool, typer.Option("--wire", help="Fly in real time on ptys, CAN, UDP and PPS FIFOs.")] = False,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="--wire: use the wires of this configuration.")
    ] = None,
    wait: Annotated[float, typer.Option(help="--wire: seconds to wait until every port has a reader.", min=0)] = 60.0,
    set_clock: Annotated[
        bool, typer.Option("--set-clock", help="--wire: let simulated faults step this computer's clock (root).")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of the noise, instead of the plan's.", min=0)] = None,
    seconds: Annotated[float | None, typer.Option(help="Fly only this many seconds from the start.", min=0.1)] = None,
    no_truth: Annotated[bool, typer.Option("--no-truth", help="Do not write truth.npz.")] = False,
) -> None:
    """Fly a plan.

    With `-o`, as fast as possible into a log like one of the recorder; beside it go its configuration, nominal and
    true calibration, ground control and the truth. With `--wire`, in real time for a recorder in another terminal.
    """
    from rich.console import Console

    from swath.daemon.simulate.plans import FlightOptions

    logging.getLogger("swath").addHandler(logging.NullHandler())  # events are written to the log, not to stderr
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    options = FlightOptions(plan, seed, seconds)
    if wire:
        if config is not None and output is not None:
            raise UserError(
                "--wire takes -o (new wires in a folder) or --config (wires of a configuration), not both",
                ExitCode.USAGE,
            )
        _fly_on_wires(console, options, output, config, wait, set_clock=set_clock)
        return
    if config is not None or set_clock:
        raise UserError(f"{'--config' if config else '--set-clock'} needs --wire", ExitCode.USAGE)
    if output is None:
        raise UserError("no output given; use -o LOG or --wire", ExitCode.USAGE)
    _fly_into_log(options, output, with_truth=not no_truth)


@app.command("plan", short_help="Draw a plan and print what it covers.")
def plan_(
    plan: PlanArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Picture to write: PNG, PDF or SVG; default: PLAN.png in this folder.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Draw a plan (lines, swaths, buildings, height profile, density, overlap) and print its figures as a table."""
    from swath.daemon.cli.progress import page_console, progress_bar
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.files import aside_folder
    from swath.daemon.simulate.plans import FlightOptions, draw

    picture = output if output is not None else Path(f"{Path(plan).stem}.png")
    refuse_existing([picture], overwrite=overwrite, instead="name")
    try:
        with progress_bar(compiling=True) as tell:
            tell("drawing", 0, 0)
            with aside_folder(picture.parent) as aside:
                rows = draw(FlightOptions(plan), aside / picture.name)
    except UserError as error:  # it names the unfinished picture
        raise UserError(error.message.replace(str(aside / picture.name), str(picture)), error.exit_code) from error
    except OSError as error:
        raise UserError(one_line(error_words(error, picture)), ExitCode.IO) from error
    if as_json:
        print(json.dumps({"picture": str(picture), "lines": rows[:-1], "total": rows[-1]}, indent=2))
        return
    _print_lines(page_console(), rows)
    print(one_line(str(picture)))


def _print_lines(console: Console, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("line", "length", "time", "lowest", "mean", "swath", "per m²", "overlap"):
        table.add_column(column, justify="left" if column == "line" else "right", no_wrap=column == "line")
    for row in rows[:-1]:
        figures = ("length_m", "seconds", "height_min_m", "height_mean_m", "swath_m", "density_per_m2")
        units = ("m", "s", "m", "m", "m", "")
        cells = [
            f"{row[key]:,.{0 if unit == 'm' else 1}f} {unit}".strip() for key, unit in zip(figures, units, strict=True)
        ]
        overlap = f"{row['overlap_percent']:.0f} %" if row["overlap_percent"] else "–"
        table.add_row(one_line(row["name"]), *cells, overlap)
    console.print(table)
    total = rows[-1]
    console.print(
        f"{total['seconds']:.0f} s in all, {total['line_s']:.0f} s on lines; "
        f"about {total['pulses'] / 1e6:,.1f} M pulses, a log of {total['log_bytes'] / 1e6:,.0f} MB",
        highlight=False,
    )


# ---------------------------------------------------------------------------------------------- into a log


def _fly_into_log(options: FlightOptions, output: Path, *, with_truth: bool) -> None:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.simulate.folder import FlightFolder

    started_s = time.monotonic()
    try:
        with progress_bar(compiling=True) as tell, FlightFolder(output) as folder:
            report, names = _make_log(tell, options, folder, with_truth=with_truth)
            logs = folder.keep(report.paths)
    except OSError as error:
        raise UserError(one_line(error_words(error, output)), ExitCode.IO) from error
    _print_flown(report, time.monotonic() - started_s, logs, names)


def _make_log(
    tell: Tell, options: FlightOptions, folder: FlightFolder, *, with_truth: bool
) -> tuple[SimReport, list[str]]:
    """Make all files of a flight in the hidden folder; return the report and the names of the files beside the log."""
    from swath.daemon.config import load_config
    from swath.daemon.simulate.into_log import fly_into_log, sim_session_info
    from swath.daemon.simulate.plans import configuration, make_flight

    plan = options.load()
    folder.refuse_taken([CONFIG_NAME])  # before anything that takes long
    tell("preparing the flight", 0, 0)
    flight, files = make_flight(options, folder.work / TRUTH_NAME if with_truth else None)
    files[CONFIG_NAME] = configuration(plan, None, ".")
    names = sorted([*files, *([TRUTH_NAME] if with_truth else [])])
    folder.refuse_taken(names)
    folder.write(files)
    config = load_config(folder.work / CONFIG_NAME)
    flight_seed = plan.tables.flight.seed
    folder.refuse_session(sim_session_info(config.session.name, flight.host_clock, flight_seed).session_id)
    flown = f"flying {config.session.name}"
    reached = Reached(lambda done, total: tell(flown, done, total, SECONDS))
    with room_noted(folder.work, reached.share):
        report = fly_into_log(
            config,
            folder.work,
            flight,
            flight_seed,
            lambda flown_s, *_: reached(round(flown_s), round(flight.duration_s)),
        )
    tell("packing the truth", 0, 0)
    flight.finish_truth()
    return report, names


def _print_flown(report: SimReport, took_s: float, logs: list[Path], names: list[str]) -> None:
    print(
        f"{report.session_id}: {report.seconds:.1f} s flown in {took_s:.1f} s, {sum(report.units.values()):,} units, "
        f"{report.returns:,} returns, {report.bytes / 1e6:.1f} MB"
    )
    for path in logs:
        print(one_line(f"  {path}"))
    print(f"  beside it: {', '.join(names)}")


# ---------------------------------------------------------------------------------------------- on wires


def _fly_on_wires(
    console: Console,
    options: FlightOptions,
    folder: Path | None,
    config_path: Path | None,
    wait_s: float,
    *,
    set_clock: bool,
) -> None:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.replay.units import close_outputs
    from swath.daemon.simulate.ahead import Ahead
    from swath.daemon.simulate.on_wires import check_steps, open_wires
    from swath.daemon.simulate.plans import make_flight_in_time

    plan = options.load()
    config = load_config(config_path) if config_path is not None else None
    ahead = Ahead(partial(make_flight_in_time, options))
    stop: list[int] = []
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        with progress_bar() as tell:
            tell("preparing the flight", 0, 0)
            facts = ahead.facts
        check_steps(facts, set_clock=set_clock)
        if config_path is None or config is None:
            config_path = _make_wires(console, plan, facts, folder)
            config = load_config(config_path)
        outputs, others = open_wires(config, facts)
        for signum in before:
            signal.signal(signum, lambda number, frame: stop.append(number))
        try:
            _await_readers(console, outputs, wait_s, lambda: bool(stop))
            report = _play(plan.tables.flight.name, ahead, outputs, others, lambda: bool(stop))
        finally:
            close_outputs(outputs)
            close_outputs(others)
    except OSError as error:
        text = error_words(error, error.filename) if error.filename else str(error)
        raise UserError(one_line(text), ExitCode.IO) from error
    finally:
        ahead.close()
        for signum, handler in before.items():
            signal.signal(signum, handler)
    _tell_report(console, report, facts, outputs, config_path)
    if stop:
        raise typer.Exit(INTERRUPTED)


def _make_wires(console: Console, plan: Any, facts: FlightFacts, folder: Path | None) -> Path:
    """Make a folder with ports, FIFOs and the configuration that records from them; return the configuration's path."""
    from swath.daemon.simulate.on_wires import own_wires
    from swath.daemon.simulate.plans import configuration

    place = Path(tempfile.mkdtemp(prefix="swath-sim-")) if folder is None else folder.absolute()
    path = place / CONFIG_NAME
    baud = {f"gnss/{name}": table.baud for name, table in plan.tables.gnss.items()}
    files = facts.files | {CONFIG_NAME: configuration(plan, own_wires(place, facts.sources, baud), LOGS_NAME)}
    for name in (CONFIG_NAME, *facts.files):
        if (place / name).exists():
            instead = f"use its wires with --config {path}, or " if name == CONFIG_NAME else ""
            raise UserError(one_line(f"{place / name}: already exists; {instead}choose another folder"), ExitCode.IO)
    make_folder(place)
    for name, data in files.items():
        (place / name).write_bytes(data)
    console.print(f"the wires of the flight are in {place}; record it in another terminal:\n\n  swath run {path}\n")
    return path


def _await_readers(console: Console, outputs: Mapping[str, Output], wait_s: float, stopped: Callable[[], bool]) -> None:
    from swath.daemon.replay.wire_player import wait_for_readers

    with console.status("waiting for a reader to open the ports"):
        for source in wait_for_readers(outputs, wait_s, stopped):
            console.print(f"{source}: no reader has opened it; flying without one")
        settled_s = time.monotonic() + SETTLE_S
        while time.monotonic() < settled_s and not stopped():
            time.sleep(0.05)


def _play(
    name: str,
    ahead: Ahead,
    outputs: Mapping[str, Output],
    others: Mapping[str, Output],
    stopped: Callable[[], bool],
) -> PlayReport:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.simulate.on_wires import fly_on_wires

    duration_s = ahead.facts.duration_s
    with progress_bar() as tell:  # the other process has compiled

        def flown(flown_s: float, report: PlayReport) -> None:
            tell(f"flying {name}", round(flown_s), round(duration_s), SECONDS)

        return fly_on_wires(ahead.units(), ahead.facts, outputs, others, progress=flown, stopped=stopped)


def _tell_report(
    console: Console, report: PlayReport, facts: FlightFacts, outputs: Mapping[str, Output], config: Path
) -> None:
    for source in sorted(report.passed_over):
        console.print(f"{source}: is in the flight but not in {config}; not sent")
    for source in sorted(outputs):
        if source not in facts.sources:
            console.print(f"{source}: is in {config} but not in the flight")
            continue
        refused = f", {report.refused[source]:,} rejected by a reader" if report.refused[source] else ""
        console.print(f"{source}: {report.units[source]:,} units, {report.bytes[source]:,} bytes{refused}")
    slow = report.latest_s > LATE_S and not report.refused  # otherwise it may have waited for a reader
    remark = "; this computer is too slow to fly this plan in real time" if slow else ""
    console.print(f"largest delay of a unit: {report.latest_s:.3f} s{remark}")
