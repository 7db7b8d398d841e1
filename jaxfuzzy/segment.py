"""From points to objects: how many stand on the ground plane, and which point belongs to which."""

from jaxfuzzy.arrays import Array, Float, Int, record
from jaxfuzzy.fcm import Partition
from jaxfuzzy.seeding import Seeds
from jaxfuzzy.validity import ClusterCount


@record
class Segmentation:
    """Points divided into objects.

    Attributes:
        labels: The object of each point, -1 for outliers.
        k: Number of objects.
        sizes: Sizes of the clusters (the paper's alpha); they sum to 1.
        shares: Share of the labelled points in each object.
        partition: A fuzzy partition of all N points into the k objects.
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
