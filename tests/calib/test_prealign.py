"""Tests coarse alignment against the truth of virtual flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.calib.flight import Flight
from swath.calib.planes.fit import PlaneSettings
from swath.calib.planes.search import find_planes
from swath.calib.prealign import NAMES, Lattice, PrealignError, PrealignSettings, _damping, prealign, surface
from swath.calib.scale import scale_of
from swath.georef.scanner.calibration import Calibration
from tests.calib.cast_flight import Cast, Line, cast_flight

pytestmark = pytest.mark.xdist_group("kernels")

LINES: tuple[Line, ...] = (
    (-200, 0, 200, 0, 850),
    (200, 60, -200, 60, 850),
    (0, 200, 0, -200, 850),
)
TERRAIN = """
height_m = 450.0
relief_m = {relief}
wavelength_m = 500.0
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [260.0, 240.0]
heading_deg = 25.0
houses = 40
[[terrain.forest]]
center_m = [130.0, 90.0]
size_m = [80.0, 60.0]
trees_per_ha = 200.0
"""
YARD = """
height_m = 450.0
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [{size}, {size}]
heading_deg = 25.0
houses = {houses}
"""
FAST = PrealignSettings(returns=40_000)
COARSE, FINE = replace(FAST, smooth_m=(48.0,)), replace(FAST, smooth_m=(24.0, 8.0))


@pytest.fixture(scope="module")
def cast() -> Cast:
    return cast_flight(TERRAIN.format(relief=8.0), LINES, prf_hz=9_000.0)


def off(cast: Cast, degrees: tuple[float, float, float], range_m: float = 0.0) -> dict[str, Calibration]:
    """Return a start that differs from the truth by the given amounts."""
    values = [*np.radians(degrees).tolist(), range_m]
    changed = {name: cast.truth.value(name) + value for name, value in zip(NAMES, values, strict=True)}
    return {"left": cast.truth.changed(**changed)}


def errors_deg(cast: Cast, found: dict[str, Calibration]) -> list[float]:
    return [float(np.degrees(found["left"].value(name) - cast.truth.value(name))) for name in NAMES[:3]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "range_m"),
    [((-3.0, 3.0, -3.0), 5.0), ((3.0, -3.0, -3.0), -5.0)],
)
def test_errors_of_three_degrees_and_five_metres_become_small(
    cast: Cast, degrees: tuple[float, float, float], range_m: float
) -> None:
    found = prealign(cast.flight, FAST, off(cast, degrees, range_m))
    assert np.abs(errors_deg(cast, found)).max() < 0.05
    assert abs(found["left"].value("range_offset_m") - cast.truth.value("range_offset_m")) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2])
def test_errors_become_small_over_flat_ground_with_houses_only(seed: int) -> None:
    flat = cast_flight(TERRAIN.format(relief=0.0), LINES, prf_hz=9_000.0, seed=seed)
    signs = np.random.default_rng(seed).choice([-3.0, 3.0], 3).tolist()
    found = prealign(flat.flight, FAST, off(flat, (signs[0], signs[1], signs[2])))
    assert np.abs(errors_deg(flat, found)).max() < 0.05


LOW: tuple[Line, ...] = ((-70, 0, 70, 0, 510), (70, 0, -70, 0, 530), (0, -70, 0, 70, 510))
LOWEST: tuple[Line, ...] = ((-45, 0, 45, 0, 470), (45, 4, -45, 4, 480), (0, -45, 0, 45, 470))
HIGH: tuple[Line, ...] = ((-900, 0, 900, 0, 3450), (900, 500, -900, 500, 3450), (0, -900, 0, 900, 3450))


@pytest.mark.parametrize(
    ("lines", "half_angle_deg", "prf_hz", "speed_mps", "size_m", "houses"),
    [
        pytest.param(LOW, 15.0, 5_000.0, 10.0, 150.0, 30, id="32 m wide from 60 m and 80 m"),
        pytest.param(LOWEST, 35.0, 5_000.0, 10.0, 90.0, 14, id="from 20 m"),
        pytest.param(HIGH, 20.0, 6_000.0, 75.0, 1000.0, 250, id="from 3,000 m", marks=pytest.mark.slow),
    ],
)
def test_strips_of_any_height_become_good_enough_for_planes(
    lines: tuple[Line, ...], half_angle_deg: float, prf_hz: float, speed_mps: float, size_m: float, houses: int
) -> None:
    """The boresight is two degrees off; the rest moves the swath's edge by less than a plane may be displaced."""
    half_angle_rad = float(np.radians(half_angle_deg))
    low = cast_flight(
        YARD.format(size=size_m, houses=houses),
        lines,
        prf_hz=prf_hz,
        half_angle_rad=half_angle_rad,
        speed_mps=speed_mps,
    )
    found = prealign(low.flight, FAST, off(low, (2.0, -2.0, 2.0)))
    roll, pitch, heading = np.radians(errors_deg(low, found))
    sizes = scale_of(low.flight)
    assert sizes is not None
    allowed_m = PlaneSettings().scaled(sizes).displacement_m
    assert np.hypot(roll, pitch) * sizes.height_m < 0.3 * allowed_m
    assert abs(heading) * 0.5 * sizes.width_m < 0.3 * allowed_m
    assert np.degrees(abs(heading)) < 1.0


@pytest.mark.slow
def test_a_long_line_is_aligned_by_the_part_that_a_short_one_crosses() -> None:
    """On a line of 2 km beside one of 60 m, samples over the whole long line would be too far apart."""
    corridor: tuple[Line, ...] = ((-1000, 0, 1000, 0, 510), (40, 5, -40, 5, 510), (0, -60, 0, 60, 510))
    flight = cast_flight(
        YARD.format(size=150.0, houses=30), corridor, prf_hz=4_000.0, half_angle_rad=np.radians(15.0), speed_mps=20.0
    )
    found = prealign(flight.flight, replace(FAST, returns=15_000), off(flight, (1.0, -1.0, 1.0)))
    roll, pitch, _ = errors_deg(flight, found)
    assert np.hypot(roll, pitch) < 0.2


@pytest.mark.slow
def test_planes_are_found_after_prealignment() -> None:
    """With 1° of error the swaths have no common planes; after alignment they have the roofs of the scene."""
    dense = cast_flight(TERRAIN.format(relief=8.0), LINES, prf_hz=16_000.0)
    start = off(dense, (1.0, -1.0, -1.0), 2.0)
    before = find_planes(dense.flight.placed(start))
    found = prealign(dense.flight, FINE, start)
    after = find_planes(dense.flight.placed(found))
    roofs = [plane for plane in after.planes if plane.kind == "roof" and len(plane.patches) == 3]
    assert len(roofs) > 30
    assert sum(plane.kind == "roof" and len(plane.patches) == 3 for plane in before.planes) < 3


@pytest.mark.slow
def test_two_heads_are_aligned_together(cast: Cast) -> None:
    """The second one flew the third line, with another mounting."""
    flight = cast.flight
    right = replace(flight.heads[0], name="right")
    swaths = (*flight.swaths[:2], replace(flight.swaths[2], head=1))
    two = Flight(flight.frame, (*flight.heads, right), flight.trajectories, swaths)
    start = {"left": off(cast, (1.0, -1.0, 1.0))["left"], "right": off(cast, (-1.0, 0.5, 1.0))["left"]}
    found = prealign(two, FINE, start)
    assert np.abs(errors_deg(cast, {"left": found["left"]})).max() < 0.1
    assert np.abs(errors_deg(cast, {"left": found["right"]})).max() < 0.1


@pytest.mark.slow
def test_control_determines_the_height(cast: Cast) -> None:
    """The range is off by 5 m; one line flown twice shows no height, but points of the true ground do."""
    flight = replace(cast.flight, swaths=cast.flight.swaths[:2])
    bare = np.isin(cast.surface[0], (1, 4)) & (np.abs(cast.true_t[0][:, 1]) < 40.0)
    control = cast.true_t[0][np.flatnonzero(bare)[:: int(bare.sum()) // 12]]
    start = off(cast, (0.0, 0.0, 0.0), 5.0)
    found = prealign(flight, FINE, start, control)
    assert abs(found["left"].value("range_offset_m") - cast.truth.value("range_offset_m")) < 0.1


def test_undetermined_parameters_stay_near_the_start() -> None:
    """One level line flown both ways does not determine heading, which must stay near its start."""
    bare = cast_flight("height_m = 450.0", LINES[:2], prf_hz=5_000.0)
    found = prealign(bare.flight, COARSE, off(bare, (2.0, 0.5, 0.5)))
    roll, pitch, heading = errors_deg(bare, found)
    assert abs(roll) < 0.02
    assert abs(pitch) < 1.0
    assert abs(heading) < 1.0


def test_a_single_strip_is_reported(cast: Cast) -> None:
    with pytest.raises(PrealignError, match="the flight has 1 swath; at least two that overlap"):
        prealign(replace(cast.flight, swaths=cast.flight.swaths[:1]), FAST)


def test_missing_overlap_is_reported() -> None:
    apart = cast_flight("height_m = 450.0", ((-1200, 0, -1000, 0, 850), (1000, 0, 1200, 0, 850)), prf_hz=3_000.0)
    with pytest.raises(PrealignError, match="do not overlap"):
        prealign(apart.flight, FAST)


def test_missing_points_are_reported(cast: Cast) -> None:
    late = tuple(replace(swath, time_ns=swath.time_ns + 10**15) for swath in cast.flight.swaths)
    with pytest.raises(PrealignError, match="no points; use a trajectory"):
        prealign(replace(cast.flight, swaths=late), FAST)


def test_a_wrong_installation_is_reported(cast: Cast) -> None:
    """Ten degrees cannot be an error of the mounting."""
    with pytest.raises(
        PrealignError, match=r"left: \w+ moved .*° from its initial value; check the installation matrix"
    ):
        prealign(cast.flight, COARSE, off(cast, (0.0, 9.0, 0.0)))


def test_a_moved_surface_equals_the_surface_of_moved_points() -> None:
    """The same surface is made of points that were moved up, aside and tilted."""
    draws = np.random.default_rng(1)
    place = draws.uniform(0.0, 200.0, (60_000, 2))

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 3.0 * np.sin(x / 25.0) + 2.0 * np.cos(y / 30.0)

    points = np.column_stack([place, height(*place.T)])
    motion = np.stack([np.tile([0.0, 0.0, 1.0], (60_000, 1)), np.tile([1.0, 0.5, 0.0], (60_000, 1))])
    lattice = Lattice(0.0, 0.0, 4.0, 50, 50)
    one = surface(lattice, points, motion, 8.0)
    for index, by in ((0, 0.5), (1, 0.5)):
        other = surface(lattice, points + by * motion[index], motion, 8.0)
        _, a, b = np.intersect1d(one.cells, other.cells, return_indices=True)
        change = other.height_m[b] - one.height_m[a]
        assert len(a) > 1000
        assert np.std(change - by * one.change[a, index]) < 0.12 * np.sqrt(np.mean(change**2))


def test_oscillating_steps_are_halved() -> None:
    """On a fine level with few edges whole steps give x → −0.9 x for ever; damped ones come to rest within five."""
    away, share, last = np.array([[0.0, 0.0, 1e-3, 0.0]]), 1.0, np.zeros((1, 4))
    for _ in range(5):
        step = -1.95 * share * away
        away, share, last = away + step, share * _damping(last, step), step
    assert np.abs(away).max() < 1e-5
    assert _damping(np.full((1, 4), 1e-3), np.full((1, 4), -1e-4)) == 1.0
