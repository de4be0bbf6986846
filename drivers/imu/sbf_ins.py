"""The IMU of a Septentrio INS receiver, inside the receiver's own stream (``transport = "gnss:NAME"``)."""

from __future__ import annotations

from swath.drivers.driver import Driver
from swath.drivers.gnss.sbf.parser import SbfParser
from swath.drivers.gnss.sbf.startup import imu_startup_messages
from swath.drivers.parser import DeviceSettings
from swath.georef.records import ImuSamples, InsSolution


def make_imu_parser(settings: DeviceSettings) -> SbfParser:
    """Make a parser of the receiver's stream that returns inertial records only."""
    return SbfParser(settings, wanted=(ImuSamples, InsSolution))


DRIVERS = (
    Driver(
        protocol="sbf",
        kind="imu",
        transports=("gnss",),
        yields=(ImuSamples, InsSolution),
        summary="IMU and INS of a Septentrio INS receiver, inside its GNSS stream",
        make_parser=make_imu_parser,
        startup=imu_startup_messages,
    ),
)
