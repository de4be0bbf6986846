"""Tests the reader of tables: names with units, forms of time, defaults, damage, lines about what is missing."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import pytest

from swath.daemon.processing.records.tables import KINDS, flat_columns
from swath.drivers.captures.base import CapturedUnit, CaptureTally
from swath.drivers.captures.tables.columns import devices_of, normal, plan_of
from swath.drivers.captures.tables.read import read_table
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings
from swath.drivers.record_frames import NO_ARRIVAL, TELLS_TIME, Scale, decode_rows
from swath.drivers.transports.base import TransportError
from swath.georef.records import Chunk, FixType, GnssFix, ImuSamples, InsSolution, ScannerReturns, TimeMessage

GPS_NS = 1_465_549_218_250_000_000  # 2026-06-15T09:00:00.25 UTC, week 2423
TOW_S = 118_818.25
POSIX_NS = 1_781_514_000_250_000_000
DEVICES = {"fixes": "gnss", "headings": "gnss", "marks": "gnss", "times": "gnss", "samples": "imu", "solutions": "imu"}


def write(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def units_of(path: Path, device: str, tally: CaptureTally | None = None) -> list[CapturedUnit]:
    return list(read_table(path, device, tells_time=True, tally=tally))


def records_of(path: Path, device: DeviceKind, tally: CaptureTally | None = None) -> list[Any]:
    """Return the records that the driver reads in a table's units."""
    parser = find_driver(device, "records").make_parser(DeviceSettings(f"{device}/x"))
    units = units_of(path, device, tally)
    return [record for unit in units for record in parser.feed(Chunk(f"{device}/x", unit.time_ns, unit.data))]


@pytest.mark.parametrize("table", DEVICES)
def test_every_column_of_an_export_is_read(table: str) -> None:
    names = list(flat_columns(KINDS[table].table([])))
    plan = plan_of("x", names, DEVICES[table])
    assert plan.unused == (["time_sigma_s"] if table == "solutions" else [])
    assert devices_of(names) == [DEVICES[table]]


def test_names_are_read_however_they_are_written() -> None:
    written = ["Accel X [m/s²]", "gyro-y (deg/s)", "SIGMA_NORTH_m", " lat °", "Velocity North (km/h)"]
    assert [normal(name) for name in written] == [
        *("accel_x_m_s2", "gyro_y_deg_s", "sigma_north_m", "lat_deg", "velocity_north_km_h"),
    ]


def test_units_become_si(tmp_path: Path) -> None:
    """Expected by hand: 1 g = 9.80665 m/s², 180 deg/s = π rad/s, 1 kn = 1852/3600 m/s, 90° = π/2."""
    text = (
        "gps_week;tow_s;Acc X [g];Acc Y [g];Acc Z [g];Gyr X (deg/s);Gyr Y (deg/s);Gyr Z (deg/s);temp degC\n"
        f"2423;{TOW_S};0.5;0;-1;180;-90;0;21.5\n"
    )
    [samples] = records_of(write(tmp_path, text), "imu")
    assert isinstance(samples, ImuSamples)
    [row] = samples.rows
    np.testing.assert_allclose(row["specific_force_b"], [4.903325, 0.0, -9.80665], rtol=1e-15)
    np.testing.assert_allclose(row["angular_rate_b"], [np.pi, -np.pi / 2, 0.0], rtol=1e-15)
    assert (row["temperature_c"], row["time_sigma_s"]) == (21.5, 0.0)
    assert (row["gps_week"], row["device_time_ns"]) == (2423, 118_818_250_000_000)
    text = (
        "# from a receiver\nutc,lat_deg,lon_deg,height_msl_m,undulation_m,vn_kn,ve_kn,vu_kn,sigma_n_m,sigma_e_cm,"
        "sigma_height_m,fix_type,num_sats,comment\n"
        "2026-06-15T09:00:00.25Z,90,-45,400,47.5,36,0,-18,0.5,20,2,RTK fixed,12,hello\n"
    )
    fix, message = sorted(records_of(write(tmp_path, text), "gnss"), key=lambda one: type(one).__name__)
    assert isinstance(fix, GnssFix)
    assert isinstance(message, TimeMessage)
    assert (fix.lat_rad, fix.lon_rad, fix.height_m, fix.undulation_m) == (np.pi / 2, -np.pi / 4, 447.5, 47.5)
    np.testing.assert_allclose(fix.velocity_l or (), [18.52, 0.0, 9.26], rtol=1e-14)
    assert fix.position_cov_l is not None
    np.testing.assert_allclose(fix.position_cov_l, np.diag([0.25, 0.04, 4.0]), rtol=1e-14)
    assert fix.velocity_cov_l is None
    assert (fix.fix_type, fix.satellites, fix.valid, fix.antenna) == (FixType.RTK_FIXED, 12, True, "primary")
    text = "unix_s,lat_deg,lon_deg,hae_m,roll_deg,pitch_deg,heading_deg\n1781514000.25,45,9,500,1,2,359\n"
    [solutions] = records_of(write(tmp_path, text), "imu")
    assert isinstance(solutions, InsSolution)
    assert solutions.rows["gps_ns"][0] == GPS_NS
    np.testing.assert_allclose(solutions.rows["heading_rad"], np.radians([359.0]))
    assert np.isnan(solutions.rows["velocity_l"]).all()


@pytest.mark.parametrize(
    ("header", "cells", "scale"),
    [
        ("gps_ns", str(GPS_NS), Scale.GPS),
        ("gps_s", "1465549218.25", Scale.GPS),
        ("gps_week,tow_ms", "2423,118818250", Scale.GPS),
        ("week,gps_sow_s", f"2423,{TOW_S}", Scale.GPS),
        ("unix_ns", str(POSIX_NS), Scale.UTC),
        ("unix_us", "1781514000250000", Scale.UTC),
        ("unix_time_s", "1781514000.25", Scale.UTC),
        ("utc", "2026-06-15 09:00:00.250", Scale.UTC),
        ("utc_time", "2026-06-15T09:00:00.25+00:00", Scale.UTC),
        ("device_time_us,host_time_ns", f"7000,{POSIX_NS}", Scale.COUNTER),
    ],
)
def test_every_form_of_time_is_the_same_moment(tmp_path: Path, header: str, cells: str, scale: Scale) -> None:
    path = write(tmp_path, f"{header},x_m,y_m,z_m\n{cells},1,2,3\n{cells},4,5,6\n")
    [unit] = units_of(path, "scanner")
    found = decode_rows(unit.data)
    assert not isinstance(found, str)
    assert (found[1], unit.time_ns, len(found[3])) == (scale, POSIX_NS, 2)
    expected = {Scale.GPS: GPS_NS, Scale.UTC: POSIX_NS, Scale.COUNTER: 7_000_000}
    assert found[3]["time_ns"].tolist() == [expected[scale]] * 2
    assert found[2] == (0 if scale is Scale.COUNTER else NO_ARRIVAL)


def test_rows_that_arrived_together_are_one_unit(tmp_path: Path) -> None:
    """Without an arrival each fix is a unit of its own, at its own time; samples in UTC are good to 0.1 s."""
    rows = "".join(f"{GPS_NS + n * 10**9},{n // 2},0.5,0.25,{n}\n" for n in range(4))
    path = write(tmp_path, "gps_ns,host_time_ns,lat_rad,lon_rad,height_m\n" + rows)
    assert [unit.time_ns for unit in units_of(path, "gnss")] == [0, 1]
    path = write(tmp_path, "gps_ns,lat_rad,lon_rad,height_m\n" + "".join(f"{GPS_NS},0.5,0.25,{n}\n" for n in range(2)))
    for unit in units_of(path, "gnss"):
        found = decode_rows(unit.data)
        assert not isinstance(found, str)
        assert found[2] == TELLS_TIME | NO_ARRIVAL
        assert unit.time_ns == POSIX_NS
    axes = ",".join(f"{name}_{axis}_{unit}" for name, unit in (("acc", "m_s2"), ("gyr", "rad_s")) for axis in "xyz")
    [samples] = records_of(write(tmp_path, f"unix_ns,{axes}\n{POSIX_NS},1,2,3,4,5,6\n"), "imu")
    assert samples.rows["time_sigma_s"].tolist() == [np.float32(0.1)]
    told = f"unix_ns,time_sigma_ms,{axes}\n{POSIX_NS},2,1,2,3,4,5,6\n"
    [samples] = records_of(write(tmp_path, told), "imu")
    assert samples.rows["time_sigma_s"].tolist() == [np.float32(0.002)]


def test_points_and_returns_are_read(tmp_path: Path) -> None:
    points = write(tmp_path, f"gps_ns,x_m,y_m,z_m,intensity\n{GPS_NS},3,-4,12,9\n{GPS_NS + 5},0,0,0,1\n")
    tally = CaptureTally()
    [points_found] = [one for one in records_of(points, "scanner", tally) if isinstance(one, ScannerReturns)]
    assert points_found.rows["range_m"].tolist() == [13.0]
    returns = write(tmp_path, f"gps_ns,range_m,azimuth_deg,elevation_deg,channel\n{GPS_NS},13,90,-30,7\n")
    [found] = [one for one in records_of(returns, "scanner") if isinstance(one, ScannerReturns)]
    [row] = found.rows
    assert (row["range_m"], row["encoder_rad"], row["channel"], row["return_number"]) == (13.0, np.pi / 2, 7, 1)
    assert row["elevation_rad"] == pytest.approx(-np.pi / 6)


@pytest.mark.parametrize("form", ["csv.gz", "parquet"])
def test_other_files_hold_the_same_units(tmp_path: Path, form: str) -> None:
    names = ["gps_ns", "lat_deg", "lon_deg", "height_m", "valid", "fix_type", "message"]
    columns: Sequence[Any] = ([GPS_NS, None], [45.5, 46.5], [9.0, None], [1.5, 2.5], [True, False], [4, 1], ["A", None])
    table = pyarrow.table(dict(zip(names, columns, strict=True)))
    pyarrow.csv.write_csv(table, tmp_path / "table.csv")
    tally, other = CaptureTally(), CaptureTally()
    expected = units_of(tmp_path / "table.csv", "gnss", tally)
    path = tmp_path / f"table.{form}"
    if form == "parquet":
        pyarrow.parquet.write_table(table, path)
    else:
        path.write_bytes(gzip.compress((tmp_path / "table.csv").read_bytes()))
    assert units_of(path, "gnss", other) == expected
    assert len(expected) == 1
    assert (tally.damage, tally.first_damage) == (1, f"{tmp_path / 'table.csv'}: a row has no time")
    assert other.damage == 1


def test_what_cannot_be_read_is_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    lines = [f"{GPS_NS},1,2,3", f"{GPS_NS + 1},oops,2,3", f"{GPS_NS + 2},1,2", "later,1,2,3", f"{GPS_NS + 4},4,5,6"]
    tally = CaptureTally()
    path = write(tmp_path, "gps_ns,x_m,y_m,z_m\n" + "\n".join(lines) + "\n")
    path.write_bytes(path.read_bytes().replace(b"oops", b"o\x9cps"))
    units = units_of(path, "scanner", tally)
    rows = np.concatenate([found[3] for unit in units if not isinstance(found := decode_rows(unit.data), str)])
    assert (rows["time_ns"] - GPS_NS).tolist() == [0, 1, 4]
    assert np.isnan(rows["x_m"]).tolist() == [False, True, False]
    assert tally.damage == 4
    assert "a row has 3 columns, the header 4" in tally.first_damage
    with pytest.raises(TransportError, match="column \"x_m\": 'oops' is no number"):
        units_of(write(tmp_path, f"gps_ns,x_m,y_m,z_m\n{GPS_NS},oops,2,3\n"), "scanner")


AXES = "accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s"


@pytest.mark.parametrize(
    ("device", "header", "words"),
    [
        ("imu", AXES, "has no column of time; want gps_ns, gps_s, gps_week with tow_s, unix_ns, unix_s or utc"),
        ("imu", "gps_ns," + AXES.replace("z_m_s2", "z"), '"accel_z" has no unit; want accel_z_mps2, accel_z_m_s2, '),
        ("imu", "gps_ns," + AXES.replace("z_m_s2", "z_m"), '"accel_z_m" has a unit of another quantity; want accel_z_'),
        (
            "imu",
            "gps_ns,accel_x_g",
            "is no table of samples or INS solutions: missing columns such as specific_",
        ),
        ("imu", "tow_s," + AXES, '"tow_s" has no week; want a column gps_week beside it'),
        ("imu", "time," + AXES, '"time" does not say its scale; want gps_ns, gps_s'),
        ("imu", "gps_ns,temp," + AXES, '"temp" has no unit; want temp_c'),
        ("gnss", "gps_ns,lat_deg,lon_deg,altitude_m", '"altitude_m" does not say what it counts from; want height_m'),
        ("gnss", "gps_ns,lat_deg,lon_deg", "is no table of fixes: missing columns such as height_m"),
        ("gnss", "gps_ns,lat_deg,lon_deg,height_msl_m", "is no table of fixes: missing columns such as undulation_m"),
        ("gnss", "gps_ns,lat_deg,lon_deg,height_m,vn", '"vn" has no unit; want vn_mps, vn_m_s'),
        ("imu", "gps_ns,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,yaw_deg", '"yaw_deg" does not say where it counts'),
        ("gnss", "gps_ns,gps_ns,lat_deg", 'has two columns "gps_ns"; rename one'),
        ("gnss", ",,", "its first line names no columns; want a header such as gps_ns,lat_deg"),
    ],
)
def test_a_mistake_is_answered_with_the_names_that_would_be_right(
    tmp_path: Path, device: str, header: str, words: str
) -> None:
    path = write(tmp_path, f"{header}\n")
    with pytest.raises(TransportError) as refused:
        units_of(path, device)
    assert str(refused.value).startswith(f"{path}: ")
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
