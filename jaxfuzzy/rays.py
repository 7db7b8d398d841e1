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
        point: Three coordinates, each (1, N), or (H, N) where every hypothesis has its own frame.
        ray: Unit direction of each viewing ray, in the same form; None without a camera.
        eye: Where the camera stands, three coordinates (1, 1) or (H, 1); None without a camera.
        gain: One over each point's deviation (N,).
        mask: Weight of each point (N,), 0 for padding.
    """

    point: tuple[Array, Array, Array]
    ray: tuple[Array, Array, Array] | None
    eye: tuple[Array, Array, Array] | None
    gain: Array
    mask: Array


class Residual(NamedTuple):
    """Residuals of H hypotheses at N points.

    Attributes:
        error: Measured less predicted depth (or signed distance, inwards positive), in deviations.
        miss: How far a ray passes by the surface, in deviations; 0 where it meets it.
        slopes: Derivative of `error` by each of the five parameters, (H, N) each.
        spins: Derivative of `error` by a small turn of the points about x, y and z.
        variance: Of the residual, in units of the point's own; slanted surfaces turn sideways errors into depth.
        part: Which part of the surface was met, an integer.
    """

    error: Array
    miss: Array
    slopes: tuple[Array, ...]
    spins: tuple[Array, Array, Array]
    variance: Array
    part: Array


def turned(view: View, rotation: Array) -> View:
    """The view in the frame of each hypothesis, `rotation` (H, 3, 3) applied to points, rays and camera."""
    turn = lambda v: tuple(sum(rotation[:, i, j, None] * v[j] for j in range(3)) for i in range(3))
    return view._replace(
        point=turn(view.point),
        ray=None if view.ray is None else turn(view.ray),
        eye=None if view.eye is None else turn(view.eye),
    )


def taken(view: View, count: int) -> View:
    """The first `count` points of a view whose points are in an order that makes any beginning a fair sample."""
    cut = lambda v: None if v is None else tuple(c[:, :count] for c in v)
    return view._replace(point=cut(view.point), ray=cut(view.ray), gain=view.gain[:count], mask=view.mask[:count])


def plane(theta: Array, view: View) -> Residual:
    """Plane n·x = k, theta (H, 5) = (n, k, unused)."""
    n, k = tuple(theta[:, i, None] for i in range(3)), theta[:, 3, None]
    length = jnp.sqrt(_dot(n, n) + TINY)
    gap = (k - _dot(n, view.point)) / length
    if view.ray is None:
        cosine, depth, outward = jnp.ones_like(gap), -gap, 1.0
        direction = tuple(-c / length for c in n)
    else:
        direction = view.ray
        cosine = _dot(n, direction) / length
        # F must grow towards the camera, whichever way the normal points.
        outward = jnp.where(cosine < 0, 1.0, -1.0)
        cosine = jnp.maximum(jnp.abs(cosine), 0.02)
        depth = -gap * outward / cosine
    hit = _along(view.point, direction, depth)
    normal = tuple(c * outward / length for c in n)
    slopes = (*(c * outward / length for c in hit), -outward / length)
    return _residual(view, depth, 0.0, cosine, cosine, hit, normal, slopes)


def sphere(theta: Array, view: View) -> Residual:
    """Sphere, theta (H, 5) = (center, radius, unused)."""
    radius = jnp.abs(theta[:, 3, None]) + 1e-4
    away = tuple(p - theta[:, i, None] for i, p in enumerate(view.point))
    square = _dot(away, away)
    if view.ray is None:
        far = jnp.sqrt(square + TINY)
        depth, miss, fall = far - radius, 0.0, radius
        direction = tuple(-c / far for c in away)
    else:
        direction = view.ray
        half, constant = _dot(away, direction), square - radius**2
        inside = half**2 - constant
        root = jnp.sqrt(jnp.maximum(inside, 0.0) + TINY)
        depth, fall = _nearer(jnp.ones_like(half), half, constant, inside, root), root
        miss = jnp.maximum(-inside, 0.0) / (2 * radius)
    hit = _along(away, direction, depth)
    place = _along(view.point, direction, depth)
    return _residual(view, depth, miss, fall, fall / radius, place, hit, (*(-c for c in hit), -radius), radius)


def revolution(theta: Array, detail: Array | None, view: View) -> Residual:
    """Cylinder or cone about y: theta (H, 5) = (x, z, radius at y = 0, how much it narrows a unit of y, level).

    Args:
        theta: Parameters.
        detail: None for the endless side alone, else (H, 3): kind of end (`SIDE`, `CLOSED` or `OPEN`), height of the rim,
            unused. The level is the height of the lid of a closed body, of the floor of an open one.
        view: The points. The camera is above the rim.
    """
    a, b, r0, narrowing = (theta[:, i, None] for i in range(4))
    x, y, z = view.point
    dx, dz, rim = x - a, z - b, r0 - narrowing * y
    lean = lax.optimization_barrier(jnp.sqrt(1 + narrowing**2))
    if view.ray is None:
        far = jnp.sqrt(dx**2 + dz**2 + TINY)
        depth, miss = (far - rim) / lean, 0.0
        direction = (-dx / far / lean, -narrowing / lean + 0 * far, -dz / far / lean)
    else:
        direction = u, v, w = view.ray
        square = u * u + w * w - (narrowing * v) ** 2
        half = dx * u + dz * w + narrowing * v * rim
        constant = dx * dx + dz * dz - rim * rim
        inside = half * half - square * constant
        root = jnp.sqrt(jnp.maximum(inside, 0.0) + TINY)
        depth = _nearer(square, half, constant, inside, root)
        miss = jnp.maximum(-inside, 0.0)
    inner: Array | float = 1.0
    if detail is not None:
        over = y + depth * v > jnp.where(detail[:, :1] == CLOSED, theta[:, 4, None], detail[:, 1, None])
        back = over & (detail[:, :1] == OPEN)
        depth = jnp.where(back, _farther(square, half, constant, root), depth)
        inner = jnp.where(back, -1.0, 1.0)
    hx, hy, hz = _along((dx, y, dz), direction, depth)
    radius = r0 - narrowing * hy
    floor = jnp.maximum(radius, 0.02 * jnp.abs(r0) + 1e-4)
    if view.ray is None:
        fall = floor * lean
    else:
        fall = root
        miss = miss / (2 * jnp.maximum(square, 0.05) * floor) + jnp.maximum(-radius, 0.0)
    normal = (hx * inner, narrowing * radius * inner, hz * inner)
    slopes = (-hx * inner, -hz * inner, -radius * inner, radius * hy * inner)
    place, length, cosine, part = (hx + a, hy, hz + b), floor * lean, fall / (floor * lean), None
    if detail is not None:
        # Over the rim: the lid of a closed body; of an open one the inner wall down to the floor.
        level = theta[:, 4, None]
        down = jnp.maximum(-v, 0.02)
        flat = (over & (detail[:, :1] == CLOSED)) | (back & (hy < level))
        drop = (y - level) / down
        fx, fz = dx + drop * u, dz + drop * w
        beyond = jnp.sqrt(fx**2 + fz**2 + TINY) - (r0 - narrowing * level)
        above = jnp.where(back & ~flat, jnp.maximum(hy - detail[:, 1, None], 0.0), 0.0)
        miss = jnp.where(flat, jnp.maximum(beyond, 0.0) * down + jnp.maximum(v, 0.0), miss) + above
        depth = jnp.where(flat, drop, depth)
        fall, length = jnp.where(flat, down, fall), jnp.where(flat, 1.0, length)
        cosine = jnp.where(flat, down, cosine)
        place = tuple(jnp.where(flat, f, p) for f, p in zip((fx + a, level, fz + b), place, strict=True))
        normal = tuple(jnp.where(flat, f, n) for f, n in zip((0.0, 1.0, 0.0), normal, strict=True))
        slopes = (*(jnp.where(flat, 0.0, c) for c in slopes), jnp.where(flat, -1.0, 0.0))
        part = jnp.where(flat, 1, jnp.where(back, 2, 0))
    return _residual(view, depth, miss, fall, cosine, place, normal, slopes, length, part)


def box(theta: Array, signs: Array, view: View) -> Residual:
    """Corner of a box, theta (H, 5) = (yaw, offsets of the faces along x', z', y, unused).

    The faces of a convex corner meet a ray in turn; the last one entered is the one seen.

    Args:
        theta: Parameters.
        signs: Outward side of each face (H, 3), 0 for no face.
        view: The points.
    """
    # Behind a barrier: else they are computed anew for every point.
    c, s = lax.optimization_barrier((jnp.cos(theta[:, 0, None]), jnp.sin(theta[:, 0, None])))
    x, y, z = view.point
    across = (c * x + s * z, c * z - s * x, y)
    side = tuple(signs[:, i, None] for i in range(3))
    if view.ray is None:
        fall = [jnp.where(side[i] != 0, 1.0, -1.0) for i in range(3)]
    else:
        u, v, w = view.ray
        fall = [-side[0] * (c * u + s * w), -side[1] * (c * w - s * u), -side[2] * v]
    gaps = [side[i] * (across[i] - theta[:, 1 + i, None]) for i in range(3)]
    reach = [jnp.where(fall[i] > 0.02, gaps[i] / jnp.maximum(fall[i], 0.02), -FAR) for i in range(3)]
    depth = jnp.maximum(jnp.maximum(reach[0], reach[1]), reach[2])
    own = (depth <= reach[0], depth <= reach[1], depth <= reach[2])
    pick = lambda of: jnp.where(own[0], of[0], jnp.where(own[1], of[1], of[2]))
    cosine = pick(fall)
    unit = [jnp.where(own[0], side[0], 0.0), jnp.where(own[1] & ~own[0], side[1], 0.0)]
    unit.append(jnp.where(own[0] | own[1], 0.0, side[2]))
    normal = (c * unit[0] - s * unit[1], unit[2], s * unit[0] + c * unit[1])
    direction = tuple(-n for n in normal) if view.ray is None else view.ray
    # A ray that no face looks at is an outlier: far off, and without a say.
    lost = depth <= -FAR
    depth, cosine = jnp.where(lost, FAR, depth), jnp.maximum(cosine, 0.02)
    hit = _along(view.point, direction, depth)
    spin = unit[0] * (c * hit[2] - s * hit[0]) - unit[1] * (c * hit[0] + s * hit[2])
    slopes = tuple(jnp.where(lost, 0.0, column) for column in (spin, -unit[0], -unit[1], -unit[2]))
    part = jnp.where(own[0], 0, jnp.where(own[1], 1, 2))
    return _residual(view, depth, 0.0, cosine, cosine, hit, normal, slopes, part=part)


def _residual(
    view: View,
    depth: Array,
    miss: Array | float,
    fall: Array,
    cosine: Array,
    hit: tuple[Array, ...],
    normal: tuple[Array, ...],
    slopes: tuple[Array | float, ...],
    length: Array | float = 1.0,
    part: Array | None = None,
) -> Residual:
    """Residual from depth along the ray, `fall` = -∇F·d and `length` = |∇F|, both at the hit."""
    if view.ray is None:
        variance, gain = jnp.ones_like(depth), view.gain * jnp.ones_like(depth)
    else:
        variance = 1 + SIDEWAYS**2 / (cosine**2 + GRAZING**2)
        gain = view.gain * lax.rsqrt(variance)
        fall = jnp.sqrt(fall**2 + (GRAZING * length) ** 2)
    rate = -gain / fall
    x, y, z = hit
    p, q, r = normal
    spins = ((y * r - z * q) * rate, (z * p - x * r) * rate, (x * q - y * p) * rate)
    unused = (jnp.zeros_like(depth),) * (5 - len(slopes))
    return Residual(
        error=-depth * gain,
        miss=miss * view.gain / SIDEWAYS * jnp.ones_like(depth),
        slopes=(*(column * rate for column in slopes), *unused),
        spins=spins,
        variance=variance,
        part=jnp.zeros(depth.shape, jnp.int32) if part is None else part,
    )


def _nearer(square: Array, half: Array, constant: Array, inside: Array, root: Array) -> Array:
    """Where a ray enters t² square + 2 t half + constant = 0; its nearest place where it misses."""
    safe = jnp.where(jnp.abs(square) < 1e-3, 1e-3, square)
    enter = jnp.where(half < 0, constant / (root - half), -(half + root) / safe)
    return jnp.where(inside < 0, -half / safe, enter)


def _farther(square: Array, half: Array, constant: Array, root: Array) -> Array:
    """Where a ray leaves it."""
    safe = jnp.where(jnp.abs(square) < 1e-3, 1e-3, square)
    return jnp.where(half > 0, -constant / (half + root), (root - half) / safe)


def _along(point: tuple[Array, ...], direction: tuple[Array, ...], depth: Array) -> tuple[Array, ...]:
    return tuple(p + depth * d for p, d in zip(point, direction, strict=True))


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
