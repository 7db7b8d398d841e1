"""Points in tiles: where they lie, their derivative, and how much memory they take on the way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfuzzy as jf
from jaxfuzzy.tiles import FARTHEST, frame, tile_points

# So many clusters make tiles of 256 points: 1,001 of them fill three and a part of a fourth.
COUNT, CLUSTERS, ROWS = 1001, 64, 256
X = np.random.default_rng(0).normal(size=(COUNT, 3)) * [1, 2, 3] + 5
WEIGHTS = np.random.default_rng(1).integers(0, 3, COUNT).astype(float)


def laid_out(x, weights, mean, scale):
    """Tiles as `Tiles` describes them, point by point."""
    blocks = np.zeros((-(-len(x) // ROWS), x.shape[1] + 2, ROWS))
    blocks[:, -1] = 1
    for i, (point, weight) in enumerate(zip(x, weights, strict=True)):
        inside = (point - mean) / scale
        inside = inside if weight > 0 else np.clip(np.nan_to_num(inside, posinf=0, neginf=0), -FARTHEST, FARTHEST)
        blocks[i // ROWS, :, i % ROWS] = [*inside, inside @ inside, 1]
    return blocks


@pytest.mark.parametrize("weights", [None, WEIGHTS])
def test_points_lie_in_their_tiles(weights):
    """Those of weight 0 too, so that they have memberships; but not where no number, or too large a one, would reach the sums."""
    x = X.copy()
    if weights is not None:
        x[np.flatnonzero(weights == 0)[:4]] = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -1e200], [1e9, 0, 0]]
    tiles = tile_points(jnp.asarray(x), None if weights is None else jnp.asarray(weights), CLUSTERS)
    w = np.ones(COUNT) if weights is None else weights
    mean = w[w > 0] @ X[w > 0] / w.sum()
    spread = np.sqrt(w[w > 0] @ np.square(X - mean)[w > 0].sum(axis=1) / w.sum())
    # Rounding of sums of a thousand numbers near 10.
    np.testing.assert_allclose(tiles.mean, mean, rtol=1e-13)
    np.testing.assert_allclose(tiles.spread, spread, rtol=1e-13)
    np.testing.assert_allclose(tiles.blocks, laid_out(x, w, mean, spread), rtol=1e-12, atol=1e-12)
    assert int(tiles.present) == (w > 0).sum()
    if weights is None:
        assert tiles.weights is None
    else:
        np.testing.assert_array_equal(np.asarray(tiles.weights).ravel()[:COUNT], w)
        assert not np.asarray(tiles.weights).ravel()[COUNT:].any()


def test_derivative_by_points():
    mean, scale = jnp.asarray(X.mean(axis=0)), jnp.asarray(2.0)
    mix = np.random.default_rng(2).normal(size=(-(-COUNT // ROWS), 5, ROWS))
    sums = lambda x: (tile_points(x, jnp.asarray(WEIGHTS), CLUSTERS, whole=(mean, scale)).blocks * mix).sum()
    found = np.asarray(jax.jit(jax.grad(sums))(jnp.asarray(X)))
    by_tile = mix.transpose(0, 2, 1).reshape(-1, 5)[:COUNT]
    inside = (X - np.asarray(mean)) / 2
    expected = (by_tile[:, :3] + 2 * by_tile[:, 3:4] * inside) / 2
    np.testing.assert_allclose(found, expected, atol=1e-12)
    step = np.random.default_rng(3).normal(size=X.shape)
    _, forward = jax.jvp(sums, (jnp.asarray(X),), (jnp.asarray(step),))
    np.testing.assert_allclose(forward, (expected * step).sum(), rtol=1e-10)


def test_frame_of_many_points_in_single_precision():
    x = np.random.default_rng(0).normal(size=(3_000_000, 3)).astype(np.float32)
    mean, spread = jax.jit(lambda x: frame(x, None))(x)
    # A running sum in single precision was off by 2.7e-3 here; one that adds up in a tree errs by a few units of rounding (6e-8).
    np.testing.assert_allclose(spread, np.sqrt(np.square(x, dtype=float).sum() / len(x)), rtol=2e-6)
    np.testing.assert_allclose(mean, x.mean(axis=0, dtype=float), atol=2e-6)


@pytest.mark.parametrize("weighted", [False, True])
def test_memory_of_a_fit(weighted):
    # Known without running: what the compiled fit takes beside its arguments, over the size of the points.
    count = 2_000_001
    x, seeds = (jax.ShapeDtypeStruct((n, 3), jnp.float32) for n in (count, 8))
    weights = jax.ShapeDtypeStruct((count,), jnp.float32) if weighted else None
    fit = jax.jit(lambda x, seeds, weights: jf.fcm(x, seeds, weights=weights, memberships=False).centers)
    needs = fit.lower(x, seeds, weights).compile().memory_analysis().temp_size_in_bytes / (12 * count)
    # Coordinates, squared length, 1 and weight, where there is one, make 2; the rest, a tile at a time, is 0.02 now. Twice the
    # points were 3.7.
    held = 2 if weighted else 5 / 3
    assert held <= needs < held + 0.1
