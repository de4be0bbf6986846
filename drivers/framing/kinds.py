"""The frames of receivers and inertial units in a stream: sync, length and its bound, checksum, name."""

from __future__ import annotations

import re
import struct
from functools import lru_cache

from swath.drivers.framing.checksums import crc16_ccitt, crc24q, crc24q_marks, crc32_novatel, nmea_xor, ubx_fletcher
from swath.drivers.framing.framer import FALSE_SYNC, NO_CHECKSUM, OVER_BOUND, UNDECIDED, FrameKind

# --- NMEA 0183: $ttsss,field,…*hh CR LF -----------------------------------------------------------------------------

# The standard allows 82 characters; proprietary sentences (PUBX,03 with 32 satellites, PQTM…) reach several hundred.
NMEA_MAX_BYTES = 1024
NMEA_LONGEST_ADDRESS = 16  # longest address that the search for its comma covers
NMEA_NUMBER_END = 9  # end of the number in $PUBX,00,
# A whole sentence with its line end, the usual case: body and checksum as below, the body of any permitted length.
NMEA_SENTENCE = re.compile(rb"[$!][A-Z][ -#%%-)+-~]{0,%d}\*[0-9A-Fa-f]{2}\r?\n" % (NMEA_MAX_BYTES - 7))
NMEA_BODY = re.compile(rb"[$!][A-Z][ -#%-)+-~]*")  # printable, neither $ (a new sentence) nor * (the checksum)
NMEA_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{2}")
NMEA_UNCHECKED = re.compile(rb"[$!][A-Z]{2}[A-Z0-9]{1,13},[ -#%-)+-~]*\r?\n")  # up to its line end, without a star
NMEA_ADDRESS = re.compile(rb"[$!]([A-Z0-9]+)(?:,(\d\d)(?=[,*]))?")


def measure_nmea(buffer: bytes, start: int, final: bool) -> int:
    """Measure a sentence with its line end, or up to its checksum where the line end is missing (6.1 of NMEA 0183)."""
    sentence = NMEA_SENTENCE.match(buffer, start)
    if sentence:
        return sentence.end() - start
    body = NMEA_BODY.match(buffer, start, start + NMEA_MAX_BYTES)
    star = body.end() if body else min(start + 1, len(buffer))
    if star - start > NMEA_MAX_BYTES - 5:
        return FALSE_SYNC
    if star < len(buffer) and buffer[star] != 0x2A:
        if buffer[star:] == b"\r" and not final:
            return UNDECIDED
        return NO_CHECKSUM if NMEA_UNCHECKED.match(buffer, start) else FALSE_SYNC
    if star + 3 > len(buffer):
        return UNDECIDED
    if not body or not NMEA_CHECKSUM.match(buffer, star):
        return FALSE_SYNC
    ending = buffer[star + 3 : star + 5]
    if ending in (b"", b"\r") and not final:
        return UNDECIDED
    return star + 3 - start + (2 if ending == b"\r\n" else 1 if ending[:1] == b"\n" else 0)


def intact_nmea(frame: bytes) -> bool:
    """Return whether the two hexadecimal digits are the XOR of the body."""
    star = frame.rindex(b"*")
    return nmea_xor(frame[1:star]) == int(frame[star + 1 : star + 3], 16)


def nmea_name(frame: bytes) -> str:
    """Return ``GGA`` for any talker, a maker's own sentence by its whole address, and u-blox's with its number
    (``PUBX00``).
    """
    comma = frame.find(b",", 0, NMEA_LONGEST_ADDRESS)
    if comma < 0:
        return _nmea_name(frame)
    return _nmea_name(frame[: NMEA_NUMBER_END if comma == 5 and frame[1:5] == b"PUBX" else comma])


@lru_cache(maxsize=256)
def _nmea_name(beginning: bytes) -> str:
    match = NMEA_ADDRESS.match(beginning)
    address, number = (match.group(1).decode(), match.group(2)) if match else ("", None)
    if not address.startswith("P") and len(address) == 5:
        return address[2:]
    return address + number.decode() if address == "PUBX" and number else address or "?"


# --- UBX: B5 62, class, id, u16 length, payload, Fletcher (u-blox F9 interface description, 3.2) ---------------------

# The longest message that a receiver sends by itself: RXM-RAWX of 255 measurements, 16 + 32 · 255 = 8176 bytes.
UBX_MAX_PAYLOAD_BYTES = 8192
UBX_OVERHEAD_BYTES = 8
UBX_LENGTH = struct.Struct("<4xH")

# Class and its name, then ids and their names in hexadecimal: message overviews of the F9, F10, M8 and antaris 4
# interface descriptions.
UBX_NAME_TABLE = """
01 NAV 01 POSECEF 02 POSLLH 03 STATUS 04 DOP 05 ATT 06 SOL 07 PVT 09 ODO 10 RESETODO 11 VELECEF 12 VELNED
01 NAV 13 HPPOSECEF 14 HPPOSLLH 17 PVAT 20 TIMEGPS 21 TIMEUTC 22 CLOCK 23 TIMEGLO 24 TIMEBDS 25 TIMEGAL 26 TIMELS
01 NAV 27 TIMEQZSS 28 NMI 30 SVINFO 31 DGPS 32 SBAS 34 ORB 35 SAT 36 COV 39 GEOFENCE 3B SVIN 3C RELPOSNED 3D EELL
01 NAV 40 EKFSTATUS 42 SLAS 43 SIG 45 DAHEADING 60 AOPSTATUS 61 EOE 62 PL 63 TIMENAVIC 64 TIMETRUSTED
02 RXM 10 RAW 11 SFRB 13 SFRBX 14 MEASX 15 RAWX 20 SVSI 30 ALM 31 EPH 32 RTCM 33 SPARTN 34 COR 36 SPARTN-KEY
02 RXM 41 PMREQ 59 RLM 61 IMES 72 PMP 73 QZSSL6 74 TM 80 MEASD12 82 MEASC12 84 MEAS20 86 MEAS50
04 INF 00 ERROR 01 WARNING 02 NOTICE 03 TEST 04 DEBUG
05 ACK 00 NAK 01 ACK
06 CFG
09 UPD 14 SOS
0A MON 02 IO 04 VER 06 MSGPP 07 RXBUF 08 TXBUF 09 HW 0B HW2 21 RXR 27 PATCH 28 GNSS 2E SMGR 31 SPAN 32 BATCH 36 COMMS
0A MON 37 HW3 38 RF 39 SYS
0B AID 01 INI 02 HUI 30 ALM 31 EPH 33 AOP
0D TIM 01 TP 03 TM2 04 SVIN 06 VRFY 11 DOSC 12 TOS 13 SMEAS 15 VCOCAL 16 FCHG 17 HOC
10 ESF 02 MEAS 03 RAW 10 STATUS 13 RESETALG 14 ALG 15 INS 16 SLAS
13 MGA 60 ACK 80 DBD
21 LOG 08 INFO 09 RETRIEVE 0B RETRIEVEPOS 0D RETRIEVESTRING 0E FINDTIME 0F RETRIEVEPOSEXTRA 11 BATCH
27 SEC 01 SIGN 03 UNIQID 09 SIG 10 SIGLOG 0A OSNMA
28 HNR 00 PVT 01 ATT 02 INS
29 NAV2 01 POSECEF 02 POSLLH 03 STATUS 04 DOP 07 PVT 09 ODO 11 VELECEF 12 VELNED 17 PVAT 20 TIMEGPS 21 TIMEUTC 22 CLOCK
29 NAV2 23 TIMEGLO 24 TIMEBDS 25 TIMEGAL 26 TIMELS 27 TIMEQZSS 32 SBAS 35 SAT 36 COV 3B SVIN 3D EELL 42 SLAS 43 SIG
29 NAV2 61 EOE 63 TIMENAVIC
"""


def _read_ubx_names(table: str) -> dict[bytes, str]:
    """Return message names by class and id (two bytes), and class names by class (one byte)."""
    names: dict[bytes, str] = {}
    for line in table.strip().splitlines():
        family, title, *pairs = line.split()
        names[bytes.fromhex(family)] = title
        for number, name in zip(pairs[::2], pairs[1::2], strict=True):
            names[bytes.fromhex(family + number)] = f"{title}-{name}"
    return names


UBX_NAMES = _read_ubx_names(UBX_NAME_TABLE)


def measure_ubx(buffer: bytes, start: int, final: bool) -> int:
    """Measure a frame by its length field."""
    if len(buffer) - start < UBX_LENGTH.size:
        return UNDECIDED
    payload: int = UBX_LENGTH.unpack_from(buffer, start)[0]
    return payload + UBX_OVERHEAD_BYTES if payload <= UBX_MAX_PAYLOAD_BYTES else OVER_BOUND


def intact_ubx(frame: bytes) -> bool:
    """Return whether the Fletcher checksum over class to payload is good."""
    return (frame[-2], frame[-1]) == ubx_fletcher(frame[2:-2])


def ubx_name(frame: bytes) -> str:
    """Return a name such as ``NAV-PVT``, or ``CFG-3E`` where the table has the class only."""
    return UBX_NAMES.get(frame[2:4]) or f"{UBX_NAMES.get(frame[2:3], f'UBX-{frame[2]:02X}')}-{frame[3]:02X}"


# --- RTCM 3: D3, 6 zero bits, 10-bit length, payload, CRC-24Q (RTCM 10403.3, 4.1) ------------------------------------

RTCM3_MAX_BYTES = 3 + 1023 + 3  # the length has 10 bits


def measure_rtcm3(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, payload by the length field, and CRC."""
    if len(buffer) - start < 3:
        return UNDECIDED
    return ((buffer[start + 1] & 3) << 8 | buffer[start + 2]) + 6


def rtcm3_name(frame: bytes) -> str:
    """Return a name such as ``RTCM1077``; the message number is the payload's first 12 bits."""
    return f"RTCM{frame[3] << 4 | frame[4] >> 4}" if len(frame) >= 8 else "RTCM-empty"


# --- NovAtel OEM binary: AA 44 12 (long header) and AA 44 13 (short header), CRC-32 (OEM7 commands and logs, Binary) --

# Long: the longest log is RANGE of all 555 channels of an OEM7, 4 + 44 · 555 = 24 424 bytes.
NOVATEL_MAX_MESSAGE_BYTES = 24 * 1024
NOVATEL_HEADER_BYTES = 28  # "the header length is variable": its growth is bounded too
NOVATEL_MAX_HEADER_BYTES = 64
NOVATEL_LENGTHS = struct.Struct("<3xB4xH")  # header length, message length
NOVATEL_SHORT_HEADER_BYTES = 12  # message length is the byte after the sync
NOVATEL_MESSAGE_ID = struct.Struct("<4xH")  # both headers


def measure_novatel(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, message and CRC of the long form."""
    if len(buffer) - start < NOVATEL_LENGTHS.size:
        return UNDECIDED
    header, message = NOVATEL_LENGTHS.unpack_from(buffer, start)
    if not NOVATEL_HEADER_BYTES <= header <= NOVATEL_MAX_HEADER_BYTES or message > NOVATEL_MAX_MESSAGE_BYTES:
        return OVER_BOUND
    return int(header + message + 4)


def measure_novatel_short(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, message and CRC of the short form."""
    if len(buffer) - start < 4:
        return UNDECIDED
    return NOVATEL_SHORT_HEADER_BYTES + buffer[start + 3] + 4


def novatel_name(frame: bytes) -> str:
    """Return a name such as ``NOVATEL-42`` by the message id; `swath.drivers.gnss.novatel.parser` has the real
    names.
    """
    return f"NOVATEL-{NOVATEL_MESSAGE_ID.unpack_from(frame)[0]}"


# --- NovAtel and Unicore ASCII: #NAME,header;fields*CRC-32, short header %NAME,… (OEM7 commands and logs, ASCII) ------

# A RANGEA of 150 signals has 15 kB; longer logs are not decoded here, and their bytes are skipped.
NOVATEL_ASCII_MAX_BYTES = 16 * 1024
NOVATEL_ASCII_BODY = re.compile(rb"[#%][A-Z][A-Z0-9_]*,[ -)+-~]*")  # printable, not * (the checksum)
NOVATEL_ASCII_BEGIN = re.compile(rb"[#%](?:\Z|[A-Z][A-Z0-9_]{0,31}(?:,|\Z))")
NOVATEL_ASCII_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{8}")
NOVATEL_ASCII_TAIL_BYTES = 9  # star and checksum


def measure_novatel_ascii(buffer: bytes, start: int, final: bool) -> int:
    """Measure a log with its line end, or up to its checksum where the line end is missing."""
    if not NOVATEL_ASCII_BEGIN.match(buffer, start):
        return FALSE_SYNC
    body = NOVATEL_ASCII_BODY.match(buffer, start, start + NOVATEL_ASCII_MAX_BYTES)
    star = body.end() if body else len(buffer)
    end = star + NOVATEL_ASCII_TAIL_BYTES
    if end - start > NOVATEL_ASCII_MAX_BYTES - 2:
        return OVER_BOUND
    if end > len(buffer):
        plausible = star == len(buffer) or buffer[star] == 0x2A
        return UNDECIDED if plausible else FALSE_SYNC
    if not NOVATEL_ASCII_CHECKSUM.match(buffer, star):
        return FALSE_SYNC
    ending = buffer[end : end + 2]
    if ending in (b"", b"\r") and not final:
        return UNDECIDED
    return end - start + (2 if ending == b"\r\n" else 1 if ending[:1] == b"\n" else 0)


def intact_novatel_ascii(frame: bytes) -> bool:
    """Return whether the eight hexadecimal digits are the CRC-32 of the bytes between the first one and the star."""
    star = frame.rindex(b"*")
    return crc32_novatel(frame[1:star]) == int(frame[star + 1 : star + NOVATEL_ASCII_TAIL_BYTES], 16)


def novatel_ascii_name(frame: bytes) -> str:
    """Return the name of the log without its format letter, and without the number of a secondary antenna."""
    name = frame[1 : frame.index(b",")].partition(b"_")[0].decode()
    return name[:-1] if name.endswith("A") else name


# --- Unicore binary: AA 44 B5, 24 bytes of header, message, CRC-32 (N4 command reference, binary header) --------------

UNICORE_HEADER_BYTES = 24
UNICORE_MAX_MESSAGE_BYTES = 16 * 1024  # the longest, OBSVM of 400 signals with 40 bytes each
UNICORE_LENGTHS = struct.Struct("<4xHH")  # message id, message length


def measure_unicore(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, message and CRC."""
    if len(buffer) - start < UNICORE_LENGTHS.size:
        return UNDECIDED
    message = UNICORE_LENGTHS.unpack_from(buffer, start)[1]
    return UNICORE_HEADER_BYTES + message + 4 if message <= UNICORE_MAX_MESSAGE_BYTES else OVER_BOUND


def unicore_name(frame: bytes) -> str:
    """Return a name such as ``UNICORE-2118``; `swath.drivers.gnss.unicore` has the real names."""
    return f"UNICORE-{UNICORE_LENGTHS.unpack_from(frame)[0]}"


# --- Trimble DCOL GENOUT: 02, status, 40, length, data, sum, 03 (Trimble OEM receiver help, GSOF messages) ------------

GENOUT_OVERHEAD_BYTES = 6
GENOUT_END = 0x03


def measure_genout(buffer: bytes, start: int, final: bool) -> int:
    """Measure a packet by its length byte; it must end in 03."""
    if len(buffer) - start < 4:
        return UNDECIDED
    length = buffer[start + 3] + GENOUT_OVERHEAD_BYTES
    end = start + length
    return FALSE_SYNC if end <= len(buffer) and buffer[end - 1] != GENOUT_END else length


def intact_genout(frame: bytes) -> bool:
    """Return whether the sum of status to data, modulo 256, is the byte behind the data."""
    return sum(frame[1:-2]) & 0xFF == frame[-2]


# --- Applanix POS: $GRP or $MSG, id, length, data with padding, sum, $# (POS AV and LV user interface documents) ------

POS_HEADER_BYTES = 8
POS_LENGTHS = struct.Struct("<4xHH")  # id, length behind this field
POS_MAX_BYTES = 16 * 1024
POS_TAIL = b"$#"


def measure_pos(buffer: bytes, start: int, final: bool) -> int:
    """Measure a group or message by its length field, a multiple of 4; it must end in ``$#``."""
    if len(buffer) - start < POS_HEADER_BYTES:
        return UNDECIDED
    if buffer[start + 1 : start + 4] not in (b"GRP", b"MSG"):
        return FALSE_SYNC
    length = POS_HEADER_BYTES + POS_LENGTHS.unpack_from(buffer, start)[1]
    if length % 4 or length < POS_HEADER_BYTES + 4:
        return FALSE_SYNC
    if length > POS_MAX_BYTES:
        return OVER_BOUND
    end = start + length
    return FALSE_SYNC if end <= len(buffer) and buffer[end - 2 : end] != POS_TAIL else length


def intact_pos(frame: bytes) -> bool:
    """Return whether all 16-bit words, checksum included, add up to 0 modulo 65536."""
    total: int = sum(struct.unpack(f"<{len(frame) // 2}H", frame))
    return total & 0xFFFF == 0


def pos_name(frame: bytes) -> str:
    """Return a name such as ``GRP1`` or ``MSG50``."""
    return f"{frame[1:4].decode()}{POS_LENGTHS.unpack_from(frame)[0]}"


# --- Xbus: FA FF, message identifier, length, data, checksum (Xsens MT Low-Level Communication Protocol) --------------

XBUS_MAX_DATA_BYTES = 2048  # data of a message with an extended length
XBUS_EXTENDED = 0xFF  # length byte: the length follows in two bytes, high one first
XBUS_MTDATA2 = 0x36
XBUS_NAMES = {0x32: "MTData", XBUS_MTDATA2: "MTData2", 0x3E: "WakeUp", 0x42: "Error"}  # a device sends these unasked
XBUS_IDENTIFIERS = bytes(sorted({*XBUS_NAMES, *range(1, 256, 2)}))  # its answers have odd identifiers


def measure_xbus(buffer: bytes, start: int, final: bool) -> int:
    """Measure preamble, bus and message identifier, length, data and checksum."""
    if len(buffer) - start < 4:
        return UNDECIDED
    length = buffer[start + 3]
    if length != XBUS_EXTENDED:
        return length + 5
    if len(buffer) - start < 6:
        return UNDECIDED
    length = buffer[start + 4] << 8 | buffer[start + 5]
    return length + 7 if length <= XBUS_MAX_DATA_BYTES else OVER_BOUND


def intact_xbus(frame: bytes) -> bool:
    """Return whether all bytes but the preamble, checksum included, add up to 0 modulo 256."""
    return sum(frame[1:]) & 0xFF == 0


def xbus_name(frame: bytes) -> str:
    """Return a name such as ``MTData2``, or ``XBUS-31`` where the table has no name."""
    return XBUS_NAMES.get(frame[2]) or f"XBUS-{frame[2]:02X}"


# --- Septentrio SBF: $@, CRC-16, block id, length, block (PolaRx5TR reference guide, 4.1.1) ---------------------------

# The length field reaches 64 KiB; RTKLIB, which decodes the longest blocks (measurements), takes 16 KiB (MAXRAWLEN).
SBF_MAX_BYTES = 16 * 1024
SBF_HEADER_BYTES = 8
SBF_HEADER = struct.Struct("<2xHHH")  # CRC, id and revision, length
SBF_CRC_START = 4  # the CRC covers everything from the id on
SBF_NUMBER_BITS = 0x1FFF  # block number within the id; the three bits above are the revision


def measure_sbf(buffer: bytes, start: int, final: bool) -> int:
    """Measure a block by its length field, which counts the whole block and is always a multiple of 4."""
    if len(buffer) - start < SBF_HEADER_BYTES:
        return UNDECIDED
    length: int = SBF_HEADER.unpack_from(buffer, start)[2]
    if length % 4 or length < SBF_HEADER_BYTES:
        return FALSE_SYNC
    return length if length <= SBF_MAX_BYTES else OVER_BOUND


def intact_sbf(frame: bytes) -> bool:
    """Return whether the CRC in the header matches that of the following bytes."""
    return bool(SBF_HEADER.unpack_from(frame)[0] == crc16_ccitt(memoryview(frame)[SBF_CRC_START:]))


def sbf_name(frame: bytes) -> str:
    """Return a name such as ``SBF-4007`` by the block's number; `swath.drivers.gnss.sbf.parser` has the real names."""
    return f"SBF-{SBF_HEADER.unpack_from(frame)[1] & SBF_NUMBER_BITS}"


# before NMEA, whose sentences begin alike: the first kind of a list that matches counts
POS = FrameKind("pos", (b"$", b"GM", b"RS", b"PG"), POS_MAX_BYTES, measure_pos, intact_pos, pos_name)
NMEA = FrameKind("nmea", (b"$!", bytes(range(0x41, 0x5B))), NMEA_MAX_BYTES, measure_nmea, intact_nmea, nmea_name)
UBX = FrameKind(
    "ubx",
    (b"\xb5", b"b"),
    UBX_MAX_PAYLOAD_BYTES + UBX_OVERHEAD_BYTES,
    measure_ubx,
    intact_ubx,
    ubx_name,
)
RTCM3 = FrameKind(
    "rtcm3",
    (b"\xd3", b"\x00\x01\x02\x03"),
    RTCM3_MAX_BYTES,
    measure_rtcm3,
    lambda frame: crc24q(frame) == 0,
    rtcm3_name,
    crc24q_marks,
)
NOVATEL = FrameKind(
    "novatel",
    (b"\xaa", b"D", b"\x12"),
    NOVATEL_MAX_HEADER_BYTES + NOVATEL_MAX_MESSAGE_BYTES + 4,
    measure_novatel,
    lambda frame: crc32_novatel(frame) == 0,
    novatel_name,
)
NOVATEL_SHORT = FrameKind(
    "novatel-short",
    (b"\xaa", b"D", b"\x13"),
    NOVATEL_SHORT_HEADER_BYTES + 255 + 4,
    measure_novatel_short,
    lambda frame: crc32_novatel(frame) == 0,
    novatel_name,
)

GENOUT = FrameKind(
    "genout",
    (b"\x02", bytes(range(256)), b"\x40"),
    255 + GENOUT_OVERHEAD_BYTES,
    measure_genout,
    intact_genout,
    lambda frame: "GENOUT",
)
UNICORE = FrameKind(
    "unicore",
    (b"\xaa", b"D", b"\xb5"),
    UNICORE_HEADER_BYTES + UNICORE_MAX_MESSAGE_BYTES + 4,
    measure_unicore,
    lambda frame: crc32_novatel(frame) == 0,
    unicore_name,
)
NOVATEL_ASCII = FrameKind(
    "novatel-ascii",
    (b"#%", bytes(range(0x41, 0x5B))),
    NOVATEL_ASCII_MAX_BYTES,
    measure_novatel_ascii,
    intact_novatel_ascii,
    novatel_ascii_name,
)

XBUS = FrameKind(
    "xbus",
    (b"\xfa", b"\xff", XBUS_IDENTIFIERS),
    XBUS_MAX_DATA_BYTES + 7,
    measure_xbus,
    intact_xbus,
    xbus_name,
)


SBF = FrameKind("sbf", (b"$", b"@"), SBF_MAX_BYTES, measure_sbf, intact_sbf, sbf_name)

GNSS_KINDS = (NMEA, UBX, RTCM3)  # may share one port of a u-blox receiver, and of most others
