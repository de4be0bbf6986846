"""Tests signals cut out of frames against cantools: random signals, and every DBC of the fixtures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from swath.drivers.imu.dbc.signals import find_signal, load_database, signal_layout
from swath.drivers.parser import DriverSettingsError
from tests.drivers.imu_dbc import IMU_DBC

FIXTURES = Path(__file__).parents[4] / "fixtures"
DBC_FILES = [*sorted((FIXTURES / "dbc").glob("*.dbc")), FIXTURES / "sbg-ellipse/sbgCan.dbc"]
CANMOD_DBC = Path(__file__).parents[4] / "drivers/imu/canmod-gps.dbc"


@dataclass(frozen=True)
class DbcSignal:
    """One signal of a generated DBC."""

    first_bit: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    message_bytes: int

    def text(self) -> str:
        """Return a DBC with this one signal."""
        start = self.first_bit // 8 * 8 + 7 - self.first_bit % 8 if self.big_endian else self.first_bit
        order, sign = int(not self.big_endian), "-" if self.signed else "+"
        kind = {32: 1, 64: 2}.get(self.length) if self.is_float else None
        return (
            f'VERSION ""\nNS_ :\nBS_:\nBU_: X\n\nBO_ 100 M: {self.message_bytes} X\n'
            f' SG_ S : {start}|{self.length}@{order}{sign} ({self.scale!r},{self.offset!r}) [0|0] "m" X\n\n'
            + (f"SIG_VALTYPE_ 100 S : {kind};\n" if kind else "")
        )


@st.composite
def dbc_signals(draw: st.DrawFn) -> DbcSignal:
    """Draw any signal that fits a classic or an FD frame."""
    message_bytes = draw(st.sampled_from([8, 64]))
    is_float = draw(st.booleans())
    length = draw(st.sampled_from([32, 64])) if is_float else draw(st.integers(1, 64))
    return DbcSignal(
        first_bit=draw(st.integers(0, message_bytes * 8 - length)),
        length=length,
        big_endian=draw(st.booleans()),
        signed=True if is_float else draw(st.booleans()),
        is_float=is_float,
        scale=draw(st.sampled_from([1.0, 0.125, -0.01, 3.5e-7, 12.0])),
        offset=draw(st.sampled_from([0.0, -64.0, 1577840400.0])),
        message_bytes=message_bytes,
    )


def assert_like_cantools(message: Any, signal: Any, data: np.ndarray[Any, np.dtype[np.uint8]]) -> int:
    """Assert that every row's value equals cantools', and return the number of rows compared."""
    layout = signal_layout(message, signal)
    values = layout.values(layout.bits(data))
    compared = 0
    for row, value in zip(data, values.tolist(), strict=True):
        payload = row.tobytes()[: message.length]
        decoded = message.decode(payload, decode_choices=False, allow_truncated=True)
        if signal.name not in decoded:
            continue
        expected = float(decoded[signal.name])
        same = value == pytest.approx(expected, rel=1e-12, abs=1e-12) or (math.isnan(value) and math.isnan(expected))
        assert same, f"{layout} of {payload.hex()}: {value!r}, cantools {expected!r}"
        compared += 1
    return compared


@example(DbcSignal(17, 32, False, True, True, 1.0, 0.0, 8), [b"\0\0\0\0\1\xff" + bytes(58)])  # a signalling NaN
@example(DbcSignal(0, 64, False, True, True, 12.0, 0.0, 8), [bytes(6) + b"\xef\x7f" + bytes(56)])  # overflows
@settings(max_examples=300, deadline=None)
@given(dbc_signals(), st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=4))
def test_any_signal_reads_as_in_cantools(signal: DbcSignal, payloads: list[bytes]) -> None:
    message = load_database(signal.text().encode()).messages[0]
    rows = np.array([np.frombuffer(payload, np.uint8) for payload in payloads])[:, : signal.message_bytes]
    assert assert_like_cantools(message, message.signals[0], rows) == len(payloads)


def test_the_fixtures_hold_dbc_files() -> None:
    assert len(DBC_FILES) >= 6, "fixtures/dbc is incomplete"


@pytest.mark.parametrize("path", [*DBC_FILES, CANMOD_DBC], ids=lambda path: path.name)
def test_every_signal_of_real_dbc_files_reads_as_in_cantools(path: Path) -> None:
    generator = np.random.default_rng(7)
    compared = 0
    for message in load_database(path.read_bytes()).messages:
        data = generator.integers(0, 256, (5, 8), dtype=np.uint8)
        if message.length > 8:
            continue
        for signal in message.signals:
            if signal.is_multiplexer or signal.multiplexer_ids:
                continue  # cantools decodes by the multiplexer's value: see test_dbc.py
            if any(other.multiplexer_ids for other in message.signals):
                continue
            compared += assert_like_cantools(message, signal, data)
    multiplexed_only = path.name == "multiplex.dbc"
    assert compared >= (0 if multiplexed_only else 10), "too little was compared"


def test_error_for_a_missing_signal_lists_the_available_ones() -> None:
    database = load_database(IMU_DBC.encode())
    with pytest.raises(
        DriverSettingsError, match=r"no signal ACC.acc_w in imu.dbc; did you mean .*; message ACC has: "
    ):
        find_signal(database, "ACC.acc_w", "imu.dbc")
    with pytest.raises(DriverSettingsError, match=r"no message ACL in imu.dbc; did you mean ACC\?; it has: "):
        find_signal(database, "ACL.acc_x", "imu.dbc")
    with pytest.raises(DriverSettingsError, match=r"not of the form MESSAGE.signal"):
        find_signal(database, "acc_x", "imu.dbc")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_in_a_dbc_is_ignored(encoding: str) -> None:
    """Windows editors save such files."""
    marked = load_database(IMU_DBC.encode(encoding))
    assert [message.name for message in marked.messages] == [
        message.name for message in load_database(IMU_DBC.encode()).messages
    ]


def test_a_file_that_is_not_a_dbc_is_refused_in_one_line() -> None:
    with pytest.raises(DriverSettingsError, match="not a DBC file"):
        load_database(b"\x7fELF not a DBC")


def test_nested_multiplexing_is_refused() -> None:
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: X\n\nBO_ 100 M: 8 X\n SG_ A M : 0|8@1+ (1,0) [0|0] "" X\n'
        ' SG_ B m1M : 8|8@1+ (1,0) [0|0] "" X\n SG_ C m2 : 16|8@1+ (1,0) [0|0] "" X\n\nSG_MUL_VAL_ 100 B A 1-1;\n'
        "SG_MUL_VAL_ 100 C B 2-2;\n"
    )
    with pytest.raises(DriverSettingsError, match=r"M.C: nested multiplexing is not supported: B, which"):
        find_signal(load_database(text.encode()), "M.C", "imu.dbc")


def test_a_duplicate_message_is_refused_only_if_it_is_used(caplog: pytest.LogCaptureFixture) -> None:
    """The meaning of a frame with two definitions is unknown; unused duplicates are not reported."""
    message = IMU_DBC[IMU_DBC.index("BO_ ") :].split("\n\n")[0]
    name = message.split()[2].rstrip(":")
    database = load_database(f"{IMU_DBC}\n\n{message}\n".encode())
    assert not caplog.records
    signal = message.split("SG_ ")[1].split()[0]
    with pytest.raises(
        DriverSettingsError, match=rf"^message {name} is defined more than once in imu.dbc; keep one definition$"
    ):
        find_signal(database, f"{name}.{signal}", "imu.dbc")
