"""What is none of the kinds but a quadric all the same: a general one fitted to an object's points, if they allow it.

One variety of dimension eight in the nine-dimensional embedding beside a noise cluster (paper eqs. 14 to 20, geometric distance,
m = 2), its noise distance annealed. With one variety and m = 2 the weights are u² = (1 + D/delta²)^-2, so that a few dozen
generalised eigenproblems A n = lambda B n of nine unknowns do; in plain NumPy, as there is nothing to compile for an object or two.
"""

import numpy as np

from jaxfuzzy.arrays import on_host, product
from jaxfuzzy.objects import MOST, fair_order
from jaxfuzzy.primitives import Quadric

# Noise distances annealed through, in units of the last, so many steps at each.
LADDER, STEPS = (16.0, 8.0, 4.0, 2.0, 1.0), 6
# Of the points near a quadric, up to so many noise distances, no larger share than this may lie beyond one noise distance; of all
# points so many must lie within it. On simulated clouds ellipsoids and saddles stay mostly below, tori and blobs are above.
NEAR, BEYOND, LEAST = 2.4, 0.14, 0.4
# A fair sample of so many points is fitted, and all are judged.
FITTED_TO = 2048


def quadric_of(points: np.ndarray, weights: np.ndarray, noise_distance: float) -> tuple[Quadric, np.ndarray] | None:
    """The quadric that an object's points lie on, and which of them do; None where they lie on none.

    Args:
        points: Points (N, 3).
        weights: Their weights (N,).
        noise_distance: How far noise carries a point from the surface.
    """
    real = weights > 0
    if real.sum() < 20 or noise_distance <= 0:
        return None
    middle = np.median(points[real], axis=0)
    unit = float(np.sqrt(((points[real] - middle) ** 2).sum(axis=1).mean()))
    if unit == 0:
        return None
    p = (points - middle) / unit
    some = np.flatnonzero(real)[fair_order(p[real])[:FITTED_TO]]
    embedded, slopes = _terms(p[some])
    delta, square = noise_distance / unit, np.zeros(len(some))
    for step in np.repeat(LADDER, STEPS):
        pull = weights[some] / (1 + square / (step * delta) ** 2) ** 2
        pull = pull / pull.sum()
        mean = pull @ embedded
        offset = embedded - mean
        scatter = (offset * pull[:, None]).T @ offset
        slope = product((slopes * np.tile(pull, 3)[:, None]).T, slopes)
        root = np.linalg.cholesky(slope + 1e-12 * np.trace(slope) * np.eye(9))
        half = np.linalg.solve(root, np.linalg.solve(root, scatter).T)
        normal = np.linalg.solve(root.T, np.linalg.eigh((half + half.T) / 2)[1][:, 0])
        square = _squared_distances(embedded, slopes, normal, mean)
    # Piece by piece, as nine dimensions of all points and their derivatives are much to hold.
    pieces = [_squared_distances(*_terms(p[i : i + MOST]), normal, mean) for i in range(0, len(p), MOST)]
    distance = np.sqrt(np.concatenate(pieces)) / delta
    on, near = weights[distance <= 1].sum(), weights[(distance > 1) & (distance <= NEAR)].sum()
    if not np.isfinite(distance).all() or on < LEAST * weights.sum() or near > BEYOND * (near + on):
        return None
    inliers = (distance <= 1) & real
    bounds = np.stack([points[inliers].min(axis=0), points[inliers].max(axis=0)])
    coefficients = _placed(np.append(normal, -mean @ normal), middle, unit)
    return Quadric(on_host(coefficients), on_host(bounds)), inliers


def _terms(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in nine dimensions (N, 9), and the derivatives by x, y and z one after the other (3 N, 9)."""
    x, y, z = p.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    slopes = [
        np.stack([2 * x, zero, zero, y, zero, z, one, zero, zero], axis=1),
        np.stack([zero, 2 * y, zero, x, z, zero, zero, one, zero], axis=1),
        np.stack([zero, zero, 2 * z, zero, y, x, zero, zero, one], axis=1),
    ]
    return np.stack([x * x, y * y, z * z, x * y, y * z, z * x, x, y, z], axis=1), np.concatenate(slopes)


def _squared_distances(embedded: np.ndarray, slopes: np.ndarray, normal: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Squared distances (N,) to the first order."""
    steep = ((slopes @ normal) ** 2).reshape(3, -1).sum(axis=0)
    return np.asarray(((embedded - mean) @ normal) ** 2 / np.maximum(steep, 1e-24))


def _placed(coefficients: np.ndarray, middle: np.ndarray, unit: float) -> np.ndarray:
    """Coefficients for points p of those for (p - middle) / unit, of length one."""
    a, b, c, ab, bc, ca, x, y, z, one = coefficients
    form = np.array([[a, ab / 2, ca / 2], [ab / 2, b, bc / 2], [ca / 2, bc / 2, c]]) / unit**2
    line = np.array([x, y, z]) / unit
    moved = line - 2 * form @ middle
    constant = one - line @ middle + middle @ form @ middle
    mixed = 2 * form[[0, 1, 2], [1, 2, 0]]
    found = np.concatenate([np.diag(form), mixed, moved, [constant]])
    return found / np.linalg.norm(found)
