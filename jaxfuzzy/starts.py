"""Starts: many rough guesses of every kind for the surface of an object, from small windows of its points.

A window is a Gaussian weight round an anchor point, or all points. In each, a plane and three tied bases (those of the embeddings
cylinder, sphere, and x² + z² with a linear y for cones) are fitted by Taubin's generalised eigenproblem; moved to its mean,
the gradient matrix of a tied basis is diagonal, so that one matrix product of moments and a few power steps on a written-out
inverse serve all windows and bases at once. Guesses that windows cannot make come from the camera: an anchor as the front line
of a cylinder or cone, or as a point on a box's second face.

Taubin, "Estimation of planar curves, surfaces, and nonplanar space curves", IEEE PAMI 13(11), 1991.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy.arrays import Array
from jaxfuzzy.rays import View

ANCHORS = 32
COMPANY = 0.2
# A lid is so many deviations thick to either side; where there is none it is up here.
LID_THICKNESS, NOWHERE = 3.0, 1e3
WIDEST, NARROWER = 1.0, 2
POWER_STEPS = 8
FRONT_ANCHORS, FRONT_RADII, FRONT_NARROWING = 12, (0.2, 0.35, 0.55, 0.8, 1.1), (0.25, 0.6)
BOX_ANCHORS, BOX_PLANES, BOX_YAWS = 16, 5, 9
LID_RADII, LID_NARROWING = (0.85, 0.92, 1.0, 1.08), (0.0, 0.25, -0.25, 0.5, -0.5)


class Windows(NamedTuple):
    """What was fitted in each of W windows: parameters as in `rays`, planes (W, 4), middles (W, 3)."""

    cylinders: Array
    cones: Array
    spheres: Array
    planes: Array
    middles: Array


def invert(matrix: Array, right: Array) -> Array:
    """Solves symmetric positive definite systems (..., p, p) x = (..., p, k) by Gauss-Jordan, for many small ones at once."""
    size = matrix.shape[-1]
    rows = jnp.concatenate([matrix, right], -1)

    def eliminate(k: int, rows: Array) -> Array:
        pivot = lax.dynamic_index_in_dim(rows, k, -2)
        pivot = pivot / lax.dynamic_index_in_dim(pivot, k, -1)
        column = lax.dynamic_index_in_dim(rows, k, -1)
        chosen = (jnp.arange(size) == k)[:, None]
        return jnp.where(chosen, pivot, rows - column * pivot)

    return lax.fori_loop(0, size, eliminate, rows)[..., size:]


def rotation(about_x: Array, about_z: Array) -> Array:
    """Rotations (..., 3, 3) by the vectors (about_x, 0, about_z): Rodrigues' formula with its limit at no turn."""
    square = about_x**2 + about_z**2
    half = 0.5 * jnp.sqrt(square + 1e-30)
    # sin(angle) / angle and (1 - cos(angle)) / angle².
    once, twice = jnp.sin(2 * half) / (2 * half), 0.5 * (jnp.sin(half) / half) ** 2
    x, z = once * about_x, once * about_z
    xx, zz, xz = twice * about_x**2, twice * about_z**2, twice * about_x * about_z
    rows = ((1 - zz, -z, xz), (z, 1 - xx - zz, -x), (xz, x, 1 - xx))
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def dense(view: View) -> Array:
    """Which points have company: local density above a fifth of the largest. Uniform outliers have little (N,)."""
    # Added up axis by axis: a sum over a last axis of three takes twelve times as long.
    square = sum((c[:, None] - c) ** 2 for c in view.point[0])
    # A product with the mask, as one added up is no faster than its exponentials are one by one.
    company = (jnp.exp(-square / (2 * COMPANY**2)) @ view.mask) * view.mask
    return (company > 0.2 * company.max()) & (view.mask > 0)


def first_of(wanted: Array, count: int) -> Array:
    """Indices of the first `count` points that are wanted, then of the first others."""
    place = jnp.arange(len(wanted))
    return lax.top_k(-(place + jnp.where(wanted, 0, len(wanted))), count)[1]


def windows(view: View, anchors: Array, extra: Array) -> Windows:
    """Fits a plane and three tied bases in every window: round anchors (A, 3), `WIDEST` and narrower, all points, `extra` (N,)."""
    x, y, z = view.point[0]
    square = sum((a[:, None] - c) ** 2 for a, c in zip(anchors.T, (x, y, z), strict=True))
    # Each width is half the next: fourth powers in place of exponentials.
    narrow = [jnp.exp(-square / (2 * WIDEST**2))]
    for _ in range(NARROWER):
        narrow.append((narrow[-1] ** 2) ** 2)
    weight = jnp.concatenate([*narrow[::-1], jnp.ones_like(square[:1]), extra[None]]) * view.mask
    # Moments of (x²+z², y², x, z, y, 1), all windows in one product.
    terms = jnp.stack([x * x + z * z, y * y, x, z, y, jnp.ones_like(x)], -1)
    pairs = np.array([(i, j) for i in range(6) for j in range(i, 6)])
    place = np.zeros((6, 6), int)
    place[pairs[:, 0], pairs[:, 1]] = place[pairs[:, 1], pairs[:, 0]] = np.arange(len(pairs))
    moment = (weight @ (terms[:, pairs[:, 0]] * terms[:, pairs[:, 1]]))[:, place]
    moment = moment / (moment[:, 5:, 5:] + 1e-12)
    mean = moment[:, :5, 5]
    scatter = moment[:, :5, :5] - mean[:, :, None] * mean[:, None, :]
    mx, mz, my = mean[:, 2], mean[:, 3], mean[:, 4]
    one, zero = jnp.ones_like(mx), jnp.zeros_like(mx)
    # The same monomials about the window's mean: x²+z², x²+y²+z², x, z, y.
    shift = jnp.stack(
        [
            jnp.stack([one, zero, -2 * mx, -2 * mz, zero], -1),
            jnp.stack([one, one, -2 * mx, -2 * mz, -2 * my], -1),
            *(jnp.broadcast_to(row, (len(mx), 5)) for row in jnp.eye(5, dtype=x.dtype)[2:]),
        ],
        1,
    )
    scatter = shift @ scatter @ shift.transpose(0, 2, 1)
    flat = scatter[:, 2, 2] + scatter[:, 3, 3] + 1e-12
    full = flat + scatter[:, 4, 4]
    unit, unit3 = 0.5 * lax.rsqrt(flat), 0.5 * lax.rsqrt(full)
    scale = jnp.stack([unit, unit3, one, one, one], 1)
    scatter = scatter * scale[:, :, None] * scale[:, None, :] / full[:, None, None]
    # Bases: circle without y, paraboloid, sphere, plane; what a basis lacks is replaced by a unit diagonal.
    bases = jnp.stack(
        [scatter[:, i][:, :, i] for i in map(np.array, ((0, 2, 3, 4), (0, 2, 3, 4), (1, 2, 3, 4), (0, 2, 3, 4)))]
    )
    kept = np.ones((4, 4))
    kept[0, 3] = kept[3, 0] = 0
    used = (kept[:, :, None] * kept[:, None, :])[:, None]
    bases = jnp.where(used > 0, bases, jnp.eye(4, dtype=x.dtype)) + 2e-6 * jnp.eye(4, dtype=x.dtype)
    inverse = invert(bases, jnp.broadcast_to(jnp.eye(4, dtype=x.dtype), bases.shape))

    # All windows of all bases along the last axis: sums over a short last axis take many times as long.
    across = jnp.moveaxis(inverse, (-2, -1), (0, 1))

    def power(_: int, v: Array) -> Array:
        v = sum(across[:, i] * v[i] for i in range(4))  # type: ignore[assignment]
        return v * lax.rsqrt(sum(v[i] ** 2 for i in range(4)) + 1e-30)

    start = jnp.broadcast_to(jnp.array([1.0, 0.31, -0.73, 0.53], x.dtype)[:, None, None], across.shape[1:])
    v = jnp.moveaxis(lax.fori_loop(0, POWER_STEPS, power, start), 0, -1)
    bend = v[:3, :, 0] * jnp.stack([unit, unit, unit3])
    bend = jnp.where(jnp.abs(bend) < 1e-4, jnp.where(bend < 0, -1e-4, 1e-4), bend)
    ox, oz, oy = (-v[:3, :, i] / (2 * bend) for i in (1, 2, 3))
    round_ = jnp.sqrt(ox**2 + oz**2 + flat)
    narrowing = jnp.clip(-oy[1] / round_[1], -1.5, 1.5)
    return Windows(
        cylinders=jnp.stack([mx + ox[0], mz + oz[0], round_[0], zero, zero], -1),
        cones=jnp.stack([mx + ox[1], mz + oz[1], round_[1] + narrowing * my, narrowing, zero], -1),
        spheres=jnp.stack(
            [mx + ox[2], my + oy[2], mz + oz[2], jnp.sqrt(ox[2] ** 2 + oz[2] ** 2 + oy[2] ** 2 + full), zero], -1
        ),
        planes=_through(jnp.stack([v[3, :, 1], v[3, :, 3], v[3, :, 2]], -1), jnp.stack([mx, my, mz], -1)),
        middles=jnp.stack([mx, my, mz], -1),
    )


def front_lines(view: View, chosen: Array) -> tuple[Array, Array]:
    """Cylinders and cones that have an anchor on the line nearest to the camera, radii and slopes on a grid."""
    anchor = view.point[0].T[chosen][:, None, :]
    radii = jnp.asarray(FRONT_RADII, anchor.dtype)
    if view.ray is not None:
        away = view.ray[0].T[chosen][:, None, ::2]
    else:
        turn = np.arange(len(chosen)) * (np.pi * (3 - np.sqrt(5)))
        away = jnp.asarray(np.stack([np.cos(turn), np.sin(turn)], -1), anchor.dtype)[:, None, :]
    away = away * lax.rsqrt((away**2).sum(-1, keepdims=True) + 1e-12)

    def lines(narrowing: float) -> Array:
        a, b = anchor[..., 0] + radii * away[..., 0], anchor[..., 2] + radii * away[..., 1]
        return jnp.stack([a, b, radii + narrowing * anchor[..., 1], 0 * a + narrowing, 0 * a], -1).reshape(-1, 5)

    return lines(0.0), jnp.concatenate([lines(s) for s in FRONT_NARROWING])


def box_corners(view: View, anchor: Array, planes: Array, middles: Array) -> tuple[Array, Array]:
    """Boxes of two upright faces: a window's plane and an anchor on the other face, or an anchor on both at a grid of yaws.

    Args:
        view: The points.
        anchor: Points (A, 3), dense and not on the best plane.
        planes: The most upright of the best planes, (B, 4).
        middles: A point on each, (B, 3).

    Returns:
        Parameters (H, 4) and signs (H, 3) as in `rays.box`, without a third face.
    """
    grid = jnp.asarray(np.arange(BOX_YAWS) * (np.pi / 2 / BOX_YAWS), anchor.dtype)
    yaw = jnp.arctan2(planes[:, 2], planes[:, 0])
    first = jnp.broadcast_to(middles[:, None, :], (len(planes), len(anchor), 3))
    second = jnp.broadcast_to(anchor, first.shape)
    both = jnp.broadcast_to(anchor, (BOX_YAWS, len(anchor), 3))
    yaws = jnp.concatenate([yaw, grid])[:, None] + jnp.zeros((1, len(anchor)), anchor.dtype)
    through1, through2 = jnp.concatenate([first, both]), jnp.concatenate([second, both])
    c, s = jnp.cos(yaws), jnp.sin(yaws)
    k1 = c * through1[..., 0] + s * through1[..., 2]
    k2 = c * through2[..., 2] - s * through2[..., 0]
    theta = jnp.stack([yaws, k1, k2, 0 * yaws, 0 * yaws], -1).reshape(-1, 5)
    return _signed(theta, view, np.array([1.0, 1.0, 0.0]))


def box_tops(height: Array, theta: Array, signs: Array) -> tuple[Array, Array]:
    """The same boxes with a top face at each height: (B * heights, 5) and signs."""
    theta = jnp.broadcast_to(theta[:, None, :], (len(theta), len(height), 5)).at[:, :, 3].set(height)
    signs = jnp.broadcast_to(signs[:, None, :], (len(signs), len(height), 3)).at[:, :, 2].set(1.0)
    return theta.reshape(-1, 5), signs.reshape(-1, 3)


def box_ledges(view: View, height: Array, planes: Array, middles: Array) -> tuple[Array, Array]:
    """Boxes of one upright face, a window's plane, and a top face at each height."""
    yaw = jnp.arctan2(planes[:, 2], planes[:, 0])
    k1 = jnp.cos(yaw) * middles[:, 0] + jnp.sin(yaw) * middles[:, 2]
    theta = jnp.stack([yaw, k1, 0 * k1, 0 * k1, 0 * k1], -1)
    theta, signs = _signed(theta, view, np.array([1.0, 0.0, 0.0]))
    return box_tops(height, theta, signs)


def _signed(theta: Array, view: View, active: np.ndarray) -> tuple[Array, Array]:
    """The outward side of each face: where the camera is, or without one all sides, four times as many boxes."""
    if view.eye is None:
        quarters = np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]]) * active
        signs = jnp.repeat(jnp.asarray(quarters, theta.dtype), len(theta), axis=0)
        return jnp.tile(theta, (4, 1)), signs
    ex, ez = view.eye[0, 0], view.eye[0, 2]
    c, s = jnp.cos(theta[:, 0]), jnp.sin(theta[:, 0])
    beyond = jnp.stack([c * ex + s * ez - theta[:, 1], c * ez - s * ex - theta[:, 2], jnp.ones_like(c)], -1)
    return theta, jnp.where(beyond > 0, 1.0, -1.0) * jnp.asarray(active, theta.dtype)


def _through(normal: Array, point: Array) -> Array:
    normal = normal * lax.rsqrt((normal**2).sum(-1, keepdims=True) + 1e-12)
    offset = (normal * point).sum(-1, keepdims=True)
    return jnp.concatenate([normal, offset, jnp.zeros_like(offset)], -1)


class Lid(NamedTuple):
    """The level surface that holds most points.

    Attributes:
        level: Its height; far up where there is none.
        on: Which points lie on it (N,).
        below: Which points with company lie below it (N,), all of them where there is none.
    """

    level: Array
    on: Array
    below: Array


def lid(view: View, normal: Array, middle: Array, usable: Array, company: Array) -> Lid:
    """Finds it among small pieces of surface.

    Args:
        view: The points.
        normal: Normals of the pieces (W, 3).
        middle: Their middles (W, 3).
        usable: Which of them to trust (W,).
        company: Which points have company (N,).
    """
    y = view.point[0, 1]
    flat = jnp.where((jnp.abs(normal[:, 1]) > 0.9) & usable, middle[:, 1], NOWHERE)
    near = jnp.abs(y - flat[:, None]) * view.gain < LID_THICKNESS
    most = jnp.argmax((near & company).sum(-1))
    on = near[most] & company
    return Lid(flat[most], on, (company & (y < flat[most]) & ~on).astype(y.dtype))


def lid_bodies(view: View, below: Array, lid: Lid) -> Array:
    """Bodies of revolution under a lid (H, 5): its points' mean and spread give the rim, a grid the rest.

    Args:
        view: The points.
        below: What fits the points below the lid (2, 5), a cylinder and a cone.
        lid: The lid.
    """
    x, _, z = view.point[0]
    total = lid.on.sum() + 1e-9
    mx, mz = (lid.on * x).sum() / total, (lid.on * z).sum() / total
    # A disc has ⟨ρ²⟩ = r² / 2.
    radius = jnp.sqrt(2 * (lid.on * ((x - mx) ** 2 + (z - mz) ** 2)).sum() / total)
    sizes, slopes = (c.ravel() for c in np.meshgrid(LID_RADII, LID_NARROWING))
    rim = radius * sizes
    fields = (mx + 0 * rim, mz + 0 * rim, rim + slopes * lid.level, 0 * rim + slopes, lid.level + 0 * rim)
    return jnp.concatenate([jnp.stack(fields, -1).astype(x.dtype), below.at[:, 4].set(lid.level)])
