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
    text: Annotated[str, typer.Argument(metavar="TEXT", help='Text of the note, such as "line 4 start".')],
    where: Annotated[
        Path,
        typer.Argument(metavar="[CONFIG|DIR]", help="Configuration or log directory of the recorder.", readable=False),
    ] = DEFAULT_CONFIG,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Write the note TEXT into the running recording, as an event `mark` with the current time.

    Exit code 1 while the recording is paused (the note is written when it resumes), 3 when no recorder is running.
    """
    from swath.daemon.recorder.control import NOTE_CHARACTERS
    from swath.daemon.recorder.control_client import ask

    if not text.strip() or len(text) > NOTE_CHARACTERS:
        raise UserError(
            f"TEXT has {len(text)} characters; want 1 to {NOTE_CHARACTERS}, not only spaces", ExitCode.USAGE
        )
    answer = ask(log_directory(where), {"command": "mark", "text": text})
    if as_json:
        print(json.dumps(answer, indent=2))
    else:
        when = datetime.fromtimestamp(answer["time_ns"] * 1e-9, tz=UTC)
        print(f"noted at {when:%H:%M:%S.%f} UTC in {answer['session_id']} part {answer['part']}: {answer['text']}")
    if not answer["recording"]:
        raise UserError(f"the recording is paused, the note is written when it resumes: {answer['reason']}")
