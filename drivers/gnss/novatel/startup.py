"""Start-up messages of NovAtel receivers: commands in abbreviated ASCII (OEM7 Commands and Logs).

LOG without a port logs to the port that sent the command. A receiver answers ``<OK`` or ``<ERROR:…`` on a line of its
own and then its prompt (``[COM1]``); recordings in ``fixtures/novatel`` contain such answers. The logs' triggers are
those of NovAtel's ROS driver (novatel_oem7_driver, ``std_init_commands.yaml``), for MARKxTIME of the LOG command's
page.
"""

from __future__ import annotations

import re

from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import PhraseListener, StartupMessage, StartupOptions, read_setup

ACCEPTED = re.compile(rb"<OK\r?\n")
REFUSED = re.compile(rb"<ERROR:?([^\r\n]*)\r?\n")

PULSE = "PPSCONTROL ENABLE_FINETIME POSITIVE 1.0 1000"  # no pulse before FINE; period in s, factory width
EVENT_LOGS = ("MARK1TIMEB ONNEW", "MARK2TIMEB ONNEW")
HEADING_LOGS = ("HEADING2B ONNEW",)
RAW_LOGS = (
    "RANGEB ONTIME 1",
    "RAWEPHEMB ONNEW",
    "GLOEPHEMERISB ONNEW",
    "GALINAVEPHEMERISB ONNEW",
    "GALFNAVEPHEMERISB ONNEW",
    "BDSEPHEMERISB ONNEW",
)
# INSPVAS has no sigmas, INSPVAX gives them once a second; georeferencing that uses the INS's attitude as logged
# interpolates between epochs, which are therefore 20 ms apart
IMU_LOGS = ("RAWIMUSXB ONNEW", "INSPVASB ONTIME 0.02", "INSPVAXB ONTIME 1", "INSCONFIGB ONCHANGED")
SAVE = "SAVECONFIG"


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the baud rate where it changes, PPS, and logs of time, position, events and raw measurements.

    Raises:
        DriverSettingsError: a port is named, which a NovAtel receiver does not need.
    """
    setup = read_setup(settings)
    if setup.port is not None:
        raise DriverSettingsError(
            f"setup.port: got {setup.port!r}; a NovAtel receiver sends to the port that it is asked on; remove the key"
        )
    period_s = f"{1 / setup.rate_hz:g}"
    logs = ["TIMEB ONTIME 1", f"BESTPOSB ONTIME {period_s}", f"BESTVELB ONTIME {period_s}", *EVENT_LOGS]
    if settings.config.get("secondary_lever_arm_m") is not None:
        logs += HEADING_LOGS
    if setup.raw:
        logs += RAW_LOGS
    messages = [_command(PULSE), *(_command(f"LOG {log}") for log in logs)]
    if options.baud is not None:
        # break detection off: bytes at another rate may look like a break, which sets the port back to 9600
        messages.insert(0, _command(f"SERIALCONFIG THISPORT {options.baud} N 8 1 N OFF", baud=options.baud))
    return (*messages, *_saving(options))


def imu_startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the logs of the IMU and INS in a receiver's stream."""
    return (*(_command(f"LOG {log}") for log in IMU_LOGS), *_saving(options))


def _saving(options: StartupOptions) -> tuple[StartupMessage, ...]:
    return (_command(SAVE, last=True),) if options.save else ()


def _command(text: str, *, baud: int | None = None, last: bool = False) -> StartupMessage:
    data = text.encode("ascii") + b"\r\n"
    return StartupMessage((text,), data, lambda: PhraseListener(ACCEPTED, REFUSED), baud=baud, last=last)
