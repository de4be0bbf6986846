"""The command ``swath console``: serves the operator's pages."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory
from swath.daemon.processing.requirements import require_installed

if TYPE_CHECKING:
    from swath.daemon.config.listen import Place
    from swath.daemon.config.tables import ConsoleConfig

PAIR = "pair"


def command(
    where: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[pair] [CONFIG|DIR]",
            help="Configuration or log directory of the recorder, with --replay logs. "
            "pair: show address and token as a QR code.",
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS:PORT", help="Address and port to listen at, instead of `[console] listen`."),
    ] = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="Show finished logs as in flight: for training and debriefing.")
    ] = False,
    pace: Annotated[float, typer.Option(help="--replay: times as fast as it was.", min=0.1, max=1000.0)] = 1.0,
    background: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Map behind the painted one, instead of `[console] background`."),
    ] = None,
    viewer: Annotated[bool, typer.Option("--viewer", help="pair: show the token of those who may only look.")] = False,
) -> None:
    """Serve the operator's console: pages in a browser that show whether everything records and the strips are good.

    Reads what `swath run` and `swath live` write, and asks the recorder for marks and new parts only. It listens on
    this computer alone unless another address is given; then pages need a token, which `swath console pair` shows.
    """
    require_installed("swath console", "starlette", "uvicorn", "xstatic", "cryptography", "segno", "PIL", "pmtiles")
    from swath.daemon.config.tables import ConsoleConfig
    from swath.daemon.console.rasters import open_raster
    from swath.daemon.console.serve import pairing_text, serve
    from swath.daemon.processing.live.tiles import FOLDER

    words = list(where or [])
    pairs = words[:1] == [PAIR]
    if pairs:
        words.pop(0)
    if len(words) > 1 and not replay:
        raise UserError("too many arguments; give one CONFIG or DIR", ExitCode.USAGE)
    if replay:
        _replay([Path(word) for word in words], listen, pace, background)
        return
    path = Path(words[0]) if words else DEFAULT_CONFIG
    config = ConsoleConfig()
    if path.is_file():
        from swath.daemon.config import load_config

        loaded = load_config(path)
        config = loaded.tables.console
        if background is None and config.background is not None:
            background = loaded.resolve(config.background)
    place = _place(listen, config)
    if pairs:
        print(pairing_text(place, config, viewer=viewer))
        return
    directory = log_directory(path)
    raster = None if background is None else open_raster(background)
    print(place.url, flush=True)
    serve(directory, directory / FOLDER, config, place, background=raster)


def _place(listen: str | None, config: ConsoleConfig) -> Place:
    from swath.daemon.config.listen import parse_listen

    try:
        return parse_listen(config.listen if listen is None else listen)
    except ValueError as error:
        raise UserError(f"--listen: {error}", ExitCode.USAGE) from error


def _replay(paths: list[Path], listen: str | None, pace: float, background: Path | None) -> None:
    """Let logs grow again in a temporary folder, beside `swath live`, and serve that."""
    from swath.daemon.config.tables import ConsoleConfig
    from swath.daemon.console.rasters import open_raster
    from swath.daemon.console.replaying import GrowingCopy
    from swath.daemon.console.serve import serve
    from swath.daemon.console.watch import LIVE_STATUS
    from swath.daemon.log.reader import open_logs
    from swath.daemon.processing.live.tiles import FOLDER
    from swath.daemon.processing.user_errors import as_user_error

    if not paths:
        raise UserError("--replay needs logs: swath console --replay LOG…", ExitCode.USAGE)
    config = ConsoleConfig()
    place = _place(listen, config)
    raster = None if background is None else open_raster(background)
    with as_user_error(paths[0]):
        sessions = open_logs(paths)
    if len(sessions) > 1:
        names = ", ".join(session.session_id for session in sessions)
        raise UserError(f"these are {len(sessions)} recordings, and one is shown at a time: {names}", ExitCode.USAGE)
    with tempfile.TemporaryDirectory(prefix="swath-console-") as name:
        directory = Path(name)
        os.environ["SWATH_BOOT_ID"] = str(uuid.uuid4())  # of no log, so that time is the log's and not this computer's
        program = [sys.executable, "-m", "swath.daemon.cli.main"]
        live = subprocess.Popen([*program, "live", "--accept-verdict", "--json", name], stdout=subprocess.DEVNULL)
        status = directory / FOLDER / LIVE_STATUS
        growing = GrowingCopy(sessions[0], directory, pace, lambda: status.exists() or live.poll() is not None)
        try:
            print(place.url, flush=True)
            growing.start()
            serve(directory, directory / FOLDER, config, place, asks=False, background=raster)
        finally:
            growing.close()
            live.terminate()
            live.wait()
