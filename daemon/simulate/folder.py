"""Provides the folder of a flight's log: hidden while the flight is made, in its final place when complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.exchange.log_maker import refuse_session
from swath.daemon.log.durable import sync_directory
from swath.daemon.system import held_interrupts
from swath.daemon.written import FLYING, make_folder, note_written, remove_empty_folders

_AGAIN = "already exists; remove it or choose another place"


class FlightFolder:
    """A temporary folder inside the requested one; files that are not kept at the end are removed.

    Args:
        output: a folder, or the name of the log, which ends in ``.mcap``.

    Attributes:
        work: folder where all files are written.
        place: folder where they are moved at the end.

    Raises:
        UserError: it cannot be made, or another flight is at work there.
    """

    def __init__(self, output: Path) -> None:
        self.log_name = output.name if output.suffix == ".mcap" else ""
        self.place = output.parent if self.log_name else output
        self.work = self.place / f".{output.name}{FLYING}"
        try:
            make_folder(self.place)
            self.work.mkdir()
        except FileExistsError as error:
            text = f"{error.filename}: another flight runs there, or was killed there; wait for it or remove the folder"
            if error.filename == str(self.place):
                text = f"{self.place}: is a file; give a folder or a name that ends in .mcap"
            raise UserError(text, ExitCode.IO) from error
        except OSError as error:
            raise UserError(
                f"{error.filename}: {error.strerror}; choose a place that you may write to", ExitCode.IO
            ) from error

    def __enter__(self) -> FlightFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Remove all files that were not kept, and the requested folder if it was made for them."""
        shutil.rmtree(self.work, ignore_errors=True)
        remove_empty_folders()

    def refuse_taken(self, names: Iterable[str]) -> None:
        """Refuse to overwrite existing files; raises UserError."""
        for name in (self.log_name, *sorted(names)):
            if name and os.path.lexists(self.place / name):
                raise UserError(f"{self.place / name}: {_AGAIN}", ExitCode.IO)

    def refuse_session(self, session_id: str) -> None:
        """Refuse a folder that already holds a log of this session; raises UserError."""
        if not self.log_name:
            refuse_session(self.place, session_id)

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write small files; raises OSError."""
        for name, data in files.items():
            (self.work / name).write_bytes(data)

    def keep(self, logs: list[Path]) -> list[Path]:
        """Move all files to their place and return the new paths of the log's parts.

        Args:
            logs: the parts, within ``work``; exactly one if the log has a name.

        Raises:
            UserError: a file of the same name exists already.
            OSError: the files cannot be moved.
        """
        goes = {path: path.name for path in sorted(self.work.iterdir())}
        if self.log_name:
            goes[logs[0]] = self.log_name
        self.refuse_taken(goes.values())
        with held_interrupts():
            for path, name in goes.items():
                path.rename(self.place / name)
                note_written(self.place / name)
        sync_directory(self.place)
        return [self.place / goes[path] for path in logs]
