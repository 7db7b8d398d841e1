import jax
import numpy as np
import pytest

from jaxfuzzy import embedding

POINTS = np.random.default_rng(0).normal(size=(7, 3))
X, Y, Z = POINTS.T
EXPECTED = {
    "3d": [X, Y, Z],
    "4d": [X**2, Z**2, X, Z],
    "6d": [X**2, Y**2, Z**2, X, Y, Z],
    "cylinder": [X**2 + Z**2, X, Z],
    "sphere": [X**2 + Y**2 + Z**2, X, Y, Z],
    "cone": [X**2 + Z**2, Y**2, X, Y, Z],
    "9d": [X**2, Y**2, Z**2, X * Y, Y * Z, Z * X, X, Y, Z],
    "linear": [X, Y, Z],
}
names = pytest.mark.parametrize("name", embedding.NAMES)


@names
def test_features(name):
    expected = np.stack(EXPECTED[name], 1)
    assert embedding.size(name) == expected.shape[1]
    np.testing.assert_allclose(embedding.features(POINTS, name), expected, rtol=4e-16)


@names
def test_gradients_are_derivatives(name):
    expected = jax.vmap(jax.jacfwd(lambda p: embedding.features(p[None], name)[0]))(POINTS)
    np.testing.assert_allclose(embedding.gradients(POINTS, name), expected, rtol=4e-16)


def test_linear_takes_any_dimension():
    points = np.random.default_rng(1).normal(size=(4, 5))
    np.testing.assert_array_equal(embedding.features(points, "linear"), points)
    np.testing.assert_array_equal(embedding.gradients(points, "linear"), np.tile(np.eye(5), (4, 1, 1)))
    with pytest.raises(ValueError, match="embedding must be 'linear' for points of 5 coordinates, got '6d'"):
        embedding.table("6d", 5)
    with pytest.raises(ValueError, match=r"embedding must be one of '3d', .*, got '5d'"):
        embedding.table("5d")


def test_padding():
    tables, real = embedding.padded_tables(("3d", "cone", "9d"))
    assert tables.shape == (3, 9, 9)
    assert real.sum(1).tolist() == [3, 5, 9]
    np.testing.assert_array_equal(tables[1, :5], embedding.table("cone"))
    assert (tables[~real] == 0).all()


@pytest.mark.parametrize("dims", [2, 3])
def test_monomials_of_a_moved_and_scaled_frame(dims):
    points, shift = POINTS[:, :dims], np.array([0.3, -2.0, 1.0])[:dims]
    matrix, constant = embedding.monomials_of_affine(np.array(1.7), shift)
    expected = embedding.monomials(1.7 * points + shift)
    np.testing.assert_allclose(embedding.monomials(points) @ matrix.T + constant, expected, atol=1e-14)


@names
def test_unmixed_is_the_pseudo_inverse(name):
    table = embedding.table(name)
    np.testing.assert_allclose(embedding.unmixed(table), np.linalg.pinv(table).T, atol=1e-15)


def test_float32_stays():
    assert embedding.features(POINTS.astype(np.float32), "6d").dtype == np.float32
    assert embedding.gradients(POINTS.astype(np.float32), "6d").dtype == np.float32
