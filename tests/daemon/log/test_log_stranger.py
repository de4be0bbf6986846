"""Tests that a foreign log's false claims are reported in a line, take little memory, and are not copied.

All commands read all files in one process, whose peak memory is reset before each (proc(5), clear_refs).
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from swath.daemon.log.format import LogError
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import examine, recover
from tests.daemon.builders import INFO, START_NS
from tests.daemon.log.builders import official
from tests.daemon.rig import HANGS_S, free_udp_port, session_table
from tests.fuzz import mcap_parts as mcap

ROOT = Path(__file__).resolve().parents[3]

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("stranger")]  # its files are read once, by one worker
PEAK_BYTES = 600 << 20  # of the whole process with its libraries
SECONDS = 60.0
YEAR_2200_NS = 7_258_118_400_000_000_000
RUN = """
import contextlib, io, json, sys, time
from swath.daemon.cli.main import run_app

def peak():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) * 1024

told = []
for arguments in json.load(sys.stdin):
    out, errors = io.StringIO(), io.StringIO()
    open("/proc/self/clear_refs", "w").write("5")
    began = time.monotonic()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        code = run_app(arguments)
    seconds = time.monotonic() - began
    told.append(dict(code=code, out=out.getvalue(), errors=errors.getvalue(), peak=peak(), seconds=seconds))
json.dump(told, sys.stdout)
"""


def log_of(*records: bytes, session: dict[str, str] | None = None) -> bytes:
    """Return a file of our profile with a correct beginning, these records and no end."""
    head = mcap.record(mcap.HEADER, mcap.text("swath") + mcap.text("stranger"))
    info = INFO.to_metadata(0) | (session or {})
    return mcap.MAGIC + head + mcap.record(mcap.METADATA, mcap.metadata("swath.session", info)) + b"".join(records)


def chunk(*inner: bytes, compression: bytes = b"", claimed: int | None = None) -> bytes:
    """Return a chunk of records with a correct CRC."""
    return mcap.record(mcap.CHUNK, mcap.chunk_body(b"".join(inner), compression, claimed))


def channel(number: int, topic: bytes | str, **more: Any) -> bytes:
    return mcap.record(mcap.CHANNEL, mcap.channel(number, topic, **more))


def message(number: int, time_ns: int, data: bytes = b"$GPZDA,") -> bytes:
    return mcap.record(mcap.MESSAGE, mcap.message(number, time_ns, data))


ROVER = channel(1, "/gnss/rover/raw")
GOOD = chunk(ROVER, message(1, START_NS))


def attachments_elsewhere() -> bytes:
    names = (
        "../evil",
        "/tmp/swath-evil",
        "a/../../evil",
        "..",
        "",
        "x\0y",
        "C:\\evil",
        "\\\\host\\evil",
        "e" * 5000,
        "a/" * 999,
    )
    return log_of(*(mcap.record(mcap.ATTACHMENT, mcap.attachment(name, b"evil")) for name in names), GOOD)


def lengths_and_counts() -> bytes:
    """Return a log with lengths of strings, maps, data and records that exceed every limit."""
    huge = struct.pack("<I", 0xFFFF_FFFF)
    inner = [
        mcap.record(mcap.CHANNEL, struct.pack("<HH", 2, 0) + huge),
        mcap.record(mcap.CHANNEL, struct.pack("<HH", 2, 0) + mcap.text("/a/raw") + mcap.text("x") + huge),
        mcap.record(mcap.SCHEMA, struct.pack("<H", 1) + mcap.text("n") + mcap.text("e") + huge),
        struct.pack("<BQ", mcap.MESSAGE, 1 << 62),
        channel(2, "/" + "t" * 100_000 + "/raw"),
    ]
    return log_of(
        *(chunk(one) for one in inner),
        mcap.record(mcap.ATTACHMENT, mcap.attachment("config.toml", b"", claimed=(1 << 63) + 5)),
        mcap.record(mcap.METADATA, mcap.text("m") + huge),
        GOOD,
        struct.pack("<BQ", mcap.ATTACHMENT, 1 << 40),
    )


def lz4_bomb() -> bytes:
    """Return a gigabyte in four megabytes, in chunks that state less, as much as is read, and more."""
    compressor = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    stored = compressor.begin() + b"".join(compressor.compress(bytes(4 << 20)) for _ in range(256)) + compressor.flush()
    return log_of(*(claiming(b"lz4", stored, size) for size in (100, 30 << 20, 1 << 63)), GOOD)


def zstd_bomb() -> bytes:
    """Return the same with zstd, and a window of two gigabytes."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    stored = b"".join(compressor.compress(bytes(4 << 20)) for _ in range(256)) + compressor.flush()
    wide = zstandard.ZstdCompressionParameters(window_log=31, enable_ldm=False)
    window = zstandard.ZstdCompressor(compression_params=wide).compressobj().compress(b"x" * 100)
    bombs = [claiming(b"zstd", stored, size) for size in (100, 30 << 20, 1 << 63)]
    return log_of(*bombs, claiming(b"zstd", window, 100), GOOD)


def claiming(name: bytes, stored: bytes, size: int) -> bytes:
    """Return a chunk of those bytes that states the given uncompressed size."""
    body = struct.pack("<QQQII", 0, 1, size, 1, len(name)) + name + struct.pack("<Q", len(stored)) + stored
    return mcap.record(mcap.CHUNK, body)


def small_messages_that_unfold() -> bytes:
    """Return a small log that unfolds: tiny alternating messages of one time, zeros, events and one huge JSON."""
    pair = message(1, START_NS, b"") + message(2, START_NS, b"")
    event = json.dumps({"severity": "x", "code": "mark"}).encode()
    events = b"".join(message(3, START_NS, event + b" " * at) for at in range(2)) * 2_000
    return log_of(
        chunk(ROVER, channel(2, "/scanner/left/raw"), pair * 4_000, compression=b"zstd"),
        chunk(bytes(30 << 20), compression=b"zstd"),
        chunk(channel(3, "/events", encoding="json"), events, compression=b"zstd"),
        chunk(message(3, START_NS, b'{"a":[' + b"0," * (8 << 20) + b"0]}"), compression=b"zstd"),
        *(chunk(message(1, START_NS, bytes(30 << 20)), compression=b"zstd") for _ in range(6)),
    )


def times_beyond_reason() -> bytes:
    """Return a log with times before 1970, in 1970, at the limits of 63 and 64 bits, in 2200, and invalid edges."""
    times = (0, 1, START_NS, YEAR_2200_NS, (1 << 63) - 1, -(1 << 63), -1, START_NS + 10**9)
    edges = (b"{}", b"[]", b"no", b'{"edge_time_ns":1e400}', b'{"edge_time_ns":-5}', b'{"edge_time_ns":%d}' % (1 << 70))
    return log_of(
        chunk(ROVER, *(message(1, time) for time in times)),
        chunk(channel(2, "/pps/main", encoding="json"), *(message(2, START_NS, edge) for edge in edges)),
        chunk(ROVER, *(message(1, time) for time in reversed(times))),
    )


def schemas_not_ours() -> bytes:
    """Return a log with a foreign schema, one that no record describes, and two with the same number."""
    return log_of(
        chunk(
            mcap.record(mcap.SCHEMA, mcap.schema(1, "stranger.Thing", b'{"title":"Thing"}')),
            channel(1, "/stranger/things", schema=1, encoding="json"),
            channel(2, "/gnss/rover/raw", schema=999),
            message(1, START_NS, b"{}"),
            message(2, START_NS),
        ),
        chunk(
            mcap.record(mcap.SCHEMA, mcap.schema(1, "stranger.Other")),
            channel(3, "/x/y", schema=1),
            message(3, START_NS),
        ),
    )


def channels_of_one_number() -> bytes:
    """Return a file in which number 1 denotes two channels and number 7 none."""
    again = channel(1, "/imu/main/raw")
    return log_of(
        GOOD, chunk(again, message(1, START_NS)), again, chunk(message(7, START_NS), ROVER, message(1, START_NS))
    )


def many_channels() -> bytes:
    """Return a file with fifteen thousand channels with long names."""
    return log_of(
        *(
            chunk(*(channel(at, f"/{at}{'x' * 4000}/raw") for at in range(first, first + 3000)), compression=b"zstd")
            for first in range(1, 15_000, 3000)
        )
    )


def parts_beyond_reason() -> bytes:
    return log_of(GOOD, session={"part": "9" * 17})


def session_that_leads_elsewhere() -> bytes:
    return log_of(GOOD, session={"session_id": "../../evil", "realtime_ns": "-" + "9" * 30, "part": "999999"})


def damage_without_end() -> bytes:
    """Return a log with thousands of damaged places that cannot be reported as one."""
    bad = claiming(b"", b"abcd", 4)
    return log_of(*([bad, GOOD] * 2_500))


FILES: dict[str, Callable[[], bytes]] = {
    make.__name__: make
    for make in (
        *(attachments_elsewhere, lengths_and_counts, lz4_bomb, zstd_bomb, small_messages_that_unfold),
        *(times_beyond_reason, schemas_not_ours, channels_of_one_number, many_channels, parts_beyond_reason),
        *(session_that_leads_elsewhere, damage_without_end),
    )
}
COMMANDS = ("info", "recover", "replay", "export")


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], dict[str, Any]]:
    """Run every command on every file; return the output and the files left behind."""
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "wire.toml").write_text(
        session_table(folder / "logs")
        + f'[scanner.left]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
        + f'[pps.main]\nsource = "fixed:{folder}/pps"\n'
    )
    runs: dict[tuple[str, str], list[str]] = {}
    for name, make in FILES.items():
        path = folder / f"{name}.mcap"
        path.write_bytes(make())
        for command in COMMANDS:
            runs[name, command] = [*command.split(), str(path), *_rest(folder, name, command)]
    before = _files(folder)
    Path("/tmp/swath-evil").unlink(missing_ok=True)  # of an earlier failure
    (folder / "tmp").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        input=json.dumps(list(runs.values())),
        env=os.environ | {"TMPDIR": str(folder / "tmp"), "COLUMNS": "100", "NO_COLOR": "1"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert {path for path in _files(folder) - before if path.parts[0] not in ("recover", "export")} == set()
    assert not Path("/tmp/swath-evil").exists()
    return dict(zip(runs, json.loads(done.stdout), strict=True))


def _rest(folder: Path, name: str, command: str) -> list[str]:
    if command == "replay":
        return ["--wire", str(folder / "wire.toml"), "--wait", "0", "--pace", "1"]
    if command not in ("recover", "export"):
        return []
    (folder / command / name).mkdir(parents=True)
    return [*(["--output"] if command == "recover" else []), str(folder / command / name)]


def _files(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", FILES)
def test_a_foreign_log_is_read_or_refused_in_few_words_and_little_memory(
    told: dict[tuple[str, str], dict[str, Any]], name: str, command: str
) -> None:
    said = told[name, command]
    assert said["code"] in (0, 1, 3, 4), said
    assert "internal error" not in said["errors"]
    assert "Traceback" not in said["errors"] + said["out"]
    assert len(said["errors"].splitlines()) <= 6, said["errors"][:2000]
    assert max(map(len, said["errors"].splitlines()), default=0) < 1000
    assert said["peak"] < PEAK_BYTES, f"{said['peak'] >> 20} MiB"
    assert said["seconds"] < SECONDS


def write(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "stranger.mcap"
    path.write_bytes(data)
    return path


def test_a_foreign_schema_is_recovered_with_its_messages(tmp_path: Path) -> None:
    """The official reader finds the foreign schema, by name and text, with the copy's messages."""
    report = recover(write(tmp_path, schemas_not_ours()))
    assert report.messages == {"/stranger/things": 1, "/gnss/rover/raw": 1, "/x/y": 1}
    assert report.recovered is not None
    with report.recovered.open("rb") as file:
        found = {
            channel.topic: schema and (schema.name, schema.data)
            for schema, channel, _ in make_reader(file, validate_crcs=True).iter_messages()
        }
    assert found["/stranger/things"] == ("stranger.Thing", b'{"title":"Thing"}')
    assert found["/x/y"] == ("stranger.Other", b"{}")
    assert found["/gnss/rover/raw"] is None


def test_impossible_times_are_counted_and_the_other_messages_kept(tmp_path: Path) -> None:
    """Two messages of each order of times have the sign bit; the others are copied with their stamps."""
    path = write(tmp_path, times_beyond_reason())
    report = recover(path)
    said = [(damage.what, damage.messages) for damage in report.damage if damage.messages]
    assert said == [("messages with an impossible time", 2)] * 2
    assert report.recovered is not None
    kept = sorted(2 * [0, 1, START_NS, START_NS + 10**9, YEAR_2200_NS, (1 << 63) - 1])
    assert sorted(time for time, _ in official(report.recovered)["/gnss/rover/raw"]) == kept
    (session,) = open_logs([path])
    times = np.concatenate([batch.log_time_ns for batch in session.batches_by_time() if batch.channel_id == 1])
    assert sorted(times.tolist()) == kept


def test_a_channel_that_changes_its_topic_is_refused(tmp_path: Path) -> None:
    """Its later messages do not appear under the earlier topic, nor the earlier ones under the later topic."""
    report = examine(write(tmp_path, channels_of_one_number()))
    assert report.messages == {"/gnss/rover/raw": 2}
    again = "channel 1 is described as '/imu/main/raw', before as '/gnss/rover/raw'"
    assert [damage.what for damage in report.damage[:2]] == [again, again]
    assert report.damage[2].what == "messages of channel 7, whose record is lost"


def test_a_thousand_damaged_places_are_listed(tmp_path: Path) -> None:
    path = write(tmp_path, damage_without_end())
    report = examine(path)
    assert len(report.damage) == 1000
    assert report.lost_bytes == path.stat().st_size - 8 - 2_500 * len(GOOD) - len(log_of()) + 8
    (session,) = open_logs([path])
    assert sum(len(batch.log_time_ns) for batch in session.batches()) == 2_500
    assert len(session.damage) == 1001


def test_a_file_with_an_absurd_part_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is not a part number, want 0 to"):
        open_logs([write(tmp_path, parts_beyond_reason())])
    (session,) = open_logs([write(tmp_path, session_that_leads_elsewhere())])
    assert len(session.missing_parts) == 1000
