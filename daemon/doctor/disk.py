"""Checks the disk that logs go to: its file system, its free space, its speed."""

from __future__ import annotations

import os
import shlex
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from swath.daemon.doctor.devices import User
from swath.daemon.doctor.finding import Finding, Tree, Verdict
from swath.daemon.log.directory import nearest_there
from swath.daemon.log.words import duration_text

SCANNER_BYTES_PER_S = 25e6  # of a scanner whose driver declares no rate: 20 000 datagrams of 1206 bytes
OTHER_BYTES_PER_S = 0.2e6
AUXILIARY_BYTES_PER_S = 0.5e6  # position packets of a head: at most 800 datagrams of 554 bytes
SERIAL_BITS_A_BYTE = 10
USUAL_BAUD = 115200  # of a transport that gives none
LITTLE_ROOM_S = 3600.0
TEST_BYTES = 64 << 20
SYNC_WRONG_S = 2.0  # the queue holds 2.6 s of this scanner's data
SYNC_NOTE_S = 0.5
FAT_FILE_BYTES = 4 << 30
_FAT = ("vfat", "msdos", "exfat")
_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs", "ceph", "glusterfs")
_MEMORY = ("tmpfs", "ramfs")
_UNSAFE_OPTIONS = ("nobarrier", "barrier=0", "data=writeback")


@dataclass(frozen=True, slots=True)
class Mount:
    """A line of /proc/mounts."""

    device: str
    point: str
    kind: str
    options: tuple[str, ...]


def mount_of(tree: Tree, directory: Path) -> Mount | None:
    """Return the mounted file system that holds a directory."""
    best: Mount | None = None
    for line in (tree.read("/proc/mounts") or "").splitlines():
        device, point, kind, options, *_ = [*line.split(), "", "", "", ""]
        point = point.replace("\\040", " ")
        if directory.is_relative_to(point) and (best is None or len(point) >= len(best.point)):
            best = Mount(device, point, kind, tuple(options.split(",")))
    return best


def file_system(mount: Mount | None, split_bytes: float) -> Iterator[Finding]:
    """Check whether a file system is safe for a recording.

    Args:
        split_bytes: the largest size of a part.
    """
    check = "file system"
    if mount is None:
        return
    where = f"{mount.point} ({mount.kind} on {mount.device})"
    move = "mount a separate ext4 or XFS disk there, or set another session.directory"
    if "ro" in mount.options:
        yield Finding(check, Verdict.WRONG, f"{where} is mounted read-only", f"sudo mount -o remount,rw {mount.point}")
    if mount.kind in _MEMORY:
        yield Finding(check, Verdict.WRONG, f"{where} is in memory: logs are lost at power off", move)
    elif mount.kind in _NETWORK:
        yield Finding(
            check, Verdict.WRONG, f"{where} is on another computer: recording would depend on the network", move
        )
    elif mount.kind in _FAT:
        text = f"{where} has no journal: a power cut may destroy whole logs"
        too_large = mount.kind != "exfat" and split_bytes > FAT_FILE_BYTES
        text += ", and it cannot hold a part of more than 4 GB" if too_large else ""
        yield Finding(check, Verdict.WRONG, text, move)
    elif unsafe := [option for option in mount.options if option in _UNSAFE_OPTIONS]:
        text = f"{where} is mounted {','.join(unsafe)}: written data may not survive a power cut"
        yield Finding(check, Verdict.WRONG, text, f"remove {','.join(unsafe)} from /etc/fstab, then mount it again")
    else:
        yield Finding(check, Verdict.OK, where)


def room(free_bytes: float, reserve_bytes: float, bytes_per_s: float) -> Iterator[Finding]:
    """Check the free space above the reserve against the highest data rate of the configured sensors."""
    left_s = max(0.0, free_bytes - reserve_bytes) / bytes_per_s
    text = f"{free_bytes / 1e9:.1f} GB free, {duration_text(left_s)} at {bytes_per_s / 1e6:.1f} MB/s"
    few = left_s < LITTLE_ROOM_S
    mend = "copy logs with swath offload; it names the logs that are safe to delete" if few else ""
    yield Finding("disk space", Verdict.WRONG if few else Verdict.OK, text, mend)


def writable(tree: Tree, directory: Path, user: User) -> Iterator[Finding]:
    """Check that logs can be made in a directory: its user must be able to enter all parent folders and to
    write to it.
    """
    check = "log directory"
    there, permitted = nearest_there(tree.at(directory))
    existing = Path("/") / there.relative_to(tree.root)
    way = [*reversed(existing.parents), *([] if permitted else [existing])]
    closed = next((path for path in way if not user.may(tree.at(path).stat(), 1)), None)
    if closed is not None:
        mend = f"sudo chmod o+x {shlex.quote(str(closed))}  # or set another session.directory"
        yield Finding(check, Verdict.WRONG, f"{user.name} may not enter {closed}, which holds {directory}", mend)
    elif not permitted:
        text = f"not checked: this user may not enter {existing}, which holds {directory}; {user.name} may"
        yield Finding(check, Verdict.NOTE, text, "sudo swath doctor")
    elif user.may(there.stat(), 3):
        yield Finding(check, Verdict.OK, f"{user.name} may write to {existing}")
    else:
        mend = f"sudo install -d -o {user.name} -g {user.name} -m 0750 {directory}"
        yield Finding(check, Verdict.WRONG, f"{user.name} may not write to {existing}", mend)


def measure(folder: Path, size: int = TEST_BYTES) -> tuple[float, float]:
    """Write as a recorder does, and return bytes per second and the longest sync in seconds; no file is left behind.

    Raises:
        OSError: the folder cannot be written to.
    """
    block, longest_s, written = os.urandom(1 << 20), 0.0, 0
    with tempfile.TemporaryFile(dir=folder) as file:
        began_s = time.monotonic()
        while written < size:
            written += os.write(file.fileno(), block)
            if written % (16 << 20) == 0 or written >= size:
                sync_s = time.monotonic()
                os.fdatasync(file.fileno())
                longest_s = max(longest_s, time.monotonic() - sync_s)
        return written / (time.monotonic() - began_s), longest_s


def speed(bytes_per_s: float, longest_sync_s: float, needed_bytes_per_s: float) -> Iterator[Finding]:
    """Check that the disk is fast enough for the sensors."""
    check = "disk speed"
    measured = f"writes {bytes_per_s / 1e6:.0f} MB/s, longest sync {longest_sync_s * 1e3:.0f} ms"
    text = f"{measured}; the sensors may send {needed_bytes_per_s / 1e6:.1f} MB/s"
    mend = "use another disk or file system; find other programs that write to it: sudo iotop -oa"
    if bytes_per_s < 2 * needed_bytes_per_s or longest_sync_s > SYNC_WRONG_S:
        yield Finding(check, Verdict.WRONG, text, mend)
    elif longest_sync_s > SYNC_NOTE_S:
        yield Finding(check, Verdict.NOTE, text, mend)
    else:
        yield Finding(check, Verdict.OK, text)
