"""Fuzzy c-varieties with noise clustering in enlarged data spaces (paper section III)."""

from jaxfuzzy.arrays import Array, Bool, Float, Int, Scalar, record, static


@record
class Varieties:
    """C linear varieties in an embedding, and the points' memberships in them.

    With a tuple of embeddings every array field has a leading axis E and is padded to the largest Q.

    Attributes:
        centers: A point on each variety.
        normals: Unit normal of each hyperplane (q = Q - 1); zeros where q < Q - 1.
        basis: Orthonormal directions that span each variety; no gradient is promised for them.
        squared_distances: Squared distances, in metres squared if geometric, of the embedding if algebraic.
        memberships: Memberships in the varieties.
        noise: Membership in the noise cluster; zero without one.
        labels: The variety of largest membership, -1 where noise is larger.
        inliers: Where noise membership is not the largest.
        objective: The objective.
        steps: Number of steps taken.
        status: Reasons to read this with care; see `describe`.
        m: Fuzzifier.
        noise_distance: Noise distance, infinite without a noise cluster.
        embedding: Name of the embedding, or the names.
    """

    centers: Float[Array, "C Q"]
    normals: Float[Array, "C Q"]
    basis: Float[Array, "C Q q"]
    squared_distances: Float[Array, "N C"]
    memberships: Float[Array, "N C"]
    noise: Float[Array, " N"]
    labels: Int[Array, " N"]
    inliers: Bool[Array, " N"]
    objective: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    m: Scalar
    noise_distance: Scalar
    embedding: str | tuple[str, ...] = static()
