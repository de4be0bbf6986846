"""The command line `swath COMMAND`; each command has its own file.

Every error is one line on stderr. Users never see a traceback: the details of an internal error are written to a file
that the line names.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import keyword
import math
import os
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from swath import __version__
from swath.daemon import written
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.system import keep_freed_memory

INTERRUPTED = 130  # 128 + SIGINT, as in shells
PIPE_CLOSED = 141  # 128 + SIGPIPE
CLEANING_S = 5.0  # after an interrupt, during which another one does not disturb the removal of unfinished files
WITHOUT_FILES = ("run", "mark", "split", "check", "monitor", "live", "console", "info", "devices", "doctor", "setup")

COMPLETE_VARIABLE = "_SWATH_COMPLETE"  # set by the script of `swath completion` when it asks

HELP = """Record, georeference and calibrate an airborne laser scanner.

`swath check CONFIG` tests every device; `swath run CONFIG` records.
"""
EPILOG = (
    "Exit codes: 0 ok, 1 problem found, 2 wrong configuration or usage, 3 cannot read or write, 4 damaged data, "
    "130 interrupted."
)


@dataclass(frozen=True, slots=True)
class Listed:
    """A command with its name, its summary and its panel in the help."""

    name: str
    summary: str
    panel: str

    @property
    def module(self) -> str:
        """Module of the command; a name that is a Python keyword gets an underscore at its end."""
        name = self.name.replace("-", "_")
        return f"swath.daemon.cli.{name}_" if keyword.iskeyword(name) else f"swath.daemon.cli.{name}"


COMMANDS = (
    Listed("run", "Record every byte of the configured sensors.", "Record"),
    Listed("check", "Validate a configuration; listen to every device.", "Record"),
    Listed("mark", "Write a note into the log being recorded.", "Record"),
    Listed("split", "Begin a new part of the log being recorded.", "Record"),
    Listed("monitor", "Show a running recorder live: rates, losses, time, disk.", "Record"),
    Listed("live", "Georeference the running recording and show it.", "Record"),
    Listed("console", "Serve pages that show the operator what is recorded.", "Record"),
    Listed("landing", "Say before landing: fly again, or go home, and why.", "Record"),
    Listed("info", "Report what logs hold: counts, gaps, losses, time.", "Logs"),
    Listed("replay", "Play the bytes of a log back on wires.", "Logs"),
    Listed("import", "Make a log from captures: pcap, candump, serial bytes.", "Logs"),
    Listed("export", "Write a log as files for the devices' own tools.", "Logs"),
    Listed("recover", "Repair a log left open by a crash; report losses.", "Logs"),
    Listed("offload", "Copy finished logs to another disk; verify each copy.", "Logs"),
    Listed("trajectory", "Compute the trajectory of logs, with accuracies.", "Products"),
    Listed("georef", "Georeference logs: one LAZ file per strip.", "Products"),
    Listed("accuracy", "Say how sure points and their differences are.", "Products"),
    Listed("view", "Show products on one page: maps, differences, a profile.", "Products"),
    Listed("calibrate", "Estimate boresight, range offset and more.", "Calibration"),
    Listed("plan-calibration", "Predict the accuracy of a planned calibration.", "Calibration"),
    Listed("strips", "Compare strips; judge them by specifications.", "Calibration"),
    Listed("validate", "Test a calibration with independent data.", "Calibration"),
    Listed("history", "Follow the calibrations of an aircraft over time.", "Calibration"),
    Listed("sim", "Simulate a flight into a log or on wires.", "Logs"),
    Listed("warm-up", "Compile the computing code before the flight.", "Setup"),
    Listed("doctor", "Check whether this computer can record safely.", "Setup"),
    Listed("setup", "Show or send the set-up messages of the devices.", "Setup"),
    Listed("completion", "Print the script for completion in a shell.", "Setup"),
    Listed("devices", "List the supported protocols and their records.", "Setup"),
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"swath {__version__}")
        raise typer.Exit


def _callback(
    version: Annotated[
        bool,
        typer.Option(
            "--version", metavar="", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Take the options of `swath` itself."""


@functools.cache
def make_app(name: str | None) -> typer.Typer:
    """Make the application with the command of this name, or all; each command imports its heavy modules
    when it runs.
    """
    made = typer.Typer(name="swath", help=HELP, epilog=EPILOG, add_completion=False, rich_markup_mode="markdown")
    made.callback(help=HELP, epilog=EPILOG)(_callback)
    for listed in COMMANDS:
        if name in (None, listed.name) and importlib.util.find_spec(listed.module) is not None:
            module = importlib.import_module(listed.module)
            if hasattr(module, "app"):  # it has subcommands
                made.add_typer(module.app, name=listed.name, short_help=listed.summary, rich_help_panel=listed.panel)
            else:
                made.command(listed.name, short_help=listed.summary, rich_help_panel=listed.panel)(module.command)
    return made


def main() -> None:
    """Run the command line and leave with its exit code."""
    keep_freed_memory()
    interrupts = _Interrupts()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a background job of a shell ignores it
        signal.signal(signal.SIGINT, interrupts.take)
        sys.unraisablehook = interrupts.take_again
    sys.exit(run_app(sys.argv[1:]))


class _Interrupts:
    """Turns the first interrupt into an exception; while unfinished files are removed, more have no effect."""

    def __init__(self) -> None:
        self._since_s = -math.inf

    def take(self, number: int, frame: FrameType | None) -> None:
        """Raise `KeyboardInterrupt`, unless that was done a moment ago."""
        now_s = time.monotonic()
        if now_s - self._since_s >= CLEANING_S:
            self._since_s = now_s
            raise KeyboardInterrupt

    def take_again(self, lost: sys.UnraisableHookArgs) -> None:
        """Repeat an interrupt that was lost where Python can raise nothing, as in a finaliser."""
        if issubclass(lost.exc_type, KeyboardInterrupt):
            self._since_s = -math.inf
            signal.raise_signal(signal.SIGINT)
        else:
            sys.__unraisablehook__(lost)


def run_app(arguments: list[str]) -> int:
    """Run a command; every outcome becomes an exit code and at most one line for each error."""
    if COMPLETE_VARIABLE in os.environ:
        return _complete()
    if not arguments:
        make_app(None)(args=["--help"], prog_name="swath", standalone_mode=False)
        return int(ExitCode.USAGE)
    try:
        named = next((listed.name for listed in COMMANDS if listed.name == arguments[0]), None)
        result = make_app(named)(args=arguments, prog_name="swath", standalone_mode=False)
        if result == INTERRUPTED:  # typer's code for an interrupt, too
            return _end_interrupted(arguments[0])
        sys.stdout.flush()
    except UserError as error:
        _say(*error.message.splitlines())
        return int(error.exit_code)
    except KeyboardInterrupt:
        return _end_interrupted(arguments[0])
    except BrokenPipeError:
        _drop_output()
        return PIPE_CLOSED
    except SystemExit as leaving:  # Rich ends this way on a closed pipe
        if isinstance(leaving.__context__, BrokenPipeError):
            return PIPE_CLOSED
        raise
    except Exception as error:  # the last resort, for errors that a command does not handle
        return _end_unforeseen(error)
    finally:
        written.remove_empty_folders()
        written.begin()
    return int(result) if isinstance(result, int) else int(ExitCode.OK)


def _complete() -> int:
    """Answer a shell that completes: names of commands without importing them, or the options of the one named."""
    from typer._completion_classes import completion_init

    completion_init()
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
    words = line.split()
    begun = words[1] if len(words) > 2 or (len(words) == 2 and line[-1:].isspace()) else None
    made = make_app(begun) if any(listed.name == begun for listed in COMMANDS) else _names_app()
    made(args=[], prog_name="swath", complete_var=COMPLETE_VARIABLE, standalone_mode=False)
    return int(ExitCode.OK)


def _names_app() -> typer.Typer:
    """Return an application that knows the commands' names and summaries only."""
    made = typer.Typer(name="swath", help=HELP, add_completion=False)
    made.callback(help=HELP)(_callback)
    for listed in COMMANDS:
        made.command(listed.name, short_help=listed.summary, help=listed.summary)(lambda: None)
    return made


def _drop_output() -> None:
    """Redirect output that is still buffered to /dev/null; otherwise the interpreter would report an error
    at its end.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _end_interrupted(command: str) -> int:
    """Say in one line what an interrupted command has written."""
    if command != "monitor":  # whose page ends in no other way
        _say("interrupted" if command in WITHOUT_FILES else f"interrupted; {written.written_words()}")
    return INTERRUPTED


def _end_unforeseen(error: Exception) -> int:
    """Report a usage error of the argument parser, an abort, an I/O error or a defect of swath; return the
    exit code.
    """
    format_message = getattr(error, "format_message", None)  # its class moved between versions of typer
    if callable(format_message):
        message = " ".join(str(format_message()).split())
        context = getattr(error, "ctx", None)
        _say(f"{message.rstrip('.')}; see `{context.command_path if context else 'swath'} --help`")
        return int(ExitCode.USAGE)
    if isinstance(error, typer.Abort):
        return _end_interrupted("")
    if isinstance(error, OSError) and error.errno in written.NO_ROOM:
        if error.filename is None:
            _say(f"output: {error.strerror}; free some space and run the command again")
        else:
            _say(written.error_words(error, error.filename))
        try:
            sys.stdout.flush()
        except OSError:
            _drop_output()
        return int(ExitCode.IO)
    path = _write_traceback(error)
    what = f"{type(error).__name__}: {error}".splitlines()[0]
    _say(f"internal error: {what} (details in {path})" if path else f"internal error: {what}")
    return int(ExitCode.IO if isinstance(error, OSError) else ExitCode.PROBLEM)


def _write_traceback(error: Exception) -> Path | None:
    """Write the details to the service's state directory, or else to the temporary one, and return the file's path."""
    directory = os.environ.get("STATE_DIRECTORY", "").split(":")[0] or tempfile.gettempdir()
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    try:
        descriptor, name = tempfile.mkstemp(prefix=f"swath-error-{stamp}-", suffix=".txt", dir=directory)
        with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
            stream.write(f"swath {' '.join(sys.argv[1:])}\n")
            traceback.print_exception(error, file=stream)
    except OSError:
        return None
    return Path(name)


def _say(*lines: str) -> None:
    for line in lines:
        print(f"swath: {one_line(line)}", file=sys.stderr)


if __name__ == "__main__":
    main()
