"""Finds signals of a DBC file by name and extracts them from whole batches of frames.

A DBC signal is a run of bits in a frame's data (start bit, length, byte order), read as unsigned, two's complement or
IEEE 754, times scale plus offset. Little-endian ("Intel", ``@1``): the start bit is the lowest one, bits count up
through the bytes. Big-endian ("Motorola", ``@0``): the start bit is the highest one, as ``byte * 8 + bit in byte``,
and bits continue downwards into the next byte.
"""

from __future__ import annotations

import difflib
import logging
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.drivers.can_frames import CAN_EFF_FLAG, frame_id
from swath.drivers.parser import DriverSettingsError
from swath.georef.arrays import BoolArray, FloatArray, UInt64Array
from swath.georef.records import ByteRows
from swath.georef.text_encoding import decoded

WORD_BITS = 64
LONG_IDENTIFIER = re.compile(r"Standard frame id 0x([0-9a-fA-F]+) is more than 11 bits in message (\w+)")  # cantools'
FLOAT_TYPES: dict[int, tuple[type[np.unsignedinteger[Any]], str]] = {
    16: (np.uint16, "<f2"),
    32: (np.uint32, "<f4"),
    64: (np.uint64, "<f8"),
}


@dataclass(frozen=True, slots=True)
class SignalLayout:
    """Position and scaling of a signal.

    Attributes:
        name: ``MESSAGE.signal``.
        first_byte: first byte of the 64-bit word that contains it.
        shift: number of bits below it in that word; negative where it reaches into a ninth byte.
        length: number of bits.
        big_endian, signed, is_float: interpretation of its bits.
        scale, offset: physical = raw · scale + offset.
        unit: unit as written in the DBC.
        needs_bytes: number of data bytes that a frame must have to contain it.
        minimum, maximum: the DBC's range of physical values; infinite where it gives none.
    """

    name: str
    first_byte: int
    shift: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    unit: str
    needs_bytes: int
    minimum: float = -math.inf
    maximum: float = math.inf

    def bits(self, data: ByteRows) -> UInt64Array:
        """Return the signal's bits of each row of (n, 8 or 64) data, right-aligned and unsigned."""
        word = np.ascontiguousarray(data[:, self.first_byte : self.first_byte + 8]).view("<u8").reshape(-1)
        if self.big_endian:
            word = word.byteswap()
        mask = np.uint64((1 << self.length) - 1)
        if self.shift >= 0:
            return (word >> np.uint64(self.shift)) & mask
        return self._with_ninth_byte(data, word) & mask

    def _with_ninth_byte(self, data: ByteRows, word: UInt64Array) -> UInt64Array:
        """Return the bits of a signal that begins inside one byte and ends in the ninth."""
        ninth = data[:, self.first_byte + 8].astype(np.uint64)
        over = -self.shift
        if self.big_endian:
            return (word << np.uint64(over)) | (ninth >> np.uint64(8 - over))
        low = WORD_BITS - (self.length - over)
        return (word >> np.uint64(low)) | (ninth << np.uint64(WORD_BITS - low))

    @np.errstate(invalid="ignore", over="ignore")
    def values(self, bits: UInt64Array) -> FloatArray:
        """Return physical values of right-aligned bits; floats on the wire may be NaN or overflow."""
        if self.is_float:
            unsigned, floating = FLOAT_TYPES[self.length]
            raw = bits.astype(unsigned).view(floating).astype(np.float64)
        elif self.signed:
            up = np.uint64(WORD_BITS - self.length)
            raw = ((bits << up).view(np.int64) >> np.int64(up)).astype(np.float64)
        else:
            raw = bits.astype(np.float64)
        if self.scale != 1.0:
            raw *= self.scale
        if self.offset != 0.0:
            raw += self.offset
        return raw

    def outside(self, values: FloatArray) -> BoolArray:
        """Return which physical values (n,) are outside the DBC's range, by more than half a step."""
        half = max(1e-6 * abs(self.minimum), 1e-6 * abs(self.maximum)) if self.is_float else 0.5 * abs(self.scale)
        if not np.isfinite(half):  # a range that is open on one side, of a float
            half = 0.0
        return (values < self.minimum - half) | (values > self.maximum + half)


@dataclass(frozen=True, slots=True)
class FoundSignal:
    """A configured signal: its layout and the frames that carry it.

    Attributes:
        layout: its position and scaling.
        can_id: ``can_id`` word of its message, extended flag included.
        message: the message's name.
        selector: layout of the multiplexer that decides whether a frame carries it; None: every frame does.
        selector_values: the multiplexer's values in frames that carry it.
    """

    layout: SignalLayout
    can_id: int
    message: str
    selector: SignalLayout | None = None
    selector_values: frozenset[int] = frozenset()


def signal_layout(message: Any, signal: Any) -> SignalLayout:
    """Return the layout of a cantools signal.

    Raises:
        DriverSettingsError: the signal is a float of another length than 16, 32 or 64 bits, or longer than 64 bits.
    """
    name = f"{message.name}.{signal.name}"
    length = int(signal.length)
    if length > WORD_BITS:
        raise DriverSettingsError(f"signal {name} has {length} bits; want at most 64")
    if signal.is_float and length not in FLOAT_TYPES:
        raise DriverSettingsError(f"signal {name} is a float of {length} bits; want 16, 32 or 64")
    big_endian = signal.byte_order == "big_endian"
    start = int(signal.start)
    if big_endian:  # bits counted from the highest bit of byte 0
        first_bit = start // 8 * 8 + 7 - start % 8
    else:
        first_bit = start
    last_byte = (first_bit + length - 1) // 8
    first_byte = first_bit // 8 if last_byte >= 8 else 0
    first_byte = min(first_byte, 56)
    inside = first_bit - first_byte * 8
    past = inside + length - WORD_BITS  # bits in a ninth byte
    shift = -past if big_endian or past > 0 else inside
    return SignalLayout(
        name=name,
        first_byte=first_byte,
        shift=shift,
        length=length,
        big_endian=big_endian,
        signed=bool(signal.is_signed),
        is_float=bool(signal.is_float),
        scale=float(signal.scale),
        offset=float(signal.offset),
        unit=signal.unit or "",
        needs_bytes=last_byte + 1,
        **_range_of(signal),
    )


def _range_of(signal: Any) -> dict[str, float]:
    """Return a cantools signal's range; ``[0|0]`` and a range without width give none."""
    least, most = signal.minimum, signal.maximum
    if least is not None and most is not None and least >= most:
        return {}
    return {
        "minimum": -math.inf if least is None else float(least),
        "maximum": math.inf if most is None else float(most),
    }


def load_database(contents: bytes, key: str = "dbc") -> Any:
    """Load the cantools database of a DBC file's bytes.

    The text is UTF-8, UTF-16 by its mark, else Windows-1252, the format's own encoding.

    Raises:
        DriverSettingsError: the file is not a DBC file.
    """
    import cantools.database as dbc  # slow to import, and needed only with a DBC
    from cantools.database import errors

    logging.getLogger("cantools").setLevel(logging.ERROR)  # `find_signal` reports relevant duplicates
    try:
        text = decoded(contents)
    except UnicodeDecodeError:
        text = contents.decode("cp1252", errors="replace")
    try:
        return dbc.load_string(text, database_format="dbc", strict=False)
    except (errors.Error, ValueError) as error:
        if long := LONG_IDENTIFIER.search(str(error)):
            number, message = int(long[1], 16), long[2]
            raise DriverSettingsError(
                f"{key}: the identifier {number} of message {message} has more than 11 bits; "
                f"a DBC marks 29 bits by adding 2147483648: BO_ {number | CAN_EFF_FLAG} {message}"
            ) from error
        raise DriverSettingsError(f"{key}: not a DBC file ({' '.join(str(error).split())})") from error


def find_signal(database: Any, path: str, file_name: str) -> FoundSignal:
    """Find ``MESSAGE.signal`` in a database.

    Raises:
        DriverSettingsError: the message or signal is missing; the text lists the existing ones.
    """
    message_name, dot, signal_name = path.partition(".")
    if not dot or not signal_name:
        raise DriverSettingsError(f"signal {path!r} is not of the form MESSAGE.signal")
    messages = {message.name: message for message in database.messages}
    if sum(message.name == message_name for message in database.messages) > 1:
        raise DriverSettingsError(
            f"message {message_name} is defined more than once in {file_name}; keep one definition"
        )
    if message_name not in messages:
        raise DriverSettingsError(f"no message {message_name} in {file_name}{_instead(message_name, messages, 'it')}")
    message = messages[message_name]
    signals = {signal.name: signal for signal in message.signals}
    if signal_name not in signals:
        there = _instead(signal_name, signals, f"message {message_name}")
        raise DriverSettingsError(f"no signal {path} in {file_name}{there}")
    selector, selector_values = _multiplexing(message, signals, signals[signal_name])
    return FoundSignal(
        layout=signal_layout(message, signals[signal_name]),
        can_id=frame_id(message.frame_id, extended=message.is_extended_frame),
        message=message_name,
        selector=selector,
        selector_values=selector_values,
    )


def _multiplexing(message: Any, signals: dict[str, Any], signal: Any) -> tuple[SignalLayout | None, frozenset[int]]:
    """Return the multiplexer that selects a signal; one level is supported, deeper ones are refused."""
    if not signal.multiplexer_ids:
        return None, frozenset()
    selector = signals[signal.multiplexer_signal]
    if selector.multiplexer_ids:
        raise DriverSettingsError(
            f"signal {message.name}.{signal.name}: nested multiplexing is not supported: {selector.name}, which "
            "selects it, is selected itself; want a DBC in which one multiplexer selects it"
        )
    return signal_layout(message, selector), frozenset(int(value) for value in signal.multiplexer_ids)


def _instead(wanted: str, names: dict[str, Any], owner: str) -> str:
    """Return ``; did you mean …?`` and the list of existing names."""
    close = difflib.get_close_matches(wanted, names, n=3, cutoff=0.5)
    listed = ", ".join(list(names)[:12]) + (", …" if len(names) > 12 else "")
    meant = f"; did you mean {' or '.join(close)}?" if close else ""
    return f"{meant}; {owner} has: {listed}" if names else f"; {owner} has none"
