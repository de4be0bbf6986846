"""Encodes the CAN frames of an inertial unit with the signal map that its parser uses.

It serves the virtual aircraft and the tests, for any unit described by a DBC; `swath.drivers.imu.dbc.parser` reads its
frames.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swath.drivers.can_frames import CAN_FRAME_BYTES, CAN_FRAME_DTYPE
from swath.drivers.imu.dbc.settings import MappedSignal, SignalMap
from swath.drivers.imu.dbc.signals import FLOAT_TYPES, SignalLayout
from swath.georef.arrays import FloatArray, Int64Array, UInt64Array
from swath.georef.records import ByteRows

CLASSIC_BYTES = 8


def encode_samples(
    signals: SignalMap,
    ticks: Int64Array,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    *,
    temperature_c: FloatArray | None = None,
    status: Int64Array | None = None,
    packet_counter: Int64Array | None = None,
) -> ByteRows:
    """Encode frames of n samples, sample after sample; an opening message comes first, a closing one last in its
    sample.

    Messages beside the samples are sent with every sample if their values are given.

    Args:
        signals: the signal map.
        ticks: (n,) the device's counter; its low bits are sent.
        specific_force: (n, 3) m/s², in the device's axes.
        angular_rate: (n, 3) rad/s, in the device's axes.
        temperature_c, status, packet_counter: (n,) each; where absent, not sent, or 0 in a message that is sent.

    Returns:
        (n · messages of a sample, 16) frames in the layout of the log and SocketCAN.

    Raises:
        ValueError: a message has more than 8 bytes, or a value does not fit its signal.
    """
    scalars = (
        (signals.sample_ticks, ticks),
        (signals.temperature, temperature_c),
        (signals.status, status),
        (signals.packet_counter, packet_counter),
    )
    words = np.zeros((len(signals.parts), len(ticks)), np.uint64)
    sent = set(range(signals.grouped))
    for number, signal in enumerate(signals.vectors):
        values = (specific_force if number < 3 else angular_rate)[:, number % 3] / signal.factor
        words[signal.part] |= _placed(signal.layout, _raw_of_values(signal.layout, values))
    for scalar, column in scalars:
        if scalar is not None and column is not None:
            words[scalar.part] |= _placed(scalar.layout, _raw_of_scalar(signals, scalar, column))
            sent.add(scalar.part)
    order = list(_order(signals, sent))
    return np.stack([_frames(signals, part, words[part]) for part in order], axis=1).reshape(-1, CAN_FRAME_BYTES)


def encode_latch(signals: SignalMap, ticks: int) -> bytes:
    """Encode the frame of the message with the counter latched at a PPS edge.

    Raises:
        ValueError: the latched counter needs a message of its own, or the message has more than 8 bytes.
    """
    latch = signals.pps_ticks
    if latch is None or latch.part < signals.grouped:
        raise ValueError("the latched counter needs a message of its own")
    word = _placed(latch.layout, np.array([ticks], np.int64).astype(np.uint64))
    frame: bytes = _frames(signals, latch.part, word)[0].tobytes()
    return frame


def _order(signals: SignalMap, sent: set[int]) -> Iterator[int]:
    """Yield the parts of a sample in sending order; the key part is first or last, by the rule."""
    key = signals.key_part
    others = sorted(sent - {key})
    yield from [*others, key] if signals.rule == "last" else [key, *others]


def _raw_of_scalar(signals: SignalMap, signal: MappedSignal, column: Int64Array | FloatArray) -> UInt64Array:
    """Return raw values: counters and status words unchanged, a temperature by its scale."""
    if signal is signals.temperature:
        return _raw_of_values(signal.layout, np.asarray(column, np.float64))
    return np.asarray(column, np.int64).astype(np.uint64)


def _raw_of_values(layout: SignalLayout, values: FloatArray) -> UInt64Array:
    """Return the bits of physical values, rounded to the signal's resolution."""
    scaled = (values - layout.offset) / layout.scale
    if layout.is_float:
        unsigned, floating = FLOAT_TYPES[layout.length]
        return scaled.astype(floating).view(unsigned).astype(np.uint64)
    raw = np.rint(scaled)
    least = -(2.0 ** (layout.length - 1)) if layout.signed else 0.0
    if len(raw) and not (raw.min() >= least and raw.max() < least + 2.0**layout.length):
        raise ValueError(f"{layout.name} holds {layout.length} bits: {values.min()} … {values.max()} does not fit")
    return raw.astype(np.int64).astype(np.uint64)


def _placed(layout: SignalLayout, raw: UInt64Array) -> UInt64Array:
    """Return the signal's bits at their position, in the word whose little-endian bytes are the frame's data."""
    if layout.needs_bytes > CLASSIC_BYTES:
        raise ValueError(f"{layout.name} lies beyond the 8 bytes of a classic frame")
    word = (raw & np.uint64((1 << layout.length) - 1)) << np.uint64(layout.shift)
    return word.byteswap() if layout.big_endian else word


def _frames(signals: SignalMap, part: int, words: UInt64Array) -> ByteRows:
    """Return (n, 16) frames of one message."""
    frames = np.zeros(len(words), CAN_FRAME_DTYPE)
    frames["can_id"] = signals.parts[part].can_id
    frames["length"] = signals.parts[part].needs_bytes
    frames["data"] = words.astype("<u8").view(np.uint8).reshape(-1, CLASSIC_BYTES)
    return frames.view(np.uint8).reshape(-1, CAN_FRAME_BYTES)
