"""The sweep over tiles of points: everything that sums over points, with nothing of size N × K in memory.

Points are centered, scaled to RMS 1 and stored tile by tile as (tiles, D, n), so that distances and sums are small matrix products
that stay in the processor's cache. Padding points have weight 0.

Over several devices each holds its own tiles and sweeps them alone; only the sums travel, by one all-reduce a sweep.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxfuzzy.arrays import Array, Float, Int, record, static

Sums = TypeVar("Sums")

# Values a tile's distances may hold: with 4-byte floats 64 KiB, which stays in a core's second-level cache.
TILE_VALUES = 16_384
# A point of weight 0 is where it is, so that it has memberships and its weight a derivative; but no farther from the others, in
# their own spread, than a sum that it is multiplied by 0 in can bear.
FARTHEST = 1e6


@dataclass(frozen=True)
class Parts:
    """The devices among which points are divided.

    Attributes:
        mesh: The devices.
        axes: Names of the mesh's axes along which points are divided; along others they are repeated.
    """

    mesh: Mesh
    axes: tuple[str, ...]

    @classmethod
    def of(cls, points: Any, mesh: Mesh | None) -> "Parts | None":
        """Along all axes of a mesh that was asked for, or as an array's first axis is divided already; None: one device."""
        axes: Any = None
        if mesh is not None:
            axes = mesh.axis_names
        elif isinstance(points, jax.Array) and not isinstance(points, jax.core.Tracer):
            kind = points.sharding
            if isinstance(kind, NamedSharding) and isinstance(kind.mesh, Mesh) and len(kind.spec) and kind.spec[0]:
                mesh, axes = kind.mesh, kind.spec[0]
        if mesh is None or mesh.size == 1:
            return None
        # The mesh of devices alone: whether its owner wants shardings in types is no business of the sums.
        plain = Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,) * len(mesh.axis_names))
        return cls(plain, (axes,) if isinstance(axes, str) else tuple(axes))

    @property
    def count(self) -> int:
        """Number of parts."""
        sizes = dict(self.mesh.shape)
        return math.prod(sizes[name] for name in self.axes)

    def place(self, array: Array) -> Array:
        """Divides a known array where it comes out even; the rest is done by `split` inside the compiled function."""
        if isinstance(array, jax.core.Tracer) or array.shape[0] % self.count:
            return array
        return jax.device_put(array, NamedSharding(self.mesh, PartitionSpec(self.axes)))

    def split(self, array: Array) -> Array:
        """An array with its first axis divided among the devices, zeros added where it does not come out even."""
        array = jnp.pad(array, [(0, -array.shape[0] % self.count)] + [(0, 0)] * (array.ndim - 1))
        return lax.with_sharding_constraint(array, NamedSharding(self.mesh, PartitionSpec(self.axes)))

    def each(self, do: Callable[..., Any], *arrays: Array, whole: bool = False) -> Any:
        """Does something to each part of some arrays; `whole` where the outcome is the same for all."""
        divided = PartitionSpec(self.axes)
        out = PartitionSpec() if whole else divided
        return jax.shard_map(do, mesh=self.mesh, in_specs=divided, out_specs=out)(*arrays)

    def total(self, sums: Any) -> Any:
        """Adds up what each part has summed; to be called inside `each`."""
        return lax.psum(sums, self.axes)

    def largest(self, value: Array) -> Array:
        """The largest value of any part; to be called inside `each`."""
        return lax.pmax(value, self.axes)


@record
class Tiles:
    """Points in tiles, in units where their weighted mean is 0 and their RMS distance from it is 1.

    Attributes:
        blocks: Tiles of points, one a column: coordinates, squared length, 1. Where padding lies is of no account.
        weights: Weight of each point; padding has 0. None where all points weigh the same, on one device.
        mean: What was taken off, in the input's units.
        scale: What was divided by; 1 where all points are equal.
        spread: RMS distance from the mean in the input's units, 0 where all points are equal.
        present: How many points have weight.
        count: Number of points N.
        parts: The devices that hold the tiles; None: one.
    """

    blocks: Float[Array, "T D_2 n"]
    weights: Float[Array, "T n"] | None
    mean: Float[Array, " D"]
    scale: Float[Array, ""]
    spread: Float[Array, ""]
    present: Int[Array, ""]
    count: int = static()
    parts: Parts | None = static(default=None)


def tile_points(
    points: Float[Array, "N D"],
    weights: Float[Array, " N"] | None,
    clusters: int,
    parts: Parts | None = None,
    whole: tuple[Array, Array] | None = None,
) -> Tiles:
    """Centers, scales and tiles points for sweeps over a number of clusters.

    Args:
        points: The points.
        weights: Their weights.
        clusters: How many clusters will be swept.
        parts: The devices to divide them among.
        whole: Mean and spread where these points are but a block of all.
    """
    count = points.shape[0]
    # The map that is iterated commutes with shifts and scaling, so the frame itself needs no derivative.
    mean, spread = lax.stop_gradient(frame(points, weights) if whole is None else whole)
    scale = jnp.where(spread > 0, spread, 1)
    own = count if parts is None else -(-count // parts.count)
    # A power of two: matrix products with other numbers of rows took three to five times as long on a CPU.
    rows = min(max(256, 1 << ((TILE_VALUES // clusters).bit_length() - 1)), own)
    rows = -(-rows // 8) * 8
    if weights is None and parts is None:
        blocks = _design(rows, points, None, mean, scale)
        return Tiles(blocks, None, mean, scale, spread, jnp.asarray(count), count)
    weights = jnp.ones(count, points.dtype) if weights is None else weights.astype(points.dtype)
    present = (weights > 0).sum()
    lay = partial(_lay_out, mean, scale, rows, parts)
    if parts is None:
        blocks, weights = lay(points, weights)
    else:
        blocks, weights = parts.each(lay, parts.split(points), parts.split(weights))
    return Tiles(blocks, weights, mean, scale, spread, present, count, parts)


def _lay_out(
    mean: Array, scale: Array, rows: int, parts: Parts | None, points: Array, weights: Array
) -> tuple[Array, Array]:
    if parts is not None:
        mean, scale = lax.pcast((mean, scale), parts.axes, to="varying")
    weights = _cut(weights[:, None], rows)[:, 0]
    return _design(rows, points, weights, mean, scale), weights


def _cut(array: Float[Array, "N D"], rows: int) -> Float[Array, "T D n"]:
    array = jnp.pad(array, ((0, -array.shape[0] % rows), (0, 0)))
    return array.reshape(-1, rows, array.shape[1]).transpose(0, 2, 1)


def _present(count: int, rows: int, tile: Array) -> Array:
    """Which places of a tile hold one of so many points."""
    return tile * rows + jnp.arange(rows) < count


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _design(
    rows: int,
    points: Float[Array, "N D"],
    weights: Float[Array, "T n"] | None,
    mean: Float[Array, " D"],
    scale: Float[Array, ""],
) -> Float[Array, "T D_2 n"]:
    """Tiles of points as `Tiles` holds them, made one by one: all at once would hold the points two more times on the way."""
    count, tiles = points.shape[0], -(-points.shape[0] // rows)

    def put(at: Array, blocks: Array) -> Array:
        cut = points.at[at * rows + jnp.arange(rows)].get(mode="fill", fill_value=0, indices_are_sorted=True)
        inside = (cut.T - mean[:, None]) / scale
        if weights is not None:
            inside = jnp.where(weights[at] > 0, inside, tame(inside))
        inside = jnp.where(_present(count, rows, at), inside, 0)
        # With its squared length and a 1 beside each point, distances and sums are one matrix product each.
        longer = [inside, jnp.square(inside).sum(axis=0, keepdims=True), jnp.ones_like(inside[:1])]
        return blocks.at[at].set(jnp.concatenate(longer))

    # Any filler will do; this one cannot take memory before the frame is known and what that needed is free again.
    return lax.fori_loop(0, tiles, put, jnp.full((tiles, mean.size + 2, rows), scale))


def _design_jvp(rows: int, primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Any]:
    # Only the points are moved here; backward through the loop each tile would pass over a gradient of the size of all points.
    _, weights, _, scale = primals
    blocks = _design(rows, *primals)
    if isinstance(tangents[0], SymbolicZero):
        return blocks, jax.custom_derivatives.zero_from_primal(blocks)
    moved = _cut(tangents[0], rows) / scale
    if weights is not None:
        moved = jnp.where((weights[:, None] > 0) | (jnp.abs(blocks[:, : moved.shape[1]]) < FARTHEST), moved, 0)
    longer = 2 * (blocks[:, : moved.shape[1]] * moved).sum(axis=1, keepdims=True)
    return blocks, jnp.concatenate([moved, longer, jnp.zeros_like(longer)], axis=1)


_design.defjvp(_design_jvp, symbolic_zeros=True)


def tame(places: Array) -> Array:
    """Places, in units of the points' spread, that may be anything, even no numbers, as some that can be multiplied by 0."""
    return jnp.where(jnp.isfinite(places), jnp.clip(places, -FARTHEST, FARTHEST), 0)


def frame(points: Float[Array, "N D"], weights: Float[Array, " N"] | None) -> tuple[Array, Array]:
    """Weighted mean (D,) and RMS distance from it (), exact far from the origin and at any scale."""
    if weights is None:
        origin, weights = points[0], jnp.ones(points.shape[0], points.dtype)
    else:
        weights = weights.astype(points.dtype) / weights.max()
        origin = points[jnp.argmax(weights)]
    # Sums, not matrix products, which would need the offsets in memory and, with 4-byte floats, lose 0.3 % of 3 million points.
    total = weights.sum()
    here = (weights > 0)[:, None]
    mean = origin + jnp.where(here, weights[:, None] * (points - origin), 0).sum(axis=0) / total
    offsets = jnp.where(here, points - mean, 0)
    largest = jnp.abs(offsets).max()
    unit = jnp.where(largest > 0, largest, 1)
    spread = unit * jnp.sqrt((weights * jnp.square(offsets / unit).sum(axis=1)).sum() / total)
    return mean, spread


def sum_tiles(
    tiles: Tiles,
    body: Callable[[Sums, Array, Array], Sums],
    start: Sums,
    join: Callable[[Parts, Sums], Sums] = Parts.total,
) -> Sums:
    """Adds up over tiles: `body(sums, block (D + 2, n), weights (n,)) -> sums`, one tile in memory at a time.

    Going backward each tile is computed again rather than kept, so a gradient needs no N × K memory either.

    Args:
        tiles: The tiles.
        body: Adds one tile.
        start: Sums of nothing.
        join: Makes one of the sums of all devices.
    """
    parts, weights = tiles.parts, tiles.weights
    number, _, rows = tiles.blocks.shape

    @jax.checkpoint
    def step(sums: Sums, tile: tuple[Array, Array]) -> tuple[Sums, None]:
        block, w = tile
        if weights is None:  # then w is the number of the tile
            w = _present(tiles.count, rows, w).astype(block.dtype)
        return body(sums, block, w), None

    if parts is None or weights is None:
        return lax.scan(step, start, (tiles.blocks, jnp.arange(number) if weights is None else weights))[0]

    def part(blocks: Array, weights: Array) -> Sums:
        begin = jax.tree.map(lambda zero: lax.pcast(zero, parts.axes, to="varying"), start)
        return join(parts, lax.scan(step, begin, (blocks, weights))[0])

    return parts.each(part, tiles.blocks, weights, whole=True)


def map_tiles(tiles: Tiles, body: Callable[[Array], Any]) -> Any:
    """`body` of each tile's points (D + 2, n) -> arrays (n, ...), put together for all N points."""
    parts = tiles.parts

    def some(blocks: Array) -> Any:
        out = lax.map(jax.checkpoint(body), blocks)
        own = tiles.count if parts is None else -(-tiles.count // parts.count)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:own], out)

    if parts is None:
        return some(tiles.blocks)
    return jax.tree.map(lambda leaf: leaf[: tiles.count], parts.each(some, tiles.blocks))


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
