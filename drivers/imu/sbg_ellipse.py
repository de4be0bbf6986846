"""SBG Systems Ellipse (also Ekinox, Apogee, Quanta) on CAN.

The maker's own DBC (sbg-ellipse.dbc beside this file: github.com/SBG-Systems/sbgECom, can/sbgCan.dbc, which contains
its MIT licence) and its document canProtocol.md agree on all fields read here. A sample is IMU_INFO with the time stamp
in microseconds since power-on, then IMU_ACCEL and IMU_GYRO of the same cycle, which carry no time of their own. All
identifiers are disabled until the user chooses them; those of the DBC are the document's.
"""

from __future__ import annotations

from pathlib import Path

from swath.drivers.driver import Driver
from swath.drivers.imu.can_profile import profile_map
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.dbc.settings import SignalMap
from swath.drivers.parser import DeviceSettings
from swath.georef.records import DeviceClockSamples, ImuSamples

DBC_PATH = Path(__file__).with_name("sbg-ellipse.dbc")
PREFIX = "SBG_ECAN_MSG_"
SIGNALS = {  # canProtocol.md; TIME_STAMP is in µs, the default of tick_hz
    "specific_force": [f"{PREFIX}IMU_ACCEL.ACCEL_{axis}" for axis in "XYZ"],
    "angular_rate": [f"{PREFIX}IMU_GYRO.GYRO_{axis}" for axis in "XYZ"],
    "sample_ticks": f"{PREFIX}IMU_INFO.TIME_STAMP",
    "temperature": f"{PREFIX}IMU_INFO.TEMPERATURE",
    "status": f"{PREFIX}IMU_INFO.STATUS",
}


def signal_map(settings: DeviceSettings) -> SignalMap:
    """Return the device's signal map; with ``pps_event``, the time of that Sync In's last event is the latched counter.

    Raises:
        DriverSettingsError: a setting is invalid; the text names the key and a valid value.
    """
    event = settings.config.get("pps_event")
    latch = {"pps_ticks": f"{PREFIX}EVENT_INFO_{event}.TIME_STAMP"} if event else {}
    return profile_map(settings, DBC_PATH.read_bytes(), DBC_PATH.name, SIGNALS | latch, prefix=PREFIX)


def make_parser(settings: DeviceSettings) -> DbcParser:
    """Make the parser of all record types."""
    return DbcParser(settings, signal_map=signal_map(settings))


def make_clock_parser(settings: DeviceSettings) -> DbcParser:
    """Make the recorder's parser, which returns samples of the device's clock only."""
    return DbcParser(settings, clock_only=True, signal_map=signal_map(settings))


DRIVERS = (
    Driver(
        protocol="sbg-ellipse",
        kind="imu",
        transports=("can",),
        yields=(ImuSamples, DeviceClockSamples),
        summary="SBG Systems Ellipse, Ekinox, Apogee and Quanta: IMU messages on CAN",
        make_parser=make_parser,
        make_time_parser=make_clock_parser,
    ),
)
