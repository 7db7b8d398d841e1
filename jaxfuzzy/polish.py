"""The winner on all points: Gauss-Newton steps under mixture memberships until it stands still, and its covariance.

The axis is free to lean, with a prior. Weights are the probabilities of belonging to the surface; they fall off for good points
too, which the plain inverse normal matrix does not know. The covariance is therefore the sandwich H⁻¹ (Σ ψ² J Jᵀ) H⁻¹ with
H = Σ ψ' J Ĵᵀ (Huber, Robust Statistics, 1981), J the derivatives that steps take and Ĵ the true ones: along a ray that grazes the
surface the former are damped. In ψ² a residual counts as if its point had not pulled the surface towards itself (HC3; MacKinnon
and White, J. Econometrics 29, 1985).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.candidates import Candidates
from jaxfuzzy.choice import FLATTEST, HALF_LOG_2PI
from jaxfuzzy.linalg import divide
from jaxfuzzy.rays import Meeting, Residual, View

MOST_STEPS = 120
# A step is so many times what derivatives say at least, and at most; where even the least is too long, points change sides.
STIFFEST, SOFTEST = 4.0, 0.3
# Below lie the last few points before a silhouette, where a surface bends away faster than a derivative tells.
LEAST_DAMPING = 0.2
MOST_LEVERAGE = 0.9
LEAST_BEND = 0.5
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
    """What one look at the points gives: derivatives (7, N), residual, its square, damping of derivatives, membership."""

    rows: Array
    error: Array
    square: Array
    damping: Array
    own: Array


class _State(NamedTuple):
    """Where the surface is; `look` is at where it was a step before, `last` says that it rests, `done` that it was seen there.

    Of the last step: `wanted` is what derivatives asked for, `move` what was done, `calm` how many times shorter steps are made.
    """

    step: Array
    theta: Array
    turn: Array
    scale: Array
    background: Array
    met: Meeting
    look: _Look
    wanted: Array
    move: Array
    calm: Array
    moved: Array
    last: Array
    done: Array


def polish(
    family: Array,
    candidate: Candidates,
    turn: Array,
    view: View,
    scale: Array,
    background: Array,
    depth_range: Array,
    lean: Array,
    scale_bounds: tuple[float, float],
    tolerance: float,
) -> Polished:
    """Moves one surface to the maximum of its likelihood on all points.

    Args:
        family: `PLANE`, `BOX`, `REVOLUTION` or `SPHERE`.
        candidate: Where to start, a single candidate without leading axis.
        turn: Rotation into its frame (3, 3).
        view: All points.
        scale: Noise to start from.
        background: Share of background to start from.
        depth_range: Range of depth over which background is spread.
        lean: Standard deviation of the prior on the axis' lean, in radians.
        scale_bounds: Least and largest noise scale.
        tolerance: Stop when no parameter changes by more, in units of the object's spread.
    """
    outside = -jnp.log(depth_range * view.gain)
    count = view.mask.sum()
    free, dtype = candidate.free, view.gain.dtype
    prior = jnp.array([0, 0, 0, 0, 0, 1, 1], dtype) / lean**2 * free

    def look(state: _State) -> _Look:
        square, log_variance, damping, rows = residual_of(
            family, state.theta, state.turn, candidate.detail, view, state.met
        )
        scale = state.scale
        on = -0.5 * (square / scale**2 + log_variance) - jnp.log(scale) - HALF_LOG_2PI
        odds = on + jnp.log1p(-state.background) - jnp.log(state.background) - outside
        return _Look(rows[1:] * free[:, None], rows[0], square, damping, jax.nn.sigmoid(odds) * view.mask)

    def normal(theta: Array, rows: Array, weight: Array, scale: Array) -> Array:
        matrix = (rows * weight) @ rows.T / scale**2 + jnp.diag(prior)
        # The length of a plane's parameters means nothing and is kept.
        idle = jnp.concatenate([theta, jnp.zeros(2, dtype)]) * (family == PLANE)
        matrix = matrix + jnp.trace(matrix) * idle[:, None] * idle / (idle @ idle + 1e-30)
        return matrix + jnp.diag(1e-9 * jnp.abs(jnp.diag(matrix)).max() + (1 - free))

    def step(state: _State) -> _State:
        theta, turn, scale, background = state.theta, state.turn, state.scale, state.background
        # At the first look nothing is known yet of where rays meet the surface; the last is at where it came to rest.
        still = (state.step == 0) | state.last
        seen = look(state)
        leaning = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[1, 0] - turn[0, 1]])
        downhill = (seen.rows * seen.own) @ seen.error / scale**2 + prior * jnp.concatenate(
            [jnp.zeros(5, dtype), leaning]
        )
        matrix = normal(theta, seen.rows, seen.own, scale)
        matrix = matrix + jnp.diag(1e-5 * jnp.diag(matrix))
        wanted = jnp.clip(-starts.invert(matrix, downhill[:, None])[:, 0] * free, -0.2, 0.2)
        wanted = jnp.where(still, 0.0, wanted)
        # Derivatives are damped at grazing incidence and know nothing of weights, so that steps would swing about for ever, or
        # creep: how far the last one led tells how long this one is to be (Barzilai and Borwein, IMA J. Numer. Anal. 8, 1988).
        # Across an edge where points change from face to face no step is short enough: they grow shorter and come to rest on it.
        pull = matrix @ state.move
        stiffness = divide(pull @ (state.wanted - wanted), pull @ state.move, 1.0)
        calm = jnp.where(stiffness > STIFFEST, 2.0, 0.8) * state.calm
        calm = jnp.where(still, 1.0, jnp.maximum(calm, 1.0))
        move = wanted / (jnp.clip(stiffness, SOFTEST, STIFFEST) * calm)
        total = seen.own.sum()
        to_scale = jnp.clip(jnp.sqrt((seen.own * seen.square).sum() / (total + 1e-9)), *scale_bounds)
        to_background = jnp.clip(1 - total / count, 1e-3, 0.999)
        to_scale, to_background = jnp.where(still, scale, to_scale), jnp.where(still, background, to_background)
        # Noise and share matter to the parameters only through the weights: a hundredth as much.
        noise = jnp.maximum(jnp.abs(to_scale - scale), jnp.abs(to_background - background))
        moved = jnp.where(still, state.moved, jnp.maximum(jnp.abs(wanted).max() / calm, 0.01 * noise))
        theta, turn = theta + move[:5], starts.rotation(move[5], move[6]) @ turn
        met = met_by(family, theta, turn, candidate.detail, view)
        # What grows without end is flat.
        radius = jnp.where(family == SPHERE, theta[3], jnp.where(family == REVOLUTION, theta[2], 0.0))
        last = ~(moved > tolerance) | (state.step >= MOST_STEPS) | (radius > FLATTEST)
        return _State(
            state.step + 1, theta, turn, to_scale, to_background, met, seen, wanted, move, calm, moved, last, state.last
        )

    blank, no = jnp.zeros_like(view.gain), jnp.asarray(False)
    nowhere = Meeting(blank[None], blank[None], blank[None].astype(jnp.int32))
    unseen = _Look(jnp.zeros((7, len(blank)), dtype), blank, blank, blank, blank)
    far, nil = jnp.asarray(jnp.inf, dtype), jnp.zeros(7, dtype)
    start = _State(
        jnp.asarray(0), candidate.theta, turn, scale, background, nowhere, unseen, nil, nil, 1 + blank[0], far, no, no
    )
    end = lax.while_loop(lambda s: ~s.done, step, start)
    seen = end.look
    # ψ = own · e and its derivative, with d(own)/de = -own (1 - own) e / scale².
    bend = seen.own * (1 - (1 - seen.own / jnp.maximum(view.mask, 1e-12)) * seen.error**2 / end.scale**2)
    # Steps take derivatives damped at grazing incidence; how residuals really change is the undamped ones.
    bend = bend / jnp.maximum(seen.damping, LEAST_DAMPING)
    inverse = _inverse(normal(end.theta, seen.rows, bend, end.scale), normal(end.theta, seen.rows, seen.own, end.scale))
    leverage = seen.own / end.scale**2 * (seen.rows * (inverse @ seen.rows)).sum(0)
    pull = seen.own * seen.error / end.scale / (1 - jnp.clip(leverage, 0.0, MOST_LEVERAGE))
    # The prior is one more observation, which errs as it says.
    meat = (seen.rows * pull**2) @ seen.rows.T / end.scale**2 + jnp.diag(prior)
    return Polished(
        theta=end.theta,
        turn=end.turn,
        scale=end.scale,
        background=end.background,
        covariance=inverse @ meat @ inverse.T * (free[:, None] * free),
        square=seen.square,
        depth=end.met.depth[0],
        part=end.met.part[0],
        moved=end.moved,
    )


def _inverse(bent: Array, steep: Array) -> Array:
    """Inverse of the curvature, in no direction less than `LEAST_BEND` of the steep one, which knows nothing of weights that fall.

    A few points beside a silhouette may bend it the other way: it is then nobody's curvature, and its inverse has any size.
    """
    # Parameters in units of their own, so that none is lost to rounding.
    unit = lax.rsqrt(jnp.diag(steep))
    alike = steep * unit[:, None] * unit + 8 * jnp.finfo(steep.dtype).eps * jnp.eye(len(unit), dtype=steep.dtype)
    half = jnp.linalg.inv(jnp.linalg.cholesky(alike)) * unit
    values, vectors = jnp.linalg.eigh(half @ bent @ half.T)
    root = half.T @ vectors
    return (root / jnp.maximum(values, LEAST_BEND)) @ root.T


def met_by(family: Array, theta: Array, turn: Array, detail: Array, view: View) -> Meeting:
    """Where one surface of a family known only at run time meets the rays (1, N)."""
    seen, signs = rays.turned(view, turn[None]), detail[None]
    ends = None if view.ray is None else signs
    families = (
        lambda t: rays.meet_plane(t, seen),
        lambda t: rays.meet_box(t, signs, seen),
        lambda t: rays.meet_revolution(t, ends, seen),
        lambda t: rays.meet_sphere(t, ends, seen),
    )
    return lax.switch(family, families, theta[None])


def residual_of(
    family: Array, theta: Array, turn: Array, detail: Array, view: View, met: Meeting
) -> tuple[Array, Array, Array, Array]:
    """How far the points lie from that surface.

    Returns:
        Squared residual (N,), logarithm of its variance (N,), what its derivatives are damped by (N,), and the residual with these
        derivatives, by the five parameters and by a lean about x and about z (8, N).
    """
    seen, signs = rays.turned(view, turn[None]), detail[None]
    families = (
        lambda t: rays.plane(t, seen, met),
        lambda t: rays.box(t, signs, seen, met),
        lambda t: rays.revolution(t, seen, met),
        lambda t: rays.sphere(t, seen, met),
    )

    def packed(of: Callable[[Array], Residual]) -> Callable[[Array], Array]:
        def rows(t: Array) -> Array:
            r = of(t)
            each = (r.error**2 + r.miss**2, jnp.log(r.variance), r.damping, r.error, *r.slopes, r.spins[0], r.spins[2])
            return jnp.concatenate([jnp.broadcast_to(jnp.asarray(a, view.gain.dtype), met.depth.shape) for a in each])

        return rows

    # One array: a program hands arrays from branch to branch one by one.
    found = lax.switch(family, [packed(f) for f in families], theta[None])
    return found[0], found[1], found[2], found[3:]
