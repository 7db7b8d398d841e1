"""The choice among kinds once more, by what is seen past the outline of each.

The points of an object say little of what shape a part of a body has: two faces of a box hold the tip of a cone well. The picture
says more, since the faces would hide what stands beside the tip. What is seen through a surface are points that it must leave to
the background like its own outliers: each independent one costs minus the logarithm of the share of outliers, in nats. Rivals are
fitted only where their scores without that could win.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from jaxfuzzy.evidence import TELLS, margin_of, spoken_against
from jaxfuzzy.objects import PIXELS_PER_POINT
from jaxfuzzy.outline import Sight, seen_through
from jaxfuzzy.primitives import KINDS
from jaxfuzzy.shapes import Shape

# The shapes in some places of the list as other kinds, one each.
Again = Callable[[Sequence[int], Sequence[str]], tuple[Shape, ...]]

# A surface leaves this share of its points to the background at least.
LEAST_OUTLIERS = 0.01


def chosen_by_outline(
    points: np.ndarray, members: Sequence[np.ndarray], shapes: Sequence[Shape], sight: Sight, again: Again
) -> tuple[Shape, ...]:
    """Shapes with the cost of what is seen through them in their scores, of another kind where that is then the best.

    Args:
        points: All points (N, 3), those `sight_of` was given.
        members: Indices of the points of each shape.
        shapes: The shapes, their scores in nats of independent points.
        sight: What the camera sees.
        again: Some of them as other kinds, with scores like these.
    """
    shapes = [_with_cost(points, own, shape, sight) for own, shape in zip(members, shapes, strict=True)]
    tried = [{shape.kind} for shape in shapes]
    for _ in KINDS:
        named = ((i, _rival(shape, tried[i])) for i, shape in enumerate(shapes))
        rivals = {i: kind for i, kind in named if kind is not None}
        if not rivals:
            break
        for i, rival in zip(rivals, again(list(rivals), list(rivals.values())), strict=True):
            tried[i].add(rivals[i])
            if rival.primitive is not None:
                shapes[i] = _better(shapes[i], _with_cost(points, members[i], rival, sight))
    return tuple(shapes)


def _rival(shape: Shape, tried: set[str]) -> str | None:
    """The best kind that was not tried and could win, or be as likely."""
    if shape.kind not in shape.scores:
        return None
    most = shape.scores[shape.kind] + TELLS
    able = {k: s for k, s in shape.scores.items() if s < most and k not in tried | spoken_against(shape)}
    return min(able, key=able.__getitem__, default=None)


def _with_cost(points: np.ndarray, own: np.ndarray, shape: Shape, sight: Sight) -> Shape:
    """A shape whose own score counts what is seen through it."""
    if shape.kind not in shape.scores:
        return shape
    outliers = max(1 - float(np.asarray(shape.inliers).mean()), LEAST_OUTLIERS)
    behind = max(seen_through(points, own, shape, sight).points, 0.0)
    cost = -math.log(outliers) * behind / PIXELS_PER_POINT
    scores = shape.scores | {shape.kind: shape.scores[shape.kind] + cost}
    return dataclasses.replace(shape, scores=scores, margin=margin_of(shape, scores))


def _better(shape: Shape, rival: Shape) -> Shape:
    """The one with the better score, which knows both."""
    scores = shape.scores | rival.scores
    if rival.scores[rival.kind] >= shape.scores[shape.kind]:
        return dataclasses.replace(shape, scores=scores, margin=margin_of(shape, scores))
    rival = dataclasses.replace(rival, guards=shape.guards)
    return dataclasses.replace(rival, scores=scores, margin=margin_of(rival, scores))
