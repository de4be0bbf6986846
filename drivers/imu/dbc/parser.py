"""Any inertial unit on CAN, by its DBC file and a map of its signals (protocol ``dbc``).

The configuration names the signals (``[imu.NAME.signals]``, docs/configuration.md); the DBC gives their positions and
units. Frames are decoded in batches; `SampleGrouper` joins the frames of one sample, and `CounterUnwrapper` makes
counters continuous. Specific force and angular rate are in the device's own axes: the configuration's rotation_b_imu,
sample and stamp are applied where the samples are used, except that increments (sample = "increment") are divided by
the nominal interval here. A sample is dropped and counted if one of its values is outside the DBC's range of the
signal, or is a code of J1939 for "error" or "not available"; such a temperature is unknown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swath.drivers.can_frames import CAN_ERR_FLAG, CAN_RTR_FLAG, decode_can_frames
from swath.drivers.driver import Driver
from swath.drivers.imu.counters import CounterUnwrapper, GapCounter, LatchTracker, nanoseconds
from swath.drivers.imu.dbc.groups import (
    Frames,
    GroupRule,
    SampleGrouper,
    Samples,
    closing_part,
    has_evidence,
    no_frames,
)
from swath.drivers.imu.dbc.j1939 import FLAGS, SourceChoice, may_be_j1939, parameter_codes, pgn_mask
from swath.drivers.imu.dbc.settings import MappedSignal, Part, SignalMap, map_signals
from swath.drivers.parser import DeviceSettings, PacketParser
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import DEVICE_CLOCK_DTYPE, IMU_DTYPE, ByteRows, DeviceClockSamples, ImuSamples, Record


class SideSignal:
    """A signal of a message beside the samples; its value holds from its frame to the next one."""

    def __init__(self, signal: MappedSignal) -> None:
        self._signal = signal
        self._last = np.uint64(0)
        self._known = False
        self._where = np.empty(0, np.intp)
        self._bits = np.empty(0, np.uint64)

    def take(self, frames: Frames) -> None:
        """Read the signal from the frames of one call."""
        if len(self._bits):
            self._last, self._known = self._bits[-1], True
        self._where = np.flatnonzero(frames.part == self._signal.part)
        self._bits = self._signal.layout.bits(frames.data[self._where])

    def before(self, position: NDArray[np.intp]) -> tuple[UInt64Array, BoolArray]:
        """Return its bits as of positions (m,) among this call's frames, and whether a value existed by then."""
        place = np.searchsorted(self._where, position, side="left")
        bits = np.concatenate([[self._last], self._bits])[place]
        return bits, (place > 0) | self._known


class DbcParser(PacketParser):
    """Decodes CAN units to `ImuSamples`, and to `DeviceClockSamples` where the device latches PPS."""

    def __init__(
        self, settings: DeviceSettings, *, clock_only: bool = False, signal_map: SignalMap | None = None
    ) -> None:
        """Read the DBC and find the signals.

        Args:
            settings: the device's table and the DBC's bytes (``files["dbc"]``).
            clock_only: return `DeviceClockSamples` only, for the recorder.
            signal_map: a map that the caller has made already; None: made here.

        Raises:
            DriverSettingsError: a setting is invalid; the text names the key or signal and a valid value.
        """
        super().__init__()
        self._map = signal_map or map_signals(settings)
        self._clock_only = clock_only
        self._width = 8 if all(part.needs_bytes <= 8 for part in self._map.parts) else 64
        self._rule_is_open = not self._map.rule_is_said
        self._unread = no_frames(self._width)  # frames that wait for the rule
        self._grouper = self._grouper_of(self._map.rule, self._map.key_part)
        ticks, latch = self._map.sample_ticks, self._map.pps_ticks
        self._unwrapper = CounterUnwrapper(ticks.layout.length, float(self._map.tick_hz)) if ticks else None
        self._latch = LatchTracker(latch.layout.length) if latch else None
        packets = self._map.packet_counter
        self._gaps = GapCounter(packets.layout.length) if packets else None
        optional = (latch, self._map.temperature, self._map.status)
        address = settings.config.get("source_address")
        self._choice = SourceChoice(None if address is None else int(address))
        self._doubts: tuple[str, ...] = ()
        self._outside: Counter[str] = Counter()  # dropped samples by signal that was outside its range
        self._side = {
            signal.layout.name: SideSignal(signal) for signal in optional if signal and signal.part >= self._map.grouped
        }

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode CAN frames, (n, 16) or (n, 72)."""
        self.counters.bytes += units.size
        frames = self._configured_frames(host_time_ns, units)
        self._count_gaps(frames)
        if self._rule_is_open:
            frames = self._unread = frames.after(self._unread)
            if not has_evidence(frames.part[frames.part < self._map.grouped], self._map.grouped):
                return []
            self._settle_rule()
        return self._samples_of(frames) if len(frames.part) else []

    def close(self) -> list[Record]:
        """Return the last sample of rule "first", which only the end of the stream completes."""
        frames = self._unread
        if self._rule_is_open:
            self._settle_rule()
        return self._samples_of(frames, at_end=True)

    def _grouper_of(self, rule: GroupRule, key_part: int) -> SampleGrouper:
        return SampleGrouper(self._map.grouped, rule, key_part, self._width)

    def _settle_rule(self) -> None:
        """Use the rule that the spacing of the first frames shows; if they come evenly, keep the default and note a
        doubt.
        """
        grouped = self._unread.part < self._map.grouped
        last = closing_part(self._unread.part[grouped], self._unread.host_time_ns[grouped], self._map.grouped)
        if last is not None:
            self._grouper = self._grouper_of("last", last)
        elif grouped.any():
            names = " and ".join(dict.fromkeys(part.message for part in self._map.parts[: self._map.grouped]))
            self._doubts = (
                f"the frames of {names} are evenly spaced, so it is uncertain which of them form one sample: specific "
                'force and angular rate may be one sample apart; set group = "last" or "first"',
            )
        self._rule_is_open, self._unread = False, no_frames(self._width)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Facts that the frames leave uncertain, one line for the user each."""
        parts = {part.message: part for part in self._map.parts}
        lines = [*self._doubts]
        for message, part in parts.items():
            seen = self.counters.messages[message]
            lines += self._choice.lines(message, part.can_id, seen=seen, chosen=part.any_source)
        layouts = {
            signal.layout.name: signal.layout for signal in (*self._map.vectors, self._map.temperature) if signal
        }
        for name, count in self._outside.items():
            layout = layouts[name]
            lines.append(
                f"{count} values of {name} are outside the range {layout.minimum:g} to {layout.maximum:g} of the DBC; "
                "correct the DBC file if its range or the signal's byte order is wrong"
            )
        return tuple(lines)

    # -- frames

    def _configured_frames(self, host_time_ns: Int64Array, units: ByteRows) -> Frames:
        """Return the data frames of configured parts; other identifiers belong to other devices."""
        table = decode_can_frames(units)
        if table is None:
            self.counters.count_bad("bad_length", len(units))
            return no_frames(self._width)
        can_id = table["can_id"]
        self._count_flagged(can_id)
        self._choose_sources(can_id)
        part = np.full(len(can_id), -1, np.int8)
        for number, kind in enumerate(self._map.parts):
            part[self._frames_of(kind, table, can_id)] = number
        mine = np.flatnonzero(part >= 0)
        data = np.zeros((len(mine), self._width), np.uint8)
        carried = min(self._width, table["data"].shape[1])
        data[:, :carried] = table["data"][mine, :carried]
        return Frames(part[mine], np.asarray(host_time_ns, np.int64)[mine], data)

    def _frames_of(self, kind: Part, table: StructArray, can_id: NDArray[np.uint32]) -> NDArray[np.intp]:
        """Return indices of the complete frames of a kind; short ones are counted."""
        where = self._named(kind, can_id)
        if kind.any_source:
            where = self._choice.pick(kind.message, kind.can_id & 0xFF, where, can_id & np.uint32(0xFF))
        elif may_be_j1939(kind.can_id) and not kind.j1939 and not self.counters.messages[kind.message]:
            alike = (can_id ^ np.uint32(kind.can_id)) & np.uint32(FLAGS | pgn_mask(kind.can_id)) == 0
            alike[where] = False
            self._choice.note_others(kind.message, can_id[alike] & np.uint32(0xFF))
        if kind.selector is not None:
            data = _padded(table["data"][where], self._width)
            value = kind.selector.bits(data)
            where = where[np.isin(value, np.array(sorted(kind.selector_values), dtype=np.uint64))]
        whole = table["length"][where] >= kind.needs_bytes
        if not whole.all():
            self.counters.count_bad("bad_length", int(np.count_nonzero(~whole)))
            where = where[whole]
        if len(where):
            self.counters.messages[kind.message] += len(where)
        return where

    @staticmethod
    def _named(kind: Part, can_id: NDArray[np.uint32]) -> NDArray[np.intp]:
        """Return indices of the frames with a kind's identifier, whichever device sends them where any may."""
        return np.flatnonzero((can_id ^ np.uint32(kind.can_id)) & np.uint32(kind.id_mask) == 0)

    def _choose_sources(self, can_id: NDArray[np.uint32]) -> None:
        """Choose the devices of the J1939 messages that any may send."""
        named: dict[int, list[NDArray[np.intp]]] = {}
        for kind in self._map.parts:
            if kind.any_source:
                named.setdefault(kind.can_id & 0xFF, []).append(self._named(kind, can_id))
        if named:
            joined = {address: np.concatenate(found) for address, found in named.items()}
            self._choice.settle(joined, can_id & np.uint32(0xFF))

    def _count_gaps(self, frames: Frames) -> None:
        """Count the frames that the device's own counter shows to be missing."""
        packets = self._map.packet_counter
        if packets is not None and self._gaps is not None:
            missing = self._gaps.missing(packets.layout.bits(frames.data[frames.part == packets.part]))
            if missing:
                self.counters.errors["packet_gap"] += missing

    def _count_flagged(self, can_id: NDArray[np.uint32]) -> None:
        """Count error frames and remote requests, whose identifiers match no message."""
        flagged = can_id[can_id & np.uint32(CAN_ERR_FLAG | CAN_RTR_FLAG) != 0]
        if len(flagged):
            errors = int(np.count_nonzero(flagged & np.uint32(CAN_ERR_FLAG)))
            self.counters.errors["error_frame"] += errors
            self.counters.errors["rtr_frame"] += len(flagged) - errors

    # -- samples

    def _samples_of(self, frames: Frames, *, at_end: bool = False) -> list[Record]:
        """Group frames into samples and decode them."""
        grouped = np.flatnonzero(frames.part < self._map.grouped)
        samples = self._grouper.split(frames.take(grouped), at_end=at_end)
        for code, count in (("sample_incomplete", samples.incomplete), ("sample_duplicate", samples.duplicate)):
            if count:
                self.counters.errors[code] += count
        for side in self._side.values():
            side.take(frames)
        if not samples.index.shape[1]:
            return []
        earlier = len(samples.frames.part) - len(grouped)
        place = np.concatenate([np.full(earlier, -1, np.intp), grouped, [len(frames.part)]])
        return self._records(samples, place[samples.closed_at])

    def _records(self, samples: Samples, position: NDArray[np.intp]) -> list[Record]:
        """Return rows of good samples; ``position`` is where each was closed among this call's frames."""
        rows = np.zeros(samples.index.shape[1], IMU_DTYPE)
        rows["host_time_ns"] = samples.frames.host_time_ns[samples.index.max(axis=0)]
        data = [samples.frames.data[index] for index in samples.index]
        self._fill_times(rows, data, position)
        records: list[Record] = []
        if self._latch is not None:
            records.append(DeviceClockSamples(_clock_rows(rows)))
        if not self._clock_only:
            dropped = self._fill_values(rows, data, position)
            kept = rows[~dropped] if dropped.any() else rows
            if len(kept):
                records.append(ImuSamples(kept))
        return records

    def _fill_times(self, rows: StructArray, data: list[ByteRows], position: NDArray[np.intp]) -> None:
        """Write device time and the time of the latest PPS edge on its scale, −1 where the device has none."""
        rows["device_time_ns"] = -1
        rows["pps_time_ns"] = -1
        rows["gps_week"] = -1
        ticks, latch = self._map.sample_ticks, self._map.pps_ticks
        if ticks is None or self._unwrapper is None:
            return
        counts, restart = self._unwrapper.unwrap(ticks.layout.bits(data[ticks.part]), rows["host_time_ns"].copy())
        if restart.any():
            self.counters.errors["restart"] += int(restart.sum())
        rows["device_time_ns"] = nanoseconds(counts, self._map.tick_hz)
        if latch is not None and self._latch is not None:
            latched = self._latch.track(*self._bits_of(latch, data, position), counts, restart)
            rows["pps_time_ns"] = np.where(latched >= 0, nanoseconds(latched, self._map.tick_hz), -1)

    def _fill_values(self, rows: StructArray, data: list[ByteRows], position: NDArray[np.intp]) -> BoolArray:
        """Write specific force, angular rate, temperature and status (its low 32 bits); return the rows to drop."""
        dropped = np.zeros(len(rows), np.bool_)
        for number, signal in enumerate(self._map.vectors):
            bits = signal.layout.bits(data[signal.part])
            values = signal.layout.values(bits)
            dropped |= self._unusable(signal, bits, values, dropped)
            field = "specific_force_b" if number < 3 else "angular_rate_b"
            np.multiply(values, signal.factor, out=rows[field][:, number % 3])
        for first in range(0, len(self._map.vectors), 3):
            dropped |= self._blank(self._map.vectors[first : first + 3], data, dropped)
        rows["temperature_c"] = np.nan
        temperature = self._map.temperature
        if temperature is not None:
            bits, known = self._bits_of(temperature, data, position)
            values = temperature.layout.values(bits)
            known &= ~self._unusable(temperature, bits, values, ~known)
            rows["temperature_c"][known] = values[known]
        if self._map.status is not None:
            bits, known = self._bits_of(self._map.status, data, position)
            rows["status"] = np.where(known, bits & np.uint64(0xFFFF_FFFF), 0)
        return dropped

    def _blank(self, axes: Sequence[MappedSignal], data: list[ByteRows], dropped: BoolArray) -> BoolArray:
        """Return where all axes of an unsigned quantity are ones, its usual "not available"; count the rows that are
        not dropped already.

        A DBC that gives no range and does not say that it is J1939's leaves no other sign of it. One saturated axis, or
        −1 in signed ones, may be measured.
        """
        if any(axis.layout.is_float or axis.layout.signed for axis in axes):
            return np.zeros(len(dropped), np.bool_)
        ones = [axis.layout.bits(data[axis.part]) == np.uint64((1 << axis.layout.length) - 1) for axis in axes]
        blank: BoolArray = np.logical_and.reduce(ones) & ~dropped
        if blank.any():
            self.counters.errors["not_available"] += int(blank.sum())
        return blank

    def _unusable(self, signal: MappedSignal, bits: UInt64Array, values: FloatArray, dropped: BoolArray) -> BoolArray:
        """Return which values of a signal cannot be used; count the rows that are not dropped already."""
        missing = failed = np.zeros(len(bits), np.bool_)
        if self._map.parts[signal.part].j1939:
            missing, failed = parameter_codes(signal.layout, bits)
        outside = signal.layout.outside(values) & ~missing & ~failed
        for code, found in (("not_available", missing), ("error_value", failed), ("out_of_range", outside)):
            count = int(np.count_nonzero(found & ~dropped)) if found.any() else 0
            if count:
                self.counters.errors[code] += count
                if code == "out_of_range":
                    self._outside[signal.layout.name] += count
        return missing | failed | outside

    def _bits_of(
        self, signal: MappedSignal, data: list[ByteRows], position: NDArray[np.intp]
    ) -> tuple[UInt64Array, BoolArray]:
        """Return the bits of an optional signal for each sample, from its own frames or from the message beside
        them.
        """
        if signal.part < self._map.grouped:
            bits = signal.layout.bits(data[signal.part])
            return bits, np.ones(len(bits), np.bool_)
        return self._side[signal.layout.name].before(position)


def _padded(data: ByteRows, width: int) -> ByteRows:
    """Return data bytes cut or zero-padded to the width that signals are read from."""
    if data.shape[1] >= width:
        return data[:, :width]
    return np.pad(data, ((0, 0), (0, width - data.shape[1])))


def _clock_rows(rows: StructArray) -> StructArray:
    """Return the device clock samples in rows of inertial samples."""
    clock = np.zeros(len(rows), DEVICE_CLOCK_DTYPE)
    for name in ("host_time_ns", "device_time_ns", "pps_time_ns"):
        clock[name] = rows[name]
    clock["pps_count"] = -1
    clock["locked"] = -1
    return clock


def make_clock_parser(settings: DeviceSettings) -> DbcParser:
    """Make the recorder's parser, which returns samples of the device's clock only."""
    return DbcParser(settings, clock_only=True)


DRIVERS = (
    Driver(
        protocol="dbc",
        kind="imu",
        transports=("can",),
        yields=(ImuSamples, DeviceClockSamples),
        summary="any IMU on CAN, by its DBC file and a map of its signals",
        make_parser=DbcParser,
        make_time_parser=make_clock_parser,
        needs=("dbc", "signals"),
    ),
)
