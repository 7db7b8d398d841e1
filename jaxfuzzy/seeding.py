"""Deterministic starts: PCA and histogram seeds for fuzzy c-means (paper section II-A)."""

from jaxfuzzy.arrays import Array, Float, Int, record


@record
class Seeds:
    """Seeds from the histogram along the first principal axis.

    Attributes:
        centers: One seed a cluster.
        axis: The first principal axis, a unit vector.
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
