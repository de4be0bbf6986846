"""Computes echoes of pulses, compiled: hits of a beam's axis and rim, put in order, merged and cut to the slots."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import ByteArray, FloatArray, Int64Array
from swath.sim import compiled, shots
from swath.sim.compiled import borrowed, digest, jit_cached, jit_inline, whole
from swath.sim.scene import casting, rays
from swath.sim.scene.casting import RIM_SHARE, SPENT, Frame, Pulse, SceneArrays, march
from swath.sim.scene.rays import NEVER, Ray

SOFT_HITS = 24
_NONE = whole(0)
# Columns of soft hits: distance, share of the arriving energy, reflectance, cosine of incidence, surface.
# Columns of echoes: distance, apparent reflectance, cosine of incidence, surface, 1 if on the axis.


class Work(NamedTuple):
    """Work arrays for soft hits and echoes."""

    soft: FloatArray
    echo: FloatArray


def workspace_bytes() -> Work:
    """Make the work arrays; they serve one call at a time."""
    return Work(np.empty((SOFT_HITS, 5)), np.empty((SOFT_HITS + 5, 5)))


@jit_inline
def in_order(rows: FloatArray, count: int) -> None:
    """Sort the first rows by distance; insertion suffices because they are few."""
    for i in range(1, count):
        for j in range(i, 0, -1):
            if rows[j - 1, 0] <= rows[j, 0]:
                break
            for k in range(5):
                rows[j - 1, k], rows[j, k] = rows[j, k], rows[j - 1, k]


@jit_inline
def energy_at(soft: FloatArray, count: int, at: float) -> float:
    """Return the share of a pulse's energy that the sorted soft hits leave at a distance."""
    energy = 1.0
    for k in range(count):
        if soft[k, 0] >= at:
            break
        energy *= 1.0 - soft[k, 1]
    return energy if energy >= SPENT else 0.0


@jit_inline
def add(echo: FloatArray, count: int, at: float, strength: float, cos: float, surface: float, on_axis: float) -> int:
    """Append an echo if it has any strength and there is room; return the number of echoes."""
    if at < NEVER and strength > 0.0 and count < len(echo):
        echo[count, 0], echo[count, 1], echo[count, 2], echo[count, 3], echo[count, 4] = (
            at,
            strength,
            cos,
            surface,
            on_axis,
        )
        return count + 1
    return count


@jit_inline
def rim(ray: Ray, spread: float, side: int) -> Ray:
    """Return one of the four rays that surround a beam's axis, ``spread`` radians from it."""
    ox, oy, oz, dx, dy, dz, _, _ = ray
    if abs(dx) < 0.8:
        ax, ay, az = 0.0, dz, -dy  # d × x
    else:
        ax, ay, az = -dz, 0.0, dx  # d × y
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    if side >= 2:
        ax, ay, az = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
    aside = math.tan(spread) if side % 2 == 0 else -math.tan(spread)
    scale = 1.0 / math.sqrt(1.0 + aside * aside)
    dx, dy, dz = scale * (dx + aside * ax), scale * (dy + aside * ay), scale * (dz + aside * az)
    return ox, oy, oz, dx, dy, dz, 1.0 / dx, 1.0 / dy


@jit_inline
def move(echo: FloatArray, source: int, target: int) -> None:
    """Copy a row over another."""
    for k in range(5):
        echo[target, k] = echo[source, k]


@jit_inline
def merged(echo: FloatArray, count: int, pulse_m: float) -> int:
    """Merge echoes nearer to each other than a pulse; return the number that is left.

    The echoes are in order. A merged echo keeps the place of the axis's echo, or else of the stronger one.
    """
    kept = _NONE
    for k in range(1, count):
        if echo[k, 0] - echo[kept, 0] < pulse_m:
            strength = echo[kept, 1] + echo[k, 1]
            if echo[k, 4] > echo[kept, 4] or (echo[k, 4] == echo[kept, 4] and echo[k, 1] > echo[kept, 1]):
                move(echo, k, kept)
            echo[kept, 1] = strength
        else:
            kept += 1
            move(echo, k, kept)
    return kept + 1 if count else 0


@jit_inline
def echoes_of(
    frame: Frame,
    z: FloatArray,
    top: FloatArray,
    first: Int64Array,
    item: Int64Array,
    rows: FloatArray,
    ray: Ray,
    spread: float,
    pulse: Pulse,
    soft: FloatArray,
    echo: FloatArray,
) -> int:
    """Write all echoes of a pulse in order of distance and return their number."""
    count, softs, room, share, wide, beam = _NONE, _NONE, len(soft), 1.0, spread, ray
    for side in range(5):
        at, surface, reflectance, cos, edge, softs = march(
            frame, z, top, first, item, rows, beam, wide, pulse, soft, softs, room
        )
        if side == 0:
            in_order(soft, softs)
            for k in range(softs):
                if soft[k, 0] < at:
                    strength = energy_at(soft, softs, soft[k, 0]) * soft[k, 1] * soft[k, 2] * soft[k, 3]
                    count = add(echo, count, soft[k, 0], strength, soft[k, 3], soft[k, 4], 1.0)
            if spread > 0.0 and edge <= at < NEVER:
                share = 1.0 - 4.0 * RIM_SHARE
        strength = energy_at(soft, softs, at) * share * reflectance * cos
        count = add(echo, count, at, strength, cos, float(surface), 1.0 if side == 0 else 0.0)
        if share == 1.0:
            return count
        share, wide, room = RIM_SHARE, 0.0, _NONE
        beam = rim(ray, spread, side)
    in_order(echo, count)
    return count


def _cast_pulses(sources: int) -> Callable[..., None]:
    """Return `cast_pulses` compiled from sources with this digest."""

    @jit_cached
    def cast_pulses(
        scene: SceneArrays,
        work: Work,
        origin: FloatArray,
        direction: FloatArray,
        time_s: FloatArray,
        number: Int64Array,
        spread: float,
        pulse_m: float,
        range_m: FloatArray,
        reflectance: FloatArray,
        incidence_rad: FloatArray,
        surface: ByteArray,
    ) -> None:
        """Write echoes of n pulses into tables (n, slots), which hold the values of empty slots beforehand."""
        slots = range_m.shape[1] if sources else 0
        frame, seed = scene.frame, scene.seed
        z, top, first = borrowed(scene.z), borrowed(scene.top), borrowed(scene.first)
        item, rows = borrowed(scene.item), borrowed(scene.rows)
        soft, echo = borrowed(work.soft), borrowed(work.echo)
        for i in range(len(origin)):
            dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
            ray = origin[i, 0], origin[i, 1], origin[i, 2], dx, dy, dz, 1.0 / dx, 1.0 / dy
            pulse = time_s[i], number[i], seed
            found = echoes_of(frame, z, top, first, item, rows, ray, spread, pulse, soft, echo)
            count = merged(echo, found, pulse_m)
            for slot in range(min(count, slots)):
                k = count - 1 if slot == slots - 1 else slot
                range_m[i, slot] = echo[k, 0]
                reflectance[i, slot] = echo[k, 1]
                incidence_rad[i, slot] = math.acos(min(echo[k, 2], 1.0))
                surface[i, slot] = np.uint8(echo[k, 3])

    return cast_pulses


cast_pulses = _cast_pulses(digest(casting, compiled, rays, shots))
