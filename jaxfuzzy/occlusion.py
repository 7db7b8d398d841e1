"""Which ends of a shape were seen: an end is hidden where the view just beyond it is blocked by something nearer.

A shape ends where its points end. They may do so because the body does, and then what is seen just beyond lies farther away than
the body's surface would if it went on, or nothing does. Or something stands in the way, and the body is longer than it looks: its
size is a lower bound. An end that rests on the ground is seen whatever stands before it, and so is one whose face was seen.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfuzzy.arrays import lengths, nth_smallest, on_host, product
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

# Points within this share of an extent from its end are asked what is seen beyond; more where points are this sparse.
STRIP, SPACINGS = 0.1, 3.0
# So many of them at most, and at least; and so many tell how dense the points are.
MOST_ASKED, FEWEST_ASKED, SAMPLE = 128, 8, 32
# A view is blocked where so many points are nearer, within the reach of so many points of the sparser of the two: what is looked
# at and what stands before it. Outliers are so sparse only where they are as many as the points of the shape.
IN_FRONT, NEIGHBOURS = 4, 8
# Of the points of a shape, and of those of none, so many are looked at.
LOOKED_AT = 16_384
# Nearer means by more than so many noise distances.
CLEARLY = 2.0
# An end is hidden when more than this share of the views beyond it is blocked.
BLOCKED = 0.5


class Bundle(NamedTuple):
    """A bundle of rays: some points as the camera sees them.

    Attributes:
        ray: Their directions (n, 3).
        depth: Their distances (n,).
        reach: The reach of `NEIGHBOURS` of them in the view.
        middle: The middle of the view of them (3,).
        wide: How far from it they are seen.
    """

    ray: np.ndarray
    depth: np.ndarray
    reach: float
    middle: np.ndarray
    wide: float


class End(NamedTuple):
    """One end of an extent: which extent it belongs to, a point there, the direction out of the body, the extent's length."""

    extent: int
    place: np.ndarray
    outward: np.ndarray
    length: float


def with_hidden_ends(
    points: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    camera: np.ndarray,
    ground: Plane | None,
    thickness: float,
) -> tuple[Shape, ...]:
    """Tells for each shape whether its ends were seen: in `Box.seen` and, where one was not, by the status LOWER_BOUND.

    Args:
        points: The points (N, 3) of all objects, and outliers; not those of the ground.
        members: Indices of the points of each shape.
        shapes: The shapes.
        camera: Where the points were seen from (3,).
        ground: The plane they stand on.
        thickness: How far above it points were taken for its own.
    """
    on = [own[np.asarray(shape.inliers)] for own, shape in zip(members, shapes, strict=True)]
    rays = [_seen_from(camera, points, own) for own in on]
    bundles = [_bundle(ray, depth, _reach(ray)) for ray, depth in rays]
    rest = np.delete(np.arange(len(points)), np.concatenate([np.zeros(0, int), *on]))
    outliers = _bundle(*_seen_from(camera, points, rest), 0.0)
    told = []
    for k, shape in enumerate(shapes):
        # What belongs to no shape may be an occluder too, if it is as dense as what it hides.
        loose = outliers._replace(reach=bundles[k].reach)
        before = [*(s for i, s in enumerate(bundles) if i != k), loose]
        hidden = {
            end.extent
            for end in ends_of(shape.primitive)
            if not _rests(end, ground, thickness) and _hidden(end, shape, bundles[k], before, camera)
        }
        if hidden:
            body = shape.primitive
            if isinstance(body, Box):
                seen = np.array([i not in hidden for i in range(3)]) & np.asarray(body.seen)
                body = dataclasses.replace(body, seen=on_host(seen))
            status = on_host(int(shape.status) | Status.LOWER_BOUND, np.int32)
            shape = dataclasses.replace(shape, primitive=body, status=status)
        told.append(shape)
    return tuple(told)


def ends_of(body: Primitive | None) -> list[End]:
    """The ends of what a body extends over; a sphere and the tip of a cone have none, as they cannot go on."""
    match body:
        case Cylinder():
            base, axis, height = np.asarray(body.base), np.asarray(body.axis), float(body.height)
            return [End(0, base, -axis, height), End(0, base + height * axis, axis, height)]
        case Cone():
            apex, axis, (low, high) = np.asarray(body.apex), np.asarray(body.axis), np.asarray(body.height, float)
            wide = End(0, apex + high * axis, axis, high - low)
            return [wide, End(0, apex + low * axis, -axis, high - low)] if low > STRIP * high else [wide]
        case Box():
            center, size, axes = np.asarray(body.center), np.asarray(body.size, float), np.asarray(body.axes)
            return [
                End(i, center + side * size[i] / 2 * axes[i], side * axes[i], size[i])
                for i in range(3)
                for side in (-1, 1)
            ]
        case Plane():
            corners = np.asarray(body.corners)
            # Each edge with the next one, which leads away from it.
            leads = np.roll(corners, -1, axis=0) - corners
            long = np.linalg.norm(leads, axis=1)
            return [End(i % 2, corners[i], -leads[i] / max(long[i], 1e-12), float(long[i])) for i in range(4)]
    return []


def _rests(end: End, ground: Plane | None, thickness: float) -> bool:
    """Whether an end stands on the ground, where the body has its points taken away with those of the ground."""
    if ground is None:
        return False
    up = np.asarray(ground.normal)
    height = float((end.place - np.asarray(ground.point)) @ up)
    return bool(end.outward @ up < 0 and height < 2 * thickness + STRIP * end.length)


def _seen_from(camera: np.ndarray, points: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and distances of a fair share of some points."""
    offset = np.asarray(points[own[:: -(-len(own) // LOOKED_AT) or 1]] - camera, float)
    depth = lengths(offset)
    return offset / np.maximum(depth, 1e-12)[:, None], depth


def _bundle(ray: np.ndarray, depth: np.ndarray, reach: float) -> Bundle:
    middle = ray.mean(axis=0) if len(ray) else np.zeros(3)
    return Bundle(ray, depth, reach, middle, float(lengths(ray - middle).max(initial=0.0)))


def _reach(ray: np.ndarray) -> float:
    if len(ray) <= NEIGHBOURS:
        return 0.0
    some = ray[np.linspace(0, len(ray) - 1, min(len(ray), SAMPLE)).astype(int)]
    square = np.maximum(2 - 2 * product(some, ray.T), 0)
    return float(np.sqrt(np.median(nth_smallest(square, NEIGHBOURS))))


def _hidden(end: End, shape: Shape, own: Bundle, before: Sequence[Bundle], camera: np.ndarray) -> bool:
    if own.reach == 0:
        return False
    surface = own.ray * own.depth[:, None]
    # How far inside the end each point is.
    inside = (end.place - camera - surface) @ end.outward
    away = float(np.median(own.depth))
    width = max(STRIP * end.length, SPACINGS * own.reach * away / np.sqrt(NEIGHBOURS))
    asked = np.flatnonzero(inside < width)
    if len(asked) < FEWEST_ASKED:
        return False
    asked = asked[np.linspace(0, len(asked) - 1, min(len(asked), MOST_ASKED)).astype(int)]
    nearer = np.zeros(len(asked), int)
    for other in before:
        reach = max(own.reach, other.reach)
        # The surface as far beyond its end as half the strip is wide, or as the other's points tell where it ends.
        step = np.maximum(inside[asked], 0) + max(width / 2, 0.7 * reach * away)
        beyond = _moved(shape.primitive, surface[asked], end, step, camera)
        far = lengths(beyond)
        view = beyond / far[:, None]
        middle = view.mean(axis=0)
        middle = middle / np.linalg.norm(middle)
        wide = lengths(view - middle).max() + reach
        if np.linalg.norm(other.middle - middle) > other.wide + wide:
            continue
        near = 2 - 2 * other.ray @ middle < wide**2
        close = 2 - 2 * product(view, other.ray[near].T) < reach**2
        in_front = other.depth[near] < far[:, None] - CLEARLY * float(shape.noise_distance)
        nearer = np.maximum(nearer, (close & in_front).sum(axis=1))
    return bool((nearer >= IN_FRONT).mean() > BLOCKED)


def _moved(body: Primitive | None, own: np.ndarray, end: End, step: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Points of a surface, from the camera, moved on along it; on a cone along the line to its tip."""
    if isinstance(body, Cone):
        tip = np.asarray(body.apex) - camera
        along = (own - tip) @ end.outward
        return tip + (own - tip) * (1 + step / np.where(np.abs(along) > 1e-9, along, 1.0))[:, None]
    return own + step[:, None] * end.outward
