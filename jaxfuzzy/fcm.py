"""Fuzzy c-means, plain and with a variable for cluster sizes (paper section II-D), optionally with a noise cluster.

Paper symbols → words: x point, v center, u membership, alpha size, m fuzzifier, delta noise distance, J objective.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp

from jaxfuzzy import checks
from jaxfuzzy.alternation import (
    Theta,
    diagnose,
    log_sizes_of,
    short_powers,
    smooth_powers,
    square_powers,
    step,
    step_jacobian,
    strengths_of,
    sweep,
)
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, is_concrete, record, static
from jaxfuzzy.memberships import shares
from jaxfuzzy.solve import Effort, Solver, fixed_point
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import Tiles, squared_distances, tile_points


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
    points: ArrayLike,
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
    objective have derivatives with respect to `points`, `weights`, `m` and `noise_distance`, those of the fixed point reached.

    The sizes alpha are not shares of points: alpha_i goes with S_i^(1/m), S_i the cluster's sum of u^m times squared distance.

    Args:
        points: Points (N, D), any unit.
        seeds: Centers to start from (K, D), K at most N.
        m: Fuzzifier, above 1.
        sizes: Whether to learn the sizes (eq. 11); otherwise all are 1/K.
        noise_distance: Distance of the noise cluster from every point, in the unit of the points; a `NoiseRule` to take it from the
            data; None for no noise cluster.
        weights: Weight of each point (N,), not negative: weight 2 is the point twice, weight 0 the point absent.
        memberships: Whether to make memberships, noise and labels; without them nothing of size N × K ever exists.
        solver: Steps, tolerance and acceleration.

    Returns:
        The partition; its `status` tells what to mistrust.

    Raises:
        ValueError: An argument out of range, shapes that do not agree, non-finite points.
        TypeError: Points, seeds or weights that are not real numbers.
    """
    points = checks.points(points)
    seeds = checks.points(seeds, "seeds", dims=points.shape[1])
    checks.integer(
        seeds.shape[0], "number of seeds", at_least=1, at_most=points.shape[0], why=" (the number of points)"
    )
    checks.fuzzifier(m)
    weights = checks.weights(weights, points.shape[0])
    rule = noise_distance if isinstance(noise_distance, NoiseRule) else None
    given = None if rule else checks.noise_distance(noise_distance)
    dtype = jnp.result_type(points, seeds)
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
        sizes=bool(sizes),
        square=is_concrete(m) and float(m) == 2,
        memberships=bool(memberships),
    )


_STATIC = ("rule", "sizes", "square", "memberships")


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
) -> Partition:
    """The compiled fit; `mask` says which of the seeds are real, the others being pads of a batch over k."""
    chex.assert_rank([points, seeds], 2)
    chex.assert_equal_shape_suffix([points, seeds], 1)
    count, (clusters, _) = points.shape[0], seeds.shape
    tiles = tile_points(points, weights, clusters)
    start = {"centers": (jax.lax.stop_gradient(seeds) - tiles.mean) / tiles.scale}
    if sizes:
        real = jnp.ones(clusters, bool) if mask is None else mask
        start["log_sizes"] = jnp.where(real, -jnp.log(real.sum().astype(points.dtype)), 0)
    # Static flags are bound here; what is traced goes through the arguments.
    powers = square_powers if square else short_powers
    short = partial(step, sizes=sizes, powers=powers, exact=tiles.blocks.shape[0] == 1)
    smooth = partial(step, sizes=sizes, powers=smooth_powers, exact=True)
    solve = partial(fixed_point, short, solver=effort, smooth_step=smooth, jacobian=partial(step_jacobian, sizes=sizes))
    if rule is not None:
        plain = solve(start, (tiles, m, None, mask))
        noise_distance = _rule_distance(rule, tiles, plain.theta["centers"], mask)
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
    u, noise = _memberships(tiles, theta, m, squared_noise, mask)
    return _with_memberships(partition, u[:count], noise[:count])


def _with_memberships(partition: Partition, u: Float[Array, "N K"], noise: Float[Array, " N"]) -> Partition:
    labels = jnp.where(noise > u.max(axis=1), -1, u.argmax(axis=1)).astype(jnp.int32)
    all_noise = jnp.where((labels < 0).all(), int(Status.ALL_NOISE), 0)
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
    """Memberships and noise of the tiled points, padding included, tile by tile."""
    strengths, clusters = strengths_of(theta, mask), theta["centers"].shape[0]

    def one(block: Array) -> tuple[Array, Array]:
        part = shares(squared_distances(block, theta["centers"]), m, strengths, squared_noise)
        return part.memberships.T, part.noise

    u, noise = jax.lax.map(jax.checkpoint(one), tiles.blocks)
    return u.reshape(-1, clusters), noise.reshape(-1)


@jax.jit
def _memberships_of(
    points: Float[Array, "N D"], partition: Partition
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    tiles = tile_points(points, None, partition.centers.shape[0])
    theta = {"centers": (partition.centers - tiles.mean) / tiles.scale}
    if partition.sizes_learned:
        theta["log_sizes"] = jnp.log(partition.sizes)
    u, noise = _memberships(
        tiles, theta, jnp.asarray(partition.m), jnp.square(partition.noise_distance / tiles.scale), None
    )
    return u[: tiles.count], noise[: tiles.count]


def memberships(points: ArrayLike, partition: Partition) -> Float[Array, "N K"]:
    """Memberships of points, those of the fit or new ones, in the clusters of a partition (eqs. 9 and 20).

    Args:
        points: Points (N, D) in the units of the fit.
        partition: What `fcm` gave.

    Returns:
        Memberships (N, K); what is missing to 1 in a row belongs to noise. Made tile by tile.

    Raises:
        ValueError: Points of another dimension, or not finite.
    """
    points = checks.points(points, dims=partition.centers.shape[1])
    return _memberships_of(points.astype(jnp.result_type(points, partition.centers)), partition)[0]


def _rule_distance(rule: NoiseRule, tiles: Tiles, centers: Array, mask: Array | None) -> Array:
    """The noise distance by rule, in the input's units."""
    apart = jax.lax.map(lambda block: squared_distances(block, centers), tiles.blocks)  # (T, K, n)
    real = jnp.ones(centers.shape[0], bool) if mask is None else mask
    if rule.name == "dave":
        total = jnp.einsum("tkn,tn,k->", apart, tiles.weights, real.astype(apart.dtype))
        return tiles.scale * jnp.sqrt(rule.value * total / (tiles.weights.sum() * real.sum()))
    nearest = jnp.where(real[:, None], apart, jnp.inf).min(axis=1).ravel()
    order = jnp.argsort(nearest)
    heap = jnp.cumsum(tiles.weights.ravel()[order])
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
