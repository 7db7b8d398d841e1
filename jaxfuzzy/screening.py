"""Screening: of many starts of each family, the few that explain an object's points best."""

import jax.numpy as jnp
from jax import lax

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.candidates import Candidates, Counts, boxes_of, joined, planes_of, sides_of, spheres_of
from jaxfuzzy.rays import Meeting, View

# Noise distance in deviations; twice as much is wider than thin objects, and wrong basins win.
SCREEN = 2.0
KEPT = 6
SLOPES, SLOPED = (0.0, 0.3, 0.7), 2


def price(met: Meeting, view: View, threshold: float | Array = SCREEN) -> Array:
    """Σ D / (D + c²), the objective of one fuzzy variety beside a noise cluster at distance c, for m = 2."""
    square = (met.depth**2 + (met.miss / rays.SIDEWAYS) ** 2) * (view.gain / threshold) ** 2
    total = (square / (1 + square)) @ view.mask
    return jnp.where(jnp.isfinite(total), total, jnp.inf)


def best(values: Array, count: int) -> Array:
    """Indices of the smallest."""
    return lax.top_k(-values, count)[1]


def absurd(radius: Array) -> Array:
    """A price that no start with such a radius can pay."""
    return jnp.where((radius > 4) | (radius < 0.02) | ~jnp.isfinite(radius), jnp.inf, 0.0)


def screened(few: View, window: starts.Windows, company: Array) -> tuple[Candidates, Counts]:
    """The best starts of each family."""
    line_cylinders, line_cones = starts.front_lines(few, starts.first_of(company, starts.FRONT_ANCHORS))
    bodies = jnp.concatenate([window.cylinders, line_cylinders, window.cones, line_cones])
    cost = price(rays.meet_revolution(bodies, None, few), few) + absurd(bodies[:, 2])
    n = len(window.cylinders) + len(line_cylinders)
    cylinders, cones = bodies[best(cost[:n], KEPT)], bodies[n + best(cost[n:], KEPT)]
    cones = jnp.concatenate([cones, *(cylinders[:SLOPED].at[:, 3].set(s) for s in SLOPES)])
    cost = price(rays.meet_sphere(window.spheres, None, few), few) + absurd(window.spheres[:, 3])
    spheres = window.spheres[best(cost, KEPT)]
    cost = price(rays.meet_plane(window.planes, few), few)
    planes = window.planes[best(cost, KEPT)]
    boxes = _boxes(few, window, cost, company)
    groups = [
        planes_of(planes),
        boxes,
        sides_of(cylinders, False),
        sides_of(cones, True),
        spheres_of(spheres),
    ]
    return joined(groups), Counts(KEPT, len(boxes.theta), len(cylinders) + len(cones), KEPT)


def _boxes(few: View, window: starts.Windows, cost: Array, company: Array) -> Candidates:
    """Boxes of two upright faces, then boxes of one and a top, from upright planes and from points off the best of them."""
    normal = window.planes[:, :3]
    cost = jnp.where(jnp.abs(normal[:, 1]) < 0.5, cost, jnp.inf)
    first = jnp.argmin(cost)
    # The two best, and the best that look another way.
    other = cost + jnp.where(jnp.abs(normal @ normal[first]) < 0.95, 0.0, 1e6)
    upright = jnp.concatenate([best(cost, 2), best(other, starts.BOX_PLANES - 2)])
    off = jnp.abs(rays.meet_plane(window.planes[first][None], few).depth[0]) * few.gain > 3
    chosen = starts.first_of(company & off, starts.BOX_ANCHORS)
    anchor = few.point[0].T[chosen]
    corner = starts.box_corners(few, anchor, window.planes[upright], window.middles[upright])
    ledge = starts.box_ledges(few, anchor[:, 1], window.planes[upright], window.middles[upright])
    theta, signs = (jnp.concatenate(c) for c in zip(corner, ledge, strict=True))
    cost = price(rays.meet_box(theta, signs, few), few)
    n = len(corner[0])
    kept = jnp.concatenate([best(cost[:n], KEPT), n + best(cost[n:], KEPT // 2)])
    return boxes_of(theta[kept], signs[kept])
