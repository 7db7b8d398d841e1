"""Fuzzy c-varieties with noise clustering written from the paper's equations, one at a time, in plain NumPy float64."""

import numpy as np


def memberships(squared, m, noise_distance):
    """Eqs. 17, 18, 20: (C, N) squared distances to (C, N) memberships and (N,) noise."""
    everything = (
        squared if noise_distance is None else np.vstack([squared, np.full(squared.shape[1], noise_distance**2)])
    )
    u = np.empty_like(everything)
    for k in range(everything.shape[1]):
        zero = everything[:, k] == 0
        if zero.any():
            u[:, k] = zero / zero.sum()
            continue
        for i in range(everything.shape[0]):
            u[i, k] = 1 / sum(
                (everything[i, k] / everything[j, k]) ** (1 / (m - 1)) for j in range(everything.shape[0])
            )
    clusters = squared.shape[0]
    return u[:clusters], 1 - u[:clusters].sum(axis=0)


def algebraic_step(x, u, q, m, weights):
    """Eqs. 15, 16, 13: embedded points and (C, N) memberships to centers, bases and squared distances."""
    centers, bases, squared = [], [], []
    for row in u:
        power = weights * row**m
        center = power @ x / power.sum()
        scatter = sum(p * np.outer(d, d) for p, d in zip(power, x - center, strict=True))
        basis = np.linalg.eigh(scatter)[1][:, ::-1][:, :q]
        offset = x - center
        squared.append((offset**2).sum(1) - ((offset @ basis) ** 2).sum(1))
        centers.append(center)
        bases.append(basis)
    return np.array(centers), np.array(bases), np.maximum(squared, 0)


def geometric_step(x, gradients, u, m, weights):
    """Taubin's generalised eigenproblem in place of eq. 16, |f|² / |∇f|² in place of eq. 13; gradients are (N, Q, 3)."""
    import scipy.linalg

    centers, normals, squared = [], [], []
    for row in u:
        power = weights * row**m
        center = power @ x / power.sum()
        scatter = np.einsum("n,nq,np->qp", power, x - center, x - center)
        metric = np.einsum("n,nqd,npd->qp", power, gradients, gradients)
        normal = scipy.linalg.eigh(scatter, metric)[1][:, 0]
        normal /= np.linalg.norm(normal)
        squared.append(((x - center) @ normal) ** 2 / ((gradients.transpose(0, 2, 1) @ normal) ** 2).sum(1))
        centers.append(center)
        normals.append(normal)
    return np.array(centers), np.array(normals), np.array(squared)


def objective(squared, u, noise, m, noise_distance, weights):
    """Eq. 19, eq. 14 without a noise cluster."""
    total = (weights * u**m * squared).sum()
    return total if noise_distance is None else total + (weights * noise**m).sum() * noise_distance**2
