"""Losses against sums over pairs and points written out in NumPy, their limits, and central differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy import losses
from jaxfuzzy.fcm import Partition
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Sphere
from jaxfuzzy.validity import variance_ratio, xie_beni

RNG = np.random.default_rng(5)
N, K = 14, 3
PARTS = RNG.dirichlet(np.ones(K + 1), N)
U, NOISE = PARTS[:, :K], PARTS[:, K]
LABELS = np.array([0, 1, 2, -1] * 3 + [0, 2])
WEIGHTS = RNG.integers(1, 4, N).astype(float)
POINTS = RNG.normal(size=(N, 2)) + 3 * np.eye(3, 2)[np.maximum(LABELS, 0)]
CENTERS = POINTS[:K]


def partition(u=U, centers=CENTERS):
    nothing = jnp.zeros(())
    labels = jnp.argmax(jnp.asarray(u), axis=1)
    return Partition(
        jnp.asarray(centers),
        jnp.ones(K) / K,
        jnp.asarray(u),
        1 - jnp.sum(u, axis=1),
        labels,
        nothing,
        1,
        0,
        2.0,
        jnp.inf,
    )


def central(f, x, h=1e-4):
    """Central differences of fourth order by every entry: error h^4, plus rounding over h, about 1e-12 here."""
    x = np.asarray(x, float)
    flat = [
        (8 * (f(x + d) - f(x - d)) - (f(x + 2 * d) - f(x - 2 * d))) / (12 * h)
        for d in h * np.eye(x.size).reshape(x.size, *x.shape)
    ]
    return np.reshape([float(v) for v in flat], x.shape)


OF_MEMBERSHIPS = {
    "soft_rand": lambda u: losses.soft_rand(u, LABELS, weights=WEIGHTS),
    "cross_entropy": lambda u: losses.cross_entropy(u, LABELS, noise=1 - u.sum(axis=1), weights=WEIGHTS),
    "noise_entropy": lambda u: losses.noise_entropy(1 - u.sum(axis=1), LABELS < 0),
    "alignment": lambda u: losses.alignment(u, U[:, ::-1] ** 2, weights=WEIGHTS),
    "held_out": lambda u: losses.held_out(U + 0.5, u, WEIGHTS % 2, (WEIGHTS + 1) % 2, dims=2, extent=9.0),
    "smooth_xie_beni": lambda u: losses.smooth_xie_beni(POINTS, partition(u), weights=WEIGHTS),
    "smooth_variance_ratio": lambda u: losses.smooth_variance_ratio(POINTS, partition(u), weights=WEIGHTS),
}


@pytest.mark.parametrize("name", OF_MEMBERSHIPS)
def test_gradients_by_memberships(name):
    loss = OF_MEMBERSHIPS[name]
    found = jax.grad(loss)(jnp.asarray(U))
    np.testing.assert_allclose(found, central(jax.jit(loss), U), rtol=1e-6, atol=1e-8)
    assert np.abs(found).max() > 1e-3


def test_gradients_by_distances_and_centers():
    held = lambda d: losses.held_out(d, U, WEIGHTS % 2, (WEIGHTS + 1) % 2, dims=1, extent=3.0)
    np.testing.assert_allclose(
        jax.grad(held)(jnp.asarray(U + 0.5)), central(jax.jit(held), U + 0.5), rtol=1e-6, atol=1e-8
    )
    gaps = lambda c: losses.smooth_xie_beni(POINTS, partition(centers=c))
    np.testing.assert_allclose(
        jax.grad(gaps)(jnp.asarray(CENTERS)), central(jax.jit(gaps), CENTERS), rtol=1e-6, atol=1e-8
    )


def lean(axis, angle):
    other = np.cross(axis, [0.3, 0.5, 0.81])
    return np.cos(angle) * np.asarray(axis) + np.sin(angle) * other / np.linalg.norm(other)


UP, FLAT = np.array([0.0, 1.0, 0.0]), np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
# Truth, the same with something changed, and the error by hand; an angle a counts as 1 - cos a.
WRONG = {
    "sphere": (Sphere(np.zeros(3), 2.0), Sphere(np.array([0.2, 0, 0]), 2.1), 0.01 + 0.0025),
    "cylinder, slid along its axis": (Cylinder(np.zeros(3), UP, 0.5, 1.0), Cylinder(UP, -UP, 0.5, 3.0), 0.0),
    "cylinder": (
        Cylinder(np.zeros(3), UP, 0.5, 1.0),
        Cylinder(np.array([0.1, 2, 0]), UP, 0.55, 1.0),
        0.04 + 0.01,
    ),
    "cylinder, turned": (
        Cylinder(np.zeros(3), UP, 0.5, 1.0),
        Cylinder(np.zeros(3), lean(UP, 0.1), 0.5, 1.0),
        1 - np.cos(0.1),
    ),
    "cone": (
        Cone(np.zeros(3), UP, np.arctan(0.5), np.array([0.0, 2.0])),
        Cone(np.array([0, 0.1, 0]), lean(UP, 0.2), np.arctan(0.5) + 0.03, np.array([0.0, 2.0])),
        0.01 + 0.0009 + 1 - np.cos(0.2),
    ),
    "plane": (
        Plane(np.zeros(3), UP, FLAT),
        Plane(np.array([5.0, 0.1, 0]), -UP, FLAT),
        0.01 / 2,
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_shape_error_by_hand(name):
    truth, found, expected = WRONG[name]
    np.testing.assert_allclose(losses.shape_error(found, truth), expected, atol=1e-14)
    np.testing.assert_allclose(losses.shape_error(truth, truth), 0, atol=1e-15)


def test_shape_error_gradient():
    truth, found, _ = WRONG["cone"]
    loss = lambda v: losses.shape_error(Cone(v[:3], found.axis, v[3], found.height), truth)
    at = np.append(found.apex, found.half_angle)
    np.testing.assert_allclose(jax.grad(loss)(jnp.asarray(at)), central(loss, at), rtol=1e-6, atol=1e-9)


def test_shape_error_needs_one_kind():
    sphere, box = Sphere(np.zeros(3), 1.0), Box(np.zeros(3), np.ones(3), np.eye(3), np.ones(3, bool))
    with pytest.raises(TypeError, match="must be a Plane"):
        losses.shape_error(sphere, WRONG["plane"][0])
    with pytest.raises(TypeError, match="got Box"):
        losses.shape_error(box, box)


def pairs(u, labels):
    """Adjusted index by a loop over pairs."""
    own = [i for i in range(len(u)) if labels[i] >= 0]
    both = one = true = count = 0.0
    for i, j in itertools.permutations(own, 2):
        together, same = u[i] @ u[j], labels[i] == labels[j]
        both, one, true, count = both + together * same, one + together, true + same, count + 1
    chance = one * true / count
    return (both - chance) / ((one + true) / 2 - chance)


def test_soft_rand_counts_pairs():
    np.testing.assert_allclose(losses.soft_rand(U, LABELS), pairs(U, LABELS), rtol=1e-12)
    often = np.repeat(np.arange(N), WEIGHTS.astype(int))
    weighed = losses.soft_rand(U, LABELS, weights=WEIGHTS)
    np.testing.assert_allclose(weighed, losses.soft_rand(U[often], LABELS[often]), rtol=1e-12)
    np.testing.assert_allclose(losses.soft_rand(U[:, ::-1], LABELS, weights=WEIGHTS), weighed, rtol=1e-12)


def test_soft_rand_of_crisp_memberships_is_adjusted_rand():
    metrics = pytest.importorskip("sklearn.metrics", reason="the index to compare with is scikit-learn's")
    truth, found = RNG.integers(0, 4, 200), RNG.integers(0, 3, 200)
    expected = metrics.adjusted_rand_score(truth, found)
    np.testing.assert_allclose(losses.soft_rand(np.eye(3)[found], truth), expected, atol=1e-12)
    np.testing.assert_allclose(losses.soft_rand(np.eye(4)[truth], truth), 1, atol=1e-12)
    np.testing.assert_allclose(losses.soft_rand(np.full((200, 3), 1 / 3), truth), 0, atol=1e-12)


def test_cross_entropy_by_hand():
    u = np.array([[0.1, 0.8], [0.7, 0.2], [0.3, 0.3]])
    # Group 0 is the second cluster, group 1 the first, the last point an outlier.
    expected = -(np.log(0.8) + np.log(0.7) + np.log(0.4)) / 3
    found = losses.cross_entropy(u, [0, 1, -1], noise=1 - u.sum(axis=1))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(losses.cross_entropy(u, [0, 1, -1]), -(np.log(0.8) + np.log(0.7)) / 2, rtol=1e-12)
    with pytest.raises(ValueError, match="columns to be matched"):
        losses.cross_entropy(u[:, :1], [0, 1, -1])


def test_noise_entropy_is_balanced():
    noise = np.array([0.9, 0.2, 0.2, 0.4])
    expected = -(np.log(0.9) + (2 * np.log(0.8) + np.log(0.6)) / 3) / 2
    np.testing.assert_allclose(losses.noise_entropy(noise, [True, False, False, False]), expected, rtol=1e-12)
    with pytest.raises(ValueError, match="both sorts"):
        losses.noise_entropy(noise, np.zeros(4, bool))


def test_alignment_is_the_correlation_of_tables():
    share = WEIGHTS / WEIGHTS.sum()
    centered = [np.sqrt(share)[:, None] * (x - share @ x) for x in (U, U**2)]
    one, other = (x @ x.T for x in centered)
    expected = (one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())
    np.testing.assert_allclose(losses.alignment(U, U**2, weights=WEIGHTS), expected, rtol=1e-12)
    np.testing.assert_allclose(losses.alignment(U, 0.5 * U[:, ::-1]), 1, rtol=1e-12)
    # Memberships that are equal everywhere say nothing, so they agree with nothing.
    assert losses.alignment(U, np.full((N, K), 1 / K)) < 1e-6
    with pytest.raises(ValueError, match="same points"):
        losses.alignment(U, U[1:])


def test_held_out_is_a_likelihood():
    fitted, tested = WEIGHTS % 2, (WEIGHTS + 1) % 2
    squares = ((POINTS[:, None] - CENTERS) ** 2).sum(axis=-1)
    total = 0.0
    share = fitted @ U / fitted.sum()
    variance = (fitted @ (U * squares)) / (2 * fitted @ U)
    for i in range(N):
        density = sum(share[k] * np.exp(-squares[i, k] / 2 / variance[k]) / (2 * np.pi * variance[k]) for k in range(K))
        total -= tested[i] * np.log(density + (1 - share.sum()) / 50)
    found = losses.held_out(squares, U, fitted, tested, dims=2, extent=50.0)
    np.testing.assert_allclose(found, total / tested.sum(), rtol=1e-12)
    # A point beyond everything is background, whatever the clusters.
    far = losses.held_out(squares + 1e6 * tested[:, None], U, fitted, tested, dims=2, extent=50.0)
    np.testing.assert_allclose(far, -np.log((1 - share.sum()) / 50), rtol=1e-12)


def test_validity_indices_in_the_limit():
    crisp = partition(np.eye(K)[LABELS % K])
    two = partition()
    # One gap of two centers is its own mean; with many it is the smallest as the sharpness grows.
    expected = xie_beni(POINTS, two) * N / U.sum()
    np.testing.assert_allclose(losses.smooth_xie_beni(POINTS, two, sharpness=500.0), expected, rtol=1e-2)
    ratio = variance_ratio(POINTS, LABELS % K)
    np.testing.assert_allclose(losses.smooth_variance_ratio(POINTS, crisp), -np.log(ratio), rtol=1e-12)
    with pytest.raises(ValueError, match="must carry memberships"):
        losses.smooth_xie_beni(POINTS[1:], two)


def test_resamples_draw_every_point_as_often_on_average():
    weights = losses.resampled(50, 400, seed=3)
    assert weights.shape == (400, 50)
    assert (weights.sum(axis=1) == 50).all()
    # The mean of 400 draws with variance 1 is within five deviations of 1.
    assert np.abs(weights.mean(axis=0) - 1).max() < 5 / 20
    np.testing.assert_array_equal(weights, losses.resampled(50, 400, seed=3))
