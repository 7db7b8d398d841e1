"""The one membership rule of the library, shared by every method.

Paper symbols → words: u membership, m fuzzifier, D squared distance, alpha size, delta noise distance.

With r = 1 / (m - 1), K clusters of size alpha_i and a noise cluster at distance delta from every point,

    u_i = K alpha_i D_i^(-r) / (sum_j K alpha_j D_j^(-r) + delta^(-2r)),

which is eqs. 9, 17 and 20 at once (without sizes K alpha_i = 1). It is evaluated relative to the nearest distance, so no
fuzzifier overflows and no absolute floor is needed; a point at distance zero belongs wholly to the clusters it lies on.
With the memberships eliminated, eqs. 8, 14 and 19 become the reduced objective

    F = sum_k w_k (sum_i K alpha_i D_ki^(-r) + delta^(-2r))^(1 - m).

Arrays here have the cluster axis first, (K, n), so that sums over points are matrix products; `memberships` itself takes (N, K).
"""

import jax.numpy as jnp
from jax import lax

from jaxfuzzy.arrays import Array, Bool, Float, Scalar, record


@record
class Shares:
    """How n points divide themselves among K clusters and noise, before normalisation.

    Attributes:
        log_parts: Logarithm of each cluster's part; far below the smallest float's where it is zero.
        log_noise: Logarithm of the noise cluster's part; -inf without one.
        log_total: Logarithm of the sum of all parts.
        nearest: The squared distance that the parts are relative to.
    """

    log_parts: Float[Array, "K n"]
    log_noise: Float[Array, " n"]
    log_total: Float[Array, " n"]
    nearest: Float[Array, " n"]

    @property
    def memberships(self) -> Float[Array, "K n"]:
        """Membership of each point in each cluster."""
        return jnp.exp(self.log_parts - self.log_total)

    @property
    def noise(self) -> Float[Array, " n"]:
        """Membership of each point in the noise cluster, by its own column and never as one minus the others."""
        return jnp.exp(self.log_noise - self.log_total)

    def log_powers(self, m: Scalar) -> Float[Array, "K n"]:
        """Logarithm of the memberships to the power m."""
        return m * (self.log_parts - self.log_total)

    def objective(self, m: Scalar, shift: Scalar = 0.0) -> Float[Array, " n"]:
        """Each point's term of the reduced objective, times exp(-shift)."""
        return self.nearest * jnp.exp((1 - m) * self.log_total - shift)


def shares(
    squared_distances: Float[Array, "K n"],
    m: Scalar,
    log_strengths: Float[Array, " K"] | None = None,
    squared_noise: Scalar | Float[Array, " n"] | None = None,
) -> Shares:
    """Divides points among clusters.

    Args:
        squared_distances: Squared distances, not negative; zero is legal.
        m: Fuzzifier.
        log_strengths: log(K alpha_i); -inf leaves a cluster out (a pad). None: all 0.
        squared_noise: Squared noise distance, for all or for each point; None: no noise cluster.
    """
    r = 1 / (m - 1)
    considered = squared_distances
    if log_strengths is not None:
        considered = jnp.where((log_strengths == -jnp.inf)[:, None], jnp.inf, squared_distances)
    nearest = considered.min(axis=0)
    if squared_noise is not None:
        nearest = jnp.minimum(nearest, squared_noise)
    # Every expression below is the same for any reference, so the reference carries no derivative.
    nearest = lax.stop_gradient(nearest)
    log_parts = _log_part(r, nearest, considered)
    if log_strengths is not None:
        real = log_strengths > -jnp.inf
        weighed = log_parts + jnp.where(real, log_strengths, 0)[:, None]
        log_parts = jnp.where(real[:, None], weighed, _nothing(nearest))
    total = jnp.exp(log_parts).sum(axis=0)
    log_noise = jnp.full_like(nearest, -jnp.inf)
    if squared_noise is not None:
        log_noise = _log_part(r, nearest, jnp.broadcast_to(squared_noise, nearest.shape).astype(nearest.dtype))
        total = total + jnp.exp(log_noise)
    return Shares(log_parts, log_noise, jnp.log(total), nearest)


def _nothing(like: Array) -> Array:
    """Logarithm of a part that is zero: finite, so that no derivative by m multiplies zero by infinity."""
    return jnp.asarray(-(jnp.finfo(like.dtype).max ** 0.25), like.dtype)


def _log_part(r: Scalar, nearest: Array, squared_distances: Array) -> Array:
    """The part's logarithm r log(nearest / squared_distances): 0 where both are zero, that of nothing where only the first is."""
    on_it = squared_distances <= 0
    far = jnp.isinf(squared_distances) | (~on_it & (nearest <= 0))
    ratio = jnp.where(on_it | far, 1, nearest / jnp.where(on_it | far, 1, squared_distances))
    # A ratio below the smallest float is as good as never reached; flushed zeros must not meet the logarithm.
    far = far | (ratio <= 0)
    return jnp.where(far, _nothing(nearest), r * jnp.log(jnp.where(far, 1, ratio)))


def memberships(
    squared_distances: Float[Array, "N K"],
    m: Scalar,
    noise_distance: Scalar | Float[Array, " N"] | None = None,
    log_sizes: Float[Array, " K"] | None = None,
    mask: Bool[Array, " K"] | None = None,
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    """Memberships of N points in K clusters and in noise.

    Args:
        squared_distances: Squared distances, not negative.
        m: Fuzzifier.
        noise_distance: Noise distance, for all or for each point; None: no noise cluster.
        log_sizes: Logarithm of the cluster sizes alpha; None: equal sizes.
        mask: Which clusters are real; the others get membership zero.

    Returns:
        Memberships (N, K) and noise memberships (N,), which add up to 1 for each point.
    """
    part = shares(
        squared_distances.T,
        m,
        log_strengths(log_sizes, mask),
        None if noise_distance is None else jnp.square(noise_distance),
    )
    return part.memberships.T, part.noise


def log_strengths(log_sizes: Float[Array, " K"] | None, mask: Bool[Array, " K"] | None) -> Float[Array, " K"] | None:
    """log(K alpha_i), with K counting the real clusters and -inf for the others; None where both are None."""
    if log_sizes is None and mask is None:
        return None
    if log_sizes is None:
        assert mask is not None
        return jnp.where(mask, 0.0, -jnp.inf).astype(jnp.result_type(float))
    if mask is None:
        return log_sizes + jnp.log(jnp.asarray(log_sizes.shape[0], log_sizes.dtype))
    return jnp.where(mask, log_sizes + jnp.log(mask.sum().astype(log_sizes.dtype)), -jnp.inf)
