"""The command ``swath split``: begins a new part of the log that is being recorded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.errors import UserError
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory


def command(
    where: Annotated[
        Path,
        typer.Argument(metavar="[CONFIG|DIR]", help="Configuration or log directory of the recorder.", readable=False),
    ] = DEFAULT_CONFIG,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Begin a new part of the running recording, as SIGHUP does; no data is lost in between.

    Exit code 1 when no new part began, 3 when no recorder is running.
    """
    from swath.daemon.recorder.control_client import ask, wait_for_part

    directory = log_directory(where)
    answer = ask(directory, {"command": "split"})
    name = wait_for_part(directory, answer["session_id"], answer["part"])
    if name is None:
        raise UserError(f"{directory}: the recorder began no new part; see its latest events (swath info, journalctl)")
    if as_json:
        print(json.dumps(answer | {"new_part": name}, indent=2))
    else:
        print(f"recording continues in {name}")
