"""Tests the sampler against integrals in closed form, with jittering stamps and cut, lost or spoilt rows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.navigation.inputs import Inertial, NavigationError
from swath.georef.navigation.samples import Sampler, SampleRule, StampRule
from swath.georef.records import IMU_DTYPE

EPOCH_NS = 1_447_000_000_000_000_000
RATE_HZ = 200.0
TURN = np.array([0.3, -0.2, 0.5])  # rad/s, of the motion below
FORCE = np.array([1.0, 2.0, -9.8])


def rate(t: FloatArray) -> FloatArray:
    return TURN * np.cos(3.0 * t)[:, None]


def rate_integral(t: FloatArray) -> FloatArray:
    return TURN * (np.sin(3.0 * t) / 3.0)[:, None]


def rows_of(force: FloatArray, turn: FloatArray) -> StructArray:
    rows = np.zeros(len(turn), IMU_DTYPE)
    rows["specific_force_b"], rows["angular_rate_b"] = force, turn
    return rows


def means(edges_s: FloatArray) -> StructArray:
    """Return what a perfect unit measures as means over the intervals between edges."""
    turn = np.diff(rate_integral(edges_s), axis=0) / np.diff(edges_s)[:, None]
    return rows_of(np.broadcast_to(FORCE, turn.shape), turn)


def ns(t: FloatArray) -> Int64Array:
    return EPOCH_NS + np.rint(t * 1e9).astype(np.int64)


def joined(parts: Iterable[Inertial]) -> Inertial:
    columns = list(zip(*[(p.time_ns, p.interval_s, p.angle_b, p.velocity_b, p.bridged) for p in parts], strict=True))
    return Inertial(*[np.concatenate(column) for column in columns])


def same(a: Inertial, b: Inertial) -> bool:
    fields = ("time_ns", "interval_s", "angle_b", "velocity_b", "bridged")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in fields)


def one_by_one(rows: StructArray, time_ns: Int64Array, **options: Any) -> tuple[Inertial, Sampler]:
    sampler = Sampler(RATE_HZ, **options)
    return joined([sampler.feed(rows[k : k + 1], time_ns[k : k + 1]) for k in range(len(rows))]), sampler


def test_means_become_increments_over_the_true_intervals() -> None:
    rng = np.random.default_rng(1)
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.006, 2000))])  # uneven sampling with true stamps
    got = Sampler(RATE_HZ).feed(means(edges), ns(edges[1:]))
    assert len(got) == 2000
    assert not got.bridged.any()
    np.testing.assert_allclose(got.angle_b[1:], np.diff(rate_integral(edges), axis=0)[1:], atol=1e-9)
    np.testing.assert_allclose(got.interval_s[1:], np.diff(edges)[1:], atol=2e-9)
    assert got.interval_s[0] == 0.005


def test_jitter_of_timestamps_does_not_reach_the_increments() -> None:
    rng = np.random.default_rng(2)
    edges = np.arange(20001) / RATE_HZ
    stamps = edges[1:] + rng.uniform(-0.002, 0.002, 20000)  # even sampling with bad stamps
    got = Sampler(RATE_HZ).feed(means(edges), ns(stamps))
    # In free fall this must be zero: force + gravity over each interval depends on the sensor, not on the stamp.
    left = got.velocity_b - FORCE * got.interval_s[:, None]
    assert np.abs(left).max() < 1e-12
    assert np.abs(got.velocity_b[:, 2] + 9.8 / RATE_HZ).max() > 0.015  # nominal intervals would leave this over
    assert abs(got.interval_s[1:].sum() - (stamps[-1] - stamps[0])) < 1e-7
    turned = np.cumsum(got.angle_b, axis=0) - rate_integral(stamps)
    assert np.abs(turned - turned.mean(axis=0)).max() < 1.5e-3  # rad, no more than a stamp's error times the rate


def test_increments_are_those_of_the_device_whatever_its_timestamps() -> None:
    rng = np.random.default_rng(3)
    edges = np.arange(2001) / RATE_HZ
    got = Sampler(RATE_HZ, sample="increment").feed(means(edges), ns(edges[1:] + rng.uniform(-0.002, 0.002, 2000)))
    np.testing.assert_allclose(got.angle_b, np.diff(rate_integral(edges), axis=0), atol=1e-15)


def test_instantaneous_samples_are_averaged_over_the_interval_between_them() -> None:
    t = np.arange(1, 2001) / RATE_HZ
    got = Sampler(RATE_HZ, sample="instant", stamp="middle").feed(
        rows_of(np.broadcast_to(FORCE, (2000, 3)), rate(t)), ns(t)
    )
    assert np.array_equal(got.time_ns, ns(t))
    # Trapezia err by h³/12 times the second derivative; a sample taken as its interval's mean errs by h²/2 · rate'.
    np.testing.assert_allclose(got.angle_b[1:], np.diff(rate_integral(t), axis=0), atol=1.05 * 0.5 * 9 * 0.005**3 / 12)


@pytest.mark.parametrize(("stamp", "late"), [("end", 0.0), ("middle", 0.0025), ("start", 0.005)])
def test_the_timestamp_rule_places_the_interval(stamp: StampRule, late: float) -> None:
    edges = np.arange(101) / RATE_HZ
    got = Sampler(RATE_HZ, stamp=stamp).feed(means(edges), ns(edges[1:] - late))
    assert np.array_equal(got.time_ns, ns(edges[1:]))


def test_rotation_converts_imu_axes_to_body_axes() -> None:
    rotation = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    got = Sampler(RATE_HZ, rot_b_from_imu=rotation).feed(
        rows_of(np.tile([1.0, 2.0, 3.0], (3, 1)), np.tile([4.0, 5.0, 6.0], (3, 1))), ns(np.arange(3) / RATE_HZ)
    )
    np.testing.assert_allclose(got.velocity_b[1] * RATE_HZ, [2.0, 1.0, -3.0])
    np.testing.assert_allclose(got.angle_b[1] * RATE_HZ, [5.0, 4.0, -6.0])


@pytest.mark.parametrize("sample", ["mean", "instant", "increment"])
def test_short_gaps_are_bridged_and_marked(sample: SampleRule) -> None:
    edges = np.arange(401) / RATE_HZ
    rows, stamps = means(edges), ns(edges[1:])
    if sample == "instant":
        rows = rows_of(np.broadcast_to(FORCE, (400, 3)), rate(edges[1:]))
    lost = np.r_[100:109, 250]
    sampler = Sampler(RATE_HZ, sample=sample)
    got = sampler.feed(np.delete(rows, lost), np.delete(stamps, lost))
    whole = Sampler(RATE_HZ, sample=sample).feed(rows, stamps)
    assert np.array_equal(got.time_ns, whole.time_ns)
    made_up = np.zeros(400, dtype=bool)
    made_up[lost] = True
    assert np.array_equal(got.bridged, made_up)
    assert sampler.counts == {"bridged": 10}
    assert sampler.gaps == []
    np.testing.assert_allclose(got.interval_s, whole.interval_s, atol=1e-9)
    sound = ~np.isin(np.arange(400), np.r_[lost, lost + 1])
    np.testing.assert_allclose(got.angle_b[sound], whole.angle_b[sound], atol=1e-15)
    # A straight line over 50 ms of cos 3t errs by at most 9 · 0.05² / 8 of the rate.
    np.testing.assert_allclose(got.angle_b, whole.angle_b, atol=0.5 * 0.005 * 9 * 0.05**2 / 8 * 1.1)


def test_long_gaps_end_the_piece_and_are_reported() -> None:
    edges = np.arange(401) / RATE_HZ
    rows, stamps = np.delete(means(edges), np.s_[100:220]), np.delete(ns(edges[1:]), np.s_[100:220])
    sampler = Sampler(RATE_HZ)
    got = sampler.feed(rows, stamps)
    assert np.array_equal(got.time_ns, stamps)
    assert sampler.gaps == [(int(stamps[99]), int(stamps[99]) + 600_000_000)]
    assert got.interval_s[100] == 0.005
    assert not got.bridged.any()


def test_unusable_rows_are_counted_by_reason() -> None:
    edges = np.arange(1001) / RATE_HZ
    rows, stamps = means(edges), ns(edges[1:])
    rows["angular_rate_b"][50, 1] = np.nan
    rows["specific_force_b"][60, 0] = -40.0
    stamps[100] = stamps[99]
    stamps[200] = stamps[190]
    stamps[300] += 604_800_000_000_000  # one wrong stamp must not make all later ones be refused
    stamps[400] -= 604_800_000_000_000
    sampler = Sampler(RATE_HZ, full_scale=(40.0, 10.0))
    got = sampler.feed(rows, stamps)
    assert sampler.counts == {
        "not_finite": 1,
        "saturated": 1,
        "duplicate": 1,
        "out_of_order": 1,
        "stamp_outlier": 1,
        "time_jumped_back": 1,
        "bridged": 5,
    }
    assert len(got) == 1000
    assert np.flatnonzero(got.bridged).tolist() == [50, 60, 100, 200, 300, 400]
    assert sampler.gaps == []


def test_a_permanent_time_jump_is_followed_forwards() -> None:
    edges = np.arange(201) / RATE_HZ
    stamps = ns(edges[1:])
    stamps[100:] += 604_800_000_000_000
    sampler = Sampler(RATE_HZ)
    assert np.array_equal(sampler.feed(means(edges), stamps).time_ns, stamps)
    assert len(sampler.gaps) == 1


@pytest.mark.parametrize("sample", ["mean", "instant", "increment"])
def test_results_do_not_depend_on_how_rows_are_cut(sample: SampleRule) -> None:
    rng = np.random.default_rng(4)
    edges = np.arange(3001) / RATE_HZ
    rows, stamps = means(edges), ns(edges[1:] + rng.uniform(-0.002, 0.002, 3000))
    stamps[700:] += 2_000_000_000
    stamps[1500] += 3_000_000_000
    rows["angular_rate_b"][rng.integers(0, 3000, 20), 0] = np.inf
    keep = np.sort(rng.permutation(3000)[:2900])
    rows, stamps = rows[keep], stamps[keep]
    sampler = Sampler(RATE_HZ, sample=sample)
    whole = sampler.feed(rows, stamps)
    cuts = np.sort(rng.integers(0, 2900, 40))
    other = Sampler(RATE_HZ, sample=sample)
    pieces = [other.feed(r, t) for r, t in zip(np.split(rows, cuts), np.split(stamps, cuts), strict=True)]
    single, alone = one_by_one(rows, stamps, sample=sample)
    assert same(whole, joined(pieces))
    assert same(whole, single)
    assert sampler.counts == other.counts == alone.counts
    assert sampler.gaps == other.gaps == alone.gaps
    assert len(sampler.gaps) == 1
    assert sampler.counts["stamp_outlier"] == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate_hz": 0.0}, "rate_hz: got 0.0"),
        ({"rate_hz": 100.0, "sample": "means"}, 'sample: got "means"'),
        ({"rate_hz": 100.0, "stamp": "begin"}, 'stamp: got "begin"'),
        (
            {"rate_hz": 100.0, "rot_b_from_imu": np.diag([1.0, 1.0, -1.0])},
            "rotation_b_imu: the rows are not a rotation",
        ),
        ({"rate_hz": 100.0, "rot_b_from_imu": 2 * np.eye(3)}, "rotation_b_imu: the rows are not a rotation"),
    ],
)
def test_wrong_options_are_refused_with_their_reason(options: dict[str, Any], words: str) -> None:
    with pytest.raises(NavigationError, match=words):
        Sampler(**options)
