"""Fuzzy c-varieties with noise clustering in enlarged data spaces (paper section III).

Paper symbols → words: w_i center, s_il basis, D squared distance, A_i scatter, U memberships, m fuzzifier, delta noise distance.

The paper's distance (eq. 13) is that in the embedding, so its unit, and delta's, differ from embedding to embedding and depend
on the origin; it is kept as `distance="algebraic"`. With f = n · (phi(p) - w) the polynomial that vanishes on a variety,
`distance="geometric"` is |f| / |∇f|, to first order the distance to the surface in metres, the same in every embedding. Its step
replaces the eigenproblem A n = λ n by A n = λ B n with B the mean of ∇phi ∇phiᵀ (Taubin, PAMI 13, 1991). That minimises a ratio
and may raise the objective, so it is stopped by the change of the prototypes, which are the centers and the projectors onto the
directions off each variety: unlike eigenvectors these have no sign and cannot rotate in place.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, is_concrete
from jaxfuzzy.blocks import Blocks
from jaxfuzzy.embedding import monomial_gradients, monomials, padded_tables
from jaxfuzzy.linalg import weighted_moments, weighted_range
from jaxfuzzy.solve import Solver, fixed_point
from jaxfuzzy.tiles import Parts, frame
from jaxfuzzy.varietyblocks import fit_blocks
from jaxfuzzy.varietyresult import Varieties as Varieties
from jaxfuzzy.varietyresult import unless_finite
from jaxfuzzy.varietystep import (
    directions,
    divide_points,
    jacobian,
    local_places,
    moments,
    pose,
    powers,
    prototypes,
    shares_of_one,
    status,
    step,
)


def nfcv(
    points: ArrayLike | Blocks,
    start: ArrayLike | Varieties,
    *,
    embedding: str | Sequence[str] = "6d",
    dimension: int | None = None,
    noise_distance: Scalar | ArrayLike | None = None,
    m: Scalar = 2.0,
    distance: Literal["geometric", "algebraic"] = "geometric",
    weights: ArrayLike | None = None,
    solver: Solver = Solver(),
) -> Varieties:
    """Fuzzy c-varieties with a noise cluster, in an enlarged data space (eqs. 12 to 21).

    Runs under `jit`, `vmap` and `grad`: everything but steps, labels, inliers and basis has first derivatives with respect to
    `points`, `weights`, `m` and `noise_distance`, those of the fixed point reached.

    Args:
        points: Points (N, 3) in metres, or (N, D) with the embedding "linear"; or `blocks` of them where they do not fit into
            memory: one embedding, one noise distance, no derivatives, and nothing that has one number a point in the result.
        start: Memberships (N, C) to start from, or Varieties of the same points to go on from (by their memberships). Over blocks,
            Varieties of any points, say of a sample, to go on from by their prototypes.
        embedding: A name of `jaxfuzzy.embedding`; or several, which are then fitted side by side in one compiled call.
        dimension: Dimension q of the varieties, Q - 1 where not given. Others need the algebraic distance, or an embedding
            in which both distances agree ("3d", "linear").
        noise_distance: Distance of the noise cluster, one number or one a point: metres with the geometric distance, the
            unit of the embedding with the algebraic one. None: no noise cluster, which is plain fuzzy c-varieties.
        m: Fuzzifier, above 1.
        distance: "geometric" or "algebraic"; see above. The algebraic one takes the coordinates as they are, uncentered.
        weights: Weight of each point (N,), not negative: weight 2 is the point twice, weight 0 the point absent, though it has
            memberships too (as if it were no farther than 1,000 spreads from the others).
        solver: Steps, tolerance and acceleration. The geometric step is never accelerated: with no objective to guard it, an
            accelerated step may circle where the plain one passes.

    Returns:
        The varieties; their `status` tells what to mistrust.

    Raises:
        ValueError: An argument out of range, an unknown name, shapes that do not agree, non-finite points.
        TypeError: Points, start or weights that are not real numbers.
    """
    if isinstance(points, Blocks):
        found = points.survey(weights)
        count, dims = found.count, found.dims
    else:
        points = checks.points(points)
        count, dims = points.shape
    checks.kind(solver, "solver", Solver)
    if not isinstance(embedding, Sequence):
        raise TypeError(f"embedding must be a name or several, got {embedding!r}")
    names = (embedding,) if isinstance(embedding, str) else tuple(embedding)
    if not names:
        raise ValueError("embedding must be a name or several, got none")
    tables, real = padded_tables(names, dims)
    checks.choice(distance, "distance", ("geometric", "algebraic"))
    sizes = real.sum(axis=1)
    geometric = distance == "geometric"
    if dimension is not None:
        most = int(sizes.min()) - 1
        checks.integer(
            dimension, "dimension", at_least=1, at_most=most, why=f" (Q - 1 of {', '.join(map(repr, names))})"
        )
        if geometric and (sizes - 1 > dimension).any():
            if not set(names) <= {"3d", "linear"}:
                raise ValueError(
                    f"dimension must be Q - 1 with distance='geometric' in {', '.join(map(repr, names))}, got {dimension};"
                    " use distance='algebraic'"
                )
            geometric = False  # the gradient has length 1 here: both distances are the same
    elif sizes.min() < 2:
        raise ValueError("points must have at least two coordinates for embedding='linear', got 1")
    spans = sizes - 1 if dimension is None else sizes * 0 + dimension

    checks.fuzzifier(m)
    if isinstance(points, Blocks):
        return fit_blocks(
            points,
            weights,
            found,
            start,
            embedding,
            tables[0],
            real[0],
            spans[0],
            m,
            noise_distance,
            solver,
            distance,
            geometric,
        )
    memberships = _start(start, count, len(names))
    checks.noise_distance(noise_distance, count)
    weights = checks.weights(weights, count)
    if weights is not None and not isinstance(start, Varieties) and is_concrete(memberships) and is_concrete(weights):
        held = np.asarray(memberships[0])[np.asarray(weights) > 0].max(axis=0) > 0
        if not held.all():
            empty = int(np.argmin(held))
            raise ValueError(f"start must leave no column all zero where points have weight, got column {empty} so")
    parts = Parts.of(points, solver.mesh)
    points = points if parts is None else parts.place(points)
    dtype = jnp.result_type(points, memberships)
    as_type = partial(jnp.asarray, dtype=dtype)
    arguments = (
        as_type(tables),
        jnp.asarray(real),
        jnp.asarray(sizes - spans),
        memberships.astype(dtype),
        points.astype(dtype),
        as_type(m),
        None if noise_distance is None else as_type(noise_distance),
        jnp.ones(count, dtype) if weights is None else weights.astype(dtype),
        as_type(solver.tol),
    )
    options: dict[str, Any] = {
        "span": int(spans.max()),
        "geometric": geometric,
        "max_steps": solver.max_steps,
        "acceleration": None if geometric else solver.acceleration,
        "names": embedding if isinstance(embedding, str) else names,
        "distance": distance,
    }
    if parts is not None:
        options["parts"] = parts
    if not isinstance(embedding, str):
        return _fit_each(*arguments, **options)
    return _fit_single(*(a[0] for a in arguments[:4]), *arguments[4:], **options)


def _start(start: ArrayLike | Varieties, count: int, embeddings: int) -> Float[Array, "E N C"]:
    """Memberships to start from, one set an embedding."""
    if isinstance(start, Varieties):
        u = start.memberships
        if u.ndim == 3 and u.shape[0] != embeddings:
            raise ValueError(f"start must hold {embeddings} embeddings, got {u.shape[0]}")
        if u.shape[-2] != count:
            raise ValueError(f"start must hold memberships of the same {count} points, got {u.shape[-2]}")
    else:
        u = checks.memberships(start, count, "start")
    return jnp.broadcast_to(u, (embeddings, *u.shape[-2:]))


def _fit_one(
    table: Float[Array, "Q M"],
    real: Bool[Array, " Q"],
    across: Int[Array, ""],
    memberships: Float[Array, "N C"],
    points: Float[Array, "N D"],
    m: Array,
    noise_distance: Array | None,
    weights: Float[Array, " N"],
    tol: Array,
    *,
    span: int,
    geometric: bool,
    max_steps: int,
    acceleration: Literal["anderson"] | None,
    names: str | tuple[str, ...],
    distance: str,
    parts: Parts | None = None,
) -> Varieties:
    """The compiled fit in one embedding, padded."""
    if parts is not None:
        return _divided(
            parts, table, real, across, memberships, points, m, noise_distance, weights, tol, span=span, geometric=geometric,
            max_steps=max_steps, acceleration=acceleration, names=names, distance=distance,
        )  # fmt: skip
    chex.assert_rank([table, memberships, points], 2)
    chex.assert_equal_shape_prefix([memberships, points], 1)
    task, place = pose(table, real, across, points, m, noise_distance, weights, geometric=geometric)
    begin = lax.stop_gradient(prototypes(moments(powers(m * jnp.log(memberships.T), weights), task), across))
    solver = Solver(max_steps, tol, acceleration)  # type: ignore[arg-type]
    solution = fixed_point(step, begin, task, solver, jacobian=jacobian, descent=not geometric)
    theta = solution.theta

    part, squared = divide_points(theta, task)
    u = part.memberships.T
    noisy = part.noise > u.max(axis=1)
    labels = jnp.where(noisy, -1, u.argmax(axis=1))
    used = weights > 0
    share = powers(part.log_powers(m), weights)
    mean, unit = lax.stop_gradient(frame(points, weights))
    unit = jnp.where(unit > 0, unit, 1)
    local = local_places(points, weights, mean, unit)
    local_centers, scatter = weighted_moments(monomials(local) @ table.T, share)
    gradients = jnp.einsum("qm,nmd->nqd", table, monomial_gradients(local))
    own = weights[:, None] * u * (labels[:, None] == jnp.arange(u.shape[1]))
    own = jnp.where(own.sum(axis=0) > 0, own, weights[:, None] * u)
    sums = moments(share, task)
    normals, basis = directions(theta, place, sums[1], real, across, span)
    offset = jnp.where(used[:, None], points - points[jnp.argmax(weights)], 0)
    extents = jnp.linalg.eigvalsh(weighted_moments(lax.stop_gradient(offset), weights[None])[1][0])
    inliers = (~noisy & used).sum()
    fit = Varieties(
        centers=place.origin + theta["centers"] @ place.back.T,
        normals=normals,
        basis=basis,
        squared_distances=squared.T * place.unit**2,
        memberships=u,
        noise=part.noise,
        labels=labels,
        inliers=~noisy,
        objective=part.objective(m) @ weights * place.unit**2,
        steps=solution.steps,
        status=status(theta, sums, real, across, extents, inliers, solution.converged),
        m=m,
        noise_distance=jnp.asarray(jnp.inf, points.dtype) if noise_distance is None else noise_distance,
        origin=mean,
        unit=unit,
        local_centers=local_centers,
        scatter=scatter,
        slopes=jnp.einsum("cn,nqd,npd->cqp", shares_of_one(share), gradients, gradients),
        bounds=jax.vmap(jax.vmap(weighted_range, (1, None), 1), (None, 1))(points, own),
        masses=weights @ u,
        embedding=names,
        distance=distance,
    )
    return unless_finite(fit)


def _divided(
    parts: Parts,
    table: Array,
    real: Array,
    across: Array,
    memberships: Array,
    points: Array,
    m: Array,
    noise_distance: Array | None,
    weights: Array,
    tol: Array,
    **options: Any,
) -> Varieties:
    """The same with whatever has one entry a point divided among devices; the compiler puts the sums together."""
    count = points.shape[0]
    noise = noise_distance
    if noise is not None and noise.ndim:
        filler = jnp.ones(-count % parts.count, noise.dtype)
        noise = parts.split(jnp.concatenate([noise, filler]))
    fit = _fit_one(
        table,
        real,
        across,
        parts.split(memberships),
        parts.split(points),
        m,
        noise,
        parts.split(weights),
        tol,
        **options,
    )
    own = {
        name: getattr(fit, name)[:count] for name in ("squared_distances", "memberships", "noise", "labels", "inliers")
    }
    return replace(fit, **own, noise_distance=fit.noise_distance if noise_distance is None else noise_distance)


_STATIC = ("span", "geometric", "max_steps", "acceleration", "names", "distance", "parts")


_fit_single = partial(jax.jit, static_argnames=_STATIC)(_fit_one)


@partial(jax.jit, static_argnames=_STATIC)
def _fit_each(*arguments: Any, **options: Any) -> Varieties:
    """One fit an embedding, side by side: the first four arguments have a leading axis E."""
    return jax.vmap(partial(_fit_one, **options), (0, 0, 0, 0, None, None, None, None, None))(*arguments)
