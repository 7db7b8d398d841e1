"""Search: from starts of every kind to the surface that explains an object best.

Screen all starts by the noise-cluster objective on a few points, move the best of each kind by Gauss-Newton steps under
memberships of a falling noise distance (m = 2: weight u² = (1 + D/δ²)⁻²), add lids and tops to the best, finish those on more
points with the axis free to lean, and choose by likelihood.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import choice, local, rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import Residual, View

KINDS = ("plane", "box", "cylinder", "cone", "sphere")
FEW, MORE = 256, 768
# How many of each kind are moved on a few points.
KEPT = 6
PATCHES = 24
# Of the spread of an object: below lies the rounding of single precision.
LEAST_DEVIATION = 2e-5
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
        passed: Whether it is allowed and no guard speaks against its best candidate (5,).
        candidates: The best candidate of each kind.
        scale: Noise scale of each.
        background: Share of background of each.
        deviation: What the points' deviations were found to be, in units of 1 / gain; 1 where given.
        local: What small windows say of them, in units of those used.
        normals: Normals of small pieces of surface (W, 3), 0 where unusable.
    """

    kind: Array
    scores: Array
    passed: Array
    candidates: Candidates
    scale: Array
    background: Array
    deviation: Array
    local: Array
    normals: Array


def search(view: View, depth_range: Array, allowed: Array, given: Array, gric: Array) -> Found:
    """Finds the best surface of each kind and chooses among the allowed ones (5,).

    Args:
        view: All points; where `given` is false, gains are right but for a common factor, which is found here.
        depth_range: Range of depth over which background is spread.
        allowed: Which kinds may be chosen (5,).
        given: Whether the deviation of the points is known.
        gric: Whether to score by GRIC in place of the likelihood.
    """
    dtype = view.gain.dtype
    few = rays.taken(view, FEW)
    company = starts.dense(few)
    anchors = jnp.stack([c[0] for c in few.point], -1)[starts.first_of(company, starts.ANCHORS)]
    patches = local.patches(rays.taken(view, MORE), anchors[:PATCHES])
    typical = jnp.maximum(local.typical_deviation(patches), LEAST_DEVIATION)
    deviation = jnp.where(given, 1.0, typical)
    view = view._replace(gain=view.gain / deviation)
    turn = local.lean(view, patches)
    few, more = rays.turned(rays.taken(view, FEW), turn[None]), rays.taken(view, MORE)
    level, on_lid = _lid(few, patches, turn, company)
    under = company & (few.point[1][0] < jnp.where(jnp.isnan(level), jnp.inf, level)) & ~on_lid
    window = starts.windows(few, anchors @ turn.T, under.astype(dtype))
    coarse = _screened(few, window, company)
    counts = (KEPT, KEPT + KEPT // 2, len(coarse.theta) - 3 * KEPT - KEPT // 2, KEPT)
    coarse, price = descend(coarse, counts, few, COARSE, 0.5, False, False)
    fine, counts = _finalists(coarse, price, counts, few, window, company, turn, level, on_lid)
    lids = view.ray is not None
    fine, _ = descend(fine, counts, more, FINE, 0.2, True, lids)
    r = residuals(fine, counts, rays.turned(more, fine.turn), lids)
    mixed = choice.mixture(r, more, depth_range, (0.35, 1.6))
    count = more.mask.sum()
    parameters = fine.free.sum(-1) - jnp.concatenate([jnp.ones(counts[0]), jnp.zeros(sum(counts[1:]))]).astype(dtype)
    likelihood = -mixed.log_likelihood + 0.5 * parameters * jnp.log(count)
    score = jnp.where(gric, choice.gric(r, more.mask, parameters), likelihood)
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
    bonus = jnp.concatenate([jnp.full(counts[0], choice.PLANE_BONUS), jnp.zeros(sum(counts[1:]))]).astype(dtype)
    score = jnp.where(jnp.isfinite(score), score, 1e9) - bonus
    # Free narrowing makes a body of revolution a cone.
    kind = jnp.concatenate(
        [jnp.full(counts[0], 0), jnp.full(counts[1], 1), jnp.where(steep, 3, 2), jnp.full(counts[3], 4)]
    )
    own = kind[None] == jnp.arange(5)[:, None]
    # The best that passes, or where none does the best of those.
    best = jnp.argmin(jnp.where(own, score + jnp.where(good, 0.0, 1e12), jnp.inf), -1)
    passed = good[best] & allowed
    scores = score[best]
    chosen = Candidates(*(c[best] for c in fine))
    return Found(
        kind=jnp.argmin(jnp.where(passed, scores, jnp.inf)),
        passed=passed,
        scores=scores * view.mask.sum() / count,
        candidates=chosen,
        scale=mixed.scale[best],
        background=mixed.background[best],
        deviation=deviation,
        local=typical / deviation,
        normals=jnp.where(patches.usable[:, None], patches.normal, 0.0),
    )


def _best(values: Array, count: int) -> Array:
    return lax.top_k(-values, count)[1]


def _flags(count: int, *flags: int) -> np.ndarray:
    return np.broadcast_to(np.array(flags, float), (count, len(flags)))


def _absurd(radius: Array) -> Array:
    return jnp.where((radius > 4) | (radius < 0.02) | ~jnp.isfinite(radius), jnp.inf, 0.0)


def _screened(few: View, window: starts.Windows, company: Array) -> Candidates:
    """The best starts of each family."""
    price = lambda r: choice.cost(r, few.mask, SCREEN)
    dtype = few.gain.dtype
    line_cylinders, line_cones = starts.front_lines(few, starts.first_of(company, starts.FRONT_ANCHORS))
    cylinders = jnp.concatenate([window.cylinders, line_cylinders])
    cones = jnp.concatenate([window.cones, line_cones])
    both = jnp.concatenate([cylinders, cones])
    cost = price(rays.revolution(both, None, few)) + _absurd(both[:, 2])
    n = len(cylinders)
    cylinders = cylinders[_best(cost[:n], KEPT)]
    cones = cones[_best(cost[n:], KEPT)]
    sloped = [cylinders[:4].at[:, 3].set(s) for s in (0.0, 0.3, 0.7)]
    spheres = window.spheres[_best(price(rays.sphere(window.spheres, few)) + _absurd(window.spheres[:, 3]), KEPT)]
    cost = price(rays.plane(window.planes, few))
    planes = window.planes[_best(cost, KEPT)]
    # Upright planes: the two best, and the best that look another way.
    normal = window.planes[:, :3]
    cost = jnp.where(jnp.abs(normal[:, 1]) < 0.5, cost, jnp.inf)
    first = jnp.argmin(cost)
    upright = _best(cost + jnp.where(jnp.abs(normal @ normal[first]) < 0.95, 0.0, 1e6), starts.BOX_PLANES - 2)
    upright = jnp.concatenate([_best(cost, 2), upright])
    off = rays.plane(window.planes[first][None], few)
    chosen = starts.first_of(company & (jnp.abs(off.error[0]) > 3), starts.BOX_ANCHORS)
    anchor = jnp.stack([c[0][chosen] for c in few.point], -1)
    corner, corner_signs = starts.box_corners(few, anchor, window.planes[upright], window.middles[upright])
    ledge, ledge_signs = starts.box_ledges(few, anchor[:, 1], window.planes[upright], window.middles[upright])
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


def _ended(theta: Array, ends: int, rim: Array, turn: Array, cone: Array) -> Candidates:
    """Bodies of revolution with a kind of end."""
    one = jnp.ones_like(rim)
    detail = jnp.stack([ends * one, rim, 0 * one], -1)
    moves = one if ends == rays.CLOSED else 0 * one
    free = jnp.stack([one, one, one, cone * one, moves, one, one], -1)
    return Candidates(theta, detail, free, jnp.broadcast_to(turn, (len(theta), 3, 3)))


def _vessels(theta: Array, cone: Array, few: View, height: Array, turn: Array) -> list[Candidates]:
    """The best lid and the best open rim for each of a few sides."""
    found = []
    for ends in (rays.CLOSED, rays.OPEN):
        level = jnp.tile(height, (len(theta), 1))
        level = level.ravel()
        many = jnp.repeat(theta, len(height), axis=0)
        many = many.at[:, 4].set(level if ends == rays.CLOSED else height.min())
        trial = _ended(many, ends, level, turn, jnp.zeros_like(level))
        cost = choice.cost(rays.revolution(many, trial.detail, few), few.mask, SCREEN).reshape(len(theta), -1)
        best = jnp.argmin(cost, -1) + jnp.arange(len(theta)) * len(height)
        found.append(_ended(many[best], ends, level[best], turn, cone))
    return found


def _lid(few: View, patches: local.Patches, turn: Array, company: Array) -> tuple[Array, Array]:
    """Height of a lid, NaN where no small piece of surface is level, and the points on it."""
    normal, middle = patches.normal @ turn.T, patches.middle @ turn.T
    flat = jnp.where((jnp.abs(normal[:, 1]) > 0.9) & patches.usable, middle[:, 1], jnp.nan)
    return starts.lid_level(few, flat, company, 3.0)


def _lidded(few: View, window: starts.Windows, turn: Array, level: Array, on_lid: Array) -> list[Candidates]:
    """A cylinder and a cone under a lid."""
    below = jnp.stack([window.cylinders[-1], window.cones[-1]])
    theta = starts.lid_bodies(few, below, jnp.where(jnp.isnan(level), 1e3, level), on_lid)
    straight = theta[:, 3] == 0
    trial = _ended(theta, rays.CLOSED, theta[:, 4], turn, ~straight)
    cost = choice.cost(rays.revolution(theta, trial.detail, few), few.mask, 2 * SCREEN) + _absurd(theta[:, 2])
    pick = lambda kept: jnp.argmin(jnp.where(kept, cost, jnp.inf))[None]
    return [Candidates(*(c[pick(kept)] for c in trial)) for kept in (straight, ~straight)]


def _finalists(
    coarse: Candidates,
    cost: Array,
    counts: tuple[int, ...],
    few: View,
    window: starts.Windows,
    company: Array,
    turn: Array,
    level: Array,
    on_lid: Array,
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
    take = lambda i: Candidates(*(c[i] for c in coarse))._replace(turn=jnp.broadcast_to(turn, (len(i), 3, 3)))
    height = few.point[1][0][starts.first_of(company, starts.BOX_ANCHORS)]
    corner = take(corners)
    tops, signs = starts.box_tops(height, corner.theta, corner.detail)
    i = _best(choice.cost(rays.box(tops, signs, few), few.mask, SCREEN), 2)
    tops, signs = tops[i], signs[i]
    topped = Candidates(tops, signs, _box_flags(signs), corner.turn[:2])
    bodies = take(jnp.concatenate([cylinders, cones]))
    bodies = bodies._replace(
        detail=jnp.broadcast_to(jnp.array([rays.SIDE, 1e3, 0.0]), bodies.detail.shape).astype(few.gain.dtype)
    )
    ended = []
    if few.ray is not None:
        # The best sides, and the cone that looks best from within.
        within = window.cones.at[:, 4].set(height.min())
        top = jnp.full(len(within), height.max())
        looked = _ended(within, rays.OPEN, top, turn, top)
        cost = choice.cost(rays.revolution(within, looked.detail, few), few.mask, SCREEN) + _absurd(within[:, 2])
        sides = jnp.stack([coarse.theta[cylinders[0]], coarse.theta[cones[0]], within[jnp.argmin(cost)]])
        ended = [
            *_vessels(sides, jnp.array([0.0, 1.0, 1.0], few.gain.dtype), few, height, turn),
            *_lidded(few, window, turn, level, on_lid),
        ]
    groups = [take(planes), take(corners[:2]), take(ledges), topped, bodies, *ended, take(spheres)]
    sizes = (2, 5, 4 + sum(len(e.theta) for e in ended), 2)
    return Candidates(*(jnp.concatenate(c) for c in zip(*groups, strict=True))), sizes
