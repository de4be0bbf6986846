"""Checks every parser on a real recording: cut anywhere, byte by byte, damaged, with the same result each time.

Units of streams (`check_stream`, `check_damage`) end anywhere, so the same bytes give the same records and counters
however they are cut. Units of packets (`check_packets`, `check_packet_damage`) are whole; only batches vary.

Records are compared in a canonical form: single events in their order, and rows of array records (`ImuSamples`, …) in
order by type, in any batches. NaN equals NaN; padding of aligned dtypes does not count.
"""

from __future__ import annotations

import bisect
import dataclasses
import io
import itertools
import pickle
import random
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swath.drivers.framing.framer import FrameKind
from swath.drivers.parser import Parser, ParserCounters
from swath.georef.arrays import StructArray
from swath.georef.records import Chunk, ChunkBatch, DeviceClockSamples, ImuSamples, InsSolution, Record, ScannerReturns

Factory = Callable[[], Parser]
SOURCE = "gnss/test"
STREAM_HOST_NS = 1_000_000_000  # the same for all reads, so that times cannot reveal the cuts
ARRAY_RECORDS = (ImuSamples, InsSolution, ScannerReturns, DeviceClockSamples)
COUNTER_FIELDS = dataclasses.fields(ParserCounters)

CUT_WINDOW_BYTES = 8 * 1024
BYTEWISE_BYTES = 64 * 1024
CUT_TAIL_BYTES = 1200  # fed after a cut; longer than nearly all messages, and the rest comes when the parser is closed
CUT_TAIL_MESSAGES = 3  # or so many messages, if their ends are known: the one cut and two more
CHECKPOINT_BYTES = 128
RANDOM_CUTS = 500


class Outcome(NamedTuple):
    """Output of a parser, comparable with ``==``."""

    events: list[Any]
    rows: dict[str, list[bytes]]
    counters: dict[str, Any]


class Message(NamedTuple):
    """Where a message lies in a recording and the name under which the parser counts it."""

    start: int
    end: int
    name: str


# --- canonical form -------------------------------------------------------------------------------------------------


PLAIN = frozenset({int, str, bytes, bool, type(None)})


def canonical(value: Any) -> Any:
    """Return a value that compares by content.

    Arrays compare by dtype, shape and bytes, dataclasses by fields, and NaN equals NaN.
    """
    kind: Any = type(value)
    if kind in PLAIN:
        return value
    if isinstance(value, float | np.floating):
        return float(value) if value == value else "nan"
    if fields := fields_of(kind):
        return (kind.__name__, *[(field, canonical(getattr(value, field))) for field in fields])
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, *packed_rows(value.reshape(-1)))
    if isinstance(value, dict):
        return tuple(sorted((str(key), canonical(item)) for key, item in value.items()))
    if isinstance(value, list | tuple):
        return tuple([canonical(item) for item in value])
    return value


@cache
def fields_of(kind: type) -> tuple[str, ...]:
    """Return the names of a dataclass's fields, none for another type."""
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else ()


def packed_rows(rows: StructArray) -> list[bytes]:
    """Return an array (n,), structured or plain, as one byte string per row, without padding."""
    if rows.dtype.names is None:
        return [row.tobytes() for row in rows]
    packed = np.empty(rows.shape, dtype=[(name, rows.dtype[name]) for name in rows.dtype.names])
    for name in rows.dtype.names:
        packed[name] = rows[name]
    return [row.tobytes() for row in packed]


def outcome(records: Iterable[Record], parser: Parser) -> Outcome:
    """Return records and counters in canonical form."""
    events: list[Any] = []
    rows: dict[str, list[bytes]] = {}
    for record in records:
        if isinstance(record, ARRAY_RECORDS):
            rows.setdefault(type(record).__name__, []).extend(packed_rows(record.rows))
        else:
            events.append(canonical(record))
    counters = {field.name: getattr(parser.counters, field.name) for field in COUNTER_FIELDS}
    counters["messages"] = +parser.counters.messages
    counters["errors"] = +parser.counters.errors
    return Outcome(events, rows, counters)


# --- streams --------------------------------------------------------------------------------------------------------


def feed_pieces(parser: Parser, pieces: Iterable[bytes], *, close: bool = True) -> list[Record]:
    """Feed the pieces as reads of one port; with ``close`` the tail is released too."""
    records: list[Record] = []
    for piece in pieces:
        records += parser.feed(Chunk(SOURCE, STREAM_HOST_NS, piece))
    return records + parser.close() if close else records


def run_stream(make: Factory, pieces: Iterable[bytes]) -> Outcome:
    """Return a new parser's outcome for the pieces, closed."""
    parser = make()
    return outcome(feed_pieces(parser, pieces), parser)


def assert_bytes_accounted(parser: Parser, fed: int) -> None:
    """Assert that each byte fed to a closed stream parser was in a good frame or was skipped."""
    counters = parser.counters
    assert counters.bytes == fed
    assert counters.bytes_framed + counters.bytes_skipped == fed, counters
    assert min(counters.bytes_framed, counters.bytes_skipped, counters.bad_checksums, counters.bad_messages) >= 0


def random_pieces(data: bytes, seed: int, largest: int = 4096) -> list[bytes]:
    """Return the data cut into reads of 1 to ``largest`` bytes, small ones as frequent as large ones."""
    rng = random.Random(seed)
    pieces, position = [], 0
    while position < len(data):
        size = max(1, int(largest ** rng.random()))
        pieces.append(data[position : position + size])
        position += size
    return pieces


def check_random_reads(make: Factory, data: bytes, seeds: Sequence[int] = (1, 2, 3)) -> None:
    """Check that random read sizes give the same records and counters as the whole."""
    whole = run_stream(make, [data])
    for seed in seeds:
        assert run_stream(make, random_pieces(data, seed)) == whole, f"differs when cut with seed {seed}"


def check_bytewise(make: Factory, data: bytes) -> None:
    """Check that single bytes give the same as the whole, over the first 64 KiB."""
    head = data[:BYTEWISE_BYTES]
    assert run_stream(make, (head[i : i + 1] for i in range(len(head)))) == run_stream(make, [head])


class Snapshot:
    """Repeatable snapshot of a parser, pickled because that takes a third of the time of `deepcopy`."""

    def __init__(self, parser: Parser) -> None:
        file = io.BytesIO()
        pickler = _Sharing(file)
        pickler.dump(parser)
        self._data, self._shared = file.getvalue(), pickler.shared

    def again(self) -> Parser:
        """Return a parser in that state."""
        unpickler = _Shared(io.BytesIO(self._data))
        unpickler.shared = self._shared
        parser: Parser = unpickler.load()
        return parser


class _Sharing(pickle.Pickler):
    """Pickler that shares constants which cannot be pickled."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.shared: list[object] = []

    def persistent_id(self, value: object) -> int | None:
        if not isinstance(value, FrameKind | FunctionType | re.Pattern):
            return None
        self.shared.append(value)
        return len(self.shared) - 1


class _Shared(pickle.Unpickler):
    shared: list[object]

    def persistent_load(self, place: int) -> object:
        return self.shared[place]


def check_cuts(make: Factory, data: bytes, positions: Iterable[int], ends: Sequence[int] = ()) -> None:
    """Check that cutting in two at each position gives the same records and counters.

    Parsers are copied at checkpoints, so that a cut costs only the bytes around it. ``ends`` has the ends of messages
    in order; after a cut, a few of them are enough.
    """
    base, taken = make(), 0
    for start, group in itertools.groupby(sorted(positions), lambda position: position - position % CHECKPOINT_BYTES):
        feed_pieces(base, [data[taken:start]], close=False)
        taken = start
        end = min(len(data), start + CHECKPOINT_BYTES + CUT_TAIL_BYTES)
        behind = ends[bisect.bisect_left(ends, start + CHECKPOINT_BYTES) :][:CUT_TAIL_MESSAGES]
        if len(behind) == CUT_TAIL_MESSAGES:
            end = min(end, behind[-1])
        snapshot = Snapshot(base)
        reference = snapshot.again()
        expected = outcome(feed_pieces(reference, [data[start:end]]), reference)
        for position in group:
            parser = snapshot.again()
            got = outcome(feed_pieces(parser, [data[start:position], data[position:end]]), parser)
            assert got == expected, f"differs when cut at byte {position}"


def check_every_cut(make: Factory, data: bytes, window: int = CUT_WINDOW_BYTES) -> None:
    """Cut in two at every position of the first ``window`` bytes."""
    ends = [message.end for message in find_messages(make, data[: window + CUT_TAIL_BYTES])]
    check_cuts(make, data, range(min(window, len(data)) + 1), ends)


def check_random_cuts(make: Factory, data: bytes, count: int = RANDOM_CUTS, seed: int = 7) -> None:
    """Cut in two at random positions of the whole recording."""
    rng = random.Random(seed)
    check_cuts(make, data, {rng.randrange(len(data) + 1) for _ in range(count)})


def check_stream(make: Factory, data: bytes) -> Outcome:
    """Check all ways of cutting, and return the outcome of the whole for the test's own expectations."""
    assert data, "an empty recording proves nothing"
    parser = make()
    whole = outcome(feed_pieces(parser, [data]), parser)
    assert_bytes_accounted(parser, len(data))
    assert sum(whole.counters["messages"].values()) > 0, "no message in this recording"
    check_random_reads(make, data)
    check_every_cut(make, data)
    check_random_cuts(make, data)
    check_bytewise(make, data)
    return whole


# --- damaged streams ------------------------------------------------------------------------------------------------


def find_messages(make: Factory, data: bytes) -> list[Message]:
    """Return the places of messages: fed byte by byte, a message ends where the parser counts it.

    Messages that appeared together (released behind a false sync) are left out, because their places are unknown.
    """
    parser = make()
    found: list[Message] = []
    for end in range(1, len(data) + 1):
        framed, before = parser.counters.bytes_framed, sum(parser.counters.messages.values())
        feed_pieces(parser, [data[end - 1 : end]], close=False)
        length = parser.counters.bytes_framed - framed
        if length and sum(parser.counters.messages.values()) - before == 1:
            alone = make()
            feed_pieces(alone, [data[end - length : end]])
            if sum(alone.counters.messages.values()) == 1:
                found.append(Message(end - length, end, next(iter(alone.counters.messages))))
    return found


class Damage(NamedTuple):
    """Damage at ``position``: one byte is changed (``flip`` ≠ 0), and ``garbage`` is inserted before it."""

    position: int
    flip: int
    garbage: bytes


def damage_strategy(size: int, starts: Sequence[bytes] = ()) -> st.SearchStrategy[list[Damage]]:
    """Return a strategy of up to eight damaged places, whose garbage often has bytes that begin frames.

    ``starts`` adds such beginnings.
    """
    syncs = st.sampled_from(
        [
            b"$",
            b"!",
            b"$$GP",
            b"\xb5b",
            b"\xb5b\x01\x07\xff\xff",
            b"\xd3",
            b"\xd3\x03\xff",
            b"\xaaD\x12\x1c",
            b"\xaaD\x13",
            *starts,
            b"$@",
            b"$@\x00\x00\xa7\x0f\x00\x08",
        ]
    )
    garbage = st.one_of(st.just(b""), syncs, st.binary(max_size=40))
    place = st.builds(Damage, st.integers(0, size - 1), st.integers(0, 255), garbage)
    return st.lists(place, min_size=1, max_size=8, unique_by=lambda damage: damage.position)


def damaged(data: bytes, damages: Sequence[Damage]) -> bytes:
    """Return the data with all damages done."""
    pieces, position = [], 0
    for damage in sorted(damages):
        pieces += [data[position : damage.position], damage.garbage, bytes([data[damage.position] ^ damage.flip])]
        position = damage.position + 1
    return b"".join([*pieces, data[position:]])


def untouched(messages: Sequence[Message], damages: Sequence[Damage]) -> Counter[str]:
    """Count names of messages without damage; garbage right before a message is outside of it."""
    names: Counter[str] = Counter()
    for message in messages:
        if not any(
            (damage.flip and message.start <= damage.position < message.end)
            or (damage.garbage and message.start < damage.position < message.end)
            for damage in damages
        ):
            names[message.name] += 1
    return names


def check_damage(
    make: Factory, data: bytes, *, examples: int = 60, window: int = 6 * 1024, starts: Sequence[bytes] = ()
) -> None:
    """Check a parser on flipped bytes and garbage between frames.

    It never raises, accounts for every byte, and finds each undamaged message.
    """
    head = data[:window]
    messages = find_messages(make, head)
    assert messages, "no message in this recording"

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(damages=damage_strategy(len(head), starts), seed=st.integers(0, 1000))
    def property_holds(damages: list[Damage], seed: int) -> None:
        broken = damaged(head, damages)
        parser = make()
        got = outcome(feed_pieces(parser, random_pieces(broken, seed)), parser)
        assert_bytes_accounted(parser, len(broken))
        missing = untouched(messages, damages) - parser.counters.messages
        assert not missing, f"undamaged messages not found: {missing}"
        assert got == run_stream(make, [broken])

    property_holds()


def check_garbage(make: Factory, *, examples: int = 60, starts: Sequence[bytes] = ()) -> None:
    """Check that a parser never raises and accounts for every byte of random ones, among them frame beginnings."""
    common = [b"$GPGGA,", b"\xb5b\x01\x07\x5c\x00", b"\xd3\x00\x13", b"\xaaD\x12\x1c", b"\xaaD\x13", b"*00\r\n"]
    common.append(b"$@\x00\x00\xa7\x0f\x60\x00")
    pieces = st.lists(st.one_of(st.binary(max_size=200), st.sampled_from([*common, *starts])), max_size=20)

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(pieces=pieces)
    def property_holds(pieces: list[bytes]) -> None:
        parser = make()
        feed_pieces(parser, pieces)
        assert_bytes_accounted(parser, sum(map(len, pieces)))

    property_holds()


# --- packets --------------------------------------------------------------------------------------------------------


def packet_batches(units: Sequence[bytes], largest: Callable[[], int]) -> list[ChunkBatch]:
    """Return consecutive units of equal length as batches of at most ``largest()`` rows; host time is 1 ms per unit."""
    batches: list[ChunkBatch] = []
    position = 0
    while position < len(units):
        limit, end = max(1, largest()), position + 1
        while end < len(units) and end - position < limit and len(units[end]) == len(units[position]):
            end += 1
        rows = np.frombuffer(b"".join(units[position:end]), dtype=np.uint8).reshape(end - position, -1)
        host = STREAM_HOST_NS + 1_000_000 * np.arange(position, end, dtype=np.int64)
        batches.append(ChunkBatch(SOURCE, host, rows))
        position = end
    return batches


def run_packets(make: Factory, units: Sequence[bytes], largest: Callable[[], int]) -> Outcome:
    """Return a new parser's outcome for the units in such batches, closed."""
    parser = make()
    records: list[Record] = []
    for batch in packet_batches(units, largest):
        records += parser.feed_batch(batch)
    return outcome(records + parser.close(), parser)


def run_together(make: Factory, units: Sequence[bytes], some: Callable[[], int]) -> Outcome:
    """Feed several of the batches, which have different lengths, at once; `some` draws how many."""
    parser = make()
    records: list[Record] = []
    batches = iter(packet_batches(units, some))
    while held := list(itertools.islice(batches, max(1, some()))):
        records += parser.feed_batches(held)
    return outcome(records + parser.close(), parser)


def few_or_many(rng: random.Random) -> int:
    """Return a size of 1 to 99, small ones as likely as large."""
    return int(100 ** rng.random())


def check_packets(make: Factory, units: Sequence[bytes], seeds: Sequence[int] = (1, 2, 3)) -> Outcome:
    """Check that the largest batches, `feed` one by one, random batches and several at once give the same."""
    assert units, "an empty recording proves nothing"
    whole = run_packets(make, units, lambda: len(units))
    assert whole.counters["bytes"] == sum(map(len, units))
    assert sum(whole.counters["messages"].values()) > 0, "no message in this recording"
    parser = make()
    single: list[Record] = []
    for index, unit in enumerate(units):
        single += parser.feed(Chunk(SOURCE, STREAM_HOST_NS + 1_000_000 * index, unit))
    assert outcome(single + parser.close(), parser) == whole, "differs when fed one by one"
    for seed in seeds:
        rng = random.Random(seed)
        got = run_packets(make, units, partial(few_or_many, rng))
        assert got == whole, f"differs in batches of seed {seed}"
        got = run_together(make, units, partial(few_or_many, rng))
        assert got == whole, f"differs in several batches at once, of seed {seed}"
    return whole


def check_packet_damage(make: Factory, units: Sequence[bytes], *, examples: int = 60) -> None:
    """Check that units cut short, extended or flipped never raise, in any batches, and every byte is counted."""
    few, fresh = list(units[:40]), Snapshot(make()).again  # a new parser may need to read a DBC file

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(
        changes=st.lists(
            st.tuples(st.integers(0, len(few) - 1), st.integers(0, 2000), st.integers(0, 255), st.binary(max_size=4)),
            min_size=1,
            max_size=10,
        ),
        seed=st.integers(0, 1000),
        kind=st.sampled_from(["flip", "cut", "longer"]),
    )
    def property_holds(changes: list[tuple[int, int, int, bytes]], seed: int, kind: str) -> None:
        broken = list(few)
        for index, position, flip, extra in changes:
            unit = bytearray(broken[index])
            if kind == "flip" and unit:
                unit[position % len(unit)] ^= flip
            broken[index] = (
                bytes(unit[:position]) if kind == "cut" else bytes(unit) + (extra if kind == "longer" else b"")
            )
        rng = random.Random(seed)
        got = run_packets(fresh, broken, lambda: int(100 ** rng.random()))
        assert got.counters["bytes"] == sum(map(len, broken))
        assert got == run_packets(fresh, broken, lambda: 1)
        assert got == run_together(fresh, broken, lambda: int(100 ** rng.random()))

    property_holds()
