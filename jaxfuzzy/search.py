"""Search: from starts of every kind to the surface that explains an object best.

Screen all starts by the noise-cluster objective on a few points, move the best of each kind by Gauss-Newton steps under
memberships of a falling noise distance (m = 2: weight u² = (1 + D/δ²)⁻²), finish the best few on more points with the axis
free to lean, choose by likelihood, and polish the winner on all points.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import choice, rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import Residual, View

FEW, MORE = 256, 768
KEPT, FINAL = 6, 2
SCREEN = 2.0
COARSE = tuple(np.geomspace(4.0, 2.5, 6))
FINE = tuple(np.geomspace(3.0, 2.5, 4))
KINDS = ("plane", "box", "cylinder", "cone", "sphere")

Surface = Callable[[Array, View], Residual]


def descend(
    surface: Surface, theta: Array, view: View, thresholds: tuple[float, ...], free: Array, largest: float = 0.5
) -> Array:
    """One damped Gauss-Newton step a threshold (noise distance in deviations), all hypotheses at once."""
    steps = jnp.asarray(thresholds, theta.dtype)

    def step(i: int, theta: Array) -> Array:
        r = surface(theta, view)
        weight = view.mask / (1 + (r.error**2 + r.miss**2) / steps[i] ** 2) ** 2
        rows = jnp.stack([*r.slopes, r.error], 1)
        normal = jnp.einsum("hin,hjn->hij", rows * weight[:, None], rows)
        return theta + jnp.clip(_solve(normal, free), -largest, largest)

    return lax.fori_loop(0, len(thresholds), step, theta)


def _solve(normal: Array, free: Array) -> Array:
    """The damped step from JᵀWJ and JᵀWe, stacked; parameters that are not free stay."""
    size = normal.shape[-1] - 1
    matrix = normal[:, :size, :size] * (free[:, :, None] * free[:, None, :])
    diagonal = jnp.einsum("hii->hi", matrix)
    damp = 1e-3 * diagonal + 1e-6 * diagonal.max(-1, keepdims=True) + (1 - free) + 1e-20
    matrix = matrix + damp[:, :, None] * jnp.eye(size, dtype=normal.dtype)
    return -starts.invert(matrix, (normal[:, :size, size] * free)[..., None])[..., 0] * free


def _best(values: Array, count: int) -> Array:
    return lax.top_k(-values, count)[1]


class Found(NamedTuple):
    kind: Array
    scores: Array
    theta: Array
    signs: Array
    scale: Array
    background: Array


def search(view: View, depth_range: Array, allowed: Array) -> Found:
    dtype = view.gain.dtype
    few, more = rays.taken(view, FEW), rays.taken(view, MORE)
    ones = lambda count, *flags: jnp.broadcast_to(jnp.asarray(flags, dtype), (count, len(flags)))
    screen = lambda surface, theta, c=SCREEN: choice.cost(surface(theta, few), few.mask, c)
    absurd = lambda radius: jnp.where((radius > 4) | (radius < 0.02) | ~jnp.isfinite(radius), jnp.inf, 0.0)
    window = starts.windows(few)
    line_cylinders, line_cones = starts.front_lines(few)
    rough = {
        "cylinder": jnp.concatenate([window.cylinders, line_cylinders]),
        "cone": jnp.concatenate([window.cones, line_cones]),
    }
    both = jnp.concatenate([rough["cylinder"], rough["cone"]])
    price = screen(rays.revolution, both) + absurd(both[:, 2])
    n = len(rough["cylinder"])
    cylinders = rough["cylinder"][_best(price[:n], KEPT)]
    cones = rough["cone"][_best(price[n:], KEPT)]
    cones = jnp.concatenate([cones, *(cylinders[:4].at[:, 3].set(s) for s in (0.0, 0.3, 0.7))])
    both = jnp.concatenate([cylinders, cones])
    both = descend(
        rays.revolution, both, few, COARSE, jnp.concatenate([ones(KEPT, 1, 1, 1, 0), ones(len(cones), 1, 1, 1, 1)])
    )
    price = screen(rays.revolution, both, 2.5)
    cylinders, cones = both[:KEPT][_best(price[:KEPT], FINAL)], both[KEPT:][_best(price[KEPT:], FINAL)]

    spheres = window.spheres[_best(screen(rays.sphere, window.spheres) + absurd(window.spheres[:, 3]), KEPT)]
    spheres = descend(rays.sphere, spheres, few, COARSE, ones(KEPT, 1, 1, 1, 1))
    spheres = spheres[_best(screen(rays.sphere, spheres, 2.5), FINAL)]

    plane_price = screen(rays.plane, window.planes)
    planes = window.planes[_best(plane_price, KEPT)]
    planes = descend(rays.plane, planes, few, COARSE, ones(KEPT, 1, 1, 1, 1))
    planes = planes[_best(screen(rays.plane, planes, 2.5), FINAL)]

    upright = _best(jnp.where(jnp.abs(window.planes[:, 1]) < 0.5, plane_price, jnp.inf), starts.BOX_PLANES)
    face, middle = window.planes[upright], window.middles[upright]
    corner, corner_signs = starts.box_corners(few, face, middle)
    ledge, ledge_signs = starts.box_ledges(few, face, middle)
    box = lambda signs: lambda theta, view: rays.box(theta, signs, view)
    flags = lambda signs: jnp.concatenate([jnp.ones_like(signs[:, :1]), jnp.abs(signs)], 1)
    i = _best(screen(box(corner_signs), corner), KEPT)
    j = _best(screen(box(ledge_signs), ledge), KEPT // 2)
    boxes = jnp.concatenate([corner[i], ledge[j]])
    signs = jnp.concatenate([corner_signs[i], ledge_signs[j]])
    boxes = descend(box(signs), boxes, few, COARSE[:5], flags(signs), 0.3)
    i = _best(screen(box(signs[:KEPT]), boxes[:KEPT]), 4)
    topped, topped_signs = starts.box_tops(few, boxes[i], signs[i])
    j = _best(screen(box(topped_signs), topped), KEPT // 2)
    boxes, signs = jnp.concatenate([boxes, topped[j]]), jnp.concatenate([signs, topped_signs[j]])
    boxes = descend(box(signs), boxes, few, COARSE[1:], flags(signs), 0.3)
    price = screen(box(signs), boxes, 2.5)
    a, b = KEPT, KEPT + KEPT // 2
    i = jnp.concatenate([_best(price[:a], FINAL), a + _best(price[a:b], 1), b + _best(price[b:], 1)])
    boxes, signs = boxes[i], signs[i]

    # Finish.
    both = descend(
        rays.revolution,
        jnp.concatenate([cylinders, cones]),
        more,
        FINE,
        jnp.concatenate([ones(FINAL, 1, 1, 1, 0), ones(FINAL, 1, 1, 1, 1)]),
        0.2,
    )
    spheres = descend(rays.sphere, spheres, more, FINE, ones(FINAL, 1, 1, 1, 1), 0.2)
    planes = descend(rays.plane, planes, more, FINE, ones(FINAL, 1, 1, 1, 1), 0.2)
    boxes = descend(box(signs), boxes, more, FINE, flags(signs), 0.2)
    parts = [
        rays.plane(planes, more),
        rays.box(boxes, signs, more),
        rays.revolution(both, more),
        rays.sphere(spheres, more),
    ]
    joined = Residual(
        *(
            jnp.concatenate([getattr(p, f) for p in parts]) if f in ("error", "miss", "log_std", "part") else ()
            for f in Residual._fields
        )
    )
    mixed = choice.mixture(joined, more, depth_range, (0.35, 1.3))
    theta = jnp.concatenate([planes, boxes, both, spheres])
    count = more.mask.sum()
    nb = len(boxes)
    parameters = jnp.concatenate(
        [jnp.full(FINAL, 3.0), 1 + jnp.abs(signs).sum(-1), jnp.full(FINAL, 3.0), jnp.full(2 * FINAL, 4.0)]
    ).astype(dtype)
    score = -mixed.log_likelihood + 0.5 * parameters * jnp.log(count)
    at = np.cumsum([0, FINAL, nb, FINAL, FINAL, FINAL])
    cut = lambda tree, k: Residual(
        *(
            t[at[k] : at[k + 1]] if f in ("error", "miss", "log_std", "part") else ()
            for f, t in zip(Residual._fields, tree)
        )
    )
    cutm = lambda k: choice.Mixture(*(t[at[k] : at[k + 1]] for t in mixed))
    good = jnp.concatenate(
        [
            jnp.ones(FINAL, bool),
            choice.faces_hold(cut(joined, 1), signs, cutm(1), more),
            cylinders_ok(theta[at[2] : at[3], 2]),
            choice.cone_tapers(theta[at[3] : at[4]], cutm(3).ownership, more.point[1]),
            cylinders_ok(theta[at[4] : at[5], 3]),
        ]
    )
    score = jnp.where(good, score, jnp.inf)
    score = score - jnp.concatenate([jnp.full(FINAL, 20.0), jnp.zeros(len(score) - FINAL)]).astype(dtype)
    pick = jnp.stack([at[k] + jnp.argmin(score[at[k] : at[k + 1]]) for k in range(5)])
    scores = jnp.where(allowed, score[pick], jnp.inf)
    return Found(
        jnp.argmin(scores),
        scores * view.mask.sum() / count,
        theta[pick],
        signs[pick[1] - at[1]],
        mixed.scale[pick],
        mixed.background[pick],
    )


def cylinders_ok(radius: Array) -> Array:
    return (radius > 0.01) & (radius < 4.0)
