"""Fuzzy c-means, plain and with a variable for cluster sizes (paper section II-D), optionally with a noise cluster.

Paper symbols → words: x point, v center, u membership, alpha size, m fuzzifier, delta noise distance, J objective.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.alternation import (
    Sums,
    Theta,
    advance,
    diagnose,
    judge,
    log_sizes_of,
    merged,
    short_powers,
    smooth_powers,
    square_powers,
    step,
    step_jacobian,
    strengths_of,
    sweep,
    unit_scatter,
)
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, is_concrete, record, static
from jaxfuzzy.blocks import Blocks, fingerprint
from jaxfuzzy.memberships import shares
from jaxfuzzy.solve import Effort, Solver, fixed_point, fixed_point_outside
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import Parts, Tiles, map_tiles, squared_distances, sum_tiles, tile_points


@record
class Partition:
    """A fuzzy partition of N points into K clusters.

    Attributes:
        centers: Cluster centers.
        sizes: Cluster sizes alpha; they sum to 1. Not the share of points: see `fcm`.
        memberships: Degree to which each point belongs to each cluster; empty (0, K) where not asked for.
        noise: Degree to which each point belongs to the noise cluster; zero without one.
        labels: The cluster of largest membership, -1 where noise is larger.
        objective: The objective in the units of the input.
        steps: Number of steps taken.
        status: Reasons to read this with care; see `describe`.
        m: Fuzzifier.
        noise_distance: Noise distance, infinite without a noise cluster.
        sizes_learned: Whether the sizes were learned.
    """

    centers: Float[Array, "K D"]
    sizes: Float[Array, " K"]
    memberships: Float[Array, "N K"]
    noise: Float[Array, " N"]
    labels: Int[Array, " N"]
    objective: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    m: Scalar
    noise_distance: Scalar
    sizes_learned: bool = static(default=False)


@dataclass(frozen=True)
class NoiseRule:
    """A noise distance taken from the data: from a fit without noise, from the same seeds.

    Attributes:
        name: "dave": delta² = value · the mean squared distance over all points and centers (Davé 1991, where value is lambda).
            "quantile": delta = the weighted quantile `value` of the points' distances to their nearest center.
        value: Davé's lambda, above 0; or the quantile, between 0 and 1.

    Raises:
        ValueError: Unknown name or value out of range.
    """

    name: Literal["dave", "quantile"] = "dave"
    value: float = 0.1

    def __post_init__(self) -> None:
        checks.choice(self.name, "NoiseRule.name", ("dave", "quantile"))
        checks.number(self.value, "NoiseRule.value", above=0.0)
        if self.name == "quantile" and is_concrete(self.value) and self.value >= 1:
            raise ValueError(f"NoiseRule.value must be below 1 for a quantile, got {self.value}")


def fcm(
    points: ArrayLike | Blocks,
    seeds: ArrayLike,
    *,
    m: Scalar = 2.0,
    sizes: bool = False,
    noise_distance: Scalar | NoiseRule | None = None,
    weights: ArrayLike | None = None,
    memberships: bool = True,
    solver: Solver = Solver(),
) -> Partition:
    """Fuzzy c-means from given seeds.

    Minimises eq. 8 of the paper by eqs. 9 to 11, with a noise cluster (Davé 1991, eqs. 19 and 20) where a noise distance is given;
    without sizes this is Bezdek's fuzzy c-means. Runs under `jit`, `vmap` and `grad`: centers, sizes, memberships, noise and
    objective have first derivatives with respect to `points`, `weights`, `m` and `noise_distance`, those of the fixed point
    reached; second ones are refused.

    The sizes alpha are not shares of points: alpha_i goes with S_i^(1/m), S_i the cluster's sum of u^m times squared distance.

    Args:
        points: Points (N, D), any unit; or `blocks` of them where they do not fit into memory, which needs `memberships=False` and
            has neither derivatives nor a `NoiseRule`.
        seeds: Centers to start from (K, D), K at most N.
        m: Fuzzifier, above 1.
        sizes: Whether to learn the sizes (eq. 11); otherwise all are 1/K.
        noise_distance: Distance of the noise cluster from every point, in the unit of the points; a `NoiseRule` to take it from the
            data; None for no noise cluster. Of many points in single precision distances below a thousandth of their spread are
            rounding: for a smaller noise distance take double precision.
        weights: Weight of each point (N,), not negative: weight 2 is the point twice, weight 0 the point absent, though it has
            memberships too (as if it were no farther than 1e6 spreads from the others).
        memberships: Whether to make memberships, noise and labels; without them nothing of size N × K ever exists.
        solver: Steps, tolerance and acceleration.

    Returns:
        The partition; its `status` tells what to mistrust.

    Raises:
        ValueError: An argument out of range, shapes that do not agree, non-finite points.
        TypeError: Points, seeds or weights that are not real numbers.
    """
    checks.fuzzifier(m)
    checks.kind(solver, "solver", Solver)
    sizes, memberships = checks.flag(sizes, "sizes"), checks.flag(memberships, "memberships")
    square = is_concrete(m) and float(m) == 2
    if isinstance(points, Blocks):
        if memberships:
            raise ValueError(
                "memberships must be False for blocks: ask `jaxfuzzy.memberships` for those of one at a time"
            )
        if isinstance(noise_distance, NoiseRule):
            raise ValueError("noise_distance must be a number or None for blocks, got a NoiseRule")
        checks.noise_distance(noise_distance)
        return _fit_blocks(points, seeds, m, noise_distance, weights, solver, sizes=sizes, square=square)
    points = checks.points(points)
    seeds = _checked_seeds(seeds, points.shape)
    weights = checks.weights(weights, points.shape[0])
    rule = noise_distance if isinstance(noise_distance, NoiseRule) else None
    given = None if rule else checks.noise_distance(noise_distance)
    dtype = jnp.result_type(points, seeds)
    parts = Parts.of(points, solver.mesh)
    points = points if parts is None else parts.place(points)
    points, seeds = points.astype(dtype), seeds.astype(dtype)
    as_type = partial(jnp.asarray, dtype=dtype)
    return _fit(
        points,
        seeds,
        as_type(m),
        None if given is None else as_type(given),
        None if weights is None else weights.astype(dtype),
        solver.traced(dtype),
        mask=None,
        rule=rule,
        sizes=sizes,
        square=square,
        memberships=memberships,
        parts=parts,
    )


def _checked_seeds(seeds: ArrayLike, shape: tuple[int, ...]) -> Array:
    seeds = checks.points(seeds, "seeds", dims=shape[1])
    checks.integer(seeds.shape[0], "number of seeds", at_least=1, at_most=shape[0], why=" (the number of points)")
    return seeds


_STATIC = ("rule", "sizes", "square", "memberships", "parts")


@partial(jax.jit, static_argnames=_STATIC)
def _fit(
    points: Float[Array, "N D"],
    seeds: Float[Array, "K D"],
    m: Array,
    noise_distance: Array | None,
    weights: Float[Array, " N"] | None,
    effort: Effort,
    *,
    mask: Bool[Array, " K"] | None,
    rule: NoiseRule | None,
    sizes: bool,
    square: bool,
    memberships: bool,
    parts: Parts | None = None,
) -> Partition:
    """The compiled fit; `mask` says which of the seeds are real, the others being pads of a batch over k."""
    chex.assert_rank([points, seeds], 2)
    chex.assert_equal_shape_suffix([points, seeds], 1)
    clusters = seeds.shape[0]
    tiles = tile_points(points, weights, clusters, parts)
    start = {"centers": (jax.lax.stop_gradient(seeds) - tiles.mean) / tiles.scale}
    if sizes:
        real = jnp.ones(clusters, bool) if mask is None else mask
        start["log_sizes"] = jnp.where(real, -jnp.log(real.sum().astype(points.dtype)), 0)
    # Static flags are bound here; what is traced goes through the arguments.
    powers = square_powers if square else short_powers
    short = partial(step, sizes=sizes, powers=powers, exact=parts is None and tiles.blocks.shape[0] == 1)
    smooth = partial(step, sizes=sizes, powers=smooth_powers, exact=True)
    solve = partial(fixed_point, short, solver=effort, smooth_step=smooth, jacobian=partial(step_jacobian, sizes=sizes))
    if rule is not None:
        plain = solve(start, (tiles, m, None, mask))
        noise_distance = _rule_distance(rule, tiles, weights, plain.theta["centers"], mask)
        start = plain.theta
    squared_noise = None if noise_distance is None else jnp.square(noise_distance / tiles.scale)
    args = (tiles, m, squared_noise, mask)
    solution = solve(start, args)
    theta = solution.theta
    sums = sweep(theta, args, powers=smooth_powers, exact=True, scatter=True)
    status = diagnose(theta, args, sums, solution.converged, sizes=sizes)
    partition = Partition(
        centers=tiles.mean + tiles.scale * theta["centers"],
        sizes=jnp.exp(log_sizes_of(theta, mask)),
        memberships=jnp.zeros((0, clusters), points.dtype),
        noise=jnp.zeros(0, points.dtype),
        labels=jnp.zeros(0, jnp.int32),
        objective=jnp.exp(sums.log_objective + 2 * jnp.log(tiles.scale)),
        steps=solution.steps,
        status=status,
        m=m,
        noise_distance=jnp.asarray(jnp.inf, points.dtype) if noise_distance is None else noise_distance,
        sizes_learned=sizes,
    )
    if not memberships:
        return partition
    used = jnp.ones(points.shape[0], bool) if weights is None else weights > 0
    return _with_memberships(partition, *_memberships(tiles, theta, m, squared_noise, mask), used)


def _fit_blocks(
    points: Blocks,
    seeds: ArrayLike,
    m: Scalar,
    noise_distance: Any,
    weights: Any,
    solver: Solver,
    *,
    sizes: bool,
    square: bool,
) -> Partition:
    """The same fit with the sums of every sweep added up over blocks."""
    found = points.survey(weights)
    seeds = _checked_seeds(seeds, (found.count, found.dims))
    dtype, clusters = jnp.result_type(found.dtype, seeds), seeds.shape[0]
    as_type = partial(jnp.asarray, dtype=dtype)
    mean, spread, fuzzifier = as_type(found.total.mean), as_type(found.total.spread), as_type(m)
    scale = jnp.where(spread > 0, spread, 1)
    squared_noise = None if noise_distance is None else jnp.square(as_type(noise_distance) / scale)
    start: Theta = {"centers": (seeds.astype(dtype) - mean) / scale}
    if sizes:
        start["log_sizes"] = jnp.full(clusters, -jnp.log(jnp.asarray(clusters, dtype)))
    parts = Parts.of(None, solver.mesh)

    def sums(thetas: list[Theta], **how: Any) -> list[Sums]:
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *thetas)
        sweep_block = partial(_sweep_block, stacked, mean, spread, fuzzifier, squared_noise, parts=parts, **how)
        each = points.each(weights, dtype, sweep_block)
        return [merged([jax.tree.map(lambda leaf, i=i: leaf[i], one) for one in each]) for i in range(len(thetas))]

    def one_round(thetas: list[Theta]) -> tuple[list[Theta], list[Array]]:
        found = sums(thetas, powers=square_powers if square else short_powers, exact=False, scatter=sizes)
        ahead = [
            _advance(theta, jax.tree.map(as_type, one), fuzzifier, None, sizes=sizes)
            for theta, one in zip(thetas, found, strict=True)
        ]
        return [theta for theta, _ in ahead], [merit for _, merit in ahead]

    total = found.total
    task = fingerprint(
        "fcm", found.count, total.weight, total.mean, total.spread, seeds, m, noise_distance, sizes, solver.acceleration
    )
    solution = fixed_point_outside(
        one_round, start, solver, saved=points.resume(task), after=partial(points.keep, task)
    )
    theta = solution.theta
    last = jax.tree.map(as_type, sums([theta], powers=smooth_powers, exact=True, scatter=True)[0])
    unit_block = partial(_unit_scatter_block, theta, mean, spread, fuzzifier, squared_noise, last.shift, parts=parts)
    units = sum(np.asarray(one, np.float64) for one in points.each(weights, dtype, unit_block))
    nothing = jnp.zeros((0, 0), dtype)
    extent = Tiles(nothing[None], nothing, mean, scale, spread, jnp.asarray(found.present), found.count)
    return Partition(
        centers=mean + scale * theta["centers"],
        sizes=jnp.exp(log_sizes_of(theta, None)),
        memberships=jnp.zeros((0, clusters), dtype),
        noise=jnp.zeros(0, dtype),
        labels=jnp.zeros(0, jnp.int32),
        objective=jnp.exp(last.log_objective + 2 * jnp.log(scale)),
        steps=solution.steps,
        status=judge(theta, last, as_type(units), fuzzifier, None, extent, solution.converged, sizes=sizes),
        m=fuzzifier,
        noise_distance=as_type(jnp.inf if noise_distance is None else noise_distance),
        sizes_learned=sizes,
    )


_advance = partial(jax.jit, static_argnames=("sizes",))(advance)


@partial(jax.jit, static_argnames=("powers", "exact", "scatter", "parts"))
def _sweep_block(
    thetas: Theta,
    mean: Array,
    spread: Array,
    m: Array,
    squared_noise: Array | None,
    points: Float[Array, "n D"],
    weights: Float[Array, " n"],
    *,
    parts: Parts | None,
    **how: Any,
) -> Sums:
    """Sums over one block of points for several prototypes at once."""
    tiles = tile_points(points, weights, thetas["centers"].shape[1], parts, (mean, spread))
    return jax.vmap(lambda theta: sweep(theta, (tiles, m, squared_noise, None), **how))(thetas)


@partial(jax.jit, static_argnames=("parts",))
def _unit_scatter_block(
    theta: Theta,
    mean: Array,
    spread: Array,
    m: Array,
    squared_noise: Array | None,
    shift: Array,
    points: Float[Array, "n D"],
    weights: Float[Array, " n"],
    *,
    parts: Parts | None,
) -> Float[Array, "K D D"]:
    tiles = tile_points(points, weights, theta["centers"].shape[0], parts, (mean, spread))
    return unit_scatter(theta, (tiles, m, squared_noise, None), shift)


def _with_memberships(
    partition: Partition, u: Float[Array, "N K"], noise: Float[Array, " N"], used: Bool[Array, " N"]
) -> Partition:
    labels = jnp.where(noise > u.max(axis=1), -1, u.argmax(axis=1)).astype(jnp.int32)
    all_noise = jnp.where(((labels < 0) | ~used).all(), int(Status.ALL_NOISE), 0)
    return Partition(
        partition.centers,
        partition.sizes,
        u,
        noise,
        labels,
        partition.objective,
        partition.steps,
        partition.status | all_noise,
        partition.m,
        partition.noise_distance,
        partition.sizes_learned,
    )


def _memberships(
    tiles: Tiles, theta: Theta, m: Array, squared_noise: Array | None, mask: Array | None
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    """Memberships and noise of the tiled points, tile by tile."""
    strengths = strengths_of(theta, mask)

    def one(block: Array) -> tuple[Array, Array]:
        part = shares(squared_distances(block, theta["centers"]), m, strengths, squared_noise)
        return part.memberships.T, part.noise

    return map_tiles(tiles, one)


@jax.jit
def _memberships_of(
    points: Float[Array, "N D"], partition: Partition
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    tiles = tile_points(points, None, partition.centers.shape[0])
    theta = {"centers": (partition.centers - tiles.mean) / tiles.scale}
    if partition.sizes_learned:
        theta["log_sizes"] = jnp.log(partition.sizes)
    return _memberships(
        tiles, theta, jnp.asarray(partition.m), jnp.square(partition.noise_distance / tiles.scale), None
    )


def memberships(points: ArrayLike, partition: Partition) -> Float[Array, "N K"]:
    """Memberships of points, those of the fit or new ones, in the clusters of a partition (eqs. 9 and 20).

    Args:
        points: Points (N, D) in the units of the fit.
        partition: What `fcm` gave.

    Returns:
        Memberships (N, K); what is missing to 1 in a row belongs to noise. Made tile by tile.

    Raises:
        ValueError: Points of another dimension, or not finite.
        TypeError: The partition is none.
    """
    checks.kind(partition, "partition", Partition)
    points = checks.points(points, dims=partition.centers.shape[1])
    return _memberships_of(points.astype(jnp.result_type(points, partition.centers)), partition)[0]


def _rule_distance(rule: NoiseRule, tiles: Tiles, weights: Array | None, centers: Array, mask: Array | None) -> Array:
    """The noise distance by rule, in the input's units."""
    real = jnp.ones(centers.shape[0], bool) if mask is None else mask
    if rule.name == "dave":

        def add(total: Array, block: Array, w: Array) -> Array:
            return total + jnp.where(real[:, None], squared_distances(block, centers), 0).sum(axis=0) @ w

        total = sum_tiles(tiles, add, jnp.zeros((), centers.dtype))
        mass = tiles.count if weights is None else weights.sum()
        return tiles.scale * jnp.sqrt(rule.value * total / (mass * real.sum()))

    def one(block: Array) -> Array:
        return jnp.where(real[:, None], squared_distances(block, centers), jnp.inf).min(axis=0)

    nearest = map_tiles(tiles, one)
    order = jnp.argsort(nearest)
    heap = jnp.cumsum((jnp.ones_like(nearest) if weights is None else weights)[order])
    at = jnp.searchsorted(heap, rule.value * heap[-1])
    return tiles.scale * jnp.sqrt(nearest[order][at])


def jacobian(points: Float[Array, "N D"], partition: Partition, weights: Float[Array, " N"] | None = None) -> Any:
    """Derivative of one step with respect to the prototypes at a partition, in units of the points' RMS spread."""
    tiles = tile_points(points, weights, partition.centers.shape[0])
    theta = {"centers": (partition.centers - tiles.mean) / tiles.scale}
    if partition.sizes_learned:
        theta["log_sizes"] = jnp.log(partition.sizes)
    squared_noise = jnp.square(partition.noise_distance / tiles.scale)
    return step_jacobian(theta, (tiles, jnp.asarray(partition.m), squared_noise, None), sizes=partition.sizes_learned)
