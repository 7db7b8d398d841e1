"""One step of fuzzy c-varieties, in a frame where the embedded points are centered and scaled.

`varieties` sets the task up, iterates `step` to its fixed point and takes the outcome back to the input's frame.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxfuzzy.arrays import Array, Bool, Float, Int, record
from jaxfuzzy.embedding import monomial_gradients, monomials, monomials_of_affine, unmixed
from jaxfuzzy.linalg import divide, normalised, pencil, smallest_eigenvector, smallest_projector, weighted_moments
from jaxfuzzy.memberships import Shares, shares
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import FARTHEST, frame, tame

# A surface whose second smallest mean squared distance is not this much above the smallest is one of many that fit.
LEAST_GAP = 4.0
# Two varieties count as one where they are this near, in units of the points' RMS spread, and their projectors as alike.
SAME_PLACE = 1e-4
# Logarithm of how far a point of weight 0 may be above all others in its membership.
MOST_ABOVE = 40.0
# Values that one pass of the Jacobian may hold at a time: 4 MiB of 4-byte floats.
JACOBIAN_VALUES = 2**20

# "centers": a point on each variety (C, Q); "across": the projector onto the directions off it (C, Q, Q).
Prototypes = dict[str, Array]


@record
class Task:
    """What a step reads beside the prototypes, in the solving frame; points come last, which is several times faster.

    Attributes:
        features: Embedded points.
        slopes: ∇phi ∇phiᵀ at each point; None with the algebraic distance.
        weights: Weight of each point.
        m: Fuzzifier.
        squared_noise: Squared noise distance, one or one a point; None without a noise cluster.
        real: Which coordinates are not padding.
        across: Number of directions off a variety, Q - q.
    """

    features: Float[Array, "Q N"]
    slopes: Float[Array, "Q Q N"] | None
    weights: Float[Array, " N"]
    m: Float[Array, ""]
    squared_noise: Float[Array, "..."] | None
    real: Bool[Array, " Q"]
    across: Int[Array, ""]


@record
class Frame:
    """How to leave the solving frame: embedded points are origin + back · (those of the solving frame).

    Attributes:
        origin: The embedded point at the solving frame's origin.
        back: Out of the solving frame.
        forward: Into it: the inverse of `back` on the real coordinates.
        unit: What distances of the solving frame are measured in.
    """

    origin: Float[Array, " Q"]
    back: Float[Array, "Q Q"]
    forward: Float[Array, "Q Q"]
    unit: Float[Array, ""]


def pose(
    table: Float[Array, "Q M"],
    real: Bool[Array, " Q"],
    across: Int[Array, ""],
    points: Float[Array, "N D"],
    m: Array,
    noise_distance: Array | None,
    weights: Float[Array, " N"],
    *,
    geometric: bool,
    whole: tuple[Array, Array, Array] | None = None,
) -> tuple[Task, Frame]:
    """Sets the task up in a well-conditioned frame; that of `whole`, (mean, unit, mean of the features), where points are a block.

    The geometric distance does not change when the points are shifted, and scales with them, so the points themselves are
    centered and scaled. The algebraic one depends on where the points are, so only the embedded points are. Both maps
    commute with a step, and carry no derivative.
    """
    if geometric:
        mean, unit = lax.stop_gradient(frame(points, weights) if whole is None else whole[:2])
        unit = jnp.where(unit > 0, unit, 1)
        points = local_places(points, weights, mean, unit)
        gradients = jnp.einsum("qm,nmd->nqd", table, monomial_gradients(points))
        slopes = jnp.einsum("nqd,npd->qpn", gradients, gradients)
        features = monomials(points) @ table.T
        middle = lax.stop_gradient(weights @ features / weights.sum() if whole is None else whole[2])
        features = features - middle
        matrix, constant = monomials_of_affine(unit, mean)
        inverse, _ = monomials_of_affine(1 / unit, -mean / unit)
        back, forward = (table @ change @ unmixed(table).T for change in (matrix, inverse))
        place = Frame(table @ constant + back @ middle, back, forward, unit)
    else:
        used = (weights > 0)[:, None]
        if whole is None:
            here, reach = lax.stop_gradient(frame(points, weights))
            reach = jnp.where(reach > 0, reach, 1)
            points = jnp.where(used, points, here + reach * local_places(points, weights, here, reach))
        else:  # a block tells nothing of single points, and may have none with weight that could say where they are
            points = jnp.where(used, points, whole[0])
        features, slopes = monomials(points) @ table.T, None
        middle, unit = lax.stop_gradient(frame(features, weights) if whole is None else (whole[2], whole[1]))
        unit = jnp.where(unit > 0, unit, 1)
        features = (features - middle) / unit
        one = jnp.eye(middle.size, dtype=unit.dtype)
        place = Frame(middle, one * unit, one / unit, unit)
    squared_noise = None if noise_distance is None else jnp.square(noise_distance / unit)
    return Task(features.T, slopes, weights, m, squared_noise, real, across), place


def local_places(
    points: Float[Array, "N D"], weights: Float[Array, " N"], mean: Array, unit: Array
) -> Float[Array, "N D"]:
    """Points in units of their spread about their mean; those of weight 0 where they are, but no farther than sums can bear."""
    local = (points - mean) / unit
    # Fourth powers of it are taken.
    near = jnp.clip(tame(local), -(FARTHEST**0.5), FARTHEST**0.5)
    return jnp.where((weights > 0)[:, None], local, near)


def step(theta: Prototypes, task: Task) -> tuple[Prototypes, Array]:
    """One round of alternating optimisation (eqs. 15 to 17 and 20), and the logarithm of the objective it started from."""
    part, _ = divide_points(theta, task)
    objective = part.objective(task.m) @ task.weights
    sums = moments(powers(part.log_powers(task.m), task.weights), task)
    return prototypes(sums, task.across), jnp.log(objective)


def divide_points(theta: Prototypes, task: Task) -> tuple[Shares, Float[Array, "C N"]]:
    """How points divide themselves among the varieties and noise, and their squared distances from each variety."""
    offset = task.features - theta["centers"][:, :, None]
    squared = jnp.einsum("cqn,cqp,cpn->cn", offset, theta["across"], offset)
    if task.slopes is not None:
        steepness = jnp.einsum("cqp,qpn->cn", theta["across"], task.slopes)
        # At an apex both vanish, the squared value faster: rounding in the divisor makes the quotient zero there.
        squared = squared / (jnp.maximum(steepness, 0) + jnp.finfo(squared.dtype).eps)
    squared = jnp.maximum(squared, 0)
    # So small that it changes no membership, so large that neither it nor its square is flushed to zero.
    floor = 4 * jnp.sqrt(jnp.finfo(squared.dtype).tiny)
    return shares(jnp.maximum(squared, floor), task.m, None, task.squared_noise), squared


def powers(log_powers: Float[Array, "C N"], weights: Float[Array, " N"]) -> Float[Array, "C N"]:
    """Weights times memberships to the power m, relative to each variety's largest one, so that they never all underflow."""
    top = lax.stop_gradient(jnp.where(weights > 0, log_powers, -jnp.inf).max(axis=1, keepdims=True))
    some = log_powers > -jnp.inf
    # Above the largest are at most points of weight 0, which count for nothing unless they overflow.
    above = jnp.minimum(log_powers - jnp.where(top > -jnp.inf, top, 0), MOST_ABOVE)
    return jnp.where(some, jnp.exp(jnp.where(some, above, 0)), 0) * weights


Moments = tuple[Array, Array, Array | None]


def moments(share: Float[Array, "C N"], task: Task) -> Moments:
    """Centers (eq. 15), scatter (eq. 16) and, with the geometric distance, the mean of gradient products."""
    centers, scatter = weighted_moments(task.features.T, share)
    metric = None if task.slopes is None else jnp.einsum("cn,qpn->cqp", shares_of_one(share), task.slopes)
    return padded_moments(centers, scatter, metric, task.real)


def padded_moments(centers: Array, scatter: Array, metric: Array | None, real: Bool[Array, " Q"]) -> Moments:
    """Gives padded coordinates an eigenvalue well above the smallest, so that none is ever a normal."""
    pad = jnp.diag(jnp.where(real, 0, 1).astype(scatter.dtype))
    total = lax.stop_gradient(jnp.trace(scatter, axis1=1, axis2=2))
    if metric is None:
        return centers, scatter + (1 + total)[:, None, None] * pad, None
    # The smallest eigenvalue is no larger than the quotient of the traces.
    most = divide(total, lax.stop_gradient(jnp.trace(metric, axis1=1, axis2=2)))
    return centers, scatter + (1 + 2 * LEAST_GAP * most)[:, None, None] * pad, metric + pad


def shares_of_one(weights: Float[Array, "C N"]) -> Float[Array, "C N"]:
    """Weights divided by their sum."""
    return divide(weights, weights.sum(axis=1, keepdims=True))


def prototypes(sums: Moments, across: Int[Array, ""]) -> Prototypes:
    """The varieties that the moments call for."""
    centers, scatter, metric = sums
    if metric is None:
        return {"centers": centers, "across": jax.vmap(smallest_projector, (0, None))(scatter, across)}
    normals = jax.vmap(smallest_eigenvector)(scatter, metric)
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    return {"centers": centers, "across": normals[:, :, None] * normals[:, None]}


def jacobian(theta: Prototypes, task: Task) -> Float[Array, "p p"]:
    """Derivative of `step` with respect to the raveled prototypes, a few columns at a time to bound memory."""
    flat, unravel = ravel_pytree(theta)

    def image(y: Array) -> Array:
        return ravel_pytree(step(unravel(y), task)[0])[0]

    def column(direction: Array) -> Array:
        return jax.jvp(image, (flat,), (direction,))[1]

    batch = max(1, JACOBIAN_VALUES // (task.features.size * theta["centers"].shape[0]))
    return lax.map(column, jnp.eye(flat.size, dtype=flat.dtype), batch_size=batch).T


def status(
    theta: Prototypes,
    sums: Moments,
    real: Bool[Array, " Q"],
    across_count: Int[Array, ""],
    extents: Float[Array, " D"],
    inliers: Int[Array, ""],
    converged: Bool[Array, ""],
) -> Int[Array, ""]:
    """Every reason to mistrust a fit; `extents` are the eigenvalues of the points' scatter, `inliers` those that are no noise."""
    theta, sums, extents = lax.stop_gradient((theta, sums, extents))
    centers, across = theta["centers"], theta["across"]
    _, scatter, metric = sums
    eps = jnp.finfo(extents.dtype).eps
    if metric is None:
        values = jnp.linalg.eigvalsh(scatter)
        largest = jnp.trace(scatter * real, axis1=1, axis2=2)
        undetermined = values[:, across_count] - values[:, across_count - 1] <= 1e3 * eps * largest
    else:
        values = jax.vmap(lambda a, b: pencil(a, b)[0])(scatter, metric)
        undetermined = values[:, 1] <= LEAST_GAP * values[:, 0] + 1e3 * eps
    clusters = centers.shape[0]
    apart = centers[:, None] - centers
    near = jnp.einsum("abq,bqp,abp->ab", apart, across, apart) <= SAME_PLACE**2
    parallel = jnp.abs(across[:, None] - across).max(axis=(2, 3)) <= SAME_PLACE
    # Any surface passes through as many points as it has coordinates, so those prove nothing.
    enough = inliers > clusters * real.sum()
    bits = [
        (Status.NOT_CONVERGED, ~converged),
        (Status.NOT_FINITE, ~(jnp.isfinite(centers).all() & jnp.isfinite(across).all())),
        (Status.MERGED, (near & parallel & ~jnp.eye(clusters, dtype=bool)).any()),
        (Status.ALL_NOISE, inliers == 0),
        (Status.TOO_FEW_POINTS, ~enough),
        (Status.DEGENERATE, extents[1] <= 1e3 * eps * extents[-1]),
        (Status.UNDER_DETERMINED, undetermined.any()),
    ]
    return sum((jnp.where(condition, int(bit), 0) for bit, condition in bits), jnp.zeros((), jnp.int32))


def directions(
    theta: Prototypes,
    place: Frame,
    scatter: Float[Array, "C Q Q"],
    real: Bool[Array, " Q"],
    across: Int[Array, ""],
    span: int,
) -> tuple[Float[Array, "C Q"], Float[Array, "C Q q"]]:
    """Unit normals, zero where a variety has several, and an orthonormal basis, both in the input's frame.

    The normal's sign makes its largest component positive; the basis has zero columns beyond a padded variety's own.
    """

    def one(projector: Array, scatter: Array) -> tuple[Array, Array]:
        inside = projector[:, jnp.argmax(lax.stop_gradient(jnp.diagonal(projector)))]
        # A hyperplane's coefficients are pulled back by the transposed map of points.
        normal = normalised(place.forward.T @ inside)
        normal = normal * jnp.where(normal[jnp.argmax(jnp.abs(normal))] < 0, -1, 1)
        single = across == 1
        off = jnp.where(single, jnp.outer(normal, normal), projector)
        along = jnp.diag(real.astype(off.dtype)) - off
        here = place.back @ scatter @ place.back.T
        ranked = along @ here @ along + (1 + jnp.trace(here)) * along
        vectors = jnp.linalg.eigh(lax.stop_gradient(ranked))[1][:, ::-1][:, :span]
        mine = jnp.arange(span) < real.sum() - across
        return jnp.where(single, normal, 0), jnp.where(mine, vectors, 0)

    return jax.vmap(one)(theta["across"], scatter)
