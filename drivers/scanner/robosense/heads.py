"""RoboSense heads: layouts of data packets (MSOP) and device information packets (DIFOP), firing times and beams.

Source: the maker's SDK rs_driver 1.5 (src/rs_driver/driver/decoder: decoder.hpp, basic_attr.hpp, block_iterator.hpp,
decoder_RS16.hpp, decoder_RS32.hpp, decoder_RSHELIOS.hpp, decoder_RSHELIOS_16P.hpp, decoder_RSBP.hpp). Both packets have
1248 bytes; numbers are big-endian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.beams import BeamTable, beam_table
from swath.georef.arrays import FloatArray, Int64Array, StructArray

PACKET_BYTES = 1248
BLOCKS = 12
PLACES = 32
BLOCK_ID = 0xFFEE
OLD_ID, HELIOS_ID = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")
DIFOP_ID = bytes.fromhex("a5ff005a11115555")
MODE_DUAL = 0
FILE = "geometry.file"
_WANT = (
    "want a DIFOP packet of the head, alone or in a capture, or a line of elevation, azimuth in degrees for each laser"
)

_CHANNEL = np.dtype([("range", ">u2"), ("reflectivity", "u1")])
_BLOCK = np.dtype([("id", ">u2"), ("azimuth", ">u2"), ("returns", _CHANNEL, (PLACES,))])
MSOP_DTYPE = np.dtype(
    {
        "names": ["id", "stamp", "type", "model", "blocks"],
        "formats": ["V8", "V10", "u1", "u1", (_BLOCK, (BLOCKS,))],
        "offsets": [0, 20, 31, 32, 42],
        "itemsize": PACKET_BYTES,
    }
)
YMD_DTYPE = np.dtype(
    [*((name, "u1") for name in ("year", "month", "day", "hour", "minute", "second")), ("ms", ">u2"), ("us", ">u2")]
)
UTC_DTYPE = np.dtype([("high", ">u2"), ("seconds", ">u4"), ("us", ">u4")])
_ANGLE = np.dtype([("negative", "u1"), ("value", ">u2")])
DIFOP_DTYPE = np.dtype(
    {
        "names": ["id", "rpm", "mode", "reversed", "elevation", "azimuth", "pitch", "tail"],
        "formats": ["V8", ">u2", "u1", "u1", (_ANGLE, (32,)), (_ANGLE, (32,)), ("u1", (16, 3)), ">u2"],
        "offsets": [0, 8, 300, 337, 468, 564, 1165, 1246],
        "itemsize": PACKET_BYTES,
    }
)


@dataclass(frozen=True)
class RobosenseHead:
    """One model of head.

    Attributes:
        name: the maker's name of it.
        identity: first bytes of its data packets.
        is_v4: lidar type 3 and model 4 in the header, which tell the newer Bpearl from the older.
        lasers: 16 or 32.
        counts_seconds: whether its time is seconds since 1970 and microseconds, rather than date and time.
        range_unit_m: metres of one unit of distance.
        round_ns: time from one round of firing to the next.
        offset_ns: (lasers,) firing times in a round.
        angle_unit_deg: degrees of a unit of the angles in its DIFOP packets; an RS-LiDAR-16 has its own form.
        forward_m, up_m: origin of the beams: ahead of the spin axis in the direction of the azimuth, and above.
        last_mode, strongest_mode: return modes in its DIFOP packets.
    """

    name: str
    identity: bytes
    is_v4: bool
    lasers: int
    counts_seconds: bool
    range_unit_m: float
    round_ns: int
    offset_ns: Int64Array
    angle_unit_deg: float
    forward_m: float
    up_m: float
    strongest_mode: int = 1
    last_mode: int = 2

    @property
    def bytes_per_s(self) -> float:
        """The most that the head sends: data packets in dual return."""
        rounds = BLOCKS * PLACES // (2 * self.lasers)
        return 1e9 * PACKET_BYTES / (rounds * self.round_ns)

    def beams(self, elevation_deg: FloatArray, azimuth_deg: FloatArray) -> BeamTable:
        """Return the table of beams (lasers,); each starts ahead of the axis at the head's azimuth, not at its own."""
        azimuth = np.radians(azimuth_deg)
        return beam_table(
            elevation_deg,
            azimuth_deg=azimuth_deg,
            forward_m=self.forward_m * np.cos(azimuth),
            right_m=-self.forward_m * np.sin(azimuth),
            up_m=np.full(self.lasers, self.up_m),
        )

    def angles(self, packet: np.void | StructArray) -> tuple[FloatArray, FloatArray] | None:
        """Return elevations and azimuths (lasers,) in degrees from a DIFOP packet; None if it has no plausible ones."""
        if self.lasers == 16 and self.identity == OLD_ID:
            # in the decoder's arithmetic 0.0001°, in the values of its own test 0.001°: the outer lasers are at 15°
            pitch = packet["pitch"].astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
            unit_deg = next((unit for unit in (1e-4, 1e-3) if 10 <= unit * pitch.max() <= 20), 0.0)
            elevation = unit_deg * pitch * np.repeat([-1.0, 1.0], 8)
            azimuth = np.zeros(16)
        else:
            elevation, azimuth = (
                np.where(packet[name]["negative"] != 0, -1.0, 1.0) * packet[name]["value"] * self.angle_unit_deg
                for name in ("elevation", "azimuth")
            )
            if (packet["elevation"]["negative"][: self.lasers] == 0xFF).any():
                return None
        elevation, azimuth = elevation[: self.lasers], azimuth[: self.lasers]
        plausible = (np.abs(elevation) <= 90).all() and (np.abs(azimuth) <= 180).all() and np.ptp(elevation) > 0
        return (elevation, azimuth) if plausible else None


def read_angles(data: bytes, head: RobosenseHead) -> tuple[FloatArray, FloatArray, int]:
    """Read the angles of a head's beams.

    Args:
        data: a DIFOP packet, which may lie anywhere in a capture, or text with a line of elevation and azimuth for each
            laser.
        head: the model.

    Returns:
        elevation_deg, azimuth_deg: (lasers,).
        mode: return mode of the DIFOP packet; -1: not stated.

    Raises:
        DriverSettingsError: the file is neither, or of another model.
    """
    at = data.find(DIFOP_ID)
    if at >= 0:
        if len(data) < at + PACKET_BYTES:
            raise DriverSettingsError(f"{FILE}: the DIFOP packet has {len(data) - at} bytes, want {PACKET_BYTES}")
        packet = np.frombuffer(data, dtype=DIFOP_DTYPE, count=1, offset=at)[0]
        if packet["reversed"] and head.lasers == 32 and head.identity == OLD_ID:
            raise DriverSettingsError(f"{FILE}: the head reverses its azimuths; switch that off in its web page")
        angles = head.angles(packet)
        if angles is None:
            raise DriverSettingsError(f"{FILE}: the DIFOP packet holds no angles of a {head.name}")
        return (*angles, int(packet["mode"]))
    found = []
    for line, text in enumerate(data.decode("utf-8-sig", "replace").splitlines(), start=1):
        if not text.strip(", \t"):
            continue
        try:
            elevation, azimuth = (float(word) for word in text.split(",")[:2])
        except ValueError:
            raise DriverSettingsError(f"{FILE}: line {line} is {text[:40]!r}; {_WANT}") from None
        if not (abs(elevation) <= 90 and abs(azimuth) <= 360):
            raise DriverSettingsError(f"{FILE}: line {line}: {elevation}, {azimuth}: not angles in degrees")
        found.append((elevation, azimuth))
    if len(found) != head.lasers:
        raise DriverSettingsError(f"{FILE}: {len(found)} lasers, want {head.lasers} of a {head.name}; {_WANT}")
    table = np.array(found)
    if not np.ptp(table[:, 0]) > 0:
        raise DriverSettingsError(f"{FILE}: all lasers have one elevation; {_WANT}")
    return table[:, 0], table[:, 1], -1


def _ns(first_us: float, step_us: float, lasers: int) -> Int64Array:
    times: Int64Array = np.rint(1000 * (first_us + step_us * np.arange(lasers))).astype(np.int64)
    return times


# The 16 lasers fire twice in a data block; in dual return a block is one round, with first and second returns.
RS16 = RobosenseHead(
    name="RS-LiDAR-16",
    identity=OLD_ID,
    is_v4=False,
    lasers=16,
    counts_seconds=False,
    range_unit_m=0.005,
    round_ns=55_500,
    offset_ns=_ns(0, 2.8, 16),
    angle_unit_deg=1e-4,
    forward_m=0.03825,
    up_m=0.0,
)
_RS32_HALF_NS = np.concatenate([_ns(0, 2.88, 15), [44_640]])
RS32 = replace(
    RS16,
    name="RS-LiDAR-32",
    lasers=32,
    round_ns=55_520,
    offset_ns=np.concatenate([_RS32_HALF_NS, _RS32_HALF_NS + 1_440]),
    angle_unit_deg=1e-3,
    forward_m=0.03997,
)
_BPEARL_HALF_NS = np.concatenate([_ns(0, 2.56, 8), _ns(25.68, 2.56, 8)])
BPEARL = replace(
    RS32,
    name="RS-Bpearl",
    offset_ns=np.concatenate([_BPEARL_HALF_NS, _BPEARL_HALF_NS + 1_280]),
    angle_unit_deg=1e-2,
    forward_m=0.01473,
    up_m=0.09427,
)
_BPEARL_V4_US = """
0 1.67 3.34 5 6.67 8.34 10.01 11.68 13.34 15.01 16.68 18.35 20.02 21.68 23.35 25.02 26.69 28.36 30.02 31.69 33.36 35.03
36.7 38.36 40.03 41.7 43.37 45.04 46.7 48.37 50.04 51.71
"""
BPEARL_V4 = replace(
    BPEARL,
    name="RS-Bpearl of 2023",
    is_v4=True,
    counts_seconds=True,
    range_unit_m=0.0025,
    round_ns=55_560,
    offset_ns=np.rint(1000 * np.array(_BPEARL_V4_US.split(), dtype=np.float64)).astype(np.int64),
    forward_m=0.01619,
    up_m=0.09571,
)
HELIOS32 = replace(
    RS32,
    name="RS-Helios",
    identity=HELIOS_ID,
    counts_seconds=True,
    range_unit_m=0.0025,
    round_ns=55_560,
    offset_ns=_ns(0, 1.73, 32),
    angle_unit_deg=1e-2,
    forward_m=0.03498,
    strongest_mode=4,
    last_mode=5,
)
HELIOS16P = replace(HELIOS32, name="RS-Helios-16P", lasers=16, offset_ns=_ns(0, 1.73, 16))
