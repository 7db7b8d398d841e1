"""The primitives a scene is made of: plane, box, cylinder, cone, sphere, quadric; in metres.

Each has `distance(points)`, the unsigned distance to its bounded surface; `mesh()`; `parameters()`, the smallest set of
numbers that fixes the surface, in the order of its covariance; and `to_dict()`, undone by `primitive_from_dict`.

Directions are given by two angles in radians, as in physics: polar, from the z axis, and azimuth, from x towards y.
They are smooth at both verticals of a camera's frame, where most axes point, and singular only along its line of sight.
"""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks, meshes
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, as_float, on_device, record
from jaxfuzzy.linalg import divide, norm, normalised, tangents

Vertices = Float[Array, "V 3"]
Faces = Int[Array, "F 3"]


class _Body:
    """What all primitives share: a name for the kind and a form in plain Python."""

    kind: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]

    def to_dict(self) -> dict[str, Any]:
        """The kind and every field as plain numbers and lists, ready for JSON."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        return {"kind": self.kind} | {k: None if v is None else np.asarray(v).tolist() for k, v in fields.items()}


@record
class Plane(_Body):
    """A flat patch.

    Its parameters are the foot of the perpendicular from the origin: normal times offset. No sign is left open; the
    tilt is lost only by a plane through the origin itself.

    Attributes:
        point: A point on it.
        normal: Unit normal.
        corners: The corners of the patch that was seen, in order around it.
    """

    point: Float[Array, "3"]
    normal: Float[Array, "3"]
    corners: Float[Array, "4 3"]

    kind: ClassVar[str] = "plane"
    parameter_names: ClassVar[tuple[str, ...]] = ("foot_x", "foot_y", "foot_z")

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the patch, which ends at its corners (they are taken as convex)."""
        p, corners, normal = as_float(points), as_float(self.corners), as_float(self.normal)
        edges = jnp.roll(corners, -1, axis=0) - corners
        from_corner = p[:, None] - corners
        side = jnp.sum(jnp.cross(normal, edges) * from_corner, -1)
        within = (side >= 0).all(1) | (side <= 0).all(1)
        along = divide(jnp.sum(from_corner * edges, -1), jnp.sum(edges**2, -1))
        to_edges = norm(from_corner - jnp.clip(along, 0.0, 1.0)[..., None] * edges)
        return jnp.where(within, jnp.abs((p - as_float(self.point)) @ normal), to_edges.min(1))

    def mesh(self) -> tuple[Vertices, Faces]:
        """Two triangles, facing along the normal."""
        corners = np.asarray(self.corners)
        turn = np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ np.asarray(self.normal)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        return jnp.asarray(corners), jnp.asarray(faces if turn >= 0 else faces[:, ::-1])

    def parameters(self) -> Float[Array, "3"]:
        """The foot of the perpendicular from the origin."""
        normal = as_float(self.normal)
        return normal * jnp.dot(normal, as_float(self.point))


@record
class Box(_Body):
    """An oriented box.

    Its parameters are center, size and the rotation vector that turns x, y, z into the rows of `axes`.

    Attributes:
        center: Its center.
        size: Full edge lengths along the rows of `axes`.
        axes: Unit vectors, one a row.
        seen: Whether each edge was seen to its end; where False its length is a lower bound. `model_cloud` tells, which knows
            what stands before it; elsewhere nothing is known to hide it, which is the default for a single box.
    """

    center: Float[Array, "3"]
    size: Float[Array, "3"]
    axes: Float[Array, "3 3"]
    seen: Bool[Array, "3"] = dataclasses.field(default_factory=lambda: on_device(np.ones(3, bool)))

    kind: ClassVar[str] = "box"
    parameter_names: ClassVar[tuple[str, ...]] = (
        *("center_x", "center_y", "center_z", "size_1", "size_2", "size_3"),
        *("rotation_x", "rotation_y", "rotation_z"),
    )

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the box's closed surface, from outside or inside."""
        local = (as_float(points) - as_float(self.center)) @ as_float(self.axes).T
        return _to_walls(jnp.abs(local) - as_float(self.size) / 2)

    def mesh(self) -> tuple[Vertices, Faces]:
        """Eight corners, twelve triangles."""
        return _as_jax(meshes.box(np.asarray(self.center), np.asarray(self.size), np.asarray(self.axes)))

    def parameters(self) -> Float[Array, "9"]:
        """Center, size, rotation vector."""
        return jnp.concatenate([as_float(self.center), as_float(self.size), _rotation_vector(as_float(self.axes))])


@record
class Cylinder(_Body):
    """A circular cylinder, closed at both ends.

    Its parameters are those of the endless surface: the axis' polar angle and azimuth, the axis' foot (its point
    nearest to the origin) along the directions in which these two angles grow, and the radius.

    Attributes:
        base: Center of the lower end.
        axis: Unit vector from the base into the body.
        radius: Radius.
        height: Length along the axis.
    """

    base: Float[Array, "3"]
    axis: Float[Array, "3"]
    radius: Float[Array, ""]
    height: Float[Array, ""]

    kind: ClassVar[str] = "cylinder"
    parameter_names: ClassVar[tuple[str, ...]] = ("axis_polar", "axis_azimuth", "foot_polar", "foot_azimuth", "radius")

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the closed surface, side and both lids."""
        across, along = _cylindrical(points, self.base, self.axis)
        half = as_float(self.height) / 2
        return _to_walls(jnp.stack([across - as_float(self.radius), jnp.abs(along - half) - half], -1))

    def mesh(self, segments: int = 48) -> tuple[Vertices, Faces]:
        """Side and both lids, with `segments` sides."""
        checks.integer(segments, "segments", at_least=3)
        profile = np.array([[self.radius, 0.0], [self.radius, self.height]], float)
        return _as_jax(meshes.revolved(np.asarray(self.base), _frame(self.axis), profile, segments))

    def parameters(self) -> Float[Array, "5"]:
        """Angles of the axis, foot of the axis, radius."""
        axis, base = as_float(self.axis), as_float(self.base)
        angles = _angles(axis)
        return jnp.concatenate([angles, _angle_directions(angles) @ base, as_float(self.radius)[None]])


@record
class Cone(_Body):
    """A circular cone, or a frustum of one, closed at both ends; the apex may be up or down.

    Its parameters are those of the endless surface: apex, the axis' polar angle and azimuth, half-angle.

    Attributes:
        apex: The tip (of the cone that a frustum is cut from).
        axis: Unit vector from the apex into the body.
        half_angle: Angle between axis and side.
        height: From and to, along the axis from the apex.
    """

    apex: Float[Array, "3"]
    axis: Float[Array, "3"]
    half_angle: Float[Array, ""]
    height: Float[Array, "2"]

    kind: ClassVar[str] = "cone"
    parameter_names: ClassVar[tuple[str, ...]] = (
        *("apex_x", "apex_y", "apex_z", "axis_polar", "axis_azimuth", "half_angle"),
    )

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the closed surface, side and both ends."""
        across, along = _cylindrical(points, self.apex, self.axis)
        place = jnp.stack([across, along], -1)
        low, high = as_float(self.height)[0], as_float(self.height)[1]
        slope = jnp.tan(as_float(self.half_angle))
        zero = jnp.zeros_like(low)
        profile = jnp.stack(
            [jnp.stack(p) for p in ((zero, low), (low * slope, low), (high * slope, high), (zero, high))]
        )
        edge = profile[1:] - profile[:-1]
        from_start = place[:, None] - profile[:-1]
        along_edge = jnp.clip(divide(jnp.sum(from_start * edge, -1), jnp.sum(edge**2, -1)), 0.0, 1.0)
        return norm(from_start - along_edge[..., None] * edge).min(-1)

    def mesh(self, segments: int = 48) -> tuple[Vertices, Faces]:
        """Side and ends, with `segments` sides; the tip is a single vertex."""
        checks.integer(segments, "segments", at_least=3)
        height = np.asarray(self.height, float)
        profile = np.stack([height * np.tan(float(self.half_angle)), height], 1)
        return _as_jax(meshes.revolved(np.asarray(self.apex), _frame(self.axis), profile, segments))

    def parameters(self) -> Float[Array, "6"]:
        """Apex, angles of the axis, half-angle."""
        return jnp.concatenate([as_float(self.apex), _angles(as_float(self.axis)), as_float(self.half_angle)[None]])


@record
class Sphere(_Body):
    """A sphere. Its parameters are center and radius.

    Attributes:
        center: Its center.
        radius: Radius.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]

    kind: ClassVar[str] = "sphere"
    parameter_names: ClassVar[tuple[str, ...]] = ("center_x", "center_y", "center_z", "radius")

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the whole sphere."""
        return jnp.abs(norm(as_float(points) - as_float(self.center)) - as_float(self.radius))

    def mesh(self, segments: int = 48) -> tuple[Vertices, Faces]:
        """Rings of `segments` sides between two poles along y."""
        checks.integer(segments, "segments", at_least=3)
        angle = np.linspace(0, np.pi, segments // 2 + 1)
        profile = float(self.radius) * np.stack([np.sin(angle), -np.cos(angle)], 1)
        profile[[0, -1], 0] = 0.0
        return _as_jax(meshes.revolved(np.asarray(self.center), _frame(np.array([0.0, 1.0, 0.0])), profile, segments))

    def parameters(self) -> Float[Array, "4"]:
        """Center, radius."""
        return jnp.concatenate([as_float(self.center), as_float(self.radius)[None]])


@record
class Quadric(_Body):
    """A general quadric: the surface where its polynomial vanishes.

    Its parameters are the ten coefficients scaled to length one, the largest positive; one of them is thus redundant.

    Attributes:
        coefficients: Of x², y², z², xy, yz, zx, x, y, z, 1.
        bounds: Lowest and highest coordinates of what was seen of it; needed to draw it, not to measure from it.
    """

    coefficients: Float[Array, "10"]
    bounds: Float[Array, "2 3"] | None = None

    kind: ClassVar[str] = "quadric"
    parameter_names: ClassVar[tuple[str, ...]] = ("xx", "yy", "zz", "xy", "yz", "zx", "x", "y", "z", "1")

    def value(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """The polynomial at each point; its sign tells the two sides of the surface apart."""
        p, matrix = as_float(points), self.matrix()
        return jnp.sum((p @ matrix[:3, :3] + 2 * matrix[:3, 3]) * p, -1) + matrix[3, 3]

    def matrix(self) -> Float[Array, "4 4"]:
        """The symmetric matrix whose quadratic form at (x, y, z, 1) is the polynomial."""
        a, b, c, ab, bc, ca, x, y, z, one = as_float(self.coefficients)
        rows = (
            (a, ab / 2, ca / 2, x / 2),
            (ab / 2, b, bc / 2, y / 2),
            (ca / 2, bc / 2, c, z / 2),
            (x / 2, y / 2, z / 2, one),
        )
        return jnp.stack([jnp.stack(row) for row in rows])

    def distance(self, points: Float[ArrayLike, "N 3"]) -> Float[Array, " N"]:
        """Distance in metres to the endless surface, to first order: |f| / |∇f| (Taubin, PAMI 13, 1991)."""
        p, matrix = as_float(points), self.matrix()
        return divide(jnp.abs(self.value(p)), norm(2 * (p @ matrix[:3, :3] + matrix[:3, 3])))

    def mesh(self, cells: int = 40) -> tuple[Vertices, Faces]:
        """The part inside `bounds`, wound towards positive values of the polynomial.

        Raises:
            ValueError: if the quadric carries no bounds.
        """
        checks.integer(cells, "cells", at_least=1)
        if self.bounds is None:
            raise ValueError("bounds must be given to draw a quadric, got None")
        matrix = np.asarray(self.matrix(), float)

        def value(p: np.ndarray) -> np.ndarray:
            return np.sum((p @ matrix[:3, :3] + 2 * matrix[:3, 3]) * p, -1) + matrix[3, 3]

        return _as_jax(meshes.implicit(value, np.asarray(self.bounds, float), cells))

    def parameters(self) -> Float[Array, "10"]:
        """The coefficients scaled to length one, the largest positive."""
        unit = normalised(as_float(self.coefficients))
        return unit * jnp.where(unit[jnp.argmax(jnp.abs(unit))] < 0, -1.0, 1.0)


Primitive = Plane | Box | Cylinder | Cone | Sphere | Quadric
PRIMITIVES: dict[str, type[Primitive]] = {c.kind: c for c in (Plane, Box, Cylinder, Cone, Sphere, Quadric)}
# Kinds to choose from: a quadric is what is none of them.
KINDS = tuple(kind for kind in PRIMITIVES if kind != "quadric")
_SHAPES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("point", "normal", "center", "size", "seen", "base", "axis", "apex"), (3,)),
    **dict.fromkeys(("radius", "half_angle"), ()),
    **{"corners": (4, 3), "axes": (3, 3), "coefficients": (10,), "bounds": (2, 3)},
}


def primitive_from_dict(data: dict[str, Any]) -> Primitive:
    """Undoes `to_dict`.

    Args:
        data: The kind and its fields.

    Raises:
        ValueError: if the kind is unknown, or a field is missing, unknown or of the wrong shape.
    """
    cls = PRIMITIVES[checks.choice(data.get("kind"), "kind", tuple(PRIMITIVES))]
    fields = dataclasses.fields(cls)
    given = {k: v for k, v in data.items() if k != "kind" and v is not None}
    needed = {f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING}
    if not needed <= set(given) <= {f.name for f in fields}:
        raise ValueError(
            f"a {cls.kind} must have the fields {', '.join(f.name for f in fields)}, got {', '.join(given)}"
        )
    values = {}
    for name, value in given.items():
        array = np.asarray(value)
        shape = ((2,) if cls is Cone else ()) if name == "height" else _SHAPES[name]
        if array.shape != shape or array.dtype.kind not in "fiub":
            raise ValueError(
                f"{name} of a {cls.kind} must be numbers of shape {shape}, got {array.dtype} {array.shape}"
            )
        values[name] = jnp.asarray(array.astype(bool)) if name == "seen" else as_float(array)
    return cls(**values)


def transform(primitive: Primitive, rotation: Float[ArrayLike, "3 3"], origin: Float[ArrayLike, "3"]) -> Primitive:
    """Moves a primitive rigidly, as p ↦ rotation p + origin moves its points.

    Args:
        primitive: What to move.
        rotation: Rotation matrix. A frame reached by p ↦ rotation (p − origin), such as the upright one, is left again
            by `transform(primitive, rotation.T, origin)`.
        origin: Where the origin goes, in metres.
    """
    turn, shift = as_float(rotation), as_float(origin)

    def place(points: Array) -> Array:
        return as_float(points) @ turn.T + shift

    def aim(directions: Array) -> Array:
        return as_float(directions) @ turn.T

    match primitive:
        case Plane(point, normal, corners):
            return Plane(place(point), aim(normal), place(corners))
        case Box(center, size, axes, seen):
            return Box(place(center), size, aim(axes), seen)
        case Cylinder(base, axis, radius, height):
            return Cylinder(place(base), aim(axis), radius, height)
        case Cone(apex, axis, half_angle, height):
            return Cone(place(apex), aim(axis), half_angle, height)
        case Sphere(center, radius):
            return Sphere(place(center), radius)
        case Quadric(_, bounds):
            back = jnp.eye(4, dtype=turn.dtype).at[:3, :3].set(turn.T).at[:3, 3].set(-turn.T @ shift)
            q = back.T @ primitive.matrix() @ back
            quadratic = [q[0, 0], q[1, 1], q[2, 2], 2 * q[0, 1], 2 * q[1, 2], 2 * q[2, 0]]
            coefficients = jnp.stack([*quadratic, *(2 * q[:3, 3]), q[3, 3]])
            if bounds is None:
                return Quadric(coefficients)
            corners = place(as_float(bounds)[meshes.CUBE_CORNERS, jnp.arange(3)])
            return Quadric(coefficients, jnp.stack([corners.min(0), corners.max(0)]))
    raise TypeError(f"primitive must be one of {', '.join(PRIMITIVES)}, got {type(primitive).__name__}")


def _to_walls(beyond: Array) -> Array:
    """Distance to the surface of a box-like body from how far a point lies beyond each pair of its walls (..., D)."""
    outside = norm(jnp.maximum(beyond, 0.0))
    return outside + jnp.maximum(-beyond.max(-1), 0.0)


def _cylindrical(points: ArrayLike, origin: Array, axis: Array) -> tuple[Array, Array]:
    """Distance from an axis and height along it."""
    local = as_float(points) - as_float(origin)
    along = local @ as_float(axis)
    return norm(local - along[:, None] * as_float(axis)), along


def _frame(axis: Any) -> np.ndarray:
    axis = np.asarray(axis, float)
    return np.vstack([np.asarray(tangents(jnp.asarray(axis))), axis])


def _as_jax(mesh: meshes.Mesh) -> tuple[Vertices, Faces]:
    return jnp.asarray(mesh[0], jnp.result_type(float)), jnp.asarray(mesh[1])


def _angles(axis: Array) -> Array:
    """Polar angle from z and azimuth from x of a unit vector; finite derivatives even along z."""
    across = norm(axis[:2])
    azimuth = jnp.arctan2(axis[1], jnp.where(across == 0, 1.0, axis[0]))
    return jnp.stack([jnp.arctan2(across, axis[2]), azimuth])


def _angle_directions(angles: Array) -> Array:
    """Unit vectors (2, 3) along which polar angle and azimuth grow."""
    polar, azimuth = angles[0], angles[1]
    sin, cos = jnp.sin(azimuth), jnp.cos(azimuth)
    down = jnp.stack([jnp.cos(polar) * cos, jnp.cos(polar) * sin, -jnp.sin(polar)])
    return jnp.stack([down, jnp.stack([-sin, cos, jnp.zeros_like(sin)])])


def _rotation_vector(axes: Array) -> Array:
    """Axis times angle of the rotation that turns x, y, z into these rows, the third reversed in a left-handed set.

    Goes through the quaternion whose largest component is computed first, which is well conditioned at every angle.
    """
    handed = jnp.where(jnp.linalg.det(axes) < 0, -1.0, 1.0)
    matrix = axes.at[2].multiply(handed).T
    trace = jnp.trace(matrix)
    diagonal = jnp.diagonal(matrix)
    skew = jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    from_vector = matrix + matrix.T + (1.0 - trace) * jnp.eye(3, dtype=axes.dtype)
    candidates = jnp.vstack([jnp.append(skew, 1.0 + trace), jnp.column_stack([from_vector, skew])])
    best = candidates[jnp.argmax(jnp.append(trace, diagonal))]
    quaternion = normalised(best) * jnp.where(best[3] < 0, -1.0, 1.0)
    sine = norm(quaternion[:3])
    return quaternion[:3] * divide(2.0 * jnp.arctan2(sine, quaternion[3]), sine, 2.0)
