"""How near a fixed point is to being one of many."""

import numpy as np
import pytest

from jaxfuzzy.conditioning import conditioning
from jaxfuzzy.fcm import fcm
from jaxfuzzy.solve import Solver
from jaxfuzzy.varieties import nfcv

EXACT = Solver(5000, 1e-13)


def test_far_lumps_are_well_conditioned_merging_ones_are_not():
    rng = np.random.default_rng(0)
    lump = rng.normal(size=(60, 2))
    values = []
    for gap in (20.0, 4.0, 2.6):
        x = np.concatenate([lump, lump + [gap, 0]])
        fit = fcm(x, np.array([[0.0, 0], [gap, 0]]), solver=EXACT)
        values.append(float(conditioning(fit, x)))
    assert values[0] > values[1] > values[2] > 0
    # Far apart, a step forgets the center it came from but for the pull of the other lump, which goes like 1 / gap^2.
    assert values[0] > 0.9


def test_one_cluster_forgets_at_once():
    x = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(conditioning(fcm(x, x[:1]), x), 1.0, atol=1e-12)


def test_varieties_one_or_several():
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 3, 200)
    x = np.stack([np.cos(a), rng.uniform(0, 2, 200), np.sin(a) + 5], axis=1) + 0.01 * rng.normal(size=(200, 3))
    start = np.ones((200, 1))
    both = conditioning(nfcv(x, start, embedding=("cylinder", "sphere"), noise_distance=0.3), x)
    alone = conditioning(nfcv(x, start, embedding="cylinder", noise_distance=0.3), x)
    assert both.shape == (2,)
    np.testing.assert_allclose(both[0], alone, rtol=1e-6)
    assert 0 < float(alone) <= 1.5


def test_points_of_another_fit_are_refused():
    x = np.random.default_rng(0).normal(size=(50, 3))
    with pytest.raises(ValueError, match="points"):
        conditioning(fcm(x, x[:2]), x[:, :2])
    with pytest.raises(ValueError, match="points"):
        conditioning(nfcv(x, np.ones((50, 1)), embedding="3d"), x[:20])
