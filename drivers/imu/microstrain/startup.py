"""Start-up messages of MicroStrain units: MIP commands.

Sources: MicroStrain's MIP SDK (``commands_base.hpp``: set to idle, communication speed, resume; ``commands_3dm.hpp``:
message format, data stream control). A unit answers with a field F1 that repeats the command's descriptor and contains
an error code, 0 where it has executed the command.
"""

from __future__ import annotations

import struct

from swath.drivers.framing.framer import Framer
from swath.drivers.imu.microstrain.wire import FIELDS, FILTER, MIP, SENSOR, SHARED, encode_packet, split_fields
from swath.drivers.parser import DeviceSettings, DriverSettingsError, ParserCounters
from swath.drivers.startup import Answer, AnswerListener, StartupMessage, StartupOptions

BASE_RATE_HZ = 1000.0  # decimations count from it; 500 in some units of the GX5 and CX5 series
DEFAULT_RATE_HZ = 200.0
SOLUTION_DECIMATION, RECEIVER_DECIMATION = 20, 1
BASE, THREE_DM = 0x01, 0x0C
COMMUNICATION_SPEED, MESSAGE_FORMAT, STREAM_CONTROL = 0x09, 0x0F, 0x11
WRITE, SAVE = 1, 3
ANSWER = 0xF1
RECEIVER_SET = 0x91
PORT = 1
ERRORS = {
    1: "unknown command",
    2: "invalid checksum",
    3: "invalid parameter",
    4: "command failed",
    5: "command timed out",
}

TIMES = ("reference_ns", "reference_step_ns", "gps_time")
SENSOR_FIELDS = {"mean": ("accel_g", "gyro"), "increment": ("delta_theta", "delta_velocity_gs")}
SOLUTION = ("gps_time", "position", "velocity", "euler", "position_sigma", "velocity_sigma", "euler_sigma", "status")
FIX = ("epoch", "position", "velocity", "fix", "leap_seconds")


class AckListener(AnswerListener):
    """Finds a unit's answer to one command among its data."""

    def __init__(self, descriptor_set: int, command: int) -> None:
        self._set, self._command = descriptor_set, command
        self._framer = Framer((MIP,), ParserCounters())

    def hear(self, data: bytes) -> Answer | None:
        """Take one read; return the answer of the first packet that answers the command."""
        return self._find([frame.data for frame in self._framer.feed(data, 0)])

    def close(self) -> Answer | None:
        """Return the answer held back behind a false sync."""
        return self._find([frame.data for frame in self._framer.close()])

    def _find(self, frames: list[bytes]) -> Answer | None:
        for frame in frames:
            for descriptor, content in (split_fields(frame) or ()) if frame[2] == self._set else ():
                if descriptor == ANSWER and len(content) == 2 and content[0] == self._command:
                    error = content[1]
                    return Answer(not error, ERRORS.get(error, f"error {error}") if error else "")
        return None


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the baud rate where it changes, formats and streams of sensor and filter data, and saving.

    Raises:
        DriverSettingsError: ``rate_hz`` does not divide the unit's 1000 Hz.
    """
    rate_hz = float(settings.config.get("rate_hz") or DEFAULT_RATE_HZ)
    decimation = BASE_RATE_HZ / rate_hz
    if decimation < 1 or decimation != round(decimation):
        raise DriverSettingsError(f"rate_hz: got {rate_hz:g}, want a rate that divides 1000, such as 200 or 500")
    kind = "increment" if settings.config.get("sample") == "increment" else "mean"
    formats = (
        (SENSOR, round(decimation), (*TIMES, *SENSOR_FIELDS[kind], "temperature", "overrange")),
        (FILTER, SOLUTION_DECIMATION, SOLUTION),
    )
    messages = [_format(descriptor_set, every, names) for descriptor_set, every, names in formats]
    messages += [_stream(descriptor_set) for descriptor_set, _, _ in formats]
    if options.baud is not None:
        content = struct.pack(">BBI", WRITE, PORT, options.baud)
        line = f"communication speed, port {PORT}, {options.baud}"
        messages.insert(0, _command(BASE, COMMUNICATION_SPEED, content, line, baud=options.baud))
    return (*messages, *_saving(options))


def receiver_startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the format and stream of the receiver inside the unit, and saving."""
    return (_format(RECEIVER_SET, RECEIVER_DECIMATION, FIX), _stream(RECEIVER_SET), *_saving(options))


def _saving(options: StartupOptions) -> tuple[StartupMessage, ...]:
    save = _command(THREE_DM, MESSAGE_FORMAT, bytes([SAVE, 0]), "message format, save all", last=True)
    return (save,) if options.save else ()


def _format(descriptor_set: int, decimation: int, names: tuple[str, ...]) -> StartupMessage:
    """Return the command that sets which fields a set has, each with the same decimation."""
    numbers = {name: number for number, (name, _) in {**SHARED, **FIELDS[descriptor_set]}.items()}
    fields = b"".join(struct.pack(">BH", numbers[name], decimation) for name in names)
    listed = " ".join(f"{numbers[name]:02X}" for name in names)
    line = f"message format, set {descriptor_set:02X}, every {decimation}: {listed}"
    return _command(THREE_DM, MESSAGE_FORMAT, bytes([WRITE, descriptor_set, len(names)]) + fields, line)


def _stream(descriptor_set: int) -> StartupMessage:
    content = bytes([WRITE, descriptor_set, 1])
    return _command(THREE_DM, STREAM_CONTROL, content, f"data stream, set {descriptor_set:02X}, on")


def _command(
    descriptor_set: int, command: int, content: bytes, line: str, *, baud: int | None = None, last: bool = False
) -> StartupMessage:
    data = encode_packet(descriptor_set, (command, content))
    return StartupMessage((line,), data, lambda: AckListener(descriptor_set, command), baud=baud, last=last)
