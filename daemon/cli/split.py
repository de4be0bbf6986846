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
        typer.Argument(
            metavar="[CONFIG|DIR]", help="Which recorder: its configuration or log directory.", readable=False
        ),
    ] = DEFAULT_CONFIG,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """Begin a new part of the log, as SIGHUP does; nothing is lost between the two.

    Exit code 1 when no new part came, 3 when no recorder runs there.
    """
    from swath.daemon.recorder.control_client import ask, wait_for_part

    directory = log_directory(where)
    answer = ask(directory, {"command": "split"})
    name = wait_for_part(directory, answer["session_id"], answer["part"])
    if name is None:
        raise UserError(f"{directory}: no new part was begun; the last events say why (swath info, journalctl)")
    if as_json:
        print(json.dumps(answer | {"new_part": name}, indent=2))
    else:
        print(f"recording goes on in {name}")
