"""Fuzzy c-means: against the paper's equations, by hand, known truth, invariances, corners."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import oracles
from jaxfuzzy.alternation import short_powers, smooth_powers, square_powers
from jaxfuzzy.fcm import NoiseRule, _fit, fcm, memberships
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status

EXACT = Solver(max_steps=2000, tol=1e-15)
EPS = np.finfo(float).eps


def blobs(counts=(40, 70, 50), seed=0, dims=3, spread=1.0):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(len(counts), dims)) * 6
    return np.concatenate(
        [c + spread * rng.normal(size=(n, dims)) for c, n in zip(centers, counts, strict=True)]
    ), centers


@pytest.mark.parametrize("m", [1.3, 2.0, 4.0])
@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("delta", [None, 2.5])
def test_matches_the_papers_equations(m, sizes, delta):
    x, seeds = blobs()
    v, alpha, u, noise, history = oracles.fcm(x, seeds, m, sizes=sizes, delta=delta)
    found = fcm(x, seeds, m=m, sizes=sizes, noise_distance=delta, solver=EXACT)
    # Both stand still to rounding; what is left is rounding over one minus the contraction, at most 1e-2 here.
    chex.assert_trees_all_close(found.centers, v, rtol=1e-9, atol=1e-9)
    chex.assert_trees_all_close(found.sizes, alpha, rtol=1e-9)
    chex.assert_trees_all_close(found.memberships, u, rtol=0, atol=1e-9)
    chex.assert_trees_all_close(found.noise, noise, rtol=0, atol=1e-9)
    objective = oracles.fcm_objective(x, v, alpha, u, noise, m, delta)
    np.testing.assert_allclose(found.objective, objective, rtol=1e-12)
    assert np.all(np.diff(history) <= 1e-12 * history[0])


def test_four_points_by_hand():
    # Points -3, -1, 1, 3 on a line, m = 2, one step from seeds -2 and 2. Squared distances to -2: 1, 1, 9, 25; to 2: 25, 9, 1, 1.
    # Memberships in the first cluster: 25/26, 9/10, 1/10, 1/26; squared: 0.924556, 0.81, 0.01, 0.001479.
    # Center: (-3 * 0.924556 - 0.81 + 0.01 + 3 * 0.001479) / 1.746036 = -2.044191.
    one = fcm(np.array([[-3.0], [-1.0], [1.0], [3.0]]), np.array([[-2.0], [2.0]]), solver=Solver(1, 0.0, None))
    np.testing.assert_allclose(one.centers.ravel(), [-2.044191, 2.044191], atol=1e-6)
    # Final centers by symmetry: v solves the fixed point v = sum u^2 x / sum u^2, v = -2.0503... found by bisection.
    x = np.array([-3.0, -1.0, 1.0, 3.0])

    def gap(v):
        near, far = (x - v) ** 2, (x + v) ** 2
        u2 = (far / (near + far)) ** 2
        return u2 @ x / u2.sum() - v

    low, high = -2.9, -1.2
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if gap(middle) > 0 else (low, middle)
    both = fcm(x[:, None], np.array([[-2.0], [2.0]]), solver=EXACT)
    np.testing.assert_allclose(both.centers.ravel(), [low, -low], atol=1e-12)


def test_sizes_follow_the_scatter_not_the_share():
    # alpha_i goes with S_i^(1/m), S_i the sum of u^m D: eq. 11. Far clusters of equal spread: with m = 2 the square root of shares.
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(9000, 2)), rng.normal(size=(1000, 2)) + [300, 0]])
    found = fcm(x, np.array([[0.0, 0], [300, 0]]), sizes=True)
    np.testing.assert_allclose(found.sizes, [0.75, 0.25], atol=0.01)
    np.testing.assert_allclose(np.mean(np.asarray(found.labels) == 0), 0.9)


@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("m", [1.5, 2.0])
def test_objective_never_rises(sizes, m):
    x, _ = blobs(seed=3, spread=2.0)
    seeds, objectives = x[:4], []
    for steps in range(1, 12):
        objectives.append(float(fcm(x, seeds, m=m, sizes=sizes, solver=Solver(steps, 0.0, "anderson")).objective))
    assert np.all(np.diff(objectives) <= 8 * EPS * objectives[0])


def test_acceleration_reaches_the_same_place_in_fewer_steps():
    x, _ = blobs((300, 300, 300, 300), seed=1, spread=2.5)
    plain = fcm(x, x[:4], solver=Solver(5000, 1e-12, None))
    fast = fcm(x, x[:4], solver=Solver(5000, 1e-12))
    np.testing.assert_allclose(fast.objective, plain.objective, rtol=1e-12)
    assert int(fast.steps) < int(plain.steps) / 2


def test_limits_of_the_membership_rule():
    x, seeds = blobs()
    far = fcm(x, seeds, noise_distance=1e8)
    plain = fcm(x, seeds)
    chex.assert_trees_all_close(far.centers, plain.centers, atol=1e-9)
    tiny = fcm(x, seeds, noise_distance=1e-6, solver=Solver(1, 0.0, None))
    assert np.all(np.asarray(tiny.labels) == -1)
    assert int(tiny.status) & Status.ALL_NOISE
    assert int(fcm(x, x.mean(axis=0, keepdims=True)).status) == 0
    chex.assert_trees_all_close(fcm(x, seeds[:1]).centers[0], x.mean(axis=0), atol=1e-12)


def test_a_point_on_a_center_belongs_to_it_alone():
    x = np.array([[0.0, 0], [1, 0], [0, 1], [5, 5]])
    for m in (1.01, 1.5, 2.0, 8.0, 30.0):
        found = fcm(x, x[[0, 3]], m=m, solver=Solver(1, 0.0, None))
        u = memberships(np.asarray(found.centers), found)
        np.testing.assert_array_equal(u, np.eye(2))
        assert np.isfinite(np.asarray(found.centers)).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e12])
@pytest.mark.parametrize("m", [1.01, 2.0, 30.0])
def test_any_scale_origin_fuzzifier_and_precision(dtype, scale, m):
    x, seeds = blobs(seed=2, spread=0.5)
    tolerance = 2e-3 if dtype == np.float32 else 1e-8
    reference = fcm(x, seeds, m=m)
    found = fcm((x * scale).astype(dtype), (seeds * scale).astype(dtype), m=m)
    assert found.centers.dtype == dtype
    np.testing.assert_allclose(found.centers / scale, reference.centers, atol=tolerance)
    shifted = fcm((x + 1e6).astype(dtype), (seeds + 1e6).astype(dtype), m=m)
    # At 1e6 a float32 resolves 1/16: the points themselves have moved by up to half of that.
    np.testing.assert_allclose(shifted.centers - 1e6, reference.centers, atol=0.1 if dtype == np.float32 else 1e-6)


def test_float32_large_fuzzifier_many_clusters_does_not_underflow():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(500, 3)).astype(np.float32)
    found = fcm(x, x[:64], m=30.0)
    assert np.isfinite(np.asarray(found.centers)).all()
    np.testing.assert_allclose(np.asarray(found.memberships).sum(axis=1), 1, atol=1e-5)


def test_transformations_agree():
    x, seeds = blobs()
    few = Solver(6, 0.0)
    one = fcm(x, seeds, m=1.7, sizes=True, noise_distance=3.0, solver=few)
    compiled = jax.jit(lambda x, s: fcm(x, s, m=1.7, sizes=True, noise_distance=3.0, solver=few))(x, seeds)
    chex.assert_trees_all_close(compiled.centers, one.centers, atol=8 * EPS * np.abs(x).max())
    starts = np.stack([seeds, seeds + 0.5])
    batch = jax.vmap(lambda s: fcm(x, s, m=1.7, sizes=True, noise_distance=3.0, solver=few))(starts)
    for i in range(2):
        alone = fcm(x, starts[i], m=1.7, sizes=True, noise_distance=3.0, solver=few)
        chex.assert_trees_all_close(batch.centers[i], alone.centers, atol=8 * EPS * np.abs(x).max())


def test_tiles_do_not_matter(monkeypatch):
    x, seeds = blobs((400, 300, 353))
    whole = fcm(x, seeds, m=1.7, sizes=True, noise_distance=3.0, solver=EXACT)
    monkeypatch.setattr("jaxfuzzy.tiles.TILE_VALUES", 64)
    jax.clear_caches()
    tiled = fcm(x, seeds, m=1.7, sizes=True, noise_distance=3.0, solver=EXACT)
    jax.clear_caches()
    chex.assert_trees_all_close(tiled.centers, whole.centers, atol=1e-11)
    chex.assert_trees_all_close(tiled.memberships, whole.memberships, atol=1e-11)


def test_short_cuts_take_the_same_step():
    # The solve takes distances by a matrix product and m = 2 without logarithms; both must be the step of the definition.
    rng = np.random.default_rng(0)
    x = rng.normal(size=(20_000, 3))
    one = fcm(x, x[:5], solver=Solver(1, 0.0, None))
    d = ((x[:, None] - x[None, :5]) ** 2).sum(axis=-1)
    d = np.maximum(d, 1e-300)
    u = (1 / d) / (1 / d).sum(axis=1, keepdims=True)
    v = (u**2).T @ x / (u**2).sum(axis=0)[:, None]
    np.testing.assert_allclose(one.centers, v, atol=1e-12)


def test_compiles_once_for_all_values():
    x, seeds = blobs()
    traces = _fit._cache_size()
    for m, delta in ((1.5, 2.0), (1.8, 3.0), (2.5, 4.0)):
        fcm(x, seeds, m=m, noise_distance=delta, solver=Solver(tol=1e-4 * m))
    assert _fit._cache_size() == traces + 1


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), turn=st.floats(0, 6), scale=st.sampled_from([1e-6, 0.1, 1.0, 1e5]))
def test_permutation_and_motion(seed, turn, scale):
    x, seeds = blobs((30, 20, 25), seed=7)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(x))
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    shift = rng.normal(size=3) * 100
    run = lambda p, q: fcm(p, q, m=1.8, sizes=True, solver=Solver(30, 0.0))
    base = run(x, seeds)
    moved = run(scale * (x[order] @ rotation.T + shift), scale * (seeds @ rotation.T + shift))
    # Shifting by 100 costs about 100 roundings of the coordinates, which 30 steps do not amplify.
    np.testing.assert_allclose(moved.centers / scale, base.centers @ rotation.T + shift, atol=1e-10)
    np.testing.assert_allclose(moved.memberships, base.memberships[order], atol=1e-10)
    np.testing.assert_allclose(moved.objective / scale**2, base.objective, rtol=1e-10)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), filler=st.floats(-1e100, 1e100))
def test_weights_are_repetitions(seed, filler):
    x, seeds = blobs((30, 20, 25), seed=7)
    # Always the same counts in another order, so that the repeated points have one length and compile once.
    counts = np.random.default_rng(seed).permutation(np.arange(len(x)) % 4)
    hostile = np.where((counts > 0)[:, None], x, filler)
    run = lambda p, w: fcm(p, seeds, m=1.8, sizes=True, noise_distance=3.0, weights=w, solver=Solver(30, 0.0))
    weighted, repeated = run(hostile, counts.astype(float)), run(np.repeat(x, counts, axis=0), None)
    np.testing.assert_allclose(weighted.centers, repeated.centers, atol=1e-11)
    np.testing.assert_allclose(weighted.sizes, repeated.sizes, atol=1e-11)
    np.testing.assert_allclose(weighted.objective, repeated.objective, rtol=1e-11)
    assert np.isfinite(np.asarray(weighted.memberships)).all()


@pytest.mark.parametrize("noise_distance", [None, 3.0])
def test_points_of_weight_zero_are_where_they_are(noise_distance):
    """Held out they change nothing, yet have the memberships of new points there, and their weights the derivative there."""
    x, seeds = blobs((30, 20, 25), seed=7)
    weights = np.arange(len(x)) % 4 > 0
    options = {"m": 1.8, "noise_distance": noise_distance, "solver": EXACT}
    run = lambda w: fcm(x, seeds, weights=w, **options)
    fit, alone = run(weights.astype(float)), fcm(x[weights], seeds, **options)
    np.testing.assert_allclose(fit.centers, alone.centers, atol=1e-12)
    np.testing.assert_allclose(fit.memberships, memberships(x, alone), atol=1e-11)
    mix = jnp.arange(1.0, 1 + fit.centers.size).reshape(fit.centers.shape)
    total = lambda w: (mix * run(w).centers).sum()
    w = jnp.asarray(weights, float)
    slope = jax.grad(total)(w)
    for at in (0, 40):
        assert w[at] == 0
        here, one, two = (total(w.at[at].set(step)) for step in (0.0, 1e-4, 2e-4))
        np.testing.assert_allclose(slope[at], (4 * one - two - 3 * here) / 2e-4, rtol=1e-6)


def test_a_cluster_without_points_is_told():
    """A fuzzifier so near to 1 leaves a center that is nobody's nearest no share that single precision can hold."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(50, 2)), rng.normal(size=(50, 2)) + [8, 0]]).astype(np.float32)
    seeds = np.array([[0, 0], [8, 0], [4, 6]], np.float32)
    lost = fcm(x, seeds, m=1.01)
    np.testing.assert_allclose(lost.centers[2], [4, 6], rtol=1e-6)
    assert int(lost.status) == Status.EMPTY
    assert int(fcm(x, seeds, m=1.02).status) == int(fcm(x, seeds[:2], m=1.01).status) == 0


def test_second_derivatives_are_refused():
    x, seeds = blobs()
    center = lambda m: fcm(x, seeds, m=m).centers[0, 0]
    assert np.isfinite(jax.jit(jax.grad(center))(2.0))
    # Its own derivative by the direction is none of these.
    along = lambda d: jax.jvp(center, (2.0,), (d,))[1]
    np.testing.assert_allclose(jax.grad(along)(1.0), jax.grad(center)(2.0), rtol=1e-12)
    for twice in (jax.grad(jax.grad(center)), jax.jacfwd(jax.grad(center)), jax.hessian(center)):
        with pytest.raises(NotImplementedError, match="second derivatives of a fit are not computed"):
            twice(2.0)


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda x, s: fcm(x, s, solver=None), TypeError, "solver must be a Solver, got NoneType"),
        (lambda x, s: fcm(x, s, sizes="no"), TypeError, "sizes must be True or False, got 'no'"),
        (lambda x, s: fcm(x, s, memberships=1), TypeError, "memberships must be True or False, got 1"),
        (lambda x, s: Solver(mesh=3), TypeError, "mesh must be a Mesh, got int"),
        (lambda x, s: memberships(x, x), TypeError, "partition must be a Partition, got ndarray"),
        (lambda x, s: fcm([[1, 2], [3]], s), ValueError, "points must have rows of one length"),
    ],
)
def test_arguments_of_another_kind_are_named(call, error, says):
    with pytest.raises(error, match=says):
        call(*blobs())


def test_points_of_weight_zero_do_not_hide_that_all_others_are_noise():
    x = np.array([[0.0, 0], [0, 9], [9, 0], [9, 9], [4.5, 4.5]])
    fit = fcm(x, x[4:], noise_distance=0.1, weights=np.array([1.0, 1, 1, 1, 0]))
    assert (np.asarray(fit.labels)[:4] == -1).all()
    assert int(fit.status) & Status.ALL_NOISE


def test_noise_rules():
    x, seeds = blobs()
    plain = fcm(x, seeds, solver=EXACT)
    d = ((x[:, None] - np.asarray(plain.centers)[None]) ** 2).sum(axis=-1)
    dave = fcm(x, seeds, noise_distance=NoiseRule("dave", 0.2))
    np.testing.assert_allclose(dave.noise_distance, np.sqrt(0.2 * d.mean()), rtol=1e-5)
    quantile = fcm(x, seeds, noise_distance=NoiseRule("quantile", 0.9))
    share = np.mean(d.min(axis=1) <= float(quantile.noise_distance) ** 2 * (1 + 1e-5))
    assert 0.9 <= share <= 0.9 + 2 / len(x)
    given_ = fcm(x, seeds, noise_distance=float(dave.noise_distance))
    chex.assert_trees_all_close(given_.centers, dave.centers, atol=1e-4)


def test_memberships_of_new_points():
    x, seeds = blobs()
    for sizes in (False, True):
        found = fcm(x, seeds, sizes=sizes, noise_distance=2.0)
        np.testing.assert_allclose(memberships(x, found), found.memberships, atol=1e-12)
        fresh = x[:7] + 0.1
        u, _ = oracles.fcm_memberships(fresh, np.asarray(found.centers), np.asarray(found.sizes), 2.0, 2.0)
        np.testing.assert_allclose(memberships(fresh, found), u, atol=1e-12)


def test_without_memberships_nothing_is_kept():
    x, seeds = blobs()
    lean, full = fcm(x, seeds, memberships=False), fcm(x, seeds)
    assert lean.memberships.shape == (0, 3)
    assert lean.noise.shape == lean.labels.shape == (0,)
    chex.assert_trees_all_equal(lean.centers, full.centers)


def test_same_bits_twice():
    x, seeds = blobs()
    chex.assert_trees_all_equal(fcm(x, seeds, m=1.9, sizes=True), fcm(x, seeds, m=1.9, sizes=True))


def degenerate_cases():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(400, 8))
    two = np.concatenate([rng.normal(size=(80, 2)), rng.normal(size=(80, 2)) + [40, 0]])
    lone = np.concatenate([rng.normal(size=(200, 2)), [[60.0, 0]]])
    return {
        # Isotropic in 8 dimensions: m* = 8 / 6, so at m = 2 all centers fall to the mean.
        Status.COLLAPSED: (ball, ball[:3], {}),
        Status.NOT_CONVERGED: (two, two[:3], {"solver": Solver(2, 1e-12)}),
        Status.SPIKE: (lone, np.array([[0.0, 0], [60, 0]]), {"sizes": True}),
        Status.UNSTABLE: (two, np.array([[0.0, 0], [0, 0]]), {}),
        Status.DEGENERATE: (np.ones((10, 2)), np.ones((2, 2)), {}),
        Status.ALL_NOISE: (two, two[:2] + 0.5, {"noise_distance": 1e-4, "solver": Solver(1, 0.0)}),
        Status.TOO_FEW_POINTS: (two, two[:3], {"weights": np.array([1.0, 1] + [0] * 158)}),
    }


@pytest.mark.parametrize("bit", degenerate_cases(), ids=lambda bit: bit.name)
def test_degeneracy_is_told(bit):
    x, seeds, options = degenerate_cases()[bit]
    found = fcm(x, seeds, **options)
    assert int(found.status) & bit
    assert np.isfinite(np.asarray(found.centers)).all()
    assert np.isfinite(np.asarray(found.memberships)).all()


def test_merged_centers_are_told_and_stable():
    # Two tight groups far apart with a third center in one of them; at a large fuzzifier the pair is a stable minimum.
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(300, 6)), rng.normal(size=(300, 6)) + 100])
    found = fcm(x, np.concatenate([x[:2], x[-1:]]), m=2.0, solver=Solver(2000, 1e-8))
    assert int(found.status) & Status.MERGED
    assert not int(found.status) & Status.COLLAPSED


def test_a_dying_size_is_told():
    # A tight lump inside a wide one: at m = 3 one cluster takes both, and the other's size falls to nothing.
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(200, 2)) * 0.1, rng.normal(size=(200, 2)) * 10])
    found = fcm(x, np.array([[0.0, 0], [0.1, 0]]), sizes=True, m=3.0)
    assert int(found.status) & Status.DYING
    assert float(found.sizes.min()) < 1e-6


def test_a_degenerate_item_leaves_the_batch_alone():
    x, seeds = blobs()
    bad = np.ones_like(x)
    both = jax.vmap(lambda p: fcm(p, seeds, m=1.7))(np.stack([x, bad]))
    alone = fcm(x, seeds, m=1.7)
    np.testing.assert_allclose(both.centers[0], alone.centers, atol=1e-7)
    assert int(both.status[0]) == 0
    assert int(both.status[1]) & Status.DEGENERATE


@pytest.mark.parametrize(
    ("arguments", "options", "word"),
    [
        ((np.ones((3, 2)), np.ones((4, 2))), {}, "seeds"),
        ((np.ones((3, 2)), np.ones((2, 3))), {}, "seeds"),
        ((np.ones(3), np.ones((2, 3))), {}, "points"),
        ((np.full((3, 2), np.nan), np.ones((2, 2))), {}, "points"),
        ((np.ones((3, 2)), np.ones((2, 2))), {"m": 1.0}, "m "),
        ((np.ones((3, 2)), np.ones((2, 2))), {"m": np.inf}, "m "),
        ((np.ones((3, 2)), np.ones((2, 2))), {"noise_distance": 0.0}, "noise_distance"),
        ((np.ones((3, 2)), np.ones((2, 2))), {"weights": -np.ones(3)}, "weights"),
        ((np.ones((3, 2)), np.ones((2, 2))), {"weights": np.ones(4)}, "weights"),
        ((np.ones((3, 2)), np.ones((2, 2))), {"weights": np.zeros(3)}, "weights"),
    ],
)
def test_wrong_arguments_are_named(arguments, options, word):
    with pytest.raises(ValueError, match=word):
        fcm(*arguments, **options)


def test_wrong_types_are_named():
    with pytest.raises(TypeError, match="points"):
        fcm("abc", np.ones((2, 2)))
    with pytest.raises(TypeError, match="points"):
        fcm(np.ones((3, 2)) * 1j, np.ones((2, 2)))
    with pytest.raises(ValueError, match="max_steps"):
        Solver(max_steps=0)
    with pytest.raises(ValueError, match="acceleration"):
        Solver(acceleration="magic")
    with pytest.raises(ValueError, match="quantile"):
        NoiseRule("quantile", 1.5)


def test_integers_and_half_floats_are_taken():
    found = fcm(np.arange(20).reshape(10, 2), np.array([[0, 1], [18, 19]]))
    assert found.centers.dtype == jnp.result_type(float)
    assert (
        fcm(np.arange(20.0).reshape(10, 2).astype(np.float16), np.ones((1, 2), np.float16)).centers.dtype == np.float64
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("m", [1.05, 1.7, 2.0, 5.0, 30.0])
@pytest.mark.parametrize("with_noise", [False, True])
@pytest.mark.parametrize("with_sizes", [False, True])
def test_short_cuts_give_the_same_powers(dtype, m, with_noise, with_sizes):
    apart = np.random.default_rng(0).chisquare(3, (4, 64)).astype(dtype)
    apart[1, 3] = apart[0, 5] = apart[2, 5] = 0
    apart[3] *= 1e-4
    args = [jnp.asarray(m, dtype), None, None, jnp.asarray(-2e4, dtype)]
    if with_sizes:
        args[1] = jnp.asarray(
            np.log([2.0, 1.5, 0.5, 0.0], where=[True, True, True, False], out=np.full(4, -np.inf)), dtype
        )
    if with_noise:
        args[2] = jnp.asarray(0.7, dtype)
    cuts = [short_powers] + [square_powers] * (m == 2)
    for cut in cuts:
        (power, term, shift), (exact, exact_term, exact_shift) = cut(apart, *args), smooth_powers(apart, *args)
        # Logarithms of up to 1e2 / (m - 1) carry that many units of rounding into the exponential; the shift is cut's own.
        tol = 1e3 * np.finfo(dtype).eps * max(1, 1 / (m - 1))
        factor = np.exp(np.float64(shift if cut is short_powers else 0) - np.float64(exact_shift))
        np.testing.assert_allclose(np.asarray(power, float) * factor, exact, rtol=tol, atol=tol)
        np.testing.assert_allclose(
            np.asarray(term, float) * factor, exact_term, rtol=tol, atol=tol * np.max(exact_term)
        )
