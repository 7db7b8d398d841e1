"""Where a plane is dense: how many places of density there are, and which of them each point belongs to.

A noise-clustering partition (paper eqs. 19 and 20 with point prototypes, m = 2) tiles the plane with many small clusters; two of
them belong together unless the support of the plane has a valley between them. Support is a possibilistic typicality,

    f(q) = sum_k w_k exp(-|q - x_k|² / 2h²),

a count of points, so that a valley can be told from chance: the square root of a Poisson count has the same spread everywhere.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxfuzzy.arrays import Array, Bool, Float, Int, record

# Small clusters that tile the objects, and how many neighbours each is compared with, at how many places on the way.
PROTOTYPES, NEIGHBOURS, STOPS = 128, 8, 7
SWEEPS = 10
# Lengths in bandwidths: distance between seeds, noise distance, farthest neighbour, margin of the box that background is sought in.
APART, DELTA, REACH, MARGIN = 2.0, 2.4, 7.2, 4.0
# Support below which no seed is put, and the lattice on which the background is measured.
LEAST, LATTICE = 3.0, 16
# A peak is an object's when the valley beside it falls below this share of it, by so many standard deviations of a count ...
VALLEY, VALLEY_SIGMAS = 0.6, 4.0
# ... and it stands so many above the background.
PEAK_SIGMAS = 6.0
# A point is an outlier when its support is below this share of its object's mean, and less than so many deviations above background.
SPARSE, SPARSE_SIGMAS = 0.2, 4.0
BLOCK = 512


@record
class Groups:
    """Density parted into groups. C prototypes, P places.

    Attributes:
        prototypes: Centers of the small clusters.
        group: Rank of the group that each prototype belongs to, -1 for none.
        found: Number of groups that the tests tell apart.
        count: Number of groups kept.
        shares: Each place's membership in the groups, -1's share left out.
        typicality: Support of each place over the least that its group asks for; below 1 it is an outlier.
        objective: Objective of the noise clustering.
    """

    prototypes: Float[Array, "C 2"]
    group: Int[Array, " C"]
    found: Int[Array, ""]
    count: Int[Array, ""]
    shares: Float[Array, "P G"]
    typicality: Float[Array, " P"]
    objective: Float[Array, ""]


@partial(jax.jit, static_argnames=("most",))
def part(
    places: Float[Array, "P 2"],
    weights: Float[Array, " P"],
    bandwidth: Float[Array, ""],
    allowed: Bool[Array, " G"],
    *,
    most: int,
) -> Groups:
    """Parts the places of a plane into groups.

    Args:
        places: Places; padded ones have weight 0.
        weights: Number of points at each place.
        bandwidth: Bandwidth h of the support.
        allowed: Which numbers of groups 1, 2, ... are allowed; where the number found is not, the nearest that is.
        most: The largest number.
    """
    support = partial(_support, places=places, weights=weights, bandwidth=bandwidth)
    held = support(places)
    seeds, real = _mountains(places, held, weights, bandwidth)
    prototypes, objective = _tile(places, weights, seeds, real, DELTA * bandwidth)
    one, other, saddle, near, peak, background = _saddles(prototypes, real, places, weights, bandwidth, support)
    valley, prominence = _prominences(one, other, saddle, near, peak, real, background)
    # Peaks by falling prominence; how many pass every test; the nearest number that is allowed.
    found = jnp.maximum((prominence >= 1).sum(), 1)
    numbers = jnp.arange(1, most + 1)
    wanted = numbers[jnp.argmin(jnp.where(allowed, jnp.abs(numbers - found) + 0.1 * (numbers > found), jnp.inf))]
    rank = jnp.argsort(jnp.argsort(-prominence, stable=True), stable=True)
    kept = (rank < wanted) & (prominence > 0)
    root = _join(one, other, near, peak, kept | (valley >= 1))
    # Objects in the order of their prototypes' support, strongest first.
    order = jnp.argsort(jnp.argsort(jnp.where(kept, -peak, jnp.inf), stable=True), stable=True)
    group = jnp.where(kept[root] & real, order[root], -1)

    inverse = jnp.where(real, 1 / _squared_distances(places, prototypes, bandwidth), 0)
    inverse = inverse / inverse.sum(axis=1, keepdims=True)
    shares = inverse @ (group[:, None] == jnp.arange(most)).astype(places.dtype)
    mine = weights[:, None] * shares**2
    usual = (held @ mine) / jnp.maximum(mine.sum(axis=0), jnp.finfo(places.dtype).tiny)
    chance = (jnp.sqrt(background) + SPARSE_SIGMAS / 2) ** 2
    least = jnp.minimum(SPARSE * usual[jnp.argmax(shares, axis=1)], chance)
    typicality = held / jnp.maximum(least, jnp.finfo(places.dtype).tiny)
    return Groups(prototypes, group, found, kept.sum(), shares, typicality, objective)


def _support(
    queries: Float[Array, "M 2"], places: Float[Array, "P 2"], weights: Float[Array, " P"], bandwidth: Array
) -> Float[Array, " M"]:
    """Support of each query, summed over blocks of places."""

    def add(total: Array, block: tuple[Array, Array]) -> tuple[Array, None]:
        place, weight = block
        square = (queries**2).sum(axis=1)[:, None] + (place**2).sum(axis=1) - 2 * queries @ place.T
        return total + jnp.exp(-0.5 * jnp.maximum(square, 0) / bandwidth**2) @ weight, None

    blocks = places.reshape(-1, min(BLOCK, len(places)), 2), weights.reshape(-1, min(BLOCK, len(places)))
    return lax.scan(add, jnp.zeros(len(queries), places.dtype), blocks)[0]


def _mountains(places: Array, held: Array, weights: Array, bandwidth: Array) -> tuple[Array, Array]:
    """Seeds by the mountain method (Yager and Filev 1994): the place of most support, all near it struck out, and so on."""

    def pick(index: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        left, seeds, real = state
        best = jnp.argmax(left)
        good = (left[best] > LEAST) | (index == 0)
        near = ((places - places[best]) ** 2).sum(axis=1) < (APART * bandwidth) ** 2
        return jnp.where(near, -1.0, left), seeds.at[index].set(places[best]), real.at[index].set(good)

    start = jnp.where(weights > 0, held, -1), jnp.zeros((PROTOTYPES, 2), places.dtype), jnp.zeros(PROTOTYPES, bool)
    _, seeds, real = lax.fori_loop(0, PROTOTYPES, pick, start)
    return seeds, real


def _tile(places: Array, weights: Array, seeds: Array, real: Array, delta: Array) -> tuple[Array, Array]:
    """Noise clustering from the seeds: with m = 2, u = D^-1 / (sum_j D_j^-1 + delta^-2)."""

    def update(prototypes: Array, _: None) -> tuple[Array, Array]:
        inverse = jnp.where(real, 1 / _squared_distances(places, prototypes, delta), 0)
        total = inverse.sum(axis=1, keepdims=True) + delta**-2
        pull = weights[:, None] * (inverse / total) ** 2
        mass = pull.sum(axis=0)[:, None]
        moved = (pull.T @ places) / jnp.maximum(mass, jnp.finfo(places.dtype).tiny)
        return jnp.where(real[:, None] & (mass > 0), moved, prototypes), weights @ (1 / total[:, 0])

    prototypes, objectives = lax.scan(update, seeds, length=SWEEPS)
    return prototypes, objectives[-1]


def _squared_distances(places: Array, prototypes: Array, scale: Array) -> Array:
    square = (places**2).sum(axis=1)[:, None] + (prototypes**2).sum(axis=1) - 2 * places @ prototypes.T
    return jnp.maximum(square, 1e-6 * scale**2)


def _saddles(
    prototypes: Array, real: Array, places: Array, weights: Array, bandwidth: Array, support: partial[Array]
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Pairs of neighbours by falling saddle between them; support at each prototype; the background."""
    gap = jnp.sqrt(((prototypes[:, None] - prototypes) ** 2).sum(axis=-1))
    gap = jnp.where(jnp.eye(PROTOTYPES, dtype=bool) | ~(real[:, None] & real), jnp.inf, gap)
    length, other = lax.top_k(-gap, NEIGHBOURS)
    one, other = jnp.repeat(jnp.arange(PROTOTYPES), NEIGHBOURS), other.ravel()
    near = -length.ravel() < REACH * bandwidth
    stops = ((jnp.arange(STOPS) + 1) / (STOPS + 1)).astype(places.dtype)[:, None]
    way = prototypes[one][:, None] * (1 - stops) + prototypes[other][:, None] * stops
    low, high = _box(places, weights)
    low, high = low - MARGIN * bandwidth, high + MARGIN * bandwidth
    step = (jnp.arange(LATTICE) + 0.5) / LATTICE
    lattice = low + (high - low) * jnp.stack(jnp.meshgrid(step, step), axis=-1).reshape(-1, 2).astype(places.dtype)
    held = support(jnp.concatenate([prototypes, way.reshape(-1, 2), lattice]))
    peak = jnp.where(real, held[:PROTOTYPES], 0)
    on_way = held[PROTOTYPES : PROTOTYPES + way.shape[0] * STOPS].reshape(-1, STOPS).min(axis=1)
    saddle = jnp.where(near, jnp.minimum(on_way, jnp.minimum(peak[one], peak[other])), -1)
    order = jnp.argsort(-saddle, stable=True)
    background = jnp.median(held[-(LATTICE**2) :])
    return one[order], other[order], saddle[order], near[order], peak, background


def _box(places: Array, weights: Array) -> tuple[Array, Array]:
    """The box that holds all but a hundredth of the weight at each side."""
    order = jnp.argsort(places, axis=0)
    passed = jnp.cumsum(weights[order], axis=0) / weights.sum()
    first, last = (passed < 0.01).sum(axis=0), (passed < 0.99).sum(axis=0)
    sides = jnp.arange(2)
    return places[order[first, sides], sides], places[order[jnp.minimum(last, len(places) - 1), sides], sides]


def _prominences(
    one: Array, other: Array, saddle: Array, near: Array, peak: Array, real: Array, background: Array
) -> tuple[Array, Array]:
    """How clearly each prototype is the peak of a group of its own; 1 is just clear enough.

    All pairs are joined, the highest saddle first. Where two groups meet, the lower peak ends and its valley is judged: against
    chance and against its own height. The first value judges the valley alone, the second also the height above the background.
    """

    def meet(edge: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        root, ended = state
        a, b = root[one[edge]], root[other[edge]]
        lower = jnp.where((peak[a] < peak[b]) | ((peak[a] == peak[b]) & (a > b)), a, b)
        upper = a + b - lower
        meets = near[edge] & (a != b)
        root = jnp.where(meets & (root == lower), upper, root)
        return root, ended.at[lower].set(jnp.where(meets, saddle[edge], ended[lower]))

    # What never meets another ends at no support at all.
    _, ended = lax.fori_loop(0, len(one), meet, (jnp.arange(PROTOTYPES), jnp.zeros_like(peak)))
    share = 1 - ended / jnp.maximum(peak, jnp.finfo(peak.dtype).tiny)
    sigmas = 2 * (jnp.sqrt(peak) - jnp.sqrt(jnp.maximum(ended, 0)))
    valley = jnp.where(real, jnp.minimum(share / (1 - VALLEY), sigmas / VALLEY_SIGMAS), 0)
    above = 2 * (jnp.sqrt(peak) - jnp.sqrt(background)) / PEAK_SIGMAS
    # The strongest peak is an object whatever the background.
    strongest = jnp.arange(PROTOTYPES) == jnp.argmax(peak)
    return valley, jnp.where(strongest, jnp.inf, jnp.where(real, jnp.minimum(valley, above), 0))


def _join(one: Array, other: Array, near: Array, peak: Array, stands: Array) -> Array:
    """Joins neighbours by falling saddle, except where both groups have a peak that stands."""

    def meet(edge: Array, root: Array) -> Array:
        a, b = root[one[edge]], root[other[edge]]
        lower = jnp.where((peak[a] < peak[b]) | ((peak[a] == peak[b]) & (a > b)), a, b)
        lower = jnp.where(stands[a] & ~stands[b], b, jnp.where(stands[b] & ~stands[a], a, lower))
        joins = near[edge] & (a != b) & ~(stands[a] & stands[b])
        return jnp.where(joins & (root == lower), a + b - lower, root)

    return lax.fori_loop(0, len(one), meet, jnp.arange(PROTOTYPES))
