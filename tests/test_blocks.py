"""Points block by block: the same answer as in memory, from every kind of source, stopped and taken up again."""

import jax
import numpy as np
import pytest

import jaxfuzzy as jf
from jaxfuzzy.blocks import Total
from jaxfuzzy.status import Status

pytestmark = pytest.mark.usefixtures("compiled_for_one_run")

N = 900
# The same programs fit some of the points and all.
THIRD, EVERY = (np.arange(N) % 3 == 0).astype(float), np.ones(N)


def cloud(seed=0, count=N):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(3, 3)) * 4
    return centers[rng.integers(0, 3, count)] + rng.normal(size=(count, 3)) + 50.0


def ball(count=N):
    rng = np.random.default_rng(3)
    x = rng.normal(size=(count, 3))
    x = x / np.linalg.norm(x, axis=1, keepdims=True) * 0.3 + 0.003 * rng.normal(size=(count, 3)) + [0.1, 0.2, 2.0]
    x[:60] = rng.uniform(-0.5, 0.5, (60, 3)) + [0.1, 0.2, 2.0]
    return x


def start_in_4d(x):
    return jf.nfcv(x[::3], np.ones((N // 3, 1)), embedding="4d", solver=jf.Solver(3, 0.0))


def same(a, b, names, rtol):
    for name in names:
        one, other = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        np.testing.assert_allclose(one, other, rtol=rtol, atol=rtol * np.abs(other).max(initial=1e-300), err_msg=name)


WEIGHTS = np.random.default_rng(1).random(N) * (np.arange(N) % 7 > 0)
FCM_FIELDS = ("centers", "sizes", "objective")


@pytest.mark.parametrize("m", [2.0, 1.6])
@pytest.mark.parametrize(("sizes", "delta", "weights"), [(False, None, None), (True, 3.0, WEIGHTS)])
def test_fcm_is_the_same_as_in_memory(m, sizes, delta, weights):
    x = cloud()
    options = {"m": m, "sizes": sizes, "noise_distance": delta, "weights": weights, "memberships": False}
    options["solver"] = jf.Solver(tol=1e-12)
    whole = jf.fcm(x, x[:3], **options)
    for rows in (250, N):
        found = jf.fcm(jf.blocks(x, rows=rows), x[:3], **options)
        # Both stand still to 1e-12 of the spread; what is left is that over one minus the contraction.
        same(found, whole, FCM_FIELDS, 1e-9)
        assert int(found.status) == int(whole.status) == 0
        assert found.memberships.shape == (0, 3)
    one = jf.memberships(x[:5], found)
    np.testing.assert_allclose(one, jf.memberships(x[:5], whole), atol=1e-8)


def test_the_same_steps_are_taken():
    # Not only the same end: with a limit of steps both stop at the same place, accelerated or not.
    x = cloud(1)
    for acceleration in ("anderson", None):
        solver = jf.Solver(7, 0.0, acceleration)
        whole = jf.fcm(x, x[:3], memberships=False, solver=solver)
        found = jf.fcm(jf.blocks(x, rows=400), x[:3], memberships=False, solver=solver)
        same(found, whole, FCM_FIELDS, 1e-9)
        assert int(found.steps) == int(whole.steps) == 7
        assert int(found.status) & Status.NOT_CONVERGED


def test_every_kind_of_source(tmp_path):
    x = cloud(2).astype(np.float32)
    np.save(tmp_path / "points.npy", x)
    pieces = [x[:10], x[10:10], x[10:700], x[700:]]
    solver = jf.Solver(5, 0.0)
    expected = jf.fcm(jf.blocks(x, rows=300), x[:3], memberships=False, solver=solver)
    assert expected.centers.dtype == np.float32
    for source in (tmp_path / "points.npy", str(tmp_path / "points.npy"), np.load(tmp_path / "points.npy", mmap_mode="r"), pieces,
                   lambda: iter(pieces), jax.numpy.asarray(x)):  # fmt: skip
        blocks = jf.blocks(source, rows=300)
        assert [len(block) for block in blocks] == [300, 300, 300]
        found = jf.fcm(blocks, x[:3], memberships=False, solver=solver)
        np.testing.assert_array_equal(found.centers, expected.centers)


# A last block that is shorter than the others costs programs of its own.
@pytest.mark.parametrize(
    ("embedding", "distance", "rows"), [("6d", "geometric", N // 3), ("4d", "algebraic", N // 3 + 50)]
)
def test_nfcv_is_the_same_as_in_memory(embedding, distance, rows):
    x = ball()
    rng = np.random.default_rng(0)
    delta = 0.02
    solver = jf.Solver(tol=1e-11, max_steps=2000)
    options = {"embedding": embedding, "distance": distance, "noise_distance": delta, "solver": solver}
    some = jf.nfcv(x, 0.5 + 0.1 * rng.random((N, 1)), weights=THIRD, **options)
    whole = jf.nfcv(x, 0.5 + 0.1 * rng.random((N, 1)), weights=EVERY, **options)
    for weights in (None, EVERY):
        found = jf.nfcv(jf.blocks(x, rows=rows), some, weights=weights, **options)
        assert int(found.status) == int(whole.status)
        # Solving frames differ by the rounding of their means; tol over one minus the contraction remains.
        same(
            found,
            whole,
            ("centers", "normals", "local_centers", "scatter", "slopes", "objective", "origin", "unit"),
            1e-7,
        )
        # Ends are read off 4096 bins over the whole length, outliers left out by their labels.
        np.testing.assert_allclose(found.bounds, whole.bounds, atol=2e-3)
    same(jf.recover(found, "quadric"), jf.recover(whole, "quadric"), ("coefficients",), 1e-6)


@pytest.mark.parametrize(("embedding", "distance"), [("6d", "geometric"), ("4d", "algebraic")])
def test_a_block_without_weight_counts_for_nothing(embedding, distance):
    x = np.roll(ball(), N // 3, axis=0)
    weights = (np.arange(N) >= N // 3).astype(float)
    options = {"embedding": embedding, "distance": distance, "noise_distance": 0.02}
    start = jf.nfcv(x, np.ones((N, 1)), weights=THIRD, **options)
    whole = jf.nfcv(x, start, weights=weights, **options)
    found = jf.nfcv(jf.blocks(x, rows=N // 3), start, weights=weights, **options)
    assert int(found.status) == int(whole.status) == 0
    same(found, whole, ("centers", "normals", "objective", "masses"), 1e-5)


def test_linear_varieties_of_lower_dimension():
    x = cloud(5)
    start = jf.nfcv(x, np.ones((N, 1)), embedding="linear", dimension=1, weights=THIRD)
    whole = jf.nfcv(x, np.ones((N, 1)), embedding="linear", dimension=1, weights=EVERY)
    found = jf.nfcv(jf.blocks(x, rows=300), start, embedding="linear", dimension=1)
    same(found, whole, ("centers", "objective"), 1e-9)
    np.testing.assert_allclose(np.abs(found.basis), np.abs(whole.basis), atol=1e-8)


class Stopped(Exception):
    pass


@pytest.mark.parametrize("after", [1, 4])
def test_stopped_and_taken_up_again(tmp_path, after):
    x, solver, sweeps = cloud(7), jf.Solver(tol=1e-10), []
    checkpoint = tmp_path / "state.npz"

    def stop(steps, change):
        sweeps.append((steps, change))
        if steps == after:
            raise Stopped

    whole = jf.fcm(jf.blocks(x, rows=300), x[:3], memberships=False, solver=solver)
    with pytest.raises(Stopped):
        jf.fcm(jf.blocks(x, rows=300, checkpoint=checkpoint, progress=stop), x[:3], memberships=False, solver=solver)
    sweeps.clear()
    go_on = jf.blocks(x, rows=300, checkpoint=checkpoint, progress=lambda steps, change: sweeps.append((steps, change)))
    found = jf.fcm(go_on, x[:3], memberships=False, solver=solver)
    # Nothing is computed twice, and the end is the same to the last bit.
    assert [steps for steps, _ in sweeps] == list(range(after + 1, int(whole.steps) + 1))
    same(found, whole, FCM_FIELDS, 0)
    # Once more: it is done already. And a tighter tolerance goes on from where it stopped.
    again = jf.fcm(go_on, x[:3], memberships=False, solver=solver)
    assert int(again.steps) == int(whole.steps)
    assert len(sweeps) == int(whole.steps) - after
    further = jf.fcm(go_on, x[:3], memberships=False, solver=jf.Solver(tol=1e-14))
    assert int(further.steps) > int(whole.steps)
    for change in ({"m": 1.9}, {"sizes": True}, {"noise_distance": 2.0}, {"weights": WEIGHTS}):
        with pytest.raises(ValueError, match="was written for other points or settings"):
            jf.fcm(go_on, x[:3], memberships=False, solver=solver, **change)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"checkpoint .* is damaged"):
        jf.fcm(go_on, x[:3], memberships=False, solver=solver)


def test_nfcv_is_taken_up_again(tmp_path):
    x, checkpoint = ball(), tmp_path / "state.npz"
    start = start_in_4d(x)
    few, many = ({"embedding": "4d", "noise_distance": 0.02, "solver": jf.Solver(steps, 0.0)} for steps in (3, 8))
    whole = jf.nfcv(jf.blocks(x, rows=300), start, **many)
    jf.nfcv(jf.blocks(x, rows=300, checkpoint=checkpoint), start, **few)
    found = jf.nfcv(jf.blocks(x, rows=300, checkpoint=checkpoint), start, **many)
    assert int(found.steps) == 8
    same(found, whole, ("centers", "normals", "objective"), 0)


def test_means_far_from_the_origin_keep_their_digits():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(1000, 2)) + 1e9
    weights = rng.random(1000)
    total = Total()
    for at in range(0, 1000, 130):
        total.add(x[at : at + 130], weights[at : at + 130])
    # By the textbook formula E[x^2] - E[x]^2 no digit would be left; doubles hold 1e9 to 1e-7.
    shifted = x - 1e9
    mean = weights @ shifted / weights.sum()
    np.testing.assert_allclose(total.mean - 1e9, mean, atol=1e-6)
    spread = np.sqrt(weights @ np.square(shifted - mean).sum(axis=1) / weights.sum())
    np.testing.assert_allclose(total.spread, spread, rtol=1e-7)


def test_wrong_use(tmp_path):
    x = cloud()
    for source, kind, says in (
        (tmp_path / "none.npy", FileNotFoundError, "points not found"),
        (iter([x]), TypeError, "used up after one sweep"),
        (5, TypeError, "must be a path, an array"),
        (x[0], ValueError, r"shape \(N, D\)"),
        (x.astype(complex), ValueError, "real numbers"),
    ):
        with pytest.raises(kind, match=says):
            jf.blocks(source)
    with pytest.raises(ValueError, match="rows must be at least 1"):
        jf.blocks(x, rows=0)
    (tmp_path / "text.npy").write_text("no array")
    with pytest.raises(ValueError, match="must be an NPY file"):
        jf.blocks(tmp_path / "text.npy")
    bad = x.copy()
    bad[700, 1] = np.nan
    for points, seeds, options, says in (
        (jf.blocks(x), x[:3], {}, "memberships must be False for blocks"),
        (jf.blocks(bad, rows=300), x[:3], {"memberships": False}, "block at point 600 must be finite"),
        (jf.blocks([x, x[:, :2]], rows=900), x[:3], {"memberships": False}, r"must have shape \(N, 3\)"),
        (jf.blocks([]), x[:3], {"memberships": False}, "at least one point, got none"),
        (jf.blocks(x), x[:3, :2], {"memberships": False}, "seeds must have shape"),
        (jf.blocks(x), x[:3], {"memberships": False, "weights": np.ones(5)}, "weights must"),
        (jf.blocks(x), x[:3], {"memberships": False, "weights": np.ones(N + 1)}, "weights must"),
        (jf.blocks(x), x[:3], {"memberships": False, "weights": -np.ones(N)}, "not negative"),
        (jf.blocks(x), x[:3], {"memberships": False, "weights": np.zeros(N)}, "must not all be zero"),
        (jf.blocks(x), x[:3], {"memberships": False, "noise_distance": jf.NoiseRule()}, "number or None for blocks"),
        (jf.blocks(x), x[:3], {"memberships": False, "noise_distance": -1.0}, "above 0"),
    ):
        with pytest.raises(ValueError, match=says):
            jf.fcm(points, seeds, **options)
    start = start_in_4d(x)
    for options, says in (
        ({"start": np.ones((N, 1)), "embedding": "4d"}, "start must be Varieties"),
        ({"start": start, "embedding": "3d"}, "start must be Varieties in the embedding '3d'"),
        ({"start": start, "embedding": ("3d", "4d")}, "one name for blocks"),
        ({"start": start, "embedding": "4d", "distance": "algebraic", "dimension": 1}, "varieties of dimension 1"),
        ({"start": start, "embedding": "4d", "noise_distance": np.ones(N)}, "noise_distance must have shape"),
    ):
        with pytest.raises(ValueError, match=says):
            jf.nfcv(jf.blocks(x), **options)
