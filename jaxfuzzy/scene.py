"""The pipeline: stereo pair -> cloud -> upright frame -> objects -> shapes. Read this module first."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Float, Int, all_on_device, on_device, record, static
from jaxfuzzy.cloud import Cloud, check_cloud
from jaxfuzzy.flecks import in_flecks
from jaxfuzzy.ground import fit_ground, foreground
from jaxfuzzy.looks import compiling_ahead
from jaxfuzzy.matcher import Matcher, chosen
from jaxfuzzy.naming import Seen, named
from jaxfuzzy.objects import OF_SCENE, PIXELS_PER_POINT
from jaxfuzzy.photos import read_pair, rectify
from jaxfuzzy.primitives import Plane
from jaxfuzzy.reproject import cloud_from_depth, cloud_from_disparity
from jaxfuzzy.rig import Rig
from jaxfuzzy.segment import Segmentation, candidates_of, segment
from jaxfuzzy.shapes import Shape, distance_of, kinds_of
from jaxfuzzy.stereo import reconstruct

# Noise distance in standard deviations of a point along its viewing ray: farther points rather belong to noise.
NOISE_SIGMAS = 2.5
# The camera's own idea of the vertical, until a supporting plane tells better (OpenCV's y points down).
CAMERA_UP = (0.0, -1.0, 0.0)
# Where points were seen from, unless something else is said.
EYE = (0.0, 0.0, 0.0)
# How far in radians a supporting plane may lean from a vertical that was given.
KNOWN_TILT = 0.15
FEWEST_POINTS = 50
# A group that rises above the ground by no more than this share of the highest one's height is part of the ground.
FLAT = 0.05
# Without such groups the rest is divided anew, and may have such groups again; so many times.
MOST_SWEPT = 3
SEGMENT_OPTIONS = ("ks",)
SHAPE_OPTIONS = ("kinds", "distance")
# One word for both choices: how objects are counted, and how shapes are named.
RULES: dict[str, tuple[Any, Any]] = {
    "robust": ("robust", "likelihood"),
    "likelihood": ("robust", "likelihood"),
    "gric": ("robust", "gric"),
    "paper": ("paper", "paper"),
}

Progress = Callable[[str, float], None]


@record
class Scene:
    """A modelled scene, everything in the camera's frame.

    Attributes:
        cloud: The points.
        up: The vertical direction, a unit vector that points up: the one given, or the supporting plane's normal refined on the
            objects (see `vertical`).
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

    def to_dict(self) -> dict[str, Any]:
        """The scene in plain Python, as `scene.json` holds it."""
        from jaxfuzzy import report

        return report.to_dict(self)

    def save(self, folder: str | Path) -> tuple[str, ...]:
        """Writes the scene into a folder, all or nothing: data, cloud and models, and the report where it can be drawn.

        Returns:
            The files written, relative to the folder.

        Raises:
            OSError: The folder cannot be written.
        """
        from jaxfuzzy import report

        return report.save(self, folder)


def model_scene(
    left: Any,
    right: Any,
    rig: Rig,
    *,
    matcher: Matcher | None = None,
    disparity_px: Any = None,
    depth_m: Any = None,
    depth_std: Any = None,
    progress: Progress | None = None,
    **options: Any,
) -> Scene:
    """Models what a stereo pair shows: points, supporting plane, objects, and a primitive for each.

    Args:
        left: The left image: a path, or a uint8 array, grey (H, W) or BGR (H, W, 3) as `cv2.imread` gives it.
        right: The right image, of the same size. It may be None where disparities or depths are given.
        rig: The cameras; of a depth camera only focal length and center matter (`load_rig(..., arbitrary_units=True)`).
        matcher: How to match.
        disparity_px: Disparities (H, W) of the left image from any other matcher, in pixels, not finite or not above 0 where
            unknown (see `read_disparity`); rectified images are then not matched, and of `matcher` the error of a disparity counts.
        depth_m: Depths (H, W) in metres along the optical axis of the left image instead, as a depth camera gives them (see
            `read_depth`).
        depth_std: Their standard deviation, one number or one a pixel (H, W); None takes the rig's stereo error, or what the
            scene shows where the rig has no baseline.
        progress: Called with the name of each stage as it begins and the share of the work done, 0 to 1.
        **options: Those of `model_cloud`.

    Returns:
        The scene, in the frame of the (rectified) left camera.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image or an option cannot be used, or sizes disagree; both disparities and depths are given.
        DataError: Fewer than 50 pixels were matched, or fewer than 50 points stand above the ground.
    """
    options = _checked(options)
    if disparity_px is not None and depth_m is not None:
        raise ValueError("disparity_px and depth_m must not both be given")
    if depth_std is not None and depth_m is None:
        raise ValueError("depth_std must come with depth_m")
    ready = disparity_px is not None or depth_m is not None
    clock = _Clock(progress)
    with clock.stage("matching"):
        image, image_right = read_pair(left, left if ready and right is None else right, rig)
        if not ready and not rig.rectified:
            image, image_right, rig = rectify(image, image_right, rig)
        if depth_m is not None:
            cloud = cloud_from_depth(depth_m, None, rig, image=image, depth_std=depth_std)
        elif disparity_px is not None:
            std_px = chosen(matcher).disparity_std_px
            cloud = cloud_from_disparity(disparity_px, None, rig, image=image, disparity_std_px=std_px)
        else:
            cloud = reconstruct(image, image_right, rig, matcher=matcher)
    scene = _model(cloud, clock, **options)
    pictures: dict[str, Any] = {"image": _as_rgb(image), "image_right": None if right is None else _as_rgb(image_right)}
    return dataclasses.replace(scene, **pictures, rig=rig)


def model_cloud(cloud: Cloud, *, progress: Progress | None = None, **options: Any) -> Scene:
    """Models a point cloud: supporting plane, objects, and a primitive for each.

    Args:
        cloud: The points, in metres.
        progress: Called with the name of each stage as it begins and the share of the work done, 0 to 1.
        **options: `up`: the vertical direction (3,), either sign, or "auto" to take it from the supporting plane, which may then
            lean by up to 50 degrees from the camera's y axis: clouds in a frame with z up need (0, 0, 1). From a given direction
            it may lean by 8.6 degrees.
            `ground`: "auto" to look for a supporting plane and to leave out what belongs to it; None where the cloud has none,
            which needs `up`. `camera`: where the points were seen from (3,), the origin by default; None where not known.
            `ks`: numbers of objects allowed, as in `segment`. `kinds`, `distance`, `noise_distance`, `weights`: as in `fit_shape`.
            Covariances, scores and margins of clouds with `pixels_px` allow for neighboring pixels that err alike.
            `rule`: "robust" (the default, for objects; "likelihood" is the same), "gric", or "paper" for the paper's own rules
            throughout.

    Returns:
        The scene, in the frame of the cloud.

    Raises:
        ValueError: An option cannot be used.
        TypeError: An unknown option.
        DataError: Fewer than 50 points stand above the ground.
    """
    return _model(cloud, _Clock(progress), **_checked(options))


def _checked(options: dict[str, Any]) -> dict[str, Any]:
    """The options, all checked before the work begins that can be without knowing the points."""
    known = ("up", "ground", "camera", "rule", "noise_distance", "weights", *SEGMENT_OPTIONS, *SHAPE_OPTIONS)
    for name in options:
        if name not in known:
            raise TypeError(f"unknown option {name!r}: allowed are {', '.join(known)}")
    rule, camera = options.get("rule", "robust"), options.get("camera", EYE)
    checks.choice(rule, "rule", tuple(RULES))
    ground, up = options.get("ground", "auto"), options.get("up", "auto")
    if ground is not None:
        checks.choice(ground, "ground", ("auto",))
    elif isinstance(up, str):
        raise ValueError("up must be given as (x, y, z) where ground=None: there is no plane to take it from")
    if isinstance(up, str):
        checks.choice(up, "up", ("auto",))
    else:
        checks.direction(up, "up")
    division, naming = RULES[rule]
    distance_of(options.get("distance"), naming, camera)
    if np.ndim(options.get("noise_distance", "auto")) == 0:
        checks.noise_distance_or_auto(options.get("noise_distance", "auto"))
    several: dict[str, Any] = {}
    if "kinds" in options:
        several["kinds"] = kinds_of(options["kinds"])
    if "ks" in options:
        numbers = candidates_of(options["ks"], division)
        several["ks"] = options["ks"] if isinstance(options["ks"], str) else numbers
    return options | several


def _model(
    cloud: Cloud,
    clock: "_Clock",
    *,
    up: Any = "auto",
    ground: str | None = "auto",
    camera: Any = EYE,
    rule: str = "robust",
    noise_distance: Any = "auto",
    weights: Any = None,
    **options: Any,
) -> Scene:
    # Picked from on the host: each number of points picked in JAX would compile and keep a program of its own.
    points = check_cloud(cloud)
    count = points.shape[0]
    heaviness = checks.weights(weights, count)
    checks.noise_distance_or_auto(noise_distance, count)
    division, naming = RULES[rule]
    seen = Seen(
        points=points,
        pixels=None if cloud.pixels_px is None or rule == "paper" else np.asarray(cloud.pixels_px),
        noise_distance=noise_distance,
        weights=None if heaviness is None else np.asarray(heaviness),
        camera=None if camera is None else np.asarray(camera),
        up=np.asarray(CAMERA_UP) if isinstance(up, str) else checks.direction(up, "up"),
        up_given=not isinstance(up, str),
        ground=None,
        flat=np.zeros(count, bool),
        thickness=0.0,
    )
    along_ray = camera is not None and options.get("distance", "ray") == "ray"
    with compiling_ahead(OF_SCENE, points.dtype, along_ray):
        with clock.stage("ground"):
            seen, kept = _above_ground(seen, cloud.depth_std, look=ground is not None)
        with clock.stage("objects"):
            how = {name: options[name] for name in SEGMENT_OPTIONS if name in options}
            own, parts = _divided(seen, np.flatnonzero(kept), rule=division, **how)
    with clock.stage("shapes"):
        how = {name: options[name] for name in SHAPE_OPTIONS if name in options}
        regroup = division == "robust" and "ks" not in options
        parts, shapes, vertical = named(seen, own, parts, naming, regroup, **how)
    settings = {
        "up": up,
        "ground": ground,
        "camera": camera,
        "rule": rule,
        "noise_distance": _told(seen.noise_distance),
    }
    status = int(cloud.status) | int(parts.status) | (0 if seen.ground is None else int(seen.ground.status))
    return Scene(
        cloud=cloud,
        up=on_device(vertical, points.dtype),
        ground=None if seen.ground is None else seen.ground.plane,
        segmentation=_of_all(parts, own, count),
        shapes=all_on_device(shapes),
        timings=clock.seconds,
        settings={name: _plain(value) for name, value in (settings | options).items()},
        status=on_device(status, np.int32),
    )


def _above_ground(seen: Seen, depth_std: Any, *, look: bool) -> tuple[Seen, np.ndarray]:
    """What the supporting plane tells: the vertical, the noise, and which points (N,) stand on it.

    Args:
        seen: The cloud.
        depth_std: Standard deviation of each point along its ray (N,); None where not known.
        look: Whether there is such a plane to look for.
    """
    kept = np.ones(len(seen.points), bool) if seen.weights is None else seen.weights > 0
    if look:
        known_up = {"max_tilt": KNOWN_TILT} if seen.up_given else {}
        which: dict[str, Any] = {"up": seen.up, "weights": seen.weights, "camera": seen.camera}
        found = fit_ground(seen.points, depth_std=depth_std, **which, **known_up)
        standing = foreground(seen.points, found, **which)
        kept &= np.asarray(standing.mask)
        depth_std = found.depth_std
        seen = seen._replace(ground=found, flat=np.asarray(standing.ground), thickness=float(standing.cut))
        if found.plane is not None:
            seen = seen._replace(up=np.asarray(found.plane.normal))
    if isinstance(seen.noise_distance, str) and depth_std is not None:
        seen = seen._replace(noise_distance=NOISE_SIGMAS * np.asarray(depth_std))
    if seen.pixels is not None:
        kept &= ~in_flecks(seen.pixels, kept, PIXELS_PER_POINT)
    return seen, kept


def _divided(seen: Seen, own: np.ndarray, **how: Any) -> tuple[np.ndarray, Segmentation]:
    """The points that stand above the ground, by their indices, and their division; without groups that are none."""
    # Of pixels, of which neighbours err alike, so many tell as much as one independent point.
    smallest = 1 if seen.pixels is None else PIXELS_PER_POINT
    if len(own) < FEWEST_POINTS:
        raise checks.DataError(
            f"only {len(own)} of {len(seen.points)} points stand above the ground, {FEWEST_POINTS} are needed"
        )
    parts = segment(seen.points[own], **seen.of(own), **how)
    plane = None if seen.ground is None else seen.ground.plane
    for _ in range(MOST_SWEPT):
        kept = _standing(seen.points[own], np.asarray(parts.labels), plane, smallest)
        if kept.all() or kept.sum() < FEWEST_POINTS:
            break
        own = own[kept]
        parts = segment(seen.points[own], **seen.of(own), **how)
    return own, parts


def load_scene(folder: str | Path) -> Scene:
    """Reads back what `Scene.save` wrote.

    Raises:
        FileNotFoundError: There is no such folder or no scene in it.
        ValueError: The files are damaged or of another version.
    """
    from jaxfuzzy import report

    return report.load(folder)


def _standing(points: np.ndarray, labels: np.ndarray, ground: Plane | None, smallest: int) -> np.ndarray:
    """Which points belong to no group that lies flat on the ground or has fewer points than say anything.

    Matching errs by more than its noise over wide smooth surfaces, so patches of the table may float above their own noise. What
    nowhere rises above the ground by more than a share of the highest object's height is such a patch, not an object. So is what
    has less than one independent point: a speck left of a wall.
    """
    groups = [labels == k for k in range(int(labels.max(initial=-1)) + 1)]
    gone = np.array([own.sum() < smallest for own in groups], bool)
    if ground is not None:
        height = (points - np.asarray(ground.point)) @ np.asarray(ground.normal)
        rises = np.array([np.quantile(height[own], 0.95) for own in groups])
        gone |= rises < FLAT * rises.max(initial=0.0)
    return ~np.isin(labels, np.flatnonzero(gone))


def _of_all(parts: Segmentation, own: np.ndarray, count: int) -> Segmentation:
    """A division of some points as one of all: the others belong to noise alone."""

    def filled(filler: float, values: Array) -> Array:
        whole = np.full((count, *values.shape[1:]), filler, values.dtype)
        whole[own] = np.asarray(values)
        return jax.device_put(whole)

    partition, labels = parts.partition, filled(-1, parts.labels)
    whole = dataclasses.replace(
        partition, memberships=filled(0, partition.memberships), noise=filled(1, partition.noise), labels=labels
    )
    return dataclasses.replace(parts, labels=labels, partition=whole)


def _told(noise_distance: Any) -> Any:
    """A noise distance as the settings tell it: the median where every point has its own."""
    return noise_distance if np.ndim(noise_distance) == 0 else float(np.median(np.asarray(noise_distance)))


def _plain(value: Any) -> Any:
    """A setting in plain Python."""
    return np.asarray(value).tolist() if hasattr(value, "shape") else value


def _as_rgb(image: np.ndarray) -> Array:
    return on_device(image[..., ::-1] if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2))


class _Clock:
    """Times the stages and tells how far the work has come."""

    # Shares of the work done before each stage, as measured on the bundled pair.
    begins: dict[str, float] = {"matching": 0.0, "ground": 0.12, "objects": 0.25, "shapes": 0.35}  # noqa: RUF012

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        if self.progress is not None:
            self.progress(name, self.begins[name])
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin
