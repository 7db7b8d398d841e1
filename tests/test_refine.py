import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.spatial.transform

from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Quadric, Sphere, transform
from jaxfuzzy.refine import refine
from jaxfuzzy.status import Status

SIGMA, CLOUDS, COUNT, OUTLIERS = 0.002, 200, 300, 30
UP = np.array([0.0, 1.0, 0.0])
# Tilted and well away from the origin, as a camera sees it.
TURN = scipy.spatial.transform.Rotation.from_euler("xyz", [0.3, 0.4, -0.2]).as_matrix()
PLACE = np.array([0.2, -0.1, 1.1])


def visible(kind, rng):
    """A primitive of 10 cm at the origin, points on the half of it that faces -z, and their unit normals."""
    angle, share = rng.uniform(-1.3, 1.3, COUNT), rng.uniform(size=COUNT)
    circle = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1)
    if kind == "plane":
        points = np.column_stack([rng.uniform(-0.1, 0.1, (COUNT, 2)), np.zeros(COUNT)])
        corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
        return Plane(np.zeros(3), np.array([0.0, 0, -1]), corners), points, np.tile([0.0, 0, -1], (COUNT, 1))
    if kind == "sphere":
        height = rng.uniform(-0.9, 0.9, COUNT)[:, None]
        normals = np.sqrt(1 - height**2) * circle + height * UP
        return Sphere(np.zeros(3), np.array(0.1)), 0.1 * normals, normals
    if kind == "cylinder":
        points = 0.1 * circle + 0.25 * share[:, None] * UP
        return Cylinder(np.zeros(3), UP, np.array(0.1), np.array(0.25)), points, circle
    if kind == "cone":
        along = 0.25 * np.sqrt(0.1 + 0.9 * share)[:, None]
        points = along * (np.tan(0.4) * circle + UP)
        height = np.array([0.25 * np.sqrt(0.1), 0.25])
        return Cone(np.zeros(3), UP, np.array(0.4), height), points, np.cos(0.4) * circle - np.sin(0.4) * UP
    axes = scipy.spatial.transform.Rotation.from_euler("y", 0.6).as_matrix()
    size, face = np.array([0.2, 0.15, 0.25]), rng.integers(0, 3, COUNT)
    inward = np.where(axes[:, 2] > 0, 1.0, -1.0)
    inward[1] = 1.0
    local = rng.uniform(-0.5, 0.5, (COUNT, 3))
    local[np.arange(COUNT), face] = -0.5 * inward[face]
    normals = -inward[face][:, None] * axes[face]
    return Box(np.zeros(3), size, axes, np.ones(3, bool)), (local * size) @ axes, normals


def cloud(kind, seed):
    rng = np.random.default_rng(seed)
    truth, points, normals = visible(kind, rng)
    points = points + SIGMA * rng.normal(size=(COUNT, 1)) * normals
    low, high = points.min(0) - 0.02, points.max(0) + 0.02
    points = np.vstack([points, rng.uniform(low, high, (OUTLIERS, 3))])
    return transform(truth, TURN, PLACE), points @ TURN.T + PLACE


def off(primitive, by=0.5):
    """A start some half a deviation off."""
    turn = scipy.spatial.transform.Rotation.from_rotvec(by * SIGMA * 10 * np.array([1, -1, 0.5])).as_matrix()
    return transform(primitive, turn, PLACE - turn @ PLACE + by * SIGMA * np.array([1, -1, 1]))


KINDS = ("plane", "sphere", "cylinder", "cone", "box")


KINDS = ("plane", "sphere", "cylinder", "cone", "box")
# Corner of a box and its rotation: of three seen faces and three hidden ones, the seen ones meet where the camera looks.
BATCH = jax.jit(jax.vmap(lambda s, p: refine(s, p, noise_distance=2.5 * SIGMA), (None, 0)))


def numbers(primitive):
    """What the points tell: all parameters, of a box the corner in which its seen faces meet and its rotation."""
    if not isinstance(primitive, Box):
        return primitive.parameters()
    corner = primitive.center @ primitive.axes.T - jnp.asarray(INWARD) * primitive.size / 2
    return jnp.concatenate([corner, primitive.parameters()[6:]])


INWARD = np.where(scipy.spatial.transform.Rotation.from_euler("y", 0.6).as_matrix()[:, 2] > 0, 1.0, -1.0)
INWARD[1] = 1.0


@pytest.mark.parametrize("kind", KINDS)
def test_error_bars_are_calibrated(kind):
    truth, _ = cloud(kind, 0)
    fits = BATCH(off(truth), np.stack([cloud(kind, seed)[1] for seed in range(CLOUDS)]))
    assert not np.any(np.asarray(fits.status))
    estimates = np.asarray(jax.jit(jax.vmap(lambda p: p.parameters()))(fits.primitive))
    error, covariance = estimates - np.asarray(truth.parameters()), np.asarray(fits.covariance)
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    if kind == "box":
        # Hidden ends stay where the start put them, so size and center are as sure as the seen faces that they end at: along
        # each axis center - inward · size / 2 is such a face. A face moves both alike, hence size / 2 and center agree.
        change = np.zeros((6, 9))
        change[:3, :3], change[:3, 3:6], change[3:, 6:] = np.asarray(truth.axes), -np.diag(INWARD) / 2, np.eye(3)
        error, covariance = error @ change.T, change @ covariance @ change.T
    spread = (error / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).std(0)
    # 200 clouds tell a standard deviation to 5 %
    assert (spread > 0.8).all(), spread
    assert (spread < 1.2).all(), spread


def literal(kind, start, points):
    """The same objective by scipy, without jaxfuzzy: unbounded distances, Geman-McClure, from the same start."""
    delta = 2.5 * SIGMA
    if kind == "sphere":
        distance = lambda t: np.linalg.norm(points - t[:3], axis=1) - t[3]
        first = np.append(start.center, start.radius)
    else:
        first = np.concatenate([start.base, start.axis, [start.radius]])

        def distance(t):
            axis = t[3:6] / np.linalg.norm(t[3:6])
            local = points - t[:3]
            return np.linalg.norm(local - np.outer(local @ axis, axis), axis=1) - t[6]

    robust = lambda t: distance(t) / np.sqrt(1 + (distance(t) / delta) ** 2)
    return scipy.optimize.least_squares(robust, first, xtol=1e-12, ftol=1e-12, gtol=1e-12).x


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_it_is_the_minimum_of_the_noise_clustering_objective(kind):
    truth, points = cloud(kind, 3)
    fit = jax.tree.map(lambda leaf: leaf[0], BATCH(off(truth), np.repeat(points[None], CLOUDS, 0)))
    expected = literal(kind, off(truth), points)
    # both stop where a step changes less than half the digits of the objective
    assert float(fit.primitive.radius) == pytest.approx(expected[-1], abs=1e-6)
    distance = np.asarray(_endless(kind, fit.primitive, points))
    np.testing.assert_allclose(fit.memberships, 1 / (1 + (distance / (2.5 * SIGMA)) ** 2), atol=1e-9)


def _endless(kind, primitive, points):
    if kind == "sphere":
        return primitive.distance(points)
    long = Cylinder(primitive.base - 9 * primitive.axis, primitive.axis, primitive.radius, np.array(20.0))
    return long.distance(points)


def test_weights_status_and_quadrics():
    truth, points = cloud("sphere", 0)
    center, radius = np.asarray(truth.center), float(truth.radius)
    coefficients = np.concatenate([np.ones(3), np.zeros(3), -2 * center, [center @ center - radius**2]])
    weights = np.ones(len(points))
    weights[:30] = 0
    spoilt = points.copy()
    spoilt[:30] = 1e6
    fit = refine(Quadric(coefficients), spoilt, noise_distance=2.5 * SIGMA, weights=weights)
    assert int(fit.status) == 0
    unit = np.asarray(fit.primitive.parameters())
    sphere = refine(off(truth), points[30:], noise_distance=2.5 * SIGMA)
    # the quadric has five numbers more, so it follows the noise a little more closely
    assert float(sphere.primitive.radius) == pytest.approx(radius, abs=2e-3)
    np.testing.assert_allclose(unit[:3] / unit[0], 1, atol=0.2)
    near = np.abs(fit.primitive.distance(points[30:]) - sphere.primitive.distance(points[30:]))
    assert np.median(near) < SIGMA
    assert fit.covariance.shape == (10, 10)
    lost = refine(off(truth), points + 10, noise_distance=2.5 * SIGMA)
    assert int(lost.status) & Status.ALL_NOISE
    assert np.isfinite(lost.covariance).all()
    same = refine(off(truth), np.tile(points[:1], (30, 1)), noise_distance=2.5 * SIGMA)
    assert np.isfinite(same.covariance).all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"primitive": "sphere"}, TypeError, "primitive must be a Plane, Box, .*, got str"),
        ({"points": np.ones((4, 2))}, ValueError, r"points must have shape \(N, 3\), got \(4, 2\)"),
        ({"noise_distance": -1.0}, ValueError, "noise_distance must be finite and above 0, got -1"),
        ({"weights": np.ones(3)}, ValueError, "weights must have shape"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    truth, points = cloud("sphere", 0)
    arguments = {"primitive": truth, "points": points, "noise_distance": 0.01} | change
    with pytest.raises(error, match=message):
        refine(**arguments)
