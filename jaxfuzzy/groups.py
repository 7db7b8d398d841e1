"""From groups to objects, by their shapes: parts of one body merged, bodies that touch told apart.

Places alone cannot tell: the inner wall of a vessel stands apart from the outer one, an occluder cuts a body in two, and
bodies that touch are one group. Two bodies cannot fill the same space, so what lies inside a round body is part of it, its inner
wall or floor. For the rest a joint fit tells: where one surface holds nearly as many points of two groups as a surface each
does, it needs half the parameters and they are one object; where two surfaces hold clearly more points of a group than one, they
are two. And what the surface of a group leaves over is looked at by places once more: a part of it that a surface of its own holds
is an object beside the first.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from jaxfuzzy.arrays import on_device, on_host, product
from jaxfuzzy.dividing import SMALLEST, Parted, Stepped, cut_in_two, left_over, with_left_over
from jaxfuzzy.fitting import distances
from jaxfuzzy.joining import parts_of_one_body
from jaxfuzzy.segment import Segmentation
from jaxfuzzy.shapes import Shape
from jaxfuzzy.trials import FEWEST, Fit, contained, held_by


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
    flat = product(points, across.T)
    up = np.cross(*across)
    joined = parts_of_one_body(points, flat, members, shapes, fit, camera, up)
    taken = gathered.union(*joined)
    rests = left_over(members, shapes, taken, parted, least)
    divided = with_left_over(points, members, shapes, rests, fit, least)
    divided |= cut_in_two(points, flat, up, members, shapes, taken.union(divided), fit, least)
    still = {k: rest for k, rest in rests.items() if k not in divided}
    divided |= with_left_over(points, members, shapes, still, fit, least, nameless=True)
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


def by_steps(
    points: np.ndarray,
    parts: Segmentation,
    shapes: tuple[Shape, ...],
    fit: Fit,
    stepped: Stepped,
    least: int,
) -> tuple[Segmentation, tuple[Shape, ...]]:
    """Divides groups that no surface holds where the depth steps: pieces that have a surface of their own are objects.

    Args:
        points: Points (N, 3).
        parts: Their division.
        shapes: The shape of each group.
        fit: Fits shapes to sets of points given by their indices.
        stepped: The pieces of points given by their indices between which the depth steps by more than a noise distance.
        least: Points below which no part of a group is an object.

    Returns:
        The division and the shapes that came of it; the same records where nothing changed.
    """
    members = members_of(parts)
    pieces = {
        k: [piece for piece in stepped(own, float(shape.noise_distance)) if len(piece) <= (1 - SMALLEST) * len(own)]
        for k, (own, shape) in enumerate(zip(members, shapes, strict=True))
        if shape.primitive is None and len(own) >= 2 * least
    }
    divided = with_left_over(points, members, shapes, pieces, fit, least)
    if not divided:
        return parts, shapes
    groups: list[tuple[np.ndarray, Shape, int]] = []
    for k, both in enumerate(zip(members, shapes, strict=True)):
        # A rest that is too small to be an object is none.
        of = [part for part in divided[k] if len(part[0]) >= least] if k in divided else [both]
        groups += [(own, shape, k) for own, shape in of]
    return _rebuilt(points, parts, groups, {}), tuple(shape for _, shape, _ in groups)


def members_of(parts: Segmentation) -> list[np.ndarray]:
    """Indices of the points of each group."""
    labels = np.asarray(parts.labels)
    return [np.flatnonzero(labels == k) for k in range(parts.k)]


def _gathered(
    points: np.ndarray, parts: Segmentation, shapes: tuple[Shape, ...], fit: Fit
) -> tuple[Segmentation, tuple[Shape, ...], set[int]]:
    """Merges groups into the round body that they lie inside: the new division, its shapes, and which of them are merged ones."""
    members = members_of(parts)
    into = contained(points, members, shapes)
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
            better = on_own > held_by(shape) or (joint.kind == shape.kind and held_by(joint) > held_by(outside))
            groups.append((whole[k], joint if better else outside, k))
        elif k not in into:
            groups.append((own, shape, k))
    merged = {i for i, (_, _, k) in enumerate(groups) if k in whole}
    return _rebuilt(points, parts, groups, into), tuple(shape for _, shape, _ in groups), merged


def _extended(points: np.ndarray, every: np.ndarray, own: np.ndarray, shape: Shape) -> Shape:
    """The same shape with more points than it was fitted to: those count by their orthogonal distance."""
    inliers = np.zeros(len(every), bool)
    if shape.primitive is not None:
        inliers = distances(shape.primitive, points[every]) <= float(shape.noise_distance)
    inliers[np.isin(every, own)] = np.asarray(shape.inliers)
    return dataclasses.replace(shape, inliers=on_host(inliers))


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
    memberships, noise = product(u, pick), np.array(parts.partition.noise)
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
        centers.append(np.array([along[own].mean() for along in points.T]))
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
        centers=on_device(np.stack(centers), parts.partition.centers.dtype),
        sizes=on_device(np.array(size) / np.sum(size), parts.sizes.dtype),
        memberships=jax.device_put(memberships),
        noise=jax.device_put(noise),
        labels=jax.device_put(labels),
    )
    return dataclasses.replace(
        parts,
        labels=partition.labels,
        k=len(groups),
        sizes=partition.sizes,
        shares=on_device(counts / counts.sum(), parts.shares.dtype),
        partition=partition,
    )
