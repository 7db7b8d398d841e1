"""Patches of planes made level: of ragged points the rectangle of least area may lie at any angle.

While shapes are sought a patch is the least rectangle that holds its points. Most flat things stand or lie level, and where a
corner is hidden or a side is ragged, a level rectangle is nearly as small as the least one: it is taken then.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxfuzzy.arrays import lengths, on_host
from jaxfuzzy.bounds import stretch
from jaxfuzzy.primitives import Plane
from jaxfuzzy.shapes import Shape

# A level rectangle may be so many times as large as the least one, both without so large a share of the points at either side: so
# large is one about a square that is turned by five degrees.
LARGER, ENDS = 1.1, (0.002, 0.998)
# Sine of the angle below which a ray grazes the plane.
GRAZING = 0.1
# Sine of the tilt below which a plane lies level itself, so that no direction in it is level before others.
FLAT = 0.05


def level_patches(
    points: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
    up: np.ndarray,
    camera: np.ndarray | None,
) -> tuple[Shape, ...]:
    """Planes with level sides above and below where these hold their points nearly as well.

    Args:
        points: Points (N, 3) in metres.
        members: Indices of the points of each shape.
        shapes: The shapes; other kinds stay as they are.
        up: The vertical (3,).
        camera: Where the points were seen from (3,): they are moved along their rays onto the plane; None to drop them on it.
    """
    told = []
    for own, shape in zip(members, shapes, strict=True):
        patch = None
        if isinstance(shape.primitive, Plane):
            patch = _level(np.asarray(points[own[np.asarray(shape.inliers)]], float), shape.primitive, up, camera)
        told.append(shape if patch is None else dataclasses.replace(shape, primitive=patch))
    return tuple(told)


def _level(on: np.ndarray, plane: Plane, up: np.ndarray, camera: np.ndarray | None) -> Plane | None:
    """The plane with a level rectangle about its points, where that is not much larger than its own."""
    normal, middle = np.asarray(plane.normal, float), np.asarray(plane.point, float)
    level = np.cross(up, normal)
    if not len(on) or np.linalg.norm(level) < FLAT:
        return None
    ways = np.broadcast_to(normal, on.shape) if camera is None else on - camera
    # A ray along the plane meets it nowhere near.
    ways = np.where((np.abs(ways @ normal) > GRAZING * lengths(ways))[:, None], ways, normal)
    on = on - ways * ((on - middle) @ normal / (ways @ normal))[:, None]
    corners = np.asarray(plane.corners, float)
    places, least = (
        np.stack([first, np.cross(normal, first)]) @ (on - middle).T / np.linalg.norm(first)
        for first in (level, corners[1] - corners[0])
    )
    area, of_least = (np.diff(np.quantile(of, ENDS, axis=1), axis=0).prod() for of in (places, least))
    if area > LARGER * of_least:
        return None
    (left, right), (low, high) = (stretch(values)[:2] for values in places)
    axes = np.stack([level, np.cross(normal, level)]) / np.linalg.norm(level)
    corners = middle + np.array([[left, low], [right, low], [right, high], [left, high]]) @ axes
    dtype = plane.corners.dtype
    return dataclasses.replace(plane, point=on_host(corners.mean(axis=0), dtype), corners=on_host(corners, dtype))
