"""Refinement of a primitive on orthogonal distances, and the covariance of its parameters.

A surface d away from a point pays δ² d² / (d² + δ²): the objective of one variety beside a noise cluster (eq. 19, m = 2) with the
memberships eliminated. That is the square of r = d / sqrt(1 + d² / δ²), so Levenberg-Marquardt on the residuals r minimises
it as it stands, memberships renewed at every step. With ψ = d / (1 + d² / δ²)² and J = ∂d/∂θ the covariance is the sandwich
H⁻¹ (Σ w ψ² J Jᵀ) H⁻¹, H = Σ w ψ' J Jᵀ (Huber, Robust Statistics, 1981), which need not be told how large the noise is.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, Int, Scalar, as_float, record
from jaxfuzzy.linalg import divide, norm, normalised, tangents
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Quadric, Sphere
from jaxfuzzy.status import Status

MAX_STEPS = 100
# A face nearest to fewer of the points than this says nothing of where it is.
LEAST_SHARE = 0.035


@record
class Refined:
    """A refined primitive.

    Attributes:
        primitive: The primitive.
        covariance: Of `primitive.parameters()`; zero where the points say nothing, as of a box's hidden faces.
        memberships: Membership of each point in the surface.
        status: Reasons to read this with care; see `describe`.
    """

    primitive: Primitive
    covariance: Float[Array, "P P"]
    memberships: Float[Array, " N"]
    status: Int[Array, ""]


def refine(
    primitive: Primitive,
    points: Float[ArrayLike, "N 3"],
    *,
    noise_distance: Scalar | ArrayLike,
    weights: ArrayLike | None = None,
) -> Refined:
    """Moves a primitive to where the points want it, by their orthogonal distances from its endless surface.

    Ends stay where they are along the surface, but for a box, whose seen faces are its surface. Runs under `jit` and `vmap`.

    Args:
        primitive: Where to start, near enough that its inliers lie within the noise distance.
        points: Points in metres, outliers among them.
        noise_distance: Noise distance in metres, one number or one a point; two and a half deviations of the noise lose
            little of good points.
        weights: Weight of each point (N,): weight 2 is the point twice, weight 0 the point absent.

    Returns:
        The primitive and the covariance of its parameters.

    Raises:
        ValueError: an argument out of range, shapes that do not agree, non-finite points.
        TypeError: what is to be refined is no primitive.
    """
    if not isinstance(primitive, Primitive):
        raise TypeError(
            f"primitive must be a Plane, Box, Cylinder, Cone, Sphere or Quadric, got {type(primitive).__name__}"
        )
    array = checks.points(points, dims=3)
    checks.noise_distance(noise_distance, array.shape[0])
    heaviness = checks.weights(weights, array.shape[0])
    start = jax.tree.map(
        lambda leaf: leaf if leaf.dtype == bool else leaf.astype(array.dtype), jax.tree.map(_array, primitive)
    )
    return _refine(
        start,
        array,
        jnp.broadcast_to(jnp.asarray(noise_distance, array.dtype), array.shape[:1]),
        jnp.ones(array.shape[0], array.dtype) if heaviness is None else heaviness.astype(array.dtype),
    )


def _array(leaf: ArrayLike) -> Array:
    array = jnp.asarray(leaf)
    return array if array.dtype == bool else as_float(array)


@jax.jit
def _refine(
    primitive: Primitive, points: Float[Array, "N 3"], noise: Float[Array, " N"], weights: Float[Array, " N"]
) -> Refined:
    used = weights > 0
    total = weights.sum()
    center = weights @ jnp.where(used[:, None], points, 0) / total
    offset = jnp.where(used[:, None], points - center, 0)
    scale = jnp.sqrt(weights @ jnp.sum(offset**2, axis=1) / total)
    scale = jnp.where(scale > 0, scale, 1)
    points = center + offset
    held = _held(primitive, points, noise, weights)

    def distances(theta: Array) -> Array:
        return _signed(_moved(primitive, theta, center, scale), points, held)

    def residuals(theta: Array, _: None) -> Array:
        d = distances(theta) / noise
        return jnp.sqrt(weights / total) * d / jnp.sqrt(1 + d**2)

    tolerance = float(jnp.finfo(points.dtype).eps) ** 0.5
    solver: Any = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    start = jnp.zeros(_freedom(primitive), points.dtype)
    solution: Any = optx.least_squares(residuals, solver, start, max_steps=MAX_STEPS, throw=False)
    theta = solution.value

    far = (distances(theta) / noise) ** 2
    pull = jnp.sqrt(far) * noise / (1 + far) ** 2
    bend = (1 - 3 * far) / (1 + far) ** 3
    slopes = jax.jacfwd(distances)(theta)
    inverse = _pseudo_inverse((slopes.T * (weights * bend)) @ slopes)
    outcome = jax.jacfwd(lambda t: _moved(primitive, t, center, scale).parameters())(theta) @ inverse
    covariance = outcome @ ((slopes.T * (weights * pull**2)) @ slopes) @ outcome.T
    memberships = 1 / (1 + far)
    bits = [
        (Status.NOT_CONVERGED, solution.result != optx.RESULTS.successful),
        (Status.NOT_FINITE, ~(jnp.isfinite(theta).all() & jnp.isfinite(covariance).all())),
        (Status.ALL_NOISE, ~((memberships > 0.5) & used).any()),
        (Status.TOO_FEW_POINTS, ((memberships > 0.5) & used).sum() <= _freedom(primitive)),
    ]
    status = sum((jnp.where(condition, int(bit), 0) for bit, condition in bits), jnp.zeros((), jnp.int32))
    return Refined(_moved(primitive, theta, center, scale), covariance, memberships, status)


def _freedom(primitive: Primitive) -> int:
    """Number of free parameters."""
    return {Plane: 3, Sphere: 4, Cylinder: 5, Cone: 6, Box: 9, Quadric: 9}[type(primitive)]


def _moved(primitive: Primitive, theta: Array, center: Array, scale: Array) -> Primitive:
    """The primitive a little off: angles in radians about the points' center, lengths in units of their spread."""
    match primitive:
        case Plane(point, normal, corners):
            turn = _turn(theta[:2] @ tangents(normal))

            def place(p: Array) -> Array:
                return center + (p - center) @ turn.T + theta[2] * scale * turn @ normal

            return Plane(place(point), turn @ normal, place(corners))
        case Sphere(middle, radius):
            return Sphere(middle + theta[:3] * scale, radius + theta[3] * scale)
        case Cylinder(base, axis, radius, height):
            across = tangents(axis)
            turn = _turn(theta[:2] @ across)
            base = center + turn @ (base - center + theta[2:4] * scale @ across)
            return Cylinder(base, turn @ axis, radius + theta[4] * scale, height)
        case Cone(apex, axis, half_angle, height):
            turn = _turn(theta[:2] @ tangents(axis))
            apex = center + turn @ (apex - center + theta[2:5] * scale)
            # Ends stay where they are in space while the apex slides along the axis.
            slid = theta[2:5] @ axis * scale
            return Cone(apex, turn @ axis, half_angle + theta[5], jnp.maximum(height - slid, 0))
        case Box(middle, size, axes, seen):
            turn = _turn(theta[:3])
            low, high = theta[3:6] * scale - size / 2, theta[6:9] * scale + size / 2
            middle = center + turn @ (middle - center + (low + high) / 2 @ axes)
            return Box(middle, high - low, axes @ turn.T, seen)
        case Quadric(coefficients, bounds):
            unit = normalised(coefficients)
            others = jnp.linalg.svd(lax.stop_gradient(unit)[None])[2][1:]
            return Quadric(unit + theta @ others, bounds)


def _turn(vector: Array) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues), smooth at zero."""
    square = vector @ vector
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return jnp.eye(3, dtype=vector.dtype) + first * cross + second * cross @ cross


def _signed(primitive: Primitive, points: Array, held: Array) -> Float[Array, " N"]:
    """Signed distance from the endless surface; of a box from the nearest of the faces that points hold."""
    match primitive:
        case Plane(point, normal, _):
            return (points - point) @ normal
        case Sphere(middle, radius):
            return norm(points - middle) - radius
        case Cylinder(base, axis, radius, _):
            local = points - base
            return norm(local - (local @ axis)[:, None] * axis) - radius
        case Cone(apex, axis, half_angle, _):
            local = points - apex
            along = local @ axis
            across = norm(local - along[:, None] * axis)
            sine, cosine = jnp.sin(half_angle), jnp.cos(half_angle)
            behind = along * cosine + across * sine < 0
            return jnp.where(behind, norm(local), across * cosine - along * sine)
        case Box():
            beyond, nearest = _faces(primitive, points, held)
            return jnp.take_along_axis(beyond, nearest[:, None], axis=1)[:, 0]
        case Quadric():
            return divide(
                primitive.value(points), norm(jax.vmap(jax.grad(lambda p: primitive.value(p[None])[0]))(points))
            )


def _faces(box: Box, points: Array, held: Array) -> tuple[Float[Array, "N 6"], Int[Array, " N"]]:
    """How far points lie beyond each face (three lower, three upper), and the nearest face by the distance to its patch."""
    local = (points - box.center) @ box.axes.T
    beyond = jnp.concatenate([-local - box.size / 2, local - box.size / 2], axis=1)
    outside = jnp.maximum(jnp.abs(local) - box.size / 2, 0) ** 2
    aside = outside.sum(axis=1, keepdims=True) - outside
    square = beyond**2 + jnp.concatenate([aside, aside], axis=1)
    return beyond, jnp.argmin(jnp.where(held, lax.stop_gradient(square), jnp.inf), axis=1)


def _held(primitive: Primitive, points: Array, noise: Array, weights: Array) -> Array:
    """Which of a box's faces enough points lie on."""
    if not isinstance(primitive, Box):
        return jnp.ones(6, bool)
    beyond, nearest = _faces(primitive, points, jnp.ones(6, bool))
    near = jnp.abs(jnp.take_along_axis(beyond, nearest[:, None], axis=1)[:, 0]) < noise
    counts = jnp.zeros(6, weights.dtype).at[nearest].add(weights * near)
    return counts >= jnp.maximum(LEAST_SHARE * counts.sum(), jnp.finfo(weights.dtype).tiny)


def _pseudo_inverse(matrix: Float[Array, "P P"]) -> Float[Array, "P P"]:
    """Inverse of a symmetric matrix on what it determines; its rows must be alike in size."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = values > 64 * jnp.finfo(matrix.dtype).eps * jnp.abs(values).max()
    return (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1), 0)) @ vectors.T
