"""NMEA sentences of the virtual receiver: GGA, RMC, VTG, GST, ZDA and HDT (NMEA 0183 v4.11)."""

from __future__ import annotations

import math

from swath.drivers.gnss.nmea.sentences import (
    encode_gga,
    encode_gst,
    encode_hdt,
    encode_rmc,
    encode_sentence,
    encode_vtg,
    encode_zda,
)
from swath.georef.records import FixType
from swath.sim.gnss.calendar import Calendar, Stamp
from swath.sim.gnss.pulse import Pulse
from swath.sim.gnss.receiver import Epochs, InsEpochs
from swath.sim.plan.tables import GnssTable

QUALITY = {FixType.SINGLE: 1, FixType.RTK_FIXED: 4, FixType.RTK_FLOAT: 5}  # GGA field 6


class NmeaMessages:
    """Encodes the sentences of an epoch; arguments as `swath.sim.gnss.novatel.NovatelMessages`."""

    def __init__(self, table: GnssTable, calendar: Calendar, pulse: Pulse) -> None:
        self._calendar = calendar
        self._undulation_m = table.undulation_m
        self._two_antennas = table.secondary_lever_arm_m is not None

    def epoch(self, epochs: Epochs, row: int) -> list[bytes]:
        """GGA, RMC, on whole seconds ZDA, VTG, GST, with a second antenna HDT: the direction of the baseline."""
        stamp = self._calendar.at(float(epochs.time_s[row]))
        there = epochs.fix[row] != FixType.NONE
        sentences = self._solution(epochs, row, stamp) if there else _no_solution(stamp)
        if stamp.second is not None:  # not last: what ends an epoch is in every epoch
            sentences.insert(2, encode_zda(stamp.day_ns, stamp.date))
        if self._two_antennas:
            sentences.append(encode_hdt(float(epochs.heading_rad[row])) if there else encode_sentence("GNHDT,,T"))
        return sentences

    def ins_epoch(self, ins: InsEpochs, row: int) -> list[bytes]:
        """NMEA receivers have no INS here."""
        return []

    def _solution(self, epochs: Epochs, row: int, stamp: Stamp) -> list[bytes]:
        lat_rad, lon_rad = float(epochs.lat_rad[row]), float(epochs.lon_rad[row])
        north, east, _ = map(float, epochs.velocity_l[row])
        speed_mps, course_rad = math.hypot(north, east), math.atan2(east, north)
        gga = encode_gga(
            stamp.day_ns,
            lat_rad,
            lon_rad,
            float(epochs.height_m[row]) - self._undulation_m,
            self._undulation_m,
            quality=QUALITY[FixType(int(epochs.fix[row]))],
            satellites=int(epochs.satellites[row]),
        )
        return [
            gga,
            encode_rmc(stamp.day_ns, stamp.date, lat_rad, lon_rad, speed_mps, course_rad),
            encode_vtg(speed_mps, course_rad),
            encode_gst(stamp.day_ns, *map(float, epochs.position_sigma_l[row])),
        ]


def _no_solution(stamp: Stamp) -> list[bytes]:
    """Time goes on; what there is no solution for stays empty."""
    hour, minute, ms = stamp.clock
    time = f"{hour:02d}{minute:02d}{ms / 1000.0:05.2f}"
    return [
        encode_sentence(f"GNGGA,{time},,,,,0,00,99.99,,,,,,"),
        encode_sentence(f"GNRMC,{time},V,,,,,,,{stamp.date:%d%m%y},,,N"),
        encode_sentence("GNVTG,,T,,M,,N,,K,N"),
        encode_sentence(f"GNGST,{time},,,,,,,"),
    ]
