"""Photographs before matching: reading them, what they say about their rectification, and rectifying them."""

import dataclasses
import os
import re
from typing import Any

import cv2
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.files import one_line, read_arrays, read_bytes
from jaxfuzzy.rig import Rig
from jaxfuzzy.rigfiles import NUMBER

Image = np.ndarray  # uint8, grey (H, W) or BGR (H, W, 3)

SMALLEST = 32
ALIGNMENT_WIDTH, FEATURES, FEWEST_FEATURES = 800, 500, 20
LEAST_SHARE = 0.2  # of matched features that must agree: real pairs 0.24 to 0.95, repeating patterns at wrong rows 0.15
# How rows differ over the picture is told from so many features and such a share on: fewer, of a chart, lay on a wrong plane.
SURE_FEATURES, SURE_SHARE = 100, 0.4
SURELY = 3.0  # standard errors: features of one thing err together
BRIGHTEST = 0.999  # this quantile of more than 8 bits becomes white: a few hot pixels would make all others dark


def read_pair(left: Any, right: Any, rig: Rig) -> tuple[Image, Image]:
    """Two images ready for matching: uint8, the same size and number of channels, the size of the rig.

    16-bit and floating-point images are scaled to 8 bits so that a thousandth of the pixels of the brighter one is white; a grey
    image beside a color one makes both grey; an opaque alpha channel is dropped.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image cannot be used, or sizes disagree.
        TypeError: An argument is neither a path nor an array, or the rig is none.
    """
    checks.kind(rig, "rig", Rig, "load_rig reads one from a file")
    images = [_image(value, name) for value, name in ((left, "left"), (right, "right"))]
    if images[0].shape[:2] != images[1].shape[:2]:
        sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in images]
        raise ValueError(f"left and right must have the same size, got {sizes[0]} and {sizes[1]}")
    height, width = images[0].shape[:2]
    if min(height, width) < SMALLEST:
        raise ValueError(f"images must be at least {SMALLEST} pixels wide and high, got {width} x {height}")
    if rig.image_size is not None and (width, height) != rig.image_size:
        raise ValueError(
            f"images must have the size the rig is for, {rig.image_size[0]} x {rig.image_size[1]}, got {width} x"
            f" {height}; rig.scaled(({width}, {height})), or --resized, makes the rig of resized images"
        )
    if images[0].dtype != images[1].dtype:
        raise ValueError(f"left and right must have the same type, got {images[0].dtype} and {images[1].dtype}")
    if images[0].dtype != np.uint8:
        top = max(_brightest(image) for image in images)
        images = [_eight_bits(image, top) for image in images]
    if images[0].ndim != images[1].ndim:
        images = [grey(image) for image in images]
    return images[0], images[1]


def read_grey(value: Any, name: str) -> Image:
    """One image as uint8 (H, W), from a path or an array of any kind that `read_pair` takes.

    Raises:
        FileNotFoundError: It does not exist.
        ValueError: It cannot be used.
        TypeError: It is neither a path nor an array.
    """
    image = _image(value, name)
    return grey(image if image.dtype == np.uint8 else _eight_bits(image, _brightest(image)))


def _brightest(image: np.ndarray) -> float:
    return float(np.quantile(image, BRIGHTEST)) or float(image.max())


def _eight_bits(image: np.ndarray, top: float) -> Image:
    return (np.minimum(image * (255.0 / max(top, 1e-12)), 255.0) + 0.5).astype(np.uint8)


def _decoded(data: bytes) -> Any:
    """The image in a file's bytes, turned as a JPEG file says, like `cv2.imread`; None where it is none that OpenCV reads."""
    # Unchanged images are not turned; JPEG has no opacity that could be lost.
    how = cv2.IMREAD_ANYCOLOR if data.startswith(b"\xff\xd8") else cv2.IMREAD_UNCHANGED
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except (cv2.error, MemoryError):  # it says a size that it cannot have
        return None


def _image(value: Any, name: str) -> np.ndarray:
    if isinstance(value, str | os.PathLike):
        image = _decoded(read_bytes(value, f"{name} image"))
        if image is None:
            raise ValueError(f"{name} is not an image that can be read: {os.fspath(value)}")
    elif value is None:
        raise TypeError(f"{name} must be an image or a path, got None")
    else:
        image = np.asarray(value)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3 and image.shape[2] == 4:
        opaque = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(image.dtype, 1.0)
        if not np.all(image[:, :, 3] == opaque):
            raise ValueError(f"{name} has transparent pixels, whose color is unknown: remove the alpha channel")
        image = image[:, :, :3]
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or 0 in image.shape:
        raise ValueError(f"{name} must be grey (H, W) or BGR (H, W, 3), got shape {image.shape}")
    if image.dtype.kind == "f":
        if not np.all(np.isfinite(image)) or image.min() < 0:
            raise ValueError(f"{name} must be finite and not negative")
    elif image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{name} must be uint8, uint16 or floating point, got {image.dtype}")
    return image


def read_disparity(path: str | os.PathLike[str], *, scale: float = 1.0) -> np.ndarray:
    """Reads a ready disparity map, float32 (H, W) in pixels; NaN where it is unknown.

    Maps of 16-bit numbers with a sign are OpenCV's fixed point, and refused without their scale.

    Args:
        path: A PFM file (rows from the bottom, infinite where unknown), a PNG or TIFF (0 where unknown), or NPY or NPZ
            with one map (not finite where unknown).
        scale: What the file's numbers are divided by: 4 for Middlebury 2003, 8 for 2001, 3 and 2 for the third and half
            sizes of 2005 and 2006, 16 for OpenCV's fixed point, 256 for KITTI. The number in a PFM header is no scale.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no disparity map.
    """
    return _map(path, scale, "disparity")


def read_depth(path: str | os.PathLike[str], *, scale: float = 1.0) -> np.ndarray:
    """Reads a depth map, float32 (H, W) in metres; NaN where it is unknown.

    Args:
        path: A PFM, PNG, TIFF, NPY or NPZ file, as `read_disparity` reads them.
        scale: What the file's numbers are divided by: 1000 for millimetres, which depth cameras give.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no depth map.
    """
    return _map(path, scale, "depth")


def _map(path: str | os.PathLike[str], scale: float, what: str) -> np.ndarray:
    """One number a pixel; NaN where it is unknown."""
    checks.number(scale, "scale", above=0.0)
    data, is_image = read_bytes(path, what), False
    try:
        if data.startswith((b"Pf", b"PF")):
            values = _pfm(data)
        elif data.startswith((b"\x93NUMPY", b"PK")):
            arrays = list(read_arrays(data).values())
            if len(arrays) != 1:
                raise ValueError(f"holds {len(arrays)} arrays, one is needed")
            values = arrays[0]
        else:
            image, is_image = _decoded(data), True
            if image is None:
                raise ValueError("is no image, PFM, NPY or NPZ file")
            # Middlebury's 2001 maps are grey stored as color.
            values = image[:, :, 0] if image.ndim == 3 and np.ptp(image[:, :, :3], axis=2).max() == 0 else image
        if values.ndim != 2 or values.dtype.kind not in "fiu":
            raise ValueError(f"must hold one number a pixel, got {values.dtype} {values.shape}")
        if what == "disparity" and values.dtype.kind == "i" and values.dtype.itemsize == 2 and scale == 1:
            raise ValueError("holds int16, which is OpenCV's fixed point: give scale=16, or --disparity-scale 16")
        if what == "depth" and values.dtype.kind in "iu" and scale == 1:
            raise ValueError(
                f"holds {values.dtype}, as depth cameras give millimetres: give scale=1000, or --depth-scale 1000"
            )
    except ValueError as error:
        raise ValueError(f"{what} {os.fspath(path)} {one_line(error)}") from None
    known = np.isfinite(values) & ((values > 0) if is_image or values.dtype.kind != "f" else True)
    return np.where(known, values.astype(np.float32) / np.float32(scale), np.float32(np.nan))


def _pfm(data: bytes) -> np.ndarray:
    between = rb"(?:\s|#[^\n]*\n)+"
    head = re.match(
        rb"Pf" + between + rb"(\d+)" + between + rb"(\d+)" + between + rb"([-+]?[\d.]+(?:[eE][-+]?\d+)?)(?:\r\n|\s)",
        data,
    )
    if head is None or not NUMBER.fullmatch(head[3].decode()) or float(head[3]) == 0:
        raise ValueError("is not a PFM file of one channel")
    width, height = int(head[1]), int(head[2])
    kind = np.dtype("<f4" if float(head[3]) < 0 else ">f4")
    there, promised = len(data) - head.end(), width * height * kind.itemsize
    if there != promised:
        raise ValueError(
            f"is {'cut short' if there < promised else 'longer than it says'}: {width} x {height} pixels are promised"
        )
    return np.frombuffer(data, kind, width * height, head.end()).reshape(height, width)[::-1]


@dataclasses.dataclass(frozen=True)
class Alignment:
    """What features common to both images say about their rectification.

    Attributes:
        matches: How many features support it; 0 where there were too few to say anything.
        rows_px: How much further down the right image shows things; 0 for a rectified pair.
        corners_px: By how much that surely differs, in a corner, from the middle: cameras rolled or of different focal length.
        disparity_px: How much further left: the fifth, fiftieth and ninety-fifth of a hundred.
        swapped: Whether nearly everything appears further right in the right image.
    """

    matches: int
    rows_px: float
    corners_px: float
    disparity_px: tuple[float, float, float]
    swapped: bool


UNKNOWN = Alignment(0, 0.0, 0.0, (0.0, 0.0, 0.0), False)


def alignment(left: Image, right: Image) -> Alignment:
    """Compares the places of ORB features (Rublee et al., ICCV 2011) in two images, without any calibration.

    Semi-global matching searches rows only: with rows 2 px apart half of its answers are gone, with 6 px nearly all.
    """
    shrink = -(-left.shape[1] // ALIGNMENT_WIDTH)
    size = (max(1, left.shape[1] // shrink), max(1, left.shape[0] // shrink))
    detector = cv2.ORB.create(FEATURES, fastThreshold=7)
    found = [
        detector.detectAndCompute(cv2.resize(grey(image), size, interpolation=cv2.INTER_AREA), None)
        for image in (left, right)
    ]
    (left_points, left_codes), (right_points, right_codes) = found
    if left_codes is None or right_codes is None:
        return UNKNOWN
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_codes, right_codes)
    if len(pairs) < FEWEST_FEATURES:
        return UNKNOWN
    ends = np.array([[*left_points[pair.queryIdx].pt, *right_points[pair.trainIdx].pt] for pair in pairs])
    x, y, right_x, right_y = shrink * ends.T
    across, down = x - right_x, right_y - y
    where = np.stack([np.ones_like(x), 2 * x / left.shape[1] - 1, 2 * y / left.shape[0] - 1], axis=1)
    plane, good = _rows(where, down, 2.5 * shrink)
    if good.sum() < max(SURE_FEATURES, SURE_SHARE * len(pairs)):
        plane, good = _rows(where[:, :1], down, 2.5 * shrink)
    if good.sum() < max(FEWEST_FEATURES, LEAST_SHARE * len(pairs)):
        return UNKNOWN
    spread = (down - where[:, : len(plane)] @ plane)[good].var()
    error = np.sqrt(np.diag(np.linalg.pinv(where[good].T @ where[good]) * spread))[: len(plane)]
    low, middle, high = np.percentile(across[good], [5, 50, 95])
    return Alignment(
        matches=int(good.sum()),
        rows_px=float(plane[0]),
        corners_px=float(np.maximum(np.abs(plane) - SURELY * error, 0)[1:].sum()),
        disparity_px=(float(low), float(middle), float(high)),
        swapped=bool(np.mean(across[good] < -1) > 0.9),
    )


def _rows(where: np.ndarray, down: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """How far down things are shown, as a plane over the picture, and which pairs lie on it; wrong ones, anywhere, do no harm.

    Right pairs share their rows, or nearly so where a camera is rolled: the densest rows hold them, fewer and fewer of them.
    """
    plane = np.zeros(where.shape[1])
    for width in (16 * reach, 8 * reach, 4 * reach, 2 * reach):
        rest = down - where @ plane
        rows = np.sort(rest)
        held = np.searchsorted(rows, rows + width) - np.arange(len(rows))
        near = np.abs(rest - np.median(rows[held.argmax() :][: held.max()])) <= width / 2
        plane = np.linalg.lstsq(where[near], down[near], rcond=None)[0]
    return plane, np.abs(down - where @ plane) <= reach


def rectify(left: Any, right: Any, rig: Rig) -> tuple[Image, Image, Rig]:
    """Undistorts and turns both images of a raw pair so that rows correspond, and gives the rig of the new images.

    Black borders are cut away inside the new images (OpenCV's alpha = 0), so that nothing is matched that was not seen.

    Args:
        left: The left image, as the camera took it: a path or an array.
        right: The right image.
        rig: The rig with rotation and translation.

    Returns:
        Both rectified images and their rig, whose left camera is turned against that of `rig`.

    Raises:
        ValueError: The rig is rectified already, or images and rig do not fit.
    """
    left, right = read_pair(left, right, rig)
    if rig.rectified or rig.translation is None:
        raise ValueError("rig must have rotation and translation to rectify by; this one is rectified already")
    size = (left.shape[1], left.shape[0])
    cameras = [
        np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
        for focal, center in (
            (rig.focal_px, rig.center_px),
            (rig.right_focal_px or rig.focal_px, rig.right_center_px or rig.center_px),
        )
    ]
    lenses = [np.array(lens) if lens else np.zeros(5) for lens in rig.distortion or ((), ())]
    turn_left, turn_right, project_left, project_right = cv2.stereoRectify(
        cameras[0],
        lenses[0],
        cameras[1],
        lenses[1],
        size,
        np.array(rig.rotation),
        np.array(rig.translation)[:, None],
        alpha=0,
    )[:4]
    turns, projections = (turn_left, turn_right), (project_left, project_right)
    images = [
        cv2.remap(
            image, *cv2.initUndistortRectifyMap(camera, lens, turn, projection, size, cv2.CV_32FC1), cv2.INTER_LINEAR
        )
        for image, camera, lens, turn, projection in zip(
            (left, right), cameras, lenses, turns, projections, strict=True
        )
    ]
    straight = Rig(
        focal_px=(project_left[0, 0], project_left[1, 1]),
        center_px=(project_left[0, 2], project_left[1, 2]),
        baseline_m=-project_right[0, 3] / project_right[0, 0],
        image_size=size,
        doffs_px=project_right[0, 2] - project_left[0, 2],
        max_disparity_px=rig.max_disparity_px,
        metric=rig.metric,
        calibration=rig.calibration,
    )
    return images[0], images[1], straight


def grey(image: Image) -> Image:
    """One channel."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
