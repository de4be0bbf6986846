"""UBX-ESF: samples of the inertial sensors in u-blox receivers with dead reckoning, and the motion they result in.

ESF-MEAS has one value of each sensor and a time tag, ESF-RAW several values with a time tag each: three rates in
2^-12 deg/s, three accelerations in 2^-10 m/s², the gyroscope's temperature in 0.01 °C (u-blox 8 / M8 receiver
description, "ESF measurement data"; M8 ADR and UDR, F9 HPS). Values of one tag make one sample, in the sensor's axes.
A receiver that sends both sends the same samples twice: from the first ESF-RAW on, ESF-MEAS is not used.

The manuals give no unit of the tags. Here those of ESF-MEAS count milliseconds and those of ESF-RAW 1/25600 s, which
was not confirmed on a device; the setting ``tick_hz`` overrides both.
"""

from __future__ import annotations

import struct
from math import nan, radians

import numpy as np

from swath.drivers.gnss.ubx.messages import ESF_INS, ESF_INS_FIRST_VALID_BIT, EsfIns, encode_frame
from swath.drivers.imu.counters import CounterUnwrapper
from swath.drivers.parser import DeviceSettings, DriverSettingsError, ParserCounters
from swath.drivers.record_rows import Row
from swath.georef.records import DeviceStatus, ImuSamples
from swath.georef.timescales.gps_time import SECOND_NS

MEAS_KEY, RAW_KEY = b"\x10\x02", b"\x10\x03"
MEAS_HEADER = struct.Struct("<IHH")  # time tag, flags, provider
RAW_HEADER_BYTES = 4  # reserved
PAIR = struct.Struct("<II")  # value and its time tag
VALUE = struct.Struct("<I")
COUNT_SHIFT, CALIBRATED_TAG = 11, 8  # of the flags: number of values; a receiver time of 4 bytes follows the values
TYPE_SHIFT, TYPE_BITS = 24, 0x3F
FIELD_BITS = 24

RATE_SCALE, ACCELERATION_SCALE, TEMPERATURE_SCALE = radians(2.0**-12), 2.0**-10, 1e-2
RATE_AXES = {14: 0, 13: 1, 5: 2}  # axis by type of value
ACCELERATION_AXES = {16: 0, 17: 1, 18: 2}
TEMPERATURE_TYPE = 12
SENSOR_TYPES = frozenset((*RATE_AXES, *ACCELERATION_AXES))
MEAS_TICK_HZ, RAW_TICK_HZ, TAG_BITS = 1000.0, 25600.0, 32


class SensorSamples:
    """Joins the values of one time tag to samples.

    Args:
        settings: ``tick_hz`` is the rate of the time tags.
        counters: the parser's counters; a sample without all six axes counts as ``imu_incomplete``, a time tag that
            jumps as ``restart``.

    Raises:
        DriverSettingsError: ``tick_hz`` is not a positive number.
    """

    def __init__(self, settings: DeviceSettings, counters: ParserCounters) -> None:
        tick_hz = settings.config.get("tick_hz")
        if tick_hz is not None and not (isinstance(tick_hz, int | float) and tick_hz > 0):
            raise DriverSettingsError(f"tick_hz: got {tick_hz!r}, want the rate of the time tags in Hz")
        self._rates = {MEAS_KEY: float(tick_hz or MEAS_TICK_HZ), RAW_KEY: float(tick_hz or RAW_TICK_HZ)}
        self._unwrappers = {key: CounterUnwrapper(TAG_BITS, rate) for key, rate in self._rates.items()}
        self._counters = counters
        self._has_raw = False
        self._temperature_c = nan

    def measured(self, host_time_ns: int, frame: bytes) -> list[Row] | None:
        """Return the sample of an ESF-MEAS, if it has one; None where its length is wrong."""
        payload = frame[6:-2]
        if len(payload) < MEAS_HEADER.size:
            return None
        tag, flags, _ = MEAS_HEADER.unpack_from(payload)
        there = (len(payload) - MEAS_HEADER.size - (4 if flags & CALIBRATED_TAG else 0)) // VALUE.size
        count = flags >> COUNT_SHIFT or there  # receivers before M8 leave the number at 0
        if count > there:
            return None
        values = [VALUE.unpack_from(payload, MEAS_HEADER.size + VALUE.size * at)[0] for at in range(count)]
        return [] if self._has_raw else self._samples(MEAS_KEY, host_time_ns, [(value, tag) for value in values])

    def raw(self, host_time_ns: int, frame: bytes) -> list[Row] | None:
        """Return the samples of an ESF-RAW; None where its length is wrong."""
        payload = frame[6:-2]
        if len(payload) < RAW_HEADER_BYTES or (len(payload) - RAW_HEADER_BYTES) % PAIR.size:
            return None
        self._has_raw = True
        return self._samples(RAW_KEY, host_time_ns, list(PAIR.iter_unpack(payload[RAW_HEADER_BYTES:])))

    def _samples(self, key: bytes, host_time_ns: int, values: list[tuple[int, int]]) -> list[Row]:
        """Return a sample for each time tag, in the order of the tags' first values."""
        by_tag: dict[int, dict[int, int]] = {}
        for value, tag in values:
            kind, field = value >> TYPE_SHIFT & TYPE_BITS, value & (1 << FIELD_BITS) - 1
            field -= (field >> FIELD_BITS - 1) << FIELD_BITS
            if kind == TEMPERATURE_TYPE:
                self._temperature_c = field * TEMPERATURE_SCALE
            elif kind in SENSOR_TYPES:
                by_tag.setdefault(tag, {})[kind] = field
        rows = []
        for tag, fields in by_tag.items():
            if fields.keys() != SENSOR_TYPES:
                self._counters.errors["imu_incomplete"] += 1
                continue
            rows.append(self._row(key, host_time_ns, tag, fields))
        return rows

    def _row(self, key: bytes, host_time_ns: int, tag: int, fields: dict[int, int]) -> Row:
        host = np.array([host_time_ns], np.int64)
        counts, restart = self._unwrappers[key].unwrap(np.array([tag], np.uint64), host)
        if restart.any():
            self._counters.errors["restart"] += 1
        force = tuple(fields[kind] * ACCELERATION_SCALE for kind in ACCELERATION_AXES)
        rate = tuple(fields[kind] * RATE_SCALE for kind in RATE_AXES)
        device_ns = round(int(counts[0]) * (SECOND_NS / self._rates[key]))
        return Row(ImuSamples, (host_time_ns, device_ns, -1, force, rate, self._temperature_c, 0, -1))


def vehicle_motion(host_time_ns: int, message: EsfIns) -> DeviceStatus:
    """Return the rates and accelerations of an ESF-INS that are valid, all without gravity."""
    values: dict[str, float | int | str | bool] = {"itow_s": message.itow_ms / 1000.0}
    for at, axis in enumerate("xyz"):
        if message.flags >> ESF_INS_FIRST_VALID_BIT + at & 1:
            values[f"angular_rate_{axis}_radps"] = radians(message[2 + at] / 1e3)
        if message.flags >> ESF_INS_FIRST_VALID_BIT + 3 + at & 1:
            values[f"acceleration_{axis}_mps2"] = message[5 + at] / 1e2
    return DeviceStatus(host_time_ns, values, message="ESF-INS")


# --- encoders ---


def _word(kind: int, field: int) -> int:
    return kind << TYPE_SHIFT | field & (1 << FIELD_BITS) - 1


def _words(force_b: tuple[float, float, float], rate_b: tuple[float, float, float], temperature_c: float) -> list[int]:
    rates = [_word(kind, round(rate_b[axis] / RATE_SCALE)) for kind, axis in RATE_AXES.items()]
    forces = [_word(kind, round(force_b[axis] / ACCELERATION_SCALE)) for kind, axis in ACCELERATION_AXES.items()]
    return [*rates, _word(TEMPERATURE_TYPE, round(temperature_c / TEMPERATURE_SCALE)), *forces]


def encode_esf_meas(
    tag: int, force_b: tuple[float, float, float], rate_b: tuple[float, float, float], temperature_c: float
) -> bytes:
    """Encode an ESF-MEAS of one sample, m/s² and rad/s."""
    words = _words(force_b, rate_b, temperature_c)
    return encode_frame(MEAS_KEY, MEAS_HEADER.pack(tag, len(words) << COUNT_SHIFT, 0) + struct.pack("<7I", *words))


def encode_esf_raw(
    samples: list[tuple[int, tuple[float, float, float], tuple[float, float, float]]], temperature_c: float
) -> bytes:
    """Encode an ESF-RAW of samples (time tag, m/s², rad/s)."""
    pairs = [
        PAIR.pack(word, tag) for tag, force_b, rate_b in samples for word in _words(force_b, rate_b, temperature_c)
    ]
    return encode_frame(RAW_KEY, bytes(RAW_HEADER_BYTES) + b"".join(pairs))


def encode_esf_ins(message: EsfIns) -> bytes:
    """Encode an ESF-INS."""
    return ESF_INS.encode(message)
