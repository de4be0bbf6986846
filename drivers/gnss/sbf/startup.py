"""Start-up messages of Septentrio receivers: their command line.

PolaRx5TR reference guide (firmware 5.5.0): 3.1 (replies: a copy of the command after ``$R: ``, or ``$R? `` and the
reason; the prompt ends both), 1.3 and 3.2.16 (SBF streams), 3.2.9 (PPS). Baud rate: Septentrio's own ROS driver
(septentrio_gnss_driver, ``communication_core.cpp``). The streams used here are redefined, others stay unchanged.
"""

from __future__ import annotations

import re

from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import PhraseListener, StartupMessage, StartupOptions, read_setup

PORT = re.compile(r"(COM[1-4]|USB[12]|IP1[0-7]|IPS[1-5])")
PROMPT = rb"(?:[^>$]*\n)?[A-Z]+[0-9]+>"
REFUSED = re.compile(rb"\$R\? ?([^\r\n]*)\r\n" + PROMPT)

PULSE = "setPPSParameters, sec1, Low2High, , GPS"  # an omitted argument, here the delay, keeps its value
EVENT_BLOCKS = "xPPSOffset+ExtEvent"
FIX_BLOCKS = "PVTGeodetic+PosCovGeodetic+VelCovGeodetic+EndOfPVT"
SECOND_BLOCKS = "ReceiverTime"
RAW_BLOCKS = "+MeasEpoch+GPSNav+GLONav+GALNav+BDSNav"
HEADING_BLOCKS = "AttEuler+AttCovEuler+EndOfAtt"
SAVE = "exeCopyConfigFile, Current, Boot"

EVENT_STREAM, FIX_STREAM, SECOND_STREAM, HEADING_STREAM, INS_STREAM, IMU_STREAM = range(1, 7)


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the baud rate where it changes, PPS, and streams of time, position, events and raw
    measurements.

    Raises:
        DriverSettingsError: the receiver has no such port.
    """
    setup, port = read_setup(settings), _port(settings)
    period = f"msec{1000 // setup.rate_hz}" if setup.rate_hz > 1 else "sec1"
    second_blocks = SECOND_BLOCKS + (RAW_BLOCKS if setup.raw else "")
    commands = [
        PULSE,
        _stream(EVENT_STREAM, port, EVENT_BLOCKS, "OnChange"),
        _stream(FIX_STREAM, port, FIX_BLOCKS, period),
        _stream(SECOND_STREAM, port, second_blocks, "sec1"),
    ]
    if settings.config.get("secondary_lever_arm_m") is not None:
        commands.append(_stream(HEADING_STREAM, port, HEADING_BLOCKS, period))
    messages = [_command(text) for text in commands]
    if options.baud is not None and port.startswith("COM"):
        messages.insert(
            0, _command(f"setCOMSettings, {port}, baud{options.baud}, bits8, No, bit1, none", baud=options.baud)
        )
    return (*messages, *_saving(options))


def imu_startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the streams of the INS and its IMU, on the port in the receiver's own ``setup``."""
    port = _port(settings)
    commands = (
        _stream(INS_STREAM, port, "INSNavGeod", "msec20"),
        _stream(IMU_STREAM, port, "ExtSensorMeas", "OnChange"),
    )
    return (*(_command(text) for text in commands), *_saving(options))


def _port(settings: DeviceSettings) -> str:
    port = read_setup(settings).port or "COM1"
    if not PORT.fullmatch(port):
        raise DriverSettingsError(
            f"setup.port: got {port!r}, want COM1 to COM4, USB1, USB2, IP10 to IP17 or IPS1 to IPS5"
        )
    return port


def _stream(number: int, port: str, blocks: str, interval: str) -> str:
    return f"setSBFOutput, Stream{number}, {port}, {blocks}, {interval}"


def _saving(options: StartupOptions) -> tuple[StartupMessage, ...]:
    return (_command(SAVE, last=True),) if options.save else ()


def _command(text: str, *, baud: int | None = None, last: bool = False) -> StartupMessage:
    data = text.encode("ascii")
    accepted = re.compile(rb"\$R: ?" + re.escape(data) + rb" *\r\n" + PROMPT, re.IGNORECASE)
    return StartupMessage((text,), data + b"\r\n", lambda: PhraseListener(accepted, REFUSED), baud=baud, last=last)
