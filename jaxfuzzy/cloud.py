"""The point cloud: record, files, supporting plane and upright frame."""

from jaxfuzzy.arrays import Array, Float, Int, record


@record
class Cloud:
    """A point cloud in the left camera's frame (x right, y down, z forward), in metres.

    Attributes:
        points: The points.
        colors: Red, green, blue in 0..1.
        depth_std: Standard deviation of each point's depth.
        pixels_px: Column and row of each point in the left image.
        status: Reasons to read it with care; see `describe`.
    """

    points: Float[Array, "N 3"]
    colors: Float[Array, "N 3"] | None = None
    depth_std: Float[Array, " N"] | None = None
    pixels_px: Float[Array, "N 2"] | None = None
    status: Int[Array, ""] | int = 0
