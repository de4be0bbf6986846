"""NMEA 0183 sentences: fields located by pynmea2's tables, times and numbers checked strictly, and an encoder for each.

pynmea2 locates the fields; tables here do for headings, which it has not for every talker. Times are read here, since
second 60 of a leap second must be accepted and fractions must stay exact, and ``datetime.time`` supports neither;
numbers and coordinates are read here too.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from typing import Any

import pynmea2

from swath.drivers.framing.checksums import nmea_xor
from swath.georef.timescales.gps_time import SECOND_NS

DAY_NS = 86_400 * SECOND_NS
MPS_PER_KNOT = 1852.0 / 3600.0
MPS_PER_KMPH = 1.0 / 3.6

TIME = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d|60)(?:\.(\d*))?")
NUMBER = re.compile(r"[+-]?(?:\d{1,12}(?:\.\d*)?|\.\d+)")
DEGREES_MINUTES = re.compile(r"(\d{1,3})([0-5]\d(?:\.\d*)?)")
DATE_DDMMYY = re.compile(r"\d{6}")
FIELDS = {  # of sentences that pynmea2 does not have, after the address
    "THS": ("heading", "mode"),  # IEC 61162-1; mode A, E, M, S, V
    # Unicore N4 command reference, GPHPR
    "HPR": ("timestamp", "heading", "pitch", "roll", "quality", "num_sats", "age", "station"),
    # Applanix POS LV and Trimble BD9xx; OEM7 PASHR
    "PASHR": (
        *("timestamp", "heading", "true", "roll", "pitch", "heave"),
        *("roll_sigma", "pitch_sigma", "heading_sigma", "gps_quality", "imu_status"),
    ),
    # Trimble OEM receiver help, NMEA-0183 message PTNL,AVR
    "PTNLAVR": (
        *("type", "timestamp", "heading", "_yaw", "pitch", "_tilt", "roll", "_roll", "range", "quality", "pdop"),
        "num_sats",
    ),
}
PLACES = {kind: {name: place for place, name in enumerate(names)} for kind, names in FIELDS.items()}


class FieldError(ValueError):
    """A field cannot be read; the sentence is counted as bad."""


class Sentence:
    """Gives access to one sentence's fields by pynmea2's names.

    Args:
        kind: sentence type of `FIELDS`, or one that pynmea2 knows, such as ``GGA``.
        frame: the whole sentence, its checksum already verified.
    """

    def __init__(self, kind: str, frame: bytes) -> None:
        fields = frame[1 : frame.rindex(b"*")].decode("ascii").split(",")
        self._places: dict[str, int] | None = PLACES.get(kind)
        self._data = fields[1:]
        if self._places is None:
            message: Any = pynmea2.TalkerSentence.sentence_types[kind](fields[0][:-3], kind, fields[1:])
            self._places, self._data = message.name_to_idx, message.data

    def text(self, name: str) -> str:
        """Return the field's text, empty where the sentence is shorter."""
        assert self._places is not None
        place = self._places[name]
        return self._data[place] if place < len(self._data) else ""

    def number(self, name: str) -> float | None:
        """Return the field as a number; None where it is empty."""
        text = self.text(name)
        if not text:
            return None
        if not NUMBER.fullmatch(text):
            raise FieldError(f"{name}: {text!r}")
        return float(text)

    def time_ns(self) -> int | None:
        """Return nanoseconds of the UTC day, 86 400 s and above in a leap second; None where the receiver has no
        time.
        """
        text = self.text("timestamp")
        if not text:
            return None
        match = TIME.fullmatch(text)
        if not match:
            raise FieldError(f"time {text!r}")
        hours, minutes, seconds = (int(part) for part in match.group(1, 2, 3))
        if seconds == 60 and (hours, minutes) != (23, 59):
            raise FieldError(f"time {text!r}")
        fraction = ((match.group(4) or "") + "000000000")[:9]
        return (hours * 3600 + minutes * 60 + seconds) * SECOND_NS + int(fraction)

    def position_rad(self) -> tuple[float, float] | None:
        """Return latitude and longitude; None where a field is empty."""
        if not (self.text("lat") and self.text("lon")):
            return None
        if self.text("lat_dir") not in ("N", "S") or self.text("lon_dir") not in ("E", "W"):
            raise FieldError("hemisphere")
        latitude, longitude = self._degrees("lat", 90.0), self._degrees("lon", 180.0)
        south, west = self.text("lat_dir") == "S", self.text("lon_dir") == "W"
        return math.radians(-latitude if south else latitude), math.radians(-longitude if west else longitude)

    def _degrees(self, name: str, most: float) -> float:
        """Return the degrees of a field in degrees and minutes; the point and later digits may be missing (NMEA
        0183).
        """
        text = self.text(name)
        match = DEGREES_MINUTES.fullmatch(text)
        if match is None or (degrees := float(match[1]) + float(match[2]) / 60.0) > most:
            raise FieldError(f"{name} {text!r}")
        return degrees

    def date_ddmmyy(self) -> dt.date | None:
        """Return RMC's date; a year of two digits is 1980 to 2079."""
        text = self.text("datestamp")
        if not text:
            return None
        if not DATE_DDMMYY.fullmatch(text):
            raise FieldError(f"date {text!r}")
        year = int(text[4:6])
        return checked_date(year + (1900 if year >= 80 else 2000), int(text[2:4]), int(text[:2]))

    def date_ymd(self) -> dt.date | None:
        """Return ZDA's date."""
        texts = [self.text(name) for name in ("year", "month", "day")]
        if not any(texts):
            return None
        if not all(text.isdecimal() for text in texts):
            raise FieldError(f"date {texts}")
        return checked_date(*(int(text) for text in texts))


def checked_date(year: int, month: int, day: int) -> dt.date:
    """Return a date, checked against the calendar.

    Raises:
        FieldError: the date is not on the calendar.
    """
    try:
        return dt.date(year, month, day)
    except (ValueError, OverflowError):
        raise FieldError(f"date {year}-{month}-{day}") from None


def velocity_from_course(speed_mps: float | None, course_deg: float | None) -> tuple[float, float, float] | None:
    """Return north and east velocity, and nan for the unknown down component; None where speed or course is empty."""
    if speed_mps is None or course_deg is None:
        return None
    course = math.radians(course_deg)
    return speed_mps * math.cos(course), speed_mps * math.sin(course), math.nan


# --- encoders -------------------------------------------------------------------------------------------------------


def encode_sentence(body: str) -> bytes:
    """Return ``$body*hh`` with the line end."""
    raw = body.encode("ascii")
    return b"$%s*%02X\r\n" % (raw, nmea_xor(raw))


def _time_text(time_ns: int) -> str:
    """Return hhmmss.ss of nanoseconds of the UTC day, 235960 in a leap second."""
    centiseconds = time_ns // 10_000_000
    seconds, hundredths = divmod(centiseconds, 100)
    leap = max(0, seconds - 86_399)
    minutes, second = divmod(seconds - leap, 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours:02d}{minute:02d}{second + leap:02d}.{hundredths:02d}"


def _angle_text(angle_rad: float, degree_digits: int, letters: str) -> str:
    """Return ddmm.mmmmmmmm and the hemisphere's letter."""
    scaled = round(abs(math.degrees(angle_rad)) * 60e8)
    degrees, minutes = divmod(scaled, 60 * 10**8)
    whole, fraction = divmod(minutes, 10**8)
    return f"{degrees:0{degree_digits}d}{whole:02d}.{fraction:08d},{letters[angle_rad < 0]}"


def _position_text(lat_rad: float, lon_rad: float) -> str:
    return f"{_angle_text(lat_rad, 2, 'NS')},{_angle_text(lon_rad, 3, 'EW')}"


def encode_gga(
    time_ns: int,
    lat_rad: float,
    lon_rad: float,
    altitude_m: float,
    separation_m: float,
    *,
    quality: int = 1,
    satellites: int = 12,
    talker: str = "GN",
) -> bytes:
    """Encode a GGA: altitude above the receiver's geoid, height of the geoid above the ellipsoid, and time of the UTC
    day.
    """
    return encode_sentence(
        f"{talker}GGA,{_time_text(time_ns)},{_position_text(lat_rad, lon_rad)},{quality},{satellites:02d},0.80,"
        f"{altitude_m:.4f},M,{separation_m:.4f},M,,"
    )


def encode_rmc(
    time_ns: int,
    date: dt.date,
    lat_rad: float,
    lon_rad: float,
    speed_mps: float,
    course_rad: float,
    *,
    valid: bool = True,
    talker: str = "GN",
) -> bytes:
    """Encode an RMC: position, speed over ground and course; ``valid=False`` gives status V and mode N."""
    return encode_sentence(
        f"{talker}RMC,{_time_text(time_ns)},{'A' if valid else 'V'},{_position_text(lat_rad, lon_rad)},"
        f"{speed_mps / MPS_PER_KNOT:.4f},{math.degrees(course_rad) % 360.0:.4f},{date:%d%m%y},,,{'A' if valid else 'N'}"
    )


def encode_zda(time_ns: int, date: dt.date, *, talker: str = "GN") -> bytes:
    """Encode a ZDA: UTC time and date, local zone 0."""
    return encode_sentence(f"{talker}ZDA,{_time_text(time_ns)},{date:%d,%m,%Y},00,00")


def encode_gst(time_ns: int, sigma_n_m: float, sigma_e_m: float, sigma_d_m: float, *, talker: str = "GN") -> bytes:
    """Encode a GST: sigmas of latitude, longitude and height; the error ellipse is left empty."""
    return encode_sentence(f"{talker}GST,{_time_text(time_ns)},,,,,{sigma_n_m:.4f},{sigma_e_m:.4f},{sigma_d_m:.4f}")


def encode_vtg(speed_mps: float, course_rad: float, *, talker: str = "GN") -> bytes:
    """Encode a VTG: course over ground and speed."""
    course = math.degrees(course_rad) % 360.0
    knots, kmph = speed_mps / MPS_PER_KNOT, speed_mps / MPS_PER_KMPH
    return encode_sentence(f"{talker}VTG,{course:.4f},T,,M,{knots:.4f},N,{kmph:.4f},K,A")


def encode_hdt(heading_rad: float, *, talker: str = "GN") -> bytes:
    """Encode an HDT: true heading."""
    return encode_sentence(f"{talker}HDT,{math.degrees(heading_rad) % 360.0:.4f},T")


def encode_ths(heading_rad: float | None, *, mode: str = "A", talker: str = "GN") -> bytes:
    """Encode a THS: true heading and mode (A autonomous, E estimated, M manual, S simulated, V not valid)."""
    return encode_sentence(f"{talker}THS,{_degrees_text(heading_rad)},{mode}")


def encode_hpr(time_ns: int, heading_rad: float, pitch_rad: float, *, quality: int = 4, talker: str = "GN") -> bytes:
    """Encode Unicore's HPR: heading and pitch of the baseline; quality as of GGA."""
    pitch = math.degrees(pitch_rad)
    return encode_sentence(
        f"{talker}HPR,{_time_text(time_ns)},{_degrees_text(heading_rad)},{pitch:.4f},0.0000,{quality},30,0.00,0999"
    )


def encode_pashr(
    time_ns: int,
    roll_rad: float,
    pitch_rad: float,
    heading_rad: float,
    sigmas_rad: tuple[float, float, float],
    *,
    gps_quality: int = 2,
    imu_status: int = 1,
) -> bytes:
    """Encode a PASHR: attitude of the vehicle, its sigmas in the same order, and status."""
    roll, pitch = math.degrees(roll_rad), math.degrees(pitch_rad)
    sigmas = ",".join(f"{math.degrees(sigma):.3f}" for sigma in sigmas_rad)
    return encode_sentence(
        f"PASHR,{_time_text(time_ns)},{_degrees_text(heading_rad)},T,{roll:+.4f},{pitch:+.4f},+0.00,{sigmas},"
        f"{gps_quality},{imu_status}"
    )


def encode_avr(time_ns: int, yaw_rad: float, tilt_rad: float, range_m: float, *, quality: int = 3) -> bytes:
    """Encode a PTNL,AVR: yaw and tilt of a moving baseline and its length; quality 3 is a fixed solution."""
    yaw, tilt = math.degrees(yaw_rad), math.degrees(tilt_rad)
    return encode_sentence(
        f"PTNL,AVR,{_time_text(time_ns)},{yaw:+.4f},Yaw,{tilt:+.4f},Tilt,,,{range_m:.3f},{quality},1.6,12"
    )


def _degrees_text(heading_rad: float | None) -> str:
    return "" if heading_rad is None else f"{math.degrees(heading_rad) % 360.0:.4f}"
