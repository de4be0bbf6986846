"""The files of a trajectory: SBET and smrmsg, CSV, and what goes beside them; written out of sight, put in place whole.

Epochs are written in blocks, so that five hours of them do not stand in memory twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.files import gone_on_failure, write_aside
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
    """Where the files of a run go.

    Attributes:
        sbet, smrmsg, csv: None: not wanted.
        summary: the JSON, written last.
        page: the plots.
    """

    sbet: Path | None
    smrmsg: Path | None
    csv: Path | None
    summary: Path
    page: Path

    def all(self) -> list[Path]:
        """Return those wanted."""
        named = (self.sbet, self.smrmsg, self.csv, self.page, self.summary)
        return [path for path in named if path is not None]

    @classmethod
    def of_output(cls, output: Path, session: str, *, csv: bool) -> TrajectoryFiles:
        """Make it by what ``-o`` says: a file .sbet, .out or .csv, or a folder for files with the session's name.

        Raises:
            UserError: it is neither.
        """
        suffix = output.suffix.lower()
        if suffix == ".csv":
            return cls(None, None, output, output.with_suffix(".json"), output.with_suffix(".html"))
        if suffix in SBETS:
            text = output.with_suffix(".csv") if csv else None
            return cls(output, _smrmsg_of(output), text, output.with_suffix(".json"), output.with_suffix(".html"))
        if suffix and not output.is_dir():
            raise UserError(f"-o {output}: want a name that ends in .sbet, .out or .csv, or a folder", ExitCode.USAGE)
        return cls.in_folder(output, session, csv=csv)

    @classmethod
    def in_folder(cls, folder: Path, session: str, *, csv: bool) -> TrajectoryFiles:
        """Return files with the session's name."""

        def ending(suffix: str) -> Path:
            return folder / f"{session}_trajectory{suffix}"

        text = ending(".csv") if csv else None
        return cls(ending(".sbet"), ending(".smrmsg"), text, ending(".json"), ending(".html"))

    def refuse_existing(self, *others: Path | None) -> None:
        """UserError where a file is there already, another one that is to be written included."""
        for path in [*self.all(), *(other for other in others if other is not None)]:
            if path.exists():
                raise UserError(f"{path}: is there already; want another name, or --overwrite", ExitCode.USAGE)


def _smrmsg_of(sbet: Path) -> Path:
    """Return the name under which the sigmas of an SBET are written."""
    if sbet.name.startswith("sbet") and sbet.suffix == ".out":
        return sbet.with_name("smrmsg" + sbet.name.removeprefix("sbet"))
    return sbet.with_suffix(".smrmsg")


def smrmsg_beside(sbet: Path) -> Path | None:
    """Return the sigmas that came with an SBET: as they are written here, or with the name's first word exchanged."""
    names = [_smrmsg_of(sbet)] if sbet.suffix.lower() in SBETS else []
    if sbet.name.startswith("sbet"):
        names.append(sbet.with_name("smrmsg" + sbet.name.removeprefix("sbet")))
    return next((name for name in names if name.exists()), None)


def write_trajectory(
    files: TrajectoryFiles, trajectory: Trajectory, velocity_sigma_l: FloatArray | None
) -> list[tuple[Path, Path]]:
    """Return SBET, smrmsg and CSV as far as they are wanted, under names that `put_in_place` takes away.

    Args:
        files: where to.
        trajectory: of the body's origin.
        velocity_sigma_l: (n, 3) north, east, down; None: unsaid.

    Returns:
        What was written, and where it belongs.

    Raises:
        OSError: it cannot be written; nothing is left then.
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
    """Return seconds of the week of the trajectory's first epoch, running past its end."""
    week, _ = week_from_gps(trajectory.span[0])
    since: FloatArray = (trajectory.time_ns[first:last] - week * WEEK_NS) / SECOND_NS
    return since


def _sbet_blocks(trajectory: Trajectory) -> Iterator[bytes]:
    """Yield an epoch beyond the block gives its last one's acceleration and rates; the very last has those before
    it.
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
