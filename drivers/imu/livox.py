"""The inertial units inside Livox heads: on a port of their own, or among the packets of the head's points.

A head of SDK 2 sends its samples to a port of their own, which may be the scanner's ``auxiliary`` or a wire of the IMU.
A head of SDK 1 sends them to the port of its points (Livox-SDK #76): ``transport = "scanner:NAME"``.
"""

from __future__ import annotations

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, Parser
from swath.drivers.scanner.livox.layout import AVIA, HAP, MID360, SAMPLES_HZ, LivoxHead
from swath.drivers.scanner.livox.parser import LivoxParser
from swath.georef.records import DeviceClockSamples, ImuSamples


def _driver(protocol: str, head: LivoxHead) -> Driver:
    def make_parser(settings: DeviceSettings) -> Parser:
        return LivoxParser(settings, head, imu_only=True)

    return Driver(
        protocol=protocol,
        kind="imu",
        transports=("udp", "scanner"),
        yields=(ImuSamples, DeviceClockSamples),
        summary=f"the IMU inside Livox {head.name} (SDK {head.sdk}), on its own port or among the head's packets",
        make_parser=make_parser,
        bytes_per_s=SAMPLES_HZ * head.imu_bytes,
    )


DRIVERS = (_driver("livox-avia", AVIA), _driver("livox-mid360", MID360), _driver("livox-hap", HAP))
