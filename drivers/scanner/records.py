"""Returns of scanners that another program decoded, one frame in a datagram (`swath.drivers.record_frames`).

Rows have two angles and a range, or x, y and z along axes x forward, y left, z up, from which those are computed. Times
become stamps that count from 1970: in UTC as they are, GPS times in TAI, so that both are exact and none is mistaken.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, PacketParser
from swath.drivers.record_frames import (
    LATEST_NS,
    NO_ARRIVAL,
    OVERHEAD_BYTES,
    SYNC,
    TAI_EPOCH_NS,
    RowKind,
    Scale,
    decode_rows,
    gps_times,
    intact,
    message_name,
)
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    DEVICE_CLOCK_DTYPE,
    ByteRows,
    DeviceClockSamples,
    NamesEdge,
    Record,
    ScannerReturns,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.coarse import TYPICAL_DELAY_NS
from swath.georef.timescales.gps_time import SECOND_NS, WEEK_NS


class ReturnsParser(PacketParser):
    """Turns frames into returns, clock samples and, once a second, a message that names it.

    Counts ``bad_sync``, ``bad_version``, ``bad_kind``, ``bad_scale``, ``bad_length`` and ``no_time`` of frames; of rows
    ``bad_point``: the origin, or no number; and ``no_time``. These rows are left out.

    Args:
        settings: no key is needed.
        clock_only: return no returns.
    """

    def __init__(self, settings: DeviceSettings, *, clock_only: bool = False) -> None:
        super().__init__()
        del settings
        self._clock_only = clock_only
        self._points = 0  # so far; each is a pulse of its own
        self._told_second = -1

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode datagrams of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        records: list[Record] = []
        for host_ns, unit in zip(host_time_ns.tolist(), units, strict=True):
            records += self._frame(host_ns, unit.tobytes())
        return records

    def _frame(self, host_ns: int, frame: bytes) -> list[Record]:
        if not frame.startswith(SYNC) or len(frame) < OVERHEAD_BYTES:
            self.counters.count_bad("bad_sync", 1, len(frame))
            return []
        if not intact(frame):
            self.counters.bad_checksums += 1
            self.counters.bytes_skipped += len(frame)
            return []
        self.counters.bytes_framed += len(frame)
        found = decode_rows(frame)
        if isinstance(found, str):
            self.counters.count_bad(found)
            return []
        kind, scale, flags, rows = found
        self.counters.messages[message_name(frame)] += 1
        if kind not in (RowKind.RETURN, RowKind.POINT):
            return []
        time_ns = rows["time_ns"]
        timed = (time_ns >= 0) & (time_ns < LATEST_NS)
        self.counters.errors["no_time"] += int((~timed).sum())
        rows, time_ns = rows[timed], time_ns[timed]
        if not len(rows):
            return []
        latest_ns = int(time_ns.max())
        records: list[Record] = [*self._second(host_ns, latest_ns, scale, flags)]
        device_ns = time_ns + TAI_EPOCH_NS if scale is Scale.GPS else time_ns
        clock = np.zeros(1, DEVICE_CLOCK_DTYPE)
        clock["host_time_ns"], clock["device_time_ns"] = host_ns, int(device_ns.max())
        clock["pps_time_ns"] = clock["pps_count"] = clock["locked"] = -1
        records.append(DeviceClockSamples(clock))
        if not self._clock_only:
            records += self._returns(host_ns, device_ns, rows, kind)
        return records

    def _second(self, host_ns: int, time_ns: int, scale: Scale, flags: int) -> list[Record]:
        """Return a message that names the second of a frame's last row, once for each; a counter names none."""
        gps_ns = int(gps_times(np.array([time_ns], np.int64), scale)[0])
        second, fraction_ns = divmod(gps_ns, SECOND_NS)
        if gps_ns < 0 or second == self._told_second:
            return []
        self._told_second = second
        week, tow_ns = divmod(second * SECOND_NS, WEEK_NS)
        arrival_ns = host_ns + (TYPICAL_DELAY_NS if flags & NO_ARRIVAL else 0) - fraction_ns
        tag = TimeTag(TimeScale.GPS, tow_ns, week)
        return [TimeMessage(arrival_ns, tag, NamesEdge.PREVIOUS, message="returns")]

    @np.errstate(invalid="ignore", over="ignore")  # a signalling NaN on the wire is a NaN like any other
    def _returns(self, host_ns: int, device_ns: Int64Array, rows: StructArray, kind: RowKind) -> list[Record]:
        found = np.zeros(len(rows), AIMED_RETURN_DTYPE)
        for name in set(AIMED_RETURN_DTYPE.names or ()) & set(rows.dtype.names or ()):
            found[name] = rows[name]
        found["host_time_ns"], found["device_time_ns"] = host_ns, device_ns
        if kind is RowKind.POINT:
            x, y, z = (rows[name].astype(np.float64) for name in ("x_m", "y_m", "z_m"))
            flat2 = x * x + y * y
            found["range_m"] = np.sqrt(flat2 + z * z)
            found["encoder_rad"], found["elevation_rad"] = np.arctan2(y, x), np.arctan2(z, np.sqrt(flat2))
            found["pulse_id"] = self._points + np.arange(len(rows))
            self._points += len(rows)
        good = np.isfinite(found["range_m"]) & (found["range_m"] > 0.0)
        good &= np.isfinite(found["encoder_rad"]) & np.isfinite(found["elevation_rad"])
        if not good.all():
            self.counters.errors["bad_point"] += int((~good).sum())
            found = found[good]
        return [ScannerReturns(found)] if len(found) else []


DRIVERS = (
    Driver(
        protocol="records",
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, TimeMessage),
        summary="returns of other programs: CSV, Parquet and ROS messages by swath import",
        make_parser=ReturnsParser,
        make_time_parser=partial(ReturnsParser, clock_only=True),
        needs=("installation",),
        aimed=True,
    ),
)
