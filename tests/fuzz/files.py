"""Targets for captures and configurations: foreign files are read or refused in one line."""

from __future__ import annotations

import dataclasses
import gzip
import io
import random
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from swath.daemon.config import load_config
from swath.daemon.errors import UserError
from swath.drivers.captures.base import until_damage
from swath.drivers.captures.opening import (
    CaptureTally,
    FileClock,
    open_bag,
    read_can_log,
    read_lvx,
    read_network,
    read_pcap,
    read_serial,
    tells_time,
)
from swath.drivers.captures.rosbag.messages import SENTENCE
from swath.drivers.captures.tables.read import read_table
from swath.drivers.transports.base import TransportError
from tests.drivers.captures.bags import (
    CONTAINERS,
    START_NS,
    Ros,
    cloud_message,
    custom_message,
    every_type,
    fix_message,
    imu_message,
    write_bag,
)
from tests.drivers.captures.can_logs import (
    ASC_HEAD,
    ASC_LINES,
    BLF_CLASSIC,
    BLF_FD_64,
    BLF_REMOTE,
    TRC_HEAD,
    blf_container,
    blf_file,
    blf_object,
)
from tests.drivers.captures.network import SYN, a_ms_apart, acknowledging, from_device, pcap_of
from tests.drivers.livox_cases import FILES
from tests.drivers.lvx_files import FileHead, lvx1_package, lvx2_package, lvx_file
from tests.drivers.recordings import FIXTURES
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.mutation import damage

CONFIG = FIXTURES / "config"
WORDS = (
    *(
        "0",
        "-1",
        "1e999",
        "nan",
        "inf",
        "[]",
        "{}",
        '""',
        '"\\u0000"',
        "true",
        "9" * 30,
        '"x/../.."',
        '"/"',
        "[[[[1]]]]",
    ),
    *(
        '"udp:0.0.0.0:0"',
        '"can:socketcan:can0?bitrate=0"',
        '"serial:?"',
        '"gnss:x"',
        '"é"',
        "1979-05-27",
        '"/dev/pps0"',
    ),
)


def file_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets of capture readers, each with its own kind of file, and of the configuration with its files."""
    yield "pcap", lambda: _captures("pcap", _pcaps(), read_pcap)
    yield "pcap-network", lambda: _captures("pcap-network", _networks(), _read_network)
    yield "candump", lambda: _captures("candump", _candumps(), partial(_read_can_log, "candump"))
    yield "can-asc", lambda: _captures("can-asc", _ascs(), partial(_read_can_log, "asc"))
    yield "can-blf", lambda: _captures("can-blf", _blfs(), partial(_read_can_log, "blf"))
    yield "can-trc", lambda: _captures("can-trc", _trcs(), partial(_read_can_log, "trc"))
    yield "lvx", lambda: _captures("lvx", _lvxs(), _read_lvx)
    yield "serial", lambda: _captures("serial", [_serial_case()], _read_serial)
    yield "bag", _bags
    yield "table", _tables
    yield "config", _configuration


def _heads(*patterns: str) -> list[bytes]:
    paths = [path for pattern in patterns for path in sorted(FIXTURES.glob(pattern))]
    return [gzip.decompress(path.read_bytes())[:3000] for path in paths]


def _pcaps() -> list[bytes]:
    """Return the beginnings of captures, one of them gzipped and cut off."""
    found = _heads("*/*.pcap.gz")
    return [*found, gzip.compress(found[0], mtime=0)[:-20]]


def _networks() -> list[bytes]:
    """Return captures of TCP connections and CAN buses."""
    frames = [from_device(99, b"abc", SYN), from_device(110, b"def"), acknowledging(103), from_device(103, bytes(9))]
    classic = bytes.fromhex("98fea5d3080000000102030405060708")
    cooked = [bytes.fromhex("0001011800000000000000000000000c") + classic]
    return [
        pcap_of(a_ms_apart(frames)),
        pcap_of(a_ms_apart([classic, bytes.fromhex("000001230c050000") + bytes(12)]), 227),
        pcap_of(a_ms_apart(cooked), 113, ">"),
        *_heads("captures/tcp.pcap.gz"),
    ]


def _read_network(path: Path, tally: CaptureTally | None) -> Iterator[object]:
    return read_network(path, lambda source, destination: source[1] > destination[1] % 40_000, tally)


def _candumps() -> list[bytes]:
    """Return logs of candump, with and without ``-L``, with times of each form."""
    shown = [
        f" ({{}})  can0  {rest}\n" for rest in ("120   [2]  01 02   'ab'", "18FF50E5  [12]  " + "07 " * 12, "1{{F}}")
    ]
    stamps = ("1700000000.000001", "2023-11-14 23:13:20.000001", "000.000000")
    texts = ["".join(shown).replace("{}", stamp).encode() for stamp in stamps]
    return [*_heads("nmea2000/*.log.gz", "canmod-gps/*.log.gz"), *texts]


def _ascs() -> list[bytes]:
    text = ASC_HEAD + ASC_LINES
    return [text.encode(), text.replace("absolute", "relative").replace("base hex", "base dec").encode()]


def _trcs() -> list[bytes]:
    first = (
        TRC_HEAD.format("1.1", "").replace(";$COLUMNS=", ";") + "1)  1059.9  Rx  0300  7  00 00 00 00 04 00 00\n" * 3
    )
    second = (
        TRC_HEAD.format("2.1", "N,O,T,B,I,d,R,L,D")
        + "1 1.0 FB 1 0300 Rx - 9 "
        + "00 " * 12
        + "\n2 1.0 RR 1 0300 Rx - 3\n"
    )
    return [first.encode(), second.encode()]


def _blfs() -> list[bytes]:
    frames = [blf_object(1, BLF_CLASSIC), blf_object(86, BLF_REMOTE), blf_object(101, BLF_FD_64, version=2)]
    whole = b"".join(frames)
    return [blf_file(blf_container(whole[:90]), blf_container(whole[90:])), blf_file(blf_container(whole, 0), *frames)]


def _read_can_log(kind: str, path: Path, tally: CaptureTally | None) -> Iterator[object]:
    return read_can_log(path, kind, FileClock(None if kind in ("asc", "trc") else 0), tally)


def _lvxs() -> list[bytes]:
    """Return files of Livox Viewer of both kinds, one of them gzipped and cut off."""
    heads = {"avia": FileHead("3JEDHB300100641", 0, 7), "mid360": FileHead("47MDK4A0020123", 7, 9)}
    first = [[lvx1_package(0, unit)] for unit in sorted(FILES["avia"](), key=len)[:12]]
    second = [[lvx2_package(7, unit)] for unit in sorted(FILES["mid360"](), key=len)[:5]]
    found = [lvx_file(1, [heads["avia"]], first), lvx_file(2, [heads["mid360"]], second)]
    return [*found, gzip.compress(found[1], mtime=0)[:-20]]


def _read_lvx(path: Path, tally: CaptureTally | None) -> Iterator[object]:
    return read_lvx(path, None if tells_time(path) else 1_800_000_000_000_000_000, tally)


def _captures(name: str, seeds: list[bytes], read: Callable[..., Iterator[object]]) -> Target:
    def run(data: bytes) -> Iterator[str]:
        seen = set()
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            path = Path(folder, "capture")
            path.write_bytes(data)
            for tally in (None, CaptureTally()):
                try:
                    for unit in islice(read(path, tally=tally), 5000):
                        seen.add(f"{type(unit).__name__} {len(getattr(unit, 'data', b'')).bit_length()}")
                except TransportError as error:
                    if "\n" in str(error):
                        raise FindingError(f"more than a line: {error}") from error
                    seen.add(str(error).removeprefix(str(path))[:24])
        return iter(seen)

    return Target(name, seeds, lambda rng, base: damage(rng, base, start=rng.choice((0, 0, 20))), run)


_TABLE = b"arrival_unix_s,offset,length\n1600000000.25,0,10\n1600000000.5,10,20\n1600000001,30,70\n"


def _serial_case() -> bytes:
    """Return the table of arrivals and, after an empty line, the bytes."""
    return _TABLE + b"\n" + bytes(range(100))


def _read_serial(path: Path, tally: CaptureTally | None) -> Iterator[object]:
    table, _, data = path.read_bytes().partition(b"\n\n")
    bare, chunks = path.with_name("bytes.bin"), path.with_name("chunks.csv")
    bare.write_bytes(data)
    chunks.write_bytes(table)
    return read_serial(bare, chunks, tally=tally)


# --- bags of ROS ----------------------------------------------------------------------------------------------------

_FUZZED_TYPES = ("pandar_msgs/msg/PandarScan", "nebula_msgs/msg/NebulaPackets", "can_msgs/msg/Frame", SENTENCE)


def _bags() -> Target:
    seeds = []
    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        for container in CONTAINERS:
            ros = Ros(container)
            messages = [one for one in every_type(ros)[0] if one[1] in _FUZZED_TYPES]
            points = np.array([(1.0, 2.0, 3.0, 0.01)] * 4, [(name, "<f4") for name in ("x", "y", "z", "time")])
            for kind, message in (
                ("sensor_msgs/msg/Imu", imu_message(ros, START_NS, (0.1, 0.2, 9.8), (0.1, 0.2, 0.3))),
                ("sensor_msgs/msg/NavSatFix", fix_message(ros, START_NS, (47.0, 8.0, 500.0))),
                ("sensor_msgs/msg/PointCloud2", cloud_message(ros, START_NS, points)),
                ("livox_ros_driver2/msg/CustomMsg", custom_message(ros, START_NS, [(0, 1.0, 2.0, 3.0, 4, 5, 6)] * 3)),
            ):
                messages.append((f"/{kind}", kind, START_NS, message))
            seeds.append(write_bag(Path(folder, container), container, messages).read_bytes())
    target = _captures("bag", seeds, _read_bag)
    return dataclasses.replace(target, peak_bytes=lambda size: (64 << 20) + 400 * size)  # rosbags compiles definitions


def _read_bag(path: Path, tally: CaptureTally | None) -> Iterator[object]:
    with open_bag(path) as bag:
        yield from until_damage(bag.units(list(bag.topics), tally), tally)


# --- tables of records ----------------------------------------------------------------------------------------------

_POINTS = b"gps_week,tow_s,x_m,y_m,z_m,intensity\n" + b"2423,118818.25,3,-4,12.5,9\n2423,118818.5,,nan,1e300,-1\n" * 40
_FIXES = b"utc;lat_deg;lon_deg;height_m;valid;fix_type\n2026-06-15T09:00:00Z;47.5;8.5;500;true;RTK fixed\n"
_SAMPLES = (
    b"gps_ns,host_time_ns,device_time_ns,accel_x_g,accel_y_g,accel_z_g,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s\n"
    b"1465549218000000000,1781514000000000000,5,0,0,-1,1,2,3\n-1,1781514000000000001,6,0,0,-1,1,2,3\n"
)


def _tables() -> Target:
    parquet = io.BytesIO()
    columns = {"unix_ns": [1_781_514_000_000_000_000, None], "x_m": [1.0, 2.0], "y_m": [3.0, 4.0], "z_m": [5, 6]}
    pyarrow.parquet.write_table(pyarrow.table(columns), parquet)
    seeds = [_POINTS, _FIXES, _SAMPLES, gzip.compress(_POINTS, mtime=0)[:-9], parquet.getvalue()]
    return dataclasses.replace(_captures("table", seeds, _read_table), peak_bytes=lambda size: (64 << 20) + 400 * size)


def _read_table(path: Path, tally: CaptureTally | None) -> Iterator[object]:
    """Read a table as each kind of device, the parser's records too."""
    for device in ("scanner", "gnss", "imu"):
        try:
            yield from until_damage(read_table(path, device, tells_time=True, tally=tally), tally)
        except TransportError as error:
            if "\n" in str(error):
                raise FindingError(f"more than a line: {error}") from error


# --- the configuration ----------------------------------------------------------------------------------------------

_PARTED = b"\n#### FILE ####\n"


def _configuration() -> Target:
    named = [(CONFIG / name).read_bytes() for name in ("imu.dbc", "left.toml")]
    texts = [CONFIG / "aircraft.toml", *sorted((CONFIG / "bad").glob("*.toml"))]
    seeds = [_PARTED.join([path.read_bytes(), *named]) for path in texts]
    return Target("config", seeds, _changed_configuration, _load)


def _changed_configuration(rng: random.Random, base: bytes) -> bytes:
    """Change a value of the configuration, or bytes of it or of a file that it names."""
    parts = base.split(_PARTED)
    at = rng.choice((0, 0, 0, rng.randrange(len(parts))))
    lines = parts[at].split(b"\n")
    for _ in range(rng.randrange(1, 4)):
        place = rng.randrange(len(lines))
        key, sign, _ = lines[place].partition(b" = ")
        if at == 0 and sign and rng.random() < 0.7:
            lines[place] = key + sign + rng.choice(WORDS).encode()
        elif rng.random() < 0.5:
            lines.insert(rng.randrange(len(lines)), lines[place])
        else:
            lines[place] = damage(rng, lines[place])
    parts[at] = b"\n".join(lines)
    return _PARTED.join(parts)


def _load(data: bytes) -> Iterator[str]:
    text, *files = data.split(_PARTED)
    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        for name, content in zip(("imu.dbc", "left.toml"), files, strict=False):
            Path(folder, name).write_bytes(content)
        path = Path(folder, "swath.toml")
        path.write_bytes(text)
        try:
            config = load_config(path)
        except UserError as error:
            return iter({line.removeprefix(str(path))[:30] for line in error.message.splitlines()})
        return iter({device.source for device in config.devices()})
