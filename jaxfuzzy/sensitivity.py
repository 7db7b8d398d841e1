"""What a result hangs on: its derivatives by every single point, by the fuzzifier and by the noise distance."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, as_float, record
from jaxfuzzy.tuning import Hyper


@record
class Influence:
    """How a number taken from a fit changes with everything that went into it.

    Attributes:
        value: The number.
        points: Its derivative by every coordinate of every point.
        hyper: Its derivatives by fuzzifier, noise distance and the weight of each point. Minus the last is, to first order, what
            leaving the point out would change.
    """

    value: Float[Array, ""]
    points: Float[Array, "N D"]
    hyper: Hyper


def influence(measure: Callable[[Array, Hyper], Any], points: ArrayLike, hyper: Hyper) -> Influence:
    """Derivatives of a number that a fit gives: which points decide it, and how it depends on m and the noise distance.

    For a radius, say, `measure` is `lambda points, hyper: jf.recover(jf.nfcv(points, start, embedding="cylinder", m=hyper.m,
    noise_distance=hyper.noise_distance, weights=hyper.weights), "cylinder").radius`.

    Args:
        measure: From points and `Hyper` to one number; compiled once a function.
        points: Points (N, D).
        hyper: Where to differentiate; weights are 1 where not given.

    Raises:
        ValueError: Non-finite points, weights of another length, a measure that is not one number.
    """
    array = checks.points(points)
    weights = checks.weights(hyper.weights, array.shape[0])
    weights = jnp.ones(array.shape[0], array.dtype) if weights is None else weights
    given = jax.tree.map(as_float, dataclasses.replace(hyper, weights=weights))
    value, (by_point, by_hyper) = _derived(measure, array, given)
    return Influence(value, by_point, by_hyper)


@eqx.filter_jit
def _derived(measure: Callable[[Array, Hyper], Any], points: Array, hyper: Hyper) -> Any:
    def number(points: Array, hyper: Hyper) -> Array:
        value = jnp.asarray(measure(points, hyper))
        if value.shape != ():
            raise ValueError(f"measure must give one number, got shape {value.shape}")
        return value

    return jax.value_and_grad(number, argnums=(0, 1))(points, hyper)
