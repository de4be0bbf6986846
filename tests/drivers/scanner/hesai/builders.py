"""Provides the Hesai models with their recordings, and packets of them made by the encoder."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.hesai.heads import MODE_STRONGEST, HesaiHead, echoes_of
from swath.drivers.scanner.hesai.models import QT64, QT128, XT16, XT32, XT32M2X
from swath.drivers.scanner.hesai.parser import HesaiParser, encode_point_packet
from swath.georef.arrays import StructArray
from swath.georef.records import Chunk
from tests.drivers.builders import returns_of
from tests.drivers.recordings import FIXTURES

NOON = dt.datetime(2026, 11, 21, 12, 0, 0, 250_000, tzinfo=dt.UTC)
NOON_NS = 1_795_262_400_250_000_000  # `date -u -d '2026-11-21 12:00:00' +%s`


@dataclass(frozen=True)
class Model:
    """A recording of a model, and the known facts about it."""

    protocol: str
    head: HesaiHead
    angles: str
    cloud: str
    motor_rpm: int
    mode: int
    errors: dict[str, int] = field(default_factory=dict)

    @property
    def capture(self) -> str:
        return f"hesai/{self.cloud.partition('_golden')[0]}.pcap.gz"

    def settings(self) -> DeviceSettings:
        return DeviceSettings("scanner/left", {}, {"geometry": (FIXTURES / "hesai" / self.angles).read_bytes()})

    def parser(self) -> HesaiParser:
        return HesaiParser(self.settings(), self.head)


MODELS = (
    Model("hesai-xt32", XT32, "calib_PandarXT32.csv", "nebula_xt32_golden_1673400678101968885", 599, 0x39),
    Model("hesai-qt64", QT64, "calib_PandarQT64.csv", "nebula_qt64_golden_1673401196087570870", 600, 0x3B),
    Model("hesai-xt16", XT16, "calib_PandarXT16.csv", "nebula_xt16_golden_1732848128093928016", 599, 0x39),
    Model(
        "hesai-xt32m2x",
        XT32M2X,
        "calib_PandarXT32M.csv",
        "nebula_xt32m_golden_1660893203292679064",
        599,
        0x3C,
        {"sequence_gap": 852},
    ),
    Model("hesai-qt128", QT128, "calib_PandarQT128.csv", "nebula_qt128_golden_1730273789174759609", 600, 0x39),
)


def packet(
    head: HesaiHead = XT32,
    mode: int = MODE_STRONGEST,
    time: dt.datetime = NOON,
    ranges: ArrayLike = 5000,
    light: ArrayLike = 7,
    sequence: int | None = 1,
    **tail: int,
) -> bytes:
    """Return a packet whose rounds are 0.18° apart."""
    rounds = np.arange(head.blocks) // echoes_of(mode)
    full = np.broadcast_to(np.asarray(ranges), (head.blocks, head.channels))
    return encode_point_packet(time, 1000 + 18 * rounds, full, light, mode, head=head, sequence=sequence, tail=tail)


def decode(unit: bytes, head: HesaiHead = XT32) -> StructArray:
    """Return the returns of one packet, with the design angles."""
    return returns_of(HesaiParser(DeviceSettings("scanner/left"), head).feed(Chunk("scanner/left", 1, unit)))
