"""The stereo stage: two photographs and a rig become disparities, and these a metric point cloud.

Matching is semi-global (Hirschmüller, PAMI 2008) as OpenCV has it, with what its users stumble over taken care of:
disparities come in pixels, not in sixteenths; what was not matched is masked, not a point behind the camera; the left
strip that the matcher cannot answer is regained by padding; both images are matched and compared.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, Bool, Float
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.files import read_bytes
from jaxfuzzy.reproject import DISPARITY_STD_PX, cloud_from_disparity
from jaxfuzzy.rig import Rig, load_rig
from jaxfuzzy.status import Status

Image = np.ndarray  # uint8, grey (H, W) or BGR (H, W, 3)

METHODS = {"sgbm": cv2.StereoSGBM_MODE_SGBM_3WAY, "hh": cv2.StereoSGBM_MODE_HH, "bm": -1}
FEWEST_POINTS = 50
FEW_MATCHES_SHARE = 0.1
SIXTEENTHS = 16  # OpenCV's fixed point: disparities are int16, 16 a pixel
STEP = 16  # OpenCV searches a multiple of 16 disparities
COARSE_WIDTH = 320  # the disparity range is looked for on images no wider than this
RANGE_SHARE = 0.002  # share of coarse matches left out at either end of the range


@dataclasses.dataclass(frozen=True)
class Matcher:
    """How to match. The defaults are those that answered most and erred least on ten real scenes with ground truth.

    Attributes:
        method: "sgbm" (semi-global, three directions), "hh" (all directions: smoother fractions, several times slower)
            or "bm" (block matching: only where there is texture).
        min_disparity: Smallest disparity to search, whole pixels; None takes it from the scene.
        disparities: How many disparities to search, a multiple of 16; None takes it from the scene.
        block: Side of the matched block, odd. Larger ones fatten edges ("bm" uses at least 15).
        smoothness: Price of a disparity step of one pixel and of more, per channel and pixel of the block.
        uniqueness: By how many per cent the best match must beat the second.
        left_right_px: Largest difference between matching left to right and right to left; None leaves the check out.
        speckle_px: Connected patches of at most so many pixels are removed; 0 keeps them.
        edge_px: Pixels to erode from the nearer side of a depth edge, where matching bleeds over; 0 keeps them.
        disparity_std_px: Standard deviation of a disparity, from which every point's `depth_std` comes.
    """

    method: str = "sgbm"
    min_disparity: int | None = None
    disparities: int | None = None
    block: int = 3
    smoothness: tuple[float, float] = (8.0, 32.0)
    uniqueness: int = 10
    left_right_px: float | None = 1.0
    speckle_px: int = 100
    edge_px: int = 1
    disparity_std_px: float = DISPARITY_STD_PX

    def __post_init__(self) -> None:
        checks.choice(self.method, "method", METHODS.keys())
        if self.min_disparity is not None:
            checks.integer(self.min_disparity, "min_disparity", at_least=-4096, at_most=4096)
        if self.disparities is not None:
            checks.integer(self.disparities, "disparities", at_least=STEP, at_most=4096)
            if self.disparities % STEP:
                raise ValueError(f"disparities must be a multiple of {STEP}, got {self.disparities}")
        checks.integer(self.block, "block", at_least=1, at_most=51)
        if self.block % 2 == 0:
            raise ValueError(f"block must be odd, got {self.block}")
        if len(self.smoothness) != 2 or not 0 < self.smoothness[0] < self.smoothness[1]:
            raise ValueError(f"smoothness must be two prices, 0 < first < second, got {self.smoothness}")
        checks.integer(self.uniqueness, "uniqueness", at_least=0, at_most=100)
        if self.left_right_px is not None:
            checks.number(self.left_right_px, "left_right_px", above=0.0)
        checks.integer(self.speckle_px, "speckle_px", at_least=0)
        checks.integer(self.edge_px, "edge_px", at_least=0, at_most=20)
        checks.number(self.disparity_std_px, "disparity_std_px", above=0.0)


def reconstruct(left: Any, right: Any, rig: Rig, *, matcher: Matcher | None = None) -> Cloud:
    """Turns a stereo pair into a point cloud in metres, in the frame of the left camera (rectified, where it was not).

    Args:
        left: The left image: a path, or an array, grey (H, W) or BGR (H, W, 3) as `cv2.imread` gives it.
        right: The right image, of the same size.
        rig: The rig of these images; one that is not rectified has its images rectified first.
        matcher: How to match.

    Returns:
        The cloud with colors, `depth_std` and `pixels_px`, and a status.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image cannot be used, sizes disagree, or fewer than 50 pixels were matched.
    """
    matcher = Matcher() if matcher is None else matcher
    left, right = read_pair(left, right, rig)
    disparity_px, valid = disparity(left, right, rig, matcher=matcher)
    count = int(valid.sum())
    if count < FEWEST_POINTS:
        raise ValueError(
            f"only {count} of {valid.size} pixels were matched, {FEWEST_POINTS} are needed: check that left and right"
            " are not swapped, that the images are rectified, the range of disparities, and that there is texture"
        )
    cloud = cloud_from_disparity(disparity_px, valid, rig, image=left, disparity_std_px=matcher.disparity_std_px)
    status = int(cloud.status)
    if count < FEW_MATCHES_SHARE * valid.size:
        status |= int(Status.FEW_MATCHES)
    return dataclasses.replace(cloud, status=status)


def disparity(
    left: Any, right: Any, rig: Rig, *, matcher: Matcher | None = None
) -> tuple[Float[Array, "H W"], Bool[Array, "H W"]]:
    """Matches a rectified pair: pixel (u, v) of the left image is seen at (u - disparity, v) in the right one.

    Args:
        left: The left image: a path or an array.
        right: The right image, of the same size.
        rig: The rig of these images, rectified.
        matcher: How to match.

    Returns:
        Disparities in pixels, and which of them are valid; where they are not, the disparity is NaN.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image cannot be used, sizes disagree, the rig is not rectified or the image is too narrow.
    """
    matcher = Matcher() if matcher is None else matcher
    left, right = read_pair(left, right, rig)
    if not rig.rectified:
        raise ValueError("rig must be rectified for matching: rectify the pair first, or use reconstruct")
    low, count = search_range(left, right, rig, matcher)
    values = _match(left, right, low, count, matcher)
    valid = values >= low
    if matcher.left_right_px is not None:
        mirrored = _match(right[:, ::-1], left[:, ::-1], low, count, matcher)[:, ::-1]
        valid &= _agrees(values, mirrored, low, matcher.left_right_px)
    if matcher.edge_px:
        valid &= ~_edges(values, valid, matcher.edge_px)
    if matcher.speckle_px:
        valid = _without_speckles(values, valid, matcher.speckle_px)
    return jnp.asarray(np.where(valid, values, np.float32(np.nan))), jnp.asarray(valid)


def search_range(left: Image, right: Image, rig: Rig, matcher: Matcher) -> tuple[int, int]:
    """The smallest disparity to search and how many: the matcher's own, or what a coarse match of the scene shows.

    Both are looked for on shrunk images among all disparities that put a point before the camera, up to half the
    width or the rig's `max_disparity_px`.
    """
    width = left.shape[1]
    low, count = matcher.min_disparity, matcher.disparities
    if low is None or count is None:
        first, last = _scene_range(left, right, rig, matcher)
        low = first if low is None else low
        count = STEP * max(1, -(-(last + 1 - low) // STEP)) if count is None else count
    if width <= matcher.block or count > STEP * -(-width // STEP):
        raise ValueError(
            f"images are {width} pixels wide, too narrow for {count} disparities and blocks of {matcher.block}:"
            " give smaller ones or larger images"
        )
    return low, count


def _scene_range(left: Image, right: Image, rig: Rig, matcher: Matcher) -> tuple[int, int]:
    width = left.shape[1]
    shrink = -(-width // COARSE_WIDTH)
    size = (max(1, width // shrink), max(1, left.shape[0] // shrink))
    small_left, small_right = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right))
    top = width / 2 if rig.max_disparity_px is None else min(rig.max_disparity_px, width)
    bottom = -min(max(rig.doffs_px, -top), width / 8)
    low = int(np.floor(bottom / shrink))
    count = STEP * max(1, int(np.ceil((top / shrink - low) / STEP)))
    coarse = dataclasses.replace(matcher, method="sgbm", block=3)
    values = _match(small_left, small_right, low, count, coarse)
    mirrored = _match(small_right[:, ::-1], small_left[:, ::-1], low, count, coarse)[:, ::-1]
    valid = _without_speckles(values, (values >= low) & _agrees(values, mirrored, low, 1.0), 20)
    found = np.sort(values[valid]) * shrink
    if len(found) < FEWEST_POINTS:
        return int(np.floor(bottom)), int(np.ceil(top))
    skip = int(RANGE_SHARE * len(found))
    # One coarse pixel of play at either end, and one more for the rounding of the coarse disparities themselves.
    first, last = found[skip] - 2 * shrink, found[-1 - skip] + 2 * shrink
    return int(np.floor(max(first, bottom))), int(np.ceil(min(last, top)))


def _match(left: Image, right: Image, low: int, count: int, matcher: Matcher) -> np.ndarray:
    """Disparities float32 (H, W) of one direction; below `low` where there is none."""
    before, after = max(0, low + count), max(0, -low)
    padded = [
        cv2.copyMakeBorder(np.ascontiguousarray(image), 0, 0, before, after, cv2.BORDER_REPLICATE)
        for image in (left, right)
    ]
    if matcher.method == "bm":
        block = max(matcher.block, 15)
        bm = cv2.StereoBM.create(count, block)
        bm.setMinDisparity(low)
        bm.setUniquenessRatio(matcher.uniqueness)
        padded = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in padded]
        values = bm.compute(*padded)
    else:
        area = matcher.block**2 * (1 if left.ndim == 2 else left.shape[2])
        first, second = (round(price * area) for price in matcher.smoothness)
        sgbm = cv2.StereoSGBM.create(
            minDisparity=low,
            numDisparities=count,
            blockSize=matcher.block,
            P1=first,
            P2=second,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=matcher.uniqueness,
            mode=METHODS[matcher.method],
        )
        values = sgbm.compute(*padded)
    return values[:, before : before + left.shape[1]].astype(np.float32) / SIXTEENTHS


def _agrees(values: np.ndarray, mirrored: np.ndarray, low: int, tolerance: float) -> np.ndarray:
    """Where the disparity of the pixel that a left pixel maps to, matched the other way, is the same."""
    width = values.shape[1]
    columns = np.arange(width, dtype=np.int32) - np.rint(values).astype(np.int32)
    inside = (values >= low) & (columns >= 0) & (columns < width)
    other = np.take_along_axis(mirrored, np.clip(columns, 0, width - 1), axis=1)
    return inside & (other >= low) & (np.abs(other - values) <= tolerance)


def _edges(values: np.ndarray, valid: np.ndarray, radius: int, jump: float = 2.0) -> np.ndarray:
    """The nearer side of depth edges: pixels with a valid neighbor within `radius` that is `jump` further away."""
    far = cv2.erode(np.where(valid, values, np.float32(np.inf)), np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    return valid & (values - far > jump)


def _without_speckles(values: np.ndarray, valid: np.ndarray, area: int, jump: int = 2) -> np.ndarray:
    gone = -(2**15) + 1
    fixed = np.where(valid, np.rint(values * SIXTEENTHS), gone).astype(np.int16)
    cv2.filterSpeckles(fixed, gone, area, jump * SIXTEENTHS)
    return valid & (fixed != gone)


def read_pair(left: Any, right: Any, rig: Rig) -> tuple[Image, Image]:
    """Two images ready for matching: uint8, the same size and number of channels, the size of the rig.

    16-bit and floating-point images are scaled to 8 bits by the larger maximum of the two; a grey image beside a color
    one makes both grey; an opaque alpha channel is dropped.

    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image cannot be used, or sizes disagree.
        TypeError: An argument is neither a path nor an array.
    """
    images = [_image(value, name) for value, name in ((left, "left"), (right, "right"))]
    if images[0].shape[:2] != images[1].shape[:2]:
        sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in images]
        raise ValueError(f"left and right must have the same size, got {sizes[0]} and {sizes[1]}")
    height, width = images[0].shape[:2]
    if rig.image_size is not None and (width, height) != rig.image_size:
        raise ValueError(
            f"images must have the size the rig is for, {rig.image_size[0]} x {rig.image_size[1]}, got {width} x"
            f" {height}; rig.scaled(({width}, {height})) makes the rig of resized images"
        )
    if images[0].dtype != images[1].dtype:
        raise ValueError(f"left and right must have the same type, got {images[0].dtype} and {images[1].dtype}")
    if images[0].dtype != np.uint8:
        top = max(float(image.max()) for image in images)
        images = [(image * (255.0 / max(top, 1e-12)) + 0.5).astype(np.uint8) for image in images]
    if images[0].ndim != images[1].ndim:
        images = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    return images[0], images[1]


def _image(value: Any, name: str) -> np.ndarray:
    if isinstance(value, str | os.PathLike):
        data = np.frombuffer(read_bytes(value, f"{name} image"), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
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


def example_pair() -> tuple[Path, Path, Rig]:
    """The bundled photographs, Middlebury 2003 "cones", and their rig.

    The rig's numbers are those of the sister scene of the same size: absolute lengths are nominal.
    """
    folder = Path(__file__).parent / "data" / "cones"
    return folder / "im2.png", folder / "im6.png", load_rig(folder / "calib.txt")
