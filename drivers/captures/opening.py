"""Readers of recordings that other programs made: pcap and pcapng, ``candump -L`` text, serial bytes with arrival
times, files of Livox Viewer.

Each yields the units that were on the wire, with the recorder's time, in the file's order; gzip is recognised by its
magic. They serve import, replay, demonstrations and tests. A damaged file raises `TransportError` with one line, after
the units before the bad place; a reader with a `CaptureTally` counts the damage instead.
"""

from swath.drivers.captures.base import Address, CapturedUnit, CaptureTally, open_capture, read_beginning
from swath.drivers.captures.candump import candump_line, held_by_line, is_candump, is_shown_candump, read_candump
from swath.drivers.captures.lvx import LvxHead, is_lvx, read_lvx, read_lvx_heads, tells_time
from swath.drivers.captures.pcap import is_pcap, read_pcap
from swath.drivers.captures.serial import BareTime, chunk_table, read_bare, read_serial, read_tagged

__all__ = [
    "Address",
    "BareTime",
    "CaptureTally",
    "CapturedUnit",
    "LvxHead",
    "candump_line",
    "chunk_table",
    "held_by_line",
    "is_candump",
    "is_lvx",
    "is_pcap",
    "is_shown_candump",
    "open_capture",
    "read_bare",
    "read_beginning",
    "read_candump",
    "read_lvx",
    "read_lvx_heads",
    "read_pcap",
    "read_serial",
    "read_tagged",
    "tells_time",
]
