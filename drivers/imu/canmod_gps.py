"""CSS Electronics CANmod.gps: an automotive IMU (100 Hz) and a GNSS receiver (1 Hz) on one CAN bus.

A preset of `swath.drivers.imu.dbc.parser` with the maker's own DBC (canmod-gps.dbc beside this file, which contains its
MIT licence). The device has no counter and no PPS output: its samples are timed by their arrival, and its time message,
a second old and some 0.5 s late, refers to the edge before it for a host that receives PPS from another source.
Its altitude is the height above the WGS 84 ellipsoid (CANmod.gps manual, Configuration, GNSS, Output, Altitude).
"""

from __future__ import annotations

import datetime as dt
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swath.drivers.can_frames import decode_can_frames
from swath.drivers.driver import Driver, receiver_inside
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.dbc.signals import SignalLayout, find_signal, load_database
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import (
    ByteRows,
    DeviceStatus,
    FixType,
    GnssFix,
    ImuSamples,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS

DBC_PATH = Path(__file__).with_name("canmod-gps.dbc")
IMU_SIGNALS = {
    "specific_force": [f"gnss_imu.Acceleration{axis}" for axis in "XYZ"],
    "angular_rate": [f"gnss_imu.AngularRate{axis}" for axis in "XYZ"],
}
IMU_VALID = "gnss_imu.ImuValid"
# message -> its validity signal, and the key and factor of each signal in the device's status
STATUS_SIGNALS: dict[str, tuple[str, dict[str, tuple[str, float]]]] = {
    "gnss_altitude": ("AltitudeValid", {"Altitude": ("altitude_m", 1), "AltitudeAccuracy": ("altitude_accuracy_m", 1)}),
    "gnss_attitude": (
        "AttitudeValid",
        {
            "Roll": ("roll_rad", radians(1)),
            "Pitch": ("pitch_rad", radians(1)),
            "Heading": ("heading_rad", radians(1)),
            "RollAccuracy": ("roll_accuracy_rad", radians(1)),
            "PitchAccuracy": ("pitch_accuracy_rad", radians(1)),
            "HeadingAccuracy": ("heading_accuracy_rad", radians(1)),
        },
    ),
    "gnss_odo": (
        "DistanceValid",
        {
            "DistanceTrip": ("distance_trip_m", 1),
            "DistanceAccuracy": ("distance_accuracy_m", 1),
            "DistanceTotal": ("distance_total_m", 1000),
        },
    ),
    "gnss_speed": ("SpeedValid", {"Speed": ("speed_mps", 1), "SpeedAccuracy": ("speed_accuracy_mps", 1)}),
    "gnss_geofence": (
        "FenceValid",
        {"FenceCombined": ("fence_combined", 1), **{f"Fence{n}": (f"fence_{n}", 1) for n in range(1, 5)}},
    ),
}
GNSS_SIGNALS = {  # message -> the signals read from it
    "gnss_status": ("FixType", "Satellites"),
    "gnss_time": ("TimeValid", "TimeConfirmed", "Epoch"),
    "gnss_pos": ("PositionValid", "Latitude", "Longitude", "PositionAccuracy"),
    **{name: (valid, *signals) for name, (valid, signals) in STATUS_SIGNALS.items()},
}
FIX_TYPES = {  # VAL_ 1 FixType of the DBC
    0: FixType.NONE,
    1: FixType.DEAD_RECKONING,
    2: FixType.SINGLE,
    3: FixType.SINGLE,
    4: FixType.SINGLE,
    5: FixType.NONE,
}
UNIX_EPOCH = dt.date(1970, 1, 1)
MS_PER_S = 1000
MS_PER_DAY = 86_400_000


class GnssMessage(NamedTuple):
    """One kind of GNSS frame: identifier, minimum length, signals by name."""

    can_id: int
    needs_bytes: int
    signals: dict[str, SignalLayout]


class CanmodGpsParser(DbcParser):
    """Decodes `ImuSamples` by the DBC parser, and the 1 Hz GNSS messages."""

    def __init__(self, settings: DeviceSettings, *, time_only: bool = False) -> None:
        """Prepare a parser for one device.

        Args:
            settings: the device's table.
            time_only: return time messages only, for the recorder.
        """
        contents = settings.files.get("dbc") or DBC_PATH.read_bytes()
        file_name = str(settings.config.get("dbc") or DBC_PATH.name)
        config: dict[str, Any] = {**settings.config, "signals": IMU_SIGNALS, "dbc": file_name}
        super().__init__(DeviceSettings(settings.source, config, {"dbc": contents}))
        database = load_database(contents)
        self._imu_valid = find_signal(database, IMU_VALID, file_name)
        self._gnss = {name: _gnss_message(database, name, file_name) for name in GNSS_SIGNALS}
        self._time_only = time_only
        self._time: TimeTag | None = None
        self._status: dict[str, float] = {}
        self._waiting: GnssFix | None = None  # a position whose altitude follows in the next message

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode CAN frames, (n, 16) or (n, 72)."""
        table = decode_can_frames(units)
        if table is None:
            return super().parse_units(host_time_ns, units)
        if self._time_only:
            self.counters.bytes += units.size
            return self._gnss_records(host_time_ns, table)
        bad = (table["can_id"] == self._imu_valid.can_id) & (self._imu_valid.layout.bits(table["data"]) == 0)
        rejected = int(np.count_nonzero(bad))
        if rejected:
            self.counters.errors["imu_invalid"] += rejected
            self.counters.bytes += rejected * units.shape[1]
            host_of_good, good = host_time_ns[~bad], units[~bad]
            return [*super().parse_units(host_of_good, good), *self._gnss_records(host_time_ns, table)]
        return [*super().parse_units(host_time_ns, units), *self._gnss_records(host_time_ns, table)]

    def _gnss_records(self, host_time_ns: Int64Array, table: StructArray) -> list[Record]:
        """Return the records of a batch's GNSS messages, which come once a second, in the order of arrival."""
        found: list[tuple[int, str, dict[str, float]]] = []
        for name, message in self._gnss.items():
            where = np.flatnonzero(table["can_id"] == np.uint32(message.can_id))
            whole = where[table["length"][where] >= message.needs_bytes]
            if len(whole) < len(where):
                self.counters.bad_messages += len(where) - len(whole)
                self.counters.errors["bad_length"] += len(where) - len(whole)
            if not len(whole):
                continue
            self.counters.messages[name] += len(whole)
            data = table["data"][whole]
            columns = {key: layout.values(layout.bits(data)).tolist() for key, layout in message.signals.items()}
            found += [(int(row), name, {key: columns[key][n] for key in columns}) for n, row in enumerate(whole)]
        records: list[Record] = []
        for row, name, values in sorted(found, key=lambda item: item[0]):
            records += self._placed(values if name == "gnss_altitude" else {})
            records += self._gnss_record(int(host_time_ns[row]), name, values)
        return records

    def _placed(self, altitude: dict[str, float]) -> list[Record]:
        """Return the fix that waits for its height, which the message after it gives if that is ``gnss_altitude``."""
        fix, self._waiting = self._waiting, None
        if fix is None:
            return []
        if not altitude.get("AltitudeValid") or fix.position_cov_l is None:
            return [fix]
        variances = [*np.diag(fix.position_cov_l)[:2], altitude["AltitudeAccuracy"] ** 2]
        return [replace(fix, height_m=altitude["Altitude"], position_cov_l=np.diag(variances))]

    def close(self) -> list[Record]:
        """Return the samples and the fix that are still held back."""
        return [*super().close(), *self._placed({})]

    def _gnss_record(self, host_time_ns: int, name: str, values: dict[str, float]) -> list[Record]:
        """Return the records of one GNSS message."""
        if name == "gnss_status":
            self._status = values
            return []
        if name == "gnss_time":
            self._time = utc_tag(values["Epoch"])
            return [
                TimeMessage(
                    host_time_ns, self._time, NamesEdge.PREVIOUS, valid=bool(values["TimeValid"]), message="gnss_time"
                )
            ]
        if self._time_only:
            return []
        if name == "gnss_pos":
            self._waiting = self._fix(host_time_ns, values) if self._time is not None else None
            return []
        return [DeviceStatus(host_time_ns, _status_values(name, values), message=name)]

    def _fix(self, host_time_ns: int, values: dict[str, float]) -> GnssFix:
        """Return the position at the epoch of the last time message, without its height."""
        assert self._time is not None
        accuracy = values["PositionAccuracy"]
        fix_type = FIX_TYPES.get(int(self._status.get("FixType", 0)), FixType.NONE)
        valid = bool(values["PositionValid"])
        return GnssFix(
            host_time_ns=host_time_ns,
            time=self._time,
            lat_rad=radians(values["Latitude"]) if valid else None,
            lon_rad=radians(values["Longitude"]) if valid else None,
            height_m=None,
            position_cov_l=np.diag([accuracy**2 / 2, accuracy**2 / 2, np.nan]) if valid else None,
            fix_type=fix_type if valid else FixType.NONE,
            satellites=int(self._status["Satellites"]) if self._status else None,
            valid=valid,
            message="gnss_pos",
        )


def _gnss_message(database: Any, name: str, file_name: str) -> GnssMessage:
    """Find the layouts of one GNSS message."""
    found = {key: find_signal(database, f"{name}.{key}", file_name) for key in GNSS_SIGNALS[name]}
    layouts = {key: signal.layout for key, signal in found.items()}
    needs = max(layout.needs_bytes for layout in layouts.values())
    return GnssMessage(next(iter(found.values())).can_id, needs, layouts)


def utc_tag(unix_s: float) -> TimeTag:
    """Return UTC of a Unix time with the device's 1 ms resolution.

    The device truncates its epoch to milliseconds, so a whole second reads as .000 or .999; both become the whole
    second.
    """
    unix_ms = round(unix_s * MS_PER_S)
    if unix_ms % MS_PER_S == MS_PER_S - 1:
        unix_ms += 1
    days, ms_of_day = divmod(unix_ms, MS_PER_DAY)
    return TimeTag(TimeScale.UTC, ms_of_day * MILLISECOND_NS, date=UNIX_EPOCH + dt.timedelta(days=days))


def _status_values(name: str, values: dict[str, float]) -> dict[str, float | int | str | bool]:
    """Return the message's values with their units in the keys; empty where the device marks them invalid."""
    valid, signals = STATUS_SIGNALS[name]
    return {key: values[signal] * factor for signal, (key, factor) in signals.items()} if values[valid] else {}


def make_time_parser(settings: DeviceSettings) -> CanmodGpsParser:
    """Make the recorder's parser, which returns time messages only."""
    return CanmodGpsParser(settings, time_only=True)


UNIT = Driver(
    protocol="canmod-gps",
    kind="imu",
    transports=("can",),
    yields=(ImuSamples, TimeMessage, GnssFix, DeviceStatus),
    summary="CSS Electronics CANmod.gps: IMU at 100 Hz, GNSS at 1 Hz",
    make_parser=CanmodGpsParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
)
DRIVERS = (UNIT, receiver_inside(UNIT))
