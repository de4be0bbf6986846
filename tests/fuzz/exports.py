"""Targets for exported logs: the manifest, sidecars, edges, time tags, checksums."""

from __future__ import annotations

import gzip
import json
import random
import tempfile
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from unittest.mock import patch

import numpy as np

from swath.daemon.config import load_config
from swath.daemon.exchange.capture_files import ImportOptions, find_captures
from swath.daemon.exchange.export import MANIFEST, export_session
from swath.daemon.exchange.import_ import merge
from swath.daemon.exchange.offload import NAME, ChecksumList
from swath.daemon.exchange.routes import Routes
from swath.daemon.exchange.sidecar import SUFFIX
from swath.daemon.log.format import ChannelSpec, LogError
from swath.daemon.log.mcap.encode import encode_block, encode_json
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.reader import open_logs
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.transports.base import TransportError
from tests.drivers.recordings import FIXTURES
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.logs import INFO, START_NS, log_seeds, mutate_log
from tests.fuzz.mutation import damage
from tests.fuzz.texts import NUMBERS, OF_CSV, OF_JSON, changed_text, told

UNITS = 5000  # of one input
EDGES, TAGGED = "pps-main.txt", "gnss-rover.gps"
OF_FILES = ('"../x"', '"/etc/passwd"', '"a\\u0000b"', '"."', '"pcap"', '"serial"', '"candump"', '"pps"', '"gnss/rover"')
Place = tuple[str, tuple[str, ...]]


def export_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets of a log's export, of each file of an import, and of an offload's list."""
    yield "export", _exports
    manifest: Place = (MANIFEST, (*NUMBERS, *OF_JSON, *OF_FILES))
    yield "export-manifest", partial(_imports, "export-manifest", manifest)
    yield "export-sidecar", partial(_imports, "export-sidecar", (EDGES + SUFFIX, (*NUMBERS, *OF_CSV)))
    yield "export-edges", partial(_imports, "export-edges", (EDGES, NUMBERS))
    yield "export-tags", partial(_imports, "export-tags", (TAGGED + ".tag", ()))
    yield "checksums", _checksums


# --- a folder of an export ------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _exported() -> dict[str, bytes]:
    """Return the exported files of a log with every kind of source."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log.mcap")
        _write(path)
        (session,) = open_logs([path])
        made = export_session(session, Path(folder, "out")).folder
        return {one.name: one.read_bytes() for one in made.iterdir() if one.is_file()}


def _write(path: Path) -> None:
    kinds = (
        ("/gnss/rover/raw", "serial", b"$GPZDA,1*00\r\n", {"protocol": "novatel"}),
        ("/imu/main/raw", "can", encode_can_frame(0x101, bytes(6)), {"transport": "can:socketcan:can0"}),
        ("/scanner/left/raw", "udp", bytes(60), {"port": "2368", "source_address": "10.0.0.9", "source_port": "9"}),
    )
    writer = PartWriter(path, INFO, 0)
    for number, (topic, kind, _, said) in enumerate(kinds, start=1):
        writer.add_channel(number, ChannelSpec(topic, f"x-swath-{kind}", said))
    writer.add_channel(4, ChannelSpec("/pps/main", "json", {}, "swath.Pps"))
    for turn in range(6):
        time_ns = START_NS + 300_000_123 * turn
        for number, (_, _, unit, _) in enumerate(kinds, start=1):
            writer.add(encode_block(number, turn, np.array([time_ns]), np.frombuffer(unit, np.uint8)[np.newaxis, :]))
        writer.add(encode_json(4, turn, time_ns, {"edge_time_ns": time_ns, "sequence": turn}))
    writer.finish()
    writer.close()


def _imports(target: str, place: Place) -> Target:
    """Return the target that changes one file of an export.

    A sidecar is changed before it is packed, because gzip's checksum would hide the change.
    """
    name, words = place
    packed = name.endswith(SUFFIX)
    seed = gzip.decompress(_exported()[name]) if packed else _exported()[name]

    def run(data: bytes) -> Iterator[str]:
        files = _exported() | {name: gzip.compress(data, 1, mtime=0) if packed else data}
        if target == "export-tags":  # the sidecar would replace the tags
            files.pop(TAGGED + SUFFIX, None)
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            for one, content in files.items():
                path = Path(folder, one)
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(content)
            return iter(told(lambda: _imported(Path(folder)), TransportError, begins=folder))

    def mutate(rng: random.Random, base: bytes) -> bytes:
        return changed_text(rng, base, words) if words else damage(rng, base, start=rng.choice((0, 60)))

    # a read may be as long as a unit
    return Target(target, [seed], mutate, run, None, lambda size: (48 << 20) + 400 * size)


def _imported(folder: Path) -> Iterator[str]:
    """Yield what `swath import` reads before it writes."""
    routes = _routes()
    captures = find_captures(routes, [folder], ImportOptions(start_ns={"": 0}))
    for unit in islice(merge(captures, routes), UNITS):
        yield f"{unit.port.source} {len(unit.data).bit_length()}"
    for capture in captures:
        json.dumps(capture.plain())
        if "\n" in capture.tally.first_damage:
            raise FindingError(f"more than a line: {capture.tally.first_damage!r}")
        yield capture.tally.first_damage.removeprefix(str(folder))[:24]


@lru_cache(maxsize=1)
def _routes() -> Routes:
    return Routes.of(load_config(FIXTURES / "config/aircraft.toml"))


# --- a log that is exported -----------------------------------------------------------------------------------------


def _exports() -> Target:
    def run(data: bytes) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            path = Path(folder, "log.mcap")
            path.write_bytes(data)
            seen = told(lambda: _export(path, Path(folder, "out")), LogError)
            written = {one.name for one in Path(folder).iterdir()}
        if extra := written - {"log.mcap", "out"}:
            raise FindingError(f"written: {extra}")
        return iter({words.removeprefix(folder)[:40] for words in seen})

    return Target("export", [_log(), *log_seeds()], mutate_log, run, None, lambda size: (48 << 20) + 200 * size)


def _log() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        _write(Path(folder, "log.mcap"))
        return Path(folder, "log.mcap").read_bytes()


def _export(path: Path, out: Path) -> Iterator[str]:
    """Export a log and read the export again, unit by unit."""
    for session in open_logs([path]):
        report = export_session(session, out)
        yield f"{len(report.files)} files, {len(report.notes)} notes"
        if set(report.units) <= set(_routes().ports):
            yield from _imported(report.folder)


# --- the sums of an offload -----------------------------------------------------------------------------------------


def _checksums() -> Target:
    """Read checksums, add one and read again: every existing one must remain."""
    text = "".join(f"{bytes([n]).hex() * 32}  log_{n}.mcap\n" for n in range(3)) + f"\\{'0' * 64} *a\\nb\n# x\n"

    def run(data: bytes) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as name, patch("os.fsync"):
            folder = Path(name)
            Path(folder, NAME).write_bytes(data)
            before = ChecksumList(folder)
            sums = dict(before.sums)
            before.add("new.mcap", "f" * 64)
            after = ChecksumList(folder).sums
        if after != sums | {"new.mcap": "f" * 64}:
            raise FindingError(f"{sums} became {after}")
        return iter({f"{len(sums)} sums"})

    words = (*OF_CSV, "f" * 64, "0" * 64, "\\", "\\n", "*x", "new.mcap", "\xff\r", "\x85")
    return Target("checksums", [text.encode()], lambda rng, base: changed_text(rng, base, words), run)
