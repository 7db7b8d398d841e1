"""Fuzzy c-means, plain and with a variable for cluster sizes (paper section II-D), optionally with a noise cluster."""

from jaxfuzzy.arrays import Array, Float, Int, Scalar, record


@record
class Partition:
    """A fuzzy partition of N points into K clusters.

    Attributes:
        centers: Cluster centers.
        sizes: Cluster sizes alpha; they sum to 1. Not the share of points: see `fcm`.
        memberships: Degree to which each point belongs to each cluster; empty (0, K) where not asked for.
        noise: Degree to which each point belongs to the noise cluster; zero without one.
        labels: The cluster of largest membership, -1 where noise is larger.
        objective: The objective in the units of the input.
        steps: Number of steps taken.
        status: Reasons to read this with care; see `describe`.
        m: Fuzzifier.
        noise_distance: Noise distance, infinite without a noise cluster.
    """

    centers: Float[Array, "K D"]
    sizes: Float[Array, " K"]
    memberships: Float[Array, "N K"]
    noise: Float[Array, " N"]
    labels: Int[Array, " N"]
    objective: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    m: Scalar
    noise_distance: Scalar
