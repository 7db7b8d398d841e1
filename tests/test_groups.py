"""Groups made objects by their shapes, without the search: surfaces are stood in for by what a fit would say."""

import jax.numpy as jnp
import numpy as np

from jaxfuzzy.groups import by_shapes
from jaxfuzzy.primitives import Sphere
from jaxfuzzy.segment import segment
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

ACROSS = np.array([[1.0, 0, 0], [0, 0, 1.0]])


def ball(center, radius=0.1, count=300, seed=0):
    toward = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(center) + radius * toward / np.linalg.norm(toward, axis=1, keepdims=True)


def shape_of(points, sphere, noise=0.005):
    """A shape as a fit would give it; unknown where the sphere holds less than half of the points."""
    held = np.asarray(sphere.distance(points)) < noise
    good = held.mean() > 0.5
    return Shape(
        primitive=sphere if good else None,
        inliers=jnp.asarray(held & good),
        noise_distance=jnp.asarray(noise),
        scores={},
        margin=0.0,
        counts={},
        covariance=jnp.zeros((4, 4)),
        status=jnp.asarray(int(Status(0)), jnp.int32),
        kind="sphere" if good else "unknown",
    )


def fitted_to(points, spheres):
    """Takes for every set the sphere that holds most of it."""

    def fit(sets, capacity):
        best = lambda own: max((shape_of(points[own], s) for s in spheres), key=lambda s: int(s.inliers.sum()))
        return tuple(best(own) for own in sets)

    return fit


def divided(points, labels):
    """A division by places, relabelled as asked."""
    parts = segment(points, ks=(int(labels.max()) + 1,))
    assert parts.k == labels.max() + 1
    return parts


def hardened(parts):
    u, noise = np.asarray(parts.partition.memberships), np.asarray(parts.partition.noise)
    np.testing.assert_allclose(u.sum(1) + noise, 1, atol=1e-6)
    return np.where(noise > u.max(1), -1, u.argmax(1))


def test_two_parts_of_one_ball_are_merged_and_a_stranger_is_not():
    whole = ball([0, 0, 1.0], 0.15, 900)
    # An occluder has cut the ball in two.
    cut = whole[np.abs(whole[:, 0]) > 0.05]
    other = ball([0.6, 0, 1.0], 0.05)
    points = np.concatenate([cut, other])
    parts = divided(points, np.array([0, 1, 2]))
    fit = fitted_to(points, [Sphere(jnp.array([0, 0, 1.0]), jnp.asarray(0.15)), Sphere(jnp.array([0.6, 0, 1.0]), 0.05)])
    members = [np.flatnonzero(np.asarray(parts.labels) == k) for k in range(3)]
    merged, shapes = by_shapes(points, ACROSS, parts, fit(members, 0), fit)
    assert merged.k == len(shapes) == 2
    labels = np.asarray(merged.labels)
    assert len(set(labels[: len(cut)]) - {-1}) == 1
    np.testing.assert_array_equal(hardened(merged), labels)
    np.testing.assert_allclose(float(merged.sizes.sum()), 1, rtol=1e-6)
    for k, shape in enumerate(shapes):
        assert len(shape.inliers) == (labels == k).sum()


def test_two_balls_that_touch_are_told_apart():
    points = np.concatenate([ball([0, 0, 1.0]), ball([0.2, 0, 1.0], seed=1)])
    parts = segment(points, ks=(1,))
    spheres = [Sphere(jnp.array([x, 0, 1.0]), jnp.asarray(0.1)) for x in (0.0, 0.2)]
    fit = fitted_to(points, spheres)
    one = fit([np.flatnonzero(np.asarray(parts.labels) == 0)], 0)
    apart, shapes = by_shapes(points, ACROSS, parts, one, fit)
    assert apart.k == len(shapes) == 2
    labels = np.asarray(apart.labels)
    np.testing.assert_array_equal(hardened(apart), labels)
    assert {shape.kind for shape in shapes} == {"sphere"}
    # A group that one surface holds stays whole.
    alone = segment(points[:300], ks=(1,))
    held = fit([np.flatnonzero(np.asarray(alone.labels) == 0)], 0)
    same, _ = by_shapes(points[:300], ACROSS, alone, held, fit)
    assert same is alone
