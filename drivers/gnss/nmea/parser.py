"""NMEA 0183: GGA, GNS, RMC, ZDA, VTG, GST, HDT, THS and HPR of any talker, PASHR and PTNL,AVR.

The standard's sentences by v4.11; u-blox and NovAtel manuals agree. HPR by Unicore's N4 command reference, PASHR by
Applanix, PTNL,AVR by Trimble.

Time: RMC and ZDA refer to the previous PPS edge, in UTC. RMC confirms its time by status A; ZDA has no status and is
accepted while the stream's latest GGA, GNS or RMC has a fix, or if the stream has none of them. A tag off the whole
second does not count.

Fix: the sentences of one time of day make one `GnssFix` (`swath.drivers.gnss.epochs`): position and quality of GGA,
else of GNS, else of RMC; date of RMC or ZDA of the same time; velocity of RMC, else of VTG, which carries no time and
so belongs to the epoch in which it arrives; sigmas of GST. Height is the altitude plus the geoid separation of GGA or
GNS, None where the receiver leaves either empty. There is no vertical velocity. Empty fields mean a receiver without a
fix, not an error. GNS has a mode for each constellation; the best of them applies to the fix, as all constellations
make one position. Where a receiver adds a GNS for each constellation, these have no mode and give satellites only: they
are ignored.

Heading: HPR and PTNL,AVR have the direction of the baseline between two antennas with its quality, and count with fixed
ambiguities only. PASHR has the vehicle's heading with its sigma. THS and HDT have neither time nor quality, so they
count only where none of these comes. The sigma is the one in the sentence, else None.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import GNSS_KINDS
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import ReceiverDates
from swath.drivers.gnss.epochs import EpochGatherer
from swath.drivers.gnss.nmea.sentences import MPS_PER_KMPH, MPS_PER_KNOT, FieldError, Sentence, velocity_from_course
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.georef.arrays import FloatArray
from swath.georef.records import (
    FixType,
    GnssFix,
    GnssHeading,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)

# GGA field 6, quality; 9 is NovAtel's SBAS
FIX_TYPE_BY_QUALITY = {
    0: FixType.NONE,
    1: FixType.SINGLE,
    2: FixType.DIFFERENTIAL,
    3: FixType.SINGLE,
    4: FixType.RTK_FIXED,
    5: FixType.RTK_FLOAT,
    6: FixType.DEAD_RECKONING,
    7: FixType.MANUAL,
    8: FixType.SIMULATED,
    9: FixType.DIFFERENTIAL,
}
# mode indicator: RMC field 12, VTG field 9, and GNS field 6 for each constellation; absent before NMEA 2.3
FIX_TYPE_BY_MODE = {
    "": FixType.SINGLE,
    "A": FixType.SINGLE,
    "D": FixType.DIFFERENTIAL,
    "P": FixType.SINGLE,
    "F": FixType.RTK_FLOAT,
    "R": FixType.RTK_FIXED,
    "E": FixType.DEAD_RECKONING,
    "M": FixType.MANUAL,
    "S": FixType.SIMULATED,
    "N": FixType.NONE,
}
MODES_BEST_FIRST = "RFDPAEMS"
HEADING_ERRORS = {
    "V": "heading_not_valid",
    "E": "heading_estimated",
    "M": "heading_estimated",
    "S": "heading_estimated",
}
QUALITY_FIXED = {"HPR": 4, "PTNL,AVR": 3}  # of the baseline: the values of GGA, and Trimble's own
BETTER_HEADING_LASTS = 16  # sentences without time and quality that are left out after one that has them
POSITION_SENTENCES = ("GGA", "GNS", "RMC")  # the first one present gives position and quality
VOUCHED = frozenset(
    {FixType.SINGLE, FixType.DIFFERENTIAL, FixType.RTK_FLOAT, FixType.RTK_FIXED}  # fixes from satellites, not estimates
)


@dataclass(frozen=True, slots=True)
class Part:
    """Data of one sentence about its epoch."""

    host_time_ns: int
    time_ns: int | None
    fix_type: FixType | None = None
    position_rad: tuple[float, float] | None = None
    height_m: float | None = None
    satellites: int | None = None
    velocity_l: tuple[float, float, float] | None = None
    position_cov_l: FloatArray | None = None
    date: dt.date | None = None
    undulation_m: float | None = None


class NmeaDecoder:
    """Converts checked sentences to records; parsers of protocols with NMEA in their stream use it too.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all dates.
        counters: the parser's counters; bad sentences and errors are counted there.
        time_only: return the same time messages, and no other records.
    """

    def __init__(self, settings: DeviceSettings, counters: ParserCounters, *, time_only: bool = False) -> None:
        self.counters = counters
        self._source = settings.source
        self._dates = ReceiverDates(settings)
        self._epochs: EpochGatherer[Part] = EpochGatherer(self.counters)
        self._time_only = time_only
        self._has_fix: bool | None = None  # whether the latest GGA, GNS or RMC has a fix
        self._without_time = 0  # GGA, GNS, RMC and ZDA without a time; −1 once one had it
        self._decoders: dict[bytes, Callable[[int, Sentence], list[Record]]] = {
            b"GGA": self._gga,
            b"GNS": self._gns,
            b"RMC": self._rmc,
            b"ZDA": self._zda,
        }
        if not time_only:
            self._decoders |= {b"VTG": self._vtg, b"GST": self._gst, b"HDT": self._hdt, b"THS": self._ths}
            self._decoders |= {b"HPR": self._hpr, b"PASHR": self._pashr, b"PTNLAVR": self._avr}
        self._better_headings = 0  # sentences without time and quality that are still left out

    def decode(self, frames: list[Frame]) -> list[Record]:
        """Return the records that sentences among the frames completed."""
        records: list[Record] = []
        for kind, host_time_ns, data in frames:
            if kind != "nmea":
                continue
            name = _sentence_type(data)
            decoder = self._decoders.get(name)
            if decoder is None:
                continue
            try:
                records += decoder(host_time_ns, Sentence(name.decode(), data))
            except FieldError:
                self.counters.bad_messages += 1
        return records

    def close(self) -> list[Record]:
        """Return the fix of the last epoch."""
        return self._fixes(self._epochs.end())

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's dates, on sentences without checksum, and on sentences without content."""
        remarks = self._dates.remarks()
        unchecked = self.counters.errors["nmea_without_checksum"]
        if unchecked > self.counters.messages.total():
            remarks.append(
                f"{self._source}: {unchecked:,} sentences have no checksum and are not read; switch the checksum on in "
                "the receiver"
            )
        if self._without_time > 0:
            remarks.append(
                f"{self._source}: its {self._without_time:,} sentences of time and position are empty: the receiver "
                "knows neither; give its antenna a free view of the sky, and check the antenna's cable and power"
            )
        return remarks

    # --- sentences ---

    def _gga(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        quality = sentence.number("gps_qual")
        fix_type = FIX_TYPE_BY_QUALITY.get(int(quality), FixType.NONE) if quality is not None else FixType.NONE
        return self._solution(host_time_ns, sentence, fix_type, "GGA")

    def _gns(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        modes = sentence.text("mode_indicator")
        if not modes:
            return []
        mode = next((mode for mode in MODES_BEST_FIRST if mode in modes), "N")
        return self._solution(host_time_ns, sentence, FIX_TYPE_BY_MODE[mode], "GNS")

    def _solution(self, host_time_ns: int, sentence: Sentence, fix_type: FixType, name: str) -> list[Record]:
        time_ns, position = self._known(sentence.time_ns()), sentence.position_rad()
        altitude, separation = sentence.number("altitude"), sentence.number("geo_sep")
        satellites = sentence.number("num_sats")
        self._has_fix = fix_type in VOUCHED
        part = Part(
            host_time_ns,
            time_ns,
            fix_type,
            position,
            altitude + separation if altitude is not None and separation is not None else None,
            int(satellites) if satellites is not None else None,
            undulation_m=separation,
        )
        return self._add(name, part)

    def _rmc(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        time_ns, date = self._known(sentence.time_ns()), self._meant(sentence.date_ddmmyy(), host_time_ns)
        position, speed = sentence.position_rad(), sentence.number("spd_over_grnd")
        velocity = velocity_from_course(None if speed is None else speed * MPS_PER_KNOT, sentence.number("true_course"))
        fix_type = FIX_TYPE_BY_MODE.get(sentence.text("mode_indicator"), FixType.NONE)
        if sentence.text("status") != "A":
            fix_type = FixType.NONE
        self._has_fix = fix_type in VOUCHED
        records = self._time_message(host_time_ns, time_ns, date, self._has_fix, "RMC")
        part = Part(host_time_ns, time_ns, fix_type, position, velocity_l=velocity, date=self._believed(date))
        return records + self._add("RMC", part)

    def _zda(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        time_ns, date = self._known(sentence.time_ns()), self._meant(sentence.date_ymd(), host_time_ns)
        records = self._time_message(host_time_ns, time_ns, date, self._has_fix is not False, "ZDA")
        return records + self._add("ZDA", Part(host_time_ns, time_ns, date=self._believed(date)))

    def _vtg(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        knots, kmph = sentence.number("spd_over_grnd_kts"), sentence.number("spd_over_grnd_kmph")
        speed = knots * MPS_PER_KNOT if knots is not None else None if kmph is None else kmph * MPS_PER_KMPH
        velocity = velocity_from_course(speed, sentence.number("true_track"))
        return self._add("VTG", Part(host_time_ns, self._epochs.key, velocity_l=velocity))

    def _gst(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        sigmas = [sentence.number(f"std_dev_{axis}") for axis in ("latitude", "longitude", "altitude")]
        known = [sigma for sigma in sigmas if sigma is not None]
        covariance = np.diag(np.square(np.array(known))) if len(known) == 3 else None
        return self._add("GST", Part(host_time_ns, sentence.time_ns(), position_cov_l=covariance))

    def _hdt(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        heading = sentence.number("heading")
        if heading is None or self._has_better():
            return []
        return [GnssHeading(host_time_ns, time=None, heading_rad=math.radians(heading), message="HDT")]

    def _ths(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        heading, mode = sentence.number("heading"), sentence.text("mode")
        if self._has_better():
            return []
        error = HEADING_ERRORS.get(mode)
        if error is not None:
            self.counters.errors[error] += 1
        if heading is None:
            return []
        valid = mode == "A"
        return [GnssHeading(host_time_ns, None, math.radians(heading), valid=valid, message="THS")]

    def _has_better(self) -> bool:
        """Return whether headings with time and quality have come lately, and count down."""
        self._better_headings = max(0, self._better_headings - 1)
        return self._better_headings > 0

    def _hpr(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        return self._baseline(host_time_ns, sentence, "HPR", None)

    def _avr(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        return self._baseline(host_time_ns, sentence, "PTNL,AVR", sentence.number("range"))

    def _baseline(self, host_time_ns: int, sentence: Sentence, name: str, range_m: float | None) -> list[Record]:
        """Return the direction of a baseline; without fixed ambiguities it is counted and not valid."""
        time_ns, heading, pitch = sentence.time_ns(), sentence.number("heading"), sentence.number("pitch")
        quality = sentence.number("quality")
        self._better_headings = BETTER_HEADING_LASTS
        if quality != QUALITY_FIXED[name]:
            self.counters.errors["heading_not_fixed" if quality else "heading_not_valid"] += 1
        if heading is None or time_ns is None:
            return []
        return [
            GnssHeading(
                host_time_ns,
                TimeTag(TimeScale.UTC, time_ns),
                heading_rad=math.radians(heading),
                pitch_rad=None if pitch is None else math.radians(pitch),
                baseline_m=range_m or None,
                valid=quality == QUALITY_FIXED[name],
                message=name,
            )
        ]

    def _pashr(self, host_time_ns: int, sentence: Sentence) -> list[Record]:
        """Return the vehicle's heading; its pitch is not that of the baseline. A sigma of 0 is not known.

        The sentence of that address with a name in place of the time (``ATT``, ``POS``) is another one of Ashtech's.
        """
        if sentence.text("timestamp").isalpha():
            return []
        time_ns, heading = sentence.time_ns(), sentence.number("heading")
        sigma = sentence.number("heading_sigma")
        self._better_headings = BETTER_HEADING_LASTS
        valid = bool(sentence.number("gps_quality"))
        if not valid:
            self.counters.errors["heading_not_valid"] += 1
        if heading is None or time_ns is None or sentence.text("true") != "T":
            return []
        return [
            GnssHeading(
                host_time_ns,
                TimeTag(TimeScale.UTC, time_ns),
                heading_rad=math.radians(heading),
                heading_sigma_rad=math.radians(sigma) if sigma else None,
                valid=valid,
                message="PASHR",
            )
        ]

    # --- time and epochs ---

    def _known(self, time_ns: int | None) -> int | None:
        """Count the sentences without a time before the first one that has it; return the time."""
        if time_ns is not None:
            self._without_time = -1
        elif self._without_time >= 0:
            self._without_time += 1
        return time_ns

    def _time_message(
        self, host_time_ns: int, time_ns: int | None, date: dt.date | None, vouched: bool, name: str
    ) -> list[Record]:
        """Return the second of the previous edge; a date before the floor is a rolled-over week, and counted."""
        if time_ns is None:
            return []
        if date is not None and date < self._dates.floor:
            self.counters.errors["date_before_floor"] += 1
        tag = TimeTag(TimeScale.UTC, time_ns, date=date)
        valid = vouched and self._believed(date) is not None
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=name)]

    def _believed(self, date: dt.date | None) -> dt.date | None:
        return date if date is not None and date >= self._dates.floor else None

    def _meant(self, date: dt.date | None, host_time_ns: int) -> dt.date | None:
        return None if date is None else self._dates.date(date, host_time_ns)

    def _add(self, name: str, part: Part) -> list[Record]:
        if part.time_ns is None or self._time_only:
            return []
        return self._fixes(self._epochs.add(part.time_ns, name, part))

    def _fixes(self, epochs: list[dict[str, Part]]) -> list[Record]:
        return [fix for parts in epochs if (fix := merge_epoch(parts)) is not None]


def _sentence_type(data: bytes) -> bytes:
    """Return the type of a sentence: the address without talker, of a maker's own sentence all of it."""
    if data[1:2] == b"P":
        return b"PTNLAVR" if data[5:10] == b",AVR," else data[1:6] if data[6:7] == b"," else b""
    return data[3:6] if data[6:7] == b"," else b""


def merge_epoch(parts: dict[str, Part]) -> GnssFix | None:
    """Merge an epoch's sentences into one fix; return None where none of them has a position."""
    message = next((name for name in POSITION_SENTENCES if name in parts), "")
    solution = parts.get(message)
    if solution is None or solution.fix_type is None or solution.time_ns is None:
        return None
    others = [parts[name] for name in ("RMC", "VTG", "ZDA", "GST") if name in parts]
    velocity = next((part.velocity_l for part in others if part.velocity_l is not None), None)
    date = next((part.date for part in others if part.date is not None), None)
    lat_rad, lon_rad = solution.position_rad or (None, None)
    return GnssFix(
        host_time_ns=solution.host_time_ns,
        time=TimeTag(TimeScale.UTC, solution.time_ns, date=date),
        lat_rad=lat_rad,
        lon_rad=lon_rad,
        height_m=solution.height_m,
        velocity_l=velocity,
        position_cov_l=parts["GST"].position_cov_l if "GST" in parts else None,
        fix_type=solution.fix_type,
        satellites=solution.satellites,
        valid=solution.fix_type in VOUCHED and lat_rad is not None,
        message=message,
        undulation_m=solution.undulation_m,
    )


class NmeaParser(FramedParser):
    """Converts sentences to records; UBX and RTCM3 on the same port are framed and counted.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all dates.
        time_only: return the same time messages, and no other records.
    """

    def __init__(self, settings: DeviceSettings, *, time_only: bool = False) -> None:
        super().__init__(GNSS_KINDS)
        self._decoder = NmeaDecoder(settings, self.counters, time_only=time_only)

    def decode_frames(self, frames: list[Frame]) -> list[Record]:
        """Decode consecutive frames; return their records in order."""
        return self._decoder.decode(frames)

    def finish(self) -> list[Record]:
        """Return the records of the last epoch."""
        return self._decoder.close()

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's dates and sentences."""
        return self._decoder.remarks()


DRIVERS = (
    Driver(
        protocol="nmea",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, GnssHeading),
        summary="NMEA 0183 sentences of any receiver (GGA GNS RMC ZDA VTG GST HDT THS HPR PASHR AVR)",
        make_parser=NmeaParser,
        make_time_parser=lambda settings: NmeaParser(settings, time_only=True),
        names_edge=NamesEdge.PREVIOUS,
    ),
)
