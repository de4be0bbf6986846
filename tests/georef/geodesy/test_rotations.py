"""Tests rotations against the formula sheet and SciPy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.geodesy.rotations import (
    attitude_of,
    boresight,
    quaternion_from_rot,
    rot_from_quaternion,
    rot_l_from_b,
    rot_l_from_plumb,
    skew,
)


def test_matrices_match_the_formula_sheet() -> None:
    attitude = rot_l_from_b(*np.radians([3.0, -2.0, 75.0]))  # FORMULAS 1.4
    expected = [
        [0.2586613795, -0.9650747911, 0.0415323763],
        [0.9653374104, 0.2567000805, -0.0472096686],
        [0.0348994967, 0.0523040746, 0.9980211966],
    ]
    np.testing.assert_allclose(attitude, expected, atol=1e-10)
    first_row = boresight(*np.radians([0.21, -0.35, 0.12]))[0]  # FORMULAS 1.6
    np.testing.assert_allclose(first_row, [0.999979149037, -0.00209435449453, -0.00610861439068], atol=1e-12)


def test_attitude_angles_have_the_documented_signs() -> None:
    nose, right = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert (rot_l_from_b(0, 0, np.radians(90)) @ nose)[1] > 0.999  # heading east: the nose is east
    assert (rot_l_from_b(0, np.radians(10), 0) @ nose)[2] < -0.17  # nose up
    assert (rot_l_from_b(np.radians(10), 0, 0) @ right)[2] > 0.17  # right wing down


def test_attitude_and_quaternions_agree_with_scipy() -> None:
    rng = np.random.default_rng(2)
    turns = Rotation.random(2000, rng=rng)
    matrices = turns.as_matrix()
    ours = quaternion_from_rot(matrices)
    theirs = np.roll(turns.as_quat(canonical=True), 1, axis=1)
    np.testing.assert_allclose(np.abs((ours * theirs).sum(axis=1)), 1.0, atol=1e-14)
    assert (ours[:, 0] >= 0).all()
    np.testing.assert_allclose(rot_from_quaternion(ours), matrices, atol=1e-14)
    roll, pitch, heading = attitude_of(matrices)
    np.testing.assert_allclose(rot_l_from_b(roll, pitch, heading), matrices, atol=1e-12)
    expected = turns.as_euler("ZYX")
    np.testing.assert_allclose(
        np.stack([heading, pitch, roll], axis=1) % (2 * np.pi), expected % (2 * np.pi), atol=1e-9
    )


def test_half_turns_have_a_quaternion() -> None:
    for axis in np.eye(3):
        half_turn = Rotation.from_rotvec(np.pi * axis).as_matrix()
        np.testing.assert_allclose(rot_from_quaternion(quaternion_from_rot(half_turn)), half_turn, atol=1e-14)


def test_the_plumb_line_is_tilted_by_the_deflection() -> None:
    lat, second = np.radians(47.1234567), np.radians(1 / 3600)
    rotation = rot_l_from_plumb(lat, 8 * second, -5 * second)  # FORMULAS 1.8
    np.testing.assert_allclose(1000.0 * rotation[:, 2], [-0.0388, 0.0242, 1000.0], atol=5e-5)
    np.testing.assert_allclose(rotation[:2, 0], [1.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)


def test_the_skew_matrix_gives_the_cross_product() -> None:
    one, other = np.random.default_rng(3).normal(size=(2, 5, 3))
    np.testing.assert_allclose((skew(one) @ other[..., None])[..., 0], np.cross(one, other), atol=1e-14)
