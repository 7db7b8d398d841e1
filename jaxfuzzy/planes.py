"""Planes in a view: one linear fuzzy variety beside a noise cluster, found from many starts.

The variety is that of paper eqs. 12-20 in the 3D space with m = 2, its noise distance annealed. What lets it find a table of
which little is seen is that its members are not points but small patches of the view, each with its mean and its scatter: a
patch is near a plane when its mean lies on it AND it does not run through it. A slab through clutter holds many points, but
hardly a patch, and where noise is large enough for that the points of a patch still run through it from one side to the other, by
which it is told. A plane is scored by its members, minus the patches seen behind it (nothing is seen through a table), times a
prior on its angle.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy.arrays import Array, Bool, Float, Int, lengths, on_device, record
from jaxfuzzy.linalg import TO_STD, normalised, tangents

# Patches along each side of the view. 24 leaves a patch of a 450 x 375 image some 19 x 16 pixels: over that, a standing
# surface runs through a lying plane by several deviations of a stereo match, and a strip of board between cones fills some.
GRID = 24
# A cloud is thinned to the last of these and padded to the next, so that few sizes are ever compiled.
CAPACITIES = (1024, 4096, 16384)
# For each direction to start from: the offsets that hold most patches, out of so many bins.
OFFSETS, BINS = 4, 48
# Noise distance of a patch and of a point, in standard deviations.
PATCH_DELTA, POINT_DELTA = 1.0, 2.5
# Sideways deviation of a point over the one along its ray: keeps grazing planes from becoming infinitely thin.
SIDEWAYS = 0.1
# Cosine between its normal and the ray to its middle below which a plane is seen edge on: it ends no view.
EDGE_ON = 0.2
# Share of the scatter of a patch about a plane that follows the place in the view, in the mean of its members, from which on it is
# a slab through things that stand across it; deviations below the second share of the expected one are none. On photographs
# tables and walls have 0.15 to 0.62, slabs 0.76 to 0.98.
SLANTED, TRUE = 0.7, 0.1
# Coordinates of the products that make a scatter, how often each stands in it, and how often cofactors are squared.
PAIRS, TWICE = np.triu_indices(3), np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0], np.float32)
SQUARINGS = 9


@record
class View:
    """Points with their noise, and the patch of the view that each is seen in; padded with weight 0.

    Attributes:
        points: The points.
        weights: Their weights.
        ray: One standard deviation along the viewing ray; zero where no camera is known.
        floor: Standard deviation in any direction.
        patch: Index of the patch, below GRID².
        place: Where in the view it is seen, in patches.
    """

    points: Float[Array, "N 3"]
    weights: Float[Array, " N"]
    ray: Float[Array, "N 3"]
    floor: Float[Array, " N"]
    patch: Int[Array, " N"]
    place: Float[Array, "N 2"]


@record
class Prior:
    """What is known of a plane before it is looked for.

    Attributes:
        starts: Directions to start from.
        axis: The direction that the angle refers to.
        angle: Center, standard deviation and largest difference of the angle between normal and axis, in radians.
        ends_view: The plane ends the view: it is not seen edge on, and all that is behind it counts against it, not only what
            is behind within its outline.
        eye: The camera and 1, or zeros where it is not known.
    """

    starts: Float[Array, "S 3"]
    axis: Float[Array, "3"]
    angle: Float[Array, "3"]
    ends_view: Bool[Array, ""]
    eye: Float[Array, "4"]


@record
class Candidate:
    """A plane normal · x = offset.

    Attributes:
        normal: Unit normal, pointing to the camera, or where it is not known to the side that holds more.
        offset: Its offset.
        support: Share of the view that lies on it, net of what is seen behind it.
        spread: Robust standard deviation of its points over the one expected.
    """

    normal: Float[Array, "3"]
    offset: Float[Array, ""]
    support: Float[Array, ""]
    spread: Float[Array, ""]


@jax.jit
def fit_plane(view: View, prior: Prior, scale: Float[Array, ""]) -> Candidate:
    """The best plane of a view; `scale` multiplies every standard deviation."""
    patches, middle = _patches(view)
    patches = patches._replace(ray=scale * patches.ray, floor=scale * patches.floor)
    weight = patches.weight

    def step(planes: tuple[Array, Array], delta: Array) -> tuple[tuple[Array, Array], None]:
        # One variety and noise, m = 2: u = 1 / (1 + D / delta^2) is eq. 20, u^2 weighs the scatter of eq. 16.
        gap, through, variance = _apart(patches, *planes)
        u2 = weight / (1 + (gap**2 + through) / variance / delta**2) ** 2 / variance
        return _smallest_directions(u2, patches, planes[0]), None

    def judge(
        normal: Array, offset: Array, u: Array, residual: Array, within: Array, slanted: Array
    ) -> tuple[Array, Array, Array]:
        above, below = (weight * (residual > 3)).sum(), (weight * (residual < -3)).sum()
        seen_from = (prior.eye[:3] - middle) @ normal - offset
        side = jnp.where(jnp.where(prior.eye[3] > 0, seen_from, above - below) < 0, -1, 1)
        away = jnp.linalg.norm(u @ patches.mean / jnp.maximum(u.sum(), 1e-9) - (prior.eye[:3] - middle))
        edge_on = prior.ends_view & (prior.eye[3] > 0) & (jnp.abs(seen_from) < EDGE_ON * away)
        outline = jnp.where(prior.ends_view, 1, within)
        hidden = jnp.where(side * residual < -3, weight * outline, 0).sum()
        center, deviation, largest = prior.angle
        angle = jnp.arccos(jnp.clip(jnp.abs(normal @ prior.axis), 0, 1)) - center
        support = (u.sum() - hidden) / weight.sum()
        score = jnp.where(support > 0, support * jnp.exp(-0.5 * (angle / deviation) ** 2), support)
        # Seen from above, what stands is nothing but slanted.
        slab = (prior.eye[3] > 0) & (u @ slanted > SLANTED * u.sum())
        return jnp.where((jnp.abs(angle) <= largest) & ~edge_on & ~slab, score, -jnp.inf), support, side

    starts = jnp.repeat(prior.starts, OFFSETS, axis=0), _offsets(patches, prior.starts).ravel()
    deltas = PATCH_DELTA * jnp.concatenate([4 * 0.8 ** jnp.arange(6.0), jnp.ones(4)]).astype(middle.dtype)
    (normals, offsets), _ = lax.scan(step, starts, deltas)
    gap, through, variance = _apart(patches, normals, offsets)
    shares = weight / (1 + (gap**2 + through) / variance / PATCH_DELTA**2)
    residuals = gap * lax.rsqrt(variance)
    slanted = _squares(normals, patches.slope) / (through + TRUE**2 * variance)
    scores, supports, sides = jax.vmap(judge)(normals, offsets, shares, residuals, _within(shares), slanted)
    best = jnp.argmax(scores)
    normal, offset = sides[best] * normals[best], sides[best] * offsets[best]

    # Finish on the points of the patches that belong to it.
    rays, floors, points = scale * view.ray, scale * view.floor, view.points - middle
    trust = view.weights * (shares[best] / jnp.maximum(weight, 1e-9))[view.patch]

    def finish(plane: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        normal, offset = plane
        variance = (rays @ normal) ** 2 + floors**2
        u2 = trust / (1 + (points @ normal - offset) ** 2 / variance / POINT_DELTA**2) ** 2 / variance
        return _smallest_direction(u2, points, normal), None

    (normal, offset), _ = lax.scan(finish, (normal, offset), length=6)
    residual = jnp.abs(points @ normal - offset) * lax.rsqrt((rays @ normal) ** 2 + floors**2)
    # What is further than 5 belongs to something else.
    spread = TO_STD * _weighted_median(residual, jnp.where(residual < 5, trust, 0))
    support = jnp.where(scores[best] == -jnp.inf, -1, supports[best])
    return Candidate(normal, offset + middle @ normal, support, spread)


class _Patches(NamedTuple):
    """Means (P, 3) about the middle of all, scatters (P, 6) as `PAIRS` has them, weights (P,), rays (P, 3) and floors (P,).

    `slope` (P, 6) is what of the scatter follows the place in the view.
    """

    mean: Array
    scatter: Array
    slope: Array
    weight: Array
    ray: Array
    floor: Array


def _apart(patches: _Patches, normals: Array, offsets: Array) -> tuple[Array, Array, Array]:
    """Of planes (S, 3), (S,) and patches: distance, mean square of a patch's points about it, and its variance (S, P) each."""
    through = _squares(normals, patches.scatter)
    return normals @ patches.mean.T - offsets[:, None], through, (normals @ patches.ray.T) ** 2 + patches.floor**2


def _squares(normals: Array, scatter: Array) -> Array:
    """Mean squares (S, P) along normals (S, 3) of scatters (P, 6)."""
    return (normals[:, PAIRS[0]] * normals[:, PAIRS[1]] * TWICE) @ scatter.T


def _smallest_directions(weights: Array, patches: _Patches, toward: Array) -> tuple[Array, Array]:
    """For weights (S, P) the same as `_smallest_direction`, from moments that one product gives.

    The eigenvector of the smallest eigenvalue is that of the largest one of the cofactors, found by squaring them.
    """
    mean = patches.mean
    moments = jnp.concatenate(
        [jnp.ones_like(mean[:, :1]), mean, patches.scatter + mean[:, PAIRS[0]] * mean[:, PAIRS[1]]], 1
    )
    total = weights @ moments
    total = total / jnp.maximum(total[:, :1], jnp.finfo(mean.dtype).tiny)
    center = total[:, 1:4]
    xx, xy, xz, yy, yz, zz = (total[:, 4:] - center[:, PAIRS[0]] * center[:, PAIRS[1]]).T
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    power = jnp.moveaxis(jnp.stack([jnp.stack([a, b, c]), jnp.stack([b, d, e]), jnp.stack([c, e, f])]), -1, 0)
    for _ in range(SQUARINGS):
        power = power / jnp.maximum(jnp.trace(power, axis1=1, axis2=2), jnp.finfo(mean.dtype).tiny)[:, None, None]
        power = (power[:, :, :, None] * power[:, None]).sum(2)
    column = jnp.argmax(jnp.diagonal(power, axis1=1, axis2=2), axis=1)
    normal = jnp.take_along_axis(power, column[:, None, None], axis=2)[..., 0]
    normal = normalised(normal * lax.rsqrt(jnp.abs(normal).max(1, keepdims=True) + jnp.finfo(mean.dtype).tiny))
    normal = jnp.where((normal != 0).any(1, keepdims=True), normal, toward)
    normal = normal * jnp.where((normal * toward).sum(1, keepdims=True) < 0, -1, 1)
    return normal, (normal * center).sum(1)


def _smallest_direction(weights: Array, points: Array, toward: Array) -> tuple[Array, Array]:
    """Normal and offset of the plane of least weighted squared distance; of the two signs, the one near `toward`."""
    weights = weights / jnp.maximum(weights.sum(), jnp.finfo(points.dtype).tiny)
    mean = weights @ points
    centred = points - mean
    normal = jnp.linalg.eigh((centred * weights[:, None]).T @ centred)[1][:, 0]
    normal = normal * jnp.where(normal @ toward < 0, -1, 1)
    return normal, normal @ mean


def _offsets(patches: _Patches, normals: Array) -> Array:
    """Along directions (S, 3) the offsets (S, OFFSETS) where most patches lie, out of evenly spaced ones."""
    weight = patches.weight
    height, through, variance = _apart(patches, normals, jnp.zeros_like(normals[:, 0]))
    low = jnp.min(jnp.where(weight > 0, height, jnp.inf), axis=1, keepdims=True)
    high = jnp.max(jnp.where(weight > 0, height, -jnp.inf), axis=1, keepdims=True)
    offsets = low + (high - low) * (jnp.arange(BINS, dtype=height.dtype) + 0.5) / BINS
    rate = 1 / (variance * (4 * PATCH_DELTA) ** 2)
    near = lambda offset: (weight / (1 + ((height - offset[:, None]) ** 2 + through) * rate)).sum(1)
    held = lax.map(near, offsets.T).T
    padded = jnp.pad(held, ((0, 0), (1, 1)), constant_values=-1)
    peak = (held >= padded[:, :-2]) & (held > padded[:, 2:])
    return jnp.take_along_axis(offsets, lax.top_k(jnp.where(peak, held, -1), OFFSETS)[1], axis=1)


def _patches(view: View) -> tuple[_Patches, Array]:
    """The patches, and the middle of all that their means are about (3,)."""
    total = partial(jax.ops.segment_sum, segment_ids=view.patch, num_segments=GRID**2)
    weight = total(view.weights)
    share = (view.weights / jnp.maximum(weight, 1e-9)[view.patch])[:, None]
    first = total(share * jnp.concatenate([view.points, view.ray, view.floor[:, None]], axis=1))
    centred = view.points - first[view.patch, :3]
    second = total(share * centred[:, PAIRS[0]] * centred[:, PAIRS[1]])
    place = view.place - total(share * view.place)[view.patch]
    # Scatter of places (xx, xy, yy), and of places with points (2 x 3).
    across = total(share * place[:, [0, 0, 1]] * place[:, [0, 1, 1]])
    both = total(share[:, :, None] * place[:, :, None] * centred[:, None, :])
    xx, xy, yy = across.T[:, :, None]
    down, side = both[:, 0], both[:, 1]
    inverse = 1 / jnp.maximum(xx * yy - xy * xy, 1e-6)
    i, j = PAIRS
    slope = (yy * down[:, i] * down[:, j] + xx * side[:, i] * side[:, j]) * inverse
    slope = slope - xy * (down[:, i] * side[:, j] + side[:, i] * down[:, j]) * inverse
    # An empty patch has weight 0 and needs a finite deviation.
    floor = jnp.where(weight > 0, first[:, 6], 1)
    middle = weight @ first[:, :3] / jnp.maximum(weight.sum(), 1e-9)
    mean = jnp.where(weight[:, None] > 0, first[:, :3] - middle, 0)
    return _Patches(mean, second, slope, weight / weight.max(), first[:, 3:6], floor), middle


def _within(u: Float[Array, "S P"]) -> Float[Array, "S P"]:
    """How far each place of the view is inside the outline of members: 1 in the middle, small from four deviations on."""
    side = (np.arange(GRID) + 0.5) / GRID
    x, y = (c.ravel().astype(u.dtype) for c in np.meshgrid(side, side, indexing="ij"))
    terms = jnp.asarray(np.stack([x, y, x * x, x * y, y * y], axis=1))
    share = u / jnp.maximum(u.sum(axis=1, keepdims=True), 1e-9)
    mx, my, xx, xy, yy = (share @ terms).T[:, :, None]
    least = 1 / (12 * GRID**2)
    xx, xy, yy = xx - mx * mx + least, xy - mx * my, yy - my * my + least
    dx, dy = x - mx, y - my
    return jnp.exp((2 * xy * dx * dy - yy * dx**2 - xx * dy**2) / (8 * (xx * yy - xy * xy)))


def _weighted_median(values: Array, weights: Array) -> Array:
    """By halving the range that holds it, to the last digit; far faster than sorting."""
    half = weights.sum() / 2

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) / 2
        below = jnp.where(values <= middle, weights, 0).sum() >= half
        return jnp.where(below, low, middle), jnp.where(below, middle, high)

    start = jnp.zeros((), values.dtype), jnp.where(weights > 0, values, 0).max()
    return lax.fori_loop(0, jnp.finfo(values.dtype).nmant + 8, halve, start)[1]


def view_of(
    x: np.ndarray, w: np.ndarray, ray: np.ndarray, floor: np.ndarray, axis: np.ndarray, eye: np.ndarray | None
) -> View:
    """Thins and pads a cloud, and cuts what is seen of it into patches (from above where no camera is known)."""
    count = len(x)
    capacity = next((c for c in CAPACITIES if c >= count), CAPACITIES[-1])
    take = np.arange(count) if count <= capacity else np.linspace(0, count - 1, capacity).astype(int)
    x, w, ray, floor = x[take], w[take], ray[take], floor[take]
    seen = seen_at(x, axis, eye, w > 0)
    low, high = np.quantile(seen[w > 0], [0.002, 0.998], axis=0)
    place = np.clip((seen - low) / np.maximum(high - low, np.finfo(x.dtype).tiny) * GRID, 0, GRID - 1e-3)
    cell, place = place.astype(np.int32), place.astype(x.dtype)

    def padded(values: np.ndarray, filler: float = 0.0) -> Array:
        spare = np.full((capacity - len(x), *values.shape[1:]), filler, values.dtype)
        return on_device(np.concatenate([values, spare]))

    # Padding stands at the first point with weight 0, so that nothing is larger or smaller for it.
    points = np.concatenate([x, np.broadcast_to(x[:1], (capacity - len(x), 3))])
    return View(
        on_device(points),
        padded(w),
        padded(ray),
        padded(np.maximum(floor, 1e-12), 1e-12),
        padded(cell[:, 0] * GRID + cell[:, 1]),
        padded(place),
    )


def seen_at(x: np.ndarray, axis: np.ndarray, eye: np.ndarray | None, of: np.ndarray) -> np.ndarray:
    """Where each point is seen (N, 2): in the image of a camera that looks at the middle of some points, or from above."""
    if eye is None:
        return x @ np.asarray(tangents(axis)).T
    ahead = (x[of] - eye).mean(axis=0)
    ahead = ahead / np.linalg.norm(ahead)
    side = np.cross(ahead, axis) if abs(ahead @ axis) < 0.99 else np.asarray(tangents(ahead))[0]
    side = side / np.linalg.norm(side)
    depth = np.maximum((x - eye) @ ahead, 1e-6 * np.abs(x - eye).max())
    return (x - eye) @ np.stack([side, np.cross(ahead, side)], axis=1) / depth[:, None]


def prior_of(
    axis: np.ndarray,
    angle: tuple[float, float, float],
    eye: np.ndarray | None,
    dtype: Any,
    *,
    starts: int = 96,
    ends_view: bool = False,
) -> Prior:
    """A prior with its starts spread evenly, on a Fibonacci spiral, over the directions that it allows.

    Args:
        axis: The direction that the angle refers to.
        angle: Center, standard deviation and largest difference of the angle, in radians.
        eye: The camera, or None.
        dtype: Float type.
        starts: How many directions to start from.
        ends_view: See `Prior`.
    """
    near, far = np.cos(max(angle[0] - angle[2], 0.0)), np.cos(min(angle[0] + angle[2], np.pi / 2))
    index = np.arange(starts)
    cosine = near - (index + 0.5) / starts * (near - far)
    turn = np.pi * (3 - np.sqrt(5)) * index
    sine = np.sqrt(1 - cosine**2)
    across = np.asarray(tangents(axis))
    directions = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1) @ np.vstack([across, axis])
    return Prior(
        on_device(directions, dtype),
        on_device(axis, dtype),
        on_device(angle, dtype),
        on_device(ends_view),
        on_device(np.zeros(4) if eye is None else [*eye, 1.0], dtype),
    )


def noise_of(x: np.ndarray, std: np.ndarray, eye: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of each point along its viewing ray as a vector, and in any direction."""
    if eye is None:
        return np.zeros_like(x), std
    ray = x - eye
    ray = ray / np.maximum(lengths(ray)[:, None], np.finfo(x.dtype).tiny)
    return ray * std[:, None], SIDEWAYS * std


def deviation_across(normal: np.ndarray, ray: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Standard deviation of each point's distance from a plane."""
    return np.sqrt((ray @ normal) ** 2 + floor**2)
