"""From points to objects: how many stand on the ground plane, and which point belongs to which."""

from collections.abc import Iterable
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, Int, extents, nth_smallest, on_device, product, record
from jaxfuzzy.density import DELTA, PROTOTYPES, SWEEPS, part
from jaxfuzzy.fcm import Partition, fcm
from jaxfuzzy.linalg import tangents
from jaxfuzzy.seeding import Seeds, histogram_seeds
from jaxfuzzy.status import Status
from jaxfuzzy.validity import ClusterCount, choose_k

# "auto" allows so many objects.
MOST = 20
# Bandwidth over (spacing² · size)^(1/3), spacing that of the points on their surface, size that of the surface.
BANDWIDTH = 2.025
# Points are gathered in cells of half the bandwidth; numbers of cells that are compiled.
CAPACITIES = (1024, 2048, 4096)
# A cloud counts for no more points than this: of a dense one, neighbours are not independent.
COUNTED = 4096
# A scene too wide for its detail is looked at with a wider bandwidth, one with too few peaks with a narrower one; so many times.
COARSER, ATTEMPTS = 1.25, 24
# The spacing is measured at so many points, among so many, by the distance to this neighbour; a low quantile leaves outliers out.
PROBES, AT_A_TIME, CROWD, NEIGHBOUR, QUANTILE, ALONE = 768, 64, 3072, 8, 0.2, 2.5


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
    cloud = checks.places(points)
    count = cloud.shape[0]
    given = checks.weights(weights, count)
    checks.choice(rule, "rule", ("robust", "paper"))
    candidates = candidates_of(ks, rule, count)
    axes = np.asarray(tangents(checks.direction(up, "up")))
    noise = _noise(noise_distance, count)
    if camera is not None:
        checks.position(camera, "camera")
    x = np.asarray(cloud)
    w = np.ones(count, x.dtype) if given is None else np.asarray(given, x.dtype)
    if rule == "paper":
        return _paper(x, w, (x @ axes.T).astype(x.dtype), candidates)
    return _robust(x, w, axes, candidates, noise)


def _robust(x: np.ndarray, w: np.ndarray, axes: np.ndarray, candidates: tuple[int, ...], noise: float) -> Segmentation:
    # A noise distance beyond the cloud's own extent says no more than that extent, and may overflow when squared.
    bandwidth = max(_bandwidth(x, w), min(noise, float(np.linalg.norm(extents(x)))))
    # The plane in its own frame, so that shifts and turns of the cloud change nothing.
    flat = product(x - np.average(x, axis=0, weights=w), axes.T)
    turn = np.linalg.eigh((flat * w[:, None]).T @ flat)[1]
    flat = product(flat, turn)
    able = [k for k in candidates if k <= PROTOTYPES[-1]]
    if not able:
        raise ValueError(f"ks must hold a number of at most {PROTOTYPES[-1]} for rule='robust', got {candidates}")
    length = MOST if able[-1] <= MOST else PROTOTYPES[-1]
    allowed = on_device(np.isin(np.arange(1, length + 1), able))
    box = on_device(np.quantile(flat[w > 0], [0.01, 0.99], axis=0), x.dtype)
    for _ in range(ATTEMPTS):
        places, weight, cell = _places(flat, w, bandwidth)
        number = int(cell.max()) + 1
        groups = part(
            on_device(places, x.dtype),
            on_device(weight, x.dtype),
            box,
            on_device(bandwidth, x.dtype),
            allowed,
            number,
        )
        if groups is not None and int(groups.count) >= able[0]:
            break
        # Too wide a scene for its detail, or too few peaks to choose from.
        bandwidth *= COARSER if groups is None else 1 / COARSER
    if groups is None:
        raise checks.DataError(
            "the points are too scattered to be divided: remove outliers, or give a larger noise_distance"
        )
    k = int(groups.count)
    shares, typicality = np.asarray(groups.shares)[:number, :k], np.asarray(groups.typicality)[:number]
    # Noise takes as much of a place as its best object does where its support is just enough, and more with less support;
    # and all that belongs to groups that are no objects.
    best = shares.max(axis=1)
    total = typicality + best
    u = shares * (typicality / total)[:, None]
    lost = best / total + (1 - shares.sum(axis=1)) * typicality / total
    labels = np.where(lost > u.max(axis=1), -1, u.argmax(axis=1)).astype(np.int32)
    status = Status.AT_BOUND if int(groups.found) >= candidates[-1] else Status(0)
    if not (labels >= 0).any():
        status |= Status.ALL_NOISE
    if k not in able:
        status |= Status.TOO_FEW_POINTS
    centers, sizes = _sizes(x, w, flat, u, cell)
    partition = Partition(
        centers=on_device(centers, x.dtype),
        sizes=on_device(sizes, x.dtype),
        memberships=jax.device_put(u[cell]),
        noise=jax.device_put(lost[cell]),
        labels=jax.device_put(labels[cell]),
        objective=groups.objective,
        steps=on_device(SWEEPS, np.int32),
        status=on_device(int(status), np.int32),
        m=2.0,
        noise_distance=DELTA * bandwidth,
    )
    return Segmentation(
        partition.labels,
        k,
        partition.sizes,
        _shares(labels[cell], w, k, x.dtype),
        partition,
        None,
        None,
        partition.status,
    )


def _sizes(
    x: np.ndarray, w: np.ndarray, flat: np.ndarray, u: np.ndarray, cell: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centers (eq. 10) and sizes (eq. 11, m = 2: alpha goes with the root of the sum of u² D) of memberships given a cell."""
    total = partial(np.bincount, cell, minlength=len(u))
    mass = total(w)
    held = np.maximum(mass, np.finfo(float).tiny)
    mean = np.stack([total(w * x[:, i]) for i in range(3)], axis=1) / held[:, None]
    middle = np.stack([total(w * flat[:, i]) for i in (0, 1)], axis=1) / held[:, None]
    within = total(w * sum((flat[:, i] - middle[cell, i]) ** 2 for i in (0, 1)))
    square = u.astype(float) ** 2
    pull = mass[:, None] * square
    share = pull / np.maximum(pull.sum(axis=0), np.finfo(float).tiny)
    squared = ((middle[:, None] - share.T @ middle) ** 2).sum(axis=-1)
    sizes = np.sqrt((pull * squared).sum(axis=0) + square.T @ within)
    return share.T @ mean, sizes / sizes.sum() if sizes.sum() > 0 else np.full(len(sizes), 1 / len(sizes))


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
        fit.labels, k, fit.sizes, _shares(labels, w, k, x.dtype), fit, count, seeds, on_device(int(status), np.int32)
    )


def _bandwidth(x: np.ndarray, w: np.ndarray) -> float:
    """From the spacing of the points on their surface and the size of that surface; what lies alone counts as neither."""
    real = np.flatnonzero(w > 0)
    crowd = x[real[:: max(len(real) // (16 * CROWD), 1)]].astype(float)
    crowd = crowd - crowd[0]  # points that are all one are now zero, to the last digit
    crowd = crowd - np.ones(len(crowd)) @ crowd / len(crowd)
    # Thinned in an order of the points' own, so that the one they come in does not matter.
    crowd = crowd[np.argsort(np.einsum("ij,ij->i", crowd, crowd))]
    crowd = crowd[np.linspace(0, len(crowd) - 1, min(len(crowd), CROWD)).astype(int)]
    probes = crowd[np.linspace(0, len(crowd) - 1, min(len(crowd), PROBES)).astype(int)]
    neighbour = min(NEIGHBOUR, len(crowd) - 1)
    # |p - c|² less |p|², one product, few probes at a time so that what is looked at stays at hand.
    beside = np.concatenate([-2 * crowd.T, np.einsum("ij,ij->i", crowd, crowd)[None]])
    asked = np.concatenate([probes, np.ones((len(probes), 1))], axis=1)
    parts = np.array_split(asked, -(-len(asked) // AT_A_TIME))
    nearest = np.concatenate([nth_smallest(product(part, beside), neighbour) for part in parts])
    reach = np.sqrt(np.maximum(nearest + np.einsum("ij,ij->i", probes, probes), 0))
    usual = np.quantile(reach, QUANTILE)
    # `neighbour` points within a disc of this radius: so much surface has each of the points that lie on a surface.
    area = np.pi * usual**2 / max(neighbour, 1) * (reach <= ALONE * usual).mean() * len(crowd)
    spacing, surface = np.sqrt(area / max(len(real) * (reach <= ALONE * usual).mean(), 1)), np.sqrt(area)
    # Points that are all one have no scale of their own: any will do.
    smallest = np.sqrt(np.finfo(x.dtype).eps) * (float(np.abs(crowd).max()) or 1.0)
    return max(BANDWIDTH * float(np.cbrt(spacing**2 * surface)), smallest)


def _places(flat: np.ndarray, w: np.ndarray, bandwidth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points as few enough weighted places, padded; and the place of each point."""
    most = CAPACITIES[-1]
    real = np.flatnonzero(w > 0)
    pitch = bandwidth / 2
    while True:
        corner = np.floor(np.clip(flat / pitch, -1e9, 1e9)).astype(np.int64)
        key = (corner[:, 0] - corner[:, 0].min()) * (np.ptp(corner[:, 1]) + 1) + corner[:, 1] - corner[:, 1].min()
        cell = _numbered(key)
        if cell.max() < most:
            break
        pitch *= 1.25
    number = int(cell.max()) + 1
    # A point counts as one on the average, and a dense cloud for fewer points than it has.
    scale = min(len(real), COUNTED) / w.sum()
    weight = np.bincount(cell, w, minlength=number)
    # Points of weight 0 get a label too; alone in their cell, they are where they are.
    share = np.where(weight[cell] > 0, w, 1.0)
    total = np.bincount(cell, share, minlength=number)
    at = np.stack([np.bincount(cell, share * flat[:, i], minlength=number) for i in (0, 1)], axis=1) / total[:, None]
    capacity = next(c for c in CAPACITIES if c >= number)
    spare = capacity - number
    return np.pad(at, ((0, spare), (0, 0))), np.pad(weight * scale, (0, spare)), cell


def _numbered(keys: np.ndarray) -> np.ndarray:
    """Keys, whole numbers from 0 on, as their places among those that occur."""
    if keys.max() > 8 * len(keys):
        return np.unique(keys, return_inverse=True)[1].astype(np.int64)
    occurs = np.zeros(int(keys.max()) + 1, bool)
    occurs[keys] = True
    return (np.cumsum(occurs) - 1)[keys]


def _shares(labels: np.ndarray, w: np.ndarray, k: int, dtype: Any) -> Array:
    mass = np.bincount(labels[labels >= 0], w[labels >= 0], minlength=k)
    return on_device(mass / max(mass.sum(), np.finfo(dtype).tiny), dtype)


def candidates_of(ks: Any, rule: str, count: int | None = None) -> tuple[int, ...]:
    """The numbers of objects allowed, in order, of so many points; any where that is not known yet."""
    if isinstance(ks, str):
        checks.choice(ks, "ks", ("auto",))
        low, high = (2, 5) if rule == "paper" else (1, MOST)
        return tuple(range(low, min(high, count or high) + 1)) or (low,)
    if not isinstance(ks, Iterable):
        raise TypeError(f"ks must be 'auto' or several numbers such as (3,), got {ks!r}")
    wanted = [checks.integer(k, "ks", at_least=1, at_most=count, why=" (the number of points)") for k in ks]
    if not wanted or len(set(wanted)) < len(wanted):
        raise ValueError(f"ks must hold at least one number and none twice, got {tuple(wanted)}")
    return tuple(sorted(wanted))


def _noise(value: Any, count: int) -> float:
    given = checks.noise_distance_or_auto(value, count)
    return 0.0 if given is None else float(np.median(np.asarray(given)))
