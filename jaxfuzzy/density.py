"""Where a plane is dense: how many places of density there are, and which of them each point belongs to.

A noise-clustering partition (paper eqs. 19 and 20 with point prototypes, m = 2) tiles the plane with many small clusters; two of
them belong together unless the support of the plane has a valley between them. Support is a possibilistic typicality,

    f(q) = sum_k w_k exp(-|q - x_k|² / 2h²),

a count of points, so that a valley can be told from chance: the square root of a Poisson count has the same spread everywhere.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy.arrays import WIDE, Array, Bool, Float, Int, on_device, record

# Small clusters that tile the objects (the sizes compiled); neighbours each is compared with, at so many places on the way.
PROTOTYPES, NEIGHBOURS, STOPS = (64, 128, 192, 256), 4, 5
SWEEPS = 10
# Bandwidths that the number of groups is looked for at: two ladders of a factor 2 in h², interleaved, over the first one's base.
LADDER = 2.0 ** (np.arange(8) / 4 - 0.5)
# Rung of the base. A number of groups is steady when it stays for so many rungs; where the prominence that decides is within
# this factor of the limit, by its logarithm, a rung counts in part, so that rounding moves no number by a whole rung.
# Numbers that stay as long but for the last part of a rung stay as long.
BASE, STEADY, SOFT, AS_LONG = 2, 2.1, 1.16, 0.25
# Lengths in bandwidths: distance between seeds, noise distance, farthest neighbour, margin of the box that background is sought in.
APART, DELTA, REACH, MARGIN = 2.0, 2.4, 7.2, 4.0
# A seed stands so many standard deviations of a count above the background, which is the median over a lattice.
SEED_SIGMAS, LATTICE = 3.0, 16
# A peak is an object's when the valley beside it falls below this share of it, by so many standard deviations of a count ...
VALLEY, VALLEY_SIGMAS = 0.6, 4.0
# ... and it stands so many above the background.
PEAK_SIGMAS = 6.0
# An outlier's support is below this share of its object's mean, and not so many deviations above the background; a point
# counts in its own support, so that above no background one alone is an outlier and one with a neighbour is none.
SPARSE, SPARSE_SIGMAS = 0.2, 2.2
# Places and queries that meet at a time.
BLOCK, QUERIES = 128, 128


@record
class Groups:
    """Density parted into groups. C prototypes, P places.

    Attributes:
        prototypes: Centers of the small clusters.
        group: Rank of the group that each prototype belongs to, -1 for none.
        found: Number of groups that stays longest along the ladder of bandwidths; where none stays, the one at its base.
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


def part(
    places: Float[Array, "P 2"],
    weights: Float[Array, " P"],
    box: Float[Array, "2 2"],
    bandwidth: Float[Array, ""],
    allowed: Bool[Array, " G"],
    number: int,
) -> Groups | None:
    """Parts the places of a plane into groups; None where the prototypes do not suffice to tile it at this bandwidth.

    Args:
        places: Places; padded ones have weight 0.
        weights: Number of points at each place.
        box: Lower and upper corner of the box that holds nearly all of them.
        bandwidth: Bandwidth h of the support.
        allowed: Which numbers of groups 1, 2, ... are allowed; where the number found is not, the nearest that is.
        number: How many places there are; the others are padding.
    """
    survey = _survey(places, weights, box, bandwidth, on_device(number))
    real = int(np.asarray(survey.real).sum())
    # One seed more than there are places for would say that the tiling is not whole.
    most = next((c for c in PROTOTYPES if real < c), None)
    return None if most is None else _divide(places, weights, box, bandwidth, survey, allowed, most=most)


@record
class Survey:
    """The density of a plane, and where small clusters that tile its dense parts are to start.

    Attributes:
        held: Support of each place.
        background: Support where there is nothing but outliers.
        seeds: Starts of the small clusters, the strongest first.
        real: Which of them are.
    """

    held: Float[Array, " P"]
    background: Float[Array, ""]
    seeds: Float[Array, "C 2"]
    real: Bool[Array, " C"]


@partial(jax.jit, compiler_options=WIDE)
def _survey(places: Array, weights: Array, box: Array, bandwidth: Array, number: Array) -> Survey:
    queries = jnp.concatenate([places, _lattice(box, bandwidth)])
    # Places of weight 0 are asked for too, padding is not.
    index = jnp.arange(len(queries))
    wanted = (index < number) | (index >= len(places))
    held, around = jnp.split(_supports(queries, wanted, places, weights, bandwidth[None])[0], [len(places)])
    background = jnp.median(around)
    least = (jnp.sqrt(background) + SEED_SIGMAS / 2) ** 2
    return Survey(held, background, *_mountains(places, held, weights, bandwidth, least, PROTOTYPES[-1]))


def _tile(
    places: Array, weights: Array, bandwidth: Array, seeds: Array, real: Array
) -> tuple[Float[Array, "C 2"], Float[Array, ""]]:
    """Noise clustering from seeds: with m = 2, u = D^-1 / (sum_j D_j^-1 + delta^-2). The clusters and their objective."""
    delta = DELTA * bandwidth
    blocks = _blocks(places, BLOCK), _blocks(weights, BLOCK, fill=True)
    # Blocks of padding alone need not be looked at.
    stop = jnp.max(jnp.where(weights > 0, jnp.arange(len(weights)) // BLOCK + 1, 0))

    def update(prototypes: Array, _: None) -> tuple[Array, Array]:
        def add(i: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
            place, weight = blocks[0][i], blocks[1][i]
            inverse = jnp.where(real, 1 / _squared_distances(place, prototypes, delta), 0)
            total = inverse.sum(axis=1, keepdims=True) + delta**-2
            pull = weight[:, None] * (inverse / total) ** 2
            moments = pull.T @ jnp.concatenate([place, jnp.ones_like(place[:, :1])], axis=1)
            return sums[0] + moments, sums[1] + weight @ (1 / total[:, 0])

        start = jnp.zeros((len(prototypes), 3), places.dtype), jnp.zeros((), places.dtype)
        moments, objective = lax.fori_loop(0, stop, add, start)
        mass = moments[:, 2:]
        moved = moments[:, :2] / jnp.maximum(mass, jnp.finfo(places.dtype).tiny)
        return jnp.where(real[:, None] & (mass > 0), moved, prototypes), objective

    prototypes, objectives = lax.scan(update, seeds, length=SWEEPS)
    return prototypes, objectives[-1]


@partial(jax.jit, static_argnames="most", compiler_options=WIDE)
def _divide(
    places: Array, weights: Array, box: Array, bandwidth: Array, survey: Survey, allowed: Array, *, most: int
) -> Groups:
    real = survey.real[:most]
    prototypes, objective = _tile(places, weights, bandwidth, survey.seeds[:most], real)
    one, other, near = _neighbours(prototypes, real, bandwidth)
    peaks, saddles, backgrounds = _landscape(prototypes, real, one, other, near, places, weights, box, bandwidth)
    peaks = jnp.where(real, peaks, 0)
    saddles = jnp.where(near, jnp.minimum(saddles, jnp.minimum(peaks[:, one], peaks[:, other])), -1)
    orders = jnp.argsort(-saddles, axis=1, stable=True)
    judge = jax.vmap(lambda *level: _prominences(one, other, near, real, *level))
    valleys, prominences = judge(orders, saddles, peaks, backgrounds)
    level, number = _steadiest(prominences)
    peak, order, valley, prominence = peaks[level], orders[level], valleys[level], prominences[level]

    # The nearest number that is allowed, the lower of two.
    numbers = jnp.arange(1, len(allowed) + 1)
    wanted = numbers[jnp.argmin(jnp.where(allowed, jnp.abs(numbers - number), jnp.inf))]
    kept = (_rank(-prominence) < wanted) & real
    root = _join(one[order], other[order], near[order], peak, kept | (valley >= 1))
    # Objects in the order of their peaks, the strongest first.
    group = jnp.where(kept[root] & real, _rank(jnp.where(kept, -peak, jnp.inf))[root], -1)

    inverse = jnp.where(real, 1 / _squared_distances(places, prototypes, bandwidth), 0)
    inverse = inverse / inverse.sum(axis=1, keepdims=True)
    shares = inverse @ (group[:, None] == jnp.arange(len(allowed))).astype(places.dtype)
    mine = weights[:, None] * shares**2
    usual = (survey.held @ mine) / jnp.maximum(mine.sum(axis=0), jnp.finfo(places.dtype).tiny)
    chance = (jnp.sqrt(backgrounds[BASE]) + SPARSE_SIGMAS / 2) ** 2
    least = jnp.minimum(SPARSE * usual[jnp.argmax(shares, axis=1)], chance)
    typicality = survey.held / jnp.maximum(least, jnp.finfo(places.dtype).tiny)
    return Groups(prototypes, group, number, kept.sum(), shares, typicality, objective)


def _rank(values: Array) -> Array:
    """How many values come before each; the first of equal ones first."""
    index = jnp.arange(len(values))
    before = (values < values[:, None]) | ((values == values[:, None]) & (index < index[:, None]))
    return before.sum(axis=1)


def _steadiest(prominences: Float[Array, "L C"]) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The number of groups that stays longest along a ladder of bandwidths, and a rung at which there are so many.

    Where none stays for `STEADY` rungs there is detail at every scale, as in a crowded photograph, and a number that two rungs
    share is chance: the base is taken, and the number there.
    """
    last = jnp.zeros_like(prominences[:, :1])
    ranked = jnp.concatenate([-jnp.sort(-prominences, axis=1), last], axis=1)
    # How far the prominence of each rank stands above the limit: 0 to 1.
    above = jnp.log(jnp.maximum(ranked, jnp.finfo(ranked.dtype).tiny))
    stands = jnp.clip(0.5 + 0.5 * above / np.log(SOFT), 0, 1)
    share = stands[:, :-1] * (1 - stands[:, 1:])
    life = share.sum(axis=0)
    # Of two that stay as long the narrower, which is the larger number.
    most = len(life) - 1 - jnp.argmax(jnp.where(life >= life.max() - AS_LONG, 1, 0)[::-1])
    nearness = jnp.round(share[:, most], 1) - 0.01 * jnp.abs(jnp.arange(len(share)) - BASE)
    steady = life.max() >= STEADY
    level = jnp.where(steady, jnp.argmax(nearness), BASE)
    return level, jnp.where(steady, most + 1, jnp.maximum((prominences[BASE] >= 1).sum(), 1))


def _supports(
    queries: Float[Array, "M 2"],
    wanted: Bool[Array, " M"],
    places: Float[Array, "P 2"],
    weights: Float[Array, " P"],
    bandwidths: Float[Array, " L"],
) -> Float[Array, "L M"]:
    """Support of each query that is wanted at each bandwidth, 0 of the others; summed over blocks of places.

    The bandwidths are one ladder of a factor 2 in h² downwards from each of the last two, which takes two exponentials for all.
    """
    levels = len(bandwidths)
    # What counts comes first, so that blocks of padding need not be looked at.
    turn, order = jnp.argsort(~wanted), jnp.argsort(weights == 0)
    rows = _blocks(queries[turn], QUERIES)
    place, weight = _blocks(places[order], BLOCK), _blocks(weights[order], BLOCK, fill=True)

    def of_block(row: int, found: Array) -> Array:
        def add(i: int, total: Array) -> Array:
            dx, dy = (rows[row, :, None, axis] - place[i, :, axis] for axis in (0, 1))
            square = -0.5 * (dx**2 + dy**2)
            kernels: dict[int, Array] = {}
            for level in reversed(range(levels)):
                above = kernels.get(level + 2)
                kernels[level] = jnp.exp(square / bandwidths[level] ** 2) if above is None else above**2
            return total + jnp.stack([kernels[level] @ weight[i] for level in range(levels)])

        stop = -(-(weights > 0).sum() // BLOCK)
        return found.at[row].set(lax.fori_loop(0, stop, add, jnp.zeros_like(found[0])))

    found = jnp.zeros((len(rows), levels, QUERIES), places.dtype)
    found = lax.fori_loop(0, -(-wanted.sum() // QUERIES), of_block, found)
    found = jnp.moveaxis(found, 0, 1).reshape(levels, -1)[:, : len(queries)]
    return jnp.where(wanted, jnp.zeros_like(found).at[:, turn].set(found), 0)


def _blocks(values: Array, size: int, fill: bool = False) -> Array:
    """Rows in blocks of one size, the last one filled by zeros or, where these would lie elsewhere, by its own last row."""
    pad = ((0, -len(values) % size), *((0, 0),) * (values.ndim - 1))
    return jnp.pad(values, pad, mode="constant" if fill else "edge").reshape(-1, size, *values.shape[1:])


def _mountains(
    places: Array, held: Array, weights: Array, bandwidth: Array, least: Array, most: int
) -> tuple[Array, Array]:
    """Seeds by the mountain method (Yager and Filev 1994): the place of most support, all near it struck out, and so on."""

    def pick(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        index, left, seeds, real = state
        best = jnp.argmax(left)
        near = ((places - places[best]) ** 2).sum(axis=1) < (APART * bandwidth) ** 2
        left = jnp.where(near, -1.0, left)
        return index + 1, left, seeds.at[index].set(places[best]), real.at[index].set(True)

    def more(state: tuple[Array, Array, Array, Array]) -> Array:
        # The first is one however little it holds.
        index, left, *_ = state
        return (index < most) & ((left.max() > least) | (index == 0))

    start = jnp.where(weights > 0, held, -1), jnp.zeros((most, 2), places.dtype), jnp.zeros(most, bool)
    return lax.while_loop(more, pick, (jnp.zeros((), int), *start))[2:]


def _squared_distances(places: Array, prototypes: Array, scale: Array) -> Array:
    square = (places**2).sum(axis=1)[:, None] + (prototypes**2).sum(axis=1) - 2 * places @ prototypes.T
    return jnp.maximum(square, 1e-6 * scale**2)


def _neighbours(prototypes: Array, real: Array, bandwidth: Array) -> tuple[Array, Array, Array]:
    """Each prototype with the nearest of those stronger than itself: the one, the other, and whether they are near at all."""
    gap = jnp.sqrt(((prototypes[:, None] - prototypes) ** 2).sum(axis=-1))
    index = jnp.arange(len(real))
    gap = jnp.where((index < index[:, None]) & real[:, None] & real, gap, jnp.inf)
    length, other = lax.top_k(-gap, NEIGHBOURS)
    one = jnp.repeat(jnp.arange(len(real)), NEIGHBOURS)
    return one, other.ravel(), -length.ravel() < REACH * bandwidth


def _landscape(
    prototypes: Array,
    real: Array,
    one: Array,
    other: Array,
    near: Array,
    places: Array,
    weights: Array,
    box: Array,
    bandwidth: Array,
) -> tuple[Array, Array, Array]:
    """At each bandwidth of the ladder: support at the prototypes, the least on the way between neighbours, the background."""
    stops = ((jnp.arange(STOPS) + 1) / (STOPS + 1)).astype(places.dtype)[:, None]
    way = prototypes[one][:, None] * (1 - stops) + prototypes[other][:, None] * stops
    lattice = _lattice(box, bandwidth)
    queries = jnp.concatenate([prototypes, way.reshape(-1, 2), lattice])
    wanted = jnp.concatenate([real, jnp.repeat(near, STOPS), jnp.ones(len(lattice), bool)])
    held = _supports(queries, wanted, places, weights, bandwidth * jnp.asarray(LADDER, places.dtype))
    peaks, on_way, around = jnp.split(held, [len(prototypes), len(queries) - len(lattice)], axis=1)
    return peaks, on_way.reshape(len(LADDER), -1, STOPS).min(axis=-1), jnp.median(around, axis=1)


def _lattice(box: Float[Array, "2 2"], bandwidth: Array) -> Array:
    """Where the background is looked at."""
    low, high = box[0] - MARGIN * bandwidth, box[1] + MARGIN * bandwidth
    step = ((jnp.arange(LATTICE) + 0.5) / LATTICE).astype(box.dtype)
    return low + (high - low) * jnp.stack(jnp.meshgrid(step, step), axis=-1).reshape(-1, 2)


def _prominences(
    one: Array, other: Array, near: Array, real: Array, order: Array, saddle: Array, peak: Array, background: Array
) -> tuple[Array, Array]:
    """How clearly each prototype is the peak of a group of its own; 1 is just clear enough.

    All pairs are joined, the highest saddle first. Where two groups meet, the lower peak ends and its valley is judged: against
    chance and against its own height. The first value judges the valley alone, the second also the height above the background.
    """

    def meet(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        root, ended = state
        edge = order[step]
        a, b = root[one[edge]], root[other[edge]]
        lower = _lower(peak, a, b)
        meets = near[edge] & (a != b)
        root = jnp.where(meets & (root == lower), a + b - lower, root)
        return root, ended.at[lower].set(jnp.where(meets, saddle[edge], ended[lower]))

    # What never meets another ends at no support at all.
    start = jnp.arange(len(real)), jnp.zeros_like(peak)
    _, ended = lax.fori_loop(0, len(one), meet, start)
    share = 1 - ended / jnp.maximum(peak, jnp.finfo(peak.dtype).tiny)
    sigmas = 2 * (jnp.sqrt(peak) - jnp.sqrt(jnp.maximum(ended, 0)))
    valley = jnp.where(real, jnp.minimum(share / (1 - VALLEY), sigmas / VALLEY_SIGMAS), 0)
    above = 2 * (jnp.sqrt(peak) - jnp.sqrt(background)) / PEAK_SIGMAS
    # The strongest peak is an object whatever the background.
    strongest = jnp.arange(len(real)) == jnp.argmax(peak)
    return valley, jnp.where(strongest, jnp.inf, jnp.where(real, jnp.minimum(valley, above), 0))


def _join(one: Array, other: Array, near: Array, peak: Array, stands: Array) -> Array:
    """Joins neighbours, in the order given, except where both groups have a peak that stands."""

    def meet(edge: Array, root: Array) -> Array:
        a, b = root[one[edge]], root[other[edge]]
        lower = jnp.where(stands[a] == stands[b], _lower(peak, a, b), jnp.where(stands[a], b, a))
        joins = near[edge] & (a != b) & ~(stands[a] & stands[b])
        return jnp.where(joins & (root == lower), a + b - lower, root)

    return lax.fori_loop(0, len(one), meet, jnp.arange(len(peak)))


def _lower(peak: Array, a: Array, b: Array) -> Array:
    return jnp.where((peak[a] < peak[b]) | ((peak[a] == peak[b]) & (a > b)), a, b)
