"""Small numerics under everything: guarded division and root, moments, eigenvectors with their own derivatives."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from jaxfuzzy.arrays import Array, Float, Int

# Standard deviation of normal errors over the median of their absolute values.
TO_STD = 1.4826


def divide(numerator: Array, denominator: Array, fallback: float = 0.0) -> Array:
    """The quotient, and `fallback` where the denominator is zero; the derivative is zero there, never NaN."""
    zero = denominator == 0
    return jnp.where(zero, fallback, numerator / jnp.where(zero, 1.0, denominator))


def root(value: Array) -> Array:
    """The square root, and 0 where the value is zero or below; the derivative is zero there, never infinite."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def norm(vectors: Array, axis: int = -1) -> Array:
    """Euclidean length along an axis; the derivative at the zero vector is zero."""
    return root(jnp.sum(vectors**2, axis=axis))


def normalised(vectors: Array, axis: int = -1) -> Array:
    """Vectors scaled to length one; the zero vector stays zero."""
    return divide(vectors, jnp.expand_dims(norm(vectors, axis), axis))


@jax.jit
def tangents(axis: Array) -> Array:
    """Two unit vectors (2, 3) that make a right-handed frame with a unit vector (3,); smooth but for a jump at z = 0.

    Source: Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017.
    """
    x, y, z = axis[0], axis[1], axis[2]
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = jnp.stack([1.0 + sign * x**2 * a, sign * b, -sign * x])
    return jnp.stack([first, jnp.stack([b, sign + y**2 * a, -y])])


def weighted_moments(
    values: Float[Array, "N Q"], weights: Float[Array, "C N"]
) -> tuple[Float[Array, "C Q"], Float[Array, "C Q Q"]]:
    """Mean and scatter about it (eqs. 15, 16), both divided by the sum of weights; zero where that is zero."""
    share = divide(weights, weights.sum(axis=1, keepdims=True))
    mean = share @ values
    offset = values - mean[:, None]
    return mean, jnp.einsum("cn,cnq,cnp->cqp", share, offset, offset)


def weighted_range(values: Float[Array, " N"], weights: Float[Array, " N"], tail: float = 0.02) -> Float[Array, "2"]:
    """Where evenly spread values begin and end: two quantiles, stretched by the share that lies beyond them.

    A few values far out move the ends no further than by as many places in the order of the others; values of weight 0, wherever
    they are, do not move them at all.
    """
    # Those come last, at the place of the last that has weight: the ends of few values must not lead towards them.
    order = jnp.argsort(jnp.where(weights > 0, values, jnp.inf))
    last = jnp.max(jnp.where(weights > 0, values, -jnp.inf))
    values = jnp.where((weights > 0) | (last == -jnp.inf), values, last)
    heap = jnp.cumsum(weights[order]) - weights[order] / 2
    heap = divide(heap, weights.sum(), 0.5)
    low, high = jnp.interp(jnp.array([tail, 1 - tail], values.dtype), heap, values[order])
    beyond = (high - low) * tail / (1 - 2 * tail)
    return jnp.stack([low - beyond, high + beyond])


@jax.custom_jvp
def smallest_projector(matrix: Float[Array, "Q Q"], count: Int[Array, ""]) -> Float[Array, "Q Q"]:
    """Projector onto the eigenvectors of the `count` smallest eigenvalues of a symmetric matrix.

    Its derivative divides only by gaps between those eigenvalues and the others, so eigenvalues may repeat on either side.
    A gap that vanishes leaves the projector undetermined; it then gives no derivative instead of an infinite one.
    """
    return _projector(jnp.linalg.eigh(matrix)[1], count)


@smallest_projector.defjvp
def _smallest_projector_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Any]) -> tuple[Array, Array]:
    matrix, count = primals
    values, vectors = jnp.linalg.eigh(matrix)
    taken = jnp.arange(values.size) < count
    across = (taken[:, None] & ~taken[None]) | (~taken[:, None] & taken[None])
    turn = jnp.where(across, _inverse_gaps(values[:, None], values[None], values), 0.0)
    turn = turn * jnp.where(taken[:, None], 1.0, -1.0)
    inside = vectors.T @ _symmetric(tangents[0]) @ vectors
    return _projector(vectors, count), vectors @ (turn * inside) @ vectors.T


def _projector(vectors: Array, count: Array) -> Array:
    taken = jnp.where(jnp.arange(vectors.shape[1]) < count, vectors, 0.0)
    return taken @ taken.T


@jax.custom_jvp
def smallest_eigenvector(matrix: Float[Array, "Q Q"], metric: Float[Array, "Q Q"]) -> Float[Array, " Q"]:
    """The vector n that solves A n = λ B n for the smallest λ, scaled to nᵀ B n = 1, of either sign.

    A is symmetric, B also positive semi-definite; rounding is added to B's diagonal, so that B may be singular. The
    derivative divides only by gaps between the smallest eigenvalue and the others, and leaves out gaps that vanish.
    """
    return pencil(matrix, metric)[1][:, 0]


@smallest_eigenvector.defjvp
def _smallest_eigenvector_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    values, vectors = pencil(*primals)
    least = vectors[:, 0]
    change, stretch = _symmetric(tangents[0]) @ least, _symmetric(tangents[1]) @ least
    pull = vectors.T @ (change - values[0] * stretch)
    others = jnp.arange(values.size) > 0
    toward = jnp.where(others, _inverse_gaps(values[0], values, values) * pull, -0.5 * (least @ stretch))
    return least, vectors @ toward


def pencil(matrix: Float[Array, "Q Q"], metric: Float[Array, "Q Q"]) -> tuple[Float[Array, " Q"], Float[Array, "Q Q"]]:
    """Eigenvalues, smallest first, and eigenvectors (columns) of A n = λ B n, with nᵀ B n = 1."""
    size = metric.shape[0]
    floor = 8 * jnp.finfo(metric.dtype).eps * jnp.trace(metric) + jnp.finfo(metric.dtype).tiny
    lower = jnp.linalg.cholesky(metric + floor * jnp.eye(size, dtype=metric.dtype))
    half = solve_triangular(lower, matrix, lower=True)
    values, turned = jnp.linalg.eigh(_symmetric(solve_triangular(lower, half.T, lower=True)))
    return values, solve_triangular(lower, turned, lower=True, trans="T")


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


def _inverse_gaps(here: Array, there: Array, values: Array) -> Array:
    """1 / (here − there), and 0 where the two eigenvalues are the same to rounding."""
    gap = here - there
    same = jnp.abs(gap) <= 8 * jnp.finfo(values.dtype).eps * jnp.abs(values).max()
    return jnp.where(same, 0.0, 1.0 / jnp.where(same, 1.0, gap))


def orthogonal(rows: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The orthogonal matrix nearest to three nearly orthogonal rows, by Newton's iteration (Higham, SISC 7(4), 1986).

    It is differentiable where a singular value decomposition is not: at rows that are orthogonal already.
    """
    for _ in range(8):
        rows = (rows + jnp.linalg.inv(rows).T) / 2
    return rows
