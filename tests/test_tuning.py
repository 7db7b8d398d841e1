"""Tuning: known minima of losses in closed form, of fits, and every way to fail said so."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxfuzzy import losses
from jaxfuzzy.fcm import fcm
from jaxfuzzy.recover import recover
from jaxfuzzy.sensitivity import influence
from jaxfuzzy.simulate import simulate_object
from jaxfuzzy.solve import Solver
from jaxfuzzy.status import Status
from jaxfuzzy.tuning import Hyper, tune
from jaxfuzzy.varieties import nfcv

pytestmark = pytest.mark.usefixtures("compiled_for_one_run")

EXACT = Solver(max_steps=5_000, tol=1e-13)
GOOD = Hyper(1.4, jnp.array([0.3, 5.0]), jnp.array([0.0, 2.0, 0.5]))


def bowl(hyper):
    """Least, and 7, at GOOD; not quadratic in what is tuned."""
    m = jnp.log(hyper.m - 1) - jnp.log(GOOD.m - 1)
    noise = jnp.log(hyper.noise_distance / GOOD.noise_distance)
    weights = jnp.log(hyper.weights[1:] / GOOD.weights[1:])
    return 7 + jnp.cosh(m) - 1 + m * noise[0] / 2 + noise @ noise + weights @ weights


START = Hyper(3.0, jnp.array([1.0, 1.0]), jnp.array([0.0, 1.0, 1.0]))


def test_finds_a_known_minimum():
    seen = []
    tuned = tune(bowl, START, progress=lambda text, share: seen.append((text, share)))
    assert int(tuned.status) == 0
    # The loss is 7 with rounding 1e-15, so places are known to about the root of that.
    for found, good in zip(jax.tree.leaves(tuned.hyper), jax.tree.leaves(GOOD), strict=True):
        np.testing.assert_allclose(found, good, rtol=1e-4)
    assert (np.diff(tuned.losses) <= 0).all()
    assert len(seen) == tuned.evaluations - 1
    assert all(text.startswith("tuning") and 0 < share <= 1 for text, share in seen)


def test_path_losses_and_gradients_belong_together():
    tuned = tune(bowl, START)
    places = [jax.tree.map(lambda leaf, s=s: leaf[s], tuned.path) for s in range(len(tuned.losses))]
    np.testing.assert_array_equal(jax.tree.leaves(places[0])[0], START.m)
    for place, value, gradient in zip(
        places,
        tuned.losses,
        [jax.tree.map(lambda g, s=s: g[s], tuned.gradients) for s in range(len(places))],
        strict=True,
    ):
        expected, slope = jax.value_and_grad(bowl)(place)
        np.testing.assert_allclose(value, expected, rtol=1e-12)
        np.testing.assert_allclose(gradient.m, slope.m, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(gradient.noise_distance, slope.noise_distance, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(gradient.weights, slope.weights, rtol=1e-9, atol=1e-9)


def test_unit_of_the_loss_is_of_no_account():
    tuned = tune(lambda hyper: 1e-9 * (bowl(hyper) - 7), START)
    assert int(tuned.status) == 0
    np.testing.assert_allclose(tuned.hyper.m, 1.4, rtol=1e-3)


def test_single_precision():
    start = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), START)
    tuned = tune(lambda hyper: jnp.asarray(bowl(hyper), jnp.float32), start)
    assert int(tuned.status) == 0
    assert tuned.losses.dtype == tuned.hyper.m.dtype == jnp.float32
    # A loss of 7 known to 1e-6 hides errors of its root.
    np.testing.assert_allclose(tuned.hyper.m, 1.4, rtol=2e-3)


def test_another_minimiser_and_what_is_not_read():
    loss = lambda hyper: jnp.cosh(jnp.log(hyper.noise_distance / 0.2))
    tuned = tune(loss, Hyper(2.5, 1.0), solver=optx.LBFGS(rtol=1e-4, atol=1e-4))
    assert int(tuned.status) == 0
    np.testing.assert_allclose(tuned.hyper.noise_distance, 0.2, rtol=1e-3)
    assert float(tuned.hyper.m) == 2.5
    with pytest.raises(TypeError, match="must keep the gradient"):
        tune(loss, Hyper(2.5, 1.0), solver=optx.NelderMead(1e-4, 1e-4))


def test_data_may_come_with_the_loss():
    traces = []

    def loss(wanted, hyper):
        traces.append(1)
        return jnp.cosh(jnp.log(hyper.noise_distance / wanted))

    first = tune(jax.tree_util.Partial(loss, jnp.asarray(0.2)), Hyper(2.0, 1.0))
    traced = len(traces)
    second = tune(jax.tree_util.Partial(loss, jnp.asarray(0.7)), Hyper(2.0, 1.0))
    assert len(traces) == traced > 0
    np.testing.assert_allclose(first.hyper.noise_distance, 0.2, rtol=1e-3)
    np.testing.assert_allclose(second.hyper.noise_distance, 0.7, rtol=1e-3)


def by_noise(f):
    return lambda hyper: f(jnp.log(hyper.noise_distance))


FAILING = {
    "flat": (by_noise(lambda d: 0 * d + 1), Status.FLAT_LOSS),
    "kink": (by_noise(lambda d: jnp.abs(d - 0.37)), Status.STALLED | Status.NOT_CONVERGED),
    "jump": (by_noise(lambda d: jnp.where(d > -0.3, d, d + 2)), Status.STALLED | Status.NOT_CONVERGED),
    "falls for ever": (by_noise(lambda d: 1 / (1 + jnp.exp(d))), Status.RAN_AWAY | Status.NOT_CONVERGED),
    "not finite": (by_noise(lambda d: jnp.sqrt(d - 1)), Status.NOT_FINITE),
    "no slope": (by_noise(lambda d: jnp.sqrt(jnp.abs(d))), Status.NOT_FINITE),
}


@pytest.mark.parametrize("name", FAILING)
def test_failure_is_said(name):
    loss, expected = FAILING[name]
    tuned = tune(loss, Hyper(2.0, 1.0), steps=80)
    assert Status(int(tuned.status)) == expected
    assert np.isfinite(tuned.hyper.noise_distance)


def test_out_of_steps_is_not_converged():
    tuned = tune(bowl, START, steps=3)
    assert Status(int(tuned.status)) == Status.NOT_CONVERGED
    assert tuned.evaluations == 3


def test_one_evaluation_is_no_minimum():
    found = tune(lambda hyper: jnp.square(hyper.noise_distance - 3.0), Hyper(noise_distance=1.0), steps=1)
    assert found.gradients.noise_distance == pytest.approx(-4.0)
    assert int(found.status) & Status.NOT_CONVERGED


def test_a_start_without_slope_is_not_called_a_minimum():
    # Flat to rounding: a minimum here, but a plateau would look the same.
    tuned = tune(by_noise(lambda d: 1 + d**2), Hyper(2.0, 1.0 + 1e-12))
    assert Status(int(tuned.status)) == Status.FLAT_LOSS
    assert tuned.evaluations == 1


BAD = [
    ({"m": 1.0}, "start.m must be finite and above 1"),
    ({"noise_distance": 0.0}, "start.noise_distance must be finite and above 0"),
    ({"noise_distance": jnp.array([1.0, jnp.nan])}, "start.noise_distance must be finite"),
    ({"weights": jnp.array([-1.0, 2.0])}, "start.weights must be finite and not negative"),
    ({"weights": jnp.zeros(3)}, "not all zero"),
]


@pytest.mark.parametrize(("fields", "message"), BAD)
def test_wrong_starts(fields, message):
    with pytest.raises(ValueError, match=message):
        tune(bowl, Hyper(**fields))


def test_wrong_arguments():
    with pytest.raises(TypeError, match="start must be a Hyper"):
        tune(bowl, 2.0)
    with pytest.raises(ValueError, match="steps must be at least 1"):
        tune(bowl, START, steps=0)
    with pytest.raises(ValueError, match="loss must give one number"):
        tune(lambda hyper: hyper.weights, START)


CORNERS = np.array([[0.0, 0.0], [4.0, 0.0], [1.0, 4.0]])
GROUPS = np.repeat([0, 1, 2, -1], 20)


def scenes():
    """Three round clusters and a quarter of outliers, twice."""
    made = []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        blobs = [c + s * rng.normal(size=(20, 2)) for c, s in zip(CORNERS, (0.6, 1.0, 0.8), strict=True)]
        made.append(np.concatenate([*blobs, rng.uniform(-6, 9, (20, 2))]))
    return jnp.asarray(np.stack(made))


def label_loss(hyper):
    def one(points):
        fit = fcm(points, CORNERS, m=hyper.m, noise_distance=hyper.noise_distance, solver=EXACT)
        return losses.cross_entropy(fit.memberships, GROUPS, noise=fit.noise)

    return jax.vmap(one)(scenes()).mean()


def test_labels_choose_fuzzifier_and_noise_distance_over_a_batch():
    loss = jax.jit(label_loss)
    tuned = tune(label_loss, Hyper(3.0, 12.0))
    assert int(tuned.status) == 0
    grid = [
        (float(loss(Hyper(m, d))), m, d)
        for m in (1.1, 1.25, 1.4, 1.6, 2.0, 2.5)
        for d in (1.0, 1.5, 2.0, 2.5, 3.5, 5.0)
    ]
    lowest, m, d = min(grid)
    # The minimum lies within a cell of the grid's best and is at least as low.
    assert float(tuned.losses[-1]) <= lowest
    assert abs(np.log((float(tuned.hyper.m) - 1) / (m - 1))) < np.log(1.7)
    assert abs(np.log(float(tuned.hyper.noise_distance) / d)) < np.log(1.5)
    # Far less than a third of where it began, in fewer fits than half the grid has.
    assert float(tuned.losses[-1]) < float(tuned.losses[0]) / 3
    assert tuned.evaluations < len(grid) / 2
    step = 1e-4
    slope = jax.tree.map(lambda g: g[0], tuned.gradients)
    # Fourth-order differences: error step^4, rounding and the fits' own 1e-13 over the step.
    for name in ("m", "noise_distance"):
        at = lambda e, name=name: float(
            loss(Hyper(**{"m": 3.0, "noise_distance": 12.0, name: {"m": 3.0}.get(name, 12.0) + e}))
        )
        expected = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
        np.testing.assert_allclose(getattr(slope, name), expected, rtol=1e-6)


SEEN = simulate_object("cylinder", 3, points=(150, 150), outliers=0.3)
POINTS = jnp.asarray(SEEN.points)
NEAR = np.where(SEEN.labels[:, None] == 0, 1.0, 0.2)


def cylinder(points, hyper):
    fit = nfcv(
        points,
        NEAR,
        embedding="cylinder",
        m=hyper.m,
        noise_distance=hyper.noise_distance,
        weights=hyper.weights,
        solver=EXACT,
    )
    return recover(fit, "cylinder")


def shape_loss(hyper):
    # The fuzzifier held, so that the question has one answer.
    found = cylinder(POINTS, Hyper(2.0, hyper.noise_distance, jnp.ones(len(POINTS))))
    return losses.shape_error(found, SEEN.truths[0].primitive)


def test_geometry_chooses_the_noise_distance():
    tuned = tune(shape_loss, Hyper(2.0, 0.15))
    assert not int(tuned.status) & Status.STALLED
    # Not compiled as one, so that the fits are those compiled for the other tests.
    grid = [float(shape_loss(Hyper(2.0, d))) for d in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.15)]
    # Twenty times too wide it begins with the outliers in the fit.
    assert float(tuned.losses[-1]) <= 1.05 * min(grid)
    assert float(tuned.losses[-1]) < float(tuned.losses[0]) / 10


def radius(points, hyper):
    return cylinder(points, hyper).radius


def test_influence_is_what_leaving_out_does():
    ones = jnp.ones(len(POINTS))
    found = influence(radius, POINTS, Hyper(2.0, 0.01))
    value = lambda points=POINTS, noise=0.01, weights=ones: float(radius(points, Hyper(2.0, noise, weights)))
    np.testing.assert_allclose(found.value, value(), rtol=1e-12)

    def difference(change, h=1e-4):
        return (8 * (change(h) - change(-h)) - (change(2 * h) - change(-2 * h))) / (12 * h)

    by_weight = np.asarray(found.hyper.weights)
    for k in np.argsort(-np.abs(by_weight))[:2]:
        np.testing.assert_allclose(by_weight[k], difference(lambda e, k=k: value(weights=ones.at[k].add(e))), rtol=1e-6)
        # A tenth of a millimetre moves the fit so little that its 1e-13 shows in the fifth digit.
        expected = difference(lambda e, k=k: value(points=POINTS.at[k, 2].add(e)))
        np.testing.assert_allclose(found.points[k, 2], expected, rtol=1e-5)
    expected = difference(lambda e: value(noise=0.01 + e), 1e-5)
    np.testing.assert_allclose(found.hyper.noise_distance, expected, rtol=1e-6)
    # Leaving out one of 100 points is a large step, so first order is right in rank and size, not in digits.
    some = np.flatnonzero(SEEN.labels == 0)[:15]
    left = [value(weights=ones.at[k].set(0.0)) - value() for k in some]
    assert np.corrcoef(left, -by_weight[some])[0, 1] > 0.9
    # Ten noise distances off the surface a point's pull, d / (1 + d²)², has faded to 0.3 % of its peak; what lever it has there
    # multiplies that by a few.
    truth = SEEN.truths[0].primitive
    off = np.hypot(*(SEEN.points - truth.base)[:, [0, 2]].T) - truth.radius
    assert np.abs(by_weight[np.abs(off) > 0.1]).max() < 0.05 * np.abs(by_weight).max()


def test_influence_wants_one_number():
    with pytest.raises(ValueError, match="measure must give one number"):
        influence(lambda points, hyper: points, POINTS, Hyper())
    with pytest.raises(ValueError, match="weights must have shape"):
        influence(radius, POINTS, Hyper(2.0, 0.01, jnp.ones(3)))
