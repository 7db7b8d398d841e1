"""What is left of the evidence for a shape when neighboring pixels err alike.

A matcher smooths, so that hundreds of neighboring pixels tell as much as one independent point. Likelihoods and covariances of
shapes count every point as independent; here both are brought down to the number of independent ones, and what was named on next
to no evidence is not named.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxfuzzy.choice import PLANE_BONUS
from jaxfuzzy.search import KINDS
from jaxfuzzy.shapes import Shape, refused
from jaxfuzzy.status import Status

# Neighboring pixels that together tell as much of a size as one independent point: 84 to 335, 190 on average, against the
# ground truth of thirteen real pairs (`measure_noise`).
PIXELS_PER_POINT = 190
# As many independent points as the largest number of parameters of a kind.
FEWEST = 6
# In nats of independent points: below, another family is as likely, and the next kind of the same family.
TELLS, NARROW = 0.2, 1.0
# Of its points a surface holds this share at least: on photographs right ones hold 0.53 and more, a cone within a plant 0.2.
HOLDS = 0.3
# A plane is a face of a box, a cylinder a cone that does not narrow.
FAMILIES = {"plane": "flat", "box": "flat", "cylinder": "turned", "cone": "turned", "sphere": "sphere"}


def with_correlated_errors(shapes: Sequence[Shape], fitted_to: int) -> tuple[Shape, ...]:
    """Shapes with the covariance, scores and margin that independent points leave; "unknown" where these do not tell.

    Args:
        shapes: Shapes of points that are pixels.
        fitted_to: Points of each that its scores and its covariance were counted from at most.
    """
    return tuple(_with_correlated_errors(shape, fitted_to) for shape in shapes)


def _with_correlated_errors(shape: Shape, fitted_to: int) -> Shape:
    count = max(len(shape.inliers), 1)
    worth = max(1.0, PIXELS_PER_POINT * min(count, fitted_to) / count)
    status = int(shape.status) & ~Status.LOW_MARGIN
    if shape.kind in KINDS and shape.margin / worth < NARROW:
        status |= Status.LOW_MARGIN
    shape = dataclasses.replace(
        shape,
        scores={kind: score / worth for kind, score in shape.scores.items()},
        margin=shape.margin / worth,
        covariance=jnp.asarray(np.asarray(shape.covariance) * worth, shape.covariance.dtype),
        status=jnp.asarray(status, jnp.int32),
    )
    if shape.kind not in KINDS:
        return shape
    if count < FEWEST * PIXELS_PER_POINT:
        return refused(shape, Status.TOO_FEW_POINTS, "too few pixels for the errors that they share")
    if np.asarray(shape.inliers).mean() < HOLDS:
        return refused(shape, Status(0), "it holds too few of the object's points")
    return refused(shape, Status.LOW_MARGIN, "another kind is as likely") if _lead(shape, worth) < TELLS else shape


def _lead(shape: Shape, worth: float) -> float:
    """Nats by which a kind leads the best one of another family that no guard spoke against, without the bonus of planes."""
    spoken = {guard.split(":")[0] for guard in shape.guards}
    scores = {k: s + PLANE_BONUS / worth * (k == "plane") for k, s in shape.scores.items() if k not in spoken}
    others = [s for k, s in scores.items() if FAMILIES[k] != FAMILIES[shape.kind]]
    return min(others) - scores[shape.kind] if others and shape.kind in scores else float("inf")
