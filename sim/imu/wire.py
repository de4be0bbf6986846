"""An inertial unit on CAN: its DBC, the configuration that records it, and its frames in order of time.

One sample is four frames: X, Y and Z with specific force and angular rate of that axis, then SAMPLE with the counter at
the interval's end. The counter at a PPS edge comes in a message of its own, SYNC. `swath.drivers.imu.dbc.encoder`
writes the frames through the same DBC and signal map with which the recorder reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from swath.drivers.imu.dbc.encoder import encode_latch, encode_samples
from swath.drivers.imu.dbc.settings import map_signals
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import PulsePerSecond, generator
from swath.sim.imu.grades import noise_of
from swath.sim.imu.sensors import InertialUnit
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ImuTable
from swath.sim.shots import WireUnit

FORCE_UNIT_MPS2 = 1e-7  # 32 bits reach 21 g; half a unit per sample is far below a navigation grade's noise
RATE_UNIT_RADPS = 5e-9  # 32 bits reach 615 °/s
LARGEST = np.repeat([FORCE_UNIT_MPS2, RATE_UNIT_RADPS], 3) * (2**31 - 1)
TEMPERATURE_C = 38.0
SAMPLE_FRAMES = 4
FRAME_S = 120e-6  # 8 bytes at 1 Mbit/s: 111 bits, stuffed bits and the gap
PROCESSING_S = 50e-6  # from the stamp to the first frame's begin
LATCH_DELAY_S = (200e-6, 800e-6)  # from an edge to the end of its frame
TICK_ROUNDING = 1e-3  # keeps rounding from moving an edge or an end on a tick to the tick before
CONFIGURED_NOISE = (  # keys that ImuNoiseTable shares with the configuration
    "angle_random_walk_deg_per_sqrt_h",
    "velocity_random_walk_m_per_s_per_sqrt_h",
    "gyro_bias_deg_per_h",
    "accel_bias_mg",
    "bias_correlation_h",
    "gyro_scale_ppm",
    "accel_scale_ppm",
    "misalignment_mrad",
)
DBC = """VERSION ""

NS_ :

BS_:

BU_: IMU

BO_ 256 SAMPLE: 8 IMU
 SG_ ticks : 0|{bits}@1+ (1,0) [0|{most}] "" Vector__XXX
 SG_ temperature : 32|16@1- (0.01,0) [-40|85] "degC" Vector__XXX
 SG_ status : 48|8@1+ (1,0) [0|255] "" Vector__XXX
 SG_ packet_counter : 56|8@1+ (1,0) [0|255] "" Vector__XXX

{axes}
BO_ 260 SYNC: {latch_bytes} IMU
 SG_ pps_ticks : 0|{bits}@1+ (1,0) [0|{most}] "" Vector__XXX

CM_ BO_ 256 "Counter at the end of the sample's interval; sent after X, Y and Z of the same sample.";
CM_ BO_ 260 "Counter at the last PPS edge.";
"""
DBC_AXIS = """BO_ {identifier} {axis}: 8 IMU
 SG_ force : 0|32@1- ({force_unit:g},0) [-{most_force:.15g}|{most_force:.15g}] "m/s2" Vector__XXX
 SG_ rate : 32|32@1- ({rate_unit:g},0) [-{most_rate:.15g}|{most_rate:.15g}] "rad/s" Vector__XXX
"""


def dbc_text(table: ImuTable) -> str:
    """Return the DBC of a unit of the plan."""
    units = {"force_unit": FORCE_UNIT_MPS2, "rate_unit": RATE_UNIT_RADPS}
    ranges = {"most_force": LARGEST[0], "most_rate": LARGEST[3]}
    axes = "\n".join(
        DBC_AXIS.format(identifier=257 + number, axis=axis, **units, **ranges) for number, axis in enumerate("XYZ")
    )
    bits = table.tick_bits
    return DBC.format(bits=bits, most=2**bits - 1, axes=axes, latch_bytes=bits // 8)


def config_table(table: ImuTable, name: str, transport: str) -> dict[str, Any]:
    """Return ``[imu.<name>]`` of the configuration that records the unit; its DBC is ``<name>.dbc``."""
    signals: dict[str, Any] = {
        "specific_force": [f"{axis}.force" for axis in "XYZ"],
        "angular_rate": [f"{axis}.rate" for axis in "XYZ"],
        "sample_ticks": "SAMPLE.ticks",
        "temperature": "SAMPLE.temperature",
        "status": "SAMPLE.status",
        "packet_counter": "SAMPLE.packet_counter",
    }
    wired: dict[str, Any] = {}
    if table.pps is not None:
        signals["pps_ticks"] = "SYNC.pps_ticks"
        wired["pps"] = table.pps
    return {
        "transport": transport,
        "protocol": "dbc",
        "dbc": f"{name}.dbc",
        "rate_hz": table.rate_hz,
        "rotation_b_imu": table.rotation_b_imu,
        "tick_hz": table.tick_hz,
        **wired,
        "sample": "mean",
        "stamp": "end",
        "group": "last",
        "signals": signals,
        "noise": _configured_noise(table),
    }


def _configured_noise(table: ImuTable) -> dict[str, Any]:
    """Return the noise table for a filter; a perfect unit gets the best grade, because no filter runs on zeros."""
    if table.grade == "perfect":
        return {"grade": "navigation"}
    noise = noise_of(table)
    return {"grade": table.grade} | {key: noise[key] for key in CONFIGURED_NOISE}


class ImuWire:
    """Frames of a unit as the host receives them.

    A sample's frames leave when its stamp has passed: the stamp is the unit's counter at the interval's end plus
    ``latency_us``. Frames follow each other at the bus's pace, the host's stamps lag by an exponential delay, and a
    frame's stamp is never before that of the frame ahead of it.

    Args:
        unit: unit whose samples are sent.
        pulse: its PPS; None if no pulse is wired to it.
        can_jitter_us: mean delay of the host's stamps; it is 0 for a unit without noise.
        lost_pps: (from_s, to_s) in which the unit gets no edge.

    Raises:
        PlanError: its counter is too slow for its samples, or wraps too soon to be resolved.
    """

    def __init__(
        self,
        unit: InertialUnit,
        pulse: PulsePerSecond | None,
        can_jitter_us: float,
        lost_pps: Sequence[tuple[float, float]] = (),
    ) -> None:
        table, self.source = unit.table, f"imu/{unit.name}"
        self._unit, self._pulse, self._lost_pps = unit, pulse, lost_pps
        self._jitter_s = 1e-6 * can_jitter_us if unit.noise else 0.0
        _check_counter(table, unit.name, self._jitter_s)
        self._late_s = 1e-6 * table.latency_us
        self._sent_after_s = max(self._late_s, 0.0) + PROCESSING_S + FRAME_S * np.arange(1, SAMPLE_FRAMES + 1)
        self._start_ticks = table.oscillator.ticks_at_start & ((1 << table.tick_bits) - 1)
        config = config_table(table.model_copy(update={"pps": "main"}), unit.name, "")
        self._signals = map_signals(DeviceSettings(self.source, config, {"dbc": dbc_text(table).encode()}))
        self._latest_s = -np.inf

    def units(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return the frames that pass the bus from ``start_s`` to before ``stop_s``, in order.

        Consecutive calls give the same frames and stamps however time is cut; a stamp may lie a little after
        ``stop_s``, by the host's delay.
        """
        parts = [self._sample_frames(start_s, stop_s), self._latch_frames(start_s, stop_s)]
        sent_s, delay_s = (np.concatenate([part[column] for part in parts]) for column in (0, 1))
        frames = [frame for part in parts for frame in part[2]]
        order = np.argsort(sent_s, kind="stable")
        stamp_s = np.maximum.accumulate(np.concatenate([[self._latest_s], (sent_s + delay_s)[order]]))
        self._latest_s = stamp_s[-1]
        return [
            WireUnit(at_s, self.source, frames[number])
            for at_s, number in zip(stamp_s[1:].tolist(), order.tolist(), strict=True)
        ]

    def _sample_frames(self, start_s: float, stop_s: float) -> tuple[FloatArray, FloatArray, list[bytes]]:
        """Return the sending times of sample frames, the delays of their stamps, and the frames; (n,) each."""
        first = max(self._unit.count(start_s - self._sent_after_s[-1]), 1)
        last = min(self._unit.count(stop_s - self._sent_after_s[0]) + 1, self._unit.last)
        first = min(first, last + 1)
        number = np.arange(first, last + 1)
        end_s, force, rate = self._unit.samples(first, len(number))
        sent_s = (end_s[:, None] + self._sent_after_s).ravel()
        sent = (sent_s >= start_s) & (sent_s < stop_s)
        values = np.clip(np.concatenate([force, rate], axis=1), -LARGEST, LARGEST)
        frames = encode_samples(
            self._signals,
            self._ticks(end_s + self._late_s),
            values[:, :3],
            values[:, 3:],
            temperature_c=np.full(len(number), TEMPERATURE_C),
            packet_counter=number,
        )
        return sent_s[sent], self._delays(number).ravel()[sent], [frame.tobytes() for frame in frames[sent]]

    def _latch_frames(self, start_s: float, stop_s: float) -> tuple[FloatArray, FloatArray, list[bytes]]:
        """Return the sending times, delays and bytes of the edges' frames; (n,) each."""
        second = np.arange(max(int(start_s) - 1, 0), int(np.ceil(stop_s)) + 1)
        if self._pulse is None:
            second = second[:0]
        draws = [generator(self._unit.seed, self.source, "latch", int(one)) for one in second]
        early_s, late_s = LATCH_DELAY_S
        share = np.array([draw.random() if self._unit.noise else 0.5 for draw in draws])
        delay_s = np.array([draw.exponential() for draw in draws]) * self._jitter_s
        edge_s = self._pulse.edges(second) if self._pulse is not None else np.zeros(0)
        sent_s = edge_s + early_s + share * (late_s - early_s)
        sent = (sent_s >= start_s) & (sent_s < stop_s)
        for from_s, to_s in self._lost_pps:
            sent &= ~((edge_s >= from_s) & (edge_s < to_s))
        frames = [encode_latch(self._signals, int(ticks)) for ticks in self._ticks(edge_s[sent])]
        return sent_s[sent], delay_s[sent], frames

    def _ticks(self, time_s: FloatArray) -> Int64Array:
        """Return (n,) the counter's readings, not wrapped."""
        phase = self._unit.oscillator.phase(time_s)
        return np.floor(phase + TICK_ROUNDING).astype(np.int64) + self._start_ticks

    def _delays(self, number: Int64Array) -> FloatArray:
        """Return (n, frames of a sample) delays of the host's stamps, drawn for whole seconds of samples."""
        rate_hz = self._unit.table.rate_hz
        delays_s = np.zeros((len(number), SAMPLE_FRAMES))
        for second in np.unique(number // rate_hz).tolist() if self._jitter_s else []:
            draws = generator(self._unit.seed, self.source, "can", second).exponential(size=(rate_hz, SAMPLE_FRAMES))
            inside = number // rate_hz == second
            delays_s[inside] = self._jitter_s * draws[number[inside] % rate_hz]
        return delays_s


def _check_counter(table: ImuTable, name: str, jitter_s: float) -> None:
    """Refuse a counter whose readings cannot be made continuous; see `swath.drivers.imu.counters`.

    Between samples the host's stamps show how often the counter has wrapped, to half a wrap; forty mean delays never
    occur. A latched value is searched up to seven eighths of a wrap before the sample after it; a value ahead of its
    sample (its stamps are early) up to an eighth.
    """
    if table.tick_hz < table.rate_hz:
        raise PlanError(f"imu.{name}.tick_hz", f"got {table.tick_hz}, want rate_hz, {table.rate_hz}, or more")
    wrap_s = 2**table.tick_bits / table.tick_hz
    least_s = max(80 * jitter_s, 8 / 7 * (1 / table.rate_hz + 2e-3), 8 * (1e-3 + max(-1e-6 * table.latency_us, 0.0)))
    if wrap_s < least_s:
        text = f"{table.tick_bits} bits at tick_hz = {table.tick_hz} wrap every {1e3 * wrap_s:.3g} ms"
        raise PlanError(f"imu.{name}.tick_bits", f"{text}, want {1e3 * least_s:.3g} ms or more: more bits, fewer ticks")
