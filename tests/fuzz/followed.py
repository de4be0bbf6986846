"""Targets for a growing log: the sign that names the file, its followers, and the index of a finished log."""

from __future__ import annotations

import contextlib
import io
import json
import random
import tempfile
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

from rich.console import Console

from swath.daemon.cli.monitor import page
from swath.daemon.exchange.offload import is_growing
from swath.daemon.log.chunk_index import Listening, index_log, read_chunks
from swath.daemon.log.follow import LogFollower
from swath.daemon.log.format import LogError
from swath.daemon.log.parts import RECORDING_SIGN, read_sign
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.live.follow import LiveFollower
from tests.daemon.monitor.builders import Looking
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.logs import BATCHES, INFO, VALUES, log_seeds, mutate_log
from tests.fuzz.mcap_parts import MESSAGE, take_apart
from tests.fuzz.texts import NUMBERS, OF_JSON, changed_text

NAME = f"{INFO.session_id}_{{}}.mcap"
SIGN = {"session_id": INFO.session_id, "part": 0, "path": NAME.format(0), "pid": 1, "boot_id": INFO.boot_id}
OF_PATHS = (
    '"../x.mcap"',
    '"a\\u0000b"',
    '"\\ud800"',
    '"/etc/passwd"',
    '"."',
    '"../../../tmp/x"',
    '"x' + "y" * 300 + '"',
)


def followed_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets with a changed sign and good logs, and with a changed log and a good sign."""
    yield "recording-sign", _signs
    yield "log-followed", _followed


def _signs() -> Target:
    logs = log_seeds()
    seeds = [json.dumps(SIGN | {"part": number, "path": NAME.format(number)}).encode() + b"\n" for number in (0, 1)]

    def run(data: bytes) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as name:
            folder = Path(name, "logs")
            folder.mkdir()
            for number in (0, 1):
                Path(folder, NAME.format(number)).write_bytes(logs[number])
            Path(folder, RECORDING_SIGN).write_bytes(data)
            return iter({*_sign(folder), *_monitored(folder), *_live(folder), *_polled(folder)})

    words = (*NUMBERS, *OF_JSON, *OF_PATHS)
    return Target("recording-sign", seeds, lambda rng, base: changed_text(rng, base, words), run, None, _peak)


def _peak(size: int) -> int:
    return (48 << 20) + 200 * size


def _sign(folder: Path) -> Iterator[str]:
    sign = read_sign(folder)
    if sign is None:
        yield "no sign"
        return
    if sign.path.parent != folder or not sign.path.name.endswith(".mcap") or "/" in sign.session_id:
        raise FindingError(f"leads out of the folder, or to no log: {sign}")
    yield f"{is_growing(sign.path)} {sign.path.exists()} {sign.part.bit_length()}"


def _polled(folder: Path) -> Iterator[str]:
    follower = LogFollower(folder, 5.0)
    for _ in range(2):
        for batch in islice(follower.poll(), BATCHES):
            yield f"followed {batch.channel.topic[:20]}"
    follower.close()


def _monitored(folder: Path) -> Iterator[str]:
    """Run `swath monitor` in both forms."""
    monitor = Looking(folder)
    monitor.poll()
    found = monitor.snapshot()
    monitor.close()
    json.dumps(found)
    Console(file=io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), width=100).print(page(found))
    yield f"{found['verdict']}, {len(found['sources'])} sources, {len(found['troubles'])} troubles"
    yield from (f"{values['state']!s:.9} {values['age_s'] is None}" for values in found["sources"].values())


def _live(folder: Path) -> Iterator[str]:
    """Yield the types of what `swath live` receives for georeferencing."""
    for from_start in (False, True):
        follower = LiveFollower(folder, from_start=from_start)
        for item in islice(follower.poll(), BATCHES):
            yield f"live {type(item).__name__}"
        yield follower.ended
        follower.close()


def _followed() -> Target:
    def run(data: bytes) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as name:
            folder = Path(name)
            path = folder / NAME.format(0)
            path.write_bytes(data)
            Path(folder, RECORDING_SIGN).write_text(json.dumps(SIGN))
            return iter({*_monitored(folder), *_live(folder), *_indexed(path)})

    def mutate(rng: random.Random, base: bytes) -> bytes:
        return _said_otherwise(rng, base) if rng.random() < 0.5 else mutate_log(rng, base)

    return Target("log-followed", log_seeds(), mutate, run, None, _peak)


def _said_otherwise(rng: random.Random, base: bytes) -> bytes:
    """Replace or remove values of statuses, events, edges and clocks."""
    parts = take_apart(base)
    pieces = [inner for piece in parts.pieces for inner in (piece.inner or [piece])]
    messages = [piece for piece in pieces if piece.opcode == MESSAGE and piece.body[22:23] == b"{"]
    for piece in rng.sample(messages, min(len(messages), rng.randrange(1, 6))):
        with contextlib.suppress(ValueError):
            value = json.loads(piece.body[22:])
            key = rng.choice([*value, "last_unit_age_s"])
            value[key] = rng.choice((*VALUES, 1e308, "silent", float("nan"), float("inf"), "9" * 30))
            if rng.random() < 0.2:
                del value[key]
            piece.body = piece.body[:22] + json.dumps(value).encode()
    return parts.encode()


def _indexed(path: Path) -> Iterator[str]:
    """Yield the chunks of a log as jobs read them, each its own piece."""
    try:
        for session in open_logs([path]):
            index = index_log(session)
            damage = list(index.damage)
            for batch in islice(read_chunks(index, index.chunks, None, damage), BATCHES):
                assert len(batch.log_time_ns) == len(batch.units) > 0
                yield f"indexed {batch.channel.topic[:20]}"
            index.spans()
            listening = Listening(session)
            for _ in islice(listening.batches(), BATCHES):
                pass
            yield f"{len(index.chunks)} chunks, {len(damage)} places, {len(listening.lost())} lost"
    except LogError as error:
        yield f"refused {str(error)[-30:]}"
