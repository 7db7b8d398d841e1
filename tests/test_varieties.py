from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oracles_varieties as oracle
from jaxfuzzy import embedding as emb
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.varieties import nfcv

pytestmark = pytest.mark.usefixtures("compiled_for_one_run")
EPS = np.finfo(float).eps
ONCE = Solver(max_steps=1, tol=0.0, acceleration=None)
TIGHT = Solver(max_steps=2000, tol=1e-14)


def arc(center, seed, count=120, outliers=20, noise=0.02):
    """The near half of an upright cylinder of radius 0.5 and height 2, and uniform outliers round it."""
    rng = np.random.default_rng(seed)
    angle, y = rng.uniform(-1.4, 1.4, count), rng.uniform(-1, 1, count)
    surface = np.stack([0.5 * np.sin(angle), y, -0.5 * np.cos(angle)], 1) + noise * rng.normal(size=(count, 3))
    return np.vstack([surface, rng.uniform(-1, 1, (outliers, 3))]) + center


POINTS = np.vstack([arc([-1.0, -0.2, 0.8], 0), arc([1.0, 0.3, -0.2], 1)])
OWN = np.repeat(np.eye(2), 140, axis=0)
START = 0.7 * OWN + 0.3 * np.random.default_rng(1).dirichlet([1, 1], 280)
WEIGHTS = np.random.default_rng(2).uniform(0.2, 2, len(POINTS))
PAIR = ("4d", "6d")
ONE, ALL = POINTS[:140], np.ones((140, 1))


@pytest.mark.parametrize(("names", "dimension"), [(("4d", "6d"), None), (("3d", "6d"), 2)])
def test_algebraic_is_the_paper_to_the_letter(names, dimension):
    points = POINTS + [4, 0, 7]  # raw camera coordinates: the paper centers nothing
    options = {"noise_distance": 3.0, "m": 1.7, "distance": "algebraic", "weights": WEIGHTS, "solver": ONCE}
    together = nfcv(points, START, embedding=names, dimension=dimension, **options)
    for e, name in enumerate(names):
        x, u = np.asarray(emb.features(points, name)), START.T
        size = x.shape[1]
        q = dimension or size - 1
        for _ in range(2):
            centers, bases, squared = oracle.algebraic_step(x, u, q, 1.7, WEIGHTS)
            u, rest = oracle.memberships(squared, 1.7, 3.0)
        fit = jax.tree.map(lambda leaf, e=e: leaf[e], replace(together, m=WEIGHTS, noise_distance=WEIGHTS))
        # eq. 13 is a difference of squares near 100 here, so it leaves distances down to 1e-7 only seven digits
        np.testing.assert_allclose(fit.memberships, u.T, atol=1e-6)
        np.testing.assert_allclose(fit.noise, rest, atol=1e-6)
        np.testing.assert_allclose(fit.centers[:, :size], centers, rtol=1e-7)
        np.testing.assert_allclose(fit.squared_distances, squared.T, rtol=1e-6, atol=1e-10)
        expected = oracle.objective(squared, u, rest, 1.7, 3.0, WEIGHTS)
        assert float(fit.objective) == pytest.approx(expected, rel=1e-9)
        for i in range(2):
            basis = fit.basis[i, :size, :q]
            np.testing.assert_allclose(basis @ basis.T, bases[i] @ bases[i].T, atol=1e-7)
            np.testing.assert_allclose(basis.T @ basis, np.eye(q), atol=1e-13)
            if q == size - 1:
                np.testing.assert_allclose(fit.normals[i, :size] @ basis, 0, atol=1e-12)
            else:
                np.testing.assert_array_equal(fit.normals[i], 0)


def test_geometric_is_taubins_step():
    options = {"noise_distance": 0.3, "m": 1.8, "weights": WEIGHTS, "solver": ONCE}
    together = nfcv(POINTS, START, embedding=PAIR, **options)
    for e, name in enumerate(PAIR):
        x, gradients = np.asarray(emb.features(POINTS, name)), np.asarray(emb.gradients(POINTS, name))
        u, size = START.T, x.shape[1]
        for _ in range(2):
            centers, normals, squared = oracle.geometric_step(x, gradients, u, 1.8, WEIGHTS)
            u, rest = oracle.memberships(squared, 1.8, 0.3)
        np.testing.assert_allclose(together.memberships[e], u.T, atol=1e-10)
        np.testing.assert_allclose(together.noise[e], rest, atol=1e-10)
        np.testing.assert_allclose(together.squared_distances[e], squared.T, rtol=1e-8, atol=1e-11)
        cosines = np.sum(together.normals[e, :, :size] * normals, 1)
        np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-12)
        np.testing.assert_allclose(together.centers[e, :, :size], centers, atol=1e-11)


def test_five_points_by_hand():
    """Three points on y = 0, two 3 off it: with delta = 2 those belong by 1 / (1 + 9 / 4) = 4 / 13, which keeps the line.

    Scatter along is 2² + 2² = 8, across 2 (4 / 13)² 3² = 1.7; F = 2 · 9 · 4 / (9 + 4) = 72 / 13.
    """
    points = np.array([[0.0, 0], [2, 0], [4, 0], [2, 3], [2, -3]])
    share = 4 / 13
    start = np.array([[1.0], [1], [1], [share], [share]])
    fit = nfcv(points, start, embedding="linear", noise_distance=2.0, solver=ONCE)
    np.testing.assert_allclose(fit.squared_distances[:, 0], [0, 0, 0, 9, 9], atol=1e-15)
    np.testing.assert_allclose(fit.memberships[:, 0], start[:, 0], atol=1e-15)
    np.testing.assert_allclose(fit.noise, [0, 0, 0, 1 - share, 1 - share], atol=1e-15)
    np.testing.assert_allclose(fit.centers, [[2, 0]], atol=1e-15)
    np.testing.assert_allclose(fit.normals, [[0, 1]], atol=1e-15)
    np.testing.assert_allclose(np.abs(fit.basis[0, :, 0]), [1, 0], atol=1e-15)
    np.testing.assert_allclose(fit.unit**2, (4 + 4 + 9 + 9) / 5)
    scatter = np.diag([8, 2 * 9 * share**2]) / (3 + 2 * share**2)
    np.testing.assert_allclose(fit.scatter[0] * fit.unit**2, scatter, atol=1e-14)
    np.testing.assert_allclose(fit.objective, 72 / 13)
    np.testing.assert_array_equal(fit.labels, [0, 0, 0, -1, -1])
    np.testing.assert_array_equal(fit.inliers, [True, True, True, False, False])


def test_algebraic_objective_never_rises():
    options = {"embedding": PAIR, "noise_distance": 0.3, "distance": "algebraic", "weights": WEIGHTS, "solver": ONCE}
    fit, values = nfcv(POINTS, START, **options), []
    for _ in range(25):
        fit = nfcv(POINTS, fit, **options)
        values.append(np.asarray(fit.objective))
    # rounding of the sums
    assert (np.diff(values, axis=0) <= 1e-13 * values[0]).all()
    assert (values[-1] < 0.99 * values[0]).all()


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_answer_is_a_fixed_point(distance):
    options = {"embedding": "cylinder", "noise_distance": 0.3, "distance": distance, "solver": TIGHT}
    fit = nfcv(ONE, ALL, **options)
    assert not int(fit.status) & Status.NOT_CONVERGED
    again = nfcv(ONE, fit, **options)
    assert int(again.steps) <= 2
    np.testing.assert_allclose(again.memberships, fit.memberships, atol=1e-12)


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_embeddings_side_by_side_are_as_one_by_one_and_padding_is_none(distance):
    options = {"noise_distance": 0.3, "distance": distance, "weights": WEIGHTS, "solver": ONCE}
    together = nfcv(POINTS, START, embedding=PAIR, **options)
    assert together.centers.shape == (2, 2, 6)
    assert together.embedding == PAIR
    for i, name in enumerate(PAIR):
        alone = nfcv(POINTS, START, embedding=name, **options)
        assert int(alone.status) & Status.NOT_CONVERGED
        q = alone.centers.shape[1]
        for field in ("squared_distances", "memberships", "noise", "objective", "bounds"):
            # 8 eps grow 1e4-fold: two varieties in 6D, each fitted twice with eigenvalue gaps near 1e-2
            np.testing.assert_allclose(getattr(together, field)[i], getattr(alone, field), rtol=1e-10, atol=1e-10)
        for field in ("centers", "normals"):
            np.testing.assert_allclose(getattr(together, field)[i][:, :q], getattr(alone, field), atol=1e-10)
            np.testing.assert_array_equal(getattr(together, field)[i][:, q:], 0)
        np.testing.assert_array_equal(together.basis[i][:, q:], 0)
        np.testing.assert_array_equal(together.labels[i], alone.labels)


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_hostile_padding_is_no_padding(distance):
    rng = np.random.default_rng(5)
    where = np.sort(rng.choice(160, 140, replace=False))
    padded, start, weights = 1e6 * rng.normal(size=(160, 3)), rng.uniform(size=(160, 1)), np.zeros(160)
    padded[where], start[where], weights[where] = ONE, ALL, 1
    options = {"embedding": "cylinder", "noise_distance": 0.3, "distance": distance, "solver": TIGHT}
    alone, fit = nfcv(ONE, ALL, **options), nfcv(padded, start, weights=weights, **options)
    np.testing.assert_allclose(fit.memberships[where], alone.memberships, atol=800 * EPS)
    np.testing.assert_allclose(fit.centers, alone.centers, atol=800 * EPS)
    np.testing.assert_allclose(fit.bounds, alone.bounds, atol=800 * EPS)
    assert int(fit.status) == int(alone.status) == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((fit.scatter, fit.slopes, fit.objective)))


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_points_of_weight_zero_are_where_they_are(distance):
    weights = np.arange(140) % 5 > 0
    options = {"embedding": "cylinder", "noise_distance": 0.3, "distance": distance, "solver": TIGHT}
    run = lambda w: nfcv(ONE, ALL, weights=w, **options)
    fit, whole = run(weights.astype(float)), nfcv(ONE, ALL, **options)
    alone = nfcv(ONE[weights], ALL[weights], **options)
    np.testing.assert_allclose(fit.centers, alone.centers, atol=800 * EPS)
    np.testing.assert_allclose(fit.bounds, alone.bounds, atol=800 * EPS)
    # The points are about a tenth of the noise distance off, held out or not; none is where their mean is.
    held_out, there = (np.sqrt(of.squared_distances[~weights, 0]) for of in (fit, whole))
    np.testing.assert_allclose(held_out, there, atol=0.1 * np.ptp(there) + 1e-3)
    total = lambda w: run(w).centers.sum() + run(w).objective
    w = jnp.asarray(weights, float)
    here, one, two = (total(w.at[5].set(step)) for step in (0.0, 1e-4, 2e-4))
    # The quotient of two differences of 1e-4 has an error of 1e-8 of the third derivative, and of 1e-12 of rounding.
    np.testing.assert_allclose(jax.grad(total)(w)[5], (4 * one - two - 3 * here) / 2e-4, rtol=1e-6, atol=1e-8)


def test_arguments_of_another_kind_are_named():
    with pytest.raises(TypeError, match="solver must be a Solver, got str"):
        nfcv(ONE, ALL, solver="anderson")
    with pytest.raises(TypeError, match="embedding must be a name or several, got 5"):
        nfcv(ONE, ALL, embedding=5)
    start = np.concatenate([ALL, ALL * (np.arange(len(ALL)) < 3)[:, None]], axis=1)
    with pytest.raises(ValueError, match="no column all zero where points have weight, got column 1"):
        nfcv(ONE, start, weights=np.arange(len(ONE)) >= 3)


def test_weights_count_points():
    counts = np.random.default_rng(6).permutation(np.repeat([0, 1, 2, 1], 35))
    options = {"embedding": "cylinder", "noise_distance": 0.3, "solver": TIGHT}
    weighted, repeated = nfcv(ONE, ALL, weights=counts, **options), nfcv(np.repeat(ONE, counts, 0), ALL, **options)
    np.testing.assert_allclose(np.repeat(weighted.memberships, counts, 0), repeated.memberships, atol=800 * EPS)
    np.testing.assert_allclose(weighted.objective, repeated.objective, rtol=800 * EPS)


def test_compiled_is_eager_and_one_compilation_serves_all_values():
    def fit(points, start, noise_distance, m):
        return nfcv(points, start, embedding="cylinder", noise_distance=noise_distance, m=m, solver=TIGHT)

    compiled = jax.jit(fit)
    for noise, m in ((0.3, 2.0), (0.5, 1.7)):
        for a, b in zip(*(jax.tree.leaves(f(ONE, ALL, noise, m)) for f in (compiled, fit)), strict=True):
            if a.dtype == float:
                np.testing.assert_allclose(a, b, rtol=0, atol=800 * EPS)
    assert compiled._cache_size() == 1


def test_far_noise_is_no_noise():
    options = {"embedding": "cylinder", "solver": TIGHT}
    plain, far = nfcv(ONE, ALL, **options), nfcv(ONE, ALL, noise_distance=1e7, **options)
    assert float(far.noise.max()) < 1e-13
    np.testing.assert_array_equal(plain.memberships, 1)
    np.testing.assert_allclose(far.normals, plain.normals, atol=1e-11)
    np.testing.assert_allclose(far.objective, plain.objective, rtol=1e-11)
    np.testing.assert_array_equal(plain.noise, 0)
    assert np.isinf(plain.noise_distance)
    assert (plain.labels >= 0).all()
    assert plain.inliers.all()


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_near_noise_takes_all(distance):
    """All but the few points that any surface passes through; the status says that these prove nothing."""
    options = {"embedding": "cylinder", "distance": distance, "solver": TIGHT}
    for noise_distance in (1e-5, 1e-9):
        none = nfcv(ONE, ALL, noise_distance=noise_distance, **options)
        assert (np.asarray(none.noise) > 0.99).sum() >= 140 - 3
        assert int(none.status) & (Status.ALL_NOISE | Status.TOO_FEW_POINTS)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(none))


def test_noise_distance_may_differ_from_point_to_point():
    each = np.where(np.arange(140) < 100, 0.3, 0.1)
    fit = nfcv(ONE, ALL, embedding="cylinder", noise_distance=each, solver=TIGHT)
    expected = 1 / (1 + np.asarray(fit.squared_distances[:, 0]) / each**2)
    np.testing.assert_allclose(fit.memberships[:, 0], expected, rtol=1e-10)


CASES = {
    "algebraic, padded": (POINTS, START, {"embedding": ("3d", "6d"), "distance": "algebraic"}, 0.3),
    "algebraic, q = 2 of 6": (POINTS, START, {"embedding": "6d", "dimension": 2, "distance": "algebraic"}, 0.3),
    "geometric, padded": (ONE, ALL, {"embedding": ("3d", "cylinder", "6d")}, 0.3),
    "geometric, two planes, no noise cluster": (POINTS, START, {"embedding": "3d"}, None),
}


def line_of_squares():
    """Squares round the z axis: off the line both eigenvalues are the same."""
    corner = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    height = np.linspace(-3, 3, 12)
    points = np.concatenate([np.column_stack([0.3 * corner, np.full(4, z)]) for z in height])
    return points, np.ones((len(points), 1))


CASES["repeated eigenvalues, q = 1"] = (*line_of_squares(), {"embedding": "3d", "dimension": 1}, 0.5)


# Each compiles for a while; the two with the most corners are looked at every time.
EVERY_TIME = ("geometric, padded", "repeated eigenvalues, q = 1")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in EVERY_TIME else pytest.mark.slow) for name in CASES]
)
def test_gradients_are_central_differences(name):
    points, start, options, noise = CASES[name]
    rng = np.random.default_rng(7)
    arguments = {"points": points, "m": np.array(2.2), "weights": np.ones(len(points))}
    if noise is not None:
        arguments["noise_distance"] = np.array(noise)

    def outcome(arguments):
        fit = nfcv(start=start, solver=TIGHT, **options, **arguments)
        parts = (fit.memberships, fit.noise, fit.squared_distances, fit.objective, fit.centers, fit.normals)
        mix = np.random.default_rng(8)
        return sum(jnp.sum(mix.normal(size=p.shape) * p) for p in parts)

    both = jax.jit(jax.value_and_grad(outcome))
    slope = both(arguments)[1]
    for key, at in arguments.items():
        direction = rng.normal(size=at.shape)
        step = 1e-5 / max(1.0, np.linalg.norm(direction) / 10)
        up, down = (both({**arguments, key: at + sign * step * direction})[0] for sign in (1, -1))
        # rounding of the fits, some 1e-12, over the step leaves the difference itself some 1e-7
        expected = pytest.approx(float((up - down) / (2 * step)), rel=1e-6, abs=1e-6)
        assert float(np.sum(slope[key] * direction)) == expected, key


SINGLE = {"embedding": "cylinder", "noise_distance": 0.3, "solver": TIGHT}


@pytest.mark.parametrize(
    ("points", "weights", "bits"),
    [
        (np.ones((140, 3)), None, Status.DEGENERATE | Status.UNDER_DETERMINED),
        (np.linspace(0, 1, 140)[:, None] * [1, 2, 3], None, Status.DEGENERATE),
        (np.column_stack([np.arange(140) % 2, np.linspace(0, 1, 140), np.zeros(140)]), None, Status.UNDER_DETERMINED),
        (ONE, np.arange(140) < 3, Status.TOO_FEW_POINTS),
        (1e-3 * ONE, None, Status(0)),
        (ONE + 100, None, Status(0)),
    ],
)
@pytest.mark.parametrize("distance", ["geometric", "algebraic"])
def test_hopeless_data_set_a_status_and_nothing_is_nan(points, weights, bits, distance):
    noise = 0.3e-3 if np.ptp(points) < 0.01 else 0.3
    fit = nfcv(points, ALL, distance=distance, weights=weights, **(SINGLE | {"noise_distance": noise}))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit))
    if distance == "geometric" or bits:
        assert int(fit.status) & bits == bits
    if distance == "geometric" and not bits:
        assert int(fit.status) == 0


def test_twins_are_merged():
    start = np.repeat(ALL, 2, 1)
    assert int(nfcv(ONE, start, embedding="3d", solver=TIGHT).status) & Status.MERGED


def test_hopeless_item_leaves_the_rest_of_a_batch_alone():
    batch = np.stack([ONE, np.ones((140, 3)), np.full((140, 3), np.nan)])
    fits = jax.jit(jax.vmap(lambda p: nfcv(p, ALL, **SINGLE)))(batch)
    alone = nfcv(ONE, ALL, **SINGLE)
    np.testing.assert_allclose(fits.memberships[0], alone.memberships, atol=800 * EPS)
    assert int(fits.status[0]) == 0
    assert int(fits.status[1]) & Status.DEGENERATE
    assert int(fits.status[2]) & Status.NOT_FINITE


def test_single_precision_stays_and_agrees():
    small = nfcv(ONE.astype(np.float32), ALL.astype(np.float32), embedding="cylinder", noise_distance=0.3)
    assert {leaf.dtype for leaf in jax.tree.leaves(small)} == {np.dtype(t) for t in ("f4", "i4", "i8", "bool")}
    double = nfcv(ONE, ALL, **SINGLE)
    # single precision stops at a change of 1e-6 of the spread; the gaps make 1e-4 of it
    np.testing.assert_allclose(small.memberships, double.memberships, atol=1e-4)
    assert int(small.status) == 0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"embedding": "7d"}, ValueError, "embedding must be one of '3d'"),
        ({"embedding": ()}, ValueError, "embedding must be a name or several, got none"),
        ({"distance": "metric"}, ValueError, "distance must be one of 'geometric', 'algebraic', got 'metric'"),
        ({"dimension": 3}, ValueError, r"dimension must be at least 1 and at most 2 \(Q - 1 of 'cylinder'\), got 3"),
        ({"dimension": 1}, ValueError, "dimension must be Q - 1 with distance='geometric' in 'cylinder', got 1"),
        ({"dimension": 1.0}, TypeError, "dimension must be a whole number, got 1.0"),
        ({"m": 1.0}, ValueError, "m must be a finite number above 1.0, got 1.0"),
        ({"noise_distance": 0}, ValueError, "noise_distance must be finite and above 0, got 0"),
        ({"noise_distance": np.ones(3)}, ValueError, "noise_distance must have shape"),
        ({"weights": -np.ones(140)}, ValueError, "weights must not be negative"),
        ({"start": ALL[:5]}, ValueError, r"start must have shape \(140, C\), one row a point, got \(5, 1\)"),
        ({"start": -ALL}, ValueError, "start must not be negative, got a smallest value of -1.0"),
        ({"start": 0 * ALL}, ValueError, "start must leave no column all zero, got column 0 so"),
        ({"points": ONE[:, :2]}, ValueError, "embedding must be 'linear' for points of 2 coordinates, got 'cylinder'"),
        ({"points": np.where(ONE > 0.5, np.nan, ONE)}, ValueError, "points must be finite"),
        ({"points": ONE + 1j}, TypeError, "points must be real numbers"),
        ({"points": ONE[:, :1], "embedding": "linear"}, ValueError, "points must have at least two coordinates"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    arguments = {"points": ONE, "start": ALL, **SINGLE} | change
    with pytest.raises(error, match=message):
        nfcv(**arguments)


def half_seen(kind, seed=0):
    """1,000 points on the half of a primitive that faces the camera, 200 uniform outliers; RMS 1 about the origin."""
    rng = np.random.default_rng(seed)
    angle, share = rng.uniform(0, np.pi, 1000), rng.uniform(-1, 1, (1000, 1))
    circle, up = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], 1), np.array([0, 1.0, 0])
    if kind == "cylinder":
        points = 0.5 * circle + share * up
    elif kind == "sphere":
        points = np.sqrt(1 - share**2) * circle + share * up
    elif kind == "cone":
        points = np.sqrt(np.abs(share)) * (0.6 * circle - 1.5 * up)
    else:
        side, along = rng.integers(0, 2, (1000, 1)), rng.uniform(0, 1, (1000, 1))
        axes = np.array([[np.cos(0.6), 0, np.sin(0.6)], [-np.sin(0.6), 0, np.cos(0.6)]])
        points = along * np.where(side == 0, axes[0], axes[1]) + share * up
    points = points + 0.01 * rng.normal(size=points.shape)
    points = np.vstack([points, rng.uniform(points.min(0) - 0.2, points.max(0) + 0.2, (200, 3))])
    points = points - points.mean(0)
    return points / np.sqrt((points**2).sum(1).mean())


SINGLES = ("3d", "4d", "6d")


def counts(points, distance):
    """Inliers in 3d with one plane and with two, in 4d and in 6d, each from a good start with delta falling to 0.1."""
    one = np.where(np.arange(1200) < 1000, 1.0, 0.02)[:, None]
    side = np.stack([points @ [np.cos(a), 0, np.sin(a)] for a in np.arange(4) * np.pi / 4])
    side = 1 / (1 + np.exp(-4 * (side - side.mean(1, keepdims=True))))
    pairs = [np.stack([s, 1 - s], 1) for s in side]
    for noise_distance in (0.4, 0.2, 0.1):
        options = {"noise_distance": noise_distance, "solver": Solver(300)}
        one = nfcv(points, one, embedding=SINGLES, distance=distance, **options)
        pairs = [nfcv(points, pair, embedding="3d", **options) for pair in pairs]
    two = min(pairs, key=lambda pair: float(pair.objective))
    plane, *curved = np.asarray(one.inliers.sum(1)).tolist()
    return [plane, int(two.inliers.sum()), *curved]


# What these clouds give 13 spreads away from the camera: the paper's distance takes in all outliers in 4d and 6d whatever the
# shape; the geometric one holds the same points wherever the camera stands, and most of them in the right space.
TABLE = {
    "cylinder": ([511, 913, 1200, 1200], [511, 913, 1047, 1045]),
    "sphere": ([234, 446, 1200, 1200], [234, 453, 370, 1033]),
    "cone": ([524, 906, 1200, 1200], [524, 906, 341, 1024]),
    "box": ([582, 1034, 1200, 1200], [582, 1034, 788, 788]),
}


@pytest.mark.parametrize("kind", TABLE)
def test_most_points_misname_by_the_papers_distance_and_name_by_the_geometric_one(kind):
    points, away = half_seen(kind), np.array([1.0, 0, 13])
    algebraic, geometric = (counts(points + away, distance) for distance in ("algebraic", "geometric"))
    # a point or so at the edge of delta may turn with rounding, some tens with the local optimum two planes end in
    np.testing.assert_allclose(algebraic, TABLE[kind][0], atol=20)
    np.testing.assert_allclose(geometric, TABLE[kind][1], atol=20)
    assert algebraic[2] == algebraic[3] == 1200
    simplest = next(i for i in range(4) if geometric[i] >= 0.99 * max(geometric))
    assert ["plane", "box", "cylinder", "sphere or cone"][simplest].find(kind) >= 0
    assert counts(points, "geometric") == geometric
