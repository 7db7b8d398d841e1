"""The winner on all points: Gauss-Newton steps under mixture memberships until it stands still, and its covariance.

The axis is free to lean, with a prior of ten degrees, so that an upright frame known to a few degrees does no harm. Weights
are the probabilities of belonging to the surface; they fall off for good points too, which the plain inverse normal matrix
does not know. The covariance is therefore the sandwich H⁻¹ (Σ ψ² J Jᵀ) H⁻¹ with H = Σ ψ' J Jᵀ (Huber, Robust Statistics, 1981).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.choice import HALF_LOG_2PI
from jaxfuzzy.rays import Residual, View
from jaxfuzzy.search import Candidates

MOST_STEPS = 40
LEAN_PRIOR = 0.1745
PLANE, BOX, REVOLUTION, SPHERE = range(4)


class Polished(NamedTuple):
    """A surface on all points: parameters, noise and covariance.

    Attributes:
        theta: Parameters as in `rays` (5,).
        turn: Rotation into the frame in which the axis is y (3, 3).
        scale: Noise in units of the points' own deviations.
        background: Share of background.
        covariance: Of (theta, lean about x, lean about z), (7, 7).
        square: Squared residual of each point in deviations (N,).
        depth: From each point along its ray to the surface (N,).
        part: Which part of the surface each point met (N,).
        moved: The largest change in the last step.
    """

    theta: Array
    turn: Array
    scale: Array
    background: Array
    covariance: Array
    square: Array
    depth: Array
    part: Array
    moved: Array


class _Look(NamedTuple):
    """What one look at the points gives: derivatives (7, N), residual, its square, membership, and the residual's extras."""

    rows: Array
    error: Array
    square: Array
    own: Array
    variance: Array
    part: Array


class _State(NamedTuple):
    step: Array
    theta: Array
    turn: Array
    scale: Array
    background: Array
    look: _Look
    moved: Array


def polish(
    family: Array,
    candidate: Candidates,
    view: View,
    scale: Array,
    background: Array,
    depth_range: Array,
    scale_bounds: tuple[float, float],
    tolerance: float,
) -> Polished:
    """Moves one surface to the maximum of its likelihood on all points.

    Args:
        family: `PLANE`, `BOX`, `REVOLUTION` or `SPHERE`.
        candidate: Where to start, a single candidate without leading axis.
        view: All points.
        scale: Noise to start from.
        background: Share of background to start from.
        depth_range: Range of depth over which background is spread.
        scale_bounds: Least and largest noise scale.
        tolerance: Stop when no parameter changes by more, in units of the object's spread.
    """
    outside = -jnp.log(depth_range * view.gain)
    count = view.mask.sum()
    free, dtype = candidate.free, view.gain.dtype
    prior = jnp.array([0, 0, 0, 0, 0, 1, 1], dtype) / LEAN_PRIOR**2 * free

    def surface(theta: Array, turn: Array) -> Residual:
        seen, detail = rays.turned(view, turn[None]), candidate.detail[None]
        families = (
            lambda t: rays.plane(t, seen),
            lambda t: rays.box(t, detail, seen),
            lambda t: rays.revolution(t, None if view.ray is None else detail, seen),
            lambda t: rays.sphere(t, seen),
        )
        return lax.switch(family, families, theta[None])

    def look(theta: Array, turn: Array, scale: Array, background: Array) -> _Look:
        r = surface(theta, turn)
        square = (r.error**2 + r.miss**2)[0]
        on = jnp.log1p(-background) - 0.5 * (square / scale**2 + jnp.log(r.variance[0])) - jnp.log(scale) - HALF_LOG_2PI
        own = jax.nn.sigmoid(on - jnp.log(background) - outside) * view.mask
        rows = jnp.concatenate([*r.slopes, r.spins[0], r.spins[2]], 0) * free[:, None]
        return _Look(rows, r.error[0], square, own, r.variance[0], r.part[0])

    def normal(theta: Array, rows: Array, weight: Array, scale: Array) -> Array:
        matrix = (rows * weight) @ rows.T / scale**2 + jnp.diag(prior)
        # The length of a plane's parameters means nothing and is kept.
        idle = jnp.concatenate([theta, jnp.zeros(2, dtype)]) * (family == PLANE)
        matrix = matrix + jnp.trace(matrix) * idle[:, None] * idle / (idle @ idle + 1e-30)
        return matrix + jnp.diag(1e-9 * jnp.abs(jnp.diag(matrix)).max() + (1 - free))

    def step(state: _State) -> _State:
        _, theta, turn, scale, background, seen, _ = state
        lean = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[1, 0] - turn[0, 1]])
        downhill = (seen.rows * seen.own) @ seen.error / scale**2 + prior * jnp.concatenate([jnp.zeros(5, dtype), lean])
        matrix = normal(theta, seen.rows, seen.own, scale)
        matrix = matrix + jnp.diag(1e-5 * jnp.diag(matrix))
        first = state.step == 0
        move = -starts.invert(matrix, downhill[:, None])[:, 0] * free
        move = jnp.where(first, 0.0, jnp.clip(move, -0.2, 0.2))
        total = seen.own.sum()
        to_scale = jnp.clip(jnp.sqrt((seen.own * seen.square).sum() / (total + 1e-9)), *scale_bounds)
        to_background = jnp.clip(1 - total / count, 1e-3, 0.999)
        to_scale, to_background = jnp.where(first, scale, to_scale), jnp.where(first, background, to_background)
        # Noise and share matter to the parameters only through the weights: a hundredth as much.
        moved = jnp.maximum(
            jnp.abs(move).max(), 0.01 * jnp.maximum(jnp.abs(to_scale - scale), jnp.abs(to_background - background))
        )
        theta, turn = theta + move[:5], starts.rotation(move[5], move[6]) @ turn
        seen = look(theta, turn, to_scale, to_background)
        return _State(state.step + 1, theta, turn, to_scale, to_background, seen, jnp.where(first, jnp.inf, moved))

    blank = jnp.zeros_like(view.gain)
    nothing = _Look(jnp.zeros((7, len(blank)), dtype), blank, blank, blank, blank, jnp.zeros(len(blank), jnp.int32))
    start = _State(
        jnp.asarray(0), candidate.theta, candidate.turn, scale, background, nothing, jnp.asarray(jnp.inf, dtype)
    )
    end = lax.while_loop(lambda s: (s.step < MOST_STEPS) & (s.moved > tolerance), step, start)
    seen = end.look
    # ψ = own · e and its derivative, with d(own)/de = -own (1 - own) e / scale².
    bend = seen.own * (1 - (1 - seen.own) * seen.error**2 / end.scale**2)
    inverse = jnp.linalg.inv(normal(end.theta, seen.rows, bend, end.scale))
    meat = (seen.rows * (seen.own * seen.error / end.scale) ** 2) @ seen.rows.T / end.scale**2
    return Polished(
        theta=end.theta,
        turn=end.turn,
        scale=end.scale,
        background=end.background,
        covariance=inverse @ meat @ inverse.T * (free[:, None] * free),
        square=seen.square,
        depth=-seen.error * jnp.sqrt(seen.variance) / view.gain,
        part=seen.part,
        moved=end.moved,
    )
