"""The command ``swath warm-up``: compiles everything before there is anything to compute."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.processing.requirements import require_installed


def command(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="[CONFIG]", help="Also compile what this configuration needs.", readable=False),
    ] = None,
) -> None:
    """Compile the computing code of swath live, georef and calibrate, and store it for later runs.

    The folder is NUMBA_CACHE_DIR, else beside the program or in the user's cache; it is printed. Once is enough until
    the program or the computer changes.
    """
    require_installed("swath warm-up")
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.processing.setup.sent_files import example_files
    from swath.daemon.processing.setup.setup import Options, Setup
    from swath.daemon.processing.warm_up import warm_up

    setups: list[Setup] = []
    if config is not None:
        loaded = load_config(config)
        setups.append(Setup.of_config(loaded, Options(uncertainty=False), example_files(loaded)))
    with progress_bar() as tell:
        done = warm_up(setups, calibration=True, tell=tell)
    print(done.text(), flush=True)
