"""The vertical that objects and ground agree on: known truths, a case worked by hand, and sizes it mends in a rendered pair."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxfuzzy as jf
from jaxfuzzy import naming
from jaxfuzzy.primitives import Box, Cylinder, Sphere
from jaxfuzzy.render import render_pair, table_scene
from jaxfuzzy.simulate import simulate_scene
from jaxfuzzy.status import Status
from jaxfuzzy.vertical import (
    LEAST_LEAN,
    NOISE_DISTANCE,
    Vertical,
    Witness,
    agreed_vertical,
    upright_again,
    witness_of,
)
from synthetic import fitted_shape

UP = np.array([0.0, -1.0, 0.0])
DEGREE = np.deg2rad(1.0)


def standing(lean_deg, error_deg=0.2, kind="cylinder"):
    """A body whose axis leans by so many degrees towards x and z, known to `error_deg`."""
    x, z = np.deg2rad(lean_deg)
    axis = np.array([x, -1.0, z]) / np.sqrt(1 + x * x + z * z)
    if kind == "cylinder":
        body = Cylinder(jnp.zeros(3), jnp.asarray(axis), jnp.asarray(0.1), jnp.asarray(0.3))
        covariance = np.diag([error_deg**2, error_deg**2, 1, 1, 1]) * DEGREE**2
    else:
        first = np.cross(axis, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        axes = np.stack([first, axis, np.cross(first, axis)])
        body = Box(jnp.zeros(3), jnp.ones(3), jnp.asarray(axes), jnp.ones(3, bool))
        covariance = np.diag([1, 1, 1, 1, 1, 1, *[error_deg**2] * 3]) * DEGREE**2
    return dataclasses.replace(fitted_shape(body, np.ones(1000, bool), 0.01), covariance=jnp.asarray(covariance))


def ground(error_deg, doubtful=False):
    return Witness(UP, (error_deg * DEGREE) ** 2 * np.eye(2), doubtful)


def off(up):
    """How far a direction leans from UP towards x and z, in degrees."""
    return np.rad2deg(np.array([up[0], up[2]]) / -up[1])


def scattered(middle, spread, count, seed=0):
    return [standing(lean) for lean in np.random.default_rng(seed).normal(middle, spread, (count, 2))]


def test_equal_objects_worked_by_hand():
    # Leans of ±0.5 degrees about (1, 0) in either direction, each known to 0.2, all far from noise. Let S be the mean
    # square of a lean about the vertical (v, 0) in one direction: S = 0.25 + (1 - v)² / 2. Four objects weigh 4 / S, a
    # ground known to 0.5 degrees 4, so that v = 1 / (1 + S). Both hold for S = 0.273 and v = 0.786.
    objects = [standing(lean) for lean in ((0.5, 0.5), (1.5, 0.5), (0.5, -0.5), (1.5, -0.5))]
    found = agreed_vertical(objects, ground(0.5))
    assert found.upright == [0, 1, 2, 3]
    # A few per cent: memberships of what lies 0.7 degrees off are 0.98, and count squared.
    np.testing.assert_allclose(off(found.up), [0.786, 0.0], atol=0.02)
    assert np.rad2deg(found.lean) == pytest.approx(np.sqrt(0.273 - 0.2**2), rel=0.03)
    assert np.rad2deg(found.std) == pytest.approx(1 / np.sqrt(4 / 0.273 + 4), rel=0.03)


def test_a_sure_ground_stays():
    found = agreed_vertical(scattered((1.0, -1.0), 1.0, 6), ground(0.01))
    assert np.abs(off(found.up)).max() < 0.01


@pytest.mark.parametrize("kind", ["cylinder", "box"])
def test_objects_mend_a_guess(kind):
    leans = np.random.default_rng(1).normal((7.0, -4.0), 0.5, (6, 2))
    found = agreed_vertical([standing(lean, kind=kind) for lean in leans], ground(10.0, doubtful=True))
    # The mean of six leans of half a degree errs by 0.2.
    np.testing.assert_allclose(off(found.up), (7.0, -4.0), atol=0.6)
    assert found.upright == list(range(6))


def test_a_slab_is_noise_among_objects_that_agree():
    found = agreed_vertical(scattered((20.0, 5.0), 0.5, 5), ground(0.3, doubtful=True))
    np.testing.assert_allclose(off(found.up), (20.0, 5.0), atol=0.6)
    # And a good plane that was only noisier than thought stays.
    found = agreed_vertical(scattered((1.0, 0.0), 1.0, 5), ground(0.3, doubtful=True))
    assert np.abs(off(found.up)).max() < 0.6


def test_what_leans_for_good_is_noise():
    objects = scattered((1.0, 0.0), 0.3, 4)
    without = agreed_vertical(objects, ground(1.0))
    found = agreed_vertical([*objects, standing((25.0, 3.0))], ground(1.0))
    assert found.upright == [0, 1, 2, 3]
    # Its membership is (5 / 24)² / (1 + (5 / 24)²) = 0.04.
    np.testing.assert_allclose(off(found.up), off(without.up), atol=0.02)


def test_objects_that_stand_exactly_alike_keep_the_least_lean():
    found = agreed_vertical([standing((0.0, 0.0), 0.01)] * 5, ground(0.3))
    assert found.lean == LEAST_LEAN


def test_too_few_that_agree():
    assert agreed_vertical(scattered((0.0, 0.0), 0.3, 2), ground(0.3)) is None
    apart = 3 * np.rad2deg(NOISE_DISTANCE)
    assert agreed_vertical([standing((x, 0.0)) for x in (0.0, 0.1, apart)], ground(0.3)) is None


def test_doubtful_fits_and_bodies_without_an_axis_do_not_count():
    doubtful = dataclasses.replace(standing((4.0, 0.0)), status=jnp.asarray(int(Status.NOT_CONVERGED)))
    loose = dataclasses.replace(standing((4.0, 0.0)), inliers=jnp.arange(1000) < 700)
    ball = fitted_shape(Sphere(jnp.zeros(3), jnp.asarray(0.1)), np.ones(1000, bool), 0.01)
    unknown = dataclasses.replace(standing((4.0, 0.0)), covariance=jnp.full((5, 5), jnp.nan))
    good = scattered((0.0, 0.0), 0.3, 3)
    found = agreed_vertical([doubtful, *good, loose, ball, unknown], ground(0.3))
    assert found.upright == [1, 2, 3]
    np.testing.assert_array_equal(found.up, agreed_vertical(good, ground(0.3)).up)


def test_what_cannot_stand_stays_as_it_was():
    old = [dataclasses.replace(standing((x, 0.0)), scores={"cylinder": 1.0}) for x in (0.5, 1.0, 1.5, 30.0)]
    again = [standing((0.1, 0.0)), dataclasses.replace(old[1], kind="unknown", primitive=None), standing((0.2, 0.0))]
    again[0] = dataclasses.replace(again[0], scores={}, status=jnp.asarray(int(Status.NOT_CONVERGED)))
    again[2] = dataclasses.replace(again[2], inliers=jnp.arange(1000) < 700)
    asked = []

    def fit(of, lean):
        asked.append((list(of), lean))
        return again

    new = upright_again(old, Vertical(UP, 0.003, 0.004, [0, 1, 2]), fit)
    assert asked == [([0, 1, 2], pytest.approx(0.005))]
    assert new[0].primitive is again[0].primitive
    assert new[0].scores == {"cylinder": 1.0}
    assert int(new[0].status) == Status.NOT_CONVERGED
    # Refused about the vertical, holding too few of its points there, never upright.
    assert [new[i] is old[i] for i in (1, 2, 3)] == [True] * 3


def test_error_of_a_plane_is_that_of_its_points():
    rng = np.random.default_rng(2)
    count, std = 20000, 0.02
    flat = rng.uniform(-0.5, 0.5, (count, 2))
    normals = []
    for _ in range(40):
        # Height above a level plane, straight above which the camera looks down: depth is height.
        height = rng.normal(0, std, count)
        normals.append(np.linalg.lstsq(np.column_stack([flat, np.ones(count)]), height, rcond=None)[0][:2])
    points = np.column_stack([flat[:, 0], np.zeros(count), flat[:, 1]])
    plane = jf.Plane(jnp.zeros(3), jnp.asarray(UP), jnp.zeros((4, 3)))
    nothing = jnp.zeros(())
    seen = jf.ground.Ground(
        plane, jnp.ones(count, bool), jnp.full(count, std), nothing + 1, nothing + 1, jnp.zeros((), jnp.int32)
    )
    given = {"given": False, "camera": np.array([0.0, -1e6, 0.0]), "correlated": False}
    witness = witness_of(points, seen, UP, **given)
    own = np.rad2deg(np.sqrt(np.diag(witness.error))) ** 2 - 0.3**2
    # Eighty values tell a variance to 16 per cent.
    assert own.mean() == pytest.approx(np.rad2deg(np.std(normals)) ** 2, rel=0.4)
    assert not witness.doubtful
    assert witness_of(points, None, UP, **given).doubtful
    assert not witness_of(points, None, UP, **given | {"given": True}).doubtful


def test_cones_that_stand_are_measured_better(monkeypatch):
    picture = render_pair(table_scene(5, tilt=np.deg2rad(9.2)), seed=5)
    truth = np.rad2deg([float(o.half_angle) for o in picture.objects if o.kind == "cone"])

    def half_angle():
        found = jf.model_scene(picture.left, picture.right, picture.rig)
        return np.rad2deg([float(s.primitive.half_angle) for s in found.shapes if s.kind == "cone"])

    together = half_angle()
    monkeypatch.setattr(naming, "agreed_vertical", lambda *_: None)
    alone = half_angle()
    assert len(together) == len(alone) == len(truth) == 1
    # By itself it leans by 1.5 and 1.9 degrees.
    assert abs(together - truth)[0] < 0.5 * abs(alone - truth)[0]


def test_a_vertical_that_was_given_is_kept():
    seen = simulate_scene(4, seed=3, outliers=0.1)
    up = np.array([0.05, -1.0, 0.02]) / np.linalg.norm([0.05, -1.0, 0.02])
    scene = jf.model_cloud(jf.Cloud(seen.points), ground=None, up=up)
    assert sum(shape.kind != "unknown" for shape in scene.shapes) >= 3
    np.testing.assert_allclose(scene.up, up, atol=1e-6)
