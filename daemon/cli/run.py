"""The command ``swath run``: records."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer


def _log_to_stderr() -> None:
    from swath.daemon.recorder.journal import JournalFormatter, JournalHandler

    handler = JournalHandler(sys.stderr.fileno())
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(JournalFormatter("%(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-8s %(message)s", "%H:%M:%S"))
    logging.getLogger("swath").addHandler(handler)
    logging.getLogger("swath").setLevel(logging.INFO)


def command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, for example /etc/swath/swath.toml.")],
    seconds: Annotated[
        float | None, typer.Option(help="Stop after this many seconds; default: run until stopped.", min=0.0)
    ] = None,
) -> None:
    """Record every byte of the sensors in CONFIG until SIGTERM or Ctrl-C; SIGHUP begins a new part of the log."""
    from swath.daemon.config import load_config
    from swath.daemon.config.findings import NO_SOURCE
    from swath.daemon.recorder.run import record

    _log_to_stderr()
    loaded = load_config(config, to_record=True)
    if not any(loaded.device_tables()) and not loaded.pps:
        logging.getLogger("swath").warning("%s: %s", config, NO_SOURCE)
    raise typer.Exit(int(record(loaded, seconds)))
