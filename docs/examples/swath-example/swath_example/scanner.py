"""The Example scanner: one datagram is a header and the returns of 80 pulses, each with its direction as two angles.

Layout and units: Example Scanner, Interface Manual, sections 3.1 (header) and 3.2 (return). Numbers are little-endian.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from swath.drivers.interface import (
    AIMED_RETURN_DTYPE,
    DEVICE_CLOCK_DTYPE,
    INTERFACE,
    RETURN_FLAG_PPS_LOCKED,
    ByteRows,
    DeviceClockSamples,
    DeviceSettings,
    Driver,
    Int64Array,
    Options,
    PacketParser,
    Record,
    ScannerReturns,
    StructArray,
    read_options,
)

MAGIC = b"EXS1"
LOCKED = 1  # of the flags: the clock is locked to the pulse
HEADER = np.dtype(
    [
        ("magic", "S4"),
        ("sequence", "<u4"),
        ("time_ns", "<u8"),  # the head's counter at the first pulse
        ("pps_time_ns", "<i8"),  # the same counter at the latest PPS edge; -1: none yet
        ("pps_count", "<u4"),  # edges since power-on
        ("flags", "<u2"),
        ("count", "<u2"),
    ]
)
RETURN = np.dtype(
    [
        ("after_ns", "<u4"),  # since the first pulse
        ("range", "<u4"),  # in units that are set in the head
        ("azimuth", "<i2"),  # 0.01°, from forward towards left
        ("elevation", "<i2"),  # 0.01°, up
        ("intensity", "<u2"),
        ("pulse", "<u2"),  # 0 … 79; a pulse without an echo is left out
    ]
)
PULSES = 80  # of a datagram
ANGLE_UNIT_RAD = np.radians(0.01)


class ScannerOptions(Options):
    """The keys of ``[scanner.<name>.options]``."""

    range_unit_mm: Literal[1, 2, 4] = Field(1, description="unit of the ranges, as set in the head")
    least_intensity: int = Field(0, ge=0, le=65535, description="fainter returns are left out")


class ScannerParser(PacketParser):
    """Decodes datagrams; counts ``bad_length``, ``bad_magic`` and ``sequence_gap``."""

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__()
        self._options = read_options(settings, ScannerOptions)
        self._next: np.uint32 | None = None  # sequence number

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode datagrams of equal length, all at once."""
        datagrams, length = units.shape
        self.counters.bytes += units.size
        count, rest = divmod(length - HEADER.itemsize, RETURN.itemsize)
        if rest or not 0 <= count <= PULSES:
            self.counters.count_bad("bad_length", datagrams, length)
            return []
        units = np.ascontiguousarray(units)
        headers: StructArray = units[:, : HEADER.itemsize].copy().view(HEADER)[:, 0]
        good = (headers["magic"] == MAGIC) & (headers["count"] == count)
        self.counters.count_bad("bad_magic", int((~good).sum()), length)
        host_time_ns, headers, units = host_time_ns[good], headers[good], units[good]
        if not len(headers):
            return []
        self.counters.messages["returns"] += len(headers)
        self.counters.bytes_framed += units.size
        self._note_gaps(headers["sequence"].astype(np.uint32))
        returns: StructArray = units[:, HEADER.itemsize :].copy().view(RETURN)
        records: list[Record] = [DeviceClockSamples(_clock_rows(host_time_ns, headers, returns))]
        return [*records, ScannerReturns(self._return_rows(host_time_ns, headers, returns))] if count else records

    def _return_rows(self, host_time_ns: Int64Array, headers: StructArray, returns: StructArray) -> StructArray:
        """Return a row for each return of datagrams (n,), returns (n, count), in units and frame of Swath."""
        rows = np.zeros(returns.shape, AIMED_RETURN_DTYPE)
        rows["host_time_ns"] = host_time_ns[:, np.newaxis]
        rows["device_time_ns"] = headers["time_ns"].astype(np.int64)[:, np.newaxis] + returns["after_ns"]
        rows["range_m"] = returns["range"] * (1e-3 * self._options.range_unit_mm)
        rows["encoder_rad"] = returns["azimuth"] * ANGLE_UNIT_RAD  # x forward, y left, as the manual draws them
        rows["elevation_rad"] = returns["elevation"] * ANGLE_UNIT_RAD
        number = headers["sequence"].astype(np.uint64)[:, np.newaxis] * np.uint64(PULSES)
        rows["pulse_id"] = number + returns["pulse"]
        rows["intensity"] = returns["intensity"]
        rows["return_number"] = rows["number_of_returns"] = 1
        rows["flags"] = np.where(headers["flags"] & LOCKED, RETURN_FLAG_PPS_LOCKED, 0)[:, np.newaxis]
        kept: StructArray = rows[returns["intensity"] >= self._options.least_intensity]
        return kept

    def _note_gaps(self, sequence: NDArray[np.uint32]) -> None:
        """Count datagrams that did not arrive, by their sequence numbers, which wrap."""
        first = sequence[0] if self._next is None else self._next
        missing = (sequence - np.append(first, sequence[:-1] + np.uint32(1))).astype(np.int32)
        lost = int(missing[missing > 0].sum())
        if lost:
            self.counters.errors["sequence_gap"] += lost
        self._next = (sequence[-1:] + np.uint32(1))[0]


def _clock_rows(host_time_ns: Int64Array, headers: StructArray, returns: StructArray) -> StructArray:
    """Return the head's clock beside the host's, one row for each datagram."""
    rows = np.zeros(len(headers), DEVICE_CLOCK_DTYPE)
    last_ns = returns["after_ns"][:, -1] if returns.shape[1] else 0
    rows["host_time_ns"], rows["device_time_ns"] = host_time_ns, headers["time_ns"].astype(np.int64) + last_ns
    rows["pps_time_ns"], rows["pps_count"] = headers["pps_time_ns"], headers["pps_count"]
    rows["locked"] = headers["flags"] & LOCKED
    return rows


def encode(sequence: int, time_ns: int, pps_time_ns: int, pps_count: int, returns: StructArray) -> bytes:
    """Encode a datagram of a locked head, for tests; ``returns`` has the dtype `RETURN`."""
    header = np.array((MAGIC, sequence, time_ns, pps_time_ns, pps_count, LOCKED, len(returns)), HEADER)
    return header.tobytes() + returns.tobytes()


DRIVER = Driver(
    protocol="example-scanner",
    kind="scanner",
    transports=("udp",),
    yields=(ScannerReturns, DeviceClockSamples),
    summary="Example scanner: up to 80 returns a datagram, with azimuth and elevation",
    make_parser=ScannerParser,
    needs=("installation",),
    aimed=True,
    wavelength_nm=1550.0,
    bytes_per_s=5e6,
    options=ScannerOptions,
    interface=INTERFACE,
)
