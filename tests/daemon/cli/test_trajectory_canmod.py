"""`swath trajectory` with a CANmod.gps alone: its IMU, and the receiver inside it, on one bus."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest

from swath.daemon.processing.navigation.log import read_navigation_log
from swath.daemon.processing.navigation.sources import NavigationSources
from swath.drivers.imu.canmod_gps import DBC_PATH
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import GnssFix
from tests.daemon.commands import swath
from tests.daemon.short_flight import Flown, fly_short, two_lines

CONFIG = """
[session]
name = "canmod"
directory = "logs"

[imu.main]
transport = "can:socketcan:can0"
protocol = "canmod-gps"
rate_hz = 100

[imu.main.noise]
grade = "consumer"

[gnss.inside]
transport = "imu:main"
protocol = "canmod-gps"
lever_arm_m = [0.1, -0.05, -1.2]
"""
IMU_NAMES = [f"{kind}{axis}" for kind in ("Acceleration", "AngularRate") for axis in "XYZ"]


def unix_s(fix: GnssFix) -> float:
    """Return the fix's epoch of a receiver that gives UTC with a date."""
    assert fix.time.date is not None
    midnight = dt.datetime.combine(fix.time.date, dt.time(), dt.UTC)
    return midnight.timestamp() + fix.time.time_ns * 1e-9


def candump(flown: Flown) -> str:
    """Return what a CANmod.gps sends in a flight, by the maker's DBC: samples of its IMU and a fix a second."""
    session = flown.session()
    found = read_navigation_log(session, NavigationSources(flown.config, session.attachments()))
    database: Any = cantools.database.load_file(DBC_PATH)
    lines: list[tuple[int, str]] = []

    def add(time_ns: int, name: str, values: dict[str, float]) -> None:
        message = database.get_message_by_name(name)
        whole = {signal.name: 0 for signal in message.signals} | values
        data = message.encode(whole, strict=False)
        lines.append((time_ns, f"({time_ns / 1e9:.6f}) can0 {message.frame_id:03X}#{data.hex().upper()}"))

    for row in found.imu:
        measured = [*row["specific_force_b"].tolist(), *np.degrees(row["angular_rate_b"]).tolist()]
        add(int(row["host_time_ns"]), "gnss_imu", dict(zip(IMU_NAMES, measured, strict=True)) | {"ImuValid": 1})
    for fix in found.fixes:
        if fix.lat_rad is None or fix.lon_rad is None or fix.height_m is None or unix_s(fix) % 1.0:
            continue
        at_ns = fix.host_time_ns
        add(at_ns, "gnss_status", {"FixType": 3, "Satellites": 12})
        add(at_ns + 1000, "gnss_time", {"TimeValid": 1, "TimeConfirmed": 1, "Epoch": unix_s(fix)})
        place = {"Latitude": float(np.degrees(fix.lat_rad)), "Longitude": float(np.degrees(fix.lon_rad))}
        add(at_ns + 2000, "gnss_pos", place | {"PositionValid": 1, "PositionAccuracy": 3})
        add(at_ns + 3000, "gnss_altitude", {"AltitudeValid": 1, "Altitude": fix.height_m, "AltitudeAccuracy": 4})
    return "\n".join(line for _, line in sorted(lines)) + "\n"


@pytest.mark.slow
def test_a_canmod_gps_alone_navigates(tmp_path: Path) -> None:
    plan = two_lines("canmod", gnss='grade = "spp"\nprotocol = "nmea"', imu="rate_hz = 100", prf_hz=100)
    flown = fly_short(tmp_path, plan)
    (tmp_path / "bus.log").write_text(candump(flown))
    (tmp_path / "canmod.toml").write_text(CONFIG)
    made = swath("import", str(tmp_path / "canmod.toml"), str(tmp_path / "bus.log"), "-o", str(tmp_path / "again"))
    assert made.returncode == 0, made.stderr
    run = swath("trajectory", str(tmp_path / "again"), "-o", str(tmp_path / "t.sbet"))
    summary = json.loads((tmp_path / "t.json").read_text())
    assert "Traceback" not in run.stderr
    assert summary["sessions"][0]["gnss"]["observations"]["position"] > 60
    rows = np.fromfile(tmp_path / "t.sbet", "<f8").reshape(-1, 17)
    truth = flown.truth()
    week_ns = 604_800 * 10**9
    begins_ns = int(truth.time_ns[0]) // week_ns * week_ns
    time_ns = begins_ns + np.round(rows[:, 0] * 1e9).astype(np.int64)
    inside = truth.fates(time_ns) == 0
    assert inside.sum() > 0.5 * len(truth.time_ns) / 2  # most of the flight, at 100 Hz instead of 200
    apart_m = (
        e_from_geodetic(rows[inside, 1], rows[inside, 2], rows[inside, 3]) - truth.poses(time_ns[inside]).position_e
    )
    assert float(np.sqrt(np.mean(np.sum(apart_m**2, axis=1)))) < 6.0  # fixes of 2 m and 4 m, to 0.1 m on the bus
