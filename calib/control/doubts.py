"""Detect errors of control as a whole: heights above the geoid, another datum, another place.

Such control would change a calibration unnoticed: all points agree with each other, but not with the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from swath.calib.control.points import ControlRules, Ground, grounds_at
from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.mapping.frame import Mapping, MappingError

Undulation = Callable[[FloatArray], tuple[float, str] | None]  # from a position in e: metres, and the geoid's name

FEWEST_POINTS = 3
FEWEST_FOR_SHIFT = 6
CONSTANT_M = 0.5  # a difference that calibration errors cannot explain
ORTHOMETRIC_M = (5.0, 110.0)  # undulations go from −107 to +86 m
FEET = 1.0 / 0.3048
OUTSIDE_M = 30.0
THINNED_TO = 20_000  # returns of a swath that represent its extent
SURE_SIGMAS = 5.0
SWATHS_APART = 0.5  # of the heights' spread; swaths farther apart show a wrong boresight
GEOIDS = ((3855, "EGM2008"), (5773, "EGM96"))
GIVE_HEIGHTS = "give heights above the ellipsoid, or the CRS of the control with its vertical part"
COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


@dataclass(frozen=True, slots=True)
class Doubt:
    """A doubt about control.

    Attributes:
        kind: ``outside``, ``orthometric``, ``ellipsoidal``, ``height``, ``shift`` of all control; ``point`` of single
            points.
        text: one line for the user.
        points: names of the points concerned.
    """

    kind: str
    text: str
    points: tuple[str, ...] = ()

    @property
    def refuses(self) -> bool:
        """True if control with this doubt must not be used for calibration."""
        return self.kind != "point"


def geoid_undulation(position_e: FloatArray) -> tuple[float, str] | None:
    """Return the geoid's name and height above the ellipsoid at a position in e (3,); None if PROJ has no grid."""
    lat, lon, height = (float(value) for value in geodetic_from_e(position_e))
    zone = int((math.degrees(lon) + 180.0) % 360.0 // 6.0) + 1
    for epsg, geoid in GEOIDS:
        try:
            frame = Mapping(f"EPSG:{32600 + zone if lat >= 0.0 else 32700 + zone}+{epsg}", accuracy_m=5.0)
            above_geoid_m = float(frame.exact(position_e[np.newaxis])[0, 2])
        except MappingError:
            continue
        return height - above_geoid_m, geoid
    return None


def doubts(
    flight: Flight,
    points: Sequence[ControlPoint],
    rules: ControlRules | None = None,
    undulation: Undulation = geoid_undulation,
) -> tuple[Doubt, ...]:
    """Return doubts about points of control; the swaths should be calibrated at least roughly.

    Args:
        flight: with its points placed.
        points: in its frame.
        rules: None: `ControlRules()`.
        undulation: of the geoid, where it is known.
    """
    rules = rules or ControlRules()
    if not points:
        return ()
    grounds, _ = grounds_at(flight, points, replace(rules, farthest_m=math.inf))
    found = _outside(flight, points, {one.point for one in grounds}, rules)
    if not grounds:
        return found
    seen = sorted({one.point for one in grounds})
    above_m = np.array([np.median([one.above_m for one in grounds if one.point == number]) for number in seen])
    if len(seen) >= FEWEST_POINTS:
        whole = _heights(flight, [points[number] for number in seen], above_m, undulation)
        whole = whole or _shift(points, grounds)
        found += whole or _single(points, seen, above_m, grounds)
    return found


def _outside(flight: Flight, points: Sequence[ControlPoint], seen: set[int], rules: ControlRules) -> tuple[Doubt, ...]:
    lost = [number for number in range(len(points)) if number not in seen]
    places = [swath.points_t[:: -(-len(swath) // THINNED_TO), :2] for swath in flight.swaths if len(swath)]
    if not lost or not places:
        return ()
    thinned = np.concatenate(places)
    tree = cKDTree(thinned[np.isfinite(thinned).all(axis=1)])
    away_m = tree.query(np.array([points[number].position_t[:2] for number in lost]))[0]
    far = [(points[number].name, float(away)) for number, away in zip(lost, away_m, strict=True) if away > OUTSIDE_M]
    if not far:
        return ()
    names = tuple(name for name, _ in far)
    nearest, least_m = min(far, key=lambda one: one[1])
    if len(far) < len(points):
        text = f"{_some(names)} outside the flight, {_length(least_m)} or more from its returns, and will not be used"
        return (Doubt("point", text, names),)
    text = (
        f"no control point lies within the flight: the nearest, {nearest}, is {_length(least_m)} from its returns; "
        "give control in the area of the flight, and the CRS of its coordinates"
    )
    return (Doubt("outside", text, names),)


def _some(names: tuple[str, ...]) -> str:
    listed = ", ".join(names[:3]) + (f" and {len(names) - 3} more points" if len(names) > 3 else "")
    return f"{listed} {'lies' if len(names) == 1 else 'lie'}"


def _length(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 1000.0 else f"{metres:.0f} m"


def _heights(
    flight: Flight, points: Sequence[ControlPoint], above_m: FloatArray, undulation: Undulation
) -> tuple[Doubt, ...]:
    """Detect a difference in height that all points share."""
    middle_m, spread_m = _middle(above_m)
    if spread_m > max(1.0, 0.05 * abs(middle_m)) or abs(middle_m) < CONSTANT_M:
        return ()
    if abs(middle_m) < SURE_SIGMAS * spread_m / math.sqrt(len(above_m)):
        return ()
    places_e = flight.frame.e_from_t(np.mean([point.position_t for point in points], axis=0))
    ground_m = float(geodetic_from_e(places_e)[2]) - middle_m
    side = "above" if middle_m > 0.0 else "below"
    what = f"control lies {abs(middle_m):.{1 if abs(middle_m) >= 10.0 else 2}f} m {side} the laser's ground everywhere"
    names = tuple(point.name for point in points)
    known = undulation(places_e)
    if known is not None and abs(known[0]) > 1.0 and abs(middle_m + known[0]) < max(1.0, 0.1 * abs(known[0])):
        text = f"{what}, as orthometric heights would lie; the undulation there is {known[0]:.1f} m ({known[1]})"
        return (Doubt("orthometric", f"{text}; {GIVE_HEIGHTS}", names),)
    if known is not None and abs(known[0]) > 1.0 and abs(middle_m - known[0]) < max(1.0, 0.1 * abs(known[0])):
        text = f"{what}, as ellipsoidal heights read as heights above the geoid would lie; the undulation there is "
        text += f"{known[0]:.1f} m ({known[1]})"
        return (Doubt("ellipsoidal", f"{text}; give the CRS of the control without its vertical part", names),)
    if ground_m > 30.0 and abs((ground_m + middle_m) / ground_m - FEET) < 0.1:
        return (Doubt("height", f"{what}, as heights in feet would lie; give metres above the ellipsoid", names),)
    if known is None and ORTHOMETRIC_M[0] <= abs(middle_m) <= ORTHOMETRIC_M[1]:
        text = f"{what}, as orthometric heights would lie where the undulation is {-middle_m:.1f} m"
        return (Doubt("orthometric", f"{text}; {GIVE_HEIGHTS}", names),)
    not_geoid = "" if known is None else f"; this is not the undulation of {known[1]}, which is {known[0]:.1f} m there"
    text = f"{what} (± {spread_m / math.sqrt(len(above_m)):.2f} m), as in another height reference or datum{not_geoid}"
    return (Doubt("height", text, names),)


def _middle(values: FloatArray) -> tuple[float, float]:
    """Return the median, and the sigma of a value from the median absolute deviation."""
    middle = float(np.median(values))
    return middle, 1.4826 * float(np.median(np.abs(values - middle)))


def _shift(points: Sequence[ControlPoint], grounds: Sequence[Ground]) -> tuple[Doubt, ...]:
    """Detect a horizontal shift of control from slopes.

    Control shifted uphill lies below the slope: Δz = c − g · shift.
    """
    numbers = sorted({one.point for one in grounds})
    if len(numbers) < FEWEST_FOR_SHIFT:
        return ()
    rows, above, apart = [], [], []
    for number in numbers:
        own = [one for one in grounds if one.point == number]
        apart += [one.above_m - own[0].above_m for one in own[1:]]
        normal = np.mean([one.plane.normal_t for one in own], axis=0)
        rows.append([normal[0] / normal[2], normal[1] / normal[2], 1.0])
        above.append(np.median([one.above_m for one in own]))
    design, heights = np.array(rows), np.array(above)
    solution, covariance = _huber(design, heights)
    shift, size = solution[:2], float(np.hypot(*solution[:2]))
    if size < CONSTANT_M:
        return ()
    along = shift / size
    sigma_m = math.sqrt(float(along @ covariance[:2, :2] @ along))
    left, before = _middle(heights - design @ solution)[1], _middle(heights)[1]
    if not size > SURE_SIGMAS * sigma_m or left > 0.7 * before:
        return ()
    if apart and np.median(np.abs(apart)) > SWATHS_APART * np.median(np.abs(heights - np.median(heights))):
        return ()  # a wrong boresight moves each swath differently; another datum moves control alone
    way = COMPASS[round(math.degrees(math.atan2(shift[0], shift[1])) / 45.0) % 8]
    text = (
        f"control lies {size:.2f} m (± {sigma_m:.2f} m) to the {way} of where the laser sees the same slopes, as "
        "positions in another datum or epoch would lie; give positions in the trajectory's datum"
    )
    return (Doubt("shift", text, tuple(points[number].name for number in numbers)),)


def _huber(design: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve least squares with Huber's weights; return unknowns and covariance.

    If the unknowns are not determined, all variances are infinite.
    """
    weights = np.ones(len(values))
    unknowns: FloatArray = np.zeros(design.shape[1])
    for _ in range(10):
        root = np.sqrt(weights)
        unknowns = np.asarray(np.linalg.lstsq(design * root[:, np.newaxis], values * root, rcond=1e-6)[0], np.float64)
        residuals = values - design @ unknowns
        sigma = max(_middle(residuals)[1], 1e-4)
        weights = np.minimum(1.0, 1.5 * sigma / np.maximum(np.abs(residuals), 1e-12))
    normal = (design * weights[:, np.newaxis]).T @ design
    if np.linalg.cond(normal) > 1e12:
        return unknowns, np.full_like(normal, np.inf)
    return unknowns, np.asarray(sigma**2 * np.linalg.inv(normal))


def _single(
    points: Sequence[ControlPoint], seen: Sequence[int], above_m: FloatArray, grounds: Sequence[Ground]
) -> tuple[Doubt, ...]:
    """Find single points that disagree with the others."""
    middle_m, spread_m = _middle(above_m)
    limit_m = max(SURE_SIGMAS * spread_m, CONSTANT_M / 2.0)
    found = []
    for number, above in zip(seen, above_m, strict=True):
        if abs(above - middle_m) > limit_m:
            swaths = sum(one.point == number for one in grounds)
            side = "above" if above > middle_m else "below"
            text = (
                f"{points[number].name} lies {abs(above - middle_m):.2f} m {side} the ground of {swaths} "
                f"swath{'s' * (swaths != 1)} on which the other points agree"
            )
            found.append(Doubt("point", text, (points[number].name,)))
    return tuple(found)
