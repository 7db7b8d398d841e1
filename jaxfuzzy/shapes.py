"""From the points of an object to its shape: its kind, its size, how sure that is; many objects in one compiled batch.

The engine is a fuzzy variety beside a noise cluster (see `search`), its residual taken along the viewing ray where the camera is
known: stereo errs along the ray alone, so a surface should predict one depth a ray, its first hit that faces the camera.
"""

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import jax
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, Scalar, all_on_device, on_host, record, static
from jaxfuzzy.assembly import Bounded, bounded
from jaxfuzzy.fitting import TOLERANCES, Fitted
from jaxfuzzy.looks import Look, Settings, first_look, further_look, look_about, look_as, side_by_side, unfit
from jaxfuzzy.mostpoints import most_points
from jaxfuzzy.objects import DEVIATIONS, MOST, Prepared, capacity_for, prepared
from jaxfuzzy.primitives import KINDS, Primitive
from jaxfuzzy.quadrics import quadric_of
from jaxfuzzy.status import Status

# Of these bits a quadric has the first alone.
NO_QUADRIC = Status.REFUSED | Status.ALL_NOISE | Status.SEEN_THROUGH | Status.PIECE
# Nats of margin below which the next kind is nearly as good.
NARROW = 10.0
# A plane is a face of a box, a cylinder a cone that does not narrow.
FAMILIES = {"plane": "flat", "box": "flat", "cylinder": "turned", "cone": "turned", "sphere": "sphere"}
GUARDS = {
    "plane": "not tried",
    "box": "a face holds too few of the points within its extent, or other faces lie beyond it",
    "cylinder": "its radius is next to nothing, or so large that it is flat, or less than 60 degrees around it are seen",
    "cone": "it does not taper by a quarter, or its radius is out of range, or less than 60 degrees around it are seen",
    "sphere": "its radius is next to nothing, or so large that it is flat",
}


@record
class Shape:
    """What an object is.

    Attributes:
        kind: "plane", "box", "cylinder", "cone", "sphere", or "quadric", or "unknown".
        primitive: The primitive; None where unknown.
        inliers: Which of the object's points lie on it.
        noise_distance: The noise distance used, in metres (the median where it differs from point to point).
        scores: Score of every kind tried, the best of all looks at it; lower is better.
        margin: Score of the best other kind that no guard spoke against less that of this one; below 0 where that one was refused.
        counts: Inliers in each embedding, where the paper's rule was asked for.
        covariance: Of `primitive.parameters()`.
        status: Reasons to read this with care; see `describe`.
        guards: Kinds that a guard spoke against, whatever their score, and why.
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
    guards: tuple[str, ...] = static(default=())


def fit_shape(
    points: Float[ArrayLike, "N 3"],
    *,
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    kinds: Sequence[str] = KINDS,
    up: ArrayLike = (0.0, 1.0, 0.0),
    camera: ArrayLike | None = None,
    distance: Literal["ray", "geometric", "algebraic"] | None = None,
    rule: Literal["likelihood", "gric", "paper"] = "likelihood",
    weights: ArrayLike | None = None,
) -> Shape:
    """Names and fits the shape of one object.

    Args:
        points: Its points (N, 3) in metres, outliers among them.
        noise_distance: How far a point may lie from the surface and still belong to it, in metres: two and a half standard
            deviations, for all points or for each (N,), along the viewing ray where that is known. "auto": the deviation is read
            from the residuals of small windows, growing with the square of the distance from a known camera, and then
            from those of the surface found.
        kinds: Kinds to choose from. What fits none is "quadric" or "unknown".
        up: The vertical direction, near which axes are looked for; its sign may be either.
        camera: Where the points were seen from (3,), in their own frame.
        distance: "ray", along the viewing ray (the default with a camera); "geometric", orthogonal (without); "algebraic", the
            paper's, in the embedding (the default of, and only for, the paper's rule, which has no "ray").
        rule: "likelihood" of surface noise against background less a price per parameter; "gric", Torr's criterion; "paper", most
            points in 3D, 4D or 6D, see `mostpoints`: its `counts` are told, its shapes have no covariance, and the scores are
            those of the likelihood, whose disagreement is told by the status.
        weights: Weight of each point (N,).

    Returns:
        The shape. It is "unknown" with a status where the data do not tell.

    Raises:
        ValueError: An argument out of range or of wrong shape.
        TypeError: An argument of wrong kind.
    """
    array = checks.places(points)
    return fit_shapes(
        array,
        np.zeros(len(array), int),
        noise_distance=noise_distance,
        kinds=kinds,
        up=up,
        camera=camera,
        distance=distance,
        rule=rule,
        weights=weights,
    )[0]


def fit_shapes(
    points: Float[ArrayLike, "N 3"],
    labels: Int[ArrayLike, " N"],
    *,
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    kinds: Sequence[str] = KINDS,
    up: ArrayLike = (0.0, 1.0, 0.0),
    camera: ArrayLike | None = None,
    distance: Literal["ray", "geometric", "algebraic"] | None = None,
    rule: Literal["likelihood", "gric", "paper"] = "likelihood",
    weights: ArrayLike | None = None,
) -> tuple[Shape, ...]:
    """Names and fits the shapes of all objects of a scene in one compiled batch.

    Args:
        points: Points (N, 3) of all objects in metres.
        labels: The object of each point (N,), 0, 1, ...; -1 is left out.
        noise_distance: As in `fit_shape`.
        kinds: As in `fit_shape`.
        up: As in `fit_shape`.
        camera: As in `fit_shape`.
        distance: As in `fit_shape`.
        rule: As in `fit_shape`.
        weights: As in `fit_shape`.

    Returns:
        One shape a label, in the order of the labels.

    Raises:
        ValueError: An argument out of range or of wrong shape.
        TypeError: An argument of wrong kind.
    """
    array = checks.places(points)
    label = checks.labels(labels, len(array))
    if label.max() >= len(array):
        raise ValueError(
            f"labels must count objects 0, 1, ..., fewer than the {len(array)} points, got {int(label.max())}"
        )
    members = [np.flatnonzero(label == k) for k in range(int(label.max()) + 1)]
    fits = Fits(
        array,
        noise_distance=noise_distance,
        kinds=kinds,
        up=up,
        camera=camera,
        distance=distance,
        rule=rule,
        weights=weights,
    )
    shapes = fits.shapes(members)
    return all_on_device(with_quadrics(np.asarray(array), members, shapes, weights))


def kinds_of(kinds: Any) -> tuple[str, ...]:
    """The kinds to choose from."""
    if isinstance(kinds, str):
        raise TypeError(f"kinds must be several names, got the string {kinds!r}")
    if not isinstance(kinds, Iterable):
        raise TypeError(f"kinds must be several names, got {kinds!r}")
    kinds = tuple(map(str, kinds))
    if not kinds:
        raise ValueError(f"kinds must name one of {', '.join(map(repr, KINDS))} at least, got none")
    return tuple(checks.choice(k, "kinds", KINDS) for k in kinds)


def distance_of(distance: Any, rule: str, camera: Any) -> str:
    """How far a point lies from a surface: what was asked for, or what is usual."""
    if camera is not None:
        checks.position(camera, "camera")
    usual = "algebraic" if rule == "paper" else "geometric" if camera is None else "ray"
    able = ("geometric", "algebraic") if rule == "paper" else ("ray", "geometric")
    found: str = checks.choice(distance or usual, f"distance with rule={rule!r}", able)
    if found == "ray" and camera is None:
        raise ValueError("camera must be given with distance='ray', got None")
    return found


class Fits:
    """Shapes of sets of points of one cloud, which may overlap; none of them is searched twice.

    Args:
        points: Points (N, 3) in metres.
        noise_distance, kinds, up, camera, distance, rule, weights: As in `fit_shape`.
        capacity: Points that a set is fitted to at most; 0 to choose by the first sets. Larger sets are fitted to a fair sample,
            and all their points judged.
        correlated: Whether the points are pixels, of which neighbors err alike.
    """

    def __init__(
        self,
        points: Float[ArrayLike, "N 3"],
        *,
        noise_distance: Literal["auto"] | ArrayLike = "auto",
        kinds: Sequence[str] = KINDS,
        up: ArrayLike = (0.0, 1.0, 0.0),
        camera: ArrayLike | None = None,
        distance: Literal["ray", "geometric", "algebraic"] | None = None,
        rule: Literal["likelihood", "gric", "paper"] = "likelihood",
        weights: ArrayLike | None = None,
        capacity: int = 0,
        correlated: bool = False,
    ) -> None:
        self.points = checks.places(points)
        count = len(self.points)
        given = checks.noise_distance_or_auto(noise_distance, count)
        # Of each point; None where it is not given.
        self.delta = None if given is None else np.broadcast_to(np.asarray(given, float), count)
        kinds = kinds_of(kinds)
        self.up = checks.direction(up, "up")
        self.rule = checks.choice(rule, "rule", ("likelihood", "gric", "paper"))
        self.distance = distance_of(distance, rule, camera)
        eye = None if camera is None else checks.position(camera, "camera")
        weight = checks.weights(weights, count)
        self.weight = np.ones(count) if weight is None else np.asarray(weight, float)
        along_ray = self.distance == "ray" or (rule == "paper" and eye is not None)
        most = capacity and capacity_for(capacity)
        self.settings = Settings(kinds, rule == "gric", along_ray, eye, self.points.dtype, most, correlated)
        self._first: dict[bytes, Look | Status] = {}
        self._further: dict[bytes, Look] = {}

    def shapes(self, members: Sequence[np.ndarray], *, further: Sequence[bool] | None = None) -> tuple[Shape, ...]:
        """The shape of each set.

        Args:
            members: Indices of the points of each set.
            further: Which of them may be lying where they fit badly; all by default.
        """
        looks, poor = self._looks(members, further)
        if self.rule != "paper":
            return _shapes(looks, poor, [len(m) for m in members], self.settings)
        shapes = []
        for i, m in enumerate(members):
            if i in looks:
                own = None if self.delta is None else self.delta[m]
                found = np.asarray(self.points)[m], self.weight[m], own, looks[i], self.up, self.settings, self.distance
                shapes.append(_by_most_points(*found))
            else:
                arrays, told = _unknown(len(m), None, poor[i], self.settings)
                shapes.append(Shape(**arrays, **told))
        return tuple(shapes)

    def shapes_as(self, members: Sequence[np.ndarray], kinds: Sequence[str]) -> tuple[Shape, ...]:
        """The shapes of sets as other kinds, one each, from what was found of these kinds."""
        looks, poor = self._looks(members)
        again = side_by_side(lambda i: look_as(looks[i], kinds[i], self.settings), looks)
        return self._one_by_one(dict(zip(looks, again, strict=True)), poor, members, kinds)

    def shapes_about(
        self, members: Sequence[np.ndarray], kinds: Sequence[str], up: np.ndarray, leans: Sequence[float]
    ) -> tuple[Shape, ...]:
        """The shapes of sets as kinds, one each, with axes that lean from a vertical with so large a standard deviation."""
        looks, poor = self._looks(members)

        def again(i: int) -> Look:
            look, kind = looks[i], KINDS.index(kinds[i])
            look = look if look.fitted.kind == kind else look_as(look, kinds[i], self.settings)
            return look_about(look, up, leans[i], self.settings)

        found = side_by_side(again, looks)
        return self._one_by_one(dict(zip(looks, found, strict=True)), poor, members, kinds)

    def _one_by_one(
        self, looks: dict[int, Look], poor: list[Status], members: Sequence[np.ndarray], kinds: Sequence[str]
    ) -> tuple[Shape, ...]:
        shapes = _shapes(looks, poor, [len(m) for m in members], self.settings)
        # Of other kinds it is not asked.
        scores = [
            {k: s for k, s in shape.scores.items() if k == kind} for shape, kind in zip(shapes, kinds, strict=True)
        ]
        return tuple(dataclasses.replace(s, scores=own, guards=()) for s, own in zip(shapes, scores, strict=True))

    def _looks(
        self, members: Sequence[np.ndarray], further: Sequence[bool] | None = None
    ) -> tuple[dict[int, Look], list[Status]]:
        """Looks at sets that have one, and why the others have none."""
        keys = [hashlib.blake2b(m.tobytes(), digest_size=16).digest() for m in members]
        wanted = {key for i, key in enumerate(keys) if further is None or further[i]}
        if not self.settings.capacity and members:
            self.settings = self.settings._replace(capacity=capacity_for(min(max(map(len, members)), MOST)))

        def looked(key: bytes) -> tuple[Look | Status, Look | None]:
            first, more = self._first.get(key), self._further.get(key)
            if first is None:
                item = self._prepared(sets[key])
                first = unfit(item) or first_look(item, self.settings)  # type: ignore[arg-type]
            if isinstance(first, Look) and key in wanted and more is None:
                more = further_look(first, self.settings)
            return first, more

        sets = dict(zip(keys, members, strict=True))
        for key, (first, more) in zip(sets, side_by_side(looked, sets), strict=True):
            self._first[key] = first
            if more is not None:
                self._further[key] = more
        found = [self._further.get(key, self._first[key]) for key in keys]
        looks = {i: look for i, look in enumerate(found) if isinstance(look, Look)}
        return looks, [Status(0) if isinstance(why, Look) else why for why in found]

    def _prepared(self, own: np.ndarray) -> Prepared | None:
        if not len(own):
            return None
        points = np.asarray(self.points).take(own, axis=0).astype(float)
        deviation = None if self.delta is None else self.delta[own] / DEVIATIONS
        return prepared(points, self.weight[own], deviation, self.up, self.settings.camera, self.settings.along_ray)


def with_quadrics(
    points: np.ndarray, members: Sequence[np.ndarray], shapes: Sequence[Shape], weights: ArrayLike | None = None
) -> tuple[Shape, ...]:
    """Names "quadric" what is refused as every kind but lies on a general quadric; its status stays REFUSED.

    What is refused since things are seen through it or since it goes on lies on some surface, and is none all the same.

    Args:
        points: Points (N, 3) in metres.
        members: Indices of the points of each shape.
        shapes: The shapes.
        weights: Weight of each point (N,).
    """
    weight = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    told = []
    for own, shape in zip(members, shapes, strict=True):
        found = None
        if shape.primitive is None and int(shape.status) & NO_QUADRIC == Status.REFUSED:
            found = quadric_of(np.asarray(points[own], float), weight[own], float(shape.noise_distance))
        if found is not None:
            quadric = jax.tree.map(lambda a: a.astype(points.dtype), found[0])
            shape = dataclasses.replace(shape, kind="quadric", primitive=quadric, inliers=on_host(found[1]))
        told.append(shape)
    return tuple(told)


def _by_most_points(
    points: np.ndarray,
    weight: np.ndarray,
    delta: np.ndarray | None,
    look: Look,
    up: np.ndarray,
    settings: Settings,
    distance: str,
) -> Shape:
    """The paper's answer for one object, beside the scores of ours."""
    if delta is None:
        delta = np.full(len(points), DEVIATIONS * look.expected * look.item.frame.unit)
    found = most_points(points, weight, delta, up, settings.kinds, distance == "geometric")
    scores, margin, guards = _told(look.fitted, settings.kinds)
    ours = "unknown" if look.reason else KINDS[look.fitted.kind]
    status = found.status | (Status.PAPER_DISAGREES if found.kind != ours else Status(0))
    if found.kind == "plane":
        status |= Status.MAY_BE_BOX
    return Shape(
        primitive=found.primitive,
        inliers=on_host(found.inliers),
        noise_distance=on_host(np.median(delta), settings.dtype),
        scores=scores,
        margin=margin,
        counts=found.counts,
        covariance=on_host(np.zeros((0, 0)), settings.dtype),
        status=on_host(status, np.int32),
        kind=found.kind,
        guards=guards,
    )


def _shapes(looks: dict[int, Look], poor: list[Status], sizes: list[int], settings: Settings) -> tuple[Shape, ...]:
    """Shapes of all objects."""
    made, shapes = bounded(looks, settings), []
    for i, size in enumerate(sizes):
        if i in made:
            own, told = _named(looks[i], made[i], settings)
        else:
            own, told = _unknown(size, looks.get(i), Status(poor[i] or looks[i].reason), settings)
        shapes.append(Shape(**own, **told))
    return tuple(shapes)


def _named(look: Look, made: Bounded, settings: Settings) -> tuple[dict[str, Any], dict[str, Any]]:
    """The fields of a shape that has a name: those that are arrays, and the rest."""
    item, fitted = look.item, look.fitted
    kind = KINDS[fitted.kind]
    inliers = np.zeros(len(item.points), bool)
    inliers[item.order] = made.on
    scores, margin, guards = _told(fitted, settings.kinds)
    status = look.scattered | (Status.MAY_BE_BOX if kind == "plane" else Status(0))
    if margin < NARROW:
        status |= Status.LOW_MARGIN
    if fitted.polished.moved > TOLERANCES[np.dtype(settings.dtype)]:
        status |= Status.NOT_CONVERGED
    scale = 1.0 if item.given else float(fitted.polished.scale)
    deviation = item.typical * fitted.deviation * item.frame.unit * scale
    arrays = {
        "primitive": made.primitive,
        "inliers": inliers,
        "noise_distance": np.asarray(DEVIATIONS * deviation, settings.dtype),
        "covariance": made.covariance,
        "status": np.asarray(status, np.int32),
    }
    return arrays, {"kind": kind, "scores": scores, "margin": margin, "counts": {}, "guards": guards}


def _told(fitted: Fitted, kinds: tuple[str, ...]) -> tuple[dict[str, float], float, tuple[str, ...]]:
    """Scores, margin, and the guards that spoke."""
    scores = {k: float(s) for k, s in zip(KINDS, fitted.scores, strict=True) if k in kinds}
    passed = {k for k, good in zip(KINDS, fitted.passed, strict=True) if good}
    rivals = [score for k, score in scores.items() if k in passed and k != KINDS[fitted.kind]]
    margin = min(rivals) - scores[KINDS[fitted.kind]] if rivals else float("inf")
    return scores, margin, tuple(f"{k}: {GUARDS[k]}" for k in scores if k not in passed)


def _unknown(size: int, look: Look | None, status: Status, settings: Settings) -> tuple[dict[str, Any], dict[str, Any]]:
    """The same of one that has none."""
    scores, margin, guards = ({}, 0.0, ()) if look is None else _told(look.fitted, settings.kinds)
    used = 0.0
    if look is not None:
        deviation = look.item.typical if look.item.given else look.expected
        used = DEVIATIONS * deviation * float(look.item.frame.unit)
    arrays = {
        "primitive": None,
        "inliers": np.zeros(size, bool),
        "noise_distance": np.asarray(used, settings.dtype),
        "covariance": np.zeros((0, 0), settings.dtype),
        "status": np.asarray(status, np.int32),
    }
    return arrays, {"kind": "unknown", "scores": scores, "margin": margin, "counts": {}, "guards": guards}
