"""What a fit of fuzzy c-varieties gives back."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Bool, Float, Int, Scalar, record, static
from jaxfuzzy.embedding import size
from jaxfuzzy.status import Status


@record
class Varieties:
    """C linear varieties in an embedding, and the points' memberships in them.

    With a tuple of embeddings every array field has a leading axis E and is padded to the largest Q.

    Attributes:
        centers: A point on each variety.
        normals: Unit normal of each hyperplane (q = Q - 1); zeros where q < Q - 1.
        basis: Orthonormal directions that span each variety, that of largest scatter first; no gradient is promised for them.
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
        origin: Mean of the points. With `unit` it makes the local frame (p - origin) / unit in which moments are kept, since
            in the input's frame they lose digits far from its origin.
        unit: RMS distance of the points from their mean.
        local_centers: Centers of the embedded local points (eq. 15).
        scatter: Their scatter about the centers (eq. 16), divided by the sum of its weights.
        slopes: Mean of their ∇phi ∇phiᵀ under the same weights: n · scatter n / n · slopes n is a mean squared distance.
        bounds: Lowest and highest coordinates of each variety's inliers: their 2 % and 98 % quantiles, stretched as if they
            were spread evenly, so that one outlier moves nothing.
        masses: Weighted sum of the memberships in each variety.
        embedding: Name of the embedding, or the names.
        distance: Which distance was used.
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
    origin: Float[Array, " D"]
    unit: Float[Array, ""]
    local_centers: Float[Array, "C Q"]
    scatter: Float[Array, "C Q Q"]
    slopes: Float[Array, "C Q Q"]
    bounds: Float[Array, "C 2 D"]
    masses: Float[Array, " C"]
    embedding: str | tuple[str, ...] = static()
    distance: str = static(default="geometric")

    def pick(self, embedding: str) -> "Varieties":
        """The varieties in one of several embeddings, without padding.

        Raises:
            ValueError: this embedding was not fitted.
        """
        names = (self.embedding,) if isinstance(self.embedding, str) else self.embedding
        checks.choice(embedding, "embedding", names)
        if isinstance(self.embedding, str):
            return self
        at, q = names.index(embedding), size(embedding, self.origin.shape[-1])
        one = jax.tree.map(lambda leaf: leaf[at], self)
        return replace(
            one,
            centers=one.centers[:, :q],
            normals=one.normals[:, :q],
            basis=one.basis[:, :q, : q - 1],
            local_centers=one.local_centers[:, :q],
            scatter=one.scatter[:, :q, :q],
            slopes=one.slopes[:, :q, :q],
            embedding=embedding,
        )


def unless_finite(fit: Varieties) -> Varieties:
    """Says so where something of what is given back is not finite."""
    shown = (fit.centers, fit.normals, fit.basis, fit.squared_distances, fit.objective, fit.bounds)
    finite = jnp.stack([jnp.isfinite(value).all() for value in shown]).all()
    return replace(fit, status=fit.status | jnp.where(finite, 0, int(Status.NOT_FINITE)))
