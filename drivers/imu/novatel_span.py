"""The IMU of a NovAtel SPAN system, inside the receiver's own stream (``transport = "gnss:NAME"``)."""

from __future__ import annotations

from swath.drivers.driver import Driver
from swath.drivers.gnss.novatel.parser import NovatelParser
from swath.drivers.gnss.novatel.startup import imu_startup_messages
from swath.drivers.parser import DeviceSettings
from swath.georef.records import ImuSamples, InsSolution


def make_imu_parser(settings: DeviceSettings) -> NovatelParser:
    """Make a parser of the receiver's stream that returns inertial records only."""
    return NovatelParser(settings, wanted=(ImuSamples, InsSolution))


DRIVERS = (
    Driver(
        protocol="novatel",
        kind="imu",
        transports=("gnss",),
        yields=(ImuSamples, InsSolution),
        summary="IMU and INS of a NovAtel SPAN receiver, inside its GNSS stream",
        make_parser=make_imu_parser,
        startup=imu_startup_messages,
    ),
)
