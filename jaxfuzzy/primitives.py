"""The primitives a scene is made of: plane, box, cylinder, cone, sphere, quadric; in metres."""

from jaxfuzzy.arrays import Array, Bool, Float, record


@record
class Plane:
    """A flat patch.

    Attributes:
        point: A point on it.
        normal: Unit normal.
        corners: The corners of the patch that was seen, in order around it.
    """

    point: Float[Array, "3"]
    normal: Float[Array, "3"]
    corners: Float[Array, "4 3"]


@record
class Box:
    """An oriented box.

    Attributes:
        center: Its center.
        size: Full edge lengths along the rows of `axes`.
        axes: Unit vectors, one a row.
        seen: Whether each edge was seen to its end; where False its length is a lower bound.
    """

    center: Float[Array, "3"]
    size: Float[Array, "3"]
    axes: Float[Array, "3 3"]
    seen: Bool[Array, "3"]


@record
class Cylinder:
    """A circular cylinder.

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


@record
class Cone:
    """A circular cone, or a frustum of one.

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


@record
class Sphere:
    """A sphere.

    Attributes:
        center: Its center.
        radius: Radius.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]


@record
class Quadric:
    """A general quadric: the surface where its polynomial vanishes.

    Attributes:
        coefficients: Of x², y², z², xy, yz, zx, x, y, z, 1.
    """

    coefficients: Float[Array, "10"]


Primitive = Plane | Box | Cylinder | Cone | Sphere | Quadric
