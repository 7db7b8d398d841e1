"""From points to objects: how many stand on the ground plane, and which point belongs to which."""

from collections.abc import Iterable
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, Int, record
from jaxfuzzy.density import DELTA, part
from jaxfuzzy.fcm import Partition, fcm
from jaxfuzzy.linalg import tangents
from jaxfuzzy.seeding import Seeds, histogram_seeds
from jaxfuzzy.status import Status
from jaxfuzzy.validity import ClusterCount, choose_k

# "auto" allows so many objects.
MOST = 20
# Bandwidth over (spacing² · size)^(1/3), spacing that of the points on their surface, size that of the surface.
BANDWIDTH = 2.05
# Points beyond this number are gathered in cells of a third of the bandwidth; the sizes that are compiled.
CAPACITIES = (256, 512, 1024, 2048, 4096)
# The spacing is measured at so many points, among so many, by the distance to this neighbour; a low quantile leaves outliers out.
PROBES, CROWD, NEIGHBOUR, QUANTILE, ALONE = 192, 4096, 8, 0.2, 2.5


@record
class Segmentation:
    """Points divided into objects.

    Attributes:
        labels: The object of each point, -1 for outliers.
        k: Number of objects.
        sizes: Sizes of the clusters (the paper's alpha); they sum to 1. Not the share of points: see `fcm`.
        shares: Share of the labelled points in each object.
        partition: A fuzzy partition of all N points into the k objects, whose hardened labels are `labels`.
        count: How k was chosen, where an index chose it.
        seeds: Histogram seeds, where they were used.
        status: Reasons to read this with care; see `describe`.
    """

    labels: Int[Array, " N"]
    k: int
    sizes: Float[Array, " k"]
    shares: Float[Array, " k"]
    partition: Partition
    count: ClusterCount | None
    seeds: Seeds | None
    status: Int[Array, ""]


def segment(
    points: ArrayLike,
    *,
    ks: Literal["auto"] | Iterable[int] = "auto",
    up: ArrayLike = (0.0, 1.0, 0.0),
    camera: ArrayLike | None = None,
    rule: Literal["robust", "paper"] = "robust",
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    weights: ArrayLike | None = None,
) -> Segmentation:
    """Divides what stands on the ground into objects, by where they stand: only the plane perpendicular to `up` is looked at.

    `rule="robust"` tiles the plane with many small clusters beside a noise cluster and joins those between which the density of
    points has no valley (see `density`). Its one length follows from the spacing of the points on their surface and the size of
    that surface, and is never less than the noise distance; the number of objects is the one that stays longest as that length
    is varied. One object is as good an answer as any.

    `rule="paper"` is sections II-A to II-D of the paper: fuzzy c-means from histogram seeds for every k, the k by the variance
    ratio, then fuzzy c-means with sizes. It knows neither outliers nor a single object.

    Args:
        points: Points (N, 3) in any unit, without the ground.
        ks: Numbers of objects allowed; "auto" is 1 to 20 (2 to 5 for the paper's rule, as the paper has it).
        up: The vertical direction; its sign may be either.
        camera: Where the points were seen from (3,).
        rule: "robust" or "paper".
        noise_distance: How far noise carries a point from its object, for all or for each point (N,); "auto" supposes no further
            than points are apart.
        weights: Weights (N,), not negative.

    Returns:
        The division. Its status is AT_BOUND where as many objects were found as allowed, or more.

    Raises:
        ValueError: An argument out of range or of wrong shape; TypeError: of wrong kind.
    """
    cloud = checks.points(points, dims=3)
    count = cloud.shape[0]
    given = checks.weights(weights, count)
    checks.choice(rule, "rule", ("robust", "paper"))
    candidates = _candidates(ks, rule, count)
    axes = np.asarray(tangents(jnp.asarray(checks.direction(up, "up"))))
    noise = _noise(noise_distance, count)
    if camera is not None:
        checks.position(camera, "camera")
    x = np.asarray(cloud)
    w = np.ones(count, x.dtype) if given is None else np.asarray(given, x.dtype)
    if rule == "paper":
        return _paper(x, w, (x @ axes.T).astype(x.dtype), candidates)
    return _robust(x, w, axes, candidates, noise)


def _robust(x: np.ndarray, w: np.ndarray, axes: np.ndarray, candidates: tuple[int, ...], noise: float) -> Segmentation:
    bandwidth = max(_bandwidth(x, w), noise)
    # The plane in its own frame, so that shifts and turns of the cloud change nothing.
    flat = (x - np.average(x, axis=0, weights=w)) @ axes.T
    turn = np.linalg.eigh((flat * w[:, None]).T @ flat)[1]
    flat = flat @ turn
    places, weight, cell = _places(flat, w, bandwidth)
    allowed = np.isin(np.arange(1, candidates[-1] + 1), candidates)
    groups = part(
        jnp.asarray(places, x.dtype),
        jnp.asarray(weight, x.dtype),
        jnp.asarray(bandwidth, x.dtype),
        jnp.asarray(allowed),
    )
    k = int(groups.count)
    shares = np.asarray(groups.shares)[cell, :k]
    # Noise takes as much of a point as its best object does where its support is just enough, and more with less support.
    typicality = np.asarray(groups.typicality)[cell]
    best = shares.max(axis=1)
    total = typicality + best
    u, noise_share = shares * (typicality / total)[:, None], best / total
    # What is left belongs to groups that are no objects.
    noise_share = noise_share + (1 - shares.sum(axis=1)) * typicality / total
    labels = np.where(noise_share > u.max(axis=1), -1, u.argmax(axis=1)).astype(np.int32)
    status = Status.AT_BOUND if int(groups.found) >= candidates[-1] else Status(0)
    if not (labels >= 0).any():
        status |= Status.ALL_NOISE
    partition = _partition(x, w, axes, u, noise_share, labels, float(groups.objective), DELTA * bandwidth, int(status))
    return Segmentation(
        partition.labels, k, partition.sizes, _shares(labels, w, k, x.dtype), partition, None, None, partition.status
    )


def _paper(x: np.ndarray, w: np.ndarray, flat: np.ndarray, candidates: tuple[int, ...]) -> Segmentation:
    able = tuple(k for k in candidates if k > 1)
    status = Status.SKIPPED_ONE if len(able) < len(candidates) else Status(0)
    if not able:
        raise ValueError(f"ks must hold a number above 1 for rule='paper', got {candidates}")
    count = choose_k(flat, able, weights=w)
    k = int(count.k)
    seeds = histogram_seeds(flat, k, weights=w)
    # Sizes start from the plain fit: from raw seeds one may die before the centers have found their place.
    fit = fcm(flat, count.partition.centers, sizes=True, weights=w)
    status |= Status(int(fit.status))
    labels = np.asarray(fit.labels)
    return Segmentation(
        fit.labels, k, fit.sizes, _shares(labels, w, k, x.dtype), fit, count, seeds, jnp.asarray(int(status), jnp.int32)
    )


def _bandwidth(x: np.ndarray, w: np.ndarray) -> float:
    """From the spacing of the points on their surface and the size of that surface; what lies alone counts as neither."""
    real = np.flatnonzero(w > 0)
    crowd = x[real[np.linspace(0, len(real) - 1, min(len(real), CROWD)).astype(int)]].astype(float)
    probes = crowd[np.linspace(0, len(crowd) - 1, min(len(crowd), PROBES)).astype(int)]
    neighbour = min(NEIGHBOUR, len(crowd) - 1)
    offset = crowd.mean(axis=0)
    crowd, probes = crowd - offset, probes - offset
    square = (probes**2).sum(axis=1)[:, None] + (crowd**2).sum(axis=1) - 2 * probes @ crowd.T
    reach = np.sqrt(np.maximum(np.partition(square, neighbour, axis=1)[:, neighbour], 0))
    usual = np.quantile(reach, QUANTILE)
    # `neighbour` points within a disc of this radius: so much surface has each of the points that lie on a surface.
    area = np.pi * usual**2 / max(neighbour, 1) * (reach <= ALONE * usual).mean() * len(crowd)
    spacing, surface = np.sqrt(area / max(len(real) * (reach <= ALONE * usual).mean(), 1)), np.sqrt(area)
    smallest = np.sqrt(np.finfo(x.dtype).eps) * max(float(np.abs(crowd).max()), 1e-30)
    return max(BANDWIDTH * float(np.cbrt(spacing**2 * surface)), smallest)


def _places(flat: np.ndarray, w: np.ndarray, bandwidth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points as few enough weighted places, padded; and the place of each point."""
    most = CAPACITIES[-1]
    real = np.flatnonzero(w > 0)
    pitch = bandwidth / 3
    while True:
        corner = np.floor(np.clip(flat / pitch, -1e9, 1e9)).astype(np.int64)
        key = (corner[:, 0] - corner[:, 0].min()) * (np.ptp(corner[:, 1]) + 1) + corner[:, 1] - corner[:, 1].min()
        cell = np.unique(key, return_inverse=True)[1].astype(np.int64)
        if cell.max() < most:
            break
        pitch *= 1.25
    number = int(cell.max()) + 1
    # A point counts as one on the average, and a cloud for no more points than there are places: neighbouring pixels err alike.
    scale = min(len(real), most) / w.sum()
    weight = np.bincount(cell, w, minlength=number)
    # Points of weight 0 get a label too; alone in their cell, they are where they are.
    share = np.where(weight[cell] > 0, w, 1.0)
    total = np.bincount(cell, share, minlength=number)
    at = np.stack([np.bincount(cell, share * flat[:, i], minlength=number) for i in (0, 1)], axis=1) / total[:, None]
    capacity = next(c for c in CAPACITIES if c >= number)
    spare = capacity - number
    return np.pad(at, ((0, spare), (0, 0))), np.pad(weight * scale, (0, spare)), cell


def _partition(
    x: np.ndarray,
    w: np.ndarray,
    axes: np.ndarray,
    u: np.ndarray,
    noise: np.ndarray,
    labels: np.ndarray,
    objective: float,
    delta: float,
    status: int,
) -> Partition:
    pull = w[:, None] * u**2
    centers = (pull.T @ x) / np.maximum(pull.sum(axis=0), np.finfo(x.dtype).tiny)[:, None]
    squared = (((x[:, None] - centers) @ axes.T) ** 2).sum(axis=-1)
    # Eq. 11 with m = 2: alpha goes with the root of the sum of u² D.
    sizes = np.sqrt((pull * squared).sum(axis=0))
    sizes = sizes / sizes.sum() if sizes.sum() > 0 else np.full(len(sizes), 1 / len(sizes))
    return Partition(
        centers=jnp.asarray(centers, x.dtype),
        sizes=jnp.asarray(sizes, x.dtype),
        memberships=jnp.asarray(u, x.dtype),
        noise=jnp.asarray(noise, x.dtype),
        labels=jnp.asarray(labels),
        objective=jnp.asarray(objective, x.dtype),
        steps=jnp.asarray(0),
        status=jnp.asarray(status, jnp.int32),
        m=2.0,
        noise_distance=delta,
    )


def _shares(labels: np.ndarray, w: np.ndarray, k: int, dtype: Any) -> Array:
    mass = np.bincount(labels[labels >= 0], w[labels >= 0], minlength=k)
    return jnp.asarray(mass / max(mass.sum(), np.finfo(dtype).tiny), dtype)


def _candidates(ks: Any, rule: str, count: int) -> tuple[int, ...]:
    if isinstance(ks, str):
        checks.choice(ks, "ks", ("auto",))
        low, high = (2, 5) if rule == "paper" else (1, MOST)
        return tuple(range(low, min(high, count) + 1)) or (low,)
    wanted = [checks.integer(k, "ks", at_least=1, at_most=count, why=" (the number of points)") for k in ks]
    if not wanted or len(set(wanted)) < len(wanted):
        raise ValueError(f"ks must hold at least one number and none twice, got {tuple(wanted)}")
    return tuple(sorted(wanted))


def _noise(value: Any, count: int) -> float:
    if isinstance(value, str):
        checks.choice(value, "noise_distance", ("auto",))
        return 0.0
    if value is None:
        raise ValueError("noise_distance must be 'auto' or above 0, got None")
    return float(np.median(np.asarray(checks.noise_distance(value, count))))
