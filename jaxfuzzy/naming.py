"""From the groups of a scene to its objects: fitted, merged and divided, named or refused, stood upright, their ends told.

The order is that of what each step needs. Groups are changed while shapes are only tried. Then every shape is weighed by what
neighboring pixels leave of its evidence and by what is seen past its outline. What stays gets the vertical that all agree on, and
last come what hangs on it: level patches, quadrics, hidden ends, and whether another kind is as likely.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxfuzzy.arrays import lengths
from jaxfuzzy.evidence import FEWEST_PIXELS, in_independent_points, told_apart, worth
from jaxfuzzy.flecks import pixels_a_point
from jaxfuzzy.ground import Ground
from jaxfuzzy.groups import by_shapes, by_steps, members_of
from jaxfuzzy.linalg import tangents
from jaxfuzzy.objects import OF_SCENE
from jaxfuzzy.occlusion import with_hidden_ends
from jaxfuzzy.outline import Sight, sight_of, without_seen_through
from jaxfuzzy.patches import level_patches
from jaxfuzzy.pieces import without_pieces
from jaxfuzzy.rivals import chosen_by_outline
from jaxfuzzy.segment import Segmentation, segment
from jaxfuzzy.shapes import Fits, Shape, with_quadrics
from jaxfuzzy.steps import between_steps
from jaxfuzzy.trials import FEWEST
from jaxfuzzy.vertical import agreed_vertical, upright_again, witness_of


class Seen(NamedTuple):
    """A cloud and what is known of it when its objects are looked for.

    Attributes:
        points: All points (N, 3) in metres.
        pixels: Column and row of each (N, 2), of which neighbors err alike; None where they are no pixels, or are taken for none.
        noise_distance: "auto", one in metres for all points, or one for each (N,).
        weights: Weight of each (N,); None for equal ones.
        camera: Where they were seen from (3,); None where not known.
        up: The vertical (3,).
        up_given: Whether that was given; otherwise the objects have a say in it.
        ground: The supporting plane, where one was looked for.
        flat: Which points lie on it (N,).
        thickness: How far above it points were taken for its own, in metres.
    """

    points: np.ndarray
    pixels: np.ndarray | None
    noise_distance: Any
    weights: np.ndarray | None
    camera: np.ndarray | None
    up: np.ndarray
    up_given: bool
    ground: Ground | None
    flat: np.ndarray
    thickness: float

    def of(self, own: np.ndarray) -> dict[str, Any]:
        """What dividing and fitting some of the points take beside these."""
        noise = self.noise_distance if np.ndim(self.noise_distance) == 0 else np.asarray(self.noise_distance)[own]
        weights = None if self.weights is None else self.weights[own]
        return {"up": self.up, "camera": self.camera, "noise_distance": noise, "weights": weights}


class Named(NamedTuple):
    """The objects: which points each has, its shape, and the vertical (3,) that they agree on."""

    parts: Segmentation
    shapes: tuple[Shape, ...]
    up: np.ndarray


def named(seen: Seen, own: np.ndarray, parts: Segmentation, rule: str, regroup: bool, **how: Any) -> Named:
    """Names the objects that groups of points are.

    Args:
        seen: The cloud.
        own: Indices of the points that were divided.
        parts: Their division.
        rule: How a kind is chosen, as in `fit_shape`.
        regroup: Whether groups may be merged and divided by their shapes.
        **how: `kinds` and `distance`, as in `fit_shape`.
    """
    points, camera = seen.points[own], seen.camera
    sight = None
    if camera is not None and rule != "paper":
        loose = np.ones(len(seen.points), bool)
        loose[own[np.concatenate([np.zeros(0, int), *members_of(parts)])]] = False
        sight = sight_of(seen.points, loose, camera, np.asarray(seen.up, float))
    tried = _Tried(seen, own, sight, rule, how)
    shapes = tried.fit(members_of(parts))
    if regroup:
        across = np.asarray(tangents(seen.up))
        parts, shapes = by_shapes(points, across, parts, shapes, tried.fit, tried.parted, camera, tried.least)
        if seen.pixels is not None and camera is not None:
            parts, shapes = by_steps(points, parts, shapes, tried.fit, tried.stepped, tried.least)
    members = members_of(parts)
    shapes = _weighed(tried, members, shapes)
    up = seen.up
    if rule != "paper":
        shapes, up = _upright(tried, members, shapes)
        shapes = level_patches(points, members, shapes, np.asarray(up, float), camera)
    shapes = with_quadrics(points, members, shapes, seen.of(own)["weights"])
    if camera is not None:
        plane = None if seen.ground is None else seen.ground.plane
        shapes = with_hidden_ends(points, members, shapes, camera, plane, seen.thickness)
    if seen.pixels is not None:
        shapes = told_apart(shapes, np.asarray(up, float))
    return Named(parts, shapes, up)


class _Tried:
    """What is tried on sets of a scene's points, given by their indices among those that were divided."""

    def __init__(self, seen: Seen, own: np.ndarray, sight: Sight | None, rule: Any, how: dict[str, Any]) -> None:
        self.seen, self.own, self.sight = seen, own, sight
        self.points = seen.points[own]
        correlated = seen.pixels is not None
        self.fits = Fits(self.points, rule=rule, capacity=OF_SCENE, correlated=correlated, **seen.of(own), **how)
        # Of fewer points no part of a group is an object.
        self.least = FEWEST_PIXELS if correlated else FEWEST
        self.spacing = np.inf if seen.pixels is None else pixels_a_point(seen.pixels)

    def fit(
        self,
        sets: Sequence[np.ndarray],
        wholes: Sequence[np.ndarray] | None = None,
        further: Sequence[bool] | None = None,
    ) -> tuple[Shape, ...]:
        """The shape of each set, "unknown" where things are seen through it; see `trials.Fit`."""
        found = self.fits.shapes(sets, further=further)
        if self.sight is None:
            return found
        of = None if wholes is None else [self.own[m] for m in wholes]
        return without_seen_through(self.seen.points, [self.own[m] for m in sets], found, self.sight, of)

    def parted(self, of: np.ndarray) -> np.ndarray:
        """Labels of points by places."""
        return np.asarray(segment(self.points[of], **self.seen.of(self.own[of])).labels)

    def stepped(self, of: np.ndarray, noise_distance: float) -> list[np.ndarray]:
        """Pieces of points between which the depth steps by more than a noise distance."""
        assert self.seen.pixels is not None
        depth = lengths(self.points[of] - self.seen.camera)
        return [of[i] for i in between_steps(self.seen.pixels[self.own[of]], depth, noise_distance, self.spacing)]

    def as_kinds(self, sets: Sequence[np.ndarray], kinds: Sequence[str]) -> tuple[Shape, ...]:
        """Sets as other kinds, one each."""
        return self.independent(self.fits.shapes_as(sets, kinds))

    def about(self, sets: Sequence[np.ndarray], kinds: Sequence[str], up: np.ndarray, lean: float) -> tuple[Shape, ...]:
        """Sets as kinds, one each, with axes that lean from a vertical with so large a deviation."""
        # The prior is weighed against all points that a fit counts, of which few are independent.
        leans = [lean / np.sqrt(worth(len(m), OF_SCENE) if self.seen.pixels is not None else 1.0) for m in sets]
        return self.independent(self.fits.shapes_about(sets, kinds, up, leans))

    def independent(self, shapes: tuple[Shape, ...]) -> tuple[Shape, ...]:
        """Shapes with the evidence that neighboring pixels leave."""
        return shapes if self.seen.pixels is None else in_independent_points(shapes, OF_SCENE)


def _weighed(tried: _Tried, members: list[np.ndarray], shapes: tuple[Shape, ...]) -> tuple[Shape, ...]:
    """Shapes by the evidence of independent points and by what is seen past their outlines."""
    seen, sight = tried.seen, tried.sight
    shapes = tried.independent(shapes)
    if sight is None:
        return shapes
    mine = [tried.own[m] for m in members]
    if seen.pixels is not None:
        again = lambda of, kinds: tried.as_kinds([members[i] for i in of], kinds)
        shapes = chosen_by_outline(seen.points, mine, shapes, sight, again)
    shapes = without_seen_through(seen.points, mine, shapes, sight)
    if seen.pixels is not None:
        shapes = without_pieces(seen.pixels, lengths(seen.points - seen.camera), seen.flat, mine, shapes)
    return shapes


def _upright(
    tried: _Tried, members: list[np.ndarray], shapes: tuple[Shape, ...]
) -> tuple[tuple[Shape, ...], np.ndarray]:
    """The objects, those that stand upright fitted once more about the vertical that all agree on, and that (3,)."""
    seen = tried.seen
    axis, correlated = np.asarray(seen.up, float), seen.pixels is not None
    witness = witness_of(seen.points, seen.ground, axis, given=seen.up_given, camera=seen.camera, correlated=correlated)
    agreed = agreed_vertical(shapes, witness)
    if agreed is None:
        return shapes, seen.up
    again = lambda of, lean: tried.about([members[i] for i in of], [shapes[i].kind for i in of], agreed.up, lean)
    return upright_again(shapes, agreed, again), agreed.up
