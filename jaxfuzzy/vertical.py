"""The vertical that upright objects and their supporting plane agree on, and the objects fitted once more about it.

Every object has a lean of its own, which a side seen over a small angle leaves vague, and its error goes over into sizes: into the
half-angle of a cone by 0.8 degrees a degree. Objects on one table mostly stand alike. The vertical v is therefore found from the
axes a of all well-fitted objects together, as one fuzzy cluster beside noise (what lies, or leans for good, is noise), with the
supporting plane's normal as one more witness. a = v + lean + error: errors are as large as the fits say, and leans
have a common deviation, found by expectation-maximisation (a random-effects model; Laird and Ware, Biometrics 38, 1982). Each
object that stands is then fitted again about v with that deviation as its prior: what is vague takes after the others, what is
sure stays.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxfuzzy.arrays import on_host
from jaxfuzzy.ground import Ground
from jaxfuzzy.linalg import tangents
from jaxfuzzy.objects import PIXELS_PER_POINT
from jaxfuzzy.planes import deviation_across, noise_of
from jaxfuzzy.primitives import Box, Cone, Cylinder
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

# Radians. Noise distance of axes about the vertical.
NOISE_DISTANCE = np.deg2rad(5.0)
# Error of a supporting plane beyond its noise: the board of the cones, matched at two sizes, is 0.2 and 0.4 degrees off its truth.
# And the errors of a vertical that no plane told: of the camera's own, and of one that was given, which is kept.
PLANE_ERROR, GUESS_ERROR, GIVEN_ERROR = np.deg2rad(0.3), np.deg2rad(10.0), 1e-9
# Paper cones and tins stand no straighter.
LEAST_LEAN = np.deg2rad(0.25)
# Cosine of the angle from which on an axis is no upright one's.
MOST_LEANING = 0.5
FEWEST_OBJECTS = 3
# Of a well-fitted object's points, on its surface.
LEAST_SHARE = 0.8
STEPS = 100
DOUBTFUL = Status.REFUSED | Status.LOW_MARGIN | Status.NOT_CONVERGED | Status.SCATTERED | Status.PIECE


class Witness(NamedTuple):
    """What was known of the vertical before any object was.

    Attributes:
        up: The direction (3,).
        error: Covariance (2, 2) of its two angles, along `linalg.tangents` of it.
        doubtful: Whether it may be noise itself, as a slab through clutter or a guess is.
    """

    up: np.ndarray
    error: np.ndarray
    doubtful: bool


class Vertical(NamedTuple):
    """What objects and ground agree on.

    Attributes:
        up: The vertical, a unit vector that points up (3,).
        std: Its standard deviation in radians, the larger of two directions.
        lean: Standard deviation of the objects' own leans about it, in radians, in each of two directions.
        upright: Which objects stand upright.
    """

    up: np.ndarray
    std: float
    lean: float
    upright: list[int]


def agreed_vertical(shapes: Sequence[Shape], ground: Witness) -> Vertical | None:
    """The vertical from all well-fitted objects and the supporting plane together; None where fewer than three objects agree.

    Args:
        shapes: The objects, their covariances those of independent points.
        ground: The supporting plane, or what stands in for it.
    """
    up, across = ground.up, _tangents(ground.up)
    told = {i: _lean_of(shape, up, across) for i, shape in enumerate(shapes) if _well_fitted(shape)}
    told = {i: found for i, found in told.items() if found is not None}
    if len(told) < FEWEST_OBJECTS:
        return None
    leans, errors = (np.stack(a) for a in zip(*told.values(), strict=True))
    precision = np.linalg.inv(ground.error)

    def membership(v: np.ndarray) -> np.ndarray:
        return 1 / (1 + ((leans - v) ** 2).sum(1) / NOISE_DISTANCE**2)

    def of_ground(v: np.ndarray) -> np.ndarray:
        return precision / (1 + v @ v / NOISE_DISTANCE**2) ** (2 if ground.doubtful else 0)

    # From the plane's own normal, or where that is doubtful from the place that most agree on.
    places = np.concatenate([np.zeros((1, 2)), leans if ground.doubtful else leans[:0]])
    v = places[np.argmax([(membership(p) ** 2).sum() + 1 / (1 + p @ p / NOISE_DISTANCE**2) ** 2 for p in places])]
    variance = NOISE_DISTANCE**2 / 4
    for _ in range(STEPS):
        weight = membership(v) ** 2
        each = weight[:, None, None] * np.linalg.inv(errors + variance * np.eye(2))
        total = np.linalg.inv(each.sum(0) + of_ground(v))
        v = total @ np.einsum("kij,kj->i", each, leans)
        # What is left of each lean, and how sure that is.
        rest = np.linalg.inv(np.linalg.inv(errors) + np.eye(2) / variance)
        own = np.einsum("kij,kjl,kl->ki", rest, np.linalg.inv(errors), leans - v)
        spread = (own**2).sum(1) + np.einsum("kii->k", rest)
        variance = max(float(weight @ spread / (2 * weight.sum())), LEAST_LEAN**2)
    upright = [i for i, u in zip(told, membership(v), strict=True) if u > 0.5]
    if len(upright) < FEWEST_OBJECTS:
        return None
    new = up + v @ across
    return Vertical(
        new / np.linalg.norm(new), float(np.sqrt(np.linalg.eigvalsh(total)[-1])), float(np.sqrt(variance)), upright
    )


def witness_of(
    points: np.ndarray,
    ground: Ground | None,
    up: np.ndarray,
    *,
    given: bool,
    camera: np.ndarray | None,
    correlated: bool,
) -> Witness:
    """A supporting plane's normal, its error told by the points on it; or what stands in for one.

    Args:
        points: All points (N, 3).
        ground: The plane, if one was looked for, and which points lie on it.
        up: What stands in for its normal (3,).
        given: Whether that was given; else it is the camera's own.
        camera: Where the points were seen from.
        correlated: Whether neighboring points err alike.
    """
    if ground is None or ground.plane is None or ground.depth_std is None:
        return Witness(up, (GIVEN_ERROR if given else GUESS_ERROR) ** 2 * np.eye(2), not given)
    up = np.asarray(ground.plane.normal, float)
    on = np.asarray(ground.inliers)
    x, std = points[on].astype(float), np.asarray(ground.depth_std, float)[on]
    level = (x - x.mean(0)) @ _tangents(up).T / deviation_across(up, *noise_of(x, std, camera))[:, None]
    information = level.T @ level / (PIXELS_PER_POINT if correlated else 1)
    error = np.linalg.inv(information + np.eye(2) / GUESS_ERROR**2) + PLANE_ERROR**2 * np.eye(2)
    return Witness(up, error, bool(int(ground.status) & Status.GROUND_SLAB))


def upright_again(
    shapes: Sequence[Shape], vertical: Vertical, fit: Callable[[Sequence[int], float], Sequence[Shape]]
) -> tuple[Shape, ...]:
    """The upright objects fitted once more about the vertical, as what they were named; scores stay those of the choice.

    Args:
        shapes: All objects.
        vertical: What they agree on.
        fit: Fits some of them as the kinds that they are, with the deviation of their leans.
    """
    new, own = list(shapes), vertical.upright
    for i, found in zip(own, fit(own, float(np.hypot(vertical.lean, vertical.std))), strict=True):
        # What cannot stand as upright as the others stays as it is.
        if found.kind == shapes[i].kind and np.asarray(found.inliers).mean() >= LEAST_SHARE:
            status = int(shapes[i].status) | int(found.status) & Status.NOT_CONVERGED
            new[i] = dataclasses.replace(
                shapes[i],
                primitive=found.primitive,
                inliers=found.inliers,
                covariance=found.covariance,
                status=on_host(status, np.int32),
            )
    return tuple(new)


def _tangents(up: np.ndarray) -> np.ndarray:
    return np.asarray(tangents(up), float)


def _well_fitted(shape: Shape) -> bool:
    leans = isinstance(shape.primitive, (Box, Cylinder, Cone))
    return leans and not int(shape.status) & DOUBTFUL and bool(np.asarray(shape.inliers).mean() >= LEAST_SHARE)


def _lean_of(shape: Shape, up: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """How far an object's axis leans from a vertical (2,), and the covariance of that (2, 2); None where it is not known."""
    primitive, covariance = shape.primitive, np.asarray(shape.covariance, float)
    if isinstance(primitive, Box):
        axes = np.asarray(primitive.axes, float)
        axis = axes[np.argmax(np.abs(axes @ up))]
        # A small rotation w moves an axis by w x axis. The rotation vector's errors are taken for such: only weights hang on them.
        slope = np.cross(np.eye(3), axis).T
        part = slice(6, 9)
    else:
        assert isinstance(primitive, (Cylinder, Cone))
        axis = np.asarray(primitive.axis, float)
        polar, azimuth = np.arccos(np.clip(axis[2], -1, 1)), np.arctan2(axis[1], axis[0])
        down = [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)]
        round_ = [-np.sin(polar) * np.sin(azimuth), np.sin(polar) * np.cos(azimuth), 0.0]
        slope = np.array([down, round_]).T
        first = primitive.parameter_names.index("axis_polar")
        part = slice(first, first + 2)
    along = axis @ up
    error = across @ slope @ covariance[part, part] @ slope.T @ across.T
    # A fit that holds its axis altogether has no error to tell; it says nothing.
    if abs(along) < MOST_LEANING or not np.isfinite(error).all() or np.linalg.eigvalsh(error)[0] <= 0:
        return None
    # Where the axis meets the plane one above: that point moves faster than the axis turns.
    return across @ axis / along, error / along**2
