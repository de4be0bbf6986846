"""Measure what decoding costs on one core, beside a limit of the machine measured in the same run.

python -m benchmarks.decode [--repeats 15] [--json FILE]

Figures are items a second of this process's own CPU time, medians over the repeats. The limit beside each figure is the
least that a program must do with the same bytes: check their CRC where the protocol has one, read them once, and copy
rows of the output's size once. No decoder can be faster; the share is the decoder's rate over the limit.
"""

from __future__ import annotations

import argparse
import datetime as dt
import gzip
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from fastcrc.crc32 import iso_hdlc as crc32
from fastcrc.crc64 import xz as crc64_xz

from benchmarks.cpu_time import cpu_seconds
from swath.daemon.system import keep_freed_memory
from swath.drivers.captures.opening import read_candump, read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.framing.framer import Frame, Framer
from swath.drivers.framing.kinds import GNSS_KINDS
from swath.drivers.imu.canmod_gps import CanmodGpsParser
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.vectornav import wire
from swath.drivers.parser import DeviceSettings, Parser, ParserCounters
from swath.drivers.scanner.hesai.at128 import AT128
from swath.drivers.scanner.hesai.heads import (
    MODE_FIRST_LAST_STRONGEST,
    MODE_LAST_STRONGEST,
    MODE_STRONGEST,
    HesaiHead,
    echoes_of,
)
from swath.drivers.scanner.hesai.models import QT64, QT128, XT16, XT32, XT32M2X
from swath.drivers.scanner.hesai.pandar import PANDAR40P, PANDAR64, PANDAR128
from swath.drivers.scanner.hesai.parser import HesaiParser, MirrorParser, encode_point_packet, with_checksums
from swath.drivers.scanner.livox.layout import AVIA, POINTS_1, PTP, encode_packet_1
from swath.drivers.scanner.livox.parser import LivoxParser
from swath.drivers.scanner.ouster.layout import LidarLayout
from swath.drivers.scanner.ouster.parser import OusterParser
from swath.drivers.scanner.robosense.heads import MODE_DUAL as MODE_DUAL_RS
from swath.drivers.scanner.robosense.heads import MSOP_DTYPE, RS16, RS32
from swath.drivers.scanner.robosense.parser import RobosenseParser, encode_difop
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.srep.parser import SrepParser
from swath.drivers.scanner.velodyne.heads import PACKET_BYTES, VLP16, VLP32C, VLS128
from swath.drivers.scanner.velodyne.parser import MODE_DUAL, PACKET_DTYPE, VelodyneParser
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    IMU_DTYPE,
    RETURN_DTYPE,
    ByteRows,
    Chunk,
    ChunkBatch,
    ImuSamples,
    Record,
    ScannerReturns,
)

FIXTURES = Path(__file__).parents[1] / "fixtures"
BATCH_BYTES = 1 << 20  # of one chunk of the log
NO_RECORDING = re.compile(r"\.(md|json|chk|csv|txt)(\.gz)?$")  # files beside the recordings
READ_BYTES = 4096  # of one read of a serial port


@dataclass
class Figure:
    """One line of the table; rates are items a second of CPU, ``plain`` is the rate without compiled loops, if any."""

    name: str
    item: str
    rate: float
    target: float | None
    limit: float
    limit_is: str
    plain: float | None = None


def rate(work: Callable[[], object], items: float, repeats: int) -> float:
    """Return the median of items a second of CPU time."""
    return items / cpu_seconds(work, repeats, at_least_s=0.03)


def batches_of(units: ByteRows) -> list[ChunkBatch]:
    """Return rows as the log delivers them: 1 MiB a batch, 31 bytes of message header before each row."""
    n, length = units.shape
    table = np.zeros((n, length + 31), dtype=np.uint8)
    table[:, 31:] = units
    step = max(1, BATCH_BYTES // (length + 31))
    host = np.arange(n, dtype=np.int64) * 1_000_000
    return [ChunkBatch("bench", host[at : at + step], table[at : at + step, 31:]) for at in range(0, n, step)]


def copy_rows(dtype: np.dtype[np.void], count: int) -> Callable[[], object]:
    """Return work that copies so many rows of the output once, between arrays that already exist."""
    source, target = np.zeros(count * dtype.itemsize, np.uint8), np.zeros(count * dtype.itemsize, np.uint8)
    return lambda: np.copyto(target, source)


def count_rows(records: list[Record]) -> int:
    """Return the number of returns and samples in the records."""
    return sum(len(record.rows) for record in records if isinstance(record, ScannerReturns | ImuSamples))


def decode_all(make: Callable[[], Parser], batches: list[ChunkBatch]) -> int:
    """Decode all batches with a new parser and return the number of rows; rows of a batch are not kept."""
    parser = make()
    return sum(count_rows(parser.feed_batch(batch)) for batch in batches)


# --- scanners -------------------------------------------------------------------------------------------------------


def srep_units(pulses: int, slots: int, second_share: float) -> ByteRows:
    """Make about 4 MB of SREP datagrams at a pulse rate of 200 kHz.

    Every pulse has a first return; each further slot is used with the probability `second_share`.
    """
    random = np.random.default_rng(1)
    header = SrepHeader(flags=5, pps_count=1, pps_ticks=1, prf_mhz=200_000_000)
    length = len(encode_datagram(header, np.zeros(pulses), np.zeros(pulses), np.ones((pulses, slots))))
    units = np.empty((4_000_000 // length, length), dtype=np.uint8)
    number = np.arange(pulses)
    for at in range(len(units)):
        ranges = random.integers(5_000_000, 15_000_000, (pulses, slots))
        ranges[:, 1:] *= random.random((pulses, slots - 1)) < second_share
        one = replace(header, sequence=at, first_ticks=at * pulses * 50)
        data = encode_datagram(one, number * 50, (at * pulses + number) % 524_288, ranges, 800, 450)
        units[at] = np.frombuffer(data, dtype=np.uint8)
    return units


def measure_srep(repeats: int) -> Iterator[Figure]:
    """Measure three kinds of SREP datagrams."""
    polygon = {"type": "polygon", "facets": 4}
    for name, shape, config in (
        ("SREP, 1 return a pulse", (512, 1, 0.0), {}),
        ("SREP, 2 slots, 30 % used", (340, 2, 0.3), {}),
        ("SREP, 2 slots, polygon", (340, 2, 0.3), {"geometry": polygon}),
    ):
        settings = DeviceSettings("scanner/bench", {"mirror_factor": 2.0, **config})
        units = srep_units(*shape)
        rows = decode_all(partial(SrepParser, settings), batches_of(units))
        copy = copy_rows(RETURN_DTYPE, rows)

        def least(units: ByteRows = units, copy: Callable[[], object] = copy) -> None:
            for unit in units:
                crc32(unit)
            copy()

        compiled, plain = both_rates(SrepParser, settings, units, rows, repeats)
        yield Figure(name, "returns", compiled, 15e6, rate(least, rows, repeats), "CRC-32 + copy of the rows", plain)


def both_rates(
    make: Callable[[DeviceSettings], Parser], settings: DeviceSettings, units: ByteRows, rows: int, repeats: int
) -> tuple[float, float]:
    """Return the rates of decoding with compiled loops and without."""
    batches = batches_of(units)
    compiled = replace(settings, compiled=True)
    return (
        rate(lambda: decode_all(lambda: make(compiled), batches), rows, repeats),
        rate(lambda: decode_all(lambda: make(settings), batches), rows, repeats),
    )


def head_figure(
    name: str,
    make: Callable[[DeviceSettings], Parser],
    settings: DeviceSettings,
    units: ByteRows,
    target: float,
    repeats: int,
    row: np.dtype[np.void] = RETURN_DTYPE,
) -> Figure:
    """Measure the decoding of a spinning head's packets, beside a copy of packets and rows."""
    rows = decode_all(lambda: make(settings), batches_of(units))
    copy, taken = copy_rows(row, rows), np.empty(units.shape, np.uint8)

    def least() -> None:
        np.copyto(taken, units)
        copy()

    compiled, plain = both_rates(make, settings, units, rows, repeats)
    return Figure(name, "returns", compiled, target, rate(least, rows, repeats), "copy of packets and rows", plain)


def livox_units(data_type: int, packets: int = 2000) -> ByteRows:
    """Make packets of an Avia, 240 000 pulses a second, of which every eleventh has no return."""
    kind, random = POINTS_1[data_type], np.random.default_rng(2)
    table = np.zeros((packets, kind.pulses), dtype=kind.dtype)
    returns = table["echoes"] if kind.echoes > 1 else table
    for axis in "xyz":
        returns[axis] = random.integers(-60_000, 60_000, returns.shape)
        returns[axis][:, ::11] = 0
    step_ns = kind.pulses * 1_000_000_000 // 240_000
    units = [encode_packet_1(data_type, PTP, 5_000_000_000 + at * step_ns, row) for at, row in enumerate(table)]
    return np.frombuffer(b"".join(units), dtype=np.uint8).reshape(packets, -1)


def measure_livox(repeats: int) -> Iterator[Figure]:
    """Measure Cartesian points of SDK 1, single and dual return; there are no compiled loops."""
    for name, data_type in (("Livox Avia, x y z", 2), ("Livox Avia, dual return", 4)):
        settings = DeviceSettings("scanner/bench")
        make = partial(LivoxParser, head=AVIA)
        yield head_figure(name, make, settings, livox_units(data_type), 8e6, repeats, AIMED_RETURN_DTYPE)


def measure_hesai(repeats: int) -> Iterator[Figure]:
    """Measure Hesai heads with real packets in dual return and a continuous sequence, and one with three returns."""
    for name, head, recording in (
        ("PandarXT-32, dual return", XT32, "nebula_xt32.pcap.gz"),
        ("PandarXT-16, dual return", XT16, "nebula_xt16.pcap.gz"),
        ("XT32M2X, dual return", XT32M2X, "nebula_xt32m.pcap.gz"),
        ("PandarQT, dual return", QT64, "nebula_qt64.pcap.gz"),
        ("QT128C2X, dual return, CRC", QT128, "nebula_qt128.pcap.gz"),
    ):
        units = hesai_units(head, recording)
        yield hesai_figure(name, head, units, repeats)
        if head is XT32M2X:
            packets = units.view(head.packet_dtype())[:, 0]
            packets["mode"] = MODE_FIRST_LAST_STRONGEST
            packets["blocks"]["azimuth"] = np.repeat(packets["blocks"]["azimuth"][:, ::3], 3, axis=1)
            yield hesai_figure("XT32M2X, three returns", head, units, repeats)
    for head in (PANDAR40P, PANDAR64, PANDAR128):
        yield hesai_figure(f"{head.name}, strongest return", head, made_units(head, MODE_STRONGEST), repeats)
    file = gzip.decompress((FIXTURES / "hesai" / "at128.dat.gz").read_bytes())
    settings = DeviceSettings("scanner/bench", {}, {"geometry": file})
    for name, mode in (("AT128, strongest return", MODE_STRONGEST), ("AT128, dual return", MODE_LAST_STRONGEST)):
        make = partial(MirrorParser, head=AT128)
        yield head_figure(name, make, settings, made_units(AT128, mode), 10e6, repeats, AIMED_RETURN_DTYPE)


def made_units(head: HesaiHead, mode: int) -> ByteRows:
    """Make 3600 packets of a head without recording, 70 % of the places used."""
    random, shape = np.random.default_rng(1), (head.blocks, head.channels)
    ranges = random.integers(500, 30_000, shape) * (random.random(shape) < 0.7)
    when = dt.datetime(2026, 4, 15, 10, tzinfo=dt.UTC)
    azimuth = 7000 + 20 * (np.arange(head.blocks) // echoes_of(mode))
    one = encode_point_packet(when, azimuth, ranges, 50, mode, head=head, tail={"operation": 2})
    units = np.tile(np.frombuffer(one, dtype=np.uint8), (3600, 1))
    dtype = next(layout.dtype for length, layout in head.layouts().items() if length == len(one))
    units.view(dtype)["sequence"][:, 0] = np.arange(1, len(units) + 1)
    return units


def hesai_units(head: HesaiHead, recording: str) -> ByteRows:
    """Return a recording's packets, repeated several times with continuous sequence numbers and the CRCs of that."""
    packets = [unit.data for unit in read_pcap(FIXTURES / "hesai" / recording)]
    once = np.frombuffer(b"".join(packets), dtype=np.uint8).reshape(len(packets), -1)
    units, dtype = np.tile(once, (max(1, 3600 // len(once)), 1)), head.packet_dtype()
    units.view(dtype)["sequence"][:, 0] = np.arange(1, len(units) + 1)
    sealed = b"".join(with_checksums(unit.tobytes(), dtype) for unit in units)
    return np.frombuffer(bytearray(sealed), dtype=np.uint8).reshape(units.shape)


def hesai_figure(name: str, head: HesaiHead, units: ByteRows, repeats: int) -> Figure:
    """Measure one Hesai head."""
    return head_figure(name, partial(HesaiParser, head=head), DeviceSettings("scanner/bench"), units, 10e6, repeats)


def measure_robosense(repeats: int) -> Iterator[Figure]:
    """Measure RoboSense heads with made packets, 60 % of the places used: 32 lasers, and 16 in dual return."""
    packets = [unit.data for unit in read_pcap(FIXTURES / "robosense" / "made.pcap.gz", port=2368)][24:39]
    units = np.tile(np.frombuffer(b"".join(packets), dtype=np.uint8).reshape(len(packets), -1), (240, 1))
    pairs = units.copy()
    blocks = pairs.view(MSOP_DTYPE)[:, 0]["blocks"]
    blocks["azimuth"] = np.repeat(blocks["azimuth"][:, ::2], 2, axis=1)
    for name, head, sent, mode in (
        ("RS-LiDAR-32, single return", RS32, units, 1),
        ("RS-LiDAR-32, dual return", RS32, pairs, MODE_DUAL_RS),
        ("RS-LiDAR-16, dual return", RS16, units, MODE_DUAL_RS),
    ):
        file = encode_difop(head, np.linspace(-15, 15, head.lasers), mode=mode)
        settings = DeviceSettings("scanner/bench", {}, {"geometry": file})
        yield head_figure(name, partial(RobosenseParser, head=head), settings, sent, 10e6, repeats)


def velodyne_units(name: str, step_us: float) -> ByteRows:
    """Return a recording's data packets, repeated several times with continuous time stamps."""
    packets = [unit.data for unit in read_pcap(FIXTURES / "velodyne" / name, port=2368)]
    once = np.frombuffer(b"".join(packets), dtype=np.uint8).reshape(-1, PACKET_BYTES)
    return with_stamps(np.tile(once, (max(1, 3600 // len(once)), 1)), step_us)


def with_stamps(units: ByteRows, step_us: float) -> ByteRows:
    """Write continuous time stamps into Velodyne data packets."""
    units.view(PACKET_DTYPE)["stamp_us"][:, 0] = np.rint(np.arange(len(units)) * step_us)
    return units


def as_dual(units: ByteRows) -> ByteRows:
    """Return single-return packets as dual-return ones, in which two neighbouring blocks share an azimuth."""
    dual = units.copy()
    packets = dual.view(PACKET_DTYPE)[:, 0]
    packets["mode"], packets["blocks"]["azimuth"] = (
        MODE_DUAL,
        np.repeat(packets["blocks"]["azimuth"][:, ::2], 2, axis=1),
    )
    return dual


def as_vls128(units: ByteRows) -> ByteRows:
    """Return VLP-32C packets as those of a VLS-128, in which four blocks have one azimuth."""
    other = units.copy()
    packets = other.view(PACKET_DTYPE)[:, 0]
    packets["product"], packets["blocks"]["flag"] = VLS128.product_ids[0], VLS128.used_block_flags(dual=False)
    packets["blocks"]["azimuth"] = np.repeat(packets["blocks"]["azimuth"][:, ::4], 4, axis=1)
    return other


def measure_velodyne(repeats: int) -> Iterator[Figure]:
    """Measure VLP-16, VLP-32C and VLS-128 with packets of real recordings.

    Some dual-return packets are made of single-return ones, and those of the VLS-128 of the VLP-32C's.
    """
    vlp16 = velodyne_units("mrpt_vlp16_gps.pcap.gz", 1327.104)
    vlp32c = velodyne_units("nebula_vlp32.pcap.gz", 663.552)
    for name, head, units in (
        ("VLP-16, strongest return", VLP16, vlp16),
        ("VLP-16, dual, 26 % used", VLP16, velodyne_units("nebula_vlp16.pcap.gz", 663.552)),
        ("VLP-16, dual, 67 % used", VLP16, with_stamps(as_dual(vlp16), 663.552)),
        ("VLP-32C, strongest return", VLP32C, vlp32c),
        ("VLP-32C, dual return", VLP32C, with_stamps(as_dual(vlp32c), 331.776)),
        ("VLS-128, strongest return", VLS128, with_stamps(as_vls128(vlp32c), 159.9)),
    ):
        settings = DeviceSettings("scanner/bench")
        yield head_figure(name, partial(VelodyneParser, head=head), settings, units, 10e6, repeats)


def ouster_units(recording: str, layout: LidarLayout) -> ByteRows:
    """Return a recording's first frame, repeated with continuous frame numbers, time stamps and CRCs."""
    per_frame = layout.head.columns_per_frame // layout.head.columns_per_packet
    packets = [unit.data for unit in read_pcap(FIXTURES / "ouster" / f"{recording}.pcap.gz", port=7502)][:per_frame]
    once = np.frombuffer(b"".join(packets), dtype=np.uint8).reshape(per_frame, -1)
    units = np.tile(once, (max(1, 8_000_000 // once.size), 1))
    table = units.view(layout.dtype).reshape(-1)
    frame, columns = np.arange(len(units)) // per_frame, table["columns"]
    columns["time_ns"] = 97_656 * np.arange(columns.size).reshape(columns.shape)
    if layout.legacy:
        columns["frame_id"] = frame[:, np.newaxis]
        return units
    table["frame_id"] = frame
    table["crc"] = [crc64_xz(unit[:-8]) for unit in units]
    return units


def measure_ouster(repeats: int) -> Iterator[Figure]:
    """Measure Ouster heads with real packets; packets with a header get the CRC of newer firmware."""
    for name, recording, metadata in (
        ("Ouster, LEGACY, 32 beams", "OS-1-32-G_v2.1.1_1024x10", "OS-1-32-G_v2.1.1_1024x10"),
        ("Ouster, dual return, 32 beams", "OS-0-32-U1_v2.2.0_1024x10", "OS-0-32-U1_v2.2.0_1024x10"),
        ("Ouster, low rate, 128 beams", "OS-1-128_v2.3.0_1024x10_lb_n3", "OS-1-128_v2.3.0_1024x10"),
    ):
        file = (FIXTURES / "ouster" / f"{metadata}.json").read_bytes()
        settings = DeviceSettings("scanner/bench", {}, {"geometry": file})
        units = ouster_units(recording, OusterParser(settings).layout)
        yield head_figure(name, OusterParser, settings, units, 8e6, repeats)


# --- CAN ------------------------------------------------------------------------------------------------------------


def imu_units(samples: int = 20_000) -> ByteRows:
    """Make frames of fixtures/config/imu.dbc as a 1 kHz unit sends them: ACC, GYR, SAMPLE, and SYNC each second."""
    frames = np.zeros((samples, 3), dtype=[("id", "<u4"), ("length", "<u4"), ("data", "u1", 8)])
    frames["id"], frames["length"] = [257, 258, 256], 6
    random = np.random.default_rng(1)
    frames["data"][:, :2] = random.integers(0, 256, (samples, 2, 8))
    frames["data"][:, 2, :4] = (np.arange(samples, dtype="<u4") * 1000).view(np.uint8).reshape(-1, 4)
    units = frames.reshape(-1).view(np.uint8).reshape(-1, 16)
    sync = np.zeros((1, 16), dtype=np.uint8)
    sync[0, :2], sync[0, 4] = [3, 1], 4
    return np.insert(units, np.arange(0, len(units), 3000), sync, axis=0)


def measure_can(repeats: int) -> Iterator[Figure]:
    """Measure CAN frames decoded by a DBC: an IMU alone on its bus, and a CANmod.gps on the bus of a car."""
    signals = {
        "specific_force": [f"ACC.acc_{axis}" for axis in "xyz"],
        "angular_rate": [f"GYR.gyr_{axis}" for axis in "xyz"],
        "sample_ticks": "SAMPLE.ticks",
        "pps_ticks": "SYNC.pps_ticks",
        "temperature": "SAMPLE.temperature",
    }
    dbc = {"dbc": (FIXTURES / "config" / "imu.dbc").read_bytes()}
    table = {"dbc": "imu.dbc", "tick_hz": 1_000_000, "group": "last", "signals": signals}
    settings = DeviceSettings("imu/bench", table, dbc)
    log = FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz"
    frames = b"".join(unit.data for unit in read_candump(log))
    car = np.tile(np.frombuffer(frames, dtype=np.uint8).reshape(-1, 16), (10, 1))
    makers: list[tuple[str, Callable[[], Parser], ByteRows]] = [
        ("CAN, dbc, 3 frames a sample", lambda: DbcParser(settings), imu_units()),
        ("CAN, canmod-gps recording", lambda: CanmodGpsParser(DeviceSettings("imu/bench")), car),
    ]
    for name, make, units in makers:
        batches = batches_of(units)
        copy, taken = copy_rows(IMU_DTYPE, decode_all(make, batches)), np.empty(units.shape, np.uint8)

        def least(units: ByteRows = units, taken: ByteRows = taken, copy: Callable[[], object] = copy) -> None:
            np.copyto(taken, units)
            copy()

        # one parser serves all repeats, because reading a DBC file is not part of decoding frames
        parser = make()
        decode = rate(
            lambda p=parser, b=batches: [p.feed_batch(batch) for batch in b],  # type: ignore[misc]
            len(units),
            repeats,
        )
        yield Figure(name, "frames", decode, 1e6, rate(least, len(units), repeats), "copy of frames and rows")


# --- serial streams -------------------------------------------------------------------------------------------------


def frames_in(path: Path) -> list[Frame]:
    """Return the frames of a recording, which may be compressed."""
    data = path.read_bytes()
    framer = Framer(GNSS_KINDS, ParserCounters())
    return framer.feed(gzip.decompress(data) if path.suffix == ".gz" else data, 0) + framer.close()


def mixed_stream() -> tuple[bytes, int]:
    """Return 2 MB of real UBX, NMEA and RTCM3 frames in turn, and the number of frames."""
    recordings = [path for kind in ("ubx", "nmea", "rtcm3") for path in sorted((FIXTURES / kind).glob("*"))]
    by_kind: dict[str, list[bytes]] = {}
    for path in recordings:
        if not NO_RECORDING.search(path.name):
            for frame in frames_in(path):
                by_kind.setdefault(frame.kind, []).append(frame.data)
    if set(by_kind) != {"ubx", "nmea", "rtcm3"}:
        raise SystemExit(f"fixtures hold frames of {sorted(by_kind)} only; needs ubx, nmea and rtcm3")
    pieces: list[bytes] = []
    size, turn = 0, 0
    while size < 2_000_000:
        for frames in by_kind.values():
            pieces.append(frames[turn % len(frames)])
            size += len(pieces[-1])
        turn += 1
    return b"".join(pieces), len(pieces)


def measure_framing(repeats: int) -> Iterator[Figure]:
    """Measure the framing of the mixed stream, checksums included, in reads of 4 KiB."""
    stream, count = mixed_stream()
    reads = [stream[at : at + READ_BYTES] for at in range(0, len(stream), READ_BYTES)]
    sync = re.compile(rb"\$|\xb5\x62|\xd3[\x00-\x03]")

    def frame_all() -> int:
        framer = Framer(GNSS_KINDS, ParserCounters())
        found = sum(len(framer.feed(read, 0)) for read in reads) + len(framer.close())
        if found != count:
            raise SystemExit(f"{found} frames framed instead of {count}")
        return found

    def least() -> None:
        for match in sync.finditer(stream):
            match.start()
        crc32(stream)

    name = f"framing, {len(stream) / count:.0f} bytes a frame"
    limit = rate(least, len(stream), repeats)
    yield Figure(
        name, "bytes", rate(frame_all, len(stream), repeats), 5e6, limit, "regular expression over the syncs + CRC-32"
    )


def vectornav_stream(samples: int = 5000) -> bytes:
    """Make messages of a sample each, as ``swath setup`` asks a unit for them."""
    fields = {
        **{(wire.TIME, number): wire.encode_field(wire.TIME, number, 5) for number in (0, 2, 4, 5)},
        (wire.TIME, 3): wire.encode_field(wire.TIME, 3, 2443),
        (wire.TIME, 9): wire.encode_field(wire.TIME, 9, 3),
        **{(wire.IMU, number): wire.encode_field(wire.IMU, number, 0.1, 0.2, -9.8) for number in (2, 3)},
        (wire.IMU, 4): wire.encode_field(wire.IMU, 4, 25.0),
        (wire.IMU, 11): wire.encode_field(wire.IMU, 11, 0),
    }
    return wire.encode_frame(fields) * samples


def measure_inertial(repeats: int) -> Iterator[Figure]:
    """Measure framing and decoding of inertial units' streams in reads of 4 KiB."""
    streams = {"VectorNav, 1 sample a message": ("vectornav", vectornav_stream())}
    for name, protocol, file, times in (
        ("MicroStrain recording", "microstrain", "microstrain/mip_data.bin.gz", 1),
        ("sbgECom, made stream", "sbg-ecom", "sbg-ecom/made.bin.gz", 10),
        ("NCOM, made stream", "oxts-ncom", "oxts-ncom/made.bin.gz", 10),
    ):
        streams[name] = protocol, gzip.decompress((FIXTURES / file).read_bytes()) * times
    for name, (protocol, stream) in streams.items():
        chunks = [
            Chunk("imu/bench", at * 1000, stream[at : at + READ_BYTES]) for at in range(0, len(stream), READ_BYTES)
        ]

        def decode_stream(protocol: str = protocol, chunks: list[Chunk] = chunks) -> Parser:
            parser = find_driver("imu", protocol).make_parser(DeviceSettings("imu/bench"))
            for chunk in chunks:
                parser.feed(chunk)
            return parser

        def least(stream: bytes = stream) -> None:
            crc32(stream)
            bytearray(stream)

        size = decode_stream().counters.bytes_framed
        limit = rate(least, size, repeats)
        yield Figure(name, "bytes", rate(decode_stream, size, repeats), None, limit, "CRC-32 + copy of the stream")


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15, help="measurements per figure; the median counts")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    figures = []
    print(f"{'decoding, one core':<30} {'no numba':>9} {'rate':>9} {'asked':>8} {'limit':>9} {'share':>6}  item, limit")
    for measure in (
        measure_srep,
        measure_velodyne,
        measure_hesai,
        measure_robosense,
        measure_livox,
        measure_ouster,
        measure_can,
        measure_framing,
        measure_inertial,
    ):
        for figure in measure(arguments.repeats):
            figures.append(figure)
            asked = f"{figure.target / 1e6:.0f} M/s" if figure.target else "-"
            plain = f"{figure.plain / 1e6:.1f} M/s" if figure.plain else "-"
            print(
                f"{figure.name:<30} {plain:>9} {figure.rate / 1e6:>5.1f} M/s {asked:>8} {figure.limit / 1e6:>5.0f} M/s "
                f"{figure.rate / figure.limit:>6.1%}  {figure.item}; {figure.limit_is}"
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1))


if __name__ == "__main__":
    main()
