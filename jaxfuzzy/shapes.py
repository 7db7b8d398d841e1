"""From the points of an object to its shape: hypotheses, choice, batch."""

from jaxfuzzy.arrays import Array, Bool, Float, Int, Scalar, record, static
from jaxfuzzy.primitives import Primitive


@record
class Shape:
    """What an object is.

    Attributes:
        kind: "plane", "box", "cylinder", "cone", "sphere", or "quadric", or "unknown".
        primitive: The primitive; None where unknown.
        inliers: Which of the object's points lie on it.
        noise_distance: The noise distance used, in metres (the median where it differs from point to point).
        scores: Score of every kind tried, lower is better.
        margin: Score of the second best less that of the best.
        counts: Inliers in each embedding, where the paper's rule was asked for.
        covariance: Of `primitive.parameters()`.
        status: Reasons to read this with care; see `describe`.
    """

    primitive: Primitive | None
    inliers: Bool[Array, " N"]
    noise_distance: Scalar
    scores: dict[str, float]
    margin: float
    counts: dict[str, int]
    covariance: Float[Array, "P P"]
    status: Int[Array, ""]
    kind: str = static()
