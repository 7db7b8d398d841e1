"""Search: from starts of every kind to the surface that explains an object best.

Screen all starts by the noise-cluster objective on a few points, move the best of each kind by Gauss-Newton steps under
memberships of a falling noise distance (m = 2: weight u² = (1 + D/δ²)⁻²), add lids and tops to the best, finish those on more
points with the axis free to lean, and choose by likelihood.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import choice, rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import Residual, View

KINDS = ("plane", "box", "cylinder", "cone", "sphere")
FEW, MORE = 256, 768
# How many of each kind are moved on a few points.
KEPT = 6
SCREEN = 2.0
COARSE = tuple(np.geomspace(4.0, 2.5, 6))
FINE = tuple(np.geomspace(3.0, 2.5, 5))


class Candidates(NamedTuple):
    """Hypotheses of all families, one after the other: planes, boxes, bodies of revolution, spheres.

    Attributes:
        theta: Parameters as in `rays` (H, 5).
        detail: Signs of a box, ends of a body of revolution (H, 3).
        free: Which parameters may move, and whether the axis may lean about x and z (H, 7).
        turn: Rotation into the frame in which the axis is y (H, 3, 3).
    """

    theta: Array
    detail: Array
    free: Array
    turn: Array


def residuals(candidates: Candidates, counts: tuple[int, int, int, int], view: View, lids: bool) -> Residual:
    """Residuals of all candidates, families of the given sizes."""
    cuts = np.cumsum((0, *counts))
    families = [slice(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]

    def part(family: slice) -> View:
        pick = lambda v: None if v is None else tuple(c if len(c) == 1 else c[family] for c in v)
        return view._replace(point=pick(view.point), ray=pick(view.ray), eye=pick(view.eye))

    p, b, r, s = families
    theta, detail = candidates.theta, candidates.detail
    each = [
        rays.plane(theta[p], part(p)),
        rays.box(theta[b], detail[b], part(b)),
        rays.revolution(theta[r], detail[r] if lids else None, part(r)),
        rays.sphere(theta[s], part(s)),
    ]
    join = lambda *a: jnp.concatenate(a)
    return Residual(
        error=join(*(r.error for r in each)),
        miss=join(*(r.miss for r in each)),
        slopes=tuple(join(*(r.slopes[i] for r in each)) for i in range(5)),
        spins=tuple(join(*(r.spins[i] for r in each)) for i in range(3)),
        variance=join(*(r.variance for r in each)),
        part=join(*(r.part for r in each)),
    )


def descend(
    candidates: Candidates,
    counts: tuple[int, int, int, int],
    view: View,
    thresholds: tuple[float, ...],
    largest: float,
    lean: bool,
    lids: bool,
) -> tuple[Candidates, Array]:
    """One damped Gauss-Newton step a threshold (noise distance in deviations), all candidates at once; and their costs before the last."""
    steps = jnp.asarray(thresholds, candidates.theta.dtype)
    size = 7 if lean else 5

    def step(i: int, state: tuple[Candidates, Array]) -> tuple[Candidates, Array]:
        now, _ = state
        r = residuals(now, counts, rays.turned(view, now.turn) if lean else view, lids)
        square = (r.error**2 + r.miss**2) / steps[i] ** 2
        weight = view.mask / (1 + square) ** 2
        cost = (view.mask * (square / (1 + square))).sum(-1)
        rows = jnp.stack([*r.slopes, r.spins[0], r.spins[2], r.error] if lean else [*r.slopes, r.error], 1)
        normal = jnp.einsum("hin,hjn->hij", rows * weight[:, None], rows)
        move = jnp.clip(_step(normal, now.free[:, :size]), -largest, largest)
        turn = starts.rotation(move[:, 5], move[:, 6]) @ now.turn if lean else now.turn
        return now._replace(theta=now.theta + move[:, :5], turn=turn), cost

    start = jnp.zeros(len(candidates.theta), steps.dtype)
    return lax.fori_loop(0, len(thresholds), step, (candidates, start))


def _step(normal: Array, free: Array) -> Array:
    """The damped step from JᵀWJ and JᵀWe, stacked; parameters that are not free stay."""
    size = normal.shape[-1] - 1
    matrix = normal[:, :size, :size] * (free[:, :, None] * free[:, None, :])
    diagonal = jnp.einsum("hii->hi", matrix)
    damp = 1e-3 * diagonal + 1e-6 * diagonal.max(-1, keepdims=True) + (1 - free) + 1e-20
    matrix = matrix + damp[:, :, None] * jnp.eye(size, dtype=normal.dtype)
    return -starts.invert(matrix, (normal[:, :size, size] * free)[..., None])[..., 0] * free


class Found(NamedTuple):
    """The best candidate of each kind, in the order of `KINDS`, and which kind is best.

    Attributes:
        kind: Index of the best kind.
        scores: Score of each kind, lower is better (5,).
        candidates: The best candidate of each kind.
        scale: Noise scale of each.
        background: Share of background of each.
    """

    kind: Array
    scores: Array
    candidates: Candidates
    scale: Array
    background: Array


def search(view: View, depth_range: Array, allowed: Array) -> Found:
    """Finds the best surface of each kind and chooses among the allowed ones (5,)."""
    dtype = view.gain.dtype
    few, more = rays.taken(view, FEW), rays.taken(view, MORE)
    coarse = _screened(few)
    counts = (KEPT, KEPT + KEPT // 2, len(coarse.theta) - 3 * KEPT - KEPT // 2, KEPT)
    coarse, price = descend(coarse, counts, few, COARSE, 0.5, False, False)
    fine, counts = _finalists(coarse, price, counts, few)
    fine, _ = descend(fine, counts, more, FINE, 0.2, True, True)
    r = residuals(fine, counts, rays.turned(more, fine.turn), True)
    mixed = choice.mixture(r, more, depth_range, (0.35, 1.6))
    count = more.mask.sum()
    score = -mixed.log_likelihood + 0.5 * fine.free.sum(-1) * jnp.log(count)
    p, b, n, s = (slice(i, j) for i, j in zip(np.cumsum((0, *counts[:-1])), np.cumsum(counts), strict=True))
    part = lambda tree, cut: tree._replace(
        **{k: getattr(tree, k)[cut] for k in tree._fields if k not in ("slopes", "spins")}
    )
    height = rays.turned(more, fine.turn[n]).point[1]
    tapers = choice.cone_tapers(fine.theta[n], part(mixed, n).ownership, height)
    steep = fine.free[n][:, 3] > 0
    good = jnp.concatenate(
        [
            jnp.ones(counts[0], bool),
            choice.faces_hold(part(r, b), fine.detail[b], part(mixed, b), more),
            choice.stout(fine.theta[n][:, 2]) & (tapers | ~steep),
            choice.stout(fine.theta[s][:, 3]),
        ]
    )
    score = jnp.where(good, score, jnp.inf)
    score = score - jnp.concatenate([jnp.full(counts[0], choice.PLANE_BONUS), jnp.zeros(sum(counts[1:]))]).astype(dtype)
    # Free narrowing makes a body of revolution a cone.
    kind = jnp.concatenate(
        [jnp.full(counts[0], 0), jnp.full(counts[1], 1), jnp.where(steep, 3, 2), jnp.full(counts[3], 4)]
    )
    table = jnp.where(kind[None] == jnp.arange(5)[:, None], score[None], jnp.inf)
    best = jnp.argmin(table, -1)
    scores = jnp.where(allowed, table.min(-1), jnp.inf)
    chosen = Candidates(*(c[best] for c in fine))
    return Found(
        jnp.argmin(scores), scores * view.mask.sum() / count, chosen, mixed.scale[best], mixed.background[best]
    )


def _best(values: Array, count: int) -> Array:
    return lax.top_k(-values, count)[1]


def _flags(count: int, *flags: int) -> np.ndarray:
    return np.broadcast_to(np.array(flags, float), (count, len(flags)))


def _absurd(radius: Array) -> Array:
    return jnp.where((radius > 4) | (radius < 0.02) | ~jnp.isfinite(radius), jnp.inf, 0.0)


def _screened(few: View) -> Candidates:
    """The best starts of each family."""
    price = lambda r: choice.cost(r, few.mask, SCREEN)
    dtype = few.gain.dtype
    window = starts.windows(few)
    line_cylinders, line_cones = starts.front_lines(few)
    cylinders = jnp.concatenate([window.cylinders, line_cylinders])
    cones = jnp.concatenate([window.cones, line_cones])
    both = jnp.concatenate([cylinders, cones])
    cost = price(rays.revolution(both, None, few)) + _absurd(both[:, 2])
    cylinders = cylinders[_best(cost[: len(cylinders)], KEPT)]
    cones = cones[_best(cost[len(cylinders) :][-len(cones) :], KEPT)]
    sloped = [cylinders[:4].at[:, 3].set(s) for s in (0.0, 0.3, 0.7)]
    spheres = window.spheres[_best(price(rays.sphere(window.spheres, few)) + _absurd(window.spheres[:, 3]), KEPT)]
    cost = price(rays.plane(window.planes, few))
    planes = window.planes[_best(cost, KEPT)]
    upright = _best(jnp.where(jnp.abs(window.planes[:, 1]) < 0.5, cost, jnp.inf), starts.BOX_PLANES)
    corner, corner_signs = starts.box_corners(few, window.planes[upright], window.middles[upright])
    ledge, ledge_signs = starts.box_ledges(few, window.planes[upright], window.middles[upright])
    i = _best(price(rays.box(corner, corner_signs, few)), KEPT)
    j = _best(price(rays.box(ledge, ledge_signs, few)), KEPT // 2)
    bodies = jnp.concatenate([cylinders, cones, *sloped])
    theta = jnp.concatenate([planes, corner[i], ledge[j], bodies, spheres])
    nb, nc = KEPT + KEPT // 2, len(bodies) - KEPT
    detail = jnp.concatenate(
        [jnp.zeros((KEPT, 3), dtype), corner_signs[i], ledge_signs[j], jnp.zeros((len(bodies) + KEPT, 3), dtype)]
    )
    free = jnp.concatenate(
        [
            _flags(KEPT, 1, 1, 1, 1, 0, 0, 0),
            _box_flags(detail[KEPT : KEPT + nb]),
            _flags(KEPT, 1, 1, 1, 0, 0, 1, 1),
            _flags(nc, 1, 1, 1, 1, 0, 1, 1),
            _flags(KEPT, 1, 1, 1, 1, 0, 0, 0),
        ]
    ).astype(dtype)
    return Candidates(theta, detail, free, jnp.broadcast_to(jnp.eye(3, dtype=dtype), (len(theta), 3, 3)))


def _box_flags(signs: Array) -> Array:
    ones = jnp.ones_like(signs[:, :1])
    return jnp.concatenate([ones, jnp.abs(signs), 0 * ones, ones, ones], 1)


def _finalists(
    coarse: Candidates, cost: Array, counts: tuple[int, ...], few: View
) -> tuple[Candidates, tuple[int, int, int, int]]:
    """The best two of each kind, the best boxes with a top, the best bodies of revolution with a lid or open."""
    p, b, n, _ = np.cumsum(counts)
    k = KEPT
    planes = _best(cost[:p], 2)
    corners = p + _best(cost[p : p + k], 4)
    ledges = p + k + _best(cost[p + k : b], 1)
    cylinders = b + _best(cost[b : b + k], 2)
    cones = b + k + _best(cost[b + k : n], 2)
    spheres = n + _best(cost[n:], 2)
    take = lambda i: Candidates(*(c[i] for c in coarse))
    corner = take(corners)
    tops, signs = starts.box_tops(few, corner.theta, corner.detail)
    i = _best(choice.cost(rays.box(tops, signs, few), few.mask, SCREEN), 2)
    tops, signs = tops[i], signs[i]
    topped = Candidates(tops, signs, _box_flags(signs), corner.turn[:2])
    bodies = take(jnp.concatenate([cylinders, cones]))
    bodies = bodies._replace(
        detail=jnp.broadcast_to(jnp.array([rays.SIDE, 1e3, 0.0]), bodies.detail.shape).astype(few.gain.dtype)
    )
    groups = [take(planes), take(corners[:2]), take(ledges), topped, bodies, take(spheres)]
    sizes = (2, 5, 4, 2)
    return Candidates(*(jnp.concatenate(c) for c in zip(*groups, strict=True))), sizes
