"""RTCM 3 of a base station (RTCM 10403.3): every message is framed, checked and counted by its number.

Messages 1005 and 1006 give the station's coordinates, so that a moved base is noticed. Observations are not decoded:
the log holds their bytes.
"""

from __future__ import annotations

from swath.drivers.driver import STREAM_TRANSPORTS, Driver
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import RTCM3
from swath.drivers.framing.parser import FramedParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import DeviceStatus, Record

HEADER_BYTES, CRC_BYTES = 3, 3
STATION = {1005: 152, 1006: 168}  # bits of the stationary reference point's messages (3.5.2)
COORDINATE_BITS = 38
COORDINATE_M = 1e-4
# bit positions in the message: DF002 12 bits, DF003 12, DF021 6, four indicators, then DF025, 2 bits, DF026, 2, DF027
ID_AT, X_AT, Y_AT, Z_AT, HEIGHT_AT = 12, 34, 74, 114, 152


class Rtcm3Parser(FramedParser):
    """Parses one stream of corrections; bytes between its frames are skipped and counted."""

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__((RTCM3,))

    def decode_frames(self, frames: list[Frame]) -> list[Record]:
        """Return a record for each message with the station's coordinates."""
        found = (self._station(frame.data[HEADER_BYTES:-CRC_BYTES], frame.host_time_ns) for frame in frames)
        return [record for record in found if record is not None]

    def _station(self, payload: bytes, host_time_ns: int) -> Record | None:
        if len(payload) < 2:
            return None
        number = payload[0] << 4 | payload[1] >> 4
        if number not in STATION:
            return None
        if 8 * len(payload) < STATION[number]:
            self.counters.bad_messages += 1
            return None
        places = zip("xyz", (X_AT, Y_AT, Z_AT), strict=True)
        values: dict[str, float | int | str | bool] = {"station": _unsigned(payload, ID_AT, 12)}
        values |= {f"{axis}_m": COORDINATE_M * _signed(payload, at, COORDINATE_BITS) for axis, at in places}
        if number == 1006:
            values["antenna_height_m"] = COORDINATE_M * _unsigned(payload, HEIGHT_AT, 16)
        return DeviceStatus(host_time_ns, values, f"RTCM{number}")


def _unsigned(payload: bytes, first: int, bits: int) -> int:
    """Read an unsigned number of ``bits`` bits from bit ``first`` on, the highest bit first."""
    whole = int.from_bytes(payload, "big")
    return whole >> (8 * len(payload) - first - bits) & ((1 << bits) - 1)


def _signed(payload: bytes, first: int, bits: int) -> int:
    value = _unsigned(payload, first, bits)
    return value - (1 << bits) if value >> (bits - 1) else value


DRIVERS = (
    Driver(
        protocol="rtcm3",
        kind="corrections",
        transports=(*STREAM_TRANSPORTS, "ntrip"),
        yields=(DeviceStatus,),
        summary="RTCM 3 of a base station or caster: framed and counted by number; 1005 and 1006 decoded",
        make_parser=Rtcm3Parser,
    ),
)
