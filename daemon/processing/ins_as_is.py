"""The trajectory of a device's own INS, as it stands in the log (``--ins as-is``)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from swath.daemon.errors import UserError
from swath.daemon.processing.navigation.log import session_holes
from swath.daemon.processing.navigation.sources import config_of_log, files_of, without_scanners
from swath.daemon.processing.points.feed import read_clocks
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.daemon.log.reader import Session


@dataclass(frozen=True, eq=False)
class AsIs:
    """A session's INS.

    Attributes:
        source: whose.
        trajectory: attitude of b.
        solutions: by what became of them.
        holes: what is missing, a line each.
    """

    source: str
    trajectory: Trajectory
    solutions: Counter[str]
    holes: list[str]


def ins_as_is(session: Session, config: Config | None) -> AsIs:
    """Read it.

    Raises:
        UserError: there is none.
        LogError, OSError: the log cannot be read.
    """
    log = session.parts[0].path
    files = files_of(session, config)
    try:
        setup = Setup(without_scanners(config or config_of_log(files)), files, Options(uncertainty=False))
    except UserError as error:
        lines = [f"{log}: {line}" for line in error.message.splitlines()]
        raise UserError("\n".join(lines), error.exit_code) from error
    clocks = read_clocks(session, setup)
    if setup.ins_source is None or not len(clocks.ins_rows):
        raise UserError(f"{log}: no INS solution in the log; without --ins as-is its IMU and GNSS are navigated")
    buffer = TrajectoryBuffer(setup.ins_protocol, name=session.session_id)
    buffer.append(clocks.ins_rows)
    trajectory = buffer.snapshot().with_velocities()
    if len(trajectory) < 2:
        raise UserError(f"{log}: {setup.ins_source}: its INS had no solution")
    return AsIs(setup.ins_source, trajectory, +Counter(buffer.counts), session_holes(session))
