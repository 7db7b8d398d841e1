"""Deviation of the points where nobody gave it: from robust local fits, before any shape is known.

Round each anchor a small window of points is fitted by a quadratic height over its own tangent plane. Residuals are judged by
an M-scale (Huber, Robust Statistics, 1981), which a third of wrong points does not break, and points are reweighted by it. Windows
that lie across an edge or on an outlier come out too large, so a low quantile of the windows is taken.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import View

WINDOWS = 24
WIDTH = 0.2
STEPS = 8
# For normal residuals of deviation s the mean of e² / (e² + s²) is 1 - sqrt(π/2) exp(½) erfc(sqrt(½)).
NORMAL_MEAN = 0.34432
QUANTILE = 0.3


def local_deviation(view: View) -> Array:
    """Deviation of the points in units of 1 / gain: along the viewing ray, or without a camera along the surface's normal."""
    point = jnp.stack([c[0] for c in view.point], -1)
    anchor = point[:WINDOWS]
    window = jnp.exp(-((anchor[:, None] - point) ** 2).sum(-1) / (2 * WIDTH**2)) * view.mask
    total = window.sum(-1) + 1e-9
    mean = (window @ point) / total[:, None]
    offset = point - mean[:, None]
    scatter = jnp.einsum("wn,wni,wnj->wij", window, offset, offset) / total[:, None, None]
    eye3 = jnp.eye(3, dtype=point.dtype)
    level = jnp.einsum("wii->w", scatter)[:, None, None] * 1e-5 + 1e-9
    inverse = starts.invert(scatter + level * eye3, jnp.broadcast_to(eye3, scatter.shape))
    normal = jnp.broadcast_to(jnp.array([0.57, 0.31, -0.76], point.dtype), mean.shape)
    for _ in range(6):
        normal = (inverse * normal[:, None, :]).sum(-1)
        normal = normal * lax.rsqrt((normal**2).sum(-1, keepdims=True) + 1e-30)
    least = jnp.abs(normal) == jnp.abs(normal).min(-1, keepdims=True)
    first = jnp.cross(normal, least.astype(point.dtype))
    first = first * lax.rsqrt((first**2).sum(-1, keepdims=True) + 1e-30)
    second = jnp.cross(normal, first)
    s, t, h = (jnp.einsum("wni,wi->wn", offset, axis) / WIDTH for axis in (first, second, normal))
    terms = jnp.stack([jnp.ones_like(s), s, t, s * s, s * t, t * t, h], 1)
    start = jnp.sqrt((window * h**2).sum(-1) / total) + 1e-6

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        scale, coefficients = state
        error = jnp.einsum("wcn,wc->wn", terms, coefficients)
        # A noise cluster at 2.5 deviations, m = 2.
        weight = window / (1 + error**2 / (6.25 * scale**2)[:, None]) ** 2
        moment = jnp.einsum("wcn,wdn->wcd", terms * weight[:, None], terms)
        left = moment[:, :6, :6] + 1e-6 * total[:, None, None] * jnp.eye(6, dtype=point.dtype)
        solved = starts.invert(left, moment[:, :6, 6:])[..., 0]
        coefficients = jnp.concatenate([-solved, jnp.ones_like(solved[:, :1])], -1)
        error = jnp.einsum("wcn,wc->wn", terms, coefficients)
        ratio = (window * error**2 / (error**2 + scale[:, None] ** 2 + 1e-20)).sum(-1) / total
        return jnp.maximum(scale * (ratio / NORMAL_MEAN) ** 0.8, 1e-7), coefficients

    zero = jnp.concatenate([jnp.zeros((WINDOWS, 6), point.dtype), jnp.ones((WINDOWS, 1), point.dtype)], -1)
    scale, coefficients = lax.fori_loop(0, STEPS, step, (start, zero))
    slope1, slope2 = coefficients[:, 1], coefficients[:, 2]
    outward = normal + slope1[:, None] * first + slope2[:, None] * second
    outward = outward * lax.rsqrt((outward**2).sum(-1, keepdims=True))
    across = scale * WIDTH * lax.rsqrt(1 + slope1**2 + slope2**2)
    if view.ray is not None:
        ray = jnp.stack([c[0, :WINDOWS] for c in view.ray], -1)
        across = across / jnp.maximum(jnp.abs((ray * outward).sum(-1)), 0.2)
    effective = total**2 / ((window**2).sum(-1) + 1e-9)
    across = across * view.gain[:WINDOWS] * jnp.sqrt(effective / jnp.maximum(effective - 6, 1.0))
    usable = (effective >= 15) & (view.mask[:WINDOWS] > 0)
    order = jnp.sort(jnp.where(usable, across, jnp.inf))
    position = jnp.maximum(jnp.floor(QUANTILE * usable.sum()).astype(int), 0)
    return jnp.where(usable.any(), order[position], 0.05)
