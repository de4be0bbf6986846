"""Rows of an Applanix or Trimble INS's own solution, and the navigation of a POS's sensor 1 or 2."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, hypot, nan, radians, sin
from typing import TypeAlias

from swath.drivers.gnss.applanix import groups as pos
from swath.drivers.gnss.applanix import gsof
from swath.drivers.gnss.date_floor import WEEK_MS
from swath.drivers.parser import ParserCounters
from swath.drivers.record_rows import Row
from swath.georef.records import InsSolution, Record
from swath.georef.timescales.gps_time import MILLISECOND_NS

Items: TypeAlias = list[Record | Row]
Triple: TypeAlias = tuple[float, float, float]

WEEK_NS = WEEK_MS * MILLISECOND_NS
SIGMAS_LAST_NS = 1_500_000_000  # sigmas are sent once a second or with every epoch
UNKNOWN: Triple = (nan, nan, nan)
EARTH_RADIUS_M = 6_371_000.0
APART_MPS = 0.5  # by which velocities of two points may differ beyond their rotation: errors of attitude and lever arm


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Sigmas of position, velocity and attitude (m, m/s, rad) at a time of week."""

    time_ns: int
    position_l: Triple
    velocity_l: Triple
    attitude_rad: Triple


def sigmas_of(time_ns: int, values: tuple[float, ...]) -> Sigmas:
    """Return sigmas of nine RMS errors: north, east, down, twice, and roll, pitch, heading in degrees."""
    return Sigmas(
        time_ns,
        (values[0], values[1], values[2]),
        (values[3], values[4], values[5]),
        (radians(values[6]), radians(values[7]), radians(values[8])),
    )


def navigation_row(
    host_time_ns: int,
    week: int,
    time_ns: int,
    navigation: gsof.InsNavigation | pos.Navigation,
    sigmas: Sigmas | None,
) -> Row:
    """Return a row of `INS_DTYPE`; its status is the alignment status."""
    apart = None if sigmas is None else (time_ns - sigmas.time_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2
    known = sigmas if apart is not None and abs(apart) <= SIGMAS_LAST_NS else None
    values = (
        host_time_ns,
        week * WEEK_NS + time_ns,
        radians(navigation.lat_deg),
        radians(navigation.lon_deg),
        navigation.height_m,
        (navigation.north_mps, navigation.east_mps, navigation.down_mps),
        radians(navigation.roll_deg),
        radians(navigation.pitch_deg),
        radians(navigation.heading_deg),
        known.position_l if known else UNKNOWN,
        known.velocity_l if known else UNKNOWN,
        known.attitude_rad if known else UNKNOWN,
        navigation.alignment,
    )
    return Row(InsSolution, values)


class SensorSolutions:
    """Makes rows for a sensor of a POS from its own groups and the vehicle's group 1 of the same time.

    Groups 102 and 103 have no alignment status: it is that of group 1. They give the horizontal velocity along and
    across the track, and the document does not say whether this is the heading or the course. It is taken as the
    heading of the sensor, and compared with the vehicle's north and east velocity: rows where the two differ by more
    than the vehicle's rotation explains are counted as ``velocity_disagrees`` and left out.

    Args:
        number: of the sensor, 1 or 2.
        counters: the parser's counters.

    Attributes:
        index: of the sensor's layouts in `pos.SENSORS` and `pos.SENSOR_PERFORMANCES`.
        sigmas: its last sigmas, their horizontal velocities along and across.
    """

    def __init__(self, number: int, counters: ParserCounters) -> None:
        self.index = number - 1
        self.sigmas: Sigmas | None = None
        self._counters = counters
        self._vehicle: tuple[int, pos.Navigation] | None = None  # time of week (ns)
        self._waiting: tuple[int, int, pos.SensorNavigation] | None = None  # week, time of week (ns)

    def add_vehicle(self, host_time_ns: int, time_ns: int, vehicle: pos.Navigation) -> Items:
        """Take a group 1; return the row that it completes."""
        self._vehicle = time_ns, vehicle
        return self._completed(host_time_ns)

    def add_sensor(self, host_time_ns: int, week: int, time_ns: int, sensor: pos.SensorNavigation) -> Items:
        """Take a group of the sensor; return the row that it completes."""
        self.finish()
        self._waiting = week, time_ns, sensor
        return self._completed(host_time_ns)

    def finish(self) -> None:
        """Count a group of the sensor that no group 1 of its time followed."""
        if self._waiting is not None:
            self._counters.errors["vehicle_missing"] += 1
        self._waiting = None

    def _completed(self, host_time_ns: int) -> Items:
        if self._vehicle is None or self._waiting is None or self._vehicle[0] != self._waiting[1]:
            return []
        (week, time_ns, sensor), (_, vehicle) = self._waiting, self._vehicle
        self._waiting = None
        if vehicle.alignment not in (pos.FULL_NAVIGATION, pos.FINE_ALIGNMENT):
            self._counters.errors["ins_not_aligned"] += 1
            return []
        cos_h, sin_h = cos(radians(sensor.heading_deg)), sin(radians(sensor.heading_deg))
        north = sensor.along_mps * cos_h - sensor.across_mps * sin_h
        east = sensor.along_mps * sin_h + sensor.across_mps * cos_h
        if hypot(north - vehicle.north_mps, east - vehicle.east_mps) > APART_MPS + swing_mps(vehicle, sensor):
            self._counters.errors["velocity_disagrees"] += 1
            return []
        moved = vehicle._replace(
            **{name: getattr(sensor, name) for name in ("lat_deg", "lon_deg", "height_m", "down_mps")},
            **{name: getattr(sensor, name) for name in ("roll_deg", "pitch_deg", "heading_deg")},
            north_mps=north,
            east_mps=east,
        )
        sigmas = self.sigmas
        if sigmas is not None:
            along, across, down = sigmas.velocity_l
            level = hypot(along * cos_h, across * sin_h), hypot(along * sin_h, across * cos_h)
            sigmas = replace(sigmas, velocity_l=(*level, down))
        return [navigation_row(host_time_ns, week, time_ns, moved, sigmas)]


def swing_mps(vehicle: pos.Navigation, sensor: pos.SensorNavigation) -> float:
    """Return the greatest velocity of a sensor relative to the vehicle's point by the vehicle's rotation, m/s."""
    north_m = radians(sensor.lat_deg - vehicle.lat_deg) * EARTH_RADIUS_M
    east_m = radians(sensor.lon_deg - vehicle.lon_deg) * EARTH_RADIUS_M * cos(radians(vehicle.lat_deg))
    rate_radps = radians(hypot(vehicle.x_rate_dps, vehicle.y_rate_dps, vehicle.z_rate_dps))
    return rate_radps * hypot(north_m, east_m, sensor.height_m - vehicle.height_m)
