"""The inertial sensors of a u-blox receiver, inside the receiver's own stream (``transport = "gnss:NAME"``)."""

from __future__ import annotations

from swath.drivers.driver import Driver
from swath.drivers.gnss.ubx.parser import UbxParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import ImuSamples, InsSolution


def make_imu_parser(settings: DeviceSettings) -> UbxParser:
    """Make a parser of the receiver's stream that returns inertial records only."""
    return UbxParser(settings, wanted=(ImuSamples, InsSolution))


DRIVERS = (
    Driver(
        protocol="ubx",
        kind="imu",
        transports=("gnss",),
        yields=(ImuSamples, InsSolution),
        summary="inertial sensors and attitude of a u-blox receiver (ESF, NAV-ATT), inside its GNSS stream",
        make_parser=make_imu_parser,
    ),
)
