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
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, is_concrete, record, static
from jaxfuzzy.memberships import log_strengths, shares
from jaxfuzzy.solve import Solver, fixed_point
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import Tiles, expanded_distances, squared_distances, sum_tiles, tile_points

# Two centers nearer to each other than this share of their own points' RMS distance count as one.
SAME_PLACE = 1e-2


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
        as_type(solver.tol),
        mask=None,
        rule=rule,
        sizes=bool(sizes),
        square=is_concrete(m) and float(m) == 2,
        memberships=bool(memberships),
        max_steps=solver.max_steps,
        acceleration=solver.acceleration,
    )


_STATIC = ("rule", "sizes", "square", "memberships", "max_steps", "acceleration")


@partial(jax.jit, static_argnames=_STATIC)
def _fit(
    points: Float[Array, "N D"],
    seeds: Float[Array, "K D"],
    m: Array,
    noise_distance: Array | None,
    weights: Float[Array, " N"] | None,
    tol: Array,
    *,
    mask: Bool[Array, " K"] | None,
    rule: NoiseRule | None,
    sizes: bool,
    square: bool,
    memberships: bool,
    max_steps: int,
    acceleration: Literal["anderson"] | None,
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
    short = partial(_step, sizes=sizes, square=square, exact=tiles.points.shape[0] == 1)
    smooth = partial(_step, sizes=sizes, square=False, exact=True)
    solver = Solver(max_steps, tol, acceleration)  # type: ignore[arg-type]
    solve = partial(fixed_point, short, solver=solver, smooth_step=smooth, jacobian=partial(_jacobian, sizes=sizes))
    if rule is not None:
        plain = solve(start, (tiles, m, None, mask))
        noise_distance = _rule_distance(rule, tiles, plain.theta["centers"], mask)
        start = plain.theta
    squared_noise = None if noise_distance is None else jnp.square(noise_distance / tiles.scale)
    args = (tiles, m, squared_noise, mask)
    solution = solve(start, args)
    theta = solution.theta
    sums = _sweep(theta, args, square=False, exact=True)
    status = _status(theta, args, sums, solution.converged, sizes=sizes)
    partition = Partition(
        centers=tiles.mean + tiles.scale * theta["centers"],
        sizes=jnp.exp(_log_sizes(theta, mask)),
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


# What a step reads besides the prototypes: tiles, fuzzifier, squared noise distance, which clusters are real.
Args = tuple[Tiles, Array, Array | None, Array | None]
Theta = dict[str, Array]


@record
class Sums:
    """What one sweep over all points adds up; the first three are relative to exp(shift), which cancels in every ratio.

    Attributes:
        mass: Sum of w u^m.
        moment: Sum of w u^m x.
        scatter: Sum of w u^m D.
        log_objective: Logarithm of the reduced objective.
        shift: The largest log u^m, or 0 where it was not needed.
    """

    mass: Float[Array, " K"]
    moment: Float[Array, "K D"]
    scatter: Float[Array, " K"]
    log_objective: Float[Array, ""]
    shift: Float[Array, ""]


def _log_sizes(theta: Theta, mask: Array | None) -> Float[Array, " K"]:
    """Logarithm of the sizes; -inf for pads."""
    clusters, dtype = theta["centers"].shape[0], theta["centers"].dtype
    real = jnp.ones(clusters, bool) if mask is None else mask
    equal = jnp.broadcast_to(-jnp.log(real.sum().astype(dtype)), (clusters,))
    return jnp.where(real, theta.get("log_sizes", equal), -jnp.inf)


def _strengths(theta: Theta, mask: Array | None) -> Float[Array, " K"] | None:
    strengths = log_strengths(theta.get("log_sizes"), mask)
    return None if strengths is None else strengths.astype(theta["centers"].dtype)


def _sweep(theta: Theta, args: Args, *, square: bool, exact: bool) -> Sums:
    """One pass over the points. `square` is the short cut for m = 2, `exact` takes distances by differences."""
    tiles, m, squared_noise, mask = args
    centers, strengths = theta["centers"], _strengths(theta, mask)
    distances = squared_distances if exact else expanded_distances
    clusters, dims = centers.shape
    dtype = centers.dtype
    lowest = jnp.asarray(-1e4, dtype)
    zero = jnp.zeros((), dtype)

    def add(
        sums: tuple[Array, Array, Array, Array, Array], x: Array, w: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        mass, moment, scatter, objective, shift = sums
        apart = distances(x, centers)
        if square:
            power, term = _square_powers(apart, strengths, squared_noise)
            new_shift, rescale = zero, jnp.ones((), dtype)
        else:
            part = shares(apart, m, strengths, squared_noise)
            logs = part.log_powers(m)
            new_shift = jax.lax.stop_gradient(jnp.maximum(shift, jnp.maximum(logs.max(), lowest)))
            rescale = jnp.exp(shift - new_shift)
            power, term = jnp.exp(logs - new_shift), part.objective(m, new_shift)
        power = power * w
        return (
            mass * rescale + power.sum(axis=1),
            moment * rescale + jnp.matmul(power, x.T, precision=jax.lax.Precision.HIGHEST),
            scatter * rescale + (power * apart).sum(axis=1),
            objective * rescale + term @ w,
            new_shift,
        )

    start = (
        jnp.zeros(clusters, dtype),
        jnp.zeros((clusters, dims), dtype),
        jnp.zeros(clusters, dtype),
        zero,
        zero if square else 2 * lowest,
    )
    mass, moment, scatter, objective, shift = sum_tiles(tiles, add, start)
    return Sums(mass, moment, scatter, jnp.log(objective) + shift, shift)


def _square_powers(
    apart: Float[Array, "K n"], strengths: Float[Array, " K"] | None, squared_noise: Array | None
) -> tuple[Float[Array, "K n"], Float[Array, " n"]]:
    """Squared memberships and objective terms for m = 2, where no logarithm is needed."""
    # Distances are relative to a spread of 1, so the square of rounding stands for zero without overflow.
    floor = jnp.square(jnp.finfo(apart.dtype).eps)
    closeness = 1 / jnp.maximum(apart, floor)
    if strengths is not None:
        closeness = closeness * jnp.exp(strengths)[:, None]
    total = closeness.sum(axis=0)
    if squared_noise is not None:
        total = total + 1 / squared_noise
    return jnp.square(closeness / total), 1 / total


def _step(theta: Theta, args: Args, *, sizes: bool, square: bool, exact: bool) -> tuple[Theta, Array]:
    """One round of alternating optimisation (eqs. 9, 10, 11) and the objective where it started from."""
    _, m, _, mask = args
    sums = _sweep(theta, args, square=square, exact=exact)
    filled = sums.mass > 0
    mass = jnp.where(filled, sums.mass, 1)
    centers = jnp.where(filled[:, None], sums.moment / mass[:, None], theta["centers"])
    if not sizes:
        return {"centers": centers}, sums.log_objective
    # Eq. 11 with the distances from the new centers: moving to the mean lowers each scatter by mass times move squared.
    moved = jnp.square(centers - theta["centers"]).sum(axis=1)
    rounding = jnp.finfo(centers.dtype).eps
    scatter = jnp.maximum(sums.scatter - sums.mass * moved, jnp.square(rounding) * sums.mass)
    log_root = jnp.log(jnp.where(filled, scatter, 1)) / m
    log_root = jnp.where(filled, log_root, -jnp.inf)
    if mask is not None:
        log_root = jnp.where(mask, log_root, -jnp.inf)
    logs = log_root - jax.nn.logsumexp(log_root)
    # A dying size would fall for ever; at rounding it counts as dead and the status says so.
    return {"centers": centers, "log_sizes": jnp.maximum(logs, jnp.log(rounding))}, sums.log_objective


def _jacobian(theta: Theta, args: Args, *, sizes: bool) -> Float[Array, "p p"]:
    """Derivative of `_step` at a fixed point in one sweep.

    With psi_i = (x - v_i, D_i) and phi_j = d log(part_j) / d(v_j, log alpha_j) = (2 r (x - v_j) / D_j, 1), memberships change
    by d(u_i^m) = m u_i^m (delta_ij - u_j) phi_j, so all sums are one matrix product of (K (D + 1), n) with its like.
    """
    tiles, m, squared_noise, mask = args
    centers, strengths = theta["centers"], _strengths(theta, mask)
    clusters, dims = centers.shape
    rows = dims + 1 if sizes else dims
    r = 1 / (m - 1)
    shift = _sweep(theta, args, square=False, exact=True).shift

    def add(sums: tuple[Array, Array, Array, Array], x: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        crossed, own, mass, scatter = sums
        offset = x[None] - centers[:, :, None]
        apart = jnp.square(offset).sum(axis=1)
        part = shares(apart, m, strengths, squared_noise)
        u, power = part.memberships, jnp.exp(part.log_powers(m) - shift) * w
        off = apart > 0
        phi = jnp.where(off[:, None], 2 * r * offset / jnp.where(off, apart, 1)[:, None], 0)
        psi = offset
        if sizes:
            psi = jnp.concatenate([psi, apart[:, None]], axis=1)
            phi = jnp.concatenate([phi, jnp.ones_like(apart)[:, None]], axis=1)
        left = (power[:, None] * psi).reshape(clusters * rows, -1)
        right = (u[:, None] * phi).reshape(clusters * rows, -1)
        return (
            crossed + left @ right.T,
            own + jnp.einsum("kan,kbn->kab", power[:, None] * psi, phi),
            mass + power.sum(axis=1),
            scatter + (power * apart).sum(axis=1),
        )

    start = (
        jnp.zeros((clusters * rows, clusters * rows), centers.dtype),
        jnp.zeros((clusters, rows, rows), centers.dtype),
        jnp.zeros(clusters, centers.dtype),
        jnp.zeros(clusters, centers.dtype),
    )
    crossed, own, mass, scatter = sum_tiles(tiles, add, start)
    change = -crossed.reshape(clusters, rows, clusters, rows)
    change = m * change.at[jnp.arange(clusters), :, jnp.arange(clusters)].add(own)
    per_mass = jnp.where(mass > 0, 1 / jnp.where(mass > 0, mass, 1), 0)
    to_centers = change[:, :dims] * per_mass[:, None, None, None]
    flat = clusters * dims
    if not sizes:
        return to_centers.reshape(flat, flat)
    per_scatter = jnp.where(scatter > 0, 1 / jnp.where(scatter > 0, scatter, 1), 0)
    log_scatter = change[:, dims] * per_scatter[:, None, None] / m
    alpha = jnp.exp(_log_sizes(theta, mask))
    alive = theta["log_sizes"] > jnp.log(jnp.finfo(centers.dtype).eps)
    to_sizes = jnp.where(alive[:, None, None], log_scatter - jnp.einsum("i,ijb->jb", alpha, log_scatter), 0)

    def by_name(block: Array) -> Array:
        """From (rows, K, D + 1) to (rows, K D + K), the order in which the prototypes are raveled."""
        block = block.reshape(-1, clusters, rows)
        return jnp.concatenate([block[:, :, :dims].reshape(-1, flat), block[:, :, dims]], axis=1)

    return jnp.concatenate([by_name(to_centers), by_name(to_sizes)])


def _memberships(
    tiles: Tiles, theta: Theta, m: Array, squared_noise: Array | None, mask: Array | None
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    """Memberships and noise of the tiled points, padding included, tile by tile."""
    strengths, clusters = _strengths(theta, mask), theta["centers"].shape[0]

    def one(x: Array) -> tuple[Array, Array]:
        part = shares(squared_distances(x, theta["centers"]), m, strengths, squared_noise)
        return part.memberships.T, part.noise

    u, noise = jax.lax.map(jax.checkpoint(one), tiles.points)
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
    apart = jax.lax.map(lambda x: squared_distances(x, centers), tiles.points)  # (T, K, n)
    real = jnp.ones(centers.shape[0], bool) if mask is None else mask
    if rule.name == "dave":
        total = jnp.einsum("tkn,tn,k->", apart, tiles.weights, real.astype(apart.dtype))
        return tiles.scale * jnp.sqrt(rule.value * total / (tiles.weights.sum() * real.sum()))
    nearest = jnp.where(real[:, None], apart, jnp.inf).min(axis=1).ravel()
    order = jnp.argsort(nearest)
    heap = jnp.cumsum(tiles.weights.ravel()[order])
    at = jnp.searchsorted(heap, rule.value * heap[-1])
    return tiles.scale * jnp.sqrt(nearest[order][at])


def _status(theta: Theta, args: Args, sums: Sums, converged: Array, *, sizes: bool) -> Int[Array, ""]:
    """Every reason to mistrust a fit, found in one more sweep over the points."""
    tiles, m, squared_noise, mask = jax.lax.stop_gradient(args)
    theta, sums = jax.lax.stop_gradient((theta, sums))
    centers, strengths = theta["centers"], _strengths(theta, mask)
    clusters, dims = centers.shape
    real = jnp.ones(clusters, bool) if mask is None else mask

    def add(total: Array, x: Array, w: Array) -> Array:
        offset = x[None] - centers[:, :, None]
        apart = jnp.square(offset).sum(axis=1)
        part = shares(apart, m, strengths, squared_noise)
        power = jnp.exp(part.log_powers(m) - sums.shift) * w
        unit = power / jnp.where(apart > 0, apart, 1)
        return total + jnp.einsum("kn,kan,kbn->kab", unit, offset, offset)

    spread = sum_tiles(tiles, add, jnp.zeros((clusters, dims, dims), centers.dtype))
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    elongation = jnp.linalg.eigvalsh(spread / mass[:, None, None])[:, -1]
    own = sums.scatter / mass
    apart = jnp.square(centers[:, None] - centers[None]).sum(axis=-1)
    close = apart <= SAME_PLACE**2 * jnp.maximum(jnp.minimum(own[:, None], own[None]), jnp.finfo(own.dtype).eps ** 2)
    twins = close & real[:, None] & real[None] & ~jnp.eye(clusters, dtype=bool)
    # Merged centers are stable where no direction holds more than (m - 1) / 2m of the unit scatter; elsewhere a nudge parts them.
    stable = elongation <= (m - 1) / (2 * m) * (1 + 1e-3)
    merged, parted = twins.any(axis=1) & stable, twins.any(axis=1) & ~stable
    one_place = (twins | ~real[None] | ~real[:, None] | jnp.eye(clusters, dtype=bool)).all() & (real.sum() > 1)
    finite = jnp.isfinite(centers).all() & jnp.isfinite(sums.log_objective) | (sums.log_objective == -jnp.inf)
    bits = [
        (Status.NOT_CONVERGED, ~converged),
        (Status.NOT_FINITE, ~finite),
        (Status.COLLAPSED, one_place & merged.any() & (tiles.spread > 0)),
        (Status.MERGED, merged.any() & ~one_place),
        (Status.UNSTABLE, parted.any() & (tiles.spread > 0)),
        (Status.TOO_FEW_POINTS, (tiles.weights > 0).sum() < real.sum()),
        (Status.DEGENERATE, tiles.spread <= 0),
    ]
    if sizes:
        alpha = jnp.exp(_log_sizes(theta, mask))
        rounding = jnp.finfo(centers.dtype).eps
        pointlike = real & (own <= 1e3 * rounding) & (sums.mass > 0) & (tiles.spread > 0)
        dying = real & (alpha * real.sum() < 1e-3) & ~pointlike
        bits += [(Status.SPIKE, pointlike.any() & (real.sum() > 1)), (Status.DYING, dying.any())]
    return sum((jnp.where(condition, int(bit), 0) for bit, condition in bits), jnp.zeros((), jnp.int32))


def jacobian(points: Float[Array, "N D"], partition: Partition, weights: Float[Array, " N"] | None = None) -> Any:
    """Derivative of one step with respect to the prototypes at a partition, in units of the points' RMS spread."""
    tiles = tile_points(points, weights, partition.centers.shape[0])
    theta = {"centers": (partition.centers - tiles.mean) / tiles.scale}
    if partition.sizes_learned:
        theta["log_sizes"] = jnp.log(partition.sizes)
    squared_noise = jnp.square(partition.noise_distance / tiles.scale)
    return _jacobian(theta, (tiles, jnp.asarray(partition.m), squared_noise, None), sizes=partition.sizes_learned)
