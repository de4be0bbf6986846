"""The files beside a flight's log: its recording configuration, calibrations, control points and a README."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
import tomlkit

from swath.georef.arrays import FloatArray
from swath.sim.clocks import generator
from swath.sim.gnss.wire import config_table as gnss_config
from swath.sim.imu.wire import config_table as imu_config
from swath.sim.imu.wire import dbc_text
from swath.sim.plan.plan import Plan
from swath.sim.preview.coverage import control_points
from swath.sim.scanners.calibration_files import calibration_text
from swath.sim.scanners.ouster_wire import config_table as ouster_config
from swath.sim.scanners.ouster_wire import os1_metadata
from swath.sim.scanners.rosette import config_table as rosette_config
from swath.sim.scanners.srep_wire import config_table as srep_config
from swath.sim.scanners.velodyne_wire import config_table as velodyne_config
from swath.sim.scene.scene import Scene
from swath.sim.site import Site, geodetic_from_e

FIRST_UDP_PORT = 2368
FIRST_POSITION_PORT = 8308
PLAN_NAME = "plan.toml"  # the configuration names it, so that live judges the lines by it
README = """# A flight of the virtual aircraft: {name}

`swath sim fly` made this flight from the plan in `plan.toml` with seed {seed}. It starts at {start}; GPS − UTC is
{leap_seconds} s.

| file | what |
|---|---|
| `*.mcap` | the log, in the form that the recorder writes |
| `swath.toml` | the configuration that records this flight; a copy is in the log |
{calibrations}
| `control.csv` | surveyed ground control: {control} points, σ {sigma_m} m in each coordinate, ellipsoidal heights |
| `truth.npz` | the true values, described below |

`truth.npz` (read it with `numpy.load`) has one array for each column:

- `trajectory.*`: the body's true poses at the IMU's rate: `gps_ns` (since 1980-01-06, continuous), `lat_rad`,
  `lon_rad`, `height_m` (ellipsoidal), `velocity_l` (north, east, down), `roll_rad`, `pitch_rad`, `heading_rad`, `strip`
- `<scanner>.*`: one row for each return, in the order of the returns in the scanner's packets, including packets that
  a fault kept from the log: `gps_ns` and `pulse` of the emission, `point_e` (ECEF, the echo on the beam's axis),
  `range_m`, `incidence_rad`, `strip` (index of the flight line, −1 between lines), `channel` (facet or beam),
  `return_number`, `surface` (index into `surfaces`)
- `surfaces`, `lines`: names; `control_e`: the true positions of the control points
- `imu.<name>.*`: the errors that were drawn for each IMU
"""


def default_wires(plan: Plan) -> dict[str, str]:
    """Return the transport URI of each source and the device of each PPS, as wired on an aircraft's computer."""
    tables = plan.tables
    wires = {f"pps/{name}": f"/dev/pps{number}" for number, name in enumerate(tables.pps)}
    for number, (name, gnss) in enumerate(tables.gnss.items()):
        wires[f"gnss/{name}"] = f"serial:/dev/ttyUSB{number}?baud={gnss.baud}"
    for number, name in enumerate(tables.imu):
        wires[f"imu/{name}"] = f"can:socketcan:can{number}?bitrate=1000000"
    for number, (name, scanner) in enumerate(tables.scanner.items()):
        wires[f"scanner/{name}"] = f"udp:0.0.0.0:{FIRST_UDP_PORT + number}"
        if scanner.kind == "vlp16":
            wires[f"scanner/{name}/aux"] = f"udp:0.0.0.0:{FIRST_POSITION_PORT + number}"
    return wires


def config_text(plan: Plan, wires: dict[str, str], directory: str) -> str:
    """Return the configuration that records a flight (CONFIG).

    Args:
        plan: of the flight.
        wires: transport URI of each source, and the source of each PPS; see `default_wires`.
        directory: directory for logs.
    """
    tables = plan.tables
    document: dict[str, Any] = {
        "session": {"name": tables.flight.name, "directory": directory},
        "pps": {name: {"source": wires[f"pps/{name}"]} for name in tables.pps},
        "gnss": {name: gnss_config(table, name, wires[f"gnss/{name}"]) for name, table in tables.gnss.items()},
        "imu": {name: imu_config(table, name, wires[f"imu/{name}"]) for name, table in tables.imu.items()},
        "scanner": {name: _scanner_config(plan, name, wires) for name in tables.scanner},
        "atmosphere": tables.atmosphere.model_dump(exclude={"visibility_km"}),
        "plan": {"file": PLAN_NAME},
        "profile": {"aircraft": "virtual", "installation": f"virtual/{tables.flight.name}"},
        "output": {"crs": tables.flight.crs},
    }
    return tomlkit.dumps(document)


def companion_files(plan: Plan, site: Site, scene: Scene) -> dict[str, bytes]:
    """Return the small files beside the log by name, without the configuration.

    They are DBC files, calibrations, head tables, control points, the plan and the README.
    """
    tables = plan.tables
    files = {f"{name}.dbc": dbc_text(table) for name, table in tables.imu.items()}
    for name in tables.scanner:
        files[f"{name}.nominal.toml"] = calibration_text(plan, name, true=False)
        files[f"{name}.true.toml"] = calibration_text(plan, name, true=True)
    files["control.csv"] = control_text(plan, control_points_e(plan, site, scene))
    files[PLAN_NAME] = plan.text
    files["README.md"] = _readme(plan)
    content = {name: text.encode() for name, text in files.items()}
    return content | {
        f"{name}.json": os1_metadata(table) for name, table in tables.scanner.items() if table.kind == "os1"
    }


def control_points_e(plan: Plan, site: Site, scene: Scene) -> FloatArray:
    """Return (k, 3) true ECEF coordinates of the control points."""
    return site.e_from_site(control_points(plan, scene))


def control_text(plan: Plan, points_e: FloatArray) -> str:
    """Return the control points with their survey's errors, as the CSV that CONVENTIONS defines."""
    sigma_m = plan.tables.control.sigma_m
    draws = generator(plan.tables.flight.seed, "control").standard_normal(points_e.shape)
    lat_rad, lon_rad, height_m = geodetic_from_e(points_e + sigma_m * draws)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["name", "lat_deg", "lon_deg", "h_ellipsoidal_m", "sigma_m"])
    for number, (lat, lon, height) in enumerate(zip(np.degrees(lat_rad), np.degrees(lon_rad), height_m, strict=True)):
        rows.writerow([f"GCP{number + 1:02d}", f"{lat:.10f}", f"{lon:.10f}", f"{height:.4f}", f"{sigma_m:g}"])
    return text.getvalue()


def _scanner_config(plan: Plan, name: str, wires: dict[str, str]) -> dict[str, Any]:
    table = plan.tables.scanner[name]
    source = f"scanner/{name}"
    if table.kind == "vlp16":
        config = velodyne_config(table, name, wires[source], wires[f"{source}/aux"])
    elif table.kind == "rosette":
        config = rosette_config(table, wires[source])
    elif table.kind == "os1":
        config = ouster_config(table, name, wires[source])
    else:
        config = srep_config(table, name, wires[source])
    return config | {"calibration": f"{name}.nominal.toml"}


def _readme(plan: Plan) -> str:
    tables = plan.tables
    calibrations = "\n".join(
        f"| `{name}.nominal.toml`, `{name}.true.toml` | calibration of {name}: the nominal one and the true one |"
        for name in tables.scanner
    )
    return README.format(
        name=tables.flight.name,
        seed=tables.flight.seed,
        start=tables.flight.start.isoformat(),
        leap_seconds=plan.leap_seconds,
        calibrations=calibrations,
        control=tables.control.points,
        sigma_m=tables.control.sigma_m,
    )
