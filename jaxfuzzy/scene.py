"""The pipeline: stereo pair -> cloud -> upright frame -> objects -> shapes. Read this module first."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Float, Int, all_on_device, lengths, on_device, record, static
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.evidence import FEWEST_PIXELS, in_independent_points, told_apart, worth
from jaxfuzzy.flecks import in_flecks, pixels_a_point
from jaxfuzzy.ground import fit_ground, foreground
from jaxfuzzy.groups import by_shapes, by_steps, members_of
from jaxfuzzy.linalg import tangents
from jaxfuzzy.looks import compiling_ahead
from jaxfuzzy.matcher import Matcher, chosen
from jaxfuzzy.objects import OF_SCENE, PIXELS_PER_POINT
from jaxfuzzy.occlusion import with_hidden_ends
from jaxfuzzy.outline import sight_of, without_seen_through
from jaxfuzzy.patches import level_patches
from jaxfuzzy.photos import read_pair, rectify
from jaxfuzzy.pieces import without_pieces
from jaxfuzzy.primitives import Plane
from jaxfuzzy.reproject import cloud_from_disparity
from jaxfuzzy.rig import Rig
from jaxfuzzy.rivals import chosen_by_outline
from jaxfuzzy.segment import Segmentation, segment
from jaxfuzzy.shapes import Fits, Shape, with_quadrics
from jaxfuzzy.steps import between_steps
from jaxfuzzy.stereo import reconstruct
from jaxfuzzy.trials import FEWEST
from jaxfuzzy.vertical import agreed_vertical, upright_again, witness_of

# Noise distance in standard deviations of a point along its viewing ray: farther points rather belong to noise.
NOISE_SIGMAS = 2.5
# The camera's own idea of the vertical, until a supporting plane tells better (OpenCV's y points down).
CAMERA_UP = (0.0, -1.0, 0.0)
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
    progress: Progress | None = None,
    **options: Any,
) -> Scene:
    """Models what a stereo pair shows: points, supporting plane, objects, and a primitive for each.

    Args:
        left: The left image: a path, or a uint8 array, grey (H, W) or BGR (H, W, 3) as `cv2.imread` gives it.
        right: The right image, of the same size.
        rig: The cameras.
        matcher: How to match.
        disparity_px: Disparities (H, W) of the left image from any other matcher, in pixels, not finite or not above 0 where
            unknown (see `read_disparity`); rectified images are then not matched, and of `matcher` the error of a disparity counts.
        progress: Called with the name of each stage as it begins and the share of the work done, 0 to 1.
        **options: Those of `model_cloud`.

    Returns:
        The scene, in the frame of the (rectified) left camera.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image or an option cannot be used, or sizes disagree.
        DataError: Fewer than 50 pixels were matched, or fewer than 50 points stand above the ground.
    """
    _check_options(options)
    clock = _Clock(progress)
    with clock.stage("matching"):
        image, image_right = read_pair(left, right, rig)
        if disparity_px is None and not rig.rectified:
            image, image_right, rig = rectify(image, image_right, rig)
        if disparity_px is None:
            cloud = reconstruct(image, image_right, rig, matcher=matcher)
        else:
            std_px = chosen(matcher).disparity_std_px
            cloud = cloud_from_disparity(disparity_px, None, rig, image=image, disparity_std_px=std_px)
    scene = _model(cloud, clock, **options)
    return dataclasses.replace(scene, image=_as_rgb(image), image_right=_as_rgb(image_right), rig=rig)


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

    Raises:
        ValueError: An option cannot be used.
        TypeError: An unknown option.
        DataError: Fewer than 50 points stand above the ground.
    """
    _check_options(options)
    return _model(cloud, _Clock(progress), **options)


def _check_options(options: dict[str, Any]) -> None:
    known = ("up", "ground", "camera", "rule", "noise_distance", "weights", *SEGMENT_OPTIONS, *SHAPE_OPTIONS)
    for name in options:
        if name not in known:
            raise TypeError(f"unknown option {name!r}: allowed are {', '.join(known)}")
    checks.choice(options.get("rule", "robust"), "rule", RULES)
    ground, up = options.get("ground", "auto"), options.get("up", "auto")
    if ground is not None:
        checks.choice(ground, "ground", ("auto",))
    elif isinstance(up, str):
        raise ValueError("up must be given as (x, y, z) where ground=None: there is no plane to take it from")
    if isinstance(up, str):
        checks.choice(up, "up", ("auto",))
    else:
        checks.direction(up, "up")


def _model(
    cloud: Cloud,
    clock: "_Clock",
    *,
    up: Any = "auto",
    ground: str | None = "auto",
    camera: Any = (0.0, 0.0, 0.0),
    rule: str = "robust",
    noise_distance: Any = "auto",
    weights: Any = None,
    **options: Any,
) -> Scene:
    checks.kind(cloud, "cloud", Cloud, "Cloud(points) makes one, read_cloud reads one")
    # Picked from on the host: each number of points picked in JAX would compile and keep a program of its own.
    points = np.asarray(checks.places(cloud.points, "cloud.points"))
    count = points.shape[0]
    vertical = CAMERA_UP if isinstance(up, str) else checks.direction(up, "up")
    known_up = {} if isinstance(up, str) else {"max_tilt": KNOWN_TILT}
    heaviness = checks.weights(weights, count)
    checks.noise_distance_or_auto(noise_distance, count)
    if cloud.pixels_px is not None and cloud.pixels_px.shape != (count, 2):
        raise ValueError(f"cloud.pixels_px must have shape ({count}, 2), got {cloud.pixels_px.shape}")
    deviation, plane, status = cloud.depth_std, None, int(cloud.status)
    thickness, flat, found = 0.0, np.zeros(count, bool), None
    kept = np.ones(count, bool) if heaviness is None else np.asarray(heaviness) > 0
    # Of pixels, of which neighbours err alike, so many tell as much as one independent point.
    smallest = 1 if cloud.pixels_px is None or rule == "paper" else PIXELS_PER_POINT
    along_ray = camera is not None and options.get("distance", "ray") == "ray"
    with compiling_ahead(OF_SCENE, points.dtype, along_ray):
        with clock.stage("ground"):
            if ground is not None:
                found = fit_ground(
                    points, up=vertical, weights=heaviness, depth_std=cloud.depth_std, camera=camera, **known_up
                )
                standing = foreground(points, found, up=vertical, weights=heaviness, camera=camera)
                kept &= np.asarray(standing.mask)
                thickness, flat = float(standing.cut), np.asarray(standing.ground)
                plane, deviation, status = found.plane, found.depth_std, status | int(found.status)
                vertical = vertical if plane is None else np.asarray(plane.normal)
                if smallest > 1:
                    kept &= ~in_flecks(np.asarray(cloud.pixels_px), kept, smallest)
        if isinstance(noise_distance, str) and deviation is not None:
            noise_distance = NOISE_SIGMAS * np.asarray(deviation)
        segment_rule, shape_rule = RULES[rule]
        own = np.flatnonzero(kept)

        def seen(of: np.ndarray) -> dict[str, Any]:
            """What both stages take beside the points."""
            noise = noise_distance if np.ndim(noise_distance) == 0 else np.asarray(noise_distance)[of]
            own_weights = None if heaviness is None else np.asarray(heaviness)[of]
            return {"up": vertical, "camera": camera, "noise_distance": noise, "weights": own_weights}

        with clock.stage("objects"):
            if len(own) < FEWEST_POINTS:
                raise checks.DataError(
                    f"only {len(own)} of {count} points stand above the ground, {FEWEST_POINTS} are needed"
                )
            picked = {name: options[name] for name in SEGMENT_OPTIONS if name in options}
            parts = segment(points[own], rule=segment_rule, **seen(own), **picked)
            for _ in range(MOST_SWEPT):
                kept_of = _standing(points[own], np.asarray(parts.labels), plane, smallest)
                if kept_of.all() or kept_of.sum() < FEWEST_POINTS:
                    break
                own = own[kept_of]
                parts = segment(points[own], rule=segment_rule, **seen(own), **picked)
    with clock.stage("shapes"):
        picked = {name: options[name] for name in SHAPE_OPTIONS if name in options}
        places, eye = points[own], None if camera is None else np.asarray(camera)
        members = members_of(parts)
        sight = None
        if eye is not None and shape_rule != "paper":
            loose = np.ones(count, bool)
            loose[own[np.concatenate([np.zeros(0, int), *members])]] = False
            sight = sight_of(points, loose, eye, np.asarray(vertical, float))

        correlated = cloud.pixels_px is not None and shape_rule != "paper"
        how = picked | {"rule": shape_rule, "capacity": OF_SCENE, "correlated": correlated}
        fits = Fits(places, **seen(own) | how)

        def fit(
            sets: Sequence[np.ndarray],
            wholes: Sequence[np.ndarray] | None = None,
            further: Sequence[bool] | None = None,
        ) -> tuple[Shape, ...]:
            found = fits.shapes(sets, further=further)
            if sight is None:
                return found
            of = None if wholes is None else [own[m] for m in wholes]
            return without_seen_through(points, [own[m] for m in sets], found, sight, of)

        def parted(of: np.ndarray) -> np.ndarray:
            return np.asarray(segment(places[of], **seen(own[of])).labels)

        def stepped(of: np.ndarray, noise: float) -> list[np.ndarray]:
            pixels = np.asarray(cloud.pixels_px)[own[of]]
            return [of[i] for i in between_steps(pixels, lengths(places[of] - eye), noise, spacing)]

        def as_kinds(of: Sequence[int], kinds: Sequence[str]) -> tuple[Shape, ...]:
            return in_independent_points(fits.shapes_as([members[i] for i in of], kinds), OF_SCENE)

        def stood(of: Sequence[int], lean: float) -> tuple[Shape, ...]:
            # The prior is weighed against all points that a fit counts, of which few are independent.
            leans = [lean / np.sqrt(worth(len(members[i]), OF_SCENE) if correlated else 1.0) for i in of]
            sets, kinds = [members[i] for i in of], [shapes[i].kind for i in of]
            found = fits.shapes_about(sets, kinds, np.asarray(vertical, float), leans)
            return in_independent_points(found, OF_SCENE) if correlated else found

        least = FEWEST_PIXELS if correlated else FEWEST
        spacing = pixels_a_point(np.asarray(cloud.pixels_px)) if correlated else np.inf
        shapes = fit(members)
        if segment_rule == "robust" and "ks" not in options:
            across = np.asarray(tangents(vertical))
            parts, shapes = by_shapes(places, across, parts, shapes, fit, parted, eye, least)
            if correlated and eye is not None:
                parts, shapes = by_steps(places, parts, shapes, fit, stepped, least)
            members = members_of(parts)
        if correlated:
            shapes = in_independent_points(shapes, OF_SCENE)
        if sight is not None:
            mine = [own[m] for m in members]
            if correlated:
                shapes = chosen_by_outline(points, mine, shapes, sight, as_kinds)
            shapes = without_seen_through(points, mine, shapes, sight)
            if correlated:
                depth = lengths(points - eye)
                shapes = without_pieces(np.asarray(cloud.pixels_px), depth, flat, mine, shapes)
        if shape_rule != "paper":
            given = not isinstance(up, str)
            axis = np.asarray(vertical, float)
            witness = witness_of(points, found, axis, given=given, camera=eye, correlated=correlated)
            agreed = agreed_vertical(shapes, witness)
            if agreed is not None:
                vertical = agreed.up
                shapes = upright_again(shapes, agreed, stood)
            shapes = level_patches(places, members, shapes, np.asarray(vertical, float), eye)
        shapes = with_quadrics(places, members, shapes, seen(own)["weights"])
        if eye is not None:
            shapes = with_hidden_ends(places, members, shapes, eye, plane, thickness)
        if correlated:
            shapes = told_apart(shapes, np.asarray(vertical, float))
    settings = {"up": up, "ground": ground, "camera": camera, "rule": rule, "noise_distance": _told(noise_distance)}
    return Scene(
        cloud=cloud,
        up=on_device(vertical, points.dtype),
        ground=plane,
        segmentation=_of_all(parts, own, count),
        shapes=all_on_device(shapes),
        timings=clock.seconds,
        settings={name: _plain(value) for name, value in (settings | options).items()},
        status=on_device(status | int(parts.status), np.int32),
    )


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
    begins: dict[str, float] = {"matching": 0.0, "ground": 0.1, "objects": 0.4, "shapes": 0.6}  # noqa: RUF012

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
