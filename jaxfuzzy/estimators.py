"""The scikit-learn front: `FuzzyCMeans` and `FuzzyVarieties` for pipelines, searches and pickles (extra `sklearn`).

Both compute in float64, start deterministically from the histogram along the first principal axis, and heed `sample_weight`.
"""

from numbers import Integral, Real
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, ClusterMixin, TransformerMixin
from sklearn.utils._param_validation import Interval
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from jaxfuzzy.fcm import fcm
from jaxfuzzy.memberships import memberships, shares
from jaxfuzzy.seeding import histogram_seeds
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import describe
from jaxfuzzy.varieties import nfcv


class _Fuzzy(ClassNamePrefixFeaturesOutMixin, TransformerMixin, ClusterMixin, BaseEstimator):
    """What both have in common: checks, prediction from squared distances, scores."""

    n_clusters: int
    m: float
    noise_distance: float | None
    max_iter: int
    tol: float

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "n_clusters": [Interval(Integral, 1, None, closed="left")],
        "m": [Interval(Real, 1, None, closed="neither")],
        "noise_distance": [Interval(Real, 0, None, closed="neither"), None],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
    }

    def _points(self, X: Any, sample_weight: Any = None, *, reset: bool) -> tuple[np.ndarray, np.ndarray]:
        points = validate_data(self, X, dtype=np.float64, reset=reset)
        weights = _check_sample_weight(sample_weight, points, dtype=np.float64, ensure_non_negative=True)
        if reset:
            self._validate_params()
            if len(points) < self.n_clusters:
                raise ValueError(f"n_samples={len(points)} should be >= n_clusters={self.n_clusters}.")
            if not (weights > 0).any():
                raise ValueError("sample_weight must not all be zero")
        return points, weights

    def _shares(self, X: Any) -> tuple[np.ndarray, np.ndarray]:
        """Memberships and noise of any points."""
        check_is_fitted(self)
        points, _ = self._points(X, reset=False)
        with jax.enable_x64(True):
            u, noise = memberships(
                jnp.asarray(self._squared_distances(points)), self.m, self.noise_distance, self._log_sizes()
            )
            return np.asarray(u), np.asarray(noise)

    def _squared_distances(self, points: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _log_sizes(self) -> Any:
        return None

    def transform(self, X: Any) -> np.ndarray:
        """Memberships (n_samples, n_clusters)."""
        return self._shares(X)[0]

    def predict_proba(self, X: Any) -> np.ndarray:
        """Memberships; what is missing to 1 in a row belongs to noise."""
        return self.transform(X)

    def predict(self, X: Any) -> np.ndarray:
        """The cluster of largest membership, -1 where noise is larger."""
        return _labels(*self._shares(X))

    def score(self, X: Any, y: Any = None, sample_weight: Any = None) -> float:
        """The negative objective a unit of weight: higher is better, for one and the same m."""
        check_is_fitted(self)
        points, weights = self._points(X, sample_weight, reset=False)
        with jax.enable_x64(True):
            sizes = self._log_sizes()
            strengths = None if sizes is None else sizes + np.log(self.n_clusters)
            noise = None if self.noise_distance is None else self.noise_distance**2
            terms = shares(jnp.asarray(self._squared_distances(points).T), self.m, strengths, noise).objective(self.m)
            return -float(weights @ np.asarray(terms) / weights.sum())

    @property
    def _n_features_out(self) -> int:
        return self.n_clusters

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64"]
        return tags


class FuzzyCMeans(_Fuzzy):
    """Fuzzy c-means with optional sizes and noise cluster; see `jaxfuzzy.fcm`.

    Args:
        n_clusters: Number of clusters.
        m: Fuzzifier, above 1.
        sizes: Whether to learn the sizes of the clusters.
        noise_distance: Distance of the noise cluster; None for none.
        n_init: Further starts from points far from each other, besides the histogram's; the lowest objective is kept.
        max_iter: Largest number of steps.
        tol: Largest move of a center, in units of the points' RMS spread, that counts as none.

    Attributes:
        cluster_centers_: Centers (n_clusters, n_features).
        sizes_: Sizes (n_clusters,).
        labels_: Cluster of each training point, -1 for noise.
        memberships_: Memberships of the training points.
        objective_: The objective.
        n_iter_: Number of steps.
        status_: What to mistrust, in sentences.
    """

    _parameter_constraints = _Fuzzy._parameter_constraints | {
        "sizes": ["boolean"],
        "n_init": [Interval(Integral, 1, None, closed="left")],
    }

    def __init__(
        self,
        n_clusters: int = 2,
        *,
        m: float = 2.0,
        sizes: bool = False,
        noise_distance: float | None = None,
        n_init: int = 1,
        max_iter: int = 500,
        tol: float = 1e-10,
    ) -> None:
        self.n_clusters = n_clusters
        self.m = m
        self.sizes = sizes
        self.noise_distance = noise_distance
        self.n_init = n_init
        self.max_iter = max_iter
        self.tol = tol

    def fit(self, X: Any, y: Any = None, sample_weight: Any = None) -> Self:
        """Fits the clusters. `y` is not used."""
        points, weights = self._points(X, sample_weight, reset=True)
        options: dict[str, Any] = {
            "m": self.m,
            "sizes": self.sizes,
            "noise_distance": self.noise_distance,
            "weights": weights,
        }
        with jax.enable_x64(True):
            solver = Solver(int(self.max_iter), float(self.tol))
            starts = [np.asarray(histogram_seeds(points, int(self.n_clusters), weights=weights).centers)]
            starts += [_spread(points, weights, int(self.n_clusters), i) for i in range(self.n_init - 1)]
            if self.sizes:
                # Sizes learned from raw seeds may die before the centers have found their place.
                plain = options | {"sizes": False}
                starts = [np.asarray(fcm(points, start, **plain, solver=solver).centers) for start in starts]
            fits = [fcm(points, start, **options, solver=solver) for start in starts]
            fit = min(fits, key=lambda f: float(f.objective))
        self.cluster_centers_ = np.asarray(fit.centers)
        self.sizes_ = np.asarray(fit.sizes)
        self.labels_ = np.asarray(fit.labels)
        self.memberships_ = np.asarray(fit.memberships)
        self.objective_ = float(fit.objective)
        self.n_iter_ = int(fit.steps)
        self.status_ = describe(fit.status)
        return self

    def _squared_distances(self, points: np.ndarray) -> np.ndarray:
        return np.square(points[:, None] - self.cluster_centers_[None]).sum(axis=-1)

    def _log_sizes(self) -> Any:
        return jnp.log(self.sizes_) if self.sizes else None


class FuzzyVarieties(_Fuzzy):
    """Fuzzy c-varieties: clusters around lines, planes or flats of higher dimension; see `jaxfuzzy.nfcv`.

    Args:
        n_clusters: Number of varieties.
        dimension: Their dimension; at most n_features - 1.
        m: Fuzzifier, above 1.
        noise_distance: Distance of the noise cluster; None for none.
        max_iter: Largest number of steps.
        tol: Largest change of a variety, in units of the points' RMS spread, that counts as none.

    Attributes:
        cluster_centers_: A point on each variety (n_clusters, n_features).
        components_: Orthonormal directions that span each variety (n_clusters, dimension, n_features).
        labels_: Variety of each training point, -1 for noise.
        memberships_: Memberships of the training points.
        objective_: The objective.
        n_iter_: Number of steps.
        status_: What to mistrust, in sentences.
    """

    _parameter_constraints = _Fuzzy._parameter_constraints | {"dimension": [Interval(Integral, 1, None, closed="left")]}

    def __init__(
        self,
        n_clusters: int = 2,
        *,
        dimension: int = 1,
        m: float = 2.0,
        noise_distance: float | None = None,
        max_iter: int = 500,
        tol: float = 1e-10,
    ) -> None:
        self.n_clusters = n_clusters
        self.dimension = dimension
        self.m = m
        self.noise_distance = noise_distance
        self.max_iter = max_iter
        self.tol = tol

    def fit(self, X: Any, y: Any = None, sample_weight: Any = None) -> Self:
        """Fits the varieties, starting from the memberships of fuzzy c-means. `y` is not used."""
        points, weights = self._points(X, sample_weight, reset=True)
        if points.shape[1] <= self.dimension:
            raise ValueError(
                f"dimension={self.dimension} must be below n_features: {points.shape[1]} feature(s) is too few"
            )
        with jax.enable_x64(True):
            seeds = histogram_seeds(points, int(self.n_clusters), weights=weights).centers
            start = fcm(points, seeds, m=self.m, weights=weights, solver=Solver(10, 0.0)).memberships
            fit = nfcv(
                points,
                start,
                embedding="linear",
                dimension=int(self.dimension),
                noise_distance=self.noise_distance,
                m=self.m,
                distance="algebraic",
                weights=weights,
                solver=Solver(int(self.max_iter), float(self.tol)),
            )
        self.cluster_centers_ = np.asarray(fit.centers)
        self.components_ = np.asarray(fit.basis).transpose(0, 2, 1)
        self.labels_ = np.asarray(fit.labels)
        self.memberships_ = np.asarray(fit.memberships)
        self.objective_ = float(fit.objective)
        self.n_iter_ = int(fit.steps)
        self.status_ = describe(fit.status)
        return self

    def _squared_distances(self, points: np.ndarray) -> np.ndarray:
        offset = points[:, None] - self.cluster_centers_[None]
        along = np.einsum("ncd,cqd->ncq", offset, self.components_)
        return np.maximum(np.square(offset).sum(axis=-1) - np.square(along).sum(axis=-1), 0)


def _labels(u: np.ndarray, noise: np.ndarray) -> np.ndarray:
    return np.where(noise > u.max(axis=1), -1, u.argmax(axis=1))


def _spread(points: np.ndarray, weights: np.ndarray, count: int, start: int) -> np.ndarray:
    """Seeds far from each other: the point at a quantile of the first coordinates, then always the farthest one."""
    present = points[weights > 0]
    order = np.lexsort(present.T[::-1])
    chosen = [order[(2 * start + 1) * len(order) // (2 * start + 2) % len(order)]]
    nearest = np.square(present - present[chosen[0]]).sum(axis=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.square(present - present[chosen[-1]]).sum(axis=1))
    return present[chosen]
