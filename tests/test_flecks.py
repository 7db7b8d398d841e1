"""Pieces of a picture that are too small to say anything: by hand, with gaps, thinned, and on a noisy table."""

import numpy as np
import pytest

from jaxfuzzy.flecks import in_flecks


def picture(shape=(60, 80), every=1):
    """Columns and rows of pixels, and a picture of which of them are kept: a block of 20 x 20, a fleck of 5 x 5, a lone one."""
    kept = np.zeros(shape, bool)
    kept[10:30, 10:30] = True
    kept[45:50, 45:50] = True
    kept[5, 70] = True
    rows, columns = (a[::every, ::every].ravel() for a in np.indices(shape))
    return np.stack([columns, rows], axis=1).astype(float), kept[::every, ::every].ravel()


@pytest.mark.parametrize("every", [1, 3])
def test_small_pieces_are_flecks_and_large_ones_are_not(every):
    pixels, kept = picture(every=every)
    found = in_flecks(pixels, kept, 100 // every**2)
    assert not found[~kept].any()
    block = (pixels < 30).all(axis=1)
    np.testing.assert_array_equal(found, kept & ~block)


def test_the_count_is_the_number_of_points():
    pixels, kept = picture()
    assert in_flecks(pixels, kept, 26).sum() == 26
    assert in_flecks(pixels, kept, 25).sum() == 1
    assert in_flecks(pixels, kept, 401).sum() == kept.sum()


def test_pixels_that_were_not_matched_part_no_piece():
    pixels, kept = picture()
    gone = (pixels[:, 0] % 3 == 1) | (pixels[:, 1] == 20)
    block = (pixels < 30).all(axis=1)
    assert not in_flecks(pixels[~gone], kept[~gone], 100)[block[~gone]].any()
    # But a wide gap does: each half has fewer than 250.
    gone = (pixels[:, 0] >= 18) & (pixels[:, 0] < 24)
    assert in_flecks(pixels[~gone], kept[~gone], 250)[(block & kept)[~gone]].all()


def test_pieces_that_meet_at_a_corner_are_one():
    rows, columns = (a.ravel() for a in np.indices((60, 80)))
    pixels = np.stack([columns, rows], axis=1).astype(float)
    kept = (rows // 10 == columns // 10) & (rows < 40)
    assert not in_flecks(pixels, kept, 101).any()


def test_what_is_no_picture_has_no_flecks():
    scattered = np.random.default_rng(0).uniform(0, 1000, (500, 2))
    assert not in_flecks(scattered, np.ones(500, bool), 100).any()
    assert not in_flecks(picture()[0], np.zeros(60 * 80, bool), 100).any()
