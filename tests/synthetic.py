"""A small scene made of the records alone: what a stereo camera would see of a table with five bodies on it."""

import dataclasses
import functools
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxfuzzy
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.fcm import Partition
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Sphere
from jaxfuzzy.rig import Rig
from jaxfuzzy.scene import Scene
from jaxfuzzy.segment import Segmentation
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

SCHEMA = json.loads((Path(jaxfuzzy.__file__).parent / "data" / "scene.schema.json").read_text())
WIDTH, HEIGHT = 200, 150
RIG = Rig((180.0, 180.0), ((WIDTH - 1) / 2, (HEIGHT - 1) / 2), 0.08, (WIDTH, HEIGHT))
PITCH = math.radians(25)
UP = np.array([0.0, -math.cos(PITCH), -math.sin(PITCH)])
AWAY = np.array([0.0, -math.sin(PITCH), math.cos(PITCH)])
RIGHT = np.array([1.0, 0.0, 0.0])


def on_table(right, away, height=0.0):
    return np.array([0.0, 0.16, 1.0]) + right * RIGHT + away * AWAY + height * UP


def bodies():
    """Cone, box, cylinder, sphere and a frustum, standing on the table."""
    turn = math.radians(30)
    first = math.cos(turn) * RIGHT + math.sin(turn) * AWAY
    return (
        Cone(on_table(-0.3, 0.0, 0.2), -UP, math.radians(20), np.array([0.0, 0.2])),
        Box(
            on_table(0.0, -0.05, 0.06),
            np.array([0.14, 0.12, 0.1]),
            np.stack([first, UP, np.cross(first, UP)]),
            np.array([True, True, False]),
        ),
        Cylinder(on_table(0.24, -0.1), UP, 0.05, 0.15),
        Sphere(on_table(0.0, 0.3, 0.07), 0.07),
        Cone(on_table(0.38, 0.3, 0.36), -UP, math.radians(12), np.array([0.16, 0.36])),
    )


def cast(meshes, rays, origin=(0.0, 0.0, 0.0)):
    """Depth and index of the first mesh that each ray meets (z of the ray is 1), and the normal there."""
    depth = np.full(len(rays), np.inf)
    index = np.full(len(rays), -1)
    normal = np.zeros((len(rays), 3))
    for number, (vertices, faces) in enumerate(meshes):
        corners = vertices - np.asarray(origin)
        middle = corners.mean(0)
        reach = np.linalg.norm(corners - middle, axis=1).max()
        near = np.flatnonzero(np.linalg.norm(np.cross(rays, middle), axis=1) <= reach * np.linalg.norm(rays, axis=1))
        for a, b, c in corners[faces]:
            n = np.cross(b - a, c - a)
            if a @ n >= 0:
                continue  # it is turned away
            t = (a @ n) / np.where(rays[near] @ n == 0, 1e-12, rays[near] @ n)
            hit = rays[near] * t[:, None]
            inside = np.all([np.cross(q - p, hit - p) @ n >= 0 for p, q in ((a, b), (b, c), (c, a))], axis=0)
            first = near[inside & (t > 0) & (t < depth[near])]
            depth[first], index[first] = ((a @ n) / (rays[first] @ n)), number
            normal[first] = n / np.linalg.norm(n)
    return depth, index, normal


@functools.cache
def seen():
    """Points, labels (-1 table), pixels, and both photographs."""
    made = bodies()
    corners = np.array([on_table(*p) for p in ((-0.6, -0.4), (0.6, -0.4), (0.6, 0.7), (-0.6, 0.7))])
    table = Plane(on_table(0, 0), UP, corners)
    meshes = [(np.asarray(v), np.asarray(f)) for v, f in (b.mesh() if isinstance(b, Box) else b.mesh(20) for b in made)]
    meshes.append((corners, np.array([[0, 1, 2], [0, 2, 3]])))
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    pixels = np.stack([column.ravel(), row.ravel()], 1).astype(float)
    rays = np.column_stack([(pixels - RIG.center_px) / RIG.focal_px, np.ones(len(pixels))])
    tints = np.array([[210, 60, 50], [220, 200, 170], [60, 90, 200], [60, 170, 90], [200, 150, 60], [150, 150, 155]])
    images = []
    for eye in ((0.0, 0.0, 0.0), (RIG.baseline_m, 0.0, 0.0)):
        depth, index, normal = cast(meshes, rays, eye)
        light = np.abs(normal @ np.array([0.3, -0.8, -0.52]))[:, None]
        shaded = np.where(index[:, None] >= 0, tints[index] * (0.35 + 0.65 * light), 40)
        images.append(shaded.reshape(HEIGHT, WIDTH, 3).astype(np.uint8))
        if eye[0] == 0:
            hit = np.flatnonzero(np.isfinite(depth))
            rng = np.random.default_rng(0)
            noisy = depth[hit] + 0.002 * depth[hit] ** 2 * rng.standard_normal(len(hit))
            points = rays[hit] * noisy[:, None]
            labels = np.where(index[hit] < len(made), index[hit], -1)
            pixels = pixels[hit]
            colors = images[0].reshape(-1, 3)[hit] / 255.0
    return points, labels, pixels, colors, images, table


def make_scene(*, photograph=True, dtype=np.float64):
    """The scene as `model_scene` would give it back, except that truth is what it found."""
    points, labels, pixels, colors, images, table = seen()
    made, count = bodies(), len(bodies())
    plan = points @ np.stack([RIGHT, AWAY], 1)
    centers = np.stack([plan[labels == i].mean(0) for i in range(count)])
    closeness = 1 / (np.sum((plan[:, None] - centers) ** 2, -1) + 1e-6)
    memberships = closeness / closeness.sum(1, keepdims=True)

    def array(value):
        return jnp.asarray(np.asarray(value, dtype))

    shapes = []
    for i, body in enumerate(made):
        body = jax.tree.map(lambda x: jnp.asarray(x) if np.asarray(x).dtype == bool else array(x), body)
        inliers = np.arange(np.sum(labels == i)) % 10 != 0
        size = len(body.parameter_names)
        scores = {"plane": 12.0, "box": 7.0, "cylinder": 5.0, "cone": 6.5, "sphere": math.inf} | {body.kind: 1.0}
        shapes.append(
            Shape(
                primitive=body,
                inliers=jnp.asarray(inliers),
                noise_distance=0.01,
                scores=scores,
                margin=4.0,
                counts={"3d": 10, "4d": 12, "6d": 12} if i == 0 else {},
                covariance=array(np.eye(size) * 1e-6 * (i + 1)),
                status=jnp.asarray(int(Status.LOWER_BOUND) if i == 2 else 0),
                kind=body.kind,
            )
        )
    status = jnp.asarray(int(Status.GROUND_SLAB))
    partition = Partition(
        array(centers),
        array(np.full(count, 1 / count)),
        array(memberships),
        array(np.zeros(len(points))),
        jnp.asarray(memberships.argmax(1)),
        array(1.0),
        jnp.asarray(7),
        jnp.asarray(0),
        2.0,
        math.inf,
    )
    shares = np.bincount(labels[labels >= 0]) / np.sum(labels >= 0)
    segmentation = Segmentation(
        jnp.asarray(labels), count, partition.sizes, array(shares), partition, None, None, jnp.asarray(0)
    )
    cloud = Cloud(array(points), array(colors), array(0.002 * points[:, 2] ** 2), array(pixels))
    return Scene(
        cloud=cloud,
        up=array(UP),
        ground=table,
        segmentation=segmentation,
        shapes=tuple(shapes),
        timings={"match": 0.5, "segment": 0.1, "shapes": 0.25},
        settings={"ks": "auto", "noise_distance": "auto", "kinds": ("box", "cone"), "baseline": np.float32(0.08)},
        status=status,
        image=images[0] if photograph else None,
        image_right=images[1] if photograph else None,
        rig=RIG if photograph else None,
    )


def odd_scene():
    """No photograph, no ground; an object of unknown kind, scores and a covariance that are not finite, one without any."""
    plain = make_scene(photograph=False)
    first = plain.shapes[0]
    unknown = dataclasses.replace(
        first, primitive=None, kind="unknown", covariance=jnp.zeros((0, 0)), scores={}, margin=math.inf
    )
    bare = dataclasses.replace(plain.shapes[2], covariance=jnp.zeros((0, 0)))
    flat = dataclasses.replace(plain.shapes[3], covariance=jnp.full((4, 4), jnp.inf))
    return dataclasses.replace(plain, ground=None, shapes=(unknown, plain.shapes[1], bare, flat, plain.shapes[4]))


def empty_scene():
    plain = make_scene(photograph=False)
    count = len(plain.cloud.points)
    fuzzy = dataclasses.replace(plain.segmentation.partition, memberships=jnp.zeros((count, 0)), sizes=jnp.zeros(0))
    none = dataclasses.replace(plain.segmentation, labels=jnp.full(count, -1), k=0, partition=fuzzy)
    return dataclasses.replace(plain, segmentation=none, shapes=(), timings={})


def fitted_shape(body, inliers, noise_distance):
    """A shape as a fit would give it; unknown without a body."""
    return Shape(
        primitive=body,
        inliers=jnp.asarray(inliers),
        noise_distance=jnp.asarray(noise_distance),
        scores={},
        margin=0.0,
        counts={},
        covariance=jnp.zeros((0, 0)),
        status=jnp.asarray(0, jnp.int32),
        kind="unknown" if body is None else body.kind,
    )
