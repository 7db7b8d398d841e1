"""Residuals of a surface: what a ray from the camera should have met, or how far a point lies from it, with derivatives.

Stereo noise moves a point along its viewing ray only, so with a known camera a surface predicts one depth a ray: its first
hit that faces the camera. Hidden parts, and which face of a box a point belongs to, then need no further rule. Without a camera
the residual is the orthogonal distance, which is the same thing along the surface's own normal.

Every surface is F(x; parameters) = 0 with F growing outwards. A ray of direction d that meets it at x has
d(depth)/d(parameter) = -F_parameter / (∇F·d), and turning the body about the origin by a small vector ω has F_ω = x × ∇F. Residuals
are in units of each point's own deviation; H hypotheses at once, arrays (H, N).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxfuzzy.arrays import Array

# A matched point also errs sideways, by this share of its deviation in depth; on a surface seen at a slant that is depth error.
SIDEWAYS = 0.2
# Near a silhouette depth and slope of a residual grow without bound: cosines of incidence below this are taken as this.
GRAZING = 0.12
TINY = 1e-12
# Depth of a ray that meets nothing, in units of the object's spread.
FAR = 1e2
# Ends of a body of revolution: the side alone, a lid on top, or open with the inside seen over the rim.
SIDE, CLOSED, OPEN = 0, 1, 2


class View(NamedTuple):
    """Points of an object as hypotheses see them, in units of the object's spread, its mean at the origin.

    Attributes:
        point: Places (1, 3, N), or (H, 3, N) where every hypothesis has its own frame.
        ray: Unit direction of each viewing ray, in the same form; None without a camera.
        eye: Where the camera stands, (1, 3) or (H, 3); None without a camera.
        gain: One over each point's deviation (N,).
        mask: Weight of each point (N,), 0 for padding.
    """

    point: Array
    ray: Array | None
    eye: Array | None
    gain: Array
    mask: Array


class Meeting(NamedTuple):
    """Where H surfaces meet N rays.

    Attributes:
        depth: From each point along its ray to the surface (H, N).
        miss: How far a ray passes by, 0 where it meets the surface (H, N).
        part: Which part of the surface was met, an integer (H, N).
    """

    depth: Array
    miss: Array
    part: Array


class Residual(NamedTuple):
    """Residuals of H surfaces at N points.

    Attributes:
        error: Measured less predicted depth (or signed distance, inwards positive), in deviations.
        miss: How far a ray passes by the surface, in deviations sideways.
        variance: Of the error, in units of the point's own; on slanted surfaces errors sideways are errors of depth.
        slopes: Derivative of `error` by each of the five parameters, (H, N) each.
        spins: Derivative of `error` by a small turn of the points about x, y and z.
        damping: What all derivatives were multiplied by where a ray grazes the surface, 1 elsewhere.
    """

    error: Array
    miss: Array
    variance: Array
    slopes: tuple[Array, ...]
    spins: tuple[Array, Array, Array]
    damping: Array


def turned(view: View, rotation: Array) -> View:
    """A view in one frame in that of each hypothesis: `rotation` (H, 3, 3) applied to points, rays and camera."""

    def turn(v: Array) -> Array:
        return jnp.einsum("hij,j...->hi...", rotation, v[0])

    ray, eye = (None if v is None else turn(v) for v in (view.ray, view.eye))
    return view._replace(point=turn(view.point), ray=ray, eye=eye)


def taken(view: View, count: int) -> View:
    """The first `count` points of a view whose points are in an order that makes any beginning a fair sample."""
    ray = None if view.ray is None else view.ray[..., :count]
    return view._replace(point=view.point[..., :count], ray=ray, gain=view.gain[:count], mask=view.mask[:count])


def picked(view: View, index: Array) -> View:
    """Some points of a view."""
    ray = None if view.ray is None else view.ray[..., index]
    return view._replace(point=view.point[..., index], ray=ray, gain=view.gain[index], mask=view.mask[index])


def columns(vectors: Array) -> tuple[Array, Array, Array]:
    """Three coordinates (G, N) of vectors (G, 3, N)."""
    return vectors[:, 0], vectors[:, 1], vectors[:, 2]


def meet_plane(theta: Array, view: View) -> Meeting:
    """Plane n·x = k, theta (H, 5) = (n, k, unused)."""
    n, k = tuple(theta[:, i, None] for i in range(3)), theta[:, 3, None]
    gap = k - _dot(n, columns(view.point))
    if view.ray is None:
        return _meeting(-gap * lax.rsqrt(_dot(n, n) + TINY))
    toward = _dot(n, columns(view.ray))
    steep = 0.02 * jnp.sqrt(_dot(n, n) + TINY)
    return _meeting(gap / jnp.where(jnp.abs(toward) < steep, jnp.where(toward < 0, -steep, steep), toward))


def plane(theta: Array, view: View, met: Meeting) -> Residual:
    """Residuals of planes."""
    n = tuple(theta[:, i, None] for i in range(3))
    scale = lax.rsqrt(_dot(n, n) + TINY)
    if view.ray is not None:
        # F must grow towards the camera, whichever way the normal points.
        scale = jnp.where(_dot(n, columns(view.ray)) < 0, scale, -scale)
    normal = tuple(c * scale for c in n)
    direction = tuple(-c for c in normal) if view.ray is None else columns(view.ray)
    hit = _along(columns(view.point), direction, met.depth)
    return _residual(view, met, direction, hit, normal, (*(c * scale for c in hit), -scale, 0.0), 1.0)


def meet_sphere(theta: Array, detail: Array | None, view: View) -> Meeting:
    """Sphere, theta (H, 5) = (center, radius, unused).

    Args:
        theta: Parameters.
        detail: None for a whole sphere, else (H, 3): kind of end (`SIDE` or, a bowl seen from above, `OPEN`), height of the
            rim, unused.
        view: The points.
    """
    radius = jnp.abs(theta[:, 3, None]) + 1e-4
    away = tuple(p - theta[:, i, None] for i, p in enumerate(columns(view.point)))
    square = _dot(away, away)
    if view.ray is None:
        return _meeting(jnp.sqrt(square + TINY) - radius)
    half, constant = _dot(away, columns(view.ray)), square - radius**2
    inside = half**2 - constant
    root = jnp.sqrt(jnp.maximum(inside, 0.0) + TINY)
    depth, miss = _nearer(1.0, half, constant, inside, root), jnp.maximum(-inside, 0.0) / (2 * radius)
    if detail is None:
        return _meeting(depth, miss)
    y, v = view.point[:, 1], view.ray[:, 1]
    back = (y + depth * v > detail[:, 1, None]) & (detail[:, :1] == OPEN)
    depth = jnp.where(back, _farther(1.0, half, constant, root), depth)
    miss = jnp.where(back, miss + jnp.maximum(y + depth * v - detail[:, 1, None], 0.0), miss)
    return Meeting(depth, miss, jnp.where(back, 2, 0).astype(jnp.int32))


def sphere(theta: Array, view: View, met: Meeting) -> Residual:
    """Residuals of spheres; parts are 0 for the outside, 2 for the inside of a bowl."""
    inner = jnp.where(met.part == 2, -1.0, 1.0)
    radius = jnp.abs(theta[:, 3, None]) + 1e-4
    direction: tuple[Array, ...]
    if view.ray is not None:
        direction = columns(view.ray)
    else:
        away = tuple(p - theta[:, i, None] for i, p in enumerate(columns(view.point)))
        direction = tuple(-c * lax.rsqrt(_dot(away, away) + TINY) for c in away)
    hit = _along(columns(view.point), direction, met.depth)
    normal = tuple((h - theta[:, i, None]) * inner for i, h in enumerate(hit))
    return _residual(view, met, direction, hit, normal, (*(-c for c in normal), -radius * inner, 0.0), radius)


def meet_revolution(theta: Array, detail: Array | None, view: View) -> Meeting:
    """Cylinder or cone about y: theta (H, 5) = (x, z, radius at y = 0, how much it narrows a unit of y, level).

    Args:
        theta: Parameters.
        detail: None for the endless side alone, else (H, 3): kind of end (`SIDE`, `CLOSED` or `OPEN`), height of the rim,
            unused. The level is the height of the lid of a closed body, of the floor of an open one.
        view: The points. The camera is above the rim.
    """
    a, b, r0, narrowing = (theta[:, i, None] for i in range(4))
    x, y, z = columns(view.point)
    dx, dz, rim = x - a, z - b, r0 - narrowing * y
    if view.ray is None:
        return _meeting((jnp.sqrt(dx**2 + dz**2 + TINY) - rim) * lax.rsqrt(1 + narrowing**2))
    u, v, w = columns(view.ray)
    square = u * u + w * w - (narrowing * v) ** 2
    half = dx * u + dz * w + narrowing * v * rim
    constant = dx * dx + dz * dz - rim * rim
    inside = half * half - square * constant
    root = jnp.sqrt(jnp.maximum(inside, 0.0) + TINY)
    depth = _nearer(square, half, constant, inside, root)
    if detail is not None:
        level, top = theta[:, 4, None], detail[:, 1, None]
        closed = detail[:, :1] == CLOSED
        over = y + depth * v > jnp.where(closed, level, top)
        back = over & (detail[:, :1] == OPEN)
        depth = jnp.where(back, _farther(square, half, constant, root), depth)
    height = y + depth * v
    radius = r0 - narrowing * height
    beside = jnp.maximum(-inside, 0.0) / (
        2 * jnp.maximum(square, 0.05) * (jnp.maximum(radius, 0.0) + 0.02 * jnp.abs(r0))
    )
    miss = beside + jnp.maximum(-radius, 0.0)
    if detail is None:
        return _meeting(depth, miss)
    # Over the rim: the lid of a closed body; of an open one the inner wall, down to the floor.
    flat = (over & closed) | (back & (height < level))
    down = jnp.maximum(-v, 0.02)
    drop = (y - level) / down
    outside = jnp.sqrt((dx + drop * u) ** 2 + (dz + drop * w) ** 2) - (r0 - narrowing * level)
    miss = jnp.where(flat, jnp.maximum(outside, 0.0) * down + jnp.maximum(v, 0.0), miss)
    miss = jnp.where(back & ~flat, miss + jnp.maximum(height - top, 0.0), miss)
    return _meeting(jnp.where(flat, drop, depth), miss, jnp.where(flat, 1, jnp.where(back, 2, 0)).astype(jnp.int32))


def revolution(theta: Array, view: View, met: Meeting) -> Residual:
    """Residuals of bodies of revolution; parts are 0 for the side, 1 for lid or floor, 2 for the inner wall."""
    a, b, r0, narrowing = (theta[:, i, None] for i in range(4))
    if view.ray is not None:
        direction = columns(view.ray)
    else:
        dx, dz = view.point[:, 0] - a, view.point[:, 2] - b
        far, lean = lax.rsqrt(dx**2 + dz**2 + TINY), lax.rsqrt(1 + narrowing**2)
        direction = (-dx * far * lean, -narrowing * lean * jnp.ones_like(far), -dz * far * lean)
    hit = _along(columns(view.point), direction, met.depth)
    flat, inner = met.part == 1, jnp.where(met.part == 2, -1.0, 1.0)
    radius = (r0 - narrowing * hit[1]) * inner
    hx, hz = (hit[0] - a) * inner, (hit[2] - b) * inner
    side = lambda value: jnp.where(flat, 0.0, value)
    normal = (side(hx), jnp.where(flat, 1.0, narrowing * radius), side(hz))
    slopes = (side(-hx), side(-hz), side(-radius), side(radius * hit[1]), jnp.where(flat, -1.0, 0.0))
    size = (jnp.abs(radius) + 0.02 * jnp.abs(r0) + 1e-4) * jnp.sqrt(1 + narrowing**2)
    return _residual(view, met, direction, hit, normal, slopes, jnp.where(flat, 1.0, size))


def meet_box(theta: Array, signs: Array, view: View) -> Meeting:
    """Corner of a box, theta (H, 5) = (yaw, offsets of the faces along x', z', y, unused).

    The faces of a convex corner meet a ray in turn; the last one entered is the one seen.

    Args:
        theta: Parameters.
        signs: Outward side of each face (H, 3), 0 for no face.
        view: The points.
    """
    c, s = jnp.cos(theta[:, 0, None]), jnp.sin(theta[:, 0, None])
    x, y, z = columns(view.point)
    gap = (c * x + s * z - theta[:, 1, None], c * z - s * x - theta[:, 2, None], y - theta[:, 3, None])
    if view.ray is None:
        fall = tuple(jnp.where(signs[:, i, None] != 0, 1.0, -1.0) for i in range(3))
    else:
        u, v, w = columns(view.ray)
        toward = (c * u + s * w, c * w - s * u, v)
        fall = tuple(-signs[:, i, None] * toward[i] for i in range(3))
    reach = tuple(
        jnp.where(fall[i] > 0.02, signs[:, i, None] * gap[i] / jnp.maximum(fall[i], 0.02), -FAR) for i in range(3)
    )
    depth = jnp.maximum(jnp.maximum(reach[0], reach[1]), reach[2])
    part = jnp.where(depth <= reach[0], 0, jnp.where(depth <= reach[1], 1, 2))
    # A ray that no face looks at is an outlier, without a say: part 3.
    lost = depth <= -FAR
    return _meeting(jnp.where(lost, FAR, depth), None, jnp.where(lost, 3, part))


def box(theta: Array, signs: Array, view: View, met: Meeting) -> Residual:
    """Residuals of boxes; parts are the faces."""
    c, s = jnp.cos(theta[:, 0, None]), jnp.sin(theta[:, 0, None])
    unit = tuple(jnp.where(met.part == i, signs[:, i, None], 0.0) for i in range(3))
    normal = (c * unit[0] - s * unit[1], unit[2], s * unit[0] + c * unit[1])
    direction = tuple(-n for n in normal) if view.ray is None else columns(view.ray)
    hit = _along(columns(view.point), direction, met.depth)
    spin = unit[0] * (c * hit[2] - s * hit[0]) - unit[1] * (c * hit[0] + s * hit[2])
    return _residual(view, met, direction, hit, normal, (spin, -unit[0], -unit[1], -unit[2], 0.0), 1.0)


def _residual(
    view: View,
    met: Meeting,
    direction: tuple[Array, ...],
    hit: tuple[Array, ...],
    normal: tuple[Array, ...],
    slopes: tuple[Array | float, ...],
    length: Array | float,
) -> Residual:
    """Residual from where a ray meets a surface: ∇F there (of the given length) and the derivatives of F."""
    fall = -_dot(normal, direction)
    variance, damping = jnp.ones_like(met.depth), jnp.ones_like(met.depth)
    if view.ray is not None:
        variance = 1 + SIDEWAYS**2 / ((fall / length) ** 2 + GRAZING**2)
        steep = jnp.abs(fall)
        fall = jnp.sqrt(fall**2 + (GRAZING * length) ** 2)
        damping = steep / fall
    gain = view.gain * lax.rsqrt(variance)
    rate = -gain / fall
    x, y, z = hit
    p, q, r = normal
    return Residual(
        error=-met.depth * gain,
        miss=met.miss * view.gain / SIDEWAYS,
        variance=variance,
        slopes=tuple(column * rate for column in slopes),
        spins=((y * r - z * q) * rate, (z * p - x * r) * rate, (x * q - y * p) * rate),
        damping=damping,
    )


def _meeting(depth: Array, miss: Array | None = None, part: Array | int = 0) -> Meeting:
    part = jnp.broadcast_to(jnp.asarray(part, jnp.int32), depth.shape)
    return Meeting(depth, jnp.zeros_like(depth) if miss is None else miss, part)


def _nearer(square: Array | float, half: Array, constant: Array, inside: Array, root: Array) -> Array:
    """Where a ray enters t² square + 2 t half + constant = 0; its nearest place where it misses."""
    safe = square if isinstance(square, float) else jnp.where(jnp.abs(square) < 1e-3, 1e-3, square)
    enter = jnp.where(half < 0, constant / (root - half), -(half + root) / safe)
    return jnp.where(inside < 0, -half / safe, enter)


def _farther(square: Array | float, half: Array, constant: Array, root: Array) -> Array:
    """Where a ray leaves it."""
    safe = square if isinstance(square, float) else jnp.where(jnp.abs(square) < 1e-3, 1e-3, square)
    return jnp.where(half > 0, -constant / (half + root), (root - half) / safe)


def _along(point: tuple[Array, ...], direction: tuple[Array, ...], depth: Array) -> tuple[Array, ...]:
    return tuple(p + depth * d for p, d in zip(point, direction, strict=True))


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
