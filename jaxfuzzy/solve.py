"""The one fixed-point loop: plain or Anderson-accelerated, guarded, with an implicit derivative of its own.

A method gives its step, a map from prototypes to prototypes; `fixed_point` iterates it in an optimistix `lax.while_loop` until
the prototypes stand still, and differentiates the fixed point, once, by the implicit function theorem,

    d theta = (I - dT/dtheta)^+ dT,

with a rank-revealing pseudo-inverse, so that a singular item (coincident centers) gets the minimum-norm derivative and leaves the
other items of a batch alone. Nothing raises inside a compiled function, forward or backward.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Bool, Float, Int, is_concrete, record, static

# How many past steps Anderson acceleration combines: more brings little on prototypes, which are few.
MEMORY = 5


@dataclass(frozen=True)
class Solver:
    """How a fixed point is looked for.

    Attributes:
        max_steps: Largest number of steps, the first one from the seeds included.
        tol: A fit has converged when no prototype moves further than this, in units of the RMS spread of the points; never
            taken below 16 units of rounding. 0 is legal and takes exactly `max_steps` steps.
        acceleration: "anderson" combines the last steps and takes the outcome only where its objective is no higher than that of
            the plain step from the same point; None is plain alternating optimisation.
        mesh: Devices to divide the points among, along all its axes. None: those the points lie on already (`jax.device_put` with
            a `NamedSharding` of their first axis), else the default device.

    Raises:
        ValueError: `max_steps` below 1, `tol` negative or not finite, unknown `acceleration`.
    """

    max_steps: int = 500
    tol: float = 1e-6
    acceleration: Literal["anderson"] | None = "anderson"
    mesh: jax.sharding.Mesh | None = None

    def __post_init__(self) -> None:
        checks.integer(self.max_steps, "max_steps", at_least=1)
        if is_concrete(self.tol):
            checks.number(self.tol, "tol", at_least=0.0)
        checks.choice(self.acceleration, "acceleration", ("anderson", None))
        if self.mesh is not None:
            checks.kind(self.mesh, "mesh", jax.sharding.Mesh)

    def traced(self, dtype: Any) -> "Effort":
        """The same as values that JAX traces, so that another tolerance or step limit needs no other compilation."""
        return Effort(
            jnp.asarray(self.tol, dtype), jnp.asarray(self.max_steps, jnp.int32), self.acceleration is not None
        )


@record
class Effort:
    """A solver's settings inside compiled code.

    Attributes:
        tol: Tolerance.
        max_steps: Step limit.
        accelerate: Whether to accelerate.
    """

    tol: Float[Array, ""]
    max_steps: Int[Array, ""]
    accelerate: bool = static()


@record
class FixedPoint:
    """Where an iteration ended.

    Attributes:
        theta: The prototypes.
        steps: Number of steps taken.
        change: Largest change of the last step.
        converged: Whether the change fell below the tolerance.
    """

    theta: Any
    steps: Int[Array, ""]
    change: Float[Array, ""]
    converged: Bool[Array, ""]


# step(theta, args) -> (theta one step on, merit of theta); of two candidates the one with the lower merit is the better.
Step = Callable[[Any, Any], tuple[Any, Array]]
Jacobian = Callable[[Any, Any], Float[Array, "p p"]]


def fixed_point(
    step: Step,
    start: Any,
    args: Any,
    solver: Solver | Effort,
    *,
    smooth_step: Step | None = None,
    jacobian: Jacobian | None = None,
    descent: bool = True,
) -> FixedPoint:
    """Iterates `step` from `start` until it stands still; differentiable in `args`.

    Args:
        step: One step; must not close over traced values: what may be differentiated or batched comes through `args`.
        start: Prototypes to start from, a pytree of float arrays in units where the points' RMS spread is 1.
        args: Everything else the step reads: points, weights, fuzzifier, noise distance.
        solver: Tolerance, step limit, acceleration, as given or already traced.
        smooth_step: The same map in a form that carries every derivative, where `step` takes a short cut; None: `step` itself.
        jacobian: The derivative of the map with respect to the raveled prototypes, at a fixed point; None: by forward
            differentiation of `smooth_step`.
        descent: Whether the step never raises its merit. Where it may, candidates are compared by how far they still move.
    """
    flat, unravel = ravel_pytree(start)
    effort = solver.traced(flat.dtype) if isinstance(solver, Solver) else solver

    def flat_step(y: Array, args: Any, of: Step = step) -> tuple[Array, Array]:
        new, merit = of(unravel(y), args)
        return ravel_pytree(new)[0].astype(y.dtype), merit

    def flat_jacobian(y: Array, args: Any) -> Array:
        if jacobian is not None:
            return jacobian(unravel(y), args)
        return jax.jacfwd(lambda z: flat_step(z, args, smooth_step or step)[0])(y)

    smooth = partial(flat_step, of=smooth_step or step)
    y, steps, change, converged = _solve(
        flat_step, smooth, flat_jacobian, effort.accelerate, descent, flat, effort.tol, effort.max_steps, args
    )
    return FixedPoint(unravel(y), steps, change, converged)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3, 4))
def _solve(
    step: Any,
    smooth: Any,
    jacobian: Any,
    accelerate: bool,
    descent: bool,
    start: Array,
    tol: Array,
    max_steps: Array,
    args: Any,
) -> tuple[Array, Array, Array, Array]:
    del smooth, jacobian
    solver = _alternation(start, tol, max_steps, accelerate, descent)
    # The step limit is the solver's own, so that it is traced: another limit needs no other compilation.
    solution = optx.fixed_point(step, solver, start, args, has_aux=True, max_steps=None, throw=False)
    state = solution.state
    return state.ahead, state.steps, state.change, solver.converged(state)


def _solve_jvp(
    step: Any,
    smooth: Any,
    jacobian: Any,
    accelerate: bool,
    descent: bool,
    primals: tuple[Any, ...],
    tangents: tuple[Any, ...],
) -> tuple[Any, Any]:
    start, tol, max_steps, args = primals
    out = _solve(step, smooth, jacobian, accelerate, descent, start, tol, max_steps, args)
    y = out[0]
    leaves, treedef = jax.tree.flatten(args)
    together = partial(jax.tree.unflatten, treedef)
    changes = jax.tree.leaves(tangents[3])
    moving = [not isinstance(change, SymbolicZero) for change in changes]

    def of_moving(parts: list[Array]) -> Array:
        rest = iter(parts)
        return smooth(y, together([next(rest) if on else leaf for on, leaf in zip(moving, leaves, strict=True)]))[0]

    dy = jnp.zeros_like(y)
    if any(moving):
        primal = [leaf for on, leaf in zip(moving, leaves, strict=True) if on]
        tangent = [change for on, change in zip(moving, changes, strict=True) if on]
        forced = jax.jvp(of_moving, (primal,), (tangent,))[1]
        response = _pseudo_inverse(jnp.eye(y.size, dtype=y.dtype) - jacobian(y, args))
        dy = _once(response) @ forced
    no_tangent = jax.custom_derivatives.zero_from_primal
    return out, (dy, *(no_tangent(value) for value in out[1:]))


_solve.defjvp(_solve_jvp, symbolic_zeros=True)


@jax.custom_jvp
def _once(value: Array) -> Array:
    """A value that is part of a first derivative, whose own derivative is not known."""
    return value


@_once.defjvp
def _once_jvp(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError("second derivatives of a fit are not computed: differentiate it once")


def _pseudo_inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Minimum-norm inverse: directions in which the matrix vanishes to rounding give no response."""
    u, s, vt = jnp.linalg.svd(matrix)
    kept = s > 8 * matrix.shape[0] * jnp.finfo(matrix.dtype).eps * s[0]
    inverse = jnp.where(kept, 1 / jnp.where(kept, s, 1), 0)
    return (vt.T * inverse) @ u.T


class _State(eqx.Module):
    """What is carried from step to step beside the prototypes themselves."""

    steps: Int[Array, ""]
    ahead: Float[Array, " p"]  # one step on from the current prototypes
    change: Float[Array, ""]
    moves: Float[Array, "memory p"]  # past differences of prototypes ...
    turns: Float[Array, "memory p"]  # ... and of their steps
    known: Int[Array, ""]  # how many of them are filled


class _Alternation(optx.AbstractFixedPointSolver):
    """Alternating optimisation, each step either plain or Anderson's combination of the last ones, whichever is better."""

    rtol: float
    atol: float  # the largest change that counts as standing still
    norm: Callable[[Any], Array] = eqx.field(static=True)
    max_steps: Int[Array, ""]
    accelerate: bool = eqx.field(static=True)
    descent: bool = eqx.field(static=True)

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> _State:
        del options, f_struct, aux_struct, tags
        return self.begin(y, fn(y, args)[0])

    def begin(self, y: Array, ahead: Array) -> _State:
        """The state after the first step."""
        memory = jnp.zeros((MEMORY if self.accelerate else 0, y.size), y.dtype)
        zero = jnp.zeros((), jnp.int32)
        return _State(zero + 1, ahead, self.norm(ahead - y), memory, memory, zero)

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any) -> tuple[Any, _State, Any]:
        del options, tags
        tried = self.candidates(y, state)
        if len(tried) == 1:
            ahead, merit = (value[None] for value in fn(tried[0], args))
        else:
            ahead, merit = jax.vmap(lambda z: fn(z, args))(tried)
        return self.choose(y, state, tried, ahead, merit)

    def candidates(self, y: Array, state: _State) -> Float[Array, "1_or_2 p"]:
        """Where to step from next: the outcome of the plain step, and Anderson's combination."""
        if not self.accelerate:
            return state.ahead[None]
        return jnp.stack([state.ahead, _anderson(y, state.ahead, state)])

    def choose(self, y: Array, state: _State, tried: Array, ahead: Array, merit: Array) -> tuple[Array, _State, Array]:
        """The better candidate, once one step has been taken from each."""
        plain = tried[0]
        if len(tried) == 1:
            return plain, _ahead(state, ahead[0], self.norm(ahead[0] - plain)), merit[0]
        bold = tried[1]
        if not self.descent:
            merit = jnp.log(jnp.abs(ahead - tried).max(axis=1))
        slack = 8 * jnp.finfo(y.dtype).eps
        better = (state.known > 0) & (merit[1] <= merit[0] + slack) & jnp.isfinite(ahead[1]).all()
        # Both candidates were swept, so both teach the next combination.
        state = _remember(state, plain - y, (ahead[0] - plain) - (state.ahead - y))
        taught = _remember(state, bold - plain, (ahead[1] - bold) - (ahead[0] - plain))
        state = jax.tree.map(partial(jnp.where, better), taught, state)
        new, ahead = jnp.where(better, bold, plain), jnp.where(better, ahead[1], ahead[0])
        return new, _ahead(state, ahead, self.norm(ahead - new)), jnp.where(better, merit[1], merit[0])

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any) -> tuple[Array, Any]:
        del fn, y, args, options, tags
        return self.done(state), optx.RESULTS.successful

    def done(self, state: _State) -> Bool[Array, ""]:
        """Whether to stop."""
        return (state.change <= self.atol) | (state.steps >= self.max_steps)

    def converged(self, state: _State) -> Bool[Array, ""]:
        """Whether the prototypes stand still; with a tolerance of 0, to rounding."""
        limit = jnp.where(self.atol >= 0, self.atol, 16 * jnp.finfo(state.ahead.dtype).eps)
        return (state.change <= limit) & jnp.isfinite(state.ahead).all()

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: _State, tags: Any, result: optx.RESULTS
    ) -> tuple[Any, Any, dict[str, Any]]:
        del fn, args, options, state, tags, result
        return y, aux, {}


def _alternation(start: Array, tol: Array, max_steps: Array, accelerate: bool, descent: bool) -> _Alternation:
    # Rounding alone keeps prototypes moving by a few units, so a tolerance below that would never be met.
    limit = jnp.where(tol > 0, jnp.maximum(tol, 16 * jnp.finfo(start.dtype).eps), -1.0)
    return _Alternation(0.0, limit, _largest, max_steps, accelerate, descent)  # type: ignore[arg-type]


def fixed_point_outside(
    step: Callable[[list[Any]], tuple[list[Any], Sequence[Any]]],
    start: Any,
    solver: Solver,
    *,
    descent: bool = True,
    saved: Mapping[str, Any] | None = None,
    after: Callable[[dict[str, Any]], None] = lambda state: None,
) -> FixedPoint:
    """The same iteration as `fixed_point`, for a step that cannot be compiled because it reads its points from elsewhere.

    Args:
        step: From a list of prototypes to those one step on, and the merit of each.
        start: Prototypes to start from.
        solver: Tolerance, step limit, acceleration.
        descent: As in `fixed_point`.
        saved: What `after` was given last, to go on from there.
        after: Called after every step with everything that is needed to go on.
    """
    flat, unravel = ravel_pytree(start)
    effort = solver.traced(flat.dtype)
    loop = _alternation(flat, effort.tol, effort.max_steps, effort.accelerate, descent)
    names = [field.name for field in dataclasses.fields(_State)]

    def steps(tried: Array) -> tuple[Array, Array]:
        ahead, merits = step([unravel(y) for y in tried])
        return jnp.stack([ravel_pytree(one)[0].astype(flat.dtype) for one in ahead]), jnp.asarray(merits, flat.dtype)

    def keep(y: Array, state: _State) -> None:
        after({"y": np.asarray(y)} | {name: np.asarray(getattr(state, name)) for name in names})

    if saved is None:
        y, state = flat, loop.begin(flat, steps(flat[None])[0][0])
        keep(y, state)
    else:
        y, state = jnp.asarray(saved["y"]), _State(*(jnp.asarray(saved[name]) for name in names))
    candidates, choose = eqx.filter_jit(_Alternation.candidates), eqx.filter_jit(_Alternation.choose)
    while not bool(loop.done(state)):
        tried = candidates(loop, y, state)
        y, state, _ = choose(loop, y, state, tried, *steps(tried))
        keep(y, state)
    return FixedPoint(unravel(state.ahead), state.steps, state.change, loop.converged(state))


def _largest(change: Array) -> Array:
    return jnp.abs(change).max()


def _remember(state: _State, move: Array, turn: Array) -> _State:
    slot = state.known % MEMORY
    moves, turns = state.moves.at[slot].set(move), state.turns.at[slot].set(turn)
    return _State(state.steps, state.ahead, state.change, moves, turns, state.known + 1)


def _ahead(state: _State, ahead: Array, change: Array) -> _State:
    return _State(state.steps + 1, ahead, change, state.moves, state.turns, state.known)


def _anderson(y: Array, plain: Array, state: _State) -> Array:
    """Anderson's combination (type II): the past steps whose mix leaves the smallest change, by damped normal equations."""
    residual = plain - y
    gram = state.turns @ state.turns.T
    lengths = jnp.sqrt(jnp.diagonal(gram))
    empty = lengths <= 0
    scale = jnp.where(empty, 1, lengths)
    gram = gram / jnp.outer(scale, scale)
    eps = jnp.finfo(y.dtype).eps
    gram = gram + jnp.diag(jnp.where(empty, 1, 64 * eps).astype(y.dtype))
    mix = jnp.linalg.solve(gram, (state.turns @ residual) / scale) / scale
    return plain - mix @ (state.moves + state.turns)
