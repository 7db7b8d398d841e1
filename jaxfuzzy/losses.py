"""Losses to tune fits by, each smooth in what the fit gives, each with its reason.

The objective of a fit cannot tell how good its fuzzifier or noise distance is: it falls with larger m and smaller noise distance
whatever the data. With known truth: `shape_error` (geometry), `soft_rand` and `cross_entropy` (labels), `noise_entropy` (known
outliers). Without: `alignment` (fits to two resamples should agree), `held_out` (points left out should be likely), and the
validity indices `smooth_xie_beni` and `smooth_variance_ratio`. All are better when lower but for `soft_rand` and `alignment`,
which are 1 at best, so that 1 minus them is the loss. All run under `jit`, `vmap` and `grad`.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, as_float
from jaxfuzzy.fcm import Partition
from jaxfuzzy.linalg import divide
from jaxfuzzy.primitives import Cone, Cylinder, Plane, Primitive, Sphere

# Permutations of more clusters than this are too many to try.
MOST_MATCHED = 7


def shape_error(found: Primitive, truth: Primitive) -> Float[Array, ""]:
    """How wrong a surface is, without a unit: the squared errors of what fixes it, lengths relative to the true radius.

    Sphere: center and radius. Cylinder: distance of the axes at the true base, angle of the axes, radius. Cone: apex relative to
    its true end, angle of the axes, half-angle. Plane: angle of the normals, offset at the true center relative to the patch's
    reach. Ends along the surface do not count: they are read off the points, not fitted. An angle counts by twice the squared sine
    of its half, which is smooth at zero.

    Args:
        found: What `recover` or `refine` gave.
        truth: The same kind of primitive.

    Raises:
        TypeError: Two kinds, or a kind other than these four.
    """
    if type(found) is not type(truth):
        raise TypeError(f"found must be a {type(truth).__name__} as truth is, got {type(found).__name__}")
    match found, truth:
        case Sphere(), Sphere():
            return _square(found.center - truth.center, truth.radius) + _square(
                found.radius - truth.radius, truth.radius
            )
        case Cylinder(), Cylinder():
            aside = _across(as_float(truth.base) - found.base, found.axis)
            size = _square(found.radius - truth.radius, truth.radius)
            return _square(aside, truth.radius) + size + _turned(found.axis, truth.axis)
        case Cone(), Cone():
            reach = jnp.max(as_float(truth.height)) * jnp.tan(as_float(truth.half_angle))
            opened = jnp.square(found.half_angle - as_float(truth.half_angle))
            return _square(found.apex - truth.apex, reach) + opened + _turned(found.axis, truth.axis)
        case Plane(), Plane():
            reach = jnp.sqrt(jnp.mean(jnp.sum(jnp.square(as_float(truth.corners) - truth.point), axis=1)))
            off = (as_float(truth.point) - found.point) @ as_float(found.normal)
            return _square(off, reach) + _turned(found.normal, truth.normal)
    raise TypeError(f"truth must be a Sphere, Cylinder, Cone or Plane, got {type(truth).__name__}")


def _square(error: ArrayLike, unit: ArrayLike) -> Array:
    return jnp.sum(jnp.square(as_float(error) / as_float(unit)))


def _across(offset: Array, axis: ArrayLike) -> Array:
    return offset - (offset @ as_float(axis)) * as_float(axis)


def _turned(found: ArrayLike, truth: ArrayLike) -> Array:
    """1 - |cos| of the angle between two lines."""
    return 1 - jnp.abs(as_float(found) @ as_float(truth))


def soft_rand(memberships: ArrayLike, labels: ArrayLike, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """Adjusted Rand index with memberships in place of labels: 1 where they are the labels, about 0 by chance.

    Two points are together to the degree sum_i u_i u_i'. Sums over pairs follow from the contingency table of memberships and
    labels; with crisp memberships this is Hubert and Arabie's index (1985). No cluster has to be matched with any label, so nothing
    flips.

    Args:
        memberships: Memberships (N, K).
        labels: True group of each point (N,); -1 leaves a point out.
        weights: Weight of each point: weight 2 is the point twice.

    Raises:
        ValueError: Shapes that do not agree.
    """
    u, member, mass = _with_labels(memberships, labels, weights)

    # Of all ordered pairs those of a point with itself are taken off again.
    alone, count = mass @ jnp.sum(jnp.square(u), axis=1), mass.sum()
    together = jnp.sum(jnp.square((mass[:, None] * u).T @ member)) - alone
    own = jnp.sum(jnp.square(mass @ u)) - alone
    true = jnp.sum(jnp.square(mass @ member)) - count
    chance = own * true / (count * (count - 1))
    return divide(together - chance, (own + true) / 2 - chance)


def cross_entropy(
    memberships: ArrayLike,
    labels: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    weights: ArrayLike | None = None,
) -> Float[Array, ""]:
    """Mean of -log of each point's membership in its own group, under the best matching of clusters with groups.

    A proper score: it asks for memberships that are right as probabilities, so it tells a fuzzifier that is too small (sure and
    wrong) from one too large (never sure), where a Rand index sees crisp labels only. All matchings are tried; where two are
    equally good it bends.

    Args:
        memberships: Memberships (N, K), K from the number of groups to 7.
        labels: True group of each point (N,), 0 to G - 1; -1 is an outlier, which should belong to noise, or is left out where
            `noise` is not given.
        noise: Noise membership of each point (N,).
        weights: Weight of each point.

    Raises:
        ValueError: Shapes that do not agree, more groups than clusters, more than 7 clusters.
    """
    u, member, mass = _with_labels(memberships, labels, weights)
    clusters, groups = u.shape[1], member.shape[1]
    if groups > clusters or clusters > MOST_MATCHED:
        raise ValueError(
            f"memberships must have {groups} (the groups) to {MOST_MATCHED} columns to be matched, got {clusters}"
        )
    price = -_log(u).T @ (member * mass[:, None])  # (K, G)
    matchings = np.array(list(itertools.permutations(range(clusters), groups)))
    total = price[matchings, np.arange(groups)].sum(axis=1).min()
    if noise is None:
        return total / mass.sum()
    outside = _heaviness(weights, u.shape[0], u.dtype) * (np.asarray(labels) < 0)
    return (total - outside @ _log(as_float(noise))) / (mass.sum() + outside.sum())


def noise_entropy(noise: ArrayLike, outliers: ArrayLike, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """Cross-entropy of noise memberships against known outliers, outliers and others counting half each.

    Without the balance a noise distance that calls nothing noise is nearly right where outliers are few.

    Args:
        noise: Noise membership of each point (N,), between 0 and 1.
        outliers: Whether each point is an outlier (N,); both must occur.
        weights: Weight of each point.

    Raises:
        ValueError: Shapes that do not agree, or no point of one of the two sorts.
    """
    given, truth = as_float(noise), np.asarray(outliers, bool)
    if given.shape != truth.shape or given.ndim != 1:
        raise ValueError(f"outliers must have the shape of noise, {given.shape}, got {truth.shape}")
    if truth.all() or not truth.any():
        raise ValueError("outliers must hold both sorts of points, got one only")
    mass = _heaviness(weights, given.shape[0], given.dtype)
    inside, outside = mass * ~truth, mass * truth
    return -(outside @ _log(given) / outside.sum() + inside @ _log(1 - given) / inside.sum()) / 2


def resampled(count: int, copies: int, *, seed: int = 0) -> np.ndarray:
    """Weights (copies, count) of bootstrap resamples: how often each point was drawn. Fits take them as `weights`."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), copies).astype(float)


def alignment(memberships: ArrayLike, others: ArrayLike, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """How well two fuzzy partitions of the same points agree on who is with whom: 1 where they say the same.

    The correlation of the two tables of being together, both centered (kernel alignment; Cortes, Mohri and Rostamizadeh 2012). The
    center and the scale are what makes it a loss: fits to resamples always agree where all memberships are equal (large m) or zero
    (small noise distance), and such agreement cancels here. No matching of clusters, no N x N.

    Args:
        memberships: Memberships (N, K), a noise column among them or not.
        others: Memberships of the same points by another fit (N, K').
        weights: Weight of each point.

    Raises:
        ValueError: Shapes that do not agree.
    """
    u, v = as_float(memberships), as_float(others)
    if u.ndim != 2 or v.ndim != 2 or u.shape[0] != v.shape[0]:
        raise ValueError(f"memberships and others must be (N, K) of the same points, got {u.shape} and {v.shape}")
    mass = _heaviness(weights, u.shape[0], u.dtype)
    share = mass / mass.sum()
    u, v = (jnp.sqrt(share)[:, None] * (x - share @ x) for x in (u, v))
    both, one, other = (jnp.sum(jnp.square(a.T @ b)) for a, b in ((u, v), (u, u), (v, v)))
    return divide(both, jnp.sqrt(one * other))


def held_out(
    squared_distances: ArrayLike,
    memberships: ArrayLike,
    fitted: ArrayLike,
    tested: ArrayLike,
    *,
    dims: int,
    extent: float,
) -> Float[Array, ""]:
    """Mean of -log likelihood of points that a fit has not seen, outliers allowed for.

    The fit stands for a mixture: round clusters (or layers along surfaces) of normally distributed points, shares and deviations by
    its memberships in the points it was fitted to, and a uniform background with the share it gave to noise. That is a density
    whatever m and noise distance, so its likelihood compares them; a noise distance too small explains inliers as background, one
    too large lets outliers widen the clusters.

    Args:
        squared_distances: From prototypes (N, K), as `Varieties` carries them or from the centers of a `Partition`.
        memberships: Memberships (N, K); what is missing to 1 is noise.
        fitted: Weights of the fit (N,): 0 for points left out.
        tested: Weight of each point in the mean (N,): above 0 for points left out.
        dims: How many coordinates a distance is made of: D for centers, 1 for surfaces in space.
        extent: Size of the space that background points come from, in the unit of distance to the power `dims`.

    Raises:
        ValueError: Shapes that do not agree, `dims` below 1, `extent` not above 0.
    """
    squares, u = as_float(squared_distances), as_float(memberships)
    if squares.shape != u.shape or u.ndim != 2:
        raise ValueError(f"memberships must have the shape of squared_distances, {squares.shape}, got {u.shape}")
    checks.integer(dims, "dims", at_least=1)
    checks.number(extent, "extent", above=0.0)
    learned, asked = (_heaviness(w, u.shape[0], u.dtype) for w in (fitted, tested))
    own = learned @ u
    share = own / learned.sum()
    variance = divide(learned @ (u * squares), dims * own)
    variance = jnp.maximum(variance, jnp.finfo(u.dtype).tiny)
    logs = _log(share) - dims / 2 * jnp.log(2 * math.pi * variance) - squares / (2 * variance)
    # A point of background is always possible, or one stray point would decide.
    noise = jnp.maximum(1 - share.sum(), 1 / (1 + learned.sum()))
    background = jnp.full((u.shape[0], 1), jnp.log(noise) - jnp.log(extent))
    return -asked @ jax.nn.logsumexp(jnp.concatenate([logs, background], axis=1), axis=1) / asked.sum()


def smooth_xie_beni(
    points: ArrayLike, partition: Partition, *, weights: ArrayLike | None = None, sharpness: float = 8.0
) -> Float[Array, ""]:
    """Xie and Beni's index with every gap of two centers counted, near ones most, so that it has a derivative; lower is better.

    Memberships are squared as in their paper (1991), not taken to the power m, which would reward any large m; so it can choose m.
    It cannot choose a noise distance: though the mean is over what belongs to clusters, the smallest one still wins.

    Args:
        points: The points (N, D) of the fit.
        partition: A partition of at least two clusters with its memberships.
        weights: Weight of each point.
        sharpness: Power p of the mean (mean of gap^-p)^(-1/p) that stands for the smallest squared gap.

    Raises:
        ValueError: Fewer than two clusters, a partition without memberships, shapes that do not agree.
    """
    array, u, mass = _of_fit(points, partition, weights)
    checks.number(sharpness, "sharpness", above=0.0)
    clusters = u.shape[1]
    apart = jnp.stack([jnp.sum(jnp.square(array - center), axis=1) for center in partition.centers], axis=1)
    compact = mass @ jnp.sum(jnp.square(u) * apart, axis=1) / (mass @ u.sum(axis=1))
    left, right = np.triu_indices(clusters, 1)
    gaps = jnp.sum(jnp.square(partition.centers[left] - partition.centers[right]), axis=1)
    logs = jnp.log(jnp.maximum(gaps, jnp.finfo(gaps.dtype).tiny))
    nearest = jnp.exp(-(jax.nn.logsumexp(-sharpness * logs) - jnp.log(len(left))) / sharpness)
    return compact / nearest


def smooth_variance_ratio(
    points: ArrayLike, partition: Partition, *, weights: ArrayLike | None = None
) -> Float[Array, ""]:
    """Logarithm of the variance ratio (eq. 6) with memberships in place of labels, negated: lower is better.

    Scatter within and between clusters is about the clusters' means under their memberships. Crisp memberships win, so it cannot
    choose m; at a given m it can choose a noise distance, whose points count in neither scatter, where clusters are compact.

    Args:
        points: The points (N, D) of the fit.
        partition: A partition of at least two clusters with its memberships.
        weights: Weight of each point.

    Raises:
        ValueError: Fewer than two clusters, a partition without memberships, shapes that do not agree.
    """
    array, u, mass = _of_fit(points, partition, weights)
    heavy = mass[:, None] * u
    own = heavy.sum(axis=0)
    count, clusters = own.sum(), u.shape[1]
    offset = array - heavy.sum(axis=1) @ array / count
    means = divide(heavy.T @ offset, own[:, None])
    between = own @ jnp.sum(jnp.square(means), axis=1)
    within = heavy.sum(axis=1) @ jnp.sum(jnp.square(offset), axis=1) - between
    return jnp.log(within / (count - clusters)) - jnp.log(between / (clusters - 1))


def _of_fit(points: ArrayLike, partition: Partition, weights: ArrayLike | None) -> tuple[Array, Array, Array]:
    array, u = checks.points(points), partition.memberships
    if u.shape[0] != array.shape[0]:
        raise ValueError(f"partition must carry memberships of the {array.shape[0]} points, got {u.shape[0]}")
    if u.shape[1] < 2:
        raise ValueError(f"partition must have at least two clusters, got {u.shape[1]}")
    return array, u, _heaviness(weights, array.shape[0], u.dtype)


def _with_labels(memberships: ArrayLike, labels: ArrayLike, weights: ArrayLike | None) -> tuple[Array, Array, Array]:
    """Memberships, crisp memberships of the labels, and the weights of labelled points."""
    u = checks.points(memberships, "memberships")
    given = checks.labels(labels, u.shape[0])
    if given.max() < 0:
        raise ValueError("labels must name at least one group, got only -1")
    member = (given[:, None] == np.arange(given.max() + 1)).astype(u.dtype)
    return u, jnp.asarray(member), _heaviness(weights, u.shape[0], u.dtype) * (given >= 0)


def _heaviness(weights: ArrayLike | None, count: int, dtype: jnp.dtype) -> Array:
    mass = checks.weights(weights, count)
    return jnp.ones(count, dtype) if mass is None else mass.astype(dtype)


def _log(value: Array) -> Array:
    """The logarithm; of what is smaller than rounding squared that of rounding squared, without derivative."""
    return jnp.log(jnp.maximum(value, jnp.finfo(value.dtype).eps ** 2))
