"""The pipeline: stereo pair -> cloud -> upright frame -> objects -> shapes. Read this module first."""

from jaxfuzzy.arrays import Array, Float, Int, record, static
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.primitives import Plane
from jaxfuzzy.rig import Rig
from jaxfuzzy.segment import Segmentation
from jaxfuzzy.shapes import Shape


@record
class Scene:
    """A modelled scene, everything in the camera's frame.

    Attributes:
        cloud: The points.
        up: The vertical direction, a unit vector that points up.
        ground: The supporting plane, if one was found.
        segmentation: The objects; its labels are those of all points of the cloud, -1 for ground, walls and outliers.
        shapes: One shape an object, in the order of the labels 0, 1, ...
        timings: Seconds a stage.
        settings: What the scene was modelled with.
        status: Reasons to read this with care; see `describe`.
        image: The left photograph the points were seen in, rectified, red green blue, uint8; None for a bare cloud.
        image_right: The right one.
        rig: The rectified cameras, in whose left image `cloud.pixels_px` counts.
    """

    cloud: Cloud
    up: Float[Array, "3"]
    ground: Plane | None
    segmentation: Segmentation
    shapes: tuple[Shape, ...]
    timings: dict[str, float]
    settings: dict[str, object]
    status: Int[Array, ""]
    image: Array | None = None
    image_right: Array | None = None
    rig: Rig | None = static(default=None)
