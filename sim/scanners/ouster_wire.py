"""The output of an Ouster OS1: its metadata, and lidar packets with single (strongest) or dual returns.

Packets follow `swath.drivers.scanner.ouster.layout`. The head counts nanoseconds in mode TIME_FROM_SYNC_PULSE_IN: each
pulse since power-on counts as one second (`swath.sim.scanners.spinning_wire.HeadClock`).
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from swath.drivers.scanner.ouster.head import SYNC_PULSE, read_head
from swath.drivers.scanner.ouster.layout import LidarLayout
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.sim.clocks import PulsePerSecond
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.spinning_wire import (
    Arrivals,
    HeadClock,
    PacketCutter,
    Windows,
    best_slot,
    counts,
    head_config,
    in_slot,
)
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

COLUMNS = 1024  # of a turn
COLUMNS_OF_PACKET = 16
BEAMS = 64
NANOSECOND_HZ = 1_000_000_000
RANGE_UNIT_M = 0.001
RANGE_MAX_RAW = (1 << 19) - 1
SERIAL_BITS = 40
FRAME_IDS = 1 << 16
HALF_FIELD_DEG = 16.6  # half of the vertical field of an OS1-64, evenly filled
STAGGER_DEG = (4.23, 1.41, -1.41, -4.23)  # four columns of diodes behind the lens
STAGGER_COLUMNS = (24, 16, 8, 0)  # columns by which rows of the image are shifted
BEAM_ORIGIN_MM = 15.806
LIDAR_ABOVE_SENSOR_MM = 36.18
IMU_IN_SENSOR_MM = (6.253, -11.775, 7.645)
INITIALIZATION_ID = 4_711


def os1_metadata(table: ScannerTable) -> bytes:
    """Return the metadata of the plan's head as its HTTP interface gives it: JSON, in sections, as of firmware 2.5.

    Args:
        table: of the plan.
    """
    x_mm, y_mm, z_mm = IMU_IN_SENSOR_MM
    profile = "RNG19_RFL8_SIG16_NIR16_DUAL" if table.dual_return else "RNG19_RFL8_SIG16_NIR16"
    lidar_mode = f"{COLUMNS}x{table.scan_hz:.0f}"
    document = {
        "sensor_info": {
            "prod_line": f"OS-1-{BEAMS}",
            "prod_sn": table.serial,
            "image_rev": "simulated",
            "initialization_id": INITIALIZATION_ID,
            "status": "RUNNING",
        },
        "beam_intrinsics": {
            "beam_altitude_angles": np.round(np.linspace(HALF_FIELD_DEG, -HALF_FIELD_DEG, BEAMS), 3).tolist(),
            "beam_azimuth_angles": list(STAGGER_DEG) * (BEAMS // 4),
            "lidar_origin_to_beam_origin_mm": BEAM_ORIGIN_MM,
            "beam_to_lidar_transform": [1, 0, 0, BEAM_ORIGIN_MM, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        },
        "lidar_intrinsics": {
            "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, LIDAR_ABOVE_SENSOR_MM, 0, 0, 0, 1]
        },
        "imu_intrinsics": {"imu_to_sensor_transform": [1, 0, 0, x_mm, 0, 1, 0, y_mm, 0, 0, 1, z_mm, 0, 0, 0, 1]},
        "lidar_data_format": {
            "columns_per_frame": COLUMNS,
            "columns_per_packet": COLUMNS_OF_PACKET,
            "pixels_per_column": BEAMS,
            "pixel_shift_by_row": list(STAGGER_COLUMNS) * (BEAMS // 4),
            "column_window": [0, COLUMNS - 1],
            "udp_profile_lidar": profile,
            "udp_profile_imu": "LEGACY",
        },
        "config_params": {"lidar_mode": lidar_mode, "timestamp_mode": SYNC_PULSE, "udp_profile_lidar": profile},
    }
    return json.dumps(document, indent=2).encode()


class OusterWire:
    """Makes the packets of one head.

    Args:
        plan: of the flight.
        name: of the scanner.
        pps: pulse wired to SYNC_PULSE_IN; None: no pulse is wired.
        lost_pps: (from, to) in which the head gets no pulse.

    Raises:
        PlanError: the packets cannot carry the serial number.
    """

    def __init__(self, plan: Plan, name: str, pps: PulsePerSecond | None, lost_pps: Windows = ()) -> None:
        table = plan.tables.scanner[name]
        _check_serial(table.serial, f"scanner.{name}.serial")
        self._source, self._dual = f"scanner/{name}", table.dual_return
        self._layout = LidarLayout(read_head(os1_metadata(table)))
        offset_s = 1e-6 * table.true.time_offset_us
        self._clock = HeadClock(NANOSECOND_HZ, table.oscillator, pps, lost_pps, offset_s, None)
        self._cutter = PacketCutter(COLUMNS_OF_PACKET * BEAMS)
        self._arrivals = Arrivals(plan, self._source)

    def units(self, pulses: Pulses, measured: Measured, truth: StructArray) -> tuple[list[WireUnit], StructArray]:
        """Return the packets that are complete, and the truth of their returns in the order of `OusterParser`.

        Args:
            pulses: of `Os1Head`, consecutive.
            measured: of the pulses, (n, R).
            truth: `RETURN_TRUTH_DTYPE` (n, R), same slots.
        """
        raw, light = counts(measured, RANGE_UNIT_M, RANGE_MAX_RAW)
        number, time_s, raw, light, truth = self._cutter.take([pulses.number, pulses.time_s, raw, light, truth])
        if len(number) == 0:
            return [], np.empty(0, RETURN_TRUTH_DTYPE)
        slots = _strongest(raw, light, 2 if self._dual else 1)
        fields: dict[str, Int64Array] = {}
        for slot, which in zip(slots, ("", "2"), strict=False):
            fields[f"RANGE{which}"] = in_slot(raw, slot)
            # the parser reads the signal as intensity: signal and reflectivity are both the receiver's intensity
            fields[f"SIGNAL{which}"] = fields[f"REFLECTIVITY{which}"] = in_slot(light, slot)
        return self._packets(number, time_s, fields), _truth(raw, slots, truth)

    def idle(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return an empty list; a head that does not fire sends nothing."""
        return []

    def close(self) -> tuple[list[WireUnit], StructArray]:
        """Return no packets; a packet that is not full is not sent."""
        return [], np.empty(0, RETURN_TRUTH_DTYPE)

    def _packets(self, number: Int64Array, time_s: FloatArray, fields: dict[str, Int64Array]) -> list[WireUnit]:
        """Return the packets of pulses (n,) with these fields (n,)."""
        shape = (-1, COLUMNS_OF_PACKET, BEAMS)
        shaped = {name: values.reshape(shape) for name, values in fields.items()}
        fired_s = time_s.reshape(shape)[:, :, 0]
        stamps = self._clock.ticks(fired_s.reshape(-1)).reshape(fired_s.shape)
        column = number.reshape(shape)[:, 0, 0] // BEAMS
        frames, places = (column // COLUMNS % FRAME_IDS).tolist(), (column % COLUMNS).tolist()
        arrived_s = self._arrivals.times(fired_s[:, -1])
        units = []
        for at in range(len(fired_s)):
            content = {name: values[at] for name, values in shaped.items()}
            data = self._layout.encode(frames[at], places[at], stamps[at], content)
            units.append(WireUnit(arrived_s[at], self._source, data))
        return units


def _strongest(raw: Int64Array, light: Int64Array, count: int) -> list[Int64Array]:
    """Return the slots (n,) of the strongest return, and of the second-strongest if ``count`` is 2."""
    rank = np.where(raw > 0, light, -1)
    slots = [best_slot(rank)]
    if count == 2:
        rank[np.arange(len(rank)), slots[0]] = -1
        slots.append(best_slot(rank))
    return slots


def _truth(raw: Int64Array, slots: list[Int64Array], truth: StructArray) -> StructArray:
    """Return the truth of the returns in these slots, (n,) each, flattened pulse by pulse.

    Of two returns the nearer is first.
    """
    pulse = np.arange(len(raw))
    rows = np.stack([truth[pulse, slot] for slot in slots], axis=1)
    there = np.stack([slot >= 0 for slot in slots], axis=1)
    rows["return_number"] = 1
    if len(slots) == 2:
        two = there[:, 1]
        turned = two & (raw[pulse, slots[1]] < raw[pulse, slots[0]])
        rows[turned] = rows[turned][:, ::-1]
        rows["return_number"][two, 1] = 2
    flat: StructArray = rows[there]
    return flat


def _check_serial(serial: str, key: str) -> None:
    """Refuse a serial number of digits that packets cannot return unchanged; other texts pass."""
    if serial.isdecimal() and (str(int(serial)) != serial or int(serial) >= 1 << SERIAL_BITS):
        raise PlanError(key, f'got "{serial}", want a number below 2^{SERIAL_BITS} without leading zeros')


def config_table(table: ScannerTable, name: str, transport: str) -> dict[str, Any]:
    """Return ``[scanner.<name>]`` of the configuration that records this head.

    The head's metadata is in ``<name>.json`` beside it.

    Args:
        table: of the plan.
        name: of the scanner.
        transport: URI at which its packets arrive.
    """
    return head_config(table, transport, "ouster") | {"geometry": {"file": f"{name}.json"}}
