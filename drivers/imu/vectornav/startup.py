"""Start-up messages of VectorNav units: ASCII commands that write their registers.

VN-300 user manual UM005: 5.1 (``$VNWRG`` and its echo, ``$VNERR``), 6.2 (registers 5 baud rate, 6 asynchronous ASCII
output, 32 synchronisation, 75 to 77 binary outputs; ``$VNWNV`` saves). Fields of register 32 also from the SDK
(``SyncControl``).
"""

from __future__ import annotations

import re

from swath.drivers.framing.checksums import nmea_xor
from swath.drivers.imu.vectornav import wire
from swath.drivers.imu.vectornav.wire import ATTITUDE, GNSS1, IMU, INS, TIME
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import PhraseListener, StartupMessage, StartupOptions

Outputs = dict[int, tuple[str, ...]]  # names of fields by group

BASE_RATE_HZ = 800.0  # the rates of binary outputs divide it
DEFAULT_RATE_HZ = 200.0
SOLUTION_DIVISOR, FIX_DIVISOR = 16, 160  # 50 Hz, 5 Hz
PORT = 1  # serial port 1
REFUSED = re.compile(rb"\$VN(ERR,[0-9A-Fa-f]+)\*[0-9A-Fa-f]{2}")

TIMES = ("time_startup", "gps_tow", "gps_week", "time_sync_in", "time_gps_pps", "time_status")
MEASUREMENTS = ("uncomp_accel", "uncomp_gyro")
INCREMENTS = ("delta_theta", "delta_vel")
SOLUTION: Outputs = {
    TIME: ("gps_tow", "gps_week", "time_status"),
    ATTITUDE: ("yaw_pitch_roll", "ypr_sigma"),
    INS: ("ins_status", "pos_lla", "vel_ned", "pos_sigma", "vel_sigma"),
}
FIX: Outputs = {
    GNSS1: ("tow", "week", "satellites", "fix", "pos_lla", "vel_ned", "pos_sigma", "vel_sigma", "time_info"),
}
# synchronisation: count rising edges on SyncIn, no skip, 0; SyncOut at the receiver's PPS, positive, no skip, 1 ms, 0
SYNCHRONISATION = "32,3,0,0,0,6,1,0,1000000,0"


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the baud rate where it changes, the binary outputs, PPS on SyncIn and SyncOut, and saving.

    Raises:
        DriverSettingsError: ``rate_hz`` does not divide the unit's 800 Hz.
    """
    rate_hz = float(settings.config.get("rate_hz") or DEFAULT_RATE_HZ)
    divisor = BASE_RATE_HZ / rate_hz
    if divisor < 1 or divisor != round(divisor):
        raise DriverSettingsError(f"rate_hz: got {rate_hz:g}, want a rate that divides 800, such as 200 or 400")
    measured = INCREMENTS if settings.config.get("sample") == "increment" else MEASUREMENTS
    samples: Outputs = {TIME: TIMES, IMU: (*measured, "temperature", "saturation")}
    commands = [
        "VNWRG,06,0",
        f"VNWRG,{SYNCHRONISATION}",
        output_command(75, round(divisor), samples),
        output_command(76, SOLUTION_DIVISOR, SOLUTION),
    ]
    messages = [_command(text) for text in commands]
    if options.baud is not None:
        messages.insert(0, _command(f"VNWRG,05,{options.baud}", baud=options.baud))
    return (*messages, *_saving(options))


def receiver_startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return the command for the output of the receiver inside the unit, and saving."""
    return (_command(output_command(77, FIX_DIVISOR, FIX)), *_saving(options))


def _saving(options: StartupOptions) -> tuple[StartupMessage, ...]:
    return (_command("VNWNV", last=True),) if options.save else ()


def output_command(register: int, divisor: int, fields: Outputs) -> str:
    """Return the command that sets a binary output: port, divisor, group byte, one word for each group, in
    hexadecimal.
    """
    numbers = {names: key for key, parts in wire.FIELDS.items() for names in [(key[0], parts[0][0])]}
    keys = {
        (group, numbers[group, f"{wire.RECEIVERS[group]}.{name}" if group in wire.RECEIVERS else name][1]): b""
        for group, names in fields.items()
        for name in names
    }
    frame = wire.encode_frame(keys)
    groups, words = frame[1], frame[2 : wire.read_header(frame, 0)]
    parts = [f"{int.from_bytes(words[at : at + 2], 'little'):04X}" for at in range(0, len(words), 2)]
    return f"VNWRG,{register},{PORT},{divisor},{groups:02X},{','.join(parts)}"


def _command(text: str, *, baud: int | None = None, last: bool = False) -> StartupMessage:
    """Return a command with its checksum; the unit answers with a copy, the number of a register without zeros."""
    body = text.encode("ascii")
    name, _, rest = text.partition(",")
    number = rest.partition(",")[0]
    echo = name if not number else f"{name},0*{int(number)}"
    accepted = re.compile(rb"\$" + echo.encode("ascii") + rb"(?:,[^*$\r\n]*)?\*[0-9A-Fa-f]{2,4}\r\n")
    data = b"$%s*%02X\r\n" % (body, nmea_xor(body))
    return StartupMessage((text,), data, lambda: PhraseListener(accepted, REFUSED), baud=baud, last=last)
