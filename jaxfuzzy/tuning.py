"""Tuning by gradient: the fuzzifier, noise distances and point weights for which a loss built from fits is least.

Each is searched for by its logarithm, log(m - 1), log delta and log w, relative to where it starts, so that m stays above 1 and
the others above 0, and a step of one means the same factor for all. Loss values are known to a few units of rounding only, so
a gradient below the square root of rounding (times the loss) cannot be told from zero; that, and never the length of the last
step alone, is what counts as having arrived.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Float, Int, as_float, is_concrete, record
from jaxfuzzy.status import Status

# The first step changes what is tuned by a factor of about e^0.5, whatever the unit of the loss.
FIRST_MOVE = 0.5
# Farther than this factor from its start a value is no longer tuned but lost.
FARTHEST = math.log(1000.0)
# So many shortened steps in a row that lower nothing mean that none will: the last is 2^-14 of the first.
MOST_REFUSALS = 14
# A gradient this small beside the largest one met counts as zero.
SMALL = 1e-3

Progress = Callable[[str, float], None]


@record
class Hyper:
    """What a fit is told rather than finds out; each may be one number or an array, as the loss reads it.

    Attributes:
        m: Fuzzifier, above 1.
        noise_distance: Noise distance, above 0: one number, one an embedding or one an object; None where there is none.
        weights: Weights of points, not negative, a zero staying zero; None where they are not tuned.
    """

    m: Any = 2.0
    noise_distance: Any = None
    weights: Any = None


@record
class Tuned:
    """What tuning found, and the way there.

    Attributes:
        hyper: The best values.
        losses: The loss at the start and after every step that lowered it.
        gradients: Derivatives of the loss by m, noise distance and weights at the same places, leading axis S.
        path: The places, leading axis S.
        evaluations: How often the loss was computed, with its gradient or without.
        status: Reasons to read this with care; see `describe`.
    """

    hyper: Hyper
    losses: Float[Array, " S"]
    gradients: Hyper
    path: Hyper
    evaluations: int
    status: Int[Array, ""]


def tune(
    loss: Callable[[Hyper], Any],
    start: Hyper,
    *,
    steps: int = 50,
    solver: optx.AbstractMinimiser | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Minimises a loss over fuzzifier, noise distance and weights.

    The loss may be built from any fit (`jaxfuzzy.losses` has some that make sense); several scenes go through one compiled
    loss by `jax.vmap` within it. What the loss does not read stays as it is. The objective of a fit is no loss: it always falls
    with larger m and smaller noise distance. Fits inside should be solved well: their error is the gradient's.

    Args:
        loss: From `Hyper` to one number; compiled once a function. Data that it takes from around it become constants of the
            compiled code; as `jax.tree_util.Partial(loss, data)`, for a `loss(data, hyper)`, they stay arguments, which compiles
            faster and once for all data of the same shapes.
        start: Where to begin.
        steps: Most evaluations of the loss.
        solver: An optimistix minimiser that follows gradients with a line search; BFGS where not given.
        progress: Called after every evaluation with the lowest loss in words and the share of the steps taken, 0 to 1.

    Returns:
        The best values with the losses and gradients on the way. Only where its status is 0 is this a minimum.

    Raises:
        ValueError: `start` out of range, `steps` below 1, a loss that is not one number.
        TypeError: `start` is no `Hyper`, or the solver keeps no gradient.
    """
    if not isinstance(start, Hyper):
        raise TypeError(f"start must be a Hyper, got {type(start).__name__}")
    checks.integer(steps, "steps", at_least=1)
    if not callable(loss):
        raise TypeError(f"loss must be a function of a Hyper, got {loss!r}")
    if not isinstance(solver, optx.AbstractMinimiser | None):
        raise TypeError(f"solver must be a minimiser of optimistix, got {solver!r}")
    start = _checked(start)
    dtype = jnp.result_type(*jax.tree.leaves(start))
    start = jax.tree.map(lambda leaf: leaf.astype(dtype), start)
    if solver is None:
        # Changes below a tenth of a per mille of any value are of no account.
        solver = optx.BFGS(rtol=1e-4, atol=1e-4)
    scaled = _Scaled(loss)
    origin: Any = jax.tree.map(jnp.zeros_like, start)
    state = solver.init(scaled, origin, None, {}, jax.ShapeDtypeStruct((), dtype), None, frozenset())
    if not hasattr(state, "f_info"):
        raise TypeError(f"solver must keep the gradient of its line search, as optx.BFGS does; {solver} does not")

    # Once for the scale of the gradient, from which the first step's length follows.
    scale = jnp.ones((), dtype)
    _, first, _ = _advance(solver, scaled, origin, (start, scale), state)
    steepest = _length(first.f_info.grad)
    trail = _Trail(start)
    trail.add(origin, first.f_info, scale)
    if not trail.finite:
        return trail.told(1, Status.NOT_FINITE)
    if steepest <= _rounding(first.f_info.f):
        return trail.told(1, Status.FLAT_LOSS)
    scale = jnp.asarray(FIRST_MOVE / steepest, dtype)
    y, evaluations, refused, arrived, lost = origin, 1, 0, False, False
    while evaluations < steps and refused < MOST_REFUSALS and not (arrived or lost):
        trial = state.y_eval
        y, state, over = _advance(solver, scaled, y, (start, scale), state)
        evaluations += 1
        moved = bool(jax.tree.all(jax.tree.map(lambda a, b: jnp.array_equal(a, b), y, trial)))
        refused = 0 if moved else refused + 1
        if moved and evaluations > 2:  # the second evaluation is the start again, now in scale
            trail.add(y, state.f_info, scale)
            if not trail.finite:
                return trail.told(evaluations, Status.NOT_FINITE)
            steepest = max(steepest, _length(state.f_info.grad) / float(scale))
        arrived = bool(over)
        lost = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(y)) > FARTHEST - 1
        if progress is not None:
            progress(f"tuning: loss {float(trail.losses[-1]):.6g}", evaluations / steps)
    left = _length(state.f_info.grad)
    # The gradient of the first evaluation alone has no scale that it could be small beside.
    level = evaluations > 1 and left <= max(SMALL * steepest * float(scale), _rounding(state.f_info.f))
    status = Status(0)
    if lost:
        status = Status.RAN_AWAY | Status.NOT_CONVERGED
    elif not level and (arrived or refused >= MOST_REFUSALS):
        status = Status.STALLED | Status.NOT_CONVERGED
    elif not (arrived or level):
        status = Status.NOT_CONVERGED
    return trail.told(evaluations, status)


class _Scaled(eqx.Module):
    """The loss over logarithms relative to the start, in units that make the first step a good one."""

    loss: Callable[[Hyper], Any]

    def __call__(self, y: Hyper, args: tuple[Hyper, Array]) -> tuple[Array, None]:
        start, scale = args
        limit = 1.5 * FARTHEST
        value = jnp.asarray(self.loss(_away(start, jax.tree.map(lambda v: jnp.clip(v, -limit, limit), y))))
        if value.shape != ():
            raise ValueError(f"loss must give one number, got shape {value.shape}")
        # Where a value is lost the line search has to come back.
        inside = jnp.stack([(jnp.abs(leaf) <= FARTHEST).all() for leaf in jax.tree.leaves(y)]).all()
        return jnp.where(inside, value.astype(scale.dtype) * scale, jnp.inf), None


@eqx.filter_jit
def _advance(solver: Any, loss: _Scaled, y: Hyper, args: Any, state: Any) -> tuple[Hyper, Any, Array]:
    """One evaluation: a step of the minimiser, or one taken back and shortened; and whether it says that it is over."""
    y, state, _ = solver.step(loss, y, args, {}, state, frozenset())
    return y, state, solver.terminate(loss, y, args, {}, state, frozenset())[0]


class _Trail:
    """The places passed, each lower than the one before."""

    def __init__(self, start: Hyper) -> None:
        self.start, self.finite = start, True
        self.places: list[Hyper] = []
        self.slopes: list[Hyper] = []
        self.losses: list[Array] = []

    def add(self, y: Hyper, info: Any, scale: Array) -> None:
        """Takes a place down, in the units of the loss and of what is tuned, unless something is not finite there."""
        if not all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((info.f, info.grad))):
            self.finite = False
            if self.places:
                return
        place = _away(self.start, y)
        self.places.append(place)
        self.losses.append(info.f / scale)
        # d value / d log, where a weight of zero has none.
        stretch = Hyper(place.m - 1, place.noise_distance, place.weights)
        self.slopes.append(
            jax.tree.map(lambda g, v: jnp.where(v > 0, g / scale / jnp.where(v > 0, v, 1), 0), info.grad, stretch)
        )

    def told(self, evaluations: int, status: Status) -> Tuned:
        """The outcome."""
        stack = lambda items: jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)
        return Tuned(
            self.places[-1],
            jnp.stack(self.losses),
            stack(self.slopes),
            stack(self.places),
            evaluations,
            jnp.asarray(int(status), jnp.int32),
        )


def _away(start: Hyper, y: Hyper) -> Hyper:
    """The values that are a logarithm away from the start."""
    noise = None if start.noise_distance is None else start.noise_distance * jnp.exp(y.noise_distance)
    weights = None if start.weights is None else start.weights * jnp.exp(y.weights)
    return Hyper(1 + (start.m - 1) * jnp.exp(y.m), noise, weights)


def _checked(start: Hyper) -> Hyper:
    """The start as arrays, each within its range."""
    found: dict[str, Array | None] = {}
    for name, bound in (("m", 1.0), ("noise_distance", 0.0), ("weights", None)):
        value = getattr(start, name)
        if value is None and name != "m":
            found[name] = None
            continue
        array = as_float(checks.real(value, f"start.{name}"))
        if is_concrete(array):
            known = np.asarray(array)
            fits = known >= 0 if bound is None else known > bound
            if not (np.isfinite(known) & fits).all() or not known.any():
                allowed = "not negative and not all zero" if bound is None else f"above {bound}"
                raise ValueError(
                    f"start.{name} must be finite and {allowed}, got {np.array2string(known, threshold=6)}"
                )
        found[name] = array
    return Hyper(**found)


def _length(gradient: Hyper) -> float:
    return math.sqrt(sum(float(jnp.sum(jnp.square(leaf))) for leaf in jax.tree.leaves(gradient)))


def _rounding(loss: Array) -> float:
    """The gradient below which rounding of the loss hides any descent."""
    return 2 * float(jnp.sqrt(jnp.finfo(loss.dtype).eps) * jnp.abs(loss))
