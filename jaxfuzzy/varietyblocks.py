"""Fuzzy c-varieties over blocks of points: the step of `varietystep` with its sums added up on the host."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Float, Int, Scalar, record
from jaxfuzzy.blocks import Blocks, Survey, Total, fingerprint
from jaxfuzzy.embedding import monomial_gradients, monomials
from jaxfuzzy.linalg import normalised, weighted_moments
from jaxfuzzy.solve import FixedPoint, Solver, fixed_point_outside
from jaxfuzzy.varietyresult import Varieties, unless_finite
from jaxfuzzy.varietystep import (
    Frame,
    Prototypes,
    Task,
    directions,
    divide_points,
    local_places,
    padded_moments,
    pose,
    powers,
    prototypes,
    shares_of_one,
    status,
)

# The ends of a variety are read off a histogram of this many bins over its whole length.
BINS = 4096

# What fixes a task besides its points: table, real coordinates, directions across, fuzzifier, noise distance, frame.
Given = tuple[Array, Array, Array, Array, Array | None, tuple[Array, Array, Array]]


@record
class Moments:
    """What a block adds: means under weights relative to exp(top), and the weights' sum.

    Attributes:
        mass: Sum of w u^m.
        top: The largest logarithm of w u^m, which `mass` is relative to; -inf where nothing has weight.
        centers: Means of the features.
        scatter: Their mean squares about these means.
        metric: Means of gradient products; None with the algebraic distance.
        objective: Sum of the objective's terms.
    """

    mass: Float[Array, " C"]
    top: Float[Array, " C"]
    centers: Float[Array, "C Q"]
    scatter: Float[Array, "C Q Q"]
    metric: Float[Array, "C Q Q"] | None
    objective: Float[Array, ""]


@record
class Ends:
    """What the last sweep adds to the moments.

    Attributes:
        solving: Moments in the solving frame.
        local: Moments of the embedded local points.
        points: Those of the local points themselves, with their own weights alone.
        inliers: How many points with weight are no noise.
        low: Lowest coordinates of each variety's own points.
        high: Highest ones.
        masses: Weighted sum of the memberships in each variety.
    """

    solving: Moments
    local: Moments
    points: Moments
    inliers: Int[Array, ""]
    low: Float[Array, "C D"]
    high: Float[Array, "C D"]
    masses: Float[Array, " C"]


def fit_blocks(
    points: Blocks,
    weights: Any,
    found: Survey,
    start: Any,
    embedding: str | Sequence[str],
    table: np.ndarray,
    real: np.ndarray,
    span: int,
    m: Scalar,
    noise_distance: Any,
    solver: Solver,
    distance: str,
    geometric: bool,
) -> Varieties:
    """The fit of `varieties` with the sums of every step added up over blocks."""
    if not isinstance(embedding, str):
        raise ValueError(f"embedding must be one name for blocks, got {tuple(embedding)}")
    if not isinstance(start, Varieties) or start.embedding != embedding:
        raise ValueError(
            f"start must be Varieties in the embedding {embedding!r} for blocks: those of a sample will do"
        )
    if start.basis.shape[2] != span or start.origin.shape != (found.dims,):
        raise ValueError(f"start must hold varieties of dimension {span} of points with {found.dims} coordinates")
    checks.noise_distance(noise_distance)
    dtype = jnp.result_type(found.dtype, start.centers)
    as_type = partial(jnp.asarray, dtype=dtype)
    noise = None if noise_distance is None else as_type(noise_distance)
    across = jnp.asarray(real.sum() - span)
    mean = as_type(found.total.mean)
    spread = as_type(found.total.spread if found.total.spread > 0 else 1.0)
    embedded = Total()
    embed = partial(
        _embed, as_type(table), *((mean, spread) if geometric else (jnp.zeros_like(mean), jnp.ones_like(spread)))
    )
    points.each(weights, dtype, lambda block, w: embedded.add(np.asarray(embed(block), float), np.asarray(w, float)))
    unit = spread if geometric else as_type(embedded.spread if embedded.spread > 0 else 1.0)
    given = (as_type(table), jnp.asarray(real), across, as_type(m), noise, (mean, unit, as_type(embedded.mean)))
    # The frame is the same for every block, so that of any one point will do.
    place = _pose(given, mean[None], jnp.ones(1, dtype), geometric=geometric)[1]
    solution = _solve(points, weights, found, given, place, _entering(start, place, real, dtype), solver, geometric)
    theta = solution.theta
    ends = points.each(weights, dtype, partial(_ends_of_block, theta, given, (mean, spread), geometric=geometric))
    low = np.min([np.asarray(one.low) for one in ends], axis=0)
    high = np.max([np.asarray(one.high) for one in ends], axis=0)
    low, high = np.where(low <= high, low, 0), np.where(low <= high, high, 0)
    count = partial(_histogram_of_block, theta, given, (as_type(low), as_type(high)), geometric=geometric)
    counts = np.sum([np.asarray(one, float) for one in points.each(weights, dtype, count)], axis=0)
    solving, local, cloud = (merged([getattr(one, of) for one in ends]) for of in ("solving", "local", "points"))
    sums = _padded(jax.tree.map(as_type, solving), jnp.asarray(real))
    extents = jnp.linalg.eigvalsh(as_type(cloud.scatter[0]))
    inliers = jnp.asarray(sum(int(one.inliers) for one in ends))
    normals, basis = directions(theta, place, sums[1], jnp.asarray(real), across, int(span))
    clusters = normals.shape[0]
    empty = jnp.zeros((0, clusters), dtype)
    return unless_finite(
        Varieties(
            centers=place.origin + theta["centers"] @ place.back.T,
            normals=normals,
            basis=basis,
            squared_distances=empty,
            memberships=empty,
            noise=empty[:, 0],
            labels=jnp.zeros(0, jnp.int32),
            inliers=jnp.zeros(0, bool),
            objective=as_type(solving.objective) * place.unit**2,
            steps=solution.steps,
            status=status(theta, sums, jnp.asarray(real), across, extents, inliers, solution.converged),
            m=as_type(m),
            noise_distance=as_type(jnp.inf) if noise is None else noise,
            origin=mean,
            unit=spread,
            local_centers=as_type(local.centers),
            scatter=as_type(local.scatter),
            slopes=as_type(local.metric),
            bounds=as_type(_range(counts, low, high)),
            masses=as_type(sum(np.asarray(one.masses, float) for one in ends)),
            embedding=embedding,
            distance=distance,
        )
    )


def _solve(
    points: Blocks,
    weights: Any,
    found: Survey,
    given: Given,
    place: Frame,
    begin: Prototypes,
    solver: Solver,
    geometric: bool,
) -> FixedPoint:
    dtype = begin["centers"].dtype
    as_type = partial(jnp.asarray, dtype=dtype)

    def one_round(thetas: list[Prototypes]) -> tuple[list[Prototypes], list[Array]]:
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *thetas)
        each = points.each(weights, dtype, partial(_moments_of_block, stacked, given, geometric=geometric))
        sums = [merged([jax.tree.map(lambda leaf, i=i: leaf[i], one) for one in each]) for i in range(len(thetas))]
        ahead = [_ahead(jax.tree.map(as_type, one), given) for one in sums]
        return ahead, [jnp.log(as_type(one.objective)) for one in sums]

    table, _, _, m, noise, _ = given
    total = found.total
    data = (found.count, total.weight, total.mean, total.spread)
    task = fingerprint(
        "nfcv", geometric, *data, table, begin["centers"], begin["across"], m, noise, solver.acceleration
    )
    after = partial(points.keep, task)
    return fixed_point_outside(one_round, begin, solver, descent=not geometric, saved=points.resume(task), after=after)


def _entering(start: Varieties, place: Frame, real: np.ndarray, dtype: Any) -> Prototypes:
    """Prototypes of varieties, taken from the input's frame into the solving one."""
    centers, normals, basis = (jnp.asarray(value, dtype) for value in (start.centers, start.normals, start.basis))
    if normals.shape[1] - basis.shape[2] == 1:
        normals = jax.vmap(normalised)(normals @ place.back)
        off = normals[:, :, None] * normals[:, None]
    else:
        off = jnp.diag(jnp.asarray(real, dtype)) - jnp.einsum("cqa,cpa->cqp", basis, basis)
    return {"across": off, "centers": (centers - place.origin) @ place.forward.T}


def merged(blocks: list[Moments]) -> Moments:
    """Moments of several blocks put together on the host in double precision (Chan, Golub and LeVeque, 1979)."""
    each = [jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), block) for block in blocks]
    top = np.max([one.top for one in each], axis=0)
    known = np.where(top > -np.inf, top, 0)
    heaps = [one.mass * np.exp(one.top - known) for one in each]
    mass = np.sum(heaps, axis=0)
    parts = [heap / np.where(mass > 0, mass, 1) for heap in heaps]
    centers = np.sum([part[:, None] * one.centers for part, one in zip(parts, each, strict=True)], axis=0)
    moves = [one.centers - centers for one in each]
    scatter = sum(
        part[:, None, None] * (one.scatter + move[:, :, None] * move[:, None])
        for part, one, move in zip(parts, each, moves, strict=True)
    )
    metric = None
    if each[0].metric is not None:
        metric = sum(part[:, None, None] * one.metric for part, one in zip(parts, each, strict=True))
    return Moments(mass, top, centers, scatter, metric, sum(one.objective for one in each))


@jax.jit
def _embed(table: Array, mean: Array, unit: Array, points: Float[Array, "n D"]) -> Float[Array, "n Q"]:
    return monomials((points - mean) / unit) @ table.T


@partial(jax.jit, static_argnames="geometric")
def _pose(given: Given, points: Array, weights: Array, *, geometric: bool) -> tuple[Task, Frame]:
    table, real, across, m, noise_distance, whole = given
    return pose(table, real, across, points, m, noise_distance, weights, geometric=geometric, whole=whole)


def _sums(features: Float[Array, "n Q"], slopes: Array | None, share: Array, top: Array, objective: Array) -> Moments:
    centers, scatter = weighted_moments(features, share)
    metric = None if slopes is None else jnp.einsum("cn,qpn->cqp", shares_of_one(share), slopes)
    return Moments(share.sum(axis=1), top, centers, scatter, metric, objective)


def _divided(theta: Prototypes, task: Task) -> tuple[Any, Array, Array, Moments]:
    part, _ = divide_points(theta, task)
    logs = part.log_powers(task.m)
    share = powers(logs, task.weights)
    top = jnp.where(task.weights > 0, logs, -jnp.inf).max(axis=1)
    objective = part.objective(task.m) @ task.weights
    return part, share, top, _sums(task.features.T, task.slopes, share, top, objective)


@partial(jax.jit, static_argnames="geometric")
def _moments_of_block(thetas: Prototypes, given: Given, points: Array, weights: Array, *, geometric: bool) -> Moments:
    task, _ = _pose(given, points, weights, geometric=geometric)
    return jax.vmap(lambda theta: _divided(theta, task)[3])(thetas)


@partial(jax.jit, static_argnames="geometric")
def _ends_of_block(
    theta: Prototypes, given: Given, local: tuple[Array, Array], points: Array, weights: Array, *, geometric: bool
) -> Ends:
    task, _ = _pose(given, points, weights, geometric=geometric)
    part, share, top, solving = _divided(theta, task)
    used = weights > 0
    inside = local_places(points, weights, *local)
    gradients = jnp.einsum("qm,nmd->nqd", given[0], monomial_gradients(inside))
    slopes = jnp.einsum("nqd,npd->qpn", gradients, gradients)
    labels = _labels(part)
    mine = (labels == jnp.arange(share.shape[0])[:, None]) & used
    zero = jnp.zeros((), points.dtype)
    return Ends(
        solving=solving,
        local=_sums(monomials(inside) @ given[0].T, slopes, share, top, zero),
        points=_sums(inside, None, weights[None], zero[None], zero),
        inliers=((labels >= 0) & used).sum(),
        low=jnp.where(mine[:, :, None], points, jnp.inf).min(axis=1),
        high=jnp.where(mine[:, :, None], points, -jnp.inf).max(axis=1),
        masses=part.memberships @ weights,
    )


@partial(jax.jit, static_argnames="geometric")
def _histogram_of_block(
    theta: Prototypes, given: Given, ends: tuple[Array, Array], points: Array, weights: Array, *, geometric: bool
) -> Float[Array, "C D B"]:
    """Weight of each variety's own points over its length."""
    task, _ = _pose(given, points, weights, geometric=geometric)
    part, _ = divide_points(theta, task)
    labels, u = _labels(part), part.memberships
    low, high = (end[labels] for end in ends)
    place = (points - low) / jnp.where(high > low, high - low, 1) * BINS
    bins = jnp.clip(place.astype(jnp.int32), 0, BINS - 1)
    own = jnp.where(labels >= 0, weights * u[labels, jnp.arange(u.shape[1])], 0)
    empty = jnp.zeros((u.shape[0], points.shape[1], BINS), points.dtype)
    return empty.at[labels[:, None], jnp.arange(points.shape[1]), bins].add(own[:, None])


def _labels(part: Any) -> Int[Array, " n"]:
    u = part.memberships
    return jnp.where(part.noise > u.max(axis=0), -1, u.argmax(axis=0))


def _range(counts: np.ndarray, low: np.ndarray, high: np.ndarray, tail: float = 0.02) -> np.ndarray:
    """What `linalg.weighted_range` gives, read off histograms (C, D, B) between the lowest and highest values (C, D)."""
    out = np.empty((counts.shape[0], 2, counts.shape[1]))
    for c, d in np.ndindex(counts.shape[:2]):
        heap = np.concatenate([[0.0], np.cumsum(counts[c, d])])
        heap = heap / heap[-1] if heap[-1] > 0 else np.linspace(0, 1, len(heap))
        edges = np.linspace(low[c, d], high[c, d], len(heap))
        ends = np.interp([tail, 1 - tail], heap, edges)
        beyond = (ends[1] - ends[0]) * tail / (1 - 2 * tail)
        out[c, :, d] = ends[0] - beyond, ends[1] + beyond
    return out


def _padded(sums: Moments, real: Array) -> tuple[Array, Array, Array | None]:
    return padded_moments(sums.centers, sums.scatter, sums.metric, real)


@jax.jit
def _ahead(sums: Moments, given: Given) -> Prototypes:
    _, real, across, *_ = given
    return prototypes(_padded(sums, real), across)
