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

from jaxfuzzy.arrays import Array

# A matched point also errs sideways, by this share of its deviation in depth; on a surface seen at a slant that is depth error.
SIDEWAYS = 0.2
# Near a silhouette depth and slope of a residual grow without bound: cosines of incidence below this are taken as this.
GRAZING = 0.12
TINY = 1e-12


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
        slopes: Derivative of `error` by each parameter, (H, N) each.
        spins: Derivative of `error` by a small turn of the points about x, y and z.
        log_std: Logarithm of the residual's deviation in units of the point's own.
        part: Which part of the surface was met, an integer.
    """

    error: Array
    miss: Array
    slopes: tuple[Array, ...]
    spins: tuple[Array, Array, Array]
    log_std: Array
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
    """Plane n·x = k, theta (H, 4) = (n, k)."""
    n, k = tuple(theta[:, i, None] for i in range(3)), theta[:, 3, None]
    length = jnp.sqrt(_dot(n, n) + TINY)
    gap = (k - _dot(n, view.point)) / length
    cosine = jnp.ones_like(gap) if view.ray is None else _dot(n, view.ray) / length
    steep = jnp.where(jnp.abs(cosine) < 0.02, jnp.where(cosine < 0, -0.02, 0.02), cosine)
    depth = -gap if view.ray is None else gap / steep
    direction = tuple(-c / length for c in n) if view.ray is None else view.ray
    hit = _along(view.point, direction, depth)
    # F must grow towards the camera, whichever way the normal points.
    outward = 1.0 if view.ray is None else -jnp.sign(steep)
    normal = tuple(c * outward / length for c in n)
    slopes = (*(c * outward / length for c in hit), -outward / length)
    return _residual(view, depth, 0.0, jnp.abs(steep), jnp.abs(steep), hit, normal, slopes)


def sphere(theta: Array, view: View) -> Residual:
    """Sphere, theta (H, 4) = (center, radius)."""
    radius = jnp.abs(theta[:, 3, None]) + 1e-4
    away = tuple(p - theta[:, i, None] for i, p in enumerate(view.point))
    square = _dot(away, away)
    if view.ray is None:
        far = jnp.sqrt(square + TINY)
        depth, miss, fall = far - radius, jnp.zeros_like(far), radius
        direction = tuple(-c / far for c in away)
    else:
        direction = view.ray
        half, constant = _dot(away, direction), square - radius**2
        inside = half**2 - constant
        depth, fall = _first_root(1.0, half, constant, inside)
        miss = jnp.maximum(-inside, 0.0) / (2 * radius)
    hit = _along(away, direction, depth)
    place = _along(view.point, direction, depth)
    slopes = (*(-c for c in hit), -radius)
    return _residual(view, depth, miss, fall, fall / radius, place, hit, slopes, radius)


def revolution(theta: Array, view: View) -> Residual:
    """Side of a cylinder or cone about y, theta (H, 4) = (x, z, radius at y = 0, how much it narrows a unit of y)."""
    a, b, r0, narrowing = (theta[:, i, None] for i in range(4))
    x, y, z = view.point
    dx, dz, rim = x - a, z - b, r0 - narrowing * y
    lean = jnp.sqrt(1 + narrowing**2)
    if view.ray is None:
        far = jnp.sqrt(dx**2 + dz**2 + TINY)
        depth = (far - rim) / lean
        direction = (-dx / far / lean, -narrowing / lean + 0 * far, -dz / far / lean)
        miss = jnp.zeros_like(far)
    else:
        direction = view.ray
        u, v, w = direction
        square = u * u + w * w - (narrowing * v) ** 2
        half = dx * u + dz * w + narrowing * v * rim
        constant = dx * dx + dz * dz - rim * rim
        inside = half * half - square * constant
        depth, fall = _first_root(square, half, constant, inside)
        miss = jnp.maximum(-inside, 0.0)
    hx, hy, hz = _along((dx, y, dz), direction, depth)
    radius = r0 - narrowing * hy
    floor = jnp.maximum(radius, 0.02 * jnp.abs(r0) + 1e-4)
    if view.ray is None:
        fall = floor * lean
    else:
        miss = miss / (2 * jnp.maximum(square, 0.05) * floor) + jnp.maximum(-radius, 0.0)
    slopes = (-hx, -hz, -radius, radius * hy)
    normal = (hx, narrowing * radius, hz)
    return _residual(view, depth, miss, fall, fall / (floor * lean), (hx + a, hy, hz + b), normal, slopes, floor * lean)


def box(theta: Array, signs: Array, view: View) -> Residual:
    """Corner of a box, theta (H, 4) = (yaw, offsets of the faces along x', z', y), signs (H, 3) = outward side, 0 for no face.

    The faces of a convex corner meet a ray in turn; the last one entered is the one seen.
    """
    c, s = jnp.cos(theta[:, 0, None]), jnp.sin(theta[:, 0, None])
    x, y, z = view.point
    across = (c * x + s * z, c * z - s * x, y)
    offsets = tuple(theta[:, 1 + i, None] for i in range(3))
    side = tuple(signs[:, i, None] for i in range(3))
    if view.ray is None:
        reach = [jnp.where(side[i] != 0, side[i] * (across[i] - offsets[i]), -1e3) for i in range(3)]
        fall = [jnp.ones_like(reach[0])] * 3
    else:
        u, v, w = view.ray
        toward = (c * u + s * w, c * w - s * u, v)
        fall = [-side[i] * toward[i] for i in range(3)]
        reach = [
            jnp.where(fall[i] > 0.02, side[i] * (across[i] - offsets[i]) / jnp.maximum(fall[i], 0.02), -1e3)
            for i in range(3)
        ]
    depth = jnp.maximum(jnp.maximum(reach[0], reach[1]), reach[2])
    part = jnp.where(depth <= reach[0], 0, jnp.where(depth <= reach[1], 1, 2))
    own = [part == i for i in range(3)]
    cosine = sum(jnp.where(own[i], fall[i], 0.0) for i in range(3))
    unit = [jnp.where(own[i], side[i], 0.0) for i in range(3)]
    normal = (c * unit[0] - s * unit[1], unit[2], s * unit[0] + c * unit[1])
    direction = tuple(-n for n in normal) if view.ray is None else view.ray
    hit = _along(view.point, direction, depth)
    spin = unit[0] * (c * hit[2] - s * hit[0]) - unit[1] * (c * hit[0] + s * hit[2])
    slopes = (spin, -unit[0], -unit[1], -unit[2])
    found = depth > -1e2
    depth, cosine = jnp.where(found, depth, 1e2), jnp.where(found, jnp.maximum(cosine, 0.02), 1.0)
    slopes = tuple(jnp.where(found, column, 0.0) for column in slopes)
    return _residual(view, depth, 0.0, cosine, cosine, hit, normal, slopes, part=part)


def _residual(
    view: View,
    depth: Array,
    miss: Array | float,
    fall: Array,
    cosine: Array,
    hit: tuple[Array, ...],
    normal: tuple[Array, ...],
    slopes: tuple[Array, ...],
    length: Array | float = 1.0,
    part: Array | None = None,
) -> Residual:
    """Residual from depth along the ray, `fall` = -∇F·d and `length` = |∇F|, both at the hit."""
    gain = view.gain * jnp.ones_like(depth)
    log_std = jnp.zeros_like(depth)
    if view.ray is not None:
        log_std = 0.5 * jnp.log1p(SIDEWAYS**2 / (cosine**2 + GRAZING**2))
        gain = gain * jnp.exp(-log_std)
        fall = jnp.sqrt(fall**2 + (GRAZING * length) ** 2)
    rate = -gain / fall
    x, y, z = hit
    p, q, r = normal
    spins = ((y * r - z * q) * rate, (z * p - x * r) * rate, (x * q - y * p) * rate)
    return Residual(
        error=-depth * gain,
        miss=miss * view.gain / SIDEWAYS * jnp.ones_like(depth),
        slopes=tuple(column * rate for column in slopes),
        spins=spins,
        log_std=log_std,
        part=jnp.zeros(depth.shape, jnp.int32) if part is None else part,
    )


def _first_root(square: Array | float, half: Array, constant: Array, inside: Array) -> tuple[Array, Array]:
    """Where a ray enters a t² square + 2 t half + constant = 0, and how steeply; its nearest place where it misses."""
    root = jnp.sqrt(jnp.maximum(inside, 0.0) + TINY)
    safe = jnp.where(jnp.abs(square) < 1e-3, 1e-3, square) * jnp.ones_like(half)
    enter = jnp.where(half < 0, constant / (root - half), -(half + root) / safe)
    return jnp.where(inside < 0, -half / safe, enter), root


def _along(point: tuple[Array, ...], direction: tuple[Array, ...], depth: Array) -> tuple[Array, ...]:
    return tuple(p + depth * d for p, d in zip(point, direction, strict=True))


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
