"""What stands behind a body must not be seen through it: bodies cast by hand before a wall, whole and with parts missing."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.outline import sight_of, without_seen_through
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Sphere
from jaxfuzzy.render import body_of
from jaxfuzzy.status import Status
from synthetic import fitted_shape

CAMERA, UP = np.zeros(3), np.array([0.0, 1.0, 0.0])
TURN = np.deg2rad(30)
SIDE = np.array([[np.cos(TURN), 0, np.sin(TURN)], [0, 1, 0], [-np.sin(TURN), 0, np.cos(TURN)]])
BODIES = {
    "box": Box(jnp.array([0, 0, 1.2]), jnp.array([0.2, 0.3, 0.1]), jnp.asarray(SIDE), jnp.ones(3, bool)),
    "cylinder": Cylinder(jnp.array([0, -0.15, 1.3]), jnp.array([0, 1.0, 0]), jnp.asarray(0.1), jnp.asarray(0.3)),
    "cone": Cone(jnp.array([0, 0.2, 1.3]), jnp.array([0, -1.0, 0]), jnp.asarray(0.3), jnp.array([0.1, 0.35])),
    "sphere": Sphere(jnp.array([0, 0, 1.2]), jnp.asarray(0.15)),
    "plane": Plane(
        jnp.array([0, 0, 1.2]),
        jnp.array([0, 0, -1.0]),
        jnp.array([[-0.2, -0.15, 1.2], [0.2, -0.15, 1.2], [0.2, 0.15, 1.2], [-0.2, 0.15, 1.2]]),
    ),
}
WALL = 2.0


def rays():
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 121), np.linspace(-0.3, 0.3, 121))
    ray = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def met(body, ray):
    """How far each ray goes to a body, inf where it misses."""
    if isinstance(body, Plane):
        depth = 1.2 / ray[:, 2]
        within = np.abs(ray[:, :2] * depth[:, None]) <= [0.2, 0.15]
        return np.where(within.all(axis=1), depth, np.inf)
    return body_of(body).hit(ray)[0]


def told(body, missing=None, screen=None, unmatched=None, outliers=0):
    """The shape of a body before a wall after a look through it.

    Args:
        body: The body.
        missing: Which points of it, by their places (N, 3), are not there: the wall is seen in their stead.
        screen: Which rays (N, 3) meet a screen before the body.
        unmatched: Which points of the wall are not there either.
        outliers: How many points lie anywhere round it.
    """
    ray = rays()
    depth = met(body, ray)
    there = np.isfinite(depth)
    if missing is not None:
        there &= ~missing(np.where(there, depth, 0)[:, None] * ray)
    depth = np.where(there, depth, WALL / ray[:, 2])
    if screen is not None:
        hidden = screen(ray)
        depth, there = np.where(hidden, 0.8 / ray[:, 2], depth), there & ~hidden
    kept = np.ones(len(ray), bool) if unmatched is None else there | ~unmatched(depth[:, None] * ray)
    rng = np.random.default_rng(0)
    stray = rng.uniform([-0.4, -0.4, 0.7], [0.4, 0.4, 1.7], (outliers, 3))
    points = np.concatenate([(depth[:, None] * ray)[kept], stray])
    own = np.flatnonzero(there[kept])
    shape = fitted_shape(body, np.ones(len(own), bool), 0.005)
    loose = np.ones(len(points), bool)
    loose[own] = False
    sight = sight_of(points, loose, CAMERA, UP)
    return shape, without_seen_through(points, [own], [shape], sight)[0]


@pytest.mark.parametrize("name", BODIES)
def test_a_whole_body_stays(name):
    before, after = told(BODIES[name])
    assert after is before
    # Neither what stands before it, nor holes where nothing was matched, nor outliers speak against it.
    for options in (
        {"screen": lambda ray: ray[:, 0] > 0},
        {"missing": lambda p: p[:, 0] > 0, "unmatched": lambda p: p[:, 0] > 0},
        {"outliers": 3000},
    ):
        before, after = told(BODIES[name], **options)
        assert after is before


def test_points_of_the_whole_object_behind_a_share_of_it_do_not_speak_against_it():
    ray = rays()
    depth = met(BODIES["sphere"], ray)
    hits = np.flatnonzero(np.isfinite(depth))
    open_ = hits[np.isin(hits % 121, range(61, 121))]
    depth[open_] = WALL
    points = np.where(np.isfinite(depth), depth, WALL)[:, None] * ray
    share = np.setdiff1d(hits, open_)[::2]
    shape = fitted_shape(BODIES["sphere"], np.ones(len(share), bool), 0.005)
    sight = sight_of(points, ~np.isfinite(met(BODIES["sphere"], ray)), CAMERA, UP)
    assert without_seen_through(points, [share], [shape], sight, [hits])[0] is shape
    assert without_seen_through(points, [share], [shape], sight)[0].kind == "unknown"


@pytest.mark.parametrize("name", BODIES)
def test_a_body_that_is_seen_through_is_refused(name):
    """Twigs: of each body only some crooked stripes are there."""
    before, after = told(BODIES[name], missing=lambda p: (p[:, 0] / 0.06 + 3 * p[:, 1]) % 1 < 0.5)
    assert after.kind == "unknown"
    assert after.primitive is None
    assert not np.asarray(after.inliers).any()
    assert after.inliers.shape == before.inliers.shape
    assert int(after.status) == Status.REFUSED | Status.SEEN_THROUGH
    assert after.guards[-1].startswith(f"{name}: ")


@pytest.mark.filterwarnings("error")
def test_a_body_without_an_extent_hides_nothing():
    disc = Cylinder(jnp.array([0, 0, 1.3]), jnp.array([0, 1.0, 0]), jnp.asarray(0.1), jnp.asarray(0.0))
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 1.2], [0.1, 0.1, 2.0], (500, 3))
    shape = told(BODIES["cylinder"])[0]
    shape = dataclasses.replace(shape, primitive=disc, inliers=jnp.ones(500, bool))
    sight = sight_of(points, np.zeros(500, bool), CAMERA, UP)
    assert without_seen_through(points, [np.arange(500)], [shape], sight)[0] is shape


def test_flat_things_need_not_be_rectangles():
    corner = lambda p: p[:, 0] / 0.2 + p[:, 1] / 0.15 > 0
    before, after = told(BODIES["plane"], missing=corner)
    assert after is before
    ring = lambda p: np.abs(np.hypot(p[:, 0] / 0.2, p[:, 1] / 0.15) - 0.8) > 0.2
    assert told(BODIES["plane"], missing=ring)[1].kind == "unknown"


def test_a_bowl_is_no_whole_sphere_and_a_body_half_there_none():
    sphere = BODIES["sphere"]
    before, after = told(sphere, missing=lambda p: p[:, 1] > -0.03)
    assert after is before
    assert told(sphere, missing=lambda p: p[:, 0] > 0)[1].kind == "unknown"


def test_what_sticks_out_of_a_vessel_does_not_speak_against_it():
    """Pencils: the upper half of the cylinder is a narrow stripe."""
    before, after = told(BODIES["cylinder"], missing=lambda p: (p[:, 1] > 0) & (np.abs(p[:, 0]) > 0.015))
    assert after is before


def test_an_open_vessel_is_seen_into():
    """From above the wall is seen where a lid would be; the side alone is claimed."""
    vessel = Cylinder(jnp.array([0, -0.35, 1.3]), jnp.array([0, 1.0, 0]), jnp.asarray(0.2), jnp.asarray(0.1))
    depth, part = body_of(vessel).hit(rays())
    assert (part == 2).sum() > 0.3 * np.isfinite(depth).sum()
    lid = lambda p: p[:, 1] > -0.2501
    before, after = told(vessel, missing=lid)
    assert after is before


def test_nothing_is_seen_from_within_a_body():
    """The corner of a room lies on a cone that holds the camera; one that ends before the camera may hold it."""
    for name, changes in (
        ("cylinder", {"radius": jnp.asarray(2.0)}),
        ("cone", {"apex": jnp.array([0, 3.0, 1.3]), "half_angle": jnp.asarray(0.6), "height": jnp.array([0.1, 5.0])}),
        ("sphere", {"radius": jnp.asarray(1.5)}),
        ("box", {"size": jnp.array([4.0, 5.0, 6.0])}),
    ):
        before, _ = told(BODIES[name])
        around = dataclasses.replace(before, primitive=dataclasses.replace(before.primitive, **changes))
        points = np.random.default_rng(0).uniform([-0.1, -0.1, 1.2], [0.1, 0.1, 2.0], (len(before.inliers), 3))
        sight = sight_of(points, np.zeros(len(points), bool), CAMERA, UP)
        after = without_seen_through(points, [np.arange(len(points))], [around], sight)[0]
        assert after.kind == "unknown"
        assert int(after.status) == Status.REFUSED | Status.SEEN_THROUGH
        assert "camera" in after.guards[-1]
    low = dataclasses.replace(BODIES["cylinder"], radius=jnp.asarray(2.0), base=jnp.array([0, -0.5, 1.3]))
    before = dataclasses.replace(before, kind="cylinder", primitive=low)
    after = without_seen_through(points, [np.arange(len(points))], [before], sight)[0]
    assert "camera" not in "".join(after.guards)
