"""Groups made objects by their shapes, without the search: surfaces are stood in for by what a fit would say."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.checks import DataError
from jaxfuzzy.dividing import _of_pieces, with_left_over
from jaxfuzzy.groups import by_shapes
from jaxfuzzy.joining import _seen_from, _way_hidden, parts_of_one_body
from jaxfuzzy.primitives import Cylinder, Plane, Sphere
from jaxfuzzy.segment import segment
from jaxfuzzy.status import Status
from jaxfuzzy.trials import contained
from synthetic import fitted_shape

ACROSS = np.array([[1.0, 0, 0], [0, 0, 1.0]])


def ball(center, radius=0.1, count=300, seed=0):
    toward = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(center) + radius * toward / np.linalg.norm(toward, axis=1, keepdims=True)


def shape_of(points, body, noise=0.005):
    """A shape as a fit would give it; unknown where the body holds less than half of the points."""
    held = np.asarray(body.distance(points)) < noise
    good = held.mean() > 0.49
    return fitted_shape(body if good else None, held & good, noise)


def fitted_to(points, bodies):
    """Takes for every set the body that holds most of it."""

    def fit(sets, wholes=None, lying=None):
        best = lambda own: max((shape_of(points[own], s) for s in bodies), key=lambda s: int(s.inliers.sum()))
        return tuple(best(own) for own in sets)

    return fit


def by_places(points):
    """Divides some of the points by places."""
    return lambda some: np.asarray(segment(points[some]).labels)


def divided(points, labels):
    """A division by places, relabelled as asked."""
    parts = segment(points, ks=(int(labels.max()) + 1,))
    assert parts.k == labels.max() + 1
    return parts


def hardened(parts):
    u, noise = np.asarray(parts.partition.memberships), np.asarray(parts.partition.noise)
    np.testing.assert_allclose(u.sum(1) + noise, 1, atol=1e-6)
    return np.where(noise > u.max(1), -1, u.argmax(1))


def test_two_parts_of_one_ball_are_merged_and_a_stranger_is_not():
    whole = ball([0, 0, 1.0], 0.15, 900)
    # An occluder has cut the ball in two.
    cut = whole[np.abs(whole[:, 0]) > 0.05]
    other = ball([0.6, 0, 1.0], 0.05)
    points = np.concatenate([cut, other])
    parts = divided(points, np.array([0, 1, 2]))
    fit = fitted_to(points, [Sphere(jnp.array([0, 0, 1.0]), jnp.asarray(0.15)), Sphere(jnp.array([0.6, 0, 1.0]), 0.05)])
    members = [np.flatnonzero(np.asarray(parts.labels) == k) for k in range(3)]
    merged, shapes = by_shapes(points, ACROSS, parts, fit(members), fit, by_places(points))
    assert merged.k == len(shapes) == 2
    labels = np.asarray(merged.labels)
    assert len(set(labels[: len(cut)]) - {-1}) == 1
    np.testing.assert_array_equal(hardened(merged), labels)
    np.testing.assert_allclose(float(merged.sizes.sum()), 1, rtol=1e-6)
    for k, shape in enumerate(shapes):
        assert len(shape.inliers) == (labels == k).sum()
    # Parts that are flat are none of a ball.
    flat = Plane(jnp.zeros(3), jnp.array([0, 0, -1.0]), jnp.zeros((4, 3)))
    planes = tuple(fitted_shape(flat, np.ones(len(own), bool), 0.005) for own in members)
    assert by_shapes(points, ACROSS, parts, planes, fit, by_places(points))[0] is parts


def test_two_balls_that_touch_are_told_apart():
    points = np.concatenate([ball([0, 0, 1.0]), ball([0.2, 0, 1.0], seed=1)])
    parts = segment(points, ks=(1,))
    spheres = [Sphere(jnp.array([x, 0, 1.0]), jnp.asarray(0.1)) for x in (0.0, 0.2)]
    fit = fitted_to(points, spheres)
    one = fit([np.flatnonzero(np.asarray(parts.labels) == 0)])
    apart, shapes = by_shapes(points, ACROSS, parts, one, fit, by_places(points))
    assert apart.k == len(shapes) == 2
    labels = np.asarray(apart.labels)
    np.testing.assert_array_equal(hardened(apart), labels)
    assert {shape.kind for shape in shapes} == {"sphere"}
    # A group that one surface holds stays whole.
    alone = segment(points[:300], ks=(1,))
    held = fit([np.flatnonzero(np.asarray(alone.labels) == 0)])
    same, _ = by_shapes(points[:300], ACROSS, alone, held, fit, by_places(points))
    assert same is alone


def test_one_ball_on_another_is_told_apart_but_not_a_ring():
    # With some outliers none of the balls holds half of what lies on one side of an upright cut.
    stray = np.random.default_rng(2).uniform([-0.05, -0.1, 0.95], [0.05, 0.3, 1.05], (120, 3))
    points = np.concatenate([ball([0, 0, 1.0]), ball([0, 0.2, 1.0], seed=1), stray])
    fit = fitted_to(points, [Sphere(jnp.array([0, y, 1.0]), jnp.asarray(0.1)) for y in (0.0, 0.2)])
    parts = segment(points, ks=(1,))
    members = np.flatnonzero(np.asarray(parts.labels) == 0)
    whole = fitted_shape(None, np.zeros(len(members), bool), 0.005)
    apart, shapes = by_shapes(points, ACROSS, parts, (whole,), fit, by_places(points))
    assert [shape.kind for shape in shapes] == ["sphere", "sphere"]
    labels = np.asarray(apart.labels)
    assert len(set(labels[:300]) - {-1}) == len(set(labels[300:600]) - {-1}) == 1
    through = dataclasses.replace(whole, status=jnp.asarray(int(Status.REFUSED | Status.SEEN_THROUGH)))
    assert by_shapes(points, ACROSS, parts, (through,), fit, by_places(points))[0] is parts


def test_what_a_body_leaves_over_is_an_object_where_a_surface_holds_it():
    # A large ball, and two small ones so near that the three are one group; of one of these only half is on its surface.
    rng = np.random.default_rng(2)
    places = [[0, 0, 1.0], [0.155, 0, 1.0], [-0.155, 0, 1.0]]
    fuzz = rng.uniform(-0.03, 0.03, (120, 3)) + [-0.155, 0, 1.0]
    points = np.concatenate([ball(places[0], 0.1, 700), ball(places[1], 0.04, 200), ball(places[2], 0.04, 90), fuzz])
    fit = fitted_to(
        points, [Sphere(jnp.array(p), jnp.asarray(r)) for p, r in zip(places, (0.1, 0.04, 0.04), strict=True)]
    )
    parts = segment(points, ks=(1,))
    members = np.flatnonzero(np.asarray(parts.labels) == 0)
    apart, shapes = by_shapes(points, ACROSS, parts, fit([members]), fit, by_places(points))
    labels = np.asarray(apart.labels)
    np.testing.assert_array_equal(hardened(apart), labels)
    assert [float(shape.primitive.radius) for shape in shapes] == pytest.approx([0.1, 0.04])
    assert (labels[700:900] == 1).mean() > 0.95
    assert not (labels[900:] == 1).any()
    assert [len(shape.inliers) for shape in shapes] == [(labels == k).sum() for k in (0, 1)]

    def scattered(_):
        raise DataError("too scattered")

    assert by_shapes(points, ACROSS, parts, fit([members]), fit, scattered)[0] is parts


@pytest.mark.parametrize(("body", "held", "number"), [("round", 0.84, 1), ("flat", 0.84, 2), ("round", 0.95, 2)])
def test_two_flat_strips_are_no_better_than_a_round_body_that_holds_little_less(body, held, number):
    """A cone behind another one is seen at both sides of it: of the strips two planes held 0.84, the cone 0.67."""
    rng = np.random.default_rng(4)
    points = np.concatenate([rng.normal(size=(300, 3)) * [0.01, 0.05, 0.01] + [x, 0, 1.0] for x in (-0.05, 0.05)])
    parts = segment(points, ks=(1,))
    members = np.flatnonzero(np.asarray(parts.labels) == 0)
    upright = Cylinder(jnp.array([0, -0.1, 1.0]), jnp.array([0, 1.0, 0]), jnp.asarray(0.06), jnp.asarray(0.2))
    corners = jnp.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    plane = Plane(jnp.array([0, 0, 1.0]), jnp.array([0, 0, -1.0]), corners)

    def fit(sets, wholes=None, lying=None):
        every = [len(own) > 0.8 * len(members) for own in sets]
        first = lambda own, share: np.arange(len(own)) < share * len(own)
        return tuple(
            fitted_shape(upright if body == "round" else plane, first(own, 0.67), 0.03)
            if all_of_it
            else fitted_shape(plane, first(own, held), 0.03)
            for own, all_of_it in zip(sets, every, strict=True)
        )

    nothing = lambda some: np.full(len(some), -1)
    apart, shapes = by_shapes(points, ACROSS, parts, fit([members]), fit, nothing)
    assert apart.k == len(shapes) == number


@pytest.mark.parametrize(("share", "kinds"), [(0.55, ["sphere", "unknown"]), (0.7, ["sphere"])])
def test_what_a_body_leaves_over_is_another_object_where_it_is_nearly_half(share, kinds):
    """A ball beside a heap that no surface holds, as a hat box with a doll: the body holds too little to be all of the object."""
    rng = np.random.default_rng(3)
    count = round(1000 * share)
    heap = rng.uniform(-0.06, 0.06, (1000 - count, 3)) + [0.19, 0, 1.0]
    points = np.concatenate([ball([0, 0, 1.0], 0.1, count), heap])
    fit = fitted_to(points, [Sphere(jnp.array([0, 0, 1.0]), jnp.asarray(0.1))])
    parts = segment(points, ks=(1,))
    members = np.flatnonzero(np.asarray(parts.labels) == 0)
    apart, shapes = by_shapes(points, ACROSS, parts, fit([members]), fit, by_places(points))
    labels = np.asarray(apart.labels)
    np.testing.assert_array_equal(hardened(apart), labels)
    assert [shape.kind for shape in shapes] == kinds
    if len(kinds) == 2:
        assert (labels[:count] == 0).mean() > 0.95
        assert (labels[count:] == 1).mean() > 0.9


@pytest.mark.parametrize(("held", "found"), [(0.25, [1270, 150, 150, 130, 300]), (0.8, [2000])])
def test_parts_of_a_heap_are_small_beside_what_its_surface_holds(held, found):
    """Pieces of 150 and 130 are less than a tenth of a group of 2000, but more of the 500 that a surface of it holds."""
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    own = np.arange(2000)
    flat = Plane(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.zeros((4, 3)))
    heap = fitted_shape(flat, own < held * 2000, 0.005)
    # The last three have no name: the first is large enough to be an object beside others, the next is not, nor is the third.
    pieces = [own[1000:1150], own[1150:1300], own[1300:1430], own[1500:1800], own[1800:1890], own[1900:1940]]
    names = (150, 150, 130)

    def fit(sets):
        named = [len(of) in names for of in sets]
        body = Sphere(center=np.full(3, 9.0), radius=np.array(0.1))
        return tuple(
            fitted_shape(body if yes else None, np.full(len(of), yes), 0.005)
            for yes, of in zip(named, sets, strict=True)
        )

    parts = with_left_over(points, [own], [heap], {0: pieces}, fit, 60)
    sizes = [len(of) for of, _ in parts[0]] if parts else [len(own)]
    assert sizes == found
    if parts:
        assert [shape.kind for _, shape in parts[0]] == ["plane", "sphere", "sphere", "sphere", "unknown"]
    # Where no part has a name, large ones are objects where that is asked for.
    names = ()
    assert not with_left_over(points, [own], [heap], {0: pieces}, fit, 60)
    nameless = with_left_over(points, [own], [heap], {0: pieces}, fit, 60, nameless=True)
    assert [len(of) for of, _ in nameless.get(0, [])] == ([1270, 150, 150, 130, 300] if held < 0.6 else [])


def wall(radius, toward, count=500, seed=0):
    """An arc of 100 degrees of an upright cylinder at (0, 0, 1), on the side that z leads to or comes from."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-0.87, 0.87, count)
    return np.stack([radius * np.sin(angle), rng.uniform(0, 0.1, count), 1 + toward * radius * np.cos(angle)], axis=1)


def vessel():
    """The outer wall in front, the inner one behind, and their cylinders."""
    points = np.concatenate([wall(0.1, -1), wall(0.085, 1, seed=1)])
    upright = lambda radius: Cylinder(
        jnp.array([0, 0, 1.0]), jnp.array([0, 1.0, 0]), jnp.asarray(radius), jnp.asarray(0.1)
    )
    return points, [upright(0.1), upright(0.085)]


def test_what_lies_inside_a_round_body_is_part_of_it():
    points, bodies = vessel()
    stranger = ball([0.4, 0.05, 1.0], 0.05)
    points = np.concatenate([points, stranger])
    bodies.append(Sphere(jnp.array([0.4, 0.05, 1.0]), jnp.asarray(0.05)))
    parts = divided(points, np.array([0, 1, 2]))
    fit = fitted_to(points, bodies)
    members = [np.flatnonzero(np.asarray(parts.labels) == k) for k in range(3)]
    merged, shapes = by_shapes(points, ACROSS, parts, fit(members), fit, by_places(points))
    assert merged.k == 2
    labels = np.asarray(merged.labels)
    assert len(set(labels[:1000]) - {-1}) == 1
    np.testing.assert_array_equal(hardened(merged), labels)
    whole = shapes[labels[labels >= 0][0]]
    # The outside names the whole, of which its own surface holds about half.
    np.testing.assert_allclose(whole.primitive.radius, 0.1)
    assert 0.4 < np.mean(whole.inliers) < 0.6


def test_a_vessel_in_one_group_is_not_divided():
    points, bodies = vessel()
    parts = segment(points, ks=(1,))
    fit = fitted_to(points, bodies)
    same, _ = by_shapes(
        points, ACROSS, parts, fit([np.flatnonzero(np.asarray(parts.labels) == 0)]), fit, by_places(points)
    )
    assert same is parts


@pytest.mark.parametrize(("count", "holds"), [(500, True), (4000, False)])
def test_a_body_holds_what_is_inside_but_no_heap_many_times_its_size(count, holds):
    """The front of a ball, and points within it: its inner wall, or a heap that a ball bent through a flat thing reaches round."""
    outside = ball([0, 0, 1.0], 0.1, 600)
    outside = outside[outside[:, 2] < 1.0]
    points = np.concatenate([outside, ball([0, 0, 1.0], 0.06, count)])
    members = [np.arange(len(outside)), np.arange(len(outside), len(points))]
    good = fitted_shape(Sphere(jnp.array([0, 0, 1.0]), jnp.asarray(0.1)), np.ones(len(outside), bool), 0.004)
    shapes = [good, fitted_shape(None, np.zeros(count, bool), 0.004)]
    assert contained(points, members, shapes) == ({1: 0} if holds else {})


@pytest.mark.parametrize(
    ("status", "tried"),
    [(Status(0), False), (Status.REFUSED, False), (Status.REFUSED | Status.TOO_FEW_POINTS, True)],
)
def test_pairs_that_no_surface_can_hold_are_not_tried(status, tried):
    """Two balls side by side, both named, or one refused: since its best surface does not fit it, or for lack of points."""
    points = np.concatenate([ball([-0.065, 0, 1.0], 0.08), ball([0.065, 0, 1.0], 0.08)])
    bodies = [Sphere(jnp.array([x, 0, 1.0]), jnp.asarray(0.08)) for x in (-0.065, 0.065)]
    labels = np.repeat([0, 1], len(points) // 2)
    members = [np.flatnonzero(labels == k) for k in range(2)]
    asked, fit = [], fitted_to(points, bodies)
    shapes = list(fit(members))
    if status:
        shapes[1] = dataclasses.replace(shapes[1], primitive=None, kind="unknown", status=jnp.asarray(int(status)))

    def listen(sets, wholes=None, lying=None):
        asked.extend(len(own) for own in sets)
        return fit(sets)

    joined = parts_of_one_body(points, points @ ACROSS.T, members, shapes, listen, None, np.array([0, 1.0, 0]))
    assert not joined
    assert asked == ([len(points)] if tried else [])


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
def test_parts_of_what_lies_are_asked_for_as_lying(axis):
    rng = np.random.default_rng(0)
    turn, along = rng.uniform(0, np.pi, 600), np.concatenate([rng.uniform(0, 0.1, 300), rng.uniform(0.1, 0.2, 300)])
    first, second = (np.roll(axis, i) for i in (1, 2))
    points = np.array([0, 0, 1.0]) + along[:, None] * axis
    points = points + 0.08 * (np.cos(turn)[:, None] * first - np.sin(turn)[:, None] * second)
    body = Cylinder(jnp.array([0, 0, 1.0]), jnp.array(axis), jnp.asarray(0.08), jnp.asarray(0.2))
    members = [np.arange(300), np.arange(300, 600)]
    fit, flags = fitted_to(points, [body]), []

    def listen(sets, wholes=None, lying=None):
        flags.append(lying)
        return fit(sets)

    joined = parts_of_one_body(points, points @ ACROSS.T, members, fit(members), listen, None, np.array([0, 1.0, 0]))
    assert list(joined) == [(0, 1)]
    # At first the pair, then once more those that were taken.
    assert flags[0] == [axis[1] == 0]


def test_a_piece_is_looked_at_as_lying_where_its_other_piece_is_named():
    """Of three groups' halves: both named, the second unnamed but needed, the second unnamed and too small to matter."""
    starts = (0, 500, 1000, 1500, 2000, 2500)
    sets = [np.arange(start, start + (60 if start == 2500 else 500)) for start in starts]
    pieces = {(k, 0): sets[2 * k : 2 * k + 2] for k in range(3)}
    good = fitted_shape(Sphere(jnp.zeros(3), jnp.asarray(0.1)), np.ones(500, bool), 0.004)
    bad = fitted_shape(None, np.zeros(500, bool), 0.004)
    calls = []

    def fit(some, wholes, lying):
        calls.append(([int(own[0]) for own in some], lying))
        return [bad if own[0] in (1500, 2500) and not any(lying) else good for own in some]

    found = _of_pieces(pieces, {0: 900, 1: 900, 2: 700}, dict.fromkeys(pieces, False), fit)
    assert calls == [(list(starts), [False] * 6), ([1500], [True])]
    assert [[shape is good for _, shape in both] for both in found] == [[True, True], [True, True], [True, False]]


def test_halves_far_apart_are_merged_where_something_hides_what_is_between():
    rng = np.random.default_rng(0)
    x = rng.uniform(0.08, 0.15, 600) * np.repeat([-1, 1], 300)
    halves = np.stack([x, rng.uniform(-0.05, 0.05, 600), np.ones(600)], axis=1)
    points = np.concatenate([halves, ball([0, 0, 0.6], 0.045)])
    parts = divided(points, np.array([0, 1, 2]))
    corners = jnp.array([[-0.15, -0.05, 1], [0.15, -0.05, 1], [0.15, 0.05, 1], [-0.15, 0.05, 1]])
    bodies = [
        Plane(corners.mean(0), jnp.array([0, 0, -1.0]), corners),
        Sphere(jnp.array([0, 0, 0.6]), jnp.asarray(0.045)),
    ]
    fit = fitted_to(points, bodies)
    shapes = fit([np.flatnonzero(np.asarray(parts.labels) == k) for k in range(3)])
    # Without a camera, or with one that sees between them, they are too far apart to be tried.
    for camera in (None, np.array([0, 5.0, 1.0])):
        assert by_shapes(points, ACROSS, parts, shapes, fit, by_places(points), camera)[0] is parts
    merged, found = by_shapes(points, ACROSS, parts, shapes, fit, by_places(points), np.zeros(3))
    assert merged.k == len(found) == 2


def test_halves_are_merged_behind_a_thin_thing_too():
    # Most of the way leads over the halves themselves; something stands before the fifth between them.
    rng = np.random.default_rng(0)
    x = rng.uniform(0.05, 0.4, 3000) * np.repeat([-1, 1], 1500)
    bar = np.stack([rng.uniform(-0.04, 0.04, 400), rng.uniform(-0.1, 0.1, 400), np.full(400, 0.8)], axis=1)
    points = np.concatenate([np.stack([x, rng.uniform(-0.05, 0.05, 3000), np.ones(3000)], axis=1), bar])
    view = _seen_from(np.zeros(3), points, [np.arange(1500), np.arange(1500, 3000), np.arange(3000, 3400)])
    assert _way_hidden(view, (0, 1))
    behind = view._replace(depth=np.where(view.group == 2, 3.0, view.depth))
    assert not _way_hidden(behind, (0, 1))
    # Where points of their own are between them, nothing is hidden.
    assert not _way_hidden(view._replace(group=np.where(view.group == 2, 0, view.group)), (0, 1))
