"""The sweep over tiles of points: everything that sums over points, with nothing of size N × K in memory.

Points are centered, scaled to RMS 1 and stored tile by tile as (tiles, D, n), so that distances and sums are small matrix products
that stay in the processor's cache. Padding points have weight 0.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy.arrays import Array, Float, record, static

Sums = TypeVar("Sums")

# Values a tile's distances may hold: with 4-byte floats 128 KiB, which stays in a core's second-level cache.
TILE_VALUES = 32_768


@record
class Tiles:
    """Points in tiles, in units where their weighted mean is 0 and their RMS distance from it is 1.

    Attributes:
        blocks: Tiles of points, one a column: coordinates, squared length, 1. Padding points lie at 0.
        weights: Weight of each point; padding has 0.
        mean: What was taken off, in the input's units.
        scale: What was divided by; 1 where all points are equal.
        spread: RMS distance from the mean in the input's units, 0 where all points are equal.
        count: Number of points N.
    """

    blocks: Float[Array, "T D_2 n"]
    weights: Float[Array, "T n"]
    mean: Float[Array, " D"]
    scale: Float[Array, ""]
    spread: Float[Array, ""]
    count: int = static()


def tile_points(points: Float[Array, "N D"], weights: Float[Array, " N"] | None, clusters: int) -> Tiles:
    """Centers, scales and tiles points for sweeps over a number of clusters."""
    count, dims = points.shape
    # The map that is iterated commutes with shifts and scaling, so the frame itself needs no derivative.
    mean, spread = lax.stop_gradient(frame(points, weights))
    scale = jnp.where(spread > 0, spread, 1)
    inside = (points - mean) / scale
    if weights is None:
        weights = jnp.ones(count, points.dtype)
    else:
        # A point of weight 0 may hold anything finite; it must not reach the sums.
        inside = jnp.where((weights > 0)[:, None], inside, 0)
        weights = weights.astype(points.dtype)
    rows = min(max(256, TILE_VALUES // clusters), count)
    rows = -(-rows // 8) * 8
    tiles = -(-count // rows)
    pad = tiles * rows - count
    inside = jnp.pad(inside, ((0, pad), (0, 0)))
    # With its squared length and a 1 beside each point, distances and sums are one matrix product each.
    design = [inside, jnp.square(inside).sum(axis=1, keepdims=True), jnp.ones_like(inside[:, :1])]
    blocks = jnp.concatenate(design, axis=1).reshape(tiles, rows, dims + 2).transpose(0, 2, 1)
    return Tiles(blocks, jnp.pad(weights, (0, pad)).reshape(tiles, rows), mean, scale, spread, count)


def frame(points: Float[Array, "N D"], weights: Float[Array, " N"] | None) -> tuple[Array, Array]:
    """Weighted mean (D,) and RMS distance from it (), exact far from the origin and at any scale."""
    if weights is None:
        origin, weights = points[0], jnp.ones(points.shape[0], points.dtype)
    else:
        weights = weights.astype(points.dtype) / weights.max()
        origin = points[jnp.argmax(weights)]
    total = weights.sum()
    here = (weights > 0)[:, None]
    offsets = jnp.where(here, points - origin, 0)
    mean = weights @ offsets / total
    offsets = jnp.where(here, offsets - mean, 0)
    largest = jnp.abs(offsets).max()
    unit = jnp.where(largest > 0, largest, 1)
    spread = unit * jnp.sqrt(weights @ jnp.square(offsets / unit).sum(axis=1) / total)
    return origin + mean, spread


def sum_tiles(tiles: Tiles, body: Callable[[Sums, Array, Array], Sums], start: Sums) -> Sums:
    """Adds up over tiles: `body(sums, block (D + 2, n), weights (n,)) -> sums`, one tile in memory at a time.

    Going backward each tile is computed again rather than kept, so a gradient needs no N × K memory either.
    """
    step = jax.checkpoint(lambda sums, tile: (body(sums, *tile), None))
    return lax.scan(step, start, (tiles.blocks, tiles.weights))[0]


def offsets(block: Float[Array, "D_2 n"], centers: Float[Array, "K D"]) -> Float[Array, "K D n"]:
    """From each center to each point of a tile."""
    return block[None, : centers.shape[1]] - centers[:, :, None]


def squared_distances(block: Float[Array, "D_2 n"], centers: Float[Array, "K D"]) -> Float[Array, "K n"]:
    """Squared distances by differences: exact, zero where a point lies on a center."""
    return jnp.square(offsets(block, centers)).sum(axis=1)


def expanded_distances(block: Float[Array, "D_2 n"], centers: Float[Array, "K D"]) -> Float[Array, "K n"]:
    """Squared distances by one matrix product: faster, right to rounding of the data's own scale; never negative."""
    norms = jnp.square(centers).sum(axis=1, keepdims=True)
    factors = jnp.concatenate([-2 * centers, jnp.ones_like(norms), norms], axis=1)
    return jnp.maximum(jnp.matmul(factors, block, precision=lax.Precision.HIGHEST), 0)
