"""Makes an angle file of a Hesai AT128 and packets of it before a wall, by the maker's formulas laser by laser."""

from __future__ import annotations

import datetime as dt
import math

import numpy as np

from swath.drivers.captures.pcap.writer import FILE_HEADER, pcap_frames
from swath.drivers.scanner.hesai.at128 import CIRCLE, FINE, LASERS, MirrorAngles
from swath.drivers.scanner.hesai.heads import MODE_LAST_STRONGEST, MODE_STRONGEST, HesaiHead
from swath.drivers.scanner.hesai.parser import encode_point_packet
from swath.georef.arrays import FloatArray

NOON = dt.datetime(2026, 11, 21, 12, 0, 0, 250_000, tzinfo=dt.UTC)
WALL_M = 40.0
DEG = CIRCLE // 360
STARTS_DEG = (23.25, 143.5, 263.0)


def made_angles(*, steps: int = 180) -> MirrorAngles:
    """Return angles of the size of real ones: lasers 0.2° apart, three mirrors, corrections of up to 1°."""
    laser = np.arange(LASERS)
    start = np.rint(np.array(STARTS_DEG) * DEG).astype(np.int64)
    shaft_deg = 360 / steps * np.arange(steps)[:, np.newaxis]
    into = (shaft_deg - STARTS_DEG[0]) % 120 - 60
    more_azimuth = np.rint(100 * (0.9 * np.sin(np.radians(3 * into)) + 0.002 * (laser - 64))) / 100
    more_elevation = np.rint(100 * 0.4 * np.cos(np.radians(into + 0.1 * laser))) / 100
    wide = steps == 180  # the older file has corrections for all lasers together
    return MirrorAngles(
        start=start,
        end=np.roll(start, -1),
        azimuth_deg=np.where(laser % 2, 2.4, -2.4) * (0.5 + 0.5 * (laser % 4 < 2)),
        elevation_deg=np.rint((12.9 - 0.2 * laser) * DEG) / DEG,
        more_azimuth_deg=more_azimuth if wide else more_azimuth[:, :1],
        more_elevation_deg=more_elevation if wide else more_elevation[:, :1],
    )


def direction(angles: MirrorAngles, shaft_deg: float, laser: int) -> FloatArray:
    """Return the unit vector of a beam: x = cos ε sin a, y = cos ε cos a, z = sin ε (udp4_3_parser.cc, ComputeXYZI)."""
    starts, steps = angles.start / DEG, len(angles.more_azimuth_deg)
    since_deg = float(np.min((shaft_deg - starts) % 360))
    place = shaft_deg / (360 / steps)
    low, part = int(place) % steps, place - int(place)
    column = min(laser, angles.more_azimuth_deg.shape[1] - 1)
    more_azimuth, more_elevation = (
        (1 - part) * table[low, column] + part * table[(low + 1) % steps, column]
        for table in (angles.more_azimuth_deg, angles.more_elevation_deg)
    )
    azimuth = math.radians(2 * since_deg - angles.azimuth_deg[laser] + more_azimuth)
    elevation = math.radians(angles.elevation_deg[laser] + more_elevation)
    flat = math.cos(elevation)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation)])


def scan(head: HesaiHead, angles: MirrorAngles, packets: int) -> list[bytes]:
    """Return packets of all three mirrors before a wall at x = `WALL_M`, every fourth in dual return; each eleventh
    laser meets nothing.
    """
    found = []
    for number in range(packets):
        shaft = (STARTS_DEG[number % 3] + 16 + number * 55 / packets + 0.05 * np.arange(2)) % 360
        dual = number % 4 == 3
        if dual:
            shaft[1] = shaft[0]
        per_degree = 100 * FINE if head.older else 100
        shaft = np.rint(shaft * per_degree) / per_degree
        ranges = [[WALL_M / direction(angles, one, laser)[0] for laser in range(LASERS)] for one in shaft]
        raw = np.rint(np.array(ranges) / 0.004)
        raw[:, (number % 11) :: 11] = 0
        mode = MODE_LAST_STRONGEST if dual else MODE_STRONGEST
        when = NOON + dt.timedelta(microseconds=83.332 * number)
        light = np.broadcast_to(np.arange(LASERS), (2, LASERS))
        found.append(
            encode_point_packet(when, 100 * shaft, raw, light, mode, head=head, sequence=number + 1, motor_rpm=200)
        )
    return found


def pcap_of(units: list[bytes]) -> bytes:
    """Return a capture of datagrams to port 2368."""
    start_ns = int(NOON.timestamp()) * 1_000_000_000
    frames = [
        pcap_frames(
            np.array([start_ns + 83_332 * number]),
            number,
            ("192.168.1.201", 10_000),
            ("192.168.1.100", 2368),
            np.frombuffer(unit, dtype=np.uint8).reshape(1, -1),
        ).tobytes()
        for number, unit in enumerate(units)
    ]
    return FILE_HEADER + b"".join(frames)
