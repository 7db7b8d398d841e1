"""Rendered stereo pairs with exact truth: primitives on a table before a wall, for tests, benchmarks and notebooks.

Rays are cast through the middle of every pixel, so depth, object and disparity of each are exact. The texture is a solid
noise of the surface point itself, the same from both cameras: without texture there is nothing to match. NumPy only;
the same seed gives the same picture.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfuzzy import bodies, checks
from jaxfuzzy.bodies import Body
from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Sphere
from jaxfuzzy.rig import Rig

RIG = Rig(focal_px=(700.0, 700.0), center_px=(319.5, 239.5), baseline_m=0.08, image_size=(640, 480))
WALL_M = 1.8
TEXTURE_CELLS_M = ((0.020, 0.4), (0.010, 0.3), (0.005, 0.2), (0.0025, 0.1))  # size of the grain and its weight
TABLE_PAINT, WALL_PAINT, PAINTS = 0.9, 0.7, (1.45, 1.15, 1.6, 1.3)  # brightness of table, wall and objects in turn
LIGHT = np.array([-0.4, -0.75, -0.53])  # towards the lamp: from above, left, behind the camera


def _known(value: Any) -> Any:
    """Record fields are typed as JAX arrays; known values stay NumPy's, so that rendering never wakes JAX."""
    return np.asarray(value)


@dataclasses.dataclass(frozen=True)
class Setting:
    """Objects on a table, in the left camera's frame.

    Attributes:
        objects: Boxes, cylinders, cones and spheres.
        ground: The table; it goes on beyond its corners.
    """

    objects: tuple[Primitive, ...]
    ground: Plane


@dataclasses.dataclass(frozen=True)
class Rendered:
    """A rendered pair and its truth, which is that of the left image.

    Attributes:
        left: The left image (H, W), uint8.
        right: The right image.
        rig: The cameras.
        depth_m: Depth of every pixel (H, W); infinite where nothing is.
        labels: The object of every pixel (H, W), in the order of `objects`; -1 for table and wall.
        disparity_px: Disparity of every pixel.
        visible: Pixels whose point the right camera sees too.
        objects: The primitives.
        ground: The table.
    """

    left: np.ndarray
    right: np.ndarray
    rig: Rig
    depth_m: np.ndarray
    labels: np.ndarray
    disparity_px: np.ndarray
    visible: np.ndarray
    objects: tuple[Primitive, ...]
    ground: Plane


def render_pair(
    setting: Setting,
    rig: Rig = RIG,
    *,
    noise: float = 2.0,
    gain: float = 1.0,
    offset: float = 0.0,
    vertical_px: float = 0.0,
    contrast: float = 1.0,
    wall_m: float = WALL_M,
    seed: int = 0,
) -> Rendered:
    """Photographs a setting with both cameras of a rectified rig.

    Args:
        setting: What stands there.
        rig: The cameras.
        noise: Standard deviation of the sensor noise, grey levels.
        gain: Brightness of the right image over that of the left.
        offset: Grey levels added to the right image.
        vertical_px: How much further down the right image shows everything (a fault of rectification).
        contrast: Of the texture; 0 leaves nothing to match.
        wall_m: Depth of the wall behind the table.
        seed: Of texture and noise.

    Returns:
        Both images and the truth.

    Raises:
        ValueError: The rig is not rectified or has no image size.
    """
    if not rig.rectified or rig.image_size is None:
        raise ValueError("rig must be rectified and know its image_size")
    checks.number(noise, "noise", at_least=0.0)
    width, height = rig.image_size
    columns = ((np.arange(width) - rig.center_px[0]) / rig.focal_px[0]).astype(np.float32)
    rows = ((np.arange(height) - rig.center_px[1]) / rig.focal_px[1]).astype(np.float32)
    shift = np.float32(rig.doffs_px / rig.focal_px[0])
    sink = np.float32(vertical_px / rig.focal_px[1])
    rng = np.random.default_rng(seed)
    views = []
    for eye, across, down, factor, plus in (
        (0.0, columns, rows, 1.0, 0.0),
        (rig.baseline_m, columns - shift, rows - sink, gain, offset),
    ):
        rays = np.stack([*np.meshgrid(across, down), np.ones((height, width), np.float32)], axis=-1)
        depth, label, brightness = look(setting, rays, np.array([eye, 0.0, 0.0]), contrast, wall_m, seed)
        grey = factor * brightness + plus + noise * rng.standard_normal(brightness.shape, np.float32)
        views.append((depth, label, np.clip(np.rint(grey), 0, 255).astype(np.uint8)))
    (depth, labels, left), (right_depth, _, right) = views
    with np.errstate(divide="ignore"):
        disparity = (rig.focal_px[0] * rig.baseline_m / depth - rig.doffs_px).astype(np.float32)
    return Rendered(
        left=left,
        right=right,
        rig=rig,
        depth_m=depth,
        labels=labels,
        disparity_px=disparity,
        visible=_visible(depth, disparity, right_depth, round(vertical_px)),
        objects=setting.objects,
        ground=setting.ground,
    )


def look(
    setting: Setting, rays: np.ndarray, eye: np.ndarray, contrast: float, wall_m: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What rays see: depth, object (-1 table or wall) and brightness of each.

    Args:
        setting: What stands there.
        rays: Directions (H, W, 3), third component 1 for depths along the optical axis.
        eye: Where they start (3,).
        contrast: Of the texture.
        wall_m: Third coordinate of the wall.
        seed: Of the texture.
    """
    normal, point = np.asarray(setting.ground.normal), np.asarray(setting.ground.point)
    with np.errstate(divide="ignore"):
        table = ((point - eye) @ normal / (rays @ normal.astype(np.float32))).astype(np.float32)
        wall = (np.float32(wall_m) / rays[..., 2]).astype(np.float32)
    table[~(table > 0)] = np.inf
    depth = np.minimum(table, wall)
    surface = np.where(table < wall, -1, -2)
    for index, primitive in enumerate(setting.objects):
        body = body_of(primitive)
        window = _window(body, rays, eye)
        directions = rays[window].reshape(-1, 3).astype(float) @ body.rotation.T
        start = np.broadcast_to((eye - body.origin) @ body.rotation.T, directions.shape)
        hit = body.cast(start, directions)[0].reshape(depth[window].shape).astype(np.float32)
        nearer = hit < depth[window]
        depth[window] = np.where(nearer, hit, depth[window])
        surface[window] = np.where(nearer, index, surface[window])
    places = eye.astype(np.float32) + rays * np.where(np.isfinite(depth), depth, 0)[..., None]
    grain = _texture(places.reshape(-1, 3), surface.ravel(), seed).reshape(depth.shape)
    paint = np.array([*(PAINTS[i % len(PAINTS)] for i in range(len(setting.objects))), WALL_PAINT, TABLE_PAINT])
    brightness = 255 * _shade(places) * paint.astype(np.float32)[surface] * (0.5 + contrast * (grain - 0.5))
    return depth, np.maximum(surface, -1), brightness


def body_of(primitive: Primitive) -> Body:
    """The body that rays can hit, in the place of a primitive."""
    if isinstance(primitive, Box):
        size, axes = np.asarray(primitive.size, float), np.asarray(primitive.axes, float)
        body = bodies.box(size / 2)
        # A mirrored set of axes is the same box as the one with its last axis turned round.
        body.rotation = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])[:, None]
        body.origin = np.asarray(primitive.center, float) - body.rotation[1] * size[1] / 2
    elif isinstance(primitive, Sphere):
        radius = float(primitive.radius)
        body = bodies.ellipsoid("sphere", np.full(3, radius))
        body.origin = np.asarray(primitive.center, float) - np.array([0.0, radius, 0.0])
    elif isinstance(primitive, Cylinder):
        radius, height = float(primitive.radius), float(primitive.height)
        body = bodies.frustum("cylinder", radius, radius, height, "closed")
        body.rotation, body.origin = _frame(np.asarray(primitive.axis, float)), np.asarray(primitive.base, float)
    elif isinstance(primitive, Cone):
        (start, end), slope = np.asarray(primitive.height, float), float(np.tan(primitive.half_angle))
        axis = np.asarray(primitive.axis, float)
        body = bodies.frustum("cone", slope * start, slope * end, end - start, "closed")
        body.rotation, body.origin = _frame(axis), np.asarray(primitive.apex, float) + start * axis
    else:
        raise TypeError(f"objects must be boxes, cylinders, cones or spheres, got {type(primitive).__name__}")
    return body


def paper_scene(tilt: float = 0.0) -> Setting:
    """The scene of the paper's experiment: a cylinder and a small box on a table.

    Args:
        tilt: How far the camera looks down, radians; 0 is the paper's own case, where objects are upright in its frame.
    """
    ground, place = _table(tilt)
    up = np.asarray(ground.normal)
    cylinder = _cylinder(place(-0.09, 0.0), up, 0.045, 0.15)
    return Setting((cylinder, _box(place(0.11, -0.02), ground, np.array([0.07, 0.06, 0.05]), 0.6)), ground)


def table_scene(
    seed: int,
    *,
    count: int = 4,
    tilt: float = 0.31,
    kinds: Sequence[str] = ("box", "cylinder", "cone", "sphere"),
    gap_m: float = 0.05,
    rig: Rig = RIG,
) -> Setting:
    """Random objects on a table, all in the picture, none more than a third hidden.

    Args:
        seed: Everything random follows from it.
        count: How many objects; kinds take turns.
        tilt: How far the camera looks down, radians.
        kinds: Which kinds, out of "box", "cylinder", "cone" and "sphere".
        gap_m: Least free distance between footprints.
        rig: The cameras that must see them.

    Raises:
        ValueError: No place was found for that many.
    """
    checks.integer(count, "count", at_least=1)
    rng = np.random.default_rng([seed, count])
    ground, place = _table(tilt)
    for _ in range(300):
        objects: list[Primitive] = []
        taken: list[tuple[float, float, float]] = []
        order = rng.permutation(len(kinds))
        for index in range(count):
            kind, size = kinds[order[index % len(kinds)]], rng.uniform(0.042, 0.062)
            for _ in range(60):
                x, z = rng.uniform(-0.32, 0.32), rng.uniform(-0.25, 0.35)
                if all(np.hypot(x - a, z - b) > 1.3 * (size + other) + gap_m for a, b, other in taken):
                    taken.append((x, z, size))
                    objects.append(_random_object(kind, size, place(x, z), ground, rng))
                    break
            else:
                break
        setting = Setting(tuple(objects), ground)
        if len(objects) == count and _in_view(setting, rig):
            return setting
    raise ValueError(f"no place found for count={count} objects {gap_m} m apart: lower one of them")


def _table(tilt: float) -> tuple[Plane, Any]:
    """The table under a camera that looks down by `tilt`, and a function from places on it to the camera's frame."""
    checks.number(tilt, "tilt")
    if not 0 <= tilt <= 1.2:
        raise ValueError(f"tilt must be within 0 and 1.2 radians, got {tilt}")
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    across, away = np.array([1.0, 0.0, 0.0]), np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    # Seen from far above the middle of the table is on the optical axis; seen level it must be below it.
    middle = np.array([0.0, 0.16 * np.cos(tilt), 1.0])
    corners = middle + np.array([[-0.5, -0.4], [0.5, -0.4], [0.5, 0.5], [-0.5, 0.5]]) @ np.stack([across, away])
    ground = Plane(point=_known(middle), normal=_known(up), corners=_known(corners))
    return ground, lambda x, z: middle + x * across + z * away


def _random_object(kind: str, size: float, foot: np.ndarray, ground: Plane, rng: np.random.Generator) -> Primitive:
    up = np.asarray(ground.normal)
    if kind == "box":
        return _box(foot, ground, size * np.array([2, rng.uniform(1.6, 4), rng.uniform(1.2, 2)]), rng.uniform(0.3, 1.2))
    if kind == "cylinder":
        return _cylinder(foot, up, size, size * rng.uniform(2.0, 4.0))
    if kind == "cone":
        height = size * rng.uniform(2.0, 3.5)
        apex, angle = foot + height * up, np.arctan(1.2 * size / height)
        return Cone(
            apex=_known(apex), axis=_known(-up), half_angle=_known(angle), height=_known(np.array([0.0, height]))
        )
    if kind == "sphere":
        return Sphere(center=_known(foot + 1.1 * size * up), radius=_known(1.1 * size))
    raise ValueError(f"kinds must be of 'box', 'cylinder', 'cone', 'sphere', got {kind!r}")


def _cylinder(foot: np.ndarray, up: np.ndarray, radius: float, height: float) -> Cylinder:
    return Cylinder(base=_known(foot), axis=_known(up), radius=_known(radius), height=_known(height))


def _box(foot: np.ndarray, ground: Plane, size: np.ndarray, yaw: float) -> Box:
    up = np.asarray(ground.normal)
    across, away = np.array([1.0, 0.0, 0.0]), np.cross([1.0, 0.0, 0.0], up)
    front = np.cos(yaw) * across + np.sin(yaw) * away
    axes = np.stack([front, up, np.cross(front, up)])
    center = foot + up * size[1] / 2
    return Box(center=_known(center), size=_known(size), axes=_known(axes), seen=_known(np.ones(3, bool)))


def _frame(axis: np.ndarray) -> np.ndarray:
    """Axes (rows) of a frame whose y is `axis`."""
    aside = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, aside)
    across /= np.linalg.norm(across)
    return np.stack([across, axis, np.cross(across, axis)])


def _in_view(setting: Setting, rig: Rig) -> bool:
    """Whether every object is inside both pictures and at most a third of it hidden (seen coarsely)."""
    if rig.image_size is None:
        raise ValueError("rig must know its image_size")
    width, height = rig.image_size
    for primitive in setting.objects:
        body = body_of(primitive)
        middle = body.place(np.array([0.0, body.height / 2, 0.0]))
        for aside, doffs in ((0.0, 0.0), (rig.baseline_m, rig.doffs_px)):
            u = rig.focal_px[0] * (middle[0] - aside) / middle[2] + rig.center_px[0] + doffs
            v = rig.focal_px[1] * middle[1] / middle[2] + rig.center_px[1]
            margin = max(rig.focal_px) * body.reach / middle[2]
            if not (margin <= u < width - margin and margin <= v < height - margin):
                return False
    coarse = rig.scaled(80 / width)
    assert coarse.image_size is not None
    across = (np.arange(coarse.image_size[0]) - coarse.center_px[0]) / coarse.focal_px[0]
    down = (np.arange(coarse.image_size[1]) - coarse.center_px[1]) / coarse.focal_px[1]
    rays = np.stack([*np.meshgrid(across, down), np.ones((len(down), len(across)))], axis=-1).astype(np.float32)
    eye = np.zeros(3)
    together = look(setting, rays, eye, 0.0, WALL_M, 0)[1]
    for index, primitive in enumerate(setting.objects):
        alone = look(Setting((primitive,), setting.ground), rays, eye, 0.0, WALL_M, 0)[1]
        if (together == index).sum() < 2 / 3 * (alone == 0).sum():
            return False
    return True


def _window(body: Body, rays: np.ndarray, eye: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns whose rays can hit a body (rays are those of a grid, monotone along rows and columns)."""
    middle = body.place(np.array([0.0, body.height / 2, 0.0])) - eye
    near = max(middle[2] - body.reach, 1e-3)
    slices = []
    for axis, line in ((1, rays[:, 0, 1]), (0, rays[0, :, 0])):
        ends = [(middle[axis] + side * body.reach) / z for side in (-1, 1) for z in (near, middle[2] + body.reach)]
        slices.append(slice(*np.searchsorted(line, [min(ends), max(ends)])))
    return slices[0], slices[1]


def _visible(depth: np.ndarray, disparity: np.ndarray, right_depth: np.ndarray, down: int) -> np.ndarray:
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        columns = np.rint(np.arange(width) - np.where(np.isfinite(disparity), disparity, width)).astype(int)
    rows = np.arange(height)[:, None] + down
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    other = right_depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    with np.errstate(invalid="ignore"):
        return inside & (np.abs(other - depth) < 0.01 * depth)


def _shade(places: np.ndarray) -> np.ndarray:
    """Brightness under a distant lamp, from the surface normal by differences of neighboring points."""
    across, down = np.gradient(places, axis=1), np.gradient(places, axis=0)
    normal = np.cross(down, across)
    length = np.linalg.norm(normal, axis=-1)
    return (0.75 + 0.25 * (normal @ LIGHT.astype(np.float32)) / np.maximum(length, 1e-12)).astype(np.float32)


def _texture(places: np.ndarray, salt: np.ndarray, seed: int) -> np.ndarray:
    """Value noise in 0..1 of points (N, 3): smooth interpolation of random values on cubic lattices of several sizes."""
    table = np.random.default_rng([seed, 3]).random(4096, np.float32)
    salt = (salt.astype(np.int32) + 7) * np.int32(668265263)
    total = np.zeros(len(places), np.float32)
    for cell, weight in TEXTURE_CELLS_M:
        scaled = places / np.float32(cell)
        corner = np.floor(scaled)
        part = scaled - corner
        smooth = part * part * (3 - 2 * part)
        hashed = corner.astype(np.int32) * np.array([73856093, 19349663, 83492791], np.int32)
        steps = [
            (hashed[:, i], hashed[:, i] + np.int32(prime)) for i, prime in enumerate((73856093, 19349663, 83492791))
        ]
        layers = []
        for z in steps[2]:
            lines = []
            for y in steps[1]:
                yz = y ^ z ^ salt
                a, b = (table[((x ^ yz) * np.int32(374761393) >> 20) & 4095] for x in steps[0])
                lines.append(a + smooth[:, 0] * (b - a))
            layers.append(lines[0] + smooth[:, 1] * (lines[1] - lines[0]))
        total += np.float32(weight) * (layers[0] + smooth[:, 2] * (layers[1] - layers[0]))
    return total
