"""Paint the map of a virtual flight from its truth, for tests of the verdict before landing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from swath.daemon.log.format import SessionInfo
from swath.daemon.processing.flightplan.plan import FlightPlan
from swath.daemon.processing.landing.gaps import Painted
from swath.daemon.processing.landing.watch import Landing, Outline, Places, covered_of
from swath.daemon.processing.live.grid import CELL_DTYPE
from swath.daemon.processing.live.tiles import SIDE
from swath.georef.arrays import FloatArray, StructArray
from tests.daemon.processing.flightplan.builders import Flight, watch

CELL_M = 4.0
SUB_STEPS = 3  # between two moments, 6 m apart
INFO = SessionInfo("flight", "swath", "aircraft", "boot", 0, 0)
DIFFERENCES = {"cells": 1000, "median_m": 0.0, "mean_m": 0.0, "rms_m": 0.02}


def places_of(flight: Flight) -> Places:
    """Return a level frame at the begin of the plan's first line, by PROJ."""
    lat, lon = flight.plan.lines[0].lat_deg[0], flight.plan.lines[0].lon_deg[0]
    level = f"+proj=aeqd +lat_0={lat} +lon_0={lon} +ellps=WGS84"
    there = Transformer.from_crs("EPSG:4326", level, always_xy=True)

    def local_m(lat_lon: FloatArray) -> FloatArray:
        return np.stack(there.transform(lat_lon[:, 1], lat_lon[:, 0]), axis=-1)

    def geodetic_deg(places: FloatArray) -> FloatArray:
        lon_deg, lat_deg = there.transform(places[:, 0], places[:, 1], direction="INVERSE")
        return np.stack([lat_deg, lon_deg], axis=-1)

    return Places(local_m, geodetic_deg)


def painted(rows: StructArray, places: Places, *, tells_water: bool = False) -> Painted:
    """Return the map's cells: the returns of each moment lie evenly between the edges of its swath.

    With ``tells_water`` the scanner's pulses without a return are told, and lie likewise.
    """
    rows = rows[(rows["returns"] > 0) | ((rows["empty"] > 0) & tells_water)]
    here = places.local_m(np.degrees(np.stack([rows["lat_rad"], rows["lon_rad"]], axis=-1)))
    along = np.stack([np.sin(rows["track_rad"]), np.cos(rows["track_rad"])], axis=-1)
    right = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    ahead_m = ((np.arange(SUB_STEPS) - 1) / SUB_STEPS * rows["speed_mps"][:, np.newaxis] * 0.1)[:, :, np.newaxis]
    count = int(np.ceil((rows["right_m"] - rows["left_m"]).max() / (CELL_M / 2)))
    shares = (np.arange(count) + 0.5) / count
    across_m = rows["left_m"][:, np.newaxis] + shares * (rows["right_m"] - rows["left_m"])[:, np.newaxis]
    columns, ups = (
        np.floor(
            (
                here[:, axis, np.newaxis, np.newaxis]
                + ahead_m * along[:, axis, np.newaxis, np.newaxis]
                + across_m[:, np.newaxis] * right[:, axis, np.newaxis, np.newaxis]
            ).ravel()
            / CELL_M
        ).astype(np.int64)
        for axis in (0, 1)
    )
    west, south = columns.min() // SIDE, ups.min() // SIDE
    width, height = (int(places.max()) // SIDE + 1 - low for places, low in ((columns, west), (ups, south)))
    shape = height * SIDE, width * SIDE
    flat = (ups - south * SIDE) * shape[1] + columns - west * SIDE
    each = np.repeat(rows["returns"] / (count * SUB_STEPS), count * SUB_STEPS)
    answers = np.repeat(rows["returns"] > 0, count * SUB_STEPS)
    cells = np.zeros(shape, CELL_DTYPE)
    cells["points"] = np.bincount(flat[answers], minlength=cells.size).reshape(shape)
    cells["no_return"] = np.bincount(flat[~answers], minlength=cells.size).reshape(shape)
    cells["pulses"] = np.rint(np.bincount(flat, each, minlength=cells.size)).reshape(shape)
    found = Painted()
    found.take(
        CELL_M,
        (
            (
                (int(west + column), int(south + row)),
                cells[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE],
            )
            for row in range(height)
            for column in range(width)
        ),
    )
    return found


def with_area(plan: FlightPlan, places: Places, corners_m: FloatArray) -> FlightPlan:
    """Return a plan with an area, by corners (n, 2) in the frame of `places_of`."""
    assert places.geodetic_deg is not None
    return replace(plan, area=((places.geodetic_deg(corners_m),),))


def verdict_of(
    flight: Flight,
    rows: StructArray,
    plan: FlightPlan | None = None,
    marks: tuple[str, ...] = (),
    *,
    tells_water: bool = False,
    **follower: Any,
) -> dict[str, Any]:
    """Return the verdict on a flight whose moments are ``rows``; the log is complete and nothing else is known."""
    watched = watch(flight, rows)
    for text in marks:
        assert watched.overrule(text, 0)
    landing = Landing(INFO, Path("nowhere"), flight.config, [], {})
    landing.facts.moments(rows)
    landing.facts.has_ended = True
    places = places_of(flight)
    found = plan or flight.plan
    cells = painted(rows, places, tells_water=tells_water)
    covered = covered_of(cells, watched, Outline(found, places), places, flight.config.wanted.gap_m2)
    return landing.verdict(watched, found, "", covered, DIFFERENCES, {"part": 0} | follower)
