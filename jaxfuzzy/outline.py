"""Whether a shape would hide what is seen: a body hides what stands behind it, so through one that is there nothing is seen.

A surface may hold an object's points and still be none: twigs lie near one plane, the front of a head on a blunt cone. Such a
surface goes on where the object does not, and there the camera looks through it at what stands behind. And nothing is seen from
within a body: the corner of a room is no cone. Every point of the cloud
whose viewing ray passes the surface within its ends has a say; what was not matched has none, and what stands before it neither.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxfuzzy.arrays import lengths
from jaxfuzzy.linalg import tangents
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Quadric
from jaxfuzzy.render import body_of
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status
from jaxfuzzy.trials import inside, refused

# A surface is refused when so large a share of the points that pass it lies behind. Right ones: at most 0.02 on rendered tables,
# 0.12 on depth-camera tables, 0.11 on photographs (an oval hat box as a cylinder), 0.21 on simulated tables of which 40 % are
# outliers. Rings, twigs and a lattice as planes, a beam as a cylinder and a mug as a blunt cone: 0.3 to 0.7.
THROUGH = 0.25
# Behind means by more than so many noise distances.
CLEARLY = 4.0
# A fair share of all points is looked at: so many, and less than twice as many; fewer on a surface than these say nothing.
LOOKED_AT, FEWEST = 32_768, 50
# A solid is looked at in so many slices across its axis with as many of its points each, and the worst ones do not count: pencils
# in a mug make the cylinder twice as high as it is, and of the right kind and radius all the same.
SLICES, WORST = 10, 2
# A face of a box that holds a smaller share of its points is not claimed.
FACE = 0.05
# Directions whose extents bound a flat patch; of the points' places along them and along an axis these quantiles count as ends.
DIRECTIONS, ENDS = 16, (0.01, 0.99)


class Sight(NamedTuple):
    """What the camera sees.

    Attributes:
        camera: Where it is (3,).
        up: The vertical (3,).
        which: The points looked at, by their places among all (n,).
        rays: Their directions (n, 3).
        depth: Their distances (n,).
        loose: Which of them belong to no object (n,).
        known: What was seen through shapes that were asked for, each beside its primitive and inliers, by whose places in memory
            and number of points it is found: later stages ask for the same ones again.
    """

    camera: np.ndarray
    up: np.ndarray
    which: slice
    rays: np.ndarray
    depth: np.ndarray
    loose: np.ndarray
    known: dict[tuple[int, int, int], tuple[Primitive, Any, "Through"]]


def sight_of(points: np.ndarray, loose: np.ndarray, camera: np.ndarray, up: np.ndarray) -> Sight:
    """Looks at a fair share of the points.

    Args:
        points: All points (N, 3) of the cloud, those of the ground, of walls and outliers too.
        loose: Which of them belong to no object (N,).
        camera: Where the points were seen from (3,).
        up: The vertical (3,).
    """
    which = slice(None, None, max(1, len(points) // LOOKED_AT))
    offset = np.asarray(points[which] - camera, float)
    depth = lengths(offset)
    return Sight(camera, up, which, offset / np.maximum(depth, 1e-12)[:, None], depth, loose[which], {})


def without_seen_through(
    points: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    sight: Sight,
    wholes: Sequence[np.ndarray] | None = None,
) -> tuple[Shape, ...]:
    """Names "unknown" what would hide points that are seen, by the status SEEN_THROUGH.

    Args:
        points: All points (N, 3), those `sight_of` was given.
        members: Indices of the points of each shape.
        shapes: The shapes.
        sight: What the camera sees.
        wholes: Indices of all points of each object, where the shapes are those of a share of them.
    """
    told = []
    for own, shape, whole in zip(members, shapes, wholes or members, strict=True):
        if _holds(shape.primitive, sight.camera):
            shape = refused(shape, Status.SEEN_THROUGH, "the camera would stand within it")
        elif seen_through(points, own, shape, sight, whole).share > THROUGH:
            shape = refused(shape, Status.SEEN_THROUGH, "what stands behind is seen where it would hide it")
        told.append(shape)
    return tuple(told)


def _holds(body: Primitive | None, place: np.ndarray) -> bool:
    """Whether a place (3,) lies within a body."""
    if isinstance(body, Box):
        local = np.asarray(body.axes, float) @ (place - np.asarray(body.center, float))
        return bool((np.abs(local) < np.asarray(body.size) / 2).all())
    return bool(inside(body, place[None], 0.0).any())


class Through(NamedTuple):
    """What is seen through a surface.

    Attributes:
        share: Of the points whose rays pass the surface those that lie behind it, less what outliers explain.
        points: How many of the cloud's points that are.
    """

    share: float
    points: float


def seen_through(
    points: np.ndarray, own: np.ndarray, shape: Shape, sight: Sight, whole: np.ndarray | None = None
) -> Through:
    """What is seen through a shape; nothing where it is none.

    Args:
        points: All points (N, 3), those `sight_of` was given.
        own: Indices of the shape's points.
        shape: The shape.
        sight: What the camera sees.
        whole: Indices of all points of the object, where the shape is that of a share of them.
    """
    body, inliers = shape.primitive, np.asarray(shape.inliers)
    if body is None or isinstance(body, Quadric) or not inliers.any():
        return Through(0.0, 0.0)
    whole = own if whole is None else whole
    key = id(body), id(shape.inliers), len(whole)
    if key not in sight.known:
        mine = np.zeros(len(points), bool)
        mine[whole] = True
        held = np.asarray(points.take(own[inliers], axis=0), float)
        through = _through(body, float(shape.noise_distance), held, mine[sight.which], sight)
        # Kept with what it is of, so that no other takes that place in memory.
        sight.known[key] = body, shape.inliers, through
    return sight.known[key][2]


def _through(body: Primitive, noise_distance: float, held: np.ndarray, mine: np.ndarray, sight: Sight) -> Through:
    hit = _hits(body, held, sight)
    met = np.flatnonzero(np.isfinite(hit))
    hit, depth = hit[met], sight.depth[met]
    away = np.median(lengths(held - sight.camera))
    slack = CLEARLY * noise_distance * (hit / away) ** 2
    on = np.abs(depth - hit) <= slack
    # An object's own points behind its surface are the inside of a vessel, or its other side.
    behind = (depth - hit > slack) & ~mine[met]
    # Outliers lie anywhere, before it as often as behind.
    stray = (hit - depth > slack) & sight.loose[met]
    count = np.stack([on, behind, stray]).astype(float)
    if isinstance(body, Plane):
        on, behind, stray = count.sum(axis=1)
    else:
        axis = np.asarray(body.axis, float) if isinstance(body, Cylinder | Cone) else sight.up
        ends = np.quantile((held - sight.camera) @ axis, np.linspace(*ENDS, SLICES + 1))
        place = np.searchsorted(ends, hit * (sight.rays[met] @ axis))
        slices = np.stack([np.bincount(place, c, SLICES + 2)[1:-1] for c in count])
        total = np.maximum(slices[0] + slices[1], 1)
        best = np.argsort((slices[1] - slices[2]) / total)[:-WORST]
        on, behind, stray = slices[:, best].sum(axis=1)
    if on + behind < FEWEST:
        return Through(0.0, 0.0)
    return Through(float((behind - stray) / (on + behind)), float((behind - stray) * (sight.which.step or 1)))


def _hits(body: Primitive, held: np.ndarray, sight: Sight) -> np.ndarray:
    """How far along each ray (n,) it meets the part of a surface that its points claim to be there; inf where it does not."""
    hit = np.full(len(sight.rays), np.inf)
    if isinstance(body, Plane):
        middle = held.mean(axis=0)
        reach = lengths(held - middle).max()
        near = _near(sight, middle, reach)
        hit[near] = _hits_of_plane(body, held - sight.camera, sight.rays[near], sight.camera)
    elif _extended(body):
        solid = body_of(body)
        near = _near(sight, solid.place(np.array([0.0, solid.height / 2, 0.0])), solid.reach)
        start = np.broadcast_to((sight.camera - solid.origin) @ solid.rotation.T, (len(near), 3))
        depth, part = solid.cast(start, sight.rays[near] @ solid.rotation.T)
        # A vessel may be open: of a cylinder or cone the side alone is claimed.
        claimed = np.array([True, False, False])
        if isinstance(body, Box):
            local = np.abs((held - np.asarray(body.center)) @ np.asarray(body.axes).T) / (np.asarray(body.size) / 2)
            claimed = np.bincount(local.argmax(axis=1), minlength=3) >= FACE * len(held)
        hit[near] = np.where(claimed[part], depth, np.inf)
    return hit


def _hits_of_plane(body: Plane, held: np.ndarray, rays: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """The same of a flat patch, which ends where its points do."""
    normal = np.asarray(body.normal, float)
    with np.errstate(divide="ignore"):
        hit = ((np.asarray(body.point, float) - camera) @ normal) / (rays @ normal)
    turns = np.arange(DIRECTIONS)[:, None] * np.pi / DIRECTIONS
    first, second = np.asarray(tangents(normal), float)
    across = np.cos(turns) * first + np.sin(turns) * second
    low, high = np.quantile(held @ across.T, ENDS, axis=0)
    place = np.where(hit > 0, hit, 0)[:, None] * (rays @ across.T)
    return np.where((hit > 0) & ((place >= low) & (place <= high)).all(axis=1), hit, np.inf)


def _near(sight: Sight, middle: np.ndarray, reach: float) -> np.ndarray:
    """Which rays pass within reach of a place; all where the camera is within."""
    offset = middle - sight.camera
    away = float(np.linalg.norm(offset))
    if away <= reach:
        return np.arange(len(sight.rays))
    return np.flatnonzero(sight.rays @ (offset / away) >= np.sqrt(1 - (reach / away) ** 2) - 1e-9)


def _extended(body: Primitive) -> bool:
    """Whether a body has an extent in every direction."""
    match body:
        case Cylinder():
            return float(body.height) > 0
        case Cone():
            low, high = np.asarray(body.height)
            return bool(low < high)
        case Box():
            return float(np.min(np.asarray(body.size))) > 0
    return True
