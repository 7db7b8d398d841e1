"""One round of alternating optimisation for fuzzy c-means, its derivative at a fixed point, and what can go wrong there.

Paper symbols → words: v centers, alpha sizes, u memberships; S_i, the sum of w u_i^m D_i, is a cluster's scatter. Prototypes are
a dictionary of centers and, where sizes are learned, their logarithms, in units where the points' RMS spread is 1.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy.arrays import Array, Float, Int, record
from jaxfuzzy.memberships import log_strengths, shares
from jaxfuzzy.status import Status
from jaxfuzzy.tiles import Parts, Tiles, expanded_distances, offsets, squared_distances, sum_tiles

# Two centers nearer to each other than this share of their own points' RMS distance count as one.
SAME_PLACE = 1e-2

# What a step reads besides the prototypes: tiles, fuzzifier, squared noise distance, which clusters are real.
Args = tuple[Tiles, Array, Array | None, Array | None]
Theta = dict[str, Array]
# powers(squared distances, fuzzifier, log strengths, squared noise distance, shift) -> (u^m, objective terms, new shift)
Powers = Callable[[Array, Array, Array | None, Array | None, Array], tuple[Array, Array, Array]]
# A shift is never below this, so that a tile of points without weight cannot lower it to -inf.
LOWEST = -1e4


@record
class Sums:
    """What one sweep over all points adds up; the first three are relative to exp(shift), which cancels in every ratio.

    Attributes:
        mass: Sum of w u^m.
        moment: Sum of w u^m x.
        scatter: Sum of w u^m D.
        log_objective: Logarithm of the reduced objective.
        shift: The largest log u^m, or 0 where it was not needed.
    """

    mass: Float[Array, " K"]
    moment: Float[Array, "K D"]
    scatter: Float[Array, " K"]
    log_objective: Float[Array, ""]
    shift: Float[Array, ""]


def log_sizes_of(theta: Theta, mask: Array | None) -> Float[Array, " K"]:
    """Logarithm of the sizes; -inf for pads."""
    clusters, dtype = theta["centers"].shape[0], theta["centers"].dtype
    real = jnp.ones(clusters, bool) if mask is None else mask
    equal = jnp.broadcast_to(-jnp.log(real.sum().astype(dtype)), (clusters,))
    return jnp.where(real, theta.get("log_sizes", equal), -jnp.inf)


def strengths_of(theta: Theta, mask: Array | None) -> Float[Array, " K"] | None:
    """log(K alpha) as the membership rule takes it; None for equal sizes without pads."""
    strengths = log_strengths(theta.get("log_sizes"), mask)
    return None if strengths is None else strengths.astype(theta["centers"].dtype)


def sweep(theta: Theta, args: Args, *, powers: Powers, exact: bool, scatter: bool) -> Sums:
    """One pass over the points.

    Args:
        theta: Prototypes.
        args: What else it reads.
        powers: How memberships are raised to the fuzzifier: `smooth_powers` carries every derivative, `short_powers` is
            quicker, `square_powers` the quickest, for m = 2 alone.
        exact: Take distances by differences.
        scatter: Add up the scatter too, which is left at zero otherwise.
    """
    tiles, m, squared_noise, mask = args
    centers, strengths = theta["centers"], strengths_of(theta, mask)
    distances = squared_distances if exact else expanded_distances
    clusters, dims = centers.shape
    dtype = centers.dtype
    zero = jnp.zeros((), dtype)

    def add(sums: tuple[Array, Array, Array, Array], block: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        moments, scatters, objective, shift = sums
        apart = distances(block, centers)
        power, term, new_shift = powers(apart, m, strengths, squared_noise, shift)
        rescale = jnp.exp(shift - new_shift)
        power = power * w
        return (
            moments * rescale + jnp.matmul(power, block.T, precision=jax.lax.Precision.HIGHEST),
            scatters * rescale + (power * apart).sum(axis=1) if scatter else scatters,
            objective * rescale + term @ w,
            new_shift,
        )

    start = (
        jnp.zeros((clusters, dims + 2), dtype),
        jnp.zeros(clusters, dtype),
        zero,
        jnp.full((), 0 if powers is square_powers else 2 * LOWEST, dtype),
    )
    moments, scatters, objective, shift = sum_tiles(tiles, add, start, _join)
    return Sums(moments[:, -1], moments[:, :dims], scatters, jnp.log(objective) + shift, shift)


def _join(parts: Parts, sums: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Sums of all devices, each relative to a shift of its own, relative to the largest shift."""
    *summed, shift = sums
    top = parts.largest(jax.lax.stop_gradient(shift))
    moments, scatters, objective = parts.total([value * jnp.exp(shift - top) for value in summed])
    return moments, scatters, objective, top


def merged(blocks: list[Sums]) -> Sums:
    """Sums of several blocks of points, added on the host in double precision."""
    each = [jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), block) for block in blocks]
    top = max(float(one.shift) for one in each)
    total = lambda name: sum(getattr(one, name) * np.exp(one.shift - top) for one in each)
    log_objective = np.logaddexp.reduce([np.asarray(one.log_objective) for one in each])
    return Sums(total("mass"), total("moment"), total("scatter"), log_objective, np.float64(top))  # type: ignore[arg-type]


def smooth_powers(
    apart: Float[Array, "K n"], m: Array, strengths: Array | None, squared_noise: Array | None, shift: Array
) -> tuple[Float[Array, "K n"], Float[Array, " n"], Float[Array, ""]]:
    """Memberships to the power m and objective terms, both over exp(new shift), and that shift; with every derivative."""
    part = shares(apart, m, strengths, squared_noise)
    logs = part.log_powers(m)
    shift = jax.lax.stop_gradient(jnp.maximum(shift, jnp.maximum(logs.max(), LOWEST)))
    return jnp.exp(logs - shift), part.objective(m, shift), shift


def short_powers(
    apart: Float[Array, "K n"], m: Array, strengths: Array | None, squared_noise: Array | None, shift: Array
) -> tuple[Float[Array, "K n"], Float[Array, " n"], Float[Array, ""]]:
    """The same with one exponential a distance.

    A part e = K alpha ratio^r with ratio = nearest / D has e^m = e ratio (K alpha)^(m - 1), as r (m - 1) = 1.
    """
    if strengths is not None:
        apart = jnp.where((strengths == -jnp.inf)[:, None], jnp.inf, apart)
    nearest = apart.min(axis=0)
    if squared_noise is not None:
        nearest = jnp.minimum(nearest, squared_noise)
    on_it = apart <= 0
    ratio = jnp.where(on_it, 1, nearest / jnp.where(on_it, 1, apart))
    r = 1 / (m - 1)
    part = jnp.exp(r * jnp.log(ratio))
    power = part * ratio
    if strengths is not None:
        part = part * jnp.exp(strengths)[:, None]
        power = power * jnp.exp(m * strengths)[:, None]
    total = part.sum(axis=0)
    if squared_noise is not None:
        total = total + jnp.exp(r * jnp.log(nearest / squared_noise))
    log_total = jnp.log(total)
    shift = jnp.maximum(shift, jnp.maximum((-m * log_total).max(), LOWEST))
    return power * jnp.exp(-m * log_total - shift), nearest * jnp.exp((1 - m) * log_total - shift), shift


def square_powers(
    apart: Float[Array, "K n"], m: Array, strengths: Array | None, squared_noise: Array | None, shift: Array
) -> tuple[Float[Array, "K n"], Float[Array, " n"], Float[Array, ""]]:
    """The same for m = 2, where neither logarithm nor shift is needed."""
    del m
    # Distances are relative to a spread of 1, so the square of rounding stands for zero without overflow.
    floor = jnp.square(jnp.finfo(apart.dtype).eps)
    closeness = 1 / jnp.maximum(apart, floor)
    if strengths is not None:
        closeness = closeness * jnp.exp(strengths)[:, None]
    total = closeness.sum(axis=0)
    if squared_noise is not None:
        total = total + 1 / squared_noise
    share = 1 / total
    return jnp.square(closeness * share), share, shift


def step(theta: Theta, args: Args, *, sizes: bool, powers: Powers, exact: bool) -> tuple[Theta, Array]:
    """One round of alternating optimisation (eqs. 9, 10, 11) and the objective where it started from."""
    _, m, _, mask = args
    return advance(theta, sweep(theta, args, powers=powers, exact=exact, scatter=sizes), m, mask, sizes=sizes)


def advance(theta: Theta, sums: Sums, m: Array, mask: Array | None, *, sizes: bool) -> tuple[Theta, Array]:
    """What the sums over all points make of the prototypes, and the objective where they started from."""
    filled = sums.mass > 0
    mass = jnp.where(filled, sums.mass, 1)
    centers = jnp.where(filled[:, None], sums.moment / mass[:, None], theta["centers"])
    if not sizes:
        return {"centers": centers}, sums.log_objective
    # Eq. 11 with the distances from the new centers: moving to the mean lowers each scatter by mass times move squared.
    moved = jnp.square(centers - theta["centers"]).sum(axis=1)
    rounding = jnp.finfo(centers.dtype).eps
    scatter = jnp.maximum(sums.scatter - sums.mass * moved, jnp.square(rounding) * sums.mass)
    log_root = jnp.log(jnp.where(filled, scatter, 1)) / m
    log_root = jnp.where(filled, log_root, -jnp.inf)
    if mask is not None:
        log_root = jnp.where(mask, log_root, -jnp.inf)
    logs = log_root - jax.nn.logsumexp(log_root)
    # A dying size would fall for ever; at rounding it counts as dead and the status says so.
    return {"centers": centers, "log_sizes": jnp.maximum(logs, jnp.log(rounding))}, sums.log_objective


def step_jacobian(theta: Theta, args: Args, *, sizes: bool) -> Float[Array, "p p"]:
    """Derivative of `step` at a fixed point in one sweep.

    With psi_i = (x - v_i, D_i) and phi_j = d log(part_j) / d(v_j, log alpha_j) = (2 r (x - v_j) / D_j, 1), memberships change
    by d(u_i^m) = m u_i^m (delta_ij - u_j) phi_j, so all sums are one matrix product of (K (D + 1), n) with its like.
    """
    tiles, m, squared_noise, mask = args
    centers, strengths = theta["centers"], strengths_of(theta, mask)
    clusters, dims = centers.shape
    rows = dims + 1 if sizes else dims
    r = 1 / (m - 1)
    shift = sweep(theta, args, powers=smooth_powers, exact=True, scatter=False).shift

    def add(sums: tuple[Array, Array, Array, Array], block: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        crossed, own, mass, scatter = sums
        offset = offsets(block, centers)
        apart = jnp.square(offset).sum(axis=1)
        part = shares(apart, m, strengths, squared_noise)
        u, power = part.memberships, jnp.exp(part.log_powers(m) - shift) * w
        off = apart > 0
        phi = jnp.where(off[:, None], 2 * r * offset / jnp.where(off, apart, 1)[:, None], 0)
        psi = offset
        if sizes:
            psi = jnp.concatenate([psi, apart[:, None]], axis=1)
            phi = jnp.concatenate([phi, jnp.ones_like(apart)[:, None]], axis=1)
        left = (power[:, None] * psi).reshape(clusters * rows, -1)
        right = (u[:, None] * phi).reshape(clusters * rows, -1)
        return (
            crossed + left @ right.T,
            own + jnp.einsum("kan,kbn->kab", power[:, None] * psi, phi),
            mass + power.sum(axis=1),
            scatter + (power * apart).sum(axis=1),
        )

    start = (
        jnp.zeros((clusters * rows, clusters * rows), centers.dtype),
        jnp.zeros((clusters, rows, rows), centers.dtype),
        jnp.zeros(clusters, centers.dtype),
        jnp.zeros(clusters, centers.dtype),
    )
    crossed, own, mass, scatter = sum_tiles(tiles, add, start)
    change = -crossed.reshape(clusters, rows, clusters, rows)
    change = m * change.at[jnp.arange(clusters), :, jnp.arange(clusters)].add(own)
    per_mass = jnp.where(mass > 0, 1 / jnp.where(mass > 0, mass, 1), 0)
    to_centers = change[:, :dims] * per_mass[:, None, None, None]
    flat = clusters * dims
    if not sizes:
        return to_centers.reshape(flat, flat)
    per_scatter = jnp.where(scatter > 0, 1 / jnp.where(scatter > 0, scatter, 1), 0)
    log_scatter = change[:, dims] * per_scatter[:, None, None] / m
    alpha = jnp.exp(log_sizes_of(theta, mask))
    alive = theta["log_sizes"] > jnp.log(jnp.finfo(centers.dtype).eps)
    to_sizes = jnp.where(alive[:, None, None], log_scatter - jnp.einsum("i,ijb->jb", alpha, log_scatter), 0)

    def by_name(block: Array) -> Array:
        """From (rows, K, D + 1) to (rows, K D + K), the order in which the prototypes are raveled."""
        block = block.reshape(-1, clusters, rows)
        return jnp.concatenate([block[:, :, :dims].reshape(-1, flat), block[:, :, dims]], axis=1)

    return jnp.concatenate([by_name(to_centers), by_name(to_sizes)])


def diagnose(theta: Theta, args: Args, sums: Sums, converged: Array, *, sizes: bool) -> Int[Array, ""]:
    """Every reason to mistrust a fit, found in one more sweep over the points."""
    tiles, m, _, mask = args
    spread = unit_scatter(theta, args, sums.shift)
    return judge(theta, sums, spread, m, mask, tiles, converged, sizes=sizes)


def unit_scatter(theta: Theta, args: Args, shift: Array) -> Float[Array, "K D D"]:
    """Sum of w u^m times the products of the directions from each center, relative to exp(shift)."""
    tiles, m, squared_noise, mask = jax.lax.stop_gradient(args)
    theta, shift = jax.lax.stop_gradient((theta, shift))
    centers, strengths = theta["centers"], strengths_of(theta, mask)
    clusters, dims = centers.shape

    def add(total: Array, block: Array, w: Array) -> Array:
        offset = offsets(block, centers)
        apart = jnp.square(offset).sum(axis=1)
        part = shares(apart, m, strengths, squared_noise)
        power = jnp.exp(part.log_powers(m) - shift) * w
        unit = power / jnp.where(apart > 0, apart, 1)
        return total + jnp.einsum("kn,kan,kbn->kab", unit, offset, offset)

    return sum_tiles(tiles, add, jnp.zeros((clusters, dims, dims), centers.dtype))


def judge(
    theta: Theta,
    sums: Sums,
    units: Float[Array, "K D D"],
    m: Array,
    mask: Array | None,
    tiles: Tiles,
    converged: Array,
    *,
    sizes: bool,
) -> Int[Array, ""]:
    """Every reason to mistrust a fit, from sums over all points: those of `sweep`, and `units`, those of `unit_scatter`.

    Of `tiles` only the extent, the scale and the number of points with weight are read, so that those of a block will do.
    """
    theta, sums, units, m, tiles = jax.lax.stop_gradient((theta, sums, units, m, tiles))
    centers = theta["centers"]
    clusters = centers.shape[0]
    real = jnp.ones(clusters, bool) if mask is None else mask
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    elongation = jnp.linalg.eigvalsh(units / mass[:, None, None])[:, -1]
    own = sums.scatter / mass
    apart = jnp.square(centers[:, None] - centers[None]).sum(axis=-1)
    close = apart <= SAME_PLACE**2 * jnp.maximum(jnp.minimum(own[:, None], own[None]), jnp.finfo(own.dtype).eps ** 2)
    twins = close & real[:, None] & real[None] & ~jnp.eye(clusters, dtype=bool)
    # Merged centers are stable where no direction holds more than (m - 1) / 2m of the unit scatter; elsewhere a nudge parts them.
    stable = elongation <= (m - 1) / (2 * m) * (1 + 1e-3)
    merged, parted = twins.any(axis=1) & stable, twins.any(axis=1) & ~stable
    one_place = (twins | ~real[None] | ~real[:, None] | jnp.eye(clusters, dtype=bool)).all() & (real.sum() > 1)
    representable = jnp.isfinite(jnp.exp(sums.log_objective + 2 * jnp.log(tiles.scale)))
    finite = representable & jnp.isfinite(centers).all()
    bits = [
        (Status.NOT_CONVERGED, ~converged),
        (Status.NOT_FINITE, ~finite),
        (Status.COLLAPSED, one_place & merged.any() & (tiles.spread > 0)),
        (Status.MERGED, merged.any() & ~one_place),
        (Status.UNSTABLE, parted.any() & (tiles.spread > 0)),
        (Status.TOO_FEW_POINTS, tiles.present < real.sum()),
        (Status.DEGENERATE, tiles.spread <= 0),
        (Status.EMPTY, (real & ~(sums.mass > 0)).any()),
    ]
    if sizes:
        alpha = jnp.exp(log_sizes_of(theta, mask))
        rounding = jnp.finfo(centers.dtype).eps
        pointlike = real & (own <= 1e3 * rounding) & (sums.mass > 0) & (tiles.spread > 0)
        dying = real & (alpha * real.sum() < 1e-3)
        bits += [(Status.SPIKE, pointlike.any() & (real.sum() > 1)), (Status.DYING, dying.any())]
    return sum((jnp.where(condition, int(bit), 0) for bit, condition in bits), jnp.zeros((), jnp.int32))
