"""A short run of every target, the same each time; ``make fuzz`` is the long one.

The harness itself is held to what it promises: sealed frames are good ones, and a defect behind a checksum is found.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.drivers.framing import framer as framing
from swath.drivers.framing.framer import Framer
from swath.drivers.gnss.ubx.parser import UbxParser
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.georef.records import Chunk
from tests.fuzz.engine import Target, check, fuzz
from tests.fuzz.frames import KINDS, SEALS, FramePool, mutate_stream, split_frames
from tests.fuzz.mcap_parts import take_apart
from tests.fuzz.mutation import damage
from tests.fuzz.recordings import PAGES
from tests.fuzz.targets import all_targets

SEEDS = Path(__file__).parent / "seeds"
TARGETS = all_targets()
SHORT_S = 0.3
SHORT_EXECUTIONS = 12


@pytest.mark.parametrize("name", TARGETS)
def test_a_short_run_finds_nothing(name: str) -> None:
    target = TARGETS[name]()
    few = Target(name, target.seeds[:2], target.mutate, target.run, None, target.peak_bytes)
    report = fuzz(few, seconds=SHORT_S, executions=SHORT_EXECUTIONS)
    assert not report.crashes, "\n".join(text for _, text in report.crashes.values())
    assert report.seen


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(SEEDS.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_what_was_once_found_stays_mended(path: Path) -> None:
    check(TARGETS[path.parent.name](), path.read_bytes(), memory=True)


def test_every_driver_is_a_target() -> None:
    assert {page.stem for page in PAGES.glob("*.md")} <= {
        name.partition("-")[2].removesuffix("-time") for name in TARGETS if "-" in name
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_sealed_frame_is_a_good_frame(kind: str) -> None:
    """Whatever the content; a kind of frame without a seal would be fuzzed before its checksum only."""
    rng = random.Random(kind)
    for _ in range(300):
        content = rng.randbytes(rng.randrange(5, 400))
        frame = SEALS[kind](b"$GPGGA," + content.hex().upper().encode() + b"*" if kind == "nmea" else content)
        assert KINDS[kind].measure(frame, 0, True) == len(frame)
        assert KINDS[kind].intact(frame)
        assert split_frames(b"\0" + frame) == [("", b"\0"), (kind, frame)]


def test_a_log_taken_apart_is_put_together_again_as_it_was() -> None:
    """Records, chunks of every compression, footer: byte for byte where nothing was compressed."""
    for data in TARGETS["log"]().seeds:
        again = take_apart(data).encode()
        assert [piece.opcode for piece in take_apart(again).pieces] == [
            piece.opcode for piece in take_apart(data).pieces
        ]
        assert len(again) == len(data)


@pytest.mark.slow
def test_a_defect_behind_a_checksum_is_found() -> None:
    """A decoder that cannot stand one value of one field of one message."""

    def run(data: bytes) -> Iterator[str]:
        parser = UbxParser(DeviceSettings("gnss/fuzz"))
        records = [*parser.feed(Chunk("gnss/fuzz", 0, data)), *parser.close()]
        if any(getattr(record, "satellites", 0) == 0x7F for record in records):
            raise OverflowError("planted")
        return iter(parser.counters.messages)

    target = TARGETS["gnss-ubx"]()
    report = fuzz(Target("planted", target.seeds, target.mutate, run), seconds=60, executions=8000)
    assert any("planted" in text for _, text in report.crashes.values())
    plain = Target("planted", target.seeds, lambda rng, base: damage(rng, base), run)
    assert not fuzz(plain, seconds=60, executions=1000).crashes, "found without any seal: the test says nothing"


def test_a_warning_is_a_finding() -> None:
    def run(data: bytes) -> Iterator[str]:
        import numpy as np

        np.array([1e300]).astype(np.int32)
        return iter(())

    assert fuzz(Target("cast", [b"x"], lambda rng, base: base, run), seconds=5, executions=2).crashes


def test_names_from_noise_take_bounded_memory() -> None:
    """Every sentence has another address, all of them good."""
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
