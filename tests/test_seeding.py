"""PCA and histogram seeds."""

import numpy as np
import pytest

from jaxfuzzy.seeding import histogram_seeds, principal_axes


def lumps(centers=(0.0, 5.0, 12.0), counts=(100, 200, 50), seed=0):
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(size=(n, 2)) * [0.5, 0.3] + [c, 0] for c, n in zip(centers, counts, strict=True)])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    return x @ turn.T + [7, -3], np.array(centers)[:, None] * turn[:, 0] + [7, -3]


def test_principal_axes_against_svd():
    x, _ = lumps()
    mean, axes, variances = principal_axes(x)
    np.testing.assert_allclose(mean, x.mean(axis=0), atol=1e-12)
    _, s, vt = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    np.testing.assert_allclose(variances, s**2 / len(x), rtol=1e-10)
    np.testing.assert_allclose(np.abs(np.sum(axes * vt, axis=1)), 1, atol=1e-12)
    # Eqs. 1 and 2 as read: projecting and back with all axes gives the points again.
    np.testing.assert_allclose((x - mean) @ axes.T @ axes + mean, x, atol=1e-12)


def test_one_seed_an_agglomerate_heaviest_first():
    x, truth = lumps()
    seeds = histogram_seeds(x, 3)
    assert len(seeds.peaks) == 3
    assert float(np.asarray(seeds.counts).sum()) == len(x)
    # Means of 50 to 200 points of spread 0.5 lie within 0.2 of the truth; the order is by weight.
    np.testing.assert_allclose(seeds.centers, truth[[1, 0, 2]], atol=0.2)


def test_fewer_keeps_the_heaviest_more_splits_the_heaviest():
    x, truth = lumps()
    np.testing.assert_allclose(histogram_seeds(x, 1).centers, truth[[1]], atol=0.2)
    five = np.asarray(histogram_seeds(x, 5).centers)
    along = (five - truth[0]) @ (truth[2] - truth[0]) / np.linalg.norm(truth[2] - truth[0])
    # 200 splits into 100 and 100, and of the groups of 100 one splits again.
    assert sorted(np.round(along / 6).astype(int)) in ([0, 0, 1, 1, 2], [0, 1, 1, 1, 2])
    assert len(np.unique(five, axis=0)) == 5


def test_weights_are_repetitions_and_order_does_not_matter():
    x, _ = lumps()
    counts = np.arange(len(x)) % 3
    weighted = histogram_seeds(np.where((counts > 0)[:, None], x, 1e30), 3, bins=20, weights=counts)
    repeated = histogram_seeds(np.repeat(x, counts, axis=0), 3, bins=20)
    np.testing.assert_allclose(weighted.centers, repeated.centers, atol=1e-9)
    shuffled = histogram_seeds(x[::-1], 4)
    np.testing.assert_allclose(shuffled.centers, histogram_seeds(x, 4).centers, atol=1e-9)


def test_odd_data():
    same = histogram_seeds(np.ones((5, 3)), 5)
    np.testing.assert_array_equal(same.centers, np.ones((5, 3)))
    assert histogram_seeds(np.array([[0.0], [1.0]]), 2).centers.shape == (2, 1)
    for k in (0, 6):
        with pytest.raises(ValueError, match="k must"):
            histogram_seeds(np.ones((5, 3)), k)
    with pytest.raises(ValueError, match="bins"):
        histogram_seeds(np.ones((5, 3)), 1, bins=0)
