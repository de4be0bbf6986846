"""Finds the process that holds a port or device, so that an "in use" message can name it."""

from __future__ import annotations

import os
from pathlib import Path

_UDP_TABLE = Path("/proc/self/net/udp")  # /proc/net is hidden where a service's /proc shows processes only


def process_holding(target: str) -> str:
    """Return name and id of a process with a descriptor whose link in /proc reads ``target``.

    Processes of other users cannot be examined; then, and where no process is found, the result is "another program".
    """
    for folder in Path("/proc").glob("[0-9]*/fd"):
        if _has_link(folder, target):
            pid = int(folder.parent.name)
            return "this program itself" if pid == os.getpid() else f"{_command(pid)} (process {pid})"
    return "another program"


def udp_port_holder(port: int) -> str:
    """Return name and id of a process with a UDP socket on local ``port``; "another program" where none is found."""
    try:
        table = _UDP_TABLE.read_text(encoding="ascii")
    except OSError:
        return "another program"
    for line in table.splitlines()[1:]:
        fields = line.split()
        if int(fields[1].partition(":")[2], 16) == port:
            return process_holding(f"socket:[{fields[9]}]")
    return "another program"


def _has_link(folder: Path, target: str) -> bool:
    try:
        return any(_link(entry) == target for entry in folder.iterdir())
    except OSError:  # another user's process, or one that has ended meanwhile
        return False


def _link(entry: Path) -> str:
    try:
        return os.readlink(entry)
    except FileNotFoundError:  # closed meanwhile, such as the descriptor that read the listing
        return ""


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return "a program"
