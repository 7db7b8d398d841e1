"""Candidates of all families side by side, and their descent under the memberships of a falling noise distance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import Meeting, Residual, View


class Counts(NamedTuple):
    """How many candidates there are of each family, in this order."""

    planes: int
    boxes: int
    bodies: int
    spheres: int

    def slices(self) -> tuple[slice, slice, slice, slice]:
        """Where each family stands."""
        ends = np.cumsum(self).tolist()
        return tuple(slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True))  # type: ignore[return-value]


class Candidates(NamedTuple):
    """Surfaces of all families, one after the other: planes, boxes, bodies of revolution, spheres.

    Attributes:
        theta: Parameters as in `rays` (H, 5).
        detail: Signs of a box, ends of a body of revolution (H, 3).
        free: Which parameters may move, and whether the axis may lean about x and about z (H, 7).
    """

    theta: Array
    detail: Array
    free: Array

    def take(self, index: Array) -> "Candidates":
        """Some of them."""
        packed = jnp.concatenate(self, -1)[index]
        return Candidates(packed[..., :5], packed[..., 5:8], packed[..., 8:])


def joined(groups: list[Candidates]) -> Candidates:
    """One after the other."""
    return Candidates(*(jnp.concatenate(c) for c in zip(*groups, strict=True)))


def planes_of(theta: Array) -> Candidates:
    """Planes, which do not lean."""
    return _flagged(theta, jnp.zeros((len(theta), 3), theta.dtype), (1, 1, 1, 1, 0, 0, 0))


def spheres_of(theta: Array, rim: Array | None = None) -> Candidates:
    """Spheres, which do not lean; bowls where a rim (H,) is given."""
    whole = planes_of(theta)
    if rim is None:
        return whole
    return whole._replace(detail=jnp.stack([rays.OPEN * jnp.ones_like(rim), rim, 0 * rim], -1))


def sides_of(theta: Array, cone: bool) -> Candidates:
    """Endless sides of cylinders or cones."""
    detail = jnp.broadcast_to(jnp.array([rays.SIDE, 1e3, 0.0], theta.dtype), (len(theta), 3))
    return _flagged(theta, detail, (1, 1, 1, int(cone), 0, 1, 1))


def vessels_of(theta: Array, ends: Array, rim: Array, cone: Array) -> Candidates:
    """Cylinders or cones (H,) with kinds of ends (H,) and a rim (H,)."""
    one = jnp.ones_like(rim)
    free = (one, one, one, one * cone, one * (ends == rays.CLOSED), one, one)
    return Candidates(theta, jnp.stack([ends * one, rim, 0 * one], -1), jnp.stack(free, -1))


def boxes_of(theta: Array, signs: Array) -> Candidates:
    """Boxes; a face that is not there cannot move."""
    one = jnp.ones_like(signs[:, :1])
    return Candidates(theta, signs, jnp.concatenate([one, jnp.abs(signs), 0 * one, one, one], 1))


def _flagged(theta: Array, detail: Array, flags: tuple[int, ...]) -> Candidates:
    return Candidates(theta, detail, jnp.broadcast_to(jnp.array(flags, theta.dtype), (len(theta), 7)))


def _families(view: View, counts: Counts) -> list[View]:
    cut = lambda v, family: v if v is None or len(v) == 1 else v[family]
    return [view._replace(point=cut(view.point, f), ray=cut(view.ray, f)) for f in counts.slices()]


def meet(candidates: Candidates, counts: Counts, view: View, lids: bool) -> Meeting:
    """Where all candidates meet the rays; `lids` whether bodies of revolution may have ends."""
    p, b, r, s = counts.slices()
    seen = _families(view, counts)
    theta, detail = candidates.theta, candidates.detail
    each = (
        rays.meet_plane(theta[p], seen[0]),
        rays.meet_box(theta[b], detail[b], seen[1]),
        rays.meet_revolution(theta[r], detail[r] if lids else None, seen[2]),
        rays.meet_sphere(theta[s], detail[s] if lids else None, seen[3]),
    )
    return Meeting(*(jnp.concatenate(c) for c in zip(*each, strict=True)))


def look(candidates: Candidates, counts: Counts, view: View, met: Meeting) -> Residual:
    """Residuals of all candidates."""
    p, b, r, s = counts.slices()
    seen = _families(view, counts)
    theta = candidates.theta
    part = lambda f: Meeting(*(c[f] for c in met))
    each = (
        rays.plane(theta[p], seen[0], part(p)),
        rays.box(theta[b], candidates.detail[b], seen[1], part(b)),
        rays.revolution(theta[r], seen[2], part(r)),
        rays.sphere(theta[s], seen[3], part(s)),
    )
    join = lambda *a: jnp.concatenate(a)
    spin = lambda i: join(*(e.spins[i] for e in each))
    return Residual(
        join(*(e.error for e in each)),
        join(*(e.miss for e in each)),
        join(*(e.variance for e in each)),
        tuple(join(*(e.slopes[i] for e in each)) for i in range(5)),
        (spin(0), spin(1), spin(2)),
        join(*(e.damping for e in each)),
    )


class Seen(NamedTuple):
    """How H candidates explain N points.

    Attributes:
        square: Squared residual of each point in deviations (H, N).
        variance: Of the error, in units of the point's own (H, N).
        part: Which part of the surface each ray met (H, N).
    """

    square: Array
    variance: Array
    part: Array


class _State(NamedTuple):
    candidates: Candidates
    turns: Array | None
    seen: Seen
    cost: Array


def descend(
    candidates: Candidates,
    counts: Counts,
    turns: Array | None,
    view: View,
    thresholds: tuple[float, ...],
    largest: float,
    lids: bool,
) -> tuple[Candidates, Array | None, Array, Seen]:
    """One damped Gauss-Newton step a threshold, all candidates at once.

    Args:
        candidates: Where to start.
        counts: How many of each family.
        turns: Rotation into the frame of each (H, 3, 3), free to lean; None: all in the view's frame, which stays.
        view: The points.
        thresholds: Noise distances, in deviations.
        largest: No parameter moves by more in a step.
        lids: Whether bodies of revolution may have ends.

    Returns:
        Candidates, their rotations, and in the end the objective of each and how it explains the points.
    """
    # One look more than steps: the last is at what was found, and nothing moves.
    steps = jnp.asarray((*thresholds, thresholds[-1]), candidates.theta.dtype)
    size = 5 if turns is None else 7

    def met_by(now: Candidates, turns: Array | None) -> tuple[View, Meeting]:
        seen = view if turns is None else rays.turned(view, turns)
        return seen, meet(now, counts, seen, lids)

    def nothing(now: Candidates, turns: Array | None) -> tuple[View, Meeting]:
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(met_by, now, turns))

    def step(i: int, state: _State) -> _State:
        now, turns, *_ = state
        # A branch that is always taken: without it the compiler works out anew for every derivative where rays meet surfaces.
        own, met = lax.cond(i >= 0, met_by, nothing, now, turns)
        r = look(now, counts, own, met)
        seen = Seen(r.error**2 + r.miss**2, r.variance, met.part)
        square = seen.square / steps[i] ** 2
        u = 1 / (1 + square)
        cost = (view.mask * square * u).sum(-1)
        columns = [*r.slopes, r.error] if turns is None else [*r.slopes, r.spins[0], r.spins[2], r.error]
        rows = jnp.stack(columns, 1) * (jnp.sqrt(view.mask) * u)[:, None]
        move = _move(jnp.einsum("hin,hjn->hij", rows, rows), now.free[:, :size])
        move = jnp.where(i < len(thresholds), jnp.clip(move, -largest, largest), 0.0)
        now = now._replace(theta=now.theta + move[:, :5])
        turns = None if turns is None else starts.rotation(move[:, 5], move[:, 6]) @ turns
        return _State(now, turns, seen, cost)

    blank = jnp.zeros((len(candidates.theta), len(view.gain)), candidates.theta.dtype)
    start = _State(candidates, turns, Seen(blank, blank, blank.astype(jnp.int32)), jnp.zeros_like(blank[:, 0]))
    end = lax.fori_loop(0, len(steps), step, start)
    return end.candidates, end.turns, end.cost, end.seen


def _move(normal: Array, free: Array) -> Array:
    """The damped step from JᵀWJ and JᵀWe, stacked; parameters that are not free stay."""
    size = normal.shape[-1] - 1
    matrix = normal[:, :size, :size] * (free[:, :, None] * free[:, None, :])
    diagonal = jnp.einsum("hii->hi", matrix)
    damp = 1e-3 * diagonal + 1e-6 * diagonal.max(-1, keepdims=True) + (1 - free) + 1e-20
    matrix = matrix + damp[:, :, None] * jnp.eye(size, dtype=normal.dtype)
    return -starts.invert(matrix, (normal[:, :size, size] * free)[..., None])[..., 0] * free
