"""Predict what the lines flown would determine of the calibration, by the equations of `swath plan-calibration`.

The lines are those that live has seen, with its poses and their sigmas; the planes are squares of the map whose heights
lie in one plane. As in a plan, pulses on them are made, and nothing is estimated.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from swath.calib.equations.normals import NormalError
from swath.calib.equations.trajectory_prior import gauss_markov
from swath.calib.flight import FlightError, Head, Tangent
from swath.calib.parameters import ParameterError, ParameterOptions
from swath.calib.plan import Line, Scan, Surface, planned, predict
from swath.daemon.errors import UserError, one_line
from swath.daemon.log.follow import PartFollower
from swath.daemon.log.format import LogError
from swath.daemon.processing.calibration.plan.run import EXPECTED, rows_of
from swath.daemon.processing.calibration.run import PLANES
from swath.daemon.processing.landing.command import FLOWN, PREDICTED
from swath.daemon.processing.live.files import replace_file
from swath.daemon.processing.live.tiles import SIDE, Placement, TileReader, View
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.uncertainty import Noise
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

WINDOW = 3  # cells along a side of a square
LEVEL_M = 0.03  # root mean square of heights from the plane
FLAT, SLOPED, STEEPEST = math.tan(math.radians(3.0)), math.tan(math.radians(8.0)), math.tan(math.radians(60.0))
MOST_TILES, MOST_FLAT, MOST_SLOPED, MOST_STRIPS = 400, 120, 120, 40
GRADE = "tactical"  # of the inertial unit, where the trajectory has no sigmas
STATUS = "live.json"
POINTS = 5  # along a side of a square


class UnpredictableError(ValueError):
    """Raised where nothing can be predicted; one line with the reason."""


def prediction_of(live: Path, logs: Path, session_id: str) -> dict[str, Any]:
    """Return the newest prediction for what was flown, as in ``calibration.json``; make it, if there is none yet.

    It is kept beside live's files, if this user may write there. What cannot be predicted has ``why``.
    """
    try:
        found = (live / FLOWN).stat()
    except OSError:
        return {"why": "swath live writes what is needed at its end, and at the mark of the verdict"}
    sign = f"{found.st_mtime_ns:x}-{found.st_size:x}"
    with contextlib.suppress(OSError, ValueError, AttributeError):
        before = json.loads((live / PREDICTED).read_bytes())
        if before.get("sign") == sign:
            return dict(before)
    try:
        made = predict_flown(live, logs, session_id)
    except (UnpredictableError, OSError, KeyError, TypeError) as error:
        made = {"why": one_line(str(error))}
    made = {"sign": sign, "session_id": session_id} | made
    with contextlib.suppress(OSError):
        replace_file(live / PREDICTED, (json.dumps(made) + "\n").encode())
    return made


def predict_flown(live: Path, logs: Path, session_id: str) -> dict[str, Any]:
    """Return the prediction as plain values: ``strips``, ``planes``, ``rows`` as of `swath plan-calibration`.

    Args:
        live: folder of live's files.
        logs: directory with the recording's log, for the scanners' settings and calibrations.
        session_id: of the recording.

    Raises:
        UnpredictableError: something that is needed is missing.
        OSError: a file cannot be read.
    """
    with np.load(live / FLOWN) as stored:
        flown = {name: stored[name] for name in stored.files}
    setup = _setup(logs, session_id)
    heads, scans = _heads(setup, flown)
    strips = flown["strips"][-MOST_STRIPS:]
    if len(strips) < 2:
        raise UnpredictableError("fewer than two strips have been flown")
    trajectory = _trajectory(flown)
    reader = TileReader(live)
    reader.refresh()
    frame = Tangent.at(trajectory.position_e[len(trajectory.position_e) // 2])
    surfaces = list(_surfaces(reader, frame, _lift_m(live)))
    if not surfaces:
        raise UnpredictableError("the map has no squares that lie in one plane and in two strips")
    lines = [Line(f"strip {n + 1}", 0, n + 1, int(begin), int(end)) for n, (begin, end) in enumerate(strips.tolist())]
    try:
        flight, features = planned(frame, heads, scans, [trajectory], lines, surfaces, PLANES.most_points)
        predicted = predict(flight, features, ParameterOptions("scanner"), gauss_markov(flight))
    except (FlightError, ParameterError, NormalError) as error:
        raise UnpredictableError(one_line(str(error))) from error
    return {"strips": len(strips), "planes": predicted.planes, "rows": rows_of(predicted)}


def _setup(logs: Path, session_id: str) -> Setup:
    paths = sorted(logs.glob(f"{session_id}_*.mcap"))
    if not paths:
        raise UnpredictableError(f"the log {session_id} is not in {logs}")
    try:
        part = PartFollower(paths[0])
        attachments = dict(part.attachments)
        part.close()
        return Setup.of_log(attachments, Options(uncertainty=False))
    except (LogError, UserError) as error:
        raise UnpredictableError(one_line(str(error))) from error


def _heads(setup: Setup, flown: Mapping[str, Any]) -> tuple[list[Head], list[Scan]]:
    heads, scans = [], []
    for name, half_rad, rate_hz in zip(flown["scanners"].tolist(), flown["half_rad"], flown["rate_hz"], strict=True):
        model, table = setup.georeferencer(name).model, setup.config.scanner[name]
        if not isinstance(model.geometry, LineGeometry) or model.mount.stages:
            raise UnpredictableError(f"scanner {name} is no line scanner fixed to the aircraft")
        noise = Noise(
            table.range_sigma_m, math.radians(table.angle_sigma_deg), divergence_rad=1e-3 * table.divergence_mrad
        )
        start = replace(model.calibration, mirror_factor=None)  # the angles that are made are those of the beam
        heads.append(Head(name, start, LineGeometry(), noise, model.range_gate))
        scans.append(Scan(float(half_rad), float(rate_hz)))
    return heads, scans


def _trajectory(flown: Mapping[str, Any]) -> Trajectory:
    """Return the trajectory with its sigmas; those of a good inertial unit where it has none."""
    count = len(flown["time_ns"])
    position_m, tilt_deg, heading_deg = EXPECTED[GRADE]
    usual_rad = np.radians(np.tile([tilt_deg, tilt_deg, heading_deg], (count, 1)))
    position_sigma, attitude_sigma = flown["position_sigma_l"], flown["attitude_sigma_rad"]
    return Trajectory(
        flown["time_ns"],
        np.ascontiguousarray(flown["position_e"]),
        np.ascontiguousarray(flown["q_e_from_b"]),
        np.ascontiguousarray(flown["velocity_e"]),
        np.where(np.isfinite(position_sigma), position_sigma, position_m),
        np.where(np.isfinite(attitude_sigma), attitude_sigma, usual_rad),
        max_gap_ns=SECOND_NS,
        name="live",
    )


# ---------------------------------------------------------------------- planes


def _surfaces(reader: TileReader, frame: Tangent, lift_m: float) -> Iterator[Surface]:
    """Yield squares of the map in which all heights lie in one plane and two strips have points, spread over it."""
    placement = Placement.of(reader.index)
    if placement is None:
        return
    places, planes = [], []
    tiles = sorted(reader.changed())
    for tile in tiles[:: max(1, len(tiles) // MOST_TILES)]:
        view = reader.tile(tile, ("points", "height_m", "strips"))
        if view is not None:
            place, plane = _squares(view)
            places.append(place)
            planes.append(plane)
    if not places:
        return
    place_m, plane = np.concatenate(places), np.concatenate(planes)
    slope = np.hypot(plane[:, 1], plane[:, 2])

    for kind, most in ((slope < FLAT, MOST_FLAT), ((slope >= SLOPED) & (slope <= STEEPEST), MOST_SLOPED)):
        chosen = np.flatnonzero(kind)
        for at in chosen[np.unique(np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(int))].tolist():
            points_m = _spread(place_m[at], plane[at], WINDOW * reader.cell_m)
            lat, lon = np.radians(placement.geodetic(points_m[:, :2])).T
            points_t = frame.t_from_e(e_from_geodetic(lat, lon, points_m[:, 2] + lift_m))
            normal = np.array([-plane[at, 1], -plane[at, 2], 1.0])
            area_m2 = (WINDOW * reader.cell_m) ** 2
            yield Surface(f"square {at}", normal / np.linalg.norm(normal), points_t, area_m2, "ground")


def _squares(view: View) -> tuple[FloatArray, FloatArray]:
    """Return centres (n, 2) of a tile's squares that are planes, and (n, 3) their height, slope east and north."""
    count = SIDE // WINDOW
    cut = count * WINDOW

    def windows(values: Any) -> Any:
        return values[:cut, :cut].reshape(count, WINDOW, count, WINDOW).swapaxes(1, 2).reshape(-1, WINDOW, WINDOW)

    height = windows(view.layers["height_m"].astype(np.float64))
    several = (windows(view.layers["strips"]) > 1).all(axis=(1, 2)) & np.isfinite(height).all(axis=(1, 2))
    step = np.arange(WINDOW) - (WINDOW - 1) / 2
    with np.errstate(invalid="ignore"):
        middle = height.mean(axis=(1, 2))
        square_sum = WINDOW * float((step**2).sum()) * view.cell_m
        east = (height * step).sum(axis=(1, 2)) / square_sum
        north = (height * step[:, np.newaxis]).sum(axis=(1, 2)) / square_sum
        fitted = middle[:, None, None] + view.cell_m * (
            east[:, None, None] * step + north[:, None, None] * step[:, np.newaxis]
        )
        rms = np.sqrt(((height - fitted) ** 2).mean(axis=(1, 2)))
        good = np.flatnonzero(several & (rms <= LEVEL_M))
    row, column = np.divmod(good, count)
    centre = np.stack([column, row], axis=-1) * WINDOW + WINDOW / 2
    place = np.array([view.west_m, view.south_m]) + centre * view.cell_m
    return place, np.stack([middle, east, north], axis=-1)[good]


def _spread(place_m: FloatArray, plane: FloatArray, side_m: float) -> FloatArray:
    """Return points (n, 3) spread over a square: east, north, height above the map's origin."""
    step = (np.arange(POINTS) - (POINTS - 1) / 2) * side_m / POINTS
    across, up = (one.ravel() for one in np.meshgrid(step, step))
    height = plane[0] + plane[1] * across + plane[2] * up
    return np.stack([place_m[0] + across, place_m[1] + up, height], axis=-1)


def _lift_m(live: Path) -> float:
    """Return the ellipsoidal height of the map's origin, as far as a prediction needs it.

    The map's heights may count from a geoid; live's newest pose has both.
    """
    pose = json.loads((live / STATUS).read_bytes())["pose"]
    return float(pose["height_m"]) - float(pose["up_m"])
