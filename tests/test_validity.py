"""Validity indices against their definitions, and the choice of k."""

import chex
import jax
import numpy as np
import pytest

import oracles
from jaxfuzzy import validity
from jaxfuzzy.fcm import fcm
from jaxfuzzy.seeding import histogram_seeds
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.validity import choose_k, fuzzy_silhouette, partition_coefficient, variance_ratio, xie_beni

pytestmark = pytest.mark.usefixtures("compiled_for_one_run")


def lumps(k=3, seed=0, counts=(60, 90, 40, 50)):
    rng = np.random.default_rng(seed)
    centers = np.array([[0, 0], [7, 1], [2, 8], [-7, 5]])[:k]
    return np.concatenate([c + rng.normal(size=(n, 2)) for c, n in zip(centers, counts, strict=False)])


def test_variance_ratio_is_eq_6():
    x = lumps()
    labels = np.asarray(choose_k(x, (3,)).partition.labels)
    np.testing.assert_allclose(variance_ratio(x, labels), oracles.variance_ratio(x, labels), rtol=1e-12)
    # By hand: clusters {0, 2} and {9, 11} on a line: means 1 and 10, S_B = 4 * 4.5^2 = 81, S_W = 4, (81 / 1) / (4 / 2) = 40.5.
    np.testing.assert_allclose(variance_ratio(np.array([[0.0], [2], [9], [11]]), np.array([0, 0, 1, 1])), 40.5)
    # Outliers are left out; weights count as repetitions.
    np.testing.assert_allclose(
        variance_ratio(np.array([[0.0], [2], [9], [11], [99]]), np.array([0, 0, 1, 1, -1])), 40.5
    )
    twice = variance_ratio(np.array([[0.0], [2], [9], [11]]), np.array([0, 0, 1, 1]), weights=np.array([2, 1, 1, 1]))
    np.testing.assert_allclose(
        twice, oracles.variance_ratio(np.array([[0.0], [0], [2], [9], [11]]), np.array([0, 0, 0, 1, 1]))
    )


def test_other_indices_are_their_definitions():
    x = lumps()
    p = fcm(x, histogram_seeds(x, 3).centers, m=1.8)
    u, v = np.asarray(p.memberships), np.asarray(p.centers)
    d = ((x[:, None] - v[None]) ** 2).sum(axis=-1)
    gap = min(((v[i] - v[j]) ** 2).sum() for i in range(3) for j in range(i))
    np.testing.assert_allclose(xie_beni(x, p), (u**1.8 * d).sum() / (len(x) * gap), rtol=1e-12)
    pc = (u**2).sum() / len(x)
    np.testing.assert_allclose(partition_coefficient(p), pc, rtol=1e-12)
    np.testing.assert_allclose(partition_coefficient(p, modified=True), 1 - 3 / 2 * (1 - pc), rtol=1e-12)
    labels, apart = np.asarray(p.labels), np.sqrt(((x[:, None] - x[None]) ** 2).sum(axis=-1))
    width = np.zeros(len(x))
    for k in range(len(x)):
        own = labels == labels[k]
        a = apart[k, own].sum() / (own.sum() - 1)
        b = min(apart[k, labels == j].mean() for j in range(3) if j != labels[k])
        width[k] = (b - a) / max(a, b)
    top = np.sort(u, axis=1)
    share = top[:, -1] - top[:, -2]
    np.testing.assert_allclose(fuzzy_silhouette(x, p), share @ width / share.sum(), rtol=1e-10)


# Each is a compilation of its own; those whose formula is tested above by itself are slow ones.
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("xie_beni", "modified_partition_coefficient")]


def test_points_of_noise_count_in_no_index():
    rng = np.random.default_rng(0)
    own = np.concatenate([rng.normal(size=(60, 2)), rng.normal(size=(60, 2)) + [8, 0]])
    angle = np.linspace(0, 6, 90)[:, None]
    far = np.concatenate([own, [4, 0] + 60 * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)])
    fit = lambda points: fcm(points, np.array([[0.0, 0], [8, 0]]), noise_distance=2.0)
    alone, beside = fit(own), fit(far)
    assert (np.asarray(beside.labels)[120:] == -1).all()
    for index in (
        lambda points, of: partition_coefficient(of),
        lambda points, of: partition_coefficient(of, modified=True),
        lambda points, of: xie_beni(points, of),
        lambda points, of: fuzzy_silhouette(points, of),
    ):
        # Far points still pull the centers by their small memberships.
        np.testing.assert_allclose(index(far, beside), index(own, alone), rtol=2e-3)


@pytest.mark.parametrize("index", ["vrc", "fuzzy_silhouette", "jump", *SLOW])
def test_right_number_of_clear_lumps(index):
    for k in (2, 3, 4):
        ks = (1, 2, 3, 4, 5) if index == "jump" else (2, 3, 4, 5)
        assert int(choose_k(lumps(k), ks, index=index, rule="best").k) == k, index


def test_one_cluster_can_be_said_by_jump():
    x = lumps(1, counts=(200,))
    assert int(choose_k(x, range(1, 6), index="jump", rule="best").k) == 1
    with pytest.raises(ValueError, match="jump"):
        choose_k(x, (1, 2, 3))


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        ([5, 9, 7, 8, 6], 1),  # two local maxima: the smaller k
        ([9, 7, 5, 4], 0),  # the lower end counts when above its neighbour
        ([1, 2.5, 3, 4], 1),  # only the upper end: the first abrupt rise
        ([1, 1.2, 1.5, 1.8], 3),  # no abrupt rise either: the largest
        ([1, 3, 2, 9], 1),
        ([4], 0),
    ],
)
def test_the_papers_rule(scores, chosen):
    assert validity._pick(np.array(scores, float), "vrc", "paper") == chosen


def test_the_papers_rule_fails_where_it_is_known_to():
    # Three lumps of which two stand close together: VRC has its first local maximum at 2, its best value at 3.
    rng = np.random.default_rng(0)
    lump = lambda at: rng.normal(size=(60, 2)) * 0.5 + at
    x = np.concatenate([lump([0, 0]), lump([4, 0]), lump([40, 0]), lump([44, 0])])
    assert int(choose_k(x, range(2, 7)).k) == 2
    assert int(choose_k(x, range(2, 7), rule="best").k) == 4


def test_all_ks_in_one_compiled_call_as_one_by_one():
    x = lumps()
    # Plain steps: Anderson's mix amplifies rounding on the way, though not at the end.
    few = Solver(8, 0.0, None)
    before = validity._fit_all._cache_size()
    together = choose_k(x, (2, 3, 4, 5), m=1.7, sizes=True, noise_distance=3.0, solver=few)
    choose_k(x + 1, (2, 3, 4, 5), m=1.9, sizes=True, noise_distance=4.0, solver=few)
    assert validity._fit_all._cache_size() == before + 1
    for row, k in enumerate((2, 3, 4, 5)):
        alone = fcm(x, histogram_seeds(x, k).centers, m=1.7, sizes=True, noise_distance=3.0, solver=few)
        padded = jax.tree.map(lambda leaf, row=row: leaf[row], together.partitions)
        # Pads are zeros in every sum; what differs is the order of additions: a few roundings of coordinates up to 10.
        tolerance = 8 * np.finfo(float).eps * np.abs(x).max()
        chex.assert_trees_all_close(padded.centers[:k], alone.centers, atol=10 * tolerance)
        chex.assert_trees_all_close(padded.sizes[:k], alone.sizes, atol=tolerance)
        chex.assert_trees_all_close(padded.memberships[:, :k], alone.memberships, atol=100 * tolerance)
        np.testing.assert_array_equal(padded.memberships[:, k:], 0)
        np.testing.assert_array_equal(padded.sizes[k:], 0)


def test_choice_is_unpadded_and_scored():
    x = lumps()
    count = choose_k(x)
    assert count.partition.centers.shape == (3, 2)
    assert count.partitions.centers.shape == (4, 5, 2)
    for row in range(4):
        labels = np.asarray(count.partitions.labels[row])
        np.testing.assert_allclose(count.scores[row], oracles.variance_ratio(x, labels), rtol=1e-10)
    late = choose_k(x, solver=Solver(1, 1e-9))
    assert int(late.status) & Status.NOT_CONVERGED


def test_wrong_arguments_are_named():
    x = lumps()
    for ks in ((), (2, 2), (0, 2), (2, 10_000)):
        with pytest.raises(ValueError, match="ks must"):
            choose_k(x, ks)
    with pytest.raises(ValueError, match="index"):
        choose_k(x, index="nice")
    with pytest.raises(ValueError, match="jump"):
        choose_k(x, (2, 3), index="jump")
    with pytest.raises(ValueError, match="rule"):
        choose_k(x, rule="nice")
    with pytest.raises(ValueError, match="mesh"):
        choose_k(
            np.random.default_rng(0).normal(size=(30, 2)), (2, 3), solver=Solver(mesh=jax.make_mesh((1,), ("points",)))
        )
    with pytest.raises(ValueError, match="labels"):
        variance_ratio(x, np.zeros(len(x), int))
    with pytest.raises(ValueError, match="memberships"):
        xie_beni(x, fcm(x, x[:2], memberships=False))
