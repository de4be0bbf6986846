"""The bytes that a GNSS receiver sends on its serial line, as the recorder reads them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from swath.drivers.gnss.nmea.sentences import (
    encode_gga,
    encode_gst,
    encode_hdt,
    encode_rmc,
    encode_sentence,
    encode_vtg,
    encode_zda,
)
from swath.georef.records import FixType
from swath.sim.clocks import PulsePerSecond, generator
from swath.sim.gnss.calendar import Calendar, Stamp
from swath.sim.gnss.noise import Noise
from swath.sim.gnss.novatel import NovatelMessages
from swath.sim.gnss.pulse import Pulse
from swath.sim.gnss.receiver import INS_RATE_HZ, Epochs, InsEpochs, Receiver
from swath.sim.gnss.ubx import UbxMessages
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import GnssTable
from swath.sim.shots import WireUnit

QUALITY = {FixType.SINGLE: 1, FixType.RTK_FIXED: 4, FixType.RTK_FLOAT: 5}  # GGA field 6


class NmeaMessages:
    """Encodes the NMEA sentences of an epoch; arguments as for `swath.sim.gnss.novatel.NovatelMessages`."""

    def __init__(self, table: GnssTable, calendar: Calendar, pulse: Pulse) -> None:
        self._calendar = calendar
        self._undulation_m = table.undulation_m
        self._two_antennas = table.secondary_lever_arm_m is not None

    def epoch(self, epochs: Epochs, row: int) -> list[bytes]:
        """Return the sentences of an epoch: GGA, RMC, on whole seconds ZDA, then VTG and GST.

        With a second antenna HDT follows, which gives the direction of the baseline.
        """
        stamp = self._calendar.at(float(epochs.time_s[row]))
        there = epochs.fix[row] != FixType.NONE
        sentences = self._solution(epochs, row, stamp) if there else _no_solution(stamp)
        if stamp.second is not None:  # not last: a sentence that ends an epoch must be in every epoch
            sentences.insert(2, encode_zda(stamp.day_ns, stamp.date))
        if self._two_antennas:
            sentences.append(encode_hdt(float(epochs.heading_rad[row])) if there else encode_sentence("GNHDT,,T"))
        return sentences

    def ins_epoch(self, ins: InsEpochs, row: int) -> list[bytes]:
        """Return an empty list; simulated NMEA receivers have no INS."""
        return []

    def _solution(self, epochs: Epochs, row: int, stamp: Stamp) -> list[bytes]:
        lat_rad, lon_rad = float(epochs.lat_rad[row]), float(epochs.lon_rad[row])
        north, east, _ = map(float, epochs.velocity_l[row])
        speed_mps, course_rad = math.hypot(north, east), math.atan2(east, north)
        gga = encode_gga(
            stamp.day_ns,
            lat_rad,
            lon_rad,
            float(epochs.height_m[row]) - self._undulation_m,
            self._undulation_m,
            quality=QUALITY[FixType(int(epochs.fix[row]))],
            satellites=int(epochs.satellites[row]),
        )
        return [
            gga,
            encode_rmc(stamp.day_ns, stamp.date, lat_rad, lon_rad, speed_mps, course_rad),
            encode_vtg(speed_mps, course_rad),
            encode_gst(stamp.day_ns, *map(float, epochs.position_sigma_l[row])),
        ]


def _no_solution(stamp: Stamp) -> list[bytes]:
    """Return the sentences of an epoch without a solution; they have the time, and the solution's fields are empty."""
    hour, minute, ms = stamp.clock
    time = f"{hour:02d}{minute:02d}{ms / 1000.0:05.2f}"
    return [
        encode_sentence(f"GNGGA,{time},,,,,0,00,99.99,,,,,,"),
        encode_sentence(f"GNRMC,{time},V,,,,,,,{stamp.date:%d%m%y},,,N"),
        encode_sentence("GNVTG,,T,,M,,N,,K,N"),
        encode_sentence(f"GNGST,{time},,,,,,,"),
    ]


BITS_PER_BYTE = 10  # 8N1

VARIATION_S = 0.002  # one sigma of an epoch's delay beyond the least one
GREATEST_VARIATION_S = 0.010
NAMING_S = 0.9  # FORMULAS 12: a later message may be taken for that of the next second
SLACK = 1.1  # room on the line, because numbers may get more digits
STANDARD_BAUDS = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000, 4_000_000)


class Messages(Protocol):
    """An encoder of one protocol's messages."""

    def epoch(self, epochs: Epochs, row: int) -> list[bytes]:
        """Return all messages of a solution, in the order in which they are sent."""

    def ins_epoch(self, ins: InsEpochs, row: int) -> list[bytes]:
        """Return all messages of an inertial solution."""


PROTOCOLS: dict[str, Callable[[GnssTable, Calendar, Pulse], Messages]] = {
    "novatel": NovatelMessages,
    "ubx": UbxMessages,
    "nmea": NmeaMessages,
}


class GnssWire:
    """The bytes of a receiver, ``gnss/<name>``, split wherever a read of the serial port falls.

    Args:
        plan: of the flight.
        name: of the receiver in it.
        receiver: its solutions.
        pulse: the pulse that it drives; None if no pulse is wired to it.

    Raises:
        PlanError: the messages do not fit on the line, come too late to name their second, or the protocol has no
            message for what the plan requests.
    """

    def __init__(self, plan: Plan, name: str, receiver: Receiver, pulse: PulsePerSecond | None) -> None:
        table, flight, host = receiver.table, plan.tables.flight, plan.tables.host
        _check_protocol(table, name)
        self._source, self._table, self._receiver = f"gnss/{name}", table, receiver
        calendar = Calendar(plan.start_gps_ns, plan.leap_seconds)
        self._messages = PROTOCOLS[table.protocol](table, calendar, Pulse(pulse))
        read_s = host.serial_read_ms / 1000.0
        _check_line(table, name, self._typical_second(), read_s)
        first_read_s = read_s * generator(flight.seed, "gnss", name, "reads").random()
        self._line = SerialLine(table.baud, read_s, first_read_s)
        variation_s = VARIATION_S if flight.noise else 0.0
        self._variation = [
            Noise(flight.seed, ("gnss", name, "latency", part), (variation_s,), 0.0, 1.0) for part in ("fix", "ins")
        ]
        self._stop_tick = math.ceil(receiver.trajectory.end_s * INS_RATE_HZ)  # of the last epoch, at INS_RATE_HZ
        self._second = 0  # epochs before it are sent
        self._until_s = 0.0

    def units(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return the reads with ``start_s`` <= time < ``stop_s`` that have bytes.

        Each call must continue where the previous one ended.

        Raises:
            ValueError: the call starts elsewhere.
        """
        if start_s != self._until_s:
            raise ValueError(f"units from {start_s} s on, but the last ones ended at {self._until_s} s")
        self._until_s = stop_s
        while self._second < stop_s:  # whole seconds at a time, so that rounding too is the same however time is cut
            first_tick = self._second * INS_RATE_HZ
            for time_s, data in self._bursts(first_tick, min(first_tick + INS_RATE_HZ, self._stop_tick)):
                self._line.send(time_s, data)
            self._second += 1
        return [WireUnit(time_s, self._source, data) for time_s, data in self._line.read_until(stop_s)]

    def _bursts(self, first_tick: int, stop_tick: int) -> Iterator[tuple[float, bytes]]:
        """Yield, in the order of sending, the earliest time and the bytes of each epoch in these ticks."""
        ticks = INS_RATE_HZ // self._table.rate_hz
        first, stop = -(-first_tick // ticks), -(-stop_tick // ticks)
        bursts: list[tuple[int, int, float, bytes]] = []  # tick, part, delay
        if stop > first:
            epochs = self._receiver.epochs(first, stop - first)
            delays_s = self._delays_s(0, first, stop - first)
            for row, delay_s in enumerate(delays_s):
                bursts.append(((first + row) * ticks, 0, delay_s, b"".join(self._messages.epoch(epochs, row))))
        if self._table.ins and stop_tick > first_tick:
            ins = self._receiver.ins_epochs(first_tick, stop_tick - first_tick)
            delays_s = self._delays_s(1, first_tick, stop_tick - first_tick)
            for row, delay_s in enumerate(delays_s):
                bursts.append((first_tick + row, 1, delay_s, b"".join(self._messages.ins_epoch(ins, row))))
        for tick, _, delay_s, data in sorted(bursts):
            yield tick / INS_RATE_HZ + delay_s, data

    def _delays_s(self, part: int, first: int, count: int) -> list[float]:
        """Return the delay of each epoch's first byte after the epoch."""
        variation_s = np.minimum(np.abs(self._variation[part].rows(first, count)[:, 0]), GREATEST_VARIATION_S)
        delays_s: list[float] = (self._table.latency_ms / 1000.0 + variation_s).tolist()
        return delays_s

    def _typical_second(self) -> list[tuple[float, int]]:
        """Return (time, bytes) of one second's epochs while there are satellites."""
        epochs = self._receiver.epochs(0, self._table.rate_hz)
        epochs = replace(epochs, fix=np.full_like(epochs.fix, FixType.SINGLE))
        sizes = [(float(t), _size(self._messages.epoch(epochs, row))) for row, t in enumerate(epochs.time_s)]
        if self._table.ins:
            ins = self._receiver.ins_epochs(0, INS_RATE_HZ)
            sizes += [(float(t), _size(self._messages.ins_epoch(ins, row))) for row, t in enumerate(ins.time_s)]
        return sorted(sizes)


def config_table(table: GnssTable, name: str, transport: str, leap_seconds: int | None = None) -> dict[str, Any]:
    """Return ``[gnss.<name>]`` of the configuration that records the receiver (CONFIG).

    Args:
        table: of the plan.
        name: of the receiver.
        transport: URI of its serial line.
        leap_seconds: GPS − UTC, for a protocol that does not transmit it; None: the configuration's default.
    """
    config: dict[str, Any] = {"transport": transport, "protocol": table.protocol}
    if table.pps is not None:
        config["pps"] = table.pps
    config["lever_arm_m"] = list(table.lever_arm_m)
    if table.secondary_lever_arm_m is not None:
        config["secondary_lever_arm_m"] = list(table.secondary_lever_arm_m)
    if leap_seconds is not None and table.protocol == "nmea":
        config["leap_seconds"] = leap_seconds
    return config


def _size(messages: list[bytes]) -> int:
    return sum(map(len, messages))


def _check_protocol(table: GnssTable, name: str) -> None:
    if table.ins and table.protocol != "novatel":
        raise PlanError(f"gnss.{name}.ins", f'"{table.protocol}" has no such messages; use protocol = "novatel"')
    if table.secondary_lever_arm_m is not None and table.protocol == "ubx":
        text = '"ubx" sends no heading here; use protocol = "novatel" or "nmea"'
        raise PlanError(f"gnss.{name}.secondary_lever_arm_m", text)


def _check_line(table: GnssTable, name: str, second: list[tuple[float, int]], read_s: float) -> None:
    """Refuse a serial line on which messages pile up or name their second too late."""
    bytes_per_s = math.ceil(SLACK * sum(size for _, size in second))

    def late_s(baud: int) -> float:
        return _lateness_s(table, second, read_s, baud)

    def carries(baud: int) -> bool:
        return BITS_PER_BYTE * bytes_per_s <= baud

    if carries(table.baud) and late_s(table.baud) < NAMING_S:
        return
    better = next((baud for baud in STANDARD_BAUDS if carries(baud) and late_s(baud) < NAMING_S), None)
    if better is not None and not carries(table.baud):
        text = f"{table.baud} is too slow for {bytes_per_s} bytes a second; set {better} or more, or a lower rate_hz"
        raise PlanError(f"gnss.{name}.baud", text)
    baud = table.baud if carries(table.baud) else STANDARD_BAUDS[-1]
    late = f"messages would come {late_s(baud):.2f} s after the second they name"
    if better is not None:
        text = f"{baud}: {late}; set {better} or more, or a lower latency_ms"
        raise PlanError(f"gnss.{name}.baud", text)
    most_ms = math.floor(table.latency_ms - 1000.0 * (late_s(baud) - NAMING_S)) - 1
    raise PlanError(f"gnss.{name}.latency_ms", f"{table.latency_ms:g}: {late}; set at most {max(most_ms, 0)}")


def _lateness_s(table: GnssTable, second: list[tuple[float, int]], read_s: float, baud: int) -> float:
    """Return the latest time after its second at which the last byte of a whole second's messages is read.

    Every second is taken to have the messages of this one.
    """
    free_s = latest_s = 0.0
    for start_s in range(3):
        for time_s, size in second:
            leaves_s = start_s + time_s + table.latency_ms / 1000.0 + GREATEST_VARIATION_S
            free_s = max(free_s, leaves_s) + SLACK * size * BITS_PER_BYTE / baud
            if time_s == 0.0:
                latest_s = max(latest_s, free_s - start_s + read_s)
    return latest_s


class SerialLine:
    """The serial line from a device to the recorder.

    Args:
        baud: bits a second.
        read_s: time between two reads.
        first_read_s: time of the recorder's first read.
    """

    def __init__(self, baud: int, read_s: float, first_read_s: float) -> None:
        self._byte_s = BITS_PER_BYTE / baud
        self._read_s, self._first_read_s = read_s, first_read_s
        self._free_s = 0.0
        self._queue: deque[tuple[float, bytes]] = deque()
        self._taken = 0  # bytes of the queue's first message
        self._reads = 0

    def send(self, time_s: float, data: bytes) -> None:
        """Put bytes behind those still waiting; they leave at this time at the earliest."""
        start_s = max(time_s, self._free_s)
        self._free_s = start_s + len(data) * self._byte_s
        self._queue.append((start_s, data))

    def read_until(self, stop_s: float) -> list[tuple[float, bytes]]:
        """Return the reads before ``stop_s`` that have bytes, each with its time.

        All bytes that arrive by then must have been sent already.
        """
        reads = []
        while (time_s := self._first_read_s + self._reads * self._read_s) < stop_s:
            self._reads += 1
            data = self._arrived(time_s)
            if data:
                reads.append((time_s, data))
        return reads

    def _arrived(self, time_s: float) -> bytes:
        """Return the bytes whose last bit has arrived and that no read has taken yet."""
        parts = []
        while self._queue and self._queue[0][0] < time_s:
            start_s, data = self._queue[0]
            end = min(int((time_s - start_s) / self._byte_s), len(data))
            parts.append(data[self._taken : end])
            if end < len(data):
                self._taken = end
                break
            self._queue.popleft()
            self._taken = 0
        return b"".join(parts)
