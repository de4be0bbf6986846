"""Names a recording session and describes the computer that it runs on."""

from __future__ import annotations

import os
import platform
import time
import uuid
from pathlib import Path

from swath import __version__
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.host_clock import HostClock


def read_boot_id() -> str:
    """Return the id of this boot; the service's unit passes it in ``SWATH_BOOT_ID``, because its /proc shows processes
    only.
    """
    boot_id = os.environ.get("SWATH_BOOT_ID", "")
    return str(uuid.UUID(boot_id)) if boot_id else Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def make_session_info(name: str, clock: HostClock) -> SessionInfo:
    """Make the description of a session, named by its start and this boot of the computer."""
    boot_id = read_boot_id()
    start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(clock.realtime_ns // 1_000_000_000))
    return SessionInfo(
        session_id=f"{name}-{start}-{boot_id[:4]}",
        software=f"swath {__version__}",
        host=platform.node(),
        boot_id=boot_id,
        realtime_ns=clock.realtime_ns,
        monotonic_ns=clock.monotonic_ns,
    )


def session_name(name: str, start_ns: int, boot_id: str) -> str:
    """Return the ``session_id`` of a session that begins at this wall clock time."""
    try:
        start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(start_ns // 1_000_000_000))
    except (ValueError, OverflowError, OSError):
        start = str(start_ns)
    return f"{name}-{start}-{boot_id[:4]}"
