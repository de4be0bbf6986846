"""Tests quaternion arithmetic against SciPy's rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.quaternions import about, conjugate, product, rotated, rotation_vector
from tests.georef.builders import as_rotation


def some(seed: int, n: int = 500) -> FloatArray:
    q = np.random.default_rng(seed).normal(size=(n, 4))
    unit: FloatArray = q / np.linalg.norm(q, axis=1, keepdims=True)
    return unit


def test_rotations_about_axes_are_right_handed() -> None:
    for axis, letter in enumerate("xyz"):
        angles = np.linspace(-7, 7, 50)
        expected = Rotation.from_euler(letter, angles[:, np.newaxis])
        assert (as_rotation(about(axis, angles)) * expected.inv()).magnitude().max() < 1e-14


def test_a_product_is_the_composition_of_the_rotations() -> None:
    a, b = some(1), some(2)
    expected = as_rotation(a) * as_rotation(b)
    assert (as_rotation(product(a, b)) * expected.inv()).magnitude().max() < 1e-14
    np.testing.assert_array_equal(product(a[0], b), product(np.broadcast_to(a[0], b.shape), b))
    np.testing.assert_allclose(product(a, conjugate(a)), np.tile([1.0, 0, 0, 0], (500, 1)), atol=1e-15)


def test_vectors_are_rotated_as_in_scipy() -> None:
    q, vectors = some(3), np.random.default_rng(4).normal(size=(500, 3))
    np.testing.assert_allclose(rotated(q, vectors), as_rotation(q).apply(vectors), atol=1e-14)


def test_the_rotation_vector_takes_the_shorter_way() -> None:
    q = np.concatenate([some(5), about(1, np.array([0.0, 1e-300, 1e-9, np.pi, 4.0]))])
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(rotation_vector(sign * q)[:-2], as_rotation(q).as_rotvec()[:-2], atol=1e-14)
    np.testing.assert_allclose(rotation_vector(q)[-2:], [[0, np.pi, 0], [0, 4 - 2 * np.pi, 0]], atol=1e-14)
    np.testing.assert_array_equal(rotation_vector(np.full((1, 4), np.nan)), np.full((1, 3), np.nan))
