"""Tests the encoder's frames with cantools, each unit's DBC and the parser; other values are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
import pytest

from swath.drivers.can_frames import CAN_EFF_MASK, CAN_FRAME_DTYPE
from swath.drivers.imu import sbg_ellipse, xsens_mti
from swath.drivers.imu.dbc.encoder import encode_latch, encode_samples
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.dbc.settings import SignalMap, map_signals
from swath.drivers.parser import DeviceSettings
from swath.georef.records import ChunkBatch
from tests.drivers.imu_dbc import IMU_DBC, clock_rows, imu_rows, settings, without

N = 200
DBC_FLOAT = """VERSION ""
NS_ :
BS_:
BU_: X

BO_ 10 FORCE_X: 8 X
 SG_ x : 0|64@1- (1,0) [0|0] "m/s2" X

BO_ 11 FORCE: 8 X
 SG_ y : 7|32@0- (1,0) [0|0] "g" X
 SG_ z : 39|32@0- (1,0) [0|0] "g" X

BO_ 12 RATE: 8 X
 SG_ x : 3|17@1- (0.01,-5) [0|0] "deg/s" X
 SG_ y : 20|17@1- (0.01,0) [0|0] "deg/s" X
 SG_ z : 37|17@1- (0.01,0) [0|0] "deg/s" X

SIG_VALTYPE_ 10 x : 2;
SIG_VALTYPE_ 11 y : 1;
SIG_VALTYPE_ 11 z : 1;
"""
FLOAT_SIGNALS = {
    "specific_force": ["FORCE_X.x", "FORCE.y", "FORCE.z"],
    "angular_rate": [f"RATE.{axis}" for axis in "xyz"],
}


def units() -> dict[str, tuple[SignalMap, str, DeviceSettings]]:
    """Return signal maps, the DBC's text as cantools reads it, and settings, by a name for the test."""
    empty = DeviceSettings("imu/main")
    ticked = DeviceSettings("imu/main", {"tick_hz": 10_000})
    little = DeviceSettings("imu/main", {"tick_hz": 10_000, "byte_order": "little"})
    floats, own = settings(DBC_FLOAT, FLOAT_SIGNALS), settings(IMU_DBC, without("pps_ticks"))
    return {
        "sbg-ellipse": (sbg_ellipse.signal_map(empty), sbg_ellipse.DBC_PATH.read_text(), empty),
        "xsens-mti": (xsens_mti.signal_map(ticked), xsens_mti.dbc_text("big"), ticked),
        "xsens-mti little": (xsens_mti.signal_map(little), xsens_mti.dbc_text("little"), little),
        "dbc": (map_signals(own), IMU_DBC, own),
        "floats": (map_signals(floats), DBC_FLOAT, floats),
    }


UNITS = units()


def columns() -> dict[str, Any]:
    """Return columns with values of N samples."""
    rng = np.random.default_rng(3)
    return {
        "ticks": 2**32 - 5000 + 100 * np.arange(N),
        "specific_force": rng.uniform(-90.0, 90.0, (N, 3)),
        "angular_rate": rng.uniform(-5.0, 5.0, (N, 3)),
        "temperature_c": rng.uniform(-40.0, 85.0, N),
        "status": rng.integers(0, 2**16, N),
        "packet_counter": np.arange(N) + 65400,
    }


def decoded(text: str, frames: np.ndarray[Any, np.dtype[np.uint8]]) -> dict[str, list[float]]:
    """Return cantools' values by ``MESSAGE.signal``, in order, without signals beyond a frame's end."""
    database: Any = cantools.database.load_string(text, database_format="dbc", strict=False)
    values: dict[str, list[float]] = {}
    for frame in frames.reshape(-1).view(CAN_FRAME_DTYPE):
        message = database.get_message_by_frame_id(int(frame["can_id"]) & CAN_EFF_MASK)
        data = frame["data"][: frame["length"]].tobytes()
        for name, value in message.decode(data, decode_choices=False, allow_truncated=True).items():
            values.setdefault(f"{message.name}.{name}", []).append(float(value))
    return values


@pytest.mark.parametrize("name", UNITS)
def test_cantools_decodes_encoded_frames_to_the_input(name: str) -> None:
    signals, text, _ = UNITS[name]
    given = columns()
    theirs = decoded(text, encode_samples(signals, **given))
    for number, signal in enumerate(signals.vectors):
        expected = given["specific_force" if number < 3 else "angular_rate"][:, number % 3]
        resolution = 1e-5 if signal.layout.is_float else 0.5001 * signal.layout.scale * signal.factor
        got = np.array(theirs[signal.layout.name]) * signal.factor
        np.testing.assert_allclose(got, expected, rtol=0, atol=resolution)
    for key in ("temperature", "status", "packet_counter", "sample_ticks"):
        scalar = getattr(signals, key)
        if scalar is not None and key == "temperature":
            np.testing.assert_allclose(
                theirs[scalar.layout.name], given["temperature_c"], atol=0.51 * scalar.layout.scale
            )
        elif scalar is not None:
            expected = given["ticks" if key == "sample_ticks" else key] % (1 << scalar.layout.length)
            assert theirs[scalar.layout.name] == expected.tolist()


@pytest.mark.parametrize("name", UNITS)
def test_the_parser_reads_back_every_sample(name: str) -> None:
    signals, _, made = UNITS[name]
    frames = encode_samples(signals, **columns())
    parser = DbcParser(made, signal_map=signals)
    host_ns = np.repeat(np.arange(N, dtype=np.int64) * 10_000_000, len(frames) // N)
    rows = imu_rows([*parser.feed_batch(ChunkBatch("imu/main", host_ns, frames)), *parser.close()])
    assert len(rows) == N
    assert not +parser.counters.errors
    if signals.sample_ticks is not None:
        assert set(np.diff(rows["device_time_ns"]).tolist()) == {100 * 1_000_000_000 // int(signals.tick_hz)}


def test_a_latched_edge_has_its_own_frame() -> None:
    made = DeviceSettings("imu/main", {"pps_event": "B", "ids": {"EVENT_INFO_B": 0x7A0}})
    signals = sbg_ellipse.signal_map(made)
    parser = sbg_ellipse.make_clock_parser(made)
    frames = encode_samples(signals, np.array([5000, 10_000]), np.zeros((2, 3)), np.zeros((2, 3)))
    pulse = np.frombuffer(encode_latch(signals, 4000), np.uint8)
    rows = clock_rows(
        [*parser.feed_batch(ChunkBatch("imu/main", np.arange(7), np.vstack([pulse, frames]))), *parser.close()]
    )
    assert rows["pps_time_ns"].tolist() == [4_000_000, 4_000_000]
    with pytest.raises(ValueError, match="needs a message of its own"):
        encode_latch(UNITS["sbg-ellipse"][0], 1)


def test_values_that_do_not_fit_are_refused() -> None:
    signals = UNITS["sbg-ellipse"][0]
    with pytest.raises(ValueError, match=r"GYRO_Z holds 16 bits: 40.0 … 40.0 does not fit"):
        encode_samples(signals, np.array([0]), np.zeros((1, 3)), np.array([[0.0, 0.0, 40.0]]))
    text = DBC_FLOAT.replace("BO_ 12 RATE: 8", "BO_ 12 RATE: 64").replace("z : 37|17", "z : 100|17")
    beyond = map_signals(settings(text, FLOAT_SIGNALS))
    with pytest.raises(ValueError, match=r"RATE.z lies beyond the 8 bytes"):
        encode_samples(beyond, np.array([0]), np.zeros((1, 3)), np.zeros((1, 3)))


def test_the_manufacturers_dbc_decodes_frames_like_the_encoders_own_dbc() -> None:
    shipped = Path(__file__).parents[4] / "fixtures/sbg-ellipse/sbgCan.dbc"
    theirs = decoded(shipped.read_text(encoding="cp1252"), encode_samples(UNITS["sbg-ellipse"][0], **columns()))
    assert theirs == decoded(UNITS["sbg-ellipse"][1], encode_samples(UNITS["sbg-ellipse"][0], **columns()))
