"""Xsens (Movella) MTi-600 series on CAN.

Layouts follow "MTi 600-series MT CAN Protocol Documentation", MT1604P revision A (2019), as a public audit quotes them,
and XsCanDataIdentifier in the maker's SDK. No recording was available. Two facts that the maker's documents
leave open are settings:

- the unit of SampleTime: MT1604P and the SDK give microseconds, Movella's page on CAN messages 10 kHz: ``tick_hz`` has
  no default;
- the byte order, which MT1604P does not give: ``byte_order`` is big unless set, as in three implementations and in the
  maker's serial protocol.

DeltaV, DeltaQ and the high-rate messages are not read: DeltaV's exponent and the identifiers of the high-rate messages
appear in one document each, or are contradicted, and DeltaQ resolves only 6e-5 rad a sample.
"""

from __future__ import annotations

from typing import NamedTuple

from swath.drivers.driver import Driver
from swath.drivers.imu.can_profile import profile_map
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.dbc.settings import SignalMap
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import ImuSamples

BYTE_ORDERS = {"big": 0, "little": 1}  # as a DBC numbers them


class Message(NamedTuple):
    """One message: fields of equal width from its first byte on.

    Attributes:
        name: name in MT1604P, without its prefix.
        identifier: default CAN identifier.
        fields: names of the fields.
        bits, signed: width and sign of each field.
        scale: factor to the unit.
        unit: unit in a DBC's spelling.
    """

    name: str
    identifier: int
    fields: tuple[str, ...]
    bits: int
    signed: bool
    scale: float
    unit: str


MESSAGES = (  # the comment is the section of MT1604P
    Message("SampleTime", 0x005, ("ticks",), 32, False, 1.0, ""),  # 6.1.2
    Message("GroupCounter", 0x006, ("count",), 16, False, 1.0, ""),  # 6.1.3
    Message("StatusWord", 0x011, ("status",), 32, False, 1.0, ""),  # 6.2.1
    Message("RateOfTurn", 0x032, ("x", "y", "z"), 16, True, 2.0**-9, "rad/s"),  # 6.4.2
    Message("Acceleration", 0x034, ("x", "y", "z"), 16, True, 2.0**-8, "m/s2"),  # 6.4.4
    Message("Temperature", 0x051, ("celsius",), 16, True, 2.0**-8, "degC"),  # 6.6.1
)
SIGNALS = {
    "specific_force": [f"Acceleration.{axis}" for axis in "xyz"],
    "angular_rate": [f"RateOfTurn.{axis}" for axis in "xyz"],
    "sample_ticks": "SampleTime.ticks",
    "temperature": "Temperature.celsius",
    "status": "StatusWord.status",
    "packet_counter": "GroupCounter.count",
}


def dbc_text(byte_order: str) -> str:
    """Return a DBC of the messages, with the default identifiers."""
    order = BYTE_ORDERS[byte_order]
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: MTi", ""]
    for message in MESSAGES:
        lines.append(f"BO_ {message.identifier} {message.name}: {len(message.fields) * message.bits // 8} MTi")
        sign = "-" if message.signed else "+"
        for number, field in enumerate(message.fields):
            start = number * message.bits + (7 if order == 0 else 0)
            place = f"{start}|{message.bits}@{order}{sign}"
            lines.append(f' SG_ {field} : {place} ({message.scale},0) [0|0] "{message.unit}" Vector__XXX')
        lines.append("")
    return "\n".join(lines)


def signal_map(settings: DeviceSettings) -> SignalMap:
    """Return the device's signal map.

    Raises:
        DriverSettingsError: a setting is invalid; the text names the key and a valid value.
    """
    if settings.config.get("tick_hz") is None:
        raise DriverSettingsError(
            "tick_hz: missing; want 1000000 or 10000, as the maker's documents differ on the unit of SampleTime"
        )
    order = settings.config.get("byte_order") or "big"
    if order not in BYTE_ORDERS:
        raise DriverSettingsError(f'byte_order: got "{order}", want "big" or "little"')
    return profile_map(settings, dbc_text(order).encode(), "xsens-mti's messages", SIGNALS)


def make_parser(settings: DeviceSettings) -> DbcParser:
    """Make the parser of all record types."""
    return DbcParser(settings, signal_map=signal_map(settings))


DRIVERS = (
    Driver(
        protocol="xsens-mti",
        kind="imu",
        transports=("can",),
        yields=(ImuSamples,),
        summary="Xsens MTi-600 series on CAN",
        make_parser=make_parser,
        needs=("tick_hz",),
    ),
)
