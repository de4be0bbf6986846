"""Runs every target for a short time, the same each time; ``make fuzz`` is the long run.

The harness is tested too: sealed frames are valid, and planted defects are found.
"""

from __future__ import annotations

import csv
import datetime as dt
import random
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from swath.drivers.driver import RAW
from swath.drivers.framing import framer as framing
from swath.drivers.framing.framer import Framer
from swath.drivers.gnss.ubx.parser import UbxParser
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.drivers.scanner.hesai.models import QT128
from swath.drivers.scanner.hesai.parser import HesaiParser, encode_point_packet
from swath.georef.records import Chunk
from tests.fuzz.engine import Target, check, fuzz
from tests.fuzz.frames import KINDS, SEALS, FramePool, mutate_stream, split_frames, tail_of
from tests.fuzz.mcap_parts import MESSAGE, take_apart
from tests.fuzz.mutation import damage
from tests.fuzz.parsers import unpack
from tests.fuzz.recordings import PAGES
from tests.fuzz.targets import all_targets

SEEDS = Path(__file__).parent / "seeds"
TARGETS = all_targets()
SHORT_PATHS = 4


@pytest.mark.parametrize("name", TARGETS)
def test_a_short_run_finds_nothing(name: str) -> None:
    target = TARGETS[name]()
    assert all(check(target, data) for data in target.seeds[:2])
    report = fuzz(target, SHORT_PATHS)
    assert not report.findings, "\n".join(_traceback(error) for _, error in report.findings.values())
    assert report.executions >= SHORT_PATHS


def _traceback(error: Exception) -> str:
    return "".join(traceback.format_exception(error))


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(SEEDS.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_earlier_findings_stay_fixed(path: Path) -> None:
    check(TARGETS[path.parent.name](), path.read_bytes(), memory=True)


def test_every_driver_is_a_target() -> None:
    pages = {page.stem for page in PAGES.glob("*.md")} - {RAW}  # nothing reads such a device
    assert pages <= {name.partition("-")[2].removesuffix("-time") for name in TARGETS if "-" in name}


@pytest.mark.parametrize("kind", KINDS)
def test_a_sealed_frame_is_valid(kind: str) -> None:
    """It is valid whatever its content; a kind without a seal would be fuzzed only up to its checksum."""
    rng = random.Random(kind)
    for _ in range(300):
        content = rng.randbytes(rng.randrange(5, 400))
        frame = SEALS[kind](b"$GPGGA," + content.hex().upper().encode() + b"*" if kind == "nmea" else content)
        assert KINDS[kind].measure(frame, 0, True) == len(frame)
        assert KINDS[kind].intact(frame)
        assert split_frames(b"\0" + frame) == [("", b"\0"), (kind, frame)]


def test_a_changed_datagram_of_a_hesai_head_is_sealed_again() -> None:
    """Its two CRCs are inside it, where a seal at the end would not reach."""
    good = encode_point_packet(dt.datetime(2026, 4, 15, tzinfo=dt.UTC), 0, 5_000, 7, head=QT128)
    changed = good[:100] + b"\x07" + good[101:1070] + b"\x09" + good[1071:]
    parsers = [HesaiParser(DeviceSettings("scanner/left"), QT128) for _ in range(2)]
    for parser, unit in zip(parsers, (changed, tail_of([good])(changed)), strict=True):
        parser.feed(Chunk("scanner/left", 0, unit))
    assert [parser.counters.bad_checksums for parser in parsers] == [1, 0]


def test_a_log_taken_apart_is_reassembled_unchanged() -> None:
    """Records, chunks of every compression and footer are equal byte for byte where nothing was compressed."""
    for data in TARGETS["log"]().seeds:
        again = take_apart(data).encode()
        assert [piece.opcode for piece in take_apart(again).pieces] == [
            piece.opcode for piece in take_apart(data).pieces
        ]
        assert len(again) == len(data)


def _planted(name: str, is_reached: Callable[[bytes], bool]) -> Target:
    """Return a target that cannot stand what is reached, and reads nothing else."""
    target = TARGETS[name]()

    def run(data: bytes) -> Iterator[str]:
        if is_reached(data):
            raise OverflowError("planted")
        return iter(())

    return Target("planted", target.seeds, target.mutate, run)


def _has_127_satellites(data: bytes) -> bool:
    """Return True if a message, behind its checksum, has the value 127 in its number of satellites."""
    parser = UbxParser(DeviceSettings("gnss/fuzz"))
    records = [*parser.feed(Chunk("gnss/fuzz", 0, data)), *parser.close()]
    return any(getattr(record, "satellites", 0) == 0x7F for record in records)


def _has_frame_of_ones(data: bytes) -> bool:
    return any(unit[8:] == b"\xff" * 8 for _, unit in unpack(data))


def _has_tiny_sigma(data: bytes) -> bool:
    rows = csv.reader(data.decode(errors="replace").splitlines())
    return any(len(row) == 5 and row[4] == "1e-320" for row in rows)


def _has_edge_without_time(data: bytes) -> bool:
    """Return True if a JSON message inside a compressed chunk has an edge without time."""
    pieces = [inner for piece in take_apart(data).pieces for inner in piece.inner or [piece]]
    return any(piece.opcode == MESSAGE and b'"edge_time_ns": null' in piece.body for piece in pieces)


@pytest.mark.parametrize(
    ("name", "is_reached", "paths"),
    [
        ("imu-dbc", _has_frame_of_ones, 200),
        ("control-points", _has_tiny_sigma, 1000),
        pytest.param("log-followed", _has_edge_without_time, 2000, marks=pytest.mark.slow),
        pytest.param("gnss-ubx", _has_127_satellites, 4000, marks=pytest.mark.slow),
    ],
)
def test_a_planted_defect_is_found(name: str, is_reached: Callable[[bytes], bool], paths: int) -> None:
    target = _planted(name, is_reached)
    assert not any(is_reached(data) for data in target.seeds)
    (finding,) = fuzz(target, paths).findings.values()
    assert is_reached(finding[0])


@pytest.mark.slow
def test_a_defect_behind_a_checksum_needs_seals() -> None:
    target = _planted("gnss-ubx", _has_127_satellites)
    plain = Target("planted", target.seeds, lambda rng, base: damage(rng, base), target.run)
    assert not fuzz(plain, 200).findings


def test_a_warning_is_a_finding() -> None:
    def run(data: bytes) -> Iterator[str]:
        np.array([1e300]).astype(np.int32)
        return iter(())

    assert fuzz(Target("cast", [b"x"], lambda rng, base: base, run), 2).findings


def test_an_input_that_takes_much_memory_is_a_finding() -> None:
    def run(data: bytes) -> Iterator[str]:
        bytearray(len(data) << 24)
        return iter(())

    target = Target("large", [b"x"], lambda rng, base: base, run)
    (finding,) = fuzz(target, 500).findings.values()
    assert "bytes of memory" in str(finding[1])


def test_a_finding_is_minimised() -> None:
    def run(data: bytes) -> Iterator[str]:
        assert len(data) < 4
        return iter(())

    def mutate(rng: random.Random, base: bytes) -> bytes:
        return base + rng.randbytes(rng.randrange(1, 4))

    (finding,) = fuzz(Target("long", [b"", b"x"], mutate, run), 100).findings.values()
    assert len(finding[0]) == 4


def test_names_from_noise_take_bounded_memory() -> None:
    """Every sentence has another address and a good checksum."""
    counters = ParserCounters()
    framer = Framer((KINDS["nmea"],), counters)
    for number in range(5000):
        framer.feed(SEALS["nmea"](b"$GPX%05d,1*" % number), 0)
    assert len(counters.messages) == framing.MAX_NAMES + 1
    assert counters.messages.total() == 5000
    assert counters.messages[framing.OTHER_NAMES] == 5000 - framing.MAX_NAMES


def test_mutations_follow_from_the_seed() -> None:
    pool = FramePool([b"$GPGGA,1*00\r\n"])
    one, other = (mutate_stream(random.Random(5), b"$GPZDA,,,,,,*48\r\n" * 3, pool) for _ in range(2))
    assert one == other
