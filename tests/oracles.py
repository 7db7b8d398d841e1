"""The paper's equations in plain NumPy, loops allowed, written from the page and not from the package."""

import numpy as np


def fcm_memberships(x, v, alpha, m, delta=None):
    """Eq. 9 point by point; with a noise cluster eq. 20's denominator. Zero distance: the limit."""
    n, c = len(x), len(v)
    u, noise = np.zeros((n, c)), np.zeros(n)
    for k in range(n):
        d = [float(((x[k] - v[i]) ** 2).sum()) for i in range(c)]
        if min(d) == 0:
            on = [i for i in range(c) if d[i] == 0]
            for i in on:
                u[k, i] = alpha[i] / sum(alpha[j] for j in on)
            continue
        for i in range(c):
            total = sum(alpha[j] / alpha[i] * (d[i] / d[j]) ** (1 / (m - 1)) for j in range(c))
            if delta is not None:
                # Noise enters with the strength of an equal share, so that it is standard noise clustering at equal sizes.
                total += 1 / (c * alpha[i]) * (d[i] / delta**2) ** (1 / (m - 1))
            u[k, i] = 1 / total
        if delta is not None:
            total = sum(c * alpha[j] * (delta**2 / d[j]) ** (1 / (m - 1)) for j in range(c))
            noise[k] = 1 / (1 + total)
    return u, noise


def fcm_step(x, v, alpha, m, *, sizes, delta=None, weights=None):
    """Steps 2 to 4 of the paper's algorithm: eqs. 9, 10, 11."""
    w = np.ones(len(x)) if weights is None else np.asarray(weights, float)
    u, noise = fcm_memberships(x, v, alpha, m, delta)
    um = w[:, None] * u**m
    new_v = np.stack([um[:, i] @ x / um[:, i].sum() for i in range(len(v))])
    new_alpha = alpha
    if sizes:
        s = [um[:, i] @ ((x - new_v[i]) ** 2).sum(axis=1) for i in range(len(v))]
        new_alpha = np.array([1 / sum((s[j] / s[i]) ** (1 / m) for j in range(len(v))) for i in range(len(v))])
    return new_v, new_alpha, u, noise


def fcm_objective(x, v, alpha, u, noise, m, delta=None, weights=None):
    """Eq. 8 times K^(m-1), so that equal sizes give standard fuzzy c-means; with eq. 19's noise term."""
    w = np.ones(len(x)) if weights is None else np.asarray(weights, float)
    c = len(v)
    total = 0.0
    for i in range(c):
        d = ((x - v[i]) ** 2).sum(axis=1)
        total += c ** (1 - m) * alpha[i] ** (1 - m) * (w * u[:, i] ** m) @ d
    return total + (0 if delta is None else (w * noise**m).sum() * delta**2)


def fcm(x, v, m, *, sizes=False, delta=None, weights=None, steps=2000):
    """Alternating optimisation until nothing moves; returns centers, sizes, memberships, noise, objectives."""
    alpha = np.full(len(v), 1 / len(v))
    history = []
    for _ in range(steps):
        new_v, new_alpha, u, noise = fcm_step(x, v, alpha, m, sizes=sizes, delta=delta, weights=weights)
        history.append(fcm_objective(x, v, alpha, u, noise, m, delta, weights))
        still = np.abs(new_v - v).max() < 1e-14 and np.abs(new_alpha - alpha).max() < 1e-14
        v, alpha = new_v, new_alpha
        if still:
            break
    u, noise = fcm_memberships(x, v, alpha, m, delta)
    return v, alpha, u, noise, history


def variance_ratio(x, labels):
    """Eq. 6 from the traces of the scatter matrices of eq. 5."""
    mean = x.mean(axis=0)
    k, n = len(set(labels)), len(x)
    within = between = np.zeros((x.shape[1], x.shape[1]))
    for i in sorted(set(labels)):
        own = x[labels == i]
        within = within + (own - own.mean(axis=0)).T @ (own - own.mean(axis=0))
        between = between + len(own) * np.outer(own.mean(axis=0) - mean, own.mean(axis=0) - mean)
    total = (x - mean).T @ (x - mean)
    np.testing.assert_allclose(total, within + between, atol=1e-9 * np.trace(total))
    return np.trace(between) / (k - 1) / (np.trace(within) / (n - k))
