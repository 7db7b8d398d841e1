"""From hyperplanes in an embedding to the primitive they stand for: its numbers in metres.

A kind ties coefficients of A x² + B y² + C z² + D x + E y + F z + G = 0 together: A = B = C for a sphere, A = C and B = E = 0
for an upright cylinder, A = C for an upright cone. Where the embedding leaves them free, the hyperplane of that kind which
fits the variety's own points best, under its own memberships and distance, takes the place of the free one; where they are
tied already this is the variety itself. Completing squares then gives center, radius and half-angle.

Whether a kind holds is judged in metres: by how far its ties move the surface, root mean square over the inliers.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, is_concrete
from jaxfuzzy.embedding import LEFT, RIGHT, monomials_of_affine, table, unmixed
from jaxfuzzy.linalg import divide, normalised, orthogonal, root, smallest_eigenvector, tangents, weighted_range
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Quadric, Sphere
from jaxfuzzy.varieties import Varieties

# Which kinds a hyperplane of each embedding can be; simpler kinds first.
CAN_BE = {
    "3d": ("plane", "box"),
    "linear": ("plane", "box"),
    "4d": ("cylinder",),
    "cylinder": ("cylinder",),
    "sphere": ("plane", "sphere"),
    "cone": ("plane", "cylinder", "sphere", "cone"),
    "6d": ("plane", "cylinder", "sphere", "cone"),
    "9d": ("plane", "cylinder", "sphere", "cone"),
}
# From the completed squares a cone's tip is some steps away; four halve to rounding, more are for rough starts.
NEWTON_STEPS = 12
KINDS = ("plane", "box", "cylinder", "sphere", "cone", "quadric")


def recover(
    varieties: Varieties,
    kind: str,
    *,
    variety: int | None = None,
    points: ArrayLike | None = None,
    weights: ArrayLike | None = None,
) -> Primitive:
    """The primitive that a variety stands for.

    Runs under `jit`, `vmap` and `grad`; derivatives reach back through `nfcv`. The axis of a cylinder or cone is y but for the
    embedding "9d", where it is free. Heights, corners and edges are where the inliers end along them; without the points
    they are read from the inliers' bounds, which do as well for upright bodies and are some 10 % off for slanting edges.

    Args:
        varieties: What `nfcv` gave in one embedding (`pick` one of several).
        kind: "plane", "cylinder", "cone", "sphere"; "box" from two or three planes, its faces; or "quadric".
        variety: Which of C varieties; the one of largest weighted membership where not given. A box takes all of them.
        points: The points (N, 3) of the fit.
        weights: Their weights (N,) in the fit, where they had any.

    Returns:
        The primitive; a `Quadric` where the kind does not hold (see `holds`). While JAX traces, values cannot choose a type and
        the kind asked for is given back in any case.

    Raises:
        ValueError: an unknown kind, one that no hyperplane of this embedding is, or points that are not those of the fit.
    """
    _check(varieties, kind)
    inliers = None if points is None else checks.points(points, dims=3)
    if inliers is not None and inliers.shape[0] != varieties.noise.shape[0]:
        raise ValueError(f"points must be the {varieties.noise.shape[0]} points of the fit, got {inliers.shape[0]}")
    if weights is not None and inliers is None:
        raise ValueError("weights must come with points, whose weights they are")
    heaviness = None if inliers is None else checks.weights(weights, inliers.shape[0])
    if kind == "quadric":
        return _quadric(varieties, _index(varieties, variety))
    primitive, right = _found(varieties, _index(varieties, variety), inliers, heaviness, kind=kind)
    if is_concrete(right) and not bool(right):
        return _quadric(varieties, _index(varieties, variety))
    return primitive


def holds(varieties: Varieties, kind: str, *, variety: int | None = None) -> Bool[Array, ""]:
    """Whether a variety is of a kind: imposing it moves the surface by no more than the inliers scatter about it.

    A curved kind must also be told from a plane, which fits worse by five standard errors at least, or its radius means nothing.

    Args:
        varieties: What `nfcv` gave in one embedding.
        kind: As for `recover`.
        variety: As for `recover`.

    Raises:
        ValueError: as `recover`.
    """
    _check(varieties, kind)
    if kind == "quadric":
        return jnp.asarray(True)
    return _found(varieties, _index(varieties, variety), None, None, kind=kind)[1]


def _check(varieties: Varieties, kind: str) -> None:
    checks.kind(varieties, "varieties", Varieties)
    if not isinstance(varieties.embedding, str):
        raise ValueError(
            f"varieties must be of one embedding, got {len(varieties.embedding)}: use varieties.pick(name)"
        )
    checks.choice(kind, "kind", KINDS)
    name, count = varieties.embedding, varieties.centers.shape[-2]
    if varieties.origin.shape[-1] != 3:
        raise ValueError(f"varieties must be of 3D points, got points of {varieties.origin.shape[-1]} coordinates")
    if kind != "quadric" and kind not in CAN_BE[name]:
        allowed = ", ".join(map(repr, (*CAN_BE[name], "quadric")))
        raise ValueError(f"kind must be one of {allowed} in the embedding {name!r}, got {kind!r}")
    if kind == "box" and count not in (2, 3):
        raise ValueError(f"kind 'box' must have two or three varieties, one a face, got {count}")
    if varieties.basis.shape[-1] != varieties.centers.shape[-1] - 1:
        raise ValueError(f"varieties must be hyperplanes, got dimension {varieties.basis.shape[-1]}")


@partial(jax.jit, static_argnames="kind")
def _found(
    varieties: Varieties, at: Array, points: Array | None, weights: Array | None, *, kind: str
) -> tuple[Primitive, Bool[Array, ""]]:
    """The primitive of a kind and whether the kind holds."""
    ends = _Ends(varieties, at, points, weights)
    if kind == "box":
        primitive, shift, scatter, sound = _box(varieties, ends)
    else:
        primitive, shift, scatter, sound = _shaped(varieties, kind, at, ends)
    rounding = 8 * jnp.sqrt(jnp.finfo(scatter.dtype).eps) * varieties.unit
    return primitive, sound & (shift <= jnp.maximum(scatter, rounding))


def _index(varieties: Varieties, variety: int | None) -> Array:
    if variety is None:
        return jnp.argmax(varieties.masses)
    return jnp.asarray(checks.integer(variety, "variety", at_least=0, at_most=varieties.centers.shape[0] - 1))


class _Tied(NamedTuple):
    """A hyperplane of a kind, in the local frame.

    Attributes:
        parts: Coefficients of the kind's own coordinates.
        constant: The constant term.
        square: Mean squared distance of the inliers from it, in metres squared.
    """

    parts: Float[Array, " K"]
    constant: Float[Array, ""]
    square: Float[Array, ""]


def _tied(varieties: Varieties, at: Array, ties: Float[Array, "K Q"]) -> _Tied:
    """The best hyperplane whose normal is a mix of the ties' rows, under the variety's own distance."""
    scatter, slopes, metric = varieties.scatter[at], varieties.slopes[at], _metric(varieties, at)
    parts = smallest_eigenvector(ties @ scatter @ ties.T, ties @ metric @ ties.T)
    normal = parts @ ties
    square = jnp.maximum(divide(normal @ scatter @ normal, normal @ slopes @ normal), 0) * varieties.unit**2
    return _Tied(parts, -normal @ varieties.local_centers[at], square)


def _metric(varieties: Varieties, at: Array) -> Float[Array, "Q Q"]:
    """What the variety's distance divides a squared polynomial by, as a form in the local coefficients."""
    if varieties.distance == "geometric":
        return varieties.slopes[at]
    dtype = varieties.centers.dtype
    mixing = jnp.asarray(table(_name(varieties)), dtype)
    change, _ = monomials_of_affine(1 / varieties.unit, -varieties.origin / varieties.unit)
    forward = mixing @ change @ unmixed(mixing).T
    return forward @ forward.T


def _name(varieties: Varieties) -> str:
    assert isinstance(varieties.embedding, str)
    return varieties.embedding


def _quadratic(matrix: Float[Array, "3 3"]) -> Float[Array, " 9"]:
    """Monomial coefficients of pᵀ matrix p, the matrix symmetric."""
    twice = jnp.where(LEFT == RIGHT, 1, 2)
    return jnp.concatenate([twice * matrix[LEFT, RIGHT], jnp.zeros(3, matrix.dtype)])


def _linear(vectors: Float[Array, "K 3"]) -> Float[Array, "K 9"]:
    return jnp.concatenate([jnp.zeros((vectors.shape[0], 6), vectors.dtype), vectors], axis=1)


def _axis(varieties: Varieties, at: Array, free: Float[Array, " Q"]) -> Float[Array, "3"]:
    """The body's axis: y, or with free mixed terms the direction in which the quadratic form differs from its two others."""
    dtype = varieties.centers.dtype
    if _name(varieties) != "9d":
        return jnp.array([0.0, 1.0, 0.0], dtype)
    half = jnp.where(LEFT == RIGHT, 1, 0.5) * free[:6]
    form = jnp.zeros((3, 3), dtype).at[LEFT, RIGHT].set(half).at[RIGHT, LEFT].set(half)
    middle = jnp.linalg.eigvalsh(lax.stop_gradient(form))[1]
    axis = normalised(smallest_eigenvector(form * jnp.where(middle < 0, -1, 1), jnp.eye(3, dtype=dtype)))
    return axis * jnp.where(axis[jnp.argmax(jnp.abs(axis))] < 0, -1, 1)


def _shaped(varieties: Varieties, kind: str, at: Array, ends: "_Ends") -> tuple[Primitive, Array, Array, Array]:
    """The primitive, how far its ties move the surface, how far inliers scatter about it, and whether its numbers are real."""
    dtype = varieties.centers.dtype
    mixing = jnp.asarray(table(_name(varieties)), dtype)
    everything = jnp.eye(mixing.shape[0], dtype=dtype)
    free = _tied(varieties, at, everything)
    axis = _axis(varieties, at, free.parts)
    unit, origin = varieties.unit, varieties.origin
    round_axis = _quadratic(jnp.eye(3, dtype=dtype) - jnp.outer(axis, axis))[None]
    along_axis = _quadratic(jnp.outer(axis, axis))[None]
    directions = jnp.eye(3, dtype=dtype)
    if kind == "cylinder":
        directions = tangents(axis)
    ties = {
        "plane": (),
        "cylinder": (round_axis,),
        "sphere": (round_axis + along_axis,),
        "cone": (round_axis, along_axis),
    }[kind]
    own = jnp.concatenate([*ties, _linear(directions)]) @ unmixed(mixing).T
    tied = _tied(varieties, at, own)
    linear = tied.parts[len(ties) :] @ directions
    shift_square = jnp.maximum(tied.square - free.square, 0)
    primitive: Primitive
    if kind == "plane":
        normal = normalised(linear)
        on = origin - normal * (divide(tied.constant, jnp.sqrt(jnp.sum(linear**2))) * unit)
        primitive = _patch(on, normal, ends)
        return primitive, root(shift_square), root(free.square), jnp.asarray(True)

    # A surface of huge radius is a plane: only a plane that fits worse by five standard errors is told from it.
    flat = _tied(varieties, at, _linear(directions) @ unmixed(mixing).T)
    chance = 25 * divide(free.square, varieties.masses[at])
    curved = flat.square - free.square > jnp.maximum(chance, 64 * jnp.finfo(dtype).eps * unit**2)
    curvature = tied.parts[0]
    center = -divide(linear, 2 * curvature)
    level = jnp.sum(center**2) - divide(tied.constant, curvature)
    if kind == "sphere":
        sound = curved & (level > 0)
        primitive = Sphere(origin + unit * center, unit * root(level))
    elif kind == "cylinder":
        sound = curved & (level > 0)
        radius = unit * root(level)
        low, high = ends.along(axis, 2 * radius * root(1 - axis**2))
        across = origin + unit * center
        primitive = Cylinder(across + (low - across @ axis) * axis, axis, radius, high - low)
    else:
        taper = -divide(tied.parts[1], curvature)
        sound = curved & (taper > 0)
        height = -divide(linear @ axis, 2 * tied.parts[1])
        rough = jnp.append(center + (height - center @ axis) * axis, jnp.log(jnp.maximum(taper, 1e-6)))
        pointed, square = _pointed(varieties, at, own, axis, rough)
        shift_square = jnp.maximum(square - free.square, 0)
        apex = origin + unit * pointed[:3]
        from_apex = ends.along(axis, jnp.zeros(3, dtype)) - apex @ axis
        side = jnp.where(from_apex.sum() < 0, -1, 1)
        primitive = Cone(
            apex, side * axis, jnp.arctan(jnp.exp(pointed[3] / 2)), jnp.maximum(jnp.sort(side * from_apex), 0)
        )
    return primitive, root(shift_square), root(free.square), sound


def _pointed(
    varieties: Varieties, at: Array, ties: Float[Array, "5 Q"], axis: Array, rough: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Array]:
    """The best cone with a true tip: apex and log tan² of its half-angle, local, and its mean squared distance in metres.

    A quadric of revolution is a cone only where its waist vanishes, which no tie of coefficients can say. So the mean squared
    distance is minimised over cones by damped Newton steps. The last step starts from a value without derivative, which gives
    it the derivative of the minimum itself.
    """
    center = ties @ varieties.local_centers[at]
    moments = ties @ varieties.scatter[at] @ ties.T + jnp.outer(center, center)
    slopes = ties @ varieties.slopes[at] @ ties.T
    metric = ties @ _metric(varieties, at) @ ties.T

    def coefficients(cone: Array) -> tuple[Array, Array]:
        apex, taper = cone[:3], jnp.exp(cone[3])
        along = apex @ axis
        linear = -2 * (apex - along * axis) + 2 * taper * along * axis
        return jnp.concatenate([jnp.stack([jnp.ones_like(taper), -taper]), linear]), apex @ apex - (
            1 + taper
        ) * along**2

    def mean_square(cone: Array, metric: Array) -> Array:
        parts, constant = coefficients(cone)
        value = parts @ moments @ parts + 2 * constant * (parts @ center) + constant**2
        return value / (parts @ metric @ parts)

    def newton(cone: Array) -> Array:
        slope, bend = jax.grad(mean_square)(cone, metric), lax.stop_gradient(jax.hessian(mean_square)(cone, metric))
        values, vectors = jnp.linalg.eigh(bend)
        floor = jnp.finfo(cone.dtype).eps * jnp.abs(values).max() + jnp.finfo(cone.dtype).tiny
        step = vectors @ ((vectors.T @ slope) / jnp.maximum(jnp.abs(values), floor))
        return cone - step * jnp.minimum(1, 0.5 / jnp.sqrt(jnp.sum(step**2) + floor))

    cone = lax.stop_gradient(lax.fori_loop(0, NEWTON_STEPS, lambda _, c: newton(c), lax.stop_gradient(rough)))
    cone = newton(cone)
    return cone, jnp.maximum(mean_square(cone, slopes), 0) * varieties.unit**2


class _Ends(NamedTuple):
    """Where the inliers of a variety end: read from the points, or from their bounds alone."""

    varieties: Varieties
    at: Array
    points: Array | None
    weights: Array | None

    def _measured(self, directions: Float[Array, "K 3"]) -> Float[Array, "K 2"]:
        v = self.varieties
        assert self.points is not None
        all_of = v.memberships[:, self.at] * (1 if self.weights is None else self.weights)
        own = all_of * (v.labels == self.at)
        own = jnp.where(own.sum() > 0, own, all_of)
        return jax.vmap(weighted_range, (1, None))(self.points @ directions.T, own)

    def along(self, axis: Float[Array, "3"], across: Float[Array, "3"]) -> Float[Array, "2"]:
        """First and last coordinate along an axis of a body that takes up `across` of the bounds' size by its width."""
        if self.points is not None:
            return self._measured(axis[None])[0]
        low, high = self.varieties.bounds[self.at]
        length = jnp.maximum(jnp.sum(jnp.abs(axis) * (high - low - across)), 0) / jnp.sum(axis**2)
        return axis @ (low + high) / 2 + jnp.array([-0.5, 0.5], axis.dtype) * length

    def of_rectangle(self, edges: Float[Array, "2 3"]) -> Float[Array, "2 2"]:
        """First and last coordinates along the two edges of a rectangle, by least squares where bounds are all there is."""
        if self.points is not None:
            return self._measured(edges)
        low, high = self.varieties.bounds[self.at]
        reach = jnp.abs(edges)
        gram, wanted = reach @ reach.T, reach @ (high - low)
        determinant = gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2
        solved = jnp.stack(
            [gram[1, 1] * wanted[0] - gram[0, 1] * wanted[1], gram[0, 0] * wanted[1] - gram[0, 1] * wanted[0]]
        )
        # Edges that fill the bounds alike cannot be told apart: a square.
        alike = determinant <= 1e-3 * gram[0, 0] * gram[1, 1]
        length = jnp.where(alike, wanted.sum() / gram.sum(), solved / jnp.where(alike, 1, determinant))
        middle = edges @ (low + high) / 2
        return middle[:, None] + jnp.maximum(length, 0)[:, None] * jnp.array([-0.5, 0.5], edges.dtype)


def _patch(on: Array, normal: Array, ends: _Ends) -> Plane:
    """The patch of a plane that the inliers fill, two edges level; its normal looks at the origin."""
    normal = normal * jnp.where(normal @ on > 0, -1, 1)
    vertical = jnp.where(jnp.abs(normal[1]) > 0.9, jnp.array([0.0, 0, 1]), jnp.array([0.0, 1, 0])).astype(normal.dtype)
    level = normalised(jnp.cross(normal, vertical))
    edges = jnp.stack([level, jnp.cross(normal, level)])
    (left, right), (bottom, top) = ends.of_rectangle(edges)
    places = jnp.stack([jnp.stack(p) for p in ((left, bottom), (right, bottom), (right, top), (left, top))])
    corners = places @ edges + (normal @ on) * normal
    return Plane(corners.mean(axis=0), normal, corners)


def _box(varieties: Varieties, ends_of: _Ends) -> tuple[Primitive, Array, Array, Array]:
    """The box of two or three faces, how far squaring its corners moves them, how far inliers scatter about them."""
    faces, centers = varieties.normals, varieties.centers
    third = normalised(jnp.cross(faces[0], faces[1]))
    axes = orthogonal(faces if faces.shape[0] == 3 else jnp.concatenate([faces, third[None]]))
    known = faces.shape[0]
    ends = []
    for i in range(3):
        others = [c for c in range(known) if c != i]
        starts, stops = [], []
        for c in others:
            of_face = ends_of._replace(at=jnp.asarray(c))
            start, stop = of_face.of_rectangle(axes[jnp.array([i, 3 - i - c])])[0]
            starts.append(start)
            stops.append(stop)
        low, high = jnp.stack(starts).min(), jnp.stack(stops).max()
        if i < known:  # the face itself is one end; the body lies on the side of the other faces' points
            face = axes[i] @ centers[i]
            beyond = jnp.stack([axes[i] @ centers[c] for c in others]).mean() > face
            low, high = jnp.where(beyond, face, low), jnp.where(beyond, high, face)
        ends.append(jnp.stack([low, high]))
    bounds = jnp.stack(ends)
    size = jnp.maximum(bounds[:, 1] - bounds[:, 0], 0)
    box = Box(bounds.mean(axis=1) @ axes, size, axes, jnp.ones(3, bool))
    tilt = jnp.sqrt(jnp.sum((faces - axes[:known]) ** 2, axis=1))
    # A face of edge L turned by t moves by t L / sqrt(12), root mean square.
    shift = jnp.max(tilt) * jnp.max(size) / jnp.sqrt(12.0)
    scatter = jnp.einsum("cq,cqp,cp->c", faces, varieties.scatter, faces)
    return box, shift, jnp.sqrt(scatter.max()) * varieties.unit, jnp.all(size > 0)


@jax.jit
def _quadric(varieties: Varieties, at: Array) -> Quadric:
    """The variety as it is."""
    normal, center = varieties.normals[at], varieties.centers[at]
    mixing = jnp.asarray(table(_name(varieties)), normal.dtype)
    return Quadric(jnp.append(normal @ mixing, -normal @ center), varieties.bounds[at])
