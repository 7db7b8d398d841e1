"""The stereo stage: two photographs and a rig become disparities, and these a metric point cloud.

Matching is semi-global (Hirschmüller, PAMI 2008) as OpenCV has it, with what its users stumble over taken care of:
disparities come in pixels, not in sixteenths; what was not matched is masked, not a point behind the camera; the left
strip that the matcher cannot answer is regained by padding; both images are matched and compared.

What is used of OpenCV is the same from 4.10 to 5.0. Two of its wheels in one environment (with and without "contrib" or
"headless") write over each other, and then `cv2` lacks names: keep one.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxfuzzy.arrays import Array, Bool, Float, on_device
from jaxfuzzy.brightness import UNCHANGED, Line, evened, line_between
from jaxfuzzy.checks import DataError
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.linalg import TO_STD
from jaxfuzzy.matcher import FURTHEST_PX, STEP, Matcher, chosen
from jaxfuzzy.photos import Alignment, Image, alignment, grey, read_pair, rectify
from jaxfuzzy.reproject import cloud_from_disparity, usual_std_px
from jaxfuzzy.rig import Rig, load_rig
from jaxfuzzy.status import Status, describe

MODES = {"sgbm": cv2.StereoSGBM_MODE_SGBM_3WAY, "hh": cv2.StereoSGBM_MODE_HH}
FEWEST_POINTS = 50
FEW_MATCHES_SHARE = 0.1
MISALIGNED_PX, ROLLED_PX = 0.75, 1.0  # rows may differ by less without harm, on the whole and in a corner
BM_BLOCK = 15  # block matching needs more to tell places apart
SIXTEENTHS = 16  # OpenCV's fixed point: disparities are int16, 16 a pixel
COARSE_WIDTH, COARSE_BLOCK = 320, 3  # the disparity range is looked for on images no wider than this, by such blocks
COARSE_AGREE_PX, COARSE_SPECKLE_PX = 1.0, 20  # of them both directions must agree so well; patches of so few are none
RANGE_SHARE = 0.002  # share of coarse matches left out at either end of the range
MISSED_SHARE = 0.1  # of coarse matches outside a range that was given, from which on that is told
WINDOW_PX, SMOOTHING_PX, LARGEST_STEP_PX = 1.5, 2.0, 0.5  # of the refinement
ALIKE_PX = 1.0  # its means weigh neighbors by a normal curve of so wide a difference of disparity
UNLIKE_PX = 8.0  # so far beyond all others that a pixel counts for nothing in them
TEXTURE_PX = 15  # an image tells something where it is not of one grey over so many pixels in both directions
STEP_PX = 2  # a larger one between neighbors is a step in depth
PREFILTER_CAP = 31  # slopes of grey levels count up to so much, so that one strong edge does not outweigh a texture
# Where noise or compression leaves disparities rough, images are smoothed over so many pixels, among so similar grey levels, and
# matched once more, and refined by a second step. Rough are those that differ from their smoother neighborhood by more than such a
# share of their usual deviation: of twelve real scenes as they are 0.14 to 0.24, with noise of 4 grey levels 0.27 to 0.50, as JPEG
# of quality 60 0.35 to 0.47.
NOISE_PX, NOISE_LEVELS, ROUGH = 1.5, 15.0, 0.36
WIDER_WINDOW_PX, WIDER_SMOOTHING_PX, FURTHER_PX = 2.5, 3.5, 1.0


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
        ValueError: An image cannot be used or sizes disagree.
        DataError: Fewer than 50 pixels were matched, or left and right are swapped or one and the same.
    """
    matcher = chosen(matcher)
    left, right = read_pair(left, right, rig)
    if not rig.rectified:
        left, right, rig = rectify(left, right, rig)
    found = _checked(left, right, matcher)
    disparity_px, valid = _matched(left, right, rig, matcher)
    count = int(np.asarray(valid).sum())
    if count < FEWEST_POINTS:
        rows = f"rows differ by {found.rows_px:+.1f} px" if found.matches else "no common features were found"
        raise DataError(
            f"only {count} of {valid.size} pixels were matched, {FEWEST_POINTS} are needed: check that the images are"
            f" rectified ({rows}), the range of disparities, and that there is texture"
        )
    status = int(Status.MISALIGNED) * _misaligned(found)
    status |= int(Status.FEW_MATCHES) * (count < FEW_MATCHES_SHARE * valid.size)
    cloud = cloud_from_disparity(disparity_px, valid, rig, image=left, disparity_std_px=matcher.disparity_std_px)
    return dataclasses.replace(cloud, status=int(cloud.status) | status)


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
        DataError: Left and right are swapped or one and the same.
    """
    matcher = chosen(matcher)
    left, right = read_pair(left, right, rig)
    if not rig.rectified:
        raise ValueError(
            "rig must be rectified for matching: rectify the pair first, or use reconstruct; where the images are rectified"
            " already, load_rig(..., rectified=True)"
        )
    found = _checked(left, right, matcher)
    values, valid = _matched(left, right, rig, matcher)
    if _misaligned(found):
        warnings.warn(describe(Status.MISALIGNED), stacklevel=2)
    if not np.asarray(valid).any():
        warnings.warn("no pixel was matched: check the range of disparities, and that there is texture", stacklevel=2)
    return values, valid


def _misaligned(found: Alignment) -> bool:
    """Whether rows differ by so much that matching suffers."""
    return abs(found.rows_px) > MISALIGNED_PX or found.corners_px > ROLLED_PX


def _checked(left: Image, right: Image, matcher: Matcher) -> Alignment:
    """What features say of the pair, unless it is none."""
    if np.array_equal(left, right) and np.ptp(left):
        raise DataError("left and right are the same picture: give the photographs of two cameras")
    found = alignment(left, right)
    if found.swapped and matcher.min_disparity is None:
        raise DataError(
            "left and right seem to be swapped: things appear further right in the right image"
            f" ({found.disparity_px[1]:.0f} px in the middle of {found.matches} matches); where that is right because the"
            " cameras look inwards, give Matcher(min_disparity=...), or --min-disparity"
        )
    return found


def _matched(left: Image, right: Image, rig: Rig, matcher: Matcher) -> tuple[Array, Array]:
    """Disparities of a pair that is one."""
    low, count, to_left = _glance(left, right, rig, matcher)
    left, right = evened(left, right, to_left)
    for rough in (False, True):
        if rough:
            left, right = (cv2.bilateralFilter(image, -1, NOISE_LEVELS, NOISE_PX) for image in (left, right))
        values, valid = _answered(left, right, rig, low, count, matcher)
        if not (matcher.refine and valid.any()):
            break
        values, still = _refined(left, right, values, valid, rough)
        if not still:
            break
    return on_device(np.where(valid, values, np.float32(np.nan))), on_device(valid)


def _answered(
    left: Image, right: Image, rig: Rig, low: int, count: int, matcher: Matcher
) -> tuple[np.ndarray, np.ndarray]:
    """Disparities (H, W) in sixteenths of a pixel, and which of them stand every check."""
    values = _match(left, right, low, count, matcher)
    valid = (values >= low) & (values + rig.doffs_px > 0) & _textured(left)
    if matcher.left_right_px is not None:
        mirrored = _match(right[:, ::-1], left[:, ::-1], low, count, matcher)[:, ::-1]
        valid &= _agrees(values, mirrored, low, matcher.left_right_px) & _whole_blocks(values, matcher)
    if matcher.edge_px:
        valid &= ~_edges(values, valid, matcher.edge_px)
    if matcher.speckle_px:
        valid = _without_speckles(values, valid, matcher.speckle_px)
    return values, valid


def search_range(left: Image, right: Image, rig: Rig, matcher: Matcher) -> tuple[int, int]:
    """The smallest disparity to search and how many: the matcher's own, or what a coarse match of the scene shows.

    Both are looked for on shrunk images among all disparities that put a point before the camera, up to half the
    width or the rig's `max_disparity_px`.
    """
    return _glance(left, right, rig, matcher)[:2]


def _glance(left: Image, right: Image, rig: Rig, matcher: Matcher) -> tuple[int, int, Line]:
    """What a coarse match shows: the range of disparities, and how levels of the right image become those of the left."""
    height, width = left.shape[:2]
    low, count = matcher.min_disparity, matcher.disparities

    def check(count: int) -> None:
        block = max(matcher.block, BM_BLOCK) if matcher.method == "bm" else matcher.block
        if min(height, width) <= block or count > STEP * -(-width // STEP):
            raise ValueError(
                f"images are {width} pixels wide and {height} high, too small for {count} disparities and blocks of"
                f" {block}: give smaller ones or larger images"
            )

    if count is not None:
        check(count)
    top = width / 2 if rig.max_disparity_px is None else min(rig.max_disparity_px, width)
    bottom = -min(max(rig.doffs_px, -top), width / 8)
    if low is not None:
        bottom, top = min(bottom, float(low)), max(top, float(low + (count or 0)))
    found, shrink, to_left = _coarse(left, right, matcher, bottom, top)
    first, last = bottom, top
    if len(found):
        # One coarse pixel of play at either end, and one more for the rounding of the coarse disparities themselves.
        skip = int(RANGE_SHARE * len(found))
        first, last = max(found[skip] - 2 * shrink, bottom), min(found[-1 - skip] + 2 * shrink, top)
        begin = float(first) if low is None else float(low)
        end = np.inf if count is None else begin + count
        missed = np.mean((found < begin - shrink) | (found >= end + shrink))
        if missed > MISSED_SHARE:
            until = max(begin, min(end, last))
            warnings.warn(
                f"disparities of {begin:.0f} to {until:.0f} px are searched, but {100 * missed:.0f} % of the picture has"
                f" others, from {found[skip]:.0f} to {found[-1 - skip]:.0f}: what lies there is missing, or wrong",
                stacklevel=2,
            )
    first, last = int(np.floor(first)), int(np.ceil(last))
    low = first if low is None else low
    if count is None:  # no more than the picture is wide, as what is searched ends in the padding beyond
        count = STEP * min(max(1, -(-(last + 1 - low) // STEP)), -(-width // STEP))
    check(count)
    if not -FURTHEST_PX <= low <= low + count <= FURTHEST_PX + STEP:
        raise ValueError(
            f"disparities of {low} to {low + count} pixels are beyond the {FURTHEST_PX} that OpenCV's matchers can say:"
            " shrink the images, and scale the rig with them"
        )
    return low, count, to_left


def _coarse(left: Image, right: Image, matcher: Matcher, bottom: float, top: float) -> tuple[np.ndarray, int, Line]:
    """Disparities between two bounds, in order, of a match of shrunk images; how much these are; and the levels of what matches."""
    width = left.shape[1]
    shrink = -(-width // COARSE_WIDTH)
    size = (max(1, width // shrink), max(1, left.shape[0] // shrink))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    levels = [image.reshape(size[0] * size[1], -1) for image in small]
    one, other = evened(small[0], small[1], line_between(levels[1], levels[0]))
    low = int(np.floor(bottom / shrink))
    count = STEP * max(1, int(np.ceil((top / shrink - low) / STEP)))
    # Prices for other blocks may be too high for these.
    prices = matcher.smoothness if matcher.method != "bm" and matcher.block >= COARSE_BLOCK else Matcher.smoothness
    coarse = dataclasses.replace(matcher, method="sgbm", block=COARSE_BLOCK, smoothness=prices)
    values = _match(one, other, low, count, coarse)
    mirrored = _match(other[:, ::-1], one[:, ::-1], low, count, coarse)[:, ::-1]
    valid = (values >= low) & _agrees(values, mirrored, low, COARSE_AGREE_PX) & _textured(small[0])
    valid = _without_speckles(values, valid, COARSE_SPECKLE_PX)
    if valid.sum() < FEWEST_POINTS:
        return np.zeros(0), shrink, UNCHANGED
    at = np.flatnonzero(valid)
    to_left = line_between(levels[1][at - np.rint(values.ravel()[at]).astype(int)], levels[0][at])
    return np.sort(values[valid]) * shrink, shrink, to_left


def _match(left: Image, right: Image, low: int, count: int, matcher: Matcher) -> np.ndarray:
    """Disparities float32 (H, W) of one direction; below `low` where there is none."""
    before, after = max(0, low + count), max(0, -low)
    padded = [
        cv2.copyMakeBorder(np.ascontiguousarray(image), 0, 0, before, after, cv2.BORDER_REPLICATE)
        for image in (left, right)
    ]
    if matcher.method == "bm":
        bm = cv2.StereoBM.create(count, max(matcher.block, BM_BLOCK))
        bm.setMinDisparity(low)
        bm.setUniquenessRatio(matcher.uniqueness)
        values = bm.compute(grey(padded[0]), grey(padded[1]))
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
            preFilterCap=PREFILTER_CAP,
            uniquenessRatio=matcher.uniqueness,
            mode=MODES[matcher.method],
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


def _textured(image: Image) -> np.ndarray:
    """Where there is any texture at all near a pixel: what is of one grey (overexposed, say) matches everywhere."""
    around = np.ones((TEXTURE_PX, TEXTURE_PX), np.uint8)
    return cv2.dilate(grey(image), around) != cv2.erode(grey(image), around)


def _whole_blocks(values: np.ndarray, matcher: Matcher) -> np.ndarray:
    """Where the compared block, and the pixel around it that its slopes need, lies within both images' sides.

    Beyond a side only a copy of its last pixel is compared: disparities there err three to four times as much.
    """
    reach = (max(matcher.block, BM_BLOCK) if matcher.method == "bm" else matcher.block) // 2 + 1
    columns = np.arange(values.shape[1], dtype=np.float32)
    inside = lambda at: (at >= reach) & (at <= values.shape[1] - 1 - reach)
    return inside(columns) & inside(columns - values)


def _edges(values: np.ndarray, valid: np.ndarray, radius: int) -> np.ndarray:
    """The nearer side of depth edges: pixels with a valid neighbor within `radius` that is a step further away."""
    far = cv2.erode(np.where(valid, values, np.float32(np.inf)), np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    return valid & (values - far > STEP_PX)


def _without_speckles(values: np.ndarray, valid: np.ndarray, area: int) -> np.ndarray:
    gone = -(2**15) + 1
    fixed = np.where(valid, np.rint(values * SIXTEENTHS), gone).astype(np.int16)
    cv2.filterSpeckles(fixed, gone, area, STEP_PX * SIXTEENTHS)
    return valid & (fixed != gone)


def _refined(left: Image, right: Image, values: np.ndarray, valid: np.ndarray, rough: bool) -> tuple[np.ndarray, bool]:
    """Disparities moved by a step of Lucas and Kanade (IJCAI 1981), between two edge-keeping means; and if they are rough then.

    The step minimises the squared difference of left and shifted right image, less its mean (brightness may differ), over
    a Gaussian window. The means are bilateral: a neighbor counts less the further its disparity is. `rough` ones are moved by
    a second step, of a wider window and between wider means.
    """
    left, right = (grey(image).astype(np.float32) for image in (left, right))
    columns, rows = np.meshgrid(*(np.arange(size, dtype=np.float32) for size in left.shape[::-1]))
    slope = np.array([[1, -8, 0, 8, -1]], np.float32) / 12
    slopes = [cv2.filter2D(image, -1, slope) for image in (left, right)]
    here = valid.astype(np.float32)

    def mean(values: np.ndarray, reach: float) -> np.ndarray:
        low = np.float32(values[valid].min() - UNLIKE_PX)
        return cv2.bilateralFilter(np.where(valid, values, low), -1, ALIKE_PX, reach)

    def moved(start: np.ndarray, wide: float, furthest: float) -> np.ndarray:
        share = np.maximum(cv2.GaussianBlur(here, (0, 0), wide), 1e-6)
        window = lambda of: cv2.GaussianBlur(of * here, (0, 0), wide) / share
        gradient = (slopes[0] + cv2.remap(slopes[1], columns - start, rows, cv2.INTER_LINEAR)) / 2
        difference = left - cv2.remap(right, columns - start, rows, cv2.INTER_LINEAR)
        flat, plain = window(gradient), window(difference)
        # Two squared grey levels in the divisor keep pixels without texture where they are.
        step = (window(gradient * difference) - flat * plain) / (window(gradient**2) - flat**2 + 2)
        return np.where(valid, np.clip(start - step, values - furthest, values + furthest), values)

    new = moved(mean(values, SMOOTHING_PX), WINDOW_PX, LARGEST_STEP_PX)
    smooth = mean(new, SMOOTHING_PX)
    if rough:
        new = moved(mean(new, WIDER_SMOOTHING_PX), WIDER_WINDOW_PX, FURTHER_PX)
        smooth = mean(new, WIDER_SMOOTHING_PX)
    unlike = TO_STD * float(np.median(np.abs(new - smooth)[valid]))
    return np.where(valid, smooth, values), unlike > ROUGH * usual_std_px(len(values))


def example_pair() -> tuple[Path, Path, Rig]:
    """The bundled photographs, Middlebury 2003 "cones", and their rig.

    The rig's numbers are those of the sister scene of the same size: absolute lengths are nominal.
    """
    folder = Path(__file__).parent / "data" / "cones"
    return folder / "im2.png", folder / "im6.png", load_rig(folder / "calib.txt")
