"""Finalists: the best of each kind after the coarse descent, and the same with tops, lids and open rims."""

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import rays, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.candidates import Candidates, Counts, boxes_of, joined, spheres_of, vessels_of
from jaxfuzzy.rays import View
from jaxfuzzy.screening import KEPT, SCREEN, absurd, best, price

FINAL, CORNERS = 2, 4


def finalists(
    coarse: Candidates, cost: Array, counts: Counts, few: View, window: starts.Windows, company: Array, lid: starts.Lid
) -> tuple[Candidates, Counts]:
    """A few candidates of every kind.

    Args:
        coarse: The candidates after the coarse descent: boxes of two upright faces before those with a top, cylinders before cones.
        cost: Their objectives.
        counts: How many of each family.
        few: The points.
        window: Fits in windows.
        company: Which points have company.
        lid: The level surface that holds most points.
    """
    planes, boxes, bodies, spheres = counts.slices()
    pick = lambda start, stop, count: start + best(cost[start:stop], count)
    corners = pick(boxes.start, boxes.start + KEPT, CORNERS)
    cylinders = pick(bodies.start, bodies.start + KEPT, FINAL)
    cones = pick(bodies.start + KEPT, bodies.stop, FINAL)
    height = few.point[0, 1][starts.first_of(company, starts.BOX_ANCHORS)]
    corner = coarse.take(corners)
    tops, signs = starts.box_tops(height, corner.theta, corner.detail)
    top = best(price(rays.meet_box(tops, signs, few), few), FINAL)
    plain = jnp.concatenate(
        [
            pick(planes.start, planes.stop, FINAL),
            corners[:FINAL],
            pick(boxes.start + KEPT, boxes.stop, 1),
            cylinders,
            cones,
            pick(spheres.start, spheres.stop, FINAL),
        ]
    )
    upright = coarse.take(plain)
    cut = np.cumsum((FINAL, FINAL + 1, 2 * FINAL))
    piece = lambda a, b: Candidates(*(c[a:b] for c in upright))
    ended, bowls = [], []
    if few.ray is not None:
        ended = [_ended(coarse.theta[cylinders[0]], coarse.theta[cones[0]], few, window, height, lid)]
        bowls = [_bowls(upright.theta[cut[2]], few, window, height)]
    groups = [
        piece(0, cut[1]),
        boxes_of(tops[top], signs[top]),
        piece(cut[1], cut[2]),
        *ended,
        piece(cut[2], None),
        *bowls,
    ]
    extra = lambda more: sum(len(m.theta) for m in more)
    return joined(groups), Counts(FINAL, 2 * FINAL + 1, 2 * FINAL + extra(ended), FINAL + extra(bowls))


def _ended(
    cylinder: Array, cone: Array, few: View, window: starts.Windows, height: Array, lid: starts.Lid
) -> Candidates:
    """The best lid and the best open rim for the best sides, and a cylinder and a cone under the best lid."""
    floor = height.min()
    one = jnp.ones(len(window.cones) - starts.ANCHORS, few.gain.dtype)
    # The cone and the cylinder that look best from within.
    within = jnp.concatenate([window.cones[starts.ANCHORS :], window.cylinders[starts.ANCHORS :]]).at[:, 4].set(floor)
    both = jnp.tile(one, 2)
    looked = vessels_of(within, both * rays.OPEN, both * height.max(), both)
    cost = price(rays.meet_revolution(within, looked.detail, few), few) + absurd(within[:, 2])
    inner = [within[jnp.argmin(cost[: len(one)])], within[len(one) + jnp.argmin(cost[len(one) :])]]
    sides = jnp.stack([cylinder, cone, *inner])
    steep = jnp.array([0.0, 1.0, 1.0, 0.0], few.gain.dtype)

    # Each side with its rim at each height, open and, those seen from without, with a lid.
    each = np.array([0, 1, 2, 3, 0, 1])
    ends = jnp.array([rays.OPEN] * len(sides) + [rays.CLOSED] * 2, few.gain.dtype)
    side, ends, slope = (jnp.repeat(a, len(height), axis=0) for a in (sides[each], ends, steep[each]))
    tried = jnp.tile(height, len(each))
    many = side.at[:, 4].set(jnp.where(ends == rays.CLOSED, tried, floor))
    rimmed = vessels_of(many, ends, tried, slope)

    # The lid that was found, with bodies of a grid below it.
    theta = starts.lid_bodies(few, jnp.stack([window.cylinders[-1], window.cones[-1]]), lid)
    straight = theta[:, 3] == 0
    lidded = vessels_of(theta, rays.CLOSED * jnp.ones_like(theta[:, 4]), theta[:, 4], ~straight)

    every, n = joined([rimmed, lidded]), len(many)
    threshold = jnp.where(jnp.arange(len(every.theta)) < n, SCREEN, 2 * SCREEN)[:, None]
    cost = price(rays.meet_revolution(every.theta, every.detail, few), few, threshold)
    rim = jnp.argmin(cost[:n].reshape(-1, len(height)), -1) + jnp.arange(n // len(height)) * len(height)
    below = cost[n:] + absurd(theta[:, 2])
    pair = jnp.stack([jnp.argmin(jnp.where(kept, below, jnp.inf)) for kept in (straight, ~straight)])
    return every.take(jnp.concatenate([rim, n + pair]))


def _bowls(sphere: Array, few: View, window: starts.Windows, height: Array) -> Candidates:
    """The best rim for the best sphere and for the one that looks best from within."""
    within = window.spheres[starts.ANCHORS :]
    looked = spheres_of(within, jnp.full(len(within), height.max()))
    cost = price(rays.meet_sphere(within, looked.detail, few), few) + absurd(within[:, 3])
    both = jnp.stack([sphere, within[jnp.argmin(cost)]])
    rimmed = spheres_of(jnp.repeat(both, len(height), axis=0), jnp.tile(height, 2))
    cost = price(rays.meet_sphere(rimmed.theta, rimmed.detail, few), few).reshape(2, -1)
    return rimmed.take(jnp.argmin(cost, -1) + jnp.arange(2) * len(height))
