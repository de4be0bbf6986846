"""Measure the errors of the host's clock model, and its cost, with simulated oscillators, edges and messages.

python -m benchmarks.clock [--seconds 5400] [--seeds 3]

Beside the model's error stands the error of a robust line over fixed windows of 16, 64 and 256 edges of the same
stamps. The first 15 min of each run are left out, because the model still learns noise and wander then.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from swath.georef.timescales import PpsClock
from tests.georef.clock_run import Outcome, rms, run
from tests.georef.clock_simulation import Edges, Oscillator, Sender, Simulation, utc_tag, week_tag

START = 1_479_297_618
LEARNING_S = 900
NOISES_NS = (50.0, 1500.0, 15e3, 300e3)
AHEAD_S = (10.0, 60.0, 300.0)
WINDOWS = (16, 64, 256)
Floats = NDArray[np.float64]


def window_errors(simulation: Simulation, window: int) -> Floats:
    """Return the errors (ns) of a robust line over a fixed window, half a second ahead, every 20 s."""
    stamps = [(host, simulation.true_gps_ns(host)) for host, kind, _, _ in simulation if kind == "edge"]
    seconds = np.array([round(gps / 1e9) for _, gps in stamps], dtype=np.int64)
    near = np.array([abs(gps - round(gps / 1e9) * 10**9) < 2_000_000 for _, gps in stamps])
    host = np.array([host for host, _ in stamps], dtype=np.int64)[near]
    at = seconds[near] - simulation.start_gps_s
    errors = []
    for end in range(LEARNING_S, len(at) - 2, 20):
        rows = slice(end - window, end)
        x = (at[rows] - at[end - 1]).astype(np.float64)
        y = (host[rows] - host[end - 1] - (at[rows] - at[end - 1]) * 10**9).astype(np.float64)
        keep = np.ones(len(x), dtype=bool)
        for _ in range(3):
            line = np.polyfit(x[keep], y[keep], 1)
            off = np.abs(y - np.polyval(line, x))
            keep = off <= 3 * 1.4826 * np.median(off[keep]) + 1e-3
        predicted = int(host[end - 1]) + 500_000_000 + float(np.polyval(line, 0.5))
        errors.append(predicted - simulation.host_ns(int(at[end - 1]) + 0.5))
    return np.array(errors)


def settled(outcome: Outcome) -> tuple[Floats, Floats, Floats, Floats]:
    """Return locked errors, their sigmas, errors ahead and their sigmas, all after the first LEARNING_S."""
    skip = next(k for k, second in enumerate(outcome.seconds) if second >= LEARNING_S)
    columns = (outcome.errors_ns, outcome.sigmas_ns, outcome.ahead_errors_ns, outcome.ahead_sigmas_ns)
    locked, sigma, ahead, ahead_sigma = (np.array(column[skip:]) for column in columns)
    return locked, sigma, ahead, ahead_sigma


def row(noise_ns: float, ramps: bool, seconds: int, seeds: int) -> str:
    """Return one line of the table."""
    runs = [
        Simulation(START, Oscillator(seconds, seed=seed, ramps=ramps), Edges(noise_ns=noise_ns), [sender], seed=seed)
        for seed in range(seeds)
        for sender in [Sender("TIME", week_tag())]
    ]
    cells = [f"{noise_ns / 1e3:g} µs", "0.5 ppm/min" if ramps else "none"]
    for place, ahead_s in enumerate(AHEAD_S):
        found = [settled(run(simulation, PpsClock(18), ahead_s=ahead_s)) for simulation in runs]
        locked, sigma, ahead, ahead_sigma = (np.concatenate(column) for column in zip(*found, strict=True))
        if place == 0:
            cells.append(f"{rms(locked) / 1e3:.3g} ({rms(locked / sigma):.2f})")
        cells.append(f"{rms(ahead) / 1e3:.3g} ({rms(ahead / ahead_sigma):.2f})")
    for window in WINDOWS:
        cells.append(f"{rms(np.concatenate([window_errors(simulation, window) for simulation in runs])) / 1e3:.3g}")
    return "| " + " | ".join(cells) + " |"


def cost_us(seconds: int = 3000) -> tuple[float, float]:
    """Return the CPU time (µs) of one second (an edge and four messages), and that of one status."""
    senders = [Sender(name, utc_tag(18), delay_s=0.1 + 0.01 * k) for k, name in enumerate(("RMC", "ZDA", "GGA", "GST"))]
    events = list(Simulation(START, Oscillator(seconds), Edges(), senders))
    clock = PpsClock(18)
    start = time.process_time()
    for host_ns, _kind, source, message in events:
        if message is None:
            clock.add_edge(host_ns, 0)
        else:
            clock.add_message(source, message)
    fed = time.process_time()
    last = events[-1][0]
    for k in range(10_000):
        clock.status(last + k)
    return (fed - start) / seconds * 1e6, (time.process_time() - fed) / 10_000 * 1e6


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=5400)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    ahead = " | ".join(f"{seconds:g} s ahead" for seconds in AHEAD_S)
    fixed = " | ".join(f"line over {window}" for window in WINDOWS)
    print("rms in µs (and normalised by the stated sigma)")
    print(f"| stamps | ramps | locked | {ahead} | {fixed} |")
    print("|" + "---|" * 9)
    for noise_ns in NOISES_NS:
        for ramps in (False, True):
            print(row(noise_ns, ramps, options.seconds, options.seeds), flush=True)
    second, status = cost_us()
    print(f"one second with an edge and four messages: {second:.0f} µs; one status: {status:.0f} µs")


if __name__ == "__main__":
    main()
