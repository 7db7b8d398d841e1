"""Search: from starts of every kind to the surface that explains an object best.

Screen all starts by the noise-cluster objective on a few points, move the best of each kind by Gauss-Newton steps under
memberships of a falling noise distance (m = 2: weight u² = (1 + D/δ²)⁻²), add lids and tops to the best, finish those on more
points with the axis free to lean, and choose by likelihood.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import choice, local, starts
from jaxfuzzy.arrays import Array
from jaxfuzzy.candidates import Candidates, Counts, Seen, descend
from jaxfuzzy.finalists import finalists
from jaxfuzzy.rays import View, picked, taken, turned
from jaxfuzzy.screening import screened

FEW, MORE = 256, 512
PATCHES = 24
COARSE = tuple(np.geomspace(4.0, 2.5, 6))
FINE = tuple(np.geomspace(3.0, 2.5, 4))
# A noise scale beyond explains nothing better; its lower end keeps the mixture from settling on a few points.
SCALES = (0.35, 2.5)
# Deviation of a piece of surface over that of the points from which on its normal is not believed.
ROUGH = 2.5
# Of the spread of an object: below lies the rounding of single precision.
LEAST_DEVIATION = 2e-5


class Found(NamedTuple):
    """The best candidate of each kind, in the order of `KINDS`.

    Attributes:
        scores: Score of each kind, lower is better (5,).
        passed: Whether no guard speaks against its best candidate (5,).
        candidates: The best candidate of each kind.
        turn: Rotation into the frame of each, in which its axis is y (5, 3, 3).
        scale: Noise scale of each.
        background: Share of background of each.
        deviation: What the points' deviations were found to be, in units of 1 / gain; 1 where given.
        local: What small windows say of them, in units of those used.
        normals: Normals of small pieces of surface (W, 3), 0 where unusable.
    """

    scores: Array
    passed: Array
    candidates: Candidates
    turn: Array
    scale: Array
    background: Array
    deviation: Array
    local: Array
    normals: Array


def search(view: View, depth_range: Array, given: Array, gric: Array) -> Found:
    """Finds the best surface of each kind.

    Args:
        view: All points; where `given` is false, gains are right but for a common factor, which is found here.
        depth_range: Range of depth over which background is spread.
        given: Whether the deviation of the points is known.
        gric: Whether to score by GRIC in place of the likelihood.
    """
    more = taken(view, MORE)
    # Screened are points that have company, so that fewer outliers are among the few.
    among = starts.first_of(starts.dense(more), FEW)
    few = picked(more, among)
    company = starts.dense(few)
    anchors = few.point[0].T[starts.first_of(company, starts.ANCHORS)]
    patches = local.patches(more, anchors[:PATCHES])
    typical = jnp.maximum(local.typical_deviation(patches), LEAST_DEVIATION)
    deviation = jnp.where(given, 1.0, typical)
    few, more = (v._replace(gain=v.gain / deviation) for v in (few, more))
    # Pieces much rougher than the noise are none: among many outliers they would have any normal.
    sharp = patches.deviation < ROUGH * deviation
    turn = local.lean(more, patches, sharp)
    # From here to the finish in the frame in which the axis is about upright.
    few = turned(few, turn[None])
    lid = starts.lid(few, patches.normal @ turn.T, patches.middle @ turn.T, patches.usable, company)
    window = starts.windows(few, anchors @ turn.T, lid.below)
    coarse, counts = screened(few, window, company)
    coarse, _, cost, _ = descend(coarse, counts, None, few, COARSE, 0.5, False)
    fine, counts = finalists(coarse, cost, counts, few, window, company, lid)
    upright = jnp.broadcast_to(turn, (len(fine.theta), 3, 3))
    fine, turns, _, seen = descend(fine, counts, upright, more, FINE, 0.2, view.ray is not None)
    assert turns is not None
    return _choose(fine, turns, counts, seen, more, depth_range, gric)._replace(
        deviation=deviation,
        local=typical / deviation,
        normals=jnp.where(patches.usable[:, None], patches.normal, 0.0),
    )


def _choose(
    fine: Candidates,
    turns: Array,
    counts: Counts,
    seen: Seen,
    more: View,
    depth_range: Array,
    gric: Array,
) -> Found:
    mixed = choice.mixture(seen.square, seen.variance, more, depth_range, SCALES)
    count = more.mask.sum()
    planes, boxes, bodies, spheres = counts.slices()
    # The length of a plane's parameters means nothing.
    parameters = fine.free.sum(-1).at[planes].add(-1)
    likelihood = -mixed.log_likelihood + 0.5 * parameters * jnp.log(count)
    score = jnp.where(gric, choice.gric(seen.square, more.mask, parameters), likelihood)
    score = jnp.where(jnp.isfinite(score), score, 1e9).at[planes].add(-choice.PLANE_BONUS)
    # Free narrowing makes a body of revolution a cone.
    steep = fine.free[bodies, 3] > 0
    tapers = choice.cone_tapers(fine.theta[bodies], mixed.ownership[bodies], turns[bodies, 1] @ more.point[0])
    good = jnp.concatenate(
        [
            jnp.ones(counts.planes, bool),
            choice.faces_hold(
                fine.theta[boxes],
                fine.detail[boxes],
                seen.part[boxes],
                mixed.ownership[boxes],
                mixed.background[boxes],
                turned(more, turns[boxes]),
            ),
            choice.stout(fine.theta[bodies, 2]) & (tapers | ~steep),
            choice.stout(fine.theta[spheres, 3], choice.FLATTEST_BALL),
        ]
    )
    zeros = lambda n: jnp.zeros(n, int)
    kind = jnp.concatenate(
        [zeros(counts.planes), zeros(counts.boxes) + 1, jnp.where(steep, 3, 2), zeros(counts.spheres) + 4]
    )
    own = kind == jnp.arange(5)[:, None]
    # The best that passes, or where none does the best of those.
    best = jnp.argmin(jnp.where(own, score + jnp.where(good, 0.0, 1e12), jnp.inf), -1)
    return Found(
        scores=score[best],
        passed=good[best],
        candidates=fine.take(best),
        turn=turns[best],
        scale=mixed.scale[best],
        background=mixed.background[best],
        deviation=count,
        local=count,
        normals=turns[0],
    )
