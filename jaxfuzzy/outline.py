"""Whether a shape would hide what is seen: a body hides what stands behind it, so through one that is there nothing is seen.

A surface may hold an object's points and still be none: twigs lie near one plane, the front of a head on a blunt cone. Such a
surface goes on where the object does not, and there the camera looks through it at what stands behind. Every point of the cloud
whose viewing ray passes the surface within its ends has a say; what was not matched has none, and what stands before it neither.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxfuzzy.linalg import tangents
from jaxfuzzy.primitives import Box, Plane, Primitive, Quadric, Sphere
from jaxfuzzy.render import body_of
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

# A surface is refused when so large a share of the points that pass it lies behind. Right ones: at most 0.02 on rendered tables,
# 0.12 on depth-camera tables, 0.11 on photographs (an oval hat box as a cylinder). Rings, twigs and a lattice as planes, a beam as
# a cylinder and a mug as a blunt cone: 0.35 to 0.77; a bust as a blunt cone 0.26.
THROUGH = 0.25
# Behind means by more than so many noise distances.
CLEARLY = 4.0
# A fair share of all points is looked at: so many, and less than twice as many; fewer on a surface than these say nothing.
LOOKED_AT, FEWEST = 65_536, 50
# A face of a box that holds a smaller share of its points is not claimed.
FACE = 0.05
# Directions whose extents bound a flat patch, and quantiles that bound it and a sphere.
DIRECTIONS, ENDS = 16, (0.01, 0.99)


def without_seen_through(
    points: np.ndarray, members: Sequence[np.ndarray], shapes: Sequence[Shape], camera: np.ndarray, up: np.ndarray
) -> tuple[Shape, ...]:
    """Names "unknown" what would hide points that are seen, by the status SEEN_THROUGH.

    Args:
        points: All points (N, 3) of the cloud, those of the ground, of walls and outliers too.
        members: Indices of the points of each shape.
        shapes: The shapes.
        camera: Where the points were seen from (3,).
        up: The vertical (3,).
    """
    label = np.full(len(points), -1)
    for k, own in enumerate(members):
        label[own] = k
    step = max(1, len(points) // LOOKED_AT)
    offset = np.asarray(points[::step] - camera, float)
    depth = np.linalg.norm(offset, axis=1)
    rays, label = offset / np.maximum(depth, 1e-12)[:, None], label[::step]
    told = []
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        if shape.primitive is not None and not isinstance(shape.primitive, Quadric):
            held = np.asarray(points[own[np.asarray(shape.inliers)]], float)
            if _seen_through(shape, held, rays, depth, label, k, camera, up) > THROUGH:
                shape = _refused(shape)
        told.append(shape)
    return tuple(told)


def _seen_through(
    shape: Shape,
    held: np.ndarray,
    rays: np.ndarray,
    depth: np.ndarray,
    label: np.ndarray,
    k: int,
    camera: np.ndarray,
    up: np.ndarray,
) -> float:
    """Share of the points whose rays pass a surface that lies behind it."""
    if len(held) == 0 or shape.primitive is None:
        return 0.0
    hit = _hits(shape.primitive, held, rays, camera, up)
    met = np.isfinite(hit)
    hit, depth, label = hit[met], depth[met], label[met]
    away = np.median(np.linalg.norm(held - camera, axis=1))
    slack = CLEARLY * float(shape.noise_distance) * (hit / away) ** 2
    on = np.abs(depth - hit) <= slack
    # An object's own points behind its surface are the inside of a vessel, or its other side.
    behind = (depth - hit > slack) & (label != k)
    # Outliers lie anywhere, before it as often as behind.
    stray = (hit - depth > slack) & (label < 0)
    total = on.sum() + behind.sum()
    return float((behind.sum() - stray.sum()) / total) if total >= FEWEST else 0.0


def _hits(body: Primitive, held: np.ndarray, rays: np.ndarray, camera: np.ndarray, up: np.ndarray) -> np.ndarray:
    """How far along each ray (N,) it meets the part of a surface that its points claim to be there; inf where it does not."""
    if isinstance(body, Plane):
        normal = np.asarray(body.normal, float)
        with np.errstate(divide="ignore"):
            hit = ((np.asarray(body.point, float) - camera) @ normal) / (rays @ normal)
        hit = np.where(hit > 0, hit, np.inf)
        turns = np.arange(DIRECTIONS)[:, None] * np.pi / DIRECTIONS
        first, second = np.asarray(tangents(jnp.asarray(normal)), float)
        return _within(hit, rays, camera, held, np.cos(turns) * first + np.sin(turns) * second)
    solid = body_of(body)
    start = np.broadcast_to((camera - solid.origin) @ solid.rotation.T, rays.shape)
    hit, part = solid.cast(start, rays @ solid.rotation.T)
    if isinstance(body, Sphere):
        # A bowl is no whole sphere.
        return _within(hit, rays, camera, held, up[None])
    if isinstance(body, Box):
        local = np.abs((held - np.asarray(body.center)) @ np.asarray(body.axes).T / (np.asarray(body.size) / 2))
        share = np.bincount(local.argmax(axis=1), minlength=3) / len(held)
        return np.where(share[part] >= FACE, hit, np.inf)
    # A vessel may be open: its side alone is claimed.
    return np.where(part == 0, hit, np.inf)


def _within(
    hit: np.ndarray, rays: np.ndarray, camera: np.ndarray, held: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Hits that lie where the points do, by their extents along some directions (n, 3)."""
    low, high = np.quantile((held - camera) @ directions.T, ENDS, axis=0)
    along = np.where(np.isfinite(hit), hit, 0)[:, None] * (rays @ directions.T)
    return np.where(((along >= low) & (along <= high)).all(axis=1), hit, np.inf)


def _refused(shape: Shape) -> Shape:
    return dataclasses.replace(
        shape,
        kind="unknown",
        primitive=None,
        inliers=jnp.zeros_like(shape.inliers),
        covariance=jnp.zeros((0, 0), shape.covariance.dtype),
        status=jnp.asarray(Status.REFUSED | Status.SEEN_THROUGH, jnp.int32),
        guards=(*shape.guards, f"{shape.kind}: what stands behind is seen where it would hide it"),
    )
