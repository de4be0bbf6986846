"""Collects facts for a calibration's record: from the user's file, and from the configuration and navigation of
instruments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from swath.calib.record.record import RecordError, told_value
from swath.calib.record.values import Plain, Value
from swath.daemon.errors import UserError
from swath.daemon.processing.calibration.returns import KeptFlight
from swath.daemon.processing.navigation.navigate import Navigated
from swath.daemon.processing.trajectory.series import used_positions
from swath.daemon.text_files import text_of
from swath.georef.timescales import SECOND_NS
from swath.georef.toml_tables import TomlError, key_text, toml_tables


def facts_of(file: Path) -> dict[str, Plain]:
    """Return the facts that a user gives about a calibration, by ``CLASS.attribute``: one table per class, as
    ``[CA_GNSS] numberSatellites``.

    Raises:
        UserError: the file is not such a file, or an entry is not an attribute or not a value that it takes.
    """
    try:
        tables = toml_tables(text_of(file, "a TOML file"))
    except TomlError as error:
        raise UserError(f"{file}: {error}") from error
    facts: dict[str, Plain] = {}
    for owner, table in tables.items():
        if not isinstance(table, dict):
            raise UserError(
                f"{file}: {key_text(owner)}: give each class a table, such as [CA_GNSS] with numberSatellites = 14"
            )
        for name, value in table.items():
            key = f"{owner}.{name}"
            facts[key] = tuple(value) if isinstance(value, list) else value
            try:
                told_value(key, facts[key])
            except RecordError as error:
                raise UserError(f"{file}: {error}") from error
    return facts


def instruments_of(kept: KeptFlight) -> dict[str, Value]:
    """Return facts about the instruments, by ``CLASS.attribute``; empty if the trajectory was not navigated here.

    The first of several sessions stands for all: they are of one installation. ISO/TS 19159-1 types intervals as
    DateTime: they are given as durations of ISO 8601.
    """
    navigated = kept.logged[0].navigated
    if navigated is None:
        return {}
    sources = navigated.inputs.sources
    arm_b = tuple(navigated.inputs.setup.lever_arms_b[0].tolist())
    note = f"antenna of gnss.{sources.gnss_name} from the IMU: forward, right, down"
    found = {
        "CA_IMU.dataRate": Value(_duration(1.0 / sources.imu.rate_hz), "", f"of imu.{sources.imu_name}, nominal"),
        "CA_AuxiliaryDevice.leverarm": Value(arm_b, "m", note),
    }
    return found | _receiver(navigated)


def _receiver(navigated: Navigated) -> dict[str, Value]:
    used = [used_positions(leg.solved.forward) for leg in navigated.legs]
    satellites = np.concatenate([rows["satellites"][rows["satellites"] > 0] for rows in used] or [np.zeros(0)])
    apart_ns = np.concatenate([np.diff(rows["time_ns"]) for rows in used] or [np.zeros(0)])
    found = {}
    if len(satellites):
        found["CA_GNSS.numberSatellites"] = Value(int(np.median(satellites)), "", "median of the positions used")
    if len(apart_ns):
        cycle_s = float(np.median(apart_ns)) / SECOND_NS
        found["CA_GNSS.registrationCycle"] = Value(_duration(cycle_s), "", "median of the positions used")
    return found


def _duration(seconds: float) -> str:
    return f"PT{seconds:.6g}S"
