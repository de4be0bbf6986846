"""Septentrio SBF frames: header, time stamp, names of the blocks, and a block's layout and encoder.

PolaRx5TR reference guide (firmware 5.5.0), 4.1. Numbers and names of blocks: its appendix A, the mosaic-X5's list of
blocks, and for INS receivers Septentrio's own ROS driver (septentrio_gnss_driver, ``sbf_blocks.hpp``).
"""

from __future__ import annotations

import struct
from typing import Generic, NamedTuple, TypeVar

from swath.drivers.framing.checksums import crc16_ccitt
from swath.drivers.framing.kinds import SBF_CRC_START, SBF_HEADER, SBF_NUMBER_BITS

BlockT = TypeVar("BlockT", bound=tuple[float, ...])

HEADER = struct.Struct("<2sHHHIH")  # sync, CRC, id, length (4.1.1); TOW, WNc (4.1.3)
REVISION_SHIFT = 13  # position of the revision in the id
SYNC = b"$@"
ALIGNMENT_BYTES = 4  # padding rounds the length up to a multiple of it

TOW_UNSET, WEEK_UNSET = 0xFFFF_FFFF, 0xFFFF

NAME_TABLE = """
4000 MeasExtra 4001 DOP 4002 GALNav 4003 GALAlm 4004 GLONav 4005 GLOAlm 4006 PVTCartesian 4007 PVTGeodetic
4012 SatVisibility 4013 ChannelStatus 4014 ReceiverStatus 4015 Commands 4017 GPSRawCA 4018 GPSRawL2C 4019 GPSRawL5
4020 GEORawL1 4021 GEORawL5 4022 GALRawFNAV 4023 GALRawINAV 4024 GALRawCNAV 4026 GLORawCA 4027 MeasEpoch
4028 BaseVectorGeod 4030 GALIon 4031 GALUtc 4032 GALGstGps 4034 GALSARRLM 4036 GLOTime 4037 ExtEventPVTCartesian
4038 ExtEventPVTGeodetic 4040 BBSamples 4042 GPSCNav 4043 BaseVectorCart 4044 PosCart 4047 BDSRaw 4049 RTCMDatum
4050 ExtSensorMeas 4052 PosLocal 4053 NTRIPClientStatus 4058 IPStatus 4059 DiskStatus 4066 QZSRawL1CA 4067 QZSRawL2C
4068 QZSRawL5 4075 ASCIIIn 4076 PVTSupport 4079 PVTSupportA 4081 BDSNav 4082 QualityInd 4090 InputLink 4091 OutputLink
4092 RFStatus 4093 NAVICRaw 4094 PosProjected 4095 QZSNav 4097 EncapsulatedOutput 4103 RxMessage 4105 DynDNSStatus
4109 Meas3Ranges 4110 Meas3CN0HiRes 4111 Meas3Doppler 4112 Meas3PP 4113 Meas3MP 4116 QZSAlm 4119 BDSAlm 4120 BDSIon
4121 BDSUtc 4122 NTRIPServerStatus 4201 LBandTrackerStatus 4204 LBandBeams 4211 FugroDDS 4212 LBandRaw 4214 FugroStatus
4217 ExtEventBaseVectGeod 4218 BDSRawB1C 4219 BDSRawB2a 4221 GPSRawL1C 4224 IMUSetup 4225 INSNavCart 4226 INSNavGeod
4227 QZSRawL1C 4228 QZSRawL1S 4229 ExtEventINSNavCart 4230 ExtEventINSNavGeod 4237 ExtEventAttEuler 4238 P2PPStatus
4242 BDSRawB2b 4244 VelSensorSetup 4245 GALAuthStatus 4246 QZSRawL5S 4251 BDSCNav1 4252 BDSCNav2 4253 BDSCNav3
4254 NavICLNav 4270 QZSRawL6D 4271 QZSRawL6E 4272 NavCart 4275 NavGeod 5891 GPSNav 5892 GPSAlm 5893 GPSIon 5894 GPSUtc
5896 GEONav 5897 GEOAlm 5902 ReceiverSetup 5905 PosCovCartesian 5906 PosCovGeodetic 5907 VelCovCartesian
5908 VelCovGeodetic 5911 xPPSOffset 5914 ReceiverTime 5917 GEOServiceLevel 5918 GEONetworkTime 5919 DiffCorrIn
5921 EndOfPVT 5922 EndOfMeas 5924 ExtEvent 5925 GEOMT00 5926 GEOPRNMask 5927 GEOFastCorr 5928 GEOIntegrity
5929 GEOFastCorrDegr 5930 GEODegrFactors 5931 GEOIGPMask 5932 GEOLongTermCorr 5933 GEOIonoDelay
5934 GEOClockEphCovMatrix 5936 Comment 5938 AttEuler 5939 AttCovEuler 5942 AuxAntPositions 5943 EndOfAtt
5949 BaseStation
"""
_WORDS = NAME_TABLE.split()
NAMES = dict(zip(map(int, _WORDS[::2]), _WORDS[1::2], strict=True))


class BlockError(ValueError):
    """A block with a good checksum has impossible content; the text is the error under which it is counted."""


class BlockHeader(NamedTuple):
    """Number, revision and time stamp, with which every block begins."""

    number: int
    revision: int
    tow_ms: int | None
    week: int | None


def number_of(frame: bytes) -> int:
    """Return the block's number."""
    return int(SBF_HEADER.unpack_from(frame)[1] & SBF_NUMBER_BITS)


def name_of(frame: bytes) -> str:
    """Return a name such as ``PVTGeodetic``, or ``SBF-4999`` where the table has no name."""
    number = number_of(frame)
    return NAMES.get(number, f"SBF-{number}")


def read_header(frame: bytes) -> BlockHeader:
    """Read number and time stamp of a whole frame.

    Raises:
        BlockError: the frame is too short for a time stamp.
    """
    if len(frame) < HEADER.size:
        raise BlockError("bad_length")
    _, _, identity, _, tow_ms, week = HEADER.unpack_from(frame)
    return BlockHeader(
        identity & SBF_NUMBER_BITS,
        identity >> REVISION_SHIFT,
        tow_ms if tow_ms != TOW_UNSET else None,
        week if week != WEEK_UNSET else None,
    )


class Layout(Generic[BlockT]):
    """Encodes and decodes one block: its number and its fields.

    Args:
        number: the block's number.
        block: the NamedTuple class.
        formats: struct formats of the fields of revision 0, then of the fields that each later revision added.
    """

    def __init__(self, number: int, block: type[BlockT], *formats: str) -> None:
        self.number = number
        self._block = block
        self._wires = [struct.Struct("<" + "".join(formats[: count + 1])) for count in range(len(formats))]
        self._fields = [len(wire.unpack(bytes(wire.size))) for wire in self._wires]

    @property
    def end(self) -> int:
        """Offset in the frame behind the fields of the latest revision."""
        return HEADER.size + self._wires[-1].size

    def decode(self, frame: bytes) -> BlockT:
        """Decode the block of a whole frame.

        Raises:
            BlockError: the frame is shorter than its revision requires.
        """
        revision = SBF_HEADER.unpack_from(frame)[1] >> REVISION_SHIFT
        wire = self._wires[min(revision, len(self._wires) - 1)]
        if len(frame) < HEADER.size + wire.size:
            raise BlockError("bad_length")
        return self._block(*wire.unpack_from(frame, HEADER.size))

    def encode(
        self, block: BlockT, tow_ms: int | None, week: int | None, *, revision: int | None = None, behind: bytes = b""
    ) -> bytes:
        """Encode a whole frame, of the latest revision by default; ``behind`` contains the sub-blocks."""
        revision = len(self._wires) - 1 if revision is None else revision
        known = min(revision, len(self._wires) - 1)
        body = self._wires[known].pack(*block[: self._fields[known]])
        return encode_frame(self.number, body + behind, tow_ms, week, revision=revision)


def encode_frame(number: int, body: bytes, tow_ms: int | None, week: int | None, *, revision: int = 0) -> bytes:
    """Build a block's frame: header, time stamp, body, padding.

    Args:
        number, revision: number and revision of the block.
        body: all bytes behind the time stamp.
        tow_ms, week: the time stamp; None for unset.
    """
    length = -(-(HEADER.size + len(body)) // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
    stamp = (TOW_UNSET if tow_ms is None else tow_ms, WEEK_UNSET if week is None else week)
    frame = bytearray(HEADER.pack(SYNC, 0, number | revision << REVISION_SHIFT, length, *stamp) + body)
    frame += bytes(length - len(frame))
    frame[2:4] = crc16_ccitt(frame[SBF_CRC_START:]).to_bytes(2, "little")
    return bytes(frame)
