"""Anything at all thrown at the public functions: an answer with a status, or an error that says what was wrong.

The default run takes a few hundred cases; `python -m pytest -m slow tests/test_hardness.py` takes thousands.
"""

import signal
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxfuzzy as jf
from jaxfuzzy import report
from jaxfuzzy.status import Status

HERE = Path(__file__).parent
# Few compiled shapes: the sizes are fixed, the contents are not.
POINTS, CLUSTERS = 24, 3
QUICK = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
LONG = settings(max_examples=2000, deadline=None, print_blob=True, suppress_health_check=list(HealthCheck))
SAID = (ValueError, TypeError)
SHORT = jf.Solver(max_steps=30)


def made(kind, rng, count, dims):
    """Points of one of the kinds that break things."""
    x = rng.normal(size=(count, dims))
    match kind:
        case "duplicates":
            return x[rng.integers(0, max(1, count // 6), count)]
        case "two values":
            return np.where(rng.random((count, 1)) < 0.5, 0.0, 1.0) * np.ones(dims)
        case "constant":
            return np.ones((count, dims)) * x[0]
        case "zero":
            return np.zeros((count, dims))
        case "collinear":
            return x[:, :1] * x[0] + x[1]
        case "coplanar":
            return x @ np.diag([1.0] * (dims - 1) + [0.0])
        case "grid":
            return np.round(x * 2)
        case "one far":
            x[0] *= 1e6
        case "heavy tails":
            return x / np.maximum(rng.random((count, 1)), 1e-12) ** 4
        case "sorted":
            return np.sort(x, axis=0)
        case "sphere":
            return x / np.linalg.norm(x, axis=1, keepdims=True)
    return x


KINDS = ("normal", "duplicates", "two values", "constant", "zero", "collinear", "coplanar", "grid", "one far", "heavy tails",
         "sorted", "sphere")  # fmt: skip
# All of them become the default type, so that the default run compiles little; the long one has float32 too.
DTYPES = (np.float64, np.float64, np.float64, np.float16, np.int32, np.uint8, bool)
ALL_DTYPES = (*DTYPES, np.float32, np.float32, np.float32)


@st.composite
def clouds(draw, count=POINTS, dims=3, dtypes=DTYPES):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    x = made(draw(st.sampled_from(KINDS)), rng, count, dims)
    scale = 10.0 ** draw(st.sampled_from((0, 0, 0, -3, 3, -12, 12, -37, 37, -150, 150, -300, 300)))
    shift = draw(st.sampled_from((0, 0, 1, 1e3, -1e6, 1e9)))
    with np.errstate(all="ignore"):
        x = (x + shift * np.abs(x).max()) * scale
    poison = draw(st.sampled_from((None,) * 8 + (np.nan, np.inf, -np.inf)))
    if poison is not None:
        x[draw(st.integers(0, count - 1)), draw(st.integers(0, dims - 1))] = poison
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return x.astype(draw(st.sampled_from(dtypes)))


def holds(result, *, but=()):
    """Nothing in a result is NaN, nor infinite unless it may be, where the status does not say so."""
    status = int(np.bitwise_or.reduce(np.ravel(np.asarray(result.status))))
    if status & Status.NOT_FINITE:
        return
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        name = jax.tree_util.keystr(path)
        value = np.asarray(leaf)
        if value.dtype.kind == "f" and not any(part in name for part in ("noise_distance", "score", "margin", *but)):
            assert np.isfinite(value).all(), (name, value, status)
    assert jf.describe(status)


def answered(call, *args, **kwargs):
    """What a call gives, or None where it refuses in a sentence."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return call(*args, **kwargs)
        except SAID as error:
            said = str(error)
    assert 10 < len(said) < 1000, said
    assert "\n" not in said, said
    return None


odd_numbers = st.sampled_from(
    (0, -1, 1, 1.5, 1 + 1e-9, 50.0, 1e6, 1e-30, 1e30, 1e300, np.nan, np.inf, "2", True, 1j, [2.0], 10**400)
)
given_numbers = st.one_of(st.just(1.7), st.floats(1.01, 5.0), odd_numbers)
numbers = st.one_of(st.just(2.0), st.none(), given_numbers)
WEIGHINGS = ("ones", "ones", "random", "zeros", "one", "tiny", "huge", "negative", "nan", "short", "text")
weighings, all_weighings = st.sampled_from(WEIGHINGS), st.sampled_from((*WEIGHINGS, "none", "none"))


def weights_of(name, count):
    rng = np.random.default_rng(0)
    return {
        "none": None,
        "ones": np.ones(count),
        "random": rng.random(count),
        "zeros": np.zeros(count),
        "one": np.eye(count)[0],
        "tiny": np.full(count, 1e-30),
        "huge": np.full(count, 1e30),
        "negative": rng.normal(size=count),
        "nan": np.full(count, np.nan),
        "short": np.ones(count - 1),
        "text": ["a"] * count,
    }[name]


def try_fcm(x, pick, m, sizes, delta, weighing):
    seeds = x[np.random.default_rng(pick).choice(len(x), CLUSTERS, replace=pick % 2 == 0)]
    found = answered(
        jf.fcm, x, seeds, m=m, sizes=sizes, noise_distance=delta, weights=weights_of(weighing, len(x)), solver=SHORT
    )
    if found is None:
        return
    holds(found)
    if not int(found.status) & Status.NOT_FINITE:
        total = np.asarray(found.memberships).sum(axis=1) + np.asarray(found.noise)
        # Each is an exponential of its own: their sum is 1 to the rounding of as many terms in float32.
        np.testing.assert_allclose(total, 1, atol=1e-5)
        assert np.asarray(jf.memberships(x[:5].astype(found.centers.dtype), found)).shape == (5, CLUSTERS)


fcm_cases = (clouds(), st.integers(0, 9), numbers, st.just(True), given_numbers, weighings)
all_fcm_cases = (clouds(dtypes=ALL_DTYPES), st.integers(0, 9), numbers, st.booleans(), numbers, all_weighings)


@given(st.tuples(*fcm_cases))
@QUICK
def test_fcm(case):
    try_fcm(*case)


@pytest.mark.slow
@given(st.tuples(*all_fcm_cases))
@LONG
def test_fcm_at_length(case):
    try_fcm(*case)


def try_nfcv(x, pick, m, delta, distance, embedding, weighing):
    start = np.random.default_rng(pick).dirichlet(np.ones(2), len(x)) if pick else np.ones((len(x), 2))
    found = answered(
        jf.nfcv,
        x,
        start,
        m=m,
        noise_distance=delta,
        distance=distance,
        embedding=embedding,
        weights=weights_of(weighing, len(x)),
        solver=SHORT,
    )
    if found is not None:
        holds(found)


nfcv_cases = (clouds(), st.integers(0, 3), numbers, given_numbers, st.just("geometric"), st.just("4d"), weighings)
all_nfcv_cases = (
    clouds(dtypes=ALL_DTYPES),
    st.integers(0, 3),
    numbers,
    numbers,
    st.sampled_from(("geometric", "algebraic")),
    st.sampled_from(("3d", "4d", "6d")),
    all_weighings,
)


@given(st.tuples(*nfcv_cases))
@QUICK
def test_nfcv(case):
    try_nfcv(*case)


@pytest.mark.slow
@given(st.tuples(*all_nfcv_cases))
@LONG
def test_nfcv_at_length(case):
    try_nfcv(*case)


def try_choose_k(x, m, index, weighing):
    found = answered(jf.choose_k, x, (2, 3), m=m, index=index, weights=weights_of(weighing, len(x)), solver=SHORT)
    if found is not None:
        holds(found)
        assert int(found.k) in (2, 3)


choose_k_cases = (clouds(), numbers, st.just("vrc"), weighings)
all_choose_k_cases = (
    clouds(dtypes=ALL_DTYPES),
    numbers,
    st.sampled_from(("vrc", "xie_beni", "fuzzy_silhouette")),
    all_weighings,
)


@given(st.tuples(*choose_k_cases))
@QUICK
def test_choose_k(case):
    try_choose_k(*case)


@pytest.mark.slow
@given(st.tuples(*all_choose_k_cases))
@LONG
def test_choose_k_at_length(case):
    try_choose_k(*case)


def try_shapes(x, delta, weighing):
    """One shape of an object, and the objects of a scene."""
    weights = weights_of(weighing, len(x))
    shape = answered(jf.fit_shape, x, noise_distance=delta, weights=weights)
    if shape is not None:
        assert np.isfinite(shape.noise_distance).all()
        if shape.primitive is not None and not int(shape.status) & Status.NOT_FINITE:
            assert np.isfinite(np.asarray(shape.primitive.parameters())).all(), shape
    scene = answered(jf.segment, x, noise_distance=delta, weights=weights, ks=(1, 2, 3))
    if scene is not None:
        holds(scene)
        assert np.asarray(scene.labels).shape == (len(x),)
        assert np.asarray(scene.labels).max() < int(scene.k)


@pytest.mark.slow
@given(clouds(count=120, dtypes=(np.float32,)), st.one_of(st.just("auto"), given_numbers), weighings)
@settings(LONG, max_examples=400)
def test_shapes_at_length(x, delta, weighing):
    try_shapes(x, delta, weighing)


@pytest.mark.parametrize("m", [1e300, 1 + 1e-9])
def test_a_fuzzifier_that_single_precision_cannot_hold_is_refused(m):
    x = np.random.default_rng(0).normal(size=(24, 3)).astype(np.float32)
    for call in (lambda: jf.fcm(x, x[:2], m=m), lambda: jf.choose_k(x, m=m), lambda: jf.nfcv(x, np.ones((24, 1)), m=m)):
        with pytest.raises(ValueError, match="m must be a finite number above 1"):
            call()


@pytest.mark.parametrize("value", [0.0, 3.0, 0.1])
def test_points_that_are_all_one_are_one_object(value):
    found = jf.segment(np.full((120, 3), value, np.float32))
    assert int(found.k) == 1
    np.testing.assert_allclose(found.partition.centers, [[value] * 3], rtol=1e-6)
    assert (np.asarray(found.labels) == 0).all()


def test_a_noise_distance_beyond_all_points_is_that_of_their_extent():
    x = np.random.default_rng(0).normal(size=(120, 3)).astype(np.float32)
    found, wide = jf.segment(x, noise_distance=1e30), jf.segment(x, noise_distance=100.0)
    holds(found)
    np.testing.assert_array_equal(found.labels, wide.labels)


@pytest.mark.parametrize("scale", [1e-37, 1e-12, 1e12, 1e30])
def test_scenes_of_no_size_are_refused(scale):
    x = np.random.default_rng(0).normal(size=(60, 3)) * scale
    for call in (jf.segment, jf.fit_shape, jf.find_ground, lambda x: jf.model_cloud(jf.Cloud(x))):
        with pytest.raises(ValueError, match="give them in another unit"):
            call(x)


@given(clouds(), st.sampled_from((0, 1, 3, 24, 25, "3", 2.0, None)), weighings)
@QUICK
def test_seeds(x, k, weighing):
    found = answered(jf.histogram_seeds, x, k, weights=weights_of(weighing, len(x)))
    if found is not None:
        holds_seeds = [np.asarray(leaf) for leaf in jax.tree.leaves(found)]
        assert all(np.isfinite(leaf).all() for leaf in holds_seeds)
        assert found.centers.shape == (k, 3)


@pytest.mark.parametrize(
    "x", [None, "points", b"points", [], [[]], np.zeros((0, 3)), np.zeros((3, 0)), np.zeros(3), np.zeros((2, 2, 2)), 5,
          [[1, 2, 3], [4, 5]], [["a", "b", "c"]], np.zeros((4, 3), complex), np.array([[None] * 3]), {"x": 1}, object(),
          np.zeros((3, 3), "M8[s]"), [[10**400, 0, 0]]]
)  # fmt: skip
def test_what_is_no_cloud_is_refused_in_a_sentence(x):
    seeds = np.zeros((1, 3))
    for call in (
        lambda: jf.fcm(x, seeds),
        lambda: jf.fcm(np.zeros((4, 3)), x),
        lambda: jf.nfcv(x, np.ones((4, 1))),
        lambda: jf.nfcv(np.zeros((4, 3)), x),
        lambda: jf.choose_k(x),
        lambda: jf.histogram_seeds(x, 1),
        lambda: jf.segment(x),
        lambda: jf.fit_shape(x),
        lambda: jf.fit_shapes(x, np.zeros(4, int)),
        lambda: jf.find_ground(x),
        lambda: jf.variance_ratio(x, np.zeros(4, int)),
    ):
        assert answered(call) is None


def fuzz(cases, seed):
    done = subprocess.run(
        [sys.executable, HERE / "fuzz_files.py", "--cases", str(cases), "--seed", str(seed)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    # The last case said on standard error is the one that hung or crashed the process.
    assert done.returncode == 0, done.stdout + done.stderr.split("\r")[-1]
    print(done.stdout)


def test_damaged_files():
    fuzz(500, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_damaged_files_at_length(seed):
    fuzz(10_000, seed)


def test_a_killed_run_leaves_the_old_folder_or_the_new_one(tmp_path):
    done = subprocess.run(
        [sys.executable, HERE / "kill_save.py", str(tmp_path), "8"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    lines = done.stdout.splitlines()
    # Two files are put aside and three moved in: killed before any of the five moves, the old folder stands.
    assert lines[:5] == ["killed | old old - | later later later"] * 5
    assert lines[5:] == ["done | new new new | later later later", "saved"]
    scene = report.load(tmp_path / "scene")
    assert scene.settings == {"run": 1}
    report.save(scene, tmp_path / "scene", view=False)
    assert not [path for path in (tmp_path / "scene").iterdir() if path.name.startswith(".")]
