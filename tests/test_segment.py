"""Objects from points: the density landscape by hand and against oracles, counts on simulated and on real scenes."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from jaxfuzzy import density
from jaxfuzzy.fcm import fcm
from jaxfuzzy.ground import fit_ground, foreground
from jaxfuzzy.segment import segment
from jaxfuzzy.simulate import simulate_scene
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.stereo import example_pair, reconstruct
from jaxfuzzy.validity import choose_k


def blobs(centers, counts=200, spread=0.02, seed=0):
    """Points round upright poles: (x, z) of each, as many points as told."""
    rng = np.random.default_rng(seed)
    counts = np.broadcast_to(counts, len(centers))
    points = [
        np.stack([x + spread * rng.normal(size=n), rng.uniform(0, 0.2, n), z + spread * rng.normal(size=n)], axis=1)
        for (x, z), n in zip(centers, counts, strict=True)
    ]
    return np.concatenate(points), np.repeat(np.arange(len(centers)), counts)


# The landscape


def test_support_is_a_sum_of_gaussians():
    rng = np.random.default_rng(0)
    # More than a block of either, some places without weight, some queries that nobody asked for.
    places, queries, weights = rng.normal(size=(600, 2)), rng.normal(size=(70, 2)), rng.uniform(0, 2, 600)
    weights[::3], wanted = 0, np.arange(70) % 5 != 2
    bandwidths = 0.3 * density.LADDER
    expected = [
        [
            sum(w * np.exp(-((q - p) ** 2).sum() / (2 * h**2)) for p, w in zip(places, weights, strict=True))
            if asked
            else 0
            for q, asked in zip(queries, wanted, strict=True)
        ]
        for h in bandwidths
    ]
    got = density._supports(*map(jnp.asarray, (queries, wanted, places, weights, bandwidths)))
    # Exponents of up to a few hundred are rounded by some 1e-14 of their own, which squared kernels double.
    np.testing.assert_allclose(got, expected, rtol=1e-11)


def test_tiling_is_noise_clustering():
    """The tiling's own sweep, written for m = 2, against the general fuzzy c-means beside noise: ten plain steps of both."""
    points, _ = blobs([(0, 0), (0.3, 0.1)])
    places, weights = points[:256, [0, 2]], np.linspace(0.5, 1.5, 256)
    h = 0.02
    survey = density._survey(*map(jnp.asarray, (places, weights, np.array([[-0.1, -0.1], [0.4, 0.2]]), h, 256)))
    real = np.asarray(survey.real)
    assert 3 < real.sum() < 64
    prototypes, _ = density._tile(jnp.asarray(places), jnp.asarray(weights), jnp.asarray(h), survey.seeds, survey.real)
    seeds = survey.seeds
    solver = Solver(max_steps=density.SWEEPS, tol=0.0, acceleration=None)
    fit = fcm(places, seeds[real], noise_distance=density.DELTA * h, weights=weights, solver=solver)
    # The tiling bounds distances from below by a thousandth of the noise distance, 5e-5 here.
    np.testing.assert_allclose(prototypes[real], fit.centers, atol=1e-7)


def test_seeds_are_mountains_apart():
    points, _ = blobs([(0, 0)])
    places, h = points[:128, [0, 2]], 0.01
    held = np.exp(-((places[:, None] - places) ** 2).sum(-1) / (2 * h**2)).sum(axis=1)
    seeds, real = density._mountains(*map(jnp.asarray, (places, held, np.ones(128), h, 3.0)), 64)
    taken = []
    left = held.copy()
    while left.max() > 3:
        taken.append(places[left.argmax()])
        left[((places - taken[-1]) ** 2).sum(axis=1) < (2 * h) ** 2] = -1
    np.testing.assert_allclose(np.asarray(seeds)[np.asarray(real)], taken)


def ladder(counts, edge=()):
    """Prominences with so many groups at each rung, 3 and 0.3 of the limit; `edge` maps (rung, rank) to others."""
    found = np.full((8, 20), 0.3)
    for rung, count in enumerate(counts):
        found[rung, :count] = 3.0
    found[:, 0] = np.inf
    for place, value in dict(edge).items():
        found[place] = value
    return jnp.asarray(found)


@pytest.mark.parametrize(
    ("counts", "edge", "level", "number"),
    [
        ([5, 3, 3, 3, 2, 1, 1, 1], (), 2, 3),  # 3 and 1 stay as long: the narrower, at the base
        ([5, 4, 3, 2, 2, 2, 2, 1], (), 3, 2),  # 2 stays longest, from the fourth on
        ([2, 2, 1, 1, 1, 2, 2, 2], (), 1, 2),  # a number that comes back has all its rungs
        ([2, 2, 1, 1, 1, 1, 1, 2], (), 2, 1),
        ([1] * 8, (), 2, 1),
        ([8, 7, 6, 5, 4, 3, 2, 1], (), 2, 6),  # none stays: the base
        ([16, 15, 14, 11, 9, 9, 7, 5], (), 2, 14),  # two alike are chance
        ([9, 8, 7, 6, 5, 5, 5, 4], {(7, 4): 0.999}, 4, 5),  # one that falls short by a hair counts half
        ([9, 8, 7, 6, 5, 5, 4, 4], {(6, 4): 0.8}, 2, 7),  # by a fifth, not at all
    ],
)
def test_the_number_that_stays_longest(counts, edge, level, number):
    assert tuple(map(int, density._steadiest(ladder(counts, edge)))) == (level, number)


def test_a_number_does_not_hang_on_a_hair():
    """With rungs counted whole the last fell to 4 groups as a prominence passed 1: 5 stayed for two, and the base was taken."""
    edges = [ladder([16, 12, 11, 9, 6, 5, 5, 5], {(7, 4): value}) for value in (0.98, 0.999, 1.001, 1.02)]
    assert {tuple(map(int, density._steadiest(edge))) for edge in edges} == {(5, 5)}


def test_less_than_the_background_stands_nowhere():
    found = ladder([4] * 8).at[:, 6:].set(-0.2)
    assert tuple(map(int, density._steadiest(found))) == (2, 4)


def chain(peaks, saddles):
    """Prototypes in a row, each joined to the one before."""
    one, other = np.arange(1, len(peaks)), np.arange(len(peaks) - 1)
    order = np.argsort(-np.asarray(saddles), kind="stable")
    return map(jnp.asarray, (one, other, np.ones(len(one), bool), np.ones(len(peaks), bool), order, saddles, peaks))


def test_prominence_by_hand():
    # 100 | 20 | 64 | 60 | 81: the 64 ends at 60 against the 81, the 81 ends at 20 against the 100.
    valley, prominence = density._prominences(*chain([100.0, 64.0, 81.0], [20.0, 60.0]), jnp.asarray(4.0))
    shallow = min((1 - 60 / 64) / 0.4, 2 * (8 - np.sqrt(60)) / 4)
    deep = min((1 - 20 / 81) / 0.4, 2 * (9 - np.sqrt(20)) / 4)
    np.testing.assert_allclose(valley[1:], [shallow, deep])
    np.testing.assert_allclose(prominence[1:], [shallow, min(deep, 2 * (9 - 2) / 6)])
    assert np.isinf(prominence[0])


def test_join_keeps_what_stands_apart():
    one, other, near, _, order, _, peaks = chain([100.0, 64.0, 81.0, 9.0], [20.0, 60.0, 5.0])
    stands = jnp.asarray([True, False, True, False])
    root = density._join(one[order], other[order], near[order], peaks, stands)
    np.testing.assert_array_equal(root, [0, 2, 2, 2])
    root = density._join(one[order], other[order], near[order].at[2].set(False), peaks, stands)
    np.testing.assert_array_equal(root, [0, 2, 2, 3])


# Simple places


@pytest.mark.parametrize("centers", [[(0, 0)], [(0, 0), (0.4, 0)], [(0, 0), (0.3, 0.2), (-0.3, 0.3), (0.1, -0.4)]])
def test_poles_are_counted(centers):
    points, truth = blobs(centers)
    found = segment(points)
    assert found.k == len(centers)
    assert adjusted_rand_score(truth, found.labels) > 0.99
    assert int(found.status) == 0
    assert found.count is None
    assert found.seeds is None


def test_partition_is_a_fuzzy_partition_whose_hardened_labels_are_the_labels():
    points, _ = blobs([(0, 0), (0.3, 0.1), (-0.2, 0.3)], (300, 200, 100))
    points = np.concatenate([points, np.random.default_rng(1).uniform([-1, 0, -1], [1, 0.2, 1], (150, 3))])
    found = segment(points)
    part, labels = found.partition, np.asarray(found.labels)
    u, noise = np.asarray(part.memberships), np.asarray(part.noise)
    assert u.shape == (len(points), found.k)
    np.testing.assert_allclose(u.sum(axis=1) + noise, 1, atol=1e-12)
    assert u.min() >= 0
    np.testing.assert_array_equal(labels, np.where(noise > u.max(axis=1), -1, u.argmax(axis=1)))
    np.testing.assert_array_equal(labels, part.labels)
    assert 0.5 < (labels[600:] < 0).mean() < 1
    np.testing.assert_allclose(found.shares, np.bincount(labels[labels >= 0]) / (labels >= 0).sum())
    np.testing.assert_allclose(part.centers, (u**2).T @ points / (u**2).sum(axis=0)[:, None], atol=1e-12)
    # Eq. 11 with m = 2, the distances those in the plane.
    squared = ((points[:, None] - np.asarray(part.centers))[..., [0, 2]] ** 2).sum(axis=-1)
    sizes = np.sqrt((u**2 * squared).sum(axis=0))
    np.testing.assert_allclose(found.sizes, sizes / sizes.sum(), rtol=1e-10)
    np.testing.assert_allclose(found.sizes, part.sizes)


def test_a_point_alone_is_an_outlier_and_two_are_not():
    points, _ = blobs([(0, 0)])
    lone = np.array([[1.0, 0.1, 1.0]])
    assert np.asarray(segment(np.concatenate([points, lone])).labels)[-1] == -1
    assert (np.asarray(segment(points).labels) == 0).all()


def test_objects_are_in_the_order_of_their_density():
    points, truth = blobs([(0, 0), (0.4, 0), (0, 0.4)], (100, 400, 200))
    found = segment(points)
    assert [np.bincount(truth[np.asarray(found.labels) == i]).argmax() for i in range(3)] == [1, 2, 0]


def test_numbers_allowed():
    points, _ = blobs([(0, 0), (0.4, 0), (0, 0.4)], (400, 200, 100))
    assert segment(points, ks=(1, 2, 3, 4)).k == 3
    fewer = segment(points, ks=(1, 2))
    assert fewer.k == 2
    assert int(fewer.status) & Status.AT_BOUND
    assert (np.asarray(fewer.labels)[-100:] == -1).all()
    assert segment(points, ks=(2, 5)).k == 2  # the nearest, the lower of two
    assert int(segment(points, ks=(3,)).status) & Status.AT_BOUND
    assert segment(points, ks=[4]).k == 4
    short = segment(points[:5], ks=(5,))
    assert short.k == 5 or int(short.status) & Status.TOO_FEW_POINTS


def test_noise_distance_is_the_least_bandwidth():
    points, _ = blobs([(0, 0), (0.3, 0)])
    assert segment(points).k == 2
    assert segment(points, noise_distance=0.3).k == 1
    assert segment(points, noise_distance=np.full(400, 0.3)).k == 1
    tiny = segment(points, noise_distance=1e-5)
    np.testing.assert_array_equal(tiny.labels, segment(points).labels)


def test_weights():
    points, _ = blobs([(0, 0), (0.4, 0)])
    found = segment(points)
    np.testing.assert_array_equal(segment(points, weights=np.full(400, 3.0)).labels, found.labels)
    # Weight 0 is the point absent, though it gets a label; a third pole of such points is no object.
    more = np.concatenate([points, blobs([(0, 0.5)])[0]])
    absent = segment(more, weights=np.repeat([1.0, 0.0], [400, 200]))
    assert absent.k == 2
    np.testing.assert_array_equal(np.asarray(absent.labels)[:400], found.labels)
    np.testing.assert_allclose(absent.partition.memberships[:400], found.partition.memberships, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_invariance(dtype):
    scene = simulate_scene(3, 11, outliers=0.15)
    points = np.asarray(scene.points, dtype)
    found = segment(points)
    assert found.partition.memberships.dtype == dtype
    turn = np.array([[np.cos(0.7), 0, np.sin(0.7)], [0, 1, 0], [-np.sin(0.7), 0, np.cos(0.7)]], dtype)
    shuffle = np.random.default_rng(0).permutation(len(points))
    changed = {
        "shift": points + np.array([3, -1, 2], dtype),
        "unit": points * dtype(1000),
        "yaw": points @ turn.T,
        "order": points[shuffle],
    }
    for name, other in changed.items():
        again = segment(other)
        at = shuffle if name == "order" else slice(None)
        u, labels = np.asarray(found.partition.memberships)[at], np.asarray(found.labels)[at]
        assert again.k == found.k, name
        if dtype == np.float64:
            np.testing.assert_array_equal(again.labels, labels, err_msg=name)
            np.testing.assert_allclose(again.partition.memberships, u, atol=1e-6, err_msg=name)
        else:
            # In single precision a point may change its cell when it is moved: its membership changes with it.
            assert (np.asarray(again.labels) == labels).mean() > 0.995, name
            assert np.quantile(np.abs(np.asarray(again.partition.memberships) - u), 0.9) < 1e-2, name


def test_any_vertical_direction():
    points, truth = blobs([(0, 0), (0.4, 0), (0, 0.4)])
    lying = points[:, [1, 2, 0]]  # the poles along x
    for up in ((1, 0, 0), (-1, 0, 0)):
        assert adjusted_rand_score(truth, segment(lying, up=up).labels) > 0.99


# Simulated scenes


@pytest.mark.parametrize(
    ("options", "right"),
    [
        ({"outliers": 0.0}, 9),
        ({"outliers": 0.25}, 9),
        ({"outliers": 0.4}, 9),
        ({"spacing": 0.22}, 9),
        ({"stripes": 0.3}, 8),
    ],
)
def test_objects_of_simulated_scenes(options, right):
    """Ten scenes of one to five objects; of hundreds, 99, 99, 99, 99 and 95 in a hundred are counted right (benchmarks)."""
    counted, agree = 0, []
    for seed in range(10):
        k = 1 + seed % 5 if "spacing" not in options else 2 + seed % 4
        scene = simulate_scene(k, seed, **options)
        found = segment(scene.points)
        counted += found.k == k
        own = scene.labels >= 0
        if found.k == k:
            agree.append(adjusted_rand_score(scene.labels[own], np.asarray(found.labels)[own]))
    assert counted >= right
    assert np.mean(agree) > 0.99


# The paper's rule


def test_papers_rule():
    points, truth = blobs([(0, 0), (0.5, 0)], (600, 200))
    found = segment(points, ks=(2, 3), rule="paper")
    assert found.k == 2
    assert adjusted_rand_score(truth, found.labels) == 1
    assert found.seeds.centers.shape == (2, 2)
    expected = choose_k(np.stack([points[:, 0], -points[:, 2]], axis=1), (2, 3))
    np.testing.assert_allclose(found.count.scores, expected.scores, rtol=1e-9)
    # The denser pole is three times as heavy with the same spread: alpha goes with the root of the share.
    np.testing.assert_allclose(max(found.sizes), np.sqrt(3) / (1 + np.sqrt(3)), atol=0.02)
    np.testing.assert_allclose(max(found.shares), 0.75)


def test_papers_rule_has_no_single_object():
    points, _ = blobs([(0, 0)])
    found = segment(points, ks=(1, 2, 3), rule="paper")
    assert found.k > 1
    assert int(found.status) & Status.SKIPPED_ONE
    with pytest.raises(ValueError, match="ks must hold a number above 1 for rule='paper'"):
        segment(points, ks=(1,), rule="paper")


# Bad input


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.zeros((2, 3)),
        np.ones((50, 3)),
        np.outer(np.linspace(0, 1, 40), [1.0, 0.0, 1.0]),
        np.outer(np.linspace(0, 1, 40), [0.0, 1.0, 0.0]),
        np.concatenate([blobs([(0, 0)])[0], [[1e9, 0, 0]]]),
    ],
    ids=["one", "two", "equal", "line", "pole", "far"],
)
def test_degenerate_points(points):
    found = segment(points)
    assert found.k >= 1
    for leaf in (found.sizes, found.shares, found.partition.memberships, found.partition.centers):
        assert np.isfinite(np.asarray(leaf)).all()
    np.testing.assert_allclose(np.asarray(found.sizes).sum(), 1)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"points": np.zeros((5, 2))}, ValueError, r"points must have shape \(N, 3\)"),
        ({"points": np.full((5, 3), np.nan)}, ValueError, "points must be finite"),
        ({"ks": ()}, ValueError, "ks must hold at least one number"),
        ({"ks": (2, 2)}, ValueError, "none twice"),
        ({"ks": (0, 1)}, ValueError, "ks must be at least 1"),
        ({"ks": (2, 500)}, ValueError, "ks must be at least 1 and at most 200"),
        ({"ks": "all"}, ValueError, "ks must be one of 'auto'"),
        ({"ks": (1.5,)}, TypeError, "ks must be a whole number"),
        ({"up": (0, 0, 0)}, ValueError, "up must be finite and not of length zero"),
        ({"rule": "best"}, ValueError, "rule must be one of 'robust', 'paper'"),
        ({"noise_distance": 0.0}, ValueError, "noise_distance must be finite and above 0"),
        ({"noise_distance": None}, TypeError, "noise_distance must be 'auto' or above 0, got None"),
        ({"weights": -np.ones(200)}, ValueError, "weights must not be negative"),
        ({"camera": (0, 0)}, ValueError, r"camera must have shape \(3,\)"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    arguments = {"points": blobs([(0, 0)])[0]} | change
    with pytest.raises(error, match=message):
        segment(arguments.pop("points"), **arguments)


# Real scenes


def test_cones_of_the_bundled_pair_stand_alone():
    left, right, rig = example_pair()
    cloud = reconstruct(cv2.imread(str(left)), cv2.imread(str(right)), rig)
    ground = fit_ground(cloud.points, depth_std=cloud.depth_std)
    own = np.flatnonzero(foreground(cloud.points, ground).mask)
    found = segment(
        np.asarray(cloud.points)[own], up=ground.plane.normal, noise_distance=2.5 * np.asarray(ground.depth_std)[own]
    )
    assert 10 <= found.k <= 18  # a person sees about fourteen
    labels = np.asarray(found.labels)
    columns, rows = np.asarray(cloud.pixels_px)[own].astype(int).T
    # Column of the axis, row of the rim, half-width there, row of the tip: the front cones and the red one behind them.
    cones = [(120, 335, 38, 220), (240, 335, 38, 230), (83, 290, 38, 175), (180, 305, 20, 195), (135, 215, 25, 140)]
    names = []
    for middle, rim, half, tip in cones:
        inside = (rows > tip) & (rows < rim) & (np.abs(columns - middle) < 0.7 * half * (rows - tip) / (rim - tip))
        counts = np.bincount(labels[inside] + 1)
        names.append(counts.argmax())
        assert counts.max() / inside.sum() > 0.9
        assert (labels == counts.argmax() - 1).sum() < 3.5 * inside.sum()  # the triangle is a third of its cone
    assert len(set(names)) == len(cones)


@pytest.mark.parametrize(
    ("name", "objects", "most"), [("learn0", 2, 3), ("learn33", 5, 6), ("learn36", 3, 5), ("learn44", 3, 4)]
)
def test_objects_of_labelled_tables(shared_data, name, objects, most):
    """Hollow vessels are split into front and inner wall, which only shapes can mend; nothing is merged."""
    cloud = np.load(shared_data / "mosd" / f"{name}.npz")
    seen = np.isfinite(cloud["xyz"]).all(axis=-1)
    points, truth = cloud["xyz"][seen], cloud["label"][seen] // 10
    ground = fit_ground(points)
    own = np.asarray(foreground(points, ground).mask)
    noise = 2.5 * np.asarray(ground.depth_std)[own]
    found = segment(points[own], up=ground.plane.normal, noise_distance=noise)
    assert objects <= found.k <= most
    labels, truth = np.asarray(found.labels), truth[own]
    for i in range(found.k):
        names = np.bincount(truth[(labels == i) & (truth >= 2)])
        assert names.max() / names.sum() > 0.95


def test_the_mug_stands_alone(shared_data):
    """Front, inner wall and handle, for shapes to put together; what else there is are crumbs."""
    xyz = np.load(shared_data / "pcl_mug_stereo" / "table_scene_mug_stereo_textured.npz")["xyz"]
    points = xyz[np.isfinite(xyz).all(axis=-1)]
    ground = fit_ground(points)
    own = np.asarray(foreground(points, ground).mask)
    found = segment(points[own], up=ground.plane.normal, noise_distance=2.5 * np.asarray(ground.depth_std)[own])
    assert found.k <= 6
    assert np.sort(found.shares)[::-1][:3].sum() > 0.95
