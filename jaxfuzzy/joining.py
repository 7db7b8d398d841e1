"""Which groups are parts of one body: pairs of neighbours, or halves behind something, that one surface holds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfuzzy.arrays import lengths
from jaxfuzzy.primitives import Cone, Cylinder, Primitive, Sphere
from jaxfuzzy.shapes import FAMILIES, Shape
from jaxfuzzy.status import Status
from jaxfuzzy.trials import FEWEST, Fit, held_by, lies, named_sets, some_of

# Only neighbours are tried together: centers nearer than this share of the sum of their reaches, or than the second one where
# something hides most of so many stops on the way between them that are on neither; and so many pairs at most.
NEAR, FAR, STOPS, MOST_PAIRS = 1.0, 4.0, 12, 16
# The middle of a part of a round body is within so many radii of its axis.
REACHES = 1.5
# For that a fair share of all points is looked at: so many, and less than twice as many.
LOOKED_AT = 12_000
# Of what a part's own surface holds, the joint one must hold this share; of a part without a surface, this share of its points.
HOLDS, HOLDS_OF_ALL = 0.9, 0.7


def parts_of_one_body(
    points: np.ndarray,
    flat: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    fit: Fit,
    camera: np.ndarray | None,
    up: np.ndarray,
) -> dict[tuple[int, int], tuple[np.ndarray, Shape]]:
    """Pairs of groups that one surface holds, and that surface; each group is in one pair at most."""
    able = [k for k, own in enumerate(members) if len(own) >= FEWEST and not _hopeless(shapes[k])]
    middle = {k: np.median(flat[members[k]], axis=0) for k in able}
    reach = {k: np.quantile(lengths(flat[members[k]] - middle[k]), 0.9) for k in able}
    apart = {
        (a, b): np.linalg.norm(middle[a] - middle[b]) / max(reach[a] + reach[b], 1e-12)
        for a in able
        for b in able
        if a < b
    }
    view = None if camera is None or len(members) < 3 else _seen_from(camera, points, members)
    centers = {k: np.median(points[members[k]], axis=0) for k in able}
    able_pairs = (
        (a, b)
        for (a, b), away in apart.items()
        if away < FAR
        and (_reaches(shapes[a].primitive, centers[b]) or _reaches(shapes[b].primitive, centers[a]))
        and (away < NEAR or (view is not None and _way_hidden(view, (a, b))))
    )
    pairs = sorted(able_pairs, key=apart.__getitem__)[:MOST_PAIRS]
    # Stable sorting takes advantage of each being in order already.
    both = [np.sort(np.concatenate([members[a], members[b]]), kind="stable") for a, b in pairs]
    good: list[tuple[float, tuple[int, int], np.ndarray]] = []
    some = [some_of(own) for own in both]
    # The parts of what lies lie too.
    lying = [any(lies(shapes[k].primitive, up) for k in pair) for pair in pairs]
    for (a, b), of, own, shape in zip(pairs, some, both, fit(some, both, lying) if both else (), strict=True):
        families = {FAMILIES.get(shapes[k].kind) for k in (a, b)}
        # Two parts that are flat are no part of a cone.
        if shape.primitive is None or (len(families) == 1 and not families <= {None, FAMILIES.get(shape.kind)}):
            continue
        held = of[np.asarray(shape.inliers)]
        shares = []
        for k in (a, b):
            part = np.isin(held, members[k]).sum() * len(own) / len(of)
            alone = held_by(shapes[k])
            shares.append(part / (HOLDS * alone if alone else HOLDS_OF_ALL * len(members[k])))
        if min(shares) >= 1:
            good.append((min(shares), (a, b), own))
    chosen: dict[tuple[int, int], np.ndarray] = {}
    for _, pair, own in sorted(good, key=lambda g: -g[0]):
        if not {i for p in chosen for i in p} & set(pair):
            chosen[pair] = own
    return named_sets(chosen, fit)


def _hopeless(shape: Shape) -> bool:
    """Whether even the surface that fits a group best does not, so that none that fits more than it can."""
    status = int(shape.status)
    other = Status.TOO_FEW_POINTS | Status.DEGENERATE | Status.SEEN_THROUGH
    return shape.primitive is None and bool(status & Status.REFUSED) and not status & other


def _reaches(body: Primitive | None, place: np.ndarray) -> bool:
    """Whether a place may be on the same body: what is round holds within its radius whatever else is part of it."""
    if isinstance(body, Sphere):
        return float(np.linalg.norm(place - np.asarray(body.center))) <= REACHES * float(body.radius)
    if isinstance(body, Cylinder | Cone):
        offset, axis = place - np.asarray(body.base if isinstance(body, Cylinder) else body.apex), np.asarray(body.axis)
        along = float(offset @ axis)
        if isinstance(body, Cone):
            radius = max(float(np.asarray(body.height)[1]), abs(along)) * float(np.tan(float(body.half_angle)))
        else:
            radius = float(body.radius)
        return float(np.linalg.norm(offset - along * axis)) <= REACHES * radius
    return True


class View(NamedTuple):
    """Groups as the camera sees them.

    Attributes:
        middle: Of each group, from the camera (K, 3).
        ray: Directions of a fair share of all points (n, 3).
        depth: Their distances (n,).
        group: Their groups (n,).
    """

    middle: np.ndarray
    ray: np.ndarray
    depth: np.ndarray
    group: np.ndarray


def _seen_from(camera: np.ndarray, points: np.ndarray, members: Sequence[np.ndarray]) -> View:
    step = max(1, sum(map(len, members)) // LOOKED_AT)
    some = [own[::step] for own in members]
    offset = [points[own] - camera for own in some]
    every = np.concatenate(offset)
    depth = lengths(every)
    return View(
        np.stack([np.median(o, axis=0) if len(o) else np.zeros(3) for o in offset]),
        every / np.maximum(depth, 1e-12)[:, None],
        depth,
        np.repeat(np.arange(len(some)), [len(own) for own in some]),
    )


def _way_hidden(view: View, pair: tuple[int, int]) -> bool:
    """Whether other groups stand before most of the way from one group to another, where it leads mostly over neither."""
    one, other = view.middle[list(pair)]
    here, there = one / np.linalg.norm(one), other / np.linalg.norm(other)
    way = there - here
    length = float(way @ way)
    if length == 0:
        return False
    along = (view.ray - here) @ way / length
    aside = ((view.ray - here - along[:, None] * way) ** 2).sum(axis=1)
    on = np.flatnonzero((along >= 0) & (along < 1) & (aside < length / STOPS**2))
    stop, own = (along[on] * STOPS).astype(int), np.isin(view.group[on], pair)
    before = view.depth[on] < (1 - along[on]) * np.linalg.norm(one) + along[on] * np.linalg.norm(other)
    theirs, ahead, behind = (np.bincount(stop[of], minlength=STOPS) for of in (own, ~own & before, ~own & ~before))
    gap, hidden = theirs <= ahead + behind, ahead > np.maximum(theirs, behind)
    return bool(hidden.sum() > 0.5 * gap.sum())
