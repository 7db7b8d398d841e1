"""Implicit derivatives of fuzzy c-means against central differences of the whole fit, in float64, corners included."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxfuzzy.alternation import smooth_powers, step, step_jacobian
from jaxfuzzy.fcm import NoiseRule, fcm
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import tile_points

# Fits stand still to rounding over one minus their contraction.
EXACT = Solver(max_steps=20_000, tol=1e-15)


def blobs(seed=0):
    rng = np.random.default_rng(seed)
    centers = np.array([[0, 0, 0], [4, 0, 0], [0, 5, 1]])
    x = np.concatenate([c + rng.normal(size=(n, 3)) for c, n in zip(centers, (20, 30, 15), strict=True)])
    return jnp.asarray(x), jnp.asarray(centers + 0.3)


def fourth_order(f, h):
    """Central difference of fourth order: its own error is about h^4 plus rounding over h."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


@partial(jax.jit, static_argnames=("sizes", "pieces"))
def _loss(seeds, m, noise, x, w, *, sizes, pieces):
    p = fcm(x, seeds, m=m, noise_distance=noise, weights=w, sizes=sizes, solver=EXACT)
    if pieces == "centers":
        return jnp.sum(jnp.sin(p.centers)) + p.objective / x.shape[0]
    return (
        jnp.sum(jnp.sin(p.centers))
        + 3 * jnp.sum(p.sizes**2)
        + jnp.mean(jnp.cos(3 * p.memberships))
        + jnp.mean(p.noise**2)
        + p.objective / x.shape[0]
    )


def loss_of(seeds, sizes, pieces="all"):
    return lambda *at: _loss(seeds, *at, sizes=sizes, pieces=pieces)


def check(loss, m, noise, x, w, *, m_step=1e-3, places=((7, 1), (40, 0)), tolerance=1e-6):
    """Every derivative within 1e-6, relative to one or to itself, of central differences of the refitted loss."""
    grads = jax.grad(loss, argnums=(0, 1, 2, 3))(m, noise, x, w)

    def agree(derivative, change, h):
        expected = fourth_order(change, h)
        np.testing.assert_allclose(derivative, expected, rtol=tolerance, atol=tolerance)

    agree(grads[0], lambda e: loss(m + e, noise, x, w), m_step)
    agree(grads[1], lambda e: loss(m, noise + e, x, w), 1e-3)
    for k, d in places:
        agree(grads[2][k, d], lambda e, k=k, d=d: loss(m, noise, x.at[k, d].add(e), w), 1e-3)
        agree(grads[3][k], lambda e, k=k: loss(m, noise, x, w.at[k].add(e)), 1e-3)


@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("m", [1.5, 2.0])
def test_every_argument(sizes, m):
    x, seeds = blobs()
    check(loss_of(seeds, sizes), m, 2.5, x, jnp.ones(x.shape[0]))


@pytest.mark.parametrize("m", [1.05, 8.0])
def test_extreme_fuzzifiers(m):
    x, seeds = blobs()
    # Near 1 the loss bends within 1e-3 of m, so the difference takes a smaller step there.
    check(loss_of(seeds, False), m, 2.5, x, jnp.ones(x.shape[0]), m_step=1e-5 if m < 1.1 else 1e-3)


def test_one_cluster():
    x, seeds = blobs()
    check(loss_of(seeds[:1], False), 2.0, 4.0, x, jnp.ones(x.shape[0]))


@pytest.mark.parametrize("m", [1.5, 2.0, 5.0])
def test_a_point_on_a_center(m):
    # Symmetric about each center, so that a point lies exactly on it. Its own membership has a derivative only for m < 3.
    star = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
    x = jnp.asarray(np.concatenate([star, star * [[1, 1]] + [[6, 0]]]))
    x = jnp.concatenate([x, jnp.asarray([[3.0, 4.0], [3.0, -4.0]])])
    seeds = jnp.asarray([[0.0, 0], [6, 0]])
    on = fcm(x, seeds, m=m, noise_distance=3.0, solver=EXACT)
    # Moved onto the fixed point exactly, the center stays where it is.
    x = x.at[0].set(on.centers[0])
    for _ in range(200):
        x = x.at[0].set(fcm(x, seeds, m=m, noise_distance=3.0, solver=EXACT).centers[0])
    loss = loss_of(seeds, False, "all" if m < 3 else "centers")
    grads = jax.grad(loss, argnums=(0, 1))(m, 3.0, x, jnp.ones(x.shape[0]))
    ones = jnp.ones(x.shape[0])
    # Moved off the point by h, the center feels |h|^(2 / (m - 1)): for large m only a small step tells the derivative at h = 0.
    h = 1e-3 if m < 3 else 1e-7
    np.testing.assert_allclose(grads[0], fourth_order(lambda e: loss(m + e, 3.0, x, ones), h), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(grads[1], fourth_order(lambda e: loss(m, 3.0 + e, x, ones), h), rtol=1e-6, atol=1e-6)
    assert all(np.isfinite(np.asarray(g)).all() for g in jax.grad(loss, argnums=(2, 3))(m, 3.0, x, ones))


def test_nearly_merged_centers():
    # Two lumps so close that their centers are almost one: the derivative is large and still right.
    rng = np.random.default_rng(3)
    x = jnp.asarray(
        np.concatenate(
            [rng.normal(size=(40, 2)), rng.normal(size=(40, 2)) + [2.2, 0], rng.normal(size=(30, 2)) + [9, 0]]
        )
    )
    seeds = jnp.asarray([[0.0, 0], [2.2, 0], [9, 0]])
    check(loss_of(seeds, False), 3.0, 6.0, x, jnp.ones(x.shape[0]), tolerance=2e-6)


def test_forward_equals_reverse():
    x, seeds = blobs()
    loss = lambda m: jnp.sum(fcm(x, seeds, m=m, sizes=True, noise_distance=2.0, solver=EXACT).centers ** 2)
    np.testing.assert_allclose(jax.jvp(loss, (1.7,), (1.0,))[1], jax.grad(loss)(1.7), rtol=1e-10)


def test_step_derivative_is_that_of_the_step():
    x, seeds = blobs()
    for sizes in (False, True):
        p = fcm(x, seeds, m=1.7, sizes=sizes, noise_distance=2.0, solver=EXACT)
        tiles = tile_points(x, None, 3)
        theta = {"centers": (p.centers - tiles.mean) / tiles.scale}
        if sizes:
            theta["log_sizes"] = jnp.log(p.sizes)
        args = (tiles, jnp.asarray(1.7), (2.0 / tiles.scale) ** 2, None)
        flat, unravel = ravel_pytree(theta)

        def flat_step(y, unravel=unravel, args=args, sizes=sizes):
            return ravel_pytree(step(unravel(y), args, sizes=sizes, powers=smooth_powers, exact=True)[0])[0]

        expected = jax.jit(jax.jacfwd(flat_step))(flat)
        np.testing.assert_allclose(step_jacobian(theta, args, sizes=sizes), expected, atol=1e-13)


def test_a_singular_item_leaves_the_batch_alone():
    # Coincident centers make I - J singular; that item's derivative is finite, its neighbour's as if alone.
    x, seeds = blobs()
    starts = jnp.stack([seeds, seeds.at[1].set(seeds[0])])
    loss = lambda m, start: jnp.sum(fcm(x, start, m=m, solver=EXACT).centers ** 2)
    both = jax.vmap(jax.grad(loss), in_axes=(None, 0))(1.7, starts)
    np.testing.assert_allclose(both[0], jax.grad(loss)(1.7, seeds), rtol=1e-9)
    assert np.isfinite(both).all()
    assert int(fcm(x, starts[1], m=1.7, solver=EXACT).status) & Status.UNSTABLE


def test_gradient_through_a_noise_rule():
    x, seeds = blobs()
    loss = lambda factor: jnp.sum(fcm(x, seeds, noise_distance=NoiseRule("dave", factor), solver=EXACT).centers ** 2)
    fixed = lambda noise: jnp.sum(fcm(x, seeds, noise_distance=noise, solver=EXACT).centers ** 2)
    # delta = sqrt(lambda mean D): moving lambda moves delta alone, since the fit without noise does not know it.
    delta = float(fcm(x, seeds, noise_distance=NoiseRule("dave", 0.3), solver=EXACT).noise_distance)
    by_rule = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(fixed)(delta) * delta / (2 * 0.3), by_rule, rtol=1e-6)
