"""How far a gradient can be trusted: how near a fixed point is to being one of many."""

import jax
import jax.numpy as jnp

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float
from jaxfuzzy.embedding import padded_tables
from jaxfuzzy.fcm import Partition, jacobian
from jaxfuzzy.varieties import Varieties
from jaxfuzzy.varietystep import jacobian as variety_jacobian
from jaxfuzzy.varietystep import moments, pose, prototypes


def conditioning(
    fit: Partition | Varieties, points: ArrayLike, *, weights: ArrayLike | None = None
) -> Float[Array, "*E"]:
    """Smallest singular value of I - J, J the derivative of one step with respect to the prototypes.

    The implicit derivative of a fit is (I - J)⁻¹ times that of one step. Where this value is near 0 (centers about to merge, a
    surface that the points do not determine) the derivative is large and unsure; at 0 it is the minimum-norm one. Values
    near 1 mean that one step forgets where it came from.

    Args:
        fit: What `fcm` or `nfcv` gave.
        points: The points of the fit.
        weights: The weights of the fit.

    Returns:
        One number; one an embedding where several were fitted.

    Raises:
        ValueError: Points or weights that are not those of the fit.
    """
    array = checks.points(points)
    heaviness = checks.weights(weights, array.shape[0])
    if not isinstance(fit, Partition | Varieties):
        raise TypeError(f"fit must be a Partition or Varieties, got {type(fit).__name__}")
    if isinstance(fit, Partition):
        if fit.labels.shape[0] not in (0, array.shape[0]):
            raise ValueError(f"points must be the {fit.labels.shape[0]} points of the fit, got {array.shape[0]}")
        if array.shape[1] != fit.centers.shape[1]:
            raise ValueError(f"points must have {fit.centers.shape[1]} coordinates as in the fit, got {array.shape[1]}")
        return _smallest(jacobian(array, fit, heaviness))
    if fit.memberships.shape[-2] != array.shape[0]:
        raise ValueError(f"points must be the {fit.memberships.shape[-2]} points of the fit, got {array.shape[0]}")
    names = (fit.embedding,) if isinstance(fit.embedding, str) else fit.embedding
    tables, real = padded_tables(names, array.shape[1])
    span = fit.basis.shape[-1]
    ones = jnp.ones(array.shape[0], array.dtype) if heaviness is None else heaviness
    found = []
    for e in range(len(names)):
        one = fit if isinstance(fit.embedding, str) else jax.tree.map(lambda leaf, e=e: leaf[e], fit)
        across = max(1, int(real[e].sum()) - span)
        task, _ = pose(
            jnp.asarray(tables[e], array.dtype),
            jnp.asarray(real[e]),
            jnp.asarray(across),
            array,
            jnp.asarray(one.m),
            jnp.asarray(one.noise_distance),
            ones,
            geometric=fit.distance == "geometric" and across == 1,
        )
        theta = prototypes(moments(ones * one.memberships.T**task.m, task), task.across)
        found.append(_smallest(variety_jacobian(theta, task)))
    return found[0] if isinstance(fit.embedding, str) else jnp.stack(found)


def _smallest(derivative: Float[Array, "p p"]) -> Float[Array, ""]:
    return jnp.linalg.svd(jnp.eye(derivative.shape[0], dtype=derivative.dtype) - derivative, compute_uv=False)[-1]
