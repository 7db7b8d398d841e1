import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Quadric, Sphere
from jaxfuzzy.recover import CAN_BE, holds, recover
from jaxfuzzy.solve import Solver
from jaxfuzzy.varieties import nfcv

pytestmark = pytest.mark.usefixtures("compiled_for_one_run")

COUNT, OUTLIERS, DEVIATION = 500, 60, 0.002
EMBEDDINGS = ("3d", "4d", "6d", "cylinder", "sphere", "cone", "9d")
PLACE = np.array([0.3, -0.1, 1.1])
UP = np.array([0.0, 1.0, 0.0])


def cloud(kind, seed=0, deviation=DEVIATION, outliers=OUTLIERS):
    """The half of a primitive that faces the camera, 10 cm in radius, and uniform outliers."""
    rng = np.random.default_rng(seed)
    angle, share = rng.uniform(-1.3, 1.3, COUNT), rng.uniform(size=COUNT)
    circle = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1)
    if kind == "cylinder":
        points = 0.1 * circle + 0.25 * share[:, None] * UP
    elif kind == "sphere":
        height = rng.uniform(-0.9, 0.9, COUNT)[:, None]
        points = 0.1 * (np.sqrt(1 - height**2) * circle + height * UP)
    elif kind in ("cone up", "cone down"):
        along = 0.25 * np.sqrt(0.1 + 0.9 * share)[:, None]
        points = along * (np.tan(0.4) * circle + (UP if kind == "cone down" else -UP))
    elif kind == "ellipsoid":
        points = cloud("sphere", seed, 0.0, 0) * [1, 1.3, 1] - PLACE * [1, 1.3, 1]
    else:
        points = 0.2 * (
            rng.uniform(-1, 1, (COUNT, 1)) * LEVEL + 0.5 * rng.uniform(-1, 1, (COUNT, 1)) * np.cross(NORMAL, LEVEL)
        )
    points = PLACE + points + deviation * rng.normal(size=points.shape)
    return np.vstack([points, rng.uniform(points.min(0) - 0.02, points.max(0) + 0.02, (outliers, 3))])


LEVEL = np.array([np.cos(0.4), 0, np.sin(0.4)])
NORMAL = np.cross(LEVEL, [-np.sin(0.3) * np.sin(0.4), np.cos(0.3), np.sin(0.3) * np.cos(0.4)])


def fitted(points, deviation=DEVIATION):
    fits = np.ones((len(points), 1))
    for noise_distance in (0.1, 0.06, 0.03, 0.015, 4 * deviation):  # annealed
        fits = nfcv(points, fits, embedding=EMBEDDINGS, noise_distance=noise_distance, solver=Solver(200, 1e-9))
    return fits


KINDS = ("plane", "cylinder", "sphere", "cone up", "cone down", "ellipsoid")
FITS = {}


@pytest.fixture(scope="module")
def fits():
    return {kind: fitted(cloud(kind)) for kind in KINDS}


def check(kind, primitive, tilted=False):
    # 2 mm over 500 points of a 10 cm body: lengths to 1 mm, angles to 1 degree; ends to 2 %
    if kind == "plane":
        assert isinstance(primitive, Plane)
        assert abs(primitive.normal @ NORMAL) > np.cos(0.01)
        assert primitive.normal @ primitive.point < 0
        sides = np.linalg.norm(np.roll(primitive.corners, -1, 0) - primitive.corners, axis=1)
        np.testing.assert_allclose(sides, [0.4, 0.2, 0.4, 0.2], rtol=0.03)
        np.testing.assert_allclose((primitive.corners - primitive.point) @ primitive.normal, 0, atol=1e-12)
        np.testing.assert_allclose(primitive.corners[1, 1], primitive.corners[0, 1])  # level
    elif kind == "cylinder":
        assert isinstance(primitive, Cylinder)
        assert float(primitive.radius) == pytest.approx(0.1, abs=1e-3)
        np.testing.assert_allclose(primitive.base, PLACE, atol=6e-3)
        np.testing.assert_allclose(primitive.axis, UP, atol=0.03 if tilted else 0)
        assert float(primitive.height) == pytest.approx(0.25, rel=0.03)
    elif kind == "sphere":
        assert isinstance(primitive, Sphere)
        assert float(primitive.radius) == pytest.approx(0.1, abs=1e-3)
        np.testing.assert_allclose(primitive.center, PLACE, atol=1e-3)
    else:
        assert isinstance(primitive, Cone)
        sign = 1 if kind == "cone down" else -1
        np.testing.assert_allclose(primitive.axis, sign * UP, atol=0.03 if tilted else 0)
        assert float(primitive.half_angle) == pytest.approx(0.4, abs=0.03 if tilted else 0.01)
        np.testing.assert_allclose(primitive.apex, PLACE, atol=0.015 if tilted else 0.006)
        np.testing.assert_allclose(primitive.height, [0.25 * np.sqrt(0.1), 0.25], atol=0.02 if tilted else 0.01)


NAMES = {"plane": "plane", "cylinder": "cylinder", "sphere": "sphere", "cone up": "cone", "cone down": "cone"}


@pytest.mark.parametrize(
    ("kind", "embedding"),
    [(k, e) for k, n in NAMES.items() for e in EMBEDDINGS if n in CAN_BE[e] and (k, e) != ("plane", "9d")],
)
def test_known_truth(fits, kind, embedding):
    fit = fits[kind].pick(embedding)
    check(kind, recover(fit, NAMES[kind], points=cloud(kind)), tilted=embedding == "9d")


@pytest.mark.parametrize("count", [15, 30, 60])
def test_few_inliers_end_where_they_do_whatever_else_there_is(count):
    """Quantiles of fewer than 25 points lie beyond the last: what follows there, outliers and pads, must not lead them on."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-1.5, 1.5, count) - np.pi / 2
    own = np.stack([0.2 + 0.05 * np.cos(angle), np.linspace(0, 0.12, count), 1 + 0.05 * np.sin(angle)], 1)
    own += 3e-4 * rng.normal(size=own.shape)
    fit = lambda p, **options: nfcv(p, np.ones((len(p), 1)), embedding="cylinder", noise_distance=0.005, **options)
    alone = recover(fit(own), "cylinder", points=own).height
    assert float(alone) == pytest.approx(0.12, rel=0.1)
    outliers, pads, ones = np.array([[0.2, 5, 1], [0.2, -5, 1]]), np.full((40, 3), 50.0), np.ones(count)
    # Whether they come first or last.
    for far in (np.r_[own, outliers], np.r_[outliers, own]):
        for height in (recover(fit(far), "cylinder").height, recover(fit(far), "cylinder", points=far).height):
            np.testing.assert_allclose(height, alone, rtol=1e-5)
    for padded, weights in (
        (np.r_[own, pads], np.r_[ones, np.zeros(40)]),
        (np.r_[pads, own], np.r_[np.zeros(40), ones]),
    ):
        found = fit(padded, weights=weights)
        for points in ({}, {"points": padded, "weights": weights}):
            np.testing.assert_allclose(recover(found, "cylinder", **points).height, alone, rtol=1e-5)


def test_the_heaviest_variety_is_the_one_with_most_weight():
    rng = np.random.default_rng(1)
    flat = lambda count, z: np.column_stack([rng.uniform(-1, 1, (count, 2)), z + 1e-3 * rng.normal(size=count)])
    points, weights = np.r_[flat(40, 1.0), flat(30, 1.3)], np.r_[np.ones(40), np.full(30, 10.0)]
    start = np.where((np.arange(70) < 40)[:, None], [0.9, 0.1], [0.1, 0.9])
    plane = recover(nfcv(points, start, embedding="3d", weights=weights, noise_distance=0.02), "plane")
    assert float(plane.point[2]) == pytest.approx(1.3, abs=0.01)
    with pytest.raises(ValueError, match="weights must come with points"):
        recover(nfcv(points, start, embedding="3d"), "plane", weights=weights)


@pytest.mark.parametrize("embedding", ["6d", "cone"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_hold_is_a_quadric(fits, kind, embedding):
    fit = fits[kind].pick(embedding)
    for asked in ("plane", "cylinder", "sphere", "cone"):
        right = asked == NAMES.get(kind)
        assert bool(holds(fit, asked)) == right, asked
        assert isinstance(recover(fit, asked), Quadric) != right
    quadric = recover(fit, "quadric")
    # the polynomial of the hyperplane itself: distances agree to first order, which is what nfcv gives
    np.testing.assert_allclose(quadric.distance(cloud(kind)) ** 2, fit.squared_distances[:, 0], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(quadric.bounds, fit.bounds[0])


def test_completing_squares_by_hand():
    """On (x - 1)² + (z - 4)² = 4 the squares leave a = 1, b = 4, r = 2 exactly, whatever the distance."""
    angle = np.arange(300) * 0.1
    points = np.stack([1 + 2 * np.sin(angle), np.arange(300) % 4, 4 - 2 * np.cos(angle)], 1)
    for distance in ("geometric", "algebraic"):
        for embedding in ("cylinder", "4d"):
            fit = nfcv(points, np.ones((300, 1)), embedding=embedding, distance=distance)
            cylinder = recover(fit, "cylinder")
            assert float(cylinder.radius) == pytest.approx(2, abs=1e-9)
            np.testing.assert_allclose(cylinder.base[jnp.array([0, 2])], [1, 4], atol=1e-9)


def test_literal_4d_coefficients_lose_the_radius_of_a_quarter_arc_and_ties_keep_it():
    rng = np.random.default_rng(3)
    angle, y = rng.uniform(-np.pi / 4, np.pi / 4, 300), rng.uniform(-4, 4, 300)
    points = np.stack([3 * np.sin(angle), y, 40 - 3 * np.cos(angle)], 1) + 0.05 * rng.normal(size=(300, 3))
    literal = nfcv(points, np.ones((300, 1)), embedding="4d", distance="algebraic")
    a, c, d, f = np.asarray(literal.normals[0])
    level = d**2 / (4 * a) + f**2 / (4 * c) + float(literal.normals[0] @ literal.centers[0])
    assert np.sqrt(level / ((a + c) / 2)) < 0.6
    for embedding in ("4d", "cylinder"):
        tied = recover(nfcv(points, np.ones((300, 1)), embedding=embedding), "cylinder")
        assert float(tied.radius) == pytest.approx(3, rel=0.02)


def test_radius_of_a_quarter_arc_under_strong_noise():
    """90 degrees with noise of 10 % of the radius: 3 within 1 % in the median of 40 clouds, as Taubin's fit allows."""
    radii = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        angle, y = rng.uniform(-np.pi / 4, np.pi / 4, 300), rng.uniform(-4, 4, 300)
        away = 3 + 0.3 * rng.normal(size=300)
        points = np.stack([away * np.sin(angle), y, 40 - away * np.cos(angle)], 1)
        radii.append(float(recover(nfcv(points, np.ones((300, 1)), embedding="cylinder"), "cylinder").radius))
    # the median of 40 such fits, each some 15 % off, is sure to 3 %
    assert np.median(radii) == pytest.approx(3, rel=0.03)


def faces(count, seed=0):
    """Two or three faces of a box of 0.3, 0.2, 0.1 turned by 0.5 about the vertical, seen from the side of their normals."""
    rng = np.random.default_rng(seed)
    axes = np.array([[np.cos(0.5), 0, np.sin(0.5)], [-np.sin(0.5), 0, np.cos(0.5)], [0, 1, 0]])
    size, parts = np.array([0.3, 0.2, 0.1]), []
    for i in range(count):
        local = rng.uniform(-0.5, 0.5, (200, 3))
        local[:, i] = -0.5 if i < 2 else 0.5
        parts.append(PLACE + (local * size) @ axes + 0.001 * rng.normal(size=(200, 3)))
    start = np.repeat(np.eye(count), 200, axis=0) * 0.8 + 0.1
    return np.vstack(parts), start, axes, size


@pytest.mark.parametrize("count", [2, 3])
def test_box_from_its_faces(count):
    points, start, axes, size = faces(count)
    fit = nfcv(points, start, embedding="3d", noise_distance=0.01)
    box = recover(fit, "box")
    assert isinstance(box, Box)
    # 1 mm over 200 points a face
    np.testing.assert_allclose(np.abs(np.sum(box.axes * axes, 1)), 1, atol=1e-4)
    np.testing.assert_allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(box.size, size, rtol=0.04)
    np.testing.assert_allclose(box.center, PLACE, atol=3e-3)
    bent = points.copy()
    bent[200:400] += 0.3 * (points[200:400] @ axes[0] - PLACE @ axes[0])[:, None] * axes[1]
    assert isinstance(recover(nfcv(bent, start, embedding="3d", noise_distance=0.01), "box"), Quadric)


def test_patch_alike_in_both_directions_is_square():
    rng = np.random.default_rng(0)
    count = COUNT + OUTLIERS
    turned = rng.uniform(-1, 1, (count, 2)) @ [[np.sqrt(0.5), np.sqrt(0.5)], [-np.sqrt(0.5), np.sqrt(0.5)]]
    plane = recover(fitted(np.column_stack([turned, np.full(count, 3.0)])).pick("3d"), "plane")
    sides = np.linalg.norm(np.roll(plane.corners, -1, 0) - plane.corners, axis=1)
    np.testing.assert_allclose(sides, sides[0], rtol=0.05)


GRADIENTS = {
    ("cylinder", "cylinder"): lambda p: jnp.stack([p.radius, p.height, p.base[0]]),
    ("sphere", "6d"): lambda p: jnp.append(p.center, p.radius),
    ("cone up", "cone"): lambda p: jnp.concatenate([p.apex, p.half_angle[None], p.height]),
    ("cylinder", "9d"): lambda p: jnp.append(p.axis, p.radius),
}


# Each compiles for a while; one of them, with every part of the way in it, is looked at every time.
@pytest.mark.parametrize(
    ("kind", "embedding"),
    [pytest.param(*case, marks=[] if case[1] == "9d" else pytest.mark.slow) for case in GRADIENTS],
)
def test_derivatives_reach_back_to_the_noise_distance_and_the_fuzzifier(fits, kind, embedding):
    points, start = cloud(kind), np.asarray(fits[kind].pick(embedding).memberships)

    def numbers(hyper):
        fit = nfcv(points, start, embedding=embedding, noise_distance=hyper[0], m=hyper[1], solver=Solver(1000, 1e-14))
        return GRADIENTS[kind, embedding](recover(fit, NAMES[kind]))

    at = np.array([0.01, 2.0])
    both = jax.jit(lambda h: (numbers(h), jax.jacrev(numbers)(h)))
    exact = both(at)[1]
    for i, step in enumerate([1e-7, 1e-5]):
        shift = step * np.eye(2)[i]
        numeric = (both(at + shift)[0] - both(at - shift)[0]) / (2 * step)
        # fits repeat to 1e-13, which the step of 1e-7 turns into 1e-6
        np.testing.assert_allclose(exact[:, i], numeric, rtol=1e-6, atol=2e-6)


def test_batches_and_far_places():
    """The same body at three places, 50 m away among them, in one batch and in single precision."""
    shifts = np.array([[0.0, 0, 0], [3, -1, 5], [-20, 5, 50]])
    points = cloud("cylinder")[None] + shifts[:, None]
    start = np.ones((len(points[0]), 1))

    def radius(p, s):
        fit = nfcv(p, s, embedding="cylinder", noise_distance=0.01)
        cylinder = recover(fit, "cylinder")
        return cylinder.radius, cylinder.base

    begin = np.asarray(nfcv(points[0], start, embedding="cylinder", noise_distance=0.03).memberships)
    radii, bases = jax.jit(jax.vmap(radius, (0, None)))(points, begin)
    np.testing.assert_allclose(radii, radii[0], rtol=1e-6)
    np.testing.assert_allclose(bases - shifts, np.tile(bases[0], (3, 1)), atol=1e-6)
    small, _ = jax.jit(jax.vmap(radius, (0, None)))(points.astype(np.float32), begin.astype(np.float32))
    assert small.dtype == np.float32
    # coordinates near 50 m hold 4 µm in single precision
    np.testing.assert_allclose(small, radii, rtol=1e-3)


@pytest.mark.parametrize(
    ("embedding", "kind", "message"),
    [
        ("all", "plane", r"varieties must be of one embedding, got 7: use varieties.pick\(name\)"),
        ("3d", "torus", "kind must be one of 'plane', 'box'.*, got 'torus'"),
        ("3d", "sphere", "kind must be one of 'plane', 'box', 'quadric' in the embedding '3d', got 'sphere'"),
        ("3d", "box", "kind 'box' must have two or three varieties, one a face, got 1"),
    ],
)
def test_wrong_arguments_are_named(fits, embedding, kind, message):
    fit = fits["plane"] if embedding == "all" else fits["plane"].pick(embedding)
    with pytest.raises(ValueError, match=message):
        recover(fit, kind)
    with pytest.raises(ValueError, match=message):
        holds(fit, kind)


def test_which_variety():
    points, start, _, _ = faces(2)
    fit = nfcv(points, start, embedding="3d", noise_distance=0.01, weights=np.repeat([1.0, 0.2], 200))
    for i in range(2):
        assert abs(recover(fit, "plane", variety=i).normal @ fit.normals[i]) > 1 - 1e-12
    with pytest.raises(ValueError, match="variety must be at least 0 and at most 1, got 2"):
        recover(fit, "plane", variety=2)


def test_pick(fits):
    plane = fits["plane"].pick("3d")
    assert plane.centers.shape == (1, 3)
    assert plane.basis.shape == (1, 3, 2)
    assert plane.pick("3d") is plane
    with pytest.raises(ValueError, match="embedding must be one of '3d', got '4d'"):
        plane.pick("4d")
    with pytest.raises(ValueError, match=r"embedding must be one of '3d', '4d', '6d', .*, got '5d'"):
        fits["plane"].pick("5d")
