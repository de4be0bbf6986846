"""Start-up messages of u-blox receivers of generation 9 and later: UBX-CFG-VALSET, acknowledged by UBX-ACK.

u-blox ZED-F9P interface description (UBX-18010854): UBX-CFG-VALSET, UBX-ACK, constants of CFG-RATE-TIMEREF and CFG-TP.
A message with one unknown key sets nothing, so each concern has its own message: a missing feature affects no other.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from swath.drivers.framing.framer import Frame, Framer
from swath.drivers.framing.kinds import GNSS_KINDS
from swath.drivers.gnss.ubx.messages import encode_frame
from swath.drivers.parser import DeviceSettings, DriverSettingsError, ParserCounters
from swath.drivers.startup import Answer, AnswerListener, StartupMessage, StartupOptions, read_setup

CFG_VALSET = b"\x06\x8a"
ACK_ACK, ACK_NAK = b"\x05\x01", b"\x05\x00"  # payload: class and id of the answered message
ACK_PAYLOAD = slice(6, 8)
VALSET_HEADER = struct.Struct("<BB2x")  # version, layers, reserved
LAYER_RAM, LAYER_BBR, LAYER_FLASH = 1, 2, 4

KEY_SIZE_SHIFT, KEY_SIZE_BITS = 28, 7  # bits of a key's id that give the size of its value
VALUE_FORMATS = {1: "B", 2: "B", 3: "H", 4: "I"}

PORT_PLACES = {"UART1": 1, "UART2": 2, "USB": 3}  # offsets of a message's keys: I2C, UART1, UART2, USB, SPI
UBX_OUTPUT = {"UART1": 0x10740001, "UART2": 0x10760001, "USB": 0x10780001}
BAUD_RATES = {"UART1": 0x40520001, "UART2": 0x40530001}

MESSAGE_RATES = {  # CFG-MSGOUT-UBX_…, the key of I2C; its value is a number of epochs
    "NAV_PVT": 0x20910006,
    "NAV_HPPOSLLH": 0x20910033,
    "NAV_COV": 0x20910083,
    "NAV_TIMEGPS": 0x20910047,
    "NAV_TIMELS": 0x20910060,
    "NAV_EOE": 0x2091015F,
    "NAV_RELPOSNED": 0x2091008D,
    "TIM_TP": 0x2091017D,
    "TIM_TM2": 0x20910178,
    "RXM_RAWX": 0x209102A4,
    "RXM_SFRBX": 0x20910231,
}
EACH_EPOCH = ("NAV_PVT", "NAV_HPPOSLLH", "NAV_COV", "NAV_TIMEGPS", "NAV_EOE", "TIM_TP", "TIM_TM2")
HEADING_EACH_EPOCH = ("NAV_RELPOSNED",)  # where a second antenna is configured
EACH_SECOND = ("NAV_TIMELS",)
RAW_EACH_EPOCH, RAW_EACH_SECOND = ("RXM_SFRBX",), ("RXM_RAWX",)

PERIOD_US = 1_000_000
PULSE_US = 100_000
TIME_PULSE = (  # 1 Hz, rising edge at the top of the second of GPS time; no pulse before the time is known
    ("CFG-TP-PULSE_DEF", 0x20050023, 0),  # PERIOD
    ("CFG-TP-PULSE_LENGTH_DEF", 0x20050030, 1),  # LENGTH
    ("CFG-TP-PERIOD_TP1", 0x40050002, PERIOD_US),
    ("CFG-TP-PERIOD_LOCK_TP1", 0x40050003, PERIOD_US),
    ("CFG-TP-LEN_TP1", 0x40050004, 0),
    ("CFG-TP-LEN_LOCK_TP1", 0x40050005, PULSE_US),
    ("CFG-TP-TP1_ENA", 0x10050007, 1),
    ("CFG-TP-SYNC_GNSS_TP1", 0x10050008, 1),
    ("CFG-TP-USE_LOCKED_TP1", 0x10050009, 1),
    ("CFG-TP-ALIGN_TO_TOW_TP1", 0x1005000A, 1),
    ("CFG-TP-POL_TP1", 0x1005000B, 1),  # rising
    ("CFG-TP-TIMEGRID_TP1", 0x2005000C, 1),  # GPS
)


class Item(NamedTuple):
    """One setting: name and id of its key, and its value."""

    name: str
    key: int
    value: int


class AckListener(AnswerListener):
    """Finds the acknowledgement of a UBX-CFG-VALSET between frames of any kind."""

    def __init__(self) -> None:
        self._framer = Framer(GNSS_KINDS, ParserCounters())

    def hear(self, data: bytes) -> Answer | None:
        """Take one read; return the answer once it is complete."""
        return self._find(self._framer.feed(data, 0))

    def close(self) -> Answer | None:
        """Return the answer in the frames that a false sync held back."""
        return self._find(self._framer.close())

    @staticmethod
    def _find(frames: list[Frame]) -> Answer | None:
        for kind, _, data in frames:
            if kind == "ubx" and data[2:4] in (ACK_ACK, ACK_NAK) and data[ACK_PAYLOAD] == CFG_VALSET:
                return Answer(True) if data[2:4] == ACK_ACK else Answer(False, "UBX-ACK-NAK")
        return None


def encode_valset(items: tuple[Item, ...], layers: int) -> bytes:
    """Encode a UBX-CFG-VALSET, version 0: at most 64 keys with values, stored in the given layers."""
    payload = VALSET_HEADER.pack(0, layers)
    for item in items:
        size = item.key >> KEY_SIZE_SHIFT & KEY_SIZE_BITS
        payload += struct.pack("<I" + VALUE_FORMATS[size], item.key, item.value)
    return encode_frame(CFG_VALSET, payload)


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return messages that set UBX output, rates, time pulse and messages; the baud rate first where it changes.

    Raises:
        DriverSettingsError: the receiver has no such port.
    """
    setup = read_setup(settings)
    port = setup.port or "UART1"
    if port not in PORT_PLACES:
        raise DriverSettingsError(f"setup.port: got {port!r}, want one of: {', '.join(PORT_PLACES)}")
    layers = LAYER_RAM | LAYER_BBR | (LAYER_FLASH if options.save else 0)
    groups = [
        (Item(f"CFG-{port}OUTPROT-UBX", UBX_OUTPUT[port], 1),),
        (
            Item("CFG-RATE-MEAS", 0x30210001, round(1000 / setup.rate_hz)),
            Item("CFG-RATE-NAV", 0x30210002, 1),
            Item("CFG-RATE-TIMEREF", 0x20210003, 1),  # GPS
        ),
        tuple(Item(*item) for item in TIME_PULSE),
    ]
    two_antennas = settings.config.get("secondary_lever_arm_m") is not None
    each_epoch = EACH_EPOCH + (HEADING_EACH_EPOCH if two_antennas else ()) + (RAW_EACH_EPOCH if setup.raw else ())
    each_second = EACH_SECOND + (RAW_EACH_SECOND if setup.raw else ())
    groups += [(_message_rate(name, port, 1),) for name in each_epoch]
    groups += [(_message_rate(name, port, setup.rate_hz),) for name in each_second]
    messages = [_valset(items, layers) for items in groups]
    if options.baud is not None and port in BAUD_RATES:
        rate = Item(f"CFG-{port}-BAUDRATE", BAUD_RATES[port], options.baud)
        messages.insert(0, _valset((rate,), layers, options.baud))
    return tuple(messages)


def _message_rate(name: str, port: str, epochs: int) -> Item:
    return Item(f"CFG-MSGOUT-UBX_{name}_{port}", MESSAGE_RATES[name] + PORT_PLACES[port], epochs)


def _valset(items: tuple[Item, ...], layers: int, baud: int | None = None) -> StartupMessage:
    where = "+".join(name for name, bit in (("RAM", 1), ("BBR", 2), ("Flash", 4)) if layers & bit)
    lines = (f"UBX-CFG-VALSET {where}", *(f"{item.name} = {item.value}" for item in items))
    return StartupMessage(lines, encode_valset(items, layers), AckListener, baud=baud)
