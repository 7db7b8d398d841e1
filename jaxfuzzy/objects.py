"""Objects made ready for the search: each in a frame of its own, in a fair order, padded to a common size.

The frame has its origin at the mean of the points, y up, z away from the camera, and the spread of the points as its unit, so that
neither place, heading nor unit of the cloud changes what the search sees. Points are put in an order that depends on their places
alone, and of which every beginning is a fair sample.
"""

from typing import Any, NamedTuple

import numpy as np

# A noise distance is so many standard deviations; residuals are searched and weighed in deviations.
DEVIATIONS = 2.5
# Sizes that are compiled: points an object, and objects a batch. Beyond, powers of two.
CAPACITIES = (1024, 2048)
COUNTS = (1, 4, 8, 16, 24, 32)
GOLDEN = 0.6180339887498949


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
        weight: Weight of each (N,).
        eye: Where the camera is; zeros without.
        depth_range: Range of depth over which outliers are spread.
        given: Whether the deviation is known.
        frame: The frame.
        flatness: Spread along the second and third principal axis over that along the first.
    """

    points: np.ndarray
    rays: np.ndarray
    order: np.ndarray
    gain: np.ndarray
    weight: np.ndarray
    eye: np.ndarray
    depth_range: float
    given: bool
    frame: Frame
    flatness: tuple[float, float]


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
    middle = np.average(p, axis=0, weights=weight)
    if camera is not None and (camera - middle) @ up < 0:
        up = -up
    forward = middle - camera if camera is not None else np.zeros(3)
    forward = forward - up * (up @ forward)
    if np.linalg.norm(forward) <= 1e-6 * np.linalg.norm(middle - (0 if camera is None else camera)):
        # Seen from straight above, or by nobody: any level direction will do.
        forward = np.eye(3)[np.argmin(np.abs(up))]
        forward = forward - up * (up @ forward)
    forward = forward / np.linalg.norm(forward)
    turn = np.stack([np.cross(up, forward), up, forward])
    offset = (p - middle) @ turn.T
    spread = np.sqrt(np.average(offset**2, axis=0, weights=weight))
    unit = float(np.linalg.norm(spread))
    q = offset / (unit if unit > 0 else 1.0)
    # Sorted by height and then dealt out by the golden ratio, whatever order the points came in.
    order = np.lexsort((q[:, 2], q[:, 0], q[:, 1]))
    order = order[np.argsort(np.arange(len(p)) * GOLDEN % 1.0, kind="stable")]
    order = order[np.argsort(weight[order] == 0, kind="stable")]
    eye, depth = np.zeros(3), q[:, 2]
    ray, relative = np.zeros_like(q), np.ones(len(p))
    if along_ray and camera is not None:
        eye = turn @ (camera - middle) / (unit if unit > 0 else 1.0)
        depth = np.linalg.norm(q - eye, axis=1)
        ray = (q - eye) / np.maximum(depth, 1e-12)[:, None]
        # Without a better word the deviation of stereo grows with the square of the distance.
        relative = (depth / np.average(depth, weights=weight)) ** 2
    gain = 1 / (relative if deviation is None else deviation / (unit if unit > 0 else 1.0))
    scatter = (
        np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(q.T, aweights=weight, ddof=0)), 0)) if len(p) > 1 else np.zeros(3)
    )
    return Prepared(
        points=q[order],
        rays=ray[order],
        order=order,
        gain=gain[order],
        weight=weight[order],
        eye=eye,
        depth_range=max(float(np.ptp(depth)), 1e-6),
        given=deviation is not None,
        frame=Frame(turn, middle, np.asarray(unit)),
        flatness=(float(scatter[1] / max(scatter[2], 1e-300)), float(scatter[0] / max(scatter[2], 1e-300))),
    )


def stacked(items: list[Prepared], dtype: Any) -> dict[str, np.ndarray]:
    """One padded batch: weight 0 and a finite filler where there is no point."""
    capacity = padded(max(len(o.points) for o in items), CAPACITIES)
    count = padded(len(items), COUNTS)
    batch = {
        "points": np.zeros((count, 3, capacity), dtype),
        "rays": np.zeros((count, 3, capacity), dtype),
        "gain": np.ones((count, capacity), dtype),
        "weight": np.zeros((count, capacity), dtype),
        "eye": np.zeros((count, 3), dtype),
        "depth_range": np.ones(count, dtype),
        "given": np.ones(count, bool),
    }
    for i, o in enumerate(items):
        n = len(o.points)
        batch["points"][i, :, :n], batch["rays"][i, :, :n] = o.points.T, o.rays.T
        batch["gain"][i, :n], batch["weight"][i, :n] = o.gain, o.weight
        batch["eye"][i], batch["depth_range"][i], batch["given"][i] = o.eye, o.depth_range, o.given
    return batch


def padded(size: int, sizes: tuple[int, ...]) -> int:
    """The smallest of a few sizes that is large enough; beyond them, the next power of two."""
    return next((s for s in sizes if s >= size), 1 << (size - 1).bit_length())
