"""Writes the files of a trajectory: SBET and smrmsg, CSV, and those beside them, to temporary files that are then
renamed.

Epochs are written in blocks, so that five hours of them are not in memory twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.earlier_runs import refuse_existing
from swath.daemon.processing.files import gone_on_failure, write_aside
from swath.daemon.processing.pages.names import PRINTED
from swath.georef.arrays import FloatArray
from swath.georef.formats.sbet import SBET_DOUBLES, SMRMSG_DOUBLES, sbet_bytes, smrmsg_bytes
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.timescales.gps_time import SECOND_NS, WEEK_NS, week_from_gps
from swath.georef.trajectory.trajectory import Trajectory

BLOCK = 1 << 16  # epochs written at once
SBETS = (".sbet", ".out")
COLUMNS = ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")


@dataclass(frozen=True, slots=True)
class TrajectoryFiles:
    """The paths of a run's files.

    Attributes:
        sbet, smrmsg, csv: None: not written.
        summary: path of the JSON, which is written last.
        page: path of the plots, with the PDF beside it.
    """

    sbet: Path | None
    smrmsg: Path | None
    csv: Path | None
    summary: Path
    page: Path

    def all(self) -> list[Path]:
        """Return the paths of all files that are written."""
        named = (self.sbet, self.smrmsg, self.csv, self.page, self.page.with_suffix(PRINTED), self.summary)
        return [path for path in named if path is not None]

    @classmethod
    def of_output(cls, output: Path, session: str, *, csv: bool) -> TrajectoryFiles:
        """Return paths for the value of ``-o``: a file .sbet, .out or .csv, or a folder for files named after the
        session.

        Raises:
            UserError: the value is neither.
        """
        suffix = output.suffix.lower()
        if suffix == ".csv":
            return cls(None, None, output, output.with_suffix(".json"), output.with_suffix(".html"))
        if suffix in SBETS:
            text = output.with_suffix(".csv") if csv else None
            return cls(output, _smrmsg_of(output), text, output.with_suffix(".json"), output.with_suffix(".html"))
        if suffix and not output.is_dir():
            raise UserError(f"-o {output}: the name must end in .sbet, .out or .csv, or be a folder", ExitCode.USAGE)
        return cls.in_folder(output, session, csv=csv)

    @classmethod
    def in_folder(cls, folder: Path, session: str, *, csv: bool) -> TrajectoryFiles:
        """Return paths in a folder, named after the session."""

        def ending(suffix: str) -> Path:
            return folder / f"{session}_trajectory{suffix}"

        text = ending(".csv") if csv else None
        return cls(ending(".sbet"), ending(".smrmsg"), text, ending(".json"), ending(".html"))

    def refuse_existing(self, *others: Path | None) -> None:
        """Refuse with `UserError` to replace any of the files, or of ``others``, that exists."""
        paths = [*self.all(), *(other for other in others if other is not None)]
        refuse_existing(paths, overwrite=False, instead="name")


def _smrmsg_of(sbet: Path) -> Path:
    """Return the path under which the sigmas of an SBET are written."""
    if sbet.name.startswith("sbet") and sbet.suffix == ".out":
        return sbet.with_name("smrmsg" + sbet.name.removeprefix("sbet"))
    return sbet.with_suffix(".smrmsg")


def smrmsg_beside(sbet: Path) -> Path | None:
    """Return the path of the sigmas beside an SBET: named as this software does, or with the first word exchanged."""
    names = [_smrmsg_of(sbet)] if sbet.suffix.lower() in SBETS else []
    if sbet.name.startswith("sbet"):
        names.append(sbet.with_name("smrmsg" + sbet.name.removeprefix("sbet")))
    return next((name for name in names if name.exists()), None)


def write_trajectory(
    files: TrajectoryFiles, trajectory: Trajectory, velocity_sigma_l: FloatArray | None
) -> list[tuple[Path, Path]]:
    """Write SBET, smrmsg and CSV, as far as they have paths, to temporary files for `put_in_place`.

    Args:
        files: paths of the files.
        trajectory: trajectory of the body's origin.
        velocity_sigma_l: (n, 3) north, east, down; None: unknown.

    Returns:
        What was written, and where it belongs.

    Raises:
        OSError: a file cannot be written; no temporary file is left.
    """
    written: list[tuple[Path, Path]] = []
    wanted: tuple[tuple[Path | None, Callable[[IO[bytes]], None]], ...] = (
        (files.sbet, lambda stream: _write(stream, _sbet_blocks(trajectory))),
        (files.smrmsg, lambda stream: _write(stream, _smrmsg_blocks(trajectory, velocity_sigma_l))),
        (files.csv, lambda stream: _write(stream, _csv_blocks(trajectory))),
    )
    with gone_on_failure(written):
        for path, write in wanted:
            if path is not None:
                written.append((write_aside(path, write), path))
    return written


def _write(stream: IO[bytes], blocks: Iterator[bytes]) -> None:
    for block in blocks:
        stream.write(block)


def _part(trajectory: Trajectory, first: int, last: int) -> Trajectory:
    return replace(trajectory, **{column: getattr(trajectory, column)[first:last] for column in COLUMNS})


def _of_week_s(trajectory: Trajectory, first: int, last: int) -> FloatArray:
    """Return seconds of the week of the trajectory's first epoch, continued past its end."""
    week, _ = week_from_gps(trajectory.span[0])
    since: FloatArray = (trajectory.time_ns[first:last] - week * WEEK_NS) / SECOND_NS
    return since


def _sbet_blocks(trajectory: Trajectory) -> Iterator[bytes]:
    """Yield blocks of SBET records.

    One epoch beyond a block gives acceleration and rates of the block's last epoch; the very last epoch repeats those
    before.
    """
    n = len(trajectory)
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)
        begin = first - 1 if last == n and first else first
        part = _part(trajectory, begin, min(last + 1, n))
        table = np.frombuffer(sbet_bytes(part), "<f8").reshape(-1, SBET_DOUBLES)[first - begin :][: last - first].copy()
        table[:, 0] = _of_week_s(trajectory, first, last)
        yield table.tobytes()


def _smrmsg_blocks(trajectory: Trajectory, velocity_sigma_l: FloatArray | None) -> Iterator[bytes]:
    for first in range(0, len(trajectory), BLOCK):
        last = min(first + BLOCK, len(trajectory))
        sigma = None if velocity_sigma_l is None else velocity_sigma_l[first:last]
        data = smrmsg_bytes(_part(trajectory, first, last), sigma)
        table = np.frombuffer(data, "<f8").reshape(-1, SMRMSG_DOUBLES).copy()
        table[:, 0] = _of_week_s(trajectory, first, last)
        yield table.tobytes()


def _csv_blocks(trajectory: Trajectory) -> Iterator[bytes]:
    for first in range(0, len(trajectory), BLOCK):
        text = csv_text(_part(trajectory, first, first + BLOCK))
        yield (text if not first else text.partition("\n")[2]).encode()
