"""Tests oscillators, the pulse per second, and randomness that belongs to a name."""

from __future__ import annotations

import numpy as np

from swath.sim.clocks import Oscillator, PulsePerSecond, generator
from swath.sim.plan.tables import OscillatorTable, PpsTable


def test_an_oscillator_runs_fast_by_its_offset_and_drift() -> None:
    oscillator = Oscillator(10_000_000, OscillatorTable(offset_ppm=2.0, drift_ppm_per_h=3.6))
    rate = np.diff(oscillator.phase(np.array([0.0, 1.0, 1000.0, 1001.0])))[[0, 2]]
    np.testing.assert_allclose(rate / 1e7 - 1, [2.0e-6 + 0.0005e-6, 2.0e-6 + 1.0005e-6], rtol=0, atol=1e-12)


def test_the_periodic_error_is_zero_after_its_period() -> None:
    oscillator = Oscillator(1_000_000, OscillatorTable(wander_ppm=0.5))
    np.testing.assert_allclose(oscillator.phase(np.array([600.0])), 600e6, rtol=0, atol=0.3e3)
    half = oscillator.phase(np.array([300.0]))[0] - 300e6
    np.testing.assert_allclose(half, 0.5 * 600 / np.pi, rtol=1e-9)  # the integral of a half wave, in microseconds


def test_time_of_is_the_inverse_of_the_phase() -> None:
    oscillator = Oscillator(10_000_000, OscillatorTable(offset_ppm=-150.0, drift_ppm_per_h=40.0, wander_ppm=5.0))
    ticks = np.array([0.0, 1e7, 3.3e9])
    np.testing.assert_allclose(oscillator.phase(oscillator.time_of(ticks)), ticks, rtol=0, atol=2e-5)


def test_ticks_are_integers_and_begin_where_the_plan_states() -> None:
    oscillator = Oscillator(1000, OscillatorTable(ticks_at_start=4_294_967_290))
    assert oscillator.ticks(np.array([0.0, 0.0059, 0.006])).tolist() == [4_294_967_290, 4_294_967_295, 4_294_967_296]


def test_edges_do_not_depend_on_how_they_are_requested() -> None:
    one = PulsePerSecond(PpsTable(jitter_ns=50.0), 7, "main", noise=True)
    other = PulsePerSecond(PpsTable(jitter_ns=50.0), 7, "main", noise=True)
    first = one.edges(np.arange(3))
    np.testing.assert_array_equal(other.edges(np.arange(5000))[:3], first)
    late = one.edges(np.arange(5000)) - np.arange(5000)
    assert 45e-9 < late.std() < 55e-9  # 5000 draws: one sigma of the estimate is a hundredth
    assert not np.array_equal(first, PulsePerSecond(PpsTable(), 8, "main", noise=True).edges(np.arange(3)))


def test_the_latest_edge_is_the_last_one_that_has_arrived() -> None:
    pps = PulsePerSecond(PpsTable(jitter_ns=1000.0), 1, "main", noise=True)
    edges = pps.edges(np.arange(10))
    np.testing.assert_array_equal(pps.latest(edges), np.arange(10))
    np.testing.assert_array_equal(pps.latest(edges - 1e-9), np.arange(10) - 1)


def test_without_noise_edges_have_no_jitter() -> None:
    pps = PulsePerSecond(PpsTable(jitter_ns=1000.0), 1, "main", noise=False)
    np.testing.assert_array_equal(pps.edges(np.arange(10)), np.arange(10))


def test_each_purpose_has_its_own_random_numbers() -> None:
    draws = {generator(1, "imu", name).random() for name in ("main", "second")} | {generator(2, "imu", "main").random()}
    assert len(draws) == 3
    assert generator(1, "imu", "main").random() == generator(1, "imu", "main").random()
