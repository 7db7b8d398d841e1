"""How many clusters: validity indices, the paper's rule, and `choose_k` over all candidates in one compiled call.

Paper symbols → words: k number of clusters, VRC variance ratio (eq. 6), S_W and S_B scatter within and between clusters.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, Int, Scalar, as_float, is_concrete, record
from jaxfuzzy.fcm import _STATIC, NoiseRule, Partition, _fit
from jaxfuzzy.seeding import histogram_seeds
from jaxfuzzy.solve import Effort, Solver

Index = Literal[
    "vrc", "xie_beni", "partition_coefficient", "modified_partition_coefficient", "fuzzy_silhouette", "jump"
]
INDICES: tuple[Index, ...] = get_args(Index)
RULES = ("paper", "best")
# Where VRC rises to its upper end only, the paper takes the k before which it "increases rapidly": made exact as this ratio.
ABRUPT = 2.0
# Candidates fitted in lock step on a CPU, where it saves little that they are: all of them wait for the slowest.
LOCK_STEP = 2
# Points whose distances to all others are held at once by the silhouette.
SILHOUETTE_ROWS = 256


@record
class ClusterCount:
    """The chosen number of clusters and what it was chosen from.

    Attributes:
        k: The chosen number.
        ks: The candidates.
        scores: The index for each candidate.
        partitions: One partition a candidate, padded to the largest k, leading axis M; pads have size 0 and membership 0.
        partition: The chosen one, unpadded.
        status: Reasons to read this with care; see `describe`.
    """

    k: Int[Array, ""]
    ks: Int[Array, " M"]
    scores: Float[Array, " M"]
    partitions: Partition
    partition: Partition
    status: Int[Array, ""]


def choose_k(
    points: ArrayLike,
    ks: Iterable[int] = (2, 3, 4, 5),
    *,
    m: Scalar = 2.0,
    sizes: bool = False,
    index: Index = "vrc",
    rule: Literal["paper", "best"] = "paper",
    noise_distance: Scalar | NoiseRule | None = None,
    weights: ArrayLike | None = None,
    solver: Solver = Solver(),
) -> ClusterCount:
    """Chooses the number of clusters: fuzzy c-means from histogram seeds for every k in one compiled call (section II).

    The indices: "vrc" (eq. 6, Caliński and Harabasz 1974), "xie_beni" (1991, lower is better), "partition_coefficient"
    (Bezdek
    1981) and its normalised form "modified_partition_coefficient" (Davé 1996), "fuzzy_silhouette" (Campello and Hruschka 2006),
    "jump" (Sugar and James 2003). Of these only "jump" can say k = 1; the partition coefficient is 1 there whatever the data,
    unless noise takes its share.

    Args:
        points: Points (N, D).
        ks: Candidates, each at least 1 and at most N.
        m: Fuzzifier.
        sizes: Whether to learn the sizes; the paper chooses k without and then fits with them.
        index: Which validity index.
        rule: "paper": the smallest k that is a local maximum (an end counts when above its neighbour); where only the upper end is
            one, the smallest k at which the index at least doubles, if any. "best": the best value.
        noise_distance: As in `fcm`; points that belong to noise most then count in no index.
        weights: Weight of each point (N,).
        solver: Steps, tolerance and acceleration.

    Returns:
        The choice with all candidates' scores and partitions.

    Raises:
        ValueError: Empty or repeated `ks`, a k out of range, 1 among `ks` for an index that cannot score it, unknown names,
            a solver for several devices.
        TypeError: `ks` are not several whole numbers, or the solver is none.
    """
    array = checks.points(points)
    checks.kind(solver, "solver", Solver)
    if not isinstance(ks, Iterable):
        raise TypeError(f"ks must be several numbers such as (2, 3), got {ks!r}")
    candidates = [
        checks.integer(k, "ks", at_least=1, at_most=array.shape[0], why=" (the number of points)") for k in ks
    ]
    if not candidates or len(set(candidates)) < len(candidates):
        raise ValueError(f"ks must hold at least one number and none twice, got {tuple(candidates)}")
    candidates.sort()
    checks.choice(index, "index", INDICES)
    checks.choice(rule, "rule", RULES)
    if candidates[0] == 1 and index not in ("jump", "partition_coefficient"):
        raise ValueError(f"ks must not hold 1 for index={index!r}, which cannot score one cluster; index='jump' can")
    if index == "jump" and candidates != list(range(1, len(candidates) + 1)):
        raise ValueError(f"ks must be 1, 2, ... without a gap for index='jump', got {tuple(candidates)}")
    if solver.mesh is not None:
        raise ValueError("solver must have no mesh: choose_k runs on one device; use fcm for each k on several")
    checks.fuzzifier(m)
    weights = checks.weights(weights, array.shape[0])
    noise = noise_distance if isinstance(noise_distance, NoiseRule) else checks.noise_distance(noise_distance)
    most, dims = candidates[-1], array.shape[1]
    seeds = np.zeros((len(candidates), most, dims))
    for row, k in enumerate(candidates):
        seeds[row, :k] = histogram_seeds(array, k, weights=weights).centers
    mask = np.arange(most) < np.array(candidates)[:, None]
    as_type = partial(jnp.asarray, dtype=array.dtype)
    partitions, scores = _fit_all(
        array,
        as_type(seeds),
        jnp.asarray(mask),
        as_type(m),
        None if noise is None or isinstance(noise, NoiseRule) else as_type(noise),
        None if weights is None else weights.astype(array.dtype),
        solver.traced(array.dtype),
        index=index,
        rule=noise if isinstance(noise, NoiseRule) else None,
        sizes=checks.flag(sizes, "sizes"),
        square=is_concrete(m) and float(m) == 2,
        memberships=True,
    )
    chosen = _pick(np.asarray(scores, float), index, rule)
    k = candidates[chosen]
    one = jax.tree.map(lambda leaf: leaf[chosen], partitions)
    partition = Partition(
        one.centers[:k],
        one.sizes[:k],
        one.memberships[:, :k],
        one.noise,
        one.labels,
        one.objective,
        one.steps,
        one.status,
        one.m,
        one.noise_distance,
        one.sizes_learned,
    )
    return ClusterCount(jnp.asarray(k), jnp.asarray(candidates), scores, partitions, partition, partition.status)


@partial(jax.jit, static_argnames=("index", *_STATIC))
def _fit_all(
    points: Array,
    seeds: Array,
    mask: Array,
    m: Array,
    noise_distance: Array | None,
    weights: Array | None,
    effort: Effort,
    *,
    index: Index,
    **static: object,
) -> tuple[Partition, Float[Array, " M"]]:
    def fit(seeds: Array, mask: Array) -> Partition:
        return _fit(points, seeds, m, noise_distance, weights, effort, mask=mask, **static)

    count = mask.shape[0]
    width = min(count, LOCK_STEP) if jax.default_backend() == "cpu" else count
    # Filled up with the first candidate again, the quickest to stop.
    rows = np.r_[np.arange(count), np.zeros(-count % width, int)].reshape(-1, width)
    found = jax.lax.map(lambda own: jax.vmap(fit)(*own), (seeds[rows], mask[rows]))
    partitions = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], found)
    ks = mask.sum(axis=1)
    if index == "jump":
        return partitions, _jumps(points, partitions, weights)

    def score(item: tuple[Partition, Array, Array]) -> Array:
        partition, real, k = item
        if index == "vrc":
            return _variance_ratio(points, partition.labels, weights, real.shape[0], k)
        if index == "xie_beni":
            return _xie_beni(points, partition, weights, real)
        if index == "fuzzy_silhouette":
            return _fuzzy_silhouette(points, partition, weights)
        return _coefficient(partition, weights, k, modified=index != "partition_coefficient")

    return partitions, jax.lax.map(score, (partitions, mask, ks))


def _pick(scores: np.ndarray, index: str, rule: str) -> int:
    """Position of the chosen candidate."""
    better = -scores if index == "xie_beni" else scores
    better = np.where(np.isfinite(better), better, -np.inf)
    if rule == "best" or len(better) == 1:
        return int(better.argmax())
    walled = np.concatenate([[-np.inf], better, [-np.inf]])
    peaks = np.flatnonzero((walled[1:-1] > walled[:-2]) & (walled[1:-1] >= walled[2:]))
    if len(peaks) and peaks[0] < len(better) - 1:
        return int(peaks[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        rises = np.flatnonzero(scores[1:] / scores[:-1] >= ABRUPT) if index != "xie_beni" else np.array([], int)
    return int(rises[0]) + 1 if len(rises) else len(better) - 1


def variance_ratio(points: ArrayLike, labels: ArrayLike, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """Variance ratio criterion of a hard partition (eq. 6): (S_B / (k - 1)) / (S_W / (n - k)); higher is better.

    Args:
        points: Points (N, D).
        labels: Cluster of each point (N,), 0 to k - 1; -1 leaves a point out.
        weights: Weight of each point; n is their sum.

    Raises:
        ValueError: Shapes that do not agree, fewer than two clusters.
    """
    array = checks.points(points)
    given = checks.labels(labels, array.shape[0])
    heaviness = checks.weights(weights, array.shape[0])
    clusters = int(given.max()) + 1
    if clusters < 2:
        raise ValueError(f"labels must name at least two clusters for the variance ratio, got {clusters}")
    return _variance_ratio(array, jnp.asarray(given), heaviness, clusters, clusters)


def _within(points: Array, labels: Array, weights: Array | None, clusters: int) -> tuple[Array, Array, Array]:
    """Scatter within and between hard clusters, and the weight they hold."""
    inside = _counted(labels, weights, points.dtype)
    origin = inside @ points / inside.sum()
    offsets = jnp.where((inside > 0)[:, None], points - origin, 0)
    member = jax.nn.one_hot(labels, clusters, dtype=points.dtype) * inside[:, None]
    mass = member.sum(axis=0)
    means = member.T @ offsets / jnp.where(mass > 0, mass, 1)[:, None]
    own = jnp.where((labels >= 0)[:, None], means[labels], 0)
    return inside @ jnp.square(offsets - own).sum(axis=1), mass @ jnp.square(means).sum(axis=1), inside.sum()


def _variance_ratio(
    points: Array, labels: Array, weights: Array | None, clusters: int, k: int | Array
) -> Float[Array, ""]:
    within, between, count = _within(points, labels, weights, clusters)
    return between / (k - 1) / (within / (count - k))


def _jumps(points: Array, partitions: Partition, weights: Array | None) -> Float[Array, " M"]:
    """Sugar and James (2003): how far the distortion to the power -D/2 jumps at each k = 1, 2, ...; at 0 it counts as 0."""
    dims, clusters = points.shape[1], partitions.centers.shape[1]
    within = jax.lax.map(lambda labels: jnp.stack(_within(points, labels, weights, clusters)[::2]), partitions.labels)
    # Relative to the largest distortion, so that no unit overflows the power.
    distortion = within[:, 0] / within[:, 1]
    level = (distortion / distortion.max()) ** (-dims / 2)
    before = jnp.concatenate([jnp.zeros(1, points.dtype), level[:-1]])
    return level - before


def xie_beni(points: ArrayLike, partition: Partition, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """Xie and Beni's index (1991): mean of u^m D over the smallest squared distance of two centers; lower is better.

    Points that belong to noise most are left out; where all do it is not a number.

    Args:
        points: The points (N, D) of the fit.
        partition: A partition with at least two clusters and its memberships.
        weights: Weight of each point.

    Raises:
        ValueError: Fewer than two clusters, or a partition made with `memberships=False`.
    """
    array, heaviness = _fitted(points, partition, weights)
    if partition.centers.shape[0] < 2:
        raise ValueError("partition must have at least two clusters for the Xie-Beni index, got 1")
    return _xie_beni(array, partition, heaviness, jnp.ones(partition.centers.shape[0], bool))


def _xie_beni(points: Array, partition: Partition, weights: Array | None, real: Array) -> Float[Array, ""]:
    compact = jnp.zeros((), points.dtype)
    heaviness = _counted(partition.labels, weights, points.dtype)
    for i in range(partition.centers.shape[0]):
        apart = jnp.square(points - partition.centers[i]).sum(axis=1)
        compact += (heaviness * partition.memberships[:, i] ** partition.m) @ apart
    gaps = jnp.square(partition.centers[:, None] - partition.centers[None]).sum(axis=-1)
    counted = real[:, None] & real[None] & ~jnp.eye(real.shape[0], dtype=bool)
    return compact / (heaviness.sum() * jnp.where(counted, gaps, jnp.inf).min())


def partition_coefficient(
    partition: Partition, *, modified: bool = False, weights: ArrayLike | None = None
) -> Float[Array, ""]:
    """Partition coefficient (Bezdek 1981): the mean of the summed squared memberships, 1/K to 1; higher is crisper.

    Points that belong to noise most are left out; where all do it is not a number.

    Args:
        partition: A partition with its memberships.
        modified: Davé's normalised form 1 - K/(K-1) (1 - PC), 0 to 1, which does not favour few clusters.
        weights: Weight of each point.

    Raises:
        ValueError: A partition made with `memberships=False`.
    """
    count = checks.kind(partition, "partition", Partition).memberships.shape[0]
    if count == 0:
        raise ValueError("partition must carry memberships: fit with memberships=True")
    return _coefficient(partition, checks.weights(weights, count), partition.centers.shape[0], modified=modified)


def _coefficient(partition: Partition, weights: Array | None, k: int | Array, *, modified: bool) -> Float[Array, ""]:
    heaviness = _counted(partition.labels, weights, partition.memberships.dtype)
    mean = heaviness @ jnp.square(partition.memberships).sum(axis=1) / heaviness.sum()
    return 1 - k / (k - 1) * (1 - mean) if modified else mean


def _counted(labels: Array, weights: Array | None, dtype: Any) -> Float[Array, " N"]:
    """Weights of the points that count in an index: those that do not belong to noise most."""
    inside = (labels >= 0).astype(dtype)
    return inside if weights is None else inside * weights


def fuzzy_silhouette(points: ArrayLike, partition: Partition, *, weights: ArrayLike | None = None) -> Float[Array, ""]:
    """Fuzzy silhouette (Campello and Hruschka 2006): silhouettes weighted by how far the two largest memberships differ.

    The silhouettes are those of the hardened partition with mean distances between points; time grows with N², memory with N.

    Args:
        points: The points (N, D) of the fit.
        partition: A partition with at least two clusters and its memberships.
        weights: Weight of each point.

    Raises:
        ValueError: Fewer than two clusters, or a partition made with `memberships=False`.
    """
    array, heaviness = _fitted(points, partition, weights)
    if partition.centers.shape[0] < 2:
        raise ValueError("partition must have at least two clusters for the silhouette, got 1")
    return _fuzzy_silhouette(array, partition, heaviness)


def _fuzzy_silhouette(points: Array, partition: Partition, weights: Array | None) -> Float[Array, ""]:
    count, clusters = partition.memberships.shape
    heaviness = _counted(partition.labels, weights, points.dtype)
    member = jax.nn.one_hot(partition.labels, clusters, dtype=points.dtype) * heaviness[:, None]
    mass = member.sum(axis=0)
    rows = min(SILHOUETTE_ROWS, count)
    pad = -count % rows
    padded = jnp.pad(points, ((0, pad), (0, 0))).reshape(-1, rows, points.shape[1])

    def distance_sums(block: Array) -> Array:
        squares = sum(jnp.square(block[:, None, d] - points[None, :, d]) for d in range(points.shape[1]))
        return jnp.sqrt(jnp.asarray(squares)) @ member

    sums = jax.lax.map(distance_sums, padded).reshape(-1, clusters)[:count]
    own = jax.nn.one_hot(partition.labels, clusters, dtype=bool)
    others = mass - jnp.where(own, heaviness[:, None], 0)
    mean = jnp.where(others > 0, sums / jnp.where(others > 0, others, 1), jnp.inf)
    within, nearest = jnp.where(own, mean, jnp.inf).min(axis=1), jnp.where(own, jnp.inf, mean).min(axis=1)
    # A point alone in its cluster has silhouette 0, as in the crisp definition.
    usable = jnp.isfinite(within) & jnp.isfinite(nearest)
    larger = jnp.where(usable, jnp.maximum(within, nearest), 1)
    width = jnp.where(usable, (nearest - within) / jnp.where(larger > 0, larger, 1), 0)
    first, second = jax.lax.top_k(partition.memberships, 2)[0].T
    share = (first - second) * heaviness
    return share @ width / share.sum()


def _fitted(points: ArrayLike, partition: Partition, weights: ArrayLike | None) -> tuple[Array, Array | None]:
    checks.kind(partition, "partition", Partition)
    array = as_float(checks.points(points, dims=partition.centers.shape[1]))
    if partition.memberships.shape[0] != array.shape[0]:
        raise ValueError(
            f"partition must carry memberships of the {array.shape[0]} points, got {partition.memberships.shape[0]}:"
            " fit with memberships=True"
        )
    return array, checks.weights(weights, array.shape[0])
