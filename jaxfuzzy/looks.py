"""Looks at objects: the first, further ones where the noise or the vertical was not what was thought, and the refusal.

What fits no kind shows in the noise of its best surface: that of a wrong one is larger than small windows of the points, which know
nothing of kinds, say it is.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxfuzzy import fitting
from jaxfuzzy.choice import FLATTEST, FLATTEST_BALL, SLOPES
from jaxfuzzy.fitting import Fitted
from jaxfuzzy.linalg import TO_STD
from jaxfuzzy.objects import DEVIATIONS, PIXELS_PER_POINT, Prepared, about, padded, prepared, with_more
from jaxfuzzy.polish import Polished
from jaxfuzzy.primitives import KINDS
from jaxfuzzy.search import MORE
from jaxfuzzy.status import Status

FEWEST = 12
# Noise of a surface over that of small windows from which on it is refused; and from which on it is where many points lie
# just off it, between one and 2.4 noise distances, and the noise is more than real boxes and tins bulge and dent, as a share
# of the object's spread. Measured: right ones stay below 1.25 on simulated clouds of 0.5 to 3 mm noise, a wavy carton has 1.81.
MISFIT, SUSPECT, NEAR, BULGE = 1.9, 1.35, 0.06, 0.055
# And over that of small windows from which on it may be lying, though the noise that was given hides it. On rendered tables right
# surfaces have up to 1.45, boxes fitted to lying cylinders 2.5 and more.
UNEVEN = 1.8
# And where it leaves so large a share of the points to the background, and so many of the normals of small pieces, which outliers
# have none of, are more than so many radians from any of its own. A group of pixels holds pieces of other things as well.
MUCH_LEFT, ODD, SAME = 0.1, 0.1, 0.35
# The same where the noise was given: real tins, cups and boxes stay below 1.7, a carved mask has 1.86.
MISFIT_GIVEN = 1.75
# A surface is refused too where its noise is so many times what was given, or more, and so many times what small windows say: the
# noise given is then too large for this object, and hides slow waves. Small windows of stereo take part of its noise, which
# neighbors share, for surface: right ones above the first have up to 1.9 of the last on photographs, rendered and depth-camera
# tables (a bowl of which every third row is looked at 2.1), on simulated clouds 1.1; a plaster bust has 2.3 to 3.4 by five
# matchers, bowling pins 3.3 to 5.1, boxes fitted to round things 2.9 to 4.8. Flat things may be bent a little (the second).
ABOVE, ABOVE_FLAT, WAVY = 0.8, 1.15, 2.2
# A surface of pixels is refused where the mean residuals of patches, of as many pixels as tell as much as one independent
# point, are so many deviations (in the median; flat things may be bent a little), though small windows scatter no more than
# they should: the surface bends in other ways than its kind does. On photographs right ones have up to 0.71, a carved mask
# 1.5, a bust 1.4, pins 1.9. Patches of fewer points are none, and fewer patches say nothing. Depth cameras are so exact that
# real boxes bulge by more.
WAVES, WAVES_FLAT, FEWEST_IN_PATCH, FEWEST_PATCHES = 1.1, 1.6, 16, 9
# Just off a surface: up to so many deviations.
FAR = 6.0
# Share of points between one and 2.4 given noise distances of the surface, less what uniform outliers explain, from which on it is
# refused. On simulated clouds with up to 70 % outliers right surfaces stay below 0.18, and below 0.25 with half the true noise
# distance; of wrong ones for what is no primitive 92 to 100 % are above.
BEYOND = 0.25
# Scatter within small windows over the deviation given from which on that is said to be too small.
SCATTERED = 2.0
# Noise over spread of the points from which on there is no surface to speak of.
HOPELESS = 0.35
# Least share of an object's points that must lie on its surface.
LEAST_SHARE = 0.1
# Noise found over noise first thought from which on, and below which, the search is repeated with what was found.
UNDERRATED, OVERRATED, MOST_LOOKS = 1.3, 0.5, 4
# Sine of the angle from which on two normals tell an axis, and of the error of a normal; and the share that must agree on one: of
# lying cylinders in photographs 0.75 and more, of blobs among outliers 0.54 and less.
APART, SLANT, AGREE = 0.3, 0.1, 0.65
ROUND = ("cylinder", "cone", "sphere")
# Of a cylinder or cone so many degrees around its axis are to be seen, between these quantiles of its points: a wide one holds two
# flat things at an angle, or one that is bent. Of half hidden cylinders on rendered tables 63 and more are seen, on photographs 90,
# and pieces of planes in rooms and streets lay on 19 to 55.
LEAST_ARC, ARC_ENDS = 60.0, np.array([0.02, 0.98])
# Second principal spread over first below which points are one line; third over first, one plane to the last digit.
LINE, SHEET = 1e-4, 1e-7
# One more than there are processors, as Python prepares the next.
AT_A_TIME = (os.cpu_count() or 1) + 1

T = TypeVar("T")
R = TypeVar("R")


class Settings(NamedTuple):
    """What is the same for all objects of a call.

    Attributes:
        kinds: Kinds to choose from.
        gric: Whether to score by GRIC.
        along_ray: Whether residuals are along the viewing ray.
        camera: Where the points were seen from.
        dtype: Their type.
        capacity: Points that an object is fitted to at most.
        correlated: Whether the points are pixels, of which neighbors err alike.
    """

    kinds: tuple[str, ...]
    gric: bool
    along_ray: bool
    camera: np.ndarray | None
    dtype: Any
    capacity: int
    correlated: bool = False


class Look(NamedTuple):
    """One object and the surface found.

    Attributes:
        item: The object in the frame it was searched in.
        fitted: What was found.
        expected: Noise of its points by what was given or by small windows, in its unit.
        reason: Why it is refused; 0 where it is not.
        rivals: Looks about other verticals that found better candidates of some kinds, by the indices of these.
    """

    item: Prepared
    fitted: Fitted
    expected: float
    reason: Status
    rivals: Mapping[int, "Look"] = MappingProxyType({})

    @property
    def fitted_to(self) -> int:
        """How many of its points it was fitted to."""
        return min(len(self.item.points), len(self.fitted.polished.square))

    @property
    def noise(self) -> float:
        """Noise of the surface found, in the object's unit."""
        return float(self.fitted.polished.scale * self.fitted.deviation * self.item.typical)

    @property
    def misfit(self) -> float:
        """Noise of the surface over what is expected of a right one."""
        return self.noise / self.expected

    @property
    def scattered(self) -> Status:
        """Whether even small windows say that the given deviation is too small."""
        return Status.SCATTERED if self.item.given and self.fitted.local > SCATTERED else Status(0)

    @property
    def unit_of_score(self) -> float:
        """What is taken from scores to make them independent of what deviation they were searched with."""
        n = min(self.fitted_to, MORE)
        return float(self.item.weight[:n] @ np.log(self.item.gain[:n] / self.fitted.deviation))

    @property
    def score(self) -> float:
        """Score of the surface, made independent of what deviation it was searched with."""
        return float(self.fitted.scores[self.fitted.kind]) - self.unit_of_score


def unfit(item: Prepared | None) -> Status:
    """Why an object cannot be searched at all; 0 where it can."""
    if item is None or (item.weight > 0).sum() < FEWEST:
        return Status.TOO_FEW_POINTS
    if item.frame.unit == 0 or item.flatness[0] < LINE or (item.flatness[1] < SHEET and not item.given):
        return Status.DEGENERATE
    return Status(0)


def first_look(item: Prepared, settings: Settings) -> Look:
    """Searches an object, again where the noise was not what was thought."""
    look = _search(item, settings)
    expected = look.expected
    # A wrong first guess of the noise blurs the search or blinds it: look again with what was found.
    for _ in range(MOST_LOOKS - 1):
        scale = look.fitted.polished.scale
        if item.given or OVERRATED <= scale <= UNDERRATED:
            break
        sharper = _search(_with_noise_found(look), settings, expected)
        if scale >= OVERRATED and sharper.score >= look.score:
            break
        look = sharper
    return look


def further_look(look: Look, settings: Settings) -> Look:
    """Searches what a box or a cone fits badly once more, as it may be lying."""
    best = look
    for item in _turned(look, settings) if _doubtful(look, settings.correlated) else ():
        new = _search(item, settings, look.expected)
        # Another vertical is one more freedom: what it finds must fit well.
        if not new.reason and new.misfit <= SUSPECT and (best.reason or new.score < best.score):
            whole = _judged(_knowing(new, best)._replace(item=_whole(new.item, look, settings)), settings)
            best = best if whole.reason else whole
    return best


def _doubtful(look: Look, correlated: bool) -> bool:
    """Whether another vertical may fit better: the surface is refused, leaves much over, or its noise is not that of the points."""
    polished = look.fitted.polished
    # A flat thing may be bent a little, and a ball has no axis.
    turns = KINDS[look.fitted.kind] not in ("plane", "sphere")
    uneven = turns and polished.scale > UNEVEN * look.fitted.local
    left = not correlated and polished.background > MUCH_LEFT and _odd_normals(look) > ODD
    return bool(look.reason or look.misfit > SUSPECT or uneven or left)


def _odd_normals(look: Look) -> float:
    """The share of the normals of small pieces of surface that none of the surface found has."""
    theta, kind = look.fitted.polished.theta, KINDS[look.fitted.kind]
    normals = np.asarray(look.fitted.found.normals)
    normals = normals[normals.any(axis=1)] @ look.fitted.polished.turn.T
    if not len(normals) or kind == "sphere":
        return 0.0
    if kind == "plane":
        has = np.abs(normals @ theta[:3]) / np.linalg.norm(theta[:3])
    elif kind == "box":
        c, s = np.cos(theta[0]), np.sin(theta[0])
        has = np.abs(normals @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])).max(axis=1)
    else:
        # Of a side, or of a lid.
        lean = np.arctan(theta[3])
        has = np.maximum(np.cos(np.arcsin(np.clip(normals[:, 1], -1, 1)) - lean), np.abs(normals[:, 1]))
        has = np.maximum(has, np.cos(np.arcsin(np.clip(-normals[:, 1], -1, 1)) - lean))
    return float((has < np.cos(SAME)).mean())


def look_as(look: Look, kind: str, settings: Settings) -> Look:
    """The same object as another kind, from the best candidate of it that was found."""
    index = KINDS.index(kind)
    source = look.rivals.get(index, look)
    found, small = source.fitted.found, padded(source.item, settings.capacity, settings.dtype)
    polished = fitting.finished(small, found, index, settings.along_ray)
    return _judged(source._replace(fitted=look.fitted._replace(kind=index, found=found, polished=polished)), settings)


def look_about(look: Look, up: np.ndarray, lean: float, settings: Settings) -> Look:
    """The same surface fitted once more in the frame of another vertical, from which its axis may lean by so many radians."""
    item, step = about(look.item, up, settings.camera)
    item, fitted = item._replace(lean=lean), look.fitted
    candidate = jax.tree.map(lambda a: a[fitted.kind], fitted.found.candidates)._replace(theta=fitted.polished.theta)
    polished = fitted.polished
    start = fitting.Start(candidate, polished.turn @ step.T, polished.scale, polished.background)
    small = padded(item, settings.capacity, settings.dtype)
    again = fitting.polished_from(small, start, fitted.kind, fitted.deviation, settings.along_ray)
    return _judged(look._replace(item=item, fitted=fitted._replace(polished=again)), settings)


def _judged(look: Look, settings: Settings) -> Look:
    return look._replace(reason=_reason(look, settings.correlated))


@contextmanager
def compiling_ahead(capacity: int, dtype: Any, along_ray: bool) -> Iterator[None]:
    """Compiles the search beside what the block does.

    Args:
        capacity: Points that an object will be fitted to at most.
        dtype: Their type.
        along_ray: Whether residuals will be along the viewing ray.
    """
    pool = threads(AT_A_TIME)
    # What fails here fails again, aloud, in the search itself.
    ahead = [pool.submit(part, padded(None, capacity, dtype), along_ray) for part in fitting.PARTS]
    yield
    wait(ahead)


def threads(count: int) -> ThreadPoolExecutor:
    """Threads that compute in the precision this one does: `with jax.enable_x64()` holds for the thread that says so alone."""
    return _threads(count, jax.dtypes.canonicalize_dtype(np.float64) == np.float64)


@cache
def _threads(count: int, double: bool) -> ThreadPoolExecutor:
    def enter() -> None:
        jax.enable_x64(double).__enter__()  # for as long as the thread lives

    return ThreadPoolExecutor(count, initializer=enter)


def side_by_side(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """What compiled work makes of each item, some at a time; NumPy's own would only take turns."""
    return list(threads(AT_A_TIME).map(work, items))


def _search(item: Prepared, settings: Settings, expected: float = 0.0) -> Look:
    """The best surface of one object; `expected` is the noise of its points in its unit, 0 where this look is to say."""
    small = padded(item, settings.capacity, settings.dtype)
    allowed = np.array([k in settings.kinds for k in KINDS])
    fitted = fitting.fit(small, allowed, settings.gric, settings.along_ray)
    noise = expected or max(1.0, fitted.local) * fitted.deviation * item.typical
    # What the last polish took out of shape is of another kind.
    while _worn(item, fitted):
        passed = fitted.passed & (np.arange(len(KINDS)) != fitted.kind)
        kind = fitting.best_kind(fitted.scores, passed)
        fitted = fitted._replace(kind=kind, passed=passed)
        if passed.any():
            fitted = fitted._replace(polished=fitting.finished(small, fitted.found, kind, settings.along_ray))
    return _judged(Look(item, fitted, noise, Status(0)), settings)


def _worn(item: Prepared, fitted: Fitted) -> bool:
    """Whether the last polish took all narrowing from a cone, or the bend from what is round, or too little of it is seen."""
    kind, theta = KINDS[fitted.kind], fitted.polished.theta
    straight = kind == "cone" and not SLOPES[0] < abs(theta[3])
    flat = kind in ROUND and not (theta[3] < FLATTEST_BALL if kind == "sphere" else theta[2] < FLATTEST)
    if not fitted.passed.any():
        return False
    return straight or flat or (kind in ("cylinder", "cone") and _arc(item, fitted.polished) < LEAST_ARC)


def _arc(item: Prepared, polished: Polished) -> float:
    """How many degrees around the axis of a body of revolution its points lie."""
    # The first points are a fair sample of all.
    n = min(len(item.points), MORE)
    reach = DEVIATIONS * max(1.0, float(polished.scale))
    # Lid and floor are seen from above all around.
    on = (polished.square[:n] <= reach**2) & (item.weight[:n] > 0) & (polished.part[:n] != 1)
    if on.sum() < FEWEST:
        return 360.0
    hits = item.points[:n] + polished.depth[:n, None] * item.rays[:n]
    x, z = (hits @ polished.turn[[0, 2]].T - polished.theta[:2])[on].T
    length = np.maximum(np.hypot(x, z), 1e-12)
    # Angles from the middle of them, so that none is cut in two.
    c, s = (x / length).sum(), (z / length).sum()
    angle = np.sort(np.arctan2(c * z - s * x, c * x + s * z))
    low, high = (ARC_ENDS * (len(angle) - 1)).round().astype(int)
    return float(np.degrees(angle[high] - angle[low]))


def _reason(look: Look, correlated: bool) -> Status:
    """Why the best surface is refused; 0 where it is not."""
    item, p = look.item, look.fitted.polished
    if not look.fitted.passed.any() or not np.isfinite(p.theta).all() or _worn(item, look.fitted):
        return Status.REFUSED
    weight = item.weight[: look.fitted_to]
    distance = np.sqrt(p.square[: look.fitted_to]) / max(1.0, p.scale)
    on = weight @ (distance <= DEVIATIONS)
    if look.noise > HOPELESS or on < max(FEWEST / 2, LEAST_SHARE * weight.sum()):
        return Status.ALL_NOISE | Status.REFUSED
    times = float(p.scale) / max(1.0, float(look.fitted.local))
    least = ABOVE_FLAT if KINDS[look.fitted.kind] == "plane" else ABOVE
    wavy = p.scale > max(least, WAVY * float(look.fitted.local))
    if item.given and (times > MISFIT_GIVEN or wavy or _beyond(look) > BEYOND or (correlated and _waves(look) > 1)):
        return Status.REFUSED | look.scattered
    near = weight @ ((distance > DEVIATIONS) & (distance < FAR)) / (weight @ (distance < FAR))
    suspect = look.misfit > SUSPECT and near > NEAR and look.noise > BULGE
    return Status.REFUSED | look.scattered if look.misfit > MISFIT or suspect else Status(0)


def _waves(look: Look) -> float:
    """How far patches of the points lie off a surface as wholes, over what a right one allows; 0 where too few can tell."""
    item, p, n = look.item, look.fitted.polished, look.fitted_to
    side = int(np.sqrt(min(len(item.points) // PIXELS_PER_POINT, n // FEWEST_IN_PATCH)))
    residual = np.sqrt(p.square[:n]) * np.sign(p.depth[:n])
    near = np.flatnonzero((np.abs(residual) < FAR) & (item.weight[:n] > 0))
    if side**2 < FEWEST_PATCHES or len(near) < FEWEST_IN_PATCH * side**2 / 2 or not item.rays.any():
        return 0.0
    # Columns of the view that hold as many points each, and as many pieces of each column.
    across, down, ahead = item.rays[near].T
    column = np.empty(len(near), int)
    column[np.argsort(across / ahead)] = np.arange(len(near)) * side // len(near)
    patch = np.arange(len(near)) * side**2 // len(near)
    mean = np.bincount(patch, residual[near[np.lexsort((down / ahead, column))]]) / np.bincount(patch)
    most = WAVES_FLAT if KINDS[look.fitted.kind] == "plane" else WAVES
    return float(TO_STD * np.median(np.abs(mean)) / most / max(1.0, look.fitted.local / SCATTERED))


def _beyond(look: Look) -> float:
    """Share of the points near a surface that lie just off it, in given noise distances, less that of uniform outliers."""
    item, p = look.item, look.fitted.polished
    weight, distance = item.weight[: look.fitted_to], np.sqrt(p.square[: look.fitted_to])
    on = weight @ (distance <= DEVIATIONS)
    near = weight @ ((distance > DEVIATIONS) & (distance < FAR))
    stray = p.background * weight.sum() * 2 * (FAR - DEVIATIONS) * item.typical / item.depth_range
    return float((near - stray) / max(near + on, 1e-12))


def _with_noise_found(look: Look) -> Prepared:
    item, found = look.item, look.fitted
    times = float(found.deviation * found.polished.scale)
    return item._replace(gain=item.gain / times, typical=item.typical * times, given=True)


def _turned(look: Look, settings: Settings) -> list[Prepared]:
    """The points searched with other verticals: the axis that most normals tell, and the direction along which most are."""
    item, normals, n = look.item, np.asarray(look.fitted.found.normals), look.fitted_to
    axes = np.stack([_axis_of_most(normals), np.linalg.eigh(normals.T @ normals)[1][:, 2]]) @ item.frame.turn
    p, deviation = _in_metres(look, slice(n))
    found = []
    for axis in axes:
        if abs(axis @ item.frame.turn[1]) < 0.95:
            new = prepared(p, item.weight[:n], deviation, axis, settings.camera, settings.along_ray)
            found.append(new._replace(order=item.order[:n][new.order], given=True))
    return found


def _axis_of_most(normals: np.ndarray) -> np.ndarray:
    """The axis that most normals (W, 3) are square to, those of a side, or along, those of an end; normals of edges do no harm.

    It is sought among the normals and what is square to two of them. Where fewer than a share agree, as in a heap of outliers, it
    is the one that all are square to in the mean.
    """
    mean = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    one, other = np.triu_indices(len(normals), 1)
    across = np.cross(normals[one], normals[other])
    length = np.linalg.norm(across, axis=1)
    usable = normals[normals.any(axis=1)]
    # Two that are nearly the same say nothing, and unusable ones are zero.
    across = across[length > APART] / length[length > APART, None]
    if not len(across):
        return mean
    axes = np.concatenate([across, usable])
    off = _off_axis(usable, axes)
    best = axes[np.argmin((off / (1 + off)).sum(axis=0))]
    along = usable @ best
    off = _off_axis(usable, best[:, None].T)[:, 0]
    if (off < 1).mean() < AGREE:
        return mean
    weight = np.where(np.abs(along) < np.sqrt(0.5), 1.0, -1.0) / (1 + off) ** 2
    return np.linalg.eigh((usable * weight[:, None]).T @ usable)[1][:, 0]


def _off_axis(normals: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """How far normals (W, 3) are from square to axes (A, 3) or along them, the smaller one squared, in units of their error."""
    square = (normals @ axes.T) ** 2
    return np.minimum(square, np.maximum(1 - square, 0)) / SLANT**2


def _knowing(new: Look, other: Look) -> Look:
    """A look that knows what another one found: of the kinds that it did not take, the better score of the two."""
    theirs = np.asarray(other.fitted.scores) - other.unit_of_score + new.unit_of_score
    better = (theirs < new.fitted.scores) & (np.arange(len(KINDS)) != new.fitted.kind)
    pick: Any = lambda of, own: np.where(better, of, own)
    scores, passed = pick(theirs, new.fitted.scores), pick(other.fitted.passed, new.fitted.passed)
    # What that one knew from others is theirs.
    rivals = {int(i): other.rivals.get(int(i), other) for i in np.flatnonzero(better)}
    return new._replace(fitted=new.fitted._replace(scores=scores, passed=passed), rivals=rivals)


def _whole(new: Prepared, look: Look, settings: Settings) -> Prepared:
    """An object turned, with all the points that were not searched."""
    item, more = look.item, slice(look.fitted_to, None)
    p, deviation = _in_metres(look, more)
    return with_more(new, p, item.weight[more], deviation, item.order[more], settings.along_ray)


def _in_metres(look: Look, of: slice) -> tuple[np.ndarray, np.ndarray]:
    """Points in the user's frame and their deviations."""
    frame = look.item.frame
    p = frame.origin + frame.unit * look.item.points[of] @ frame.turn
    return p, frame.unit / look.item.gain[of] * look.fitted.deviation
