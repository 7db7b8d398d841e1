"""The paper's own choice of a shape (section III-C): fuzzy c-varieties in 3D, 4D and 6D, the most points decide.

A hyperplane is a plane in 3D, an upright cylinder in 4D, an upright cone or sphere in 6D; two in 3D are two faces of a box. Richer
spaces hold simpler surfaces too, so that ties are common; the simpler space is then taken and the tie is told.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy.objects import capacity_for, upright
from jaxfuzzy.primitives import Primitive, Quadric, transform
from jaxfuzzy.recover import recover
from jaxfuzzy.status import Status
from jaxfuzzy.varieties import Varieties, nfcv

# Simpler spaces first, and what each may be; kinds are tried in this order.
SPACES: dict[str, tuple[str, ...]] = {
    "3d": ("plane",),
    "3d, two planes": ("box",),
    "4d": ("cylinder",),
    "6d": ("sphere", "cone"),
}
# Two faces start from the two halves of the object, left and right, with this membership.
HALF = 0.9


class MostPoints(NamedTuple):
    """What the rule says of one object.

    Attributes:
        kind: The kind, "quadric" where the winning hyperplane is of no kind allowed.
        primitive: The primitive in the frame of the points.
        inliers: Points of the winning space's cluster (N,).
        counts: Points in each space.
        status: PAPER_TIE, or what the winning fit says.
    """

    kind: str
    primitive: Primitive
    inliers: np.ndarray
    counts: dict[str, int]
    status: Status


def most_points(
    points: np.ndarray,
    weights: np.ndarray,
    noise_distance: np.ndarray,
    up: np.ndarray,
    kinds: Sequence[str],
    geometric: bool,
) -> MostPoints:
    """Names one object by the paper's rule.

    Args:
        points: Its points (N, 3), in the coordinates in which the embeddings are made: the algebraic distance depends on them.
        weights: Their weights (N,).
        noise_distance: Noise distance of each (N,), in metres with the geometric distance, in the unit of each embedding without.
        up: The vertical direction.
        kinds: Kinds allowed.
        geometric: Whether to measure distances in metres in place of the paper's.
    """
    turn = upright(up, np.array([0.0, 0.0, 1.0])).astype(points.dtype)
    count = len(points)
    fill = capacity_for(count) - count
    padded = jnp.asarray(np.pad(points @ turn.T, ((0, fill), (0, 0)), mode="edge"))
    weight = jnp.asarray(np.pad(weights, (0, fill)), points.dtype)
    delta = jnp.asarray(np.pad(noise_distance, (0, fill), mode="edge"), points.dtype)
    options: dict[str, Any] = {
        "distance": "geometric" if geometric else "algebraic",
        "noise_distance": delta,
        "weights": weight,
    }
    whole = jnp.ones((count + fill, 1), points.dtype)
    left = jnp.where(padded[:, 0] < jnp.median(padded[:count, 0]), HALF, 1 - HALF).astype(points.dtype)
    single = nfcv(padded, whole, embedding=("3d", "4d", "6d"), **options)
    pair = nfcv(padded, jnp.stack([left, 1 - left], 1), embedding="3d", **options)
    fits: dict[str, Varieties] = {"3d": single.pick("3d"), "3d, two planes": pair}
    fits |= {name: single.pick(name) for name in ("4d", "6d")}
    held = {name: np.asarray(fit.inliers)[:count] & (weights > 0) for name, fit in fits.items()}
    counts = {name: int(own.sum()) for name, own in held.items()}
    able = [name for name, can in SPACES.items() if set(can) & set(kinds)]
    most = max(counts[name] for name in able)
    best = [name for name in able if counts[name] == most]
    chosen = best[0]
    status = Status(int(fits[chosen].status)) | (Status.PAPER_TIE if len(best) > 1 else Status(0))
    for kind in (k for k in SPACES[chosen] if k in kinds):
        primitive = recover(fits[chosen], kind, points=padded, weights=weight)
        if not isinstance(primitive, Quadric):
            break
    else:
        status |= Status.REFUSED
    moved = transform(primitive, turn.T, np.zeros(3, points.dtype))
    return MostPoints(primitive.kind, jax.device_get(moved), held[chosen], counts, status)
