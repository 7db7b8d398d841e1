"""Deterministic starts: PCA and histogram seeds for fuzzy c-means (paper section II-A).

The points are projected on their first principal axis; the histogram along it falls into agglomerates, parted by valleys, and the
seeds are the mean points of the agglomerates. The paper's eqs. 1 and 2 are read as z = Wᵀ(x - mu) and x ≈ W z + mu.
"""

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float, Int, record

# A valley parts two agglomerates where the lower peak rises above it by this many standard deviations of a count.
VALLEY_SIGMAS = 2.0
# More bins than this tell nothing more, however heavy the points are (Rice's rule reaches them at 1e12 points).
MOST_BINS = 20_000


@record
class Seeds:
    """Seeds from the histogram along the first principal axis.

    Attributes:
        centers: One seed a cluster.
        axis: The first principal axis, a unit vector whose largest component is positive.
        mean: Mean of the points.
        edges: Edges of the histogram's bins along the axis, measured from the mean.
        counts: Weight of the points in each bin.
        peaks: Index of the bin at the top of each agglomerate, heaviest agglomerate first.
    """

    centers: Float[Array, "k D"]
    axis: Float[Array, " D"]
    mean: Float[Array, " D"]
    edges: Float[Array, " B_1"]
    counts: Float[Array, " B"]
    peaks: Int[Array, " P"]


def principal_axes(points: ArrayLike, weights: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Principal axes of points (eqs. 1 to 4).

    Args:
        points: Points (N, D).
        weights: Weight of each point (N,).

    Returns:
        Mean (D,), axes (D, D) as rows with the widest first, variances along them (D,).
    """
    points, heaviness = _eager(points, weights)
    mean = heaviness @ points / heaviness.sum()
    offsets = np.where((heaviness > 0)[:, None], points - mean, 0)
    covariance = (heaviness * offsets.T) @ offsets / heaviness.sum()
    variances, axes = np.linalg.eigh(covariance)
    axes = axes.T[::-1]
    largest = axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)]
    return mean, axes * np.sign(largest)[:, None], variances[::-1]


def histogram_seeds(points: ArrayLike, k: int, *, bins: int | None = None, weights: ArrayLike | None = None) -> Seeds:
    """Seeds at the centers of the agglomerates of the histogram along the first principal axis (paper section II-A).

    Asked for more seeds than there are agglomerates, the heaviest one is split at its median, again and again; asked for fewer, the
    heaviest are kept. Deterministic.

    Args:
        points: Points (N, D).
        k: Number of seeds, at most N.
        bins: Number of bins; None takes twice the cube root of the points' weight (Rice's rule), at least 8; at most 20,000.
        weights: Weight of each point (N,).

    Raises:
        ValueError: `k` below 1 or above N, `bins` below 1 or above 20,000, points that are not finite.
    """
    array = checks.points(points)
    checks.integer(k, "k", at_least=1, at_most=array.shape[0], why=" (the number of points)")
    if bins is not None:
        checks.integer(bins, "bins", at_least=1, at_most=MOST_BINS)
    rows, heaviness = _eager(array, weights)
    mean, axes, _ = principal_axes(rows, heaviness)
    along = (rows - mean) @ axes[0]
    present = heaviness > 0
    low, high = along[present].min(), along[present].max()
    # Counting weight, not rows, makes weight 2 the same as the point twice.
    bins = bins or min(max(8, round(2 * heaviness.sum() ** (1 / 3))), MOST_BINS)
    edges = np.linspace(low, high if high > low else low + 1, bins + 1)
    place = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(place, heaviness, len(edges) - 1)
    owner, peaks = _agglomerates(counts)
    groups = [np.flatnonzero(present & (owner[place] == i)) for i in range(len(peaks))]
    order = np.argsort([-heaviness[g].sum() for g in groups], kind="stable")
    groups, peaks = [groups[i] for i in order], peaks[order]
    while len(groups) < k:
        heaviest = max(range(len(groups)), key=lambda i: heaviness[groups[i]].sum() if len(groups[i]) > 1 else -1.0)
        group = groups.pop(heaviest)
        sort = group[np.argsort(along[group], kind="stable")]
        heap = np.cumsum(heaviness[sort])
        cut = _between(along[sort], int(np.searchsorted(heap, heap[-1] / 2)) + 1)
        groups[heaviest:heaviest] = [sort[:cut], sort[cut:] if len(sort) > 1 else sort]
    centers = np.stack([heaviness[g] @ rows[g] / heaviness[g].sum() for g in groups[:k]])
    as_type = lambda value: jnp.asarray(value, array.dtype)
    return Seeds(as_type(centers), as_type(axes[0]), as_type(mean), as_type(edges), as_type(counts), jnp.asarray(peaks))


def _between(values: np.ndarray, cut: int) -> int:
    """The nearest cut of sorted values that keeps equal ones together, so that a weight does what repetition does."""
    cuts = np.flatnonzero(np.diff(values) > 0) + 1
    return int(cuts[np.abs(cuts - cut).argmin()]) if len(cuts) else max(1, len(values) // 2)


def _eager(points: ArrayLike, weights: ArrayLike | None) -> tuple[np.ndarray, np.ndarray]:
    rows = np.asarray(checks.points(points), float)
    given = checks.weights(weights, len(rows))
    heaviness = np.ones(len(rows)) if given is None else np.asarray(given, float)
    # A point of weight 0 may hold anything finite; put it where it does no harm.
    return np.where((heaviness > 0)[:, None], rows, rows[np.argmax(heaviness)]), heaviness


def _agglomerates(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which agglomerate each bin belongs to, and the bin at the top of each, from left to right."""
    padded = np.pad(counts, 2, mode="edge")
    smooth = np.convolve(padded, np.array([1, 4, 6, 4, 1]) / 16, mode="valid")
    # Bins are joined from the fullest down: each belongs to the peak it is reached from, and two peaks stay apart where the
    # valley between them is deeper than chance makes it.
    owner = np.full(len(counts), -1)
    tops: dict[int, float] = {}
    for bin_ in np.argsort(-smooth, kind="stable"):
        beside = sorted({int(owner[j]) for j in (bin_ - 1, bin_ + 1) if 0 <= j < len(counts) and owner[j] >= 0})
        if not beside:
            owner[bin_], tops[int(bin_)] = bin_, smooth[bin_]
            continue
        high = max(beside, key=lambda top: tops[top])
        owner[bin_] = high
        for low in beside:
            rise = 2 * (np.sqrt(tops[low]) - np.sqrt(smooth[bin_]))
            if low != high and rise < VALLEY_SIGMAS:
                owner[owner == low] = high
                del tops[low]
    peaks = np.array(sorted(tops))
    return np.searchsorted(peaks, owner), peaks
