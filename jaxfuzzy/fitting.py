"""The compiled part of shape fitting: a padded object in, its best surface out; and bounded primitives."""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import bounds, polish, rays, search
from jaxfuzzy.arrays import WIDE, Array
from jaxfuzzy.candidates import Candidates
from jaxfuzzy.objects import MOST, Frame, Prepared, opened
from jaxfuzzy.packing import leaf, packed, unpacked
from jaxfuzzy.primitives import KINDS, Primitive

FAMILIES = (polish.PLANE, polish.BOX, polish.REVOLUTION, polish.REVOLUTION, polish.SPHERE)
# Several objects are searched at a time, each by one thread: that takes a twentieth less than to share out the work on each.
ONE_THREAD = WIDE | {"xla_cpu_multi_thread_eigen": False}
# Noise of a surface in units of the points' deviation may be found to be so small or large.
SCALES = (0.2, 8.0)
# A surface stands still when nothing moves by more, in units of the object's spread.
TOLERANCES = {jnp.dtype(jnp.float32): 1e-5, jnp.dtype(jnp.float64): 1e-9}


class Start(NamedTuple):
    """What a polish starts from: a candidate, the rotation into its frame, its noise scale and its share of background."""

    candidate: Candidates
    turn: Array
    scale: Array
    background: Array


# How these and what is found are handed to programs and back.
_KINDS = len(KINDS)
STARTED = (leaf(dtype=np.int32), leaf(), Start(Candidates(leaf(5), leaf(3), leaf(7)), leaf(3, 3), leaf(), leaf()))
FOUND = search.Found(
    scores=leaf(_KINDS),
    passed=leaf(_KINDS, dtype=bool),
    candidates=Candidates(leaf(_KINDS, 5), leaf(_KINDS, 3), leaf(_KINDS, 7)),
    turn=leaf(_KINDS, 3, 3),
    scale=leaf(_KINDS),
    background=leaf(_KINDS),
    deviation=leaf(),
    local=leaf(),
    normals=leaf(search.PATCHES, 3),
)


@cache
def _polished(count: int) -> polish.Polished:
    of_all = {"square": leaf(count), "depth": leaf(count), "part": leaf(count, dtype=np.int32)}
    return polish.Polished(leaf(5), leaf(3, 3), leaf(), leaf(), leaf(7, 7), **of_all, moved=leaf())


class Fitted(NamedTuple):
    """The surface of an object, and what the search found of all kinds.

    Attributes:
        kind: Index of its kind.
        scores: Score of every kind (5,).
        passed: Whether it is allowed and no guard speaks against it (5,).
        found: The best candidate of each kind.
        polished: The surface on all points.
    """

    kind: int
    scores: np.ndarray
    passed: np.ndarray
    found: search.Found
    polished: polish.Polished

    @property
    def detail(self) -> np.ndarray:
        """Signs of a box, ends of a body of revolution (3,)."""
        return np.asarray(self.found.candidates.detail[self.kind])

    @property
    def deviation(self) -> float:
        """Factor found for deviations that were not given, else 1."""
        return float(self.found.deviation)

    @property
    def local(self) -> float:
        """What small windows say of the points' deviation, in units of that used."""
        return float(self.found.local)


def fit(item: np.ndarray, allowed: np.ndarray, gric: bool, along_ray: bool) -> Fitted:
    """The best surface of one object.

    Args:
        item: As `objects.padded` makes it.
        allowed: Which kinds may be chosen (5,).
        gric: Whether to score by GRIC in place of the likelihood.
        along_ray: Whether residuals are along the viewing ray.
    """
    found = unpacked(np.asarray(_search(item, np.asarray(gric), along_ray)), FOUND)
    passed = np.asarray(found.passed) & allowed
    scores = np.asarray(found.scores)
    kind = best_kind(scores, passed)
    return Fitted(kind, scores, passed, found, finished(item, found, kind, along_ray))


def best_kind(scores: np.ndarray, passed: np.ndarray) -> int:
    """The kind of the best score among those that passed (5,)."""
    return int(np.argmin(np.where(passed, scores, np.inf)))


def finished(item: np.ndarray, found: search.Found, kind: int, along_ray: bool) -> polish.Polished:
    """The best candidate of a kind, polished on all points."""
    start = jax.tree.map(lambda a: a[kind], Start(found.candidates, found.turn, found.scale, found.background))
    return polished_from(item, start, kind, float(found.deviation), along_ray)


def polished_from(item: np.ndarray, start: Start, kind: int, deviation: float, along_ray: bool) -> polish.Polished:
    """A surface of a kind, polished on all points."""
    # The search is in single precision: a rotation is made one to the last digit of double.
    turn = np.asarray(start.turn, float)
    turn = 1.5 * turn - 0.5 * turn @ turn.T @ turn
    given = packed((FAMILIES[kind], deviation, start._replace(turn=turn)), item.dtype, np)
    return unpacked(np.asarray(_polish(item, given, along_ray)), _polished(item.shape[1]))


@partial(jax.jit, static_argnames="along_ray", compiler_options=ONE_THREAD)
def _search(item: Array, gric: Array, along_ray: bool) -> Array:
    """The best candidate of each kind for one object; single precision is enough, as the winner is polished in the input's own."""
    parts = jax.tree.map(lambda a: a if a.dtype == bool else a.astype(jnp.float32), opened(item))
    return packed(search.search(_view(parts, along_ray), parts["depth_range"], parts["given"], gric), jnp.float32)


@partial(jax.jit, static_argnames="along_ray", compiler_options=ONE_THREAD)
def _polish(item: Array, given: Array, along_ray: bool) -> Array:
    parts = opened(item)
    view = _view(parts, along_ray)
    family, deviation, start = unpacked(given, STARTED)
    polished = polish.polish(
        family,
        start.candidate,
        start.turn,
        view._replace(gain=view.gain / deviation),
        start.scale,
        start.background,
        parts["depth_range"],
        parts["lean"],
        SCALES,
        TOLERANCES[view.gain.dtype],
    )
    return packed(polished, item.dtype)


def _ahead_of_search(item: np.ndarray, along_ray: bool) -> None:
    _search(item, np.asarray(False), along_ray)


def _ahead_of_polish(item: np.ndarray, along_ray: bool) -> None:
    none = np.zeros(())
    start = Start(Candidates(np.zeros(5), np.zeros(3), np.zeros(7)), np.eye(3), none + 1, none + 0.5)  # type: ignore[arg-type]
    polished_from(item, start, 0, 1.0, along_ray)


# Compiled one beside the other, given an object without points.
PARTS = (_ahead_of_search, _ahead_of_polish)


def _view(item: dict[str, Array], along_ray: bool) -> rays.View:
    point, gain, mask = item["points"][None], item["gain"], item["weight"]
    if not along_ray:
        return rays.View(point, None, None, gain, mask)
    return rays.View(point, item["rays"][None], item["eye"][None], gain, mask)


class Judged(NamedTuple):
    """All points of an object beside its surface, in the order of the search.

    Attributes:
        square: Squared residual in deviations (N,).
        depth: From each along its ray to the surface (N,).
        part: Which part of the surface each met (N,).
    """

    square: np.ndarray
    depth: np.ndarray
    part: np.ndarray


def judged(item: Prepared, fitted: Fitted, along_ray: bool) -> Judged:
    """What the fit says of the points it was made to, and for a larger object of all others too."""
    n, polished, dtype = len(item.points), fitted.polished, fitted.polished.theta.dtype
    if n <= len(polished.square):
        return Judged(*(np.asarray(a)[:n] for a in (polished.square, polished.depth, polished.part)))
    pieces = []
    for start in range(0, n, MOST):
        own = slice(start, start + MOST)
        fill = lambda a: np.pad(a, ((0, MOST - len(a)), *((0, 0),) * (a.ndim - 1)), mode="edge").astype(dtype)
        points, rays_, gain = (fill(a[own]) for a in (item.points, item.rays, item.gain))
        surface = (np.asarray(FAMILIES)[fitted.kind], polished.theta, polished.turn, fitted.detail)
        pieces.append(_judge(*surface, points.T, rays_.T, item.eye.astype(dtype), gain / fitted.deviation, along_ray))
    return Judged(*(np.concatenate(a)[:n] for a in zip(*jax.device_get(pieces), strict=True)))


@partial(jax.jit, static_argnames="along_ray")
def _judge(
    family: Array,
    theta: Array,
    turn: Array,
    detail: Array,
    points: Array,
    directions: Array,
    eye: Array,
    gain: Array,
    along_ray: bool,
) -> tuple[Array, Array, Array]:
    item = {"points": points, "rays": directions, "eye": eye, "gain": gain, "weight": jnp.ones_like(gain)}
    view = _view(item, along_ray)
    met = polish.met_by(family, theta, turn, detail, view)
    square, *_ = polish.residual_of(family, theta, turn, detail, view, met)
    return square, met.depth[0], met.part[0]


# Run once a call on a few numbers: optimising the code takes longer than it saves.
@partial(
    jax.jit,
    static_argnames="kind",
    compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False},
)
def assemble_batch(
    kind: str, theta: Array, covariance: Array, turn: Array, detail: Array, ends: Array, frame: Frame
) -> tuple[Primitive, Array]:
    """Bounded primitives of one kind in metres, and the covariance of their parameters; every argument has a leading axis."""

    def one(
        theta: Array, covariance: Array, turn: Array, detail: Array, ends: Array, frame: Frame
    ) -> tuple[Primitive, Array]:
        def build(x: Array) -> Primitive:
            moved = jnp.concatenate([x[7:].reshape(3, 2), ends[:, 2:]], 1)
            return bounds.assembled(kind, x[:5], x[5:7], moved, detail, turn, frame)

        x = jnp.concatenate([theta, jnp.zeros(2, theta.dtype), ends[:, :2].ravel()])

        def parameters(x: Array) -> tuple[Array, Primitive]:
            primitive = build(x)
            return primitive.parameters(), primitive

        slope, primitive = jax.jacfwd(parameters, has_aux=True)(x)
        errors = jnp.repeat(ends[:, 2] ** 2, 2)
        full = jnp.zeros((13, 13), theta.dtype).at[:7, :7].set(covariance)
        full = full.at[jnp.arange(7, 13), jnp.arange(7, 13)].set(errors)
        return primitive, slope @ full @ slope.T

    return jax.vmap(one)(theta, covariance, turn, detail, ends, frame)


def distances(primitive: Primitive, points: np.ndarray) -> np.ndarray:
    """Distances in metres of points (N, 3) from a bounded primitive, by a program of one size."""
    found = [np.zeros(0, points.dtype)]
    for start in range(0, len(points), MOST):
        own = points[start : start + MOST]
        padded = np.pad(own, ((0, MOST - len(own)), (0, 0)), mode="edge")
        found.append(np.asarray(_distances(primitive, padded))[: len(own)])
    return np.concatenate(found)


@jax.jit
def _distances(primitive: Primitive, points: Array) -> Array:
    return primitive.distance(points)
