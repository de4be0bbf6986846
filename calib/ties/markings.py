"""Find tie points from intensity: road markings and other patterns on flat ground, in every swath.

Ground is cut into squares. Where a square is flat, and its pattern strong, in two swaths or more, the intensities of
each swath become a smooth image, and the image of the swath with the densest returns is located in the others' by
normalised cross-correlation (Lewis 1995). The peak, interpolated between cells, is the shift; its curvature, and the
part of the images that the correlation leaves unexplained, give the covariance. Heights come from the plane of each
swath's own returns.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.signal import fftconvolve

from swath.calib.features import Features, Sighting, TiePoint
from swath.calib.flight import Flight, Swath
from swath.georef.arrays import FloatArray, Int64Array

CHUNK = 1_000_000
LEAST_RMS_M = 0.002

THIN = 0.05  # smoothed returns per cell, as a share of their mean; an image with fewer has a hole

BACK = 13.8  # χ²(2), 0.999: limit of the difference between a shift and its reverse


@dataclass(frozen=True, slots=True)
class MarkingSettings:
    """Limits and sizes of the search for markings.

    Attributes:
        square_m: side of a square of ground.
        cell_m: of the images; `smooth_m`: their smoothing (one sigma); grows where returns are sparse.
        search_m: greatest shift between swaths.
        least_density: returns per square metre.
        rms_m, flat_slope: greatest scatter about the square's plane, and its slope.
        least_contrast: standard deviation of intensities in a square, as a share of their mean.
        least_correlation: of the peak.
        unique: by how much the peak has to exceed the correlation of any place away from it.
        greatest_sigma_m: of a shift in any direction: lines alone do not fix the shift along themselves.
        most: greatest number of squares, the strongest patterns first.
    """

    square_m: float = 12.0
    cell_m: float = 0.25
    smooth_m: float = 0.4
    search_m: float = 3.0
    least_density: float = 4.0
    rms_m: float = 0.06
    flat_slope: float = 0.15
    least_contrast: float = 0.12
    least_correlation: float = 0.6
    unique: float = 0.1
    greatest_sigma_m: float = 0.15
    most: int = 300


_DEFAULT = MarkingSettings()


@dataclass(frozen=True, eq=False)
class Image:
    """Intensities of one swath in and around a square.

    Attributes:
        value: (rows, columns), rows to the north, columns to the east; the middle is that of the square.
        smooth_m: of their smoothing, one sigma.
        whole: whether there are no holes.
    """

    value: FloatArray
    smooth_m: float
    whole: bool


@dataclass(frozen=True, eq=False)
class Shift:
    """The place of an image in another one: east and north (2,), covariance (2, 2) m², correlation."""

    shift_m: FloatArray
    covariance: FloatArray
    correlation: float


def find_markings(flight: Flight, settings: MarkingSettings = _DEFAULT) -> Features:
    """Find tie points of kind ``marking`` on flat ground; squares without one are counted by reason.

    Args:
        flight: with points, whose swaths coincide within ``search_m``.
        settings: limits and sizes.
    """
    refused: Counter[str] = Counter()
    grid = grid_of(flight, settings.square_m)
    if grid is None:
        return Features()
    squares: dict[int, dict[int, Square]] = {}
    for index, swath in enumerate(flight.swaths):
        for square in squares_of(swath, grid, settings.least_density):
            if not (square.rms_m <= settings.rms_m and square.slope <= settings.flat_slope):
                refused["marking: the ground is not flat"] += 1
            else:
                squares.setdefault(square.number, {})[index] = square
    shared = {number: seen for number, seen in squares.items() if len(seen) > 1}
    strong = {n: min(one.contrast for one in seen.values()) for n, seen in shared.items()}
    kept = [number for number in shared if strong[number] >= settings.least_contrast]
    refused["marking: too little contrast"] += len(shared) - len(kept)
    kept = sorted(kept, key=lambda number: (-strong[number], number))[: settings.most]
    around = [near(swath, grid, [n for n in kept if index in shared[n]]) for index, swath in enumerate(flight.swaths)]
    ties = []
    for number in sorted(kept):
        returns = {index: around[index][number] for index in shared[number]}
        tie = _tie(flight, grid, number, shared[number], returns, settings, refused)
        if tie is not None:
            ties.append(tie)
    return Features(ties=tuple(ties), refused=+refused)


def _tie(
    flight: Flight,
    grid: Grid,
    number: int,
    seen: dict[int, Square],
    returns: dict[int, Int64Array],
    settings: MarkingSettings,
    refused: Counter[str],
) -> TiePoint | None:
    """Build the tie point of a square: its centre in the best swath, and the matching places in the others."""
    centre = grid.centre(number)
    smooth_m = max(settings.smooth_m, *(0.8 / np.sqrt(square.density) for square in seen.values()))
    images = {i: _image(flight.swaths[i], returns[i], seen[i], centre, float(smooth_m), settings) for i in seen}
    best = max(seen, key=lambda index: (seen[index].density, -index))
    found: dict[int, Shift] = {}
    for index in sorted(seen):
        if index == best:
            continue
        shift = there_and_back(images[best], images[index], settings)
        if isinstance(shift, str):
            refused[f"marking: {shift}"] += 1
        else:
            found[index] = shift
    if not found:
        return None
    mean = np.mean([shift.covariance for shift in found.values()], axis=0)
    placed = {best: (centre, 0.5 * mean)}  # each image contributes half of the noise
    placed |= {index: (centre + shift.shift_m, 0.5 * shift.covariance) for index, shift in found.items()}
    sightings = tuple(
        _sighting(flight.swaths[index], index, returns[index], seen[index], *placed[index]) for index in sorted(placed)
    )
    return TiePoint(f"marking {number}", sightings, kind="marking")


def _sighting(
    swath: Swath,
    index: int,
    at: Int64Array,
    square: Square,
    place: FloatArray,
    covariance: FloatArray,
) -> Sighting:
    """Return the sighting on the square's plane; the slope carries errors of its place over to its height."""
    points = np.asarray(swath.points_t[at, :2])
    nearest = int(at[np.argmin(np.sum((points - place) ** 2, axis=1))])
    to_plane = np.concatenate([np.eye(2), square.slopes[np.newaxis]])
    whole = to_plane @ covariance @ to_plane.T
    whole[2, 2] += square.sigma_m**2
    point = np.array([place[0], place[1], square.height_at(place)])
    return Sighting(index, nearest, point, whole)


def _image(
    swath: Swath,
    at: Int64Array,
    square: Square,
    centre: FloatArray,
    smooth_m: float,
    settings: MarkingSettings,
) -> Image:
    """Return the mean intensities of cells, weighted by distance, of the square and the search margin around it."""
    points = np.asarray(swath.points_t[at])
    on_ground = np.abs(points[:, 2] - square.heights_at(points[:, :2])) <= 5.0 * settings.rms_m
    points, intensity = points[on_ground], swath.rows["intensity"][at][on_ground].astype(np.float64)
    half = _cells(settings.square_m / 2.0 + settings.search_m, settings.cell_m)
    border = half + _cells(4.0 * smooth_m, settings.cell_m)
    sums, count = _spread((points[:, :2] - centre) / settings.cell_m + border, intensity, 2 * border + 1)
    sigma = smooth_m / settings.cell_m
    weight = gaussian_filter(count, sigma, mode="constant")
    value = gaussian_filter(sums, sigma, mode="constant") / np.maximum(weight, 1e-12)
    cut = slice(border - half, border + half + 1)
    whole = bool((weight[cut, cut] > THIN * square.density * settings.cell_m**2).all())
    return Image(value[cut, cut], smooth_m, whole)


def _spread(place: FloatArray, values: FloatArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return sums (side, side) of values (n,) and of ones, each shared among the four cells around its place (n, 2).

    The sharing is linear, so that the positions of scan lines within the cells do not move the image.
    """
    whole = np.floor(place).astype(np.int64)
    share = place - whole
    sums, count = np.zeros(side * side), np.zeros(side * side)
    for east in (0, 1):
        for north in (0, 1):
            column, row = whole[:, 0] + east, whole[:, 1] + north
            weight = np.abs(1.0 - east - share[:, 0]) * np.abs(1.0 - north - share[:, 1])
            inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
            cell = row[inside] * side + column[inside]
            sums += np.bincount(cell, (weight * values)[inside], side * side)
            count += np.bincount(cell, weight[inside], side * side)
    return sums.reshape(side, side), count.reshape(side, side)


def _cells(metres: float, cell_m: float) -> int:
    return round(metres / cell_m)


def shifted(image: Image, other: Image, settings: MarkingSettings) -> Shift | str:
    """Return the shift of the same pattern in the other image; a string is the reason of failure."""
    if not (image.whole and other.whole):
        return "the ground has holes"
    search = _cells(settings.search_m, settings.cell_m)
    template = image.value[search:-search, search:-search]
    if np.ptp(template) <= 0.0 or np.ptp(other.value) <= 0.0:
        return "the ground has no pattern"
    correlation = _correlations(template, other.value)
    row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
    peak = float(correlation[row, column])
    if peak < settings.least_correlation:
        return "the strips have too little in common"
    if not (1 <= row <= 2 * search - 1 and 1 <= column <= 2 * search - 1):
        return "the shift exceeds the search radius"
    surface = _surface(correlation[row - 1 : row + 2, column - 1 : column + 2])
    curvature = -np.array([[2.0 * surface[3], surface[4]], [surface[4], 2.0 * surface[5]]])
    if np.linalg.eigvalsh(curvature)[0] <= 0.0:
        return "no single peak"
    off = np.linalg.solve(curvature, surface[1:3])
    if np.abs(off).max() > 1.0:
        return "no single peak"
    away = _away(correlation, int(row), int(column), settings)
    if away > peak - settings.unique:
        return "several places match equally well"
    area_m2 = (template.shape[0] * settings.cell_m) ** 2
    unexplained = 2.0 * (1.0 - min(peak, 1.0)) * 4.0 * np.pi * image.smooth_m**2 / area_m2
    covariance = unexplained * np.linalg.inv(curvature) * settings.cell_m**2
    if np.sqrt(np.linalg.eigvalsh(covariance)[1]) > settings.greatest_sigma_m:
        return "the pattern has one direction only"
    shift_m = settings.cell_m * (np.array([column - search, row - search]) + off)
    return Shift(shift_m, covariance, peak)


def there_and_back(image: Image, other: Image, settings: MarkingSettings) -> Shift | str:
    """Return the shift if the reverse search gives the same; a string is the reason of failure."""
    there, back = shifted(image, other, settings), shifted(other, image, settings)
    if isinstance(there, str) or isinstance(back, str):
        return there if isinstance(there, str) else str(back)
    apart = there.shift_m + back.shift_m
    if apart @ np.linalg.solve(there.covariance + back.covariance, apart) > BACK:
        return "matching in reverse gives another place"
    return there


def _correlations(template: FloatArray, image: FloatArray) -> FloatArray:
    """Return the normalised cross-correlation at every place of the template in the image."""
    zero_mean = template - template.mean()
    size = template.shape[0]
    image = image - image.mean()
    cross = fftconvolve(image, zero_mean[::-1, ::-1], mode="valid")
    inner = slice(size // 2, size // 2 + cross.shape[0])
    mean = uniform_filter(image, size, mode="constant")[inner, inner]
    square = uniform_filter(image**2, size, mode="constant")[inner, inner]
    spread = np.sqrt(np.maximum(square - mean**2, 1e-12) * template.size * np.sum(zero_mean**2))
    correlation: FloatArray = cross / spread
    return correlation


def _surface(values: FloatArray) -> FloatArray:
    """Fit 1, x, y, x², xy, y² to (3, 3) values by least squares; return the coefficients (6,).

    x is to the east, y to the north, in cells.
    """
    y, x = (axis.ravel().astype(np.float64) for axis in np.mgrid[-1:2, -1:2])
    design = np.stack([np.ones(9), x, y, x * x, x * y, y * y], axis=1)
    solved: FloatArray = np.linalg.lstsq(design, values.ravel(), rcond=None)[0]
    return solved


def _away(correlation: FloatArray, row: int, column: int, settings: MarkingSettings) -> float:
    """Return the greatest correlation beyond a metre, or three smoothing sigmas if larger, from the peak."""
    rows, columns = np.indices(correlation.shape)
    far = np.hypot(rows - row, columns - column) * settings.cell_m > max(1.0, 3.0 * settings.smooth_m)
    return float(np.max(correlation[far], initial=-1.0))


@dataclass(frozen=True, eq=False)
class Grid:
    """Squares over a flight: the south-west corner (2,), their side, and their columns and rows."""

    corner_t: FloatArray
    side_m: float
    columns: int
    rows: int

    def number(self, points_t: FloatArray) -> Int64Array:
        """Return the numbers (n,) of the squares in which points (n, ≥ 2) lie; −1 for nan."""
        placed = np.isfinite(points_t[:, 0])
        away = np.where(placed[:, np.newaxis], points_t[:, :2], self.corner_t) - self.corner_t
        column, row = np.floor(away / self.side_m).astype(np.int64).T
        return np.where(placed, row * self.columns + column, -1)

    def centre(self, number: int) -> FloatArray:
        """Return east and north (2,) of a square's centre."""
        row, column = divmod(number, self.columns)
        centre: FloatArray = self.corner_t + self.side_m * (np.array([column, row]) + 0.5)
        return centre

    def around(self, number: int) -> list[int]:
        """Return the numbers of a square and its neighbours."""
        row, column = divmod(number, self.columns)
        return [
            r * self.columns + c
            for r in range(max(row - 1, 0), min(row + 2, self.rows))
            for c in range(max(column - 1, 0), min(column + 2, self.columns))
        ]


@dataclass(frozen=True, eq=False)
class Square:
    """A square as a swath shows it.

    Attributes:
        number: in the grid.
        centre_t: (2,); height_m: of its plane there; slopes: (2,) to the east and north.
        rms_m: of the returns about the plane; sigma_m: of its height, from their scatter.
        density: returns per square metre.
        contrast: standard deviation of the intensities as a share of their mean.
    """

    number: int
    centre_t: FloatArray
    height_m: float
    slopes: FloatArray
    rms_m: float
    sigma_m: float
    density: float
    contrast: float

    @property
    def slope(self) -> float:
        """Steepest slope of the plane."""
        return float(np.hypot(*self.slopes))

    def height_at(self, place_t: FloatArray) -> float:
        """Return the height of the plane at a place (2,)."""
        return self.height_m + float(self.slopes @ (place_t - self.centre_t))

    def heights_at(self, places_t: FloatArray) -> FloatArray:
        """Return the heights of the plane at places (n, 2)."""
        heights: FloatArray = self.height_m + (places_t - self.centre_t) @ self.slopes
        return heights


def grid_of(flight: Flight, side_m: float) -> Grid | None:
    """Create the grid over all points of a flight; None if it has no points."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for swath in flight.swaths:
        for begin in range(0, len(swath), CHUNK):
            points = np.asarray(swath.points_t[begin : begin + CHUNK, :2])
            points = points[np.isfinite(points[:, 0])]
            low, high = (
                np.minimum(low, points.min(axis=0, initial=np.inf)),
                np.maximum(high, points.max(axis=0, initial=-np.inf)),
            )
    if not np.isfinite(low).all():
        return None
    corner = np.floor(low / side_m) * side_m
    columns, rows = (np.floor((high - corner) / side_m).astype(np.int64) + 1).tolist()
    return Grid(corner, side_m, columns, rows)


def squares_of(swath: Swath, grid: Grid, least_density: float) -> Iterator[Square]:
    """Yield the squares in which a swath has enough returns."""
    count = grid.columns * grid.rows
    sums = np.zeros((12, count))  # 1 x y z xx xy yy xz yz zz, intensity and its square
    for begin in range(0, len(swath), CHUNK):
        points = np.asarray(swath.points_t[begin : begin + CHUNK])
        square = grid.number(points)
        placed = square >= 0
        points, square = points[placed], square[placed]
        row, column = np.divmod(square, grid.columns)
        x, y = (points[:, :2] - grid.corner_t - grid.side_m * (np.stack([column, row], axis=1) + 0.5)).T
        z = points[:, 2]
        intensity = swath.rows["intensity"][begin : begin + CHUNK][
            np.isfinite(swath.points_t[begin : begin + CHUNK, 0])
        ]
        columns = (x, y, z, x * x, x * y, y * y, x * z, y * z, z * z, intensity, intensity**2)
        sums[0] += np.bincount(square, minlength=count)
        for at, values in enumerate(columns, 1):
            sums[at] += np.bincount(square, values, count)
    least = max(least_density * grid.side_m**2, 10.0)
    for number in np.flatnonzero(sums[0] >= least).tolist():
        found = _square(number, grid, sums[:, number])
        if found is not None:
            yield found


def _square(number: int, grid: Grid, sums: FloatArray) -> Square | None:
    """Return the plane and contrast of a square from its sums (12,); None if its returns do not fix a plane."""
    n, x, y, z, xx, xy, yy, xz, yz, zz, i, ii = (float(value) for value in sums)
    normal = np.array([[n, x, y], [x, xx, xy], [y, xy, yy]])
    if np.linalg.cond(normal / n) > 1e4:
        return None
    inverse = np.linalg.inv(normal)
    plane = inverse @ [z, xz, yz]
    rms_m = math.sqrt(max((zz - float(plane @ [z, xz, yz])) / (n - 3.0), 0.0))
    mean = i / n
    contrast = math.sqrt(max(ii / n - mean**2, 0.0)) / mean if mean > 0.0 else 0.0
    sigma_m = max(rms_m, LEAST_RMS_M) * float(np.sqrt(inverse[0, 0]))
    return Square(number, grid.centre(number), float(plane[0]), plane[1:], rms_m, sigma_m, n / grid.side_m**2, contrast)


def near(swath: Swath, grid: Grid, numbers: Sequence[int]) -> dict[int, Int64Array]:
    """Return, by square, the rising indexes of the returns in it and in its neighbours."""
    wanted = np.zeros(grid.columns * grid.rows, np.bool_)
    for number in numbers:
        wanted[grid.around(number)] = True
    found, squares = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for begin in range(0, len(swath), CHUNK):
        numbers_here = grid.number(np.asarray(swath.points_t[begin : begin + CHUNK]))
        chosen = np.flatnonzero((numbers_here >= 0) & wanted[numbers_here])
        found.append(begin + chosen)
        squares.append(numbers_here[chosen])
    at, square = np.concatenate(found), np.concatenate(squares)
    order = np.argsort(square, kind="stable")
    at, square = at[order], square[order]
    first, last = (
        np.searchsorted(square, np.arange(len(wanted)), side="left"),
        np.searchsorted(square, np.arange(len(wanted)), side="right"),
    )
    return {
        number: np.sort(np.concatenate([at[first[one] : last[one]] for one in grid.around(number)]))
        for number in numbers
    }
