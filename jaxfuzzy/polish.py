"""The winner on all points: Gauss-Newton under mixture memberships until it stands still, and its covariance.

The axis is free to lean, with a prior of ten degrees, so that an upright frame known to a degree or two does no harm. Weights are the probabilities
of belonging to the surface; they fall off for good points too, which the plain inverse normal matrix does not know. The covariance is
therefore the sandwich H⁻¹ (Σ ψ² J Jᵀ) H⁻¹ with H = Σ ψ' J Jᵀ (Huber, Robust Statistics, 1981).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.choice import HALF_LOG_2PI
from jaxfuzzy.rays import Residual, View

MOST_STEPS = 40
LEAN_PRIOR = 0.1745


class Polished(NamedTuple):
    """A surface on all points: its four parameters, the rotation into its own frame, noise and covariance.

    Attributes:
        theta: Parameters as in `rays` (4,).
        rotation: Rotation into the frame in which the axis is y (3, 3).
        scale: Noise in units of the points' own deviations.
        background: Share of background.
        covariance: Of (theta, lean about x, lean about z), (6, 6).
        ownership: Probability that each point belongs to the surface (N,).
        square: Squared residual of each point in deviations (N,).
        depth: From each point along its ray to the surface (N,).
        part: Which part of the surface each point met (N,).
        moved: The largest change in the last step.
    """

    theta: Array
    rotation: Array
    scale: Array
    background: Array
    covariance: Array
    ownership: Array
    square: Array
    depth: Array
    part: Array
    moved: Array


def polish(
    surface: Callable[[Array, View], Residual],
    free: Array,
    view: View,
    theta: Array,
    scale: Array,
    background: Array,
    depth_range: Array,
    scale_bounds: tuple[float, float],
    tolerance: float,
    gauge: bool = False,
) -> Polished:
    """Moves one surface to the maximum of its likelihood; `free` (6,) says which of theta and lean may move.

    With `gauge` the length of theta means nothing and is kept.
    """
    outside = -jnp.log(depth_range * view.gain)
    count = view.mask.sum()
    prior = jnp.concatenate([jnp.zeros(4, theta.dtype), jnp.full(2, 1 / LEAN_PRIOR**2, theta.dtype)]) * free

    def look(theta: Array, rotation: Array, scale: Array, background: Array) -> tuple[Array, Array, Array, Array]:
        r = surface(theta[None], rays.turned(view, rotation[None]))
        square = (r.error**2 + r.miss**2)[0]
        on = jnp.log1p(-background) - 0.5 * square / scale**2 - jnp.log(scale) - r.log_std[0] - HALF_LOG_2PI
        own = jax.nn.sigmoid(on - jnp.log(background) - outside) * view.mask
        rows = jnp.concatenate([*r.slopes, r.spins[0], r.spins[2]], 0) * free[:, None]
        return rows, r.error[0], square, own

    def normal(theta: Array, rows: Array, weight: Array, scale: Array) -> Array:
        matrix = (rows * weight) @ rows.T / scale**2 + jnp.diag(prior)
        idle = jnp.concatenate([theta, jnp.zeros(2, theta.dtype)]) * gauge
        return matrix + jnp.trace(matrix) * idle[:, None] * idle / (idle @ idle + 1e-30)

    def step(state: tuple) -> tuple:
        i, theta, rotation, scale, background, _ = state
        rows, error, square, own = look(theta, rotation, scale, background)
        lean = 0.5 * jnp.array([rotation[2, 1] - rotation[1, 2], rotation[1, 0] - rotation[0, 1]])
        downhill = (rows * own) @ error / scale**2 + prior * jnp.concatenate([jnp.zeros(4, theta.dtype), lean])
        matrix = normal(theta, rows, own, scale)
        diagonal = jnp.diag(matrix)
        matrix = matrix + jnp.diag(1e-5 * diagonal + 1e-9 * diagonal.max() + (1 - free))
        move = -starts.invert(matrix, downhill[:, None])[:, 0] * free
        move = jnp.clip(move, -0.2, 0.2)
        total = own.sum()
        new_scale = jnp.clip(jnp.sqrt((own * square).sum() / (total + 1e-9)), *scale_bounds)
        new_background = jnp.clip(1 - total / count, 1e-3, 0.999)
        moved = jnp.maximum(
            jnp.abs(move).max(), 1e-2 * jnp.maximum(jnp.abs(new_scale - scale), jnp.abs(new_background - background))
        )
        return i + 1, theta + move[:4], _turn(move[4], move[5]) @ rotation, new_scale, new_background, moved

    state = (0, theta, jnp.eye(3, dtype=theta.dtype), scale, background, jnp.asarray(jnp.inf, theta.dtype))
    state = lax.while_loop(lambda s: (s[0] < MOST_STEPS) & (s[5] > tolerance), step, state)
    _, theta, rotation, scale, background, moved = state
    rows, error, square, own = look(theta, rotation, scale, background)
    last = surface(theta[None], rays.turned(view, rotation[None]))
    # ψ = own · e and its derivative, with d(own)/de = -own (1 - own) e / scale².
    influence = own * error / scale
    bend = own * (1 - (1 - own) * error**2 / scale**2)
    bread = normal(theta, rows, bend, scale)
    diagonal = jnp.diag(bread)
    bread = bread + jnp.diag(1e-9 * jnp.abs(diagonal).max() + (1 - free))
    inverse = jnp.linalg.inv(bread)
    meat = (rows * influence**2) @ rows.T / scale**2
    return Polished(
        theta=theta,
        rotation=rotation,
        scale=scale,
        background=background,
        covariance=inverse @ meat @ inverse.T * (free[:, None] * free),
        ownership=own,
        square=square,
        depth=-(last.error * jnp.exp(last.log_std))[0] / view.gain,
        part=last.part[0],
        moved=moved,
    )


def _turn(about_x: Array, about_z: Array) -> Array:
    """The rotation by a vector (about_x, 0, about_z), by Rodrigues' formula with its limit at no turn."""
    square = about_x**2 + about_z**2
    angle = jnp.sqrt(square + 1e-30)
    zero = jnp.zeros_like(square)
    cross = jnp.stack(
        [jnp.stack([zero, -about_z, zero]), jnp.stack([about_z, zero, -about_x]), jnp.stack([zero, about_x, zero])]
    )
    return (
        jnp.eye(3, dtype=square.dtype)
        + jnp.sinc(angle / jnp.pi) * cross
        + 0.5 * jnp.sinc(angle / (2 * jnp.pi)) ** 2 * cross @ cross
    )
