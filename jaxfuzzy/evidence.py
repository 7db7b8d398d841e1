"""What is left of the evidence for a shape when neighboring pixels err alike.

A matcher smooths, so that hundreds of neighboring pixels tell as much as one independent point. Likelihoods and covariances of
shapes count every point as independent; here both are brought down to the number of independent ones, and what was named on next
to no evidence is not named.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxfuzzy.arrays import on_host
from jaxfuzzy.choice import PLANE_BONUS
from jaxfuzzy.objects import PIXELS_PER_POINT
from jaxfuzzy.primitives import KINDS
from jaxfuzzy.search import MORE
from jaxfuzzy.shapes import FAMILIES, Shape
from jaxfuzzy.status import Status
from jaxfuzzy.trials import lies, refused

# Pixels of as many independent points as the largest number of parameters of a kind.
FEWEST_PIXELS = 6 * PIXELS_PER_POINT
# In nats of independent points: below, another family is as likely, and the next kind is nearly as good.
TELLS, NARROW = 1.0, 3.0
# Whether what is round narrows: below, it is as likely a cone as a cylinder.
TELLS_OF_ROUND = 0.25
# A body whose axis has a smaller cosine with the vertical was found about another one, and that took two parameters more.
TURNED = 0.8
# Of its points a surface holds this share at least: on photographs right ones hold 0.53 and more, a cone within a plant 0.2.
HOLDS = 0.3


def in_independent_points(shapes: Sequence[Shape], fitted_to: int) -> tuple[Shape, ...]:
    """Shapes with the covariance, scores and margin that independent points leave.

    Args:
        shapes: Shapes of points that are pixels, their scores in nats of all points that these were counted from.
        fitted_to: Points that each was fitted to at most.
    """
    return tuple(_in_independent_points(shape, fitted_to) for shape in shapes)


def told_apart(shapes: Sequence[Shape], up: np.ndarray) -> tuple[Shape, ...]:
    """Shapes whose scores and margins are those of independent points, "unknown" where these do not tell.

    Args:
        shapes: The shapes.
        up: The vertical.
    """
    return tuple(_told_apart(shape, up) for shape in shapes)


def worth(count: int, used: int) -> float:
    """How many of the points used, of so many in all, tell as much as one independent point."""
    return max(1.0, PIXELS_PER_POINT * min(count, used) / max(count, 1))


def spoken_against(shape: Shape) -> set[str]:
    """Kinds that a guard spoke against."""
    return {guard.split(":")[0] for guard in shape.guards}


def margin_of(shape: Shape, scores: Mapping[str, float]) -> float:
    """Score of the next best kind that no guard spoke against less that of the shape's own."""
    spoken = spoken_against(shape)
    rivals = [score for kind, score in scores.items() if kind != shape.kind and kind not in spoken]
    return min(rivals) - scores[shape.kind] if rivals and shape.kind in scores else float("inf")


def _in_independent_points(shape: Shape, fitted_to: int) -> Shape:
    count = len(shape.inliers)
    each, common = worth(count, MORE), worth(count, fitted_to)
    return dataclasses.replace(
        shape,
        scores={kind: score / each for kind, score in shape.scores.items()},
        margin=shape.margin / each,
        covariance=on_host(np.asarray(shape.covariance) * common, shape.covariance.dtype),
    )


def _told_apart(shape: Shape, up: np.ndarray) -> Shape:
    if shape.kind not in KINDS:
        return shape
    count = len(shape.inliers)
    status = int(shape.status) & ~Status.LOW_MARGIN | (Status.LOW_MARGIN if shape.margin < NARROW else 0)
    shape = dataclasses.replace(shape, status=on_host(status, np.int32))
    if count < FEWEST_PIXELS:
        return refused(shape, Status.TOO_FEW_POINTS, "too few pixels for the errors that they share")
    if np.asarray(shape.inliers).mean() < HOLDS:
        return refused(shape, Status(0), "it holds too few of the object's points")
    tied = shape.kind in ("cylinder", "cone") and shape.margin < TELLS_OF_ROUND
    # The direction of its axis is two parameters more, by which also a box must lead a plane, which has none.
    turned = lies(shape.primitive, up, TURNED)
    least = TELLS + (np.log(count / PIXELS_PER_POINT) if turned else 0.0)
    tied |= _lead(shape, turned) < least
    return refused(shape, Status.LOW_MARGIN, "another kind is as likely") if tied else shape


def _lead(shape: Shape, turned: bool) -> float:
    """Nats by which a kind leads the best one of another family that no guard spoke against, without the bonus of planes.

    A turned box is of another family than a plane.
    """
    bonus = PLANE_BONUS / worth(len(shape.inliers), MORE)
    scores = {k: s + bonus * (k == "plane") for k, s in shape.scores.items()}
    other = lambda k: FAMILIES[k] != FAMILIES[shape.kind] or (turned and k == "plane")
    return margin_of(shape, {k: s for k, s in scores.items() if k == shape.kind or other(k)})
