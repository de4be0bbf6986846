"""Encodes NovAtel OEM7 binary logs, for the virtual aircraft and the tests."""

from __future__ import annotations

from swath.drivers.framing.checksums import crc32_novatel
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel.tables import TIME_STATUS_FINESTEERING

PORT_COM1 = 32  # port identifiers of the OEM7 manual
SOFTWARE = 17002


def encode_frame(
    message_id: int,
    body: bytes,
    week: int,
    milliseconds: int,
    *,
    short: bool = False,
    time_status: int = TIME_STATUS_FINESTEERING,
    message_type: int = 0,
    extra_header: bytes = b"",
) -> bytes:
    """Build a log's frame: header, body, CRC.

    Args:
        message_id: the log's number.
        body: the log's packed fields.
        week, milliseconds: GPS reference time of the header.
        short: use the short header, whose body has at most 255 bytes.
        time_status: GPS reference time status, long header only.
        message_type: measurement source, format and response bits, long header only.
        extra_header: bytes that a later firmware may append to the long header.
    """
    if short:
        frame = bytearray(nov.SHORT_HEADER.pack(len(body), message_id, week, milliseconds))
        frame[:3] = nov.SYNC_SHORT
    else:
        size = nov.LONG_HEADER.size + len(extra_header)
        fields = (size, message_id, message_type, PORT_COM1, len(body), 0, 0, time_status)
        frame = bytearray(nov.LONG_HEADER.pack(*fields, week, milliseconds, 0, 0, SOFTWARE))
        frame[:3] = nov.SYNC_LONG
        frame += extra_header
    frame += body
    return bytes(frame) + crc32_novatel(frame).to_bytes(nov.CRC_BYTES, "little")


def encode_log(
    name: str, body: nov.Body, week: int, milliseconds: int, *, time_status: int = TIME_STATUS_FINESTEERING
) -> bytes:
    """Encode a log by name, with the header form that belongs to it.

    Raises:
        KeyError: no layout has that name.
        TypeError: the body belongs to another log.
    """
    number = nov.IDS[name]
    layout = nov.LAYOUTS[number]
    if not isinstance(body, layout.body):
        raise TypeError(f"{name} takes a {layout.body.__name__}, not a {type(body).__name__}")
    return encode_frame(
        number, layout.wire.pack(*body), week, milliseconds, short=layout.short, time_status=time_status
    )
