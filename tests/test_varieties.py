import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oracles_varieties as oracle
from jaxfuzzy import embedding as emb
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.varieties import nfcv

EPS = np.finfo(float).eps
PLAIN = Solver(max_steps=4, tol=0.0, acceleration=None)
TIGHT = Solver(max_steps=2000, tol=1e-14)


def arc(center, seed, count=120, outliers=20, noise=0.02):
    """The near half of an upright cylinder of radius 0.5 and height 2, and uniform outliers round it."""
    rng = np.random.default_rng(seed)
    angle, y = rng.uniform(-1.4, 1.4, count), rng.uniform(-1, 1, count)
    surface = np.stack([0.5 * np.sin(angle), y, -0.5 * np.cos(angle)], 1) + noise * rng.normal(size=(count, 3))
    return np.vstack([surface, rng.uniform(-1, 1, (outliers, 3))]) + center


POINTS = np.vstack([arc([3.0, 0, 8], 0), arc([5.0, 0.5, 7], 1)])
OWN = np.repeat(np.eye(2), 140, axis=0)
START = 0.7 * OWN + 0.3 * np.random.default_rng(1).dirichlet([1, 1], 280)
WEIGHTS = np.random.default_rng(2).uniform(0.2, 2, len(POINTS))
ONE, ALL = POINTS[:140], np.ones((140, 1))


@pytest.mark.parametrize(
    ("name", "dimension", "noise", "m"),
    [("6d", None, 3.0, 2.0), ("6d", 2, 3.0, 1.6), ("4d", None, None, 2.0), ("3d", 1, 0.3, 3.0), ("9d", None, 2.0, 2.0)],
)
def test_algebraic_is_the_paper_to_the_letter(name, dimension, noise, m):
    fit = nfcv(
        *(POINTS, START),
        embedding=name,
        dimension=dimension,
        noise_distance=noise,
        m=m,
        distance="algebraic",
        weights=WEIGHTS,
        solver=PLAIN,
    )
    x, u = np.asarray(emb.features(POINTS, name)), START.T
    q = dimension or x.shape[1] - 1
    for _ in range(PLAIN.max_steps + 1):
        centers, bases, squared = oracle.algebraic_step(x, u, q, m, WEIGHTS)
        u, rest = oracle.memberships(squared, m, noise)
    # raw coordinates near 8 make squares near 64, and distances lose digits as differences of those
    np.testing.assert_allclose(fit.memberships, u.T, atol=1e-9)
    np.testing.assert_allclose(fit.noise, rest, atol=1e-9)
    np.testing.assert_allclose(fit.centers, centers, rtol=1e-10)
    np.testing.assert_allclose(fit.squared_distances, squared.T, rtol=1e-7, atol=1e-11)
    assert float(fit.objective) == pytest.approx(oracle.objective(squared, u, rest, m, noise, WEIGHTS), rel=1e-9)
    for i in range(2):
        np.testing.assert_allclose(fit.basis[i] @ fit.basis[i].T, bases[i] @ bases[i].T, atol=1e-9)
        np.testing.assert_allclose(fit.basis[i].T @ fit.basis[i], np.eye(q), atol=1e-13)
    if dimension is None:
        np.testing.assert_allclose(np.einsum("cq,cqp->cp", fit.normals, fit.basis), 0, atol=1e-12)
    else:
        np.testing.assert_array_equal(fit.normals, 0)


@pytest.mark.parametrize("name", ["3d", "4d", "6d", "cylinder", "cone"])
def test_geometric_is_taubins_step(name):
    points = POINTS - [4, 0.2, 7.2]  # the oracle does not center
    fit = nfcv(points, START, embedding=name, noise_distance=0.3, m=1.8, weights=WEIGHTS, solver=PLAIN)
    x, gradients, u = np.asarray(emb.features(points, name)), np.asarray(emb.gradients(points, name)), START.T
    for _ in range(PLAIN.max_steps + 1):
        centers, normals, squared = oracle.geometric_step(x, gradients, u, 1.8, WEIGHTS)
        u, rest = oracle.memberships(squared, 1.8, 0.3)
    # rounding grows by the gaps of four eigenproblems, about 1e3
    np.testing.assert_allclose(fit.memberships, u.T, atol=1e-9)
    np.testing.assert_allclose(fit.noise, rest, atol=1e-9)
    np.testing.assert_allclose(fit.squared_distances, squared.T, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(np.abs(np.sum(fit.normals * normals, 1)), 1, atol=1e-12)
    np.testing.assert_allclose(np.sum(fit.normals * (fit.centers - centers), 1), 0, atol=1e-10)


def test_four_points_by_hand():
    """Points (0, 0), (2, 0), (4, 0), (2, 3) weigh 1, 1, 1, 0 for one line: it is y = 0; u of the last is 1 / (1 + 9 / 4)."""
    points = np.array([[0.0, 0], [2, 0], [4, 0], [2, 3]])
    start = np.array([[1.0], [1], [1], [0]])
    solver = Solver(max_steps=1, tol=0.0, acceleration=None)
    fit = nfcv(points, start, embedding="linear", noise_distance=2.0, weights=[1, 1, 1, 0], solver=solver)
    np.testing.assert_allclose(fit.squared_distances[:, 0], [0, 0, 0, 9], atol=1e-15)
    np.testing.assert_allclose(fit.memberships[:, 0], [1, 1, 1, 4 / 13], atol=1e-15)
    np.testing.assert_allclose(fit.noise, [0, 0, 0, 9 / 13], atol=1e-15)
    np.testing.assert_allclose(fit.centers, [[2, 0]], atol=1e-15)
    np.testing.assert_allclose(fit.normals, [[0, 1]], atol=1e-15)
    np.testing.assert_allclose(np.abs(fit.basis[0, :, 0]), [1, 0], atol=1e-15)
    np.testing.assert_array_equal(fit.labels, [0, 0, 0, -1])
    np.testing.assert_array_equal(fit.inliers, [True, True, True, False])


@pytest.mark.parametrize(("name", "noise"), [("6d", 3.0), ("6d", None), ("3d", 0.3)])
def test_algebraic_objective_never_rises(name, noise):
    options = {"embedding": name, "noise_distance": noise, "distance": "algebraic", "weights": WEIGHTS}
    solver = Solver(max_steps=1, tol=0.0, acceleration=None)
    fit, values = nfcv(POINTS, START, solver=solver, **options), []
    for _ in range(25):
        fit = nfcv(POINTS, fit, solver=solver, **options)
        values.append(float(fit.objective))
    # rounding of distances that are differences of squares near 64
    assert (np.diff(values) <= 1e-10 * values[0]).all()
    assert values[-1] < 0.99 * values[0]


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_answer_is_a_fixed_point(distance):
    options = {"embedding": "cylinder", "noise_distance": 0.3, "distance": distance}
    fit = nfcv(ONE, ALL, solver=Solver(tol=1e-12), **options)
    assert not int(fit.status) & Status.NOT_CONVERGED
    again = nfcv(ONE, fit, solver=Solver(max_steps=1, tol=0.0), **options)
    np.testing.assert_allclose(again.memberships, fit.memberships, atol=1e-10)
    assert int(nfcv(ONE, ALL, solver=Solver(max_steps=2), **options).status) & Status.NOT_CONVERGED


NAMES = ("3d", "cylinder", "6d", "cone")


@pytest.mark.parametrize("distance", ["algebraic", "geometric"])
def test_embeddings_side_by_side_are_as_one_by_one_and_padding_is_none(distance):
    options = {"noise_distance": 0.3, "distance": distance, "weights": WEIGHTS, "solver": PLAIN}
    points = POINTS - [4, 0.2, 7.2]
    together = nfcv(points, START, embedding=NAMES, **options)
    assert together.centers.shape == (4, 2, 6)
    assert together.embedding == NAMES
    for i, name in enumerate(NAMES):
        alone = nfcv(points, START, embedding=name, **options)
        q = alone.centers.shape[1]
        for field in ("squared_distances", "memberships", "noise", "objective"):
            # 8 eps, times what six eigenproblems with gaps near 1e-2 make of it
            np.testing.assert_allclose(getattr(together, field)[i], getattr(alone, field), rtol=0, atol=5e3 * EPS)
        for field in ("centers", "normals"):
            np.testing.assert_allclose(getattr(together, field)[i][:, :q], getattr(alone, field), atol=5e3 * EPS)
            np.testing.assert_array_equal(getattr(together, field)[i][:, q:], 0)
        np.testing.assert_array_equal(together.basis[i][:, q:], 0)
        np.testing.assert_array_equal(together.labels[i], alone.labels)


def test_hostile_padding_is_no_padding():
    rng = np.random.default_rng(5)
    where = np.sort(rng.choice(300, 280, replace=False))
    padded, start, weights = 1e6 * rng.normal(size=(300, 3)), np.ones((300, 2)), np.zeros(300)
    padded[where], start[where], weights[where] = POINTS, START, WEIGHTS
    for distance in ("algebraic", "geometric"):
        options = {"embedding": "cylinder", "noise_distance": 0.3, "distance": distance, "solver": PLAIN}
        alone = nfcv(POINTS, START, weights=WEIGHTS, **options)
        fit = nfcv(padded, start, weights=weights, **options)
        np.testing.assert_allclose(fit.memberships[where], alone.memberships, atol=5e3 * EPS)
        np.testing.assert_allclose(fit.centers, alone.centers, rtol=1e-12)
        np.testing.assert_allclose(fit.bounds, alone.bounds, atol=1e-9)
        assert int(fit.status) == int(alone.status)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((fit.scatter, fit.slopes, fit.objective)))


def test_weights_count_points():
    counts = np.random.default_rng(6).integers(0, 4, len(POINTS))
    options = {"embedding": "cylinder", "noise_distance": 0.3, "solver": PLAIN}
    weighted = nfcv(POINTS, START, weights=counts, **options)
    repeated = nfcv(np.repeat(POINTS, counts, 0), np.repeat(START, counts, 0), **options)
    np.testing.assert_allclose(np.repeat(weighted.memberships, counts, 0), repeated.memberships, atol=5e3 * EPS)
    np.testing.assert_allclose(weighted.objective, repeated.objective, rtol=1e-11)


def test_compiled_is_eager_and_one_compilation_serves_every_noise_distance():
    def fit(points, start, noise_distance, m):
        return nfcv(points, start, embedding="6d", noise_distance=noise_distance, m=m, solver=PLAIN)

    compiled = jax.jit(fit)
    for noise, m in ((0.3, 2.0), (0.5, 1.7)):
        for a, b in zip(*(jax.tree.leaves(f(POINTS, START, noise, m)) for f in (compiled, fit)), strict=True):
            np.testing.assert_allclose(a, b, rtol=8 * EPS, atol=8 * EPS)
    assert compiled._cache_size() == 1


def test_far_noise_is_no_noise_and_near_noise_takes_all():
    options = {"embedding": "cylinder", "solver": Solver(tol=1e-13)}
    plain, far = nfcv(POINTS, START, **options), nfcv(POINTS, START, noise_distance=1e7, **options)
    assert float(far.noise.max()) < 1e-13
    np.testing.assert_allclose(far.memberships, plain.memberships, atol=1e-9)
    np.testing.assert_array_equal(plain.noise, 0)
    assert np.isinf(plain.noise_distance)
    assert (plain.labels >= 0).all()
    assert plain.inliers.all()
    for distance in ("geometric", "algebraic"):
        none = nfcv(POINTS, START, noise_distance=1e-9, distance=distance, **options)
        assert float(none.noise.min()) > 0.99
        assert (none.labels == -1).all()
        assert int(none.status) & Status.ALL_NOISE
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(none))


def test_noise_distance_may_differ_from_point_to_point():
    each = np.where(np.arange(140) < 100, 0.3, 0.1)
    fit = nfcv(ONE, ALL, embedding="cylinder", noise_distance=each, solver=PLAIN)
    expected = 1 / (1 + np.asarray(fit.squared_distances[:, 0]) / each**2)
    np.testing.assert_allclose(fit.memberships[:, 0], expected, rtol=1e-10)


CASES = {
    "algebraic, padded": (POINTS, START, {"embedding": ("3d", "6d"), "distance": "algebraic"}, 2.0),
    "algebraic, q = 2 of 6": (POINTS, START, {"embedding": "6d", "dimension": 2, "distance": "algebraic"}, 2.0),
    "geometric, padded": (ONE, ALL, {"embedding": ("sphere", "cylinder", "cone")}, 0.3),
    "geometric, two planes": (POINTS, START, {"embedding": "3d"}, 0.3),
    "no noise cluster": (POINTS, START, {"embedding": "3d"}, None),
}


def line_of_squares():
    """Squares round the z axis: off the line both eigenvalues are the same."""
    corner = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    height = np.linspace(-3, 3, 12)
    points = np.concatenate([np.column_stack([0.3 * corner, np.full(4, z)]) for z in height])
    return points, np.ones((len(points), 1))


CASES["repeated eigenvalues, q = 1"] = (*line_of_squares(), {"embedding": "3d", "dimension": 1}, 0.5)


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_central_differences(name):
    points, start, options, noise = CASES[name]
    rng = np.random.default_rng(7)
    mix = None

    def value(arguments):
        fit = nfcv(
            arguments["points"],
            start,
            noise_distance=arguments.get("noise_distance"),
            m=arguments["m"],
            weights=arguments["weights"],
            solver=TIGHT,
            **options,
        )
        parts = (fit.memberships, fit.noise, fit.squared_distances, fit.objective, fit.centers, fit.normals)
        nonlocal mix
        if mix is None:
            mix = [rng.normal(size=p.shape) for p in parts]
        return sum(jnp.sum(a * b) for a, b in zip(mix, parts, strict=True))

    arguments = {"points": points, "m": np.array(2.2), "weights": np.ones(len(points))}
    if noise is not None:
        arguments["noise_distance"] = np.array(noise)
    compiled, slope = jax.jit(value), jax.jit(jax.grad(value))(arguments)
    for key, at in arguments.items():
        direction = rng.normal(size=at.shape)
        step = 1e-5 / max(1.0, np.linalg.norm(direction) / 10)
        up, down = (compiled({**arguments, key: at + sign * step * direction}) for sign in (1, -1))
        numeric = (up - down) / (2 * step)
        exact = np.sum(slope[key] * direction)
        assert float(exact) == pytest.approx(float(numeric), rel=1e-6, abs=1e-6), key
