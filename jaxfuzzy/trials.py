"""What joining and dividing groups have in common: what is tried, what lies inside what, and what cannot be."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np

from jaxfuzzy.arrays import lengths, on_host
from jaxfuzzy.primitives import Box, Cone, Cylinder, Primitive, Sphere
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

K = TypeVar("K")

# Of a group that is part of a round body, this share lies inside it, or outside by so many noise distances; so does this share
# of the body's own group, of which the second share at least must lie on its surface.
INSIDE, SURFACE, SLACK = 0.7, 0.4, 2.0
# So many of its points, and less than twice as many, say whether it does.
ASKED = 2048
# What is inside has no more points than so many times the body's own: a ball may be bent through a flat thing, and hold a heap.
MOST_INSIDE = 3.0
# A part with fewer points is no object.
FEWEST = 60
# What is only tried is fitted to a fair share of its points: so many, and less than twice as many.
TRIED = 4096
# Cosine from which on an axis is upright.
UPRIGHT = 0.95


class Fit(Protocol):
    """Fits shapes to sets of points."""

    def __call__(
        self,
        sets: Sequence[np.ndarray],
        wholes: Sequence[np.ndarray] | None = None,
        further: Sequence[bool] | None = None,
        /,
    ) -> tuple[Shape, ...]:
        """The shape of each set.

        Args:
            sets: Indices of the points of each.
            wholes: Of sets that are shares of larger ones these.
            further: Which of them may be lying; all by default.
        """
        ...


def contained(points: np.ndarray, members: Sequence[np.ndarray], shapes: Sequence[Shape]) -> dict[int, int]:
    """Which groups lie inside the round body of another, and of which."""
    into: dict[int, int] = {}
    some = [points[some_of(own, ASKED)] for own in members]
    # Of two that lie inside each other the one whose surface holds more points is the body.
    for a in sorted(range(len(members)), key=lambda k: -held_by(shapes[k])):
        if a in into or held_by(shapes[a]) < SURFACE * len(members[a]):
            continue
        slack = SLACK * float(shapes[a].noise_distance)
        within = [len(own) > 0 and inside(shapes[a].primitive, own, slack).mean() >= INSIDE for own in some]
        for b in range(len(members)):
            small = len(members[b]) <= MOST_INSIDE * len(members[a])
            # A group that holds others is no part itself.
            if small and within[a] and within[b] and b != a and b not in into and b not in into.values():
                into[b] = a
    return into


def inside(body: Primitive | None, points: np.ndarray, slack: float) -> np.ndarray:
    """Which points (N, 3) lie inside a round body, or outside by no more than the slack."""
    if isinstance(body, Sphere):
        return np.asarray(lengths(points - np.asarray(body.center)) <= float(body.radius) + slack)
    if isinstance(body, Cylinder):
        start, low, high, radius, slope = body.base, 0.0, float(body.height), float(body.radius), 0.0
    elif isinstance(body, Cone):
        (low, high), slope = np.asarray(body.height, float), float(np.tan(float(body.half_angle)))
        start, radius = body.apex, 0.0
    else:
        return np.zeros(len(points), bool)
    offset, axis = points - np.asarray(start), np.asarray(body.axis)
    along = offset @ axis
    across = lengths(offset - along[:, None] * axis)
    within = (along >= low - slack) & (along <= high + slack)
    return np.asarray(within & (across <= radius + slope * along + slack))


def refused(shape: Shape, status: Status, why: str) -> Shape:
    """The same object as "unknown", though a surface holds its points."""
    return dataclasses.replace(
        shape,
        kind="unknown",
        primitive=None,
        inliers=on_host(np.zeros(len(shape.inliers), bool)),
        covariance=on_host(np.zeros((0, 0)), shape.covariance.dtype),
        status=on_host(Status.REFUSED | status, np.int32),
        guards=(*shape.guards, f"{shape.kind}: {why}"),
    )


def held_by(shape: Shape) -> float:
    """How many points lie on a shape."""
    return float(np.asarray(shape.inliers).sum())


def lies(body: Primitive | None, up: np.ndarray, upright: float = UPRIGHT) -> bool:
    """Whether no axis of a body is upright, which is to have so large a cosine with the vertical."""
    if isinstance(body, Box):
        return bool(np.abs(np.asarray(body.axes) @ up).max() < upright)
    return isinstance(body, Cylinder | Cone) and abs(float(np.asarray(body.axis) @ up)) < upright


def some_of(own: np.ndarray, count: int = TRIED) -> np.ndarray:
    """A fair share of the points of a set: so many, and less than twice as many."""
    return own[:: max(1, len(own) // count)]


def named_sets(sets: dict[K, np.ndarray], fit: Fit) -> dict[K, tuple[np.ndarray, Shape]]:
    """The shapes of sets, of those that have one."""
    found = zip(sets.items(), fit(list(sets.values())) if sets else (), strict=True)
    return {key: (own, shape) for (key, own), shape in found if shape.primitive is not None}
