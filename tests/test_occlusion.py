"""Ends seen and ends hidden: bodies cast by hand with something before them, simulated scenes with known lengths, the whole way."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy import drawing
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.occlusion import ends_of, with_hidden_ends
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Sphere
from jaxfuzzy.scene import model_cloud
from jaxfuzzy.shapes import fit_shapes
from jaxfuzzy.simulate import KINDS, simulate_object, simulate_scene
from jaxfuzzy.status import Status
from synthetic import fitted_shape

CAMERA = np.zeros(3)
TURN = np.deg2rad(30)
SIDE = np.array([[np.cos(TURN), 0, np.sin(TURN)], [0, 1, 0], [-np.sin(TURN), 0, np.cos(TURN)]])
BOX = Box(jnp.array([0, 0, 1.2]), jnp.array([0.2, 0.3, 0.1]), jnp.asarray(SIDE), jnp.ones(3, bool))
CYLINDER = Cylinder(jnp.array([0, -0.15, 1.3]), jnp.array([0, 1.0, 0]), jnp.asarray(0.07), jnp.asarray(0.3))
CONE = Cone(jnp.array([0, 0.2, 1.3]), jnp.array([0, -1.0, 0]), jnp.asarray(0.3), jnp.array([0.1, 0.35]))
SCREEN = Plane(
    jnp.array([0, -0.2, 0.9]),
    jnp.array([0, 0, -1.0]),
    jnp.array([[-0.3, -0.4, 0.9], [0.3, -0.4, 0.9], [0.3, 0, 0.9], [-0.3, 0, 0.9]]),
)


def seen(body, count=1500, seed=0):
    """Points of a body where the camera sees it: of its mesh, the triangles that face the camera."""
    rng = np.random.default_rng(seed)
    vertices, faces = map(np.asarray, body.mesh())
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    toward = np.maximum(-(normals * corners[:, 0]).sum(1), 0)
    which = rng.choice(len(faces), count, p=toward / toward.sum())
    a, b = np.sort(rng.uniform(size=(2, count, 1)), axis=0)
    return a * corners[which, 0] + (b - a) * corners[which, 1] + (1 - b) * corners[which, 2]


def shape(body, count):
    """What a fit would say if all its points were on it."""
    return fitted_shape(body, np.ones(count, bool), 0.002)


def told(*bodies, loose=(), ground=None, thickness=0.0):
    """The shapes of bodies given with the points that are seen of each, and of what belongs to none."""
    clouds = [points for _, points in bodies]
    ends = np.cumsum([0, *map(len, clouds)])
    members = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    shapes = [shape(body, len(points)) for body, points in bodies]
    return with_hidden_ends(np.concatenate([*clouds, *loose]), members, shapes, CAMERA, ground, thickness)


def lower_bound(shape):
    return bool(int(shape.status) & Status.LOWER_BOUND)


def shorter(body, points):
    """The cylinder or cone that is found where only these points are seen of it."""
    if isinstance(body, Cylinder):
        low = points[:, 1].min()
        return dataclasses.replace(body, base=body.base.at[1].set(low), height=body.base[1] + body.height - low)
    return dataclasses.replace(body, height=body.height.at[1].set(float(body.apex[1]) - points[:, 1].min()))


@pytest.mark.parametrize("body", [BOX, CYLINDER, CONE, SCREEN], ids=lambda body: body.kind)
def test_what_stands_free_was_seen(body):
    alone = told((body, seen(body)))[0]
    assert not lower_bound(alone)
    # Points before it here and there, a third as dense as its own, hide nothing.
    loose = np.random.default_rng(1).uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.1], (1000, 3))
    assert not lower_bound(told((body, seen(body)), loose=[loose])[0])
    # Nor does a wall behind it.
    wall = dataclasses.replace(SCREEN, point=SCREEN.point * 2, corners=SCREEN.corners * 2 + jnp.array([0, 0.4, 0]))
    assert not lower_bound(told((body, seen(body)), (wall, seen(wall)))[0])


@pytest.mark.parametrize("body", [CYLINDER, CONE], ids=lambda body: body.kind)
@pytest.mark.parametrize("density", [0.05, 1.0, 10.0])
def test_a_foot_behind_a_screen_is_a_lower_bound(body, density):
    points = seen(body)
    # The screen's upper edge is at the height of the camera.
    visible = points[points[:, 1] > 0]
    screen = seen(SCREEN, round(3000 * density))
    behind, before = told((shorter(body, visible), visible), (SCREEN, screen))
    assert lower_bound(behind)
    assert not lower_bound(before)
    # The same points without the screen end where they end.
    assert not lower_bound(told((shorter(body, visible), visible))[0])


def test_a_screen_that_is_no_object_hides_too():
    points = seen(CYLINDER)
    visible = points[points[:, 1] > 0]
    # The view holds as many of its points as of the cylinder's.
    assert lower_bound(told((shorter(CYLINDER, visible), visible), loose=[seen(SCREEN, 20_000)])[0])


def test_a_foot_hidden_in_part_was_seen():
    points = seen(CYLINDER)
    half = dataclasses.replace(SCREEN, corners=SCREEN.corners * jnp.array([0.5, 1, 1]) + jnp.array([-0.15, 0, 0]))
    visible = points[(points[:, 1] > 0) | (points[:, 0] > 0)]
    assert not lower_bound(told((CYLINDER, visible), (half, seen(half)))[0])


def test_a_foot_on_the_ground_was_seen_whatever_stands_before_it():
    points = seen(CYLINDER)
    visible = points[points[:, 1] > 0]
    ground = Plane(jnp.zeros(3), jnp.array([0, 1.0, 0]), jnp.zeros((4, 3)))
    pair = (shorter(CYLINDER, visible), visible), (SCREEN, seen(SCREEN))
    assert not lower_bound(told(*pair, ground=ground, thickness=0.01)[0])
    # Ten centimetres above the ground it does not stand on it.
    lower = dataclasses.replace(ground, point=jnp.array([0, -0.1, 0]))
    assert lower_bound(told(*pair, ground=lower, thickness=0.01)[0])


def test_of_a_box_only_the_edge_that_is_hidden_is_a_lower_bound():
    points = seen(BOX)
    # Its front face leads to the right and away; what lies right of the camera's axis is hidden.
    visible = points[points[:, 0] < 0]
    along = (visible - np.asarray(BOX.center)) @ SIDE[0]
    low, high = along.min(), along.max()
    found = dataclasses.replace(
        BOX, center=BOX.center + (low + high) / 2 * SIDE[0], size=BOX.size.at[0].set(high - low)
    )
    screen = dataclasses.replace(SCREEN, corners=SCREEN.corners[:, jnp.array([1, 0, 2])] * jnp.array([-1, 1, 1]))
    assert float(screen.corners[:, 0].min()) == 0
    box = told((found, visible), (screen, seen(screen)))[0]
    assert lower_bound(box)
    np.testing.assert_array_equal(box.primitive.seen, [False, True, True])
    assert drawing.size_text(box).startswith("edge 1 at least ")
    assert drawing.size_text(box).count("at least") == 1


def test_what_has_no_ends():
    assert ends_of(Sphere(jnp.zeros(3), jnp.asarray(1.0))) == []
    assert ends_of(None) == []
    # The tip of a cone cannot go on.
    assert len(ends_of(dataclasses.replace(CONE, height=jnp.array([0.0, 0.2])))) == 1
    assert told((BOX, seen(BOX, 5)))[0].kind == "box"


def lengths(truth, shape):
    """Each extent over the true one, and whether it is said to have been seen."""
    real, got = truth.primitive, shape.primitive
    if got is None or real.kind != got.kind:
        return
    if real.kind == "cylinder":
        yield float(got.height / real.height), not lower_bound(shape)
    elif real.kind == "cone":
        yield float(np.diff(got.height)[0] / np.diff(real.height)[0]), not lower_bound(shape)
    elif real.kind == "box":
        partner = np.abs(np.asarray(got.axes) @ np.asarray(real.axes).T).argmax(1)
        for i, j in enumerate(partner):
            yield float(got.size[i] / real.size[j]), bool(got.seen[i])


@pytest.mark.slow
def test_few_false_alarms():
    alone = [simulate_object(kind, 200 + i, outliers=(0.0, 0.1, 0.3, 0.5)[i % 4]) for kind in KINDS for i in range(8)]
    labels = np.repeat(np.arange(40), [len(cloud.points) for cloud in alone])
    points, noise = (np.concatenate([getattr(c, name) for c in alone]) for name in ("points", "depth_std"))
    shapes = fit_shapes(points, labels, camera=CAMERA, noise_distance=2.5 * noise)
    for cloud, found in zip(alone, shapes, strict=True):
        assert not lower_bound(
            with_hidden_ends(cloud.points, [np.arange(len(cloud.points))], [found], CAMERA, None, 0)[0]
        )
    count, alarms = 0, 0
    for i in range(8):
        scene = simulate_scene(5, 700 + i, outliers=(0.0, 0.1, 0.25, 0.1)[i % 4], points=(150, 600))
        shapes = fit_shapes(scene.points, scene.labels, camera=CAMERA, noise_distance=2.5 * scene.depth_std)
        members = [np.flatnonzero(scene.labels == k) for k in range(5)]
        judged_shapes = with_hidden_ends(scene.points, members, shapes, CAMERA, None, 0)
        for truth, judged in zip(scene.truths, judged_shapes, strict=True):
            for ratio, was_seen in lengths(truth, judged):
                count += ratio > 0.95
                alarms += ratio > 0.95 and not was_seen
    # Where an occluder borders on an end in the picture nobody can tell.
    assert count > 40
    assert alarms <= 1


def test_a_box_seen_from_one_two_or_three_sides():
    # Face on it is a plane that may be a box; from its corner all edges are seen, from above or not.
    level, above = {"elevation": (0.0, 1.0)}, {"elevation": (30.0, 35.0)}
    for seed, options, kind in ((15, level, "plane"), (14, level, "box"), (14, above, "box")):
        cloud = simulate_object("box", seed, outliers=0.0, points=(1500, 1600), **options)
        scene = model_cloud(Cloud(cloud.points, depth_std=cloud.depth_std), ground=None, up=(0, 1, 0))
        found = max(scene.shapes, key=lambda s: len(s.inliers))
        assert found.kind == kind
        assert bool(int(found.status) & Status.MAY_BE_BOX) == (kind == "plane")
        assert not lower_bound(found)
        for ratio, was_seen in lengths(cloud.truths[0], found):
            assert was_seen
            # The last point lies up to a spacing of some millimetres inside the end.
            np.testing.assert_allclose(ratio, 1, atol=0.02)


@pytest.mark.slow
def test_the_whole_way_says_at_least():
    rng = np.random.default_rng(0)
    points = np.concatenate([(p := seen(CYLINDER, 3000))[p[:, 1] > 0], seen(SCREEN, 3000)])
    points *= 1 + 0.0005 * rng.normal(size=(len(points), 1))
    scene = model_cloud(Cloud(points), ground=None, up=(0, 1, 0))
    cylinder = next(s for s in scene.shapes if s.kind == "cylinder")
    assert lower_bound(cylinder)
    assert "height at least 1" in drawing.size_text(cylinder)
    screen = next(s for s in scene.shapes if s.kind == "plane")
    assert not lower_bound(screen)
    assert "at least" not in drawing.size_text(screen)
