"""The matrices of a calibration's computation (ISO/TS 19159-2, CA_LidarCalComputation), as at the solution.

Rows are the observations on planes in the order of the residuals; planes count in the order of the features.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted, Residuals
from swath.calib.record.values import Matrix
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import geodetic_from_e, prime_vertical_radius_m, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion
from swath.georef.records import Int64Array
from swath.georef.scanner.jacobian import observation_columns_e, parameter_columns_e

MOST_ROWS = 200_000  # observations whose rows are kept; of more, every k-th
BLOCK = 1 << 15
COLUMNS = {  # of each return: name → columns
    "designMatrix1": 16,
    "designMatrix2": 4,
    "designMatrixObservations": 8,
    "residuals": 8,
    "misclosure": 1,
    "lidarObjectPoint": 3,
    "thetaTarget": 1,
    "rhoTarget": 1,
    "attitudeBodyLocal": 3,
    "phiLocal": 1,
    "lambdaLocal": 1,
    "ellipsoidalHeight": 1,
    "nRadius": 1,
}


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations of one scanner on planes (n,): plane, swath, return, residual, sigma."""

    plane: Int64Array
    swath: Int64Array
    at: Int64Array
    misclosure_m: FloatArray
    sigma_m: FloatArray
    every: int
    count: int


def observed_of(flight: Flight, adjusted: Adjusted, scanner: str) -> Observed | None:
    """Those that were kept; None: there is none on planes."""
    tables: list[Residuals] = [group for group in adjusted.residuals if group.group == "planes"]
    heads = [flight.heads[swath.head].name == scanner for swath in flight.swaths]
    if not tables:
        return None
    table = tables[0]
    mine = np.flatnonzero((table.weight > 0.0) & (table.swath >= 0) & np.array([*heads, False])[table.swath])
    if not len(mine):
        return None
    every = -(-len(mine) // MOST_ROWS)
    kept = mine[::every]
    columns = (table.feature[kept], table.swath[kept], table.at[kept], table.misclosure_m[kept], table.sigma_m[kept])
    return Observed(*columns, every=every, count=len(mine))


def matrices_of(flight: Flight, features: Features, adjusted: Adjusted, scanner: str) -> dict[str, Matrix]:
    """By attribute; nothing where there are no observations on planes.

    designMatrix1 (n, 16): nᵀ ∂x/∂parameter in the order of `swath.georef.scanner.calibration.PARAMETERS`, SI.
    designMatrix2 (n, 4): ((x − c)ᵀ, 1), c the plane's centre, in e. designMatrixObservations (n, 8): nᵀ ∂x/∂observable
    in the order of `swath.georef.scanner.jacobian.OBSERVATIONS`. residuals (n, 8): v = Σ Bᵀ e / M (FORMULAS 6.3) of
    range and scan angle; the trajectory's are zero here, for its errors are unknowns of their own.
    designMatrixUnitLength (planes, 4): (2 s1, 2 s2, 2 s3, 0). lidarPlaneParameters (planes, 4): unit normal in e, s4 =
    −n · c.
    """
    found: dict[str, Matrix] = {}
    if features.planes:
        normals_e = np.array([plane.normal_t for plane in features.planes]) @ flight.frame.rot_t_from_e
        centres_e = flight.frame.e_from_t(np.array([plane.centre_t for plane in features.planes]))
        distance = -np.einsum("ij,ij->i", normals_e, centres_e)
        found["lidarPlaneParameters"] = Matrix.of(np.column_stack([normals_e, distance]))
        found["designMatrixUnitLength"] = Matrix.of(np.column_stack([2.0 * normals_e, np.zeros(len(distance))]))
    observed = observed_of(flight, adjusted, scanner)
    if observed is None:
        return found
    columns = {name: np.full((len(observed.at), width), np.nan) for name, width in COLUMNS.items()}
    for swath in np.unique(observed.swath).tolist():
        rows = np.flatnonzero(observed.swath == swath)
        for first in range(0, len(rows), BLOCK):
            block = rows[first : first + BLOCK]
            for name, values in _block(flight, features, adjusted, observed, swath, block).items():
                columns[name][block] = values.reshape(len(block), -1)
    return found | {name: Matrix(table, observed.count, observed.every) for name, table in columns.items()}


def _block(
    flight: Flight, features: Features, adjusted: Adjusted, observed: Observed, index: int, block: Int64Array
) -> Mapping[str, FloatArray]:
    swath = flight.swaths[index]
    head, trajectory = flight.heads[swath.head], flight.trajectories[swath.flown]
    calibration = adjusted.calibrations[head.name]
    model = head.model(calibration)
    rays = flight.rays(swath, calibration, observed.at[block])
    planes = [features.planes[plane] for plane in observed.plane[block].tolist()]
    normals_e = np.array([plane.normal_t for plane in planes]) @ flight.frame.rot_t_from_e
    centres_e = flight.frame.e_from_t(np.array([plane.centre_t for plane in planes]))
    by_observation = np.einsum("nkc,nc->nk", observation_columns_e(rays, model, trajectory), normals_e)
    residual_m, variance = observed.misclosure_m[block], observed.sigma_m[block] ** 2
    sigma2 = np.array([0.0] * 6 + [head.noise.range_m**2, head.noise.angle_rad**2])
    rot_e_b = rot_from_quaternion(_there(rays.q_e_from_b))
    lat, lon, height = geodetic_from_e(rays.points_e - np.einsum("nij,nj->ni", rot_e_b, _there(rays.arm_b)))
    attitude = attitude_of(np.swapaxes(rot_e_from_l(lat, lon), 1, 2) @ rot_e_b)
    return {
        "designMatrix1": np.einsum("nkc,nc->nk", parameter_columns_e(rays, model, trajectory), normals_e),
        "designMatrix2": np.column_stack([rays.points_e - centres_e, np.ones(len(block))]),
        "designMatrixObservations": by_observation,
        "residuals": sigma2 * by_observation * (residual_m / variance)[:, np.newaxis],
        "misclosure": -residual_m,
        "lidarObjectPoint": rays.points_e,
        "thetaTarget": rays.angle_rad,
        "rhoTarget": rays.range_m,
        "attitudeBodyLocal": np.column_stack(attitude),
        "phiLocal": lat,
        "lambdaLocal": lon,
        "ellipsoidalHeight": height,
        "nRadius": prime_vertical_radius_m(lat),
    }


def _there(column: FloatArray | None) -> FloatArray:
    """What rays with axes have."""
    assert column is not None
    return column
