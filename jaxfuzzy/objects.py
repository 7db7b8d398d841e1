"""Objects made ready for the search: each in a frame of its own, in a fair order, padded to a common size.

The frame has its origin at the mean of the points, y up, z away from the camera, and the spread of the points as its unit, so that
neither place, heading nor unit of the cloud changes what the search sees. Points are put in an order that depends on their places
alone, and of which every beginning is a fair sample.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxfuzzy.arrays import extents, lengths, product

# A noise distance is so many standard deviations; residuals are searched and weighed in deviations.
DEVIATIONS = 2.5
# Sizes that are compiled: points an object, and primitives that are made at a time.
CAPACITIES = (2048, 8192)
# An object is fitted to so many of its points at most, evenly drawn; one of a scene, where hundreds of neighboring points err
# alike, to fewer, so that all scenes share one program.
MOST = CAPACITIES[-1]
OF_SCENE = CAPACITIES[0]
BATCH = 8
# Neighboring pixels that together tell as much of a size as one independent point: 84 to 335, 190 on average, against the
# ground truth of thirteen real pairs (`measure_noise`).
PIXELS_PER_POINT = 190
GOLDEN = 0.6180339887498949
# So that an upright frame known to a few degrees does no harm: ten degrees.
LEAN = 0.1745
# An extent below this share of the largest is none: the object is seen edge on.
EDGE_ON = 1e-3
# Rows of an object at a compiled size; the last begins with six numbers: the camera's place, the range of depth, whether deviations
# are given, the lean.
POINTS, RAYS, GAIN, WEIGHT, ALONE, ROWS = slice(0, 3), slice(3, 6), 6, 7, 8, 9
ALONES = 6
# So many places along width and height of an object tell its points apart, by their bits.
PLACES, SHIFTS = 2**16 - 1, ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555))
# Of objects with many points so many are drawn, by a lot that changes over a small part of the spacing of points.
DRAWN = 2 * MOST
TO_LOT, LOTS = np.array([0.36787944, 0.57721566, 0.73205081]), 1e6


class Frame(NamedTuple):
    """From metres in the user's frame to an object's own: q = turn (p - origin) / unit."""

    turn: Any
    origin: Any
    unit: Any


class Prepared(NamedTuple):
    """One object ready for the search.

    Attributes:
        points: In its own frame, in the order in which they are sampled (N, 3).
        rays: Unit direction of the viewing ray of each; zeros without a camera (N, 3).
        order: Which of the object's points each is (N,).
        gain: One over the deviation of each, in its own unit; right but for a common factor where not `given` (N,).
        typical: The median deviation.
        weight: Weight of each (N,).
        eye: Where the camera is; zeros without.
        depth_range: Range of depth over which outliers are spread.
        given: Whether the deviation is known.
        frame: The frame.
        flatness: Spread along the second and third principal axis over that along the first.
        lean: Standard deviation in radians with which its axis may lean from the vertical, in the last polish.
    """

    points: np.ndarray
    rays: np.ndarray
    order: np.ndarray
    gain: np.ndarray
    typical: float
    weight: np.ndarray
    eye: np.ndarray
    depth_range: float
    given: bool
    frame: Frame
    flatness: tuple[float, float]
    lean: float = LEAN


def prepared(
    p: np.ndarray,
    weight: np.ndarray,
    deviation: np.ndarray | None,
    up: np.ndarray,
    camera: np.ndarray | None,
    along_ray: bool,
) -> Prepared:
    """Puts one object's points (N, 3) into its own frame.

    Args:
        p: Points in metres.
        weight: Their weights.
        deviation: Their deviations in metres, None where not known.
        up: A vertical direction; turned over where the camera is below the object.
        camera: Where they were seen from.
        along_ray: Whether deviations are along the viewing ray.
    """
    share = weight / weight.sum()
    middle = share @ p
    if camera is not None and (camera - middle) @ up < 0:
        up = -up
    turn = upright(up, np.zeros(3) if camera is None else middle - camera)
    q = product(p - middle, turn.T)
    scatter = (q * share[:, None]).T @ q
    unit = float(np.sqrt(np.trace(scatter)))
    q /= unit if unit > 0 else 1.0
    order = fair_order(q)
    if not share.all():  # weight 0 last
        order = order[np.argsort(share[order] == 0, kind="stable")]
    q, weight, share = q.take(order, axis=0), weight[order], share[order]
    eye, depth, ray, relative = np.zeros(3), q[:, 2], np.zeros_like(q), np.ones(len(p))
    if along_ray and camera is not None:
        eye = turn @ (camera - middle) / (unit if unit > 0 else 1.0)
        ray = q - eye
        depth = lengths(ray)
        ray /= np.maximum(depth, 1e-12)[:, None]
        # Without a better word the deviation of stereo grows with the square of the distance.
        relative = (depth / (share * depth).sum()) ** 2
    gain = 1 / (relative if deviation is None else deviation[order] / (unit if unit > 0 else 1.0))
    principal = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter), 0))
    return Prepared(
        points=q,
        rays=ray,
        order=order,
        gain=gain,
        typical=_typical(gain),
        weight=weight,
        eye=eye,
        depth_range=max(float(np.ptp(depth)), 1e-6),
        given=deviation is not None,
        frame=Frame(turn, middle, np.asarray(unit)),
        flatness=(float(principal[1] / max(principal[2], 1e-300)), float(principal[0] / max(principal[2], 1e-300))),
    )


def fair_order(points: np.ndarray) -> np.ndarray:
    """An order of points (N, 3) that depends on their places alone and of which every beginning is a fair sample.

    Sorted along a curve that passes near places one after the other (Morton's, over width and height), and then dealt out by the
    golden ratio: a sample is as even over the surface seen as along the curve, and what it says varies half as much as that of one
    drawn at random. Of many points that holds for the first ones, which are drawn by a number that their place has, and are more
    than are ever fitted; the others follow as they come.
    """
    if not len(points):
        return np.zeros(0, int)
    if len(points) > 2 * DRAWN:
        drawn = (points @ TO_LOT * LOTS) % 1.0 < DRAWN / len(points)
        first = np.flatnonzero(drawn)
        return np.concatenate([first[_dealt(points[first])], np.flatnonzero(~drawn)])
    return _dealt(points)


def _dealt(points: np.ndarray) -> np.ndarray:
    along = _along_curve(points)
    order = np.argsort(along)
    if not np.diff(along[order]).all():  # points of one place on the curve by their own, whatever order they come in
        order = np.lexsort((points @ TO_LOT, along))
    turn = np.arange(len(points)) * GOLDEN % 1.0
    # Those beyond what is ever fitted need no order.
    early = turn < MOST / len(points)
    first = np.flatnonzero(early)
    return order[np.concatenate([first[np.argsort(turn[first])], np.flatnonzero(~early)])]


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Where points (N, 3) lie along Morton's curve: the bits of width and height in turn, or of depth where one of them is none."""
    extent = extents(points)
    wide = extent >= EDGE_ON * extent.max()
    axes = [0, 1] if wide[:2].all() else np.sort(np.argsort(~wide, kind="stable")[:2])
    flat, extent = points[:, axes], np.maximum(extent[axes], max(EDGE_ON * extent.max(), np.finfo(points.dtype).tiny))
    least = [along.min() for along in flat.T]
    bits = ((flat - least) / extent * PLACES).astype(np.uint32)
    for shift, mask in SHIFTS:
        bits = (bits | bits << shift) & mask
    return np.asarray(bits[:, 0] | bits[:, 1] << 1)


def about(item: Prepared, up: np.ndarray, camera: np.ndarray | None) -> tuple[Prepared, np.ndarray]:
    """An object in the frame of another vertical, and the rotation (3, 3) there from the frame that it has.

    Args:
        item: The object.
        up: The vertical.
        camera: Where the points were seen from.
    """
    old = item.frame
    up = up if up @ old.turn[1] >= 0 else -up
    turn = upright(up, np.zeros(3) if camera is None else old.origin - camera)
    step = turn @ old.turn.T
    moved = item._replace(
        points=item.points @ step.T, rays=item.rays @ step.T, eye=step @ item.eye, frame=old._replace(turn=turn)
    )
    return moved, step


def with_more(
    item: Prepared, p: np.ndarray, weight: np.ndarray, deviation: np.ndarray, order: np.ndarray, along_ray: bool
) -> Prepared:
    """An object with further points behind those that it was searched with, in the frame that it has.

    Args:
        item: The object.
        p: Further points (N, 3) in metres.
        weight: Their weights.
        deviation: Their deviations in metres.
        order: Which of the object's points each is.
        along_ray: As it was prepared.
    """
    turn, origin, unit = item.frame
    q = (p - origin) @ turn.T / unit
    ray = np.zeros_like(q)
    if along_ray:
        ray = q - item.eye
        ray = ray / np.maximum(lengths(ray), 1e-12)[:, None]
    join = lambda a, b: np.concatenate([a, b])
    gain = join(item.gain, unit / deviation)
    return item._replace(
        points=join(item.points, q),
        rays=join(item.rays, ray),
        order=join(item.order, order),
        gain=gain,
        typical=_typical(gain),
        weight=join(item.weight, weight),
    )


def _typical(gain: np.ndarray) -> float:
    """The median deviation of an object's points, or of a fair sample of so many as are ever fitted."""
    return float(np.median(1 / gain[:MOST]))


def upright(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that makes `up` y and, as far as that allows, `forward` z."""
    level = forward - up * (up @ forward)
    if np.linalg.norm(level) <= 1e-6 * np.linalg.norm(forward):
        # Seen from straight above, or by nobody: any level direction will do.
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - up * (up @ level)
    level = level / np.linalg.norm(level)
    # Written out: NumPy's cross product takes longer than all the rest here.
    (a, b, c), (d, e, f) = up, level
    return np.array([[b * f - c * e, c * d - a * f, a * e - b * d], up, level])


def padded(item: Prepared | None, capacity: int, dtype: Any) -> np.ndarray:
    """An object at a compiled size: weight 0 and a finite filler where there is no point; of larger ones a fair sample.

    It is one array of `ROWS` rows, since each array that is handed to a program costs as much as many numbers; `opened` undoes it.
    """
    object_ = np.zeros((ROWS, capacity), dtype)
    object_[GAIN] = 1
    object_[ALONE, :ALONES] = 0, 0, 0, 1, 1, 1
    if item is not None:
        n = min(len(item.points), capacity)
        object_[POINTS, :n], object_[RAYS, :n] = item.points[:n].T, item.rays[:n].T
        object_[GAIN, :n], object_[WEIGHT, :n] = item.gain[:n], item.weight[:n]
        object_[ALONE, :ALONES] = *item.eye, item.depth_range, item.given, item.lean
    return object_


def opened(object_: Any) -> dict[str, Any]:
    """The parts of an object as `padded` makes it, by NumPy or traced."""
    eye, (depth_range, given, lean) = object_[ALONE, :3], object_[ALONE, 3:ALONES]
    return {
        "points": object_[POINTS],
        "rays": object_[RAYS],
        "gain": object_[GAIN],
        "weight": object_[WEIGHT],
        "eye": eye,
        "depth_range": depth_range,
        "given": given > 0,
        "lean": lean,
    }


def capacity_for(count: int) -> int:
    """The smallest of a few sizes that holds so many points; beyond them, the next power of two."""
    return next((c for c in CAPACITIES if c >= count), 1 << (count - 1).bit_length())


def batches(items: Sequence[Any]) -> list[Sequence[Any]]:
    """Divided into as few batches as hold them, of about the same size."""
    count = -(-len(items) // BATCH)
    ends = np.linspace(0, len(items), count + 1).round().astype(int)
    return [items[a:b] for a, b in itertools.pairwise(ends)]
