"""How many clusters: validity indices, the paper's rule, and `choose_k` over all candidates in one compiled call."""

from jaxfuzzy.arrays import Array, Float, Int, record
from jaxfuzzy.fcm import Partition


@record
class ClusterCount:
    """The chosen number of clusters and what it was chosen from.

    Attributes:
        k: The chosen number.
        ks: The candidates.
        scores: The index for each candidate.
        partitions: One partition a candidate, padded to the largest k, leading axis M.
        partition: The chosen one, unpadded.
        status: Reasons to read this with care; see `describe`.
    """

    k: Int[Array, ""]
    ks: Int[Array, " M"]
    scores: Float[Array, " M"]
    partitions: Partition
    partition: Partition
    status: Int[Array, ""]
