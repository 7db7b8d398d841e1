"""From points to shapes: kinds and sizes with known truth in one batch, refusals, bad input, invariances, error bars, other rules.

The search compiles once for double precision with a camera and once for single precision without; every test uses one of the two.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy import bounds, fitting, looks, polish, rays, starts
from jaxfuzzy.objects import MOST, Frame, fair_order
from jaxfuzzy.primitives import Box, Cylinder
from jaxfuzzy.render import body_of
from jaxfuzzy.shapes import Fits, fit_shape, fit_shapes
from jaxfuzzy.simulate import KINDS, simulate_object
from jaxfuzzy.status import Status

SIGMAS = 2.5
CAMERA = np.zeros(3)
UPWARDS = np.array([0.0, 1.0, 0.0])


def together(clouds):
    """Points, labels and noise distances of several clouds seen from one place, as one call takes them."""
    labels = np.repeat(np.arange(len(clouds)), [len(c.points) for c in clouds])
    noise = SIGMAS * np.concatenate([c.depth_std for c in clouds])
    return np.concatenate([c.points for c in clouds]), labels, noise


def bad_objects():
    """Objects that nobody can name, and what should be said of them."""
    rng = np.random.default_rng(0)
    along = rng.uniform(-1, 1, (200, 1))
    far = np.array([0.0, 0.0, 1.2])
    return {
        "three points": (far + 0.1 * rng.normal(size=(3, 3)), Status.TOO_FEW_POINTS),
        "one line": (far + 0.1 * along * [1.0, 2.0, 0.5], Status.DEGENERATE),
        "one place": (np.tile(far, (50, 1)), Status.DEGENERATE),
        "noise alone": (far + rng.uniform(-0.2, 0.2, (400, 3)), Status.REFUSED),
    }


@pytest.fixture(scope="module")
def clouds():
    """Three clouds a kind with up to 30 % outliers, and six that are none of the five."""
    known = [simulate_object(kind, 50 + i, outliers=(0.0, 0.1, 0.3)[i]) for kind in KINDS for i in range(3)]
    return known, [simulate_object(kind, 50 + i, outliers=0.1) for kind in ("torus", "blob") for i in range(3)]


@pytest.fixture(scope="module")
def batch(clouds):
    """All of them and the bad ones in one call."""
    known, others = clouds
    points, labels, noise = together([*known, *others])
    for i, (spoilt, _) in enumerate(bad_objects().values()):
        points = np.concatenate([points, spoilt])
        labels = np.concatenate([labels, np.full(len(spoilt), len(known) + len(others) + i)])
        noise = np.concatenate([noise, np.full(len(spoilt), SIGMAS * 0.001)])
    return fit_shapes(points, labels, camera=CAMERA, noise_distance=noise)


def test_five_kinds_are_named_right_in_one_call(clouds, batch):
    known = clouds[0]
    for cloud, shape in zip(known, batch[: len(known)], strict=True):
        assert shape.kind in cloud.truths[0].answers
        assert shape.kind == shape.primitive.kind
        # Lower is better, and the best of those no guard spoke against is the one named.
        refused = {guard.split(":")[0] for guard in shape.guards}
        assert shape.kind == min(set(shape.scores) - refused, key=shape.scores.get)
        own = cloud.labels == 0
        inliers = np.asarray(shape.inliers)
        # Of a normal distribution 1.2 % lie beyond two and a half deviations; a rim or an edge may lose a little more.
        assert inliers[own].mean() > 0.93
        assert inliers[~own].mean() < 0.3


def test_sizes_are_right(clouds, batch):
    pairs = [(cloud.truths[0].primitive, shape.primitive) for cloud, shape in zip(clouds[0], batch, strict=False)]
    same = [(truth, got) for truth, got in pairs if truth.kind == getattr(got, "kind", None)]
    assert {truth.kind for truth, _ in same} == {truth.kind for truth, _ in pairs}
    for truth, got in same:
        # Depth noise of a millimetre averaged over hundreds of points: asked are 0.1 %, 0.05 and 0.06 degrees for the median.
        if truth.kind in ("cylinder", "sphere"):
            np.testing.assert_allclose(got.radius, truth.radius, rtol=0.005)
        elif truth.kind == "cone":
            assert abs(np.degrees(float(got.half_angle - truth.half_angle))) < 0.3
        elif truth.kind == "plane":
            assert abs(np.asarray(got.normal) @ np.asarray(truth.normal)) > np.cos(np.deg2rad(0.5))
        else:
            aligned = np.abs(np.asarray(got.axes) @ np.asarray(truth.axes).T)
            assert aligned.max(0).min() > np.cos(np.deg2rad(0.5))


def test_edges_of_a_patch_do_not_hang_on_how_its_frame_leans():
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-1, 1, (2, 500))
    normal = np.array([0.4, 0.3, -0.87]) / np.linalg.norm([0.4, 0.3, -0.87])
    first, second = np.linalg.svd(normal[None])[2][1:]
    hits, on = u[:, None] * first + 0.6 * v[:, None] * second, np.ones(500, bool)
    straight, leaning = np.eye(3), np.asarray(starts.rotation(jnp.asarray(0.05), jnp.asarray(-0.03)))
    found = [
        bounds.ends_of("plane", np.append(turn @ normal, (0, 0)), hits @ turn.T, 0 * u, on, np.zeros(3), turn)
        for turn in (straight, leaning)
    ]
    # A lean of three degrees moved edges by 0.4 % where the patch was laid level in the leaning frame.
    np.testing.assert_allclose(*found, atol=1e-6)


def test_curvature_that_points_beside_a_silhouette_turn_over_is_bounded():
    """Its inverse may have any size: of the paper's cylinder the radius came out with a deviation of 0.5 to 5.7 mm."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7))
    steep = root @ root.T + np.eye(7)
    half = np.linalg.cholesky(steep)
    turn = np.linalg.qr(rng.normal(size=(7, 7)))[0]
    bent = lambda values: half @ (turn * values) @ turn.T @ half.T
    plain = np.array([0.6, 0.8, 0.9, 1.0, 1.0, 1.5, 3.0])
    found = polish._inverse(jnp.asarray(bent(plain)), jnp.asarray(steep))
    np.testing.assert_allclose(found, np.linalg.inv(bent(plain)), rtol=1e-9)
    over = np.array([-0.25, 0.01, *plain[2:]])
    found = polish._inverse(jnp.asarray(bent(over)), jnp.asarray(steep))
    np.testing.assert_allclose(found, np.linalg.inv(bent(np.maximum(over, 0.5))), rtol=1e-9)


def test_a_lid_and_a_face_that_no_point_lies_on_end_nothing():
    """A polish may carry them anywhere: of a hat box the lid went to 103 m."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, np.pi, 800), rng.uniform(-0.5, 0.7, 800)
    hits, on = np.stack([np.cos(angle), height, -np.sin(angle)], axis=1), np.ones(800, bool)
    side, lid = np.zeros(800), np.array([rays.CLOSED, 0.0, 0.0])
    ends = lambda kind, theta, part, detail: bounds.ends_of(kind, np.array(theta), hits, part, on, detail, np.eye(3))
    low, high, _ = ends("cylinder", [0, 0, 1.0, 0, 500.0], side, lid)[0]
    np.testing.assert_allclose([low, high], [-0.5, 0.7], atol=0.01)
    on_lid = np.where(height > 0.65, 1, 0)
    assert ends("cylinder", [0, 0, 1.0, 0, 0.72], on_lid, lid)[0, 1] == 0.72
    # The same of the third face of a box, the upper one.
    signs = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(ends("box", [0, 0, 0, 500.0, 0], side, signs)[2, :2], [-0.5, 0.7], atol=0.01)
    assert ends("box", [0, 0, 0, 0.72, 0], 2 * on_lid, signs)[2, 1] == 0.72


def test_the_longer_upright_edge_of_a_box_comes_first():
    """By whichever face it was found, so that no rounding changes the order."""
    frame, still = Frame(jnp.eye(3), jnp.zeros(3), jnp.asarray(1.0)), jnp.zeros(2)
    # Ends along x, along z, upwards; a quarter turn describes the same box.
    ends = {0.3: [[-1, 1, 0], [-2, 2, 0], [0, 3, 0]], 0.3 + np.pi / 2: [[-2, 2, 0], [-1, 1, 0], [0, 3, 0]]}
    one, other = (
        bounds.assembled(
            "box", jnp.array([yaw, 0, 0, 0, 0]), still, jnp.array(e, float), jnp.zeros(3), jnp.eye(3), frame
        )
        for yaw, e in ends.items()
    )
    np.testing.assert_allclose(one.size, [4, 3, 2])
    np.testing.assert_allclose(other.size, one.size)
    np.testing.assert_allclose(other.center, one.center, atol=1e-6)
    # The same directions, each one way or the other, and right-handed.
    np.testing.assert_allclose(np.abs(other.axes @ one.axes.T), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(one.axes), 1, rtol=1e-6)


def test_a_flat_face_may_be_a_box(clouds, batch):
    for shape in batch[: len(clouds[0])]:
        assert bool(int(shape.status) & Status.MAY_BE_BOX) == (shape.kind == "plane")


def test_what_is_none_of_the_five_is_refused(clouds, batch):
    known, others = clouds
    shapes = batch[len(known) : len(known) + len(others)]
    refused = [s for s in shapes if s.kind in ("unknown", "quadric")]
    # Nine in ten over many clouds, by the benchmark; one of these six may be close to a sphere.
    assert len(refused) >= 5
    for shape in refused:
        assert shape.primitive is None or shape.kind == "quadric"
        assert int(shape.status) & Status.REFUSED


def test_wrong_surfaces_are_told_by_the_points_just_off_them():
    """Half outliers hide that nothing fits: eleven of thirty-two such clouds were named before this was looked at."""
    none = [simulate_object(kind, 900 + i, outliers=0.5) for kind in ("torus", "saddle", "blob") for i in range(4)]
    right = [simulate_object(kind, 900, outliers=0.5) for kind in KINDS]
    points, labels, noise = together([*none, *right])
    shapes = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise)
    assert sum(shape.kind in ("unknown", "quadric") for shape in shapes[:12]) >= 11
    for cloud, shape in zip(right, shapes[12:], strict=True):
        assert shape.kind in cloud.truths[0].answers
        assert not shape.status & Status.SCATTERED
    # A noise distance a third of the true one: nothing is named, and why is said.
    few = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise / 3)[12:]
    assert all(shape.kind == "unknown" and shape.status & Status.SCATTERED for shape in few)


def test_slow_waves_are_told_from_noise_that_was_given_too_large():
    """Waves of 15 cm in bodies of 20 cm: no more than half as much again as the noise given, but small windows know of none."""
    kinds = ("plane", "cylinder", "cone", "sphere")
    made = {"depth_std": 0.0005, "radius": (0.1, 0.1), "points": (1600, 1600)}
    flat = [simulate_object(kind, 900, **made) for kind in kinds]
    points, labels, _ = together(flat)
    wave = np.sin(2 * np.pi * points[:, 0] / 0.15 + 1) * np.sin(2 * np.pi * points[:, 1] / 0.15)
    wavy = points * (1 + 0.009 * wave / np.linalg.norm(points, axis=1))[:, None]
    both = np.concatenate([points, wavy]), np.concatenate([labels, labels + len(kinds)])
    shapes = fit_shapes(*both, camera=CAMERA, noise_distance=SIGMAS * 0.003)
    assert [shape.kind for shape in shapes[: len(kinds)]] == list(kinds)
    for shape in shapes[len(kinds) :]:
        assert shape.kind in ("unknown", "quadric")
        assert int(shape.status) & Status.REFUSED


def test_a_surface_that_patches_lie_off_is_refused(monkeypatch):
    """Waves of 1.3 times the noise that was given, in four fifths of it: small windows find nothing, and few points are far off."""
    made = {"depth_std": 0.0024, "radius": (0.1, 0.1), "points": (16_000, 16_000), "distance": (1.0, 1.0)}
    points = simulate_object("cylinder", 904, outliers=0.0, **made).points
    wave = np.sin(2 * np.pi * points[:, 0] / 0.2 + 1) * np.sin(2 * np.pi * points[:, 1] / 0.2)
    # A product of two sines deviates by half its amplitude.
    wavy = points * (1 + 2.6 * 0.003 * wave / np.linalg.norm(points, axis=1))[:, None]

    def named(cloud, pixels=True):
        noise = SIGMAS * 0.003 * (cloud**2).sum(axis=1)
        fits = Fits(cloud, camera=CAMERA, noise_distance=noise, capacity=2048, correlated=pixels)
        return fits.shapes([np.arange(len(cloud))])[0].kind

    assert named(points) == "cylinder"
    assert named(wavy) == "unknown"
    assert named(wavy, pixels=False) == "cylinder"
    monkeypatch.setattr(looks, "WAVES", np.inf)
    assert named(wavy) == "cylinder"


def test_a_set_is_searched_once_and_known_as_other_kinds_and_about_other_verticals(clouds, monkeypatch):
    points, labels, noise = together(clouds[0])
    sets = [np.flatnonzero(labels == i) for i in range(labels.max() + 1)]
    count, fit = [], fitting.fit
    monkeypatch.setattr(fitting, "fit", lambda *args: count.append(0) or fit(*args))
    fits = Fits(points, camera=CAMERA, noise_distance=noise)
    no = [False] * len(sets)
    first = fits.shapes(sets, further=no)
    assert len(count) == len(sets)
    again = fits.shapes(sets[::-1], further=no)[::-1]
    assert len(count) == len(sets)
    assert [s.kind for s in again] == [s.kind for s in first]
    fits.shapes(sets)
    searches = len(count)

    # As a sphere, those that could be: what a search for spheres alone gives.
    as_spheres = fits.shapes_as(sets, ["sphere"] * len(sets))
    about = fits.shapes_about(sets, [s.kind for s in first], np.array([0, 1.0, 0]), [np.deg2rad(10)] * len(sets))
    tight = fits.shapes_about(sets, [s.kind for s in first], np.array([0, 1.0, 0]), [1e-6] * len(sets))
    assert len(count) == searches
    alone = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise, kinds=("sphere",))
    named = [(a, b) for a, b in zip(as_spheres, alone, strict=True) if a.kind == b.kind == "sphere"]
    assert len(named) >= 3
    for a, b in named:
        np.testing.assert_allclose(a.primitive.parameters(), b.primitive.parameters(), rtol=1e-6)
        assert a.scores.keys() == {"sphere"}
    for shape, other, stiff in zip(first, about, tight, strict=True):
        assert other.kind == shape.kind
        # The prior of a first fit: the same place, come to from another start, within what counts as rest.
        np.testing.assert_allclose(other.primitive.parameters(), shape.primitive.parameters(), atol=1e-4)
        if shape.kind in ("cylinder", "cone"):
            assert abs(abs(float(stiff.primitive.axis[1])) - 1) < 1e-9


def test_bad_objects_are_told_alone_and_in_a_batch(batch):
    for (points, status), inside in zip(bad_objects().values(), batch[-4:], strict=True):
        alone = fit_shape(points, camera=CAMERA, noise_distance=SIGMAS * 0.001)
        for shape in (alone, inside):
            assert shape.kind == "unknown"
            assert shape.primitive is None
            assert not np.asarray(shape.inliers).any()
            assert int(shape.status) & status
            assert np.isfinite(float(shape.noise_distance))
    with pytest.raises(ValueError, match="finite"):
        fit_shape(np.full((100, 3), np.nan))


def test_coplanar_points_are_a_plane_where_their_noise_is_known():
    rng = np.random.default_rng(1)
    flat = np.concatenate([rng.uniform(-0.1, 0.1, (300, 2)), np.full((300, 1), 1.2)], 1)
    assert fit_shape(flat, camera=CAMERA, noise_distance=0.002).kind == "plane"
    unknown = fit_shape(flat, camera=CAMERA)
    assert unknown.kind == "unknown"
    assert int(unknown.status) & Status.DEGENERATE


def size_of(shape):
    p = shape.primitive
    parts = {"box": "size", "cone": "half_angle", "cylinder": "radius", "sphere": "radius"}
    return np.asarray(getattr(p, parts[shape.kind])) if shape.kind in parts else np.asarray(p.normal)[1:2] ** 2


def test_place_heading_unit_and_order_change_nothing(clouds, batch):
    chosen = [0, 3, 6, 9, 12]
    points, labels, noise = together([clouds[0][i] for i in chosen])
    before = [batch[i] for i in chosen]
    turn = np.array([[np.cos(0.7), 0, np.sin(0.7)], [0, 1, 0], [-np.sin(0.7), 0, np.cos(0.7)]])
    shift = np.array([3.0, -2.0, 5.0])
    order = np.random.default_rng(0).permutation(len(points))
    moved = {
        "shift": fit_shapes(points + shift, labels, camera=shift, noise_distance=noise),
        "yaw": fit_shapes(points @ turn.T, labels, camera=CAMERA, noise_distance=noise),
        "unit": fit_shapes(1000 * points, labels, camera=CAMERA, noise_distance=1000 * noise),
        "order": fit_shapes(points[order], labels[order], camera=CAMERA, noise_distance=noise[order]),
        "up": fit_shapes(points, labels, camera=CAMERA, noise_distance=noise, up=(0, -1, 0)),
    }
    for how, after in moved.items():
        for one, other in zip(before, after, strict=True):
            assert one.kind == other.kind
            unit = 1000 if how == "unit" and one.kind not in ("cone", "plane") else 1
            # Double precision less the nine digits to which the surface is moved until it stands still.
            np.testing.assert_allclose(size_of(other) / unit, size_of(one), rtol=1e-6, err_msg=f"{how}, {one.kind}")
    again = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise)
    first = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(size_of(one), size_of(other))


def test_noise_is_found_where_it_is_not_given(clouds):
    points, labels, _ = together(clouds[0])
    for cloud, shape in zip(clouds[0], fit_shapes(points, labels, camera=CAMERA), strict=True):
        assert shape.kind in cloud.truths[0].answers
        # Found from some hundred residuals of a cloud with outliers: a fifth off at most.
        np.testing.assert_allclose(float(shape.noise_distance), SIGMAS * np.median(cloud.depth_std), rtol=0.2)


def test_fits_come_to_rest():
    # The first four swung between two places for ever while every step was as long as its damped derivatives say.
    made = [simulate_object(KINDS[1 + i % 4], i, outliers=0.2) for i in (0, 1, 8, 13, 2, 3)]
    points = np.concatenate([m.points for m in made])
    labels = np.concatenate([np.full(len(m.points), i) for i, m in enumerate(made)])
    found = fit_shapes(points, labels, camera=made[0].camera)
    assert not any(int(shape.status) & Status.NOT_CONVERGED for shape in found)


def test_points_with_their_own_deviations_count_by_them():
    cloud = simulate_object("cylinder", 60, outliers=0.0, flying=0.0, points=(1000, 1000))
    rng = np.random.default_rng(0)
    rough = rng.uniform(size=1000) < 0.5
    ray = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    points = cloud.points + ray * (rough * 0.01 * rng.normal(size=1000))[:, None]
    own = np.where(rough, 0.0101, cloud.depth_std)
    known = fit_shape(points, camera=CAMERA, noise_distance=SIGMAS * own)
    same = fit_shape(points, camera=CAMERA, noise_distance=SIGMAS * 0.007)
    assert known.kind == "cylinder"
    deviation = np.sqrt(np.diag(np.asarray(known.covariance)))[-1]
    assert abs(float(known.primitive.radius - cloud.truths[0].primitive.radius)) < 4 * deviation
    # Half the points ten times as noisy: weighing all alike costs several times in the radius' error bar.
    assert 2 * deviation < np.sqrt(np.diag(np.asarray(same.covariance)))[-1]


def test_large_objects_are_fitted_to_a_sample_and_judged_whole():
    """The program of 2,048 points; the truth says of every point whether it lies on the body."""
    cloud = simulate_object("cylinder", 61, outliers=0.1, points=(5000, 5000))
    everything = [np.arange(len(cloud.points))]
    noise = SIGMAS * cloud.depth_std
    (shape,) = Fits(cloud.points, camera=CAMERA, noise_distance=noise, capacity=2048).shapes(everything)
    assert shape.kind == "cylinder"
    deviation = np.sqrt(np.diag(np.asarray(shape.covariance)))[-1]
    assert abs(float(shape.primitive.radius - cloud.truths[0].primitive.radius)) < 4 * deviation
    # 2.5 deviations leave 1.2 % of the good points out; an outlier on the surface by chance is in.
    assert (np.asarray(shape.inliers) == (cloud.labels >= 0)).mean() > 0.95


def test_of_very_many_points_those_that_are_fitted_are_drawn_fairly_whatever_their_order():
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 300), np.linspace(-1, 1, 200)))
    points = np.stack([x, y, 0.1 * x**2], axis=1)
    order = fair_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(points)))
    shuffled = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(shuffled[fair_order(points[shuffled])[:MOST]], order[:MOST])
    # Of 64 equal squares each has its share, 5 deviations of chance allowed.
    counts = np.histogram2d(*points[order[:2048], :2].T, bins=8)[0]
    assert np.abs(counts - 32).max() < 5 * np.sqrt(32)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_seen_edge_on_is_sampled_fairly_whatever_its_order(axis):
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 150), np.linspace(-1, 1, 100)))
    points = np.insert(np.stack([u, v], axis=1), axis, 0.0, axis=1)
    order = fair_order(points)
    shuffled = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_array_equal(shuffled[fair_order(points[shuffled])[:MOST]], order[:MOST])
    counts = np.histogram2d(*np.delete(points[order[:2048]], axis, axis=1).T, bins=8)[0]
    assert np.abs(counts - 32).max() < 5 * np.sqrt(32)
    # Rounding makes no extent.
    moved = points + 1e-16 * np.random.default_rng(2).standard_normal(points.shape) * (np.arange(3) == axis)
    np.testing.assert_array_equal(fair_order(moved)[:2048], order[:2048])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_so_few_points_have_an_order(count):
    np.testing.assert_array_equal(np.sort(fair_order(np.zeros((count, 3)))), np.arange(count))


def test_single_precision_without_a_camera_agrees_with_double(clouds):
    chosen = [clouds[0][i] for i in (0, 4, 6, 10, 12)]
    points, labels, noise = (a.astype(np.float32) if a.dtype == float else a for a in together(chosen))
    shapes = fit_shapes(points, labels, noise_distance=noise)
    for cloud, shape in zip(chosen, shapes, strict=True):
        assert shape.kind in cloud.truths[0].answers
        assert shape.covariance.dtype == np.float32
        assert all(leaf.dtype in (np.float32, bool) for leaf in vars(shape.primitive).values())
        truth = cloud.truths[0].primitive
        if shape.kind in ("cylinder", "sphere"):
            # Orthogonal distances where the noise is along the rays: silhouettes bias a radius by some parts in a thousand.
            np.testing.assert_allclose(shape.primitive.radius, truth.radius, rtol=0.01)


def test_scores_by_other_criteria(clouds):
    points, labels, noise = together(clouds[0])
    shapes = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise, rule="gric")
    right = [s.kind in c.truths[0].answers for c, s in zip(clouds[0], shapes, strict=True)]
    assert np.mean(right) >= 0.8
    # Without the true kind the next best is taken, or none.
    less = fit_shapes(points, labels, camera=CAMERA, noise_distance=noise, kinds=("plane", "sphere"))
    assert all(
        s.kind in ("plane", "sphere", "quadric", "unknown") and set(s.scores) == {"plane", "sphere"} for s in less
    )


@pytest.mark.parametrize("count", [64, 129, 300])
def test_extents_by_the_papers_rule_are_those_of_the_points(count):
    """Points are padded to a compiled size; the pads must end nothing, nor hide where the body ends."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-1.5, 1.5, count) - np.pi / 2
    points = np.stack([0.2 + 0.05 * np.cos(angle), rng.uniform(0, 0.12, count), 1 + 0.05 * np.sin(angle)], 1)
    shape = fit_shape(
        points + 5e-4 * rng.normal(size=points.shape), rule="paper", noise_distance=0.005, kinds=("cylinder",)
    )
    assert float(shape.primitive.height) == pytest.approx(0.12, rel=0.05)


def test_the_papers_rule_counts_points():
    # A cylinder before the camera, in raw coordinates: 4D and 6D hold it alike, which is the rule's weakness.
    cloud = simulate_object("cylinder", 52, outliers=0.1)
    shape = fit_shape(cloud.points, camera=CAMERA, noise_distance=0.003, rule="paper")
    assert set(shape.counts) == {"3d", "3d, two planes", "4d", "6d"}
    most = max(shape.counts.values())
    assert np.asarray(shape.inliers).sum() == most
    assert shape.counts["3d"] < most
    tied = sum(count == most for count in shape.counts.values()) > 1
    assert bool(int(shape.status) & Status.PAPER_TIE) == tied
    assert bool(int(shape.status) & Status.PAPER_DISAGREES) == (shape.kind != "cylinder")


@pytest.mark.parametrize(
    ("options", "error", "word"),
    [
        ({"noise_distance": -1.0}, ValueError, "noise_distance"),
        ({"noise_distance": None}, TypeError, "noise_distance"),
        ({"kinds": ("prism",)}, ValueError, "kinds"),
        ({"kinds": "plane"}, TypeError, "kinds"),
        ({"kinds": ()}, ValueError, "kinds"),
        ({"up": (0, 0, 0)}, ValueError, "up"),
        ({"distance": "ray"}, ValueError, "camera"),
        ({"distance": "algebraic"}, ValueError, "distance"),
        ({"distance": "ray", "camera": CAMERA, "rule": "paper"}, ValueError, "distance"),
        ({"rule": "best"}, ValueError, "rule"),
        ({"weights": -np.ones(100)}, ValueError, "weights"),
    ],
)
def test_wrong_arguments_are_named(options, error, word):
    points = np.random.default_rng(0).normal(size=(100, 3))
    with pytest.raises(error, match=word):
        fit_shape(points, **options)
    with pytest.raises(ValueError, match="labels"):
        fit_shapes(points, np.zeros(99, int))
    with pytest.raises(ValueError, match="labels must count objects"):
        fit_shapes(points, np.full(100, 300_000))


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, None], ids=["camera", "no camera"])
@pytest.mark.parametrize(("kind", "size"), [("cylinder", "radius"), ("sphere", "radius"), ("cone", "half_angle")])
def test_error_bars_are_calibrated(kind, size, camera):
    clouds = [simulate_object(kind, 500 + i, outliers=0.1, flying=0.0) for i in range(200)]
    points, labels, noise = together(clouds)
    scores = []
    for cloud, shape in zip(clouds, fit_shapes(points, labels, camera=camera, noise_distance=noise), strict=True):
        truth = cloud.truths[0].primitive
        if shape.kind == kind:
            # The size stands last in the parameters of all three.
            deviation = np.sqrt(np.asarray(shape.covariance)[-1, -1])
            scores.append(float(getattr(shape.primitive, size) - getattr(truth, size)) / deviation)
    assert len(scores) > (180 if kind == "cone" else 190)
    # Of 200 scores the spread is known to 5 %; a few cones are far off.
    assert 0.85 < np.std(np.clip(scores, -6, 6)) < 1.2


@pytest.mark.parametrize("double", [True, False])
def test_threads_compute_in_the_precision_of_the_one_that_asks(double):
    with jax.enable_x64(double):
        assert looks.threads(1).submit(lambda: jnp.ones(1).dtype).result() == jnp.ones(1).dtype


@pytest.mark.parametrize(
    ("first", "polished", "kind"),
    [("cone", 0.01, "cylinder"), ("cone", 0.2, "cone"), ("sphere", 5.0, "cylinder"), ("sphere", 0.5, "sphere")],
)
def test_what_the_last_polish_took_out_of_shape_is_none(first, polished, kind, monkeypatch):
    # A cone by its narrowing, a sphere by its radius: both are the fourth parameter.
    fit, index = fitting.fit, KINDS.index(first)

    def found_first(item, allowed, *options):
        fitted = fit(item, allowed, *options)
        theta = np.where(np.arange(5) == 3, polished, fitted.polished.theta)
        return fitted._replace(kind=index, polished=fitted.polished._replace(theta=theta))

    made = simulate_object("cylinder", 3, points=(900, 901))
    monkeypatch.setattr(fitting, "fit", found_first)
    shape = fit_shape(made.points, camera=made.camera, noise_distance=2.5 * made.depth_std)
    assert shape.kind == kind
    assert kind == first or any(guard.startswith(f"{first}: it") for guard in shape.guards)


def noisy_directions(directions, rng, std=0.02):
    directions = directions + rng.normal(0, std, directions.shape)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def degrees_between(one, other):
    return np.degrees(np.arccos(min(1.0, abs(one @ other))))


@pytest.mark.parametrize("ends", [0, 10, 24])
def test_the_axis_of_most_normals_is_found_though_others_are_of_edges_and_of_an_end(ends):
    rng = np.random.default_rng(0)
    truth = np.array([0.6, 0.0, 0.8])
    around = np.linspace(-1.2, 1.2, 16)
    side = np.cos(around)[:, None] * np.cross(truth, [0, 1, 0]) + np.sin(around)[:, None] * np.array([0, 1.0, 0])
    # Edges of a hand's breadth look one way; unusable normals are zero.
    edges = noisy_directions(np.tile([0.5, 0.1, 0.86], (8, 1)), rng, 0.1)
    end = noisy_directions(np.tile(truth, (ends, 1)), rng)
    normals = np.concatenate([noisy_directions(side, rng), edges, end, np.zeros((4, 3))])
    axis = looks._axis_of_most(normals)
    plain = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    # 16 normals wrong by 0.02 each leave less than that; by all of them alike it would be far off.
    assert degrees_between(axis, truth) < 1.5 < 20 < degrees_between(plain, truth)


def test_without_two_normals_that_differ_any_direction_square_to_the_one_will_do():
    alone = looks._axis_of_most(np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))
    assert abs(alone[1]) < 1e-12


@pytest.mark.parametrize("told", [1, 5])
@pytest.mark.parametrize("yaw", [0, 25, 40, 50, 60])
def test_a_lying_cylinder_is_named_whatever_it_turns_to_the_camera(yaw, told):
    """From 40 degrees on the end is seen beside the side, as of a can; with more noise told than there is a box fits."""
    turn, tilt = np.deg2rad(yaw), np.deg2rad(35)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    away = np.cross([1.0, 0.0, 0.0], up)
    axis = np.cos(turn) * np.array([1.0, 0.0, 0.0]) + np.sin(turn) * away
    middle = np.array([0.05, 0.1, 1.0])
    truth = Cylinder(middle - 0.06 * axis, axis, np.array(0.03), np.array(0.12))
    for seed in range(4):
        points = seen_by_rays(truth, np.random.default_rng(seed))
        shape = fit_shape(points, noise_distance=SIGMAS * 0.001 * told, camera=CAMERA, up=up)
        assert shape.kind == "cylinder"
        assert degrees_between(np.asarray(shape.primitive.axis), axis) < 1.0
        assert float(shape.primitive.radius) == pytest.approx(0.03, rel=0.02)


def turned_any_way(rng):
    """A rotation drawn evenly."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


def seen_by_rays(body, rng, std=0.001):
    """Points of a body before a camera that looks ahead."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 160), np.linspace(-0.3, 0.3, 160))
    ray = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    depth = body_of(body).hit(ray)[0]
    met = np.isfinite(depth)
    return ray[met] * (depth[met] + std * rng.normal(size=met.sum()))[:, None]


def test_a_box_on_its_edge_is_named_though_one_face_holds_most_of_it():
    """A plane holds 0.6 of it and fits well; the rest is no outliers, since small pieces of it have normals of their own."""
    for seed in (0, 8, 25, 28):
        rng = np.random.default_rng([seed, 5])
        axes, size = turned_any_way(rng), rng.uniform(0.04, 0.07)
        edges = 2 * size * np.array([1, rng.uniform(0.7, 1.4), rng.uniform(0.5, 1.0)])
        body = Box(np.array([0.0, 0.0, 1.0]), edges, axes, np.ones(3, bool))
        up = np.array([0.0, -0.82, -0.57])
        shape = fit_shape(seen_by_rays(body, rng), noise_distance=0.0025, camera=CAMERA, up=up)
        assert shape.kind == "box"
        assert np.abs(np.asarray(shape.primitive.axes) @ axes.T).max(axis=1).min() > np.cos(np.deg2rad(1.0))


def test_what_outliers_leave_over_is_not_looked_at_again(monkeypatch):
    """They have no normals, or any; a second search would cost as much as the first."""
    searches = []
    search = looks._search
    monkeypatch.setattr(looks, "_search", lambda *a: searches.append(1) or search(*a))
    for kind in ("plane", "cylinder", "cone", "sphere"):
        cloud = simulate_object(kind, 7, outliers=0.5)
        shape = fit_shape(cloud.points, camera=cloud.camera, noise_distance=SIGMAS * cloud.depth_std)
        assert shape.kind == kind
    assert len(searches) == 4


def test_a_look_knows_whose_candidates_the_scores_are_that_it_was_told():
    """Three looks one after the other, each better at one kind: the last knows the first's through the second."""
    item = looks.prepared(np.random.default_rng(0).normal(size=(20, 3)), np.ones(20), np.ones(20), UPWARDS, None, False)

    def look(kind, scores):
        found, polished = SimpleNamespace(deviation=1.0), SimpleNamespace(square=np.zeros(20))
        fitted = fitting.Fitted(kind, np.array(scores), np.ones(5, bool), found, polished)
        return looks.Look(item, fitted, 1.0, Status(0))

    first, second, third = look(0, [1.0, 9, 9, 9, 9]), look(1, [9.0, 1, 9, 9, 9]), look(2, [9.0, 9, 1, 9, 9])
    known = looks._knowing(third, looks._knowing(second, first))
    np.testing.assert_array_equal(known.fitted.scores, [1, 1, 1, 9, 9])
    assert known.rivals[0] is first
    assert known.rivals[1].fitted.polished is second.fitted.polished
    assert sorted(known.rivals) == [0, 1]


def pieces_of(*patches, seed=0, std=0.002):
    """Flat patches, each a corner and two edges, with noise along the viewing rays."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([corner + rng.uniform(size=(n, 2)) @ edges for corner, edges, n in patches])
    away = np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1 + std * rng.normal(size=away.shape) / away)


def test_walls_that_part_are_no_corner_of_a_box():
    """A side of a street and the front of a house beyond it: each lies outside what the other could be a face of.

    They were a box whose third edge was -0.56 m long.
    """
    # In the frame of the walls: one at x = 0.45, one at z = -0.28, the camera between them.
    eye = np.array([1.36, 0.75, 0.08])
    side = np.array([0.45, -0.07, 0.29]), np.array([[0, 0.6, 0], [0, 0, 0.42]]), 600
    front = np.array([-1.1, -0.9, -0.28]), np.array([[1.5, 0, 0], [0, 1.0, 0]]), 600
    walls = [(corner - eye, edges, n) for corner, edges, n in (side, front)]
    shape = fit_shape(pieces_of(*walls), noise_distance=0.005, camera=CAMERA)
    assert shape.kind != "box"
    assert any(guard.startswith("box: ") for guard in shape.guards)
    # The same two as walls of one house are a box.
    side = np.array([0.45, -0.07, -0.7]), side[1], 600
    house = [(corner - eye, edges, n) for corner, edges, n in (side, front)]
    shape = fit_shape(pieces_of(*house), noise_distance=0.005, camera=CAMERA)
    assert shape.kind == "box"
    assert (np.asarray(shape.primitive.size) > 0).all()


def test_an_edge_is_never_longer_than_nothing_when_others_lie_beyond_its_face():
    """By hand: a face at x = 1 that looks along x, and points of other faces between 1.5 and 2."""
    theta, detail = np.array([0.0, 1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    hits = np.array([[1.0, 0, 0], *[[x, 0, 0] for x in np.linspace(1.5, 2, 9)]])
    ends = bounds.ends_of("box", theta, hits, np.array([0] + [1] * 9), np.ones(10, bool), detail, np.eye(3))
    assert ends[0, 0] == ends[0, 1] == 1.0


def side_of_a_cylinder(degrees, radius=0.3, height=0.5, std=0.002, count=1500):
    """As much of an upright cylinder before the camera, symmetric to it."""
    rng = np.random.default_rng(1)
    angle = np.deg2rad(rng.uniform(-degrees / 2, degrees / 2, count))
    points = np.stack(
        [radius * np.sin(angle), rng.uniform(-height, height, count) / 2, -radius * np.cos(angle)], axis=1
    )
    points = points + [0.1, 0.0, 1.5]
    return points * (1 + std * rng.normal(size=(count, 1)) / np.linalg.norm(points, axis=1, keepdims=True))


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_a_cylinder_of_which_little_is_seen_is_none(camera):
    narrow, wide = (fit_shape(side_of_a_cylinder(degrees), noise_distance=0.005, camera=camera) for degrees in (50, 75))
    assert wide.kind == "cylinder"
    assert float(wide.primitive.radius) == pytest.approx(0.3, rel=0.02)  # four standard deviations of this arc
    assert narrow.kind != "cylinder"
    assert any("60 degrees" in guard and guard.startswith("cylinder") for guard in narrow.guards)


def test_an_arc_is_cut_nowhere():
    """Wherever around the axis it lies, seen from there it has the same number of degrees."""
    cloud = side_of_a_cylinder(150, std=0.0)
    for turn in (0.0, 1.0, 2.5, 3.1):
        c, s = np.cos(turn), np.sin(turn)
        points = cloud @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        item = SimpleNamespace(points=points, rays=np.zeros_like(points), weight=np.ones(len(points)))
        axis = (np.array([0.1, 0.0, 1.5]) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))[[0, 2]]
        zero = np.zeros(len(points))
        found = SimpleNamespace(square=zero, scale=1.0, part=zero, depth=zero, turn=np.eye(3), theta=axis)
        # 96 % of what is spread evenly lies between the two quantiles; of 512 points each errs by 0.6 % of it.
        assert looks._arc(item, found) == pytest.approx(0.96 * 150, rel=0.02)
