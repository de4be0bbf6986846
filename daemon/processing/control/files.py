"""Control as a user gives it: a file, its CRS, its columns. It is read at once and placed when the logs are open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from swath.calib.control.points import ControlError, Surveyed
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import Session
from swath.daemon.processing.control.columns import given_columns
from swath.daemon.processing.control.layers import read_geopackage, read_shapefile
from swath.daemon.processing.control.place import KEY, place_control
from swath.daemon.processing.control.table import ControlTable
from swath.daemon.processing.control.text import read_text
from swath.daemon.processing.flights.flight_places import flight_places
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.text_files import text_of

LAYERS = {".gpkg": read_geopackage, ".shp": read_shapefile}


@dataclass(eq=False)
class ControlFile:
    """A control file.

    Attributes:
        table: its points as they stand there.
        crs: CRS that the user gives for them; None: none.
        points, notes: the points on the earth, and what was assumed for them, one line each; after `place`.
    """

    table: ControlTable
    crs: str | None = None
    points: tuple[Surveyed, ...] = ()
    notes: list[str] = field(default_factory=list)

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self.table.path

    def place(self, sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
        """Place the points on the earth, and check them against the place of the flight, as its logs give it.

        Raises:
            UserError: the points' CRS cannot be used; ControlError: the points cannot be meant.
        """
        mapping = setups[0].mapping
        assert mapping is not None
        opened = zip(sessions, setups, strict=True)
        places = [flight_places(session, setup.config, setup.sources.attachments) for session, setup in opened]
        placed = place_control(self.table, self.crs, mapping, np.concatenate(places))
        self.points, self.notes = placed.points, list(placed.notes)


def read_control_file(path: Path | None, crs: str | None = None, columns: str | None = None) -> ControlFile | None:
    """Read a control file as the command line gives it; None if it gives none.

    Args:
        path: text, GeoPackage or shapefile.
        crs: CRS of its coordinates; None: that of the file or the project.
        columns: the meanings of a text file's columns; None: by its header, or as is usual.

    Raises:
        UserError: the file cannot be read, or is no control; a line for each mistake.
    """
    if path is None:
        if crs or columns:
            raise UserError(f"{KEY if crs else '--control-columns'} needs --control FILE", ExitCode.USAGE)
        return None
    layer = LAYERS.get(path.suffix.lower())
    if layer is not None and columns:
        raise UserError(f"{path}: has named columns; --control-columns is for text files", ExitCode.USAGE)
    try:
        if layer is not None:
            _refuse_unreadable(path)
            return ControlFile(layer(path), crs)
        given = None if columns is None else given_columns(columns)
        return ControlFile(read_text(text_of(path), path, given), crs)
    except ControlError as error:
        raise UserError(str(error)) from error


def _refuse_unreadable(path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}", ExitCode.IO) from error
