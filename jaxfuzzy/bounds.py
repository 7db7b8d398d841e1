"""Ends of a surface: where the points on it stop, and from surface and ends to a bounded primitive in metres.

Points are first moved along their rays onto the surface, which takes the depth noise out of every end. An end is where points
become rare: the stretch that holds the most points over a price per length, a third of its own density, so that a few
outliers beyond do not move it and it lands on the last point of the surface itself.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfuzzy.arrays import Array
from jaxfuzzy.objects import Frame
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Sphere
from jaxfuzzy.rays import CLOSED, OPEN

PRICE = 0.35
# Squared sine of the tilt below which a plane counts as level.
FLAT = 1e-4
# So many points say how a flat patch is turned in its plane.
ASKED = 2048


def stretch(values: np.ndarray) -> tuple[float, float, float]:
    """Low and high end of where values lie densely, and the standard error of an end; a wrong value here or there does no harm."""
    x = np.sort(values)
    low, high = 0, len(x) - 1
    if high < 1:
        return (float(x[0]), float(x[0]), 0.0) if len(x) else (0.0, 0.0, 0.0)
    for _ in range(4):
        density = PRICE * (high - low + 1) / max(x[high] - x[low], 1e-12)
        gain = np.arange(len(x)) - density * x
        # The best stretch ends at the largest gain over the smallest one before it.
        before = np.minimum.accumulate(gain)
        new_high = int(np.argmax(gain - before))
        new_low = int(np.argmin(gain[: new_high + 1]))
        if (new_low, new_high) == (low, high) or new_high <= new_low:
            break
        low, high = new_low, new_high
    spacing = (x[high] - x[low]) / max(high - low, 1)
    # The last of evenly spread points lies half a spacing to one spacing inside the true end.
    return float(x[low] - spacing), float(x[high] + spacing), float(spacing)


def ends_of(
    kind: str,
    theta: np.ndarray,
    hits: np.ndarray,
    part: np.ndarray,
    on: np.ndarray,
    detail: np.ndarray,
    rotation: np.ndarray,
) -> np.ndarray:
    """Ends (low, high, error) (3, 3) of a surface in its own frame, unit free.

    Args:
        kind: The kind.
        theta: Its parameters as in `rays`.
        hits: Points moved onto it, in the frame in which its axis is y (N, 3).
        part: The part of the surface each belongs to.
        on: Which are inliers.
        detail: Signs of a box, ends of a body of revolution.
        rotation: From the object's frame into the surface's own (3, 3).
    """
    ends = np.zeros((3, 3))
    if kind in ("cylinder", "cone"):
        # A lid says where the side ends; how far down it goes, the side and the inner wall say.
        side = on & (part != 1)
        ends[0] = stretch(hits[side if side.sum() > 3 else on, 1])
        # A lid that no point lies on may be anywhere.
        held = (on & (part == 1)).any()
        if detail[0] == CLOSED and held:
            ends[0, 1] = theta[4]
            ends[0, 0] = min(ends[0, 0], theta[4])
        if detail[0] == OPEN and held:
            ends[0, 0] = min(ends[0, 0], theta[4])
        if kind == "cone" and theta[3] != 0:
            tip = theta[2] / theta[3]
            ends[0, :2] = np.minimum(ends[0, :2], tip) if theta[3] > 0 else np.maximum(ends[0, :2], tip)
    elif kind == "box":
        c, s = np.cos(theta[0]), np.sin(theta[0])
        across = np.stack([c * hits[:, 0] + s * hits[:, 2], c * hits[:, 2] - s * hits[:, 0], hits[:, 1]])
        for i in range(3):
            ends[i] = stretch(across[i][on & (part != i)])
            if detail[i] and (on & (part == i)).any():
                # The other end is no further out, whatever lies beyond the face.
                ends[i, :2] = (np.minimum if detail[i] > 0 else np.maximum)(ends[i, :2], theta[1 + i])
                ends[i, 1 if detail[i] > 0 else 0] = theta[1 + i]
    elif kind == "plane":
        first, second = _patch_axes(theta[:3] / np.linalg.norm(theta[:3]), rotation, np)
        a, b = hits[on] @ first, hits[on] @ second
        # The rectangle of least area, turned in its plane; the first points are a fair sample of all.
        turns = np.deg2rad(np.arange(0, 90, 3.0))
        rotated = lambda a, b, turn: (np.cos(turn) * a + np.sin(turn) * b, np.cos(turn) * b - np.sin(turn) * a)
        u, v = rotated(a[:ASKED], b[:ASKED], turns[:, None])
        cut = max(1, round(0.03 * u.shape[1]))
        within = lambda w: (
            np.diff(np.partition(w, (cut, -cut), axis=1)[:, [cut, -cut]])[:, 0] if w.shape[1] > 2 * cut else 1.0
        )
        turn = turns[int(np.argmin(within(u) * within(v)))]
        u, v = rotated(a, b, turn)
        ends[0], ends[1], ends[2, 0] = stretch(u), stretch(v), turn
    return ends


def assembled(
    kind: str, theta: Array, lean: Array, ends: Array, signs: Array, rotation: Array, frame: Frame
) -> Primitive:
    """The bounded primitive in metres, from a surface in its own frame, its ends and a small further lean of its axis."""
    zero = jnp.zeros_like(lean[0])
    cross = jnp.stack(
        [jnp.stack([zero, -lean[1], zero]), jnp.stack([lean[1], zero, -lean[0]]), jnp.stack([zero, lean[0], zero])]
    )
    # Only the derivative by the lean is ever used, at zero.
    turn = (jnp.eye(3, dtype=theta.dtype) + cross) @ rotation @ frame.turn
    place = lambda q: frame.origin + frame.unit * (turn.T @ q)
    low, high = ends[:, 0], ends[:, 1]
    up = turn[1]
    if kind == "sphere":
        return Sphere(center=place(theta[:3]), radius=frame.unit * jnp.abs(theta[3]))
    if kind == "cylinder":
        base = place(jnp.stack([theta[0], low[0], theta[1]]))
        return Cylinder(base=base, axis=up, radius=frame.unit * theta[2], height=frame.unit * (high[0] - low[0]))
    if kind == "cone":
        tip = theta[2] / theta[3]
        sign = jnp.where(theta[3] > 0, -1.0, 1.0).astype(theta.dtype)
        reach = jnp.sort(jnp.maximum(sign * (ends[0, :2] - tip), 0.0)) * frame.unit
        apex = place(jnp.stack([theta[0], tip, theta[1]]))
        return Cone(apex=apex, axis=sign * up, half_angle=jnp.arctan(jnp.abs(theta[3])), height=reach)
    if kind == "box":
        c, s = jnp.cos(theta[0]), jnp.sin(theta[0])
        axes = jnp.stack([jnp.stack([c, zero, s]), jnp.stack([zero, zero + 1, zero]), jnp.stack([-s, zero, c])])
        face = theta[1:4]
        low = jnp.where(signs < 0, face, low)[jnp.array([0, 2, 1])]
        high = jnp.where(signs > 0, face, high)[jnp.array([0, 2, 1])]
        center, size = place(axes.T @ (0.5 * (low + high))), high - low
        # The search may find a box by either of its upright faces first: the longer edge comes first.
        longer = size[2] > size[0]
        size = jnp.where(longer, size[::-1], size)
        axes = jnp.where(longer, jnp.stack([axes[2], axes[1], -axes[0]]), axes)
        return Box(
            center=center,
            size=frame.unit * size,
            axes=axes @ turn,
            # A box has two faces at least, and each edge lies along one of them; what may hide its end is not known here.
            seen=jnp.ones(3, bool),
        )
    length = jnp.sqrt((theta[:3] ** 2).sum())
    normal = theta[:3] / length
    first, second = _patch_axes(normal, rotation, jnp)
    c, s = jnp.cos(ends[2, 0]), jnp.sin(ends[2, 0])
    first, second = c * first + s * second, c * second - s * first
    foot = normal * theta[3] / length
    corner = lambda a, b: place(foot + a * first + b * second)
    corners = jnp.stack(
        [corner(low[0], low[1]), corner(high[0], low[1]), corner(high[0], high[1]), corner(low[0], high[1])]
    )
    return Plane(point=corners.mean(0), normal=turn.T @ normal, corners=corners)


def _patch_axes(normal: Any, rotation: Any, xp: Any) -> tuple[Any, Any]:
    """Two directions in a plane, by NumPy or traced: the level one, or where the plane is level itself, x; and the one across.

    Level is meant in the object's frame: how far the search let the surface's own lean says nothing of a plane.
    """
    level = xp.cross(rotation[:, 1], normal)
    level = xp.where((level**2).sum() < FLAT, xp.cross(normal, rotation[:, 2]), level)
    first = level / xp.sqrt((level**2).sum())
    return first, xp.cross(normal, first)
