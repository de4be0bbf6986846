"""Targets for every driver: it never raises, accounts for every byte, and does not depend on how input is cut."""

from __future__ import annotations

import gc
import hashlib
import random
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy

import numpy as np

from swath.drivers.driver import KINDS, Driver, all_drivers
from swath.drivers.parser import ChosenRecords, DeviceSettings, DriverSettingsError, Parser, StreamParser
from swath.georef.records import Chunk, ChunkBatch, Record
from tests.drivers.harness import Outcome, assert_bytes_accounted, outcome, random_pieces
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.frames import FramePool, changed_datagram, mutate_stream, tail_of
from tests.fuzz.mutation import LARGEST_CASE_BYTES, bounds, damage
from tests.fuzz.recordings import is_on_can, packets_of, settings_of, streams_of

SOURCE = "fuzz/fuzz"
HOST_NS = 1_800_000_000_000_000_000
EXTREME_TIMES_NS = (0, -1, (1 << 63) - 1, -(1 << 63), 7_258_118_400_000_000_000, 1)
GROWTH_BYTES = 400 * 1024  # how much a parser may grow over hundreds of inputs, by names of messages and a held frame
SEED_BYTES = 8 * 1024
_UNIT = struct.Struct("<Hq")  # of a case of packets: length of the unit, its host time
Run = Callable[[Parser, bytes, int], list[Record]]


def parser_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield a target for every parser of every driver: its name, and a function that builds it."""
    for kind in KINDS:
        for driver in all_drivers(kind).values():
            for suffix, make in (("", driver.make_parser), ("-time", driver.make_time_parser)):
                if make is not None:
                    yield (
                        f"{kind}-{driver.protocol}{suffix}",
                        _builder(driver, f"{kind}-{driver.protocol}{suffix}", make),
                    )


def _builder(driver: Driver, name: str, make: Callable[[DeviceSettings], Parser]) -> Callable[[], Target]:
    def build() -> Target:
        parsers = list(_made(make, settings_of(driver)))
        assert parsers, f"{driver.protocol}: the example on its page, with files of its fixtures, makes no parser"
        first = parsers[0].parser if isinstance(parsers[0], ChosenRecords) else parsers[0]
        stream = isinstance(first, StreamParser)
        target = _stream_target if stream else _packet_target
        # copied, because reading a DBC takes longer than an input
        return target(driver, name, lambda number: deepcopy(parsers[number % len(parsers)]), first)

    return build


def _made(make: Callable[[DeviceSettings], Parser], variants: list[DeviceSettings]) -> Iterator[Parser]:
    """Yield a parser for each of the settings that the driver accepts; a file of another head is refused."""
    for settings in variants:
        with suppress(DriverSettingsError):
            yield make(settings)


def _number(data: bytes) -> int:
    """Return a number that depends only on the input."""
    return int.from_bytes(hashlib.blake2b(data, digest_size=6).digest(), "little")


def _seen(found: Outcome) -> Iterator[str]:
    for key, values in found.counters.items():
        if isinstance(values, dict):
            yield from (f"{key} {name}" for name in list(values)[:100])
        elif values:
            yield key
    for event in found.events:
        fields = dict(event[1:])
        absent = " ".join(name for name, value in fields.items() if value is None)
        yield f"{event[0]} {fields.get('message', '')} {fields.get('valid', '')} {absent}"
    for name, rows in found.rows.items():
        yield f"{name} {len(rows).bit_length()}"


# --- streams --------------------------------------------------------------------------------------------------------


def _stream_target(driver: Driver, name: str, make: Callable[[int], Parser], first: Parser) -> Target:
    recordings = streams_of(driver)
    assert recordings, f"{driver.protocol}: no recording in its fixtures"
    pool = FramePool(recordings)
    rng = random.Random(name)
    seeds = [recording[:SEED_BYTES] for recording in recordings]
    seeds += [b"".join(pool.draw(rng)[1] for _ in range(12))[:LARGEST_CASE_BYTES] for _ in range(12)]

    def feed(parser: Parser, pieces: list[bytes], host_ns: int) -> Outcome:
        records: list[Record] = []
        for piece in pieces:
            records += parser.feed(Chunk(SOURCE, host_ns, piece))
        records += parser.close()
        return outcome(records, parser)

    def run(data: bytes) -> Iterator[str]:
        number = _number(data)
        host_ns = EXTREME_TIMES_NS[number % 6] if number % 16 == 0 else HOST_NS
        parser = make(number)
        whole = feed(parser, [data], host_ns)
        assert_bytes_accounted(parser, len(data))
        if feed(make(number), random_pieces(data, number), host_ns) != whole:
            raise FindingError(f"differs when cut with seed {number}")
        return _seen(whole)

    def mutate(rng: random.Random, base: bytes) -> bytes:
        return mutate_stream(rng, base, pool)

    return Target(name, seeds, mutate, run, lambda cases: _endure(make(0), cases, _feed_stream))


def _feed_stream(parser: Parser, data: bytes) -> None:
    parser.feed(Chunk(SOURCE, HOST_NS, data))


# --- packets --------------------------------------------------------------------------------------------------------

Units = list[tuple[int, bytes]]  # host time and content


def pack(units: Units) -> bytes:
    """Pack units into one input."""
    return b"".join(_UNIT.pack(len(data), time_ns) + data for time_ns, data in units)


def unpack(case: bytes) -> Units:
    """Return the units of an input; a unit cut off at its end counts too."""
    units: Units = []
    at = 0
    while at + _UNIT.size <= len(case) and len(units) < 400:
        length, time_ns = _UNIT.unpack_from(case, at)
        units.append((time_ns, case[at + _UNIT.size : at + _UNIT.size + length]))
        at += _UNIT.size + length
    return units


def _batches(units: Units, largest: Callable[[], int]) -> Iterator[ChunkBatch]:
    """Yield batches of neighbours with equal length, each of at most ``largest()`` units."""
    start = 0
    while start < len(units):
        limit, end, length = max(1, largest()), start + 1, len(units[start][1])
        while end < len(units) and end - start < limit and len(units[end][1]) == length:
            end += 1
        part = units[start:end]
        rows = np.frombuffer(b"".join(data for _, data in part), dtype=np.uint8).reshape(len(part), length)
        yield ChunkBatch(SOURCE, np.array([time_ns for time_ns, _ in part], dtype=np.int64), rows)
        start = end


def _packet_target(driver: Driver, name: str, make: Callable[[int], Parser], first: Parser) -> Target:
    recordings = packets_of(driver, first)
    step_ns = 100_000
    times = [[(HOST_NS + step_ns * at, data) for at, data in enumerate(units)] for units in recordings]
    window = 24 if is_on_can(driver) else max(3, min(8, 24_000 // len(recordings[0][0])))
    rng = random.Random(name)
    seeds = []
    for units in times:
        for start in (0, rng.randrange(len(units)), max(0, len(units) - window)):
            seeds.append(pack(units[start : start + window]))
    is_can = is_on_can(driver)
    pool = _kinds_of_units([unit for units in recordings for unit in units], is_can)
    seals = {len(kind[0]): tail_of(kind) for kind in pool}
    identifiers = sorted({unit[:4] for kind in pool for unit in kind}) if is_can else []

    def feed(parser: Parser, units: Units, largest: Callable[[], int]) -> Outcome:
        records: list[Record] = []
        for batch in _batches(units, largest):
            records += parser.feed_batch(batch)
        return outcome(records + parser.close(), parser)

    def run(data: bytes) -> Iterator[str]:
        number, units = _number(data), unpack(data)
        parser = make(number)
        whole = feed(parser, units, lambda: len(units))
        counters, fed = parser.counters, sum(len(unit) for _, unit in units)
        if counters.bytes != fed:
            raise FindingError(f"{counters.bytes} bytes counted of {fed}")
        if driver.kind == "scanner" and counters.bytes_framed + counters.bytes_skipped != fed:
            raise FindingError(f"{counters.bytes_framed} bytes framed and {counters.bytes_skipped} skipped of {fed}")
        sizes = random.Random(number)
        if feed(make(number), units, lambda: int(60 ** sizes.random())) != whole:
            raise FindingError(f"differs in batches of seed {number}")
        return _seen(whole)

    def mutate(rng: random.Random, base: bytes) -> bytes:
        units = unpack(base) or list(rng.choice(times)[:window])
        for _ in range(rng.choice((0, 0, 1, 3))):
            at = rng.randrange(len(units))
            units.insert(at, (units[at][0], rng.choice(rng.choice(pool))))
        for _ in range(1 + int(len(units) * rng.random() ** 3)):
            _change_unit(rng, units, identifiers, seals, is_can)
        if rng.random() < 0.15:
            del units[: rng.randrange(len(units))]
        return pack(units[: 4 * window])

    return Target(name, seeds, mutate, run, lambda cases: _endure(make(0), cases, _feed_packets))


def _kinds_of_units(units: list[bytes], is_can: bool) -> list[list[bytes]]:
    """Return a few units of every identifier (CAN) or length (datagrams), however frequent it is."""
    kinds: dict[bytes | int, list[bytes]] = {}
    for unit in units:
        kept = kinds.setdefault(unit[:4] if is_can else len(unit), [])
        if len(kept) < 24:
            kept.append(unit)
    return list(kinds.values())


def _change_unit(
    rng: random.Random,
    units: Units,
    identifiers: list[bytes],
    seals: dict[int, Callable[[bytes], bytes]],
    is_can: bool,
) -> None:
    at = rng.randrange(len(units))
    time_ns, unit = units[at]
    kind = rng.randrange(20)
    if kind == 0:
        moved_ns = max(-(1 << 63), min((1 << 63) - 1, time_ns + rng.randrange(-(10**12), 10**12)))
        units[at] = (rng.choice((*EXTREME_TIMES_NS, moved_ns)), unit)
    elif kind == 1:
        units.insert(at, units[rng.randrange(len(units))])
    elif kind == 2 and len(units) > 1:
        del units[at]
    elif not is_can:
        seal = seals.get(len(unit), lambda datagram: datagram)
        units[at] = (time_ns, changed_datagram(rng, unit, seal))
    else:
        units[at] = (time_ns, _changed_frame(rng, unit, identifiers))


def _changed_frame(rng: random.Random, unit: bytes, identifiers: list[bytes]) -> bytes:
    """Change usually a CAN frame's data, sometimes its identifier, length, flags or layout."""
    kind = rng.randrange(16)
    if kind == 0:
        return rng.choice(identifiers) + unit[4:]
    if kind == 1:
        return unit[:4] + bytes([rng.choice((*range(10), 15, 64, 255))]) + unit[5:]
    if kind == 2:
        return damage(rng, unit[:8], resize=False) + unit[8:]
    if kind == 3:
        return rng.choice(
            (
                unit[:8].ljust(16, b"\0"),
                unit.ljust(72, b"\0"),
                unit[: rng.randrange(20)],
                unit[:4] + b"\x40\4\0\0" + rng.randbytes(64),
            )
        )
    if kind == 4:
        return unit[:8] + rng.randbytes(len(unit[8:]))
    if kind == 5:  # a part of a message of several frames
        return unit[:8] + bytes([rng.randrange(256)]) + unit[9:]
    at = rng.randrange(8)
    return (unit[:8] + damage(rng, unit[8:16], resize=False) + unit[16:]) if at else unit[:8] + (bounds(rng) * 8)[:8]


def _feed_packets(parser: Parser, data: bytes) -> None:
    units = unpack(data)
    for batch in _batches(units, lambda: len(units)):
        parser.feed_batch(batch)


# --- a long life ----------------------------------------------------------------------------------------------------


def _endure(parser: Parser, cases: list[bytes], feed: Callable[[Parser, bytes], None]) -> None:
    """Feed all cases to one parser, and check that the second half does not make it grow."""
    half = len(cases) // 2
    tracemalloc.start()
    try:
        for case in cases[:half]:
            feed(parser, case)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for case in cases[half:]:
            feed(parser, case)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    if grown > GROWTH_BYTES:
        raise FindingError(f"{len(cases) - half} inputs left {grown} bytes in the parser")
