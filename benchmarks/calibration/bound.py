"""Compute the least sigmas that a calibration of a flight can have, given its returns and its trajectory.

python -m benchmarks.calibration.bound FOLDER [--every 5]

FOLDER is a flight of `swath sim fly`, with truth. From the truth come the returns, their places and the exact planes on
which they lie. From the log comes the joint covariance of the smoothed trajectory's errors, as `swath calibrate`
uses it. The derivatives of the sensor equation are written here anew and share no code with the adjustment. Two bounds:

    planes known      direction and place of every plane are known: only ranges and trajectory are uncertain
    planes unknown    every roof face and every ground tile of 15 m is estimated too, as a calibration must do

Each bound is computed with the parameters of `--model scanner` estimated, and with those of `basic` estimated and the
others known exactly.

The random walk of the gyroscopes between knots is left out, so that an adjustment cannot quite reach the bound; an
adjustment close to it has used all information. One return in `--every` is read and counts that many times.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.daemon.processing.calibration.returns import read_flight
from swath.daemon.processing.calibration.run import prior_of
from swath.daemon.processing.flights.read import GeorefOptions as Logs
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.scanner.uncertainty import Noise
from swath.sim.shots import GROUND, MARKING, ROAD, ROOF
from swath.sim.site import e_from_geodetic, rot_e_from_ned

MODELS = {"basic": 4, "scanner": 8}
NAMES = ("omega", "phi", "kappa", "range offset", "range scale", "scan angle scale", "scan plane tilt", "time offset")
UNITS = ("°", "°", "°", "m", "ppm", "ppm", "°", "µs")
FACTORS = np.array([180 / np.pi] * 3 + [1.0, 1e6, 1e6, 180 / np.pi, 1e6])
NEIGHBOURS, PLANE_M = 7, 0.003  # neighbours that define a return's plane, and their largest distance from it
TILE_M = 15.0
LEAST_RETURNS = 3
SECOND_NS = 1e9
TRACK = ("gps_ns", "lat_rad", "lon_rad", "height_m", "velocity_l", "roll_rad", "pitch_rad", "heading_rad")
STEEPEST = np.cos(np.radians(65.0))
LEAST_WIDTH_M2 = 1e-4  # least variance across the neighbours' longest axis; below it they form a line
FOOTPRINT_SIGMA = 0.25  # as a share of the full width, which is two sigmas to each side


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of the truth that lie on planes.

    Attributes:
        time_ns: (n,) GPS time.
        strip: (n,) number of the strip.
        design: (n, 8) derivatives of the distance from the plane with respect to the parameters, SI.
        normal_l: (n, 3) normal of the plane: north, east, down.
        lever_l: (n, 3) vector from the body to the point: north, east, down, metres.
        variance: (n,) variance of the distance due to range, angle and footprint, m².
        face: (n,) number of the plane.
        place: (n, 3) two coordinates in the plane, metres, and 1.
    """

    time_ns: Int64Array
    strip: Int64Array
    design: FloatArray
    normal_l: FloatArray
    lever_l: FloatArray
    variance: FloatArray
    face: Int64Array
    place: FloatArray


def returns_of(folder: Path, head: str, noise: Noise, every: int) -> Returns:
    """Read one return in `every` of those that lie on a plane of the truth."""
    with np.load(folder / "truth.npz") as truth:
        strip, surface = truth[f"{head}.strip"], truth[f"{head}.surface"]
        there = np.flatnonzero((strip >= 0) & np.isin(surface, (GROUND, ROAD, MARKING, ROOF)))
        point_e, time_ns = truth[f"{head}.point_e"][there], truth[f"{head}.gps_ns"][there]
        strip, roof = strip[there].astype(np.int64), surface[there] == ROOF
        track = {name: truth[f"trajectory.{name}"] for name in TRACK}
    origin = point_e[len(point_e) // 2]
    mean = int(np.searchsorted(track["gps_ns"], time_ns[0]))
    rot_l_from_e = rot_e_from_ned(track["lat_rad"][mean : mean + 1], track["lon_rad"][mean : mean + 1])[0].T
    point_l = (point_e - origin) @ rot_l_from_e.T
    taken, normal = planes_at(point_l, strip, roof, every)
    at = np.clip(np.searchsorted(track["gps_ns"], time_ns[taken]), 1, len(track["gps_ns"]) - 1)
    share = (time_ns[taken] - track["gps_ns"][at - 1]) / (track["gps_ns"][at] - track["gps_ns"][at - 1])

    def along(values: FloatArray) -> FloatArray:
        s = share.reshape(-1, *[1] * (values.ndim - 1))
        mixed: FloatArray = (1.0 - s) * values[at - 1] + s * values[at]
        return mixed

    body_e = along(np.asarray(e_from_geodetic(track["lat_rad"], track["lon_rad"], track["height_m"])))
    lever = point_l[taken] - (body_e - origin) @ rot_l_from_e.T
    turns = np.stack([np.unwrap(track[name]) for name in ("heading_rad", "pitch_rad", "roll_rad")], axis=1)
    before, after = turns[at - 1], turns[at]
    rot_l_from_b = Rotation.from_euler("ZYX", along(turns)).as_matrix()
    turned = (Rotation.from_euler("ZYX", after) * Rotation.from_euler("ZYX", before).inv()).as_rotvec()
    rate = turned / ((track["gps_ns"][at] - track["gps_ns"][at - 1]) / SECOND_NS)[:, np.newaxis]
    velocity = along(track["velocity_l"]) + np.cross(rate, lever)
    design, variance = equations(normal, lever, rot_l_from_b, velocity, noise)
    face, place = faces(point_l[taken], normal, roof[taken])
    return Returns(time_ns[taken], strip[taken], design, normal, lever, variance, face, place)


def planes_at(point_l: FloatArray, strip: Int64Array, roof: BoolArray, every: int) -> tuple[Int64Array, FloatArray]:
    """Return indexes (n,) of returns that lie on one plane with their neighbours, and upward normals (n, 3)."""
    taken, normals = [], []
    for number in np.unique(strip):
        for kind in (False, True):
            mine = np.flatnonzero((strip == number) & (roof == kind))
            if len(mine) < NEIGHBOURS * every:
                continue
            asked = mine[::every]
            _, near = cKDTree(point_l[mine]).query(point_l[asked], NEIGHBOURS)
            around = point_l[mine][near]
            off = around - around.mean(axis=1, keepdims=True)
            variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
            normal = axes[:, :, 0] * -np.sign(axes[:, 2:3, 0])  # z is down, so an upward normal has z < 0
            good = np.abs(np.einsum("nki,ni->nk", off, normal)).max(axis=1) < PLANE_M
            good &= (-normal[:, 2] > STEEPEST) & (variances[:, 1] > LEAST_WIDTH_M2)
            taken.append(asked[good])
            normals.append(normal[good])
    return np.concatenate(taken), np.concatenate(normals)


def equations(
    normal: FloatArray, lever: FloatArray, rot_l_from_b: FloatArray, velocity: FloatArray, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (n, 8) of the distance along the normal, and its variance (n,), in m².

    Sensor and body axes are taken to be the same. For a spinning head only the first four columns and the last
    are valid.

    Args:
        normal: (n, 3) normals of the planes: north, east, down.
        lever: (n, 3) vectors from the body to the points: north, east, down, metres.
        rot_l_from_b: (n, 3, 3).
        velocity: (n, 3) velocity of the point as part of the moving body, metres a second.
        noise: noise of the scanner.
    """
    lever_b = np.einsum("nji,nj->ni", rot_l_from_b, lever)
    normal_b = np.einsum("nji,nj->ni", rot_l_from_b, normal)
    range_m = np.linalg.norm(lever_b, axis=1, keepdims=True)
    beam_b = lever_b / range_m
    turned = np.cross(lever_b, normal_b)  # n · (e × x) = e · (x × n)
    angle = -np.arctan2(beam_b[:, 1], beam_b[:, 2])  # about x, measured from down
    cosine = (beam_b * normal_b).sum(axis=1)
    columns = [*turned.T, cosine, cosine * range_m[:, 0], angle * turned[:, 0], normal_b[:, 0] * range_m[:, 0]]
    design = np.stack([*columns, (normal * velocity).sum(axis=1)], axis=1)
    sine = np.sqrt(1.0 - np.minimum(cosine**2, 1.0))
    aside = range_m[:, 0] * np.hypot(
        noise.angle_rad * turned[:, 0] / range_m[:, 0], FOOTPRINT_SIGMA * noise.divergence_rad * sine
    )
    return design, (noise.range_m * cosine) ** 2 + aside**2


def faces(point_l: FloatArray, normal: FloatArray, roof: BoolArray) -> tuple[Int64Array, FloatArray]:
    """Return numbers (n,) of planes, by direction, place and tile of 15 m, and places (n, 3) in them."""
    distance = (normal * point_l).sum(axis=1)
    tile = np.floor(point_l[:, :2] / TILE_M)
    key = np.column_stack([tile, np.where(roof, 1, 0), np.where(roof[:, np.newaxis], np.rint(normal * 40.0), 0.0)])
    key = np.column_stack([key, np.where(roof, np.rint(distance / 0.5), 0.0)])
    _, face = np.unique(key, axis=0, return_inverse=True)
    middle = np.stack([np.bincount(face, axis) for axis in point_l[:, :2].T], axis=1) / np.bincount(face)[:, np.newaxis]
    return face.ravel(), np.column_stack([point_l[:, :2] - middle[face.ravel()], np.ones(len(face))])


def bound(returns: Returns, prior: TrajectoryPrior, parameters: int, every: int, *, known: bool) -> FloatArray:
    """Return the least sigmas (p,) of the parameters, SI."""
    size = parameters + 6 * len(prior)
    normal = np.zeros((size, size))
    normal[parameters:, parameters:] = prior.information
    order = np.argsort(returns.face, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(returns.face[order])) + 1):
        if len(rows) * every < LEAST_RETURNS or len(np.unique(returns.strip[rows])) < (1 if known else 2):
            continue
        columns, table = states(returns, rows, prior, parameters)
        weight = every / returns.variance[rows, np.newaxis]
        block = table.T @ (weight * table)
        if not known:
            place = returns.place[rows]
            own, mixed = place.T @ (weight * place), table.T @ (weight * place)
            block -= mixed @ np.linalg.solve(own + 1e-6 * np.eye(3), mixed.T)
        normal[np.ix_(columns, columns)] += block
    sigmas: FloatArray = np.sqrt(np.diag(np.linalg.inv(normal))[:parameters])
    return sigmas


def states(
    returns: Returns, rows: Int64Array, prior: TrajectoryPrior, parameters: int
) -> tuple[Int64Array, FloatArray]:
    """Return the unknowns (m,) that affect returns of one plane, and their design matrix (n, m).

    The unknowns are the parameters, followed by the trajectory's errors at knots.
    """
    after = np.clip(np.searchsorted(prior.time_ns, returns.time_ns[rows]), 1, len(prior) - 1)
    share = (returns.time_ns[rows] - prior.time_ns[after - 1]) / (prior.time_ns[after] - prior.time_ns[after - 1])
    share = np.clip(share, 0.0, 1.0)[:, np.newaxis]
    normal = returns.normal_l[rows]
    each = np.concatenate([normal, np.cross(returns.lever_l[rows], normal)], axis=1)
    knots, of = np.unique(np.concatenate([after - 1, after]), return_inverse=True)
    table = np.zeros((len(rows), len(knots), 6))
    at = np.arange(len(rows))
    table[at, of[: len(rows)]] += (1.0 - share) * each
    table[at, of[len(rows) :]] += share * each
    columns = (parameters + 6 * knots[:, np.newaxis] + np.arange(6)).ravel()
    design = np.concatenate([returns.design[rows, :parameters], table.reshape(len(rows), -1)], axis=1)
    return np.concatenate([np.arange(parameters), columns]), design


def bounds(folder: Path, every: int, tell: Callable[[str], None] = print) -> dict[tuple[str, bool], FloatArray]:
    """Return the sigmas, in the units of `UNITS`, by model and by whether planes are known."""
    options = Options(datum="same", uncertainty=False)
    with tempfile.TemporaryDirectory(prefix="swath-bound-") as work:
        georef_options = Logs([folder], Path(work), TrajectoryOptions(navigate=True), options)
        kept = read_flight(georef_options, Path(work), lambda *_: None)
        (head,) = kept.flight.heads
        prior = prior_of(kept)
    returns = returns_of(folder, head.name, head.noise, every)
    tell(f"about {len(returns.face) * every:,} returns on {int(returns.face.max()) + 1:,} planes, {len(prior)} knots")
    return {
        (model, known): FACTORS[:count] * bound(returns, prior, count, every, known=known)
        for model, count in MODELS.items()
        for known in (True, False)
    }


def main() -> None:
    """Compute and print the bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="flight of one scanner, made by swath sim fly")
    parser.add_argument("--every", type=int, default=5, help="use one return in so many")
    arguments = parser.parse_args()
    found = bounds(arguments.folder, arguments.every)
    heads = [f"{model}, planes {'known' if known else 'unknown'}" for model, known in found]
    print(f"{'':<18}" + "".join(f"{head:>24}" for head in heads))
    for number, name in enumerate(NAMES):
        cells = (f"{sigmas[number]:.5f} {UNITS[number]}" if number < len(sigmas) else "" for sigmas in found.values())
        print(f"{name:<18}" + "".join(f"{cell:>24}" for cell in cells))


if __name__ == "__main__":
    main()
