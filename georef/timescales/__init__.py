"""Time: three clocks (host, device, GPS) in one package. docs/time.md describes the method and the wiring.

It imports nothing of the project but `swath.georef.records`, reads no clock and does no I/O.
"""

from swath.georef.timescales.clock_status import ClockEvent, ClockStatus, Severity, TimeState
from swath.georef.timescales.device_clock import DeviceClock, DeviceClockStatus
from swath.georef.timescales.gps_time import (
    DAY_NS,
    GPS_EPOCH,
    HOUR_NS,
    LEAP_SECOND_TABLE,
    LEAP_TABLE_VALID_UNTIL,
    SECOND_NS,
    WEEK_NS,
    WEEK_S,
    complete_time,
    full_week,
    gps_ns_from_unix,
    gps_ns_from_utc,
    gps_ns_from_week,
    gps_ns_past_hour,
    las_adjusted_s,
    nearest_gps_ns,
    table_leap_seconds,
    unix_from_gps,
    unix_ns_from_gps,
    utc_from_gps,
    week_difference_ns,
    week_from_gps,
    whole_gps_ns,
)
from swath.georef.timescales.host_timeline import HostTimeline
from swath.georef.timescales.pps_clock import PpsClock
from swath.georef.timescales.stamp_scale import Stamps, StampScale, judge
from swath.georef.timescales.wall_check import WallComparison, ahead_s, distance_text

__all__ = [
    "DAY_NS",
    "GPS_EPOCH",
    "HOUR_NS",
    "LEAP_SECOND_TABLE",
    "LEAP_TABLE_VALID_UNTIL",
    "SECOND_NS",
    "WEEK_NS",
    "WEEK_S",
    "ClockEvent",
    "ClockStatus",
    "DeviceClock",
    "DeviceClockStatus",
    "HostTimeline",
    "PpsClock",
    "Severity",
    "StampScale",
    "Stamps",
    "TimeState",
    "WallComparison",
    "ahead_s",
    "complete_time",
    "distance_text",
    "full_week",
    "gps_ns_from_unix",
    "gps_ns_from_utc",
    "gps_ns_from_week",
    "gps_ns_past_hour",
    "judge",
    "las_adjusted_s",
    "nearest_gps_ns",
    "table_leap_seconds",
    "unix_from_gps",
    "unix_ns_from_gps",
    "utc_from_gps",
    "week_difference_ns",
    "week_from_gps",
    "whole_gps_ns",
]
