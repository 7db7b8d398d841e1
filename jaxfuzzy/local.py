"""What small windows of points tell before any shape is known: the deviation of the points, and how the object leans.

Round each anchor a small window of points is fitted by a quadratic height over its own tangent plane. Residuals are judged by
an M-scale (Huber, Robust Statistics, 1981), which a third of wrong points does not break, and points are reweighted by it.
Windows that lie across an edge or on an outlier come out too large, so a low quantile of the windows is taken for the deviation.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import View

WIDTH = 0.3
STEPS = 6
# For normal residuals of deviation s the mean of e² / (e² + s²) is 1 - sqrt(π/2) exp(½) erfc(sqrt(½)).
NORMAL_MEAN = 0.34432
QUANTILE = 0.3

# Radians: error of a window's normal; how far an axis leans and a cone opens, the cylinder's reading and the cone's.
LEAN_NOISE, LEAN_LEAST = 0.02, 0.02
LEAN_PRIORS = ((1e-3, 1e-3, 1e-3), (1e-3, 1e-3, 0.5), (0.1, 0.1, 1e-3), (0.1, 0.1, 0.5))
LEAN_PRICES = (0.0, 3.0, 2.0, 5.0)


class Patches(NamedTuple):
    """Small pieces of surface round W anchors.

    Attributes:
        normal: Unit normal (W, 3), of either sign.
        middle: A point on it (W, 3).
        deviation: Of the points in units of 1 / gain: along the viewing ray, without a camera along the normal (W,).
        usable: Whether enough points took part (W,).
    """

    normal: Array
    middle: Array
    deviation: Array
    usable: Array


def patches(view: View, anchor: Array) -> Patches:
    """Robust quadratic fits round anchors (W, 3)."""
    point = view.point[0]
    window = (
        jnp.exp(-sum((a[:, None] - c) ** 2 for a, c in zip(anchor.T, point, strict=True)) / (2 * WIDTH**2)) * view.mask
    )
    total = window.sum(-1) + 1e-9
    mean = (window @ point.T) / total[:, None]
    offset = point - mean[:, :, None]
    scatter = jnp.einsum("win,wjn->wij", offset * window[:, None], offset) / total[:, None, None]
    eye3 = jnp.eye(3, dtype=point.dtype)
    level = jnp.einsum("wii->w", scatter)[:, None, None] * 1e-5 + 1e-9
    inverse = starts.invert(scatter + level * eye3, jnp.broadcast_to(eye3, scatter.shape))

    def power(_: int, normal: Array) -> Array:
        normal = (inverse * normal[:, None, :]).sum(-1)
        return normal * lax.rsqrt((normal**2).sum(-1, keepdims=True) + 1e-30)

    normal = lax.fori_loop(0, 6, power, jnp.broadcast_to(jnp.array([0.57, 0.31, -0.76], point.dtype), mean.shape))
    least = jnp.abs(normal) == jnp.abs(normal).min(-1, keepdims=True)
    first = jnp.cross(normal, least.astype(point.dtype))
    first = first * lax.rsqrt((first**2).sum(-1, keepdims=True) + 1e-30)
    second = jnp.cross(normal, first)
    s, t, h = (jnp.einsum("win,wi->wn", offset, axis) / WIDTH for axis in (first, second, normal))
    terms = jnp.stack([jnp.ones_like(s), s, t, s * s, s * t, t * t, h], 1)
    start = jnp.sqrt((window * h**2).sum(-1) / total) + 1e-6

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        scale, error = state[0], state[2]
        # A noise cluster at 2.5 deviations, m = 2.
        weight = window / (1 + error**2 / (6.25 * scale**2)[:, None]) ** 2
        moment = jnp.einsum("wcn,wdn->wcd", terms * weight[:, None], terms)
        left = moment[:, :6, :6] + 1e-6 * total[:, None, None] * jnp.eye(6, dtype=point.dtype)
        solved = starts.invert(left, moment[:, :6, 6:])[..., 0]
        coefficients = jnp.concatenate([-solved, jnp.ones_like(solved[:, :1])], -1)
        error = jnp.einsum("wcn,wc->wn", terms, coefficients)
        ratio = (window * error**2 / (error**2 + scale[:, None] ** 2 + 1e-20)).sum(-1) / total
        return jnp.maximum(scale * (ratio / NORMAL_MEAN) ** 0.8, 1e-7), coefficients, error

    blank = jnp.zeros((len(anchor), 7), point.dtype)
    scale, coefficients, _ = lax.fori_loop(0, STEPS, step, (start, blank, h))
    slope1, slope2 = coefficients[:, 1], coefficients[:, 2]
    outward = normal + slope1[:, None] * first + slope2[:, None] * second
    outward = outward * lax.rsqrt((outward**2).sum(-1, keepdims=True))
    across = scale * WIDTH * lax.rsqrt(1 + slope1**2 + slope2**2)
    middle = mean - (scale * 0 + coefficients[:, 0] * WIDTH)[:, None] * normal
    if view.eye is not None:
        sight = view.eye[0] - middle
        sight = sight * lax.rsqrt((sight**2).sum(-1, keepdims=True))
        across = across / jnp.maximum(jnp.abs((sight * outward).sum(-1)), 0.2)
    effective = total**2 / ((window**2).sum(-1) + 1e-9)
    gain = (window @ view.gain) / total
    deviation = across * gain * jnp.sqrt(effective / jnp.maximum(effective - 6, 1.0))
    usable = (effective >= 12) & jnp.isfinite(deviation) & jnp.isfinite(outward).all(-1)
    return Patches(outward, middle, deviation, usable)


def typical_deviation(found: Patches) -> Array:
    """The deviation of the points: a low quantile of the windows' own."""
    order = jnp.sort(jnp.where(found.usable, found.deviation, jnp.inf))
    position = jnp.floor(QUANTILE * found.usable.sum()).astype(int)
    return jnp.where(found.usable.any(), order[position], 0.05)


def lean(view: View, found: Patches, sharp: Array) -> Array:
    """How an object leans, from the normals of small windows: the rotation (3, 3) into a frame in which its axis is y.

    The normals of the side of a cylinder or box are square to the axis, n·(t₁, 1, t₂) = 0; those of a cone keep one angle with it,
    n·(t₁, 1, t₂) = c; those of a lid or top are the axis itself. Both readings are solved by
    reweighting, and the cone's is taken only where it fits much better.

    Args:
        view: The points.
        found: Small pieces of its surface.
        sharp: Which of them are smooth enough to be believed (W,); the fewer, the more must a lean explain.
    """
    believed = found.usable & sharp
    doubt = found.usable.sum() / jnp.maximum(believed.sum(), 1)
    toward = found.middle if view.eye is None else view.eye[0] - found.middle
    normal = found.normal
    normal = normal * jnp.where((normal * toward).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    nx, ny, nz = normal.T
    flat = ny > 0.85
    zero, one = jnp.zeros_like(nx), jnp.ones_like(nx)
    # Equations in (t₁, t₂, c): one a window of the side, two a window of a top.
    rows = jnp.concatenate(
        [
            jnp.stack([jnp.where(flat, ny, nx), jnp.where(flat, zero, nz), jnp.where(flat, zero, -one)], -1),
            jnp.stack([zero, jnp.where(flat, ny, zero), zero], -1),
        ]
    )
    right = jnp.concatenate([jnp.where(flat, nx, -ny), jnp.where(flat, nz, zero)])
    used = jnp.concatenate([one, jnp.where(flat, one, zero)]) * jnp.tile(believed, 2)
    prior = LEAN_NOISE**2 / jnp.array(LEAN_PRIORS, nx.dtype) ** 2
    scales = jnp.asarray(np.geomspace(0.3, 2 * LEAN_NOISE, 8), nx.dtype)

    def step(i: int, solved: Array) -> Array:
        error = solved @ rows.T - right
        weight = used / (1 + error**2 / scales[i] ** 2) ** 2
        left = jnp.einsum("rw,wi,wj->rij", weight, rows, rows) + prior[:, :, None] * jnp.eye(3, dtype=nx.dtype)
        return starts.invert(left, jnp.einsum("rw,wi,w->ri", weight, rows, right)[..., None])[..., 0]

    solved = lax.fori_loop(0, len(scales), step, jnp.zeros((4, 3), nx.dtype))
    error = (solved @ rows.T - right) / scales[-1]
    cost = (used * error**2 / (1 + error**2)).sum(-1)
    t = solved[jnp.argmin(cost + doubt * jnp.asarray(LEAN_PRICES, nx.dtype))][:2]
    size = jnp.sqrt((t**2).sum() + 1e-12)
    t = t * jnp.where((size < LEAN_LEAST) | ~jnp.isfinite(size), 0.0, jnp.minimum(jnp.arctan(size), 0.3) / size)
    return starts.rotation(-t[1], t[0])
