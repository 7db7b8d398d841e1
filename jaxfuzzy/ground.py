"""The supporting plane and the upright frame that stands on it.

A plane is one linear fuzzy variety beside a noise cluster (paper eqs. 12-20 in the 3D space, m = 2), looked for from many
starts with the noise distance annealed. What lets it find a table of which little is seen is that its members are not
points but small patches of the view, each with its mean and its scatter: a patch is near a plane when its mean lies on it
AND it does not run through it. A slab through clutter holds many points, but hardly a patch.
A plane is scored by its members, minus the patches seen below it inside the outline of its members (nothing can be
seen through a table), times a prior on its tilt.
"""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, record
from jaxfuzzy.linalg import tangents
from jaxfuzzy.primitives import Plane
from jaxfuzzy.status import Status

# Patches along each side of the view. 24 leaves a patch of a 450 x 375 image some 19 x 16 pixels: over that, a standing
# surface runs through a lying plane by several deviations of a stereo match, and a strip of board between cones fills some.
GRID = 24
# A cloud is thinned to the last of these and padded to the next, so that few sizes are ever compiled.
CAPACITIES = (1024, 4096, 16384)
# Starts: directions, for each the offsets that hold most patches, out of so many bins.
DIRECTIONS, OFFSETS, BINS = 64, 4, 48
# Noise distance of a patch and of a point, in standard deviations.
PATCH_DELTA, POINT_DELTA = 1.0, 2.5
# Sideways deviation of a point over the one along its ray: keeps grazing planes from becoming infinitely thin.
SIDEWAYS = 0.1
# A plane whose standard deviation is larger than expected by this factor is called a slab.
SLAB = 1.3
# A plane must hold this share of the view, net of what is seen below it.
LEAST_SUPPORT = 0.004
# Standard deviations tried where none is given, as shares of the scene's spread.
UNKNOWN_NOISE = (0.002, 0.004, 0.008, 0.016, 0.032)


@record
class Ground:
    """The supporting plane and how well it is founded.

    Attributes:
        plane: The plane, its normal pointing up; None where there is none.
        inliers: The points on it.
        depth_std: Standard deviation of each point along its viewing ray, as the plane's own residual tells it; without a
            plane the one given, or None.
        spread: The deviation told by the plane over the one given; 1 where none was given.
        support: Share of the view that lies on it, net of what is seen below it.
        status: NO_GROUND, GROUND_SLAB or 0.
    """

    plane: Plane | None
    inliers: Bool[Array, " N"]
    depth_std: Float[Array, " N"] | None
    spread: Float[Array, ""]
    support: Float[Array, ""]
    status: Int[Array, ""]


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
class Candidate:
    """A plane normal · x = offset.

    Attributes:
        normal: Unit normal, pointing up.
        offset: Its offset.
        support: Share of the view that lies on it, net of what is seen below it.
        spread: Robust standard deviation of its points over the one expected.
    """

    normal: Float[Array, "3"]
    offset: Float[Array, ""]
    support: Float[Array, ""]
    spread: Float[Array, ""]


def find_ground(
    points: ArrayLike,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    weights: ArrayLike | None = None,
    depth_std: ArrayLike | None = None,
    camera: ArrayLike | None = (0.0, 0.0, 0.0),
    max_tilt: float = np.pi * 50 / 180,
) -> Plane | None:
    """The plane that the objects stand on; None where there is none. `fit_ground` tells more.

    Args:
        points: Points (N, 3) in metres.
        up: Roughly the vertical direction; its sign may be either.
        noise_distance: In metres, for all points or for each (N,); "auto" takes 2.5 standard deviations.
        weights: Weights (N,).
        depth_std: Standard deviation of each point along its viewing ray (N,); found from the scene where not given.
        camera: Where the points were seen from (3,), or None.
        max_tilt: Largest angle in radians between the plane's normal and `up`: small where gravity is known well.

    Raises:
        ValueError: An argument of wrong shape or value.
    """
    return fit_ground(
        points,
        up=up,
        noise_distance=noise_distance,
        weights=weights,
        depth_std=depth_std,
        camera=camera,
        max_tilt=max_tilt,
    ).plane


def fit_ground(
    points: ArrayLike,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    weights: ArrayLike | None = None,
    depth_std: ArrayLike | None = None,
    camera: ArrayLike | None = (0.0, 0.0, 0.0),
    max_tilt: float = np.pi * 50 / 180,
) -> Ground:
    """The supporting plane with its inliers, its own measure of the noise and a status. Arguments as for `find_ground`."""
    cloud = checks.points(points, dims=3)
    dtype = cloud.dtype
    x = np.asarray(cloud)
    mass = checks.weights(weights, len(x))
    w = np.ones(len(x), dtype) if mass is None else np.asarray(mass, dtype)
    axis = checks.direction(up, "up")
    checks.number(max_tilt, "max_tilt", above=0.0)
    eye = None if camera is None else np.asarray(checks.points(np.reshape(camera, (1, -1)), "camera", dims=3))[0]
    std, known = _deviation(x, w, noise_distance, depth_std, eye)
    ray, floor = _noise(x, std, eye if isinstance(noise_distance, str) else None)
    view = _view(x, w, ray, floor, axis, eye)
    starts = jnp.asarray(_cap(axis, float(max_tilt)), dtype)
    prior = jnp.asarray([0.0, max_tilt / 2, max_tilt], dtype)

    best, factor = None, 1.0
    for scale in (1.0, 2.0) if known else UNKNOWN_NOISE:
        found = fit_plane(view, starts, jnp.asarray(axis, dtype), prior, _side(eye, dtype), jnp.asarray(scale, dtype))
        if float(found.support) >= LEAST_SUPPORT:
            best, factor = found, scale
            if float(found.spread) <= SLAB:
                break
    zero = jnp.zeros((), dtype)
    if best is None:
        none = jnp.zeros(len(x), bool)
        return Ground(None, none, jnp.asarray(std) if known else None, zero + 1, zero, jnp.asarray(int(Status.NO_GROUND)))
    normal, offset, spread = np.asarray(best.normal), float(best.offset), factor * float(best.spread)
    residual = (x @ normal - offset) / np.sqrt((ray @ normal) ** 2 + floor**2)
    inliers = (np.abs(residual) <= POINT_DELTA * spread) & (w > 0)
    slab = known and spread > SLAB
    return Ground(
        _patch_of_plane(x[inliers], normal, offset),
        jnp.asarray(inliers),
        jnp.asarray(std * spread),
        zero + (spread if known else 1.0),
        best.support,
        jnp.asarray(int(Status.GROUND_SLAB) if slab else 0),
    )


def upright(points: Float[ArrayLike, "N 3"], ground: Plane) -> tuple[Array, Array, Array]:
    """Turns points into the frame that stands on the ground: y is the height above it, z leads away as it did before.

    Args:
        points: Points (N, 3).
        ground: The supporting plane, its normal up.

    Returns:
        The points turned (N, 3), the rotation (3, 3) and the origin (3,): turned = rotation @ (point - origin).
    """
    cloud = checks.points(points, dims=3)
    rotation = upright_rotation(ground.normal).astype(cloud.dtype)
    origin = ground.point.astype(cloud.dtype)
    return (cloud - origin) @ rotation.T, rotation, origin


def upright_rotation(up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation that takes a unit vector to +y and keeps z pointing away as nearly as it can."""
    along_z = up[2] ** 2 > 0.99
    ahead = jnp.where(along_z, jnp.asarray([0.0, 1.0, 0.0]), jnp.asarray([0.0, 0.0, 1.0])).astype(up.dtype)
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / jnp.linalg.norm(ahead)
    return jnp.stack([jnp.cross(up, ahead), up, ahead])


@jax.jit
def fit_plane(
    view: View,
    starts: Float[Array, "S 3"],
    axis: Float[Array, "3"],
    prior: Float[Array, "3"],
    eye: Float[Array, "4"],
    scale: Float[Array, ""],
) -> Candidate:
    """The best plane of a view.

    Args:
        view: The points.
        starts: Directions to start from.
        axis: What the prior on the angle between normal and axis refers to.
        prior: Center, standard deviation and largest difference of that angle, in radians.
        eye: The camera and 1, or zeros where it is not known.
        scale: Factor on every standard deviation.
    """
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
        seen_from = eye[:3] @ normal - offset
        side = jnp.where(jnp.where(eye[3] > 0, seen_from, above - below) < 0, -1, 1)
        hidden = jnp.where(side * residual < -3, weight * _within(u), 0).sum()
        tilt = jnp.arccos(jnp.clip(jnp.abs(normal @ axis), 0, 1)) - prior[0]
        support = (u.sum() - hidden) / weight.sum()
        score = jnp.where(support > 0, support * jnp.exp(-0.5 * (tilt / prior[1]) ** 2), support)
        return jnp.where(jnp.abs(tilt) <= prior[2], score, -jnp.inf), support, side, u

    offsets = jax.vmap(lambda n: _offsets(mean, weight, distances, n))(starts)
    normals, offsets = jax.vmap(anneal)(jnp.repeat(starts, OFFSETS, axis=0), offsets.ravel())
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


def _deviation(
    x: np.ndarray,
    w: np.ndarray,
    noise_distance: Any,
    depth_std: ArrayLike | None,
    eye: np.ndarray | None,
) -> tuple[np.ndarray, bool]:
    """Standard deviation of each point, and whether it is known or only up to a factor."""
    if not isinstance(noise_distance, str):
        given = checks.noise_distance(noise_distance, len(x))
        if given is None:
            raise ValueError("noise_distance must be 'auto' or a number above 0, got None")
        return np.broadcast_to(np.asarray(given, x.dtype) / POINT_DELTA, len(x)), True
    checks.choice(noise_distance, "noise_distance", ("auto",))
    if depth_std is not None:
        given = checks.noise_distance(depth_std, len(x), "depth_std")
        return np.broadcast_to(np.asarray(given, x.dtype), len(x)), True
    middle = np.median(x[w > 0], axis=0)
    spread = np.median(np.linalg.norm(x[w > 0] - middle, axis=1))
    if eye is None:
        return np.full(len(x), max(spread, np.finfo(x.dtype).tiny), x.dtype), False
    # A stereo match is wrong by so many pixels: its depth by the square of the distance.
    far = np.linalg.norm(x - eye, axis=1)
    return spread * far**2 / np.median(far[w > 0] ** 2), False


def _noise(x: np.ndarray, std: np.ndarray, eye: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation along the viewing ray as a vector, and in any direction."""
    if eye is None:
        return np.zeros_like(x), std
    ray = x - eye
    ray = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), np.finfo(x.dtype).tiny)
    return ray * std[:, None], SIDEWAYS * std


def _view(
    x: np.ndarray, w: np.ndarray, ray: np.ndarray, floor: np.ndarray, axis: np.ndarray, eye: np.ndarray | None
) -> View:
    """Thins and pads a cloud, and cuts what is seen of it into patches (from above where no camera is known)."""
    count = len(x)
    capacity = next((c for c in CAPACITIES if c >= count), CAPACITIES[-1])
    take = np.arange(count) if count <= capacity else np.linspace(0, count - 1, capacity).astype(int)
    x, w, ray, floor = x[take], w[take], ray[take], floor[take]
    if eye is None:
        ahead, scale = axis, np.ones(len(x))
    else:
        ahead = np.average(x - eye, axis=0, weights=w)
        ahead = ahead / np.linalg.norm(ahead)
        scale = np.maximum((x - eye) @ ahead, 1e-6 * np.abs(x - eye).max())
    across = np.asarray(tangents(jnp.asarray(ahead)))
    seen = (x - (0 if eye is None else eye)) @ across.T / scale[:, None]
    low, high = np.quantile(seen[w > 0], [0.002, 0.998], axis=0)
    cell = np.clip((seen - low) / np.maximum(high - low, np.finfo(x.dtype).tiny) * GRID, 0, GRID - 1).astype(np.int32)

    def padded(values: np.ndarray) -> Array:
        return jnp.asarray(np.concatenate([values, np.zeros((capacity - len(x), *values.shape[1:]), values.dtype)]))

    # Padding stands at the first point with weight 0, so that nothing is larger or smaller for it.
    filler = np.concatenate([x, np.broadcast_to(x[:1], (capacity - len(x), 3))])
    return View(
        jnp.asarray(filler), padded(w), padded(ray), jnp.maximum(padded(floor), 1e-12), padded(cell[:, 0] * GRID + cell[:, 1])
    )


def _side(eye: np.ndarray | None, dtype: Any) -> Array:
    return jnp.zeros(4, dtype) if eye is None else jnp.asarray([*eye, 1.0], dtype)


def _cap(axis: np.ndarray, angle: float) -> np.ndarray:
    """Directions spread evenly over the cap within an angle of an axis, on a Fibonacci spiral."""
    index = np.arange(DIRECTIONS)
    cosine = 1 - (index + 0.5) / DIRECTIONS * (1 - np.cos(angle))
    turn = np.pi * (3 - np.sqrt(5)) * index
    sine = np.sqrt(1 - cosine**2)
    across = np.asarray(tangents(jnp.asarray(axis)))
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1) @ np.vstack([across, axis])


def _patch_of_plane(inliers: np.ndarray, normal: np.ndarray, offset: float) -> Plane:
    """The plane with the rectangle that holds its inliers, a hundredth left out at each side."""
    across = np.asarray(tangents(jnp.asarray(normal)))
    middle = inliers.mean(axis=0) if len(inliers) else offset * normal
    point = middle - (middle @ normal - offset) * normal
    flat = (inliers - point) @ across.T if len(inliers) else np.zeros((1, 2))
    (low_a, low_b), (high_a, high_b) = np.quantile(flat, [0.01, 0.99], axis=0)
    corners = np.array([[low_a, low_b], [high_a, low_b], [high_a, high_b], [low_a, high_b]]) @ across + point
    return Plane(jnp.asarray(point), jnp.asarray(normal), jnp.asarray(corners.astype(normal.dtype)))
