"""Targets for the log's readers: a foreign file is read, counted, replayed and recovered, or refused in a line."""

from __future__ import annotations

import io
import json
import random
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer
from rich.console import Console

from swath.daemon.cli.info import _print_session
from swath.daemon.log.format import ChannelSpec, LogError, SessionInfo
from swath.daemon.log.mcap.encode import encode_block, encode_json
from swath.daemon.log.mcap.scan import Damage, scan
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import recover
from swath.daemon.log.statistics import session_statistics
from swath.daemon.replay.units import timed_units
from swath.drivers.can_frames import encode_can_frame
from tests.drivers.recordings import FIXTURES
from tests.drivers.srep_cases import scan_lines
from tests.fuzz import mcap_parts as mcap
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.mcap_parts import Piece, take_apart
from tests.fuzz.mutation import bounds, damage

START_NS = 1_800_000_000_000_000_000
INFO = SessionInfo("fuzz-20261121T100000Z-ab12", "swath test", "host", "boot", START_NS, 1000)
TIMES_NS = (0, 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1, 7_258_118_400_000_000_000, START_NS, START_NS + 10**12)
TEXTS = (
    *(
        b"",
        b"/",
        b"/raw",
        b"//raw",
        b"/gnss/rover/raw",
        b"/scanner/left/raw",
        b"/scanner/left/aux/raw",
        b"/imu/main/raw",
    ),
    *(b"/pps/main", b"/pps/", b"/status/gnss/rover", b"/status/", b"/events", b"/clock", b"json", b"x-swath-can"),
    *(b"../../../tmp/evil", b"/etc/passwd", b"..", b"\\\\host\\x", b"a\0b", b"\xff\xfe", b"\x1b[31m[bold]", b"9" * 40),
    *(b"swath.session", b"swath.Pps", b"config.toml", b"dbc/imu.dbc", b"geometry/left.json", "\u2028".encode(), b"-1"),
)
VALUES: tuple[Any, ...] = (None, True, -1, 1 << 70, 1.5e308, "", "NaN", [], {}, [1], "x" * 300, 0)
BATCHES = 4000  # read of one input; a log has no bound, a test has


def log_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Return the only target of logs."""
    yield "log", lambda: Target("log", log_seeds(), mutate_log, run, None, lambda size: (48 << 20) + 200 * size)


# --- seeds ----------------------------------------------------------------------------------------------------------


def log_seeds() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        made = []
        for number, (compression, finish) in enumerate(
            (("auto", True), ("none", True), ("zstd", True), ("lz4", False), ("none", False))
        ):
            path = Path(folder, f"{number}.mcap")
            _write(path, compression, finish=finish)
            made.append(path.read_bytes())
        return [*made, _of_another_writer(CompressionType.LZ4), _of_another_writer(CompressionType.NONE)]


def _write(path: Path, compression: str, *, finish: bool) -> None:
    writer = PartWriter(path, INFO, 0, compression=compression)
    config = (FIXTURES / "config/aircraft.toml").read_bytes()
    writer.add_attachment("config.toml", "application/toml", config, START_NS)
    writer.add_attachment("dbc/imu.dbc", "text/plain", (FIXTURES / "config/imu.dbc").read_bytes(), START_NS)
    raw = {1: "/gnss/rover/raw", 2: "/imu/main/raw", 3: "/scanner/left/raw"}
    for number, topic in raw.items():
        writer.add_channel(
            number, ChannelSpec(topic, "x-swath-udp", {"protocol": "x"}, None, "scanner" if number == 3 else "other")
        )
    json_topics = {
        4: ("/pps/main", "Pps"),
        5: ("/clock", "Clock"),
        6: ("/status/gnss/rover", "Status"),
        7: ("/events", "Event"),
    }
    for number, (topic, name) in json_topics.items():
        writer.add_channel(number, ChannelSpec(topic, "json", {}, f"swath.{name}"))
    read = (FIXTURES / "novatel/time.gps").read_bytes()
    units = [(1, read), (2, encode_can_frame(0x101, bytes(6))), (3, scan_lines(2, 8)[0])]
    for turn in range(3):
        for number, unit in units:
            rows = np.frombuffer(unit * 2, np.uint8).reshape(2, -1)
            times = START_NS + turn * 300_000_000 + np.array([0, 1000], dtype=np.int64)
            writer.add(encode_block(number, 2 * turn, times, rows))
        for number in json_topics:
            writer.add(encode_json(number, turn, START_NS + turn * 300_000_000, _json_value(turn)))
        writer.flush()
    if finish:
        writer.finish()
    writer.close()


def _json_value(turn: int) -> dict[str, Any]:
    return {
        **dict.fromkeys(("units", "written"), 2 * turn),
        **dict.fromkeys(("bytes", "lost_kernel", "lost_queue", "lost_write"), 0),
        **{
            "edge_time_ns": START_NS,
            "sequence": turn,
            "time_state": "LOCKED",
            "time_sigma_ns": 50.0,
            "state": "receiving",
        },
        **{"time_ns": START_NS, "severity": "warning", "source": "x", "code": "tick", "text": "words"},
    }


def _of_another_writer(compression: CompressionType) -> bytes:
    """Return a log of another writer, where channels appear once, with a foreign schema and JSON."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=600, compression=compression)
    writer.start(profile="swath", library="other")
    writer.add_metadata("swath.session", INFO.to_metadata(0))
    schema = writer.register_schema("stranger.Thing", "jsonschema", b"{}")
    raw = writer.register_channel("/gnss/rover/raw", "x-swath-serial", 0)
    own = writer.register_channel("/stranger/things", "json", schema)
    for number in range(30):
        writer.add_message(raw, START_NS + number, b"$GPZDA,%d" % number, START_NS + number)
        writer.add_message(own, START_NS + number, b"{}", START_NS + number)
    writer.finish()
    return file.getvalue()


# --- mutations ------------------------------------------------------------------------------------------------------


def mutate_log(rng: random.Random, base: bytes) -> bytes:
    """Change, move, double or remove records, usually with right lengths and checksums."""
    if rng.random() < 0.15:
        return damage(rng, base, start=8)
    parts = take_apart(base)
    for _ in range(1 + int(5 * rng.random() ** 2)):
        if not parts.pieces:
            break
        _change_pieces(rng, parts.pieces)
    data = parts.encode()
    if rng.random() < 0.1:
        data = damage(rng, data, start=8)
    return data[: 64 * 1024] if rng.random() < 0.9 else data[: rng.randrange(8, len(data) + 1)]


def _change_pieces(rng: random.Random, pieces: list[Piece]) -> None:
    at = rng.randrange(len(pieces))
    piece = pieces[at]
    kind = rng.randrange(12)
    if kind == 0:
        pieces.insert(rng.randrange(len(pieces) + 1), piece)
    elif kind == 1 and len(pieces) > 1:
        del pieces[at]
    elif kind == 2:
        piece.opcode = rng.choice((*range(1, 17), 0x80, 0x93, 255)) if piece.inner is None else piece.opcode
    elif kind == 3:
        pieces.insert(at, _new_piece(rng))
    elif piece.inner is not None:
        if kind == 4:
            piece.body = rng.choice((b"", b"lz4", b"zstd", b"bz2", b"x" * 33))
        elif kind == 5:
            piece.claimed = rng.choice((0, 1, 1 << 28, 1 << 40, (1 << 64) - 1))
        elif piece.inner:
            _change_pieces(rng, piece.inner)
    else:
        piece.body = _changed_body(rng, piece)


def _new_piece(rng: random.Random) -> Piece:
    number = rng.choice((0, 1, 2, 7, 9, 65535))
    kind = rng.randrange(6)
    if kind == 0:
        return Piece(mcap.CHANNEL, mcap.channel(number, rng.choice(TEXTS), schema=rng.choice((0, 1, 9))))
    if kind == 1:
        return Piece(mcap.SCHEMA, mcap.schema(rng.choice((0, 1, 9)), "stranger.Thing"))
    if kind == 2:
        return Piece(mcap.ATTACHMENT, mcap.attachment(rng.choice(TEXTS), rng.randbytes(9)))
    if kind == 3:
        info = {
            **INFO.to_metadata(0),
            rng.choice(("part", "realtime_ns", "session_id")): rng.choice(("-1", "9" * 30, "x")),
        }
        return Piece(mcap.METADATA, mcap.metadata("swath.session", info))
    if kind == 4:
        value = {**_json_value(1), rng.choice(list(_json_value(1))): rng.choice(VALUES)}
        return Piece(
            mcap.MESSAGE, mcap.message(rng.choice((4, 6, 7)), rng.choice(TIMES_NS), json.dumps(value).encode())
        )
    return Piece(mcap.MESSAGE, mcap.message(number, rng.choice(TIMES_NS), rng.randbytes(rng.randrange(40))))


def _changed_body(rng: random.Random, piece: Piece) -> bytes:
    body = piece.body
    if piece.opcode == mcap.MESSAGE and len(body) >= 22:
        kind = rng.randrange(4)
        if kind == 0:
            return body[:6] + struct.pack("<Q", rng.choice(TIMES_NS)) + body[14:]
        if kind == 1:
            return struct.pack("<H", rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 999))) + body[2:]
        return body[:22] + damage(rng, body[22:])
    if piece.opcode in (mcap.CHANNEL, mcap.SCHEMA, mcap.ATTACHMENT, mcap.METADATA, mcap.HEADER) and rng.random() < 0.6:
        return _another_text(rng, body)
    return damage(rng, body)


def _another_text(rng: random.Random, body: bytes) -> bytes:
    """Replace one of the strings, which is found by its length field."""
    places = []
    for at in range(len(body) - 4):
        length = int.from_bytes(body[at : at + 4], "little")
        if 0 < length <= min(200, len(body) - at - 4):
            places.append((at, length))
    if not places:
        return damage(rng, body)
    at, length = rng.choice(places)
    new = rng.choice(TEXTS) if rng.random() < 0.7 else bounds(rng)
    if rng.random() < 0.3:
        new = (new * (1 + length))[:length]
    return body[:at] + mcap.text(new) + body[at + 4 + length :]


# --- what is done with a log ----------------------------------------------------------------------------------------


def run(data: bytes) -> Iterator[str]:
    """Read, count, replay and recover; only `LogError` may come out, and only one copy may be written."""
    seen: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        inside, out = Path(folder, "in"), Path(folder, "in/out")
        out.mkdir(parents=True)
        path = inside / "log.mcap"
        path.write_bytes(data)
        _scan(data, seen)
        _read(path, seen)
        _recover(path, out, seen)
        written = {str(found.relative_to(folder)) for found in Path(folder).rglob("*")}
        if extra := written - {"in", "in/log.mcap", "in/out", "in/out/log.recovered.mcap"}:
            raise FindingError(f"written: {extra}")
    return iter(seen)


def _scan(data: bytes, seen: set[str]) -> None:
    """Check that records and damage are adjacent, from the magic to the end of the data."""
    at = 8
    try:
        for found in scan(io.BytesIO(data), len(data)):
            if found.offset != at:
                raise FindingError(f"{found} begins at {found.offset}, the one before ended at {at}")
            at += found.length
            seen.add(f"damage {found.what[:25]}" if isinstance(found, Damage) else f"record {found.opcode}")
    except LogError as error:
        seen.add(f"no log {str(error)[:12]}")
    if at > len(data):
        raise FindingError(f"{at} bytes read of {len(data)}")


def _read(path: Path, seen: set[str]) -> None:
    try:
        for session in open_logs([path]):
            for batch in islice(session.batches_by_time(), BATCHES):
                assert len(batch.log_time_ns) == len(batch.units) > 0
            for unit in islice(timed_units(session, with_pps=True), BATCHES):
                seen.add(f"unit {unit.source[:12]}")
            numbers = session_statistics(session)
            json.dumps(numbers)
            _print_session(Console(file=io.StringIO(), width=100), numbers)
            seen.update(f"told {numbers['damage'] != []} {note[:30]}" for note in numbers["notes"] or [""])
    except LogError as error:
        seen.add(f"refused {str(error)[-30:]}")


def _recover(path: Path, out: Path, seen: set[str]) -> None:
    try:
        report = recover(path, out)
    except LogError as error:
        seen.add(f"not recovered {str(error)[-30:]}")
        return
    seen.add(f"recovered {report.recovered is not None} {len(report.messages)}")
    if report.recovered is None:
        return
    again = recover(report.recovered, out)
    if not again.whole or again.messages != report.messages:
        raise FindingError(
            f"the copy is not whole, or holds {again.messages} instead of {report.messages}: {again.damage}"
        )
    with report.recovered.open("rb") as file:
        _same(make_reader(file, validate_crcs=True).iter_messages(), report.messages)
    with report.recovered.open("rb") as file:
        _same(NonSeekingReader(file, validate_crcs=True).iter_messages(), report.messages)


def _same(messages: Any, expected: Counter[str]) -> None:
    """Check that the official reader finds in a copy the messages that were reported as saved."""
    counts = Counter(channel.topic for _, channel, _ in messages)
    if counts != expected:
        raise FindingError(f"another reader finds {counts} instead of {expected}")
