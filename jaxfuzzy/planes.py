"""Planes in a view: one linear fuzzy variety beside a noise cluster, found from many starts.

The variety is that of paper eqs. 12-20 in the 3D space with m = 2, its noise distance annealed. What lets it find a table of
which little is seen is that its members are not points but small patches of the view, each with its mean and its scatter: a
patch is near a plane when its mean lies on it AND it does not run through it. A slab through clutter holds many points, but
hardly a patch. A plane is scored by its members, minus the patches seen behind it (nothing is seen through a table), times a
prior on its angle.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy.arrays import Array, Bool, Float, Int, lengths, record
from jaxfuzzy.linalg import tangents

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


@record
class View:
    """Points with their noise, and the patch of the view that each is seen in; padded with weight 0.

    Attributes:
        points: The points.
        weights: Their weights.
        ray: One standard deviation along the viewing ray; zero where no camera is known.
        floor: Standard deviation in any direction.
        patch: Index of the patch, below GRID².
    """

    points: Float[Array, "N 3"]
    weights: Float[Array, " N"]
    ray: Float[Array, "N 3"]
    floor: Float[Array, " N"]
    patch: Int[Array, " N"]


@record
class Prior:
    """What is known of a plane before it is looked for.

    Attributes:
        starts: Directions to start from.
        axis: The direction that the angle refers to.
        angle: Center, standard deviation and largest difference of the angle between normal and axis, in radians.
        anywhere: Count all that is behind the plane against it, not only what is behind within its outline.
        eye: The camera and 1, or zeros where it is not known.
    """

    starts: Float[Array, "S 3"]
    axis: Float[Array, "3"]
    angle: Float[Array, "3"]
    anywhere: Bool[Array, ""]
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
    mean, scatter, weight, ray, floor = _patches(view)
    ray, floor = scale * ray, scale * floor

    def deviation2(normal: Array, rays: Array, floors: Array) -> Array:
        return (rays @ normal) ** 2 + floors**2

    def distances(normal: Array, offset: Array) -> Array:
        """Mean squared distance of each patch's points, in variances."""
        through = jnp.einsum("pij,i,j->p", scatter, normal, normal)
        return ((mean @ normal - offset) ** 2 + through) / deviation2(normal, ray, floor)

    def step(plane: tuple[Array, Array], delta: Array) -> tuple[tuple[Array, Array], None]:
        # One variety and noise, m = 2: u = 1 / (1 + D / delta^2) is eq. 20, u^2 weighs the scatter of eq. 16.
        normal, offset = plane
        u2 = weight / (1 + distances(normal, offset) / delta**2) ** 2 / deviation2(normal, ray, floor)
        return _smallest_direction(u2, mean, normal, scatter), None

    def anneal(normal: Array, offset: Array) -> tuple[Array, Array]:
        deltas = PATCH_DELTA * jnp.concatenate([4 * 0.8 ** jnp.arange(6.0), jnp.ones(4)]).astype(mean.dtype)
        return lax.scan(step, (normal, offset), deltas)[0]

    def judge(normal: Array, offset: Array) -> tuple[Array, Array, Array, Array]:
        u = weight / (1 + distances(normal, offset) / PATCH_DELTA**2)
        residual = (mean @ normal - offset) / jnp.sqrt(deviation2(normal, ray, floor))
        above, below = (weight * (residual > 3)).sum(), (weight * (residual < -3)).sum()
        seen_from = prior.eye[:3] @ normal - offset
        side = jnp.where(jnp.where(prior.eye[3] > 0, seen_from, above - below) < 0, -1, 1)
        outline = jnp.where(prior.anywhere, 1, _within(u))
        hidden = jnp.where(side * residual < -3, weight * outline, 0).sum()
        center, deviation, largest = prior.angle
        angle = jnp.arccos(jnp.clip(jnp.abs(normal @ prior.axis), 0, 1)) - center
        support = (u.sum() - hidden) / weight.sum()
        score = jnp.where(support > 0, support * jnp.exp(-0.5 * (angle / deviation) ** 2), support)
        return jnp.where(jnp.abs(angle) <= largest, score, -jnp.inf), support, side, u

    offsets = jax.vmap(lambda n: _offsets(mean, weight, distances, n))(prior.starts)
    normals, offsets = jax.vmap(anneal)(jnp.repeat(prior.starts, OFFSETS, axis=0), offsets.ravel())
    scores, supports, sides, shares = jax.vmap(judge)(normals, offsets)
    best = jnp.argmax(scores)
    normal, offset = sides[best] * normals[best], sides[best] * offsets[best]

    # Finish on the points of the patches that belong to it.
    rays, floors, points = scale * view.ray, scale * view.floor, view.points
    trust = view.weights * (shares[best] / jnp.maximum(weight, 1e-9))[view.patch]

    def finish(plane: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        normal, offset = plane
        variance = deviation2(normal, rays, floors)
        u2 = trust / (1 + (points @ normal - offset) ** 2 / variance / POINT_DELTA**2) ** 2 / variance
        return _smallest_direction(u2, points, normal), None

    (normal, offset), _ = lax.scan(finish, (normal, offset), length=6)
    residual = jnp.abs(points @ normal - offset) / jnp.sqrt(deviation2(normal, rays, floors))
    # The median of |residual| of a normal deviation of 1 is 0.6745; what is further than 5 belongs to something else.
    spread = _weighted_median(residual, jnp.where(residual < 5, trust, 0)) / 0.6745
    support = jnp.where(scores[best] == -jnp.inf, -1, supports[best])
    return Candidate(normal, offset, support, spread)


def _smallest_direction(
    weights: Array, points: Array, toward: Array, scatter: Array | None = None
) -> tuple[Array, Array]:
    """Normal and offset of the plane of least weighted squared distance; of the two signs, the one near `toward`."""
    weights = weights / jnp.maximum(weights.sum(), jnp.finfo(points.dtype).tiny)
    mean = weights @ points
    centred = points - mean
    moments = (centred * weights[:, None]).T @ centred
    if scatter is not None:
        moments = moments + jnp.einsum("p,pij->ij", weights, scatter)
    normal = jnp.linalg.eigh(moments)[1][:, 0]
    normal = normal * jnp.where(normal @ toward < 0, -1, 1)
    return normal, normal @ mean


def _offsets(mean: Array, weight: Array, distances: Any, normal: Array) -> Array:
    """The offsets along a direction where most patches lie, out of evenly spaced ones."""
    height = mean @ normal
    low = jnp.min(jnp.where(weight > 0, height, jnp.inf))
    high = jnp.max(jnp.where(weight > 0, height, -jnp.inf))
    offsets = low + (high - low) * (jnp.arange(BINS) + 0.5) / BINS
    held = jax.vmap(lambda o: (weight / (1 + distances(normal, o) / (4 * PATCH_DELTA) ** 2)).sum())(offsets)
    padded = jnp.pad(held, 1, constant_values=-1)
    peak = (held >= padded[:-2]) & (held > padded[2:])
    return offsets[lax.top_k(jnp.where(peak, held, -1), OFFSETS)[1]]


def _patches(view: View) -> tuple[Array, Array, Array, Array, Array]:
    """Mean, scatter, weight, ray and floor of each patch."""
    total = partial(jax.ops.segment_sum, segment_ids=view.patch, num_segments=GRID**2)
    weight = total(view.weights)
    share = (view.weights / jnp.maximum(weight, 1e-9)[view.patch])[:, None]
    first = total(share * jnp.concatenate([view.points, view.ray, view.floor[:, None]], axis=1))
    centred = view.points - first[view.patch, :3]
    i, j = np.triu_indices(3)
    second = total(share * centred[:, i] * centred[:, j])
    scatter = second[:, jnp.asarray([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]
    # An empty patch has weight 0 and needs a finite deviation.
    floor = jnp.where(weight > 0, first[:, 6], 1)
    return first[:, :3], scatter, weight / weight.max(), first[:, 3:6], floor


def _within(u: Float[Array, " P"]) -> Float[Array, " P"]:
    """How far each place of the view is inside the outline of the members: 1 in the middle, small from four deviations on."""
    side = (jnp.arange(GRID) + 0.5) / GRID
    place = jnp.stack(jnp.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2).astype(u.dtype)
    share = u / jnp.maximum(u.sum(), 1e-9)
    centred = place - share @ place
    moments = (centred * share[:, None]).T @ centred + jnp.eye(2, dtype=u.dtype) / (12 * GRID**2)
    return jnp.exp(-jnp.einsum("pi,ij,pj->p", centred, jnp.linalg.inv(moments), centred) / 8)


def _weighted_median(values: Array, weights: Array) -> Array:
    order = jnp.argsort(values)
    passed = jnp.cumsum(weights[order])
    return values[order[jnp.searchsorted(passed, passed[-1] / 2)]]


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
    cell = np.clip((seen - low) / np.maximum(high - low, np.finfo(x.dtype).tiny) * GRID, 0, GRID - 1).astype(np.int32)

    def padded(values: np.ndarray) -> Array:
        return jnp.asarray(np.concatenate([values, np.zeros((capacity - len(x), *values.shape[1:]), values.dtype)]))

    # Padding stands at the first point with weight 0, so that nothing is larger or smaller for it.
    filler = np.concatenate([x, np.broadcast_to(x[:1], (capacity - len(x), 3))])
    return View(
        jnp.asarray(filler),
        padded(w),
        padded(ray),
        jnp.maximum(padded(floor), 1e-12),
        padded(cell[:, 0] * GRID + cell[:, 1]),
    )


def seen_at(x: np.ndarray, axis: np.ndarray, eye: np.ndarray | None, of: np.ndarray) -> np.ndarray:
    """Where each point is seen (N, 2): in the image of a camera that looks at the middle of some points, or from above."""
    if eye is None:
        return x @ np.asarray(tangents(jnp.asarray(axis))).T
    ahead = (x[of] - eye).mean(axis=0)
    ahead = ahead / np.linalg.norm(ahead)
    side = np.cross(ahead, axis) if abs(ahead @ axis) < 0.99 else np.asarray(tangents(jnp.asarray(ahead)))[0]
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
    anywhere: bool = False,
) -> Prior:
    """A prior with its starts spread evenly, on a Fibonacci spiral, over the directions that it allows.

    Args:
        axis: The direction that the angle refers to.
        angle: Center, standard deviation and largest difference of the angle, in radians.
        eye: The camera, or None.
        dtype: Float type.
        starts: How many directions to start from.
        anywhere: See `Prior`.
    """
    near, far = np.cos(max(angle[0] - angle[2], 0.0)), np.cos(min(angle[0] + angle[2], np.pi / 2))
    index = np.arange(starts)
    cosine = near - (index + 0.5) / starts * (near - far)
    turn = np.pi * (3 - np.sqrt(5)) * index
    sine = np.sqrt(1 - cosine**2)
    across = np.asarray(tangents(jnp.asarray(axis)))
    directions = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1) @ np.vstack([across, axis])
    return Prior(
        jnp.asarray(directions, dtype),
        jnp.asarray(axis, dtype),
        jnp.asarray(angle, dtype),
        jnp.asarray(anywhere),
        jnp.zeros(4, dtype) if eye is None else jnp.asarray([*eye, 1.0], dtype),
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
