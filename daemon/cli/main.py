"""The command line: `swath COMMAND`, one file a command, loaded when it is asked for.

Errors are one line on stderr; no traceback reaches a user.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import typer
from typer.core import TyperGroup

from daemon.errors import ExitCode, UserError

if TYPE_CHECKING:
    from click import Command, Context

INTERRUPTED = 130  # 128 + SIGINT, as shells say it

EPILOG = (
    "Exit codes: 0 ok · 1 the job found a problem · 2 wrong configuration or usage · "
    "3 cannot read or write · 4 data is damaged · 130 interrupted"
)


@dataclass(frozen=True, slots=True)
class Listed:
    """A command as the help lists it: its file is not imported for that."""

    name: str
    summary: str
    panel: str

    @property
    def module(self) -> str:
        """Where the command is."""
        return f"daemon.cli.{self.name.replace('-', '_')}"


COMMANDS = (
    Listed("run", "Record: every byte of the configured sensors into a log.", "Record"),
    Listed("check", "Open every configured device and say what it answers.", "Record"),
    Listed("info", "What a log holds: duration, counts, rates, gaps, losses, time status.", "Logs"),
    Listed("replay", "Put the bytes of a log back on the wires.", "Logs"),
    Listed("recover", "Repair a log that a crash left open; say exactly what was lost.", "Logs"),
    Listed("devices", "List the protocols there are and what each yields.", "Setup"),
)


def _is_there(listed: Listed) -> bool:
    return (Path(__file__).parent / f"{listed.module.rpartition('.')[2]}.py").exists()


class LazyGroup(TyperGroup):
    """Lists the commands without importing their files."""

    def list_commands(self, ctx: Context) -> list[str]:
        """Names in the order of the help."""
        return [listed.name for listed in COMMANDS if _is_there(listed)]

    def get_command(self, ctx: Context, cmd_name: str) -> Command | None:
        """A command: a placeholder for the help's list, the real one otherwise."""
        listed = next((listed for listed in COMMANDS if listed.name == cmd_name and _is_there(listed)), None)
        if listed is None:
            return None
        if getattr(ctx, "listing", False):
            return _placeholder(listed)
        return load_command(listed)
