"""The command ``swath trajectory``: computes the path of the aircraft from a log's IMU and GNSS."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…", readable=False)],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="FILE.sbet, FILE.out or FILE.csv to write; or a folder."),
    ],
    smooth: Annotated[
        bool, typer.Option("--smooth/--realtime", help="Filter forward and backward, or forward only, as in flight.")
    ] = True,
    gnss: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Post-processed antenna positions: RTKLIB .pos or Waypoint text."),
    ] = None,
    week: Annotated[int | None, typer.Option(help="GPS week, if the file of --gnss holds none.", min=0)] = None,
    lever_arm: Annotated[
        str | None,
        typer.Option(
            "--lever-arm", metavar="X,Y,Z", help="Antenna of --gnss, from the IMU in metres: forward, right, down."
        ),
    ] = None,
    csv: Annotated[bool, typer.Option("--csv", help="Also write the trajectory as CSV, with sigmas.")] = False,
    events: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the event marks as CSV, each with its pose.")
    ] = None,
    imu: Annotated[
        str | None, typer.Option(metavar="NAME", help="IMU to use, NAME of [imu.NAME]; default: the first.")
    ] = None,
    gnss_name: Annotated[
        str | None,
        typer.Option("--gnss-name", metavar="NAME", help="Receiver to use, NAME of [gnss.NAME]; default: the first."),
    ] = None,
    ins: Annotated[
        str,
        typer.Option(metavar="HOW", help="The device's own INS solution: ignore, observe (its attitude), or as-is."),
    ] = "ignore",
    start: Annotated[
        str | None,
        typer.Option(metavar="R,P,H", help="Roll, pitch, heading at the start, in degrees; default: estimated."),
    ] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Configuration; default: the logs' own.")] = None,
    no_page: Annotated[bool, typer.Option("--no-page", help="Do not write the page of plots and its PDF.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON, for scripts.")] = False,
) -> None:
    """Compute the trajectory of a log: SBET (or CSV) with accuracies, a JSON summary and a page of plots.

    Every fix is either used or counted with the reason for leaving it out. Exit code 1 when the trajectory is partial
    or not to be used: data damaged, parts missing, inputs that contradict each other; 2 or 3 when there is none.
    """
    require_installed("swath trajectory", *(() if no_page else PRINTED_PAGES))
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.processing.navigation.inputs import INS_USES, InputOptions
    from swath.daemon.processing.navigation.navigate import NavigationOptions, arm_of_text, attitude_of_text
    from swath.daemon.processing.trajectory.request import TrajectoryRequest
    from swath.daemon.processing.trajectory.run import make_trajectory

    if ins not in INS_USES:
        raise UserError(f'--ins: got "{ins}", want {", ".join(INS_USES)}', ExitCode.USAGE)
    arm = None if lever_arm is None else arm_of_text(lever_arm)
    if arm is not None and gnss is None:
        raise UserError(
            "--lever-arm needs --gnss FILE; for the log's own receiver set gnss.<name>.lever_arm_m", ExitCode.USAGE
        )
    inputs = InputOptions(imu, gnss_name, None if config is None else load_config(config), gnss, week, arm, ins)
    attitude = None if start is None else attitude_of_text(start)
    request = TrajectoryRequest(
        logs,
        output,
        NavigationOptions(inputs, smooth=smooth, attitude_rad=attitude, compare_noise=True),
        csv=csv,
        events=events,
        page=not no_page,
        overwrite=overwrite,
    )
    with progress_bar(compiling=True) as tell:
        report = make_trajectory(request, tell)
    if as_json:
        print(json.dumps(report.record, indent=2))
    else:
        _print(report.record, report.files)
    for line in report.warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    unusable = [line for session in report.record["sessions"] for line in _unusable(session)]
    if unusable:
        raise UserError("\n".join(f"{report.summary}: {line}" for line in unusable))
    if not report.record["complete"]:
        raise UserError(f"{report.summary}: partial: " + "; ".join(map(one_line, report.record["holes"][:5])))


def _unusable(session: dict[str, Any]) -> list[str]:
    """Return the verdicts of the legs that are not to be used."""
    return [
        one_line(leg["verdict"]["sentence"]) for leg in session.get("legs", []) if leg["verdict"]["level"] == "unusable"
    ]


def _print(record: dict[str, Any], files: list[Path]) -> None:
    for session in record["sessions"]:
        if "ins" in session:
            text = ", ".join(f"{count:,} {what.replace('_', ' ')}" for what, count in session["solutions"].items())
            print(f"{one_line(session['session'])}: {session['ins']}: {text}")
            continue
        seen = ", ".join(
            f"{count:,} {kind.replace('_', ' ')}" for kind, count in session["gnss"]["observations"].items()
        )
        taken = session["imu"]["samples"].get("taken", 0)
        print(f"{one_line(session['session'])}: {taken:,} samples; observations: {seen}")
        for what, counts in (("samples", session["imu"]["samples"]), ("GNSS", session["gnss"]["refused"])):
            left = ", ".join(f"{count:,} {why.replace('_', ' ')}" for why, count in counts.items() if why != "taken")
            if left:
                print(f"left out or changed, {what}: {left}")
        if session["imu"]["noise_words"]:
            print(one_line(session["imu"]["noise_words"]))
        for leg in session["legs"]:
            print(f"start: {leg['start']['words']}")
            for finding in leg["findings"]:
                print(f"{finding['severity']}: {one_line(finding['text'])}")
            _print_verdict(leg["verdict"])
    for line in record["warnings"]:
        print(f"warning: {one_line(line)}")
    if record.get("events") is not None:
        text = ", ".join(f"{count:,} {fate}" for fate, count in record["events"].items())
        print(f"event marks: {text or 'none in the log'}")
    print(f"{'complete' if record['complete'] else 'partial'}: {', '.join(one_line(str(path)) for path in files)}")


def _print_verdict(verdict: dict[str, Any]) -> None:
    """Print a verdict's sentence, and each reason after the first, which the sentence names, with its remedy."""
    print(one_line(verdict["sentence"]))
    for reason in verdict["reasons"][1:]:
        print(one_line(f"also: {reason['what']}" + (f": {reason['change']}" if reason["change"] else "")))
