"""UBX messages of the virtual receiver: NAV-PVT, HPPOSLLH, COV, TIMEGPS, TIMELS, EOE and TIM-TP (F9 HPG 1.32)."""

from __future__ import annotations

import math

from swath.drivers.gnss.ubx import messages as ubx
from swath.georef.records import FixType
from swath.georef.timescales import week_from_gps
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS
from swath.sim.gnss.calendar import Calendar, Stamp
from swath.sim.gnss.pulse import Pulse
from swath.sim.gnss.receiver import Epochs, InsEpochs
from swath.sim.plan.tables import GnssTable

FIX_3D = 3
CARRIER = {FixType.RTK_FLOAT: 1 << 6, FixType.RTK_FIXED: 2 << 6}  # flags of NAV-PVT
UNKNOWN_ACCURACY = 0xFFFF_FFFF
SOURCE_GPS = 2  # of leap seconds
TIME_ACCURACY_NS = 25
PDOP_1E2 = 140
GREATEST_PDOP_1E2 = 9999
UNKNOWN_COURSE_1E5_DEG = 18_000_000


class UbxMessages:
    """Encodes the UBX messages of an epoch; arguments as for `swath.sim.gnss.novatel.NovatelMessages`."""

    def __init__(self, table: GnssTable, calendar: Calendar, pulse: Pulse) -> None:
        self._calendar, self._pulse = calendar, pulse
        self._undulation_m = table.undulation_m

    def epoch(self, epochs: Epochs, row: int) -> list[bytes]:
        """Return the NAV messages of the epoch with NAV-EOE after them.

        On whole seconds they include NAV-TIMELS, and TIM-TP of the next second follows.
        """
        time_s = float(epochs.time_s[row])
        stamp = self._calendar.at(time_s)
        messages = [
            ubx.encode_nav_timegps(self._timegps(stamp)),
            ubx.encode_nav_pvt(self._pvt(epochs, row, stamp)),
            ubx.encode_nav_hpposllh(self._hpposllh(epochs, row, stamp)),
            ubx.encode_nav_cov(_cov(epochs, row, stamp)),
        ]
        if stamp.second is not None:
            messages.append(ubx.encode_nav_timels(self._timels(stamp)))
        messages.append(ubx.encode_nav_eoe(ubx.NavEoe(stamp.tow_ms)))
        if stamp.second is not None and self._pulse.wired:
            messages.append(ubx.encode_tim_tp(self._tim_tp(stamp.second + 1)))
        return messages

    def ins_epoch(self, ins: InsEpochs, row: int) -> list[bytes]:
        """Return an empty list; simulated UBX receivers have no INS."""
        return []

    def _timegps(self, stamp: Stamp) -> ubx.NavTimegps:
        valid = ubx.TIMEGPS_TOW | ubx.TIMEGPS_WEEK | ubx.TIMEGPS_LEAP
        return ubx.NavTimegps(stamp.tow_ms, 0, stamp.week, self._calendar.leap_seconds, valid, TIME_ACCURACY_NS)

    def _timels(self, stamp: Stamp) -> ubx.NavTimels:
        """Return NAV-TIMELS without an announced leap second."""
        return ubx.NavTimels(
            stamp.tow_ms, 0, SOURCE_GPS, self._calendar.leap_seconds, SOURCE_GPS, 0, 0, 0, 0, ubx.TIMELS_CURRENT
        )

    def _tim_tp(self, second: int) -> ubx.TimTp:
        """Return TIM-TP of a second; edge = true second − quantisation error."""
        week, tow_ns = week_from_gps(self._calendar.start_gps_ns + second * SECOND_NS)
        quantisation_ps = round(-1e12 * self._pulse.late_s(second))
        return ubx.TimTp(tow_ns // MILLISECOND_NS, 0, quantisation_ps, week, ubx.TP_UTC_AVAILABLE, ubx.TP_REFERENCE_GPS)

    def _pvt(self, epochs: Epochs, row: int, stamp: Stamp) -> ubx.NavPvt:
        empty = _empty_pvt(stamp)
        fix = FixType(int(epochs.fix[row]))
        if fix is FixType.NONE:
            return empty
        carrier = CARRIER.get(fix, 0)
        lat_1e9, lon_1e9, height_tenth_mm, msl_tenth_mm = self._whole(epochs, row)
        horizontal_m, vertical_m = _accuracies(epochs, row)
        return empty._replace(
            fix_type=FIX_3D,
            flags=ubx.PVT_FIX_OK | (ubx.PVT_DIFFERENTIAL if carrier else 0) | carrier,
            satellites=int(epochs.satellites[row]),
            lon_1e7_deg=_main(lon_1e9, 100),
            lat_1e7_deg=_main(lat_1e9, 100),
            height_mm=_main(height_tenth_mm, 10),
            height_msl_mm=_main(msl_tenth_mm, 10),
            horizontal_accuracy_mm=round(1e3 * horizontal_m),
            vertical_accuracy_mm=round(1e3 * vertical_m),
            pdop_1e2=PDOP_1E2,
            flags3=0,
            **_velocity(epochs, row),
        )

    def _hpposllh(self, epochs: Epochs, row: int, stamp: Stamp) -> ubx.NavHpposllh:
        if epochs.fix[row] == FixType.NONE:
            return ubx.NavHpposllh(0, 1, stamp.tow_ms, *(0,) * 8, UNKNOWN_ACCURACY, UNKNOWN_ACCURACY)
        lat_1e9, lon_1e9, height_tenth_mm, msl_tenth_mm = self._whole(epochs, row)
        scales = ((lon_1e9, 100), (lat_1e9, 100), (height_tenth_mm, 10), (msl_tenth_mm, 10))
        mains = [_main(value, scale) for value, scale in scales]
        rests = [value - scale * main for (value, scale), main in zip(scales, mains, strict=True)]
        accuracies = (round(1e4 * accuracy_m) for accuracy_m in _accuracies(epochs, row))
        return ubx.NavHpposllh(0, 0, stamp.tow_ms, *mains, *rests, *accuracies)

    def _whole(self, epochs: Epochs, row: int) -> tuple[int, int, int, int]:
        """Return the position in whole numbers of NAV-HPPOSLLH's finest units.

        They are latitude and longitude in 1e-9 degrees, heights above ellipsoid and geoid in tenths of a millimetre.
        """
        height_m = float(epochs.height_m[row])
        return (
            round(1e9 * math.degrees(epochs.lat_rad[row])),
            round(1e9 * math.degrees(epochs.lon_rad[row])),
            round(1e4 * height_m),
            round(1e4 * (height_m - self._undulation_m)),
        )


def _main(value: int, scale: int) -> int:
    """Return the part in the coarser unit, so that the remainder is at most half of that unit."""
    return (value + scale // 2) // scale


def _accuracies(epochs: Epochs, row: int) -> tuple[float, float]:
    """Return the horizontal accuracy (both axes together) and the vertical one, metres."""
    north, east, down = map(float, epochs.position_sigma_l[row])
    return math.hypot(north, east), down


def _velocity(epochs: Epochs, row: int) -> dict[str, int]:
    """Return the velocity fields of NAV-PVT."""
    north, east, down = map(float, epochs.velocity_l[row])
    speed_mps = math.hypot(north, east)
    accuracy_mps = math.hypot(*map(float, epochs.velocity_sigma_l[row][:2]))
    course_accuracy_deg = min(180.0, math.degrees(accuracy_mps / max(speed_mps, 1e-3)))
    return {
        "vel_n_mmps": round(1e3 * north),
        "vel_e_mmps": round(1e3 * east),
        "vel_d_mmps": round(1e3 * down),
        "ground_speed_mmps": round(1e3 * speed_mps),
        "course_1e5_deg": round(1e5 * math.degrees(math.atan2(east, north))) % 36_000_000,
        "speed_accuracy_mmps": round(1e3 * accuracy_mps),
        "course_accuracy_1e5_deg": round(1e5 * course_accuracy_deg),
    }


def _empty_pvt(stamp: Stamp) -> ubx.NavPvt:
    """Return NAV-PVT with the time but without a solution."""
    hour, minute, ms = stamp.clock
    return ubx.NavPvt(
        itow_ms=stamp.tow_ms,
        year=stamp.date.year,
        month=stamp.date.month,
        day=stamp.date.day,
        hour=hour,
        minute=minute,
        second=ms // 1000,
        valid=ubx.PVT_VALID_DATE | ubx.PVT_VALID_TIME | ubx.PVT_FULLY_RESOLVED,
        time_accuracy_ns=TIME_ACCURACY_NS,
        nano_ns=ms % 1000 * MILLISECOND_NS,
        fix_type=0,
        flags=0,
        flags2=0,
        satellites=0,
        lon_1e7_deg=0,
        lat_1e7_deg=0,
        height_mm=0,
        height_msl_mm=0,
        horizontal_accuracy_mm=UNKNOWN_ACCURACY,
        vertical_accuracy_mm=UNKNOWN_ACCURACY,
        vel_n_mmps=0,
        vel_e_mmps=0,
        vel_d_mmps=0,
        ground_speed_mmps=0,
        course_1e5_deg=0,
        speed_accuracy_mmps=UNKNOWN_ACCURACY,
        course_accuracy_1e5_deg=UNKNOWN_COURSE_1E5_DEG,
        pdop_1e2=GREATEST_PDOP_1E2,
        flags3=ubx.PVT_INVALID_POSITION,
    )


def _cov(epochs: Epochs, row: int, stamp: Stamp) -> ubx.NavCov:
    if epochs.fix[row] == FixType.NONE:
        return ubx.NavCov(stamp.tow_ms, 0, 0, 0, *(0.0,) * 12)
    position = [float(sigma) ** 2 for sigma in epochs.position_sigma_l[row]]
    velocity = [float(sigma) ** 2 for sigma in epochs.velocity_sigma_l[row]]
    return ubx.NavCov(stamp.tow_ms, 0, 1, 1, *_upper(position), *_upper(velocity))


def _upper(diagonal: list[float]) -> tuple[float, float, float, float, float, float]:
    north, east, down = diagonal
    return north, 0.0, 0.0, east, 0.0, down
