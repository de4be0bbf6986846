"""Probes a unit's sandbox, and prints a JSON object: ``true`` where an attempt succeeded, else the errno."""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import os
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

CLONE_NEWUSER = 0x10000000


def libc(call: str, *arguments: object) -> None:
    """Call a function of the C library; raise OSError on failure."""
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, call)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), call)


def bound(family: int, kind: int, protocol: int, address: tuple[object, ...]) -> None:
    """Bind a socket of a family."""
    with socket.socket(family, kind, protocol) as sock:
        sock.bind(address)


def opened(path: str, flags: int = os.O_RDWR) -> None:
    """Open a file."""
    os.close(os.open(path, flags | os.O_NOCTTY | os.O_NONBLOCK, 0o600))


def synced(folder: str) -> None:
    """Create and sync a file in a folder."""
    fd = os.open(f"{folder}/probe", os.O_RDWR | os.O_CREAT)
    os.fsync(fd)
    os.close(fd)
    os.unlink(f"{folder}/probe")


def stepped() -> None:
    """Set the wall clock to its own value."""
    time.clock_settime(time.CLOCK_REALTIME, time.time())


def real_time() -> None:
    """Raise unless this process has the real-time policy of its unit."""
    if os.sched_getscheduler(0) != os.SCHED_FIFO:
        raise OSError(errno.EPERM, "not real-time")


def set_uid_file() -> None:
    """Make a program that would run as its owner."""
    path = Path("/var/lib/swath/probe")
    path.touch()
    try:
        path.chmod(0o4755)
    finally:
        path.unlink()


INET, DGRAM = socket.AF_INET, socket.SOCK_DGRAM
TRIALS: dict[str, Callable[[], object]] = {
    "udp": lambda: bound(INET, DGRAM, 0, ("127.0.0.1", 0)),
    "udp ipv6": lambda: bound(socket.AF_INET6, DGRAM, 0, ("::1", 0)),
    "can": lambda: bound(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW, ("vcan0",)),
    "unix": lambda: socket.socket(socket.AF_UNIX, DGRAM),
    "packet": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
    "netlink": lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW),
    "/dev/pps0": lambda: opened("/dev/pps0"),
    "/dev/ttyS1": lambda: opened("/dev/ttyS1"),
    "/dev/vda": lambda: opened("/dev/vda", os.O_RDONLY),
    "/dev/mem": lambda: opened("/dev/mem", os.O_RDONLY),
    "/dev/kmsg": lambda: opened("/dev/kmsg", os.O_RDONLY),
    "the log directory": lambda: synced("/var/lib/swath"),
    "live": lambda: synced("/var/lib/swath/live"),
    "the configuration": lambda: opened("/etc/swath/swath.toml", os.O_RDONLY),
    "writing /etc": lambda: opened("/etc/probe", os.O_RDWR | os.O_CREAT),
    "writing the configuration": lambda: opened("/etc/swath/swath.toml"),
    "writing the program": lambda: opened("/opt/swath/probe", os.O_RDWR | os.O_CREAT),
    "root's home": lambda: os.listdir("/root"),
    "process 1": lambda: os.listdir("/proc/1"),
    "/proc/sys": lambda: os.listdir("/proc/sys"),
    "real time": real_time,
    "asking for real time": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20)),
    "reading the clock's discipline": lambda: libc("adjtimex", ctypes.create_string_buffer(512)),
    "setting the clock": stepped,
    "becoming root": lambda: os.setuid(0),
    "a namespace": lambda: libc("unshare", CLONE_NEWUSER),
    "mounting": lambda: libc("mount", b"none", b"/mnt", b"tmpfs", 0, None),
    "a module": lambda: libc("syscall", 175, None, 0, b""),
    "memory that is written and run": lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC),
    "a set-uid file": set_uid_file,
    "another's key ring": lambda: libc("syscall", 250, 0, -3, 0),
}


def main() -> None:
    """Try everything, and print what succeeds or fails with which error."""
    found: dict[str, object] = {}
    for name, trial in TRIALS.items():
        try:
            trial()
            found[name] = True
        except OSError as error:
            found[name] = errno.errorcode.get(error.errno or 0, str(error))
    json.dump(found, sys.stdout)
    sys.stdout.flush()


if __name__ == "__main__":
    main()
