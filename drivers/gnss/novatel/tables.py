"""NovAtel OEM7: status values and IMU scale factors, by the manual's tables (docs.novatel.com/OEM7)."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from swath.georef.records import FixType

FOOT_M = 0.3048
STANDARD_GRAVITY = 9.80665
FULL_SCALE_16 = 2.0**16

# Names in ASCII logs, by the manual's tables.
SOLUTION_STATUSES = {
    **{"SOL_COMPUTED": 0, "INSUFFICIENT_OBS": 1, "NO_CONVERGENCE": 2, "SINGULARITY": 3, "COV_TRACE": 4, "TEST_DIST": 5},
    **{"COLD_START": 6, "V_H_LIMIT": 7, "VARIANCE": 8, "RESIDUALS": 9, "DELTA_POS": 10, "NEGATIVE_VAR": 11},
    **{"INTEGRITY_WARNING": 13, "PENDING": 18, "INVALID_FIX": 19, "UNAUTHORIZED": 20, "INVALID_RATE": 22},
}
POSITION_TYPES = {
    **{"NONE": 0, "FIXEDPOS": 1, "FIXEDHEIGHT": 2, "FLOATCONV": 4, "WIDELANE": 5, "NARROWLANE": 6},
    **{"DOPPLER_VELOCITY": 8, "SINGLE": 16, "PSRDIFF": 17, "WAAS": 18, "SBAS": 18, "PROPAGATED": 19, "OMNISTAR": 20},
    **{"L1_FLOAT": 32, "IONOFREE_FLOAT": 33, "NARROW_FLOAT": 34, "L1_INT": 48, "WIDE_INT": 49, "NARROW_INT": 50},
    **{"RTK_DIRECT_INS": 51, "INS_SBAS": 52, "INS_PSRSP": 53, "INS_PSRDIFF": 54, "INS_RTKFLOAT": 55},
    **{"INS_RTKFIXED": 56, "INS_OMNISTAR": 57, "INS_OMNISTAR_HP": 58, "INS_OMNISTAR_XP": 59, "OMNISTAR_HP": 64},
    **{"OMNISTAR_XP": 65, "CDGPS": 66, "PPP_CONVERGING": 68, "PPP": 69, "OPERATIONAL": 70, "WARNING": 71},
    **{"OUT_OF_BOUNDS": 72, "INS_PPP_CONVERGING": 73, "INS_PPP": 74, "PPP_BASIC_CONVERGING": 77, "PPP_BASIC": 78},
    **{"INS_PPP_BASIC_CONVERGING": 79, "INS_PPP_BASIC": 80},
}
INS_STATUSES = {
    **{"INS_INACTIVE": 0, "INS_ALIGNING": 1, "INS_HIGH_VARIANCE": 2, "INS_SOLUTION_GOOD": 3, "INS_SOLUTION_FREE": 6},
    **{"INS_ALIGNMENT_COMPLETE": 7, "DETERMINING_ORIENTATION": 8, "WAITING_INITIALPOS": 9, "WAITING_AZIMUTH": 10},
    **{"INITIALIZING_BIASES": 11, "MOTION_DETECT": 12, "WAITING_ALIGNMENTORIENTATION": 14},
}
TIME_STATUSES = {
    **{"UNKNOWN": 20, "APPROXIMATE": 60, "COARSEADJUSTING": 80, "COARSE": 100, "COARSESTEERING": 120},
    **{"FREEWHEELING": 130, "FINEADJUSTING": 140, "FINE": 160, "FINEBACKUPSTEERING": 170, "FINESTEERING": 180},
    **{"SATTIME": 200},
}
CLOCK_STATUSES = {"VALID": 0, "CONVERGING": 1, "ITERATING": 2, "INVALID": 3}
UTC_STATUSES = {"INVALID": 0, "VALID": 1, "WARNING": 2}

# GPS reference time status (table of that name). The receiver's time is valid, and its PPS steered to it, in these:
TIME_STATUS_FINE = 160
TIME_STATUS_FINEBACKUPSTEERING = 170
TIME_STATUS_FINESTEERING = 180
TIME_VALID = frozenset((TIME_STATUS_FINE, TIME_STATUS_FINEBACKUPSTEERING, TIME_STATUS_FINESTEERING))

CLOCK_VALID = 0  # clock model status
UTC_VALID = 1  # UTC status; 2 is WARNING: leap seconds guessed
SOL_COMPUTED = 0  # solution status
POSITION_NONE = 0

# Position or velocity type -> the coarse class; other types are NONE.
FIX_TYPES: dict[int, FixType] = {
    1: FixType.MANUAL,  # FIXEDPOS
    2: FixType.SINGLE,  # FIXEDHEIGHT
    8: FixType.SINGLE,  # DOPPLER_VELOCITY
    16: FixType.SINGLE,
    17: FixType.DIFFERENTIAL,  # PSRDIFF
    18: FixType.DIFFERENTIAL,  # WAAS (SBAS)
    19: FixType.DEAD_RECKONING,  # PROPAGATED
    20: FixType.DIFFERENTIAL,  # OMNISTAR
    32: FixType.RTK_FLOAT,  # L1_FLOAT
    33: FixType.RTK_FLOAT,  # IONOFREE_FLOAT
    34: FixType.RTK_FLOAT,  # NARROW_FLOAT
    48: FixType.RTK_FIXED,  # L1_INT
    49: FixType.RTK_FIXED,  # WIDE_INT
    50: FixType.RTK_FIXED,  # NARROW_INT
    51: FixType.RTK_FIXED,  # RTK_DIRECT_INS
    52: FixType.DIFFERENTIAL,  # INS_SBAS
    53: FixType.SINGLE,  # INS_PSRSP
    54: FixType.DIFFERENTIAL,  # INS_PSRDIFF
    55: FixType.RTK_FLOAT,  # INS_RTKFLOAT
    56: FixType.RTK_FIXED,  # INS_RTKFIXED
    64: FixType.PPP,  # OMNISTAR_HP
    65: FixType.PPP,  # OMNISTAR_XP
    66: FixType.DIFFERENTIAL,  # CDGPS
    68: FixType.PPP,  # PPP_CONVERGING
    69: FixType.PPP,
    70: FixType.SINGLE,  # OPERATIONAL, WARNING, OUT_OF_BOUNDS: the type behind a user accuracy limit is unknown
    71: FixType.SINGLE,
    72: FixType.SINGLE,
    73: FixType.PPP,  # INS_PPP_CONVERGING
    74: FixType.PPP,  # INS_PPP
    77: FixType.PPP,  # PPP_BASIC_CONVERGING
    78: FixType.PPP,  # PPP_BASIC
    79: FixType.PPP,  # INS_PPP_BASIC_CONVERGING
    80: FixType.PPP,  # INS_PPP_BASIC
}

# Inertial solution status: in these a row is a navigation solution (HIGH_VARIANCE, GOOD, FREE, ALIGNMENT_COMPLETE).
INS_NAVIGATING = frozenset((2, 3, 6, 7))


@dataclass(frozen=True, slots=True)
class ImuScale:
    """The value of one count of RAWIMU, and the number of samples a second.

    Attributes:
        name: the manual's name of the IMU type.
        rad_per_count: angle increment.
        mps_per_count: velocity increment.
        rate_hz: samples a second; an increment covers the inverse of it.
    """

    name: str
    rad_per_count: float
    mps_per_count: float
    rate_hz: float


def _rate_output(name: str, deg_per_s: float, milli_g: float, rate_hz: float) -> ImuScale:
    """Return the scale of an IMU whose counts are rates in 1/65536 of a unit (Epson), as increments over one sample."""
    rad = radians(deg_per_s) / FULL_SCALE_16 / rate_hz
    return ImuScale(name, rad, milli_g / FULL_SCALE_16 * STANDARD_GRAVITY / 1000.0 / rate_hz, rate_hz)


_HG_RAD, _HG_MPS = 2.0**-33, 2.0**-27 * FOOT_M
_KVH_RAD, _FSAS_MPS = 0.1 / (3600.0 * 256.0), 0.05 / 2.0**15

# IMU type (INSCONFIG, RAWIMUX) -> scale: RAWIMUSX, "Raw IMU Scale Factors" and the output rates above that table.
IMU_SCALES: dict[int, ImuScale] = {
    1: ImuScale("HG1700_AG11", _HG_RAD, _HG_MPS, 100.0),
    4: ImuScale("HG1700_AG17", _HG_RAD, 2.0 * _HG_MPS, 100.0),
    5: ImuScale("HG1900_CA29", _HG_RAD, _HG_MPS, 100.0),
    8: ImuScale("LN200", 2.0**-19, 2.0**-14, 200.0),
    11: ImuScale("HG1700_AG58", _HG_RAD, _HG_MPS, 100.0),
    12: ImuScale("HG1700_AG62", _HG_RAD, 2.0 * _HG_MPS, 100.0),
    13: ImuScale("IMAR_FSAS", radians(0.1 / 256.0 / 3600.0), _FSAS_MPS, 200.0),
    20: ImuScale("HG1930_AA99", _HG_RAD, _HG_MPS, 100.0),
    26: ImuScale("ISA100C", 1.0e-9, 2.0e-8, 200.0),
    27: ImuScale("HG1900_CA50", _HG_RAD, _HG_MPS, 100.0),
    28: ImuScale("HG1930_CA50", _HG_RAD, _HG_MPS, 100.0),
    31: ImuScale("ADIS16488", radians(720.0 / 2.0**31), 200.0 / 2.0**31, 200.0),
    32: ImuScale("STIM300", radians(2.0**-21), 2.0**-22, 125.0),
    33: ImuScale("KVH_1750", _KVH_RAD, _FSAS_MPS, 200.0),
    41: _rate_output("EPSON_G320", 0.008, 0.2, 125.0),
    52: ImuScale("LITEF_MICROIMU", 1.0e-9, 2.0e-8, 200.0),
    56: ImuScale("STIM300D", radians(2.0**-21), 2.0**-22, 125.0),
    58: ImuScale("HG4930_AN01", _HG_RAD, 2.0**-29, 100.0),
    61: _rate_output("EPSON_G370", 0.0151515, 0.4, 200.0),
    62: _rate_output("EPSON_G320_200HZ", 0.008, 0.2, 200.0),
    68: ImuScale("HG4930_AN04", _HG_RAD, 2.0**-29, 100.0),
    69: ImuScale("HG4930_AN04_400HZ", _HG_RAD, 2.0**-29, 400.0),
}
IMU_TYPES = {scale.name: number for number, scale in IMU_SCALES.items()}
