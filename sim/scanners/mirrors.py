"""Directions of the light from mirrors and prisms, by vector reflection and refraction; no scan angle is assumed.

Sensor frame: x forward, y right, z along the beam at scan angle 0; all directions are unit vectors. The laser of a
swung mirror is on the +y side and shines along −y; that of the other mirrors is behind and shines along +x; through a
Risley pair the laser shines along z. FORMULAS 2.2.
"""

from __future__ import annotations

import numpy as np

from swath.georef.arrays import FloatArray

_FORWARD = np.array([1.0, 0.0, 0.0])
_DOWN = np.array([0.0, 0.0, 1.0])


def reflected(ray: FloatArray, normal: FloatArray) -> FloatArray:
    """Return (n, 3) rays after reflection at mirrors with these normals: u = u0 − 2 (u0·n) n.

    Args:
        ray: (3,) or (n, 3) rays before the mirrors.
        normal: (n, 3) normals of the mirrors.
    """
    away: FloatArray = ray - 2.0 * (normal * ray).sum(axis=1, keepdims=True) * normal
    return away


def refracted(ray: FloatArray, normal: FloatArray, ratio: float) -> FloatArray:
    """Return (n, 3) rays after refraction at surfaces, by the vector form of Snell's law.

    Args:
        ray: (n, 3) rays of n pulses before the surfaces.
        normal: (n, 3) or (3,) normals of the surfaces, which point along with the rays.
        ratio: refractive index before the surface, divided by that after it. The result is nan where the light is
            totally reflected.
    """
    along = (normal * ray).sum(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        behind = np.sqrt(1.0 - ratio**2 * (1.0 - along**2))
    bent: FloatArray = ratio * ray + (behind - ratio * along) * normal
    return bent


def swung_mirror(beam_rad: FloatArray, facet_tilt_rad: FloatArray | float, plane_tilt_rad: float) -> FloatArray:
    """Return (n, 3) rays from a flat mirror with axis x, 45° to the laser at rest: oscillating mirror and polygon.

    Args:
        beam_rad: (n,) θ, twice the turn of the mirror from rest.
        facet_tilt_rad: (n,) or one, tilt of the normal towards +x: u_x = 2 cos i sin ε, i = 45° − θ/2 (times cos ε).
        plane_tilt_rad: tilt of the laser's beam out of the plane of the scan, Δη: the scan becomes the cone of ISO Eq.
            14.
    """
    ray = np.array([-np.sin(plane_tilt_rad), -np.cos(plane_tilt_rad), 0.0])
    turned = np.pi / 4 + 0.5 * beam_rad
    flat = np.cos(facet_tilt_rad)
    normal = np.empty((len(beam_rad), 3))
    normal[:, 0] = np.sin(facet_tilt_rad)
    normal[:, 1] = flat * np.sin(turned)
    normal[:, 2] = flat * np.cos(turned)
    return reflected(ray, normal)


def monogon(shaft_rad: FloatArray, plane_tilt_rad: float) -> FloatArray:
    """Return (n, 3) rays from a single mirror turned by ``shaft_rad`` (n,) about the laser's beam, Δη/2 off its 45°."""
    slope = np.pi / 4 - 0.5 * plane_tilt_rad
    normal = np.empty((len(shaft_rad), 3))
    normal[:, 0] = -np.cos(slope)
    normal[:, 1] = np.sin(slope) * np.sin(shaft_rad)
    normal[:, 2] = np.sin(slope) * np.cos(shaft_rad)
    return reflected(_FORWARD, normal)


def nutating(shaft_rad: FloatArray, nutation_rad: float) -> FloatArray:
    """Return (n, 3) rays from a mirror whose normal leans by ψ from its shaft at 45° to the laser (Palmer scan).

    At ``shaft_rad`` (n,) 0 the normal leans in the plane of incidence so that the beam goes forward by 2ψ; a quarter
    turn later it leans to the right.
    """
    aside, along = np.sin(nutation_rad), np.cos(nutation_rad)
    in_plane = aside * np.cos(shaft_rad)
    normal = np.empty((len(shaft_rad), 3))
    normal[:, 0] = (in_plane - along) * np.sqrt(0.5)
    normal[:, 1] = aside * np.sin(shaft_rad)
    normal[:, 2] = (in_plane + along) * np.sqrt(0.5)
    return reflected(_FORWARD, normal)


def risley(
    first_rad: FloatArray, second_rad: FloatArray, wedge_rad: tuple[float, float], refractive_index: float
) -> FloatArray:
    """Return (n, 3) rays behind two prisms, refracted at all four surfaces, towards the thick end.

    Each prism has a flat entry and a wedged exit.

    Args:
        first_rad, second_rad: (n,) turns of the prisms; at 0 the thin end lies forward.
        wedge_rad: angles of the two prisms.
        refractive_index: of both; the result is nan where no light comes through.
    """
    ray = np.broadcast_to(_DOWN, (len(first_rad), 3))
    for turned, wedge in zip((first_rad, second_rad), wedge_rad, strict=True):
        exit_face = np.empty((len(turned), 3))
        exit_face[:, 0] = np.sin(wedge) * np.cos(turned)
        exit_face[:, 1] = np.sin(wedge) * np.sin(turned)
        exit_face[:, 2] = np.cos(wedge)
        ray = refracted(refracted(ray, _DOWN, 1.0 / refractive_index), exit_face, refractive_index)
    return ray
