"""From the points of an object to its shape: hypotheses, choice, batch."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfuzzy import bounds, checks, polish, rays, search
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, as_float, record, static
from jaxfuzzy.primitives import Primitive
from jaxfuzzy.status import Status

KINDS = search.KINDS
# A noise distance is so many standard deviations; residuals are searched and weighed in deviations.
DEVIATIONS = 2.5
FAMILIES = (polish.PLANE, polish.BOX, polish.REVOLUTION, polish.REVOLUTION, polish.SPHERE)
FEWEST = 12
CAPACITIES = (256, 512, 1024, 2048)


@record
class Shape:
    """What an object is.

    Attributes:
        kind: "plane", "box", "cylinder", "cone", "sphere", or "quadric", or "unknown".
        primitive: The primitive; None where unknown.
        inliers: Which of the object's points lie on it.
        noise_distance: The noise distance used, in metres (the median where it differs from point to point).
        scores: Score of every kind tried, lower is better.
        margin: Score of the second best less that of the best.
        counts: Inliers in each embedding, where the paper's rule was asked for.
        covariance: Of `primitive.parameters()`.
        status: Reasons to read this with care; see `describe`.
    """

    primitive: Primitive | None
    inliers: Bool[Array, " N"]
    noise_distance: Scalar
    scores: dict[str, float]
    margin: float
    counts: dict[str, int]
    covariance: Float[Array, "P P"]
    status: Int[Array, ""]
    kind: str = static()


def fit_shape(points: Float[ArrayLike, "N 3"], **options: Any) -> Shape:
    """Names and fits the shape of one object. See `fit_shapes` for the options."""
    array = checks.points(points, dims=3)
    return fit_shapes(array, np.zeros(len(array), int), **options)[0]


def fit_shapes(
    points: Float[ArrayLike, "N 3"],
    labels: Int[ArrayLike, " N"],
    *,
    noise_distance: Any = "auto",
    kinds: tuple[str, ...] = KINDS,
    up: ArrayLike = (0.0, 1.0, 0.0),
    camera: ArrayLike | None = None,
    distance: str | None = None,
    rule: str = "likelihood",
    weights: ArrayLike | None = None,
) -> tuple[Shape, ...]:
    """Names and fits the shapes of all objects of a scene in one compiled batch."""
    array = checks.points(points, dims=3)
    label = checks.labels(labels, len(array))
    dtype = array.dtype
    p = np.asarray(array, np.float64)
    delta = None if isinstance(noise_distance, str) else np.broadcast_to(np.asarray(noise_distance, float), len(p))
    upward = checks.direction(up, "up")
    eye = None if camera is None else np.asarray(camera, float)
    use_rays = eye is not None and distance in (None, "ray")
    members = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    objects = [_prepared(p[m], None if delta is None else delta[m], upward, eye, use_rays) for m in members]
    capacity = next((c for c in CAPACITIES if c >= max(map(len, members))), None) or 1 << int(
        np.ceil(np.log2(max(map(len, members))))
    )
    count = 1 << int(np.ceil(np.log2(len(objects))))
    batch = _stacked(objects, capacity, count, dtype)
    allowed = jnp.asarray([k in kinds for k in KINDS])
    fitted = jax.tree.map(np.asarray, _solve(batch, allowed, use_rays))
    return tuple(_shape(o, m, i, fitted, kinds, dtype) for i, (o, m) in enumerate(zip(objects, members, strict=True)))


class _Object(NamedTuple):
    """One object ready for the kernel: points in its own frame, in the order in which they are sampled."""

    points: np.ndarray
    order: np.ndarray
    gain: np.ndarray
    eye: np.ndarray
    depth_range: float
    given: bool
    frame: bounds.Frame


def _prepared(
    p: np.ndarray, delta: np.ndarray | None, up: np.ndarray, camera: np.ndarray | None, use_rays: bool
) -> _Object:
    middle = p.mean(0)
    if camera is not None and (camera - middle) @ up < 0:
        up = -up
    # A horizontal direction that points away from the camera becomes z.
    forward = middle - camera if use_rays and camera is not None else np.eye(3)[np.argmin(np.abs(up))]
    forward = forward - up * (up @ forward)
    if np.linalg.norm(forward) < 1e-9 * np.linalg.norm(middle) + 1e-30:
        forward = np.eye(3)[np.argmin(np.abs(up))]
        forward = forward - up * (up @ forward)
    forward /= np.linalg.norm(forward)
    turn = np.stack([np.cross(up, forward), up, forward])
    offset = (p - middle) @ turn.T
    unit = float(np.sqrt((offset**2).sum(1).mean()))
    unit = unit if unit > 0 else 1.0
    q = offset / unit
    # Sorted by height and then spread by the golden ratio, any beginning is a fair sample, whatever order points came in.
    order = np.lexsort((q[:, 2], q[:, 0], q[:, 1]))
    order = order[np.argsort((np.arange(len(p)) * 0.6180339887498949) % 1.0, kind="stable")]
    if use_rays and camera is not None:
        eye = turn @ (camera - middle) / unit
        away = np.linalg.norm(q - eye, axis=1)
        relative = (away / away.mean()) ** 2
        depth_range = float(np.ptp(away))
    else:
        eye, relative = np.zeros(3), np.ones(len(p))
        depth_range = float(np.ptp(q, axis=0).min())
    deviation = relative if delta is None else delta / DEVIATIONS / unit
    return _Object(
        points=q[order],
        order=order,
        gain=1 / deviation[order],
        eye=eye,
        depth_range=max(depth_range, 1e-6),
        given=delta is not None,
        frame=bounds.Frame(turn, middle, np.asarray(unit)),
    )


def _stacked(objects: list[_Object], capacity: int, count: int, dtype: Any) -> dict[str, np.ndarray]:
    batch = {
        "points": np.zeros((count, capacity, 3), dtype),
        "gain": np.ones((count, capacity), dtype),
        "mask": np.zeros((count, capacity), dtype),
        "eye": np.full((count, 3), -5.0, dtype),
        "depth_range": np.ones(count, dtype),
        "given": np.ones(count, bool),
    }
    for i, o in enumerate(objects):
        n = len(o.points)
        batch["points"][i, :n], batch["gain"][i, :n], batch["mask"][i, :n] = o.points, o.gain, 1
        batch["eye"][i], batch["depth_range"][i], batch["given"][i] = o.eye, o.depth_range, o.given
    return batch


class _Fitted(NamedTuple):
    kind: Array
    scores: Array
    detail: Array
    noise: Array
    polished: polish.Polished


@partial(jax.jit, static_argnames="use_rays")
def _solve(batch: dict[str, Array], allowed: Array, use_rays: bool) -> _Fitted:
    def one(item: dict[str, Array]) -> _Fitted:
        view = _view(item, use_rays)
        small = jax.tree.map(lambda a: a.astype(jnp.float32), view)
        found = search.search(small, item["depth_range"].astype(jnp.float32), allowed, item["given"])
        dtype = view.gain.dtype
        deviation = found.deviation.astype(dtype)
        take = lambda a: a[found.kind].astype(dtype)
        polished = polish.polish(
            jnp.asarray(FAMILIES)[found.kind],
            jax.tree.map(take, found.candidates),
            view._replace(gain=view.gain / deviation),
            take(found.scale),
            take(found.background),
            item["depth_range"],
            (0.2, 2.0),
            1e-9 if dtype == jnp.float64 else 1e-5,
        )
        return _Fitted(found.kind, found.scores, take(found.candidates.detail), deviation, polished)

    return lax.map(one, batch)


def _view(item: dict[str, Array], use_rays: bool) -> rays.View:
    p, gain, mask = item["points"], item["gain"], item["mask"]
    point = tuple(p[:, i][None] for i in range(3))
    if not use_rays:
        return rays.View(point, None, None, gain, mask)
    d = p - item["eye"]
    d = d / jnp.sqrt((d**2).sum(-1, keepdims=True))
    return rays.View(
        point, tuple(d[:, i][None] for i in range(3)), tuple(item["eye"][i][None, None] for i in range(3)), gain, mask
    )


@partial(jax.jit, static_argnames="kind")
def _assemble(
    kind: str, theta: Array, ends: Array, signs: Array, rotation: Array, frame: bounds.Frame, covariance: Array
):
    def parameters(x: Array) -> Array:
        return build(x).parameters()

    def build(x: Array) -> Primitive:
        e = jnp.concatenate([x[7:].reshape(3, 2), ends[:, 2:]], 1)
        return bounds.assembled(kind, x[:5], x[5:7], e, signs, rotation, frame)

    x = jnp.concatenate([theta, jnp.zeros(2, theta.dtype), ends[:, :2].ravel()])
    slope = jax.jacfwd(parameters)(x)
    full = jnp.zeros((13, 13), theta.dtype).at[:7, :7].set(covariance)
    full = full.at[jnp.arange(7, 13), jnp.arange(7, 13)].set(jnp.repeat(ends[:, 2] ** 2, 2))
    return build(x), slope @ full @ slope.T


def _shape(o: _Object, members: np.ndarray, i: int, fitted: _Fitted, kinds: tuple[str, ...], dtype: Any) -> Shape:
    n = len(o.points)
    polished = jax.tree.map(lambda a: a[i], fitted.polished)
    kind = KINDS[int(fitted.kind[i])]
    limit = DEVIATIONS * (1.0 if o.given else float(polished.scale))
    on = polished.square[:n] <= limit**2
    status = Status(0)
    if n < FEWEST or on.sum() < FEWEST // 2:
        status |= Status.TOO_FEW_POINTS
    direction = o.points - o.eye
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hits = (o.points + polished.depth[:n, None] * direction * bool(np.any(o.eye))) @ np.asarray(polished.turn).T
    ends = bounds.ends_of(kind, polished.theta, hits, polished.part[:n], on, fitted.detail[i])
    if kind == "plane":
        status |= Status.MAY_BE_BOX
    frame = jax.tree.map(lambda a: jnp.asarray(a, dtype), o.frame)
    primitive, covariance = _assemble(
        kind,
        jnp.asarray(polished.theta),
        jnp.asarray(ends, dtype),
        jnp.asarray(fitted.detail[i], dtype),
        jnp.asarray(polished.turn),
        frame,
        jnp.asarray(polished.covariance),
    )
    inliers = np.zeros(n, bool)
    inliers[o.order] = on
    scores = {k: float(s) for k, s in zip(KINDS, fitted.scores[i], strict=True) if k in kinds}
    ranked = sorted(scores.values())
    deviation = float(np.median(1 / o.gain)) * float(fitted.noise[i]) * float(o.frame.unit)
    return Shape(
        primitive=primitive,
        inliers=jnp.asarray(inliers),
        noise_distance=jnp.asarray(deviation * limit, dtype),
        scores=scores,
        margin=ranked[1] - ranked[0] if len(ranked) > 1 else float("inf"),
        counts={},
        covariance=covariance,
        status=jnp.asarray(int(status)),
        kind=kind,
    )
