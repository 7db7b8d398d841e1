import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxfuzzy import linalg
from jaxfuzzy.arrays import nth_smallest

RNG = np.random.default_rng(0)


def symmetric(size, seed):
    half = np.random.default_rng(seed).normal(size=(size, size))
    return half + half.T


def with_spectrum(values, seed):
    turn = scipy.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
    return turn @ np.diag(values) @ turn.T


def central(function, at, direction, step=1e-5):
    return (function(at + step * direction) - function(at - step * direction)) / (2 * step)


@pytest.mark.parametrize(
    ("rows", "count", "n"),
    [(5, 9, 8), (7, 100, 8), (3, 101, 8), (3, 81, 9), (192, 3072, 8), (3, 1000, 0), (2, 1000, 70), (2, 5000, 70)],
)
def test_the_nth_smallest_is_that_of_sorting(rows, count, n):
    values = RNG.random((rows, count)).round(3)  # with many that are equal
    np.testing.assert_array_equal(nth_smallest(values, n), np.sort(values, axis=1)[:, n])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_guards_at_zero(dtype):
    x = jnp.array([0.0, -1.0, 4.0], dtype)
    assert linalg.root(x).dtype == dtype
    np.testing.assert_array_equal(linalg.root(x), [0, 0, 2])
    np.testing.assert_array_equal(jax.grad(lambda x: linalg.root(x).sum())(x), [0, 0, 0.25])
    np.testing.assert_array_equal(linalg.divide(x, jnp.array([0.0, 2.0, 0.0], dtype), 7.0), [7, -0.5, 7])
    for order in (0, 1):
        slope = jax.grad(lambda *ab: linalg.divide(*ab).sum(), order)(x, jnp.array([0.0, 2.0, 0.0], dtype))
        np.testing.assert_array_equal(slope, [[0, 0.5, 0], [0, 0.25, 0]][order])
    np.testing.assert_array_equal(jax.jacobian(linalg.norm)(jnp.zeros(3, dtype)), [0, 0, 0])
    unit = linalg.normalised(jnp.array([[0, 0], [3, 4]], dtype))
    np.testing.assert_allclose(unit, [[0, 0], [0.6, 0.8]], rtol=2 * jnp.finfo(dtype).eps)


def test_tangents_make_a_right_handed_frame():
    for axis in (*np.eye(3), *-np.eye(3), *linalg.normalised(RNG.normal(size=(20, 3)))):
        frame = np.vstack([linalg.tangents(jnp.asarray(axis)), axis])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=4e-16)
        assert np.linalg.det(frame) == pytest.approx(1)


def test_weighted_moments_by_hand():
    values = np.array([[0.0, 0], [2, 0], [2, 4]])
    mean, scatter = linalg.weighted_moments(values, np.array([[1.0, 1, 0], [1, 0, 3], [0, 0, 0]]))
    np.testing.assert_array_equal(mean, [[1, 0], [1.5, 3], [0, 0]])
    np.testing.assert_array_equal(scatter, [[[1, 0], [0, 0]], [[0.75, 1.5], [1.5, 3]], np.zeros((2, 2))])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_projector(count):
    matrix = symmetric(4, 1)
    vectors = np.linalg.eigh(matrix)[1][:, :count]
    projector = linalg.smallest_projector(matrix, count)
    np.testing.assert_allclose(projector, vectors @ vectors.T, atol=1e-14)


@pytest.mark.parametrize(
    ("values", "count"),
    [([1.0, 2, 3, 4], 2), ([1, 1, 3, 3], 2), ([0, 0, 0, 5, 5, 5], 3), ([1, 4, 4, 4], 1), ([1, 1, 1, 4], 3)],
)
def test_derivative_of_the_projector_beside_repeated_eigenvalues(values, count):
    matrix, change = with_spectrum(values, 2), symmetric(len(values), 3)
    exact = jax.jvp(lambda a: linalg.smallest_projector(a, count), (matrix,), (change,))[1]
    numeric = central(lambda a: linalg.smallest_projector(a, count), matrix, change)
    # central differences of step 1e-5 are right to about 1e-10 of the size of the derivative
    np.testing.assert_allclose(exact, numeric, atol=1e-8)
    weight = symmetric(len(values), 4)
    reverse = jax.grad(lambda a: jnp.sum(weight * linalg.smallest_projector(a, count)))(matrix)
    np.testing.assert_allclose(np.sum(reverse * change), np.sum(weight * numeric), atol=1e-7)


def test_undetermined_projector_has_a_finite_derivative():
    slope = jax.jit(jax.jacfwd(lambda a: linalg.smallest_projector(a, 1)))(np.diag([1.0, 1.0, 2.0]))
    assert np.isfinite(slope).all()


def test_generalised_eigenvector():
    matrix, metric = symmetric(5, 5) @ symmetric(5, 5), with_spectrum([1.0, 1, 2, 3, 4], 6)
    values, vectors = linalg.pencil(matrix, metric)
    expected = scipy.linalg.eigh(matrix, metric)
    # rounding of 8 eps · trace is added to the metric
    np.testing.assert_allclose(values, expected[0], rtol=1e-12)
    np.testing.assert_allclose(vectors.T @ metric @ vectors, np.eye(5), atol=1e-12)
    least = linalg.smallest_eigenvector(matrix, metric)
    np.testing.assert_allclose(np.outer(least, least), np.outer(expected[1][:, 0], expected[1][:, 0]), atol=1e-12)


@pytest.mark.parametrize("others", [[2.0, 3, 4], [2, 2, 2], [5, 5, 1e6]])
def test_derivative_of_the_generalised_eigenvector(others):
    metric = with_spectrum([1.0, 2, 2, 3], 7)
    root = np.linalg.cholesky(metric)
    matrix = root @ with_spectrum([1.0, *others], 8) @ root.T

    def outer(pair):
        least = linalg.smallest_eigenvector(*pair)
        return jnp.outer(least, least)

    pair, change = np.stack([matrix, metric]), np.stack([symmetric(4, 9), symmetric(4, 10)])
    exact = jax.jvp(outer, (pair,), (change,))[1]
    # rounding of the eigenvalue 1e6 in a difference over 2e-5
    np.testing.assert_allclose(exact, central(outer, pair, change), atol=1e-8 if max(others) < 10 else 1e-4)


def test_singular_metric_gives_a_finite_vector_and_derivative():
    matrix, metric = np.diag([1.0, 2.0, 3.0]), np.diag([1.0, 1.0, 0.0])
    np.testing.assert_allclose(np.abs(linalg.smallest_eigenvector(matrix, metric)), [1, 0, 0], atol=1e-12)
    for argument in (0, 1):
        assert np.isfinite(jax.jit(jax.jacfwd(linalg.smallest_eigenvector, argument))(matrix, metric)).all()
    assert np.isfinite(linalg.smallest_eigenvector(np.zeros((3, 3)), np.zeros((3, 3)))).all()


def test_batches():
    matrices = np.stack([symmetric(3, s) for s in range(4)])
    metrics = np.stack([with_spectrum([1.0, 2, 3], s) for s in range(4)])
    batch = jax.vmap(linalg.smallest_eigenvector)(matrices, metrics)
    for i in range(4):
        one = linalg.smallest_eigenvector(matrices[i], metrics[i])
        np.testing.assert_allclose(np.abs(batch[i] @ metrics[i] @ one), 1, atol=1e-13)
