"""Pieces of a group's picture between which the depth steps: by hand, with gaps, thinned, and as objects."""

import numpy as np
import pytest

from jaxfuzzy.flecks import pixels_a_point
from jaxfuzzy.groups import by_steps, members_of
from jaxfuzzy.primitives import Sphere
from jaxfuzzy.segment import segment
from jaxfuzzy.steps import between_steps
from jaxfuzzy.trials import FEWEST
from synthetic import fitted_shape

NOISE = 0.01


def picture(every=1):
    """Pixels of two surfaces side by side that meet at column 40, and their depths: one slants, one stands 0.1 behind its edge."""
    rows, columns = (a[::every, ::every].ravel() for a in np.indices((30, 70)))
    depth = np.where(columns < 40, 1 + 0.5 * NOISE * columns, 1 + 0.5 * NOISE * 40 + 0.1)
    return np.stack([columns, rows], axis=1).astype(float), depth


@pytest.mark.parametrize("every", [1, 3])
def test_a_step_parts_and_a_slant_does_not(every):
    pixels, depth = picture(every)
    first, second = between_steps(pixels, depth, NOISE, every**2)
    # The larger comes first, and cells of a few pixels lie astride of the edge.
    assert pixels[first, 0].max() < 40 + 2 * every
    assert pixels[second, 0].min() > 39 - 2 * every
    assert len(first) + len(second) == len(pixels)
    np.testing.assert_array_equal(np.sort(np.concatenate([first, second])), np.arange(len(pixels)))


def test_a_step_of_less_than_the_noise_parts_nothing():
    pixels, depth = picture()
    assert len(between_steps(pixels, depth, 0.2, 1)) == 1
    # A slant by more than that a pixel is one step after another, from cell to cell of two pixels.
    assert len(between_steps(pixels, depth, 0.2 * NOISE, 1)) == 20 + 1


def test_pixels_that_were_not_matched_part_nothing_but_a_gap_does():
    pixels, depth = picture()
    some = (pixels[:, 0] % 2 == 0) | (pixels[:, 1] % 2 == 0)
    assert len(between_steps(pixels[some], depth[some], NOISE, 4 / 3)) == 2
    gap = (pixels[:, 0] >= 12) & (pixels[:, 0] < 20)
    assert [len(of) for of in between_steps(pixels[~gap], depth[~gap], NOISE, 1)] == [900, 600, 360]


def test_what_is_no_picture_has_no_pieces():
    generator = np.random.default_rng(0)
    scattered = generator.uniform(0, 1000, (500, 2))
    assert between_steps(scattered, generator.uniform(1, 2, 500), NOISE, pixels_a_point(scattered)) == []


def test_a_group_that_leaves_much_of_its_box_empty_is_as_dense_as_its_picture():
    rows, columns = (a.ravel() for a in np.indices((100, 100)))
    frame = np.maximum(np.abs(rows - 49.5), np.abs(columns - 49.5)) > 44
    pixels = np.stack([columns, rows], axis=1)[frame].astype(float)
    # The right half stands three noise distances behind: no step for cells of five pixels, which its own box would have.
    depth = np.where(pixels[:, 0] < 50, 1.0, 1 + 3 * NOISE)
    assert pixels_a_point(pixels) > 4
    assert [len(of) for of in between_steps(pixels, depth, NOISE, 1)] == [len(pixels) // 2] * 2


@pytest.mark.parametrize(("held", "number"), [(0.9, 2), (0.6, 1)])
def test_pieces_that_a_surface_holds_are_objects_and_the_rest_stays(held, number):
    points = np.random.default_rng(0).uniform(0, 1, (600, 3))
    parts = segment(points, ks=(1,))
    own = members_of(parts)[0]
    body = Sphere(center=np.zeros(3), radius=np.array(1.0))
    pieces = [own[:350], own[350:500], own[500:]]

    def fit(sets, wholes=None, lying=None):
        # The middle piece lies on a body to so large a share, the others on none.
        good = [len(of) == 150 for of in sets]
        shares = [np.arange(len(of)) < held * len(of) * yes for of, yes in zip(sets, good, strict=True)]
        return tuple(fitted_shape(body if yes else None, on, NOISE) for on, yes in zip(shares, good, strict=True))

    whole = (fitted_shape(None, np.zeros(len(own), bool), NOISE),)
    asked = []

    def stepped(of, noise):
        asked.append((len(of), noise))
        return pieces

    found, shapes = by_steps(points, parts, whole, fit, stepped, FEWEST)
    assert asked == [(len(own), NOISE)]
    assert found.k == len(shapes) == number
    if number == 2:
        rest, piece = members_of(found)
        np.testing.assert_array_equal(piece, np.sort(pieces[1]))
        np.testing.assert_array_equal(rest, np.sort(np.concatenate([pieces[0], pieces[2]])))
        assert shapes[0].primitive is None
        assert isinstance(shapes[1].primitive, Sphere)
        assert len(shapes[0].inliers) == len(rest)


def test_a_rest_too_small_to_be_an_object_is_noise():
    points = np.random.default_rng(0).uniform(0, 1, (600, 3))
    parts = segment(points, ks=(1,))
    own = members_of(parts)[0]
    cut = [own[:300], own[300 : len(own) - FEWEST // 2]]
    body = Sphere(center=np.zeros(3), radius=np.array(1.0))
    fit = lambda sets, *_: tuple(
        fitted_shape(body if len(of) > FEWEST else None, np.ones(len(of), bool), NOISE) for of in sets
    )
    whole = (fitted_shape(None, np.zeros(len(own), bool), NOISE),)
    found, shapes = by_steps(points, parts, whole, fit, lambda *_: cut, FEWEST)
    assert found.k == len(shapes) == 2
    lost = np.asarray(found.labels)[own[len(own) - FEWEST // 2 :]]
    assert (lost == -1).all()
    np.testing.assert_allclose(np.asarray(found.partition.noise)[own[-FEWEST // 2 :]], 1, atol=1e-6)


def test_a_group_that_a_surface_holds_is_not_asked_about():
    points = np.random.default_rng(0).uniform(0, 1, (600, 3))
    parts = segment(points, ks=(1,))
    own = members_of(parts)[0]
    named = (fitted_shape(Sphere(center=np.zeros(3), radius=np.array(1.0)), np.ones(len(own), bool), NOISE),)
    never = lambda *_: pytest.fail("asked")
    assert by_steps(points, parts, named, lambda sets, *_: (), never, FEWEST) == (parts, named)


def test_a_piece_that_is_nearly_the_whole_group_is_not_fitted_again():
    points = np.random.default_rng(0).uniform(0, 1, (600, 3))
    parts = segment(points, ks=(1,))
    own = members_of(parts)[0]
    whole = (fitted_shape(None, np.zeros(len(own), bool), NOISE),)
    most = len(own) - len(own) // 20
    never = lambda *_: pytest.fail("fitted")
    assert by_steps(points, parts, whole, never, lambda *_: [own[:most], own[most:]], FEWEST) == (parts, whole)
