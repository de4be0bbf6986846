"""Measure what the adjustment of a calibration costs on one core: 10 million points on 1000 planes, 15 parameters.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.adjustment [--points 10000000] [--planes 1000] [--json FILE]

Times are CPU time of this process. A pass over the rows places every return with the current calibration, makes its
row of the design matrix and adds it to the normal equations. Two limits stand beside it, each measured once: placing
the returns with their axes, and multiplying rows of this width with themselves. A pass cannot take less time than both
together. Memory is the peak of the process above what it holds with the flight's returns, which are mapped from files.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.calib.adjust import adjust
from swath.calib.equations.rows import Rows
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.features import Features, Patch, Plane
from swath.calib.flight import Flight, Head, Swath
from swath.calib.outcome import Adjusted
from swath.calib.parameters import ParameterOptions, unknowns
from swath.daemon.system import keep_freed_memory
from swath.georef.arrays import FloatArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import Calibration, nominal
from tests.calib.roofs import GROUND_M, LINES, NOISE, aimed, frame, ranges, trajectory

SEED = 20_261_122
TARGET_ROWS, TARGET_S, TARGET_BYTES = 3e6, 20.0, 1e9
PRIORS = {
    "omega_rad": 0.05, "phi_rad": 0.05, "kappa_rad": 0.05, "range_offset_m": 1.0, "range_scale": 1e-3,
    "scan_angle_scale": 1e-2, "scan_plane_tilt_rad": 1e-3, "lever_arm_x_m": 0.1, "lever_arm_y_m": 0.1,
    "lever_arm_z_m": 0.1, "time_offset_s": 1e-3, "imu_latency_s": 1e-3, "encoder_latency_s": 1e-5, "torsion_s2": 1e-8,
    "pitch_slope": 1e-3,
}  # fmt: skip
TRUTH = {"omega_rad": 0.0037, "phi_rad": -0.0061, "kappa_rad": 0.0021, "range_offset_m": 0.18}


@dataclass
class Figures:
    """All figures of a run; rates are rows a second of CPU time."""

    rows: int
    parameters: int
    unknowns: int
    pass_rate: float
    placed_rate: float
    product_rate: float
    adjust_s: float
    iterations: int
    extra_bytes: int


def plane_table(count: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return centres and normals of planes: four in five are inclined by 35°, each in a random direction."""
    g, planes = np.random.default_rng(SEED), []
    for index in range(count):
        slope, aspect = np.radians(35.0 if index % 5 else 0.0), g.uniform(0.0, 2.0 * np.pi)
        normal = np.array([np.sin(slope) * np.cos(aspect), np.sin(slope) * np.sin(aspect), np.cos(slope)])
        planes.append((np.array([*g.uniform(-280.0, 280.0, 2), GROUND_M]), normal))
    return planes


def mapped(folder: Path, name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Save the array to a file and return it mapped from there."""
    np.save(folder / f"{name}.npy", array)
    loaded: NDArray[Any] = np.load(folder / f"{name}.npy", mmap_mode="r")
    return loaded


def make(folder: Path, points: int, planes: int) -> tuple[Flight, Features]:
    """Make noisy returns of eight flight lines on the planes, and the features that hold them."""
    table, flown, g = plane_table(planes), trajectory(), np.random.default_rng(SEED)
    start: Calibration = nominal("left", (0.15, -0.08, 0.42), np.eye(3))
    truth = start.changed(**TRUTH)
    patches: list[list[Patch]] = [[] for _ in table]
    swaths = []
    for index, line in enumerate(LINES):
        ((times, encoder, plane),) = aimed(flown, [line], table, points // (len(LINES) * planes) + 1, SEED + index)
        times = times + index * 60_000_000_000
        rows = np.zeros(len(times), RETURN_DTYPE)
        rows["encoder_rad"] = encoder
        for begin in range(0, len(times), 100_000):
            mine = slice(begin, begin + 100_000)
            shaken = encoder[mine] + NOISE.angle_rad * g.normal(size=len(encoder[mine]))
            exact = ranges(flown, truth, table, times[mine], shaken, plane[mine])
            rows["range_m"][mine] = exact + NOISE.range_m * g.normal(size=len(exact))
        columns = [rows, times, np.zeros((len(rows), 3)), g.normal(size=len(rows)) * 70, g.normal(size=len(rows)) * 4e3]
        taken = [mapped(folder, f"{index}.{place}", column) for place, column in enumerate(columns)]
        swaths.append(Swath(f"{index:02}", 0, index + 1, 0, *taken))
        order = np.argsort(plane, kind="stable")
        ends = np.searchsorted(plane[order], np.arange(planes + 1))
        for which in range(planes):
            patches[which].append(Patch(index, order[ends[which] : ends[which + 1]]))
    head = Head("left", start, LineGeometry(), NOISE)
    found = (
        Plane(f"{index}", centre, normal, tuple(mine))
        for index, ((centre, normal), mine) in enumerate(zip(table, patches, strict=True))
    )
    return Flight(frame(), (head,), (flown,), tuple(swaths)), Features(tuple(found))


def cpu(work: Any) -> tuple[float, Any]:
    """Return the CPU seconds that the work takes, and its result."""
    begin = time.process_time()
    result = work()
    return time.process_time() - begin, result


def measure(flight: Flight, features: Features) -> Figures:
    """Measure the passes, the adjustment and its memory."""
    prior = gauss_markov(flight, Taus(), 5.0)
    options = ParameterOptions("full", priors=PRIORS)
    part = Features(tuple(replace(plane, patches=plane.patches[:2]) for plane in features.planes[:4]))
    adjust(flight, part, options, prior)  # compile the loops before anything is measured
    rows = Rows(flight, features.planes, unknowns(flight, options), prior)
    state, weight = rows.start(), np.ones(rows.count, np.float32)
    pass_s, _ = cpu(lambda: rows.summed(state, weight, 0.0))
    placed_s, _ = cpu(lambda: [None for _ in rows.placed(state)])
    panel = np.random.default_rng(1).normal(size=(len(rows.unknowns) + 12, 256))
    product_s, _ = cpu(lambda: [panel @ panel.T for _ in range(1000)])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    adjust_s, found = cpu(lambda: adjust(flight, features, options, prior))
    done: Adjusted = found
    extra = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    return Figures(
        rows.count,
        len(done.names),
        rows.size,
        rows.count / pass_s,
        rows.count / placed_s,
        256_000 / product_s,
        adjust_s,
        done.iterations,
        extra,
    )


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--planes", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(*make(Path(folder), arguments.points, arguments.planes))
    limit = 1.0 / (1.0 / figures.placed_rate + 1.0 / figures.product_rate)
    print(f"{figures.rows:,} rows, {figures.parameters} parameters, {figures.unknowns} unknowns with the trajectory's")
    wanted = f"want {TARGET_ROWS / 1e6:.0f}, limit {limit / 1e6:.2f}"
    print(f"a pass        {figures.pass_rate / 1e6:8.2f} M rows/s   {wanted}")
    print(f"  placing     {figures.placed_rate / 1e6:8.2f} M rows/s")
    print(f"  products    {figures.product_rate / 1e6:8.2f} M rows/s")
    print(f"adjustment    {figures.adjust_s:8.2f} s          want {TARGET_S:.0f}; {figures.iterations} linearisations")
    print(f"memory        {figures.extra_bytes / 1e6:8.0f} MB         want {TARGET_BYTES / 1e6:.0f} at most")
    if arguments.json:
        arguments.json.write_text(json.dumps(asdict(figures), indent=1))


if __name__ == "__main__":
    main()
