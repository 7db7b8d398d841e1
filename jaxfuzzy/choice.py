"""Choice among candidate surfaces: likelihood of surface noise against background, price per parameter, guards.

A candidate explains a point either by its noise (normal, with a scale of its own) or by a background that is uniform along the
viewing ray. Share and scale follow from a few EM steps. The score is minus the likelihood plus half the logarithm of the number
of points a parameter (Schwarz), in nats: lower is better.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import View, columns

EM_STEPS = 4
HALF_LOG_2PI = 0.9189385332046727
# In nats: a plane is taken unless something else is better by more than chance and small errors of the model make it.
PLANE_BONUS = 20.0
# Radius in units of an object's spread from which on its surface is flat over the object: an arc of about 45 degrees.
FLATTEST = 3.0
# The same of a ball, of which a cap of 75 degrees is to be seen: two flat things at an angle are held by a smaller one.
FLATTEST_BALL = 2.2
# Of the inliers of a box, so many must lie on each of its faces.
LEAST_FACE = 0.035
# A cone narrows by so much a unit of height at least, and at most.
SLOPES = (0.06, 2.2)
# A point is on one face alone where others are so many deviations away.
CLEAR = 3.0
# Of the inliers of a box on its other faces, no larger share may lie beyond a face: two walls that part are no corner of a box.
MOST_BEYOND = 0.25


class Mixture(NamedTuple):
    """How H candidates explain N points.

    Attributes:
        log_likelihood: (H,), in nats.
        background: Share of the points left to the background (H,).
        scale: Noise scale in units of the points' own deviations (H,).
        ownership: Probability that a point belongs to the surface (H, N), 0 for padding.
    """

    log_likelihood: Array
    background: Array
    scale: Array
    ownership: Array


def mixture(
    square: Array, variance: Array, view: View, depth_range: Array, scale_bounds: tuple[float, float]
) -> Mixture:
    """Likelihood of each candidate, its share and scale fitted by EM, from squared residuals in deviations and their variances."""
    # Both densities are per unit of depth in units of the point's own deviation.
    outside = -jnp.log(depth_range * view.gain)
    wider = 0.5 * jnp.log(variance)
    count = view.mask.sum() + 1e-9

    def logs(background: Array, scale: Array) -> tuple[Array, Array]:
        surface = -0.5 * square / (scale**2)[:, None] - jnp.log(scale)[:, None] - wider - HALF_LOG_2PI
        return jnp.log1p(-background)[:, None] + surface, jnp.log(background)[:, None] + outside

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        surface, background = logs(*state)
        own = jax.nn.sigmoid(surface - background) * view.mask
        total = own.sum(-1)
        scale = jnp.sqrt((own * square).sum(-1) / (total + 1e-9))
        return jnp.clip(1 - total / count, 1e-3, 0.999), jnp.clip(scale, *scale_bounds)

    ones = jnp.ones(square.shape[0], square.dtype)
    share, scale = lax.fori_loop(0, EM_STEPS, step, (0.3 * ones, ones))
    surface, background = logs(share, scale)
    likelihood = (view.mask * jnp.logaddexp(surface, background)).sum(-1)
    return Mixture(
        log_likelihood=jnp.where(jnp.isfinite(likelihood), likelihood, -jnp.inf),
        background=share,
        scale=scale,
        ownership=jax.nn.sigmoid(surface - background) * view.mask,
    )


def gric(square: Array, mask: Array, parameters: Array) -> Array:
    """Torr's geometric robust information criterion for surfaces, Σ min(e²/σ², 2) + k ln(3 n); lower is better.

    Torr, "Bayesian model estimation and selection for epipolar geometry and generic manifold fitting", IJCV 50(1), 2002; the term
    in the dimension of the manifold is the same for all surfaces and left out.
    """
    return (mask * jnp.minimum(square, 2.0)).sum(-1) + parameters * jnp.log(3 * mask.sum())


def cone_tapers(theta: Array, own: Array, height: Array) -> Array:
    """A cone must narrow by a quarter over its inliers, and by a slope that is allowed."""
    total = own.sum(-1) + 1e-9
    mean = (own * height).sum(-1) / total
    spread = 1.7 * jnp.sqrt(jnp.maximum((own * (height - mean[:, None]) ** 2).sum(-1) / total, 1e-12))
    low, high = (theta[:, 2] - theta[:, 3] * (mean + side * spread) for side in (-1, 1))
    ratio = jnp.minimum(low, high) / jnp.maximum(jnp.maximum(low, high), 1e-6)
    slope = jnp.abs(theta[:, 3])
    return (ratio < 0.75) & (slope > SLOPES[0]) & (slope < SLOPES[1])


def faces_hold(theta: Array, signs: Array, part: Array, ownership: Array, background: Array, view: View) -> Array:
    """Every face of a box must hold 3.5 % of its inliers, eight points, and most of the points within its own extent.

    Points that lie on another face as well, near an edge, hold nothing: any plane has such. And what lies on the other faces must
    lie behind it.

    Args:
        theta: Boxes (H, 5).
        signs: Their outward sides (H, 3).
        part: Which face each point met (H, N).
        ownership: Probability that it lies on it (H, N).
        background: Share of background (H,).
        view: The points, in the frame of each box.
    """
    face = jnp.arange(3)[None, :, None]
    met = jnp.where(part[:, None] == face, view.mask, 0.0)
    own = met * ownership[:, None]
    total = own.sum(-1) + 1e-9
    within = met
    for coordinate in _picture(theta, view):
        mean = (own * coordinate).sum(-1) / total
        spread = jnp.sqrt(jnp.maximum((own * (coordinate - mean[..., None]) ** 2).sum(-1) / total, 1e-10))
        within = within * (jnp.abs(coordinate - mean[..., None]) < 1.7 * spread[..., None])
    filled = (own * within).sum(-1) / (within.sum(-1) + 1e-9) / (1 - background)[:, None]
    inliers = ownership.sum(-1, keepdims=True) + 1e-9
    beyond = _beyond(theta, view) * view.gain
    near = (jnp.abs(beyond) < CLEAR) & (signs != 0)[..., None]
    alone = (own * (near.sum(1, keepdims=True) - near == 0)).sum(-1)
    others = ownership.sum(-1, keepdims=True) - own.sum(-1)
    before = ((ownership[:, None] - own) * (signs[..., None] * beyond > CLEAR)).sum(-1)
    held = (alone >= LEAST_FACE * inliers) & (alone >= 8.0) & (filled >= 0.6) & (before <= MOST_BEYOND * others)
    return (held | (signs == 0)).all(-1)


def _beyond(theta: Array, view: View) -> Array:
    """How far points lie beyond each face of boxes, along the axes of these (H, 3, N)."""
    c, s = jnp.cos(theta[:, :1]), jnp.sin(theta[:, :1])
    x, y, z = columns(view.point)
    return jnp.stack([c * x + s * z - theta[:, 1:2], c * z - s * x - theta[:, 2:3], y - theta[:, 3:4]], 1)


def _picture(theta: Array, view: View) -> tuple[Array, Array]:
    """Coordinates (H, 3, N) in which the extent of each face is judged: the picture's, or without a camera its own."""
    if view.ray is not None:
        u, v, w = columns(view.ray)
        # Padding has no ray.
        ahead = jnp.where(w > 0, w, 1.0)
        return (u / ahead)[:, None], (v / ahead)[:, None]
    c, s = jnp.cos(theta[:, :1]), jnp.sin(theta[:, :1])
    x, y, z = columns(view.point)
    first, second = c * x + s * z, c * z - s * x
    return jnp.stack([second, first, first], 1), jnp.stack([y, y, second], 1)


def stout(radius: Array, flattest: float = FLATTEST) -> Array:
    """A radius must be neither nothing nor so large that the surface is flat over the object."""
    return (radius > 0.01) & (radius < flattest)
