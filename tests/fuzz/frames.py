"""Changes frames and makes their checksums right, because decoders read only what a checksum guards."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable, Sequence

import numpy as np

from swath.drivers import record_frames
from swath.drivers.framing import kinds as frame_kinds
from swath.drivers.framing.checksums import crc16_ccitt, crc24q, crc32_novatel, nmea_xor, ubx_fletcher
from swath.drivers.framing.framer import FrameKind, Framer
from swath.drivers.imu import oxts_ncom
from swath.drivers.imu.microstrain import wire as microstrain
from swath.drivers.imu.sbg_ecom import wire as sbg_ecom
from swath.drivers.imu.vectornav import wire as vectornav
from swath.drivers.parser import ParserCounters
from swath.drivers.scanner.hesai.models import QT128
from swath.drivers.scanner.hesai.parser import with_checksums
from tests.fuzz.mutation import LARGEST_CASE_BYTES, bounds, damage

KINDS: dict[str, FrameKind] = {
    kind.name: kind
    for module in (frame_kinds, microstrain, oxts_ncom, record_frames, sbg_ecom, vectornav)
    for kind in vars(module).values()
    if isinstance(kind, FrameKind)
}
KEPT_OF_A_NAME = 6  # frames of one message in a pool

NMEA_FIELDS = (
    *("", "-", "0", "-0", "00", "1", "-1", "9" * 9, "9" * 30, "-" + "9" * 40, "1e999", "1e5", "nan", "inf", "-inf"),
    *("0.0", ".", "..", "1.", ".5", "1.2.3", "240000", "235960", "235959.999999999", "999999", "000000.00", "310299"),
    *("320100", "290223", "9100.0", "18060.0", "2460.0", "N", "S", "E", "W", "X", "A", "V", "M", "T", "K", "R", "+1"),
    *("1_0", " 1", "1 ", "0x1", "FF", "65536", "4294967296", "0.000000000000000000001"),
)


def _seal_nmea(frame: bytes) -> bytes:
    body = frame[1:].partition(b"*")[0].rstrip(b"\r\n")
    return frame[:1] + body + b"*%02X\r\n" % nmea_xor(body)


def _seal_ubx(frame: bytes) -> bytes:
    payload = frame[6:-2][:8192]
    content = frame[2:4].ljust(2, b"\1") + struct.pack("<H", len(payload)) + payload
    return b"\xb5b" + content + bytes(ubx_fletcher(content))


def _seal_rtcm3(frame: bytes) -> bytes:
    payload = frame[3:-3][:1023]
    content = b"\xd3" + struct.pack(">H", len(payload)) + payload
    return content + crc24q(content).to_bytes(3, "big")


def _seal_novatel(frame: bytes) -> bytes:
    content = bytearray(b"\xaaD\x12" + frame[3:-4].ljust(25, b"\0"))
    if not 28 <= content[3] <= min(64, len(content)):
        content[3] = 28
    del content[content[3] + 24 * 1024 :]
    struct.pack_into("<H", content, 8, len(content) - content[3])
    return bytes(content) + struct.pack("<I", crc32_novatel(content))


def _seal_novatel_short(frame: bytes) -> bytes:
    content = bytearray(b"\xaaD\x13" + frame[3:-4].ljust(9, b"\0")[:264])
    content[3] = len(content) - 12
    return bytes(content) + struct.pack("<I", crc32_novatel(content))


def _seal_genout(frame: bytes) -> bytes:
    content = frame[1:2].ljust(1, b"\0") + b"\x40" + bytes([len(frame[4:-2][:255])]) + frame[4:-2][:255]
    return b"\x02" + content + bytes([sum(content) & 0xFF]) + b"\x03"


def _seal_pos(frame: bytes) -> bytes:
    begin = frame[:4] if frame[:4] in (b"$GRP", b"$MSG") else b"$GRP"
    data = frame[8:-4][: 16 * 1024 - 12]
    data += bytes(-len(data) % 4)
    content = begin + frame[4:6].ljust(2, b"\1") + struct.pack("<H", len(data) + 4) + data
    total = sum(struct.unpack(f"<{len(content) // 2}H", content)) + int.from_bytes(b"$#", "little")
    return content + struct.pack("<H", -total & 0xFFFF) + b"$#"


def _seal_unicore(frame: bytes) -> bytes:
    content = bytearray(b"\xaaD\xb5" + frame[3:-4].ljust(21, b"\0")[: 21 + 16 * 1024])
    struct.pack_into("<H", content, 6, len(content) - 24)
    return bytes(content) + struct.pack("<I", crc32_novatel(content))


def _seal_novatel_ascii(frame: bytes) -> bytes:
    sync = frame[:1] if frame[:1] in (b"#", b"%") else b"#"
    text = frame[1:].rpartition(b"*")[0] or frame[1:]
    content = bytes(byte for byte in text if 0x20 <= byte < 0x7F and byte != 0x2A)[:16_000]
    if not frame_kinds.NOVATEL_ASCII_BEGIN.match(sync + content + b"!"):
        content = b"BESTPOSA," + content
    return sync + content + b"*%08x\r\n" % crc32_novatel(content)


def _seal_xbus(frame: bytes) -> bytes:
    identifier = frame[2:3] if frame[2:3] in [bytes([one]) for one in frame_kinds.XBUS_IDENTIFIERS] else b"\x36"
    payload = frame[6 if frame[3:4] == b"\xff" else 4 : -1][:2048]
    length = bytes([len(payload)]) if len(payload) < 255 else b"\xff" + struct.pack(">H", len(payload))
    content = b"\xff" + identifier + length + payload
    return b"\xfa" + content + bytes([-sum(content) & 0xFF])


def _seal_sbf(frame: bytes) -> bytes:
    content = frame[4:6].ljust(2, b"\0") + b"\0\0" + frame[8 : 16 * 1024]
    content += bytes(-len(content) % 4)
    content = content[:2] + struct.pack("<H", len(content) + 4) + content[4:]
    return b"$@" + struct.pack("<H", crc16_ccitt(content)) + content


def _seal_vectornav(frame: bytes) -> bytes:
    content = frame[:-2].ljust(vectornav.MAX_BYTES, b"\0")
    length = vectornav.measure(content, 0, True)
    if length <= 0:  # no header: the content becomes that of yaw, pitch and roll
        content = b"\xfa\x01\x08\0" + content
        length = vectornav.measure(content, 0, True)
    body = content[1 : length - 2]
    return b"\xfa" + body + crc16_ccitt(body).to_bytes(2, "big")


def _seal_mip(frame: bytes) -> bytes:
    payload = frame[4:-2][:255]
    body = b"ue" + frame[2:3].ljust(1, b"\x80") + bytes([len(payload)]) + payload
    return body + bytes(ubx_fletcher(body))


def _seal_sbg_ecom(frame: bytes) -> bytes:
    kind = frame[3] if frame[3:4] and frame[3] in sbg_ecom.CLASSES else 0
    return sbg_ecom.encode_frame(frame[2] if frame[2:3] else 44, frame[6:-3][: sbg_ecom.MAX_DATA_BYTES], kind)


def _seal_ncom(frame: bytes) -> bytes:
    packet = bytearray(b"\xe7" + frame[1:71].ljust(70, b"\0")) + b"\0"
    if packet[oxts_ncom.STATUS_AT] not in oxts_ncom.PUBLIC:
        packet[oxts_ncom.STATUS_AT] = oxts_ncom.LOCKED
    for at in (oxts_ncom.CHECKSUM_1, oxts_ncom.CHECKSUM_2, 71):
        packet[at] = oxts_ncom.checksum(packet, at)
    return bytes(packet)


def _seal_records(frame: bytes) -> bytes:
    content = bytearray(record_frames.SYNC + frame[4:-4].ljust(12, b"\0")[: record_frames.MAX_BYTES - 8])
    struct.pack_into("<I", content, 8, len(content) + 4)
    return bytes(content) + struct.pack("<I", zlib.crc32(content))


SEALS: dict[str, Callable[[bytes], bytes]] = {
    "nmea": _seal_nmea,
    "ubx": _seal_ubx,
    "rtcm3": _seal_rtcm3,
    "novatel": _seal_novatel,
    "novatel-short": _seal_novatel_short,
    "novatel-ascii": _seal_novatel_ascii,
    "unicore": _seal_unicore,
    "genout": _seal_genout,
    "pos": _seal_pos,
    "xbus": _seal_xbus,
    "sbf": _seal_sbf,
    "vectornav": _seal_vectornav,
    "mip": _seal_mip,
    "sbg-ecom": _seal_sbg_ecom,
    "ncom": _seal_ncom,
    "records": _seal_records,
}
"""Length and checksum of a frame made right, whatever is in it; by the name of its kind."""


def split_frames(data: bytes) -> list[tuple[str, bytes]]:
    """Split a stream into frames with their kind, and the bytes between them with an empty kind."""
    framer = Framer(tuple(KINDS.values()), ParserCounters())
    pieces: list[tuple[str, bytes]] = []
    position = 0
    for frame in [*framer.feed(data, 0), *framer.close()]:
        start = data.index(frame.data, position)
        if start > position:
            pieces.append(("", data[position:start]))
        pieces.append((frame.kind, frame.data))
        position = start + len(frame.data)
    return [*pieces, ("", data[position:])] if position < len(data) else pieces


class FramePool:
    """A few frames of every message in the recordings, however frequent it is."""

    def __init__(self, recordings: Sequence[bytes]) -> None:
        by_name: dict[tuple[str, str], list[bytes]] = {}
        for recording in recordings:
            for kind, data in split_frames(recording):
                if kind:
                    kept = by_name.setdefault((kind, KINDS[kind].message_name(data)), [])
                    if len(kept) < KEPT_OF_A_NAME and data not in kept:
                        kept.append(data)
        self._by_name = [(kind, frames) for (kind, _), frames in sorted(by_name.items())]

    def draw(self, rng: random.Random) -> tuple[str, bytes]:
        """Draw a frame, with equal probability for each message."""
        if not self._by_name:
            return "", rng.randbytes(rng.randrange(1, 60))
        kind, frames = rng.choice(self._by_name)
        return kind, rng.choice(frames)


def mutate_stream(rng: random.Random, base: bytes, pool: FramePool) -> bytes:
    """Return some frames of the base and of the pool, most of them changed and sealed again, some left broken."""
    pieces = split_frames(base[:LARGEST_CASE_BYTES]) or [("", base)]
    first = rng.randrange(len(pieces))
    chosen = pieces[first : first + 1 + int(12 * rng.random() ** 2)]
    for _ in range(rng.choice((0, 0, 1, 2, 4))):
        chosen.insert(rng.randrange(len(chosen) + 1), pool.draw(rng))
    if rng.random() < 0.1:
        rng.shuffle(chosen)
    if rng.random() < 0.2:
        chosen += [rng.choice(chosen)] * rng.randrange(1, 4)
    data = b"".join(_changed(rng, kind, piece) if rng.random() < 0.6 else piece for kind, piece in chosen)
    if rng.random() < 0.08:
        data = damage(rng, data)
    return data[:LARGEST_CASE_BYTES]


def _changed(rng: random.Random, kind: str, frame: bytes) -> bytes:
    seal = SEALS.get(kind)
    if seal is None:
        return damage(rng, frame)
    if kind in ("nmea", "novatel-ascii"):
        return seal(_changed_sentence(rng, frame))
    # the head tells what a frame is (identifier, time), so it is changed rarely
    start = 2 if rng.random() < 0.15 else min(6, len(frame) - 1)
    return seal(damage(rng, frame, resize=rng.random() < 0.15, start=start))


def _changed_sentence(rng: random.Random, sentence: bytes) -> bytes:
    fields = sentence.partition(b"*")[0].split(b",")
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(fields))
        kind = rng.randrange(8)
        if kind < 4 and at:
            fields[at] = rng.choice(NMEA_FIELDS).encode()
        elif kind == 4:
            text = bytearray(fields[at] or b"0")
            text[rng.randrange(len(text))] = rng.randrange(0x2D, 0x5B)
            fields[at] = bytes(text)
        elif kind == 5:
            fields[at:at] = [rng.choice(NMEA_FIELDS).encode()] * rng.choice((1, 2, 40))
        elif kind == 6 and len(fields) > 1:
            del fields[rng.randrange(1, len(fields))]
        elif kind == 7:
            fields[0] = fields[0][:3] + rng.choice(
                (
                    b"GGA",
                    b"RMC",
                    b"ZDA",
                    b"VTG",
                    b"GST",
                    b"HDT",
                    b"THS",
                    b"HPR",
                    rng.randbytes(2).hex().upper().encode(),
                )
            )
    return b",".join(fields)


# --- datagrams ------------------------------------------------------------------------------------------------------

_CRC64_POLYNOMIAL = 0xC96C5795D7870F42  # of ECMA-182, reflected, as in .xz


def _crc64_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (_CRC64_POLYNOMIAL if value & 1 else 0)
        table.append(value)
    return table


_CRC64 = _crc64_table()


def crc64_xz(data: bytes) -> int:
    """Return CRC-64 as defined by the .xz format."""
    crc = (1 << 64) - 1
    for byte in data:
        crc = _CRC64[(crc ^ byte) & 0xFF] ^ crc >> 8
    return crc ^ ((1 << 64) - 1)


HESAI_HEADS = (QT128,)
TAILS: tuple[tuple[int, Callable[[bytes], int]], ...] = ((4, zlib.crc32), (8, crc64_xz))


def _hesai_layouts(sample: Sequence[bytes]) -> list[np.dtype[np.void]]:
    """Return the layouts of Hesai heads with CRCs that these datagrams have."""
    dtypes = (layout.dtype for head in HESAI_HEADS for layout in head.layouts().values())
    fit = [dtype for dtype in dtypes if sample and {len(one) for one in sample} == {dtype.itemsize}]
    return [dtype for dtype in fit if all(with_checksums(one, dtype) == one for one in sample)][:1]


def tail_of(datagrams: Sequence[bytes]) -> Callable[[bytes], bytes]:
    """Return what seals a changed datagram again: the checksum that the recorded datagrams hold, if any.

    It is at their end, within them (the two of a Hesai head), or in the header (a Livox head).
    """
    sample = [datagram for datagram in datagrams[:8] if len(datagram) > 16]
    for dtype in _hesai_layouts(sample):
        return lambda datagram: with_checksums(datagram, dtype) if len(datagram) == dtype.itemsize else datagram
    for width, checksum in TAILS:
        if sample and all(checksum(one[:-width]) == int.from_bytes(one[-width:], "little") for one in sample):
            return lambda datagram: datagram[:-width] + checksum(datagram[:-width]).to_bytes(width, "little")
    if sample and any(_holds_in_header(one) for one in sample):
        return lambda datagram: _seal_header(datagram) if len(datagram) > HEADER_CRC_AT + 4 else datagram
    return lambda datagram: datagram


HEADER_CRC_AT = 24  # of a Livox packet of SDK 2: CRC-32 of all that follows it


def _holds_in_header(datagram: bytes) -> bool:
    return _seal_header(datagram) == datagram and any(datagram[HEADER_CRC_AT : HEADER_CRC_AT + 4])


def _seal_header(datagram: bytes) -> bytes:
    rest = datagram[HEADER_CRC_AT + 4 :]
    return datagram[:HEADER_CRC_AT] + zlib.crc32(rest).to_bytes(4, "little") + rest


def changed_datagram(rng: random.Random, datagram: bytes, seal: Callable[[bytes], bytes]) -> bytes:
    """Change a few fields of a datagram, mostly near its beginning, and usually seal it again."""
    if rng.random() < 0.3:
        head = damage(rng, datagram[:64], resize=False)
        changed = head + datagram[64:]
    else:
        changed = damage(rng, datagram, resize=rng.random() < 0.1)
    return seal(changed) if rng.random() < 0.95 else changed + bounds(rng)
