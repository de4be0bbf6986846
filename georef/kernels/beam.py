"""One beam in the head's own axes: where it starts, where it points, and how both turn with the scan angle.

A geometry is a row of eight numbers a channel (`georef.beams` fills them). In all of them column 7 is metres added to
the range; columns 0 to 6 are

    LINE       sin Δη, cos Δη, sin ε, cos ε of a mirror tilted by ε towards x; θ where the channel itself says it
    NUTATING   sin ψ, cos ψ of the normal from its shaft; sin β, cos β of the shaft from the laser's beam
    RISLEY     horizontal and vertical part of the ray before the last surface; sin, cos of the second wedge; refractive
               index; turns of the second prism a turn of the first
    SPINNING   sin, cos of elevation; azimuth; right, forward, up of the beam's start; sense of turning (1, −1)
"""

from __future__ import annotations

import math

from georef.compiled import kernel
from georef.kernels.rotations import sin_cos
from georef.kernels.types import Eight, FloatArray, Six, Three

LINE, NUTATING, RISLEY, SPINNING = 0, 1, 2, 3
COLUMNS = 8
FIXED_ANGLE, RANGE = 4, 7
_EIGHTH = 0.25 * math.pi


@kernel
def row_of(table: FloatArray, channel: int) -> Eight:
    """A row as numbers: a view of an array would be counted, return by return."""
    return (
        table[channel, 0],
        table[channel, 1],
        table[channel, 2],
        table[channel, 3],
        table[channel, 4],
        table[channel, 5],
        table[channel, 6],
        table[channel, 7],
    )


@kernel
def line_beam(row: Eight, theta: float) -> Six:
    """Off a mirror whose normal stands at 45° − θ/2 to a laser on the +y side: u = u0 − 2 (u0·n) n (FORMULAS 2.2).

    With ε = 0 this is ISO/TS 19159-2 Eq. 14's (−sin Δη, sin θ cos Δη, cos θ cos Δη).
    """
    sin, cos = sin_cos(_EIGHTH + 0.5 * theta)
    twice = 2.0 * (row[0] * row[2] + row[1] * row[3] * sin)
    return 0.0, 0.0, 0.0, twice * row[2] - row[0], twice * row[3] * sin - row[1], twice * row[3] * cos


@kernel
def line_turn(row: Eight, theta: float) -> Six:
    """∂u/∂θ and ∂u/∂Δη of `line_beam`."""
    sin, cos = sin_cos(_EIGHTH + 0.5 * theta)
    twice = 2.0 * (row[0] * row[2] + row[1] * row[3] * sin)
    by_theta = row[1] * row[3] * cos
    by_eta = 2.0 * (row[1] * row[2] - row[0] * row[3] * sin)
    return (
        by_theta * row[2],
        row[3] * (by_theta * sin + 0.5 * twice * cos),
        row[3] * (by_theta * cos - 0.5 * twice * sin),
        by_eta * row[2] - row[1],
        by_eta * row[3] * sin + row[0],
        by_eta * row[3] * cos,
    )


@kernel
def nutating_beam(row: Eight, gamma: float) -> Six:
    """Off a mirror whose normal leans by ψ from its shaft, the laser along +x (FORMULAS 2.2, Palmer)."""
    sin, cos = sin_cos(gamma)
    aside = row[0] * cos
    x, y, z = aside * row[2] - row[1] * row[3], row[0] * sin, aside * row[3] + row[1] * row[2]
    return 0.0, 0.0, 0.0, 1.0 - 2.0 * x * x, -2.0 * x * y, -2.0 * x * z


@kernel
def nutating_turn(row: Eight, gamma: float) -> Three:
    """∂u/∂γ of `nutating_beam`."""
    sin, cos = sin_cos(gamma)
    sin, cos = row[0] * sin, row[0] * cos
    x, y, z = cos * row[2] - row[1] * row[3], sin, cos * row[3] + row[1] * row[2]
    dx, dy, dz = -sin * row[2], cos, -sin * row[3]
    return -4.0 * x * dx, -2.0 * (dx * y + x * dy), -2.0 * (dx * z + x * dz)


@kernel
def risley_beam(row: Eight, gamma: float) -> Six:
    """Through the last of a Risley pair's four surfaces by Snell's law as vectors (FORMULAS 2.2).

    Before it the ray is a cone about z that turns with the first prism: the three surfaces before are passed once for
    all, in `georef.beams`. nan where the light is totally reflected.
    """
    sin, cos = sin_cos(gamma)
    x, y, z = row[0] * cos, row[0] * sin, row[1]
    sin, cos = sin_cos(row[5] * gamma)
    nx, ny, nz = row[2] * cos, row[2] * sin, row[3]
    along = nx * x + ny * y + nz * z
    more = math.sqrt(1.0 - row[4] * row[4] * (1.0 - along * along)) - row[4] * along
    return 0.0, 0.0, 0.0, row[4] * x + more * nx, row[4] * y + more * ny, row[4] * z + more * nz


@kernel
def risley_turn(row: Eight, gamma: float) -> Three:
    """∂u/∂γ of `risley_beam`."""
    sin, cos = sin_cos(gamma)
    x, y, z = row[0] * cos, row[0] * sin, row[1]
    sin, cos = sin_cos(row[5] * gamma)
    nx, ny, nz = row[2] * cos, row[2] * sin, row[3]
    dnx, dny = -row[5] * ny, row[5] * nx
    along = nx * x + ny * y + nz * z
    dalong = dnx * x + dny * y - nx * y + ny * x
    behind = math.sqrt(1.0 - row[4] * row[4] * (1.0 - along * along))
    more = behind - row[4] * along
    dmore = row[4] * dalong * (row[4] * along / behind - 1.0)
    return dmore * nx + more * dnx - row[4] * y, dmore * ny + more * dny + row[4] * x, dmore * nz


@kernel
def spinning_beam(row: Eight, theta: float) -> Six:
    """Beam of a spinning head, azimuth from y towards x (FORMULAS 2.2, the full table)."""
    azimuth = row[6] * theta + row[2]
    sin, cos = sin_cos(azimuth)
    return (
        row[4] * sin + row[3] * cos,
        row[4] * cos - row[3] * sin,
        row[5],
        row[1] * sin,
        row[1] * cos,
        row[0],
    )


@kernel
def beam_of(kind: int, row: Eight, theta: float) -> Six:
    """Where the beam starts (m) and its direction, of unit length."""
    if kind == LINE:
        return line_beam(row, theta)
    if kind == SPINNING:
        return spinning_beam(row, theta)
    if kind == NUTATING:
        return nutating_beam(row, theta)
    return risley_beam(row, theta)


@kernel
def turn_of(kind: int, row: Eight, theta: float, range_m: float) -> Six:
    """∂/∂θ and ∂/∂Δη of the point at this range, m/rad; Δη is of line scanners only."""
    if kind == LINE:
        ax, ay, az, tx, ty, tz = line_turn(row, theta)
        return range_m * ax, range_m * ay, range_m * az, range_m * tx, range_m * ty, range_m * tz
    if kind == SPINNING:
        ox, oy, _, ux, uy, _ = spinning_beam(row, theta)
        return row[6] * (oy + range_m * uy), -row[6] * (ox + range_m * ux), 0.0, 0.0, 0.0, 0.0
    if kind == NUTATING:
        ax, ay, az = nutating_turn(row, theta)
    else:
        ax, ay, az = risley_turn(row, theta)
    return range_m * ax, range_m * ay, range_m * az, 0.0, 0.0, 0.0
