"""Calibration files of a plan's scanners: true and nominal ones (CONVENTIONS)."""

from __future__ import annotations

from typing import Any

import tomlkit

from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable, Tables

CONVENTIONS_VERSION = 1
SPINNING = ("vlp16", "os1")


def mirror_factor(table: ScannerTable) -> float:
    """Return the beam angle per encoder angle: 2 for a flat mirror that swings about an axis in its plane, else 1."""
    return 2.0 if table.kind == "oscillating" else 1.0


def check_latencies(tables: Tables) -> None:
    """Refuse a true IMU latency of a scanner with `PlanError`; the latency is the IMU's own and has no effect here."""
    for name, table in tables.scanner.items():
        if table.true.imu_latency_us != 0.0:
            key = f"scanner.{name}.true.imu_latency_us"
            raise PlanError(key, "set 0 and use imu.<name>.latency_us instead, because the IMU's stamps are late")


def _imu_latency_us(tables: Tables) -> float:
    """Return the latency of the first IMU, which supplies the attitude."""
    return next((table.latency_us for table in tables.imu.values()), 0.0)


def calibration_text(plan: Plan, scanner: str, *, true: bool) -> str:
    """Return a calibration file: the true one with all errors, or the nominal one."""
    table = plan.tables.scanner[scanner]
    document: dict[str, Any] = {
        "calibration": _header(plan, scanner, table, "true" if true else "nominal"),
        "parameters": (table.true if true else table.nominal).model_dump(),
    }
    if true:
        document["parameters"]["imu_latency_us"] = _imu_latency_us(plan.tables)
        document |= _tables(table)
    return tomlkit.dumps(document)


def _header(plan: Plan, scanner: str, table: ScannerTable, which: str) -> dict[str, Any]:
    flight, air = plan.tables.flight, plan.tables.atmosphere
    return {
        "id": f"{flight.name}-{flight.seed}-{scanner}-{which}",
        "scanner": scanner,
        "created": flight.start,
        "conventions": CONVENTIONS_VERSION,
        "scanner_model": table.model,
        "scanner_serial": table.serial,
        "imu_serial": "",
        "installation": f"virtual/{flight.name}",
        "installation_matrix": table.installation,
        "mirror_factor": mirror_factor(table),
        "ranges": air.ranges,
        "refraction": air.refraction,
        "method": "nominal",
        **({"verdict": "good"} if which == "true" else {}),
        "variance_factor": 1.0,
        "redundancy": 0,
    }


def _tables(table: ScannerTable) -> dict[str, Any]:
    tables: dict[str, Any] = {
        "facet": [row.model_dump() for row in table.facet],
        "beam": [row.model_dump() for row in table.beam],
    }
    if table.ibrc is not None:
        tables["ibrc"] = table.ibrc.model_dump()
    return {name: rows for name, rows in tables.items() if rows}
