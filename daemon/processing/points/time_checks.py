"""Checks that a log's time is known well enough, and explains why returns have no time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from swath.daemon.errors import ExitCode, UserError
from swath.georef.points import Fate
from swath.georef.timescales import StampScale, TimeState

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.georef.timescales import ClockStatus, Stamps

NO_TIME = Fate.NO_TIME.name.lower()
GOOD_STATES = (TimeState.LOCKED, TimeState.HOLDOVER)
MUCH = 0.01  # share of returns without time above which a warning is given


def refuse_no_time(
    log: Path,
    clock: str | None,
    status: ClockStatus | None,
    config: Config,
    remarks: Sequence[str] = (),
    trouble: str = "",
) -> None:
    """Refuse a log whose clock is not known well enough to tell which second a pulse belongs to.

    Args:
        log: first part of the session, for messages.
        clock: the source of the time.
        status: status of that clock at the end.
        config: configuration of the session.
        remarks: remarks of the receivers' parsers.
        trouble: why the head's time messages cannot be used, if the clock is a head's own.

    Raises:
        UserError: the time is not known; the message gives the reason.
    """
    if trouble and status is not None and status.state is TimeState.NO_TIME:
        raise UserError(f"{log}: {clock}: the log has no receiver, and the head {trouble}")
    if remarks and clock is not None and clock.startswith("scanner/") and status is not None:
        _refuse_by_remarks(log, status, remarks)
    if status is None or clock is None or (clock.startswith("scanner/") and status.state is TimeState.NO_TIME):
        key = "" if clock is None else f"{clock.replace('/', '.')}.clock"
        hint = (
            f"; or the head's position packets (auxiliary), or {key} where its stamps are UTC or TAI" if clock else ""
        )
        raise UserError(
            f"{log}: its configuration has no source of time; add [pps.…] or [gnss.…]{hint}", ExitCode.USAGE
        )
    if status.ambiguous:
        raise UserError(
            f"{log}: {clock}: the second of an edge is uncertain: {status.ambiguous}; record the time messages of the "
            "receiver that gives the pulse (gnss.….pps)"
        )
    by_pps = {f"pps/{gnss.pps}": name for name, gnss in config.gnss.items() if gnss.pps}
    if status.state is TimeState.NO_TIME and clock.startswith("pps/") and clock not in by_pps:
        heard = "; ".join(f'gnss.{name}.pps is "{pps.removeprefix("pps/")}"' for pps, name in by_pps.items())
        raise UserError(
            f"{log}: {clock}: no receiver names the second of its edges ({heard or 'no gnss.….pps is set'}); set "
            "gnss.….pps of the receiver that gives the pulse, with --config"
        )
    if status.leap_doubt:
        raise UserError(f"{log}: {clock}: UTC cannot be converted to GPS time: {status.leap_doubt}")
    _refuse_by_remarks(log, status, remarks)
    if status.state is TimeState.NO_TIME:
        raise UserError(f"{log}: {clock}: the log has no time; record PPS edges and time messages")


def _refuse_by_remarks(log: Path, status: ClockStatus, remarks: Sequence[str]) -> None:
    """Refuse a log without time with the parsers' remarks on dates that they rejected."""
    if status.state is TimeState.NO_TIME and remarks:
        raise UserError("\n".join(f"{log}: {remark}" for remark in remarks))


def time_trouble(
    scanner: str,
    fates: Mapping[str, int],
    refused: Mapping[str, int],
    status: ClockStatus | None,
    stamps: Stamps | None = None,
    trouble: str = "",
) -> str:
    """Return how many returns lack a good time, and why; empty if few or none do.

    Args:
        scanner: name of the scanner.
        fates: number of its returns by fate.
        refused: number of stamps that its clock rejected, by reason.
        status: status of the host's clock.
        stamps: what its stamps count from; None: it reports itself whether it is locked, or it is not known.
        trouble: why its own time messages cannot be used; empty if they can, or it sends none.
    """
    total = sum(fates.values())
    lost = fates.get(NO_TIME, 0)
    if not total or lost <= MUCH * total:
        return ""
    lost_text = f"scanner/{scanner}: {lost:,} of {total:,} returns have no time"
    if refused.get("past_hour"):
        return (
            f"{lost_text}: its stamps contradict the host's clock by more than half a second: the head is locked to "
            "another second; connect the NMEA sentences and the pulse of one receiver to the head"
        )
    if trouble:
        return f"{lost_text}: the head {trouble}"
    if status is not None and status.state not in GOOD_STATES:
        return f"{lost_text}: the host's clock is {status.state.value}; record PPS edges and time messages throughout"
    if refused.get("spacing"):
        return (
            f"{lost_text}: {refused['spacing']:,} edges that it latched are not a second apart; connect the "
            "receiver's PPS"
        )
    if refused.get("stamp_jump"):
        return (
            f"{lost_text}: {refused['stamp_jump']:,} stamps differ by more than a second from their arrival, "
            "because its clock was set; do not set it during a recording"
        )
    found = "" if stamps is None or stamps.scale is not StampScale.FREE else f" ({stamps.text})"
    if stamps is not None and stamps.never_set:
        return (
            f"{lost_text}: its stamps run free{found}; before recording, wait until the head's web page shows that GPS "
            "or PTP is locked"
        )
    return (
        f"{lost_text}: its stamps run free{found}; lock the head to the PPS, let it latch the PPS, or set "
        f"scanner.{scanner}.clock if its stamps are UTC or TAI nevertheless"
    )
