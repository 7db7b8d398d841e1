import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import trimesh

from jaxfuzzy.primitives import PRIMITIVES, Box, Cone, Cylinder, Plane, Quadric, Sphere, primitive_from_dict, transform

RNG = np.random.default_rng(4)


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


TURN = rotation(1)
ORIGIN = np.array([0.3, -0.2, 1.1])
LEFT_HANDED = TURN * np.array([[1.0], [1.0], [-1.0]])
BODIES = {
    "plane": Plane(ORIGIN, TURN[2], ORIGIN + np.array([[-0.2, -0.1], [0.2, -0.1], [0.3, 0.2], [-0.1, 0.1]]) @ TURN[:2]),
    "box": Box(ORIGIN, np.array([0.2, 0.3, 0.1]), TURN, np.array([True, False, True])),
    "box, left-handed": Box(ORIGIN, np.array([0.2, 0.3, 0.1]), LEFT_HANDED, np.ones(3, bool)),
    "cylinder": Cylinder(ORIGIN, TURN[1], np.array(0.1), np.array(0.25)),
    "cone": Cone(ORIGIN, TURN[1], np.array(0.4), np.array([0.0, 0.3])),
    "cone, apex up": Cone(ORIGIN, np.array([0.0, -1.0, 0.0]), np.array(0.4), np.array([0.0, 0.3])),
    "frustum": Cone(ORIGIN, TURN[1], np.array(0.4), np.array([0.1, 0.3])),
    "sphere": Sphere(ORIGIN, np.array(0.2)),
    "quadric": Quadric(
        np.array([1.0, 4.0, 2.0, 0.3, -0.2, 0.1, 0.1, -0.3, 0.2, -0.1]), np.array([[-0.6, -0.4, -0.5], [0.5, 0.4, 0.4]])
    ),
}
CLOSED = [k for k in BODIES if k != "plane"]
bodies = pytest.mark.parametrize("name", BODIES)


def volume(body):
    match body:
        case Box(_, size, _, _):
            return np.prod(size)
        case Cylinder(_, _, radius, height):
            return np.pi * radius**2 * height
        case Cone(_, _, half_angle, height):
            return np.pi / 3 * np.tan(half_angle) ** 2 * (height[1] ** 3 - height[0] ** 3)
        case Sphere(_, radius):
            return 4 / 3 * np.pi * radius**3
        case Quadric():
            q = np.asarray(body.matrix())
            level = q[:3, 3] @ np.linalg.solve(q[:3, :3], q[:3, 3]) - q[3, 3]
            return 4 / 3 * np.pi * level**1.5 / np.sqrt(np.linalg.det(q[:3, :3]))


@pytest.mark.parametrize("name", CLOSED)
def test_mesh_is_closed_outward_and_of_the_right_volume(name):
    vertices, faces = BODIES[name].mesh()
    mesh = trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    # 48 sides inscribed in a circle lose 0.29 % of its area, a sphere as much again along its rings; 40 cells 0.8 %
    assert mesh.volume == pytest.approx(volume(BODIES[name]), rel=1e-9 if "box" in name else 9e-3)


def test_plane_faces_along_its_normal():
    plane = BODIES["plane"]
    for corners in (plane.corners, plane.corners[::-1]):
        vertices, faces = Plane(plane.point, plane.normal, corners).mesh()
        mesh = trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)
        np.testing.assert_allclose(mesh.face_normals, np.tile(plane.normal, (2, 1)), atol=1e-12)


@bodies
def test_distance_is_that_to_the_mesh(name):
    body = BODIES[name]
    vertices, faces = body.mesh(100) if name not in ("plane", "quadric") and "box" not in name else body.mesh()
    mesh = trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)
    center = mesh.bounds.mean(0)
    points = center + RNG.uniform(-0.4, 0.4, (200, 3))
    if name == "quadric":  # first order only: points within 2 % of its size
        points = trimesh.sample.sample_surface(mesh, 200, seed=3)[0] + RNG.uniform(-0.01, 0.01, (200, 3))
    _, expected, _ = trimesh.proximity.closest_point_naive(mesh, points)
    # 100 sides leave a sagitta of 5e-4 of a radius, twice that on the sphere; the quadric 1e-3.
    tolerance = {"plane": 1e-12, "quadric": 2e-3}.get(name, 1e-12 if "box" in name else 2.5e-4)
    np.testing.assert_allclose(body.distance(points), expected, atol=tolerance)


def test_distance_by_hand():
    cylinder = Cylinder(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array(1.0), np.array(2.0))
    points = np.array([[3.0, 1, 0], [0, 5, 0], [0, 1, 0], [4, 6, 0], [0, 1.9, 0]])
    np.testing.assert_allclose(cylinder.distance(points), [2, 3, 1, 5, 0.1], atol=1e-15)
    cone = Cone(np.zeros(3), np.array([0.0, -1.0, 0.0]), np.array(np.pi / 4), np.array([0.0, 2.0]))
    points = np.array([[0.0, 1, 0], [1, 0, 0], [0, -3, 0], [0, -1, 0], [3, -2, 0]])
    np.testing.assert_allclose(cone.distance(points), [1, np.sqrt(0.5), 1, np.sqrt(0.5), 1], atol=1e-15)


@bodies
def test_rigid_motion(name):
    body, turn = BODIES[name], rotation(7)
    shift = np.array([0.5, -2.0, 0.7])
    points = ORIGIN + RNG.uniform(-0.4, 0.4, (50, 3))
    moved = transform(body, turn, shift)
    assert type(moved) is type(body)
    # rounding of coordinates of about 2 m
    np.testing.assert_allclose(moved.distance(points @ turn.T + shift), body.distance(points), atol=1e-12)
    back = transform(moved, turn.T, -turn.T @ shift)
    for field, value in back.to_dict().items():
        if field not in ("kind", "bounds"):
            np.testing.assert_allclose(value, body.to_dict()[field], atol=1e-12)


@bodies
def test_dict_and_back(name):
    body = BODIES[name]
    data = json.loads(json.dumps(body.to_dict()))
    assert data["kind"] == body.kind
    again = primitive_from_dict(data)
    for a, b in zip(jax.tree.leaves(body), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.asarray(b).dtype == np.asarray(a).dtype


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"kind": "torus"}, "kind must be one of 'plane', 'box'"),
        ({"kind": "sphere", "center": [0, 0, 0]}, "fields center, radius, got center"),
        ({"kind": "sphere", "center": [0, 0, 0], "radius": 1, "color": 2}, "got center, radius, color"),
        ({"kind": "sphere", "center": [0, 0], "radius": 1}, r"center of a sphere must be numbers of shape \(3,\)"),
        ({"kind": "sphere", "center": ["a", "b", "c"], "radius": 1}, "center of a sphere must be numbers"),
    ],
)
def test_dict_refused(data, message):
    with pytest.raises(ValueError, match=message):
        primitive_from_dict(data)


@bodies
def test_parameters_have_names_and_finite_derivatives(name):
    body = BODIES[name]
    assert body.parameters().shape == (len(body.parameter_names),)
    assert set(PRIMITIVES) >= {body.kind}
    floats = body if not isinstance(body, Box) else Box(body.center, body.size, body.axes, np.ones(3))
    for leaf in jax.tree.leaves(jax.jit(jax.jacfwd(lambda b: b.parameters()))(floats)):
        assert np.isfinite(leaf).all()


def test_parameters_by_hand():
    up = np.array([0.0, 1.0, 0.0])
    plane = Plane(np.array([1.0, 2.0, 5.0]), np.array([0.0, 0.0, -1.0]), np.zeros((4, 3)))
    np.testing.assert_allclose(plane.parameters(), [0, 0, 5])
    cylinder = Cylinder(np.array([1.0, 7.0, 2.0]), up, np.array(0.5), np.array(1.0))
    # polar angle grows along -z and azimuth along -x where the axis is y
    np.testing.assert_allclose(cylinder.parameters(), [np.pi / 2, np.pi / 2, -2, -1, 0.5], atol=1e-15)
    shifted = Cylinder(np.array([1.0, -3.0, 2.0]), up, np.array(0.5), np.array(4.0))
    np.testing.assert_allclose(shifted.parameters(), cylinder.parameters(), atol=1e-15)
    cone = Cone(np.array([1.0, 2.0, 3.0]), -up, np.array(0.3), np.array([0.0, 1.0]))
    np.testing.assert_allclose(cone.parameters(), [1, 2, 3, np.pi / 2, -np.pi / 2, 0.3], atol=1e-15)
    np.testing.assert_allclose(Quadric(-2 * np.eye(10)[3]).parameters(), np.eye(10)[3])


SLOPE = jax.jit(jax.jacfwd(lambda a: Box(np.zeros(3), np.ones(3), a, np.ones(3)).parameters()))


@pytest.mark.parametrize("seed", range(8))
def test_rotation_vector_turns_the_unit_axes_into_these(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    # 0 and nearly half a turn are where formulas break
    angle = [0.0, 1e-9, 1e-3, 1.0, 2.0, 3.0, np.pi - 1e-6, 3.14][seed]
    vector = angle * axis / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), vector)
    matrix = scipy.linalg.expm(-cross)
    box = Box(np.zeros(3), np.ones(3), matrix, np.ones(3))
    # half a turn loses half the digits of its axis' sign-free part in the exponential itself
    np.testing.assert_allclose(box.parameters()[6:], vector, atol=1e-9)
    assert np.isfinite(SLOPE(matrix)).all()


@bodies
def test_distance_is_differentiable_and_jit_agrees(name):
    body = BODIES[name]
    points = jnp.asarray(ORIGIN + RNG.uniform(-0.4, 0.4, (20, 3)))
    points = points.at[0].set(ORIGIN)  # on centre, base, apex
    eager, compiled = body.distance(points), jax.jit(lambda b, p: b.distance(p))(body, points)
    np.testing.assert_allclose(compiled, eager, atol=8 * np.finfo(float).eps)
    assert np.isfinite(jax.jit(jax.grad(lambda p: body.distance(p).sum()))(points)).all()
    small = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, body)
    assert small.distance(points.astype(np.float32)).dtype == np.float32


def test_quadric_without_bounds_is_not_drawn():
    with pytest.raises(ValueError, match="bounds must be given to draw a quadric, got None"):
        Quadric(np.ones(10)).mesh()


def test_open_quadric_is_cut_at_its_bounds():
    saddle = Quadric(np.array([1.0, 0, -1, 0, 0, 0, 0, -1, 0, 0]), np.array([[-1.0, -1, -1], [1, 1, 1]]))
    vertices, faces = saddle.mesh(20)
    # linear interpolation in a cell of 0.1: curvature 2 leaves h²/4 = 2.5e-3
    assert np.abs(saddle.value(vertices)).max() < 6e-3
    assert np.abs(vertices).max() <= 1
    mesh = trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)
    gradient = np.stack([2 * mesh.triangles_center[:, 0], -np.ones(len(faces)), -2 * mesh.triangles_center[:, 2]], 1)
    large = mesh.area_faces > 1e-6
    assert (np.sum(mesh.face_normals * gradient, 1)[large] > 0).all()
