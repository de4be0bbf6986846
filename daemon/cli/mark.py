"""The command ``swath mark``: writes a note into the log that is being recorded."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory


def command(
    text: Annotated[str, typer.Argument(metavar="TEXT", help='What to note, such as "line 4 start".')],
    where: Annotated[
        Path,
        typer.Argument(
            metavar="[CONFIG|DIR]", help="Which recorder: its configuration or log directory.", readable=False
        ),
    ] = DEFAULT_CONFIG,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """Note TEXT in the log being recorded: an event `mark` with the time of now.

    Exit code 1 while recording stands still (the note waits for it), 3 when no recorder runs there.
    """
    from swath.daemon.recorder.control import NOTE_CHARACTERS
    from swath.daemon.recorder.control_client import ask

    if not text.strip() or len(text) > NOTE_CHARACTERS:
        raise UserError(f"a note is a text of 1 to {NOTE_CHARACTERS} characters", ExitCode.USAGE)
    answer = ask(log_directory(where), {"command": "mark", "text": text})
    if as_json:
        print(json.dumps(answer, indent=2))
    else:
        when = datetime.fromtimestamp(answer["time_ns"] * 1e-9, tz=UTC)
        print(f"noted at {when:%H:%M:%S.%f} UTC in {answer['session_id']} part {answer['part']}: {answer['text']}")
    if not answer["recording"]:
        raise UserError(f"recording stands still, the note waits for it: {answer['reason']}")
