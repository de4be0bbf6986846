"""One beam in the head's own axes: its start, its direction, and the derivatives of both by the scan angle.

A geometry is a row of eight numbers per channel (`swath.georef.scanner.beams` fills them). In all of them column 7 is
metres added to the range; columns 0 to 6 are

    LINE       sin Δη, cos Δη, sin ε, cos ε of a mirror tilted by ε towards x; θ if the channel itself gives it
    NUTATING   sin ψ, cos ψ of the normal from its shaft; sin β, cos β of the shaft from the laser's beam
    RISLEY     horizontal and vertical part of the ray before the last surface; sin, cos of the second wedge; refractive
               index; turns of the second prism per turn of the first
    SPINNING   sin, cos of elevation; azimuth; right, forward, up of the beam's start; sense of turning (1, −1)
    AIMED      the same, but each return has its own elevation
"""

from __future__ import annotations

import math

from swath.georef.compiled import jit_inline
from swath.georef.scanner.kernels.types import Eight, Three, Two

LINE, NUTATING, RISLEY, SPINNING, AIMED = 0, 1, 2, 3, 4
ONE, BY_CHANNEL, FIBRE_BY_CHANNEL, FIBRE_BY_ENCODER = 0, 1, 2, 3  # how a return chooses its row
COLUMNS = 8
FIXED_ANGLE, RANGE = 4, 7
_EIGHTH = 0.25 * math.pi


@jit_inline
def mirror_angle(theta: float) -> float:
    """Return the angle of the normal of a line scanner's mirror."""
    return _EIGHTH + 0.5 * theta


@jit_inline
def line_beam(row: Eight, sin: float, cos: float) -> Three:
    """Return the beam off a line scanner's mirror: u = u0 − 2 (u0·n) n (FORMULAS 2.2).

    The mirror's normal stands at 45° − θ/2 to a laser on the +y side. With ε = 0 this is ISO/TS 19159-2 Eq. 14's (−sin
    Δη, sin θ cos Δη, cos θ cos Δη). Sine and cosine are of `mirror_angle`.
    """
    twice = 2.0 * (row[0] * row[2] + row[1] * row[3] * sin)
    return twice * row[2] - row[0], twice * row[3] * sin - row[1], twice * row[3] * cos


@jit_inline
def line_turn(row: Eight, sin: float, cos: float) -> tuple[Three, Three]:
    """Return ∂u/∂θ and ∂u/∂Δη of `line_beam`."""
    twice = 2.0 * (row[0] * row[2] + row[1] * row[3] * sin)
    by_theta = row[1] * row[3] * cos
    by_eta = 2.0 * (row[1] * row[2] - row[0] * row[3] * sin)
    across = (
        by_theta * row[2],
        row[3] * (by_theta * sin + 0.5 * twice * cos),
        row[3] * (by_theta * cos - 0.5 * twice * sin),
    )
    return across, (by_eta * row[2] - row[1], by_eta * row[3] * sin + row[0], by_eta * row[3] * cos)


@jit_inline
def nutating_beam(row: Eight, sin: float, cos: float) -> Three:
    """Return the beam off a mirror whose normal leans by ψ from its shaft, laser along +x (FORMULAS 2.2, Palmer)."""
    aside = row[0] * cos
    x, y, z = aside * row[2] - row[1] * row[3], row[0] * sin, aside * row[3] + row[1] * row[2]
    return 1.0 - 2.0 * x * x, -2.0 * x * y, -2.0 * x * z


@jit_inline
def nutating_turn(row: Eight, sin: float, cos: float) -> Three:
    """Return ∂u/∂γ of `nutating_beam`."""
    sin, cos = row[0] * sin, row[0] * cos
    x, y, z = cos * row[2] - row[1] * row[3], sin, cos * row[3] + row[1] * row[2]
    dx, dy, dz = -sin * row[2], cos, -sin * row[3]
    return -4.0 * x * dx, -2.0 * (dx * y + x * dy), -2.0 * (dx * z + x * dz)


@jit_inline
def risley_beam(row: Eight, first: Two, second: Two) -> Three:
    """Return the beam after the last of a Risley pair's four surfaces, by Snell's law as vectors (FORMULAS 2.2).

    Before it the ray is a cone about z that turns with the first prism: `swath.georef.scanner.beams` passes the three
    surfaces before once for all returns. The result is nan where the light is totally reflected. ``first``, ``second``:
    sine and cosine of both prisms' angles.
    """
    x, y, z = row[0] * first[1], row[0] * first[0], row[1]
    nx, ny, nz = row[2] * second[1], row[2] * second[0], row[3]
    along = nx * x + ny * y + nz * z
    more = math.sqrt(1.0 - row[4] * row[4] * (1.0 - along * along)) - row[4] * along
    return row[4] * x + more * nx, row[4] * y + more * ny, row[4] * z + more * nz


@jit_inline
def risley_turn(row: Eight, first: Two, second: Two) -> Three:
    """Return ∂u/∂γ of `risley_beam`."""
    x, y, z = row[0] * first[1], row[0] * first[0], row[1]
    nx, ny, nz = row[2] * second[1], row[2] * second[0], row[3]
    dnx, dny = -row[5] * ny, row[5] * nx
    along = nx * x + ny * y + nz * z
    dalong = dnx * x + dny * y - nx * y + ny * x
    behind = math.sqrt(1.0 - row[4] * row[4] * (1.0 - along * along))
    more = behind - row[4] * along
    dmore = row[4] * dalong * (row[4] * along / behind - 1.0)
    return dmore * nx + more * dnx - row[4] * y, dmore * ny + more * dny + row[4] * x, dmore * nz


@jit_inline
def spinning_angle(row: Eight, theta: float) -> float:
    """Return the azimuth of a channel of a spinning head."""
    return row[6] * theta + row[2]


@jit_inline
def spinning_beam(row: Eight, sin: float, cos: float) -> tuple[Three, Three]:
    """Return the start (m) and direction of a spinning head's beam; azimuth from y towards x (FORMULAS 2.2)."""
    start = row[4] * sin + row[3] * cos, row[4] * cos - row[3] * sin, row[5]
    return start, (row[1] * sin, row[1] * cos, row[0])


@jit_inline
def spinning_turn(row: Eight, start: Three, direction: Three, range_m: float) -> Three:
    """Return ∂point/∂θ of `spinning_beam`, m/rad."""
    return row[6] * (start[1] + range_m * direction[1]), -row[6] * (start[0] + range_m * direction[0]), 0.0


@jit_inline
def raised(row: Eight, sin: float, cos: float, range_m: float) -> Three:
    """Return ∂point/∂elevation of `spinning_beam`, m/rad; sine and cosine are of the azimuth."""
    return -range_m * row[0] * sin, -range_m * row[0] * cos, range_m * row[1]
