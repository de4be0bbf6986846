"""Layout of Ouster's lidar packets as tables, and their encoder.

Little-endian. Packet header (32 bytes), columns, packet footer (32 bytes, CRC-64 last); a column is a header and one
channel block a beam. The LEGACY profile has neither header nor footer: its columns contain the frame and the encoder
count, and end with the status. Sources: Ouster Firmware User Manual, "Lidar Data" (firmware 2.x and 3.x);
github.com/ouster-lidar/ouster-sdk @ 46b7bce, ouster_client/src/parsing.cpp. Firmware 4 describes another STANDARD
header: its packets fail the serial number's check, so that none is misread.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from fastcrc.crc64 import xz as crc64_xz
from numpy.typing import ArrayLike, NDArray

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.ouster.head import FILE, FUSA_PROFILE, LARGEST_PACKET_BYTES, OusterHead
from swath.georef.arrays import BoolArray, ByteArray, Int64Array, StructArray

HEADER_BYTES = FOOTER_BYTES = 32
LIDAR_PACKET = 1  # packet type
IMU_PACKET = 2
ZONE_PACKET = 3
ZONE_BYTES = HEADER_BYTES + 8 + 32 + 16 * 36 + FOOTER_BYTES
ENCODER_COUNTS = 90_112  # a revolution, LEGACY only
NO_CRC = (0, 0xDEADBEEF0000C0DE)  # content in place of a CRC of firmware without one, such as 2.2 and 2.3
RANGE_MM = 0.001


class Bits(NamedTuple):
    """A field of a channel block: first bit, number of bits, low bits that are not sent (always 0)."""

    first: int
    size: int
    dropped: int = 0


class Profile(NamedTuple):
    """A channel block: its 32-bit words and the fields in them."""

    words: int
    fields: Mapping[str, Bits]


_SINGLE = {
    "RANGE": Bits(0, 19),
    "FLAGS": Bits(19, 5),
    "REFLECTIVITY": Bits(32, 8),
    "SIGNAL": Bits(48, 16),
    "NEAR_IR": Bits(64, 16),
}
_LOW_RATE = {"RANGE": Bits(0, 15, 3), "FLAGS": Bits(15, 1), "REFLECTIVITY": Bits(16, 8), "NEAR_IR": Bits(24, 8, 4)}
_LOW_RATE_DUAL = {**_LOW_RATE, "RANGE2": Bits(32, 15, 3), "FLAGS2": Bits(47, 1), "REFLECTIVITY2": Bits(48, 8)}
PROFILES: Mapping[str, Profile] = {
    "LEGACY": Profile(
        3,
        {
            "RANGE": Bits(0, 20),
            "FLAGS": Bits(28, 4),
            "REFLECTIVITY": Bits(32, 8),
            "SIGNAL": Bits(48, 16),
            "NEAR_IR": Bits(64, 16),
        },
    ),
    "RNG19_RFL8_SIG16_NIR16": Profile(3, _SINGLE),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(
        4,
        {
            "RANGE": Bits(0, 19),
            "FLAGS": Bits(19, 5),
            "REFLECTIVITY": Bits(24, 8),
            "RANGE2": Bits(32, 19),
            "FLAGS2": Bits(51, 5),
            "REFLECTIVITY2": Bits(56, 8),
            "SIGNAL": Bits(64, 16),
            "SIGNAL2": Bits(80, 16),
            "NEAR_IR": Bits(96, 16),
        },
    ),
    "RNG15_RFL8_NIR8": Profile(1, _LOW_RATE),
    "RNG15_RFL8_NIR8_DUAL": Profile(2, _LOW_RATE_DUAL),
    FUSA_PROFILE: Profile(2, _LOW_RATE_DUAL),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": Profile(3, _SINGLE),
    "RNG15_RFL8_NIR8_ZONE16": Profile(2, _LOW_RATE),
}

# Fields that are not whole words are extracted from the words around them: init_id 24 bits, serial 40 bits.
_HEADERS = {
    "legacy": [],
    "standard": [
        ("type", "<u2", 0),
        ("frame_id", "<u2", 2),
        ("init_word", "<u4", 4),
        ("serial_word", "<u8", 7),
        ("alert_flags", "u1", 12),
        ("shutdown_countdown_s", "u1", 16),
        ("shot_limiting_countdown_s", "u1", 17),
    ],
    "fusa": [
        ("type", "u1", 0),
        ("init_word", "<u4", 0),
        ("frame_id", "<u4", 4),
        ("alert_flags", "u1", 8),
        ("serial_word", "<u8", 11),
        ("shutdown_countdown_s", "u1", 16),
        ("shot_limiting_countdown_s", "u1", 17),
    ],
}
_INIT_SHIFT = {"standard": 0, "fusa": 8}
HEALTH = ("alert_flags", "shutdown_countdown_s", "shot_limiting_countdown_s")


def _table(fields: list[tuple[str, Any, int]], itemsize: int) -> np.dtype[np.void]:
    names, formats, offsets = [list(column) for column in zip(*fields, strict=True)]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})


@dataclass(frozen=True, eq=False)
class LidarLayout:
    """Layout of the lidar packets of one head.

    Raises:
        DriverSettingsError: the head's profile is unknown, or its packets are impossible.
    """

    head: OusterHead

    def __post_init__(self) -> None:
        """Refuse an unknown profile or a packet larger than a datagram with `DriverSettingsError`."""
        if self.head.profile not in PROFILES:
            known = ", ".join(PROFILES)
            raise DriverSettingsError(
                f"{FILE}: udp_profile_lidar: {self.head.profile!r} is not known; there are: {known}"
            )
        if self.packet_bytes > LARGEST_PACKET_BYTES:
            raise DriverSettingsError(
                f"{FILE}: data_format: its packets would be larger than a datagram; want the head's own metadata"
            )

    def __deepcopy__(self, memo: dict[int, object]) -> LidarLayout:
        """Return the same object: a layout never changes, so a parser's copy shares it."""
        return self

    @property
    def legacy(self) -> bool:
        """True if packets have neither header nor footer."""
        return self.head.header == "legacy"

    @property
    def profile(self) -> Profile:
        """Profile of the channel blocks."""
        return PROFILES[self.head.profile]

    @property
    def dual(self) -> bool:
        """True if a block has two returns."""
        return "RANGE2" in self.profile.fields

    @property
    def has_crc(self) -> bool:
        """True if a packet has a place for a CRC."""
        return self.head.header == "standard"

    @cached_property
    def packet_bytes(self) -> int:
        """Length of a packet."""
        around = 0 if self.legacy else HEADER_BYTES + FOOTER_BYTES
        return around + self.head.columns_per_packet * self._column.itemsize

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Numpy dtype of a packet."""
        at = 0 if self.legacy else HEADER_BYTES
        fields = [*_HEADERS[self.head.header], ("columns", (self._column, (self.head.columns_per_packet,)), at)]
        if self.has_crc:
            fields.append(("crc", "<u8", self.packet_bytes - 8))
        return _table(fields, self.packet_bytes)

    @cached_property
    def _column(self) -> np.dtype[np.void]:
        pixels = ("<u4", (self.head.beams, self.profile.words))
        size = 4 * self.head.beams * self.profile.words
        fields: list[tuple[str, Any, int]] = [("time_ns", "<u8", 0), ("id", "<u2", 8)]
        if self.legacy:
            fields += [("frame_id", "<u2", 10), ("encoder", "<u4", 12), ("pixels", pixels, 16)]
            return _table([*fields, ("status", "<u4", 16 + size)], 16 + size + 4)
        return _table([*fields, ("status", "<u2", 10), ("pixels", pixels, 12)], 12 + size)

    # -- reading

    def field(self, pixels: NDArray[np.uint32], name: str) -> NDArray[np.uint32]:
        """Return a field of channel blocks (…, words), in the maker's units; (…)."""
        bits = self.profile.fields[name]
        values = self.raw_field(pixels, name)
        return values << np.uint32(bits.dropped) if bits.dropped else values

    def raw_field(self, pixels: NDArray[np.uint32], name: str) -> NDArray[np.uint32]:
        """Return a field of channel blocks without the low bits that are not sent."""
        bits = self.profile.fields[name]
        word = pixels[..., bits.first // 32]
        shift = bits.first % 32
        if shift:
            word = word >> np.uint32(shift)
        return word & np.uint32((1 << bits.size) - 1) if shift + bits.size < 32 else word

    def headers(self, units: ByteArray) -> StructArray:
        """Return (n,) headers of packets (n, length) other than lidar packets; LEGACY heads send those with a STANDARD
        header.
        """
        kind = "standard" if self.legacy else self.head.header
        content = np.ascontiguousarray(units[:, :HEADER_BYTES])
        return content.view(_table(_HEADERS[kind], HEADER_BYTES)).reshape(-1)

    def valid(self, columns: StructArray) -> BoolArray:
        """Return which columns contain a measurement: bit 0 of the status."""
        found: BoolArray = (columns["status"] & 1).astype(np.bool_)
        return found

    def first_id(self, columns: StructArray) -> Int64Array:
        """Return (n,) measurement id of the first column of packets' columns (n, columns), derived from the first valid
        one.
        """
        place = self.valid(columns).argmax(axis=1)
        found: Int64Array = columns["id"][np.arange(len(columns)), place].astype(np.int64) - place
        return found

    def frame_id(self, packets: StructArray) -> Int64Array:
        """Return (n,) frame ids of packets (n,)."""
        found: NDArray[Any] = packets["columns"]["frame_id"][:, 0] if self.legacy else packets["frame_id"]
        return found.astype(np.int64)

    @property
    def frame_ids(self) -> int:
        """Number of frame ids before they wrap."""
        return 1 << (32 if self.head.header == "fusa" else 16)

    def window_ranks(self) -> Int64Array:
        """Return (packets of a full frame,) the rank of each place on the circle among a frame's packets, −1 outside
        the window.

        Packets are sent whole, in the order of their measurement ids, where the window reaches into them.
        """
        head = self.head
        first, last = (one // head.columns_per_packet for one in head.column_window)
        place = np.arange(head.columns_per_frame // head.columns_per_packet)
        around = head.column_window[0] > head.column_window[1]
        sent = (place >= first) | (place <= last) if around else (place >= first) & (place <= last)
        return np.where(sent, np.cumsum(sent) - 1, -1).astype(np.int64)

    def init_id(self, packets: StructArray) -> Int64Array:
        """Return (n,) number of the head's start; 0 in LEGACY, which does not contain it."""
        if self.legacy:
            return np.zeros(len(packets), dtype=np.int64)
        return ((packets["init_word"] >> _INIT_SHIFT[self.head.header]) & 0xFF_FFFF).astype(np.int64)

    def serial(self, packets: StructArray) -> Int64Array:
        """Return (n,) serial number of packets or headers; LEGACY's lidar packets have none."""
        return (packets["serial_word"] & np.uint64((1 << 40) - 1)).astype(np.int64)

    # -- writing

    def encode(
        self,
        frame_id: int,
        first_id: int,
        time_ns: ArrayLike,
        fields: Mapping[str, ArrayLike],
        status: ArrayLike = 1,
        init_id: int | None = None,
        serial: int | None = None,
    ) -> bytes:
        """Encode one packet, with its CRC where the header is STANDARD.

        Args:
            frame_id: id of the revolution.
            first_id: measurement id of the first column.
            time_ns: (columns,) time of each column.
            fields: by name, (columns, beams) or one value for all, in the maker's units; absent ones are 0.
            status: (columns,) bit 0: valid.
            init_id, serial: the head's own by default.
        """
        packet = np.zeros(1, dtype=self.dtype)
        columns = packet["columns"][0]
        columns["time_ns"], columns["id"] = time_ns, first_id + np.arange(self.head.columns_per_packet)
        columns["status"] = np.asarray(status) * (0xFFFF_FFFF if self.legacy else 1)
        for name, values in fields.items():
            bits = self.profile.fields[name]
            shape = columns["pixels"].shape[:-1]
            word = (np.broadcast_to(np.asarray(values, dtype=np.uint32), shape) >> bits.dropped) << (bits.first % 32)
            columns["pixels"][..., bits.first // 32] |= word.astype(np.uint32)
        if self.legacy:
            columns["frame_id"] = frame_id
            columns["encoder"] = columns["id"].astype(np.uint32) * (ENCODER_COUNTS // self.head.columns_per_frame)
            return packet.tobytes()
        init = (self.head.init_id or 0) if init_id is None else init_id
        packet["serial_word"] = (self.head.serial or 0) if serial is None else serial
        packet["init_word"] |= np.uint32(init << _INIT_SHIFT[self.head.header])
        packet["type"], packet["frame_id"] = LIDAR_PACKET, frame_id
        return with_crc(packet.tobytes()) if self.has_crc else packet.tobytes()


def with_crc(packet: bytes) -> bytes:
    """Replace the last eight bytes of a packet by its CRC."""
    return packet[:-8] + crc64_xz(packet[:-8]).to_bytes(8, "little")


def crc_holds(units: ByteArray) -> BoolArray:
    """Return (n,) whether packets (n, length) have a correct CRC, or were sent without one."""
    stated = np.ascontiguousarray(units[:, -8:]).view("<u8")[:, 0]
    holds: BoolArray = np.isin(stated, np.array(NO_CRC, dtype=np.uint64))
    for row in np.flatnonzero(~holds).tolist():
        holds[row] = crc64_xz(units[row, :-8].data) == stated[row]
    return holds
