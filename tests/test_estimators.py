"""The scikit-learn front: scikit-learn's own checks, and what a pipeline needs."""

import pickle

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="scikit-learn is an extra")

from sklearn.base import clone
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from jaxfuzzy.estimators import FuzzyCMeans, FuzzyVarieties


# Slow: the checks try many shapes, and each compiles a fit of its own.
@pytest.mark.slow
@parametrize_with_checks([FuzzyCMeans(), FuzzyVarieties()])
@pytest.mark.filterwarnings("ignore")
def test_scikit_learns_own_checks(estimator, check):
    check(estimator)


def lumps():
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(size=(60, 3)) + at for at in ([0, 0, 0], [8, 0, 0], [0, 9, 0])])


def test_lives_in_a_pipeline_a_search_and_a_pickle():
    x = lumps()
    pipeline = make_pipeline(StandardScaler(), FuzzyCMeans(3, sizes=True, noise_distance=2.0))
    labels = pipeline.fit_predict(x)
    # Scaling widens the coordinate that tells nothing, so a few points of each lump belong to noise.
    most = [np.bincount(labels[i * 60 : (i + 1) * 60] + 1, minlength=4) for i in range(3)]
    assert sorted(int(counts.argmax()) for counts in most) == [1, 2, 3]
    assert min(int(counts.max()) for counts in most) >= 50
    again = pickle.loads(pickle.dumps(pipeline))
    np.testing.assert_array_equal(again.predict(x), labels)
    u = pipeline.transform(x)
    np.testing.assert_allclose(u, pipeline[-1].memberships_, atol=1e-12)
    assert clone(pipeline[-1]).get_params()["noise_distance"] == 2.0
    search = GridSearchCV(FuzzyCMeans(), {"n_clusters": [2, 3]}, cv=2).fit(x)
    assert search.best_params_["n_clusters"] == 3
    assert list(pipeline[-1].get_feature_names_out()) == ["fuzzycmeans0", "fuzzycmeans1", "fuzzycmeans2"]


def test_noise_is_labelled_and_more_starts_are_never_worse():
    x = np.concatenate([lumps(), [[500.0, 500, 500]]])
    fitted = FuzzyCMeans(3, noise_distance=5.0).fit(x)
    assert fitted.labels_[-1] == fitted.predict(x)[-1] == -1
    more = FuzzyCMeans(3, noise_distance=5.0, n_init=3).fit(x)
    assert more.objective_ <= fitted.objective_ * (1 + 1e-9)
    np.testing.assert_allclose(fitted.score(x) * -len(x), fitted.objective_, rtol=1e-9)


def test_varieties_find_lines():
    rng = np.random.default_rng(0)
    t = rng.uniform(-1, 1, (100, 1))
    x = np.concatenate([t * [10, 1], t * [1, 10] + [30, 0]]) + 0.05 * rng.normal(size=(200, 2))
    fitted = FuzzyVarieties(2).fit(x)
    assert {len(set(fitted.labels_[:100])), len(set(fitted.labels_[100:]))} == {1}
    slopes = np.sort(np.abs(fitted.components_[:, 0, 0]))
    np.testing.assert_allclose(slopes, np.sort([10, 1] / np.sqrt(101)), atol=5e-3)
    np.testing.assert_array_equal(fitted.predict(x), fitted.labels_)


@pytest.mark.parametrize(
    "estimator", [FuzzyCMeans(2, noise_distance=3.0), FuzzyVarieties(1), FuzzyVarieties(1, noise_distance=0.5)]
)
def test_what_was_held_out_is_predicted_as_by_the_fit(estimator):
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(30, 3)), rng.normal(size=(20, 3)) + [6, 0, 0]])
    weight = (np.arange(50) % 4 > 0).astype(float)
    fitted = estimator.fit(x, sample_weight=weight)
    np.testing.assert_array_equal(fitted.labels_, fitted.predict(x))
    np.testing.assert_allclose(fitted.memberships_, fitted.transform(x), atol=1e-12)
