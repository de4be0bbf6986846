"""Readers of recordings that other programs made: pcap and pcapng, logs of CAN buses, serial bytes with arrival times,
files of Livox Viewer, bags of ROS.

Each yields the units that were on the wire, with the recorder's time, in the file's order; gzip is recognised by its
magic. They serve import, replay, demonstrations and tests. A damaged file raises `TransportError` with one line, after
the units before the bad place; a reader with a `CaptureTally` counts the damage instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from swath.drivers.captures.base import Address, CapturedUnit, CaptureTally, open_capture, read_beginning, until_damage
from swath.drivers.captures.can.asc import asc_time, is_asc, read_asc
from swath.drivers.captures.can.blf import MAGIC as BLF_MAGIC
from swath.drivers.captures.can.blf import blf_time, read_blf
from swath.drivers.captures.can.candump import candump_line, candump_time, held_by_line, is_candump, read_candump
from swath.drivers.captures.can.clock import FileClock, FileTime
from swath.drivers.captures.can.mf4 import mf4_time, read_mf4
from swath.drivers.captures.can.trc import is_trc, read_trc, trc_time
from swath.drivers.captures.lvx import LvxHead, is_lvx, read_lvx, read_lvx_heads, tells_time
from swath.drivers.captures.pcap.files import is_pcap
from swath.drivers.captures.pcap.reader import read_network, read_pcap
from swath.drivers.captures.rosbag.kinds import bag_kind
from swath.drivers.captures.serial import BareTime, chunk_table, read_bare, read_serial, read_tagged
from swath.drivers.captures.tables.columns import is_table
from swath.drivers.extras import how_to_install
from swath.drivers.transports.base import TransportError

if TYPE_CHECKING:
    from swath.drivers.captures.rosbag.bag import Bag

__all__ = [
    "Address",
    "BareTime",
    "CaptureTally",
    "CapturedUnit",
    "FileClock",
    "FileTime",
    "LvxHead",
    "bag_kind",
    "can_log_kind",
    "can_log_time",
    "candump_line",
    "chunk_table",
    "held_by_line",
    "is_lvx",
    "is_pcap",
    "is_table",
    "open_bag",
    "open_capture",
    "read_bag",
    "read_bare",
    "read_beginning",
    "read_can_log",
    "read_candump",
    "read_lvx",
    "read_lvx_heads",
    "read_network",
    "read_pcap",
    "read_serial",
    "read_table",
    "read_tagged",
    "table_columns",
    "tells_time",
]


_FIRST_LINES = 10
_MF4_MAGICS = (b"MDF     ", b"UnFinMF ")


def can_log_kind(head: bytes) -> str:
    """Return the kind of a log of a CAN bus with these first bytes: candump, asc, blf, trc or mf4, or ""."""
    if head.startswith(BLF_MAGIC):
        return "blf"
    if head.startswith(_MF4_MAGICS):
        return "mf4"
    lines = [line.strip() for line in head.decode("ascii", "replace").splitlines()[:_FIRST_LINES]]
    kinds = {"candump": is_candump, "asc": is_asc, "trc": is_trc}
    return next((kind for kind, is_kind in kinds.items() if any(map(is_kind, lines))), "")


def can_log_time(path: Path, kind: str) -> FileTime:
    """Return the times that a log of a CAN bus tells.

    Raises:
        TransportError: it cannot be read, or asammdf is not installed.
    """
    if kind == "mf4":
        return mf4_time(path)
    return {"candump": candump_time, "asc": asc_time, "trc": trc_time, "blf": blf_time}[kind](path)


def read_can_log(path: Path, kind: str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a log of a CAN bus of a kind, as the reader of that kind does.

    Raises:
        TransportError: it cannot be read, does not tell when it begins, or asammdf is not installed; without tally
            also: it is damaged.
    """
    if kind == "candump":
        return read_candump(path, tally=tally, clock=clock)
    if kind == "mf4":
        return read_mf4(path, clock, tally)
    return {"asc": read_asc, "trc": read_trc, "blf": read_blf}[kind](path, clock, tally)


def open_bag(path: Path) -> Bag:
    """Open a bag's file or folder, to be used in a ``with`` statement.

    Raises:
        TransportError: it is not a bag that can be read, or rosbags is not installed.
    """
    try:
        from swath.drivers.captures.rosbag.bag import Bag
    except ImportError as error:
        raise TransportError(
            f"{path}: bags need rosbags, which is not installed: {how_to_install('import')}"
        ) from error
    return Bag(path)


def table_columns(path: Path) -> list[str]:
    """Return the names of the columns of a table of records.

    Raises:
        TransportError: it cannot be read, or pyarrow is not installed.
    """
    names: list[str] = _tables(path).column_names(path)
    return names


def read_table(
    path: Path, device: str, *, tells_time: bool, tally: CaptureTally | None = None
) -> Iterator[CapturedUnit]:
    """Read a table of records as units of a kind of device; see `swath.drivers.captures.tables.read`.

    Raises:
        TransportError: it cannot be read, or pyarrow is not installed; without tally also: it is damaged.
    """
    return until_damage(_tables(path).read_table(path, device, tells_time=tells_time, tally=tally), tally)


def _tables(path: Path) -> ModuleType:
    try:
        from swath.drivers.captures.tables import read
    except ImportError as error:
        raise TransportError(
            f"{path}: tables need pyarrow, which is not installed: {how_to_install('frames')}"
        ) from error
    return read


def read_bag(path: Path, names: Sequence[str], tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the units of some topics of a bag, in the order of its messages.

    Each unit has the time that the message gives for it (the stamp of its packet, else that of the message's header),
    or the bag's time of the message where that stamp is absent or 0.

    Args:
        path: a bag's file or folder.
        names: of its topics, as `Bag.topics` has them.
        tally: counts damaged messages; where None, they are raised.

    Raises:
        TransportError: it is not a bag that can be read; without tally also: it is damaged.
    """
    with open_bag(path) as bag:
        yield from until_damage(bag.units(names, tally), tally)
