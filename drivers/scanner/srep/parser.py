"""SREP/1: ranges and encoder readings of line scanners over UDP (the project's open datagram, PROTOCOLS).

One datagram: header (48 bytes), N pulses of 8 + 8·R bytes, CRC-32. Little-endian. Device time is the scanner's tick
counter in nanoseconds, floor(ticks · 10⁹ / tick_hz), exact; its seconds count modulo 2³² (136 years) so that every
u64 counter fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError, PacketParser
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import BLOCK_SLOTS, Chosen, ReturnSlots, common_words, returns_table
from swath.drivers.scanner.sequence import LATE_DATAGRAMS, SampleThinner, SequenceTracker
from swath.drivers.scanner.srep.datagrams import Datagrams, clock_samples
from swath.drivers.scanner.srep.layout import (
    CRC,
    FLAG_LASER_ON,
    FLAG_PPS_LOCKED,
    FLAG_RANGE_GATE,
    HEADER_BYTES,
    PULSE_WIDTH_UNIT_NS,
    RANGE_UNIT_M,
    SLOT_DTYPE,
    ZONE_UNKNOWN,
    PulseRows,
    SrepHeader,
    body_words,
    datagram_bytes,
    encode_datagram,
    header_checks,
    nanoseconds,
    pulse_dtype,
    pulse_times,
)
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import (
    RETURN_FLAG_PPS_LOCKED,
    ByteRows,
    ChunkBatch,
    DeviceClockSamples,
    DeviceStatus,
    Record,
    ScannerReturns,
)

FLAG_NO_POINT = 128  # marks a row without a return, which only gives a pulse's time and encoder reading
SAME_RATE = 1e-3  # pulse rates that differ by less, relatively, count as equal: measured rates fluctuate

__all__ = ["DRIVERS", "ScanAngle", "SrepHeader", "SrepParser", "encode_datagram"]


class ScanAngle:
    """Converts an encoder reading to scan angle θ_encoder and facet (PROTOCOLS, "Encoder to scan angle").

    Args:
        config: the scanner's table; ``mirror_factor`` is mandatory, ``geometry.facets`` is for a polygon.

    Raises:
        DriverSettingsError: a key is absent or wrong.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        factor = config.get("mirror_factor")
        if isinstance(factor, bool) or not isinstance(factor, int | float) or not math.isfinite(factor) or factor == 0:
            raise DriverSettingsError(
                f"mirror_factor: got {factor!r}, want 2 for a flat mirror turned about an axis in its own plane, "
                "1 for a 45° mirror or an optical angle"
            )
        self._factor = float(factor)
        self._facets = 0
        geometry = config.get("geometry") or {}
        if geometry.get("type") == "polygon":
            facets = geometry.get("facets")
            if isinstance(facets, bool) or not isinstance(facets, int) or not 2 <= facets <= 65535:
                raise DriverSettingsError(f"geometry.facets: got {facets!r}, want the polygon's number of facets")
            self._facets = facets

    def angles(self, encoder: NDArray[np.int32], encoder_counts: int) -> tuple[FloatArray, NDArray[np.uint16] | None]:
        """Return scan angles (n, N) in radians and, for a polygon, facets (n, N) of readings (n, N)."""
        turned = encoder.astype(np.float64)
        if not self._facets:
            turned *= 2 * np.pi * self._factor / encoder_counts
            return turned, None
        # Whole and half numbers below 2⁴⁸: every sum, difference and product here is exact, and so is the floor of a
        # quotient, as one that is not whole differs from the next whole by more than its rounding. np.divmod takes ten
        # times as long.
        turned *= self._facets
        facet = np.floor(turned / encoder_counts)
        turned -= (facet + 0.5) * encoder_counts
        turned *= 4 * np.pi / self._facets / encoder_counts  # 2 · (shaft angle − facet centre)
        if facet.min(initial=0) < 0 or facet.max(initial=0) >= self._facets:  # readings beyond one turn
            facet -= np.floor(facet / self._facets) * self._facets
        return turned, facet.astype(np.uint16)


class SrepParser(PacketParser):
    """Decodes datagrams; counts ``bad_length``, ``bad_magic``, ``bad_version``, ``bad_header`` and bad CRCs.

    Args:
        settings: config keys ``mirror_factor``, ``geometry``.
        clock_only: return clock samples (one in 50 ms of host time) and status, no returns; only the CRCs of those
            datagrams, and of those that break the sequence, are then computed.

    Attributes:
        emissions: if True, where ranges are apparent (byte 15 = 255), a pulse without a return makes a row too, of
            range 0 and no returns, flagged `FLAG_NO_POINT`: matching echoes to emissions needs time and encoder of all
            pulses.
        unanswered: if True, such rows are made where ranges are true as well: for a map of where no pulse came back.
        tell_rates: called with ``pulse_id``, pulse rate in Hz (0: unknown) and tick_hz of the first datagram, and of
            each datagram with other rates, before its returns are handed over.
    """

    def __init__(self, settings: DeviceSettings, *, clock_only: bool = False) -> None:
        super().__init__()
        self._scan_angle = ScanAngle(settings.config)
        self._tracker = SequenceTracker(self.counters.errors)
        self._thinner = SampleThinner() if clock_only else None
        self._fill = filler(compiled=settings.compiled and not clock_only)
        self._last_sequence: int | None = None
        self._newest = -LATE_DATAGRAMS - 1
        self._last_status: tuple[int, ...] | None = None
        self._last_rates = (-1, 0)
        self.emissions = self.unanswered = False
        self.tell_rates: Callable[[int, float, int], None] | None = None

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode datagrams of equal length; see `PacketParser.parse_units`."""
        return self._parse(Datagrams(host_time_ns, [units])) if len(units) else []

    def feed_batches(self, batches: Sequence[ChunkBatch]) -> list[Record]:
        """Decode datagrams of any lengths at once: a scanner that ends a datagram where its zone changes mixes
        lengths.
        """
        held = [batch for batch in batches if len(batch.units)]
        if not held:
            return []
        host_time_ns = np.concatenate([batch.host_time_ns for batch in held])
        return self._parse(Datagrams(host_time_ns, [batch.units for batch in held]))

    def _parse(self, units: Datagrams) -> list[Record]:
        units, header, chosen = self._check(units)
        if not len(units):
            return []
        self.counters.messages["srep"] += len(units)
        first_time_ns = nanoseconds(header["first_ticks"], header["tick_hz"])
        unwrapped, fresh = self._tracker.follow(
            header["sequence"], first_time_ns, header["pps_count"], units.host_time_ns
        )
        keep = fresh & chosen
        if not keep.any():
            return []
        if not keep.all():
            units, header, unwrapped = units.where(keep), header[keep], unwrapped[keep]
        records: list[Record] = list(self._status(units.host_time_ns, header))
        words = units.bodies()
        forward = self._forward(unwrapped)
        if forward.any():
            records.append(DeviceClockSamples(clock_samples(units.host_time_ns, header, words)[forward]))
        if self._thinner is None:
            self._tell_rates(header, unwrapped)
            rows = self._returns(units.host_time_ns, header, words, unwrapped)
            if len(rows):
                records.append(ScannerReturns(rows))
        return records

    def _forward(self, unwrapped: Int64Array) -> BoolArray:
        """Return (n,) True for datagrams in order: the clock sample of a late one would look like a clock that went
        back.
        """
        newest = np.maximum.accumulate(np.concatenate([[self._newest], unwrapped]))
        self._newest = int(newest[-1])
        forward: BoolArray = unwrapped > newest[:-1]
        return forward

    def _check(self, units: Datagrams) -> tuple[Datagrams, StructArray, BoolArray]:
        """Return valid datagrams, their headers, and which of them are decoded; the others are counted."""
        chosen = np.ones(len(units), dtype=np.bool_)
        if self._thinner is not None:
            chosen = self._thinner.choose(units.host_time_ns)
        size, lengths = sum(block.size for block in units.blocks), units.lengths()
        if min(block.shape[1] for block in units.blocks) < HEADER_BYTES + CRC.size:
            long = lengths >= HEADER_BYTES + CRC.size
            self.counters.count_bad("bad_length", int((~long).sum()))
            units, chosen, lengths = units.where(long), chosen[long], lengths[long]
        header = units.headers()
        good = np.ones(len(units), dtype=np.bool_)
        for code, passes in header_checks(header, lengths):
            self.counters.count_bad(code, int((good & ~passes).sum()))
            good &= passes
        verify = good if self._thinner is None else good & (chosen | self._breaks(header["sequence"], good))
        agree = units.where(verify).agree_with_crc()
        self.counters.bad_checksums += int((~agree).sum())
        good[verify] = agree
        framed = int(lengths[good].sum())
        self.counters.bytes += size
        self.counters.bytes_framed += framed
        self.counters.bytes_skipped += size - framed
        if not good.all():  # else nothing is copied
            units, header, chosen = units.where(good), header[good], chosen[good]
        return units, header, chosen

    def _breaks(self, sequence: NDArray[np.uint32], good: BoolArray) -> BoolArray:
        """Return where a datagram does not follow the one before, starting from the last one of the previous batch."""
        follows = np.zeros(len(sequence), dtype=np.bool_)
        if not len(sequence):
            return follows
        follows[1:] = (np.diff(sequence) == 1) & good[1:] & good[:-1]
        if self._last_sequence is not None:
            follows[0] = int(sequence[0]) == (self._last_sequence + 1) % (1 << 32)
        self._last_sequence = int(sequence[-1]) if good[-1] else None
        return ~follows

    def _status(self, host_time_ns: Int64Array, header: StructArray) -> list[DeviceStatus]:
        """Return a status for each datagram whose flags, id or pulse rate differ from the one before."""
        keys = np.stack([header[name].astype(np.int64) for name in ("scanner_id", "flags", "prf_mhz")], axis=1)
        changed = np.ones(len(keys), dtype=np.bool_)
        changed[1:] = (keys[1:] != keys[:-1]).any(axis=1)
        changed[0] = tuple(keys[0].tolist()) != self._last_status
        self._last_status = tuple(keys[-1].tolist())
        return [_status(int(host_time_ns[row]), *keys[row].tolist()) for row in np.flatnonzero(changed).tolist()]

    def _tell_rates(self, header: StructArray, unwrapped: Int64Array) -> None:
        if self.tell_rates is None:
            return
        prf_mhz, tick_hz = header["prf_mhz"].astype(np.int64), header["tick_hz"].astype(np.int64)
        changed = np.ones(len(header), dtype=np.bool_)
        changed[1:] = (prf_mhz[1:] != prf_mhz[:-1]) | (tick_hz[1:] != tick_hz[:-1])
        for row in np.flatnonzero(changed).tolist():
            rates = (int(prf_mhz[row]), int(tick_hz[row]))
            apart_mhz = abs(rates[0] - self._last_rates[0])
            alike = apart_mhz <= SAME_RATE * self._last_rates[0] and rates[0] > 0
            if rates == self._last_rates or (rates[1] == self._last_rates[1] and alike):
                continue
            self._last_rates = rates
            self.tell_rates(int(unwrapped[row]) << 16, rates[0] / 1000, rates[1])

    def _returns(
        self, host_time_ns: Int64Array, header: StructArray, words: UInt64Array, unwrapped: Int64Array
    ) -> StructArray:
        """Decode the returns of all datagrams in order, in blocks of one layout; ``words`` are their
        `Datagrams.bodies`.
        """
        fired = header["pulses"] > 0
        if not fired.all():
            host_time_ns, header, unwrapped = host_time_ns[fired], header[fired], unwrapped[fired]
        ends = np.cumsum(body_words(header)).tolist()
        slots = np.cumsum(header["pulses"].astype(np.int64) * header["return_slots"])
        table = returns_table(int(slots[-1]) if len(slots) else 0)
        filled = 0
        for start, stop in _same_layout(header, slots):
            part = slice(start, stop)
            body = words[ends[start - 1] if start else 0 : ends[stop - 1]]
            block = self._block(host_time_ns[part], header[part], body, unwrapped[part])
            wanted = self.emissions & (header["mta_zone"][part] == ZONE_UNKNOWN) | self.unanswered
            if wanted.any():
                filled += self._fill_all(block, np.repeat(wanted, header["pulses"][part]), table[filled:])
            else:
                filled += self._fill(block, table[filled:])
        return table[:filled]

    def _fill_all(self, block: ReturnSlots, wanted: BoolArray, table: StructArray) -> int:
        """Fill rows in order of pulses, also a row for each pulse without a return that is ``wanted`` (pulses,)."""
        ranges = block.content["range"][:, block.others :]
        returns = np.zeros(len(ranges), np.int64)
        for slot in range(ranges.shape[1]):
            returns += ranges[:, slot] != 0
        alone = (returns == 0) & wanted
        if not alone.any():
            return self._fill(block, table)
        content = block.content.copy()
        content["range"][alone, block.others] = 1  # makes `fill` write a row
        block.content = content
        filled = self._fill(block, table)
        rows = np.where(alone, 1, returns)
        at = (np.cumsum(rows) - rows)[alone]
        for name in ("range_m", "intensity", "pulse_width_ns", "return_number", "number_of_returns"):
            table[name][at] = 0
        table["flags"][at] |= FLAG_NO_POINT
        return filled

    def _block(
        self, host_time_ns: Int64Array, header: StructArray, words: UInt64Array, unwrapped: Int64Array
    ) -> ReturnSlots:
        """Return the slots of datagrams of one layout; ``words`` are those of their pulses."""
        slots = int(header["return_slots"][0])
        rows = PulseRows.of(header["pulses"])
        words = words.reshape(-1, 1 + slots)
        body = words.view(pulse_dtype(slots)).reshape(rows.shape)
        angle, facet = self._scan_angle.angles(body["encoder"], int(header["encoder_counts"][0]))
        times_ns = pulse_times(header, body["ticks"], rows)
        host_times_ns = rows.spread(host_time_ns)[:, np.newaxis]
        per_pulse: dict[str, Callable[[Chosen], NDArray[Any]]] = {
            "host_time_ns": lambda at: at(host_times_ns),
            "device_time_ns": lambda at: at(times_ns),
            "encoder_rad": lambda at: at(angle),
        }
        if facet is not None:
            per_pulse["channel"] = lambda at: at(facet)
        locked = (header["flags"] & FLAG_PPS_LOCKED) * np.uint8(RETURN_FLAG_PPS_LOCKED)
        common = common_words((len(header), 1), mta_zone=header["mta_zone"][:, np.newaxis], flags=locked[:, np.newaxis])
        # a pulse's head takes one more slot before its own; beside a single slot, which pulses mostly fill, it is
        # left out
        content = np.ascontiguousarray(words[:, 1:] if slots == 1 else words).view(SLOT_DTYPE)
        return ReturnSlots(
            content=content,
            range_unit_m=RANGE_UNIT_M,
            common=rows.spread(common[:, 0])[:, np.newaxis],
            shape=rows.shape,
            pulse_id=rows.first_ids(unwrapped << 16),
            per_pulse=per_pulse,
            pulse_width_unit_ns=np.float32(PULSE_WIDTH_UNIT_NS),
            others=0 if slots == 1 else 1,
        )


def _same_layout(header: StructArray, slots: Int64Array) -> list[tuple[int, int]]:
    """Return bounds of runs of datagrams of one layout: equal R, tick_hz and encoder_counts.

    Each run has at most `BLOCK_SLOTS` slots, or one datagram; ``slots`` (n,) are cumulative counts to the end of each
    datagram.
    """
    names = ("return_slots", "tick_hz", "encoder_counts")
    layout = np.stack([header[name].astype(np.int64) for name in names], axis=1)
    edges = [0, *(np.flatnonzero((layout[1:] != layout[:-1]).any(axis=1)) + 1).tolist(), len(header)]
    bounds = []
    for start, stop in pairwise(edges):
        while start < stop:
            before = int(slots[start - 1]) if start else 0
            full = int(slots.searchsorted(before + BLOCK_SLOTS, side="right"))
            bounds.append((start, min(max(full, start + 1), stop)))
            start = bounds[-1][1]
    return bounds


def _status(host_time_ns: int, scanner_id: int, flags: int, prf_mhz: int) -> DeviceStatus:
    return DeviceStatus(
        host_time_ns,
        {
            "scanner_id": scanner_id,
            "pps_locked": bool(flags & FLAG_PPS_LOCKED),
            "range_gate_active": bool(flags & FLAG_RANGE_GATE),
            "laser_on": bool(flags & FLAG_LASER_ON),
            "prf_hz": prf_mhz / 1000,
        },
        message="srep",
    )


def _clock_parser(settings: DeviceSettings) -> SrepParser:
    return SrepParser(settings, clock_only=True)


DRIVERS = (
    Driver(
        protocol="srep",
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, DeviceStatus),
        summary="line scanners by the open SREP/1 datagram: time, encoder, ranges, PPS latch",
        make_parser=SrepParser,
        make_time_parser=_clock_parser,
        needs=("mirror_factor",),
        line_scanner=True,
        bytes_per_s=2e6 / 512 * datagram_bytes(512, 1),  # no data sheet: as said in docs/devices/srep.md
    ),
)
