"""A piece of a wall has no step in depth along its border; an object has, or stands on the ground: pictures made by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.pieces import STEP, without_pieces
from jaxfuzzy.primitives import Cylinder, Plane
from jaxfuzzy.status import Status
from synthetic import fitted_shape

BODY = Cylinder(jnp.zeros(3), jnp.array([0, 1.0, 0]), jnp.asarray(0.1), jnp.asarray(0.3))
FLAT = Plane(jnp.zeros(3), jnp.array([0, 0, -1.0]), jnp.zeros((4, 3)))
ROWS, COLUMNS = np.mgrid[0:60, 0:80]
INSIDE = (np.abs(ROWS - 30) < 15) & (np.abs(COLUMNS - 40) < 10)


def told(depth, ground=None, unmatched=None, body=BODY, others=None, noise_distance=0.01):
    """The shape of the points in the middle of a picture of depths after a look at their border."""
    there = np.ones(depth.shape, bool) if unmatched is None else ~unmatched
    pixels = np.stack([COLUMNS[there], ROWS[there]], axis=1).astype(float)
    members = [np.flatnonzero(INSIDE[there])]
    ground = np.zeros(there.sum(), bool) if ground is None else ground[there]
    shapes = [fitted_shape(body, np.ones(len(members[0]), bool), noise_distance)]
    if others is not None:
        members.append(np.flatnonzero(others[there] & ~INSIDE[there]))
        shapes.append(fitted_shape(None, np.zeros(len(members[1]), bool), noise_distance))
    return without_pieces(pixels, depth[there], ground, members, shapes)[0]


def test_a_piece_of_a_wall_is_refused():
    shape = told(2 + 0.001 * COLUMNS)
    assert (shape.kind, shape.primitive) == ("unknown", None)
    assert int(shape.status) == Status.REFUSED | Status.PIECE
    assert "cylinder: its surface goes on beyond its points" in shape.guards
    assert not np.asarray(shape.inliers).any()


@pytest.mark.parametrize("step", [0.5, -0.5])
def test_what_a_step_in_depth_surrounds_stays(step):
    assert told(np.where(INSIDE, 2.0, 2.0 + step)).kind == "cylinder"


def test_what_stands_on_the_ground_stays():
    # Below, the ground begins at the same depth; else the background is far.
    below = ROWS >= 45
    depth = np.where(INSIDE | below, 2.0, 3.0)
    assert told(depth, ground=below).kind == "cylinder"
    every = ~INSIDE
    assert told(np.full(depth.shape, 2.0), ground=every).kind == "cylinder"
    assert told(np.full(depth.shape, 2.0)).kind == "unknown"


def test_unmatched_neighbors_are_steps_and_those_of_other_objects_say_nothing():
    flat = np.full(INSIDE.shape, 2.0)
    band = (np.abs(ROWS - 30) < 15 + STEP) & (np.abs(COLUMNS - 40) < 10 + STEP) & ~INSIDE
    assert told(flat, unmatched=band).kind == "cylinder"
    assert told(flat, others=band).kind == "cylinder"


def test_how_much_of_the_border_may_go_on():
    # The border of 29 rows and 19 columns has, at five pixels, 2 x 5 x (29 + 19) = 480 neighbors; a side of columns has 95 of them,
    # one of rows 145. The bound is a quarter, 120.
    for side, kind in ((ROWS >= 45, "cylinder"), (COLUMNS >= 50, "unknown")):
        assert told(np.where(INSIDE | side, 2.0, 3.0)).kind == kind


def test_where_a_piece_was_cut_from_another_the_rest_of_its_border_tells():
    """Above, 95 of all 480 neighbors go on; where two sides with 240 meet another object at the same depth, 95 of 240 do."""
    other = (COLUMNS >= 50) | (ROWS >= 45)
    above = (ROWS < 16) & ~other
    assert told(np.where(INSIDE | above, 2.0, 3.0)).kind == "cylinder"
    assert told(np.where(INSIDE | other | above, 2.0, 3.0), others=other).kind == "unknown"
    # Of a gap of one column, 29 neighbors at most, nothing is said.
    gap = (COLUMNS == 52) & ~INSIDE
    every = ~INSIDE & ~gap
    assert told(np.full(INSIDE.shape, 2.0), others=every).kind == "cylinder"
    # Where the other object stands at another depth, its border is one like any.
    assert told(np.where(INSIDE | above, 2.0, 3.0), others=other).kind == "cylinder"


def test_a_piece_of_a_plane_is_a_plane():
    assert told(np.full(INSIDE.shape, 2.0), body=FLAT).kind == "plane"


@pytest.mark.parametrize("far", [1e12, np.nan])
def test_a_picture_that_is_none_says_nothing(far):
    pixels = np.stack([COLUMNS.ravel(), ROWS.ravel()], axis=1).astype(float)
    pixels[0] = far
    members = [np.flatnonzero(INSIDE.ravel())]
    shapes = [fitted_shape(BODY, np.ones(len(members[0]), bool), 0.01)]
    flat = np.full(len(pixels), 2.0)
    assert without_pieces(pixels, flat, np.zeros(len(pixels), bool), members, shapes)[0].kind == "cylinder"
