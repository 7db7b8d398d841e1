"""Small numerics under everything: guarded division and root, moments, eigenvectors with their own derivatives."""

import jax.numpy as jnp

from jaxfuzzy.arrays import Array


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
