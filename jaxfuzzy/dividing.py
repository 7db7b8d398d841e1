"""Which groups are several bodies: two surfaces that hold much more of one, and what a surface leaves over."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import on_host
from jaxfuzzy.fcm import fcm
from jaxfuzzy.fitting import distances
from jaxfuzzy.looks import ROUND, side_by_side
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status
from jaxfuzzy.trials import Fit, contained, held_by, lies, named_sets, refused, some_of

# Labels by places of the points with these indices.
Parted = Callable[[np.ndarray], np.ndarray]
# Pieces, as indices, of the points with these indices, between which the depth steps by more than so much a pixel.
Stepped = Callable[[np.ndarray, float], list[np.ndarray]]

# A group of which one surface holds this share is one object. Two surfaces must hold this share of the others, and this much
# more than one does; a part that a surface leaves over is an object where its own holds the second share.
WHOLE, EXPLAINED, GAINED = 0.8, 0.7, 0.15
# Two flat strips hold much of anything round: of a cone behind another one they held 0.84 where it held 0.67.
GAINED_FLAT = 0.25
# A part with a smaller share of its group, or of what the surface of that holds, is no object.
SMALLEST = 0.1
# A surface that holds less than the first share of its group is that of a part of it: what it leaves over is something else. Parts
# with so large a share of what the surface holds are then objects, whatever they are.
MIXED, LARGE = 0.6, 0.2
# A group is cut by so many of its places, with repetition where it has fewer, so that one program serves all.
PLACES = 1024


def cut_in_two(
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
        if k not in taken and len(own) >= 2 * fewest and held_by(shape) < WHOLE * len(own)
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
        least = {k: max(EXPLAINED * len(members[k]), held_by(shapes[k]) + GAINED * len(members[k])) for k in able}
        lying = {cut: lies(shapes[cut[0]].primitive, up) for cut in pieces}
        for ((k, way), two), both in zip(pieces.items(), _of_pieces(pieces, least, lying, fit), strict=True):
            count = sum(held_by(shape) / len(of) * len(piece) for piece, (of, shape) in zip(two, both, strict=True))
            named = [(shape, shape.primitive) for _, shape in both if shape.primitive is not None]
            if len(named) == 2:
                inner = contained(points, [of for of, _ in both], [shape for _, shape in both])
                flat_ones = all(shape.kind == "plane" for shape, _ in named) and shapes[k].kind in ROUND
                enough = max(least[k], held_by(shapes[k]) + GAINED_FLAT * len(members[k]) if flat_ones else 0.0)
                if not inner and count >= max(enough, good[k][0] if k in good else 0.0):
                    good[k] = count, two
                away = [distances(primitive, points[members[k]]) for _, primitive in named]
                near = np.minimum(*away) <= max(float(shape.noise_distance) for shape, _ in named)
                cuts[k, way] = np.where(near, np.argmin(away, axis=0), cuts[k, way])
            else:
                del cuts[k, way]
        cuts = {cut: side for cut, side in cuts.items() if cut in pieces}
    whole = named_sets({(k, i): piece for k, (_, two) in good.items() for i, piece in enumerate(two)}, fit)
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
    some = [some_of(piece) for piece in sets]
    found = list(fit(some, sets, [may for may in lying.values() for _ in (0, 1)])) if sets else []
    again = []
    for i, (k, _) in enumerate(pieces):
        for one, other in ((2 * i, 2 * i + 1), (2 * i + 1, 2 * i)):
            held = held_by(found[other]) / len(some[other]) * len(sets[other])
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


def left_over(
    members: Sequence[np.ndarray], shapes: Sequence[Shape], taken: set[int], parted: Parted, fewest: int
) -> dict[int, list[np.ndarray]]:
    """Of groups of which a surface leaves much over, the parts of what it leaves."""
    rests = {}
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        rest = own[~np.asarray(shape.inliers)]
        if k not in taken and shape.primitive is not None and len(rest) >= max(fewest, (1 - WHOLE) * len(own)):
            rests[k] = rest

    def parts_of(rest: np.ndarray) -> list[np.ndarray]:
        try:
            labels = parted(rest)
        except checks.DataError:  # too scattered: there is no part of it
            return []
        return [rest[labels == i] for i in range(labels.max(initial=-1) + 1)]

    return dict(zip(rests, side_by_side(parts_of, rests.values()), strict=True))


def with_left_over(
    points: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    parts: dict[int, list[np.ndarray]],
    fit: Fit,
    fewest: int,
    nameless: bool = False,
) -> dict[int, list[tuple[np.ndarray, Shape]]]:
    """Groups of which a surface holds a part and others hold parts of what it leaves over: what stays with it, and these.

    Where a surface holds less than `MIXED` of a group, large parts that no surface holds are taken as well; where there are no
    others, `nameless` says whether.
    """
    held = {k: held_by(shapes[k]) for k in parts}
    mixed = {k for k in parts if shapes[k].primitive is not None and held[k] < MIXED * len(members[k])}
    if nameless:  # parts with a name were asked for before
        parts = {k: of for k, of in parts.items() if k in mixed}
    # Parts are small beside what the surface holds: a group of which it holds little may be a heap of objects.
    beside = {k: held[k] or len(members[k]) for k in parts}
    left = [(k, piece) for k, of in parts.items() for piece in of if len(piece) >= max(fewest, SMALLEST * beside[k])]
    named: dict[int, list[tuple[np.ndarray, Shape]]] = {}
    large: dict[int, list[tuple[np.ndarray, Shape]]] = {}
    for (k, piece), shape in zip(left, fit([piece for _, piece in left]) if left else (), strict=True):
        whole = shape.primitive is not None and held_by(shape) >= EXPLAINED * len(piece)
        if not whole:
            if k not in mixed or len(piece) < LARGE * beside[k]:
                continue
            if shape.primitive is not None:
                shape = refused(shape, Status(0), "it holds too little of what another surface leaves over")
        if not contained(points, [members[k], piece], [shapes[k], shape]):
            (named if whole else large).setdefault(k, []).append((piece, shape))
    others = {k: named.get(k, []) + large.get(k, []) for k in parts if k in named or (nameless and k in large)}
    stay = {k: np.setdiff1d(members[k], np.concatenate([piece for piece, _ in of])) for k, of in others.items()}
    anew = fit(list(stay.values())) if stay else ()
    found = {}
    for (k, own), shape in zip(stay.items(), anew, strict=True):
        if shape.primitive is None:  # what was named with the parts stays so without them
            inliers = np.asarray(shapes[k].inliers)[np.isin(members[k], own)]
            shape = dataclasses.replace(shapes[k], inliers=on_host(inliers))
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
