"""Fuzzy c-means on real tables: the optimum that plain alternation in NumPy reaches from the same start."""

import numpy as np
import pytest

from jaxfuzzy.fcm import fcm
from jaxfuzzy.solve import Solver

datasets = pytest.importorskip("sklearn.datasets", reason="the real tables come with scikit-learn (extra sklearn)")
TABLES = ("iris", "wine", "breast_cancer", "diabetes", "digits")


def alternate(x, v, m, steps=20_000):
    """Plain fuzzy c-means with the ratio form of the memberships, until no center moves by 1e-12 of the spread."""
    spread = np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean())
    for _ in range(steps):
        d = np.maximum(((x[:, None] - v[None]) ** 2).sum(axis=-1), 1e-30)
        ratio = (d.min(axis=1, keepdims=True) / d) ** (1 / (m - 1))
        u = (ratio / ratio.sum(axis=1, keepdims=True)) ** m
        new = u.T @ x / u.sum(axis=0)[:, None]
        moved = np.abs(new - v).max()
        v = new
        if moved < 1e-12 * spread:
            break
    return v, (u * d).sum()


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("m", [1.5, 2.0, 2.5])
def test_objective_is_that_of_plain_alternation(name, m):
    x = getattr(datasets, f"load_{name}")().data.astype(float)
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    if name == "digits":
        x = x[:600]  # 64 coordinates: what counts is the dimension, not the number of rows
    start = x[[0, len(x) // 2, len(x) - 1]]
    _, lowest = alternate(x, start, m)
    for acceleration in ("anderson", None):
        found = fcm(x, start, m=m, memberships=False, solver=Solver(20_000, 1e-10, acceleration))
        # The objective is flat at its minimum: a center off by 1e-8 of the spread changes it by 1e-16.
        np.testing.assert_allclose(found.objective, lowest, rtol=1e-8)
