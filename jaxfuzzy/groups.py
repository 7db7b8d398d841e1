"""From groups to objects, by their shapes: parts of one body merged, bodies that touch told apart.

Places alone cannot tell: the inner wall of a vessel stands apart from the outer one, an occluder cuts a body in two, and
bodies that touch are one group. Two bodies cannot fill the same space, so what lies inside a round body is part of it, its inner
wall or floor. For the rest a joint fit tells: where one surface holds nearly as many points of two groups as a surface each
does, it needs half the parameters and they are one object; where two surfaces hold clearly more points of a group than one, they
are two. And what the surface of a group leaves over is looked at by places once more: a part of it that a surface of its own holds
is an object beside the first.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import lengths
from jaxfuzzy.fcm import fcm
from jaxfuzzy.fitting import distances
from jaxfuzzy.primitives import Box, Cone, Cylinder, Primitive, Sphere
from jaxfuzzy.segment import Segmentation
from jaxfuzzy.shapes import FAMILIES, Shape
from jaxfuzzy.status import Status

K = TypeVar("K")
# Fits shapes to sets of points given by their indices; of shares of larger sets it is told these too, and which sets may be lying.
Fit = Callable[..., tuple[Shape, ...]]
# Labels by places of the points with these indices.
Parted = Callable[[np.ndarray], np.ndarray]

# Of a group that is part of a round body, this share lies inside it, or outside by so many noise distances; so does this share
# of the body's own group, of which the second share at least must lie on its surface.
INSIDE, SURFACE, SLACK = 0.7, 0.4, 2.0
# So many of its points, and less than twice as many, say whether it does.
ASKED = 2048
# Only neighbours are tried together: centers nearer than this share of the sum of their reaches, or than the second one where
# something hides most of so many stops on the way between them that are on neither; and so many pairs at most.
NEAR, FAR, STOPS, MOST_PAIRS = 1.0, 4.0, 12, 16
# The middle of a part of a round body is within so many radii of its axis; cosine from which on an axis is upright.
REACHES, UPRIGHT = 1.5, 0.95
# For that a fair share of all points is looked at: so many, and less than twice as many.
LOOKED_AT = 12_000
# Of what a part's own surface holds, the joint one must hold this share; of a part without a surface, this share of its points.
HOLDS, HOLDS_OF_ALL = 0.9, 0.7
# A group of which one surface holds this share is one object. Two surfaces must hold this share of the others, and this much
# more than one does.
WHOLE, EXPLAINED, GAINED = 0.8, 0.7, 0.15
# A part with fewer points is no object, nor one with a smaller share of its group.
FEWEST, SMALLEST = 60, 0.1
# What is only tried is fitted to a fair share of its points: so many, and less than twice as many.
TRIED = 8192
# A group is cut by so many of its places, with repetition where it has fewer, so that one program serves all.
PLACES = 1024


def by_shapes(
    points: np.ndarray,
    across: np.ndarray,
    parts: Segmentation,
    shapes: tuple[Shape, ...],
    fit: Fit,
    parted: Parted,
    camera: np.ndarray | None = None,
    least: int = FEWEST,
) -> tuple[Segmentation, tuple[Shape, ...]]:
    """Merges and divides groups where their shapes say so.

    Args:
        points: Points (N, 3).
        across: The two directions (2, 3) of the plane objects stand on.
        parts: Their division by places.
        shapes: The shape of each group.
        fit: Fits shapes to sets of points given by their indices.
        parted: Divides points given by their indices by places: labels 0, 1, ..., -1 for none.
        camera: Where the points were seen from (3,).
        least: Points below which no part of a group is an object.

    Returns:
        The division and the shapes that came of it; the same records where nothing changed.
    """
    parts, shapes, gathered = _gathered(points, parts, shapes, fit)
    members = members_of(parts)
    flat = points @ across.T
    up = np.cross(*across)
    joined = _joined(points, flat, members, shapes, fit, camera, up)
    taken = gathered.union(*joined)
    divided = _divided(points, flat, up, members, shapes, taken, fit, least)
    divided |= _peeled(points, members, shapes, taken.union(divided), fit, parted, least)
    if not joined and not divided:
        return parts, shapes
    groups: list[tuple[np.ndarray, Shape, int]] = []
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        if k in divided:
            groups += [(piece, other, k) for piece, other in divided[k]]
        elif not any(k == b for _, b in joined):
            pair = next((pair for pair in joined if k == pair[0]), None)
            groups.append((own, shape, k) if pair is None else (*joined[pair], k))
    into = {b: a for a, b in joined}
    return _rebuilt(points, parts, groups, into), tuple(shape for _, shape, _ in groups)


def members_of(parts: Segmentation) -> list[np.ndarray]:
    """Indices of the points of each group."""
    labels = np.asarray(parts.labels)
    return [np.flatnonzero(labels == k) for k in range(parts.k)]


def _gathered(
    points: np.ndarray, parts: Segmentation, shapes: tuple[Shape, ...], fit: Fit
) -> tuple[Segmentation, tuple[Shape, ...], set[int]]:
    """Merges groups into the round body that they lie inside: the new division, its shapes, and which of them are merged ones."""
    members = members_of(parts)
    into = _contained(points, members, shapes)
    if not into:
        return parts, shapes, set()
    whole = {
        a: np.sort(np.concatenate([members[a], *(members[b] for b in into if into[b] == a)])) for a in into.values()
    }
    groups: list[tuple[np.ndarray, Shape, int]] = []
    anew = dict(zip(whole, fit(list(whole.values())), strict=True))
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        if k in whole:
            # The outside names the body, unless a surface sought on the whole holds more of the outside too.
            outside = _extended(points, whole[k], own, shape)
            joint = anew[k]
            on_own = np.isin(whole[k][np.asarray(joint.inliers)], own).sum()
            better = on_own > _held(shape) or (joint.kind == shape.kind and _held(joint) > _held(outside))
            groups.append((whole[k], joint if better else outside, k))
        elif k not in into:
            groups.append((own, shape, k))
    merged = {i for i, (_, _, k) in enumerate(groups) if k in whole}
    return _rebuilt(points, parts, groups, into), tuple(shape for _, shape, _ in groups), merged


def _contained(points: np.ndarray, members: Sequence[np.ndarray], shapes: Sequence[Shape]) -> dict[int, int]:
    """Which groups lie inside the round body of another, and of which."""
    into: dict[int, int] = {}
    some = [points[_some(own, ASKED)] for own in members]
    # Of two that lie inside each other the one whose surface holds more points is the body.
    for a in sorted(range(len(members)), key=lambda k: -_held(shapes[k])):
        if a in into or _held(shapes[a]) < SURFACE * len(members[a]):
            continue
        slack = SLACK * float(shapes[a].noise_distance)
        inside = [len(own) > 0 and _inside(shapes[a].primitive, own, slack).mean() >= INSIDE for own in some]
        for b in range(len(members)):
            # A group that holds others is no part itself.
            if inside[a] and inside[b] and b != a and b not in into and b not in into.values():
                into[b] = a
    return into


def _inside(body: Primitive | None, points: np.ndarray, slack: float) -> np.ndarray:
    """Which points lie inside a round body, or outside by no more than the slack."""
    if isinstance(body, Sphere):
        return np.asarray(lengths(points - np.asarray(body.center)) <= float(body.radius) + slack)
    if isinstance(body, Cylinder):
        start, low, high, radius, slope = body.base, 0.0, float(body.height), float(body.radius), 0.0
    elif isinstance(body, Cone):
        (low, high), slope = np.asarray(body.height, float), float(np.tan(float(body.half_angle)))
        start, radius = body.apex, 0.0
    else:
        return np.zeros(len(points), bool)
    offset, axis = points - np.asarray(start), np.asarray(body.axis)
    along = offset @ axis
    across = lengths(offset - along[:, None] * axis)
    within = (along >= low - slack) & (along <= high + slack)
    return np.asarray(within & (across <= radius + slope * along + slack))


def _held(shape: Shape) -> float:
    return float(np.asarray(shape.inliers).sum())


def _joined(
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
        if (away < NEAR or (away < FAR and view is not None and _way_hidden(view, (a, b))))
        and (_reaches(shapes[a].primitive, centers[b]) or _reaches(shapes[b].primitive, centers[a]))
    )
    pairs = sorted(able_pairs, key=apart.__getitem__)[:MOST_PAIRS]
    # Stable sorting takes advantage of each being in order already.
    both = [np.sort(np.concatenate([members[a], members[b]]), kind="stable") for a, b in pairs]
    good: list[tuple[float, tuple[int, int], np.ndarray]] = []
    some = [_some(own) for own in both]
    # The parts of what lies lie too.
    lying = [any(_lies(shapes[k].primitive, up) for k in pair) for pair in pairs]
    for (a, b), of, own, shape in zip(pairs, some, both, fit(some, both, lying) if both else (), strict=True):
        families = {FAMILIES.get(shapes[k].kind) for k in (a, b)}
        # Two parts that are flat are no part of a cone.
        if shape.primitive is None or (len(families) == 1 and not families <= {None, FAMILIES.get(shape.kind)}):
            continue
        held = of[np.asarray(shape.inliers)]
        shares = []
        for k in (a, b):
            part = np.isin(held, members[k]).sum() * len(own) / len(of)
            alone = _held(shapes[k])
            shares.append(part / (HOLDS * alone if alone else HOLDS_OF_ALL * len(members[k])))
        if min(shares) >= 1:
            good.append((min(shares), (a, b), own))
    chosen: dict[tuple[int, int], np.ndarray] = {}
    for _, pair, own in sorted(good, key=lambda g: -g[0]):
        if not {i for p in chosen for i in p} & set(pair):
            chosen[pair] = own
    return _named(chosen, fit)


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
        start = np.asarray(body.base if isinstance(body, Cylinder) else body.apex)
        offset, axis = place - start, np.asarray(body.axis)
        along = offset @ axis
        widest = (
            float(body.height[1]) * np.tan(float(body.half_angle)) if isinstance(body, Cone) else float(body.radius)
        )
        radius = max(widest, abs(along) * np.tan(float(body.half_angle))) if isinstance(body, Cone) else widest
        return float(np.linalg.norm(offset - along * axis)) <= REACHES * radius
    return True


def _lies(body: Primitive | None, up: np.ndarray) -> bool:
    """Whether no axis of a body is upright."""
    if isinstance(body, Box):
        return bool(np.abs(np.asarray(body.axes) @ up).max() < UPRIGHT)
    return isinstance(body, Cylinder | Cone) and abs(float(np.asarray(body.axis) @ up)) < UPRIGHT


def _some(own: np.ndarray, count: int = TRIED) -> np.ndarray:
    """A fair share of the points of a set: so many, and less than twice as many."""
    return own[:: max(1, len(own) // count)]


def _named(sets: dict[K, np.ndarray], fit: Fit) -> dict[K, tuple[np.ndarray, Shape]]:
    """The shapes of sets, of those that have one."""
    found = zip(sets.items(), fit(list(sets.values())) if sets else (), strict=True)
    return {key: (own, shape) for (key, own), shape in found if shape.primitive is not None}


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


def _extended(points: np.ndarray, every: np.ndarray, own: np.ndarray, shape: Shape) -> Shape:
    """The same shape with more points than it was fitted to: those count by their orthogonal distance."""
    inliers = np.zeros(len(every), bool)
    if shape.primitive is not None:
        inliers = distances(shape.primitive, points[every]) <= float(shape.noise_distance)
    inliers[np.isin(every, own)] = np.asarray(shape.inliers)
    return dataclasses.replace(shape, inliers=jax.device_put(inliers))


def _divided(
    points: np.ndarray,
    flat: np.ndarray,
    up: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    taken: set[int],
    fit: Fit,
    fewest: int,
) -> dict[int, list[tuple[np.ndarray, Shape]]]:
    """Groups that two surfaces hold much better than one, and these."""
    able = [
        k
        for k, (own, shape) in enumerate(zip(members, shapes, strict=True))
        if k not in taken and len(own) >= 2 * fewest and _held(shape) < WHOLE * len(own)
    ]
    # Places make the first cut, across the ground and in height; the two surfaces it gives the second. What is seen through is not
    # cut in height: parts of a ring lie on surfaces as well as the whole does, and are seen through no more.
    height = (points @ up)[:, None]
    ways = {k: (flat,) if int(shapes[k].status) & Status.SEEN_THROUGH else (flat, height) for k in able}
    cuts = {(k, way): _side(of[members[k]]) for k in able for way, of in enumerate(ways[k])}
    good: dict[int, tuple[float, list[np.ndarray]]] = {}
    for _ in range(2):
        pieces = {cut: [members[cut[0]][side == i] for i in (0, 1)] for cut, side in cuts.items()}
        pieces = {
            c: two for c, two in pieces.items() if min(map(len, two)) >= max(fewest, SMALLEST * sum(map(len, two)))
        }
        least = {k: max(EXPLAINED * len(members[k]), _held(shapes[k]) + GAINED * len(members[k])) for k in able}
        lying = {cut: _lies(shapes[cut[0]].primitive, up) for cut in pieces}
        for ((k, way), two), both in zip(pieces.items(), _of_pieces(pieces, least, lying, fit), strict=True):
            count = sum(_held(shape) / len(of) * len(piece) for piece, (of, shape) in zip(two, both, strict=True))
            named = [(shape, shape.primitive) for _, shape in both if shape.primitive is not None]
            inner = _contained(points, [of for of, _ in both], [shape for _, shape in both])
            if len(named) == 2 and not inner and count >= max(least[k], good[k][0] if k in good else 0.0):
                good[k] = count, two
            if len(named) == 2:
                away = [distances(primitive, points[members[k]]) for _, primitive in named]
                near = np.minimum(*away) <= max(float(shape.noise_distance) for shape, _ in named)
                cuts[k, way] = np.where(near, np.argmin(away, axis=0), cuts[k, way])
            else:
                del cuts[k, way]
        cuts = {cut: side for cut, side in cuts.items() if cut in pieces}
    whole = _named({(k, i): piece for k, (_, two) in good.items() for i, piece in enumerate(two)}, fit)
    return {k: [whole[k, 0], whole[k, 1]] for k in good if (k, 0) in whole and (k, 1) in whole}


def _of_pieces(
    pieces: dict[tuple[int, int], list[np.ndarray]],
    least: dict[int, float],
    lying: dict[tuple[int, int], bool],
    fit: Fit,
) -> list[list[tuple[np.ndarray, Shape]]]:
    """For each cut the shapes of its two pieces, and which share of their points these were fitted to.

    One that has none upright is looked at once more where the other has one and both together may then hold enough.
    """
    sets = [piece for two in pieces.values() for piece in two]
    some = [_some(piece) for piece in sets]
    found = list(fit(some, sets, [may for may in lying.values() for _ in (0, 1)])) if sets else []
    again = []
    for i, (k, _) in enumerate(pieces):
        for one, other in ((2 * i, 2 * i + 1), (2 * i + 1, 2 * i)):
            held = _held(found[other]) / len(some[other]) * len(sets[other])
            if (
                found[one].primitive is None
                and found[other].primitive is not None
                and held + len(sets[one]) >= least[k]
            ):
                again.append(one)
    more = fit([some[i] for i in again], [sets[i] for i in again], [True] * len(again)) if again else ()
    for i, shape in zip(again, more, strict=True):
        found[i] = shape
    each = list(zip(some, found, strict=True))
    return [each[i : i + 2] for i in range(0, len(each), 2)]


def _peeled(
    points: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    taken: set[int],
    fit: Fit,
    parted: Parted,
    fewest: int,
) -> dict[int, list[tuple[np.ndarray, Shape]]]:
    """Groups of which a surface holds a part and others hold parts of what it leaves over: what stays with it, and these."""
    left: list[tuple[int, np.ndarray]] = []
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        rest, least = own[~np.asarray(shape.inliers)], max(fewest, SMALLEST * len(own))
        if k not in taken and shape.primitive is not None and len(rest) >= max(least, (1 - WHOLE) * len(own)):
            try:
                labels = parted(rest)
            except checks.DataError:  # too scattered: there is no part of it
                continue
            pieces = [rest[labels == i] for i in range(labels.max(initial=-1) + 1)]
            left += [(k, piece) for piece in pieces if len(piece) >= least]
    others: dict[int, list[tuple[np.ndarray, Shape]]] = {}
    for (k, piece), shape in zip(left, fit([piece for _, piece in left]) if left else (), strict=True):
        whole = shape.primitive is not None and _held(shape) >= WHOLE * len(piece)
        if whole and not _contained(points, [members[k], piece], [shapes[k], shape]):
            others.setdefault(k, []).append((piece, shape))
    stay = {k: np.setdiff1d(members[k], np.concatenate([piece for piece, _ in of])) for k, of in others.items()}
    anew = fit(list(stay.values())) if stay else ()
    found = {}
    for (k, own), shape in zip(stay.items(), anew, strict=True):
        if shape.primitive is None:  # what was named with the parts stays so without them
            inliers = np.asarray(shapes[k].inliers)[np.isin(members[k], own)]
            shape = dataclasses.replace(shapes[k], inliers=jax.device_put(inliers))
        found[k] = [(own, shape), *others[k]]
    return found


def _side(flat: np.ndarray) -> np.ndarray:
    """Which of two fuzzy clusters each place is in."""
    some = flat[np.linspace(0, len(flat) - 1, PLACES).astype(int)]
    middle = some.mean(axis=0)
    long = np.linalg.eigh(np.atleast_2d(np.cov(some.T)))[1][:, -1]
    reach = ((some - middle) @ long).std()
    centers = np.asarray(fcm(some - middle, np.stack([-reach * long, reach * long])).centers)
    away = np.linalg.norm((flat - middle)[:, None] - centers, axis=-1)
    return np.argmin(away, axis=1)


def _rebuilt(
    points: np.ndarray,
    parts: Segmentation,
    groups: Sequence[tuple[np.ndarray, Shape, int]],
    into: dict[int, int],
) -> Segmentation:
    """The division into the groups that came of it; memberships of merged ones add up, those of divided ones follow the labels."""
    u, sizes = np.asarray(parts.partition.memberships), np.asarray(parts.sizes)
    labels = np.full(len(points), -1, np.int32)
    for i, (own, _, _) in enumerate(groups):
        labels[own] = i
    # Columns are picked by a product, several times faster than by their indices; of those of one group the first is.
    came_from = [k for *_, k in groups]
    pick = np.zeros((u.shape[1], len(groups)), u.dtype)
    for i, k in enumerate(came_from):
        pick[k, i] = came_from.index(k) == i
    memberships, noise = u @ pick, np.array(parts.partition.noise)
    size, centers, spare = [], [], np.zeros(len(points) if into else 0, u.dtype)
    for i, (own, _, k) in enumerate(groups):
        sources = [k, *(b for b, a in into.items() if a == k)]
        if len(sources) > 1:
            # Memberships add up for the points of a merged group; what that would give others stays where they belong.
            most, total, mine = u[:, sources].max(axis=1), u[:, sources].sum(axis=1), labels == i
            memberships[:, i] = np.where(mine, total, most)
            spare += np.where(mine, 0, total - most)
        siblings = [j for j, other in enumerate(came_from) if other == k]
        share = len(own) / sum(len(groups[j][0]) for j in siblings)
        if i != siblings[0]:
            # What has no label of its own stays with the first.
            memberships[own, i], memberships[own, siblings[0]] = u[own, k], 0
        size.append(share * sizes[sources].sum())
        centers.append(points[own].mean(axis=0))
    if into:
        rows = np.flatnonzero(spare)
        own, loose = rows[labels[rows] >= 0], rows[labels[rows] < 0]
        memberships[own, labels[own]] += spare[own]
        noise[loose] += spare[loose]
    # Points that a cut left out belong to noise.
    lost = np.flatnonzero((labels < 0) & (np.asarray(parts.labels) >= 0))
    noise[lost] += memberships[lost].sum(axis=1)
    memberships[lost] = 0
    counts = np.array([len(own) for own, _, _ in groups], float)
    partition = dataclasses.replace(
        parts.partition,
        centers=jnp.asarray(np.stack(centers), parts.partition.centers.dtype),
        sizes=jnp.asarray(np.array(size) / np.sum(size), parts.sizes.dtype),
        memberships=jax.device_put(memberships),
        noise=jax.device_put(noise),
        labels=jax.device_put(labels),
    )
    return dataclasses.replace(
        parts,
        labels=partition.labels,
        k=len(groups),
        sizes=partition.sizes,
        shares=jnp.asarray(counts / counts.sum(), parts.shares.dtype),
        partition=partition,
    )
